"""Input and output of a solve: guesses, solutions at and between the nodes, multipliers,
statistics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from jumplab.errors import Shown
from jumplab.ocp.problem import Problem


def resampled(old: np.ndarray, values: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Columns of ``values`` (K, C) given at ``old`` (K,), by straight lines at ``new``."""
    if np.array_equal(old, new):
        return values
    return np.array([np.interp(new, old, column) for column in values.T]).reshape(-1, len(new)).T


# a polynomial's coefficients of the powers of u, from itself at u = 0 and 1, then its first
# derivatives, then its second ones
_FROM_ENDS = np.linalg.inv(
    [polyval(u, polyder(np.eye(6), k)) for k in range(3) for u in (0.0, 1.0)]
)


def quintic(ends: Sequence[tuple], step: float, h: np.ndarray) -> np.ndarray:
    """q, v, a (3, n, nq) of the polynomials of fifth degree through q, v, a at both ``ends`` of a
    step, ``h`` after its start.

    ``ends`` are (left, right) of q, v, a, numbers or (..., nq); ``step`` [s]; ``h`` (n, 1) [s].
    """
    sides = [x * step**k for k, pair in enumerate(ends) for x in pair]
    powers = np.tensordot(_FROM_ENDS, sides, 1)
    levels = [polyval(h / step, polyder(powers, k), tensor=False) / step**k for k in range(3)]
    return np.array(levels)


@dataclass(frozen=True, repr=False)
class PhaseGuess(Shown):
    """Initial values of one phase at its nodes; derivatives that are None come by differences."""

    duration: float
    q: np.ndarray  # (N + 1, nq)
    v: np.ndarray | None = None
    a: np.ndarray | None = None
    z: np.ndarray | None = None
    constants: dict = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class PhaseSolution(Shown):
    """One phase at its nodes, and between them."""

    t: np.ndarray  # (N + 1,) from the start of the phase [s]
    q: np.ndarray  # (N + 1, nq), as v and a
    v: np.ndarray
    a: np.ndarray
    j: np.ndarray  # (N, nq)
    z: np.ndarray  # (N + 1, nz)
    duration: float  # [s]
    constants: dict  # the phase's further ones

    def sample(self, t: float | np.ndarray) -> np.ndarray:
        """q, v, a (3, n, nq) at times ``t`` (n,) [s] since the phase began.

        Polynomials of fifth degree through q, v, a of both neighbouring nodes: where the jerk is
        constant in between, they are the very motion that was optimised.
        """
        t = np.atleast_1d(np.asarray(t, float))
        n = len(self.t) - 1
        k = np.clip((t / self.duration * n).astype(int), 0, n - 1)
        ends = [(x[k], x[k + 1]) for x in (self.q, self.v, self.a)]
        return quintic(ends, self.duration / n, (t - self.t[k])[:, None])

    def guess(self, intervals: int | None = None) -> PhaseGuess:
        """This solution at its own or at (intervals + 1) nodes, as the start of another solve."""
        t = np.linspace(0, self.duration, (intervals or len(self.j)) + 1)
        return PhaseGuess(
            self.duration, *self.sample(t), resampled(self.t, self.z, t), dict(self.constants)
        )


@dataclass(frozen=True, repr=False)
class Multipliers(Shown):
    """Lagrange multipliers of a solution, free of its mesh: what each limit is worth.

    Of limits along a phase they are per unit of its share. Box bounds have the names (phase,
    "bounds of nodes") and (phase, "bounds of constants").
    """

    rows: dict  # (owner, term name) -> shares of the phase (K,), values (K, C)


@dataclass(frozen=True)
class Statistics:
    """Outcome and effort of a solve."""

    iterations: int
    status: str
    build_s: float
    solve_s: float
    variables: int
    rows: int
    objective: float
    residual: float


@dataclass(frozen=True, repr=False)
class Solution(Shown):
    """Result of one solve, every row met; what each cost and the tightest row of each constraint
    is, for people.
    """

    phases: dict[str, PhaseSolution]
    statistics: Statistics
    problem: Problem
    cost_shares: tuple[dict, ...]
    constraint_report: tuple[dict, ...]
    multipliers: Multipliers

    def guess(self, intervals: Mapping[str, int] | None = None) -> dict[str, PhaseGuess]:
        """All phases as the start of a solve, on another mesh if asked."""
        return {n: p.guess((intervals or {}).get(n)) for n, p in self.phases.items()}
