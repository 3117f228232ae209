"""Why a jump failed: what its log shows first, and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.robot.stance import knees
from jumplab.sim import STEP_S
from jumplab.sim.checks import LOADED_N, friction_used, ground_of
from jumplab.sim.playback import Actuators
from jumplab.sim.result import SATURATED, SimulationResult

CAUSES = ("slip", "over-rotation", "knee stop", "torque", "tip", "other")
SLIDING, SLIP_S = 0.97, 0.03  # [1] of the friction, used for so long: the impact of a sound landing slides less
TURNED_RAD, SOLE_RAD = 0.5, 0.2  # trunk off its stance, or a sole off the level, at touchdown; sound jumps stay at half
STOP_RAD, STOP_S = 0.02, 0.01  # a knee so close to its stop, for so long after touchdown
WEAK_S = 0.05  # a motor at the end of its torque for so long


@dataclass(frozen=True)
class Sign:
    """The earliest sign of one cause."""

    cause: str  # one of :data:`CAUSES`
    time_s: float  # of the log

    def __str__(self) -> str:
        return f"{self.cause} from {self.time_s:.3f} s"


def signs(result: SimulationResult) -> tuple[Sign, ...]:
    """The earliest sign of each cause that the log of a failed jump shows, in order of time; none if it landed.

    The first one is taken for the cause. "slip": a loaded foot uses all its friction. "over-rotation": trunk or soles
    meet the ground turned too far, either way. "knee stop": after touchdown a knee leans on its end. "torque": a motor
    has no more to give. "tip": from then on the point where the robot would come to rest (CoM plus velocity over
    sqrt(g / z)) is beyond the soles. "other", at the end of the log, if there is none of them. Raises ValueError
    without a robot.
    """
    if result.landed:
        return ()
    if result.robot is None:
        raise ValueError("the log's robot is not known")
    feet = np.isin(result.link_names, result.robot.foot.frames)
    fallen = np.flatnonzero(result.touching[:, ~feet].any(axis=1))
    until = int(fallen[0]) if len(fallen) else len(result.t)
    down = np.flatnonzero(result.phase == "landing")
    down = int(down[0]) if len(down) else None
    makers = (_slip, _over_rotation, _knee_stop, _torque, _tip)
    rows = [(make(result, down, until), cause) for make, cause in zip(makers, CAUSES, strict=False)]
    found = sorted((row, cause) for row, cause in rows if row is not None)
    return tuple(Sign(cause, float(result.t[row])) for row, cause in found) or (Sign("other", float(result.t[-1])),)


def _lasting(flags: np.ndarray, time_s: float) -> int | None:
    """Row where the first spell of ``flags`` (N,) that lasts so long begins."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    spells = edges.reshape(-1, 2)
    long = spells[np.diff(spells, axis=1)[:, 0] * STEP_S >= time_s - STEP_S / 2]
    return int(long[0, 0]) if len(long) else None


def _first(rows: list[int | None]) -> int | None:
    return min((row for row in rows if row is not None), default=None)


def _slip(result: SimulationResult, down: int | None, until: int) -> int | None:
    model, data = result.robot.model, result.robot.model.createData()
    frames, ground = [model.getFrameId(name) for name in result.robot.foot.frames], ground_of(result)
    sliding, most = result.foot_wrench[:until, :, 2] > LOADED_N, SLIDING * result.settings["perturbation"]["friction"]
    for k in np.flatnonzero(sliding.any(axis=1)):
        pin.framesForwardKinematics(model, data, result.q[k])
        for side in np.flatnonzero(sliding[k]):
            used = friction_used(result.foot_wrench[k, side, :3], data.oMf[frames[side]], ground)
            sliding[k, side] = used >= most
    return _first([_lasting(foot, SLIP_S) for foot in sliding.T])


def _over_rotation(result: SimulationResult, down: int | None, until: int) -> int | None:
    if down is None:
        return None
    robot, model = result.robot, result.robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, result.q[down])
    # up, seen by the trunk, as it is in the stance
    stance = np.array([-np.sin(robot.stance["trunk_pitch_rad"]), 0.0, np.cos(robot.stance["trunk_pitch_rad"])])
    trunk = np.arccos(np.clip(data.oMi[1].rotation[2] @ stance, -1.0, 1.0))
    soles = [np.arccos(np.clip(data.oMf[model.getFrameId(f)].rotation[2, 2], -1.0, 1.0)) for f in robot.foot.frames]
    return down if trunk > TURNED_RAD or max(soles) > SOLE_RAD else None


def _knee_stop(result: SimulationResult, down: int | None, until: int) -> int | None:
    if down is None or down >= until:
        return None
    motors, rows = Actuators(result.robot), [k for k, _, _ in knees(result.robot)]
    angles = result.q[down:until, 7:][:, rows]
    near = (angles < motors.lower[rows] + STOP_RAD) | (angles > motors.upper[rows] - STOP_RAD)
    found = _first([_lasting(knee, STOP_S) for knee in near.T])
    return None if found is None else down + found


def _torque(result: SimulationResult, down: int | None, until: int) -> int | None:
    low, high = Actuators(result.robot).range(result.v[:until, 6:])
    tau = result.tau[:until]
    spent = (np.abs(tau) >= SATURATED * np.where(tau > 0, high, -low)) & (tau != 0)
    return _first([_lasting(joint, WEAK_S) for joint in spent.T])


def _tip(result: SimulationResult, down: int | None, until: int) -> int | None:
    if down is None or down >= until:
        return None
    robot, model, beyond = result.robot, result.robot.model, []
    data, frames = model.createData(), [model.getFrameId(name) for name in robot.foot.frames]
    for q, com, speed in zip(
        result.q[down:until], result.com[down:until], result.com_velocity[down:until], strict=True
    ):
        pin.framesForwardKinematics(model, data, q)
        corners = np.array([data.oMf[frame].act(corner) for frame in frames for corner in robot.foot.corners])
        height = max(float(com[2] - corners[:, 2].min()), STEP_S)
        rests = com[:2] + speed[:2] * np.sqrt(height / robot.gravity)
        beyond.append(((rests < corners[:, :2].min(axis=0)) | (rests > corners[:, :2].max(axis=0))).any())
    inside = np.flatnonzero(~np.array(beyond))
    last = int(inside[-1]) + 1 if len(inside) else 0
    return down + last if last < len(beyond) else None
