"""The 1 kHz tape of a plan, exact between the nodes: feet do not slip, momentum is kept, no wrench
is missing.

Between nodes the plan's polynomials miss the contact by fractions of a millimetre. Legs that carry
follow from base, arms and the feet's pitch by inverse kinematics on all three levels, and the
ground's wrenches take up what inverse dynamics still misses. In flight the joints' polynomials
stand; the base follows from L and the CoM's parabola.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.io.tape import AIR, FLAT, RATE_HZ, TOE, Tape
from jumplab.models.spatial import SpatialModel
from jumplab.ocp.solution import PhaseSolution, quintic, resampled
from jumplab.robot import Robot
from jumplab.robot.contact import on_feet
from jumplab.robot.legs import LOCAL, bring_feet, give_of, least_motion
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import HOLD, SIDES
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.legs import Legs
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.problem import Schedule

SHORTEST_S = 0.05 / RATE_HZ  # a shorter last step is joined to the one before
# over which a phase passes from where the one before ended on the tape to its own plan
JOINING_S = 0.25
BALANCED_S = 0.4  # after about so much the base is back where it is planned
BALANCING = 2  # corrections, each a hundred times smaller than the one before
LANDED_RAD = 1e-6  # [rad, rad/s] by which legs may miss their plan at the end of a flight
LANDINGS = 60  # corrections of that end at most; a jump takes two or three
TURNED_RAD = 1e-10  # by which the base's attitude in flight may still change from round to round
TURNS = 100  # such rounds at most
SLOPES = 20  # samples from one slope of those corrections to the next
LEAST_LOAD = 1e-3  # share of the weight that each foot counts as carrying there
# codes of a foot in the tape's ``contacts``
CODES = {"toe": TOE, "flat": FLAT}


@dataclass(frozen=True)
class Piece:
    """Some consecutive phases without a jump of accelerations: times, motion, wrenches and contacts
    on the tape.
    """

    t: np.ndarray  # (n,) [s]
    motion: np.ndarray  # (3, n, 6 + joints) charts, rates, accelerations
    wrench: np.ndarray  # (n, 2, 6) of the feet about the world's origin, as planned
    contacts: np.ndarray  # (n, 2) codes


def make_tape(schedule: Schedule, phases: Mapping[str, PhaseSolution], gravity: float) -> Tape:
    """The tape of a solution of a ``schedule`` whose coordinates are all free; ``gravity``
    [m/s^2].
    """
    body = schedule.body
    robot = body.robot.under_gravity(gravity)
    solved = list(phases.values())
    starts = np.concatenate([[0.0], np.cumsum([p.duration for p in solved])])
    pieces: list[Piece] = []
    for numbers in _pieces(schedule):
        first = numbers[0]
        last = numbers[-1]
        t = _times(starts[first], starts[last + 1], first == 0)
        before = pieces[-1] if pieces else None
        if schedule.modes[first].flying:
            sides = schedule.landed(last + 1) if last + 1 < len(solved) else [0, 1]
            pieces.append(_flight(body, solved[first], before, t, sides, robot))
        else:
            pieces.append(_ground(schedule, solved, numbers, before, t, starts, robot))
    t, wrench, contacts = (
        np.concatenate([getattr(p, name) for p in pieces]) for name in ("t", "wrench", "contacts")
    )
    q, v, a = body.model.to_pinocchio(*np.concatenate([p.motion for p in pieces], axis=1))
    feet = feet_of(robot, q)
    f, tau, extra = forces(robot, q, v, a, wrench, contacts, feet)
    toes = np.flatnonzero((contacts == TOE).any(axis=1))
    extra |= {
        "contacts": contacts,
        "toe_phase_start": t[toes[0]] - t[0] if len(toes) else t[0],
        **_travel(robot, *feet),
    }
    phase = np.where(contacts.any(axis=1), "launch", "flight")
    frames = np.array(robot.foot.frames)
    return Tape(t - t[0], q, v, a, tau, phase, frames, f, np.array(robot.joint_names), extra)


def _pieces(schedule: Schedule) -> list[np.ndarray]:
    """Phases of each stretch whose accelerations do not jump: to take-off, and to each landing."""
    count = len(schedule.contacts.phases)
    jumps = [
        k
        for k in range(1, count)
        if schedule.modes[k].flying or schedule.modes[k - 1].flying or schedule.landed(k)
    ]
    return np.split(np.arange(count), jumps)


def _times(start: float, end: float, first: bool) -> np.ndarray:
    """Instants of a piece: milliseconds up to its end if it is the ``first``, else from its start,
    and its end [s].
    """
    if first:
        return end - np.arange(int(np.ceil((end - start) * RATE_HZ - 1e-9)), -1, -1) / RATE_HZ
    return np.append(np.arange(start, end - SHORTEST_S, 1 / RATE_HZ), end)


def feet_of(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins (n, 2, 3) [m] and attitudes (n, 2, 3, 3) of the feet's frames at configurations
    ``q`` (n, nq).
    """
    model = robot.model
    data = model.createData()
    frames = [model.getFrameId(name, pin.FrameType.BODY) for name in robot.foot.frames]
    origin = np.empty((len(q), len(frames), 3))
    turn = np.empty((len(q), len(frames), 3, 3))
    for k, configuration in enumerate(q):
        pin.framesForwardKinematics(model, data, configuration)
        for i, frame in enumerate(frames):
            origin[k, i] = data.oMf[frame].translation
            turn[k, i] = data.oMf[frame].rotation
    return origin, turn


def _travel(robot: Robot, origin: np.ndarray, turn: np.ndarray) -> dict[str, np.ndarray]:
    """Travel of the soles' middle (3,) [m], and turn of the feet about the vertical [rad]."""
    middle = (origin + turn @ robot.foot.center)[[0, -1]].mean(axis=1)
    left = turn[..., 1].sum(axis=1)  # it stays level in a flip, too
    turned = np.unwrap(np.arctan2(-left[:, 0], left[:, 1]))
    return {"soles_travel": middle[1] - middle[0], "feet_turn": np.array(turned[-1] - turned[0])}


def _joining(before: np.ndarray, after: np.ndarray, t: np.ndarray, most_s: float) -> np.ndarray:
    """Motion (3, n, k) to add to one that begins at ``after`` (3, k), so that it begins at
    ``before`` (3, k) and is itself again after :data:`JOINING_S`, ``most_s`` at the latest; ``t``
    (n,) since then [s].
    """
    ends = [(x, 0 * x) for x in before - after]
    lasts = min(JOINING_S, most_s)
    return quintic(ends, lasts, np.minimum(t, lasts)[:, None])


# on the ground
# ----------------------------------------------------------------------------------------------
def holds_of(phase: PhaseSolution, b: Mode) -> dict[int, np.ndarray]:
    """x, y, z [m] and yaw [rad] of the middle of the toe edge of feet that carry, by side."""
    return {
        side: np.array([phase.constants[f"{SIDES[side]}_{x}"] for x in HOLD]) for side in b.modes
    }


def pressed(b: Mode, side: int, hold: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Wrenches (n, 6) about the world's origin [N, N m] from the forces ``z`` (n, k) along the
    edges of one foot's friction pyramids, the foot at ``hold`` (4,), as of :func:`holds_of`.
    """
    turn = pin.rpy.rpyToMatrix(0.0, 0.0, hold[3])
    points = hold[:3] + b.points[side] @ turn.T
    forces = z.reshape(len(z), len(points), -1) @ b.edges @ turn.T
    return np.hstack([forces.sum(axis=1), np.cross(points, forces).sum(axis=1)])


def _ground(
    schedule: Schedule,
    solved: Sequence[PhaseSolution],
    numbers: np.ndarray,
    before: Piece | None,
    t: np.ndarray,
    starts: np.ndarray,
    robot: Robot,
) -> Piece:
    """A stretch on the ground, of the phases with these ``numbers``, at times ``t`` (n,) [s];
    ``starts`` of all phases [s].
    """
    parts = []
    owner = np.clip(np.searchsorted(starts, t, "right") - 1, numbers[0], numbers[-1])
    for k in np.unique(owner):
        b = schedule.modes[k]
        phase = solved[k]
        instants = t[owner == k]
        at = np.clip(instants - starts[k], 0.0, phase.duration)
        motion = phase.sample(at)
        if before is not None:  # accelerations may jump where a foot lands
            end = before.motion[:, -1]
            first = solved[numbers[0]]
            after = np.array([first.q[0, : b.nv], first.v[0, : b.nv], end[2]])
            motion[..., : b.nv] += _joining(end, after, instants - t[0], t[-1] - t[0])
        holds = holds_of(phase, b)
        legs = Legs.of(schedule.body, list(holds))
        wrench, contacts = _planned(b, phase, holds, at)
        leaves = k + 1 < len(solved) and schedule.modes[k + 1].flying
        if k == numbers[-1] and k + 1 < len(solved) and not leaves:
            end = legs.held(motion[:, -1:], holds, b.raised)
            more = _arriving_legs(schedule, solved, k + 1, end)
            motion[..., : end.shape[-1]] += quintic(more, phase.duration, at[:, None])
        line = _on_a_line(holds, b.raised) and not (schedule.follows and len(holds) == 1)
        if len(instants) > 1 and (line or leaves or schedule.follows):
            count = 1 if line else max(1, round((instants[-1] - instants[0]) / BALANCED_S))
            for rows in np.array_split(np.arange(len(instants)), count):
                given = holds, b.raised, instants[rows], robot, wrench[rows].sum(axis=1), line
                stays = not leaves or rows[-1] + 1 < len(instants)
                motion[:, rows] = _balanced(legs, motion[:, rows], *given, stays=stays)
        parts.append((legs.held(motion, holds, b.raised), wrench, contacts))
    motions, wrenches, codes = zip(*parts, strict=True)
    motion = np.concatenate(motions, axis=1)
    return Piece(t, motion, np.concatenate(wrenches), np.concatenate(codes))


def _arriving_legs(
    schedule: Schedule, solved: Sequence[PhaseSolution], k: int, end: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Ends of a bend, as of :func:`.quintic`, that leads legs from an ``end`` (3, 1, 6 + joints) on
    the ground to where feet come down as the phase ``k`` begins.
    """
    mode = schedule.modes[k]
    holds = holds_of(solved[k], mode)
    there = solved[k].sample(0.0)
    there[..., : end.shape[-1]] = end
    goal = Legs.of(schedule.body, list(holds)).held(there, holds, mode.raised)
    off = (goal - end)[:, 0]
    off[2] = 0.0  # accelerations may jump where a foot lands
    return [(0 * x, x) for x in off]


def _planned(
    b: Mode, phase: PhaseSolution, holds: Mapping[int, np.ndarray], at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Wrenches (n, 2, 6) about the world's origin as planned, and codes of the contacts (n, 2), at
    times ``at`` (n,) of the phase.
    """
    wrench = np.zeros((len(at), 2, 6))
    codes = np.full((len(at), 2), AIR, np.int8)
    z = resampled(phase.t, phase.z[:, : b.n_forces], at)
    sizes = [len(b.edges) * len(b.points[side]) for side in holds]
    parts = np.split(z, np.cumsum(sizes)[:-1], axis=1)
    for (side, hold), part in zip(holds.items(), parts, strict=True):
        wrench[:, side] = pressed(b, side, hold, part)
        codes[:, side] = CODES[b.modes[side]]
    return wrench, codes


def _on_a_line(holds: Mapping[int, np.ndarray], raised: Sequence[int]) -> bool:
    """Whether all feet that carry are on their toes, and their edges parts of one level line."""
    edge = np.array(list(holds.values()))
    ahead = edge[:, :2] @ [np.cos(edge[0, 3]), np.sin(edge[0, 3])]
    level = np.ptp(edge[:, 2:], axis=0).max() < 1e-6 and np.ptp(ahead) < 1e-4
    return len(raised) == len(holds) and level


def _balanced(
    legs: Legs,
    motion: np.ndarray,
    holds: Mapping[int, np.ndarray],
    raised: Sequence[int],
    t: np.ndarray,
    robot: Robot,
    wrench: np.ndarray,
    line: bool,
    stays: bool,
) -> np.ndarray:
    """The ``motion`` (as of :meth:`.Legs.held`), its base moved by some micrometres so that the
    ground's force is what is planned.

    Where all feet that carry are on their toes, in one ``line``, no ground force has a moment about
    it: what the motion between nodes needs of that goes. Elsewhere all that it needs besides the
    planned ``wrench`` (n, 6) goes: where the load is low, little of it would tip the feet. The
    shift of the base in a phase vanishes within it if the phase ``stays`` on the ground; what leads
    it back is in proportion to the squared load, so that it moves the centre of pressure least.
    """
    from scipy.integrate import cumulative_trapezoid  # slow to import

    edge = np.mean(list(holds.values()), axis=0)
    ahead, across, _ = pin.rpy.rpyToMatrix(0.0, 0.0, edge[3]).T
    every = np.arange(len(t))
    ways = np.array([[*ahead, 0.0, 0.0, 0.0]]) if line else np.eye(BASE)
    seen = np.array([[0.0, 0.0, 0.0, *across]]) if line else np.eye(BASE)
    data = robot.model.createData()

    def missing(change=0.0, rows=every):
        moved = motion[:, rows]
        moved[2, :, :BASE] += change
        held = legs.held(moved, holds, raised)
        states = zip(*legs.body.model.to_pinocchio(*held), strict=True)
        need = [needed(x[0], pin.rnea(robot.model, data, *x)) for x in states]
        force, about = np.split(np.array(need) - wrench[rows], 2, axis=1)
        return np.hstack([force, about - np.cross(edge[:3], force)]) @ seen.T

    def integrated(more):
        rate = cumulative_trapezoid(more, t, axis=0, initial=0.0)
        return np.array([cumulative_trapezoid(rate, t, axis=0, initial=0.0), rate, more])

    first = missing()
    # slopes hardly change, neither by the corrections nor from one sample to the next
    some = every if line else np.unique(np.append(every[::SLOPES], every[-1]))
    slopes = np.stack([missing(way, some) - first[some] for way in ways], axis=-1)
    back = np.linalg.pinv(slopes)[np.searchsorted(some, every)]
    share = (t - t[0]) / (t[-1] - t[0])
    load = np.maximum(wrench[:, 2], LEAST_LOAD * robot.total_mass * robot.gravity)
    where = (share * (1 - share) * load**2)[:, None] * np.column_stack([0 * t + 1, share])
    returning = integrated(where)
    for k in range(BALANCING + (not line)):
        shift = integrated(-np.matvec(back, missing() if k else first) @ ways)
        if stays and not line:
            shift -= returning @ np.linalg.solve(returning[:2, -1], shift[:2, -1])
        motion[..., :BASE] += shift
    return motion


def needed(q: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """The wrench (6,) about the world's origin that a motion needs from the ground, from its
    configuration (nq,) and inverse dynamics (nv,).
    """
    return pin.XYZQUATToSE3(q[:7]).act(pin.Force(torques[:6])).vector


# in flight
# ----------------------------------------------------------------------------------------------
def _flight(
    body: Body,
    flight: PhaseSolution,
    before: Piece,
    t: np.ndarray,
    sides: Sequence[int],
    robot: Robot,
) -> Piece:
    """A flight at times ``t`` (n,) [s]: joints as planned, the base as momentum demands.

    It begins where the tape so far ends; the joints are as planned a little later, and the legs of
    the feet that come down (``sides``) arrive as planned, whatever the base has drifted by.
    """
    from scipy.optimize import NoConvergence, broyden1  # slow to import

    model = body.model
    since = t - t[0]
    planned = flight.sample(since)
    last = before.motion[:, -1:]
    more = _joining(last[:, 0, BASE:], planned[:, 0, BASE:], since, since[-1])
    joints = planned[..., BASE:] + more
    fall = falling(robot, model, last)
    missed = _arriving(body, planned[:, -1:], sides)
    none = np.zeros(model.joints)
    near = planned[0][:, 3:BASE]

    def fallen(change, rows=slice(None)):
        """The motion if joints and their rates end with a change (2 joints,)."""
        shift, rate = np.split(change, 2)
        bends = quintic([(none, shift), (none, rate), (none, none)], since[-1], since[:, None])
        return fall(joints + bends, since, near, rows)

    # the change moves the base as well, in a jump by little, in a flip by about as much
    options = dict(alpha=1.0, f_tol=LANDED_RAD, maxiter=LANDINGS, line_search=None)
    try:
        at_end = slice(-1, None)
        change = broyden1(lambda x: missed(*fallen(x, at_end)), np.zeros(2 * len(none)), **options)
    except NoConvergence as e:
        change = e.args[0]
    chart = model.charts(*fallen(change), near=near[0])
    return Piece(t, chart, np.zeros((len(t), 2, 6)), np.full((len(t), 2), AIR, np.int8))


def _arriving(body: Body, end: np.ndarray, sides: Sequence[int]) -> Callable[..., np.ndarray]:
    """By what joints and their rates (2 joints,) have to change for the feet of some ``sides`` to
    arrive as at a planned ``end`` (3, 1, .), from a configuration (1, nq), twist and its rate (1,
    nv).
    """
    tree = body.model.model
    data = tree.createData()
    give = give_of(body.robot)
    anchors = on_feet(body.robot, np.zeros(3))
    feet = [anchors[side] for side in sides]

    def slopes(q):
        """(6 k, nv) of the feet's twists, in their axes."""
        pin.computeJointJacobians(tree, data, q)
        return np.vstack([foot.slope(tree, data, LOCAL) for foot in feet])

    q, v, _ = (x[0] for x in body.model.to_pinocchio(*end))
    speeds = slopes(q) @ v
    goals = {foot: foot.place(data) for foot in feet}

    def missed(q, v, _):
        there, _ = bring_feet(tree, data, q[0], goals, give)
        rows = slopes(there)
        rates = least_motion(rows, speeds - rows @ v[0], give)
        return np.concatenate([there[7:] - q[0, 7:], rates[BASE:]])

    return missed


def falling(robot: Robot, model: SpatialModel, end: np.ndarray) -> Callable[..., tuple]:
    """Free fall of a ``robot``, whose model feels gravity, from an ``end`` (3, 1, nv) of a motion,
    by what its joints do then.

    The function takes angles, rates and accelerations of the joints (3, n, joints), their times t
    (n,) [s], angles (n, 3) near those of the base, and which rows (m,) are asked for; it returns
    configurations (m, nq), twists and accelerations (m, nv).
    """
    tree = robot.model
    data = tree.createData()
    q, v, _ = (x[0] for x in model.to_pinocchio(*end))
    momentum = pin.computeCentroidalMomentum(tree, data, q, v)
    com = data.com[0].copy()
    speed = momentum.linear / model.mass
    spin = momentum.angular.copy()
    down = tree.gravity.linear

    def motion(joints, t, near, rows=slice(None)):
        zero = np.zeros((len(t), 3))
        turned = _turned(model, joints, spin, end[0, 0, 3:BASE], t, near)
        levels = zip((*turned, zero), joints, strict=True)
        q, v, a = model.to_pinocchio(*(np.hstack([zero, *x])[rows] for x in levels))
        for k, since in enumerate(t[rows]):
            pin.centerOfMass(tree, data, q[k], v[k])
            q[k, :3] = com + speed * since + down * since**2 / 2 - data.com[0]
            v[k, :3] = data.oMi[1].rotation.T @ (speed + down * since - data.vcom[0])
            a[k, :BASE] = 0.0
            missing = pin.rnea(tree, data, q[k], v[k], a[k])[:BASE]
            a[k, :BASE] = -np.linalg.solve(pin.crba(tree, data, q[k])[:BASE, :BASE], missing)
        return q, v, a

    return motion


def _turned(
    model: SpatialModel,
    joints: np.ndarray,
    spin: np.ndarray,
    first: np.ndarray,
    t: np.ndarray,
    near: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Angles of the base and their rates (n, 3) at times ``t`` (n,) [s], with which L stays the
    ``spin`` (3,) while the ``joints`` (3, n, joints) move, from the ``first`` angles (3,) on; by
    Picard's iteration from angles ``near`` (n, 3), as a whole, which takes more rounds the more the
    base turns.
    """
    from scipy.integrate import cumulative_simpson  # slow to import

    yielding, carried = _spins(model.model, joints)
    angles = near
    for _ in range(TURNS):
        turn, slope = model.attitudes(angles)
        turning = np.matvec(yielding, spin @ turn - carried)
        rates = np.linalg.solve(slope, turning[..., None])[..., 0]
        before = angles
        angles = first + cumulative_simpson(rates, x=t, axis=0, initial=0.0)
        if np.abs(angles - before).max() < TURNED_RAD:
            break
    return angles, rates


def _spins(tree: pin.Model, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity of the base per L (n, 3, 3), and L that the ``joints`` (3, n, joints) carry
    (n, 3), in the base's axes.
    """
    data = tree.createData()
    inertia = np.empty((len(joints[0]), 3, 3))
    carried = np.empty((len(joints[0]), 3))
    base = pin.neutral(tree)[:7]
    for k, (angles, rates, _) in enumerate(zip(*joints, strict=True)):
        pin.ccrba(tree, data, np.append(base, angles), np.append(np.zeros(BASE), rates))
        inertia[k] = data.Ag[3:, 3:6]
        carried[k] = data.hg.angular
    return np.linalg.inv(inertia), carried


# forces
# ----------------------------------------------------------------------------------------------
def forces(
    robot: Robot,
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    wrench: np.ndarray,
    contacts: np.ndarray,
    feet: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Wrenches (n, 2, 6) at the origins of the ``feet``, motor torques, and by name CoM with
    velocity (n, 3) and L about the CoM (n, 3).

    The part of inverse dynamics that the ``wrench`` (n, 2, 6) about the world's origin lacks is
    shared out by load among the feet that carry, by ``contacts`` (n, 2); ``feet`` as of
    :func:`feet_of`.
    """
    model = robot.model
    data = model.createData()
    joints = [anchor.joint for anchor in on_feet(robot, np.zeros(3))]
    s = contacts.any(axis=1)
    rows = []
    slopes = []
    for *x, stands in zip(q, v, a, s, strict=True):
        need = pin.rnea(model, data, *x).copy()
        momentum = pin.computeCentroidalMomentum(model, data, *x[:2]).vector
        rows.append((need, needed(x[0], need), momentum, data.com[0].copy()))
        if stands:
            pin.computeJointJacobians(model, data, x[0])
            world = pin.ReferenceFrame.WORLD
            slopes.append([pin.getJointJacobian(model, data, j, world) for j in joints])
    torques, need, momentum, com = map(np.array, zip(*rows, strict=True))
    origin, turn = feet
    total = np.zeros_like(wrench)
    least = LEAST_LOAD * robot.total_mass * robot.gravity
    soles = (origin + turn @ robot.foot.center)[s]
    missing = need[s] - wrench[s].sum(axis=1)
    total[s] = wrench[s] + _shared(wrench[s], soles, contacts[s], missing, least)
    torques[s] -= np.einsum("nkij,nki->nj", slopes, total[s])
    total[..., 3:] -= np.cross(origin, total[..., :3])
    extra = {
        "com": com,
        "com_velocity": momentum[:, :3] / robot.total_mass,
        "angular_momentum": momentum[:, 3:],
    }
    return total, torques[:, 6:] + robot.limits.lost(v[:, 6:]), extra


def _shared(
    wrench: np.ndarray, soles: np.ndarray, contacts: np.ndarray, missing: np.ndarray, least: float
) -> np.ndarray:
    """Share of each foot (n, 2, 6) in the ``missing`` (n, 6) about the origin: by its load, forces
    at its centre of pressure, which without load is the middle of its sole (n, 2, 3) [m].
    """
    lift = wrench[..., 2:3]
    lever = np.cross([0.0, 0.0, 1.0], wrench[..., 3:])
    at = np.where(lift > 0, lever / np.where(lift > 0, lift, 1.0), soles)
    load = np.maximum(lift, least) * (contacts > 0)[..., None]
    share = load / load.sum(axis=1, keepdims=True)
    force = share * missing[:, None, :3]
    moment = np.cross(at, force)
    moment += share * (missing[:, 3:] - moment.sum(axis=1))[:, None]
    return np.concatenate([force, moment], axis=-1)
