"""Solving an assembled problem with ipopt, and saying what came out: cost shares, tightest rows, or why not."""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import copy

import casadi as ca
import numpy as np

from jumplab.elastic import least_violation
from jumplab.errors import InputError, SolverError
from jumplab.solution import PhaseGuess, PhaseSolution, Solution, Statistics
from jumplab.terms import Bound, Problem
from jumplab.transcription import Assembled, PhaseLayout

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
    "nlp_scaling_method": "none",  # the terms carry their scales
    "print_level": 0,
    "sb": "yes",
}


def _resolve(value, parameters, size):
    value = value(parameters) if callable(value) else value
    return np.broadcast_to(np.asarray(value, float).ravel(), (size,))


class Nlp:
    """A problem ready to be solved for any target.

    Building is pure and done once; :meth:`solve` may be called for any parameters, weights and switches.
    """

    def __init__(self, problem: Problem, options: Mapping | None = None):
        began = time.perf_counter()
        self.problem, self.assembled = problem, Assembled(problem)
        self._solver = self._new_solver(options)
        self.build_s = time.perf_counter() - began

    def with_options(self, options: Mapping) -> Nlp:
        """The same problem, already built, under other options of ipopt."""
        other = copy(self)
        other._solver = self._new_solver(options)
        return other

    def _new_solver(self, options: Mapping | None):
        a = self.assembled
        return ca.nlpsol("solver", "ipopt", a.nlp, {
            "ipopt": {**IPOPT, **(options or {})}, "print_time": False, "error_on_fail": False,
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
    def _is_off(self, owner, name, off):
        return name in off or f"{owner}/{name}" in off

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
            weight.append(0.0 if self._is_off(owner, term.name, off) else w)
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

    def _variable_bounds(self, parameters, off):
        a = self.assembled
        low, high = np.full(a.size, -np.inf), np.full(a.size, np.inf)
        for layout in a.layouts.values():
            phase = layout.phase
            ends = [phase.duration, *(c[:2] for c in phase.constants.values())]
            for i, (lo, hi), s in zip(layout.constants(), ends, layout.constant_scales(), strict=True):
                low[i], high[i] = _resolve(lo, parameters, 1)[0] / s, _resolve(hi, parameters, 1)[0] / s
            for bound in phase.bounds:
                if not self._is_off(phase.name, bound.name, off):
                    self._apply(layout, bound, parameters, low, high)
        return low, high

    @staticmethod
    def _apply(layout: PhaseLayout, bound: Bound, parameters, low, high):
        n, nq = layout.phase.intervals, layout.nq
        first = {"q": 0, "v": nq, "a": 2 * nq, "z": 3 * nq, "j": 0}[bound.on]
        size = layout.nz if bound.on == "z" else nq
        nodes = {"all": range(n + 1), "start": (0,), "end": (n,), "inner": range(1, n + 1)}[bound.where]
        lo = _resolve(bound.lower, parameters, size) / layout.phase.scale(bound.on, size)
        hi = _resolve(bound.upper, parameters, size) / layout.phase.scale(bound.on, size)
        for k in nodes:
            if bound.on == "j" and k == n:
                continue
            i = layout.jerk(k) if bound.on == "j" else layout.node(k)[first : first + size]
            low[i], high[i] = np.maximum(low[i], lo), np.minimum(high[i], hi)
            worst = int(np.argmax(low[i] - high[i]))
            if low[i][worst] > high[i][worst]:
                which = f"bound {bound.name!r} of phase {layout.phase.name!r} and another on {bound.on!r}"
                gap = f"at node {k}, component {worst}: {low[i][worst]:.4g} > {high[i][worst]:.4g} (scaled)"
                raise InputError(f"{which} exclude each other {gap}; look at those that depend on the target")

    def _row_bounds(self, parameters, off):
        rows, cache, sizes = self.assembled.rows, {}, {}
        low, high = np.empty(len(rows)), np.empty(len(rows))
        for row in rows:
            key = (row.owner, row.term.name)
            sizes[key] = max(sizes.get(key, 0), row.component + 1)
        for i, row in enumerate(rows):
            key = (row.owner, row.term.name)
            if key not in cache:
                count = sizes[key]
                lo = _resolve(row.term.lower, parameters, count) / row.term.scale
                hi = _resolve(row.term.upper, parameters, count) / row.term.scale
                switched = self._is_off(row.owner, row.term.name, off)
                cache[key] = (np.full(count, -np.inf), np.full(count, np.inf)) if switched else (lo, hi)
            low[i], high[i] = cache[key][0][row.component], cache[key][1][row.component]
        return low, high

    def _checked_guess(self, guess, layout) -> PhaseGuess:
        name, n = layout.phase.name, layout.phase.intervals
        if name not in guess:
            raise InputError(f"{self.problem.name}: the guess has no phase {name!r}")
        g = guess[name]
        for key, size in (("q", layout.nq), ("v", layout.nq), ("a", layout.nq), ("z", layout.nz)):
            x = getattr(g, key)
            what = f"{self.problem.name}: guess {key!r} of phase {name!r}"
            if x is not None and np.shape(x) != (n + 1, size):
                raise InputError(f"{what} has shape {np.shape(x)}, must be {(n + 1, size)}")
            if x is not None and not np.all(np.isfinite(x)):
                raise InputError(f"{what} is not finite")
        if not (np.isfinite(g.duration) and g.duration > 0):
            raise InputError(f"{self.problem.name}: guess of phase {name!r} has the duration {g.duration} s")
        return g

    def _pack(self, guess: Mapping[str, PhaseGuess]):
        x = np.zeros(self.assembled.size)
        for layout in self.assembled.layouts.values():
            phase, n = layout.phase, layout.phase.intervals
            g = self._checked_guess(guess, layout)
            t = np.linspace(0, g.duration, n + 1)
            v = np.gradient(g.q, t, axis=0) if g.v is None else g.v
            a = np.gradient(v, t, axis=0) if g.a is None else g.a
            z = np.zeros((n + 1, layout.nz)) if g.z is None else g.z
            j = np.diff(a, axis=0) / (g.duration / n) / phase.scale("j", layout.nq)
            nodes = np.concatenate([g.q, v, a, z], axis=1) / layout.node_scales()
            constants = [g.duration, *(g.constants.get(c, 0.0) for c in phase.constants)]
            x[layout.constants()] = np.array(constants) / layout.constant_scales()
            for k in range(n + 1):
                x[layout.node(k)] = nodes[k]
            for k in range(n):
                x[layout.jerk(k)] = j[k]
        return x

    def _unpack(self, x) -> dict[str, PhaseSolution]:
        out = {}
        for name, layout in self.assembled.layouts.items():
            n, nq, phase = layout.phase.intervals, layout.nq, layout.phase
            nodes = np.array([x[layout.node(k)] for k in range(n + 1)]) * layout.node_scales()
            jerk = np.array([x[layout.jerk(k)] for k in range(n)]) * phase.scale("j", nq)
            constants = x[layout.constants()] * layout.constant_scales()
            q, v, a, z = np.split(nodes, [nq, 2 * nq, 3 * nq], axis=1)
            duration = float(constants[0])
            named = {c: float(value) for c, value in zip(phase.constants, constants[1:], strict=True)}
            out[name] = PhaseSolution(np.linspace(0, duration, n + 1), q, v, a, jerk, z, duration, named)
        return out

    # solving ----------------------------------------------------------------------------------------------------
    def solve(self, parameters: Mapping, guess: Mapping[str, PhaseGuess], *, references: Mapping | None = None,
              weights: Mapping[str, float] | None = None, off: tuple[str, ...] = (),
              explain: bool = True) -> Solution:  # fmt: skip
        """Solve for one target.

        Parameters
        ----------
        parameters : name -> number or column, exactly those of the problem.
        guess : phase name -> initial values.
        references : phase name -> reference name -> (size, N + 1).
        weights : term name (or "phase/name") -> weight, instead of the term's own.
        off : names of terms and bounds to leave out.
        explain : look for the terms in conflict if there is no solution; it costs about as much as the solve.

        Raises
        ------
        SolverError
            If ipopt stops without an acceptable point or the re-evaluated rows contradict it; says which terms are
            violated, where and by how much.
        """
        weights, references = dict(weights or {}), references or {}
        self.problem.check_names([*weights, *off], "weight or switch")
        self._check_weights(weights)
        p = self._parameter_vector(parameters, references, weights, off)
        low, high = self._variable_bounds(parameters, off)
        row_low, row_high = self._row_bounds(parameters, off)
        x0 = np.clip(self._pack(guess), low, high)
        began = time.perf_counter()
        answer = self._solver(x0=x0, p=p, lbx=low, ubx=high, lbg=row_low, ubg=row_high)
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
        statistics = Statistics(int(stats["iter_count"]), status, self.build_s, solve_s, len(x), len(g),
                                float(answer["f"]), residual)  # fmt: skip
        return Solution(self.problem, self._unpack(x), statistics, self._cost_shares(x, p),
                        self._constraint_report(g, row_low, row_high))  # fmt: skip

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
        best: dict[tuple, dict] = {}
        for row, value, lo, hi in zip(self.assembled.rows, g, low, high, strict=True):
            if row.term.name == "jerk chain" or not (np.isfinite(lo) or np.isfinite(hi)):
                continue
            slack, scale = min(value - lo, hi - value), row.term.scale
            key = (row.owner, row.term.name)
            if key not in best or slack * scale < best[key]["slack"]:
                best[key] = dict(phase=row.owner, name=row.term.name, equation=row.term.equation, unit=row.term.unit,
                                 kind="equality" if lo == hi else "inequality", node=row.node,
                                 value=float(value * scale), slack=float(slack * scale))  # fmt: skip
        return tuple(best.values())

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
        a, phases, named = self.assembled, self._unpack(x), {}
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
        phases = self._unpack(x)
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
