"""Records of a robot in one number of the target, the limits that end them, and the gain per unit
of each limit.

The number is an unknown of the whole-body program and as large as can be. The solver is local and
begins with several easy jumps: a record is a lower bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from jumplab.arguments import checked
from jumplab.auditing import AuditReport
from jumplab.errors import InfeasibleError, InputError, Shown, SolverError, quoted
from jumplab.io.progress import tell
from jumplab.ocp.nlp import LEAST_S, left_s, patience, unexplained
from jumplab.ocp.problem import Term
from jumplab.robot import Robot
from jumplab.sim import ENGINES, INSTALLED, Scene, SimulationResult, simulate_jump
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Limits, Mesh, bounds
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.ground import clear_of_edge_m
from jumplab.stages.whole_body.limiting import limit_of
from jumplab.stages.whole_body.problem import SOUGHT
from jumplab.stages.whole_body.program import Program, Solved
from jumplab.stages.whole_body.starts import FROM_NEIGHBOUR, RECORD, SEEKING, Asked
from jumplab.stages.whole_body.terms import WORTH
from jumplab.studies.advice import keep_record
from jumplab.studies.prices import Prices, priced
from jumplab.task import RANGES, JumpTask

if TYPE_CHECKING:
    from jumplab.studies.improve import Improved

# easy jumps to begin with: (the number sought, rise), of the leg's length, or [rad]
EASY = {
    "height_m": ((0.06, 0.06), (0.2, 0.2), (0.4, 0.4)),
    "distance_m": ((0.1, 0.06), (0.2, 0.2), (0.5, 0.3)),
    "platform_m": ((0.06, 0.2), (0.15, 0.3)),
    "side_m": ((0.1, 0.15), (0.3, 0.3)),
    "yaw_rad": ((0.3, 0.12), (1.0, 0.3)),
}
HALVES = 0.5, 0.25  # of the easiest, where none of them has a plan
GROWS = 1.5  # times the number before, from one plan to the next
# shares of the best that they led to, whose own plans, of least effort, are the next starts
CLIMB = 0.6, 0.75, 0.9
ROUNDS = 2  # of them at most
SAME = 0.01  # share of a record within which another start ended in it
# at the nodes, of the best; halvings of the share between the largest plan and what has none
HALVINGS = 5
# processor time of each, per unknown of the program [s]; a whole G1 takes 15 to 30 s from nothing
HALVING_S = 6e-3
LESS = 0.05  # of the share of a record that is played next, where a robot falls
TRIED = 5  # shares that are played
NEAR_END = 1e-3  # share of the range of a target's number, at whose end nothing of the robot binds
BINDS = 1e-2  # [m, m/s, rad] that the whole of a limit is worth at least, to be named
BINDING_SHARE = 0.05  # of its largest multiplier: from there to there it binds
LOOSE = 3.0  # times a record, from where on a bound says nothing
MOST = 8  # limits of joints that are priced


@dataclass(frozen=True)
class Binding:
    """A limit that ends a record.

    Attributes
    ----------
    phase, limit, joint : where, of what sort, of which joint ("" if of none).
    from_s, to_s : when, on the tape [s].
    worth : of the whole limit, in the unit of what is sought (m/s for a rise).
    """

    phase: str
    limit: str
    joint: str
    from_s: float
    to_s: float
    worth: float


@dataclass(frozen=True, repr=False)
class Record(Shown):
    """The largest number of a target that was found for a robot.

    Attributes
    ----------
    what, value : the field of :class:`.JumpTask`, and how large it is at least [m, rad].
    bound : what no motion exceeds, the rest of the target as in ``plan`` (of a distance, its rise
        too) [m]; inf where none is known. See :func:`.bounds.most`.
    plan, audit : a plan at the record, and its audit.
    found : by the easy jump that each start was, the number in which it ended; nan for none.
    limits : the limits that end it, the highest worth first.
    share, runs : of a plan at this share of the record, played in each engine.
    asked : the rest of what was asked for, as arguments of :func:`record`.
    """

    what: str
    value: float
    bound: float
    plan: JumpPlan
    audit: AuditReport
    found: Mapping[str, float]
    limits: tuple[Binding, ...]
    share: float
    runs: Mapping[str, SimulationResult]
    program: Program
    solved: Solved
    asked: Mapping[str, Any]

    @property
    def unit(self) -> str:
        """Of the record."""
        return unit_of(self.what)

    @property
    def best(self) -> float:
        """The largest number at the nodes, of all starts [m, rad]."""
        return float(np.nanmax(list(self.found.values())))

    @property
    def alike(self) -> int:
        """Starts that ended within 1 % of the best."""
        return sum(x >= (1 - SAME) * self.best for x in self.found.values())

    def line(self) -> str:
        """The record in a sentence."""
        word = self.what.rpartition("_")[0]
        ends = list(dict.fromkeys(f"{x.joint} {x.limit}".strip() for x in self.limits))[:3]
        landed = [name for name, run in self.runs.items() if run.landed]
        stepped = ""
        if self.value < (1 - SAME) * self.best:
            stepped = f" (reduced from {self.best:.3f} until the audit passes; prices: before)"
        played = f", lands at {self.share:.0%} of it in {' and '.join(landed) or 'no engine'}"
        return (
            f"{self.plan.robot.name}: {word} at least {self.value:.3f} {self.unit}{self._at_most} "
            f"({self.alike} of {len(self.found)} starts within 1 %), ends by "
            f"{', '.join(ends)}{stepped}{played * bool(self.runs)}"
        )

    @property
    def _at_most(self) -> str:
        """The bound in words, if it says something."""
        if self.bound > LOOSE * self.value:
            return f" and no bound below {LOOSE:g} times that is known"
        rise = self.plan.task.height_m
        by = "" if self.what == "height_m" else f" by any motion with its rise of {rise:.3f} m"
        return f" and at most {self.bound:.2f} {self.unit}{by}"

    def prices(self, most: int = MOST) -> Prices:
        """Gain per unit of the ``most`` limits of joints with the highest price, and of friction,
        mass and legs [m or rad per unit]; each checked by a record with it moved (a second or two).
        """
        return priced(self, most)

    def again(self, robot: Robot) -> Record:
        """The same record of another robot, without playing it."""
        return record(robot, self.what, **{**self.asked, "engines": ()})

    @checked
    def improve(self, free: Mapping[str, Any], budget: int = 6) -> Improved:
        """The robot within the ends of what is ``free`` whose record is larger, by priced steps.

        Parameters
        ----------
        free : what may change: "gear", a list of joints or roles (the ratio against what it is from
            0.5 to 2) or a mapping from them to (low, high); "thigh_m" and "shank_m", (low, high)
            [m]; "mass_kg", (low, high) of the robot, or a mapping from links, or tuples of links
            that change alike, to (low, high) of each [kg].
        budget : how many records may be sought on the way [1 to 40], a second or two each.

        Raises
        ------
        InputError
            For what is no number of the robot, or not between its ends now.
        """
        from jumplab.studies.improve import improve

        return improve(self, free, budget)


@checked
def record(
    robot: Robot | str,
    what: str = "height_m",
    given: JumpTask | None = None,
    *,
    share: float = 0.95,
    engines: Sequence[str] = INSTALLED,
    terms: Mapping[str, Iterable[Term]] | None = None,
    weights: Mapping[str, float] | None = None,
    off: Iterable[str] = (),
    limits: Limits | Mapping[str, Any] | None = None,
    mesh: Mesh | Mapping[str, int] | None = None,
) -> Record:
    """Find the largest value of one number of a target that has a plan, and the limits that end it.

    Parameters
    ----------
    robot : who jumps, or what :meth:`Robot.load` takes.
    what : the number: "height_m", "distance_m", "platform_m", "side_m" or "yaw_rad".
    given : the rest of the target; by default a jump on the spot (onto a platform far enough ahead
        to crouch before it), with the rise that gives most. With steps, or on one foot, only a
        height or a distance on level ground has a record.
    share : of the record; a jump of this share is played first, a smaller one if the robot falls.
    engines : in which it is played; () plays none.
    terms, weights, off, limits, mesh : as of :class:`jumplab.Planner`.

    Raises
    ------
    InputError
        For another ``what``, or a share that is not between 0 and 1.
    InfeasibleError
        If no easy jump has a plan, or if the record is an end of what a target may ask for.
    """
    robot = robot if isinstance(robot, Robot) else Robot.load(robot)
    if what not in EASY:
        raise InputError(f"what = {quoted(what)}: a record is one of {', '.join(EASY)}")
    stepping = given is not None and not given.standing
    if stepping and (what not in ("height_m", "distance_m") or given.platform_m):
        raise InputError(
            f"what = {quoted(what)}: after steps, or on one foot, only height_m and distance_m on "
            f"level ground have a record; leave out takeoff, landing and run_up"
        )
    if not 0 < share <= 1:
        raise InputError(f"share = {share:g} must be above 0 and at most 1")
    for engine in engines:
        if engine not in ENGINES:
            raise InputError(f"engine {quoted(engine)}: choose from {', '.join(ENGINES)}, or none")
    changes = dict(terms=terms, weights=weights, off=off, limits=limits, mesh=mesh)
    planner = Planner(robot, keep=True, **changes)
    search = _Search(planner, what, given)
    with unexplained():
        results, best = search.from_easy()
    if best is None:
        raise search.refusal(results)
    with unexplained():
        plan, solved, program = search.plan_at(best)
        share, runs = search.played(plan, share, engines)
    ends = tuple(_binding(program, plan.task, solved))
    value = getattr(plan.task, what)
    bound = math.inf
    if plan.task.standing:
        bound = bounds.most(search.stage.body, search.stage.limits, plan.task, what)
    if given is None and not any(changes.values()):
        keep_record(robot, what, value)
    parts = plan, plan.audit, results, ends, share, runs
    asked = {"given": given, "share": share, "engines": engines, **changes}
    return Record(what, value, bound, *parts, program, solved, asked)


class _Search:
    """The search for one record."""

    def __init__(self, planner: Planner, what: str, given: JumpTask | None):
        self.planner = planner
        self.stage = planner.stage("direct") if given is None else planner.direct(given)
        self.what = what
        self.given = given or _usual(self.stage.body, what)
        names = [name for name, field in SOUGHT.items() if field == what]
        if given is None and what != "height_m":
            names.append("takeoff_speed")
        self.sought = tuple(names)
        self.climbs = what == "yaw_rad" or not self.given.standing

    def program(self, task: JumpTask) -> Program:
        """The one in which the number is an unknown, on a mesh of which little is left to gain; of
        steps, which are three times as long, on the usual one.
        """
        seeking = self.stage.seeking(self.stage.program(task), self.sought)
        return seeking.finer if self.given.standing else seeking

    def starts(self, best: list[tuple]) -> Iterator[JumpTask]:
        """Jumps to begin with: easy ones (:data:`EASY`), if none of them led anywhere half and a
        quarter of the easiest, then shares of the ``best`` one, once more if they lead to a better
        one; after steps, where each takes a minute or more, the middle one of the easy ones alone.
        """
        leg = self.stage.body.leg_m
        alone = not self.given.standing
        easy = EASY[self.what][alone : 2 if alone else None]
        less = [(x * easy[0][0], x * easy[0][1]) for x in HALVES if not alone]
        for k, (number, rise) in enumerate([*easy, *less]):
            if k >= len(easy) and best:
                break
            x = number if self.what == "yaw_rad" else number * leg
            sizes = {self.what: x}
            if "takeoff_speed" in self.sought:
                sizes["height_m"] = max(rise * leg, RANGES["height_m"][1])
            yield replace(self.given, **sizes)
        largest = partial(max, best, key=itemgetter(0))  # of those that there are by then
        for _ in range(ROUNDS if best and not alone else 0):
            most, _, _ = largest()
            for share in CLIMB:
                yield self.at(largest()[1], share)
            if largest()[0] <= (1 + SAME) * most:
                break

    def from_easy(self) -> tuple[dict[str, float], Solved | None]:
        """Results of all starts, and the best one; None if none of them led anywhere. If they have
        plans, but none leads to a record at once, it is climbed to (:meth:`climbed`).
        """
        results: dict[str, float] = {}
        best: list[tuple] = []
        planned = False
        for task in self.starts(best):
            size = f"{getattr(task, self.what):.3f} {unit_of(self.what)}"
            word = f"{size}, rise {task.height_m:.3f} m"
            tell(f"record of {self.planner.robot.name} from {word}")
            results[word] = math.nan
            self.task = task
            try:
                # after steps links meet, and a record begins with their rows
                begin = self.stage.solved if task.standing else self.stage.plan
                near = begin(task)
                planned = True
                if self.climbs:
                    most = max((x[0] for x in best), default=RANGES[self.what][2])
                    task, near = self.climbed(task, near, most)
                program = self.program(task)
                solved = self.largest(program, Asked(task, near=near))
            except (InfeasibleError, SolverError):
                continue
            reached = program.found(task, solved)
            self.refuse_end(reached, solved)
            results[word] = getattr(reached, self.what)
            best.append((results[word], reached, solved))
        if not best and planned and not self.climbs:
            self.climbs = True
            return self.from_easy()
        if not best:
            return results, None
        _, self.task, solved = max(best, key=itemgetter(0))
        return results, solved

    def refusal(self, results: Mapping[str, float]) -> InfeasibleError:
        """Reason why there is no record: that of the last easy jump, the smallest."""
        why = "it has a plan, which leads nowhere"
        try:
            self.stage.plan(self.task)
        except (InfeasibleError, SolverError) as e:
            why = str(e)
        return InfeasibleError(
            f"robot {self.planner.robot.name}: no record of {self.what}, since none of "
            f"{len(results)} easy jumps led to one; the last one: {why}"
        )

    def largest(self, program: Program, asked: Asked) -> Solved:
        """The largest number from one plan: at once where that is far off; after a climb, from
        where little is left, with the start for that, and at once if it fails.
        """
        if self.climbs:
            with suppress(SolverError):
                return program.solve_apart(asked, RECORD)
        return program.solve_apart(asked, SEEKING)

    def climbed(self, task: JumpTask, near: Solved, most: float) -> tuple[JumpTask, Solved]:
        """The largest number below ``most`` [m, rad] that plans lead to, each from the one before,
        with rows for the links that met on the way: where the largest turn, or flight after steps,
        is sought at once, legs pass through each other.
        """
        with suppress(InfeasibleError, SolverError):
            while GROWS * getattr(task, self.what) < most:
                more = self.at(task, GROWS)
                program = self.stage.program(more)
                near = program.solve_apart(Asked(more, near=near), FROM_NEIGHBOUR[0])
                task = more
        return task, near

    def refuse_end(self, task: JumpTask, solved: Solved) -> None:
        """Refuse a record that a number of the problem ends, not the robot."""
        least, longest = self.stage.limits.flight_s
        who = f"robot {self.planner.robot.name}: the record of {self.what} is limited by"
        contacts = self.stage.contacts
        flight = contacts.phases[contacts.last_flight].name
        if solved.solution.phases[flight].duration > (1 - NEAR_END) * longest:
            raise InfeasibleError(
                f"{who} the flight of {longest:g} s, the longest that plans may have, not by the "
                f"robot; allow more by limits={{'flight_s': ({least:g}, {2 * longest:g})}}",
                number="flight_s",
                bound=longest,
            )
        for name in {SOUGHT[x] for x in self.sought}:
            _, low, high = RANGES[name]
            if getattr(task, name) > high - NEAR_END * (high - low):
                raise InfeasibleError(
                    f"{who} {name} = {high:g} {unit_of(name)}, the largest that a target may have, "
                    f"not by the robot; give the robot lower limits, or fix more of the target",
                    number=name,
                    bound=high,
                )

    def plan_at(self, best: Solved) -> tuple[JumpPlan, Solved, Program]:
        """The largest plan that passes its audit: the record on a mesh that is fine enough, or a
        share of it, halfway to what has no plan; with the record in the program's words.
        """
        robot = self.planner.robot
        program = self.program(self.task)
        most = getattr(self.task, self.what)
        failed = ""
        accepted = None
        low, share, high = 0.0, 1.0, 1.0
        for _ in range(1 + HALVINGS):
            try:
                if share == 1:  # finer meshes may allow less
                    body = self.stage.refined(program, Asked(self.task, near=best), RECORD)
                else:
                    # a record without a plan may be a motion that leads its shares nowhere
                    near = None if accepted is None else accepted[1]
                    with patience(max(LEAST_S, min(left_s(), HALVING_S * program.size))):
                        body = self.stage.plan(self.below(share), near=near)
                plan = JumpPlan.of(robot, "direct", body)
                failed = ", ".join(check.name for check in plan.audit.failed)
            except (InfeasibleError, SolverError) as e:
                failed = str(e)
            if failed:
                high = share
            else:
                accepted = plan, body, share
                low = getattr(body.task, self.what) / most
            if high - low <= 2 * SAME:
                break
            share = (low + high) / 2
        if accepted is None:
            raise SolverError(
                f"robot {robot.name}: {self.what} reaches {most:.3f} at the nodes, but no plan "
                f"down to {high:.0%} of it passes the audit ({failed})"
            )
        plan, body, share = accepted
        if share == 1:
            contacts = body.schedule.contacts
            same = contacts == program.contacts
            finest = program if same else replace(program, contacts=contacts)
            with suppress(SolverError):
                return plan, finest.solve(Asked(body.task, near=body), RECORD), finest
        return plan, best, program

    def at(self, task: JumpTask, share: float) -> JumpTask:
        """A ``share`` [1] of what is sought; of a jump onto a platform the rise stays."""
        return replace(task, **{self.what: share * getattr(task, self.what)})

    def below(self, share: float) -> JumpTask:
        """A ``share`` [1] of the record. A rise that was sought besides goes to the usual one, if
        that is lower, as the share goes to zero: at the record's rise, smaller shares may have no
        plan either.
        """
        task = self.at(self.task, share)
        if self.what == "height_m" or "takeoff_speed" not in self.sought:
            return task
        usual_m = min(self.given.height_m, task.height_m)
        return replace(task, height_m=share * task.height_m + (1 - share) * usual_m)

    def played(
        self, plan: JumpPlan, share: float, engines: Sequence[str]
    ) -> tuple[float, dict[str, SimulationResult]]:
        """A plan at a ``share`` [1] of the record, and of its rise where that was sought besides,
        played in all ``engines``: of several shares, each :data:`LESS` than the one before, the
        first that lands in all, else the last one.
        """
        runs: dict[str, SimulationResult] = {}
        most = plan.task
        rises = "takeoff_speed" in self.sought
        for tried in [share - LESS * less for less in range(TRIED if engines else 0)]:
            tell(f"playing {tried:.0%} of the record")
            with suppress(InfeasibleError, SolverError):
                task = self.at(most, tried)
                if rises:
                    rise = max(tried * most.height_m, RANGES["height_m"][1])
                    task = replace(task, height_m=rise)
                plan = self.planner.plan(task, "direct", near=plan)
                scene = Scene.of_plan(plan.summary, plan.robot)
                given = plan.tape, plan.robot
                runs = {x: simulate_jump(*given, scene=scene, engine=x) for x in engines}
                share = tried
                if all(run.landed for run in runs.values()):
                    break
        return share, runs


def unit_of(name: str) -> str:
    """Unit of a number of the target, "m" or "rad"."""
    return name.rpartition("_")[2].replace("height", "m")


def _usual(body: Body, what: str) -> JumpTask:
    """The rest of a target where nothing is said: on the spot, a platform far enough ahead to
    crouch before it.
    """
    return JumpTask(clear_of_edge_m(body.robot) if what == "platform_m" else 0.0, 0.2)


# what ends it
# ----------------------------------------------------------------------------------------------
def _binding(program: Program, task: JumpTask, solved: Solved) -> list[Binding]:
    """The limits that end a record, the highest worth first."""
    phases = {p.name: p for p in solved.solution.problem.phases}
    ends = np.cumsum([x.duration for x in solved.solution.phases.values()]).tolist()
    began = dict(zip(phases, [0.0, *ends], strict=False))
    by_limit: dict[tuple, list] = {}
    for (owner, term), column, share, lam, limit in program.limits_of(Asked(task), solved):
        worth = lam * np.where(np.isfinite(limit), np.abs(limit), 0.0) / WORTH
        for way in (1, -1):
            key = owner in phases and limit_of(phases[owner], program, term, column, way)
            if key and (way * worth > 0).any():
                by_limit.setdefault((owner, *key), []).append((share, np.maximum(way * worth, 0.0)))
    rows = []
    for (owner, limit, joint), parts in by_limit.items():
        share = parts[0][0]
        worth = sum(x for _, x in parts)
        times = share[worth > BINDING_SHARE * worth.max()] * solved.solution.phases[owner].duration
        first, last = (float(began[owner] + t) for t in (times.min(), times.max()))
        if worth.sum() > BINDS:
            rows.append(Binding(owner, limit, joint, first, last, float(worth.sum())))
    return sorted(rows, key=lambda row: -row.worth)
