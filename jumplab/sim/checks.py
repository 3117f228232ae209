"""Is a simulated jump what it claims to be? Every finding is made from the logs, or read back from
the engine.

The strongest one asks mechanics: the logged motion, torques and foot forces must obey the robot's
equations of motion. They exclude a hand that holds the base, a motor that gives more than
it says, or a velocity set.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.ndimage import maximum_filter1d

from jumplab.control.kinematics import Gauge, rotation, rotations
from jumplab.robot.contact import on_feet
from jumplab.robot.description import Foot
from jumplab.robot.legs import size
from jumplab.sim import CONTACTS, STEP_S
from jumplab.sim.armature import Armature
from jumplab.sim.result import STAND_S, Finding, SimulationResult
from jumplab.sim.scene import Scene

# name -> limit, unit, what more would hide; where engines take substeps, their limit
QUESTIONS = tomllib.loads(Path(__file__).with_name("checks.toml").read_text(encoding="utf-8"))
WINDOW = 100  # [steps] 0.1 s; a push shorter than that counts by its mean
# [1] where a contact begins or ends, velocities swing within a step by some times what the log
# shows
SWING = 3.0
CHATTER = 3  # [steps] this one, the one before and the one after, in which a contact may change
# [rad/s] from here on dry friction is there in full: engines let it grow over some tenths
SLIDES = 0.5
STOP_RAD = 0.02  # this close to its stop, a joint may lean on it
LOADED_N = 50.0  # of a 42 kg robot: below it, CoP and friction ratio are rounding
# [1] a sole that is turned by less than 45 degrees is what touches the ground of a foot
FACING = 0.7


def check(result: SimulationResult) -> tuple[Finding, ...]:
    """All findings about a ``result``, whose robot is the planned one with the stated
    perturbation.
    """
    robot = result.robot
    engine = result.settings["engine"]
    stated = result.settings["perturbation"]["friction"]
    base, joints = unexplained(result)
    low, high = robot.limits.range(result.v[:, 6:])
    slip, outside = _feet(result)
    values = {
        "unexplained force on the body": worst(base[:, :3]),
        "unexplained moment on the body": worst(base[:, 3:]),
        "unexplained joint torque": worst(joints),
        "largest jump of the state": _largest_jump(result),
        "unevenness of time": np.abs(np.diff(result.t) - STEP_S).max(initial=0.0),
        "torque beyond the motors": np.maximum(result.tau - high, low - result.tau).max(
            initial=0.0
        ),
        "friction used, of the stated coefficient": slip / stated,
        "CoP outside the sole": outside,
        # what the engine said at the end of the run
        "friction read back, less the stated": np.abs(np.array(engine["friction"]) - stated).max(),
        "contact points outside the sole": engine["beyond_sole_m"],
        "links that pass through each other": not engine["self_collision"],
        "damping and armature read back": engine["damping"],
        "mass read back, less the stated": abs(engine["mass_kg"] - robot.total_mass),
        "inertia read back, less the stated": engine["inertia_error"],
        "gravity read back, less the target's": np.abs(
            engine["gravity"] - robot.model.gravity.linear
        ).max(),
        "claimed landing, short of 3 s by": _short_landing(result),
    }
    findings = []
    for name, (limit, unit, hides, *substepped) in QUESTIONS.items():
        if substepped and engine["substeps"] > 1:
            (limit,) = substepped
        findings.append(Finding(name, float(values[name]), limit, unit, hides))
    return tuple(findings)


def _largest_jump(result: SimulationResult) -> float:
    """Largest distance of a state from the one to which the velocities before it lead [m, rad].

    Within a step of n semi-implicit ones, the velocity that moves the robot lies about v + (1 + 1 /
    n) / 2 dv.
    """
    least = 1 / result.settings["engine"]["substeps"]
    model = result.robot.model
    change = np.diff(result.v, axis=0)
    way = STEP_S * (result.v[:-1] + (1 + least) / 2 * change)
    # a foot that comes down chatters: it may swing within a step, and be back at its end
    largest = maximum_filter1d(np.abs(change).max(axis=1), CHATTER)
    room = SWING * (1 - least) * largest * STEP_S
    steps = zip(result.q[:-1], way, result.q[1:], strict=True)
    miss = [pin.difference(model, pin.integrate(model, q, v), after) for q, v, after in steps]
    left = np.abs(miss) - room[:, None]
    return float(left.max(initial=0.0))


def _pushes(result: SimulationResult) -> tuple[np.ndarray, np.ndarray]:
    """Stated external forces (N, 3) in every step [N], and the place (3,) in the base link's frame
    on which they act.

    The place is the centre of mass of the planned trunk, and not that of the real one with its
    payload.
    """
    force = np.zeros((len(result.t), 3))
    for push in result.settings.get("pushes", ()):
        begin, end = np.maximum(0, [push["step"], push["step"] + push["steps"]])
        force[begin:end] += push["force_n"]
    return force, np.array(result.settings.get("push_place_m", (0.0, 0.0, 0.0)))


def unexplained(result: SimulationResult) -> tuple[np.ndarray, np.ndarray]:
    """Generalised forces that neither torques nor foot forces explain: on the base (N - 1, 6), in
    the joints.

    Zero where the log does not say what acted: when other links touch the ground, in joints at
    their stops, and in all joints while links press on each other.
    """
    robot = result.robot
    model = robot.model
    motors = robot.limits
    engine = result.settings["engine"]
    data = model.createData()
    states = _steps(result)
    left = np.empty_like(states[2])
    pushes, place = _pushes(result)
    # the ground's wrenches, in the frames of the joints that carry the feet
    acting = pin.StdVec_Force([pin.Force.Zero()] * model.njoints)
    anchors = on_feet(robot, np.zeros(3))
    feet = result.feet if engine["substeps"] == 1 else Gauge(robot).feet(states[0])
    ground = result.foot_wrench[:-1].reshape(-1, 2, 2, 3) @ feet[: len(left), :, :3, :3]
    ground = ground.reshape(-1, 2, 6)
    for side, at in enumerate(anchors):
        ground[:, side] = ground[:, side] @ at.placement.toActionMatrixInverse()
    for k, row in enumerate(zip(*states, strict=True)):
        for at, wrench in zip(anchors, ground[k], strict=True):
            acting[at.joint].vector = wrench
        left[k] = pin.rnea(model, data, *row, acting)
    for k in np.flatnonzero(pushes[:-1].any(axis=1)):
        force = rotation(states[0][k, 3:7]).T @ pushes[k]
        left[k, :6] -= [*force, *np.cross(place, force)]
    if engine["substeps"] > 1:
        left[:, :6] = _momentum_unexplained(result)
    left[:, 6:] -= result.tau[:-1]
    if engine.get("late_armature"):
        left -= Armature(robot).late(result.q, result.v)
    if motors.lossy:
        left[:, 6:] = _rubbed(left[:, 6:], result)
    left[result.stray[:-1].any(axis=1)] = 0.0
    angle = result.q[:-1, 7:]
    at_stop = (angle < motors.lower + STOP_RAD) | (angle > motors.upper - STOP_RAD)
    return left[:, :6], np.where(at_stop | result.colliding[:-1, None], 0.0, left[:, 6:])


def _rubbed(left: np.ndarray, result: SimulationResult) -> np.ndarray:
    """Part of joint torques (N - 1, nv - 6) that the motors' friction does not explain.

    A joint that hardly moves within a step, or turns back, is held by anything up to its dry
    friction.
    """
    motors = result.robot.limits
    before = result.v[:-1, 6:]
    after = result.v[1:, 6:]
    left = left + motors.damping * (before + after) / 2
    slides = (np.minimum(np.abs(before), np.abs(after)) > SLIDES) & (before * after > 0)
    held = np.sign(left) * np.maximum(np.abs(left) - motors.friction, 0.0)
    return np.where(slides, left + motors.friction * np.sign(before), held)


def _momentum_unexplained(result: SimulationResult) -> np.ndarray:
    """Force, and moment about the world's origin, (N - 1, 6) that momentum says and the ground does
    not.
    """
    mass = result.robot.total_mass
    weight = mass * result.robot.model.gravity.linear
    _, com, velocity, momentum, _ = result.motion
    linear = mass * velocity
    spin = momentum + np.cross(com, linear)
    pushes, arm = _pushes(result)
    pushed = result.q[:, :3] + rotations(result.q[:, 3:7]) @ arm
    forces = result.foot_wrench[:, :, :3]
    turned = result.foot_wrench[:, :, 3:] + np.cross(result.feet[:, :, :3, 3], forces)
    moments = np.cross(pushed, pushes) + turned.sum(axis=1)
    turning = np.cross(com, weight)  # by the weight
    moments[:-1] += (turning[:-1] + turning[1:]) / 2
    acting = np.hstack([weight + pushes + forces.sum(axis=1), moments])
    return np.diff(np.hstack([linear, spin]), axis=0) / STEP_S - acting[:-1]


def _steps(result: SimulationResult) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Configuration (N - 1, nq), velocity and acceleration (N - 1, nv) for which each step solved
    the mechanics.

    One semi-implicit step does so at its beginning, many do on the whole in the middle.
    Accelerations are those of the base in world axes, of that point of its link whose velocity the
    engine integrates (Bullet: the CoM of the link alone, without what is fixed to it; MuJoCo: its
    origin): differences of the twist in the base's own axes, which turn within the step, or of
    another point would be wrong in a flip.
    """
    engine = result.settings["engine"]
    share = 0.0 if engine["substeps"] == 1 else 0.5
    model = result.robot.model
    # logs of older versions: the CoM of all that is fixed to the base
    older = model.inertias[1].lever * engine.get("keeps_com", True)
    arm = np.array(engine.get("keeps_m", older))
    q = result.q[:-1]
    if share:
        pairs = zip(q, result.q[1:], strict=True)
        q = np.array([pin.interpolate(model, *pair, share) for pair in pairs])
    turns, turn = (rotations(x[:, 3:7]) for x in (result.q, q))
    spins = result.v[:, 3:6]
    # of that point, in world axes; then within the step, in base axes
    twists = np.stack([spins, result.v[:, :3] + np.cross(spins, arm)])
    twists = np.einsum("kij,skj->ski", turns, twists)
    change = np.diff(twists, axis=1)
    (spin, speed), (turning, moving) = (
        np.einsum("kji,skj->ski", turn, x)
        for x in (twists[:, :-1] + share * change, change / STEP_S)
    )
    speed = speed - np.cross(spin, arm)
    origin = moving - np.cross(turning, arm) - np.cross(spin, np.cross(spin, arm))
    joints = np.diff(result.v[:, 6:], axis=0)
    v = np.hstack([speed, spin, result.v[:-1, 6:] + share * joints])
    return q, v, np.hstack([origin - np.cross(spin, speed), turning, joints / STEP_S])


def worst(force: np.ndarray) -> float:
    """Largest mean over a window of any column of (N, k)."""
    total = np.vstack([np.zeros(force.shape[1]), np.cumsum(force, axis=0)])
    window = min(WINDOW, len(force))
    return float(np.abs(total[window:] - total[:-window]).max(initial=0.0) / max(1, window))


def _feet(result: SimulationResult) -> tuple[float, float]:
    """From the measured wrenches, the most friction that a foot uses [1], and how far its CoP ever
    lies outside the sole [m].
    """
    least = size(result.robot).of(LOADED_N, "N")
    loaded, side = np.nonzero(result.foot_wrench[:-1, :, 2] > least)
    if not len(loaded):
        return 0.0, 0.0
    ground = ground_of(result)
    hard = result.settings["engine"].get("contact", CONTACTS[0]) == CONTACTS[0]
    foot = result.robot.foot
    wrench = result.foot_wrench[loaded, side]
    # a foot may move within a step: where it is at both ends of it
    before, after = (result.feet[rows, side] for rows in (loaded, loaded + 1))
    slip = friction_used(wrench[:, :3], before[:, :3, 3], ground)
    corners = before[:, None, :3, 3] + foot.corners @ before[:, :3, :3].swapaxes(1, 2)
    sunk = ground.depth_of(corners, soft=hard)
    # usual contacts act in the middle of the depth, beyond the tip of a tilted sole
    least = 0.0 if hard else sunk / 2
    beyond = [
        _outside(foot, before, end, wrench, deep) - least
        for end in (before, after)
        for deep in (0.0, sunk)
    ]
    # a foot that lies on its side presses with that
    flat = before[:, 2, 2] >= FACING
    return float(slip.max()), float(np.min(beyond, axis=0)[flat].max(initial=0.0))


def ground_of(result: SimulationResult) -> Scene:
    """The ground of a run."""
    ground = result.settings.get("ground")
    return Scene.flat() if ground is None else Scene.from_json(ground)


def friction_used(force: np.ndarray, place: np.ndarray, ground: Scene) -> np.ndarray:
    """Friction (k,) that forces (k, 3) on feet at places (k, 3) use, along the ground there over
    across it [1].
    """
    up = ground.normals_at(place)
    across = (force * up).sum(axis=1)
    return np.linalg.norm(force - across[:, None] * up, axis=1) / across


def _outside(
    foot: Foot, origin: np.ndarray, place: np.ndarray, wrench: np.ndarray, deep: Any
) -> np.ndarray:
    """Distance (k,) by which the CoP of each ``wrench`` (k, 6) about ``origin`` (k, 4, 4) lies
    outside the sole of a foot at ``place`` (k, 4, 4) [m]; negative within.

    The CoP is in the plane of the sole, or ``deep`` (k,) [m] above: ground that has given way
    presses on its sides as well.
    """
    arm = origin[:, :3, 3] - place[:, :3, 3]
    moment = wrench[:, 3:] + np.cross(arm, wrench[:, :3])
    force, moment = (np.einsum("kji,kj->ki", place[:, :3, :3], x) for x in (wrench[:, :3], moment))
    height = foot.sole_z + deep
    x = (height * force[:, 0] - moment[:, 1]) / force[:, 2]
    y = (height * force[:, 1] + moment[:, 0]) / force[:, 2]
    aside = np.abs(y - foot.center[1]) - foot.half_width
    return np.max([foot.heel - x, x - foot.toe, aside], axis=0)


def _short_landing(result: SimulationResult) -> float:
    """Seconds that a claimed landing falls short of standing on the feet alone."""
    lying = result.stray[result.phase == "landing"].any(axis=1)
    standing_s = STEP_S * float(np.argmax([*lying, True]))
    return max(0.0, STAND_S - standing_s) if result.metrics.landed else 0.0
