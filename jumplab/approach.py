"""Coming near a solution in few steps: Gauss-Newton with a QP solver that knows the order of time (HPIPM).

Each step solves the problem with its rows linearised and its costs, which are sums of squares, without their curvature.
That QP is convex and its solver takes a stage at a time, so a step costs less than one of the interior-point method on
the whole problem, and many limits may become active at once. It leaves the last digits to that method.
"""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO

import casadi as ca
import numpy as np

from jumplab.errors import SolverError
from jumplab.staged import StagedOrder
from jumplab.transcription import Assembled

STEPS = 7  # our choice: further ones cost more than they save the solve that follows
SHORTEST = 0.2  # our choice: share of a step below which it is taken all the same; the next linearisation helps more
FREE = 1e6  # our choice: stands for no limit, scaled; HPIPM takes finite bounds only
# our choice: a step is only a step; with HPIPM's own tolerances (1e-8) it takes half as long again and leads no nearer
HPIPM = {"mode": "speed", "iter_max": 30, "res_g_max": 1e-2, "res_b_max": 1e-4, "res_d_max": 1e-4, "res_m_max": 1e-3}
PENALTY_SHARE = 99  # our choice: percentile of the multipliers that the penalty must exceed; single ones are larger
DESCENT = 1e-4  # Armijo's usual share


class Approach:
    """Gauss-Newton steps for one assembled problem, built once."""

    def __init__(self, a: Assembled):
        self.a, self.order = a, StagedOrder(a)
        self._step = self._build()

    def _build(self) -> ca.Function:
        """(x, p, box, rows) -> step, multipliers of the rows, cost, its descent, rows."""
        a, o, n = self.a, self.order, len(self.order.source)
        x, p = ca.MX.sym("x", a.size), ca.MX.sym("p", a.p_size)
        low, high = ca.MX.sym("low", a.size), ca.MX.sym("high", a.size)
        row_low, row_high = ca.MX.sym("row_low", a.n_rows), ca.MX.sym("row_high", a.n_rows)
        (g, jac), (f, slope) = a.jac_g(x, p), a.grad_f(x, p)
        hess, jac = o.hessian(a.gauss_newton(x, p).nz[:]), o.jacobian(jac.nz[:])
        kept = np.flatnonzero(o.kept)
        put = ca.DM.triplet(o.place[kept].tolist(), kept.tolist(), ca.DM.ones(len(kept)), o.n_rows, a.n_rows)
        spread = ca.DM.triplet(o.copy.tolist(), list(range(a.size)), ca.DM.ones(a.size), n, a.size)
        far = spread @ ca.DM.ones(a.size) - 1  # -1 for further copies of constants, which no bound is needed for
        qp = _qp_solver(o, hess.sparsity(), jac.sparsity())
        found = qp(h=hess, g=spread @ slope, a=jac, lba=put @ _finite(row_low - g), uba=put @ _finite(row_high - g),
                   lbx=spread @ _finite(low - x) + FREE * far, ubx=spread @ _finite(high - x) - FREE * far)  # fmt: skip
        step, lam = found["x"][o.copy.tolist()], put.T @ found["lam_a"]
        return ca.Function("step", [x, p, low, high, row_low, row_high], [step, lam, f, ca.dot(slope, step), g])

    def solve(self, x: np.ndarray, p: np.ndarray, box: tuple, rows: tuple) -> tuple[np.ndarray, int]:
        """From ``x`` towards a solution.

        Parameters
        ----------
        x, p : start (n,) within ``box``, parameters.  box, rows : (lower, upper) of variables and of rows.

        Returns
        -------
        x, steps : a point near the solution, its rows not yet met, and the number of steps.

        Raises
        ------
        SolverError
            If a QP has no solution, or a step is no number.
        """
        penalty = 0.0
        for count in range(1, STEPS + 1):
            step, lam, f, descent, g = (y.full().ravel() for y in self._step(x, p, *box, *rows))
            if not np.all(np.isfinite(step)) or not np.all(np.isfinite(lam)):
                raise SolverError(f"{self.a.problem.name}: step {count} of the approach is no number",
                                  stage=self.a.problem.name, status="approach")  # fmt: skip
            beyond = _beyond(g, rows)
            penalty = max(penalty, float(np.percentile(np.abs(lam), PENALTY_SHARE)))
            merit, slope = f[0] + penalty * beyond, descent[0] - penalty * beyond
            share = 1.0
            while share > SHORTEST:
                f, g = (y.full().ravel() for y in self.a.nlp(x + share * step, p))
                if f[0] + penalty * _beyond(g, rows) <= merit + DESCENT * share * slope:
                    break
                share /= 2
            x = np.clip(x + share * step, *box)
        return x, count


def _qp_solver(order: StagedOrder, hess: ca.Sparsity, jac: ca.Sparsity) -> ca.Function:
    """HPIPM for QPs of these patterns in that order."""
    options = {"N": order.N, "nx": order.nx, "nu": order.nu, "ng": order.ng, "inf": FREE, "hpipm": HPIPM,
               "error_on_fail": False, "print_time": False}  # fmt: skip
    with redirect_stdout(StringIO()):  # making it, CasADi tells the stages' sizes
        return ca.conic("qp", "hpipm", {"h": hess, "a": jac}, options)


def _finite(values: ca.MX) -> ca.MX:
    return ca.fmax(ca.fmin(values, FREE), -FREE)


def _beyond(g: np.ndarray, rows: tuple) -> float:
    return float(np.maximum(np.maximum(rows[0] - g, g - rows[1]), 0.0).sum())
