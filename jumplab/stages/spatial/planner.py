"""Solving the spatial program for a target: cold from a planar plan, or from a neighbour's plan; and the result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, SolverError
from jumplab.io.tape import Tape
from jumplab.ocp.nlp import EXPLAINED, WARM, Nlp
from jumplab.robot import Robot
from jumplab.robot.stance import holding
from jumplab.stages.changes import StageChanges
from jumplab.stages.spatial.generic import generic
from jumplab.stages.spatial.problem import build_problem
from jumplab.stages.spatial.settings import SPATIAL_MESH, TREE_MESH, SpatialLimits, SpatialWeights
from jumplab.stages.spatial.start import from_tape
from jumplab.stages.spatial.tape import holds_between, make_tape
from jumplab.stages.spatial.terms import SpatialTerms
from jumplab.stages.whole_body.planner import BodyPlan
from jumplab.stages.whole_body.settings import Contact, Mesh
from jumplab.task import JumpTask

# beyond, the cost moves by less than one in a million; a solve that needs more time is lost
IPOPT = {"tol": 1e-3, "compl_inf_tol": 1e-4, "max_iter": 250, "max_cpu_time": 40.0}  # [s]
SHORTER = 0.9, 0.7, 0.5  # of way and turn, tried after a refusal ...
QUICK = {"max_iter": 80, "max_cpu_time": 15.0}  # [s] ... with so much patience each
# The exact Hessian is bent the wrong way nearly everywhere; the Gauss-Newton one, held by so much [1] up to a turn
# [deg], leads there in half the time, first from afar, then from a plan close by, for a cost some percent higher; with
# more than that to turn only the exact one settles
HOLDS = (75, 0.1, 1.0), (100, 3.0, 3.0), (300, 10.0, 30.0)
HELD = {"max_iter": 250, "max_cpu_time": 20.0}  # [s]; the exact Hessian has its turn after that
NEAR = WARM | {"acceptable_iter": 1, "mu_strategy": "monotone", "mu_init": 1e-4, "max_iter": 60}
# where a motion passes limits between the nodes, it often is not settled: from there on with smaller steps of the cost
PATIENT = {"acceptable_iter": 8, "acceptable_obj_change_tol": 5e-4, "max_iter": 120, "max_cpu_time": 20.0}  # [s]
FINER = 1.5  # times as many intervals, where a motion passes limits between the nodes
# joints that lie at a stop for many nodes have multipliers that settle last: where all rows are met, and the cost moves
# by less than 0.2 % twice in a row, the motion stands
IPOPT |= {"acceptable_tol": 1e8, "acceptable_dual_inf_tol": 1e10, "acceptable_compl_inf_tol": 1e-2}
IPOPT |= {"acceptable_constr_viol_tol": 5e-5, "acceptable_obj_change_tol": 2e-3, "acceptable_iter": 2}
# the Hessian is bent the wrong way nearly everywhere: what is added to it should be close to what the last step needed
IPOPT |= {"perturb_dec_fact": 0.6, "perturb_inc_fact": 4.0, "min_hessian_perturbation": 0.05}

Begin = tuple[Tape | None, float, bool]  # a tape or none, when its heels rise [s], whether side and yaw are added


@dataclass(frozen=True, repr=False)
class SpatialPlan(BodyPlan):
    """Result of the spatial program."""

    edge_m: float  # where the ground steps up or down, ahead of the toes' first place [m]
    limits: SpatialLimits = SpatialLimits()  # that it was made with


class SpatialPlanner:
    """The spatial program of one robot: built once, solved for any target.

    ``keep`` keeps what was built for later processes; ``changes`` are own terms, weights and switches.
    """

    def __init__(
        self,
        robot: Robot,
        mesh: Mesh | None = None,
        limits: SpatialLimits = SpatialLimits(),
        weights: SpatialWeights = SpatialWeights(),
        *,
        options: Mapping | None = None,
        keep: bool = False,
        changes: StageChanges = StageChanges(),
    ):
        self.robot, self.mesh = robot, mesh or (SPATIAL_MESH if robot.planar else TREE_MESH)
        self.limits, self.weights, self.changes, self._keep = limits, weights, changes, keep
        self._taped: tuple[SpatialPlan, Tape] | None = None
        self._stood: dict[tuple, tuple[float, str, float] | None] = {}
        self.terms = {c.value: SpatialTerms(robot, limits, weights, c) for c in Contact}
        self._options = options = dict(options or {})
        problem = changes.applied(build_problem(robot, self.mesh, limits, weights))
        key = f"{robot.hash} {limits} {weights}" if keep else None
        self.nlp = Nlp(problem, {**IPOPT, **options}, key)
        self._warm = self.nlp.with_options({**IPOPT, **WARM, "acceptable_iter": 1, **options})
        self._quick = self.nlp.with_options({**IPOPT, **QUICK, **options})
        self._patient = self.nlp.with_options({**IPOPT, **WARM, **PATIENT, **options})
        holds = HOLDS if robot.planar else ()  # of others, what it leads to passes limits between the nodes
        self._held = {deg: self.nlp.with_options({**IPOPT, **HELD, **options}, hold) for deg, hold, _ in holds}
        self._near = {deg: self.nlp.with_options({**IPOPT, **NEAR, **options}, hold) for deg, _, hold in holds}

    def plan(
        self,
        task: JumpTask,
        start: Tape | None = None,
        toe_phase_s: float = 0.0,
        *,
        ramps: bool = True,
        weights: Mapping[str, float] | None = None,
        near: SpatialPlan | None = None,
        stance: np.ndarray | None = None,
    ) -> SpatialPlan:
        """Solve for a target; where the motion passes limits between the nodes, on to the end, then on a finer mesh.

        Parameters
        ----------
        start : tape of the same rise whose heels rise at ``toe_phase_s`` [s]; a generic jump if None.
        ramps : the tape is one straight ahead; side and yaw are added to its flight.
        weights : of cost terms, instead of their own.
        near : this planner's plan for a target close by, to begin with.
        stance : configuration (nq,) in which the robot waits at rest, soles flat in the stance's places; it if None.

        Raises
        ------
        SolverError
            If there is no plan; names the terms in conflict, and the nearest of a few smaller targets that has one.
            Where nobody reads explanations (:data:`jumplab.ocp.nlp.EXPLAINED`), it gives up sooner.
        """
        how = {"weights": self.changes.spread(self.nlp.problem, weights or {}), "stance": stance}
        found = first = self._planned(task, (start, toe_phase_s, ramps), how, near)
        for again in (lambda: (self, self._patient), lambda: (self._finer, self._finer._warm)):
            if holds_between(self.tape(found), self.robot):
                return found
            planner, nlp = again()
            with suppress(SolverError):
                found = planner._solved(nlp, task, found, how)
        return found if holds_between(self.tape(found), self.robot) else first

    @cached_property
    def _finer(self) -> SpatialPlanner:
        """The same program on half as many nodes again."""
        mesh = Mesh(*(math.ceil(FINER * n) for n in self.mesh.intervals().values()))
        options = {"options": self._options, "keep": self._keep, "changes": self.changes}
        return SpatialPlanner(self.robot, mesh, self.limits, self.weights, **options)

    def _planned(self, task: JumpTask, begin: Begin, how: dict, near: SpatialPlan | None) -> SpatialPlan:
        turn = next((t for t in self._held if abs(np.degrees(task.yaw_rad)) <= t and not task.rotation_rad), None)
        if near is not None:
            if turn is not None:
                with suppress(SolverError):
                    return self._solved(self._near[turn], task, near, how)
            try:
                return self._solved(self._warm, task, near, how)
            except SolverError:
                if begin[0] is None:
                    raise
        if turn is not None:
            with suppress(SolverError):
                return self._solved(self._held[turn], task, begin, how)
        if not EXPLAINED.get():
            return self._solved(self._quick, task, begin, how)
        try:
            return self._solved(self.nlp, task, begin, how | {"explain": True})
        except SolverError as e:
            less = self._smaller(task, begin, how)
            if less is not None and not e.violations:  # there is a motion: perhaps from here
                try:
                    return self._solved(self._warm, task, less, how)
                except SolverError:
                    pass
            words = "" if less is None else f"; at this height, {said(less.task)} is planned"
            raise SolverError(f"{e}{words}", stage=e.stage, status=e.status, violations=e.violations) from e

    def _solved(self, nlp: Nlp, task: JumpTask, begin: SpatialPlan | Begin, how: dict) -> SpatialPlan:
        """A plan that begins with another one, or with a tape, when its heels rise, and whether it needs ramps."""
        asked, how = self.parameters(task, how["stance"]), {"explain": False} | how
        del how["stance"]
        if isinstance(begin, SpatialPlan):
            guess, how = begin.solution.guess(self.mesh.intervals()), how | {"multipliers": begin.solution.multipliers}
        else:
            tape, toe_phase_s, ramps = begin
            if tape is None:
                tape = generic(self.terms["flat"], task)
                toe_phase_s = float(tape.extra["toe_phase_start"])
            guess = from_tape(self.terms, tape, toe_phase_s, self.mesh, task, ramps)
        edge = self._edge(task)[0] - self.robot.foot.toe + float(self.robot.foot.center[0])
        return SpatialPlan(task, nlp.solve(asked, guess, **how), edge, self.limits)

    def _smaller(self, task: JumpTask, begin: Begin, how: dict) -> SpatialPlan | None:
        """The plan of the largest of a few targets with less way and less turn."""
        for share in SHORTER:
            less = {name: round(share * getattr(task, name), 3) for name in ("distance_m", "side_m", "yaw_rad")}
            try:
                return self._solved(self._quick, replace(task, **less), begin, how)
            except (InfeasibleError, SolverError):
                continue
        return None

    def tape(self, plan: SpatialPlan) -> Tape:
        """The 1 kHz tape of a plan; that of the last one is kept."""
        if self._taped is None or self._taped[0] is not plan:
            self._taped = plan, make_tape(self.terms, plan.solution.phases, plan.task.gravity)
        return self._taped[1]

    def parameters(self, task: JumpTask, stance: np.ndarray | None = None) -> dict[str, Any]:
        """Parameter values of the problem for a target.

        Raises :class:`InfeasibleError` for an impossible platform, and if the robot cannot even stand as it begins.
        """
        flat = self.terms["flat"]
        start = flat.stance if stance is None else flat.model.of_pinocchio(stance[None])[0]
        if not self.robot.planar:  # of others stage 1's closed forms tell
            self._check_standing(start, task.gravity)
        values = dict(stance=start, distance=task.distance_m, side=task.side_m, yaw=task.yaw_rad)
        values |= dict(platform=task.platform_m, takeoff_speed=task.takeoff_speed, rotation=task.rotation_rad)
        if not self.robot.planar:
            values["straight"] = float(task.in_plane)
        ways = np.cos(task.along_rad), np.sin(task.along_rad)
        edge, room = self._edge(task)
        # for clearance, also between the nodes, a platform counts as reaching further
        edge -= np.sign(task.platform_m) * min(self.limits.edge_step_m, room)
        return values | dict(edge=edge, along=ways, gravity=task.gravity)

    def _check_standing(self, start: np.ndarray, gravity: float) -> None:
        """Refuse a robot whose motors cannot hold the posture in which it waits."""
        if (key := (gravity, start.tobytes())) not in self._stood:
            q = self.terms["flat"].model.to_pinocchio(start[None], *np.zeros((2, 1, len(start))))[0][0]
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
        soles = self.robot.foot.corners - self.robot.foot.center
        corners = (self.terms["flat"].places[:, None] + soles).reshape(-1, 3)[:, :2]
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


def said(task: JumpTask) -> str:
    """Way and turn of a target in words."""
    turn = f"{np.degrees(task.yaw_rad):.3g} deg"
    return f"{task.distance_m:g} m ahead and {task.side_m:g} m to the left with a turn of {turn}"
