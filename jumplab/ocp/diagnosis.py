"""Elastic re-solve: when a problem has no solution, find the motion that violates its rows least."""

from __future__ import annotations

import casadi as ca
import numpy as np

from jumplab.ocp.assembly import Assembled

COST_SHARE = 1e-4  # our choice: enough of the cost to keep the motion sane, too little to buy violations
ELASTIC = {"tol": 1e-4, "acceptable_tol": 1e-3, "max_iter": 200, "max_wall_time": 15.0, "print_level": 0, "sb": "yes",
           "mu_strategy": "adaptive", "nlp_scaling_method": "none"}  # fmt: skip


def least_violation(
    a: Assembled, x0: np.ndarray, p: np.ndarray, box: tuple[np.ndarray, np.ndarray], rows: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the sum of row violations (L1) plus a trace of the cost, from ``x0``.

    Parameters
    ----------
    a : assembled problem.  x0, p : start and parameters.  box, rows : (lower, upper) of variables and of rows.

    Returns
    -------
    x, beyond : the motion found, and how far each row (scaled) lies outside its bounds; identities, which say
        only that the motion is one motion, stay hard.
    """
    soft = np.array([not row.term.identity for row in a.rows])
    index = np.flatnonzero(soft)
    n, m = a.size, len(index)
    place = ca.DM.triplet(index.tolist(), list(range(m)), ca.DM.ones(m), a.n_rows, m)
    w, q, lam_f, lam_g = (
        ca.MX.sym("w", n + 2 * m),
        ca.MX.sym("p", a.p_size),
        ca.MX.sym("lam_f"),
        ca.MX.sym("lam_g", a.n_rows),
    )
    x, over, under = w[:n], w[n : n + m], w[n + m :]
    f, g = a.nlp(x, q)
    cost = COST_SHARE * f + ca.sum1(over) + ca.sum1(under)
    relaxed = g - place @ over + place @ under
    gradient = ca.vertcat(COST_SHARE * a.grad_f(x, q)[1], ca.DM.ones(2 * m))
    jacobian = ca.horzcat(a.jac_g(x, q)[1], -place, place)
    hessian = ca.diagcat(a.hess_lag(x, q, COST_SHARE * lam_f, lam_g), ca.MX(2 * m, 2 * m))
    options = {
        "ipopt": ELASTIC,
        "print_time": False,
        "error_on_fail": False,
        "grad_f": ca.Function("nlp_grad_f", [w, q], [cost, gradient], ["x", "p"], ["f", "grad_f_x"]),
        "jac_g": ca.Function("nlp_jac_g", [w, q], [relaxed, jacobian], ["x", "p"], ["g", "jac_g_x"]),
        "hess_lag": ca.Function("nlp_hess_l", [w, q, lam_f, lam_g], [hessian], ["x", "p", "lam_f", "lam_g"],
                                ["triu_hess_gamma_x_x"]),
    }  # fmt: skip
    nlp = ca.Function("nlp", [w, q], [cost, relaxed], ["x", "p"], ["f", "g"])
    solver = ca.nlpsol("elastic", "ipopt", nlp, options)
    g0 = a.nlp(x0, p)[1].full().ravel()[index]
    low, high = rows[0][index], rows[1][index]
    start = np.concatenate([x0, np.maximum(g0 - high, 0.0), np.maximum(low - g0, 0.0)])
    slack = np.zeros(2 * m), np.full(2 * m, np.inf)
    answer = solver(x0=np.nan_to_num(start), p=p, lbx=np.concatenate([box[0], slack[0]]),
                    ubx=np.concatenate([box[1], slack[1]]), lbg=rows[0], ubg=rows[1])  # fmt: skip
    best = answer["x"].full().ravel()[:n]
    g = a.nlp(best, p)[1].full().ravel()
    beyond = np.maximum(np.maximum(rows[0] - g, g - rows[1]), 0.0)
    return best, np.nan_to_num(beyond, nan=np.inf)
