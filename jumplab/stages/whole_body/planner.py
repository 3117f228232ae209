"""Solving stage 3 for a target: guesses, references, the result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from jumplab.errors import InfeasibleError, SolverError
from jumplab.ocp.nlp import WARM, Near, Nlp, PhaseGuess, Solution, Statistics
from jumplab.robot import Robot
from jumplab.robot.stance import stance_angles
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body.problem import build_problem
from jumplab.stages.whole_body.settings import FOLLOWED_JERK_STEP, Limits, Mesh, Weights
from jumplab.task import JumpTask

TOE_PHASE_S = 0.12  # our choice: heel-up time of the naive guess
# naive guess, our choice: a squat, a stretched take-off, a tuck and a landing crouch (knee, trunk, heel-up, arm in rad)
POSTURES = {"crouch": (1.6, 0.65, 0.0, 0.5), "take-off": (0.4, 0.25, 0.35, -1.0), "tuck": (1.4, 0.3, 0.0, -0.2),
            "touchdown": (0.9, 0.15, 0.0, 0.2)}  # fmt: skip


# our choice: from here on the cost moves by less than one in a million, the rows are met to their own tolerance
FINE = {"tol": 1e-4, "compl_inf_tol": 1e-5}
# our choice: the coarse solution is only a start, digits beyond these would be lost on the finer mesh
COARSE = {"tol": 1e-2, "dual_inf_tol": 1e-1, "constr_viol_tol": 5e-5, "acceptable_tol": 1e-1, "acceptable_iter": 3}
# our choice: over so much of a phase, angles and rates of a roll-out's guess are averaged before the coarse mesh; they
# jump from one QP to the next, and after the steps there the fine mesh took 14 iterations instead of 9 to forget that
GUESS_WIDTHS = (0.05, 0.2)
# our choice: stage 2's motion is near enough for small multipliers; over 16 targets the coarse mesh then takes 22
# iterations instead of 26. From the naive guess the direct planner takes more with them, so it keeps ipopt's own
NEAR = {"bound_mult_init_method": "mu-based", "mu_init": 0.1}
# our choice: what a few steps on the coarse mesh lead to is a good start on the fine one but for its multipliers; over
# 13 targets it then takes 8.5 iterations, with another mu_init (1e-3, 3e-2) 10.4. A rough choice of the next barrier
# will do: with ipopt's 8 trials instead of 3 it took 9.5. No plan of 41 that began so took more than 65
REFINED = {"bound_mult_init_method": "mu-based", "mu_init": 1e-2, "max_iter": 70,
           "quality_function_max_section_steps": 3}  # fmt: skip
# our choice: factors of the jerk's weight where it jumps farther than a tape can follow, one after the other
EVENING = (2.0, 4.0, 8.0)


@dataclass(frozen=True)
class WholeBodyPlan:
    """Result of stage 3 or of the direct planner.

    Attributes
    ----------
    task : the target.
    solution : on the planner's mesh; its phases are "flat", "toe" and "flight".
    coarse : what the solve on the coarse mesh before it cost; None if there was none, or it found nothing.
    uneven : what the solves before it cost whose jerk jumped farther than a tape can follow; after each, the jerk's
        weight was raised, and the solution's own table of costs says to what.
    """

    task: JumpTask
    solution: Solution
    coarse: Statistics | None = None
    uneven: tuple[Statistics, ...] = ()

    @property
    def launch_s(self) -> float:
        """Duration of the launch [s]."""
        return self.solution.phases["flat"].duration + self.solution.phases["toe"].duration

    @property
    def flight_s(self) -> float:
        """Duration of the flight [s]."""
        return self.solution.phases["flight"].duration

    @property
    def jerk_step(self) -> float:
        """Largest jump of the jerk of a joint or of the trunk from one interval to the next [rad/s^3]."""
        jerks = [phase.j for phase in self.solution.phases.values()]
        links = np.vstack([np.pad(j, ((0, 0), (5 - j.shape[1], 0))) for j in jerks])  # a flat foot has none
        joints = np.column_stack([links[:, :4] - links[:, 1:], links[:, 3]])  # in any order and sign
        return float(np.abs(np.diff(joints, axis=0)).max())


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
            f"under a sole of {robot.name}; ask for a distance of {least:.2f} m or more (backward jumps only on the "
            f"level)"
        )


class WholeBodyPlanner:
    """Stage 3 for one robot (or, without ``tracking``, the direct planner): built once, solved for any target.

    With ``refine`` a target is solved on a coarse mesh first and refined from there, without it on ``mesh`` at once.
    With ``approach`` the coarse mesh only takes the few steps of ``Nlp.gauss_newton_steps``; where they lead
    nowhere, and without it, ipopt solves it. ``keep`` keeps what was built for later processes.
    """

    def __init__(self, robot: Robot, mesh: Mesh = Mesh(), limits: Limits = Limits(), weights: Weights = Weights(), *,
                 tracking: bool = True, options: Mapping | None = None, refine: bool = True,
                 approach: bool = True, keep: bool = False):  # fmt: skip
        self.robot, self.mesh, self.limits, self.tracking = robot, mesh, limits, tracking
        self.stance, self.weights, self._steps = stance_angles(robot), weights, approach
        options = dict(options or {})

        problem = build_problem(robot, mesh, limits, weights, tracking=tracking)

        def build(mesh: Mesh, extra: Mapping, like: Nlp | None = None) -> Nlp:
            key = f"{robot.hash} {limits} {weights} {tracking}" if keep else None
            return Nlp(problem.on_mesh(mesh.intervals()), {**extra, **options}, key, like)

        self.nlp, self._coarse = build(mesh, FINE), None
        if refine:
            self._coarse = build(mesh.coarse(), {**COARSE, **(NEAR if tracking else {})}, self.nlp)
            self._refined = self.nlp.with_options({**FINE, **REFINED, **options})
        self._warm = self.nlp.with_options({**FINE, **WARM, **options})

    def plan(self, task: JumpTask, srmp: SrmpPlan | None = None, *, guess: Mapping[str, PhaseGuess] | None = None,
             weights: Mapping[str, float] | None = None, off: tuple[str, ...] = (),
             near: WholeBodyPlan | None = None, start: np.ndarray | None = None) -> WholeBodyPlan:  # fmt: skip
        """Solve for a target; with tracking, ``srmp`` is stage 1's plan for it.

        Parameters
        ----------
        guess : start values on any mesh; those of :meth:`naive_guess` if None.
        weights, off : as in :meth:`jumplab.ocp.nlp.Nlp.solve`.
        near : this planner's plan for a target close by, to begin with instead of ``guess``; if that leads nowhere, the
            target is solved from ``guess`` all the same.
        start : absolute link angles (5,) in which the robot waits at rest, soles flat; the stance if None.

        Raises
        ------
        SolverError
            If there is no plan; names the terms in conflict.
        """
        how = {"weights": weights, "off": off}
        guess, parameters = guess or self.naive_guess(task), self.parameters(task, srmp, start)
        return self._evened(self._begun(task, srmp, guess, near, parameters, how), srmp, parameters, how)

    def _evened(self, found: WholeBodyPlan, srmp, parameters, how) -> WholeBodyPlan:
        """The plan, with a dearer jerk if it jumps too far. Whoever sets the jerk's weight or drops it is obeyed."""
        if any(name.rpartition("/")[2] == "jerk" for name in (*(how["weights"] or ()), *how["off"])):
            return found
        for factor in EVENING:
            if found.jerk_step <= FOLLOWED_JERK_STEP:
                break
            dearer = how | {"weights": {**(how["weights"] or {}), "jerk": factor * self.weights.jerk}}
            try:
                even = self._from(found.solution, self._warm, srmp, parameters, dearer)
            except SolverError:
                break  # the audit says what is wrong with the tape
            found = replace(found, solution=even, uneven=(*found.uneven, found.solution.statistics))
        return found

    def _begun(self, task, srmp, guess, near, parameters, how) -> WholeBodyPlan:
        """The solution, from the plan for a target close by, from the coarse mesh or from the guess itself."""
        if near is not None:
            try:
                return WholeBodyPlan(task, self._from(near.solution, self._warm, srmp, parameters, how))
            except SolverError:
                pass  # as if there had been none
        if self._coarse is not None:
            try:
                return self._refine(task, srmp, guess, parameters, how)
            except SolverError:
                pass  # the fine mesh has the last word, and the better explanation
        start = {name: guess[name].resampled(n) for name, n in self.mesh.intervals().items()}
        references = self.references(srmp, self.mesh)
        return WholeBodyPlan(task, self.nlp.solve(parameters, start, references=references, **how))

    def _refine(self, task, srmp, guess, parameters, how) -> WholeBodyPlan:
        mesh = self.mesh.coarse()
        if self.tracking:
            guess = {name: phase.smoothed(*GUESS_WIDTHS) for name, phase in guess.items()}
        start = {name: guess[name].resampled(n) for name, n in mesh.intervals().items()}
        references = self.references(srmp, mesh)
        if self._steps:
            try:
                first = self._coarse.gauss_newton_steps(parameters, start, references=references, **how)
                return WholeBodyPlan(task, self._from(first, self._refined, srmp, parameters, how), first.statistics)
            except SolverError:
                pass  # too far away for linear rows; what stays inside all limits finds more, and takes longer
        first = self._coarse.solve(parameters, start, references=references, explain=False, **how)
        return WholeBodyPlan(task, self._from(first, self._refined, srmp, parameters, how), first.statistics)

    def _from(self, known: Solution | Near, nlp: Nlp, srmp, parameters, how) -> Solution:
        """Solve on the planner's mesh, beginning with a solution of the same problem on any mesh."""
        multipliers = known.multipliers if isinstance(known, Solution) else None
        return nlp.solve(parameters, known.guess(self.mesh.intervals()), multipliers=multipliers,
                         references=self.references(srmp, self.mesh), explain=False, **how)  # fmt: skip

    def parameters(self, task: JumpTask, srmp: SrmpPlan | None = None, start: np.ndarray | None = None) -> dict:
        """Parameter values of the problem for a target and a ``start`` (see :meth:`plan`).

        Raises :class:`InfeasibleError` for an impossible platform.
        """
        check_platform(task, self.robot, self.limits)
        edge = platform_edge_m(task, self.robot, self.limits) - np.sign(task.platform_m) * self.limits.edge_step_m
        stance = self.stance if start is None else start
        values = dict(stance=stance, distance=task.distance_m, platform=task.platform_m, edge=edge,
                      takeoff_speed=task.takeoff_speed, rotation=task.rotation_rad, gravity=task.gravity)  # fmt: skip
        if self.tracking:
            values |= dict(momentum=srmp.launch.L[-1], launch_s=[srmp.launch_s - srmp.toe_s, srmp.toe_s])
        return values

    def references(self, srmp: SrmpPlan | None, mesh: Mesh) -> dict[str, dict[str, np.ndarray]] | None:
        """Stage 1's trajectories at a mesh's nodes, by share of each phase; None if they are not tracked."""
        if not self.tracking:
            return None
        launch, flight, split = srmp.launch, srmp.flight, srmp.launch_s - srmp.toe_s
        out = {}
        for name, first, last, n in (
            ("flat", 0.0, split, mesh.flat),
            ("toe", split, srmp.launch_s, mesh.toe),
        ):
            t = np.linspace(first, last, n + 1)
            columns = {k: np.interp(t, launch.t, getattr(launch, k))[None] for k in ("rho", "rho_rate", "L")}
            velocity = [np.interp(t, launch.t, launch.com_velocity[:, i]) for i in range(2)]
            out[name] = columns | {"velocity": np.array(velocity)}
        t = np.linspace(0, srmp.flight_s, mesh.flight + 1)
        out["flight"] = {k: np.interp(t, flight.t, getattr(flight, k))[None] for k in ("rho", "rho_rate")}
        return out

    # guesses ----------------------------------------------------------------------------------------------------
    def _posture(self, name: str) -> np.ndarray:
        """Absolute link angles (5,) of a named posture of :data:`POSTURES`, CoM roughly above the sole."""
        knee, trunk, heel, arm = POSTURES[name]
        angles = stance_angles(self.robot, knee, within_limits=False) if knee < 1.8 else self.stance.copy()
        return angles + np.array([heel, heel * 0.5, 0.0, trunk - angles[3], trunk + arm - angles[4]])

    def naive_guess(self, task: JumpTask) -> dict[str, PhaseGuess]:
        """Start values that know only the target: straight lines through four postures, at rest at every node."""
        p = {name: self._posture(name) for name in POSTURES}
        push = (p["crouch"] + p["take-off"]) / 2
        push[0] = 0.0
        turn = np.full(5, task.rotation_rad)
        flight_s = task.flight_time(min(task.platform_m, 0.9 * task.height_m))
        n, zero = self.mesh, np.zeros
        flat = _through([self.stance, p["crouch"], push], [0, 0.6, 1], n.flat)[:, 1:]
        toe = _through([push, p["take-off"]], [0, 1], n.toe)
        fly = _through([p["take-off"], p["tuck"] + turn / 2, p["touchdown"] + turn], [0, 0.5, 1], n.flight)
        lean = 0.3 * np.tanh(task.distance_m)
        constants = dict(
            com_x=lean - 0.12, com_z=0.65, vel_x=(task.distance_m - lean) / flight_s, vel_z=task.takeoff_speed
        )
        return {
            "flat": PhaseGuess(0.7, flat, zero(flat.shape), zero(flat.shape)),
            "toe": PhaseGuess(TOE_PHASE_S, toe, zero(toe.shape), zero(toe.shape)),
            "flight": PhaseGuess(flight_s, fly, zero(fly.shape), zero(fly.shape), None, constants),
        }

    def guess_from_motion(
        self,
        t: np.ndarray,
        angles: np.ndarray,
        rates: np.ndarray,
        accels: np.ndarray,
        takeoff_s: float,
        toe_s: float,
        com: np.ndarray,
        com_velocity: np.ndarray,
    ) -> dict[str, PhaseGuess]:
        """Start values from a sampled planar motion: absolute link angles (n, 5) with derivatives, take-off time and
        length of the toe phase [s].

        ``com`` and ``com_velocity`` (2,) are the CoM from the toe and its velocity at take-off.
        """
        split, end = takeoff_s - toe_s, t[-1]
        out = {}
        spans = (("flat", 0.0, split, self.mesh.flat), ("toe", split, takeoff_s, self.mesh.toe),
                 ("flight", takeoff_s, end, self.mesh.flight))  # fmt: skip
        for name, first, last, n in spans:
            at = np.linspace(first, last, n + 1)
            q, v, a = (np.stack([np.interp(at, t, x) for x in y.T], -1) for y in (angles, rates, accels))
            if name == "flat":
                q, v, a = q[:, 1:], v[:, 1:], a[:, 1:]
            if name == "toe":
                q[:, 0] = np.maximum(q[:, 0], 0.0)
            out[name] = PhaseGuess(last - first, q, v, a)
        constants = dict(com_x=com[0], com_z=com[1], vel_x=com_velocity[0], vel_z=com_velocity[1])
        flight = out["flight"]
        out["flight"] = PhaseGuess(flight.duration, flight.q, flight.v, flight.a, None, constants)
        return out


def _through(knots, shares, intervals) -> np.ndarray:
    s = np.linspace(0, 1, intervals + 1)
    return np.stack([np.interp(s, shares, column) for column in np.array(knots).T], -1)
