"""Two ways to solve a :class:`StepQp`: cvxpy with Clarabel, as the notebook shows it, and ProxQP directly, for speed.

Both get the same matrices. A status is believed only if it is on the whitelist and the answer passes its rows again.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from proxsuite import proxqp

from jumplab.errors import InputError, SolverError
from jumplab.stages.joint_qp.diagnosis import ADVICE, conflict, lines, row_scale, sentence
from jumplab.stages.joint_qp.problem import StepQp

GOOD_CVXPY = ("optimal",)
GOOD_PROXQP = (proxqp.QPSolverOutput.PROXQP_SOLVED,)
CLARABEL = {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}  # our choice: a tenth of the default
PROXQP_EPS = 1e-9  # our choice: the same, absolute
PROXQP_INFEASIBLE = 1e-12  # our choice: the default of 1e-4 called some feasible steps infeasible
PROXQP_ITERATIONS = 1000  # our choice: a step takes about ten; more than this is a failure
ROW_TOLERANCE = (
    1e-6  # our choice: re-evaluated row error, relative to the row's size, above which no answer is believed
)
POLISH_SOFTNESS = 1e-9  # our choice: of the binding rows, relative to their size, so that dependent ones do no harm
POLISH_ROUNDS = 3  # our choice: each takes back the softness' error by about its size; the third finds only round-off
BINDING_TRIES = 4  # our choice: of a jump's 154 programs 142 need one, 11 two; beyond four, ProxQP is as fast
BINDING_TOLERANCE = 1e-9  # our choice: relative, of rows and multipliers, as ProxQP's
POLISH_REACH = 1e-6  # our choice: relative; an optimum is polished, not replaced


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
        k = max(broken, key=lambda m: broken[m].max(initial=0.0))
        if broken[k].max(initial=0.0) > ROW_TOLERANCE:  # large rows have large round-off: look again in their own size
            scale = row_scale(qp)
            broken = {m: broken[m] / scale[m] for m in broken}
            k = max(broken, key=lambda m: broken[m].max(initial=0.0))
        residual = float(broken[k].max(initial=0.0))
        worst = qp.layout.labels[k][int(np.argmax(broken[k]))]
    if good and residual <= ROW_TOLERANCE:
        return Answer(x, iterations, residual)
    found = conflict(qp)
    if found:
        text = sentence(found, phase, t)
    else:
        missed = f"misses '{worst}' by {residual:.2g} of its size" if np.isfinite(residual) else "is not a finite one"
        text = (f"stage 2: at t = {t:.3f} s of the {phase} the search for a joint motion did not settle ({status}): "
                f"one exists, but the answer {missed}; {ADVICE}")  # fmt: skip
    violations = lines(found, phase) if found else ()
    raise SolverError(text, stage="joint_map", status=status, violations=violations)


class CvxpySolver:
    """One cvxpy problem with Parameters (DPP), canonicalised once and solved by Clarabel at every step.

    Rows of A that never change enter as a constant quadratic form: 1/2 |A x - b|^2 = 1/2 |A_m x - b_m|^2 + 1/2 x^T P x
    - c^T x + constant, with the moving rows A_m as Parameters. It halves the time, since every Parameter row costs an
    auxiliary variable.
    """

    name = "cvxpy"

    def __init__(self, example: StepQp):
        import cvxpy as cp

        self.x = x = cp.Variable(example.A.shape[1])
        self.moving = ~example.layout.steady_rows()
        self.steady = example.A[~self.moving]
        self.parameters = p = {k: cp.Parameter(v.shape, name=k) for k, v in self._values(example).items()}
        rows = [p["E"] @ x == p["e"], p["G"] @ x <= p["h"], p["R"] @ x >= p["lower"], p["R"] @ x <= p["upper"]]
        cost = cp.sum_squares(p["A"] @ x - p["b"]) / 2
        if len(self.steady):
            cost += cp.quad_form(x, cp.psd_wrap(self.steady.T @ self.steady)) / 2 - p["c"] @ x
        self.problem = cp.Problem(cp.Minimize(cost), rows)

    def _values(self, qp: StepQp) -> dict[str, np.ndarray]:
        """Values of all Parameters for one step."""
        rows = {k: getattr(qp, k) for k in ("E", "e", "G", "h", "R", "lower", "upper")}
        return {"A": qp.A[self.moving], "b": qp.b[self.moving], "c": self.steady.T @ qp.b[~self.moving], **rows}

    def solve(self, qp: StepQp, phase: str, t: float) -> Answer:
        """Solve one step; raises :class:`SolverError` if there is no trustworthy answer."""
        import cvxpy as cp

        for k, value in self._values(qp).items():
            self.parameters[k].value = value
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
        return checked_answer(qp, self.x.value, iterations, status, status in GOOD_CVXPY, phase, t)


def with_rows(
    hessian: np.ndarray, linear: np.ndarray, rows: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Minimise 1/2 x' H x + g' x with rows @ x = right: x (n,), the scaled rows' multipliers (m,); None if singular."""
    n, m = len(linear), len(right)
    size = np.maximum(np.abs(rows).max(axis=1, initial=0.0), 1e-9)
    C, d = rows / size[:, None], right / size
    kkt = np.zeros((n + m, n + m))
    kkt[:n, :n], kkt[:n, n:], kkt[n:, :n] = hessian, C.T, C
    want, answer = np.concatenate([-linear, d]), np.zeros(n + m)
    soft = kkt.copy()
    soft[range(n, n + m), range(n, n + m)] = -POLISH_SOFTNESS
    try:
        inverse = np.linalg.inv(soft)  # scipy could keep the factors; importing it costs more than a plan's inverses
    except np.linalg.LinAlgError:
        return None
    for _ in range(POLISH_ROUNDS):
        answer += inverse @ (want - kkt @ answer)
    return answer[:n], answer[n:]


def binding(
    rows: np.ndarray, low: np.ndarray, high: np.ndarray, x: np.ndarray, multipliers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which rows bind at an optimum ``x``, at the upper side and at the lower; multipliers positive at the upper."""
    value = rows @ x
    return multipliers > high - value, -multipliers > value - low


def bound_rows(
    equal: np.ndarray,
    right: np.ndarray,
    rows: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    top: np.ndarray,
    bottom: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Equalities C x = d, as (C, d): those of the program, then the rows that bind above and below."""
    return np.concatenate([equal, rows[top], rows[bottom]]), np.concatenate([right, high[top], low[bottom]])


def polished(
    hessian: np.ndarray,
    linear: np.ndarray,
    equal: np.ndarray,
    right: np.ndarray,
    rows: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    x: np.ndarray,
    multipliers: np.ndarray,
) -> np.ndarray:
    """The optimum (n,) from the rows that bind at ``x``: minimise 1/2 x' H x + g' x with those rows as equalities.

    ProxQP's vectorised builds sum in an order that depends on where memory happens to lie, so the last digits of its
    answer differ from run to run, and stage 3 makes 1e-9 of them. Which rows bind does not: solved again from these
    alone, the answer is the same to the last bit. ``multipliers`` are those of ``rows``, positive at the upper side.
    """
    top, bottom = binding(rows, low, high, x, multipliers)
    found = with_rows(hessian, linear, *bound_rows(equal, right, rows, low, high, top, bottom))
    if found is None:
        return x
    moved = np.abs(found[0] - x).max(initial=0.0)
    return found[0] if moved <= POLISH_REACH * max(1.0, np.abs(x).max(initial=0.0)) else x


def from_binding(
    hessian: np.ndarray,
    linear: np.ndarray,
    equal: np.ndarray,
    right: np.ndarray,
    rows: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    top: np.ndarray,
    bottom: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int] | None:
    """The optimum, beginning with the rows that bound in the step before: x, the rows that bind, and how many tries.

    Rows that are broken join, rows whose multiplier has the wrong sign leave (a primal-dual active-set method). Where
    it ends, all conditions of an optimum hold, and there is only one; None if it does not end after some tries.
    """
    first = len(right)
    for tries in range(1, BINDING_TRIES + 1):
        found = with_rows(hessian, linear, *bound_rows(equal, right, rows, low, high, top, bottom))
        if found is None:
            return None
        x, multipliers = found
        value, push = rows @ x, np.zeros(len(rows))
        push[top] = multipliers[first : first + np.count_nonzero(top)]
        push[bottom] = -multipliers[first + np.count_nonzero(top) :]
        leave = push < -BINDING_TOLERANCE * np.abs(push).max(initial=1.0)
        above, below = value > high + BINDING_TOLERANCE * np.abs(high), value < low - BINDING_TOLERANCE * np.abs(low)
        join_top, join_bottom = above & ~top & ~bottom, below & ~bottom & ~top
        if not (leave.any() or join_top.any() or join_bottom.any()):
            return x, top, bottom, tries
        top, bottom = (top & ~leave) | join_top, (bottom & ~leave) | join_bottom
    return None


class DirectSolver:
    """Begins with the rows that bound in the step before, see :func:`from_binding`; where these lead nowhere, ProxQP.

    ProxQP's dense solver is set up once and updated; its answer is polished, see :func:`polished`.
    """

    name = "direct"

    def __init__(self, example: StepQp):
        inequalities = len(example.G) + len(example.R)
        self.solver, self.ready = proxqp.dense.QP(example.A.shape[1], len(example.E), inequalities), False
        settings = self.solver.settings
        settings.eps_abs, settings.eps_primal_inf, settings.max_iter = PROXQP_EPS, PROXQP_INFEASIBLE, PROXQP_ITERATIONS
        self.below = np.full(len(example.G), -np.inf)
        self.binding: tuple[np.ndarray, np.ndarray] | None = None

    def solve(self, qp: StepQp, phase: str, t: float) -> Answer:
        """Solve one step; raises :class:`SolverError` if there is no trustworthy answer."""
        hessian, linear = qp.A.T @ qp.A, -(qp.A.T @ qp.b)
        rows, low = np.concatenate([qp.G, qp.R]), np.concatenate([self.below, qp.lower])
        data = (hessian, linear, qp.E, qp.e, rows, low, np.concatenate([qp.h, qp.upper]))
        if self.binding is not None:
            found = from_binding(*data, *self.binding)
            if found is not None:
                x, *self.binding, tries = found
                return checked_answer(qp, x, tries, "binding rows settled", True, phase, t)
        (self.solver.update if self.ready else self.solver.init)(*data)
        self.ready = True
        self.solver.solve()
        result = self.solver.results
        status = result.info.status
        x, good = np.array(result.x), status in GOOD_PROXQP
        if good:
            multipliers = np.array(result.z)
            self.binding = binding(rows, low, data[-1], x, multipliers)
            x = polished(*data, x, multipliers)
        return checked_answer(qp, x, int(result.info.iter), status.name, good, phase, t)


SOLVERS = {"cvxpy": CvxpySolver, "direct": DirectSolver}


def solver_class(method: str) -> type:
    """The solver class of a method's name."""
    if not isinstance(method, str) or method not in SOLVERS:
        raise InputError(f"stage 2: method {method!r} is unknown; it must be one of {', '.join(SOLVERS)}")
    return SOLVERS[method]
