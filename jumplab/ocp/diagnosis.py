"""Why there is no plan: terms that are no number, or terms that cannot be met together, by an elastic re-solve."""

from __future__ import annotations

import casadi as ca
import numpy as np

from jumplab.errors import InputError, SolverError
from jumplab.ocp.assembly import Assembled, Posed, unpack
from jumplab.ocp.derivatives import scatter

NAMED = 4  # so many terms are named at most
CONFLICT_LIMIT = 1e-3  # scaled row error that is worth a word
COST_SHARE = 1e-4  # enough of the cost to keep the motion sane, too little to buy violations
ELASTIC = {"tol": 1e-4, "acceptable_tol": 1e-3, "max_iter": 200, "max_wall_time": 15.0}  # [s]
ELASTIC |= {"mu_strategy": "adaptive", "nlp_scaling_method": "none", "print_level": 0, "sb": "yes"}


def failure(a: Assembled, posed: Posed, last: np.ndarray, status: str, iterations: int, explain: bool) -> SolverError:
    """What to say of a solve that ended at ``last`` (n,); to ``explain`` a conflict costs about as much as a solve."""
    name = a.problem.name
    said, violations = f"{name}: no plan ({status} after {iterations} iterations)", ()
    for where, x in {"initial guess": posed.x0, "last iterate": last}.items():
        violations = _without_number(a, x, posed.p)
        if violations:
            said += f": no finite value or slope at the {where} has {' or '.join(violations[:NAMED])}"
            said += "; keep its arguments where it is defined, or start from another guess"
            break
    if explain and not violations:
        violations = _conflicts(a, posed)
        if violations:
            said += f": the best compromise still violates {'; '.join(violations)}"
            said += "; ask for less, or give these terms more room"
        else:
            said += ": a motion that meets every constraint exists, but the search did not settle; try another guess"
    return SolverError(said, stage=name, status=status, violations=violations)


def check_start(a: Assembled, posed: Posed) -> None:
    """Refuse (:class:`InputError`) own terms without a finite value or derivative where a solve would begin."""
    if not a.problem.own or _all_finite(a, posed):
        return
    lost = {x.partition(" at node ")[0] for x in _without_number(a, posed.x0, posed.p)}
    own = [(owner, name) for owner, name in a.problem.own if f"{owner}/{name}" in lost or not lost]
    if own:
        who = " or ".join(f"{name!r} of {a.problem.place(owner)!r}" for owner, name in own)
        raise InputError(
            f"term {who}: no finite value or derivative at the start of the solve; keep its arguments where it is "
            f"defined, for instance x + 1e-6 under a root"
        )


def _all_finite(a: Assembled, posed: Posed) -> bool:
    """Whether values, slopes and curvature at the start are numbers; cheap."""
    found = *a.grad_f(posed.x0, posed.p), *a.jac_g(posed.x0, posed.p)
    found = *found, a.hess_lag(posed.x0, posed.p, 1.0, np.ones(a.n_rows))
    return all(np.all(np.isfinite(np.array(x.nonzeros()))) for x in found)


def _without_number(a: Assembled, x: np.ndarray, p: np.ndarray) -> tuple[str, ...]:
    """Terms with a value or slope at ``x`` that is not finite; ipopt says only that some are."""
    phases, named = unpack(a, x), {}
    slope = a.jac_g(x, p)[1]
    bad = ~np.isfinite(a.nlp(x, p)[1].full().ravel())
    bad[np.array(slope.sparsity().row(), int)[~np.isfinite(np.array(slope.nonzeros()))]] = True
    for row in (a.rows[i] for i in np.flatnonzero(bad)):
        when = f", t = {phases[row.owner].t[row.node]:.3f} s of the phase" if row.owner in phases else ""
        named.setdefault(f"{row.owner}/{row.term.name}", f" at node {row.node}{when}")
    lost = ~np.isfinite(a.cost_parts(x, p).full().ravel())
    if not lost.any():  # slopes only then: a value that is no number spoils the slopes of its neighbours
        lost = ~np.isfinite(a.cost_parts.jacobian()(x, p, 0)[0].full()).all(axis=1)
    for owner, term in (a.cost_terms[i] for i in np.flatnonzero(lost)):
        named.setdefault(f"{owner}/{term.name}", "")
    return tuple(name + place for name, place in named.items())


def _conflicts(a: Assembled, posed: Posed) -> tuple[str, ...]:
    """The terms that the least violating motion violates most, where and by how much, in their units."""
    x, beyond = _least_violation(a, posed)
    phases, worst = unpack(a, x), {}
    for row, amount in zip(a.rows, beyond, strict=True):
        name = f"{row.owner}/{row.term.name}"
        if amount > max(CONFLICT_LIMIT, worst.get(name, (0.0,))[0]):
            when = f" at t = {phases[row.owner].t[row.node]:.3f} s of the phase" if row.owner in phases else ""
            worst[name] = amount, f"{name} by {amount * row.term.scale:.3g} {row.term.unit}{when}"
    ranked = sorted(worst.values(), key=lambda found: -found[0])
    return tuple(text for _, text in ranked[:NAMED])


def _least_violation(a: Assembled, posed: Posed) -> tuple[np.ndarray, np.ndarray]:
    """The motion (n,) with the least sum of row violations plus a trace of the cost, and its violations (n_rows,).

    Identities, which say only that the motion is one motion, stay hard.
    """
    index = np.flatnonzero([not row.term.identity for row in a.rows])
    n, m, place = a.size, len(index), scatter(index, a.n_rows)
    w, p = ca.MX.sym("w", n + 2 * m), ca.MX.sym("p", a.p_size)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", a.n_rows)
    x, over, under = w[:n], w[n : n + m], w[n + m :]
    f, g = a.nlp(x, p)
    cost = COST_SHARE * f + ca.sum1(over) + ca.sum1(under)
    relaxed = g - place @ over + place @ under
    gradient = ca.vertcat(COST_SHARE * a.grad_f(x, p)[1], ca.DM.ones(2 * m))
    jacobian = ca.horzcat(a.jac_g(x, p)[1], -place, place)
    hessian = ca.diagcat(a.hess_lag(x, p, COST_SHARE * lam_f, lam_g), ca.MX(2 * m, 2 * m))
    names, of_hessian = ["x", "p"], ["x", "p", "lam_f", "lam_g"]
    options = {
        "ipopt": ELASTIC,
        "print_time": False,
        "error_on_fail": False,
        "grad_f": ca.Function("nlp_grad_f", [w, p], [cost, gradient], names, ["f", "grad_f_x"]),
        "jac_g": ca.Function("nlp_jac_g", [w, p], [relaxed, jacobian], names, ["g", "jac_g_x"]),
        "hess_lag": ca.Function("nlp_hess_l", [w, p, lam_f, lam_g], [hessian], of_hessian, ["triu_hess_gamma_x_x"]),
    }
    nlp = ca.Function("nlp", [w, p], [cost, relaxed], names, ["f", "g"])
    solver = ca.nlpsol("elastic", "ipopt", nlp, options)
    g0 = a.nlp(posed.x0, posed.p)[1].full().ravel()[index]
    (low, high), (row_low, row_high) = posed.box, posed.rows
    start = np.concatenate([posed.x0, np.maximum(g0 - row_high[index], 0.0), np.maximum(row_low[index] - g0, 0.0)])
    lbx, ubx = np.concatenate([low, np.zeros(2 * m)]), np.concatenate([high, np.full(2 * m, np.inf)])
    answer = solver(x0=np.nan_to_num(start), p=posed.p, lbx=lbx, ubx=ubx, lbg=row_low, ubg=row_high)
    best = answer["x"].full().ravel()[:n]
    beyond = posed.beyond(a.nlp(best, posed.p)[1].full().ravel())
    return best, np.nan_to_num(beyond, nan=np.inf)
