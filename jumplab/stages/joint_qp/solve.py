"""Two ways to solve a :class:`StepQp`: cvxpy with Clarabel, as the notebook shows it, and directly, for speed.

Both get the same matrices. A status is believed only if it is on the whitelist and the answer passes its rows again.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from proxsuite import proxqp

from jumplab.errors import SolverError
from jumplab.stages.joint_qp.diagnosis import conflict, lines, row_scale, sentence
from jumplab.stages.joint_qp.problem import StepQp

PARTS = ("A", "b", "E", "e", "G", "h", "R", "lower", "upper")  # of a StepQp
CLARABEL = {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}
PROXQP_EPS = 1e-9  # absolute, as Clarabel's
PROXQP_INFEASIBLE = 1e-12  # the default of 1e-4 calls some feasible steps infeasible
PROXQP_ITERATIONS = 1000  # a step takes about ten; more than this is a failure
ROW_TOLERANCE = 1e-6  # re-evaluated row error, relative to the row's size, above which no answer is believed
SOFTNESS = 1e-9  # of the binding rows, relative to their size, so that dependent ones do no harm
ROUNDS = 3  # each takes back the softness' error by about its size; the third finds only round-off
TRIES = 4  # sets of binding rows; nearly all steps need one or two, and beyond four ProxQP is as fast
BINDING_TOLERANCE = 1e-9  # of rows and multipliers, relative


@dataclass(frozen=True)
class Answer:
    """Optimum of one step: ``x``, iterations, and the largest re-evaluated row error relative to the rows' sizes."""

    x: np.ndarray
    iterations: int
    residual: float


def checked_answer(
    qp: StepQp, x: np.ndarray | None, iterations: int, status: str, good: bool, phase: str, t: float
) -> Answer:
    """The answer, or :class:`SolverError` naming phase, time, status and the rows that conflict."""
    residual, worst = np.inf, ""
    if x is not None and np.all(np.isfinite(x)):
        broken = qp.violations(x)
        if max(b.max(initial=0.0) for b in broken.values()) > ROW_TOLERANCE:  # large rows have large round-off
            scale = row_scale(qp)
            broken = {m: b / scale[m] for m, b in broken.items()}
        k = max(broken, key=lambda m: broken[m].max(initial=0.0))
        residual = float(broken[k].max(initial=0.0))
        worst = qp.layout.labels[k][int(np.argmax(broken[k]))]
    if good and residual <= ROW_TOLERANCE:
        return Answer(x, iterations, residual)
    found = conflict(qp)
    if found:
        raise SolverError(sentence(found, phase, t), stage="joint_map", status=status, violations=lines(found, phase))
    missed = f"misses '{worst}' by {residual:.2g} of its size" if np.isfinite(residual) else "is not a finite one"
    text = f"stage 2: at t = {t:.3f} s of the {phase} the search for a joint motion did not settle ({status}): "
    raise SolverError(f"{text}one exists, but the answer {missed}", stage="joint_map", status=status)


class CvxpySolver:
    """One cvxpy problem with Parameters (DPP), canonicalised once and solved by Clarabel at every step."""

    def __init__(self, example: StepQp):
        import cvxpy as cp

        self.x = x = cp.Variable(example.A.shape[1])
        self.parameters = p = {k: cp.Parameter(getattr(example, k).shape, name=k) for k in PARTS}
        rows = [p["E"] @ x == p["e"], p["G"] @ x <= p["h"], p["R"] @ x >= p["lower"], p["R"] @ x <= p["upper"]]
        self.problem = cp.Problem(cp.Minimize(cp.sum_squares(p["A"] @ x - p["b"]) / 2), rows)

    def solve(self, qp: StepQp, phase: str, t: float) -> Answer:
        """Solve one step; raises :class:`SolverError` if there is no trustworthy answer."""
        import cvxpy as cp

        for k, parameter in self.parameters.items():
            parameter.value = getattr(qp, k)
        status, iterations = "solver error", 0
        self.x.value = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # an inaccurate answer is judged below, not by a warning
                self.problem.solve(solver=cp.CLARABEL, warm_start=False, enforce_dpp=True, **CLARABEL)
            status = str(self.problem.status)
            iterations = int(self.problem.solver_stats.num_iters or 0)
        except cp.SolverError as e:
            status = f"solver error ({str(e).splitlines()[0]})"
        return checked_answer(qp, self.x.value, iterations, status, status == "optimal", phase, t)


@dataclass(frozen=True)
class Program:
    """min 1/2 x' H x + g' x  subject to  C x = d  and  low <= D x <= high, all dense."""

    H: np.ndarray
    g: np.ndarray
    C: np.ndarray
    d: np.ndarray
    D: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, qp: StepQp) -> Program:
        """The same program with its inequalities stacked: G, then R."""
        low = np.concatenate([np.full(len(qp.G), -np.inf), qp.lower])
        high = np.concatenate([qp.h, qp.upper])
        return cls(qp.A.T @ qp.A, -(qp.A.T @ qp.b), qp.E, qp.e, np.concatenate([qp.G, qp.R]), low, high)

    def with_equal(self, top: np.ndarray, bottom: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """The optimum (n,) with some rows of D at their upper and lower side, and these rows' multipliers.

        Multipliers (all rows of D,) are positive at the upper side. None if the linear system is singular.
        """
        rows = np.concatenate([self.C, self.D[top], self.D[bottom]])
        right = np.concatenate([self.d, self.high[top], self.low[bottom]])
        size, n, m = np.maximum(np.abs(rows).max(axis=1, initial=0.0), 1e-9), len(self.g), len(right)
        rows, right = rows / size[:, None], right / size
        kkt = np.zeros((n + m, n + m))
        kkt[:n, :n], kkt[:n, n:], kkt[n:, :n] = self.H, rows.T, rows
        soft, want, answer = kkt.copy(), np.concatenate([-self.g, right]), np.zeros(n + m)
        soft[range(n, n + m), range(n, n + m)] = -SOFTNESS
        try:
            inverse = np.linalg.inv(soft)  # scipy could keep the factors; importing it costs more than the inverses
        except np.linalg.LinAlgError:
            return None
        for _ in range(ROUNDS):
            answer += inverse @ (want - kkt @ answer)
        multipliers, ends = np.zeros(len(self.D)), np.cumsum([n + len(self.d), top.sum()])
        multipliers[top], multipliers[bottom] = answer[ends[0] : ends[1]], answer[ends[1] :]
        return answer[:n], multipliers

    def binding(self, x: np.ndarray, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which rows of D bind at an approximate optimum, at the upper side and at the lower."""
        value = self.D @ x
        return multipliers > self.high - value, -multipliers > value - self.low

    def settled(self, top: np.ndarray, bottom: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, int] | None:
        """The optimum, beginning with a guess of the rows that bind: x, the rows that do, and how many tries.

        Rows that are broken join, rows whose multiplier has the wrong sign leave (a primal-dual active-set method).
        Where it ends, all conditions of an optimum hold, and there is only one, the same to the last bit whatever
        memory is like: stage 3 makes 1e-9 of the last digits. None if it does not end after some tries.
        """
        near = BINDING_TOLERANCE
        for tries in range(1, TRIES + 1):
            found = self.with_equal(top, bottom)
            if found is None:
                return None
            x, push = found[0], np.where(bottom, -found[1], found[1])
            value, leave = self.D @ x, push < -near * np.abs(push).max(initial=1.0)
            free = ~top & ~bottom
            above = free & (value > self.high + near * np.abs(self.high))
            below = free & (value < self.low - near * np.abs(self.low))
            if not (leave | above | below).any():
                return x, top, bottom, tries
            top, bottom = (top & ~leave) | above, (bottom & ~leave) | below
        return None


class DirectSolver:
    """Begins with the rows that bound in the step before; where these lead nowhere, with those that bind for ProxQP.

    ProxQP's vectorised builds sum in an order that depends on where memory lies, so its answer itself is only a guess.
    """

    def __init__(self, example: StepQp):
        inequalities = len(example.G) + len(example.R)
        self.solver, self.ready = proxqp.dense.QP(example.A.shape[1], len(example.E), inequalities), False
        settings = self.solver.settings
        settings.eps_abs, settings.eps_primal_inf, settings.max_iter = PROXQP_EPS, PROXQP_INFEASIBLE, PROXQP_ITERATIONS
        self.binding: Sequence[np.ndarray] | None = None

    def solve(self, qp: StepQp, phase: str, t: float) -> Answer:
        """Solve one step; raises :class:`SolverError` if there is no trustworthy answer."""
        program = Program.of(qp)
        found = self.binding and program.settled(*self.binding)
        if found:
            x, *self.binding, iterations = found
            return checked_answer(qp, x, iterations, "binding rows settled", True, phase, t)
        (self.solver.update if self.ready else self.solver.init)(*vars(program).values())
        self.ready = True
        self.solver.solve()
        result = self.solver.results
        x, status = np.array(result.x), result.info.status
        good = status == proxqp.QPSolverOutput.PROXQP_SOLVED
        if good:
            self.binding = program.binding(x, np.array(result.z))
            found = program.settled(*self.binding)
            x = found[0] if found else x
        return checked_answer(qp, x, int(result.info.iter), status.name, good, phase, t)


SOLVERS = {"cvxpy": CvxpySolver, "direct": DirectSolver}
