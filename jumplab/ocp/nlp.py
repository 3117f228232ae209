"""Solving an assembled problem, with ipopt or by a few Gauss-Newton steps, and saying what came out."""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import copy
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import SolverError
from jumplab.ocp.assembly import Posed, pack_multipliers, pose, unpack, unpack_multipliers
from jumplab.ocp.cache import assembled
from jumplab.ocp.derivatives import JERK_CHAIN
from jumplab.ocp.diagnosis import check_start, failure
from jumplab.ocp.problem import Problem
from jumplab.ocp.solution import Multipliers, Near, PhaseGuess, Solution, Statistics
from jumplab.ocp.sqp import GaussNewton

GOOD_STATUSES = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
RESIDUAL_LIMIT = 1e-4  # scaled row error above which a "solved" status is not believed
IPOPT = {
    "tol": 1e-6,  # scaled; the tape's own audit is the judge of physics
    "constr_viol_tol": 1e-6,
    "acceptable_tol": 1e-4,
    "acceptable_constr_viol_tol": 1e-5,
    "max_iter": 300,
    "max_wall_time": 60.0,  # [s]; a solve that needs longer is lost, not slow
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


class Nlp:
    """A problem ready to be solved for any target.

    Building is pure and done once; :meth:`solve` may be called for any parameters, weights and switches.

    Parameters
    ----------
    problem : what to solve.
    options : of ipopt, besides :data:`IPOPT`.
    key : if given, what is built is kept for later processes, see :func:`jumplab.ocp.cache.assembled`.
    like : the same problem, ready on another mesh; saves most of the building.
    """

    def __init__(
        self, problem: Problem, options: Mapping | None = None, key: str | None = None, like: Nlp | None = None
    ):
        began = time.perf_counter()
        self.problem, self._options = problem, {**IPOPT, **(options or {})}
        self.assembled = assembled(problem, key) if like is None else like.assembled.on_mesh_of(problem)
        self.build_s = time.perf_counter() - began

    def with_options(self, options: Mapping) -> Nlp:
        """The same problem, already built, under other options of ipopt."""
        other = copy(self)
        other._options = {**IPOPT, **options}
        other.__dict__.pop("_solver", None)
        return other

    def prepare(self) -> Nlp:
        """Make the solver now; else the first :meth:`solve` does, which takes some ten milliseconds more."""
        _ = self._solver
        return self

    @cached_property
    def _solver(self) -> ca.Function:
        a = self.assembled
        options = {"ipopt": self._options, "grad_f": a.grad_f, "jac_g": a.jac_g, "hess_lag": a.hess_lag}
        quiet = ("print_time", "error_on_fail", "show_eval_warnings", "calc_lam_p")
        return ca.nlpsol("solver", "ipopt", a.nlp, options | dict.fromkeys(quiet, False))

    @cached_property
    def _gauss_newton(self) -> GaussNewton:
        return GaussNewton(self.assembled)

    def gauss_newton_steps(self, parameters: Mapping, guess: Mapping[str, PhaseGuess], **how: Any) -> Near:
        """Come near a solution in a few steps; ``how`` are references, weights, off as of :meth:`solve`.

        Raises
        ------
        SolverError
            If a step is no number.
        """
        a, posed = self.assembled, pose(self.assembled, parameters, guess, **how)
        check_start(a, posed)
        try:
            method, began = self._gauss_newton, time.perf_counter()
        except ValueError as e:  # a term joins what is not neighbouring: no stage-by-stage order, so no steps
            raise SolverError(str(e), stage=a.problem.name, status="approach") from e
        x, count = method.steps(posed)
        f, g = (y.full().ravel() for y in a.nlp(x, posed.p))
        spent, residual = time.perf_counter() - began, float(np.max(posed.beyond(g), initial=0.0))
        statistics = Statistics(count, "Approached", self.build_s, spent, len(x), len(g), float(f[0]), residual)
        return Near(unpack(a, x), statistics)

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

        Parameters
        ----------
        parameters : name -> number or column, exactly those of the problem.
        guess : phase name -> initial values.
        references : phase name -> reference name -> (size, N + 1).
        weights : term name (or "phase/name") -> weight, instead of the term's own.
        off : names of terms and bounds to leave out.
        multipliers : of a solution close by, on any mesh; used if ipopt's option ``warm_start_init_point`` is "yes".
        explain : look for the terms in conflict if there is no solution; it costs about as much as the solve.

        Raises
        ------
        SolverError
            If ipopt stops without an acceptable point or the re-evaluated rows contradict it; says which terms are
            violated, where and by how much.
        """
        a, posed = self.assembled, pose(self.assembled, parameters, guess, references, weights, off)
        check_start(a, posed)
        (lbx, ubx), (lbg, ubg), start = posed.box, posed.rows, {}
        if multipliers is not None:
            start = dict(zip(("lam_x0", "lam_g0"), pack_multipliers(a, multipliers), strict=True))
        began = time.perf_counter()
        answer = self._solver(x0=posed.x0, p=posed.p, lbx=lbx, ubx=ubx, lbg=lbg, ubg=ubg, **start)
        solve_s, stats = time.perf_counter() - began, self._solver.stats()
        x, g, lam_x, lam_g = (answer[key].full().ravel() for key in ("x", "g", "lam_x", "lam_g"))
        status, iterations = stats["return_status"], int(stats["iter_count"])
        residual = float(np.max(posed.beyond(g), initial=0.0)) if np.all(np.isfinite(g)) else float("inf")
        if status not in GOOD_STATUSES or not residual < RESIDUAL_LIMIT:
            raise failure(a, posed, x, status, iterations, explain)
        sizes, cost = (len(x), len(g)), float(answer["f"])
        functions_s = sum(value for key, value in stats.items() if key.startswith("t_proc_nlp_"))
        statistics = Statistics(iterations, status, self.build_s, solve_s, *sizes, cost, residual, functions_s)
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
