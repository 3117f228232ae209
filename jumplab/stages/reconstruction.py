"""What a motion of the full robot is in the plane: link angles, the toes' path, and planar quantities."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.models.planar import evaluator
from jumplab.robot import Robot

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


def to_link_angles(
    robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Absolute link angles (n, 5) with rates and accelerations from full-robot q, v, a; the mean of left and right."""
    model, sagittal = robot.model, robot.sagittal
    parts = [[(model.getJointId(n), sign) for n, row, sign in robot.role_signs() if row == i] for i in range(4)]
    iq = [[(model.idx_qs[j], sign) for j, sign in part] for part in parts]
    iv = [[(model.idx_vs[j], sign) for j, sign in part] for part in parts]
    pitch = np.unwrap(2 * np.arctan2(q[:, 4], q[:, 6]), period=2 * np.pi)
    out = []
    for values, index, trunk in ((q, iq, pitch), (v, iv, v[:, 4]), (a, iv, a[:, 4])):
        joints = np.zeros((len(values), 4))  # arms that are held stay at zero
        for i, pair in enumerate(index):
            if pair:
                joints[:, i] = np.mean([sign * values[:, column] for column, sign in pair], axis=0)
        out.append(sagittal.link_angles(joints, trunk))
    return tuple(out)


def planar_columns(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Planar quantities of a motion in the plane, under the names that they have on a tape; places count from where the
    toes stood first."""
    angles, rates, accels = to_link_angles(robot, tape.q, tape.v, tape.a)
    toe, velocity, acceleration = _toe_motion(robot, tape)
    values = planar_quantities(robot, angles, rates, accels, acceleration, robot.gravity)
    out = {"angles": angles, "rates": rates, "accels": accels, "toe": toe, "toe_velocity": velocity}
    out |= {"toe_acceleration": acceleration, "toe_phase_start": tape.extra["toe_phase_start"]}
    out |= {"com": toe + values["com"], "com_velocity": velocity + values["com_velocity"]}
    out |= {name: values[name] for name in ("L", "rho", "rho_rate", "joints", "joint_rates", "torques")}
    return {f"planar_{name}": x for name, x in out.items()}


def _toe_motion(robot: Robot, tape: Tape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place of the left toes' middle from where it was first, velocity and acceleration, each (n, 2), x and z."""
    model, data, frame = robot.model, robot.model.createData(), robot.model.getFrameId(robot.foot.frames[0])
    axes, n = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, len(tape.t)
    origin, arm, speed, gain = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 6)), np.empty((n, 6))
    for k, motion in enumerate(zip(tape.q, tape.v, tape.a, strict=True)):
        pin.forwardKinematics(model, data, *motion)
        placed = pin.updateFramePlacement(model, data, frame)
        origin[k], arm[k] = placed.translation, placed.rotation @ robot.foot.tip
        speed[k] = pin.getFrameVelocity(model, data, frame, axes).vector
        gain[k] = pin.getFrameClassicalAcceleration(model, data, frame, axes).vector
    spin = speed[:, 3:]
    velocity = speed[:, :3] + np.cross(spin, arm)
    acceleration = gain[:, :3] + np.cross(gain[:, 3:], arm) + np.cross(spin, np.cross(spin, arm))
    place = (origin + arm)[:, [0, 2]]
    return place - place[0], velocity[:, [0, 2]], acceleration[:, [0, 2]]
