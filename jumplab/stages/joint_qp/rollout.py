"""Roll-out of the QPs over launch and flight: every step solved, checked and integrated (JL-I1)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, Shown, require_type
from jumplab.models.full import FullBody, FullTerms
from jumplab.ocp import Problem
from jumplab.ocp.qp import Qp, QpSolver
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.stages.changes import StageChanges
from jumplab.stages.joint_qp.programs import FlightQp, LaunchQp, PhaseQp
from jumplab.stages.joint_qp.settings import Options
from jumplab.stages.joint_qp.terms import changed_problem
from jumplab.stages.joint_qp.words import checked
from jumplab.stages.srmp import SrmpPlan

# shares of a misprediction that the next guess takes over; the second one is damped
CORRECTIONS = (1.0, 0.5, 0.0)
# [m/s, rad/s] by which a rate may be mispredicted before the step is solved again
PREDICTED_RATE = 0.4
LONGEST_STEP_S = 0.02  # the feedback (damping 40 1/s) would ring with longer steps
SHORTEST_STEP_S = 0.0005  # half the control cycle; shorter steps are a typing error


class State(NamedTuple):
    """Configuration (nq,), rates (nv,) at the start of a step, and accelerations (nv,): the last
    known, or a guess.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


class Step(NamedTuple):
    """One step as it was solved; arrays as in :class:`JointPlan`, times [s]."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    predicted: np.ndarray
    f: np.ndarray
    tau: np.ndarray
    iterations: int
    solve_s: float
    residual: float


AT_NODES = Step._fields[:6]  # what a plan holds at every node


@dataclass(frozen=True)
class Statistics:
    """Effort of the roll-out: steps, solver iterations, and time [s] in the solver and in all."""

    steps: int
    iterations: int
    solve_s: float
    total_s: float
    worst_residual: float


@dataclass(frozen=True, repr=False)
class JointPlan(Shown):
    """Result of stage 2 at the N nodes of launch and flight; the instant of take-off appears once
    per phase.

    Values that a step holds stand at the node where it begins, and again at a phase's last node.
    """

    t: np.ndarray  # (N,) [s]
    phase: np.ndarray  # (N,) "launch" or "flight"
    contact: np.ndarray  # (N,) "flat", "toe" or "air"
    q: np.ndarray  # (N, nq) Pinocchio configuration
    v: np.ndarray  # (N, nv) rates
    a: np.ndarray  # (N, nv) accelerations, held over the step
    predicted: np.ndarray  # (N, nv) accelerations that the step's QP was written for
    f: np.ndarray  # (N, 2, 6) force, then moment at both tiptoes, world axes [N, N m]
    tau: np.ndarray  # (N, nv - 6) joint torques [N m] in the middle of the step
    statistics: Statistics
    options: Options  # of the QPs that made it ...
    problem: Problem  # ... and their terms

    def rows(self, phase: str) -> slice:
        """Rows of one phase."""
        inside = np.flatnonzero(self.phase == phase)
        return slice(int(inside[0]), int(inside[-1]) + 1)

    def state(self, k: int) -> State:
        """State at row ``k``, as :meth:`JointMapper.step` needs it."""
        return State(self.q[k], self.v[k], self.a[k])


def nodes(duration: float, step_s: float) -> np.ndarray:
    """Even node times (n + 1,) from 0 to ``duration`` [s], no further apart than ``step_s``."""
    return np.linspace(0.0, duration, max(int(np.ceil(duration / step_s - 1e-9)), 1) + 1)


class JointMapper:
    """Both QPs of one jump, ready to be rolled out, or looked at one step at a time.

    Parameters
    ----------
    srmp : stage 1's plan.  robot : the robot.
    step_s : step of the roll-out [s], at most, or one each for flat feet, toes and flight; each is
        divided evenly.
    options : gains, weights, limits.  q0 : (nq,) start at rest, soles flat; the robot's stance by
        default.
    changes : own terms, factors on weights, terms left out, see :func:`.terms.changed_problem`.

    Attributes
    ----------
    launch : the launch's QPs.  problem : the terms of both phases.  body : nine-link quantities.
    reference : stage 1's plan at the nodes.
    """

    def __init__(
        self,
        srmp: SrmpPlan,
        robot: Robot,
        step_s: float | tuple[float, float, float] = 0.01,
        options: Options = Options(),
        q0: np.ndarray | None = None,
        changes: StageChanges = StageChanges(),
    ):
        require_type(srmp, SrmpPlan, "stage 1's plan")
        if srmp.task.rotation_rad:
            raise InputError(
                f"stage 2 cannot follow a flip (rotation_rad = {srmp.task.rotation_rad:.3g}, must "
                "be 0); plan flips by jumplab.plan(..., method='three-step'), which skips stage 2"
            )
        parts = step_s if isinstance(step_s, tuple) and len(step_s) == 3 else (step_s,) * 3
        for step in parts:
            if not (isinstance(step, int | float) and SHORTEST_STEP_S <= step <= LONGEST_STEP_S):
                limits = f"{SHORTEST_STEP_S} and {LONGEST_STEP_S} s"
                raise InputError(f"stage 2: step_s = {step!r} s, must be a number between {limits}")
        self.body = FullBody(robot.under_gravity(srmp.task.gravity))
        self.q0 = stance_configuration(robot) if q0 is None else np.asarray(q0, float)
        if self.q0.shape != (self.body.nq,) or not np.all(np.isfinite(self.q0)):
            raise InputError(
                f"stage 2: q0 has shape {self.q0.shape}, must be ({self.body.nq},) and finite"
            )
        self.options = options
        self.problem = changed_problem(self.body, self.q0, self.options, changes)
        flat_s = srmp.launch_s - srmp.toe_s
        launch_t = np.append(nodes(flat_s, parts[0]), flat_s + nodes(srmp.toe_s, parts[1])[1:])
        self.reference = srmp.at(launch_t, nodes(srmp.flight_s, parts[2]))
        given = self.body, self.options, self.problem.phases[0]
        self.launch = LaunchQp(*given, self.reference.launch, srmp.toe_s, self.q0)

    def flight_from(self, takeoff: State) -> FlightQp:
        """The flight's QPs, beginning at a take-off state."""
        ground = float(self.launch.toe0[:, 2].mean())
        start = self.body.terms(takeoff.q, takeoff.v)
        given = self.body, self.options, self.problem.phases[1]
        return FlightQp(*given, self.reference.flight, self.launch.nominal, start, ground)

    def step(self, qp: PhaseQp, k: int, start: State) -> tuple[FullTerms, Any, Qp]:
        """Quantities in the middle of step ``k`` of a phase, target, and its program, to look at.

        ``qp`` is :attr:`launch` or one from :meth:`flight_from`; ``start.a`` guesses the step's
        accelerations. The QP's matrices are taken in the middle (midpoint rule), so that a step's
        drift is of third order. With ``start = plan.state(row)`` it is the QP that made the plan,
        up to what its prediction missed.
        """
        target = qp.target(k, self.body.terms(start.q, start.v))
        half = qp.steps[k] / 2
        moved = pin.integrate(self.body.model, start.q, half * start.v + half**2 / 2 * start.a)
        middle = self.body.terms(moved, start.v + half * start.a)
        return middle, target, qp.qp(middle, target)

    def solved(self, qp: PhaseQp, k: int, state: State, solver: Any) -> Step:
        """Step ``k`` of a phase from the ``state`` at its start, solved again where the guess of
        its accelerations is too far off.
        """
        h = qp.steps[k]
        solve_s = residual = 0.0
        for share in CORRECTIONS:
            middle, _, program = self.step(qp, k, state)
            began = time.perf_counter()
            answer = solver.solve(program)
            solve_s += time.perf_counter() - began
            residual = max(residual, checked(qp.phase, program, answer, qp.t[k]))
            a = answer.x[qp.first :]
            predicted = state.a
            if np.abs(a - predicted).max() * h / 2 < PREDICTED_RATE:
                break
            state = state._replace(a=predicted + share * (a - predicted))
        f = np.zeros(12)
        f[: qp.first] = answer.x[: qp.first]
        tau = (middle.M @ a + middle.H - middle.J.T @ f)[6:]
        spent = answer.iterations, solve_s, residual
        return Step(state.q, state.v, a, predicted, f.reshape(2, 6), tau, *spent)

    def roll(self, qp: PhaseQp, solver: Any, state: State) -> list[Step]:
        """All steps of one phase from the state at its start, and a last one that stands at its
        end.
        """
        steps = []
        before = state.a
        for k, h in enumerate(qp.steps):
            step = self.solved(qp, k, state._replace(a=2 * state.a - before), solver)
            before = state.a
            q = pin.integrate(self.body.model, step.q, step.v * h + step.a * (h * h / 2))
            state = State(q, step.v + step.a * h, step.a)
            steps.append(step)
        return [*steps, step._replace(q=state.q, v=state.v, iterations=0, solve_s=0.0)]

    def run(self, solver: Any = None) -> JointPlan:
        """Roll out launch and flight.

        ``solver`` has a method ``solve(qp)``; :class:`jumplab.ocp.qp.QpSolver` if None. Raises
        :class:`SolverError` if a QP has no trustworthy answer; names phase, time and the rows that
        conflict.
        """
        began = time.perf_counter()
        rest = np.zeros(self.body.nv)
        solver = solver or QpSolver()
        launch = self.roll(self.launch, solver, State(self.q0, rest, rest))
        takeoff = State(*launch[-1][:3])
        flight = self.roll(self.flight_from(takeoff), solver, takeoff)
        rows = Step(*zip(*launch, *flight, strict=True))
        toes = sum(self.launch.on_toes) + 1
        times = [len(launch) - toes, toes, len(flight)]
        columns = {
            "t": np.append(self.launch.t, self.launch.t[-1] + self.reference.flight.t),
            "phase": np.repeat(["launch", "launch", "flight"], times),
            "contact": np.repeat(["flat", "toe", "air"], times),
            **{name: np.array(getattr(rows, name)) for name in AT_NODES},
        }
        for x in columns.values():
            x.setflags(write=False)
        statistics = Statistics(
            len(rows.q) - 2,
            sum(rows.iterations),
            sum(rows.solve_s),
            time.perf_counter() - began,
            max(rows.residual),
        )
        return JointPlan(
            **columns, statistics=statistics, options=self.options, problem=self.problem
        )


def map_to_joints(
    srmp: SrmpPlan,
    robot: Robot,
    step_s: float | tuple[float, float, float] = 0.01,
    options: Options = Options(),
    q0: np.ndarray | None = None,
    changes: StageChanges = StageChanges(),
) -> JointPlan:
    """Map stage 1's momentum and inertia trajectories to the joints of the full robot (Sec. IV).

    Parameters
    ----------
    srmp, robot, step_s, options, q0, changes : see :class:`JointMapper` (step_s [s], q0 (nq,)).

    Raises
    ------
    InputError : an option is unknown, or a term does not fit.
    SolverError : a QP has no trustworthy answer; names phase, time and the rows that conflict.
    """
    return JointMapper(srmp, robot, step_s, options, q0, changes).run()
