"""Jumps that turn over: the same problem with other limits, and a guess whose angles turn (theta_tar of the paper)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from jumplab.errors import SolverError
from jumplab.ocp.nlp import EXPLAINED, Nlp, PhaseGuess, Solution, Statistics
from jumplab.robot import Robot
from jumplab.robot.stance import com_from_toe
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body.planner import COARSE, Asked, WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.problem import build_problem
from jumplab.stages.whole_body.settings import Limits, Mesh, Weights
from jumplab.stages.whole_body.terms import relative
from jumplab.task import JumpTask

EFFORT = {"max_iter": 150}  # a solve that needs more is lost; a count, so that a busy machine plans the same
MONOTONE = {"mu_strategy": "monotone", "mu_init": 0.1}  # the second search, where the adaptive barrier wanders
# Postures of the guess: absolute angles of foot, shank, thigh, trunk, arm [rad], rounded from a solved flip of 0.6 m on
# the spot; six of the flat foot, three of the toe phase, six of the flight. Back: the arms swing up and forward, the
# trunk follows. Front: the trunk leans back first, then whips forward over braked feet.
POSTURES = {
    -1: ([0.0, 0.15, -0.25, 0.32, 0.52], [0.0, -0.06, -0.24, 1.04, 1.77], [0.0, -0.02, -0.38, 1.49, 2.65],
         [0.0, 0.50, -0.88, 1.12, 1.84], [0.0, 0.81, -1.20, 0.81, 0.74], [0.0, 0.77, -1.28, 0.66, -0.47],
         [0.02, 0.72, -1.16, 0.55, -0.95], [0.16, 0.65, -1.0, 0.38, -1.46], [0.47, 0.56, -0.84, 0.15, -2.05],
         [1.45, 0.64, -1.25, -0.48, -3.03], [0.38, -0.49, -2.84, -1.11, -2.28], [-1.04, -1.90, -4.25, -2.25, -2.77],
         [-2.53, -3.22, -5.59, -3.57, -3.55], [-4.62, -4.39, -6.65, -4.86, -4.68], [-6.28, -5.41, -6.81, -5.98, -6.11]),
    1: ([0.0, 0.23, -0.22, -0.08, -0.12], [0.0, 0.25, -0.15, -0.39, -0.53], [0.0, 0.31, -0.09, -0.65, -0.90],
        [0.0, 0.47, -0.12, -0.79, -1.09], [0.0, 0.64, -0.19, -0.86, -1.16], [0.0, 0.87, -0.25, -0.92, -1.25],
        [0.41, 1.31, -0.47, -0.97, -1.34], [0.53, 1.39, -0.38, -1.0, -2.24], [0.40, 0.72, -0.15, -0.47, -2.07],
        [1.07, 0.24, -0.36, 0.86, -0.75], [2.56, 1.69, -0.21, 1.81, 0.92], [4.23, 3.36, 1.02, 3.01, 2.61],
        [5.54, 4.80, 2.45, 4.42, 4.15], [6.26, 6.08, 3.97, 5.64, 5.13], [6.28, 6.53, 5.13, 6.58, 5.51]),
}  # fmt: skip
FLAT_S, TOE_S = 0.9, {-1: 0.1, 1: 0.3}  # how long the phases of the launch last in those solutions
FLAT_SHARES = (0.2, 0.4, 0.6, 0.8, 0.9, 1.0)  # of the flat foot, when its postures are
EASY_M = 0.5  # searches from postures end well up to here
CLIMB_M = 0.04  # from flip to flip on the way up; longer steps get lost
LOW_M = 0.03  # the CoM touches down this much above its take-off height


class FlipPlanner(WholeBodyPlanner):
    """Stage 3 (or, without ``tracking``, the direct planner) for jumps with rotation: built once, solved for any.

    A jump without rotation is another planner's and stays the same problem whatever flips need. Mesh, limits and
    weights are by default those of a flip (``of_flip``).

    A flip has several local solutions. With ``changes``, or with weights of one plan, the solve begins with the
    solution without them: so it keeps to that one as a weight grows, and what two weights lead to can be compared.
    """

    def __init__(
        self,
        robot: Robot,
        mesh: Mesh | None = None,
        limits: Limits | None = None,
        weights: Weights | None = None,
        *,
        tracking: bool = True,
        options: Mapping | None = None,
        changes: StageChanges = StageChanges(),
    ):
        settings = mesh or Mesh().of_flip(), limits or Limits().of_flip(), weights or Weights().of_flip()
        options = {**EFFORT, **(options or {})}
        super().__init__(robot, *settings, tracking=tracking, options=options, refine=False, changes=changes)
        # the first idea of the motion may be rough: its jerks jump as they like
        self.rough, loose = self.mesh.coarse(), replace(self.limits, jerk_step=None)
        rough = changes.applied(
            build_problem(robot, self.rough, loose, self.weights, tracking=tracking), like=self.nlp.problem
        )
        first = Nlp(rough, {**COARSE, **options})
        self._searches = (first, first.with_options({**COARSE, **MONOTONE, **options}))
        self._plain = partial(FlipPlanner, robot, *settings, tracking=tracking, options=options)

    @cached_property
    def _usual(self) -> FlipPlanner | None:
        """The planner without the changes; None if they change nothing."""
        plain = build_problem(self.robot, self.mesh, self.limits, self.weights, tracking=self.tracking)
        return None if self.changes.applied(plain) == plain else self._plain()

    def plan(
        self,
        task: JumpTask,
        srmp: SrmpPlan | None = None,
        *,
        guess: Mapping[str, PhaseGuess] | None = None,
        weights: Mapping[str, float] | None = None,
        off: tuple[str, ...] = (),
        stage1: Callable[[JumpTask], SrmpPlan] | None = None,
    ) -> WholeBodyPlan:
        """Solve for a target: searches on the coarse mesh, then the fine one; a high flip by way of lower ones.

        Parameters
        ----------
        srmp, guess, weights, off : as in the base class.
        stage1 : with tracking, plans stage 1 for the lower flips on the way; without it none are tried.

        Raises
        ------
        SolverError
            After some seconds, if a search ends without a plan; it says at which height, and where the last one found
            no motion at all, which terms the best compromise violates, and by how much.
        """
        usual = self._usual or (self if weights or off else None)
        if usual is not None:
            asked = Asked(task, srmp, self.parameters(task, srmp), weights or {}, off)
            explained = EXPLAINED.set(False)  # without the changes, nobody asked
            try:
                near = usual.plan(task, srmp, guess=guess, stage1=stage1)
                return replace(near, solution=self._run(self._warm.solve, asked, near.solution, explain=False))
            except SolverError:  # perhaps only with the changes there is a solution
                if guess is not None:  # without them the postures would be next, so they are
                    raise
            finally:
                EXPLAINED.reset(explained)
        return self._searched(task, srmp, guess, weights, off, stage1)

    def _searched(self, task: JumpTask, srmp: SrmpPlan | None, guess, weights, off, stage1) -> WholeBodyPlan:
        """The plan as :meth:`plan` makes it from a guess."""
        way = [task] if guess is not None or (self.tracking and stage1 is None) else climb(task)
        plans = [srmp if t is task or not self.tracking else stage1(t) for t in way]
        asked = [Asked(t, one, self.parameters(t, one), weights or {}, off) for t, one in zip(way, plans, strict=True)]
        try:
            searches = self._searches if guess is None else self._searches[:1]
            solution, first = self._search(asked[0], guess or self.naive_guess(way[0]), searches, explain=guess is None)
            for following in asked[1:]:
                solution = self._run(self.nlp.solve, following, solution.guess(), explain=False)
        except SolverError as e:
            where = "" if len(way) == 1 else f", on the way up from a flip of {way[0].height_m:g} m"
            text = f"{e}; every search from a flip's postures ended so{where}"
            text += ": this robot may not do it within its limits" * bool(e.violations)
            raise SolverError(text, stage=e.stage, status=e.status, violations=e.violations) from e
        return WholeBodyPlan(task, solution, first, self.limits)

    def _search(self, asked: Asked, guess, searches, *, explain: bool) -> tuple[Solution, Statistics]:
        """The fine solution from a guess, and what the coarse one before it cost; ``explain`` tells why none is."""
        failure = None
        for search in searches:
            try:
                last = explain and search is searches[-1]
                first = self._run(search.solve, asked, guess, self.rough, explain=last)
                return self._run(self.nlp.solve, asked, self._finer(first), explain=False), first.statistics
            except SolverError as e:
                failure = e
        raise failure

    def _finer(self, first: Solution) -> dict[str, PhaseGuess]:
        """A coarse solution as the fine problem's start, the jerks that its intervals carry on included."""
        out = {}
        for name, guess in first.guess(self.mesh.intervals()).items():
            jerk = np.diff(guess.a, axis=0) * (len(guess.a) - 1) / guess.duration
            before = np.vstack([np.zeros(jerk.shape[1]), jerk])
            links = np.pad(before, ((0, 0), (5 - before.shape[1], 0)))  # a flat foot has none
            out[name] = guess if self.limits.jerk_step is None else replace(guess, z=relative(links.T).T)
        return out

    def naive_guess(self, task: JumpTask) -> dict[str, PhaseGuess]:
        """Start values that know only the target: a smooth curve through postures of a flip, its rates included."""
        from scipy.interpolate import PchipInterpolator  # a third of a second that other jumps need not wait for

        way = 1 if task.rotation_rad > 0 else -1
        knots = np.array([self.stance, *POSTURES[way]])
        shares = np.arange(1, 7) / 6
        knots[-6:] += (shares * (task.rotation_rad - way * 2 * np.pi))[:, None]
        takeoff, land_s = FLAT_S + TOE_S[way], task.flight_time(min(task.platform_m, 0.9 * task.height_m) - LOW_M)
        launch = *(FLAT_S * np.array(FLAT_SHARES)), *(FLAT_S + TOE_S[way] * np.arange(1, 4) / 3)
        curve = PchipInterpolator([0.0, *launch, *(takeoff + land_s * shares)], knots)
        com, down = com_from_toe(self.robot, knots[-7]), com_from_toe(self.robot, knots[-1])
        speed = (task.distance_m - com[0] + down[0]) / land_s
        ballistic = dict(com_x=com[0], com_z=com[1], vel_x=speed, vel_z=task.takeoff_speed)
        out = {}
        for name, t in self.mesh.nodes(FLAT_S, takeoff, takeoff + land_s).items():
            q, v = (curve(t, order)[:, 1 if name == "flat" else 0 :] for order in (0, 1))
            out[name] = PhaseGuess(t[-1] - t[0], q, v, 0 * q, None, ballistic if name == "flight" else {})
        return out


def climb(task: JumpTask) -> list[JumpTask]:
    """The target, preceded by lower ones if it is high: the first is as high as a guess is good for."""
    steps = max(0, math.ceil((task.height_m - EASY_M) / CLIMB_M - 1e-9))
    return [replace(task, height_m=EASY_M + (task.height_m - EASY_M) * k / steps) for k in range(steps)] + [task]
