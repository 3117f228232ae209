"""Is a simulated jump what it claims to be? Every finding is made from the logs, or read back from the engine.

The strongest one asks mechanics: the logged motion, torques and foot forces must obey the robot's equations of motion.
They leave no room for a hand that holds the base, a motor that gives more than it says, or a velocity set.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.robot.description import Foot
from jumplab.sim import STEP_S
from jumplab.sim.armature import Armature
from jumplab.sim.kinematics import rotation
from jumplab.sim.playback import Actuators
from jumplab.sim.result import STAND_S, Finding, SimulationResult
from jumplab.sim.scene import Scene

WINDOW = 100  # [steps] 0.1 s; a push shorter than that counts by its mean
# Sound jumps and flips leave 1e-10 N, 0.02 N m, and in the joints up to 1 N m at an impact.
UNEXPLAINED_FORCE_N, UNEXPLAINED_MOMENT, UNEXPLAINED_TORQUE = 1.0, 0.5, 3.0  # [N], [N m], [N m]
# Substeps are of first order and not logged: of an impact, and of fast legs after it, jumps leave 1.3 N and 1.4 N m,
# flips 3.9 N and 3.5 N m.
SUBSTEPPED_FORCE_N, SUBSTEPPED_MOMENT = 6.0, 6.0  # [N], [N m] 1.5 % of the weight
NUMERIC = 1e-6  # rounding
JUMP_M = 1e-4  # [m, rad] the engine's own step is kept to 1e-5
SUBSTEPPED_JUMP_M = 1e-3  # [m, rad] a light foot that chatters swings by 0.2 mrad within a step and is back at its end
SWING = 3.0  # [1] where a contact begins or ends, velocities swing within a step by some times what the log shows
SLIDES = 0.5  # [rad/s] from here on dry friction is there in full: engines let it grow over some tenths
STOP_RAD = 0.02  # this close to its stop, a joint may lean on it
LOADED_N = 50.0  # below it, CoP and friction ratio are rounding
SOLE_M = 0.001  # contact points of sound feet lie within the sole to 1e-7 m
FACING = 0.7  # [1] a sole that is turned by less than 45 degrees is what touches the ground of a foot
FRICTION_USE = 1.01  # 1.0001 was seen where feet slide


def check(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    """All findings about ``result`` of ``robot``: the planned one with the stated perturbation."""
    return tuple(f for part in (_mechanics, _limits, _feet, _engine, _landing) for f in part(result, robot))


def _mechanics(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    base, joints = unexplained(result, robot)
    uneven = np.abs(np.diff(result.t) - STEP_S).max(initial=0.0)
    one = result.settings["engine"]["substeps"] == 1
    limits = UNEXPLAINED_FORCE_N, UNEXPLAINED_MOMENT, JUMP_M
    force, moment, jump = limits if one else (SUBSTEPPED_FORCE_N, SUBSTEPPED_MOMENT, SUBSTEPPED_JUMP_M)
    hidden = "a pinned or carried base, a force from nowhere"
    return (
        Finding("unexplained force on the body", _worst(base[:, :3]), force, "N", hidden),
        Finding("unexplained moment on the body", _worst(base[:, 3:]), moment, "N m", hidden),
        Finding("unexplained joint torque", _worst(joints), UNEXPLAINED_TORQUE, "N m", "motors stronger than logged"),
        Finding("largest jump of the state", _largest_jump(result, robot), jump, "m or rad", "a reset"),
        Finding("unevenness of time", float(uneven), NUMERIC, "s", "a gap in the log"),
    )


def _largest_jump(result: SimulationResult, robot: Robot) -> float:
    """How far a state is from where its velocities lead [m, rad].

    Within a step of n semi-implicit ones, the velocity that moves the robot lies about v + (1 + 1 / n) / 2 dv, and
    further away only by what the logged forces of the ground may do to it within the step and undo.
    """
    least, model = 1 / result.settings["engine"]["substeps"], robot.model
    change = np.diff(result.v, axis=0)
    mean, room = result.v[:-1] + (1 + least) / 2 * change, SWING * (1 - least) * np.abs(change).max(axis=1) * STEP_S
    there = [pin.integrate(model, q, v * STEP_S) for q, v in zip(result.q[:-1], mean, strict=True)]
    miss = [pin.difference(model, a, b) for a, b in zip(there, result.q[1:], strict=True)]
    left = np.abs(miss) - room[:, None]
    for k in np.flatnonzero(left.max(axis=1, initial=0.0) > JUMP_M) if least < 1 else ():
        left[k] -= (1 - least) * STEP_S * _kick(result, robot, k)
    return float(left.max(initial=0.0))


def _kick(result: SimulationResult, robot: Robot, row: int) -> np.ndarray:
    """By how much (nv,) one step's forces change velocities at most, wherever along the soles they act first."""
    model, data, q = robot.model, robot.model.createData(), result.q[row]
    mass = pin.crba(model, data, q)
    mass = np.triu(mass) + np.triu(mass, 1).T
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    kick, ends = np.zeros(model.nv), (robot.foot.heel, robot.foot.toe)
    for name, wrench in zip(robot.foot.frames, result.foot_wrench[row], strict=True):
        jacobian = pin.getFrameJacobian(model, data, model.getFrameId(name), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        places = [wrench, *(np.array([*wrench[:3], wrench[3], -x * wrench[2], wrench[5]]) for x in ends)]
        kick += np.abs(np.linalg.solve(mass, STEP_S * jacobian.T @ np.array(places).T)).max(axis=1)
    return kick


def _pushes(result: SimulationResult, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Stated external forces (N, 3) in every step [N], and the place (3,) in the base link's frame on which they act.

    The place is the centre of mass of the planned trunk, and not that of the real one with its payload.
    """
    force = np.zeros((len(result.t), 3))
    for told in result.settings.get("pushes", ()):
        begin = max(0, told["step"])
        force[begin : max(0, told["step"] + told["steps"])] += told["force_n"]
    return force, np.array(result.settings.get("push_place_m", (0.0, 0.0, 0.0)))


def unexplained(result: SimulationResult, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Generalised forces that neither torques nor foot forces explain: on the base (N - 1, 6), in the joints.

    Zero where the log does not say what acted: when other links touch the ground, in joints at their stops, and in all
    joints while links press on each other.
    """
    model, data = robot.model, robot.model.createData()
    frames, axes = [model.getFrameId(n) for n in robot.foot.frames], pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    states = _steps(result, robot)
    left, (pushes, place) = np.empty_like(states[2]), _pushes(result, robot)
    for k, (q, v, a) in enumerate(zip(*states, strict=True)):
        pin.computeJointJacobians(model, data, q)
        left[k] = pin.rnea(model, data, q, v, a)
        for frame, wrench in zip(frames, result.foot_wrench[k], strict=True):
            if wrench.any():
                pin.updateFramePlacement(model, data, frame)
                left[k] -= pin.getFrameJacobian(model, data, frame, axes).T @ wrench
        if pushes[k].any():
            force = rotation(q[3:7]).T @ pushes[k]
            left[k, :6] -= [*force, *np.cross(place, force)]
    if result.settings["engine"]["substeps"] > 1:
        left[:, :6] = _momentum_unexplained(result, robot)
    left[:, 6:] -= result.tau[:-1]
    if result.settings["engine"].get("late_armature"):
        left -= Armature(robot).late(result.q, result.v)
    if robot.lossy:
        left[:, 6:] = _rubbed(left[:, 6:], result, robot)
    feet = np.isin(result.link_names, robot.foot.frames)
    left[result.touching[:-1, ~feet].any(axis=1)] = 0.0
    motors, angle = Actuators(robot), result.q[:-1, 7:]
    at_stop = (angle < motors.lower + STOP_RAD) | (angle > motors.upper - STOP_RAD)
    return left[:, :6], np.where(at_stop | result.colliding[:-1, None], 0.0, left[:, 6:])


def _rubbed(left: np.ndarray, result: SimulationResult, robot: Robot) -> np.ndarray:
    """What the motors' friction does not explain of joint torques (N - 1, nv - 6).

    A joint that hardly moves within a step, or turns back, is held by anything up to its dry friction.
    """
    rows = [robot.actuators[name] for name in robot.joint_names]
    dry, viscous = (np.array([row[key] for row in rows]) for key in ("friction", "damping"))
    before, after = result.v[:-1, 6:], result.v[1:, 6:]
    left = left + viscous * (before + after) / 2
    slides = (np.minimum(np.abs(before), np.abs(after)) > SLIDES) & (before * after > 0)
    held = np.sign(left) * np.maximum(np.abs(left) - dry, 0.0)
    return np.where(slides, left + dry * np.sign(before), held)


def _momentum_unexplained(result: SimulationResult, robot: Robot) -> np.ndarray:
    """Force, and moment about the world's origin, (N - 1, 6) that momentum says and the ground does not."""
    model, data, rows = robot.model, robot.model.createData(), []
    frames = [model.getFrameId(name) for name in robot.foot.frames]
    weight = robot.total_mass * model.gravity.linear
    for q, v in zip(result.q, result.v, strict=True):
        pin.ccrba(model, data, q, v)
        pin.framesForwardKinematics(model, data, q)
        feet = [data.oMf[frame].translation.copy() for frame in frames]
        rows.append((data.hg.linear.copy(), data.hg.angular.copy(), data.com[0].copy(), *feet))
    linear, spin, com, *feet = (np.array(column) for column in zip(*rows, strict=True))
    angular, gravity = spin + np.cross(com, linear), np.cross(com, weight)
    force, moment = weight + result.foot_wrench[:, :, :3].sum(axis=1), result.foot_wrench[:, :, 3:].sum(axis=1)
    pushes, arm = _pushes(result, robot)
    points = result.q[:, :3] + [rotation(q[3:7]) @ arm for q in result.q]
    force = force + pushes
    for place, push in ((points, pushes), *zip(feet, np.moveaxis(result.foot_wrench[:, :, :3], 1, 0), strict=True)):
        moment = moment + np.cross(place, push)
    moment[:-1] += (gravity[:-1] + gravity[1:]) / 2
    return np.hstack([np.diff(linear, axis=0), np.diff(angular, axis=0)]) / STEP_S - np.hstack([force, moment])[:-1]


def _steps(result: SimulationResult, robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Configuration (N - 1, nq), velocity and acceleration (N - 1, nv) for which each step solved the mechanics.

    One semi-implicit step does so at its beginning, many do on the whole in the middle. Accelerations are those of the
    base's CoM in world axes: differences of the base twist in its own axes, which turn within the step, would be off by
    17 N in a flip.
    """
    share = 0.0 if result.settings["engine"]["substeps"] == 1 else 0.5
    model = robot.model
    arm = model.inertias[1].lever  # from the base's origin to its CoM, base axes
    q = np.array([pin.interpolate(model, a, b, share) for a, b in zip(result.q[:-1], result.q[1:], strict=True)])
    turns, turn = (np.array([rotation(quaternion) for quaternion in x[:, 3:7]]) for x in (result.q, q))
    spins, speeds = result.v[:, 3:6], result.v[:, :3]

    def within(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Value within the step, and rate of change, of ``vectors`` in base axes, seen from the world; base axes."""
        there = np.einsum("kij,kj->ki", turns, vectors)
        both = there[:-1] + share * np.diff(there, axis=0), np.diff(there, axis=0) / STEP_S
        return tuple(np.einsum("kji,kj->ki", turn, x) for x in both)

    (spin, turning), (speed, moving) = within(spins), within(speeds + np.cross(spins, arm))
    speed = speed - np.cross(spin, arm)
    origin = moving - np.cross(turning, arm) - np.cross(spin, np.cross(spin, arm))
    joints, change = result.v[:-1, 6:], np.diff(result.v[:, 6:], axis=0)
    v = np.hstack([speed, spin, joints + share * change])
    return q, v, np.hstack([origin - np.cross(spin, speed), turning, change / STEP_S])


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
    slip, outside, ground = 0.0, 0.0, ground_of(result)
    for k in np.flatnonzero((result.foot_wrench[:-1, :, 2] > LOADED_N).any(axis=1)):
        places = []  # a foot may move within a step: where it is at both ends of it
        for q in result.q[k : k + 2]:
            pin.framesForwardKinematics(model, data, q)
            places.append([data.oMf[frame].copy() for frame in frames])
        for wrench, before, after in zip(result.foot_wrench[k], *places, strict=True):
            if wrench[2] > LOADED_N:
                slip = max(slip, friction_used(wrench[:3], before, ground))
                if before.rotation[2, 2] < FACING:
                    continue  # a foot that lies on its side presses with that
                corners = np.array([before.act(corner) for corner in foot.corners])
                sunk = (0.0,) if ground is None else (0.0, ground.depth_of(corners))
                pairs = product((before, after), sunk)
                outside = max(outside, min(_outside(foot, before, place, wrench, deep) for place, deep in pairs))
    stated = result.settings["perturbation"]["friction"]
    return (
        Finding("friction used, of the stated coefficient", slip / stated, FRICTION_USE, "", "sticky feet"),
        Finding("CoP outside the sole", outside, SOLE_M, "m", "oversized feet"),
    )


def ground_of(result: SimulationResult) -> Scene | None:
    """The ground of a run; None if it is hard and level."""
    told = result.settings.get("ground")
    return None if told is None else Scene.told(told)


def friction_used(force: np.ndarray, place: pin.SE3, ground: Scene | None) -> float:
    """Friction that a force (3,) on a foot at ``place`` uses, along the ground there over across it [1]."""
    if ground is None:
        return float(np.hypot(*force[:2]) / force[2])
    up = ground.normal_at(place.translation[:2])
    return float(np.linalg.norm(force - up @ force * up) / (up @ force))


def _outside(foot: Foot, origin: pin.SE3, place: pin.SE3, wrench: np.ndarray, deep: float) -> float:
    """How far the CoP of a ``wrench`` (6,) about ``origin`` lies outside the sole of a foot at ``place`` [m].

    The CoP is in the plane of the sole, or ``deep`` [m] above: ground that has given way presses on its sides as well.
    """
    moment = wrench[3:] + pin.skew(origin.translation - place.translation) @ wrench[:3]
    force, moment = place.rotation.T @ wrench[:3], place.rotation.T @ moment
    x, y = ((foot.sole_z + deep) * force[:2] + [-moment[1], moment[0]]) / force[2]
    return max(foot.heel - x, x - foot.toe, abs(y - foot.center[1]) - foot.half_width)


def _engine(result: SimulationResult, robot: Robot) -> tuple[Finding, ...]:
    """What the engine said at the end of the run, against what was stated."""
    engine, stated = result.settings["engine"], result.settings["perturbation"]["friction"]
    miss = max(abs(friction - stated) for friction in engine["friction"])
    through, lost = float(not engine["self_collision"]), abs(engine["mass_kg"] - robot.total_mass)
    falls = float(np.abs(np.subtract(engine["gravity"], [0.0, 0.0, -robot.gravity])).max())
    turns = engine["inertia_error"]
    return (
        Finding("friction read back, less the stated", miss, NUMERIC, "", "friction that never reached the feet"),
        Finding("contact points outside the sole", engine["beyond_sole_m"], SOLE_M, "m", "oversized feet"),
        Finding("links that pass through each other", through, 0.0, "", "self-collision switched off"),
        Finding("damping and armature read back", engine["damping"], NUMERIC, "SI", "joints that brake or hold"),
        Finding("mass read back, less the stated", lost, 1e-3, "kg", "a lighter robot"),
        Finding("inertia read back, less the stated", turns, NUMERIC, "kg m^2", "bodies that turn more easily"),
        Finding("gravity read back, less the target's", falls, NUMERIC, "m/s^2", "a jump on another planet"),
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
