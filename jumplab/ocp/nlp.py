"""Solving an assembled problem, with ipopt, and saying what came out.

Where no plan comes out, :mod:`jumplab.ocp.conflicts` says why.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError, SolverError
from jumplab.io.progress import tell
from jumplab.ocp.assembly import Assembled, ipopt
from jumplab.ocp.cache import in_turn
from jumplab.ocp.conflicts import check_start, reasons
from jumplab.ocp.derivatives import JERK_CHAIN
from jumplab.ocp.posing import Posed, pack_multipliers, pose, unpack, unpack_multipliers
from jumplab.ocp.problem import Problem
from jumplab.ocp.solution import Multipliers, PhaseGuess, Solution, Statistics

# off where nobody reads why there is no plan
EXPLAINED: ContextVar[bool] = ContextVar("explained", default=True)
# processor time of this thread [s] at which a search ends with the best that it has; that of the
# process is spent by its other threads as well
DEADLINE: ContextVar[float] = ContextVar("deadline", default=math.inf)
LEAST_S = 1.0  # that a solve gets all the same
OUT_OF_TIME = "Maximum_CpuTime_Exceeded"
GOOD_STATUSES = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
RESIDUAL_LIMIT = 1e-4  # scaled row error above which a "solved" status is not believed
IPOPT = {
    "tol": 1e-6,  # scaled; the tape's own audit is the judge of physics
    "constr_viol_tol": 1e-6,
    "acceptable_tol": 1e-4,
    "acceptable_constr_viol_tol": 1e-5,
    "max_iter": 300,
    # [s]; a solve that needs longer is lost, not slow; of its own time, whatever else runs
    "max_cpu_time": 60.0,
    "mu_strategy": "adaptive",
    # AMD; MUMPS's own choice for large problems doubles the time of an iteration
    "mumps_pivot_order": 0,
    # the terms carry their scales, which also spares MUMPS its own ...
    "nlp_scaling_method": "none",
    "mumps_permuting_scaling": 0,
    "mumps_scaling": 0,
    "min_refinement_steps": 0,  # ... and a refinement of every step
    "print_level": 0,
    "sb": "yes",
}
PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")


def warm(push: float) -> dict[str, Any]:
    """Options to begin from a solution with its multipliers, ``push`` [1] away from its limits."""
    return {"warm_start_init_point": "yes"} | {f"warm_start_{name}": push for name in PUSHES}


WARM = warm(1e-6)  # of one close by: the start is not pushed away


@contextmanager
def unexplained() -> Iterator[None]:
    """Inside, nobody reads why there is no plan: an explanation costs as much as a solve."""
    outside = EXPLAINED.set(False)
    try:
        yield
    finally:
        EXPLAINED.reset(outside)


@contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Inside, a search ends after so much processor time [s], with the best that it has.

    Raises :class:`InputError` unless it is positive.
    """
    if not seconds > 0:
        raise InputError(f"patience_s must be a positive number of seconds, got {seconds!r}")
    outside = DEADLINE.set(time.thread_time() + seconds)
    try:
        yield
    finally:
        DEADLINE.reset(outside)


def left_s() -> float:
    """Processor time [s] that a search may still take."""
    return DEADLINE.get() - time.thread_time()


class Nlp:
    """A problem ready to be solved for any target.

    Building is pure and done once; :meth:`solve` may be called for any parameters and weights.

    Parameters
    ----------
    problem : what to solve.
    options : of ipopt, besides :data:`IPOPT`.
    key : if given, what is built is kept for later processes, see
        :func:`jumplab.ocp.cache.functions`.
    """

    @in_turn
    def __init__(self, problem: Problem, options: Mapping | None = None, key: str | None = None):
        began = time.perf_counter()
        tell(f"building {problem.name}")
        self.problem = problem
        self._options = {**IPOPT, **(options or {})}
        self._hold = None
        self.assembled = Assembled(problem, key)
        self.build_s = time.perf_counter() - began

    def with_options(self, options: Mapping, hold: float | None = None) -> Nlp:
        """The same problem, already built, under other options of ipopt.

        With ``hold`` ipopt gets :meth:`.Assembled.held_hessian` instead of the exact Hessian.
        """
        other = copy(self)
        other._options = {**IPOPT, **options}
        other._hold = hold
        other.__dict__.pop("solver", None)
        return other

    @cached_property
    def solver(self) -> ca.Function:
        """The solver, made when it is first asked for; that takes some ten milliseconds."""
        functions = self.assembled.functions_of_nlp
        if self._hold is not None:
            functions = functions | {"hess_lag": self.assembled.held_hessian(self._hold)}
        return ipopt(functions, self._options)

    @in_turn
    def solve(
        self,
        parameters: Mapping,
        guess: Mapping[str, PhaseGuess],
        *,
        references: Mapping | None = None,
        weights: Mapping[str, float] | None = None,
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
        multipliers : of a solution close by, on any mesh; used if ipopt's option
            ``warm_start_init_point`` is "yes".
        explain : look for the terms in conflict if there is no solution; it costs about as much as
            the solve.

        Raises
        ------
        InputError
            For numbers, references or guesses that do not fit the problem.
        SolverError
            If ipopt stops without an acceptable point or the re-evaluated rows contradict it; it
            says which terms are violated, where and by how much.
        """
        a = self.assembled
        posed = pose(a, parameters, guess, references, weights)
        check_start(a, posed)
        start = {}
        if multipliers is not None:
            start = dict(zip(("lam_x0", "lam_g0"), pack_multipliers(a, multipliers), strict=True))
        tell(f"solving {a.problem.name}")
        began = time.perf_counter()
        answer = self.solver(**posed.arguments, **start)
        solve_s = time.perf_counter() - began
        stats = self.solver.stats()
        x, g, lam_x, lam_g = (answer[key].full().ravel() for key in ("x", "g", "lam_x", "lam_g"))
        status = stats["return_status"]
        iterations = int(stats["iter_count"])
        residual = np.inf
        if np.all(np.isfinite(g)):
            residual = float(np.max(posed.beyond(g), initial=0.0))
        # who asks for a rough solution gets it
        most = max(RESIDUAL_LIMIT, self._options["acceptable_constr_viol_tol"])
        if status not in GOOD_STATUSES or not residual < most:
            asked = explain and EXPLAINED.get()
            because, violations, limits = reasons(a, posed, x, asked and left_s() > 0, left_s())
            raise SolverError(
                f"{self.problem.name}: no plan ({status} after {iterations} iterations){because}",
                stage=self.problem.name,
                status=status,
                violations=violations,
                iterations=iterations,
                limits=limits,
            )
        statistics = Statistics(
            iterations=iterations,
            status=status,
            build_s=self.build_s,
            solve_s=solve_s,
            variables=len(x),
            rows=len(g),
            objective=float(answer["f"]),
            residual=residual,
        )
        return Solution(
            unpack(a, x),
            statistics,
            self.problem,
            self._cost_shares(x, posed.p),
            self._constraint_report(g, posed),
            unpack_multipliers(a, lam_x, lam_g),
        )

    def _cost_shares(self, x: np.ndarray, p: np.ndarray) -> tuple[dict, ...]:
        a = self.assembled
        weights = p[a.data_at[1] : a.data_at[2]]
        costs = a.cost_parts(x, p).full().ravel() * weights
        shares = costs / (costs.sum() or 1.0)
        values = zip(a.cost_terms, weights.tolist(), costs.tolist(), shares.tolist(), strict=True)
        return tuple(
            dict(
                phase=owner, name=t.name, equation=t.equation, weight=weight, cost=cost, share=share
            )
            for (owner, t), weight, cost, share in values
        )

    def _constraint_report(self, g: np.ndarray, posed: Posed) -> tuple[dict, ...]:
        """The tightest row of each constraint."""
        out = []
        low, high = posed.rows
        for rows in self.assembled.rows:
            term = rows.term
            i = rows.index
            slack = np.minimum(g[i] - low[i], high[i] - g[i])
            if term.name == JERK_CHAIN or not np.any(np.isfinite(slack)):
                continue
            k, c = np.unravel_index(np.argmin(slack), slack.shape)
            row = i[k, c]
            out.append(
                dict(
                    phase=rows.owner,
                    name=term.name,
                    equation=term.equation,
                    unit=term.unit,
                    kind="equality" if low[row] == high[row] else "inequality",
                    node=int(rows.nodes[k]),
                    value=float(g[row] * term.scale),
                    slack=float(slack[k, c] * term.scale),
                )
            )
        return tuple(out)
