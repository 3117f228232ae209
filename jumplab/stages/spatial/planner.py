"""Solving the spatial program for a target: cold from a planar plan, or from a neighbour's plan; and the result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, SolverError
from jumplab.io.tape import Tape
from jumplab.ocp.nlp import WARM, Nlp, Solution
from jumplab.robot import Robot
from jumplab.shown import Shown
from jumplab.stages.changes import StageChanges
from jumplab.stages.spatial.problem import build_problem
from jumplab.stages.spatial.settings import SPATIAL_MESH, SpatialLimits, SpatialWeights
from jumplab.stages.spatial.start import from_tape
from jumplab.stages.spatial.tape import make_tape
from jumplab.stages.spatial.terms import SpatialTerms
from jumplab.stages.whole_body.settings import Contact, Mesh
from jumplab.task import JumpTask

# beyond, the cost moves by less than one in a million; a solve that needs more time is lost
IPOPT = {"tol": 1e-3, "compl_inf_tol": 1e-4, "max_cpu_time": 60.0, "max_wall_time": 600.0}  # [s]
# joints that lie at a stop for many nodes have multipliers that settle last: where all rows are met, and the cost moves
# by less than 0.2 % twice in a row, the motion stands
IPOPT |= {"acceptable_tol": 1e8, "acceptable_dual_inf_tol": 1e10, "acceptable_compl_inf_tol": 1e-2}
IPOPT |= {"acceptable_constr_viol_tol": 5e-5, "acceptable_obj_change_tol": 2e-3, "acceptable_iter": 2}


@dataclass(frozen=True, repr=False)
class SpatialPlan(Shown):
    """Result of the spatial program."""

    task: JumpTask
    solution: Solution  # on the planner's mesh; its phases are "flat", "toe" and "flight"
    edge_m: float  # where the ground steps up or down, ahead of the toes' first place [m]
    limits: SpatialLimits = SpatialLimits()  # that it was made with

    @property
    def launch_s(self) -> float:
        """Duration of the launch [s]."""
        return self.solution.phases["flat"].duration + self.solution.phases["toe"].duration

    @property
    def flight_s(self) -> float:
        """Duration of the flight [s]."""
        return self.solution.phases["flight"].duration


class SpatialPlanner:
    """The spatial program of one robot: built once, solved for any target.

    ``keep`` keeps what was built for later processes; ``changes`` are own terms, weights and switches.
    """

    def __init__(
        self,
        robot: Robot,
        mesh: Mesh = SPATIAL_MESH,
        limits: SpatialLimits = SpatialLimits(),
        weights: SpatialWeights = SpatialWeights(),
        *,
        options: Mapping | None = None,
        keep: bool = False,
        changes: StageChanges = StageChanges(),
    ):
        self.robot, self.mesh, self.limits, self.weights, self.changes = robot, mesh, limits, weights, changes
        self.terms = {c.value: SpatialTerms(robot, limits, weights, c) for c in Contact}
        options = dict(options or {})
        problem = changes.applied(build_problem(robot, mesh, limits, weights))
        key = f"{robot.hash} {limits} {weights}" if keep else None
        self.nlp = Nlp(problem, {**IPOPT, **options}, key)
        self._warm = self.nlp.with_options({**IPOPT, **WARM, **options})

    def plan(
        self,
        task: JumpTask,
        start: Tape | None = None,
        toe_phase_s: float = 0.0,
        *,
        weights: Mapping[str, float] | None = None,
        near: SpatialPlan | None = None,
    ) -> SpatialPlan:
        """Solve for a target.

        Parameters
        ----------
        start : planar tape of the same rise whose heels rise at ``toe_phase_s`` [s].
        weights : of cost terms, instead of their own.
        near : this planner's plan for a target close by, to begin with.

        Raises
        ------
        SolverError
            If there is no plan; names the terms in conflict.
        """
        asked = self.parameters(task)
        how = {"weights": self.changes.spread(self.nlp.problem, weights or {})}
        edge = float(asked["edge"] - self.robot.foot.toe + self.robot.foot.center[0])
        if near is not None:
            try:
                found = self._warm.solve(
                    asked, near.solution.guess(), multipliers=near.solution.multipliers, explain=False, **how
                )
                return SpatialPlan(task, found, edge, self.limits)
            except SolverError:
                if start is None:
                    raise
        guess = from_tape(self.terms, start, toe_phase_s, self.mesh, task)
        return SpatialPlan(task, self.nlp.solve(asked, guess, **how), edge, self.limits)

    def tape(self, plan: SpatialPlan) -> Tape:
        """The 1 kHz tape of a plan."""
        return make_tape(self.terms, plan.solution.phases, plan.task.gravity)

    def parameters(self, task: JumpTask) -> dict[str, Any]:
        """Parameter values of the problem for a target; raises :class:`InfeasibleError` for an impossible platform."""
        flat = self.terms["flat"]
        values = dict(stance=flat.stance, distance=task.distance_m, side=task.side_m, yaw=task.yaw_rad)
        values |= dict(platform=task.platform_m, takeoff_speed=task.takeoff_speed, rotation=task.rotation_rad)
        return values | dict(edge=self._edge(task), gravity=task.gravity)

    def _edge(self, task: JumpTask) -> float:
        """Where the ground steps up or down [m], from the world's origin."""
        c, s = np.cos(task.yaw_rad), np.sin(task.yaw_rad)
        soles = self.robot.foot.corners - self.robot.foot.center
        corners = (self.terms["flat"].places[:, None] + soles).reshape(-1, 3)
        landed = task.distance_m + corners[:, 0] * c - corners[:, 1] * s
        room, first = self.limits.edge_before_heel_m, float(corners[:, 0].max())
        up, down = float(landed.min()) - room, first + room
        edge = down if task.platform_m < 0 else up
        apart = up - first if task.platform_m > 0 else float(landed.min()) - down
        if task.platform_m and apart < 0:
            raise InfeasibleError(
                f"platform = {task.platform_m:g} m at a distance of {task.distance_m:g} m: the two surfaces would meet "
                f"under a sole of {self.robot.name}; that takes a distance of at least {task.distance_m - apart:.2f} m",
                number="distance_m",
                bound=task.distance_m - apart,
            )
        return edge
