"""Reasons for the lack of a plan: terms that are no number, or terms that conflict."""

from __future__ import annotations

import casadi as ca
import numpy as np

from jumplab.errors import InputError
from jumplab.ocp.assembly import Assembled, ipopt, nlp_functions, scatter
from jumplab.ocp.posing import Posed, binding, unpack, unpack_multipliers

NAMED = 4  # so many terms are named at most
CONFLICT_LIMIT = 1e-3  # scaled row error that is worth a word
COST_SHARE = 1e-4  # enough of the cost to keep the motion sane, too little to buy violations
ELASTIC = {"tol": 1e-4, "acceptable_tol": 1e-3, "max_iter": 200, "max_cpu_time": 15.0}  # [s]
ELASTIC |= {"mu_strategy": "adaptive", "nlp_scaling_method": "none", "print_level": 0, "sb": "yes"}


def reasons(
    a: Assembled, posed: Posed, last: np.ndarray, explain: bool, seconds: float = np.inf
) -> tuple[str, tuple[str, ...], tuple]:
    """(end of a sentence, terms, limits) about a solve that ended at ``last`` (n,) without a plan.

    To ``explain`` a conflict costs about as much as a solve, ``seconds`` of processor time at most;
    else the terms are those that the last iterate violates. The limits, as :func:`.binding` has
    them, are those of the best compromise.
    """
    for where, x in {"initial guess": posed.x0, "last iterate": last}.items():
        lost = tuple(f"{name}{place}" for name, place in _without_number(a, x, posed.p).items())
        if lost:
            named = " or ".join(lost[:NAMED])
            return (
                f": {named} has no finite value or slope at the {where}; keep the arguments "
                "of the term where it is defined, or start from another guess",
                lost,
                (),
            )
    if not explain:
        return "", _violated(a, posed, last), ()
    x, *multipliers = _least_violation(a, posed, seconds)
    worst = _violated(a, posed, x)
    if not worst:
        return (
            ": a motion that meets every constraint exists, but the search did not settle; try "
            "another guess",
            (),
            (),
        )
    named = "; ".join(worst)
    sentence = f": the best compromise still violates {named}; these constraints conflict"
    return sentence, worst, (*binding(a, posed, unpack_multipliers(a, *multipliers)),)


def check_start(a: Assembled, posed: Posed) -> None:
    """Raise :class:`InputError` for own terms without a finite value or derivative where a solve
    would begin (n,).
    """
    if not a.problem.own:
        return
    x = posed.x0
    p = posed.p
    curved = a.gauss_newton(x, p), a.hess_lag(x, p, 1.0, np.ones(a.n_rows))
    values = *a.grad_f(x, p), *a.jac_g(x, p), *curved
    if all(np.all(np.isfinite(np.array(value.nonzeros()))) for value in values):
        return
    lost = _without_number(a, x, p)
    singular = [
        (owner, name) for owner, name in a.problem.own if f"{owner}/{name}" in lost or not lost
    ]
    if singular:
        who = " or ".join(f"{name!r} of {a.problem.place(owner)!r}" for owner, name in singular)
        raise InputError(
            f"term {who}: no finite value or derivative at the start of the solve; keep the "
            "arguments of its functions away from where they are singular, as in sqrt(x + 1e-6)"
        )


def _without_number(a: Assembled, x: np.ndarray, p: np.ndarray) -> dict[str, str]:
    """Terms with a value or slope at ``x`` that is not finite, and where; ipopt says only that some
    are.
    """
    phases = unpack(a, x)
    out: dict[str, str] = {}
    g, slope = (ca.DM(y) for y in a.jac_g(x, p))
    bad = ~np.isfinite(g.full().ravel())
    bad[np.array(slope.sparsity().row(), int)[~np.isfinite(np.array(slope.nonzeros()))]] = True
    for rows in a.rows:
        at = rows.nodes[bad[rows.index].any(axis=1)]
        if len(at):
            place = f" at node {at[0]}"
            if rows.owner in phases:
                place += f", t = {phases[rows.owner].t[at[0]]:.3f} s of the phase"
            out[f"{rows.owner}/{rows.term.name}"] = place
    lost = ~np.isfinite(a.cost_parts(x, p).full().ravel())
    # slopes only then: a value that is no number spoils the slopes of its neighbours
    if not lost.any():
        lost = ~np.isfinite(a.cost_parts.jacobian()(x, p, 0)[0].full()).all(axis=1)
    for i in np.flatnonzero(lost):
        owner, term = a.cost_terms[i]
        out[f"{owner}/{term.name}"] = ""
    return out


def _violated(a: Assembled, posed: Posed, x: np.ndarray) -> tuple[str, ...]:
    """The terms that a motion ``x`` (n,) violates most, where and by how much, in their units."""
    beyond = np.nan_to_num(posed.beyond(a.nlp(x, posed.p)[1].full().ravel()), nan=np.inf)
    phases = unpack(a, x)
    worst = []
    for rows in a.rows:
        most = beyond[rows.index].max(axis=1)
        amount = most.max()
        if amount > CONFLICT_LIMIT:
            term = rows.term
            text = f"{rows.owner}/{term.name} by {amount * term.scale:.3g} {term.unit}"
            if rows.owner in phases:
                at = phases[rows.owner].t[rows.nodes[most.argmax()]]
                text += f" at t = {at:.3f} s of the phase"
            worst.append((amount, text))
    return tuple(text for _, text in sorted(worst, key=lambda entry: -entry[0])[:NAMED])


def _least_violation(a: Assembled, posed: Posed, seconds: float) -> tuple[np.ndarray, ...]:
    """The motion (n,) with the least sum of row violations plus a trace of the cost, and the
    multipliers of its bounds (n,) and rows (n_rows,).

    Identities, which say only that the motion is one motion, stay hard.
    """
    index = np.sort(
        np.concatenate([rows.index.ravel() for rows in a.rows if not rows.term.identity])
    )
    n = a.size
    m = len(index)
    place = scatter(index, a.n_rows)
    gives = ca.horzcat(-place, place)
    w = ca.MX.sym("w", n + 2 * m)
    p = ca.MX.sym("p", a.p_size)
    lam_f = ca.MX.sym("lam_f")
    lam_g = ca.MX.sym("lam_g", a.n_rows)
    x, slack = ca.vertsplit(w, [0, n, n + 2 * m])
    f, g = a.nlp(x, p)
    hessian = a.hess_lag(x, p, COST_SHARE * lam_f, lam_g)
    functions = nlp_functions(
        (w, p, lam_f, lam_g),
        COST_SHARE * f + ca.sum1(slack),
        g + gives @ slack,
        ca.vertcat(COST_SHARE * a.grad_f(x, p)[1], ca.DM.ones(2 * m)),
        ca.horzcat(a.jac_g(x, p)[1], gives),
        ca.diagcat(hessian, ca.MX(2 * m, 2 * m)),
    )
    g0 = a.nlp(posed.x0, posed.p)[1].full().ravel()[index]
    low, high = (bound[index] for bound in posed.rows)
    start = np.concatenate([posed.x0, np.maximum(g0 - high, 0.0), np.maximum(low - g0, 0.0)])
    arguments = posed.arguments | {
        "x0": np.nan_to_num(start),
        "lbx": np.concatenate([posed.box[0], np.zeros(2 * m)]),
        "ubx": np.concatenate([posed.box[1], np.full(2 * m, np.inf)]),
    }
    options = ELASTIC | {"max_cpu_time": min(ELASTIC["max_cpu_time"], seconds)}
    answer = ipopt(functions, options)(**arguments)
    solution, lam_x, lam_g = (answer[key].full().ravel() for key in ("x", "lam_x", "lam_g"))
    return solution[:n], lam_x[:n], lam_g
