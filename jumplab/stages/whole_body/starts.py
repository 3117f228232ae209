"""Where a solve begins: a motion along the schedule by inverse kinematics, or one that is known already."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from jumplab.ocp.solution import PhaseGuess, PhaseSolution
from jumplab.robot.stance import leg_length
from jumplab.stages.whole_body.contacts import SIDES
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.terms import Body, WholeBodyTerms
from jumplab.task import JumpTask

# of the base, as shares of the leg's length; angles [rad]
CROUCH, LANDED, TUCK = 0.20, 0.12, 0.15
BOW, PITCH, HEEL_UP = 0.35, 0.12, 0.4
# the arms about a flight: back in the crouch, ahead as the feet leave, by the middle of the flight and at its end
ARMS = 0.5, -1.0, -0.2, 0.2
FOLD_RAD, FOLDED = 1.3, (0.2, 0.8)  # of hips and knees in a flight that turns over, between those shares of it
CROUCH_S = 0.35  # before and after a flight
SWING = 0.1  # of the leg, by which a foot that steps is lifted
RAMP_S = 0.15  # before take-off, in which a base begins to go aside and to turn
SIDE, YAW = 1, 3  # columns of the chart
EARLY = 0.15  # of the way of a flight, which the base has made before it, and makes after it
REACHED = 0.3  # [m, rad] a start whose feet are farther off their places is none
IK_STEPS, DAMPING, IK_STEP_RAD = 10, 1e-4, 0.3
OFF_M = 0.02  # [m, rad] a given motion whose feet are farther off their places is not begun with
NEAR_M = 1e-3  # [m, rad] near enough for a start
RATE_BOX, ACCELERATION_BOX = 15.0, 150.0  # of differences, where the start is rough


@dataclass(frozen=True)
class Motion:
    """A motion along a schedule, to begin with: per phase its duration [s] and charts (N + 1, 6 + joints).

    ``missed`` is by how much feet are off their places at worst [m, rad].
    """

    durations: np.ndarray
    charts: list[np.ndarray]
    missed: float = 0.0


class Reach:
    """Charts in which the legs bring the feet to where they are asked for, as near as they reach."""

    def __init__(self, body: Body, margin_rad: float):
        self.body, self.tree = body, body.model.model
        self.data = self.tree.createData()
        self.frames = [self.tree.getFrameId(name) for name in body.robot.foot.frames]
        self.columns = [np.array(x) for x in body.legs]
        low, high = self.tree.lowerPositionLimit[7:] + margin_rad, self.tree.upperPositionLimit[7:] - margin_rad
        for k, sign, angle in body.knees:  # never bent the other way
            end = sign * (0.1 - angle)
            if sign > 0:
                low[k] = max(low[k], end)
            else:
                high[k] = min(high[k], end)
        self.low, self.high = np.minimum(low, body.stance[BASE:]), np.maximum(high, body.stance[BASE:])
        self.tip = pin.SE3(np.eye(3), np.array(body.robot.foot.tip))

    def __call__(
        self, chart: np.ndarray, goals: Mapping[int, pin.SE3], carrying: list[int]
    ) -> tuple[np.ndarray, float]:
        """The chart with its legs moved so that the middles of the toe edges are at ``goals``.

        And by how much those that are ``carrying`` are still off [m, rad].
        """
        chart, left = chart.copy(), 0.0
        for _ in range(IK_STEPS):
            q = self.body.model.to_pinocchio(chart[None], *np.zeros((2, 1, len(chart))))[0][0]
            pin.computeJointJacobians(self.tree, self.data, q)
            pin.updateFramePlacements(self.tree, self.data)
            left = far = 0.0
            for side, goal in goals.items():
                at = self.data.oMf[self.frames[side]] * self.tip
                off = pin.log6(at.actInv(goal)).vector
                frame = self.tip.toActionMatrixInverse() @ pin.getFrameJacobian(
                    self.tree, self.data, self.frames[side], pin.ReferenceFrame.LOCAL
                )
                slope = frame[:, self.columns[side]]
                step = slope.T @ np.linalg.solve(slope @ slope.T + DAMPING * np.eye(6), off)
                chart[self.columns[side]] += np.clip(step, -IK_STEP_RAD, IK_STEP_RAD)
                far = max(far, float(np.abs(off).max()))
                if side in carrying:
                    left = max(left, float(np.abs(off).max()))
            chart[BASE:] = np.clip(chart[BASE:], self.low, self.high)
            if far < NEAR_M:
                break
        return chart, left


def along(schedule: Schedule, task: JumpTask) -> Motion:
    """A motion along the schedule: the base above feet that carry, down before and after a flight, a parabola in it;
    feet on their places, and between them on bumps; legs by inverse kinematics."""
    from scipy.ndimage import gaussian_filter1d  # slow to import

    contacts, body, gravity = schedule.contacts, schedule.body, task.gravity
    leg, count = leg_length(body.robot), len(contacts.phases)
    times = np.array([p.guess_s for p in contacts.phases])
    last = count - 1
    if contacts.ends == "touchdown":
        drop = max(
            task.takeoff_speed**2 - 2 * gravity * (task.platform_m - LANDED * leg), (0.3 * task.takeoff_speed) ** 2
        )
        times[last] = (task.takeoff_speed + np.sqrt(drop)) / gravity
    starts = np.concatenate([[0.0], np.cumsum(times)])
    holds = _footholds(schedule, task)
    fine = np.linspace(0, starts[-1], 500)
    base = body.stance[:BASE]
    ahead = base[0] - body.places[:, 0].mean()
    keys = [(0.0, np.array([base[0], base[1], 0.0, 0.0]))]
    above = [
        None if p.flying else _over([holds[contacts.contact_of(k, s)] for s in p.modes], ahead)
        for k, p in enumerate(contacts.phases)
    ]
    if contacts.ends == "touchdown":
        above.append(_over(_goal(schedule, task), ahead))
    for k, p in enumerate(contacts.phases):
        if not p.flying:
            keys.append(((starts[k] + starts[k + 1]) / 2, above[k]))
            continue
        way = above[k + 1] - above[k - 1]
        keys += [(starts[k], above[k - 1] + EARLY * way), (starts[k + 1], above[k + 1] - EARLY * way)]
    at, path = np.array([t for t, _ in keys]), np.array([x for _, x in keys])
    smooth = [gaussian_filter1d(np.interp(fine, at, path[:, i]), 6, mode="nearest") for i in range(4)]
    height, pitch = base[2] + smooth[3], np.full_like(fine, base[5])
    arms = np.zeros_like(fine)
    for k, p in enumerate(contacts.phases):
        if p.flying:
            _flown(fine, starts[k], starts[k + 1], leg, gravity, height, pitch)
            arms += _swung(fine, starts[k], starts[k + 1])
    turned = np.interp(fine, [starts[last], starts[-1]], [0.0, task.rotation_rad])
    curves = [*smooth[:2], height, smooth[2], np.full_like(fine, base[4]), pitch + turned, arms]
    return _reached(schedule, task, times, holds, lambda t: [np.interp(t, fine, c) for c in curves])


def _reached(schedule: Schedule, task: JumpTask, times: np.ndarray, holds: list[np.ndarray], curves) -> Motion:
    """The motion whose base and arms follow ``curves`` (time [s] -> x, y, z, yaw, roll, pitch, swing of the arms)."""
    contacts, body = schedule.contacts, schedule.body
    starts, leg = np.concatenate([[0.0], np.cumsum(times)]), leg_length(body.robot)
    reach, chart, missed, charts = Reach(body, schedule.limits.range_margin_rad), body.stance.copy(), 0.0, []
    for k, p in enumerate(contacts.phases):
        rows = []
        for t in np.linspace(starts[k], starts[k + 1], p.intervals + 1):
            *chart[:BASE], swing = curves(t)
            for column, sign in body.shoulders:
                chart[column] = body.stance[column] + sign * swing
            if p.flying and task.rotation_rad:
                rows.append(_folded(body, chart, (t - starts[k]) / (starts[k + 1] - starts[k])))
                continue
            goals = {side: _foot(schedule, holds, task, k, side, t, starts, leg) for side in (0, 1)}
            chart, left = reach(chart, goals, list(p.modes))
            if left > REACHED:  # a leg that was drawn somewhere is no beginning
                chart[BASE:] = body.stance[BASE:]
                chart, left = reach(chart, goals, list(p.modes))
            missed = max(missed, left)
            rows.append(chart.copy())
        charts.append(np.array(rows))
    charts[0][0] = body.stance
    return Motion(times, charts, missed)


def mended(schedule: Schedule, task: JumpTask, motion: Motion) -> Motion:
    """A motion with its feet put in their places by the legs; where they do not reach, one along the schedule."""
    reach = Reach(schedule.body, schedule.limits.range_margin_rad)
    starts, leg = np.concatenate([[0.0], np.cumsum(motion.durations)]), leg_length(schedule.body.robot)
    holds, usual, charts = _footholds(schedule, task), along(schedule, task).charts, []
    for k, rows in enumerate(motion.charts):
        times, legs = np.linspace(starts[k], starts[k + 1], len(rows)), []
        for t, chart, other in zip(times, rows, usual[k], strict=True):
            goals = {side: _foot(schedule, holds, task, k, side, t, starts, leg) for side in (0, 1)}
            moved, left = reach(chart, goals, list(goals))
            legs.append(moved if left < OFF_M else other)
        charts.append(np.array(legs))
    return replace(motion, charts=charts)


def _over(holds: list[np.ndarray], ahead: float) -> np.ndarray:
    """Place and heading of the base above feet at x, y, z, yaw: x, y, yaw, and how much higher."""
    x, y, z, yaw = np.mean(holds, axis=0)
    return np.array([x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), yaw, z])


def _goal(schedule: Schedule, task: JumpTask) -> list[np.ndarray]:
    """x, y, z, yaw of the middles of both toe edges where a jump that ends at touchdown comes down."""
    body, (c, s) = schedule.body, (np.cos(task.yaw_rad), np.sin(task.yaw_rad))
    centre = body.places.mean(axis=0) - [body.half_m, 0.0, 0.0]
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    places = centre + [task.distance_m, task.side_m, task.platform_m] + (body.places - centre) @ turn.T
    return [np.append(place, task.yaw_rad) for place in places]


def _footholds(schedule: Schedule, task: JumpTask) -> list[np.ndarray]:
    """x, y, z, yaw of the middle of the toe edge in each contact."""
    count = len(schedule.contacts.landings)
    return [np.array([np.mean(box) for box in schedule.foothold(i)]) for i in range(count)]


def _flown(t, start: float, end: float, leg: float, gravity: float, height: np.ndarray, pitch: np.ndarray) -> None:
    """Adds a flight to the curves of height and pitch: down and up before it, a parabola, down after it."""
    u = np.clip((t - start) / (end - start), 0, 1)
    height += gravity * (end - start) ** 2 / 2 * u * (1 - u)
    before, after = np.clip((t - start) / CROUCH_S + 1, 0, 1), np.clip((t - end) / CROUCH_S, 0, 1)
    height -= leg * CROUCH * np.sin(np.pi * before) * (before < 1)
    height -= leg * LANDED * np.minimum(2 * u, 1) * (1 - np.sin(np.pi * after / 2))
    pitch += (BOW - pitch[0]) * np.sin(np.pi * before) + (PITCH - pitch[0]) * (u > 0) * (1 - after)


def _swung(t, start: float, end: float) -> np.ndarray:
    """Swing of the arms about one flight [rad], backward positive."""
    crouch, left, middle, landed = ARMS
    times = start - CROUCH_S, start - 0.4 * CROUCH_S, start, (start + end) / 2, end, end + CROUCH_S
    return np.interp(t, times, [0.0, crouch, left, middle, landed, 0.0])


def _folded(body: Body, chart: np.ndarray, share: float) -> np.ndarray:
    """The chart with legs as in the stance, folded in the middle of the flight: they turn over with the body."""
    found, (first, last) = chart.copy(), FOLDED
    legs = sorted({k for side in body.legs for k in side})
    found[legs] = body.stance[legs]
    fold = FOLD_RAD * _smooth(share / first) * (1 - _smooth((share - last) / (1 - last)))
    for k, sign, _ in body.knees:
        found[BASE + k] += sign * fold
    for name, sign in zip(body.robot.joints["hip_pitch"], body.robot.sagittal.signs[0], strict=True):
        found[BASE + body.joint_names.index(name)] -= sign * fold
    return found


def _foot(schedule, holds, task, k: int, side: int, t: float, starts: np.ndarray, leg: float) -> pin.SE3:
    """Where the middle of a toe edge is at one instant."""
    contacts = schedule.contacts
    phases = contacts.phases
    if side in phases[k].modes:
        x, y, z, yaw = holds[contacts.contact_of(k, side)]
        share = np.clip((t - starts[k]) / (starts[k + 1] - starts[k]), 0, 1)
        tip = HEEL_UP * share**2 if phases[k].modes[side] == "toe" else 0.0
        return pin.SE3(pin.rpy.rpyToMatrix(0.0, tip, yaw), np.array([x, y, z]))
    left = max(i for i in range(k) if side in phases[i].modes)
    down = next((i for i in range(k, len(phases)) if side in phases[i].modes), None)
    begin, end = starts[left + 1], starts[-1] if down is None else starts[down]
    a = holds[contacts.contact_of(left, side)]
    if down is not None:
        b = holds[contacts.contact_of(down, side)]
    else:
        b = _goal(schedule, task)[side] if contacts.ends == "touchdown" else a
    u = (t - begin) / (end - begin)
    x, y, z, yaw = a + (b - a) * _smooth(u)
    z = a[2] + (b[2] - a[2]) * _smooth(2 * u if b[2] > a[2] else 2 * u - 1)  # above an edge before it, and beyond
    lift = SWING * leg * np.sin(np.pi * u)
    if phases[k].flying:
        s = (t - starts[k]) / (starts[k + 1] - starts[k])
        rise = task.gravity * (starts[k + 1] - starts[k]) ** 2 / 2 * s * (1 - s)
        lift = max(lift, rise + leg * TUCK * 4 * s * (1 - s))
    tip = HEEL_UP * (1 - u) ** 2 if phases[left].modes[side] == "toe" else 0.0
    way = pin.rpy.rpyToMatrix(0.0, tip, yaw)
    place = np.array([x, y, z + lift])
    return pin.SE3(way, place)


def _smooth(u: float) -> float:
    """From 0 at 0 to 1 at 1, at rest at both."""
    u = float(np.clip(u, 0.0, 1.0))
    return u**3 * (10 - 15 * u + 6 * u * u)


def still(schedule: Schedule, task: JumpTask) -> Motion:
    """The stance, carried along above the feet; for schedules whose feet the legs do not reach."""
    motion = along(schedule, task)
    charts = []
    for rows in motion.charts:
        same = np.tile(schedule.body.stance, (len(rows), 1))
        same[:, [0, 1, 3]] = rows[:, [0, 1, 3]]
        charts.append(same)
    return Motion(motion.durations, charts)


def guess(schedule: Schedule, motion: Motion) -> dict[str, PhaseGuess]:
    """Phase name -> start values of a motion: rates by differences, even forces, no torques."""
    contacts, body, out = schedule.contacts, schedule.body, {}
    starts = np.concatenate([[0.0], np.cumsum(motion.durations)])
    times = [np.linspace(starts[k], starts[k + 1], len(q)) for k, q in enumerate(motion.charts)]
    first = [0, *[1] * (len(times) - 1)]
    t = np.concatenate([x[i:] for x, i in zip(times, first, strict=True)])
    q = np.concatenate([x[i:] for x, i in zip(motion.charts, first, strict=True)])
    v = np.clip(np.gradient(q, t, axis=0), -RATE_BOX, RATE_BOX)
    a = np.clip(np.gradient(v, t, axis=0), -ACCELERATION_BOX, ACCELERATION_BOX)
    pitch = _pitches(body, q)
    for k, (phase, at) in enumerate(zip(contacts.phases, times, strict=True)):
        b, rows = schedule.of(k), np.searchsorted(t, at - 1e-9)
        heels = [np.maximum(pitch[rows, side], 0.0) for side in b.raised]
        level = np.zeros((len(rows), len(heels)))
        z = np.zeros((len(rows), len(b.states)))
        for side in b.sides:
            names = enumerate(b.states[: b.n_forces])
            own = [i for i, name in names if name.endswith(f"of {SIDES[side]} foot")]
            z[:, own] = body.mg / len(b.modes) / len(own)
        constants = {}
        for side in b.sides:
            contact = contacts.contact_of(k, side)
            for name, box in zip(("x", "y", "z", "yaw"), schedule.foothold(contact), strict=True):
                constants[f"{SIDES[side]}_{name}"] = float(np.mean(box))
        if b.flying:
            flown = _flight_constants(body, q[rows], v[rows], motion.durations[k], schedule)
            constants |= {name: flown[name] for name in b.constants}
        nodes = [np.column_stack([schedule.free.taken(motion.charts[k]), *heels])]
        nodes += [np.column_stack([schedule.free.taken(x[rows]), level]) for x in (v, a)]
        out[phase.name] = PhaseGuess(float(motion.durations[k]), *nodes, z, constants)
    return out


def beside(schedule: Schedule, phases: Mapping[str, PhaseSolution]) -> dict[str, PhaseGuess]:
    """Phase name -> start values of a solution with every coordinate free, in the coordinates of a schedule."""
    out = {}
    for k, phase in enumerate(schedule.contacts.phases):
        b, w, near = schedule.of(k), schedule.whole.of(k), phases[phase.name].guess(phase.intervals)
        columns = [w.coordinates.index(name) for name in b.coordinates]
        z = np.zeros((len(near.q), len(b.states)))
        z[:, b.n_forces :] = near.z[:, [w.states.index(name) for name in b.states[b.n_forces :]]]
        if b.n_forces == w.n_forces:
            z[:, : b.n_forces] = near.z[:, : b.n_forces]
        else:
            z[:, : b.n_forces] = b.mg * len(b.sides) / len(b.modes) / b.n_forces
        constants = {name: near.constants[name] for name in _constant_names(b)}
        motion = (x[:, columns] for x in (near.q, near.v, near.a))
        out[phase.name] = PhaseGuess(near.duration, *motion, z, constants)
    return out


def ramped(schedule: Schedule, phases: Mapping[str, PhaseSolution], task: JumpTask) -> dict[str, PhaseGuess]:
    """Phase name -> start values: a jump straight ahead, whose base goes aside and turns until the target is reached.

    It begins :data:`RAMP_S` before take-off.
    """
    out, near = {}, beside(schedule, phases)
    ends = np.cumsum([x.duration for x in near.values()])
    begin = max(0.0, ends[-2] - RAMP_S)
    for (name, x), end in zip(near.items(), ends, strict=True):
        u = np.clip((np.linspace(end - x.duration, end, len(x.q)) - begin) / (ends[-1] - begin), 0.0, 1.0)
        value = u**3 * (10 - 15 * u + 6 * u * u)
        slope = 30 * u**2 * (1 - u) ** 2 / (ends[-1] - begin)
        bend = 60 * u * (1 - u) * (1 - 2 * u) / (ends[-1] - begin) ** 2
        motion = [y.copy() for y in (x.q, x.v, x.a)]
        for y, shape in zip(motion, (value, slope, bend), strict=True):
            y[:, SIDE] += task.side_m * shape
            y[:, YAW] += task.yaw_rad * shape
        constants = dict(x.constants)
        if "vel_y" in constants:
            constants["vel_y"] = task.side_m / x.duration
        out[name] = replace(x, **dict(zip("qva", motion, strict=True)), constants=constants)
    return out


def _constant_names(b: WholeBodyTerms) -> list[str]:
    if b.flying:
        return b.constants
    return [f"{SIDES[side]}_{x}" for side in b.sides for x in ("x", "y", "z", "yaw")]


def _pitches(body: Body, q: np.ndarray) -> np.ndarray:
    """Pitch of both feet (n, 2) in charts (n, .) [rad], heel up positive."""
    tree, data = body.model.model, body.model.model.createData()
    frames = [tree.getFrameId(name) for name in body.robot.foot.frames]
    out = []
    for x in body.model.to_pinocchio(q, 0 * q, 0 * q)[0]:
        pin.framesForwardKinematics(tree, data, x)
        turns = [data.oMf[f].rotation for f in frames]
        out.append([np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0])) for r in turns])
    return np.array(out)


def _flight_constants(body: Body, q, v, duration: float, schedule: Schedule) -> dict[str, float]:
    """CoM at take-off, its velocity by where it comes down, no angular momentum."""
    tree, data = body.model.model, body.model.model.createData()
    ends = body.model.to_pinocchio(q[[0, -1]], 0 * q[[0, -1]], 0 * q[[0, -1]])[0]
    first, last = (pin.centerOfMass(tree, data, x).copy() for x in ends)
    speed = (last - first) / duration
    speed[2] += body.robot.gravity * duration / 2
    values = {"com": first, "vel": speed, "L": np.zeros(3)}
    return {f"{kind}_{x}": float(y) for kind, column in values.items() for x, y in zip("xyz", column, strict=True)}
