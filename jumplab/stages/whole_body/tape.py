"""The 1 kHz tape of a plan, exact between the nodes: feet do not slip, momentum is kept, no wrench is missing.

Between nodes the plan's polynomials miss the contact by fractions of a millimetre. Legs that carry follow from base,
arms and the feet's pitch by inverse kinematics on all three levels, and the ground's wrenches take up what inverse
dynamics still misses. In flight the joints' polynomials stand; the base follows from L and the CoM's parabola.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.io.tape import RATE_HZ, Tape
from jumplab.models.spatial import SpatialModel
from jumplab.ocp.solution import PhaseSolution
from jumplab.robot import Robot
from jumplab.stages.whole_body.contacts import SIDES
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.legs import LEG_STEPS, Legs, Motion
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.terms import EDGES, SOLE_SHARES, Body, WholeBodyTerms

SHORTEST_STEP = 0.05  # share of a sample; a shorter last step is joined to the one before
BALANCING = 2  # corrections, each a hundred times smaller than the one before
JOINING_S = 0.05  # over which a phase passes from where the one before ended on the tape to its own plan
LANDINGS, LANDED_RAD = 10, 1e-6  # corrections of a flight's end at most, in a jump two or three; the last is less
EVEN = 1e-9  # [kg m^2/s, kg m^2, rad] up to which nothing turns the base but about its pitch axis
SLOW, DIFFERENCE = 1.0, 1e-5  # a correction that leaves more than that share; for a derivative [rad, rad/s]
WRENCH_ARM_M = 0.05  # a moment of 0.05 N m costs what a force of 1 N does, where a missing wrench is shared out
FRICTION, LOADED_N = 0.5, 10.0  # of each foot; [N] below, the ratio is taken to this force instead
RATE_GAP, ACCELERATION_GAP = 0.01, 4.0  # [rad/s, rad/s^2] over one step, against the mean of its ends
RANGE_GAP, PRESSURE_GAP = 1e-3, 2e-3  # [rad] beyond a stop, [m] of the CoP beyond the sole
CLEAR_M, MIDDLE = 0.02, (0.3, 0.7)  # [m] of the soles over the ground, between those shares of a flight
SUNK_M = 1e-3  # [m] of a sole in the ground or in a platform
PRESSED_N = 50.0  # [N] on a foot from which on its CoP is looked at
LEAST_LOAD = 1e-3  # share of the weight that each foot counts as carrying there
AIR, TOE, FLAT = 0, 1, 2  # codes of a foot in the tape's ``contacts``
CODES = {"toe": TOE, "flat": FLAT}
Feet = tuple[np.ndarray, np.ndarray]  # origins (n, 2, 3), attitudes (n, 2, 3, 3)


@dataclass(frozen=True)
class Piece:
    """Some consecutive phases without a jump of accelerations: times, motion, wrenches and contacts on the tape."""

    t: np.ndarray  # (n,) [s]
    motion: Motion
    wrench: np.ndarray  # (n, 2, 6) of the feet about the world's origin, as planned
    contacts: np.ndarray  # (n, 2) codes


@dataclass(frozen=True)
class Surface:
    """Ground that steps up or down.

    Attributes
    ----------
    height_m : of the part beyond the edge.
    edge_m : where the edge is, ahead of the world's origin.
    along_rad : the way in which it is ahead.
    """

    height_m: float = 0.0
    edge_m: float = 0.0
    along_rad: float = 0.0

    def below(self, points: np.ndarray) -> np.ndarray:
        """Height of the ground below points (..., 3) [m]."""
        ahead = points[..., :2] @ [np.cos(self.along_rad), np.sin(self.along_rad)]
        return np.where(ahead > self.edge_m, self.height_m, 0.0)


def make_tape(schedule: Schedule, phases: Mapping[str, PhaseSolution], gravity: float) -> Tape:
    """The tape of a solution of a schedule."""
    body, robot = schedule.body, schedule.body.robot.under_gravity(gravity)
    solved = list(phases.values())
    starts = np.concatenate([[0.0], np.cumsum([p.duration for p in solved])])
    pieces: list[Piece] = []
    for first, last in _pieces(schedule):
        before = pieces[-1] if pieces else None
        t = _times(starts[first], starts[last + 1], first == 0)
        if schedule.of(first).flying:
            ends = schedule.landed(last + 1) if last + 1 < len(solved) else [0, 1]
            pieces.append(_flight(body, solved[first], before, t, starts[first], ends, gravity))
        else:
            pieces.append(_ground(schedule, solved, range(first, last + 1), before, t, starts, gravity))
    t = np.concatenate([p.t for p in pieces])
    chart = [np.concatenate(x) for x in zip(*(p.motion for p in pieces), strict=True)]
    q, v, a = body.model.to_pinocchio(*chart)
    wrench, contacts = (np.concatenate([getattr(p, k) for p in pieces]) for k in ("wrench", "contacts"))
    f, tau, com, spin = forces(robot, q, v, a, wrench, contacts)
    phase = np.where(contacts.any(axis=1), "launch", "flight")
    toes = np.flatnonzero((contacts == TOE).any(axis=1))
    extra = {
        "com": com[:, :3],
        "com_velocity": com[:, 3:],
        "angular_momentum": spin,
        "contacts": contacts,
        "toe_phase_start": t[toes[0]] - t[0] if len(toes) else t[0],
    }
    extra |= _travel(robot, _placed(robot, q))
    names = np.array(robot.foot.frames), np.array(robot.joint_names)
    return Tape(t - t[0], q, v, a, tau, phase, names[0], f, names[1], extra)


def _pieces(schedule: Schedule) -> list[tuple[int, int]]:
    """(first, last) phase of each stretch whose accelerations do not jump: up to take-off, and to each landing."""
    count, out, first = len(schedule.contacts.phases), [], 0
    for k in range(1, count):
        flying = schedule.of(k).flying or schedule.of(k - 1).flying
        if flying or schedule.landed(k):
            out.append((first, k - 1))
            first = k
    return [*out, (first, count - 1)]


def _times(start: float, end: float, first: bool) -> np.ndarray:
    """Instants of a piece: milliseconds up to its end if it is the ``first``, else from its start, and its end."""
    if first:
        return end - np.arange(int(np.ceil((end - start) * RATE_HZ - 1e-9)), -1, -1) / RATE_HZ
    return np.append(np.arange(start, end - SHORTEST_STEP / RATE_HZ, 1 / RATE_HZ), end)


def used_between(tape: Tape, robot: Robot, surface: Surface = Surface()) -> float:
    """Largest share that the tape uses of the limits of motors, stops, ground, and of gaps between angles and rates.

    The limits are those of the audit; up to 1 the tape holds them, also between the nodes. Soles that in the middle of
    a flight are as low as they may be use all of their height, on the surface twice of it.
    """
    motors, feet = [robot.actuators[name] for name in robot.joint_names], _placed(robot, tape.q)
    keys = "effort", "speed", "corner_speed", "no_load_speed"
    effort, speed, corner, free = (np.array([m[key] for m in motors]) for key in keys)
    rate = tape.v[:, 6:]
    left = np.clip((free - np.sign(tape.tau) * rate) / (free - corner), 0.0, 1.0)
    step = np.diff(tape.t)[:, None]
    moves = step[:, 0] > SHORTEST_STEP / RATE_HZ  # the instant of take-off is there twice
    gaps = (
        (np.diff(x, axis=0)[moves] / step[moves] - (y[1:] + y[:-1])[moves] / 2, most)
        for x, y, most in ((tape.q[:, 7:], rate, RATE_GAP), (rate, tape.a[:, 6:], ACCELERATION_GAP))
    )
    along, load = np.linalg.norm(tape.f[..., :2], axis=-1), np.maximum(tape.f[..., 2], LOADED_N)
    shares = [np.abs(tape.tau) / effort + (1 - left), np.abs(rate) / speed, along / (FRICTION * load)]
    low, high = (np.array([m[key] for m in motors]) for key in ("lower", "upper"))
    beyond = np.maximum(low - tape.q[:, 7:], tape.q[:, 7:] - high)
    shares += [beyond / RANGE_GAP, _pressed_outside(tape, robot, feet[1]) / PRESSURE_GAP]
    shares += [np.abs(gap) / most for gap, most in gaps]
    shares.append(_low(tape, robot, surface, feet))
    return float(max(x.max() for x in shares))


def _low(tape: Tape, robot: Robot, surface: Surface, feet: Feet) -> np.ndarray:
    """Share of what soles may be too low in flight, in its middle under :data:`CLEAR_M`, for each foot (n, 2)."""
    origin, turn = feet
    heels, way = robot.foot.corners[:2], robot.foot.corners[2:] - robot.foot.corners[:2]
    sole = np.concatenate([heels + u * way for u in SOLE_SHARES])
    points = origin[:, :, None] + np.einsum("nkij,pj->nkpi", turn, sole)
    height = (points[..., 2] - surface.below(points)).min(axis=2)
    out = np.full(height.shape, -np.inf)
    for rows in _flights(tape.extra["contacts"]):
        part = (tape.t[rows] - tape.t[rows[0]]) / max(np.ptp(tape.t[rows]), 1e-9)
        middle = ((part >= MIDDLE[0]) & (part <= MIDDLE[1]))[:, None]
        out[rows] = np.where(middle, 2 - height[rows] / CLEAR_M, -height[rows] / SUNK_M)
    return out


def _flights(contacts: np.ndarray) -> list[np.ndarray]:
    """Rows of each stretch without a foot on the ground, by the contacts (n, 2)."""
    flying = np.flatnonzero(~contacts.any(axis=1))
    return np.split(flying, np.flatnonzero(np.diff(flying) > 1) + 1) if len(flying) else []


def _pressed_outside(tape: Tape, robot: Robot, turn: np.ndarray) -> np.ndarray:
    """How far the CoP of each foot that carries is outside its sole, on its toes beside their edge (n, 2) [m].

    ``turn`` (n, 2, 3, 3) are attitudes of the feet.
    """
    foot = robot.foot
    force, moment = tape.f[..., :3], tape.f[..., 3:]
    load = np.where(force[..., 2] > PRESSED_N, force[..., 2], np.nan)
    tip = turn @ foot.tip
    x = (tip[..., 2] * force[..., 0] - moment[..., 1]) / load - tip[..., 0]
    y = (tip[..., 2] * force[..., 1] + moment[..., 0]) / load - tip[..., 1]
    ahead = turn[..., :2, 0] / np.linalg.norm(turn[..., :2, 0], axis=-1, keepdims=True)
    along, across = ahead[..., 0] * x + ahead[..., 1] * y, ahead[..., 0] * y - ahead[..., 1] * x
    length = np.where(tape.extra["contacts"] == FLAT, foot.toe - foot.heel, 0.0)
    out = np.max([along, -along - length, np.abs(across) - foot.half_width], axis=0)
    return np.where(np.isnan(load), -np.inf, out)


def _placed(robot: Robot, q: np.ndarray) -> Feet:
    """Origins (n, 2, 3) [m] and attitudes (n, 2, 3, 3) of the feet's frames."""
    model, data = robot.model, robot.model.createData()
    frames = [model.getFrameId(name) for name in robot.foot.frames]
    origin, turn = np.empty((len(q), len(frames), 3)), np.empty((len(q), len(frames), 3, 3))
    for k, x in enumerate(q):
        pin.framesForwardKinematics(model, data, x)
        for i, frame in enumerate(frames):
            origin[k, i], turn[k, i] = data.oMf[frame].translation, data.oMf[frame].rotation
    return origin, turn


def _travel(robot: Robot, feet: Feet) -> dict[str, np.ndarray]:
    """How far the middle between the soles moves (3,) [m], and by how much the feet turn about the vertical [rad]."""
    origin, turn = feet
    middle = (origin + turn @ robot.foot.center)[[0, -1]].mean(axis=1)
    left = turn[..., 1].sum(axis=1)  # it stays level in a flip, too
    turned = np.unwrap(np.arctan2(-left[:, 0], left[:, 1]))
    return {"soles_travel": middle[1] - middle[0], "feet_turn": np.array(turned[-1] - turned[0])}


# on the ground ------------------------------------------------------------------------------------------------------
def holds_of(phase: PhaseSolution, b: WholeBodyTerms) -> dict[int, np.ndarray]:
    """x, y, z [m] and yaw [rad] of the middle of the toe edge of each foot that carries, by side."""
    return {side: np.array([phase.constants[f"{SIDES[side]}_{x}"] for x in ("x", "y", "z", "yaw")]) for side in b.modes}


def edges(b: WholeBodyTerms, side: int, hold: np.ndarray) -> np.ndarray:
    """(6, 4 k): force and moment about the world's origin per unit of each edge of one foot's friction pyramids."""
    turn, columns = pin.rpy.rpyToMatrix(0.0, 0.0, hold[3]), []
    for point in b.points[side]:
        place = hold[:3] + turn @ point
        for x, y in b.limits.friction * EDGES:
            force = turn @ np.array([x, y, 1.0])
            columns.append(np.concatenate([force, np.cross(place, force)]))
    return np.array(columns).T


def _ground(schedule, solved, numbers: range, before: Piece | None, t, starts, gravity: float) -> Piece:
    """A stretch on the ground, phase by phase."""
    fading = _offset(before, solved[numbers[0]]) if before is not None else None
    parts = []
    for k in numbers:
        b, phase = schedule.of(k), solved[k]
        own = (t >= starts[k]) & (t < starts[k + 1])
        if k == numbers[0]:
            own |= t < starts[k + 1]
        if k == numbers[-1]:
            own |= t >= starts[k]
        if not own.any():
            continue
        at = np.clip(t[own] - starts[k], 0.0, phase.duration)
        sampled = phase.sample(at)
        motion = [x[:, : b.nv] for x in sampled]
        if fading is not None:
            gone = _fading(fading, t[own] - t[0])
            motion = [x + y for x, y in zip(motion, gone, strict=True)]
        pitch = {side: [x[:, b.nv + i] for x in sampled] for i, side in enumerate(b.raised)}
        holds = holds_of(phase, b)
        motion = _balanced(b.legs, motion, pitch, holds, t[own], gravity)
        parts.append((motion, *_planned(b, phase, holds, at)))
    motions, wrenches, codes = zip(*parts, strict=True)
    motion = tuple(np.concatenate(x) for x in zip(*motions, strict=True))
    return Piece(t, motion, np.concatenate(wrenches), np.concatenate(codes))


def _offset(before: Piece, phase: PhaseSolution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By what the tape so far ends away from where a phase begins: charts and rates; accelerations may jump."""
    n = before.motion[0].shape[1]
    q, v = (x[-1] - y[0, :n] for x, y in zip(before.motion[:2], (phase.q, phase.v), strict=True))
    return q, v, np.zeros(n)


def _planned(b: WholeBodyTerms, phase: PhaseSolution, holds, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wrenches (n, 2, 6) about the world's origin as planned, and codes of the contacts (n, 2)."""
    wrench, codes, first = np.zeros((len(at), 2, 6)), np.zeros((len(at), 2), np.int8), 0
    for side, hold in holds.items():
        made = edges(b, side, hold)
        z = np.stack([np.interp(at, phase.t, x) for x in phase.z[:, first : first + made.shape[1]].T], -1)
        wrench[:, side], codes[:, side] = z @ made.T, CODES[b.modes[side]]
        first += made.shape[1]
    return wrench, codes


def _balanced(legs: Legs, motion: Motion, pitch, holds, t: np.ndarray, gravity: float) -> Motion:
    """The motion with feet held, its base moved by some micrometres so that the ground's force stays on the toes.

    Where all feet that carry are on their toes, in one line, no ground force has a moment about that line: what the
    motion between nodes needs of it goes.
    """
    from scipy.integrate import cumulative_trapezoid  # slow to import

    b = legs.b
    if len(b.raised) < len(b.modes) or not _in_line(list(holds.values())) or len(t) < 2:
        return legs.held(motion, holds, pitch)
    q, v, a = (y.copy() for y in motion)
    edge = np.mean(list(holds.values()), axis=0)
    across, ahead = (pin.rpy.rpyToMatrix(0.0, 0.0, edge[3])[:, k] for k in (1, 0))
    push = np.zeros(q.shape[1])
    push[:3] = ahead

    def moment(change: np.ndarray | float = 0.0):
        need = np.array(list(_needed(b.model, *legs.held((q, v, a + change), holds, pitch), gravity)))
        return (need[:, 3:] - np.cross(edge[:3], need[:, :3])) @ across

    missing = moment()
    gained = moment(push) - missing  # hardly changed by the corrections
    for k in range(BALANCING):
        more = -(moment() if k else missing) / gained
        rate = cumulative_trapezoid(more, t, initial=0.0)
        for y, change in ((q, cumulative_trapezoid(rate, t, initial=0.0)), (v, rate), (a, more)):
            y += change[:, None] * push
    return legs.held((q, v, a), holds, pitch)


def _in_line(holds: list[np.ndarray]) -> bool:
    """Whether toe edges at x, y, z, yaw are parts of one level line."""
    first = holds[0]
    across = np.array([np.cos(first[3]), np.sin(first[3])])
    return all(
        abs(h[3] - first[3]) < 1e-6 and abs((h[:2] - first[:2]) @ across) < 1e-4 and abs(h[2] - first[2]) < 1e-6
        for h in holds
    )


def _needed(model: SpatialModel, q: np.ndarray, v: np.ndarray, a: np.ndarray, gravity: float):
    """Wrenches (6,) about the world's origin that motions, as charts (n, .), need from the ground, one by one."""
    tree = model.model.copy()
    tree.gravity.linear = np.array([0.0, 0.0, -gravity])
    data = tree.createData()
    for motion in zip(*model.to_pinocchio(q, v, a), strict=True):
        need, (x, y, z, w) = pin.rnea(tree, data, *motion)[:6], motion[0][3:7]
        base = pin.Quaternion(w, x, y, z).toRotationMatrix()
        force = base @ need[:3]
        yield np.concatenate([force, base @ need[3:] + np.cross(motion[0][:3], force)])


# in flight ----------------------------------------------------------------------------------------------------------
def _flight(
    body: Body, flight: PhaseSolution, before: Piece, t, start: float, ends: list[int], gravity: float
) -> Piece:
    """A flight: joints as planned, the base as momentum demands.

    It begins where the tape so far ends; the joints are as planned a little later, and the legs of the feet that come
    down (``ends``) arrive as planned, whatever the base has drifted by.
    """
    model, since = body.model, t - start
    tree, data = model.model, model.model.createData()
    chart0 = [x[-1] for x in before.motion]
    stood = [x[0] for x in model.to_pinocchio(*(x[None] for x in chart0))]
    pin.computeCentroidalMomentum(tree, data, *stood[:2])
    pin.centerOfMass(tree, data, *stood[:2])
    spin, com = data.hg.angular.copy(), (data.com[0].copy(), data.vcom[0].copy())
    halves = np.concatenate([since, (since[1:] + since[:-1]) / 2])
    planned = [x[:, BASE:] for x in flight.sample(halves)]
    off = [x[BASE:] - y[0] for x, y in zip(chart0, planned, strict=True)]
    joints = [x + y for x, y in zip(planned, _fading(off, halves), strict=True)]

    def moved(joints: list[np.ndarray], rows: slice = slice(None)):
        chart, rates = _turning(model, joints, chart0[0][3:6], spin, since)
        own = [x[: len(t)][rows] for x in joints]
        return _falling(model, own, chart[rows], rates[rows], com, since[rows], gravity)

    def bent(change: np.ndarray):
        bends = _arriving(halves, since[-1], *np.split(change, 2))
        return [x + y for x, y in zip(joints, bends, strict=True)]

    def missed(change: np.ndarray) -> np.ndarray:
        last = moved(bent(change), slice(-1, None))
        return np.concatenate(_missed(body, flight, [x[0] for x in last[:2]], ends))

    q, v, a = model.charts(*moved(bent(_landed(missed, 2 * len(chart0[0][BASE:])))), near=chart0[0][3:6])
    return Piece(t, (q, v, a), np.zeros((len(t), 2, 6)), np.zeros((len(t), 2), np.int8))


def _landed(missed: Callable[[np.ndarray], np.ndarray], size: int) -> np.ndarray:
    """The change (size,) of joints and rates at the end of a flight by which nothing is missed there any more.

    A change moves the base as well: in a jump by little, in a flip by about as much, so its effect is measured there.
    """
    change, now, slope = np.zeros(size), missed(np.zeros(size)), np.eye(size)
    best, measured = (change, now), False
    for _ in range(LANDINGS):
        if np.abs(now).max() < LANDED_RAD:
            break
        step, before = slope @ now, now
        change = change + step
        now = missed(change)
        if np.abs(now).max() < np.abs(best[1]).max():
            best = change, now
        if measured or np.abs(now).max() < SLOW * np.abs(before).max():
            slope = _learnt(slope, step, now - before)
        else:
            (change, now), measured = best, True
            slope = -np.linalg.pinv(_measured(missed, change, now, np.flatnonzero(now)))
    return best[0]


def _measured(missed: Callable[[np.ndarray], np.ndarray], change, now, columns) -> np.ndarray:
    """Derivative (size, size) of what is missed by the change, by differences in some of its entries."""
    slope = np.zeros((len(change), len(change)))
    for k in columns:
        moved = change.copy()
        moved[k] += DIFFERENCE
        slope[:, k] = (missed(moved) - now) / DIFFERENCE
    return slope


def _learnt(slope: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Broyden's update of how a correction follows from what is missed, which a ``step`` has changed by ``change``."""
    wrong, along = step + slope @ change, step @ slope
    size = along @ change
    return slope if abs(size) < 1e-30 else slope - np.outer(wrong, along) / size


def _arriving(t: np.ndarray, end: float, shift: np.ndarray, rate: np.ndarray) -> list[np.ndarray]:
    """A motion (n, k) on three levels from rest in zero to ``shift`` with ``rate``, unaccelerated."""
    s = (t / end)[:, None]
    x, y = shift, rate * end
    c3, c4, c5 = 10 * x - 4 * y, -15 * x + 7 * y, 6 * x - 3 * y
    value = s**3 * (c3 + s * (c4 + s * c5))
    slope = s**2 * (3 * c3 + s * (4 * c4 + s * 5 * c5)) / end
    bend = s * (6 * c3 + s * (12 * c4 + s * 20 * c5)) / end**2
    return [value, slope, bend]


def _turning(model: SpatialModel, joints, chart0: np.ndarray, spin: np.ndarray, t: np.ndarray):
    """Angles of the base (n, 3) and their rates at times ``t``, from L; ``joints`` are given there and half-way."""
    data, zero, neutral = model.model.createData(), np.zeros(6), pin.neutral(model.model)[:7]
    own, carried = np.empty((len(joints[0]), 3, 3)), np.empty((len(joints[0]), 3))
    for k, (qj, vj) in enumerate(zip(*joints[:2], strict=True)):
        pin.ccrba(model.model, data, np.concatenate([neutral, qj]), np.concatenate([zero, vj]))
        own[k], carried[k] = data.Ag[3:, 3:6], data.hg.angular
    n = len(t)
    if max(np.abs(x).max() for x in (spin[[0, 2]], carried[:, [0, 2]], own[:, 1, [0, 2]], chart0[:2])) < EVEN:
        return _pitching((spin[1] - carried[:, 1]) / own[:, 1, 1], chart0, t)
    own, (x, y, z) = np.linalg.inv(own), spin.tolist()

    def rate(angles, k):
        (cy, cr, cp), (sy, sr, sp) = np.cos(angles).tolist(), np.sin(angles).tolist()
        ahead, left = cy * x + sy * y, cy * y - sy * x
        up = cr * z - sr * left
        seen = np.array([cp * ahead - sp * up, cr * left + sr * z, sp * ahead + cp * up])  # L in base axes
        wx, wy, wz = (own[k] @ (seen - carried[k])).tolist()
        yaw = (cp * wz - sp * wx) / cr
        return np.array([yaw, cp * wx + sp * wz, wy - sr * yaw])

    chart = np.empty((n, 3))
    chart[0] = chart0
    for k in range(n - 1):  # Runge and Kutta, fourth order
        h, here, mid = t[k + 1] - t[k], chart[k], n + k
        k1 = rate(here, k)
        k2 = rate(here + h / 2 * k1, mid)
        k3 = rate(here + h / 2 * k2, mid)
        chart[k + 1] = here + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(here + h * k3, k + 1))
    return chart, np.array([rate(angles, k) for k, angles in enumerate(chart)])


def _pitching(rate: np.ndarray, chart0: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same where only the pitch turns: its ``rate`` at times ``t`` and half-way, which asks for no attitude."""
    n = len(t)
    chart, rates = np.tile(chart0, (n, 1)), np.zeros((n, 3))
    rates[:, 2] = rate[:n]
    gained = np.diff(t) / 6 * (rate[: n - 1] + 4 * rate[n:] + rate[1:n])
    chart[1:, 2] += np.cumsum(gained)
    return chart, rates


def _missed(body: Body, flight: PhaseSolution, last, sides: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """By what joints (nj,) and their rates have to change at the end for feet to arrive as planned.

    ``last`` are configuration (nq,) and twist (nv,) there.
    """
    tree, still = body.model.model, np.zeros((1, body.model.model.nv))
    data, (q, v) = tree.createData(), (x.copy() for x in last)
    planned = body.model.to_pinocchio(flight.q[-1:, : tree.nv], flight.v[-1:, : tree.nv], still)
    pin.forwardKinematics(tree, data, planned[0][0], planned[1][0])
    goals = {side: (data.oMi[k + 1].copy(), data.v[k + 1].vector.copy()) for side, k in enumerate(body.feet)}
    first, rate = q[7:].copy(), v[6:].copy()
    for _ in range(LEG_STEPS):
        pin.computeJointJacobians(tree, data, q)
        for side in sides:
            k, legs = body.feet[side], np.array(body.legs[side])
            slope = pin.getJointJacobian(tree, data, k + 1, pin.ReferenceFrame.LOCAL)[:, legs]
            q[1 + legs] += np.linalg.pinv(slope) @ pin.log6(data.oMi[k + 1].inverse() * goals[side][0]).vector
    pin.computeJointJacobians(tree, data, q)
    for side in sides:
        k, legs = body.feet[side], np.array(body.legs[side])
        slope = pin.getJointJacobian(tree, data, k + 1, pin.ReferenceFrame.LOCAL)
        v[legs] += np.linalg.pinv(slope[:, legs]) @ (goals[side][1] - slope @ v)
    return q[7:] - first, v[6:] - rate


def _fading(off, t: np.ndarray) -> list[np.ndarray]:
    """A motion (n, k) on three levels that begins with ``off`` (k,) each and has ended after :data:`JOINING_S`."""
    s = np.clip(t / JOINING_S, 0.0, 1.0)
    ends = np.array([[1, 1, 1], [3, 4, 5], [6, 12, 20]])  # value, slope and curvature of s^3, s^4, s^5 at one
    x, v, a = (y * JOINING_S**k for k, y in enumerate(off))
    rest = np.linalg.solve(ends, -np.array([x + v + a / 2, v + a, a]))
    powers = np.concatenate([[x, v, a / 2], rest])  # (6, k) of a polynomial in s
    out = []
    for order in range(3):
        out.append(np.stack([s**k for k in range(len(powers))], -1) @ powers / JOINING_S**order)
        powers = powers[1:] * np.arange(1, len(powers))[:, None]
    return out


def _falling(model: SpatialModel, joints, chart, rates, com, t, gravity):
    """Configurations, twists and accelerations in which nothing but gravity acts on the base."""
    tree, n = model.model.copy(), len(t)
    tree.gravity.linear = np.array([0.0, 0.0, -gravity])
    data, (qj, vj, aj) = tree.createData(), joints
    place, zero = np.zeros((n, 3)), np.zeros((n, 3))
    q, v, a = model.to_pinocchio(
        *(np.concatenate(x, 1) for x in ((place, chart, qj), (zero, rates, vj), (zero, zero, aj)))
    )
    fall = np.array([0.0, 0.0, -gravity])
    for k in range(n):
        pin.centerOfMass(tree, data, q[k], v[k])
        turn = data.oMi[1].rotation
        q[k, :3] = com[0] + com[1] * t[k] + fall * t[k] ** 2 / 2 - data.com[0]
        v[k, :3] = turn.T @ (com[1] + fall * t[k] - data.vcom[0])
        a[k, :6] = 0.0
        missing = pin.rnea(tree, data, q[k], v[k], a[k])[:6]
        a[k, :6] = -np.linalg.solve(pin.crba(tree, data, q[k])[:6, :6], missing)
    return q, v, a


# forces -------------------------------------------------------------------------------------------------------------
def forces(
    robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray, wrench: np.ndarray, contacts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Wrenches at the feet's frames (n, 2, 6), motor torques, CoM with velocity (n, 6), L about the CoM (n, 3).

    What inverse dynamics misses of the ``wrench`` (n, 2, 6) about the origin is shared out by load among the feet that
    carry, by ``contacts`` (n, 2).
    """
    model, data, n, world = robot.model, robot.model.createData(), len(q), pin.ReferenceFrame.WORLD
    frames = [model.getFrameId(name) for name in robot.foot.frames]
    joints = [model.frames[frame].parentJoint for frame in frames]
    standing = np.flatnonzero(contacts.any(axis=1))
    need, com, spin = np.empty((n, model.nv)), np.empty((n, 6)), np.empty((n, 3))
    places, soles, slopes = np.zeros((n, 2, 3)), np.zeros((n, 2, 3)), np.zeros((n, 2, 6, model.nv))
    base, turn = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for k in range(n):
        need[k] = pin.rnea(model, data, q[k], v[k], a[k])
        pin.computeCentroidalMomentum(model, data, q[k], v[k])
        com[k, :3], com[k, 3:], spin[k] = data.com[0], data.hg.linear / robot.total_mass, data.hg.angular
        if contacts[k].any():
            pin.computeJointJacobians(model, data, q[k])
            pin.updateFramePlacements(model, data)
            base[k], turn[k] = data.oMi[1].translation, data.oMi[1].rotation
            for i, (frame, joint) in enumerate(zip(frames, joints, strict=True)):
                places[k, i], soles[k, i] = data.oMf[frame].translation, data.oMf[frame].act(robot.foot.center)
                slopes[k, i] = pin.getJointJacobian(model, data, joint, world)
    s = standing
    force, moment = (np.einsum("nij,nj->ni", turn[s], need[s, at : at + 3]) for at in (0, 3))
    missing = np.concatenate([force, moment + np.cross(base[s], force)], axis=1) - wrench[s].sum(1)
    least = LEAST_LOAD * robot.total_mass * robot.gravity
    total = wrench[s] + _shared(wrench[s], soles[s], contacts[s], missing, least)
    f = np.zeros((n, 2, 6))
    f[s] = total
    f[s, :, 3:] -= np.cross(places[s], total[..., :3])
    need[s] -= np.einsum("nkij,nki->nj", slopes[s], total)
    tau = need[:, 6:] + robot.lost_torque(v[:, 6:]) if robot.lossy else need[:, 6:]
    return f, tau, com, spin


def _shared(wrench: np.ndarray, soles: np.ndarray, contacts: np.ndarray, missing: np.ndarray, least: float):
    """What each foot (n, 2, 6) adds of ``missing`` (n, 6) about the origin: by its load, at its centre of pressure."""
    loaded = wrench[..., 2] > 0  # else in the middle of the sole (n, 2, 3)
    up = np.where(loaded, wrench[..., 2], 1.0)
    pressed = np.stack([-wrench[..., 4] / up, wrench[..., 3] / up, 0 * up], -1)
    x, y, z = np.moveaxis(np.where(loaded[..., None], pressed, soles), -1, 0)
    column, zero = np.tile(np.eye(6), (*wrench.shape[:2], 1, 1)), np.zeros_like(x)
    arm = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    column[..., 3:, :3] = arm.reshape(*x.shape, 3, 3)
    load = np.maximum(wrench[..., 2], least) * (contacts > 0)
    share = load[..., None] * np.repeat([1.0, WRENCH_ARM_M**2], 3)
    weighted = share[..., None] * np.swapaxes(column, -1, -2)  # (n, 2, 6, 6)
    whole = np.einsum("nkij,nkjl->nil", column, weighted)
    given = weighted @ np.linalg.solve(whole, missing[..., None])[:, None]
    return np.einsum("nkij,nkj->nki", column, given[..., 0])
