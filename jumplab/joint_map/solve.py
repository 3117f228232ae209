"""Two ways to solve a :class:`StepQp`: cvxpy with Clarabel, as the notebook shows it, and ProxQP directly, for speed.

Both get the same matrices. A status is believed only if it is on the whitelist and the answer passes its rows again.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from proxsuite import proxqp

from jumplab.errors import InputError, SolverError
from jumplab.joint_map.problem import StepQp

GOOD_CVXPY = ("optimal",)
GOOD_PROXQP = (proxqp.QPSolverOutput.PROXQP_SOLVED,)
CLARABEL = {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}  # our choice: a tenth of the default
PROXQP_EPS = 1e-9  # our choice: the same, absolute
PROXQP_INFEASIBLE = 1e-12  # our choice: the default of 1e-4 called some feasible steps infeasible
PROXQP_ITERATIONS = 1000  # our choice: a step takes about ten; more than this is a failure
ROW_TOLERANCE = (
    1e-6  # our choice: re-evaluated row error, relative to the row's size, above which no answer is believed
)
CONFLICT_SHARE = 1e-3  # our choice: rows that give way by less than this share of the worst are not named
MAX_NAMED = 5


@dataclass(frozen=True)
class Answer:
    """Optimum of one step: ``x``, iterations, and the largest re-evaluated row error relative to the rows' sizes."""

    x: np.ndarray
    iterations: int
    residual: float


def row_scale(qp: StepQp) -> dict[str, np.ndarray]:
    """Size of every row of E, G and R: largest coefficient times 1, or the right side if larger; at least 1."""
    sides = {"E": np.abs(qp.e), "G": np.abs(qp.h), "R": np.minimum(np.abs(qp.lower), np.abs(qp.upper))}
    return {k: np.maximum(1.0, np.maximum(np.abs(getattr(qp, k)).max(axis=1, initial=0.0), sides[k])) for k in "EGR"}


def conflicts(qp: StepQp) -> tuple[str, ...]:
    """Rows that must give way if the QP is infeasible: those with slack in the least total (scaled) relaxation."""
    import cvxpy as cp  # half of what a new process spends on imports: only for those who use it

    x = cp.Variable(qp.A.shape[1])
    scale = row_scale(qp)
    give = {k: cp.Variable(len(scale[k]), nonneg=True) for k in "EGR" if len(scale[k])}
    zero = np.zeros(0)
    g = {k: cp.multiply(scale[k], give[k]) if k in give else zero for k in "EGR"}
    rows = [cp.abs(qp.E @ x - qp.e) <= g["E"], qp.R @ x <= qp.upper + g["R"], qp.R @ x >= qp.lower - g["R"]]
    rows += [qp.G @ x <= qp.h + g["G"]]
    problem = cp.Problem(cp.Minimize(sum(cp.sum(v) for v in give.values())), rows)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # only names are wanted
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:
        return ()
    if problem.status not in ("optimal", "optimal_inaccurate"):
        return ()
    found = [(float(v), float(s), name) for k in give
             for v, s, name in zip(give[k].value, scale[k], qp.layout.labels[k], strict=True)]  # fmt: skip
    worst = max(v for v, _, _ in found)
    named = sorted((f for f in found if f[0] > max(CONFLICT_SHARE * worst, 1e-7)), reverse=True)
    return tuple(f"{name}: off by {v * s:.3g}" for v, s, name in named[:MAX_NAMED])


def checked_answer(qp: StepQp, x, iterations: int, status: str, good: bool, phase: str, t: float) -> Answer:
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
    rows = conflicts(qp)
    if rows:
        reason = f"these rows conflict: {'; '.join(rows)}"
    elif np.isfinite(residual):
        reason = f"the rows are compatible, but the answer misses '{worst}' by {residual:.2g} of its size"
    else:
        reason = "the rows are compatible, but there is no finite answer"
    raise SolverError(
        f"stage 2, {phase} QP at t = {t:.3f} s: {status}; {reason}; relax those limits or ask for an easier jump",
        stage="joint_map", status=status, violations=rows,
    )  # fmt: skip


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


class DirectSolver:
    """ProxQP's dense solver, set up once and updated at every step.

    On the 171 QPs of one jump it took 9 ms, PIQP 20 ms, both to the same 1e-9.
    """

    name = "direct"

    def __init__(self, example: StepQp):
        inequalities = len(example.G) + len(example.R)
        self.solver, self.ready = proxqp.dense.QP(example.A.shape[1], len(example.E), inequalities), False
        settings = self.solver.settings
        settings.eps_abs, settings.eps_primal_inf, settings.max_iter = PROXQP_EPS, PROXQP_INFEASIBLE, PROXQP_ITERATIONS
        self.below = np.full(len(example.G), -np.inf)

    def solve(self, qp: StepQp, phase: str, t: float) -> Answer:
        """Solve one step; raises :class:`SolverError` if there is no trustworthy answer."""
        hessian, linear = qp.A.T @ qp.A, -(qp.A.T @ qp.b)
        rows, low = np.concatenate([qp.G, qp.R]), np.concatenate([self.below, qp.lower])
        data = (hessian, linear, qp.E, qp.e, rows, low, np.concatenate([qp.h, qp.upper]))
        (self.solver.update if self.ready else self.solver.init)(*data)
        self.ready = True
        self.solver.solve()
        result = self.solver.results
        status = result.info.status
        x = np.array(result.x)
        return checked_answer(qp, x, int(result.info.iter), status.name, status in GOOD_PROXQP, phase, t)


SOLVERS = {"cvxpy": CvxpySolver, "direct": DirectSolver}


def solver_class(method: str):
    """The solver class of a method's name."""
    if method not in SOLVERS:
        raise InputError(f"stage 2: method {method!r} is unknown; it must be one of {', '.join(SOLVERS)}")
    return SOLVERS[method]
