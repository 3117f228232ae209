"""Jumps that turn over: the same problem with other limits, and a guess whose angles turn (theta_tar of the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import com_from_toe
from jumplab.solver import Nlp, PhaseGuess, Solution
from jumplab.srmp import SrmpPlan
from jumplab.task import JumpTask
from jumplab.whole_body.planner import COARSE, WARM, WholeBodyPlan, WholeBodyPlanner
from jumplab.whole_body.problem import build_problem
from jumplab.whole_body.settings import Limits, Mesh, Weights

# our choice: a solve that needs more is lost; solutions took 46 to 109 iterations on the coarse mesh
EFFORT = {"max_iter": 130, "max_wall_time": 30.0}
# our choice: the second search; where the adaptive barrier wanders, the monotone one finds nearly all of the rest
MONOTONE = {"mu_strategy": "monotone", "mu_init": 0.1}
# Postures of the guess, our choice: absolute angles of foot, shank, thigh, trunk, arm [rad], rounded from a solved flip
# of 0.5 m; the last three of one turn. Back: the arms swing up and forward, the trunk follows. Front: the trunk whips
# forward from behind, the arms go ahead of it.
POSTURES = {
    -1: ([0.0, 0.2, -0.3, 0.75, 1.6], [0.0, 0.7, -1.3, 0.7, -0.8], [0.45, 0.6, -0.95, 0.15, -2.3],
         [0.6, -0.3, -2.6, -1.1, -2.8], [-3.3, -3.6, -5.95, -3.95, -4.0], [-6.28, -5.36, -6.74, -5.98, -6.28]),
    1: ([0.0, 0.25, -0.05, -0.5, 0.3], [0.0, 0.9, -0.15, -0.8, -1.4], [0.15, 0.55, 0.0, -0.4, -1.7],
        [2.8, 2.0, -0.1, 1.9, 1.7], [5.55, 4.95, 2.75, 4.75, 4.35], [6.28, 6.38, 4.98, 6.58, 4.68]),
}  # fmt: skip
LAUNCH_S = (0.5, 0.8, 0.9)  # our choice: when crouch, end of the flat foot, and take-off are
FLIGHT_SHARES = (0.33, 0.7, 1.0)  # our choice: of the flight, when the last three postures are
LOW_M = 0.03  # our choice: the CoM touches down this much above its take-off height


class FlipPlanner(WholeBodyPlanner):
    """Stage 3 (or, without ``tracking``, the direct planner) for jumps with rotation: built once, solved for any.

    A jump without rotation is another planner's and stays the same problem whatever flips need.
    """

    def __init__(self, robot: Robot, mesh: Mesh = Mesh(), limits: Limits = Limits(), weights: Weights = Weights(), *,
                 tracking: bool = True, options: Mapping | None = None):  # fmt: skip
        options = {**EFFORT, **(options or {})}
        super().__init__(robot, mesh.of_flip(), limits.of_flip(), weights.of_flip(), tracking=tracking,
                         options=options, refine=False)  # fmt: skip
        # the first idea of the motion may be rough: jerks as they like, and as few nodes as a jump's
        self.rough, self._jerk = replace(mesh.coarse(), toe=mesh.toe), weights.jerk
        rough = build_problem(robot, self.rough, replace(self.limits, jerk=None), weights, tracking=tracking)
        first = Nlp(rough, {**COARSE, **options})
        self._searches = (first, first.with_options({**COARSE, **MONOTONE, **options}))
        self._warm = self.nlp.with_options({**WARM, **options})

    def plan(self, task: JumpTask, srmp: SrmpPlan | None = None, *, guess: Mapping[str, PhaseGuess] | None = None,
             weights: Mapping[str, float] | None = None, off: tuple[str, ...] = ()) -> WholeBodyPlan:  # fmt: skip
        """Solve for a target; as in the base class, but with two searches on the coarse mesh, and no cold fine one.

        Raises
        ------
        SolverError
            After some seconds, if every search ends without a plan.
        """
        guess, parameters, failure = guess or self.naive_guess(task), self.parameters(task, srmp), None
        start = {name: guess[name].resampled(n) for name, n in self.rough.intervals().items()}
        references = self.references(srmp, self.rough), self.references(srmp, self.mesh)
        for search in self._searches:
            try:
                first = search.solve(parameters, start, references=references[0], weights=weights, off=off,
                                     explain=False)  # fmt: skip
            except SolverError as e:
                failure = failure or e
                continue
            try:
                return WholeBodyPlan(
                    task, self._finish(parameters, first, references[1], weights, off), first.statistics
                )
            except SolverError as e:
                failure = failure or e
        raise SolverError(
            f"{failure}; two searches from a flip's postures ended so: this robot may not do it within its limits, "
            f"ask for another height or distance",
            stage=failure.stage, status=failure.status,
        )  # fmt: skip

    def _finish(self, parameters, first: Solution, references, weights, off) -> Solution:
        """The fine mesh: within the box on jerks or, where the search for that does not end, without it.

        What jumps of the torques that leaves is for the audit to find.
        """

        def fine(solver: Nlp, start: Solution, free: bool) -> Solution:
            guess = {name: start.phases[name].guess(n) for name, n in self.mesh.intervals().items()}
            w, without = ({"jerk": self._jerk}, ("jerk box",)) if free else ({}, ())
            return solver.solve(parameters, guess, references=references, weights={**w, **(weights or {})},
                                off=(*without, *off), explain=False)  # fmt: skip

        try:
            return fine(self.nlp, first, False)
        except SolverError:
            return fine(self._warm, first, True)

    def naive_guess(self, task: JumpTask) -> dict[str, PhaseGuess]:
        """Start values that know only the target: a smooth curve through postures of a flip, its rates included."""
        from scipy.interpolate import PchipInterpolator  # a third of a second that other jumps need not wait for

        way = 1 if task.rotation_rad > 0 else -1
        knots = np.array([self.stance, *POSTURES[way]])
        knots[-1] += task.rotation_rad - way * 2 * np.pi
        knots[-2] += (task.rotation_rad - way * 2 * np.pi) * FLIGHT_SHARES[1]
        takeoff, land_s = LAUNCH_S[-1], task.flight_time(min(task.platform_m, 0.9 * task.height_m) - LOW_M)
        times = [0.0, *LAUNCH_S, *(takeoff + share * land_s for share in FLIGHT_SHARES)]
        curve, n = PchipInterpolator(times, knots), self.mesh
        com, down = com_from_toe(self.robot, knots[3]), com_from_toe(self.robot, knots[-1])
        speed = (task.distance_m - com[0] + down[0]) / land_s
        constants = dict(com_x=com[0], com_z=com[1], vel_x=speed, vel_z=task.takeoff_speed)
        out = {}
        for name, first, last, count in (("flat", 0.0, LAUNCH_S[1], n.flat), ("toe", LAUNCH_S[1], takeoff, n.toe),
                                         ("flight", takeoff, takeoff + land_s, n.flight)):  # fmt: skip
            t = np.linspace(first, last, count + 1)
            q, v = (curve(t, order)[:, 1 if name == "flat" else 0 :] for order in (0, 1))
            out[name] = PhaseGuess(last - first, q, v, 0 * q, None, constants if name == "flight" else {})
        return out
