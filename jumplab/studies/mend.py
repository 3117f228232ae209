"""Mending a clip: the nearest motion that the robot can do, along the contacts of the clip.

The whole-body program follows the clip, all limits hard. Contacts come from judging the clip, its
floor from the soles that stand, and how long phases last is free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.auditing.clip import ClipReport, judge, phases_of
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

AROUND_S = 0.6  # of standing, before the first and after the last event
MERGED_S = 0.12  # phases that are shorter are events of one ...
SHUFFLED_S = 0.2  # as are those on one foot between two on both feet
TOES_S = 0.1  # on the toes before a flight, ...
ROLLING_S = 0.22  # ... if the phase before it is this long
# steps [s] of phases on flat feet, after a flight, on the toes, in flight; the least number of them
STEPS_S = {"flat": 0.035, "landing": 0.024, "toe": 0.018, FLIGHT: 0.03}
LEAST_STEPS = 6
MOST_STEPS = 60
# shares of a phase's time within which it may be changed, on the ground and in flight: kinematics
# makes flights too long for their rise
STRETCH = (0.6, 1.5)
FLIGHT_STRETCH = (0.4, 1.2)
FREE_M = (0.15, 0.15)  # by which footholds may move
FREE_RAD = 0.4
BENT_RAD = 0.35  # of knees, down to which the base is lowered
LOWER_M = 0.005  # steps of that
MOST_LOWER_M = 0.12
OFF_M = 0.002
START_ROUNDS = 30
START_ROOM_RAD = 0.01  # of the first posture to the stops
SMOOTH_FRAMES = 3.0
FACTORS = (0.8, 0.6, 0.4)  # of what cannot be mended
NEAR = 1e-3  # of a limit's size: it binds


@dataclass(frozen=True, repr=False)
class Mended(Shown):
    """What mending a clip ended in.

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
        """The clip and the plan."""
        return f"{self.before.clip.name} as {self.plan.line()}"

    @cached_property
    def jump(self) -> JumpPlan | None:
        """The plan up to touchdown, which control can play and catch; None unless both feet leave
        the ground together, and once.
        """
        tape = self.plan.tape
        carrying = tape.extra["contacts"] > 0
        flying = ~carrying.any(axis=1)
        edges = np.flatnonzero(np.diff(flying.astype(int), append=0))
        if len(edges) != 2 or not carrying[~flying].all():
            return None
        end = int(edges[1]) + 1
        rows = ("t", "q", "v", "a", "tau", "phase", "f")
        cut = {name: getattr(tape, name)[:end] for name in rows}
        long = {k: x[:end] for k, x in tape.extra.items() if np.shape(x)[:1] == tape.t.shape}
        tape = replace(tape, **cut, extra={**tape.extra, **long})
        summary = {k: x for k, x in self.plan.summary.items() if k != "contacts"}
        return JumpPlan.on_file(tape, self.plan.robot, summary)

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


def mend(
    motion: Any,
    robot: Robot | str = "bhr",
    *,
    fps: float | None = None,
    order: str = "depth-first",
    **changes: Any,
) -> Mended:
    """The nearest motion to a clip that its robot can do.

    Parameters
    ----------
    motion, robot, fps, order : as of :func:`jumplab.judge`, one clip.
    changes : ``weights``, ``limits`` and so on, as of :class:`jumplab.Planner`.

    Raises
    ------
    InputError
        If there is no clip, or one that has no contacts to plan with.
    InfeasibleError
        If no motion near it keeps the limits; says which forbid it, and the largest part of the
        clip (in way, turn and height) that can be done.
    """
    before = (
        motion if isinstance(motion, ClipReport) else judge(motion, robot, fps=fps, order=order)
    )
    require_type(before, ClipReport, "one clip to mend")
    planner = Planner(before.clip.robot, keep=True, **changes)
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
            f"clip {before.clip.name!r} cannot be mended: {refusal}; {factor:g} of its way, turn "
            f"and height can",
            number="factor",
            bound=factor,
        ) from refusal
    raise InfeasibleError(
        f"clip {before.clip.name!r} cannot be mended: {refusal}; nor can {FACTORS[-1]:g} of its "
        f"way, turn and height"
    ) from refusal


def _mended(planner: Planner, before: ClipReport, factor: float = 1.0) -> Mended:
    draft = Draft(before, factor)
    plan = planner.follow(draft.contacts, motion=draft.motion, stance=draft.start)
    rows = tuple(_changes(before, draft, plan))
    return Mended(plan, before, rows, _binding(plan), factor, draft.span_s)


# the schedule
# ----------------------------------------------------------------------------------------------
def planned_phases(before: ClipReport) -> list[tuple[str, float, float]]:
    """Feet that carry, from and to [s]: those of the clip without events of less than
    :data:`MERGED_S`, cut to what is :data:`AROUND_S` around the others.

    Where both feet are fast for long but low, the clip skips, and flies here.
    """
    fps = before.clip.fps
    ground = before.ground.copy()
    fast = np.diff((~before.still.any(axis=1)).astype(int), prepend=0, append=0)
    for a, b in np.flatnonzero(fast).reshape(-1, 2):
        if b - a > MERGED_S * fps and ground[a:b].any(axis=1).all():
            ground[a:b] = False
    rows = [[feet, a, b] for feet, a, b in phases_of(ground, fps)]
    k = 0
    while k < len(rows):
        feet, a, b = rows[k]
        if k and feet == rows[k - 1][0]:
            rows[k - 1][2] = b
            rows.pop(k)
            k = 0
        elif len(rows) > 1 and b - a < _shortest(rows, k):
            middle = (a + b) / 2 if 0 < k < len(rows) - 1 else (a, b)[k == 0]
            if k:
                rows[k - 1][2] = middle
            if k < len(rows) - 1:
                rows[k + 1][1] = middle
            rows.pop(k)
            k = 0
        else:
            k += 1
    standing = [k for k, row in enumerate(rows) if row[0] == "LR"]
    if not standing or rows[standing[-1]][0] == FLIGHT:
        raise InputError(
            f"clip {before.clip.name!r}: it never stands on both feet, and a motion has to begin "
            f"so; give more of it"
        )
    rows = rows[standing[0] : standing[-1] + 1]
    rows[0][1] = max(rows[0][1], rows[0][2] - AROUND_S) if len(rows) > 1 else rows[0][1]
    rows[-1][2] = min(rows[-1][2], rows[-1][1] + AROUND_S) if len(rows) > 1 else rows[-1][2]
    out = []
    for (feet, a, b), after in zip(rows, [*(row[0] for row in rows[1:]), ""], strict=True):
        if after == FLIGHT and b - a > ROLLING_S:
            out += [(feet, a, b - TOES_S), (feet.lower(), b - TOES_S, b)]
        else:
            out.append((feet, a, b))
    return out


def _shortest(rows: list[list], k: int) -> float:
    """The least time [s] that phase ``k`` of (feet, from, to) has to last to count."""
    beside = [row[0] for row in rows[max(k - 1, 0) : k + 2]]
    return SHUFFLED_S if beside in (["LR", "L", "LR"], ["LR", "R", "LR"]) else MERGED_S


class Draft:
    """A clip made ready to be followed, ``factor`` of its way, turn and height.

    Attributes
    ----------
    charts : (n, 6 + joints) of the clip, from the middle of the first feet, their way ahead, its
        floor at zero.
    contacts, motion : schedule, and the clip along it with feet that carry in their places.
    start : configuration (nq,) in which it begins.
    """

    def __init__(self, before: ClipReport, factor: float = 1.0):
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
        self.contacts = self._contacts(factor)
        self.motion = self._along()

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
        back = pin.rpy.rpyToMatrix(0.0, 0.0, -angle)[:2, :2]
        out = charts.copy()
        out[:, :2] = (charts[:, :2] - middle[:2]) @ back.T
        out[:, 3] -= angle
        out[:, 3] -= 2 * np.pi * np.round(out[first.start, 3] / (2 * np.pi))
        return out

    def _holds(self) -> list[dict[int, np.ndarray]]:
        """Of each phase, side -> x, y, z, yaw of the feet that carry: medians over the contact."""
        modes = [modes_of(feet) for feet, _, _ in self.phases]
        holds: list[dict[int, np.ndarray]] = [{} for _ in modes]
        for side in (0, 1):
            k = 0
            while k < len(modes):
                end = k
                while end < len(modes) and side in modes[end]:
                    end += 1
                if end > k:
                    rows = slice(self._rows(k).start, self._rows(end - 1).stop)
                    x, y, _, yaw = np.median(self.feet[rows, side], axis=0)
                    for i in range(k, end):
                        holds[i][side] = np.array([x, y, 0.0, yaw])
                k = max(end, k + 1)
        return holds

    def _contacts(self, factor: float) -> Contacts:
        first = []
        places = []
        phases = []
        for k, (feet, a, b) in enumerate(self.phases):
            lasts = (b - a) * (math.sqrt(factor) if feet == FLIGHT else 1.0)
            low, high = FLIGHT_STRETCH if feet == FLIGHT else STRETCH
            kind = feet if feet == FLIGHT else "toe" if feet.islower() else "flat"
            if k and self.phases[k - 1][0] == FLIGHT:
                kind = "landing"
            steps = min(MOST_STEPS, max(LEAST_STEPS, math.ceil(lasts / STEPS_S[kind])))
            phases.append(ContactPhase(feet, (low * lasts, high * lasts), lasts, steps))
            for side, hold in self.holds[k].items():
                if k and side in self.holds[k - 1]:
                    continue
                ahead, left = hold[:2] - self.body.places[side][:2]
                place = Place(float(ahead), float(left), float(hold[3]), 0.0, FREE_M, FREE_RAD)
                fixed = replace(place, free_m=(0.0, 0.0), free_rad=0.0)
                (places if k else first).append(place if k else fixed)
        return Contacts(tuple(phases), tuple(places), first=tuple(first))

    def _along(self) -> Motion:
        """The clip along the schedule, feet that carry in their places; it begins at rest above
        them.
        """
        from scipy.ndimage import gaussian_filter1d  # slow to import

        drawn = []
        for (_, a, b), phase in zip(self.phases, self.contacts.phases, strict=True):
            at = np.linspace(a, b, phase.intervals + 1)
            drawn.append(np.array([np.interp(at, self.clip.t, x) for x in self.charts.T]).T)
        nodes = [(k, i) for k, rows in enumerate(drawn) for i in range(len(rows))]
        down = np.array([self._lower(drawn[k][i], k, i) for k, i in nodes])
        smooth = gaussian_filter1d(np.nan_to_num(down), SMOOTH_FRAMES)
        missed = 0.0
        for (k, i), less, least in zip(nodes, smooth, down, strict=True):
            drawn[k][i, 2] -= np.fmax(less, least)
            drawn[k][i], left = self._placed(drawn[k][i], k, i)
            missed = max(missed, left)
        start = drawn[0][0] = self._start(drawn[0][0])
        self.start = configurations(self.body.model, start[None])[0]
        durations = np.array([p.guess_s for p in self.contacts.phases])
        return Motion(durations, drawn, missed)

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
            bends = [sign * moved[BASE + j] + angle for j, sign, angle in self.body.knees]
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
            bends = [sign * chart[BASE + k] + angle for k, sign, angle in self.body.knees]
            if min(bends) < BENT_RAD or left > OFF_M:
                chart[2] -= LOWER_M
        return chart

    def _placed(self, chart: np.ndarray, k: int, i: int) -> tuple[np.ndarray, float]:
        """A chart at node ``i`` of phase ``k``, the legs that carry brought to their places, and
        what they miss.
        """
        modes = modes_of(self.phases[k][0])
        if not modes:
            return chart, 0.0
        origin, turn = feet_of(self.clip.robot, configurations(self.body.model, chart[None]))
        goals = [
            pin.SE3(turn[0, side], origin[0, side] + turn[0, side] @ self.clip.robot.foot.tip)
            for side in (0, 1)
        ]
        for side, mode in modes.items():
            *place, yaw = self.holds[k][side]
            heel = HEEL_UP * (i / self.contacts.phases[k].intervals) ** 2 * (mode == "toe")
            goals[side] = pin.SE3(pin.rpy.rpyToMatrix(0.0, heel, yaw), np.array(place))
        return self.reach(chart, goals, list(modes))


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
    for column in (0, 1, 3):
        out[:, column] = start[column] + factor * (charts[:, column] - start[column])
    high = np.maximum(charts[:, 2] - start[2], 0.0)
    out[:, 2] -= (1 - factor) * high
    return out


# what was changed
# ----------------------------------------------------------------------------------------------
def _changes(before: ClipReport, draft: Draft, plan: JumpPlan) -> list[dict[str, Any]]:
    """Rows of what the clip and the plan have, and by how much they differ."""
    phases = plan.whole_body.phases
    joints = []
    base = []
    for k, x in enumerate(phases.values()):
        _, a, b = draft.phases[k]
        at = np.linspace(a, b, len(x.q))
        clip = np.array([np.interp(at, draft.clip.t, column) for column in draft.charts.T]).T
        joints.append(x.q[:, BASE : clip.shape[1]] - clip[:, BASE:])
        base.append(x.q[:, :3] - clip[:, :3])
    joints = np.concatenate(joints)
    base = np.concatenate(base)
    moved = [0.0]
    schedule = plan.whole_body.schedule
    for contact, (k, side) in enumerate(plan.contacts.landings):
        wanted = np.mean(schedule.foothold(contact), axis=1)
        constants = list(phases.values())[k].constants
        name = ("left", "right")[side]
        moved.append(
            float(
                np.hypot(*(constants[f"{name}_{x}"] - wanted[i] for i, x in ((0, "x"), (1, "y"))))
            )
        )
    flown = [(a, b) for feet, a, b in draft.phases if feet == FLIGHT]
    times = [
        x.duration for x, p in zip(phases.values(), plan.contacts.phases, strict=True) if p.flying
    ]
    rises = [x["rise_m"] for x in before.manifest["flights"]]
    worst = int(np.abs(joints).max(axis=0).argmax())
    rows = [
        dict(what="joints, rms [rad]", change=float(np.sqrt((joints**2).mean()))),
        dict(
            what=f"joints, largest [rad]: {draft.clip.robot.joint_names[worst]}",
            change=float(np.abs(joints).max()),
        ),
        dict(what="base, rms [m]", change=float(np.sqrt((base**2).sum(axis=1).mean()))),
        dict(what="footholds, largest [m]", change=max(moved)),
    ]
    for i, ((a, b), s) in enumerate(zip(flown, times, strict=True), 1):
        rows.append(dict(what=f"flight {i} [s]", clip=b - a, mended=s, change=s - (b - a)))
    com = plan.tape.extra["com"][:, 2]
    flying = ~(plan.tape.extra["contacts"] > 0).any(axis=1)
    edges = np.flatnonzero(np.diff(flying.astype(int), prepend=0, append=0)).reshape(-1, 2)
    for i, (up, (a, b)) in enumerate(zip(rises, edges.tolist(), strict=False), 1):
        mended = float(com[a:b].max() - com[a])
        rows.append(dict(what=f"rise {i} [m]", clip=up, mended=mended, change=mended - up))
    return rows


def _binding(plan: JumpPlan) -> tuple[str, ...]:
    """Limits that bind, by what they are worth: the sum of their multipliers."""
    worth: dict[str, float] = {}
    solution = plan.whole_body.solution
    limits = {
        (r["phase"], r["name"]) for r in solution.constraint_report if r["kind"] == "inequality"
    }
    for (owner, name), (_, values) in solution.multipliers.rows.items():
        if (owner, name) in limits:
            worth[name] = worth.get(name, 0.0) + float(np.abs(values).sum())
    return tuple(sorted((n for n in worth if worth[n] > NEAR), key=worth.get, reverse=True)[:5])
