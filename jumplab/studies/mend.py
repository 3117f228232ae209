"""Mending a clip: the nearest motion that the robot can do, along the contacts of the clip.

The whole-body program follows the clip, all limits hard. Contacts come from judging the clip, its
floor from the soles that stand, and how long phases last is free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.arguments import checked
from jumplab.auditing.clip import ClipReport, judge, phases_of
from jumplab.control.kinematics import about_vertical
from jumplab.errors import InfeasibleError, InputError, Shown, SolverError, require_type
from jumplab.io.clip import Clip
from jumplab.io.progress import tell
from jumplab.ocp.nlp import unexplained
from jumplab.robot import Robot
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import FLIGHT, ContactPhase, Contacts, Place, modes_of
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.motions import HEEL_UP, Motion, Reach, configurations
from jumplab.stages.whole_body.settings import Limits
from jumplab.stages.whole_body.tape import feet_of
from jumplab.task import JumpTask

# of standing, before the first and after the last event: there it begins and ends where the joints
# move least, [rad/s] rms, a second more of it counted as one more of those
AROUND_S = (0.6, 1.2)
LONG_S = 1.5  # of standing between two motions, of which one is mended
MERGED_S = 0.12  # phases that are shorter are events of one ...
SHUFFLED_S = 0.2  # as are those on one foot between two on both feet
TOES_S = 0.1  # on the toes before a flight, but at most half of the phase
# steps [s] of phases on flat feet, where a foot lands, on the toes, in flight, with which motions
# keep their limits between the nodes as well; least and largest number of them
STEPS_S = {"flat": 0.035, "landing": 0.024, "toe": 0.014, FLIGHT: 0.024}
LEAST_STEPS = 6
MOST_STEPS = 90
# shares of a phase's time within which it may be changed, on the ground and in flight; feet that
# kinematics moves in no time need some of it
STRETCH = (0.6, 1.5)
# a flight keeps its time, for clips fly too long for their rise; one too short for clearance
# may last as long as this
FLIGHT_STRETCH = (0.86, 1.15)
SHORT_FLIGHT_S = 0.3
FREE_M = (0.15, 0.15)  # by which footholds may move
FREE_RAD = 0.4
BENT_RAD = 0.35  # of knees, down to which the base is lowered
LOWER_M = 0.005  # steps of that
MOST_LOWER_M = 0.12
OFF_M = 0.002
START_ROUNDS = 30
BEGUN_OFF = 0.05  # [m, rad] by which a sole may miss its place as it begins
START_ROOM_RAD = 0.01  # of the first posture to the stops
SMOOTH_FRAMES = 3.0
FADE_S = 0.2  # in which a leg in the air leaves what holds its foot in place, or comes to it
LEAST_RISE_M = 0.02  # of a clip's flight, to be scaled
RISE_WEIGHT = 1e5  # [1] / [m/s]^2, of the take-off speed that a target asks for
FACTORS = (0.8, 0.6, 0.4)  # of what cannot be mended
POSE = [0, 1, 3]  # x, y and yaw, of charts and of feet


@dataclass(frozen=True, repr=False)
class Mended(Shown):
    """Result of mending a clip.

    Attributes
    ----------
    plan : the motion, a plan as any other; its x axis points ahead of the first feet, whose middle
        is the origin.
    before : the clip, judged.
    changes : rows of what was kept and what was changed.
    binding : names of the limits that shape it, those first that shape it most.
    factor : by which way, turn and height of the clip were scaled before [1].
    span_s : part of the clip that it stands for.
    """

    plan: JumpPlan
    before: ClipReport
    changes: tuple[dict[str, Any], ...]
    binding: tuple[str, ...]
    factor: float = 1.0
    span_s: tuple[float, float] = (0.0, 0.0)

    def line(self) -> str:
        """The clip, what of it is kept, and the plan."""
        begin, end = self.span_s
        all_s = self.before.clip.t[-1]
        kept = f"{self.before.clip.name}, {begin:.2f} to {end:.2f} s of {all_s:.2f} s"
        return f"{kept}, as {self.plan.line()}"

    def to_json(self) -> dict[str, Any]:
        """Plain data of all but the plan."""
        return {
            "clip": self.before.manifest,
            "clip_failed": [c.name for c in self.before.failed],
            "changes": list(self.changes),
            "binding": list(self.binding),
            "factor": self.factor,
            "span_s": list(self.span_s),
        }


@checked
def mend(
    motion: Any,
    robot: Robot | str | Path = "bhr",
    *,
    fps: float | None = None,
    order: str = "depth-first",
    weights: Mapping[str, float] | None = None,
    limits: Limits | Mapping[str, Any] | None = None,
) -> Mended:
    """Plan the nearest motion to a clip that its robot can do: same contacts, all limits hard.

    The ``.plan`` of the result is like any other; ``.changes`` is a table of the differences
    from the clip.

    Parameters
    ----------
    motion : one clip, as :func:`jumplab.judge` takes it, or the report that it returned.
    robot, fps, order : as of :func:`jumplab.judge`.
    weights, limits : as of :class:`jumplab.Planner`.

    Raises
    ------
    InputError
        If there is no clip, or one that has no contacts to plan with.
    InfeasibleError
        If no motion near it keeps the limits; says which forbid it, and the largest part of the
        clip (in way, turn and height) that can be done.
    """
    before = _judged(motion, robot, fps=fps, order=order)
    planner = Planner(before.clip.robot, keep=True, weights=weights, limits=limits)
    try:
        return _mended(planner, before)
    except SolverError as e:
        refusal = e
    for factor in FACTORS:
        tell(f"mending {factor:g} of it")
        try:
            with unexplained():
                _mended(planner, before, factor)
        except SolverError:
            continue
        raise InfeasibleError(
            f"clip {before.clip.name!r} cannot be mended: {refusal}; it can with {factor:g} of its "
            f"travel, turn and height",
            number="factor",
            bound=factor,
        ) from refusal
    raise InfeasibleError(
        f"clip {before.clip.name!r} cannot be mended: {refusal}; nor can it with {FACTORS[-1]:g} "
        f"of its travel, turn and height"
    ) from refusal


def like(
    task: JumpTask,
    motion: Any,
    robot: Robot | str | Path = "bhr",
    **changes: Any,
) -> JumpPlan:
    """A jump to a target in the manner of a clip: its joints, its feet, its times on the ground.

    Parameters
    ----------
    task : travel and rise [m], and turn [rad], on level ground.
    motion, robot : as of :func:`mend`; the clip jumps once, off both feet and down on both.
    changes : as of :class:`jumplab.Planner`.

    Raises
    ------
    InputError, InfeasibleError, SolverError
        If the clip or the target is not of that sort, or there is no such motion.
    """
    if task.platform_m or task.rotation_rad:
        raise InputError(
            "a jump like a clip needs level ground and no flip; set platform_m and rotation_rad "
            "to 0"
        )
    before = _judged(motion, robot)
    draft = Draft(before, goal=task)
    return Planner(before.clip.robot, keep=True, **changes).follow(
        draft.contacts,
        gravity=task.gravity,
        rise_m=task.height_m,
        weights={"follow take-off speed": RISE_WEIGHT},
        motion=draft.motion,
        stance=draft.start,
    )


def _judged(motion: Any, robot: Robot | str | Path, **options: Any) -> ClipReport:
    """The report of one clip, or that which is given."""
    if not isinstance(motion, ClipReport):
        motion = judge(motion, robot, **options)
    require_type(motion, ClipReport, "one clip")
    return motion


def _mended(planner: Planner, before: ClipReport, factor: float = 1.0) -> Mended:
    draft = Draft(before, factor)
    plan = planner.follow(draft.contacts, motion=draft.motion, stance=draft.start)
    if failed := plan.audit.failed:
        names = ", ".join(check.name for check in failed)
        pressed = ", ".join(plan.whole_body.binding)
        raise SolverError(f"the nearest motion fails its audit ({names}), pressed by {pressed}")
    rows = tuple(_changes(before, draft, plan))
    return Mended(plan, before, rows, plan.whole_body.binding, factor, draft.span_s)


def spans(flags: np.ndarray) -> list[list[int]]:
    """First row, and the row after the last one, of each run of true ``flags`` (n,)."""
    edges = np.flatnonzero(np.diff(np.asarray(flags, int), prepend=0, append=0))
    return edges.reshape(-1, 2).tolist()


# the schedule
# ----------------------------------------------------------------------------------------------
def planned_phases(before: ClipReport) -> list[tuple[str, float, float]]:
    """Feet that carry, from and to [s]: those of the clip without events of less than
    :data:`MERGED_S`, cut to what stands around the others (:data:`AROUND_S`).

    Where both feet are fast for long but low, the clip skips: here it flies, but between two steps
    on one foot the other one carries.
    """
    fps = before.clip.fps
    ground = before.ground.copy()
    for a, b in spans(~before.still.any(axis=1)):
        if b - a > MERGED_S * fps and ground[a:b].any(axis=1).all():
            one = ground[max(a - 1, 0)]
            steps = one.sum() == 1 and np.array_equal(one, ground[min(b, len(ground) - 1)])
            ground[a:b] = ~one if steps else False
    feet, times = _merged(phases_of(ground, fps))
    standing = [k for k, x in enumerate(feet) if x == "LR"]
    if not standing:
        raise InputError(
            f"clip {before.clip.name!r}: it never stands on both feet, and a motion has to begin "
            f"so; give more of it"
        )
    # between long standing the motion that flies longest, else that of most phases
    lasts = np.diff(times)
    flown = lasts * [x == FLIGHT for x in feet]
    long = [k for k in standing[1:-1] if lasts[k] > LONG_S]
    ends = pairwise([standing[0], *long, standing[-1]])
    first, last = max(ends, key=lambda x: (sum(flown[slice(*x)]), x[1] - x[0]))
    feet = feet[first : last + 1]
    times = times[first : last + 2]
    if last > first:
        times[0] = max(times[0], times[1] - _standing_s(before, times[1], -1))
        times[-1] = min(times[-1], times[-2] + _standing_s(before, times[-2], 1))
    for k in range(len(feet) - 1, 0, -1):
        if feet[k] == FLIGHT:
            a, b = times[k - 1 : k + 1]
            times.insert(k, b - min(TOES_S, (b - a) / 2))
            feet.insert(k, feet[k - 1].lower())
    return list(zip(feet, times[:-1], times[1:], strict=True))


def _standing_s(before: ClipReport, event_s: float, way: int) -> float:
    """Part of the standing before (``way`` -1) or after an event that is kept [s]."""
    rates = np.sqrt((before.tape.v[:, 6:] ** 2).mean(axis=1))
    kept = np.arange(AROUND_S[0], AROUND_S[1] + 1e-9, 1 / before.clip.fps)
    return float(kept[np.argmin(np.interp(event_s + way * kept, before.clip.t, rates) + kept)])


def _merged(phases: Sequence[tuple[str, float, float]]) -> tuple[list[str], list[float]]:
    """Feet of n phases, and the n + 1 times [s] at which they begin and end, without those too
    short to count, those on one foot first; their time goes to those beside them, but to flights
    only what is between two of them.
    """
    feet = [x for x, _, _ in phases]
    times = [phases[0][1], *(end for _, _, end in phases)]
    while True:
        for k in range(len(feet) - 1, 0, -1):
            if feet[k] == feet[k - 1]:
                del feet[k], times[k]
        lasts = np.diff(times)
        short = [k for k, x in enumerate(lasts) if x < _shortest(feet, k)]
        if not short or len(feet) == 1:
            return feet, times
        k = min(short, key=lambda k: (feet[k] == "LR", lasts[k]))
        del feet[k]
        if k in (0, len(feet)):
            del times[0 if k == 0 else -1]
            continue
        a, b = times[k : k + 2]
        before, after = (x == FLIGHT for x in feet[k - 1 : k + 1])
        times[k : k + 2] = [(a + b) / 2 if before == after else a if before else b]


def _shortest(feet: list[str], k: int) -> float:
    """The least time [s] that phase ``k`` on these ``feet`` has to last to count."""
    beside = feet[max(k - 1, 0) : k + 2]
    return SHUFFLED_S if beside in (["LR", "L", "LR"], ["LR", "R", "LR"]) else MERGED_S


class Draft:
    """A clip made ready to be followed, ``factor`` of its way, turn and height; with a ``goal`` its
    only flight goes there.

    Attributes
    ----------
    charts : (n, 6 + joints) of the clip, from the middle of the first feet, their way ahead, its
        floor at zero.
    contacts, motion : schedule, and the clip along it with feet that carry in their places.
    start : configuration (nq,) in which it begins.
    """

    def __init__(self, before: ClipReport, factor: float = 1.0, goal: JumpTask | None = None):
        self.clip: Clip = before.clip
        self.body = Body(self.clip.robot)
        self.reach = Reach(self.body, Limits().range_margin_rad)
        self.phases = planned_phases(before)
        self.span_s = self.phases[0][1], self.phases[-1][2]
        charts = self.body.model.of_pinocchio(self.clip.q)
        charts = _level(self._ahead(charts), before)
        self.charts = _scaled(charts, self._rows(0), factor)
        origin, turn = feet_of(self.clip.robot, configurations(self.body.model, self.charts))
        yaw = np.unwrap(np.arctan2(turn[..., 1, 0], turn[..., 0, 0]), axis=0)
        tips = origin + turn @ self.clip.robot.foot.tip
        self.feet = np.concatenate([tips, yaw[..., None]], axis=2)  # (n, 2, 4) x y z yaw
        self.holds = self._holds()
        self.goal = goal
        if goal is not None:
            self._go(goal, before)
        self.contacts = self._contacts(factor)
        self.motion = self._along()

    def _go(self, goal: JumpTask, before: ClipReport) -> None:
        """Move what follows the flight to the ``goal``, and the flight on the way there, as high as
        that asks for.
        """
        feet = [x for x, *_ in self.phases]
        k = feet.index(FLIGHT) if FLIGHT in feet else 0
        if feet.count(FLIGHT) != 1 or feet[k - 1] != "lr" or feet[k + 1] != "LR":
            raise InputError(
                f"clip {self.clip.name!r}: its contacts are {' '.join(feet)}; a jump to a target "
                f"needs a clip that flies once, takes off from both feet and lands on both"
            )
        takeoff, landing = (self.middle(hold) for hold in (self.holds[0], self.holds[k + 1]))
        target = np.add(takeoff, [goal.distance_m, goal.side_m, goal.yaw_rad])
        turn = about_vertical(target[2] - landing[2])

        def there(poses: np.ndarray) -> np.ndarray:
            return (poses - landing) @ turn.T + target

        _, begin, end = self.phases[k]
        share = np.clip((self.clip.t - begin) / (end - begin), 0.0, 1.0)
        x = self.charts
        x[:, POSE] += share[:, None] * (there(x[:, POSE]) - x[:, POSE])
        rises_m = [flight["rise_m"] for flight in before.manifest["flights"]]
        line = np.interp(self.clip.t, [begin, end], np.interp([begin, end], self.clip.t, x[:, 2]))
        flown = (share > 0) & (share < 1)
        more = goal.height_m / max([*rises_m, LEAST_RISE_M]) - 1
        x[:, 2] += flown * more * (x[:, 2] - line)
        for hold in self.holds[k + 1 :]:
            for place in hold.values():
                place[POSE] = there(place[POSE])

    def middle(self, hold: dict[int, np.ndarray]) -> np.ndarray:
        """x, y of the middle between the soles in their places [m], and their mean yaw [rad]."""
        half = self.body.half_m
        soles = [[x - half * np.cos(a), y - half * np.sin(a), a] for x, y, _, a in hold.values()]
        return np.mean(soles, axis=0)

    def _rows(self, k: int) -> slice:
        """Frames of a phase."""
        _, a, b = self.phases[k]
        return slice(round(a * self.clip.fps), round(b * self.clip.fps) + 1)

    def _ahead(self, charts: np.ndarray) -> np.ndarray:
        """Charts from the middle of the first feet, whose way is ahead."""
        first = self._rows(0)
        origin, turn = feet_of(self.clip.robot, self.clip.q[first])
        middle = np.median((origin + turn @ self.clip.robot.foot.center).mean(axis=1), axis=0)
        ahead = turn[..., 0].mean(axis=(0, 1))
        angle = math.atan2(ahead[1], ahead[0])
        out = charts.copy()
        out[:, POSE] = (charts[:, POSE] - [*middle[:2], angle]) @ about_vertical(-angle).T
        out[:, 3] -= 2 * np.pi * np.round(out[first.start, 3] / (2 * np.pi))
        return out

    def _holds(self) -> list[dict[int, np.ndarray]]:
        """Of each phase, side -> x, y, z, yaw of the feet that carry: medians over the contact."""
        holds = [{} for _ in self.phases]
        for side in (0, 1):
            for first, end in spans([side in modes_of(feet) for feet, _, _ in self.phases]):
                rows = slice(self._rows(first).start, self._rows(end - 1).stop)
                place = np.median(self.feet[rows, side], axis=0)
                for hold in holds[first:end]:
                    hold[side] = place * [1.0, 1.0, 0.0, 1.0]  # on the floor
        return holds

    def _contacts(self, factor: float) -> Contacts:
        places = []
        phases = []
        held = {}
        for hold, (feet, a, b) in zip(self.holds, self.phases, strict=True):
            lasts = b - a
            lands = hold.keys() - held.keys()
            if feet == FLIGHT:
                kind = FLIGHT
                lasts *= math.sqrt(factor)
                if self.goal:
                    lasts = 2 * self.goal.takeoff_speed / self.goal.gravity
                low, high = (lasts * x for x in FLIGHT_STRETCH)
                high = max(high, SHORT_FLIGHT_S)
            else:
                kind = "toe" if feet.islower() else "landing" if phases and lands else "flat"
                low, high = (lasts * x for x in STRETCH)
            steps = min(MOST_STEPS, max(LEAST_STEPS, math.ceil(lasts / STEPS_S[kind])))
            phases.append(ContactPhase(feet, (low, high), lasts, steps))
            for side in sorted(lands):
                ahead, left = hold[side][:2] - self.body.places[side][:2]
                free = ((0.0, 0.0), 0.0) if self.goal or len(places) < 2 else (FREE_M, FREE_RAD)
                places.append(Place(float(ahead), float(left), float(hold[side][3]), 0.0, *free))
            held = hold
        return Contacts(tuple(phases), tuple(places[2:]), first=tuple(places[:2]))

    def _along(self) -> Motion:
        """The clip along the schedule, feet that carry in their places; it begins at rest above
        them.
        """
        from scipy.ndimage import gaussian_filter1d  # slow to import

        sizes = [p.intervals + 1 for p in self.contacts.phases]
        nodes = [(k, i) for k, size in enumerate(sizes) for i in range(size)]
        clip = np.concatenate([self.sampled(k, size) for k, size in enumerate(sizes)])
        down = np.array([self._lower(x, *node) for x, node in zip(clip, nodes, strict=True)])
        charts = clip.copy()
        smooth = gaussian_filter1d(np.nan_to_num(down), SMOOTH_FRAMES)
        charts[:, 2] -= np.fmax(smooth, down)
        placed = [self._placed(x, *node) for x, node in zip(charts, nodes, strict=True)]
        charts = np.array([x for x, _ in placed])
        charts[0] = self._start(charts[0])
        self.start = configurations(self.body.model, charts[:1])[0]
        durations = np.array([p.guess_s for p in self.contacts.phases])
        ends = np.cumsum(durations)
        t = np.concatenate([*map(np.linspace, ends - durations, ends, sizes)])
        for side, columns in enumerate(self.body.legs):
            in_air = [side not in modes_of(self.phases[k][0]) for k, _ in nodes]
            charts[:, columns] += faded(charts[:, columns] - clip[:, columns], t, in_air)
        drawn = np.split(charts, np.cumsum(sizes)[:-1])
        return Motion(durations, drawn, max(missed for _, missed in placed))

    def sampled(self, k: int, count: int) -> np.ndarray:
        """Charts (``count``, 6 + joints) of the clip, evenly over phase ``k``."""
        _, a, b = self.phases[k]
        at = np.linspace(a, b, count)
        return np.stack([np.interp(at, self.clip.t, x) for x in self.charts.T], axis=-1)

    def _bends(self, chart: np.ndarray) -> list[float]:
        """Bends of the knees of a chart, left and right [rad]."""
        return [sign * chart[BASE + k] + angle for k, sign, angle in self.body.knees]

    def _lower(self, chart: np.ndarray, k: int, i: int) -> float:
        """By how much the base has to come down for the legs to reach their places with bent knees
        [m]; nan in flight.
        """
        sides = list(modes_of(self.phases[k][0]))
        down = 0.0 if sides else np.nan
        while down < MOST_LOWER_M:
            lower = chart.copy()
            lower[2] -= down
            moved, left = self._placed(lower, k, i)
            bends = self._bends(moved)
            if left < OFF_M and all(bends[side] > BENT_RAD for side in sides):
                break
            down += LOWER_M
        return down

    def _start(self, chart: np.ndarray) -> np.ndarray:
        """A chart near one of the first phase, within all ranges, the CoM above the feet."""
        motors = self.body.motors
        room = START_ROOM_RAD + Limits().range_margin_rad
        chart = chart.copy()
        chart[BASE:] = np.clip(chart[BASE:], motors.lower + room, motors.upper - room)
        middle = np.mean([x[:2] for x in self.holds[0].values()], axis=0)
        yaw = np.mean([x[3] for x in self.holds[0].values()])
        middle -= self.body.half_m * np.array([np.cos(yaw), np.sin(yaw)])
        for _ in range(START_ROUNDS):
            q = configurations(self.body.model, chart[None])[0]
            com = pin.centerOfMass(self.body.model.model, self.reach.data, q)
            chart[:2] += middle - com[:2]
            chart, left = self._placed(chart, 0, 0)
            if min(self._bends(chart)) < BENT_RAD or left > OFF_M:
                chart[2] -= LOWER_M
        if left > BEGUN_OFF:
            raise InfeasibleError(
                f"clip {self.clip.name!r} cannot be mended: at its start no posture within the "
                f"joints' ranges puts both soles flat in their places, {left:.2f} rad or m are "
                f"left, at most {BEGUN_OFF:g}; the feet "
                f"are {np.linalg.norm(self.holds[0][0][:2] - self.holds[0][1][:2]):.2f} m apart"
            )
        return chart

    def _placed(self, chart: np.ndarray, k: int, i: int) -> tuple[np.ndarray, float]:
        """A chart at node ``i`` of phase ``k``, the legs that carry brought to their places, and
        what they miss.
        """
        modes = modes_of(self.phases[k][0])
        if not modes:
            return chart, 0.0
        data = self.reach.data
        q = configurations(self.body.model, chart[None])[0]
        pin.forwardKinematics(self.body.model.model, data, q)
        goals = [foot.place(data) for foot in self.reach.feet]
        for side, mode in modes.items():
            *place, yaw = self.holds[k][side]
            heel = HEEL_UP * (i / self.contacts.phases[k].intervals) ** 2 * (mode == "toe")
            goals[side] = pin.SE3(pin.rpy.rpyToMatrix(0.0, heel, yaw), np.array(place))
        return self.reach(chart, goals, list(modes))


def faded(moved: np.ndarray, t: np.ndarray, in_air: Sequence[bool]) -> np.ndarray:
    """Changes (n, joints) of a leg ``in_air`` (n,) over :data:`FADE_S` after its foot leaves and
    before it lands, at times ``t`` (n,) [s], so that it does not jump from the clip's posture to
    that which has its foot in place, ``moved`` (n, joints) off the clip's.
    """
    changes = np.zeros_like(moved)
    for first, end in spans(in_air):
        for event in {first - 1, end} - {-1, len(t)}:
            left = np.maximum(0.0, 1 - np.abs(t[first:end] - t[event]) / FADE_S)
            changes[first:end] += (left**2 * (3 - 2 * left))[:, None] * moved[event]
    return changes


def _level(charts: np.ndarray, before: ClipReport) -> np.ndarray:
    """Charts with the floor under the soles that stand at zero, straight over flights."""
    from scipy.ndimage import gaussian_filter1d  # slow to import

    robot = before.clip.robot
    origin, turn = feet_of(robot, before.clip.q)
    soles = origin[:, :, None] + np.einsum("nkij,pj->nkpi", turn, robot.foot.corners)
    height = np.where(before.ground, soles[..., 2].min(axis=2), np.nan)
    some = before.ground.any(axis=1)
    rows = np.arange(len(charts))
    floor = np.interp(rows, rows[some], np.nanmean(height[some], axis=1))
    out = charts.copy()
    out[:, 2] -= gaussian_filter1d(floor, SMOOTH_FRAMES - 1)
    return out


def _scaled(charts: np.ndarray, first: slice, factor: float) -> np.ndarray:
    """Charts with a ``factor`` of their way, turn and height over where they begin."""
    out = charts.copy()
    start = charts[first].mean(axis=0)
    out[:, POSE] = start[POSE] + factor * (charts - start)[:, POSE]
    out[:, 2] -= (1 - factor) * np.maximum(charts[:, 2] - start[2], 0.0)
    return out


# what was changed
# ----------------------------------------------------------------------------------------------
def _changes(before: ClipReport, draft: Draft, plan: JumpPlan) -> list[dict[str, Any]]:
    """Rows of what the clip and the plan have, and by how much they differ."""
    phases = list(plan.whole_body.phases.values())
    pairs = [(x.q, draft.sampled(k, len(x.q))) for k, x in enumerate(phases)]
    difference = np.concatenate([q[:, : clip.shape[1]] - clip for q, clip in pairs])
    joints = np.abs(difference[:, BASE:])
    moved = [0.0]
    for contact, (k, side) in enumerate(plan.contacts.landings):
        wanted = np.mean(plan.whole_body.schedule.foothold(contact), axis=1)
        name = ("left", "right")[side]
        place = [phases[k].constants[f"{name}_{axis}"] for axis in "xy"]
        moved.append(math.dist(place, wanted[:2]))
    worst = draft.clip.robot.joint_names[int(joints.max(axis=0).argmax())]
    changes = {
        "joints, rms [rad]": np.sqrt((joints**2).mean()),
        f"joints, largest [rad]: {worst}": joints.max(),
        "base, rms [m]": np.sqrt((difference[:, :3] ** 2).sum(axis=1).mean()),
        "footholds, largest [m]": max(moved),
    }
    rows = [{"what": name, "change": float(x)} for name, x in changes.items()]
    pairs = zip(draft.phases, phases, strict=True)
    flown_s = [(b - a, x.duration) for (feet, a, b), x in pairs if feet == FLIGHT]
    com = plan.tape.extra["com"][:, 2]
    rises_m = [flight["rise_m"] for flight in before.manifest["flights"]]
    risen_m = [com[x].max() - com[x.start] for x in plan.tape.flights]
    both = {"flight {} [s]": flown_s, "rise {} [m]": zip(rises_m, risen_m, strict=False)}
    for what, values in both.items():
        for i, (clip, mended) in enumerate(values, 1):
            row = {"what": what.format(i), "clip": clip, "mended": float(mended)}
            rows.append(row | {"change": row["mended"] - clip})
    return rows
