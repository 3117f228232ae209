"""The search for a plan: a list of starts, each with its patience, one after the other."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, InputError, JumplabError, SolverError
from jumplab.ocp.cache import in_turn
from jumplab.ocp.nlp import EXPLAINED, Nlp, left_s, unexplained
from jumplab.ocp.solution import PhaseGuess
from jumplab.robot import Robot
from jumplab.robot.stance import check_held
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body.between import shares_between
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import Contacts, jump_contacts
from jumplab.stages.whole_body.coordinates import Coordinates, even, in_plane, whole
from jumplab.stages.whole_body.limiting import held_back
from jumplab.stages.whole_body.motions import Motion, configurations
from jumplab.stages.whole_body.plan import WholeBodyPlan
from jumplab.stages.whole_body.problem import NAME
from jumplab.stages.whole_body.program import Program, Solved
from jumplab.stages.whole_body.settings import Limits, Mesh, Weights
from jumplab.stages.whole_body.starts import (
    ALONG,
    ASIDE,
    COLD,
    COMPARED,
    FROM_NEIGHBOUR,
    GIVEN,
    IN_PLANE,
    MENDED,
    NEIGHBOUR,
    REFINED,
    REFINED_ALONG,
    SETTLED,
    STANCE,
    Asked,
    Attempt,
    Start,
)
from jumplab.task import JumpTask

EXPLAINING = 30  # iterations of the search before its failure is explained
BROKEN = 1.5  # times a limit between the nodes, beyond which a motion is none
# and beyond which a new start is worth more than ever finer meshes, where half of the time is over
# (before, it is no verdict: a CoP of hardly any force can be anywhere)
HOPELESS = 10.0
# with more than that to turn only the exact Hessian settles, so it is tried first
HELD_TURN_RAD = np.radians(100)


class WholeBodyPlanner:
    """Plans motions of one robot along one schedule, by programs that are built once.

    ``contacts`` are by default those of a standing jump; ``tracking`` makes a jump follow stage 1,
    ``follows`` a plan the motion that it begins with. ``free`` are the coordinates where nothing
    asks for others: by default all, with tracking those of even motions. ``changes``, ``options``
    and ``keep`` as in :class:`.Program`.
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
        follows: bool = False,
        options: Mapping[str, Any] = MappingProxyType({}),
        keep: bool = False,
        changes: StageChanges = StageChanges(),
        body: Body | None = None,
        free: Coordinates | None = None,
    ):
        self.robot = robot
        self.mesh = mesh or Mesh()
        self.limits = limits
        self.weights = weights
        self.body = body or Body(robot)
        self.contacts = contacts or jump_contacts(limits, self.mesh)
        if self.body.short and any(len(p.modes) == 1 for p in self.contacts.phases):
            raise InputError(
                f"robot {robot.name}: a leg has fewer than six joints, so it cannot be planned to "
                f"stand on one foot"
            )
        self.free = free or (even(self.body) if tracking else whole(self.body))
        given = self.body, self.contacts, limits, weights, self.free, tracking, changes
        self.usual = Program(*given, options, keep, follows)
        self._sought: dict[tuple, Program] = {}

    @cached_property
    def _even(self) -> Program | None:
        """The program of even motions, of a flip in the plane if the feet stay in it; None where
        there is none.
        """
        turns = self.limits.capture_moment is not None
        half = in_plane(self.body) if turns else even(self.body)
        return replace(self.usual, free=half) if half.even else None

    @cached_property
    def _straight(self) -> Program | None:
        """The same without own terms: they may see what does not move there."""
        changed = self._even is not None and self.usual.changes
        return replace(self._even, changes=StageChanges()) if changed else self._even

    @property
    def nlp(self) -> Nlp:
        """The problem in the coordinates where nothing asks for others."""
        return self.usual.nlp

    def programs(
        self, task: JumpTask, weights: Mapping[str, float] = MappingProxyType({})
    ) -> list[Program]:
        """The programs of a target, to be tried in this order: that of even motions, which takes
        half the unknowns, where nothing asks for another, and behind it the one where all moves.

        ``weights`` ("term" -> weight) of one plan may ask for an uneven motion.
        """
        changes = self.usual.changes
        single = self.usual.follows or self.free.even or not (task.in_plane and self.contacts.even)
        if single or self._even is None:
            return [self.usual]
        names = (*weights, *changes.weights, *changes.off)
        # an own term may ask for an uneven motion, but in the plane there is none
        uneven = changes.terms or any(name.rpartition("/")[2] == "mirror" for name in names)
        if uneven and not self.robot.planar:
            return [self.usual]
        return [self._even] if self._even.free.plane else [self._even, self.usual]

    @in_turn
    def program(
        self, task: JumpTask, weights: Mapping[str, float] = MappingProxyType({})
    ) -> Program:
        """The first of :meth:`programs` (same arguments)."""
        return self.programs(task, weights)[0]

    @in_turn
    def plan(
        self,
        task: JumpTask,
        srmp: SrmpPlan | None = None,
        *,
        begin: Motion | None = None,
        weights: Mapping[str, float] = MappingProxyType({}),
        near: WholeBodyPlan | Mapping[str, PhaseGuess] | None = None,
        stance: np.ndarray | None = None,
        starts: Sequence[Start] | None = None,
    ) -> WholeBodyPlan:
        """Solve for a target, from one start after the other, up to the first motion that keeps
        every limit.

        Where nobody reads why there is no plan, :data:`jumplab.ocp.nlp.EXPLAINED` is off, and it
        gives up sooner.

        Parameters
        ----------
        srmp : with tracking, stage 1's plan for the target.
        begin : a motion to begin with, before all others.
        weights : of cost terms, instead of their own.
        near : a plan for a target close by to begin with, or its values at the nodes.
        stance : configuration (nq,) in which the robot waits at rest, soles flat in the stance's
            places; it if None.
        starts : instead of the usual list.

        Raises
        ------
        InfeasibleError
            For an impossible platform, and if the robot cannot even stand as it begins.
        SolverError
            If there is no plan; names the terms in conflict.
        """
        explain = EXPLAINED.get()
        chart = None if stance is None else self.body.model.of_pinocchio(stance[None])[0]
        self._check_standing(task, chart)
        asked = Asked(task, chart, srmp, weights, near, begin, self._straight)
        programs = self.programs(task, weights)
        plans = []
        failures = []
        for program in programs:
            program.surface(task)  # refuses
            patient = explain and program is programs[-1]
            usual = self._starts(program, asked, patient) if starts is None else starts
            for start in usual:
                if program.spent(asked):
                    break
                # a mesh that was too coarse for one start is so for the next
                on = program.finer if plans else program
                try:
                    plans.append(self.refined(on, asked, start))
                except (SolverError, InfeasibleError) as e:  # the jump straight ahead may have none
                    failures.append(e)
                    continue
                if plans[-1].used <= 1:
                    break
            best = min(plans, key=lambda x: x.used, default=None)
            if best is not None and best.used <= BROKEN:
                return replace(best, attempts=tuple(asked.attempts))
        if best is None:
            if left_s() <= 0:
                raise _farthest(failures)
            raise (explain and self._explained(programs[-1], asked)) or failures[-1]
        shares = shares_between(best.tape, self.robot, programs[-1].surface(task), self.body)
        shares["distance of links"] = best.used  # the largest where links meet
        name = max(shares, key=shares.get)
        raise SolverError(
            f"{NAME}: motions that keep every limit at the nodes break that of {name} between "
            f"them, at best by a factor of {best.used:.3g}, pressed by {', '.join(best.binding)}; "
            f"ask for less, or for a finer mesh",
            stage=NAME,
            violations=best.binding,
        )

    @in_turn
    def cheapest(self, task: JumpTask, count: int, **options: Any) -> WholeBodyPlan:
        """The plan of least cost from the first ``count`` of :data:`.COMPARED`, each tried to the
        end; its attempts say how they differ. ``options`` and errors as of :meth:`plan`.
        """
        plans = []
        attempts = []
        with unexplained():
            for start in COMPARED[:count]:
                began = time.thread_time()
                try:
                    body = self.plan(task, starts=[start], **options)
                except SolverError as e:
                    took = time.thread_time() - began
                    failed = Attempt(start.name, start.hessian, e.iterations, took, e.status)
                    attempts.append(failed)
                    continue
                plans.append(body)
                *first, last = body.attempts
                name = start.name + f", {last.start}" * bool(first)
                attempts += [*first, replace(last, start=name, **body.manner)]
        if not plans:
            return self.plan(task, **options)
        best = min(plans, key=lambda x: (x.used > 1, x.solution.statistics.objective))
        return replace(best, attempts=tuple(attempts))

    def solved(self, task: JumpTask) -> Solved:
        """The first motion that keeps every limit at the nodes (N + 1,), without a look between
        them; raises as :meth:`plan`.
        """
        self._check_standing(task, None)
        asked = Asked(task, straight=self._straight)
        program = self.program(task)
        *starts, last = self._starts(program, asked, patient=False)
        for start in starts:
            with suppress(SolverError):
                return program.solve(asked, start)
        return program.solve(asked, last)

    def seeking(self, program: Program, sought: tuple[str, ...]) -> Program:
        """The same ``program`` with parameters of the target (of :data:`.SOUGHT`) as unknowns, the
        first one maximised; built once.
        """
        key = program.free.kind, sought
        if key not in self._sought:
            self._sought[key] = replace(program, sought=sought)
        return self._sought[key]

    def _starts(self, program: Program, asked: Asked, patient: bool) -> list[Start]:
        """The list of starts in a program, in their order; the last one only for who is
        ``patient``.
        """
        task = asked.task
        turns = abs(task.yaw_rad) > HELD_TURN_RAD or task.rotation_rad
        aside = self.contacts.ends == "touchdown" and not task.in_plane and not program.free.even
        ramp = aside and not turns and asked.straight is not None
        cold = IN_PLANE if program.free.plane else ASIDE if ramp else COLD
        if self.contacts.ends == "rest":
            cold = ALONG
        near = FROM_NEIGHBOUR if asked.near is not None else ()
        given = GIVEN if asked.motion is not None else ()
        if task.rotation_rad:  # a body that turns over has no places for its feet
            given = [start for start in given if start.name != MENDED]
        starts = [*near, *given, *(cold if patient else cold[:-1])]
        if turns:
            starts.sort(key=lambda x: (x.name != NEIGHBOUR, x.name == STANCE, x.held))
        return starts

    def refined(self, program: Program, asked: Asked, start: Start) -> WholeBodyPlan:
        """The plan of one start, its links apart.

        Where it passes limits between the nodes it is solved on: to the end, then on finer meshes.
        """
        solved = program.solve_apart(asked, start)
        best = WholeBodyPlan.of(program, asked.task, solved, start.name)
        along = self.contacts.ends == "rest" and not program.follows
        # what is followed is settled
        for further in REFINED_ALONG if along else REFINED[program.follows :]:
            settles = further.name == SETTLED.name
            late = not settles and asked.spent_s > program.left_s(asked)
            if best.used <= 1 or (late and best.used > HOPELESS) or program.spent(asked):
                break
            program = program if settles else program.finer
            try:
                solved = program.solve_apart(replace(asked, near=solved), further)
            except SolverError:
                continue
            plan = WholeBodyPlan.of(program, asked.task, solved, start.name)
            best = min(best, plan, key=lambda x: x.used)
        return best

    def _explained(self, program: Program, asked: Asked) -> SolverError | None:
        """Reason for the lack of a plan: the terms in conflict, by a short search."""
        start = replace(COLD[1], patience=EXPLAINING)
        try:
            program.solve(replace(asked, attempts=[]), start, explain=True)
        except SolverError as e:
            held = held_back(program, e)
            return SolverError(f"{e}; held back by {held}", **vars(e)) if held else e
        return None

    def _check_standing(self, task: JumpTask, stance: np.ndarray | None) -> None:
        """Refuse a robot whose motors cannot hold the posture in which it waits; the program itself
        refuses robots that five links describe.
        """
        if self.robot.planar:
            return
        chart = self.body.stance if stance is None else stance
        q = configurations(self.body.model, chart[None])[0]
        check_held(self.robot.under_gravity(task.gravity), q, self.limits.friction)


def _farthest(failures: Sequence[JumplabError]) -> JumplabError:
    """The failure of the longest search, with what its last motion violates most."""
    e = max(failures, key=lambda e: getattr(e, "iterations", 0))
    worst = getattr(e, "violations", ())
    return type(e)(f"{e}; it was still off {worst[0]}", **vars(e)) if worst else e
