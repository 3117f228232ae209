"""Solving an assembled problem, with ipopt, and saying what came out.

Where no plan comes out, it says why: terms that are no number, or terms that cannot be met together, by an elastic
re-solve.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextvars import ContextVar
from copy import copy
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.errors import InputError, SolverError
from jumplab.io.progress import tell
from jumplab.ocp.assembly import Assembled, Posed, pack_multipliers, pose, unpack, unpack_multipliers
from jumplab.ocp.cache import assembled
from jumplab.ocp.derivatives import JERK_CHAIN, scatter
from jumplab.ocp.problem import Problem
from jumplab.ocp.solution import Multipliers, PhaseGuess, Solution, Statistics

EXPLAINED: ContextVar[bool] = ContextVar("explained", default=True)  # off where nobody reads why there is no plan
GOOD_STATUSES = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
RESIDUAL_LIMIT = 1e-4  # scaled row error above which a "solved" status is not believed
IPOPT = {
    "tol": 1e-6,  # scaled; the tape's own audit is the judge of physics
    "constr_viol_tol": 1e-6,
    "acceptable_tol": 1e-4,
    "acceptable_constr_viol_tol": 1e-5,
    "max_iter": 300,
    "max_cpu_time": 60.0,  # [s]; a solve that needs longer is lost, not slow; of its own time, whatever else runs
    "mu_strategy": "adaptive",
    "mumps_pivot_order": 0,  # AMD; MUMPS's own choice for large problems doubles the time of an iteration
    "nlp_scaling_method": "none",  # the terms carry their scales, which also spares MUMPS its own ...
    "mumps_permuting_scaling": 0,
    "mumps_scaling": 0,
    "min_refinement_steps": 0,  # ... and a refinement of every step
    "print_level": 0,
    "sb": "yes",
}
# to begin from a solution close by with its multipliers: the start is not pushed away from its limits
PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")
WARM = {"warm_start_init_point": "yes"} | {f"warm_start_{push}": 1e-6 for push in PUSHES}
# for saying why a solve failed
NAMED = 4  # so many terms are named at most
CONFLICT_LIMIT = 1e-3  # scaled row error that is worth a word
COST_SHARE = 1e-4  # enough of the cost to keep the motion sane, too little to buy violations
ELASTIC = {"tol": 1e-4, "acceptable_tol": 1e-3, "max_iter": 200, "max_cpu_time": 15.0}  # [s]
ELASTIC |= {"mu_strategy": "adaptive", "nlp_scaling_method": "none", "print_level": 0, "sb": "yes"}


class Nlp:
    """A problem ready to be solved for any target.

    Building is pure and done once; :meth:`solve` may be called for any parameters, weights and switches.

    Parameters
    ----------
    problem : what to solve.
    options : of ipopt, besides :data:`IPOPT`.
    key : if given, what is built is kept for later processes, see :func:`jumplab.ocp.cache.assembled`.
    """

    def __init__(self, problem: Problem, options: Mapping | None = None, key: str | None = None):
        began = time.perf_counter()
        tell(f"building {problem.name}")
        self.problem, self._options, self._hold = problem, {**IPOPT, **(options or {})}, None
        self.assembled = assembled(problem, key)
        self.build_s = time.perf_counter() - began

    def with_options(self, options: Mapping, hold: float | None = None) -> Nlp:
        """The same problem, already built, under other options of ipopt.

        With ``hold`` ipopt gets :meth:`.Assembled.held_hessian` instead of the exact Hessian.
        """
        other = copy(self)
        other._options, other._hold = {**IPOPT, **options}, hold
        other.__dict__.pop("_solver", None)
        return other

    def prepare(self) -> Nlp:
        """Make the solver now; else the first :meth:`solve` does, which takes some ten milliseconds more."""
        _ = self._solver
        return self

    @cached_property
    def _solver(self) -> ca.Function:
        a = self.assembled
        hessian = a.hess_lag if self._hold is None else a.held_hessian(self._hold)
        options = {"ipopt": self._options, "grad_f": a.grad_f, "jac_g": a.jac_g, "hess_lag": hessian}
        quiet = ("print_time", "error_on_fail", "show_eval_warnings", "calc_lam_p")
        options |= dict.fromkeys(quiet, False) | {"no_nlp_grad": True}  # all derivatives are given
        return ca.nlpsol("solver", "ipopt", a.nlp, options)

    def solve(
        self,
        parameters: Mapping,
        guess: Mapping[str, PhaseGuess],
        *,
        references: Mapping | None = None,
        weights: Mapping[str, float] | None = None,
        off: tuple[str, ...] = (),
        multipliers: Multipliers | None = None,
        explain: bool = True,
    ) -> Solution:
        """Solve for one target.

        Raises :class:`SolverError` if ipopt stops without an acceptable point or the re-evaluated rows contradict it;
        it says which terms are violated, where and by how much.

        Parameters
        ----------
        parameters : name -> number or column, exactly those of the problem.
        guess : phase name -> initial values.
        references : phase name -> reference name -> (size, N + 1).
        weights : term name (or "phase/name") -> weight, instead of the term's own.
        off : names of terms and bounds to leave out.
        multipliers : of a solution close by, on any mesh; used if ipopt's option ``warm_start_init_point`` is "yes".
        explain : look for the terms in conflict if there is no solution; it costs about as much as the solve.
        """
        a, posed = self.assembled, pose(self.assembled, parameters, guess, references, weights, off)
        check_start(a, posed)
        (lbx, ubx), (lbg, ubg), start = posed.box, posed.rows, {}
        if multipliers is not None:
            start = dict(zip(("lam_x0", "lam_g0"), pack_multipliers(a, multipliers), strict=True))
        tell(f"solving {a.problem.name}")
        began = time.perf_counter()
        answer = self._solver(x0=posed.x0, p=posed.p, lbx=lbx, ubx=ubx, lbg=lbg, ubg=ubg, **start)
        solve_s, stats = time.perf_counter() - began, self._solver.stats()
        x, g, lam_x, lam_g = (answer[key].full().ravel() for key in ("x", "g", "lam_x", "lam_g"))
        status, iterations = stats["return_status"], int(stats["iter_count"])
        residual = float(np.max(posed.beyond(g), initial=0.0)) if np.all(np.isfinite(g)) else float("inf")
        if status not in GOOD_STATUSES or not residual < RESIDUAL_LIMIT:
            raise _failure(a, posed, x, status, iterations, explain and EXPLAINED.get())
        functions_s = sum(value for key, value in stats.items() if key.startswith("t_proc_nlp_"))
        return self._solution(posed, (x, lam_x, lam_g), iterations, status, solve_s, functions_s)

    def _solution(
        self,
        posed: Posed,
        found: Sequence[np.ndarray],
        count: int,
        status: str,
        solve_s: float,
        functions_s: float = 0.0,
    ) -> Solution:
        """The solution of ``found``: scaled variables, multipliers of their bounds, multipliers of the rows."""
        a, (x, lam_x, lam_g) = self.assembled, found
        f, g = (y.full().ravel() for y in a.nlp(x, posed.p))
        residual = float(np.max(posed.beyond(g), initial=0.0))
        sizes = len(x), len(g)
        statistics = Statistics(count, status, self.build_s, solve_s, *sizes, float(f[0]), residual, functions_s)
        tables = self._cost_shares(x, posed.p), self._constraint_report(g, posed)
        return Solution(unpack(a, x), statistics, self.problem, *tables, unpack_multipliers(a, lam_x, lam_g))

    def _cost_shares(self, x: np.ndarray, p: np.ndarray) -> tuple[dict, ...]:
        a = self.assembled
        weights = p[a.n_par : a.n_par + a.n_weight]
        costs = a.cost_parts(x, p).full().ravel() * weights
        shares = costs / (costs.sum() or 1.0)
        values = zip(a.cost_terms, weights.tolist(), costs.tolist(), shares.tolist(), strict=True)
        return tuple(
            dict(phase=owner, name=t.name, equation=t.equation, weight=weight, cost=cost, share=share)
            for (owner, t), weight, cost, share in values
        )

    def _constraint_report(self, g: np.ndarray, posed: Posed) -> tuple[dict, ...]:
        """The tightest row of each constraint."""
        out, (low, high), rows = [], posed.rows, self.assembled.rows
        for owner, term, i in self.assembled.groups:
            slack = np.minimum(g[i] - low[i], high[i] - g[i])
            if term.name == JERK_CHAIN or not np.any(np.isfinite(slack)):
                continue
            row, least = i.flat[np.argmin(slack)], float(slack.min() * term.scale)
            kind, value = "equality" if low[row] == high[row] else "inequality", float(g[row] * term.scale)
            about = dict(phase=owner, name=term.name, equation=term.equation, unit=term.unit, kind=kind)
            out.append(about | dict(node=rows[row].node, value=value, slack=least))
        return tuple(out)


# why there is no plan -----------------------------------------------------------------------------------------
def _failure(a: Assembled, posed: Posed, last: np.ndarray, status: str, iterations: int, explain: bool) -> SolverError:
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
            said += "; they leave each other no room"
        else:
            said += ": a motion that meets every constraint exists, but the search did not settle; try another guess"
    return SolverError(said, stage=name, status=status, violations=violations, iterations=iterations)


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
        "no_nlp_grad": True,
        "calc_lam_p": False,
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
