"""Solving an assembled problem with ipopt, and saying what came out: cost shares, tightest rows, or why not."""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.errors import InputError, SolverError
from jumplab.ocp.assembly import (
    group_rows,
    is_off,
    pack,
    pack_multipliers,
    row_bounds,
    unpack,
    unpack_multipliers,
    variable_bounds,
)
from jumplab.ocp.cache import assembled
from jumplab.ocp.diagnosis import least_violation
from jumplab.ocp.problem import Problem
from jumplab.ocp.solution import Multipliers, Near, PhaseGuess, PhaseSolution, Solution, Statistics
from jumplab.ocp.sqp import Approach

__all__ = ["GOOD_STATUSES", "IPOPT", "WARM", "Near", "Nlp", "PhaseGuess", "PhaseSolution", "Solution", "Statistics"]

GOOD_STATUSES = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
RESIDUAL_LIMIT = 1e-4  # our choice: scaled row error above which a "solved" status is not believed
CONFLICT_LIMIT = 1e-3  # our choice: scaled row error that an explanation mentions
IPOPT = {
    "tol": 1e-6,  # our choice: scaled; the tape's own audit is the judge of physics
    "constr_viol_tol": 1e-6,
    "acceptable_tol": 1e-4,
    "acceptable_constr_viol_tol": 1e-5,
    "max_iter": 300,
    "max_wall_time": 60.0,  # [s]; a solve that needs longer is lost, not slow
    "mu_strategy": "adaptive",
    "mumps_pivot_order": 0,  # AMD; beyond 10 000 rows MUMPS would choose METIS, and an iteration costs twice as much
    "nlp_scaling_method": "none",  # the terms carry their scales, which also spares MUMPS its own ...
    "mumps_permuting_scaling": 0,
    "mumps_scaling": 0,
    "min_refinement_steps": 0,  # ... and a refinement of every step: as many iterations, each in 0.86 of the time
    "print_level": 0,
    "sb": "yes",
}


# our choice: begun from a solution close by with its multipliers, the start is not pushed away from its limits
WARM = {"warm_start_init_point": "yes", "warm_start_bound_push": 1e-6, "warm_start_bound_frac": 1e-6,
        "warm_start_slack_bound_push": 1e-6, "warm_start_slack_bound_frac": 1e-6,
        "warm_start_mult_bound_push": 1e-6}  # fmt: skip


@dataclass(frozen=True)
class _Posed:
    """A problem's numbers for one target: start, parameters, (lower, upper) of variables and of rows."""

    x0: np.ndarray
    p: np.ndarray
    box: tuple[np.ndarray, np.ndarray]
    rows: tuple[np.ndarray, np.ndarray]


class Nlp:
    """A problem ready to be solved for any target.

    Building is pure and done once; :meth:`solve` may be called for any parameters, weights and switches. With a ``key``
    its functions are kept for later processes (:mod:`jumplab.ocp.cache`); ``like`` is the same problem, ready on
    another mesh, and saves most of the building.
    """

    def __init__(self, problem: Problem, options: Mapping | None = None, key: str | None = None,
                 like: Nlp | None = None):  # fmt: skip
        began = time.perf_counter()
        self.problem = problem
        self.assembled = assembled(problem, key) if like is None else like.assembled.on_mesh_of(problem)
        self.groups, self._options = group_rows(self.assembled), {**IPOPT, **(options or {})}
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
    def _solver(self):
        a = self.assembled
        return ca.nlpsol("solver", "ipopt", a.nlp, {
            "ipopt": self._options, "print_time": False, "error_on_fail": False,
            "show_eval_warnings": False, "calc_lam_p": False,
            "grad_f": a.grad_f, "jac_g": a.jac_g, "hess_lag": a.hess_lag,
        })  # fmt: skip

    def _check_weights(self, weights):
        costs = {name for owner, t in self.assembled.cost_terms for name in (t.name, f"{owner}/{t.name}")}
        for name in weights:
            if name not in costs:
                raise InputError(
                    f"{self.problem.name}: {name!r} is a constraint and has no weight; switch it off instead"
                )

    # building blocks of one solve -------------------------------------------------------------------------------
    def _parameter_vector(self, parameters, references, weights, off):
        a, problem = self.assembled, self.problem
        unknown = set(parameters) ^ set(problem.parameters)
        if unknown:
            raise InputError(
                f"{problem.name}: parameters {sorted(unknown)} do not fit; it takes {list(problem.parameters)}"
            )
        values = [self._parameter(n, parameters[n], s) for n, s in problem.parameters.items()]
        weight = []
        for owner, term in a.cost_terms:
            w = weights.get(f"{owner}/{term.name}", weights.get(term.name, term.weight))
            weight.append(0.0 if is_off(owner, term.name, off) else w)
        columns = self._reference_columns(references)
        vector = np.concatenate([np.concatenate([*values, [0.0]])[:-1], weight, *columns])
        if not np.all(np.isfinite(vector)):
            raise InputError(f"{problem.name}: a parameter or weight is not finite")
        return vector

    def _parameter(self, name, value, size):
        try:
            x = np.asarray(value, float).ravel()
        except (TypeError, ValueError):
            raise InputError(f"{self.problem.name}: parameter {name!r} = {value!r} is not a number") from None
        if len(x) not in (1, size):
            raise InputError(f"{self.problem.name}: parameter {name!r} has {len(x)} values, it takes {size}")
        return np.broadcast_to(x, (size,))

    def _reference_columns(self, references):
        columns, where = [], self.problem.name
        for name, layout in self.assembled.layouts.items():
            n, known = layout.phase.intervals, layout.phase.references
            given = references.get(name, {})
            odd = sorted(set(given) ^ set(known))
            if odd:
                raise InputError(f"{where}: references {odd} of phase {name!r} do not fit; it takes {list(known)}")
            rows = [np.linspace(0, 1, n + 1)[None]]
            for ref, size in known.items():
                x = np.asarray(given[ref], float)
                if x.shape != (size, n + 1) or not np.all(np.isfinite(x)):
                    raise InputError(f"{where}: reference {ref!r} of phase {name!r} must be finite, {(size, n + 1)}")
                rows.append(x)
            columns.append(np.concatenate(rows).ravel(order="F"))
        return columns

    def _posed(self, parameters, guess, references, weights, off) -> _Posed:
        a, weights = self.assembled, dict(weights or {})
        self.problem.check_names([*weights, *off], "weight or switch")
        self._check_weights(weights)
        p, box = self._parameter_vector(parameters, references or {}, weights, off), variable_bounds(a, parameters, off)
        rows = row_bounds(self.groups, a.n_rows, parameters, off)
        return _Posed(np.clip(pack(a, guess), *box), p, box, rows)

    # solving ----------------------------------------------------------------------------------------------------
    @cached_property
    def _approach(self) -> Approach:
        return Approach(self.assembled)

    def approach(self, parameters: Mapping, guess: Mapping[str, PhaseGuess], *, references: Mapping | None = None,
                 weights: Mapping[str, float] | None = None, off: tuple[str, ...] = ()) -> Near:  # fmt: skip
        """Come near a solution in a few Gauss-Newton steps; arguments as of :meth:`solve`.

        Raises
        ------
        SolverError
            If a step is no number.
        """
        posed = self._posed(parameters, guess, references, weights, off)
        method, began = self._approach, time.perf_counter()
        x, steps = method.solve(posed.x0, posed.p, posed.box, posed.rows)
        f, g = (y.full().ravel() for y in self.assembled.nlp(x, posed.p))
        residual = float(np.max(np.maximum(posed.rows[0] - g, g - posed.rows[1]), initial=0.0))
        statistics = Statistics(steps, "Approached", self.build_s, time.perf_counter() - began, len(x), len(g),
                                float(f[0]), residual)  # fmt: skip
        return Near(unpack(self.assembled, x), statistics)

    def solve(self, parameters: Mapping, guess: Mapping[str, PhaseGuess], *, references: Mapping | None = None,
              weights: Mapping[str, float] | None = None, off: tuple[str, ...] = (),
              multipliers: Multipliers | None = None, explain: bool = True) -> Solution:  # fmt: skip
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
        posed = self._posed(parameters, guess, references, weights, off)
        a, x0, p, (low, high), (row_low, row_high) = self.assembled, posed.x0, posed.p, posed.box, posed.rows
        start = {}
        if multipliers is not None:
            start = dict(zip(("lam_x0", "lam_g0"), pack_multipliers(a, self.groups, multipliers), strict=True))
        began = time.perf_counter()
        answer = self._solver(x0=x0, p=p, lbx=low, ubx=high, lbg=row_low, ubg=row_high, **start)
        solve_s = time.perf_counter() - began
        stats = self._solver.stats()
        x, g = answer["x"].full().ravel(), answer["g"].full().ravel()
        beyond = np.maximum(np.maximum(row_low - g, g - row_high), 0.0)
        residual = float(np.max(beyond, initial=0.0)) if np.all(np.isfinite(g)) else float("inf")
        status = stats["return_status"]
        if status not in GOOD_STATUSES or not residual < RESIDUAL_LIMIT:
            said = f"{self.problem.name}: no plan ({status} after {int(stats['iter_count'])} iterations)"
            self._refuse_no_numbers({"initial guess": x0, "last iterate": x}, p, said, status)
            if not explain:
                raise SolverError(said, stage=self.problem.name, status=status)
            self._fail(said, status, x0, p, (low, high), (row_low, row_high))
        functions_s = sum(value for key, value in stats.items() if key.startswith("t_proc_nlp_"))
        statistics = Statistics(int(stats["iter_count"]), status, self.build_s, solve_s, len(x), len(g),
                                float(answer["f"]), residual, functions_s)  # fmt: skip
        lam_x, lam_g = (answer[k].full().ravel() for k in ("lam_x", "lam_g"))
        return Solution(self.problem, unpack(a, x), statistics, self._cost_shares(x, p),
                        self._constraint_report(g, row_low, row_high),
                        unpack_multipliers(a, self.groups, lam_x, lam_g))  # fmt: skip

    def _cost_shares(self, x, p):
        a = self.assembled
        parts = a.cost_parts(x, p).full().ravel()
        weighted = parts * p[a.n_par : a.n_par + a.n_weight]
        total = weighted.sum() or 1.0
        return tuple(
            dict(phase=owner, name=t.name, equation=t.equation, weight=float(w), cost=float(c), share=float(c / total))
            for (owner, t), w, c in zip(a.cost_terms, p[a.n_par : a.n_par + a.n_weight], weighted, strict=True)
        )

    def _constraint_report(self, g, low, high):
        out = []
        for group in self.groups:
            term, i = group.term, group.index
            slack = np.minimum(g[i] - low[i], high[i] - g[i])
            if term.name == "jerk chain" or not np.any(np.isfinite(slack)):
                continue
            k, c = np.unravel_index(np.argmin(slack), slack.shape)
            row = i[k, c]
            out.append(dict(phase=group.owner, name=term.name, equation=term.equation, unit=term.unit,
                            kind="equality" if low[row] == high[row] else "inequality", node=int(group.nodes[k]),
                            value=float(g[row] * term.scale), slack=float(slack[k, c] * term.scale)))  # fmt: skip
        return tuple(out)

    def _refuse_no_numbers(self, points, p, said, status):
        """Name the terms that are no number, or have no slope, at one of the points; ipopt says only that some are."""
        for where, x in points.items():
            lost = self._without_number(x, p)
            if lost:
                reason = f"no finite value or slope at the {where} has {' or '.join(lost[:4])}"
                advice = "keep its arguments where it is defined, or start from another guess"
                raise SolverError(f"{said}: {reason}; {advice}", stage=self.problem.name, status=status,
                                  violations=tuple(lost))  # fmt: skip

    def _without_number(self, x, p) -> list[str]:
        """Terms with a value or slope at ``x`` that is not finite: "phase/term at node k, t = ... s of the phase"."""
        a, phases, named = self.assembled, unpack(self.assembled, x), {}
        slope = a.jac_g(x, p)[1]
        bad = ~np.isfinite(a.nlp(x, p)[1].full().ravel())
        bad[np.array(slope.sparsity().row(), int)[~np.isfinite(np.array(slope.nonzeros()))]] = True
        for row in (a.rows[i] for i in np.flatnonzero(bad)):
            when = f", t = {phases[row.owner].t[row.node]:.3f} s of the phase" if row.owner in phases else ""
            named.setdefault((row.owner, row.term.name), f" at node {row.node}{when}")
        parts = a.cost_parts(x, p).full().ravel()
        lost = ~np.isfinite(parts)
        if not lost.any():  # slopes only then: a value that is no number spoils the slopes of its neighbours
            lost = ~np.isfinite(a.cost_parts.jacobian()(x, p, 0)[0].full()).all(axis=1)
        for i in np.flatnonzero(lost):
            owner, term = a.cost_terms[i]
            named.setdefault((owner, term.name), "")
        return [f"{owner}/{name}{place}" for (owner, name), place in named.items()]

    def _fail(self, said, status, x0, p, box, rows):
        """Re-solve with every row softened, and say which terms cannot be met together, where and by how much."""
        x, beyond = least_violation(self.assembled, x0, p, box, rows)
        worst: dict[tuple, tuple] = {}
        phases = unpack(self.assembled, x)
        for row, amount in zip(self.assembled.rows, beyond, strict=True):
            key = (row.owner, row.term.name)
            if amount > CONFLICT_LIMIT and amount > worst.get(key, (0,))[0]:
                when = phases[row.owner].t[row.node] if row.owner in phases else None
                worst[key] = (amount, amount * row.term.scale, row.term.unit, row.node, when)
        ranked = sorted(worst.items(), key=lambda kv: -kv[1][0])
        lines = tuple(
            f"{owner}/{name} by {amount:.3g} {unit}"
            + (f" at t = {when:.3f} s of the phase" if when is not None else "")
            for (owner, name), (_, amount, unit, _, when) in ranked[:4]
        )
        if lines:
            reason = "the best compromise still violates " + "; ".join(lines)
            reason += "; ask for less, or give these terms more room"
        else:
            reason = "a motion that meets every constraint exists, but the search did not settle; try another guess"
        raise SolverError(f"{said}: {reason}", stage=self.problem.name, status=status, violations=lines)
