"""From the symmetric plan to the full robot: the 1 kHz tape (last step of Sec. V: "symmetrically on each leg")."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import RATE_HZ, Tape
from jumplab.models.planar import evaluator
from jumplab.ocp import PhaseSolution
from jumplab.robot import Robot
from jumplab.robot.stance import configuration

SHORTEST_STEP = 0.05  # share of a sample; a shorter last step is joined to the one before
COM = ("com", "com_velocity", "com_acceleration")
_EVALUATORS: dict = {}


def planar_quantities(
    robot: Robot,
    angles: np.ndarray,
    rates: np.ndarray,
    accels: np.ndarray,
    toe_acceleration: np.ndarray,
    gravity: float,
    names: tuple[str, ...] | None = None,
) -> dict[str, np.ndarray]:
    """Planar quantities, all or some, at n instants: name -> (n, size) or (n,).

    Inputs are (n, 5), (n, 5), (n, 5), (n, 2); names as in :func:`jumplab.models.planar.evaluator`.
    """
    known, whole = _EVALUATORS.setdefault((robot.hash, gravity), {}), None
    if whole not in known:
        known[whole] = evaluator(robot.sagittal, gravity)
    if names not in known:
        known[names] = known[whole].factory("some", known[whole].name_in(), list(names))
    out = known[names].map(len(angles))(angles=angles.T, rates=rates.T, accels=accels.T, toe=toe_acceleration.T)
    return {k: v.full().T.squeeze() for k, v in out.items()}


def planar_motion(phases: dict[str, PhaseSolution], gravity: float, robot: Robot) -> dict[str, np.ndarray]:
    """Sample the planner's own interpolant at 1 kHz: t, angles, rates, accels (n, 5), toe with derivatives (n, 2).

    The grid is laid so that take-off falls on a sample (which appears twice): the robot stands still for up to 1 ms
    more at the start. The last sample is the touchdown itself.
    """
    flat, toe, flight = phases["flat"], phases["toe"], phases["flight"]
    launch_s = flat.duration + toe.duration
    steps = int(np.ceil(launch_s * RATE_HZ - 1e-9))
    t_launch = launch_s - np.arange(steps, -1, -1) / RATE_HZ
    q, v, a = _launch_samples(flat, toe, np.maximum(t_launch, 0.0))
    t_flight = np.append(np.arange(0, flight.duration - SHORTEST_STEP / RATE_HZ, 1 / RATE_HZ), flight.duration)
    qf, vf, af = flight.sample(t_flight)
    c, t = flight.constants, t_flight
    com = np.stack([c["com_x"] + c["vel_x"] * t, c["com_z"] + c["vel_z"] * t - gravity * t**2 / 2], -1)
    com_v = np.stack([np.full_like(t, c["vel_x"]), c["vel_z"] - gravity * t], -1)
    rel = planar_quantities(robot, qf, vf, af, np.zeros((len(qf), 2)), gravity, COM)
    fall = np.array([0.0, -gravity])
    start, zeros = t_launch[0], np.zeros((len(t_launch), 2))
    return {
        "t": np.concatenate([t_launch - start, launch_s - start + t]),
        "angles": np.concatenate([q, qf]),
        "rates": np.concatenate([v, vf]),
        "accels": np.concatenate([a, af]),
        "toe": np.concatenate([zeros, com - rel["com"]]),
        "toe_velocity": np.concatenate([zeros, com_v - rel["com_velocity"]]),
        "toe_acceleration": np.concatenate([zeros, fall - rel["com_acceleration"]]),
        "flying": np.repeat([False, True], [len(t_launch), len(t)]),
        "toe_phase_start": np.array(flat.duration - start),
    }


def _launch_samples(flat, toe, t):
    """Angles, rates and accelerations (n, 5) at times of the launch; the flat foot does not turn."""
    first = t < flat.duration
    still = np.zeros((int(first.sum()), 1))
    later = toe.sample(np.minimum(t[~first] - flat.duration, toe.duration))
    return [np.concatenate([np.hstack([still, x]), y]) for x, y in zip(flat.sample(t[first]), later, strict=True)]


def expand(
    motion: dict[str, np.ndarray],
    robot: Robot,
    gravity: float,
    extra: dict | None = None,
    wrench: np.ndarray | None = None,
) -> Tape:
    """Full-robot tape from a sampled planar motion (see :func:`planar_motion`); x is zero mid-sole at the start.

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
        wrench = planar_quantities(robot, *now, gravity, ("ground_wrench",))["ground_wrench"]
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
    return wrenches, tau + robot.lost_torque(v[:, 6:]) if robot.lossy else tau


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
