"""What goes into a solve and what comes out: guesses, solutions at and between the nodes, statistics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from jumplab.ocp.derivatives import chain
from jumplab.ocp.problem import Problem


@dataclass(frozen=True)
class PhaseGuess:
    """Initial values of one phase at its nodes; derivatives that are None are taken by differences."""

    duration: float
    q: np.ndarray  # (N + 1, nq)
    v: np.ndarray | None = None
    a: np.ndarray | None = None
    z: np.ndarray | None = None
    constants: dict = field(default_factory=dict)

    def resampled(self, intervals: int) -> PhaseGuess:
        """The same guess at the nodes of another mesh, by straight lines between its own."""
        if len(self.q) == intervals + 1:
            return self
        old, new = np.linspace(0, 1, len(self.q)), np.linspace(0, 1, intervals + 1)

        def at_nodes(x):
            if x is None:
                return None
            return np.array([np.interp(new, old, column) for column in x.T]).reshape(x.shape[1], -1).T

        return PhaseGuess(self.duration, *(at_nodes(x) for x in (self.q, self.v, self.a, self.z)), self.constants)

    def smoothed(self, width: float, rate_width: float) -> PhaseGuess:
        """The same guess with a Gaussian mean over that share of the phase: of q, and of the rates v and a."""
        s = np.linspace(0, 1, len(self.q))

        def mean(x, width):
            weights = np.exp(-(((s[:, None] - s) / width) ** 2) / 2)
            return None if x is None else weights / weights.sum(axis=1, keepdims=True) @ x

        values = mean(self.q, width), mean(self.v, rate_width), mean(self.a, rate_width)
        return PhaseGuess(self.duration, *values, self.z, self.constants)


@dataclass(frozen=True)
class PhaseSolution:
    """One phase at its nodes, and between them.

    Attributes
    ----------
    t : (N + 1,) from the start of the phase [s];  q, v, a : (N + 1, nq);  j : (N, nq);  z : (N + 1, nz).
    duration : [s];  constants : the phase's further constants.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    j: np.ndarray
    z: np.ndarray
    duration: float
    constants: dict

    def sample(self, t: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(q, v, a), each (n, nq), at times ``t`` since the phase began: the very motion that was optimised."""
        t = np.atleast_1d(np.asarray(t, float))
        n = len(self.j)
        k = np.clip((t / self.duration * n).astype(int), 0, n - 1)
        h = (t - self.t[k])[:, None]
        return chain(self.q[k], self.v[k], self.a[k], self.j[k], h)

    def guess(self, intervals: int | None = None) -> PhaseGuess:
        """This solution as the start of another solve, on another mesh if asked."""
        t = np.linspace(0, self.duration, (intervals or len(self.j)) + 1)
        q, v, a = self.sample(t)
        z = np.stack([np.interp(t, self.t, col) for col in self.z.T], -1) if self.z.shape[1] else None
        return PhaseGuess(self.duration, q, v, a, z, dict(self.constants))


@dataclass(frozen=True)
class Multipliers:
    """Lagrange multipliers of a solution, free of its mesh: what each limit is worth.

    Attributes
    ----------
    rows : (owner, term name) -> shares of the phase (K,), values (K, C); of limits along a phase per unit of share.
    nodes : phase -> (N + 1, nx) of the bounds on node variables, per unit of share.
    constants : phase -> of the bounds on duration and constants.
    """

    rows: dict
    nodes: dict
    constants: dict


@dataclass(frozen=True)
class Statistics:
    """What a solve cost; ``functions_s`` is the CPU time of function evaluations, the rest is the solver's own."""

    iterations: int
    status: str
    build_s: float
    solve_s: float
    variables: int
    rows: int
    objective: float
    residual: float
    functions_s: float = 0.0


@dataclass(frozen=True)
class Near:
    """Phases near a solution: a start for a solve, no motion yet, because rows are still violated."""

    phases: dict[str, PhaseSolution]
    statistics: Statistics

    def guess(self, intervals: Mapping[str, int] | None = None) -> dict[str, PhaseGuess]:
        """All phases as the start of a solve, on another mesh if asked."""
        return {n: p.guess((intervals or {}).get(n)) for n, p in self.phases.items()}


@dataclass(frozen=True)
class Solution:
    """Result of one solve; ``phases`` by name, tables for people."""

    problem: Problem
    phases: dict[str, PhaseSolution]
    statistics: Statistics
    cost_shares: tuple[dict, ...]
    constraint_report: tuple[dict, ...]
    multipliers: Multipliers | None = None

    def guess(self, intervals: Mapping[str, int] | None = None) -> dict[str, PhaseGuess]:
        """All phases as a warm start, on another mesh if asked."""
        return {n: p.guess((intervals or {}).get(n)) for n, p in self.phases.items()}
