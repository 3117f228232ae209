"""Is a simulated jump what it claims to be? Every finding is made from the logs, or read back from the engine.

The strongest one asks mechanics: the logged motion, torques and foot forces must obey the robot's equations of motion.
They leave no room for a hand that holds the base, a motor that gives more than it says, or a velocity set.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import rotation
from jumplab.sim.playback import Actuators
from jumplab.sim.result import STAND_S, Finding, SimulationResult

WINDOW = 100  # [steps] 0.1 s; a push shorter than that counts by its mean
# Sound jumps and flips leave 1e-10 N, 0.02 N m, and in the joints up to 1 N m at an impact.
UNEXPLAINED_FORCE_N, UNEXPLAINED_MOMENT, UNEXPLAINED_TORQUE = 1.0, 0.5, 3.0  # [N], [N m], [N m]
NUMERIC = 1e-6  # rounding
JUMP_M = 1e-4  # [m, rad] the engine's own step is kept to 1e-5
STOP_RAD = 0.02  # this close to its stop, a joint may lean on it
LOADED_N = 50.0  # below it, CoP and friction ratio are rounding
SOLE_M = 0.001  # contact points of sound feet lie within the sole to 1e-7 m
FRICTION_USE = 1.01  # 1.0001 was seen where feet slide


def check(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    """All findings about ``result`` of ``robot``: the planned one with the stated perturbation."""
    return tuple(f for part in (_mechanics, _limits, _feet, _engine, _landing) for f in part(result, robot))


def _mechanics(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    base, joints = unexplained(result, robot)
    q, v, model = result.q, result.v, robot.model
    moved = [pin.integrate(model, a, b * STEP_S) for a, b in zip(q[:-1], v[1:], strict=True)]
    missed = [np.abs(pin.difference(model, a, b)).max() for a, b in zip(moved, q[1:], strict=True)]
    uneven = np.abs(np.diff(result.t) - STEP_S).max(initial=0.0)
    hidden = "a pinned or carried base, a force from nowhere"
    return (
        Finding("unexplained force on the body", _worst(base[:, :3]), UNEXPLAINED_FORCE_N, "N", hidden),
        Finding("unexplained moment on the body", _worst(base[:, 3:]), UNEXPLAINED_MOMENT, "N m", hidden),
        Finding("unexplained joint torque", _worst(joints), UNEXPLAINED_TORQUE, "N m", "motors stronger than logged"),
        Finding("largest jump of the state", float(np.max(missed, initial=0.0)), JUMP_M, "m or rad", "a reset"),
        Finding("unevenness of time", float(uneven), NUMERIC, "s", "a gap in the log"),
    )


def unexplained(result: SimulationResult, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Generalised forces that neither torques nor foot forces explain: on the base (N - 1, 6), in the joints.

    Zero where the log does not say what acted: when other links touch the ground, in joints at their stops, and in all
    joints while links press on each other.
    """
    model, data = robot.model, robot.model.createData()
    frames, axes = [model.getFrameId(n) for n in robot.foot.frames], pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    acceleration = _accelerations(result, robot)
    left = np.empty_like(acceleration)
    for k, (q, v, a) in enumerate(zip(result.q, result.v, acceleration, strict=False)):
        pin.computeJointJacobians(model, data, q)
        left[k] = pin.rnea(model, data, q, v, a)
        for frame, wrench in zip(frames, result.foot_wrench[k], strict=True):
            if wrench.any():
                pin.updateFramePlacement(model, data, frame)
                left[k] -= pin.getFrameJacobian(model, data, frame, axes).T @ wrench
    left[:, 6:] -= result.tau[:-1]
    feet = np.isin(result.link_names, robot.foot.frames)
    left[result.touching[:-1, ~feet].any(axis=1)] = 0.0
    motors, angle = Actuators(robot), result.q[:-1, 7:]
    at_stop = (angle < motors.lower + STOP_RAD) | (angle > motors.upper - STOP_RAD)
    return left[:, :6], np.where(at_stop | result.colliding[:-1, None], 0.0, left[:, 6:])


def _accelerations(result: SimulationResult, robot: Robot) -> np.ndarray:
    """Accelerations (N - 1, nv) of the engine's steps, which step the velocity of the base's CoM in world axes.

    Differences of the base twist in its own axes, which turn within the step, would be off by 17 N in a flip.
    """
    arm = robot.model.inertias[1].lever  # from the base's origin to its CoM, base axes
    turn = np.array([rotation(quaternion) for quaternion in result.q[:, 3:7]])
    spin, speed = result.v[:, 3:6], result.v[:, :3]

    def stepped(vectors: np.ndarray) -> np.ndarray:
        """Rate of change in the world, in base axes."""
        return np.einsum("kji,kj->ki", turn[:-1], np.diff(np.einsum("kij,kj->ki", turn, vectors), axis=0) / STEP_S)

    turning, moving, spin, speed = stepped(spin), stepped(speed + np.cross(spin, arm)), spin[:-1], speed[:-1]
    origin = moving - np.cross(turning, arm) - np.cross(spin, np.cross(spin, arm))
    joints = np.diff(result.v[:, 6:], axis=0) / STEP_S
    return np.hstack([origin - np.cross(spin, speed), turning, joints])


def _worst(force: np.ndarray) -> float:
    """Largest mean over a window of any column of (N, k)."""
    total = np.vstack([np.zeros(force.shape[1]), np.cumsum(force, axis=0)])
    window = min(WINDOW, len(force))
    return float(np.abs(total[window:] - total[:-window]).max(initial=0.0) / max(1, window))


def _limits(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    low, high = Actuators(robot).range(result.v[:, 6:])
    excess = np.maximum(result.tau - high, low - result.tau).max(initial=0.0)
    return (Finding("torque beyond the motors", float(excess), NUMERIC, "N m", "unlimited torque"),)


def _feet(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    """Friction and CoP of each foot, from its measured wrench."""
    model, data, foot = robot.model, robot.model.createData(), robot.foot
    frames = [model.getFrameId(name) for name in foot.frames]
    slip, outside = 0.0, 0.0
    for k in np.flatnonzero((result.foot_wrench[:, :, 2] > LOADED_N).any(axis=1)):
        pin.framesForwardKinematics(model, data, result.q[k])
        for frame, wrench in zip(frames, result.foot_wrench[k], strict=True):
            if wrench[2] <= LOADED_N:
                continue
            slip = max(slip, np.hypot(*wrench[:2]) / wrench[2])
            turn = data.oMf[frame].rotation
            force, moment = turn.T @ wrench[:3], turn.T @ wrench[3:]
            x, y = (foot.sole_z * force[:2] + [-moment[1], moment[0]]) / force[2]
            outside = max(outside, foot.heel - x, x - foot.toe, abs(y - foot.center[1]) - foot.half_width)
    stated = result.settings["perturbation"]["friction"]
    return (
        Finding("friction used, of the stated coefficient", slip / stated, FRICTION_USE, "", "sticky feet"),
        Finding("CoP outside the sole", outside, SOLE_M, "m", "oversized feet"),
    )


def _engine(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    """What the engine said at the end of the run, against what was stated."""
    engine, stated = result.settings["engine"], result.settings["perturbation"]["friction"]
    miss = max(abs(friction - stated) for friction in engine["friction"])
    through, lost = float(not engine["self_collision"]), abs(engine["mass_kg"] - robot.total_mass)
    return (
        Finding("friction read back, less the stated", miss, NUMERIC, "", "friction that never reached the feet"),
        Finding("contact points outside the sole", engine["beyond_sole_m"], SOLE_M, "m", "oversized feet"),
        Finding("links that pass through each other", through, 0.0, "", "self-collision switched off"),
        Finding("mass read back, less the stated", lost, 1e-3, "kg", "a lighter robot"),
    )


def _landing(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    """Seconds that a claimed landing falls short of standing on the feet alone, from touchdown on."""
    down = np.flatnonzero(result.phase == "landing")
    feet = np.isin(result.link_names, robot.foot.frames)
    stood = 0.0
    if len(down):
        stray = np.flatnonzero(result.touching[down[0] :, ~feet].any(axis=1))
        stood = STEP_S * (stray[0] if len(stray) else len(result.t) - down[0])
    short = max(0.0, STAND_S - stood) if result.metrics.landed else 0.0
    return (Finding("claimed landing, short of 3 s by", short, NUMERIC, "s", "a landing shorter than 3 s"),)
