"""Roll-out of the QPs over launch and flight: every step solved, checked and integrated (JL-I1)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, Shown, SolverError
from jumplab.models.full import FullBody, FullMotion, FullTerms
from jumplab.ocp import Term
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.stages.joint_qp.changes import changed
from jumplab.stages.joint_qp.flight import FlightQp
from jumplab.stages.joint_qp.launch import WRENCH, LaunchQp
from jumplab.stages.joint_qp.problem import State, StepQp
from jumplab.stages.joint_qp.reference import FlightReference, LaunchReference
from jumplab.stages.joint_qp.settings import GENTLE, Options
from jumplab.stages.joint_qp.solve import SOLVERS, Answer

CORRECTIONS = (1.0, 0.5, 0.0)  # shares of a misprediction that the next guess takes over; the second one is damped
PREDICTED_RATE = 0.4  # [m/s, rad/s] by which a rate may be mispredicted before the step is solved again
LONGEST_STEP_S = 0.02  # the feedback (damping 40 1/s) would ring with longer steps
SHORTEST_STEP_S = 0.0005  # half the control cycle; shorter steps are a typing error


def tracking(actual: dict, reference: dict, n: int) -> dict[str, float]:
    """Errors against stage 1. The first ``n`` rows are the launch.

    Keys: ``takeoff_velocity`` (share of the take-off speed), ``takeoff_momentum`` and ``launch_momentum`` (share of the
    peak of L in the launch; at take-off, and the largest), ``launch_inertia_rms``, ``flight_inertia_rms`` (share of the
    mean of rho), ``launch_com`` (largest distance [m]), ``flight_foot_rms`` and ``touchdown_foot`` [m].
    """
    off = {k: x - reference[k] for k, x in actual.items()}
    speed, foot = reference["com_velocity"][n - 1], np.linalg.norm(off["foot_com"], axis=1)
    momentum = np.abs(off["L"][:n]) / max(np.abs(reference["L"][:n]).max(), 1e-9)

    def rms(x, size):
        return np.sqrt(np.mean(x**2)) / size

    found = {
        "takeoff_velocity": np.linalg.norm(off["com_velocity"][n - 1]) / np.linalg.norm(speed),
        "takeoff_momentum": momentum[-1],
        "launch_momentum": momentum.max(),
        "launch_inertia_rms": rms(off["rho"][:n], reference["rho"][:n].mean()),
        "flight_inertia_rms": rms(off["rho"][n:], reference["rho"][n:].mean()),
        "launch_com": np.linalg.norm(off["com"][:n], axis=1).max(),
        "flight_foot_rms": rms(foot, 1.0),
        "touchdown_foot": foot[-1],
    }
    return {k: float(x) for k, x in found.items()}


@dataclass(frozen=True)
class Statistics:
    """What the roll-out cost: steps, solver iterations, and time [s] in the solver and in all."""

    method: str
    steps: int
    iterations: int
    solve_s: float
    total_s: float
    worst_residual: float


@dataclass(frozen=True, repr=False)
class JointPlan(Shown):
    """Result of stage 2 at the N nodes of launch and flight; the instant of take-off appears once per phase.

    Wrenches and torques are those in the middle of the step that begins at the node. ``actual`` and ``reference`` say
    what the motion does and what stage 1 asks for, by name: com (from the pivot) [m], com_velocity [m/s],
    L [kg m^2/s], rho [kg m^2], and in flight foot_com (mean of both soles relative to the CoM) [m].
    """

    t: np.ndarray  # (N,) [s]
    phase: np.ndarray  # (N,) "launch" or "flight"
    contact: np.ndarray  # (N,) "flat", "toe" or "air"
    q: np.ndarray  # (N, nq) Pinocchio configuration
    v: np.ndarray  # (N, nv) rates
    a: np.ndarray  # (N, nv) accelerations held from this node to the next; a phase's last node repeats the one before
    predicted: np.ndarray  # (N, nv) accelerations that the step's QP was written for
    f: np.ndarray  # (N, 2, 6) wrenches on the feet, force then moment, world axes, at the origins of their frames
    tau: np.ndarray  # (N, nv - 6) joint torques [N m]
    actual: dict[str, np.ndarray]
    reference: dict[str, np.ndarray]
    tracking: dict[str, float]  # summary of errors, see the function
    statistics: Statistics
    options: Options  # of the QPs that made it
    gentle: str = ""  # why it follows stage 1 less closely than usual: what the usual weights ended in

    def rows(self, phase: str) -> slice:
        """Rows of one phase."""
        inside = np.flatnonzero(self.phase == phase)
        return slice(int(inside[0]), int(inside[-1]) + 1)

    def state(self, k: int) -> State:
        """State at row ``k``, as :meth:`JointMapper.problem` wants it."""
        return State(self.q[k], self.v[k], self.a[k])


@dataclass
class Rolled:
    """One phase as it is rolled out: state and quantities at the nodes, what each step was solved with, times [s]."""

    states: list[State]
    nodes: list[FullMotion] = field(default_factory=list)
    terms: list[FullTerms] = field(default_factory=list)  # in the middle of the step
    predicted: list[np.ndarray] = field(default_factory=list)  # accelerations (nv,)
    answers: list[Answer] = field(default_factory=list)
    solve_s: float = 0.0


class JointMapper:
    """Both QPs of one jump, ready to be rolled out, or looked at one step at a time.

    Parameters
    ----------
    srmp_plan : stage 1's result, with ``launch`` and ``flight``.  robot : the robot.
    step_s : step of the roll-out [s], at most, or one each for flat feet, toes and flight; each is divided evenly.
    options : gains, weights, limits.  q0 : (nq,) start at rest, soles flat; the robot's stance by default.
    terms, weights, off : own terms, factors on weights, blocks left out, see :func:`.changes.changed`.
    """

    launch_qp: Callable[..., LaunchQp] = LaunchQp
    flight_qp: Callable[..., FlightQp] = FlightQp

    def __init__(
        self,
        srmp_plan: Any,
        robot: Robot,
        step_s: float | tuple[float, float, float] = 0.01,
        options: Options | None = None,
        q0: np.ndarray | None = None,
        *,
        terms: Mapping[str, Iterable[Term]] | None = None,
        weights: Mapping[str, float] | None = None,
        off: Sequence[str] = (),
    ):
        parts = step_s if isinstance(step_s, tuple) and len(step_s) == 3 else (step_s, step_s, step_s)
        for step in parts:
            if not (isinstance(step, int | float) and SHORTEST_STEP_S <= step <= LONGEST_STEP_S):
                limits = f"{SHORTEST_STEP_S} and {LONGEST_STEP_S} s"
                raise InputError(f"stage 2: step_s = {step!r} s, must be a number between {limits}")
        self.body = FullBody(robot, getattr(getattr(srmp_plan, "task", None), "gravity", None))
        self.q0 = stance_configuration(robot) if q0 is None else np.asarray(q0, float)
        if self.q0.shape != (self.body.nq,) or not np.all(np.isfinite(self.q0)):
            raise InputError(f"stage 2: q0 has shape {self.q0.shape}, must be ({self.body.nq},) and finite")
        self.options = options or Options()
        if terms or weights or off:
            self.options = changed(self.options, self.body, self.q0, terms, weights, off)
        self.flight_reference = FlightReference.sample(srmp_plan, parts[2])
        toe_s = getattr(srmp_plan, "toe_s", None)
        toe = (toe_s, parts[1]) if isinstance(step_s, tuple) and toe_s is not None else None
        launch = LaunchReference.sample(srmp_plan, parts[0], toe)
        self.launch = self.launch_qp(self.body, self.q0, launch, self.options, toe_s)

    def flight_from(self, takeoff: State) -> FlightQp:
        """The flight's QPs, beginning at a take-off state."""
        ground, start = float(self.launch.toe0[:, 2].mean()), self.body.motion(takeoff.q, takeoff.v)
        return self.flight_qp(self.body, self.launch.nominal, start, self.flight_reference, self.options, ground)

    def middle(self, start: State, guess: np.ndarray, h: float) -> FullTerms:
        """Quantities in the middle of a step, predicted with a guess of its accelerations (nv,).

        The QP's matrices are taken there (midpoint rule), so that a step's drift is of third order.
        """
        q = pin.integrate(self.body.model, start.q, start.v * (h / 2) + guess * (h * h / 8))
        return self.body.terms(q, start.v + guess * (h / 2))

    def problem(self, qp: LaunchQp | FlightQp, k: int, start: State) -> tuple[FullTerms, Any, StepQp]:
        """Quantities in the middle of step ``k`` of a phase, target, and the matrices of its QP, to look at.

        ``qp`` is :attr:`launch` or one from :meth:`flight_from`; ``start.a`` guesses the step's accelerations. With
        ``start = plan.state(row)`` it is the QP that made the plan, up to what its prediction missed.
        """
        target = qp.target(k, self.body.motion(start.q, start.v))
        terms = self.middle(start, start.a, qp.steps[k])
        return terms, target, qp.matrices(terms, target, start)

    def roll(self, qp: LaunchQp | FlightQp, solver_type: type, state: State) -> Rolled:
        """Solve and integrate all steps of one phase."""
        out, solver, before = Rolled(states=[state]), None, state.a
        for k, h in enumerate(qp.steps):
            node = self.body.motion(state.q, state.v)
            target = qp.target(k, node)
            guess = 2 * state.a - before
            for share in CORRECTIONS:
                terms = self.middle(state, guess, h)
                matrices = qp.matrices(terms, target, state)
                solver = solver or solver_type(matrices)
                began = time.perf_counter()
                answer = solver.solve(matrices, qp.name, qp.t[k])
                out.solve_s += time.perf_counter() - began
                a, predicted = answer.x[qp.first :], guess
                if np.abs(a - guess).max() * h / 2 < PREDICTED_RATE:
                    break
                guess = guess + share * (a - guess)
            q = pin.integrate(self.body.model, state.q, state.v * h + a * (h * h / 2))
            before, state = state.a, State(q, state.v + a * h, a)
            out.states.append(state)
            out.nodes.append(node)
            out.terms.append(terms)
            out.predicted.append(predicted)
            out.answers.append(answer)
        out.nodes.append(self.body.motion(state.q, state.v))
        return out

    def run(self, method: str = "cvxpy") -> JointPlan:
        """Roll out launch and flight with "cvxpy" or "direct"."""
        if not isinstance(method, str) or method not in SOLVERS:
            raise InputError(f"stage 2: method {method!r} is unknown; it must be one of {', '.join(SOLVERS)}")
        solver_type = SOLVERS[method]
        began, rest = time.perf_counter(), np.zeros(self.body.nv)
        launch = self.roll(self.launch, solver_type, State(self.q0, rest, rest))
        takeoff = launch.states[-1]
        flight = self.roll(self.flight_from(takeoff), solver_type, takeoff)
        total, answers = time.perf_counter() - began, launch.answers + flight.answers
        iterations, worst = sum(x.iterations for x in answers), max(x.residual for x in answers)
        spent = Statistics(method, len(answers), iterations, launch.solve_s + flight.solve_s, total, worst)
        return self._plan(launch, flight, spent)

    def _plan(self, launch: Rolled, flight: Rolled, statistics: Statistics) -> JointPlan:
        """Put both phases together, and freeze them."""
        n, m = len(launch.terms), len(flight.terms)
        terms, states = launch.terms + flight.terms, launch.states + flight.states
        held = np.r_[0:n, n - 1, n : n + m, n + m - 1]  # node -> step that begins there; the last of a phase repeats
        a = np.array([x.a for x in launch.states[1:] + flight.states[1:]])  # (n + m, nv)
        F = np.zeros((n + m, 2, 6))
        F[:n] = np.array([x.x[:WRENCH] for x in launch.answers]).reshape(n, 2, 6)
        tau = np.array([(x.M @ ai + x.H - x.J.T @ Fi.ravel())[6:] for x, ai, Fi in zip(terms, a, F, strict=True)])
        data = {
            "t": np.concatenate([self.launch.t, self.launch.t[-1] + self.flight_reference.t]),
            "phase": np.repeat(["launch", "flight"], [n + 1, m + 1]),
            "contact": np.array([*np.where(self.launch.on_toes, "toe", "flat"), *["air"] * m])[held],
            "q": np.array([x.q for x in states]),
            "v": np.array([x.v for x in states]),
            "a": a[held],
            "predicted": np.array(launch.predicted + flight.predicted)[held],
            "tau": tau[held],
            "f": self._at_origins(terms, F)[held],
        }
        actual, reference = self._series(launch.nodes + flight.nodes, n + 1)
        for x in (*data.values(), *actual.values(), *reference.values()):
            x.setflags(write=False)
        seen = {"actual": actual, "reference": reference, "tracking": tracking(actual, reference, n + 1)}
        return JointPlan(**data, **seen, statistics=statistics, options=self.options)

    def _at_origins(self, terms, F) -> np.ndarray:
        """Wrenches moved from the tiptoes to the origins of the foot frames."""
        foot, out = self.body.robot.foot, F.copy()
        arm = np.array([x.foot_rotation @ [foot.toe, 0.0, foot.sole_z] for x in terms])  # origin to tiptoe (N, 2, 3)
        out[..., 3:] += np.cross(arm, F[..., :3])
        return out

    def _series(self, terms, n):
        """What the motion does and what stage 1 asked for, by name."""
        pivot, launch, flight = self.launch.pivot, self.launch.reference, self.flight_reference
        actual = {
            "com": np.array([x.com - pivot for x in terms]),
            "com_velocity": np.array([x.com_velocity for x in terms]),
            "L": np.array([x.momentum[4] for x in terms]),
            "rho": np.array([x.rho for x in terms]),
            "foot_com": np.array([x.foot_com.mean(0) for x in terms[n:]]),
        }
        reference = {
            "com": np.concatenate([launch.com.value, flight.com.value]),
            "com_velocity": np.concatenate([launch.com.rate, flight.com.rate]),
            "L": np.concatenate([launch.momentum.rate, np.full(len(terms) - n, flight.L)]),
            "rho": np.concatenate([launch.inertia.value, flight.inertia.value]),
            "foot_com": flight.foot.value,
        }
        return actual, reference


def map_to_joints(
    srmp_plan: Any,
    robot: Robot,
    step_s: float | tuple[float, float, float] = 0.01,
    method: str = "cvxpy",
    options: Options | None = None,
    q0: np.ndarray | None = None,
    *,
    terms: Mapping[str, Iterable[Term]] | None = None,
    weights: Mapping[str, float] | None = None,
    off: Sequence[str] = (),
) -> JointPlan:
    """Map stage 1's momentum and inertia trajectories to the joints of the full robot (Sec. IV).

    Parameters
    ----------
    srmp_plan : object with ``launch`` and ``flight``, each with the arrays of stage 1 at a fixed step.
    robot : the robot.  step_s : step of the roll-out [s], or one each for flat feet, toes and flight.
    method : "cvxpy" (Clarabel) or "direct" (ProxQP); the same QPs, the same optimum.
    options : gains, weights, limits; by default those of :class:`Options` or, where they find no way, ``GENTLE``; the
        plan's ``gentle`` then says why.
    q0 : (nq,) start at rest; the robot's stance by default.
    terms : "launch" or "flight" -> own terms, costs or constraints on a :class:`.own.StepPoint`.
    weights : "block" or "phase/block" -> factor on its weight.  off : "block" or "phase/block" to leave out.

    Raises
    ------
    InputError : the reference has gaps, NaN or wrong lengths, an option is unknown, or a term does not fit.
    SolverError : a QP has no trustworthy answer; names phase, time and the rows that conflict.
    """
    changes: dict[str, Any] = {"q0": q0, "terms": terms, "weights": weights, "off": off}
    if options is not None:
        return JointMapper(srmp_plan, robot, step_s, options, **changes).run(method)
    try:
        return JointMapper(srmp_plan, robot, step_s, Options(), **changes).run(method)
    except SolverError as firm:
        try:
            plan = JointMapper(srmp_plan, robot, step_s, GENTLE, **changes).run(method)
        except SolverError:
            raise firm from None
        return replace(plan, gentle=str(firm))
