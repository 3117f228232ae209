"""Solving stage 3 for a target: guesses, references, the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, Shown, SolverError
from jumplab.ocp.nlp import WARM, Near, Nlp, PhaseGuess, Solution, Statistics
from jumplab.robot import Robot
from jumplab.robot.stance import stance_angles
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body.problem import build_problem
from jumplab.stages.whole_body.settings import FOLLOWED_JERK_STEP, Limits, Mesh, Weights
from jumplab.stages.whole_body.terms import relative
from jumplab.task import JumpTask

TOE_PHASE_S = 0.12  # heel-up time of the naive guess
# naive guess: knee, trunk, heel-up, arm [rad]
POSTURES = {
    "crouch": (1.6, 0.65, 0.0, 0.5),
    "take-off": (0.4, 0.25, 0.35, -1.0),
    "tuck": (1.4, 0.3, 0.0, -0.2),
    "touchdown": (0.9, 0.15, 0.0, 0.2),
}
FINE = {"tol": 1e-4, "compl_inf_tol": 1e-5}  # beyond, the cost moves by less than one in a million
# the coarse solution is only a start, digits beyond these would be lost on the finer mesh
COARSE = {"tol": 1e-2, "dual_inf_tol": 1e-1, "constr_viol_tol": 5e-5, "acceptable_tol": 1e-1, "acceptable_iter": 3}
# shares of a phase over which angles and rates of a guess are averaged before the coarse mesh: a roll-out's rates jump
GUESS_WIDTHS = (0.05, 0.2)
# stage 2's motion is near enough for small multipliers; a naive guess is not
NEAR = {"bound_mult_init_method": "mu-based", "mu_init": 0.1}
# what the coarse mesh leads to is a good start on the fine one but for its multipliers
REFINED = {"bound_mult_init_method": "mu-based", "mu_init": 1e-2, "max_iter": 70}
REFINED |= {"quality_function_max_section_steps": 3}  # a rough choice of the next barrier will do
BRIEF = {"max_cpu_time": 3.0}  # [s] for a target that most likely has no plan; what was found there took one
EVENING = (2.0, 4.0, 8.0)  # factors of the jerk's weight, in turn, where it jumps farther than a tape can follow


@dataclass(frozen=True)
class Asked:
    """What every solve of one target is asked for, whatever its mesh and its start."""

    task: JumpTask
    srmp: SrmpPlan | None  # stage 1's plan to follow, with tracking
    parameters: Mapping[str, Any]
    weights: Mapping[str, float] = field(default_factory=dict)  # instead of the terms' own
    off: tuple[str, ...] = ()  # terms left out
    brief: bool = False  # whether to give up soon, unexplained


@dataclass(frozen=True, repr=False)
class BodyPlan(Shown):
    """A jump of the whole body, in the plane or out of it."""

    task: JumpTask
    solution: Solution  # on the planner's mesh; its phases are "flat", "toe" and "flight"

    @property
    def launch_s(self) -> float:
        """Duration of the launch [s]."""
        return self.solution.phases["flat"].duration + self.solution.phases["toe"].duration

    @property
    def flight_s(self) -> float:
        """Duration of the flight [s]."""
        return self.solution.phases["flight"].duration


@dataclass(frozen=True, repr=False)
class WholeBodyPlan(BodyPlan):
    """Result of stage 3 or of the direct planner."""

    coarse: Statistics | None = None  # of the coarse mesh before it; None if there was none, or it found nothing
    limits: Limits = Limits()  # that it was made with
    # of the solves before it whose jerk jumped farther than a tape can follow; after each, the jerk's weight was raised
    uneven: tuple[Statistics, ...] = ()

    @property
    def jerk_step(self) -> float:
        """Largest jump of the jerk of a joint or of the trunk from one interval to the next [rad/s^3]."""
        jerks = [np.pad(x.j, ((0, 0), (5 - x.j.shape[1], 0))) for x in self.solution.phases.values()]  # flat feet: none
        return float(np.abs(np.diff(relative(np.vstack(jerks).T))).max())


def platform_edge_m(task: JumpTask, robot: Robot, limits: Limits = Limits()) -> float:
    """Where the ground steps up or down, ahead of the toe's first place [m].

    A platform begins a little before the landing heel; when the robot jumps down, the launching surface ends a little
    ahead of its toe.
    """
    if task.platform_m < 0:
        return limits.edge_before_heel_m
    return task.distance_m + robot.sagittal.heel[0] - limits.edge_before_heel_m


def check_platform(task: JumpTask, robot: Robot, limits: Limits = Limits()) -> None:
    """Refuse a step up or down that the launching or the landing sole would stand across (:class:`InfeasibleError`)."""
    if task.platform_m == 0:
        return
    least = 2 * limits.edge_before_heel_m - robot.sagittal.heel[0]
    if task.distance_m < least:
        raise InfeasibleError(
            f"platform = {task.platform_m:g} m at a distance of {task.distance_m:g} m: the two surfaces would meet "
            f"under a sole of {robot.name}; that takes a distance of at least {least:.2f} m (backward jumps only on "
            f"the level)",
            number="distance_m",
            bound=least,
        )


class WholeBodyPlanner:
    """Stage 3 for one robot (or, without ``tracking``, the direct planner): built once, solved for any target.

    With ``refine`` a target is solved on a coarse mesh first and refined from there, without it on ``mesh`` at once.
    With ``approach`` the coarse mesh only takes the few steps of ``Nlp.gauss_newton_steps``; where they lead
    nowhere, and without it, ipopt solves it. ``keep`` keeps what was built for later processes. ``changes`` are own
    terms, other weights, and terms left out.
    """

    def __init__(
        self,
        robot: Robot,
        mesh: Mesh = Mesh(),
        limits: Limits = Limits(),
        weights: Weights = Weights(),
        *,
        tracking: bool = True,
        options: Mapping | None = None,
        refine: bool = True,
        approach: bool = True,
        keep: bool = False,
        changes: StageChanges = StageChanges(),
    ):
        self.robot, self.mesh, self.limits, self.weights, self.tracking = robot, mesh, limits, weights, tracking
        self.stance, self._steps, self._coarse, self.changes = stance_angles(robot), approach, None, changes
        options = dict(options or {})
        problem = changes.applied(build_problem(robot, mesh, limits, weights, tracking=tracking))
        key = f"{robot.hash} {limits} {weights} {tracking}" if keep else None
        self.nlp = Nlp(problem, {**FINE, **options}, key)
        if refine:
            coarse = {**COARSE, **(NEAR if tracking else {}), **options}
            self._coarse = Nlp(problem.on_mesh(mesh.coarse().intervals()), coarse, key, self.nlp)
            self._refined = self.nlp.with_options({**FINE, **REFINED, **options})
        self._warm = self.nlp.with_options({**FINE, **WARM, **options})
        self._brief = self.nlp.with_options({**FINE, **REFINED, **BRIEF, **options})

    def plan(
        self,
        task: JumpTask,
        srmp: SrmpPlan | None = None,
        *,
        guess: Mapping[str, PhaseGuess] | None = None,
        weights: Mapping[str, float] | None = None,
        off: tuple[str, ...] = (),
        near: WholeBodyPlan | None = None,
        start: np.ndarray | None = None,
        settle: bool = True,
        brief: bool = False,
    ) -> WholeBodyPlan:
        """Solve for a target; with tracking, ``srmp`` is stage 1's plan for it.

        Parameters
        ----------
        guess : start values on any mesh; those of :meth:`naive_guess` if None.
        weights, off : as in :meth:`jumplab.ocp.nlp.Nlp.solve`.
        near : this planner's plan for a target close by, to begin with instead of ``guess``; if that leads nowhere, the
            target is solved from ``guess`` all the same.
        start : absolute link angles (5,) in which the robot waits at rest, soles flat; the stance if None.
        settle : take a few steps from ``near`` if it is close enough, see :meth:`jumplab.ocp.nlp.Nlp.settled`; the
            least cost is found without.
        brief : give up soon, and explain nothing: for a target that most likely has no plan.

        Raises
        ------
        SolverError
            If there is no plan; names the terms in conflict.
        """
        asked = Asked(task, srmp, self.parameters(task, srmp, start), weights or {}, off, brief)
        return replace(self._evened(self._begun(asked, guess, near, settle), asked), limits=self.limits)

    def _run(self, solve: Callable, asked: Asked, start, mesh: Mesh | None = None, **how) -> Solution | Near:
        """Call an NLP's ``solve`` or ``approach`` with start values, or with a solution on any mesh.

        ``mesh`` is that of the NLP, by default the planner's; ``how`` are further arguments. All solves pass here.
        """
        mesh = mesh or self.mesh
        if isinstance(start, Solution | Near):
            how |= {"multipliers": start.multipliers} if isinstance(start, Solution) else {}
            guess = start.guess(mesh.intervals())
        else:
            guess = {name: start[name].resampled(n) for name, n in mesh.intervals().items()}
        weights = self.changes.spread(self.nlp.problem, asked.weights)
        how |= {"references": self.references(asked.srmp, mesh), "weights": weights, "off": asked.off}
        return solve(asked.parameters, guess, **how)

    def _evened(self, found: WholeBodyPlan, asked: Asked) -> WholeBodyPlan:
        """The plan, with a dearer jerk if it jumps too far. Whoever sets the jerk's weight or drops it is obeyed."""
        if self._jerk_set(asked):
            return found
        for factor in EVENING:
            if found.jerk_step <= FOLLOWED_JERK_STEP:
                break
            dearer = replace(asked, weights={**asked.weights, "jerk": factor * self.weights.jerk})
            try:
                even = self._run(self._warm.solve, dearer, found.solution, explain=False)
            except SolverError:
                break  # the audit says what is wrong with the tape
            found = replace(found, solution=even, uneven=(*found.uneven, found.solution.statistics))
        return found

    def _begun(self, asked: Asked, guess, near: WholeBodyPlan | None, settle: bool) -> WholeBodyPlan:
        """The solution: from the plan for a target close by, from the coarse mesh, or from the guess itself.

        Direct plans for targets farther away begin with the coarse mesh: it takes less time, and costs no more.
        """
        close = near is not None and asked.task.is_near(near.task)
        ways: list[Callable[[], WholeBodyPlan]] = []

        def fresh() -> Mapping[str, PhaseGuess]:
            return guess or self.naive_guess(asked.task)

        if close and settle:
            ways.append(lambda: self._beside(asked, near.solution))
        if near is not None:
            ways.append(
                lambda: WholeBodyPlan(asked.task, self._run(self._warm.solve, asked, near.solution, explain=False))
            )
        if self._coarse is not None:
            ways.insert(len(ways) if close or self.tracking else 0, lambda: self._refine(asked, fresh()))
        for way in ways:
            with suppress(SolverError):
                return way()
        if asked.brief and ways:
            raise SolverError(f"{self.nlp.problem.name}: no plan was found soon", stage=self.nlp.problem.name)
        return WholeBodyPlan(
            asked.task, self._run(self.nlp.solve, asked, fresh())
        )  # the last word, and the explanation

    def settled(
        self,
        task: JumpTask,
        near: Mapping[str, PhaseGuess],
        *,
        jerk: float | None = None,
        start: np.ndarray | None = None,
    ) -> WholeBodyPlan:
        """The direct plan for a target, a few steps from the motion ``near`` of one close by; without tracking only.

        ``jerk`` is that one's weight of the jerk if the tape asked for a dearer one; ``start`` as in :meth:`plan`.
        Raises :class:`SolverError` if the target is not that close.
        """
        asked = Asked(task, None, self.parameters(task, None, start))
        found = self._settled(asked, near, {} if jerk is None or self._jerk_set(asked) else {"jerk": jerk})
        return replace(self._evened(found, asked), limits=self.limits)

    def _settled(self, asked: Asked, near: Mapping[str, PhaseGuess], weights: Mapping[str, float]) -> WholeBodyPlan:
        how = {"references": self.references(asked.srmp, self.mesh), "off": asked.off}
        how["weights"] = self.changes.spread(self.nlp.problem, {**asked.weights, **weights})
        return WholeBodyPlan(asked.task, self.nlp.settled(asked.parameters, near, **how))

    def _beside(self, asked: Asked, near: Solution) -> WholeBodyPlan:
        """A plan a few steps from one for a target close by, whose jerk may have been made dearer for the tape."""
        jerk, weights = {row["weight"] for row in near.cost_shares if row["name"] == "jerk"}, {}
        if not self._jerk_set(asked) and jerk & {factor * self.weights.jerk for factor in EVENING}:
            weights["jerk"] = jerk.pop()
        if not self.nlp.weighs_as(near, self.changes.spread(self.nlp.problem, {**asked.weights, **weights})):
            raise SolverError(f"{self.nlp.problem.name}: the plan to begin with has other weights", stage="whole body")
        return self._settled(asked, near.guess(), weights)

    def _jerk_set(self, asked: Asked) -> bool:
        """Whether somebody set the jerk's weight by hand, or dropped it."""
        set_by_hand = *asked.weights, *asked.off, *self.changes.weights, *self.changes.off
        return any(name.rpartition("/")[2] == "jerk" for name in set_by_hand)

    def _refine(self, asked: Asked, guess) -> WholeBodyPlan:
        """The solution from a few steps on the coarse mesh, or where they lead nowhere, from ipopt's solution there."""
        mesh = self.mesh.coarse()
        if self.tracking:
            guess = {name: phase.smoothed(*GUESS_WIDTHS) for name, phase in guess.items()}

        def refined(first):
            nlp = self._brief if asked.brief else self._refined
            solution = self._run(nlp.solve, asked, first, explain=False)
            return WholeBodyPlan(asked.task, solution, first.statistics)

        if self._steps:
            try:
                return refined(self._run(self._coarse.gauss_newton_steps, asked, guess, mesh))
            except SolverError:
                if asked.brief:
                    raise
                # too far away for linear rows; what stays inside all limits finds more, and takes longer
        return refined(self._run(self._coarse.solve, asked, guess, mesh, explain=False))

    def parameters(self, task: JumpTask, srmp: SrmpPlan | None = None, start: np.ndarray | None = None) -> dict:
        """Parameter values of the problem for a target and a ``start`` (see :meth:`plan`).

        Raises :class:`InfeasibleError` for an impossible platform.
        """
        check_platform(task, self.robot, self.limits)
        edge = platform_edge_m(task, self.robot, self.limits) - np.sign(task.platform_m) * self.limits.edge_step_m
        stance = self.stance if start is None else start
        values = dict(stance=stance, distance=task.distance_m, platform=task.platform_m, edge=edge)
        values |= dict(takeoff_speed=task.takeoff_speed, rotation=task.rotation_rad, gravity=task.gravity)
        if self.tracking:
            values |= dict(momentum=srmp.launch.L[-1], launch_s=[srmp.launch_s - srmp.toe_s, srmp.toe_s])
        return values

    def references(self, srmp: SrmpPlan | None, mesh: Mesh) -> dict[str, dict[str, np.ndarray]] | None:
        """Stage 1's trajectories at a mesh's nodes, by share of each phase; None if they are not tracked."""
        if not self.tracking:
            return None
        launch, nodes = srmp.launch, mesh.nodes(srmp.launch_s - srmp.toe_s, srmp.launch_s, srmp.launch_s)

        def sampled(t, phase, *names):
            return {k: np.interp(t, phase.t, getattr(phase, k))[None] for k in names}

        out = {}
        for name in ("flat", "toe"):
            velocity = np.array([np.interp(nodes[name], launch.t, x) for x in launch.com_velocity.T])
            out[name] = sampled(nodes[name], launch, "rho", "rho_rate", "L") | {"velocity": velocity}
        t = np.linspace(0, srmp.flight_s, mesh.flight + 1)
        return out | {"flight": sampled(t, srmp.flight, "rho", "rho_rate")}

    # guesses ----------------------------------------------------------------------------------------------------
    def _posture(self, name: str) -> np.ndarray:
        """Absolute link angles (5,) of a named posture of :data:`POSTURES`, CoM roughly above the sole."""
        knee, trunk, heel, arm = POSTURES[name]
        angles = stance_angles(self.robot, knee, within_limits=False)
        return angles + np.array([heel, heel * 0.5, 0.0, trunk - angles[3], trunk + arm - angles[4]])

    def naive_guess(self, task: JumpTask) -> dict[str, PhaseGuess]:
        """Start values that know only the target: straight lines through four postures, at rest at every node."""
        p = {name: self._posture(name) for name in POSTURES}
        push = (p["crouch"] + p["take-off"]) / 2
        push[0] = 0.0
        turn = np.full(5, task.rotation_rad)
        flight_s = task.flight_time(min(task.platform_m, 0.9 * task.height_m))
        n, lean = self.mesh, 0.3 * np.tanh(task.distance_m)
        flat = _through([self.stance, p["crouch"], push], [0, 0.6, 1], n.flat)[:, 1:]
        toe = _through([push, p["take-off"]], [0, 1], n.toe)
        fly = _through([p["take-off"], p["tuck"] + turn / 2, p["touchdown"] + turn], [0, 0.5, 1], n.flight)
        speed = (task.distance_m - lean) / flight_s
        ballistic = dict(com_x=lean - 0.12, com_z=0.65, vel_x=speed, vel_z=task.takeoff_speed)
        phases = ("flat", 0.7, flat, {}), ("toe", TOE_PHASE_S, toe, {}), ("flight", flight_s, fly, ballistic)
        still = {name: np.zeros_like(q) for name, _, q, _ in phases}
        return {name: PhaseGuess(s, q, still[name], still[name], None, c) for name, s, q, c in phases}


def _through(knots, shares, intervals) -> np.ndarray:
    s = np.linspace(0, 1, intervals + 1)
    return np.stack([np.interp(s, shares, column) for column in np.array(knots).T], -1)
