"""The whole-body program of one robot, one contact schedule and one set of coordinates: built once,
solved for any target.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from jumplab.errors import Shown, SolverError
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.nlp import LEAST_S, OUT_OF_TIME, Nlp, Solution, left_s
from jumplab.ocp.posing import Posed, binding, lagrangian, pack, pose
from jumplab.ocp.problem import Problem
from jumplab.ocp.solution import PhaseSolution, resampled
from jumplab.robot import Robot
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body.apart import MORE_M, as_before, merged, runs, too_close
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import SIDES, Contacts
from jumplab.stages.whole_body.coordinates import KINDS, Coordinates
from jumplab.stages.whole_body.ground import Surface, surface_of_jump, surface_of_schedule
from jumplab.stages.whole_body.motions import Motion
from jumplab.stages.whole_body.problem import SOUGHT, Schedule
from jumplab.stages.whole_body.settings import Limits, Weights
from jumplab.stages.whole_body.shapes import Apart
from jumplab.stages.whole_body.starts import (
    AFTER_ROUGH,
    APART,
    HELD_AFTER_ROUGH,
    STILL,
    Asked,
    Beginning,
    Start,
    from_neighbour,
    from_solved,
    unpassed,
)
from jumplab.task import RANGES, JumpTask

# beyond, the cost moves by less than one in a million
IPOPT = {"tol": 1e-3, "constr_viol_tol": 1e-5, "compl_inf_tol": 1e-4}
# joints that lie at a stop for many nodes have multipliers that settle last: where all rows are
# met, and the cost moves by less than 0.2 % twice in a row, the motion stands
IPOPT |= {"acceptable_tol": 1e8, "acceptable_dual_inf_tol": 1e10, "acceptable_compl_inf_tol": 1e-2}
IPOPT |= {
    "acceptable_constr_viol_tol": 5e-5,
    "acceptable_obj_change_tol": 2e-3,
    "acceptable_iter": 2,
}
# where the Hessian is indefinite, what is added to it should be close to what the last step needed
IPOPT |= {"perturb_dec_fact": 0.6, "perturb_inc_fact": 4.0, "min_hessian_perturbation": 0.05}
FINER = 1.5  # times as many intervals, where a motion passes limits between the nodes
# of all attempts for one target, in processor time: beyond, no other start and no finer mesh is
# tried; on a busy core a hop, which has to be solved on a finer mesh with its links apart, takes 20
# to 40 s
PATIENCE_S = 60.0
OWN_SHARE = 0.8  # of a limit that is over: less of a thread's own time, and others spent the rest
USUAL_SIZE = 4500  # variables, up to which that holds; larger programs have more time
# [s] an iteration in a program of that size may take on average, three times as long as on a quiet
# core
ITERATION_S = 0.12
RISING_S = 0.06  # in which a foot that follows a motion rises or comes down by its clearance
# a motion that is followed begins beyond many limits: from further inside them all its first steps
# are longer, and it ends in the same place
INSIDE = dict.fromkeys(("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac"), 0.1)
ROUNDS = 4  # of rows for links that met
BUILT = 8  # programs with such rows that are kept


@dataclass(frozen=True, repr=False)
class Solved(Shown):
    """A solution of the program."""

    schedule: Schedule
    solution: Solution  # in the coordinates of the program

    @cached_property
    def phases(self) -> dict[str, PhaseSolution]:
        """The solution with every coordinate of the robot, as one of ``schedule.whole``."""
        return self.schedule.spread(self.solution.phases)


@dataclass(frozen=True, eq=False, repr=False)
class Program(Shown):
    """The program, with its numbers for a target.

    Attributes
    ----------
    free : the coordinates that move.
    tracking : whether a jump follows stage 1.  follows : whether it follows a given motion.
    changes : own terms, weights and switches.
    options : of ipopt besides :data:`IPOPT`.
    keep : whether what was built is kept for later processes.
    sought : parameters of the target that are unknowns, see :class:`.Schedule`.
    """

    body: Body
    contacts: Contacts
    limits: Limits
    weights: Weights
    free: Coordinates
    tracking: bool = False
    changes: StageChanges = StageChanges()
    options: Mapping[str, Any] = field(default_factory=dict)
    keep: bool = False
    follows: bool = False
    sought: tuple[str, ...] = ()
    _built: dict[tuple, Nlp] = field(default_factory=dict, init=False)

    @property
    def robot(self) -> Robot:
        """The robot that moves."""
        return self.body.robot

    def schedule(self, apart: tuple[Apart, ...] = ()) -> Schedule:
        """Its schedule, with rows for links that met (none by default)."""
        given = self.body, self.contacts, self.limits, self.weights
        return Schedule(*given, apart, self.free, self.tracking, self.follows, self.sought)

    @property
    def nlp(self) -> Nlp:
        """The problem without rows for links that met."""
        return self._nlp(())

    def _nlp(self, apart: tuple[Apart, ...]) -> Nlp:
        key = tuple((x.phase, x.first, x.last, x.pair.key, x.more_m) for x in apart)
        if key not in self._built:
            with_rows = [x for x in self._built if x]
            if len(with_rows) == BUILT:
                del self._built[with_rows[0]]
            words = (
                f"{self.robot.hash} {self.free.kind} {self.limits} {self.weights} {self.tracking} "
                f"{self.follows} {self.sought}"
            )
            problem = self.changes.applied(self.schedule(apart).problem())
            self._built[key] = Nlp(problem, {}, words if self.keep else None)
        return self._built[key]

    @cached_property
    def finer(self) -> Program:
        """The same on half as many nodes again."""
        phases = tuple(
            replace(p, intervals=math.ceil(FINER * p.intervals)) for p in self.contacts.phases
        )
        return replace(self, contacts=replace(self.contacts, phases=phases))

    def like(self, robot: Robot) -> Program:
        """The same for another robot with the same joints."""
        body = Body(robot)
        return replace(self, body=body, free=KINDS[self.free.kind](body), keep=False)

    @property
    def size(self) -> int:
        """Number of variables, the same whatever links met."""
        built = next(iter(self._built.values()), None) or self.nlp
        return built.assembled.size

    def left_s(self, asked: Asked) -> float:
        """Processor time [s] that further attempts of a program of this size may take."""
        usual = PATIENCE_S * max(1.0, self.size / USUAL_SIZE)
        return min(usual - asked.spent_s, left_s())

    def spent(self, asked: Asked) -> bool:
        """Whether no other start and no finer mesh is tried: there was one, and time is over."""
        # a program that is not built yet has no size, and building it takes seconds
        return bool(asked.attempts) and (left_s() <= 0 or self.left_s(asked) <= 0)

    def solve(
        self, asked: Asked, start: Start, begin: Beginning | None = None, *, explain: bool = False
    ) -> Solved:
        """One solve, from where the ``start`` begins if ``begin`` says nothing else; what came of
        it, and its processor time [s], is added to the attempts. Raises :class:`SolverError`, whose
        sentence names the terms in conflict where it shall ``explain``.
        """
        begin = begin or start.begin(self, asked)
        built = self._nlp(begin.apart)
        most = start.patience * ITERATION_S * self.size / USUAL_SIZE
        left = max(LEAST_S, min(most, self.left_s(asked)))
        numbers = self._numbers(asked, built.problem)
        known = {name: numbers["parameters"][name] for name in self.sought}
        guess = {k: replace(x, constants=known | x.constants) for k, x in begin.guess.items()}
        given = dict(guess=guess, **numbers, multipliers=begin.multipliers, explain=explain)
        began = time.thread_time()
        try:
            solution = self._in_time(built, start, left, given)
        except SolverError as e:
            asked.note(start, e.iterations, e.status, time.thread_time() - began)
            raise
        done = solution.statistics
        asked.note(start, done.iterations, done.status, time.thread_time() - began)
        return Solved(self.schedule(begin.apart), solution)

    def _in_time(
        self, built: Nlp, start: Start, most_s: float, given: Mapping[str, Any]
    ) -> Solution:
        """One solve of at most ``most_s`` of this thread's processor time [s].

        Ipopt counts that of the process: where other threads spent it, it begins again with more,
        so that a plan does not depend on them.
        """
        limit_s = most_s
        inside = INSIDE if self.follows else {}
        hold = start.hold if start.held else None
        while True:
            began = time.thread_time()
            limit = {"max_iter": start.patience, "max_cpu_time": limit_s}
            options = {**IPOPT, **inside, **start.options, **limit, **self.options}
            try:
                return built.with_options(options, hold).solve(**given)
            except SolverError as e:
                own_s = time.thread_time() - began
                if e.status != OUT_OF_TIME or own_s > OWN_SHARE * most_s:
                    raise
                limit_s *= 2

    def solve_apart(self, asked: Asked, start: Start) -> Solved:
        """The same, solved on with rows for whatever links meet in it (at most :data:`ROUNDS`
        times); a rough solution in any case.
        """
        solved = self.solve(asked, start)
        held = start.held
        # whether links may yet be kept on the sides where they were before they met
        sides = not (start.rough or start.begin is from_neighbour or self.contacts.ends == "rest")
        for number in range(ROUNDS):
            begin = from_solved(self, solved)
            rows = merged(begin.apart, self._met(solved))
            if rows == begin.apart and (number or not start.rough):
                break
            more = any(x.more_m > MORE_M for x in rows if x not in begin.apart)
            begin = replace(begin, apart=rows)
            after_rough = HELD_AFTER_ROUGH if start.held else AFTER_ROUGH
            again = after_rough[min(number, 1)] if start.rough else APART[not held]
            ways = [(again, begin), (APART[-1], begin)][: 1 + held]
            if sides:  # where more distance does not help, they may not pass each other
                ways.insert(0 if more else len(ways), (STILL, unpassed(self, asked, rows)))
            if self.sought and number == 0:  # what is largest without them may be far off
                first = start.begin(self, asked)
                kept = merged(first.apart, as_before(rows))
                ways.insert(0, (start, replace(first, apart=kept)))
            solved, way = self._first(asked, ways)
            held = held and way.held
            sides = sides and way is not STILL
        return solved

    def _first(self, asked: Asked, ways: Sequence[tuple[Start, Beginning]]) -> tuple[Solved, Start]:
        """The first of several ways that leads anywhere, while there is time, and which it was."""
        *others, (last, begin_last) = ways
        for way, begin in others:
            try:
                return self.solve(asked, way, begin), way
            except SolverError:
                if self.left_s(asked) <= 0:
                    raise
        return self.solve(asked, last, begin_last), last

    def _met(self, solved: Solved) -> list[Apart]:
        """Rows for links that meet; in an even motion without those of mirror images."""
        met = too_close(self.body, list(solved.phases.values()), self.limits.link_distance_m)
        if not self.free.even:
            return met
        model = self.body.model
        left = {k for k in model.left_half if model.across[k] is None}
        return [x for x in met if left & {x.pair.first.body, x.pair.second.body}]

    def limits_of(self, asked: Asked, solved: Solved) -> Iterator[tuple]:
        """Limits of a ``solved`` motion that bind: (name, column, shares, multipliers, limits) of
        each limit, see :func:`jumplab.ocp.posing.binding`.
        """
        a, posed, _ = self._posed(asked, solved)
        return binding(a, posed, solved.solution.multipliers)

    def cost_of(self, asked: Asked, solved: Solved) -> float:
        """The least cost [1], to first order, where ``solved`` is of a program like this one
        with other numbers; see :func:`jumplab.ocp.posing.lagrangian`.
        """
        a, posed, guess = self._posed(asked, solved)
        return lagrangian(a, posed, pack(a, guess), solved.solution.multipliers)

    def _posed(self, asked: Asked, solved: Solved) -> tuple[Assembled, Posed, dict]:
        """The problem of a solution, its numbers, and the solution as a start."""
        a = self._nlp(solved.schedule.apart).assembled
        guess = solved.solution.guess()
        return a, pose(a, guess=guess, **self._numbers(asked, a.problem)), guess

    def _numbers(self, asked: Asked, problem: Problem) -> dict[str, Any]:
        """Parameters, references and weights of a target in a ``problem`` of this program."""
        return {
            "parameters": self.parameters(asked.task, asked.stance, asked.srmp),
            "references": self.references(asked.srmp, asked.motion),
            "weights": self.changes.spread(problem, asked.weights),
        }

    def found(self, task: JumpTask, solved: Solved) -> JumpTask:
        """The target that a solution has reached: ``task`` with what was sought [m, rad]."""
        if not self.sought:
            return task
        constants = next(iter(solved.solution.phases.values())).constants
        new = {SOUGHT[name]: constants[name] for name in self.sought}
        if "takeoff_speed" in self.sought:
            new["height_m"] = new["height_m"] ** 2 / (2 * task.gravity)
        return replace(task, **{k: float(np.clip(x, *RANGES[k][1:])) for k, x in new.items()})

    # numbers of a target
    # ------------------------------------------------------------------------------------------
    def surface(self, task: JumpTask) -> Surface:
        """The ground on which a target is planned [m].

        Raises :class:`InfeasibleError` if a sole would stand across its edge.
        """
        if self.contacts.ends == "rest":
            return surface_of_schedule(self.body, self.limits, self.contacts, task)
        return surface_of_jump(self.body, self.limits, task)

    def parameters(
        self, task: JumpTask, stance: np.ndarray | None = None, srmp: SrmpPlan | None = None
    ) -> dict[str, Any]:
        """Parameter values of the problem for a target: name -> number or column [SI].

        ``stance`` as in :class:`Asked`; with tracking, ``srmp`` is stage 1's plan for the target.
        Raises :class:`InfeasibleError` for an impossible platform.
        """
        surface = self.surface(task)
        values = {
            "stance": self.free.taken(self.body.stance if stance is None else stance),
            "distance": task.distance_m,
            "side": task.side_m,
            "yaw": task.yaw_rad,
            "platform": surface.height_m,
            # for clearance, also between the nodes, the upper part counts as reaching further
            "edge": surface.reaching(self.limits.edge_step_m),
            "along": surface.along,
            "takeoff_speed": task.takeoff_speed,
            "rotation": task.rotation_rad,
            "gravity": task.gravity,
            "straight": float(task.in_plane and self.contacts.ends == "touchdown"),
        }
        if self.tracking:
            flat_s = srmp.launch_s - srmp.toe_s
            values |= {"momentum": srmp.launch.L[-1], "launch_s": [flat_s, srmp.toe_s]}
        return values

    def references(
        self, srmp: SrmpPlan | None = None, motion: Motion | None = None
    ) -> dict[str, dict[str, np.ndarray]]:
        """References at each node (1, N + 1) by phase: heights of the soles of feet in the air [m],
        by foot; with tracking also stage 1's trajectories, or the given motion, by share of each
        phase.
        """
        phases = self.contacts.phases
        values = {p.name: {} for p in phases}
        for side in self.free.sides:
            for run in runs(np.flatnonzero([side not in p.modes for p in phases])):
                lasts = [phases[k].guess_s if self.follows else phases[k].intervals for k in run]
                ends = np.cumsum([0.0, *lasts])
                for k, first, last in zip(run, ends, ends[1:], strict=False):
                    at = np.linspace(first, last, phases[k].intervals + 1)
                    u = at / ends[-1]
                    bump = 4 * u * (1 - u)
                    if self.follows:  # a foot does not leave, or come down, at once
                        bump = np.minimum(bump, (np.minimum(at, ends[-1] - at) / RISING_S) ** 3)
                    # in a jump the soles come down steeply, in a step they hardly leave the ground
                    height = bump**3 if run[-1] == len(phases) - 1 else bump
                    if phases[k].flying:
                        u = np.linspace(0, 1, len(bump))
                        height = np.maximum(height, (4 * u * (1 - u)) ** 3)
                    name = f"{SIDES[side]}_clearance"
                    values[phases[k].name][name] = self.limits.clearance_m * height[None]
        schedule = self.schedule() if self.follows else None
        for k, p in enumerate(phases):
            if self.tracking:
                values[p.name] |= _followed(srmp, p.name, p.intervals)
            if self.follows:
                values[p.name] |= _given(schedule, motion, k)
        return values


def _given(schedule: Schedule, motion: Motion, k: int) -> dict[str, np.ndarray]:
    """The given motion at the nodes of phase ``k``, its duration and its footholds, each
    (size, N + 1).
    """
    count = schedule.contacts.phases[k].intervals + 1
    old, new = (np.linspace(0, 1, n) for n in (len(motion.charts[k]), count))
    values = {
        "chart": resampled(old, motion.charts[k], new).T,
        "lasts": np.full((1, count), motion.durations[k]),
    }
    for side in schedule.landed(k):
        hold = np.mean(schedule.foothold(schedule.contacts.contact_of(k, side)), axis=1)
        values[f"{SIDES[side]}_hold"] = np.tile(hold[:, None], count)
    return values


def _followed(srmp: SrmpPlan, name: str, intervals: int) -> dict[str, np.ndarray]:
    """Stage 1's trajectories at the nodes of a phase, each (size, N + 1)."""
    flat_s = srmp.launch_s - srmp.toe_s
    spans = {"flat": (0.0, flat_s), "toe": (flat_s, srmp.launch_s), "flight": (0.0, srmp.flight_s)}
    columns = {"rho": "rho", "rho_rate": "rho_rate"}
    if name != "flight":
        columns |= {"L": "L", "velocity": "com_velocity"}
    part = srmp.flight if name == "flight" else srmp.launch
    t = np.linspace(*spans[name], intervals + 1)
    return {
        key: resampled(part.t, getattr(part, column).reshape(len(part.t), -1), t).T
        for key, column in columns.items()
    }
