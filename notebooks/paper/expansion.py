"""A planar motion of five links as a tape of the full robot (last step of Sec. V: "symmetrically on each leg").

For what the paper prints; the whole-body program has the full robot's coordinates itself.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.stance import configuration
from paper.planar import planar_quantities


def expand(
    motion: dict[str, np.ndarray],
    robot: Robot,
    gravity: float,
    extra: dict | None = None,
    wrench: np.ndarray | None = None,
) -> Tape:
    """Full-robot tape from a sampled planar motion; x is zero mid-sole at the start.

    ``motion`` has t, flying (n,), angles, rates, accels (n, 5), toe, toe_velocity, toe_acceleration (n, 2).
    ``wrench`` (n, 3) is the planar ground wrench if it is known already; in flight it is not looked at.
    Foot wrenches are half of the planar ground wrench each; joint torques follow from inverse dynamics of the full
    robot, whose base rows are left for the audit to judge.
    """
    model, n, roles = robot.model, len(motion["t"]), robot.role_signs()
    columns = [model.idx_vs[model.getJointId(name)] for name, _, _ in roles]
    role, signs = [row for _, row, _ in roles], np.array([sign for _, _, sign in roles])
    angles, rates, accels, flying = (motion[k] for k in ("angles", "rates", "accels", "flying"))
    toe = motion["toe"] - robot.sagittal.sole_center
    q = configuration(robot, angles, toe)
    v, a = np.zeros((n, model.nv)), np.zeros((n, model.nv))
    v[:, columns] = robot.sagittal.joint_angles(rates)[:, role] * signs
    a[:, columns] = robot.sagittal.joint_angles(accels)[:, role] * signs
    base_v, base_a = _base_motion(robot, motion)
    pitch, w = angles[:, 3], rates[:, 3]
    v[:, [0, 2]], v[:, 4] = _into_body(pitch, base_v), w
    # derivative of the body-frame velocity: R' (a - w x v)
    cross = np.stack([w * base_v[:, 1], -w * base_v[:, 0]], -1)
    a[:, [0, 2]], a[:, 4] = _into_body(pitch, base_a - cross), accels[:, 3]
    if wrench is None:
        now = angles, rates, accels, motion["toe_acceleration"]
        wrench = planar_quantities(robot, *now, gravity)["ground_wrench"]
    wrench = np.where(flying[:, None], 0.0, wrench)
    f, tau = _forces(robot.under_gravity(gravity), q, v, a, wrench, toe, ~flying)
    phase, names = np.where(flying, "flight", "launch"), (np.array(robot.foot.frames), np.array(robot.joint_names))
    extra = {f"planar_{k}": x for k, x in motion.items() if k not in ("t", "flying")} | (extra or {})
    return Tape(motion["t"], q, v, a, tau, phase, names[0], f, names[1], extra)


def _into_body(pitch, vectors):
    c, s = np.cos(pitch), np.sin(pitch)
    return np.stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]], -1)


def _base_motion(robot, motion):
    """World velocity and acceleration (n, 2) of the base link's origin."""
    model = robot.sagittal
    arms = [*model.span[:3], model.base]
    v, a = motion["toe_velocity"].copy(), motion["toe_acceleration"].copy()
    for j, arm in enumerate(arms):
        angle, w, b = motion["angles"][:, j], motion["rates"][:, j], motion["accels"][:, j]
        c, s = np.cos(angle), np.sin(angle)
        place = np.stack([c * arm[0] + s * arm[1], -s * arm[0] + c * arm[1]], -1)
        across = np.stack([place[:, 1], -place[:, 0]], -1)
        v += across * w[:, None]
        a += across * b[:, None] - place * w[:, None] ** 2
    return v, a


def _forces(robot, q, v, a, wrench, toe, on_ground):
    """Wrenches on the feet (n, K, 6), half of the planar one (n, 3) each, and the motor torques that go with them."""
    model = robot.model
    data = model.createData()
    f, external = _foot_wrenches(robot, data, q[on_ground], wrench[on_ground], toe[on_ground])
    wrenches, tau = np.zeros((len(q), *f.shape[1:])), np.empty((len(q), model.nv - 6))
    wrenches[on_ground] = f
    forces = pin.StdVec_Force()
    forces.extend([pin.Force.Zero() for _ in range(model.njoints)])
    joints = [model.frames[model.getFrameId(name)].parentJoint for name in robot.foot.frames]
    for k, local in zip(np.flatnonzero(on_ground), external, strict=True):
        for joint, one in zip(joints, local, strict=True):
            forces[joint] = pin.Force(one)
        tau[k] = pin.rnea(model, data, q[k], v[k], a[k], forces)[6:]
    for k in np.flatnonzero(~on_ground):
        tau[k] = pin.rnea(model, data, q[k], v[k], a[k])[6:]
    return wrenches, tau + robot.limits.lost(v[:, 6:]) if robot.limits.lossy else tau


def _foot_wrenches(robot, data, q, wrench, toe):
    """Wrenches (n, K, 6) on the feet: at the frames' origins in world axes, and at their joints in the joints' axes."""
    model = robot.model
    frames = [model.frames[model.getFrameId(name)] for name in robot.foot.frames]
    joints = [frame.parentJoint for frame in frames]
    seen = [(data.oMi[joint].rotation, data.oMi[joint].translation) for joint in joints]  # follow the scratch data
    turn, place = np.empty((len(q), len(frames), 3, 3)), np.empty((len(q), len(frames), 3))
    for k, x in enumerate(q):
        pin.forwardKinematics(model, data, x)
        for i, (rotation, translation) in enumerate(seen):
            turn[k, i], place[k, i] = rotation, translation
    offset = np.einsum("kiab,ib->kia", turn, np.array([frame.placement.translation for frame in frames]))
    lever = np.zeros_like(place)  # frame to toe
    lever[..., [0, 2]] = toe[:, None] - (place + offset)[..., [0, 2]]
    force, moment = np.zeros_like(place), np.zeros_like(place)
    force[..., [0, 2]] = wrench[:, None, :2] / 2
    moment[..., 1] = wrench[:, None, 2] / 2 + lever[..., 2] * force[..., 0] - lever[..., 0] * force[..., 2]
    at_joint = np.concatenate([force, moment + np.cross(offset, force)], -1)
    local = np.einsum("kiba,kicb->kica", turn, at_joint.reshape(*place.shape[:2], 2, 3)).reshape(*place.shape[:2], 6)
    return np.concatenate([force, moment], -1), local
