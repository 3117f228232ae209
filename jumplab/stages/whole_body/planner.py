"""Solving the whole-body program: a list of starts, each with its patience, one after the other; and the result."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, InputError, Shown, SolverError
from jumplab.io.tape import Tape
from jumplab.ocp.nlp import EXPLAINED, WARM, Nlp, Solution
from jumplab.ocp.solution import PhaseGuess, PhaseSolution
from jumplab.robot import Robot
from jumplab.robot.stance import holding
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body import starts
from jumplab.stages.whole_body.apart import Apart, merged, too_close
from jumplab.stages.whole_body.contacts import SIDES, ContactPhase, Contacts
from jumplab.stages.whole_body.coordinates import Coordinates, even, in_plane, whole
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.settings import Limits, Mesh, Weights
from jumplab.stages.whole_body.tape import Surface, make_tape, used_between
from jumplab.stages.whole_body.terms import Body
from jumplab.task import JumpTask

# beyond, the cost moves by less than one in a million
IPOPT = {"tol": 1e-3, "constr_viol_tol": 1e-5, "compl_inf_tol": 1e-4, "max_iter": 250}
# joints that lie at a stop for many nodes have multipliers that settle last: where all rows are met, and the cost moves
# by less than 0.2 % twice in a row, the motion stands
IPOPT |= {"acceptable_tol": 1e8, "acceptable_dual_inf_tol": 1e10, "acceptable_compl_inf_tol": 1e-2}
IPOPT |= {"acceptable_constr_viol_tol": 5e-5, "acceptable_obj_change_tol": 2e-3, "acceptable_iter": 2}
# where the Hessian is bent the wrong way, what is added to it should be close to what the last step needed
IPOPT |= {"perturb_dec_fact": 0.6, "perturb_inc_fact": 4.0, "min_hessian_perturbation": 0.05}
NEAR = WARM | {"acceptable_iter": 1, "mu_strategy": "monotone", "mu_init": 1e-4}
# where a motion passes limits between the nodes, it often is not settled: from there on with smaller steps of the cost
PATIENT = {"acceptable_iter": 8, "acceptable_obj_change_tol": 5e-4}
# of all attempts for one target: beyond, no other start and no finer mesh is tried; on a busy core a hop, which has to
# be solved on a finer mesh with its links apart, takes 20 to 40 s
PATIENCE_S = 60.0
HOLD = 0.1  # added to the Gauss-Newton Hessian of the scaled variables: it leads there in half the time
FINER = 1.5  # times as many intervals, where a motion passes limits between the nodes
USUAL_SIZE = 4500  # variables, up to which the patience of a start is what it says; larger programs have more
BROKEN = 1.5  # times a limit between the nodes, beyond which a motion is none
ROUNDS = 4  # of rows for links that met
SHORTER = 0.9, 0.7, 0.5  # of way and turn, tried after a refusal


@dataclass(frozen=True)
class Start:
    """One way to begin a solve: a motion to begin with, the Hessian, and how long it may take.

    Attributes
    ----------
    name : of the motion: "schedule" (inverse kinematics along it), "stance" (carried along), "neighbour" (a plan for a
        target close by), "ramp" (the jump straight ahead, which goes aside and turns on the way), "given motion" (also
        with its feet in place).
    held : whether the Hessian is the Gauss-Newton one, held; else the exact one.
    patience_s : processor time after which it is given up [s].
    options : of ipopt besides the usual ones.
    """

    name: str
    held: bool
    patience_s: float
    options: Mapping[str, Any]


NEIGHBOUR, MENDED = "neighbour", "given motion, feet in place"
COLD = (
    Start("schedule", True, 9.0, {"max_iter": 150}),
    Start("schedule", False, 8.0, {}),
    Start("stance", False, 3.0, {}),
)
# solved in half the unknowns, the jump straight ahead halves the iterations of one to the side or with a turn
STRAIGHT = Start("straight ahead", True, 3.0, {"max_iter": 80, "acceptable_iter": 1})
RAMP = "ramp"
ASIDE = (Start(RAMP, True, 9.0, {"max_iter": 150}), *COLD)
FROM_NEIGHBOUR = (
    Start(NEIGHBOUR, True, 4.0, NEAR),
    Start(NEIGHBOUR, False, 6.0, WARM | {"acceptable_iter": 1}),
)
# in the plane a step costs a few milliseconds: where the held Hessian wanders, the exact one is tried soon
IN_PLANE = (
    Start("schedule", True, 2.0, {"max_iter": 50}),
    Start("schedule", False, 4.0, {}),
    Start("stance", False, 2.0, {}),
)
GIVEN = (
    Start("given motion", True, 3.0, {"max_iter": 60}),
    Start("given motion", False, 5.0, {}),
    Start(MENDED, True, 3.0, {"max_iter": 60}),
    Start(MENDED, False, 5.0, {}),
)
QUICK = Start("schedule", True, 5.0, {"max_iter": 80})
APART = Start("links apart", True, 5.0, WARM | {"acceptable_iter": 1, "mu_init": 1e-3, "max_iter": 80})
SETTLED = Start("settled", False, 8.0, WARM | PATIENT)
REFINED = 2 * (Start("finer mesh", False, 10.0, WARM | {"acceptable_iter": 1}),)
HELD_TURN_RAD = np.radians(100)  # with more than that to turn only the exact Hessian settles, so it is tried first


@dataclass(frozen=True)
class Attempt:
    """What came of one start."""

    start: str
    hessian: str
    iterations: int
    cpu_s: float
    status: str


@dataclass(frozen=True)
class Asked:
    """What every solve of one target is asked for, whatever its mesh and its start."""

    task: JumpTask
    parameters: Mapping[str, Any]
    weights: Mapping[str, float]  # instead of the terms' own
    references: Mapping[str, Mapping[str, np.ndarray]]
    attempts: list[Attempt]  # made so far
    srmp: SrmpPlan | None = None

    @property
    def spent_s(self) -> float:
        """Processor time of all attempts [s]."""
        return sum(attempt.cpu_s for attempt in self.attempts)


@dataclass(frozen=True, repr=False)
class WholeBodyPlan(Shown):
    """Result of the whole-body program."""

    task: JumpTask
    solution: Solution  # in the coordinates of the program; see :attr:`phases`
    schedule: Schedule
    edge_m: float  # where the ground steps up or down, ahead of the toes' first place [m]
    limits: Limits = Limits()  # that it was made with
    attempts: tuple[Attempt, ...] = ()  # that were made, the last one with success

    @cached_property
    def tape(self) -> Tape:
        """The 1 kHz tape of the motion."""
        return make_tape(self.schedule.whole, self.phases, self.task.gravity)

    @cached_property
    def used(self) -> float:
        """Largest share of the limits that the tape uses, also between the nodes."""
        robot, along = self.schedule.body.robot, self.task.along_rad
        height = self.schedule.contacts.surface[0] if self.schedule.contacts.ends == "rest" else self.task.platform_m
        first = robot.foot.toe - float(robot.foot.center[0])
        return used_between(self.tape, robot, Surface(height, first + self.edge_m, along))

    def after(self, attempts: Iterable[Attempt]) -> WholeBodyPlan:
        """The same plan, with what was tried before it."""
        plan = replace(self, attempts=tuple(attempts))
        vars(plan).update(tape=self.tape, phases=self.phases, used=self.used)  # it is the same motion
        return plan

    @cached_property
    def phases(self) -> dict[str, PhaseSolution]:
        """The solution with every coordinate of the robot, as one of ``schedule.whole``."""
        return self.schedule.spread(self.solution.phases)

    def began(self, start: str) -> bool:
        """Whether the solve that led here began with a start of that name."""
        known = {x.name for x in (*ASIDE, *IN_PLANE, *GIVEN, *FROM_NEIGHBOUR)}
        return [x.start for x in self.attempts if x.start in known][-1:] == [start]

    @property
    def launch_s(self) -> float:
        """Time until the feet first leave the ground [s]."""
        durations = [p.duration for p in self.solution.phases.values()]
        flying = [p.flying for p in self.schedule.contacts.phases]
        return float(sum(durations[: flying.index(True)])) if any(flying) else float(sum(durations))

    @property
    def flight_s(self) -> float:
        """Duration of the first flight [s]; 0 if there is none."""
        pairs = zip(self.solution.phases.values(), self.schedule.contacts.phases, strict=True)
        return next((x.duration for x, p in pairs if p.flying), 0.0)


def platform_edge_m(task: JumpTask, robot: Robot, limits: Limits = Limits()) -> float:
    """Where the ground steps up or down in a jump straight ahead, from the toes' first place [m].

    A platform begins a little before the landing heel; when the robot jumps down, the launching surface ends a little
    ahead of its toe.
    """
    if task.platform_m < 0:
        return limits.edge_before_heel_m
    return task.distance_m - (robot.foot.toe - robot.foot.heel) - limits.edge_before_heel_m


def jump_contacts(limits: Limits, mesh: Mesh) -> Contacts:
    """The schedule of a standing jump, which ends at touchdown."""
    phases = (
        ContactPhase("LR", limits.flat_s, 0.6, mesh.flat, "flat"),
        ContactPhase("lr", limits.toe_s, 0.1, mesh.toe, "toe"),
        ContactPhase("-", limits.flight_s, 0.5, mesh.flight, "flight"),
    )
    return Contacts(phases, ends="touchdown")


class WholeBodyPlanner:
    """The whole-body program of one robot and one schedule: built once, solved for any target.

    ``contacts`` are by default those of a standing jump. ``keep`` keeps what was built for later processes; ``changes``
    are own terms, weights and switches.
    """

    def __init__(
        self,
        robot: Robot,
        mesh: Mesh | None = None,
        limits: Limits = Limits(),
        weights: Weights = Weights(),
        *,
        contacts: Contacts | None = None,
        tracking: bool = False,
        options: Mapping | None = None,
        keep: bool = False,
        changes: StageChanges = StageChanges(),
        body: Body | None = None,
        free: Coordinates | None = None,
        starts: Iterable[Start] | None = None,
    ):
        self._begun = None if starts is None else tuple(starts)
        self.robot, self.mesh, self.tracking = robot, mesh or Mesh(), tracking
        self.limits, self.weights, self.changes, self._keep = limits, weights, changes, keep
        self.body = body or Body(robot)
        self.free = free or (even(self.body) if tracking else whole(self.body))
        self.contacts = contacts or jump_contacts(limits, self.mesh)
        if self.body.short and any(len(p.modes) == 1 for p in self.contacts.phases):
            raise InputError(
                f"robot {robot.name}: a leg has fewer than six joints, so it cannot be planned to stand on one foot"
            )
        self._stood: dict[tuple, tuple[float, str, float] | None] = {}
        self._options = dict(options or {})
        self._key = f"{robot.hash} {self.free.kind} {limits} {weights} {tracking}" if keep else None
        self._apart: dict[tuple, Nlp] = {}
        self._terms: dict = {}

    @property
    def nlp(self) -> Nlp:
        """The program without rows for links that met."""
        return self._nlp(())

    def _schedule(self, apart: tuple[Apart, ...]) -> Schedule:
        return Schedule(
            self.body,
            self.contacts,
            self.limits,
            self.weights,
            apart,
            self._terms,
            free=self.free,
            tracking=self.tracking,
        )

    def _nlp(self, apart: tuple[Apart, ...]) -> Nlp:
        """The program with rows for links that met."""
        key = tuple((x.phase, x.first, x.last, x.pair.key, x.more_m) for x in apart)
        if key not in self._apart:
            if len(self._apart) > 8:
                self._apart = {(): self._apart[()]}
            problem = self.changes.applied(self._schedule(apart).problem())
            self._apart[key] = Nlp(problem, {**IPOPT, **self._options}, self._key)
        return self._apart[key]

    @cached_property
    def terms(self) -> dict:
        """Mode -> its terms."""
        return self._schedule(()).terms

    def plan(
        self,
        task: JumpTask,
        srmp: SrmpPlan | None = None,
        *,
        begin: starts.Motion | None = None,
        weights: Mapping[str, float] | None = None,
        near: WholeBodyPlan | None = None,
        stance: np.ndarray | None = None,
    ) -> WholeBodyPlan:
        """Solve for a target; where the motion passes limits between the nodes, on to the end, then on a finer mesh.

        Parameters
        ----------
        srmp : with tracking, stage 1's plan for the target.
        begin : a motion to begin with, before all other starts.
        weights : of cost terms, instead of their own.
        near : this planner's plan for a target close by, to begin with.
        stance : configuration (nq,) in which the robot waits at rest, soles flat in the stance's places; it if None.

        Raises
        ------
        SolverError
            If there is no plan; names the terms in conflict, and the nearest of a few smaller targets that has one.
            Where nobody reads explanations (:data:`jumplab.ocp.nlp.EXPLAINED`), it gives up sooner.
        """
        if (less := self.program(task, weights or {})) is not self:
            how: dict[str, Any] = {"begin": begin, "weights": weights, "near": near, "stance": stance}
            if less.free.plane:
                return less.plan(task, srmp, **how)
            explained = EXPLAINED.set(False)
            try:
                return less.plan(task, srmp, **how)
            except SolverError:
                pass  # perhaps an uneven motion does it
            finally:
                EXPLAINED.reset(explained)
        weights = self.changes.spread(self.nlp.problem, weights or {})
        asked = Asked(task, self.parameters(task, stance, srmp), weights, self._references(srmp), [], srmp)
        best, failure = self._searched(asked, near, begin)
        if best is None:
            raise self._explained(failure, asked)
        if best.used > BROKEN:
            raise SolverError(
                f"{self.nlp.problem.name}: motions that keep every limit at the nodes break them between the nodes, at "
                f"best by a factor of {best.used:.3g}; ask for less, or for a finer mesh",
                stage=self.nlp.problem.name,
            )
        return best.after(asked.attempts)

    def _searched(
        self, asked: Asked, near: WholeBodyPlan | None, begin: starts.Motion | None
    ) -> tuple[WholeBodyPlan | None, SolverError | None]:
        """The best plan of all starts, up to the first that keeps every limit; and how the last that failed did."""
        best, failure = None, None
        for start in self._starts(asked.task, near, begin):
            if asked.spent_s > self._patience_s(PATIENCE_S):
                break
            try:
                found = self._settled(self._tried(start, asked, near if start.name == NEIGHBOUR else begin), asked)
            except SolverError as e:
                failure = e
                continue
            if best is None or found.used < best.used:
                best = found
            if best.used <= 1:
                break
        return best, failure

    def _starts(self, task: JumpTask, near, begin) -> Iterable[Start]:
        """The list of starts for a target, in their order."""
        cold = IN_PLANE if self.free.plane else ASIDE if self._ramps(task) else COLD
        if not EXPLAINED.get():
            cold = cold[:-1]
        cold = cold if self._begun is None else self._begun
        given = GIVEN if begin is not None else ()
        if task.rotation_rad:  # a body that turns over has no places for its feet
            given = [start for start in given if start.name != MENDED]
        found = [*(FROM_NEIGHBOUR if near is not None else ()), *given, *cold]
        if abs(task.yaw_rad) > HELD_TURN_RAD or task.rotation_rad:
            return sorted(found, key=lambda start: (start.name != NEIGHBOUR, start.name in ("stance",), start.held))
        return found

    def _ramps(self, task: JumpTask) -> bool:
        """Whether a jump may begin with the one straight ahead."""
        small = abs(task.yaw_rad) <= HELD_TURN_RAD and not task.rotation_rad
        aside = self.contacts.ends == "touchdown" and not task.in_plane
        return aside and small and self._straight.free.kind != self.free.kind

    @cached_property
    def _straight(self) -> WholeBodyPlanner:
        """The planner of even motions, without own terms: they may see what does not move there."""
        return self._even_with(StageChanges()) if self.changes else self._even

    def beside(
        self, task: JumpTask, near: Mapping[str, PhaseGuess], *, stance: np.ndarray | None = None
    ) -> WholeBodyPlan:
        """Solve for a target from a motion of one close by, in this program's coordinates; nothing else is tried.

        Raises :class:`SolverError` if that leads nowhere.
        """
        asked = Asked(task, self.parameters(task, stance), {}, self._references(None), [])
        found = self._solved(FROM_NEIGHBOUR[0], asked, near, ())
        found = self._kept_apart(found, True, asked)
        return self._settled(found, asked).after(asked.attempts)

    def program(self, task: JumpTask, weights: Mapping[str, float] = MappingProxyType({})) -> WholeBodyPlanner:
        """The planner of a target: of even motions, which take half the unknowns, where nothing asks for another."""
        if self.free.even or not (task.in_plane and self.contacts.even):
            return self
        named = (*weights, *self.changes.weights, *self.changes.off)
        # an own term may ask for an uneven motion, but in the plane there is none
        uneven = any(name.rpartition("/")[2] == "mirror" for name in named) or self.changes.terms
        if (uneven and not self.robot.planar) or self._even.free.kind == "whole":
            return self
        return self._even

    @cached_property
    def _even(self) -> WholeBodyPlanner:
        return self._even_with(self.changes)

    def _even_with(self, changes: StageChanges) -> WholeBodyPlanner:
        """The planner of even motions; this one where there is none."""
        how = {"options": self._options, "keep": self._keep, "changes": changes, "body": self.body}
        how["starts"] = self._begun
        turns = self.limits.capture_moment is not None  # a flip: in the plane, if the feet stay in it
        how |= {"contacts": self.contacts, "free": in_plane(self.body) if turns else even(self.body)}
        if how["free"].kind == "whole":
            return self
        return WholeBodyPlanner(self.robot, self.mesh, self.limits, self.weights, **how)

    def _tried(self, start: Start, asked: Asked, given: WholeBodyPlan | starts.Motion | None) -> WholeBodyPlan:
        """A plan from one start, its links apart."""
        begin, apart = given, ()
        if start.name == NEIGHBOUR:
            apart = self._scaled(given) if given.schedule.free.kind == self.free.kind else ()
        elif start.name == RAMP:
            begin = self._ramped(asked)
        elif start.name == MENDED:
            begin = starts.mended(self._schedule(()), asked.task, given)
        elif start.name != GIVEN[0].name:
            begin = self._motion(start, asked.task)
        found = self._solved(start, asked, begin, apart)
        return self._kept_apart(found, start.held, asked)

    def _ramped(self, asked: Asked) -> dict[str, PhaseGuess]:
        """Start values of a jump to the side or with a turn: the one straight ahead, led there along a ramp.

        That one begins in the stance, whatever posture is asked for.
        """
        even = self._straight
        straight = replace(asked.task, side_m=0.0, yaw_rad=0.0)
        try:
            ahead = replace(asked, task=straight, parameters=even.parameters(straight), weights={})
        except InfeasibleError as e:  # whose platform is too near
            raise SolverError(str(e), stage=self.nlp.problem.name, status="Infeasible") from e
        ahead = replace(ahead, references=even._references(None))
        found = even._solved(STRAIGHT, ahead, even._motion(STRAIGHT, straight), ())
        return starts.ramped(self._schedule(()), found.phases, asked.task)

    def _kept_apart(self, found: WholeBodyPlan, held: bool, asked: Asked) -> WholeBodyPlan:
        """The plan, solved on with rows for whatever links meet in it."""
        for _ in range(ROUNDS):
            new = too_close(self.body, list(found.phases.values()))
            if self.free.even:
                new = [x for x in new if self._on_left(x)]
            if not new:
                break
            apart = merged(found.schedule.apart, new)
            ways = [replace(APART, held=kind) for kind in ((True, False) if held else (False,))]
            for way in ways:
                try:
                    found = self._solved(way, asked, found, apart)
                    break
                except SolverError:
                    if way is ways[-1]:
                        raise
        return found

    def _on_left(self, kept: Apart) -> bool:
        """Whether a pair of links is no mere mirror image of another."""
        model = self.body.model
        left = {k for k in model.left_half if model.across[k] is None}
        return kept.pair.first.body in left or kept.pair.second.body in left

    def _motion(self, start: Start, task: JumpTask) -> starts.Motion:
        schedule = self._schedule(())
        if start.name == "stance":
            return starts.still(schedule, task)
        motion = starts.along(schedule, task)
        return motion if motion.missed < starts.REACHED else starts.still(schedule, task)

    def _solved(self, start: Start, asked: Asked, begin, apart, *, explain: bool = False) -> WholeBodyPlan:
        """One solve; what came of it is added to the attempts.

        It begins with a plan, with a motion, or with values at the nodes.
        """
        schedule, nlp = self._schedule(apart), self._nlp(apart)
        options = {**IPOPT, **start.options, "max_cpu_time": self._patience_s(start.patience_s), **self._options}
        nlp = nlp.with_options(options, HOLD if start.held else None)
        how: dict[str, Any] = {"explain": explain, "weights": asked.weights, "references": asked.references}
        if isinstance(begin, Mapping):
            guess = begin
        elif isinstance(begin, WholeBodyPlan):
            if begin.schedule.free.kind == self.free.kind:
                guess = begin.solution.guess({p.name: p.intervals for p in self.contacts.phases})
                how["multipliers"] = begin.solution.multipliers
            else:
                guess = starts.beside(schedule, begin.phases)
        else:
            guess = starts.guess(schedule, begin)
        began, words = time.process_time(), "held Gauss-Newton" if start.held else "exact"
        try:
            solution = nlp.solve(asked.parameters, guess, **how)
        except SolverError as e:
            asked.attempts.append(Attempt(start.name, words, e.iterations, time.process_time() - began, str(e.status)))
            raise
        s = solution.statistics
        asked.attempts.append(Attempt(start.name, words, s.iterations, time.process_time() - began, s.status))
        origin = self.robot.foot.toe - float(self.robot.foot.center[0])
        edge = self._edge(asked.task)[0] if self.contacts.ends == "touchdown" else self._step()[1]
        return WholeBodyPlan(asked.task, solution, schedule, edge - origin, self.limits)

    def _patience_s(self, usual_s: float) -> float:
        """Processor time [s] that a program of this size may take where one of usual size takes ``usual_s``."""
        return usual_s * max(1.0, self.nlp.assembled.size / USUAL_SIZE)

    def _settled(self, found: WholeBodyPlan, asked: Asked) -> WholeBodyPlan:
        """The plan, solved on where it passes limits between the nodes: first to the end, then on finer meshes."""
        best, p = found, self
        for start in (SETTLED, *REFINED):
            if best.used <= 1 or asked.spent_s > self._patience_s(PATIENCE_S):
                break
            p = p if start is SETTLED else p._finer
            finer = replace(asked, references=p._references(asked.srmp))
            try:
                found = p._kept_apart(p._solved(start, finer, found, p._scaled(found)), False, finer)
            except SolverError:
                continue
            best = min(best, found, key=lambda plan: plan.used)
        return best

    def _scaled(self, found: WholeBodyPlan) -> tuple[Apart, ...]:
        """Rows for links that met, at the nodes of this planner's mesh."""
        out = []
        for x in found.schedule.apart:
            ratio = self.contacts.phases[x.phase].intervals / found.schedule.contacts.phases[x.phase].intervals
            last = min(self.contacts.phases[x.phase].intervals, math.ceil(ratio * x.last))
            out.append(replace(x, first=max(1, int(ratio * x.first)), last=last))
        return tuple(out)

    @cached_property
    def _finer(self) -> WholeBodyPlanner:
        """The same program on half as many nodes again."""
        phases = tuple(replace(p, intervals=math.ceil(FINER * p.intervals)) for p in self.contacts.phases)
        contacts = replace(self.contacts, phases=phases)
        how = {"options": self._options, "keep": self._keep, "changes": self.changes, "body": self.body}
        how |= {"contacts": contacts, "free": self.free, "tracking": self.tracking}
        return WholeBodyPlanner(self.robot, self.mesh, self.limits, self.weights, **how)

    def _explained(self, failure: SolverError, asked: Asked) -> SolverError:
        """Why there is no plan: the terms in conflict, and a smaller target that has one."""
        if not EXPLAINED.get():
            return failure
        start, task = replace(COLD[1], patience_s=1.0), asked.task
        try:
            self._solved(start, replace(asked, attempts=[]), self._motion(start, task), (), explain=True)
        except SolverError as e:
            failure = e
        less = self._smaller(asked) if self.contacts.ends == "touchdown" else None
        words = "" if less is None else f"; at this height, {said(less.task)} is planned"
        return SolverError(
            f"{failure}{words}", stage=failure.stage, status=failure.status, violations=failure.violations
        )

    def _smaller(self, asked: Asked) -> WholeBodyPlan | None:
        """The plan of the largest of a few targets with less way and less turn."""
        task = asked.task
        if self.tracking:
            return None
        for share in SHORTER:
            less = {name: round(share * getattr(task, name), 3) for name in ("distance_m", "side_m", "yaw_rad")}
            easier = replace(task, **less)
            try:
                return self._tried(QUICK, replace(asked, task=easier, parameters=self.parameters(easier)), None)
            except (InfeasibleError, SolverError):
                continue
        return None

    def _references(self, srmp: SrmpPlan | None) -> dict[str, dict[str, np.ndarray]]:
        """How high the soles of feet in the air shall be at each node (1, N + 1) [m], by phase and foot.

        With tracking also stage 1's trajectories, by share of each phase.
        """
        phases = self.contacts.phases
        out = {p.name: {} for p in phases}
        for side in self.free.sides:
            for run in _runs([side not in p.modes for p in phases]):
                count, at, last = sum(phases[k].intervals for k in run), 0, run[-1] == len(phases) - 1
                for k in run:
                    u = (at + np.arange(phases[k].intervals + 1)) / count
                    at += phases[k].intervals
                    shape = 4 * u * (1 - u)
                    # in a jump the soles come down steeply, in a step they hardly leave the ground else
                    height = self.limits.clearance_m * (shape**3 if last else shape)
                    if phases[k].flying:
                        s = np.linspace(0, 1, len(u))
                        height = np.maximum(height, self.limits.clearance_m * (4 * s * (1 - s)) ** 3)
                    out[phases[k].name][f"{SIDES[side]}_clearance"] = height[None]
        return self._followed(srmp, out) if self.tracking else out

    def _followed(self, srmp: SrmpPlan, out: dict[str, dict[str, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
        """The same with stage 1's trajectories."""
        intervals = {p.name: p.intervals for p in self.contacts.phases}
        split = srmp.launch_s - srmp.toe_s
        spans = {"flat": (0.0, split), "toe": (split, srmp.launch_s), "flight": (0.0, srmp.flight_s)}
        for name, count in intervals.items():
            t, part = np.linspace(*spans[name], count + 1), srmp.flight if name == "flight" else srmp.launch
            names = ("rho", "rho_rate") if name == "flight" else ("rho", "rho_rate", "L")
            out[name] |= {k: np.interp(t, part.t, getattr(part, k))[None] for k in names}
            if name != "flight":
                out[name]["velocity"] = np.array([np.interp(t, part.t, x) for x in part.com_velocity.T])
        return out

    def parameters(
        self, task: JumpTask, stance: np.ndarray | None = None, srmp: SrmpPlan | None = None
    ) -> dict[str, Any]:
        """Parameter values of the problem for a target; with tracking, ``srmp`` is stage 1's plan for it.

        Raises :class:`InfeasibleError` for an impossible platform, and if the robot cannot even stand as it begins.
        """
        start = self.body.stance if stance is None else self.body.model.of_pinocchio(stance[None])[0]
        if not self.robot.planar:  # of others stage 1's closed forms tell
            self._check_standing(start, task.gravity)
        values = dict(stance=self.free.taken(start), distance=task.distance_m, side=task.side_m, yaw=task.yaw_rad)
        values |= dict(platform=task.platform_m, takeoff_speed=task.takeoff_speed, rotation=task.rotation_rad)
        if self.tracking:
            values |= dict(momentum=srmp.launch.L[-1], launch_s=[srmp.launch_s - srmp.toe_s, srmp.toe_s])
        values["straight"] = float(task.in_plane and self.contacts.ends == "touchdown")
        if self.contacts.ends == "rest":
            height, edge, room = self._step()
            edge -= np.sign(height) * min(self.limits.edge_step_m, room)
            return values | dict(platform=height, edge=edge, along=(1.0, 0.0), gravity=task.gravity)
        ways = np.cos(task.along_rad), np.sin(task.along_rad)
        edge, room = self._edge(task)
        # for clearance, also between the nodes, a platform counts as reaching further
        edge -= np.sign(task.platform_m) * min(self.limits.edge_step_m, room)
        return values | dict(edge=edge, along=ways, gravity=task.gravity)

    def check_ground(self, task: JumpTask) -> None:
        """Refuse a step up or down that a sole would stand across (:class:`InfeasibleError`)."""
        self._edge(task)

    def _step(self) -> tuple[float, float, float]:
        """Height of the second surface of a schedule [m], where ahead of the world's origin it begins [m], and how far
        the upper surface could reach further before it met a sole [m].
        """
        (height, first), room = self.contacts.surface, self.limits.edge_before_heel_m
        length, toes = 2 * self.body.half_m, float(self.body.places[:, 0].mean())
        near = max([toes, *(toes + p.ahead_m for p in self.contacts.places[:first])])
        far = min([toes + p.ahead_m for p in self.contacts.places[first:]], default=near) - length
        if height == 0:
            return 0.0, 0.0, 0.0
        if far - near < 2 * room:
            raise InfeasibleError(
                f"places on a surface {height:g} m higher: it would begin {far - near:.2f} m ahead of the toes that "
                f"leave, which takes {2 * room:.2f} m; put the places {near + 2 * room + length - toes:.2f} m ahead",
                number="ahead_m",
                bound=near + 2 * room + length - toes,
            )
        edge = near + room if height < 0 else far - room
        return height, edge, max(0.0, (far - edge if height < 0 else edge - near) - 0.01)

    def _check_standing(self, start: np.ndarray, gravity: float) -> None:
        """Refuse a robot whose motors cannot hold the posture in which it waits."""
        if (key := (gravity, start.tobytes())) not in self._stood:
            q = self.body.model.to_pinocchio(start[None], *np.zeros((2, 1, len(start))))[0][0]
            self._stood[key] = holding(self.robot.under_gravity(gravity), q, self.limits.friction)
        share, joint, torque = self._stood[key] or (0.0, "", 0.0)
        if share > 1:
            effort = self.robot.actuators[joint]["effort"]
            raise InfeasibleError(
                f"robot {self.robot.name} cannot stand as it begins: however the ground's forces are shared, a joint "
                f"needs {share:.1f} times its effort, {joint} {torque:.3g} N m of {effort:.3g}; if these are motors' "
                f"efforts before their gears, give those of the joints in [limits]"
            )

    def _edge(self, task: JumpTask) -> tuple[float, float]:
        """Where the ground steps up or down [m], along the travel from the world's origin.

        And how far the upper surface could reach further before it met a sole [m].
        """
        along = np.array([np.cos(task.along_rad), np.sin(task.along_rad)])
        c, s = np.cos(task.yaw_rad), np.sin(task.yaw_rad)
        soles = self.robot.foot.corners - self.robot.foot.tip
        corners = (self.body.places[:, None] + soles).reshape(-1, 3)[:, :2]
        landed = ([task.distance_m, task.side_m] + corners @ np.array([[c, s], [-s, c]])) @ along
        room, first = self.limits.edge_before_heel_m, float((corners @ along).max())
        up, down = float(landed.min()) - room, first + room
        edge = down if task.platform_m < 0 else up
        apart = up - first if task.platform_m > 0 else float(landed.min()) - down
        if task.platform_m and apart < -1e-9:  # rounding
            way = float(np.hypot(task.distance_m, task.side_m))
            least = np.ceil(100 * (way - apart) - 1e-6) / 100
            raise InfeasibleError(
                f"platform = {task.platform_m:g} m at a distance of {way:g} m: the two surfaces would meet under a "
                f"sole of {self.robot.name}; that takes a distance of at least {least:.2f} m",
                number="distance_m",
                bound=float(least),
            )
        return edge, max(0.0, apart)


def _runs(flags: list[bool]) -> Iterator[list[int]]:
    """Runs of consecutive indices whose flag is set."""
    run: list[int] = []
    for k, flag in enumerate([*flags, False]):
        if flag:
            run.append(k)
        elif run:
            yield run
            run = []


def said(task: JumpTask) -> str:
    """Way and turn of a target in words."""
    turn = f"{np.degrees(task.yaw_rad):.3g} deg"
    return f"{task.distance_m:g} m ahead and {task.side_m:g} m to the left with a turn of {turn}"
