"""Causes of a failed jump: the first signs in its log, and their times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.control.kinematics import rotation
from jumplab.robot.legs import size
from jumplab.robot.stance import knees
from jumplab.sim import STEP_S
from jumplab.sim.checks import LOADED_N, friction_used, ground_of
from jumplab.sim.result import SimulationResult, motors_spent

# [1] of the friction, used for so long: the impact of a sound landing slides less
SLIDING = 0.97
SLIP_S = 0.03
# trunk off its stance, or a sole off the level, at touchdown; sound jumps stay at half
TURNED_RAD = 0.5
SOLE_RAD = 0.2
# a knee so close to its stop, for so long after touchdown
STOP_RAD = 0.02
STOP_S = 0.01
WEAK_S = 0.05  # a motor at the end of its torque for so long


@dataclass(frozen=True)
class Sign:
    """The earliest sign of one cause."""

    cause: str  # "slip", "over-rotation", "knee stop", "torque", "tip" or "other"
    time_s: float  # of the log

    def __str__(self) -> str:
        return f"{self.cause} from {self.time_s:.3f} s"


def signs(result: SimulationResult) -> tuple[Sign, ...]:
    """The earliest sign of each cause that the log of a failed jump shows, in order of time; none
    if it landed.

    The first one is taken for the cause. "slip": a loaded foot uses all its friction.
    "over-rotation": trunk or soles meet the ground turned too far, either way. "knee stop": after
    touchdown a knee leans on its end. "torque": a motor has no more to give. "tip": from then on
    the point where the robot would come to rest (CoM plus velocity over sqrt(g / z)) is beyond the
    soles. "other", at the end of the log, if there is none of them. Raises ValueError without a
    robot.
    """
    if result.landed:
        return ()
    if result.robot is None:
        raise ValueError("the log's robot is not known")
    until = int(np.argmax([*result.stray.any(axis=1), True]))
    down = int(np.argmax([*(result.phase == "landing"), True]))
    rows = {"slip": _slip(result, until), "torque": _torque(result, until)}
    if down < len(result.t):
        rows["over-rotation"] = _over_rotation(result, down)
    if down < until:
        rows["knee stop"] = _knee_stop(result, down, until)
        rows["tip"] = _tip(result, down, until)
    first = sorted((row, cause) for cause, row in rows.items() if row is not None)
    first = first or [(len(result.t) - 1, "other")]
    return tuple(Sign(cause, float(result.t[row])) for row, cause in first)


def _lasting(flags: np.ndarray, time_s: float) -> int | None:
    """Row where the first spell that lasts so long, in any column of ``flags`` (N, k), begins."""
    steps = round(time_s / STEP_S)
    if len(flags) < steps:
        return None
    lasts = np.lib.stride_tricks.sliding_window_view(flags, steps, axis=0).all(axis=-1).any(axis=1)
    return int(np.argmax(lasts)) if lasts.any() else None


def _slip(result: SimulationResult, until: int) -> int | None:
    least = size(result.robot).of(LOADED_N, "N")
    sliding = result.foot_wrench[:until, :, 2] > least
    row, side = np.nonzero(sliding)
    force = result.foot_wrench[row, side, :3]
    used = friction_used(force, result.feet[row, side, :3, 3], ground_of(result))
    sliding[row, side] = used >= SLIDING * result.settings["perturbation"]["friction"]
    return _lasting(sliding, SLIP_S)


def _over_rotation(result: SimulationResult, down: int) -> int | None:
    """Whether trunk or soles are turned too far at the touchdown."""
    soles = result.feet[down, :, 2, 2]
    # up, seen by the trunk, as it is in the stance
    pitch = result.robot.stance["trunk_pitch_rad"]
    trunk = rotation(result.q[down, 3:7])[2] @ [-np.sin(pitch), 0.0, np.cos(pitch)]
    return down if trunk < np.cos(TURNED_RAD) or min(soles) < np.cos(SOLE_RAD) else None


def _knee_stop(result: SimulationResult, down: int, until: int) -> int | None:
    rows = [k for k, _, _ in knees(result.robot)]
    motors = result.robot.limits[rows]
    angles = result.q[down:until, 7:][:, rows]
    near = (angles < motors.lower + STOP_RAD) | (angles > motors.upper - STOP_RAD)
    row = _lasting(near, STOP_S)
    return None if row is None else down + row


def _torque(result: SimulationResult, until: int) -> int | None:
    motors = result.robot.limits
    return _lasting(motors_spent(motors, result.tau[:until], result.v[:until, 6:]), WEAK_S)


def _tip(result: SimulationResult, down: int, until: int) -> int | None:
    """From when on the capture point stays beyond the soles."""
    rows = slice(down, until)
    corners = np.column_stack([result.robot.foot.corners, np.ones(4)])
    feet = result.feet[rows] @ corners.T  # (rows, 2, 4, corners of a sole)
    low = feet.min(axis=(1, 3))[:, :3]
    high = feet.max(axis=(1, 3))[:, :3]
    com = result.com[rows]
    height = np.maximum(com[:, 2] - low[:, 2], STEP_S)
    pendulum_s = np.sqrt(height / result.robot.gravity)
    rests = com + result.com_velocity[rows] * pendulum_s[:, None]
    inside = ((low <= rests) & (rests <= high))[:, :2].all(axis=1)
    last = down + int(np.flatnonzero([True, *inside])[-1])
    return last if last < until else None
