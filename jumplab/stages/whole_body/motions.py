"""Motions along a contact schedule to begin a solve with, by inverse kinematics; and what their
values at the nodes are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from jumplab.models.spatial import SpatialModel
from jumplab.ocp.solution import PhaseGuess, PhaseSolution, quintic, resampled
from jumplab.robot.contact import on_feet
from jumplab.robot.legs import bring_feet, give_of
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import HOLD, SIDES, Contacts
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.tape import feet_of
from jumplab.task import JumpTask

# of the base, as shares of the leg's length; angles [rad]
CROUCH = 0.20
LANDED = 0.12
TUCK = 0.15
BOW = 0.35
PITCH = 0.12
HEEL_UP = 0.4
# the arms about a flight: back in the crouch, ahead as the feet leave, by the middle of the flight
# and at its end
ARMS = 0.5, -1.0, -0.2, 0.2
# of hips and knees in a flight that turns over, between those shares of it
FOLD_RAD = 1.3
FOLDED = (0.2, 0.8)
CROUCH_S = 0.35  # before and after a flight
SWING = 0.1  # of the leg, by which a foot that steps is lifted
RAMP_S = 0.15  # before take-off, in which a base begins to go aside and to turn
EARLY = 0.15  # of the way of a flight, which the base has made before it, and makes after it
SAMPLES = 500  # of the base's path
SMOOTHING = 6  # such samples, over which it is rounded
# [m, rad] motions whose feet are farther off their places are no start: a drawn one, a given one
REACHED = 0.3
OFF_M = 0.02
# inverse kinematics
IK_STEPS = 10
DAMPING = 1e-4  # [m^2, rad^2]
IK_STEP_RAD = 0.3
NEAR_M = 1e-5  # [m, rad] near enough
LEAST_BEND_RAD = 0.1  # of knees, which never bend the other way
# of differences, where the start is rough
RATE_BOX = 15.0
ACCELERATION_BOX = 150.0
# columns of the chart
SIDE = 1
YAW = 3


@dataclass(frozen=True)
class Motion:
    """A motion along a schedule, to begin with: per phase its duration [s] and charts (N + 1, 6 +
    joints).

    ``missed`` is by how much feet are off their places at worst [m, rad].
    """

    durations: np.ndarray
    charts: list[np.ndarray]
    missed: float = 0.0

    @property
    def starts(self) -> np.ndarray:
        """When each phase begins, and the end of the last (phases + 1,) [s]."""
        return np.concatenate([[0.0], np.cumsum(self.durations)])


def along(schedule: Schedule, task: JumpTask, crouch: float = CROUCH, arms: float = 1.0) -> Motion:
    """A motion along the schedule, per phase charts (N + 1, 6 + joints): the base above feet that
    carry, down before and after a flight, a parabola in it; feet on their places, and between them
    on bumps; legs by inverse kinematics.

    ``crouch`` is how far the base goes down before a flight, of the leg's length, and ``arms`` how
    far arms swing, of :data:`ARMS` [1].
    """
    contacts = schedule.contacts
    body = schedule.body
    durations = np.array([p.guess_s for p in contacts.phases])
    if contacts.aimed or contacts.ends == "touchdown":
        durations[contacts.last_flight] = _flight_s(task, body.leg_m)
    motion = Motion(durations, [])
    curves = _curves(schedule, task, motion.starts, crouch, arms)
    reach = Reach(body, schedule.limits.range_margin_rad)
    feet = Feet(schedule, task, motion.starts)
    missed = 0.0
    chart = body.stance.copy()
    for k, p in enumerate(contacts.phases):
        rows = []
        for t in feet.times(k):
            *chart[:BASE], swing = curves(t)
            for column, sign in body.shoulders:
                chart[column] = body.stance[column] + sign * swing
            if p.flying and task.rotation_rad:
                rows.append(_folded(body, chart, feet.share(k, t)))
                continue
            goals = [feet.place(k, side, t) for side in (0, 1)]
            carrying = list(p.modes)
            chart, left = reach(chart, goals, carrying)
            if left > REACHED:  # a leg that was drawn somewhere is no beginning
                stood = np.append(chart[:BASE], body.stance[BASE:])
                chart, left = reach(stood, goals, carrying)
            missed = max(missed, left)
            rows.append(chart.copy())
        motion.charts.append(np.array(rows))
    motion.charts[0][0] = body.stance
    return replace(motion, missed=missed)


def still(schedule: Schedule, task: JumpTask) -> Motion:
    """The stance, carried above the feet as :func:`along` does (n, .); for schedules whose feet the
    legs do not reach.
    """
    motion = along(schedule, task)
    carried = np.isin(range(len(schedule.body.stance)), [0, SIDE, YAW])
    charts = [np.where(carried, rows, schedule.body.stance) for rows in motion.charts]
    return Motion(motion.durations, charts)


def reached(schedule: Schedule, task: JumpTask, **drawn: float) -> Motion:
    """The motion :func:`along` the schedule, as it is ``drawn``, if its feet are near their places
    (by less than :data:`REACHED`), else the stance.
    """
    motion = along(schedule, task, **drawn)
    return motion if motion.missed < REACHED else still(schedule, task)


def mended(schedule: Schedule, task: JumpTask, motion: Motion) -> Motion:
    """A motion (charts as of :func:`along`) with its feet put in their places by the legs; where
    they do not reach, the one along the schedule.
    """
    reach = Reach(schedule.body, schedule.limits.range_margin_rad)
    feet = Feet(schedule, task, motion.starts)
    usual = along(schedule, task).charts
    charts = []
    for k, rows in enumerate(motion.charts):
        legs = []
        for t, chart, other in zip(feet.times(k), rows, usual[k], strict=True):
            moved, left = reach(chart, [feet.place(k, side, t) for side in (0, 1)], [0, 1])
            legs.append(moved if left < OFF_M else other)
        charts.append(np.array(legs))
    return replace(motion, charts=charts)


class Reach:
    """Charts whose legs bring the feet to where they are asked for, as near as they reach."""

    def __init__(self, body: Body, margin_rad: float):
        self.model = body.model
        self.data = body.model.model.createData()
        self.feet = on_feet(body.robot, body.robot.foot.tip)
        self.give = give_of(body.robot)
        low, high = body.ranges(margin_rad, LEAST_BEND_RAD, np.inf)
        stance = body.stance[BASE:]
        self.limits = np.minimum(low, stance), np.maximum(high, stance)

    def __call__(
        self, chart: np.ndarray, goals: Sequence[pin.SE3], carrying: Sequence[int]
    ) -> tuple[np.ndarray, float]:
        """The chart (6 + joints,) with its legs moved so that the middles of the toe edges are at
        ``goals``, and by how much those that are ``carrying`` are still off [m, rad].
        """
        q = configurations(self.model, chart[None])[0]
        options = dict(damping=DAMPING, most_rad=IK_STEP_RAD, steps=IK_STEPS, near=NEAR_M)
        wanted = dict(zip(self.feet, goals, strict=True))
        there, missed = bring_feet(
            self.model.model, self.data, q, wanted, self.give, limits=self.limits, **options
        )
        left = float(np.abs(missed[carrying]).max(initial=0.0))
        return np.concatenate([chart[:BASE], there[7:]]), left


def configurations(model: SpatialModel, charts: np.ndarray) -> np.ndarray:
    """Configurations (n, nq) of charts (n, 6 + joints)."""
    return model.to_pinocchio(charts, 0 * charts, 0 * charts)[0]


# the base
# ----------------------------------------------------------------------------------------------
def _flight_s(task: JumpTask, leg: float) -> float:
    """Duration of a jump's flight, which ends on bent legs of length ``leg`` [m]."""
    speed = task.takeoff_speed
    fallen = speed**2 - 2 * task.gravity * (task.platform_m - LANDED * leg)
    return (speed + np.sqrt(max(fallen, (0.3 * speed) ** 2))) / task.gravity


def _curves(
    schedule: Schedule, task: JumpTask, starts: np.ndarray, crouch: float, swing: float
) -> Callable[[float], list[float]]:
    """Time [s] -> x, y, z, yaw, roll, pitch of the base and swing of the arms; ``crouch`` and
    ``swing`` as of :func:`along`.
    """
    from scipy.ndimage import gaussian_filter1d  # slow to import

    body = schedule.body
    fine = np.linspace(0, starts[-1], SAMPLES)
    at, path = _path(schedule, task, starts)
    rounded = gaussian_filter1d(resampled(at, path, fine), SMOOTHING, axis=0, mode="nearest")
    x, y, yaw, up = rounded.T
    height = body.stance[2] + up
    pitch = np.full_like(fine, body.stance[5])
    arms = np.zeros_like(fine)
    back, left, middle, landed = ARMS
    for k, p in enumerate(schedule.contacts.phases):
        if not p.flying:
            continue
        begin, end = starts[k : k + 2]
        u = np.clip((fine - begin) / (end - begin), 0, 1)
        before = np.clip((fine - begin) / CROUCH_S + 1, 0, 1)
        after = np.clip((fine - end) / CROUCH_S, 0, 1)
        height += task.gravity * (end - begin) ** 2 / 2 * u * (1 - u)
        height -= body.leg_m * crouch * np.sin(np.pi * before) * (before < 1)
        height -= body.leg_m * LANDED * np.minimum(2 * u, 1) * (1 - np.sin(np.pi * after / 2))
        pitch += (BOW - pitch[0]) * np.sin(np.pi * before)
        pitch += (PITCH - pitch[0]) * (u > 0) * (1 - after)
        times = begin - CROUCH_S, begin - 0.4 * CROUCH_S, begin, (begin + end) / 2, end
        swings = [0.0, back, left, middle, landed, 0.0]
        arms += swing * np.interp(fine, [*times, end + CROUCH_S], swings)
    pitch += np.interp(fine, starts[-2:], [0.0, task.rotation_rad])
    curves = [x, y, height, yaw, np.full_like(fine, body.stance[4]), pitch, arms]
    return lambda t: [np.interp(t, fine, curve) for curve in curves]


def _path(schedule: Schedule, task: JumpTask, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (m,) [s], and x, y, yaw of the base and by how much it is higher (m, 4) then."""
    body = schedule.body
    ahead = body.stance[0] - body.places[:, 0].mean()
    width = np.sum((body.places[0] - body.places[1])[:2] ** 2)
    above = []
    for feet in footholds(schedule, task):
        x, y, z, yaw = np.mean([*feet.values()], axis=0) if feet else np.zeros(4)
        if len(feet) == len(SIDES):
            # over feet further apart than in the stance, legs bend so much that they reach both
            # from above one of them
            further = np.sum((feet[0] - feet[1])[:2] ** 2) - width
            z -= max(further, 0.0) / body.leg_m
        above.append(np.array([x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), yaw, z]))
    times = [0.0]
    keys = [np.array([*body.stance[:2], 0.0, 0.0])]
    for k, p in enumerate(schedule.contacts.phases):
        if p.flying:
            way = above[k + 1] - above[k - 1]
            times += starts[k : k + 2].tolist()
            keys += [above[k - 1] + EARLY * way, above[k + 1] - EARLY * way]
        else:
            times.append(starts[k : k + 2].mean())
            keys.append(above[k])
    return np.array(times), np.array(keys)


def _folded(body: Body, chart: np.ndarray, share: float) -> np.ndarray:
    """The chart with legs as in the stance, folded in the middle of the flight: they turn over with
    the body.
    """
    folded = chart.copy()
    first, last = FOLDED
    legs = sorted({k for side in body.legs for k in side})
    folded[legs] = body.stance[legs]
    fold = FOLD_RAD * _smooth(share / first) * (1 - _smooth((share - last) / (1 - last)))
    for k, sign, _ in body.knees:
        folded[BASE + k] += sign * fold
    for column, sign in body.hips:
        folded[column] -= sign * fold
    return folded


def _smooth(u: float) -> float:
    """From 0 at 0 to 1 at 1, at rest at both."""
    u = float(np.clip(u, 0.0, 1.0))
    return u**3 * (10 - 15 * u + 6 * u * u)


# the feet
# ----------------------------------------------------------------------------------------------
def footholds(schedule: Schedule, task: JumpTask) -> list[dict[int, np.ndarray]]:
    """Side -> x, y, z [m] and yaw [rad] of the middle of the toe edge: of the feet that are on the
    ground in each phase, and in the end.
    """
    contacts = schedule.contacts
    body = schedule.body
    holds = [
        {side: np.mean(schedule.foothold(contacts.contact_of(k, side)), axis=1) for side in p.modes}
        for k, p in enumerate(contacts.phases)
    ]
    for k in range(contacts.last_flight + 1, len(holds) * contacts.aimed):
        for hold in holds[k].values():
            hold += [task.distance_m + _left_ahead(schedule, holds), 0.0, task.platform_m, 0.0]
    if contacts.ends == "rest":
        return [*holds, holds[-1]]
    turn = pin.rpy.rpyToMatrix(0.0, 0.0, task.yaw_rad)
    centre = body.places.mean(axis=0) - [body.half_m, 0.0, 0.0]
    way = np.array([task.distance_m, task.side_m, task.platform_m])
    places = centre + way + (body.places - centre) @ turn.T
    return [*holds, {side: np.append(x, task.yaw_rad) for side, x in enumerate(places)}]


def _left_ahead(schedule: Schedule, holds: Sequence[Mapping[int, np.ndarray]]) -> float:
    """By how much the feet that leave last are ahead of where they stood first [m]."""
    left = holds[schedule.contacts.last_flight - 1]
    return float(np.mean([x[0] - schedule.body.places[side, 0] for side, x in left.items()]))


class Feet:
    """Places of the feet along a schedule whose phases begin at ``starts`` (phases + 1,) [s]."""

    def __init__(self, schedule: Schedule, task: JumpTask, starts: np.ndarray):
        self.phases = schedule.contacts.phases
        self.leg_m = schedule.body.leg_m
        self.gravity = task.gravity
        self.starts = starts
        self.holds = footholds(schedule, task)

    def times(self, k: int) -> np.ndarray:
        """When the nodes of a phase are [s]."""
        return np.linspace(*self.starts[k : k + 2], self.phases[k].intervals + 1)

    def share(self, k: int, t: float) -> float:
        """The share [1] of a phase that is over at an instant ``t`` [s]."""
        begin, end = self.starts[k : k + 2]
        return float(np.clip((t - begin) / (end - begin), 0.0, 1.0))

    def place(self, k: int, side: int, t: float) -> pin.SE3:
        """Placement of the middle of a toe edge at one instant ``t`` of a phase [s, m]."""
        mode = self.phases[k].modes.get(side)
        if mode is None:
            return self._swinging(k, side, t)
        return _placed(self.holds[k][side], HEEL_UP * self.share(k, t) ** 2 * (mode == "toe"))

    def _swinging(self, k: int, side: int, t: float) -> pin.SE3:
        carried = [i for i, holds in enumerate(self.holds) if side in holds]
        left = max(i for i in carried if i < k)
        down = next((i for i in carried if i > k), len(self.phases))
        a = self.holds[left][side]
        b = self.holds[down].get(side, a)
        begin = self.starts[left + 1]
        u = (t - begin) / (self.starts[down] - begin)
        lift = SWING * self.leg_m * np.sin(np.pi * u)
        if self.phases[k].flying:
            s = self.share(k, t)
            duration = self.starts[k + 1] - self.starts[k]
            rise = self.gravity * duration**2 / 2 * s * (1 - s)
            lift = max(lift, rise + self.leg_m * TUCK * 4 * s * (1 - s))
        place = a + (b - a) * _smooth(u)
        # above an edge before it, and beyond
        place[2] = a[2] + (b[2] - a[2]) * _smooth(2 * u if b[2] > a[2] else 2 * u - 1) + lift
        return _placed(place, HEEL_UP * (1 - u) ** 2 * (self.phases[left].modes[side] == "toe"))


def _placed(hold: np.ndarray, pitch: float) -> pin.SE3:
    """Placement of a foot at x, y, z, yaw (4,) with its heel up by ``pitch`` [rad]."""
    return pin.SE3(pin.rpy.rpyToMatrix(0.0, pitch, hold[3]), hold[:3])


# values at the nodes
# ----------------------------------------------------------------------------------------------
def guess(schedule: Schedule, task: JumpTask, motion: Motion) -> dict[str, PhaseGuess]:
    """Phase name -> start values (N + 1, .) of a motion: rates by differences, even forces [N], no
    torques.
    """
    body = schedule.body
    holds = footholds(schedule, task)
    times = [np.linspace(*motion.starts[k : k + 2], len(q)) for k, q in enumerate(motion.charts)]
    t, once = np.unique(np.concatenate(times).round(9), return_index=True)
    q = np.concatenate(motion.charts)[once]
    v = np.clip(np.gradient(q, t, axis=0), -RATE_BOX, RATE_BOX)
    a = np.clip(np.gradient(v, t, axis=0), -ACCELERATION_BOX, ACCELERATION_BOX)
    turn = feet_of(body.robot, configurations(body.model, q))[1]
    pitch = np.arctan2(-turn[..., 2, 0], np.hypot(turn[..., 0, 0], turn[..., 1, 0]))
    values = {}
    for k, (phase, at) in enumerate(zip(schedule.contacts.phases, times, strict=True)):
        b = schedule.modes[k]
        rows = np.searchsorted(t, at.round(9))
        heels = np.maximum(pitch[rows][:, b.raised], 0.0)
        z = np.zeros((len(rows), len(b.states)))
        constants = {}
        for side in b.sides:
            z[:, : b.n_forces] = body.mg * len(b.sides) / len(b.modes) / b.n_forces
            names = [f"{SIDES[side]}_{x}" for x in HOLD]
            constants |= dict(zip(names, holds[k][side], strict=True))
        if b.flying:
            flown = _parabola(body, q[rows[[0, -1]]], motion.durations[k])
            constants |= {name: flown[name] for name in b.constants}
        nodes = [np.column_stack([schedule.free.taken(motion.charts[k]), heels])]
        nodes += [np.column_stack([schedule.free.taken(x[rows]), 0 * heels]) for x in (v, a)]
        values[phase.name] = PhaseGuess(float(motion.durations[k]), *nodes, z, constants)
    return values


def _parabola(body: Body, ends: np.ndarray, duration: float) -> dict[str, float]:
    """CoM at take-off and its velocity, by name, of a flight of a ``duration`` [s] between two
    charts (2, 6 + joints); no angular momentum.
    """
    tree = body.model.model
    data = tree.createData()
    first, last = (pin.centerOfMass(tree, data, q).copy() for q in configurations(body.model, ends))
    speed = (last - first) / duration + [0.0, 0.0, body.robot.gravity * duration / 2]
    names = [f"{name}_{x}" for name in ("com", "vel", "L") for x in "xyz"]
    return dict(zip(names, [*first, *speed, 0.0, 0.0, 0.0], strict=True))


def ramped(
    contacts: Contacts, phases: Mapping[str, PhaseSolution], task: JumpTask
) -> dict[str, PhaseGuess]:
    """Phase name -> start values (N + 1, .): a jump straight ahead, whose base goes aside and turns
    until the target is reached.

    It begins :data:`RAMP_S` before take-off; ``phases`` are those of the jump straight ahead, with
    every coordinate free.
    """
    values = {p.name: phases[p.name].guess(p.intervals) for p in contacts.phases}
    ends = np.cumsum([x.duration for x in values.values()])
    begin = max(0.0, ends[-2] - RAMP_S)
    length = ends[-1] - begin
    for (name, x), end in zip(values.items(), ends, strict=True):
        since = np.clip(np.linspace(end - x.duration, end, len(x.q)) - begin, 0.0, length)
        shapes = quintic([(0.0, 1.0), (0.0, 0.0), (0.0, 0.0)], length, since)
        motion = {key: getattr(x, key).copy() for key in "qva"}
        for columns, shape in zip(motion.values(), shapes, strict=True):
            columns[:, [SIDE, YAW]] += np.outer(shape, [task.side_m, task.yaw_rad])
        constants = dict(x.constants)
        if "vel_y" in constants:
            constants["vel_y"] = task.side_m / x.duration
        values[name] = replace(x, **motion, constants=constants)
    return values
