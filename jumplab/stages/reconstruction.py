"""Planar view of a motion of the full robot: link angles, the toes' path, and planar quantities."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.robot import JOINT_OF_ANGLES, Robot
from jumplab.robot.contact import on_feet


def to_link_angles(
    robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Absolute link angles (n, 5) with rates and accelerations from full-robot q, v, a (n, .); the
    mean of left and right.
    """
    mean = np.zeros((4, len(robot.joint_names)))  # arms that are held stay at zero
    for name, row, sign in robot.role_signs():
        mean[row, robot.joint_names.index(name)] = sign
    mean /= np.maximum(np.abs(mean).sum(axis=1, keepdims=True), 1.0)
    pitch = np.unwrap(2 * np.arctan2(q[:, 4], q[:, 6]), period=2 * np.pi)
    levels = (q[:, 7:], pitch), (v[:, 6:], v[:, 4]), (a[:, 6:], a[:, 4])
    return tuple(robot.sagittal.link_angles(x @ mean.T, trunk) for x, trunk in levels)


def planar_columns(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Planar quantities of a motion in the plane, under the names that they have on a ``tape``,
    each (n,) or (n, size); places count from where the toes stood first, torques are of both sides.
    """
    angles, rates, accels = to_link_angles(robot, tape.q, tape.v, tape.a)
    toe, rho = _toe_and_inertia(robot, tape)
    torques = np.zeros((len(tape.t), len(JOINT_OF_ANGLES)))
    for name, row, sign in robot.role_signs():
        torques[:, row] += sign * tape.tau[:, robot.joint_names.index(name)]
    columns = {
        "angles": angles,
        "rates": rates,
        "accels": accels,
        "toe": toe - toe[0],
        "toe_phase_start": tape.extra["toe_phase_start"],
        "com": tape.extra["com"][:, [0, 2]] - toe[0],
        "com_velocity": tape.extra["com_velocity"][:, [0, 2]],
        "L": tape.extra["angular_momentum"][:, 1],
        "rho": rho,
        "joints": angles @ JOINT_OF_ANGLES.T,
        "joint_rates": rates @ JOINT_OF_ANGLES.T,
        "torques": torques,
    }
    return {f"planar_{name}": column for name, column in columns.items()}


def _toe_and_inertia(robot: Robot, tape: Tape) -> tuple[np.ndarray, np.ndarray]:
    """Place (n, 2) of the left toes' middle [m], x and z; pitch inertia (n,) [kg m^2]."""
    data = robot.model.createData()
    tip = on_feet(robot, robot.foot.tip)[0]
    toe = np.empty((len(tape.t), 2))
    rho = np.empty(len(tape.t))
    for k, (q, v) in enumerate(zip(tape.q, tape.v, strict=True)):
        pin.ccrba(robot.model, data, q, v)
        toe[k] = data.oMi[tip.joint].act(tip.placement.translation)[[0, 2]]
        rho[k] = data.Ig.inertia[1, 1]
    return toe, rho
