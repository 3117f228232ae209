"""Where the variables of a phase stand in the decision vector: the one place that knows the order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.terms import Phase


@dataclass(frozen=True)
class PhaseLayout:
    """Where the variables of one phase stand in the decision vector.

    First come its duration and its constants, then node by node coordinates, rates, accelerations (nq each) and further
    states (nz), and between two nodes the jerk (nq).

    Attributes
    ----------
    phase : the phase.
    first : index of its duration.
    """

    phase: Phase
    first: int

    @property
    def nq(self) -> int:
        """Number of coordinates."""
        return len(self.phase.coordinates)

    @property
    def nz(self) -> int:
        """Number of further states."""
        return len(self.phase.states)

    @property
    def n_const(self) -> int:
        """Number of what is constant in the phase: its duration, and its constants."""
        return 1 + len(self.phase.constants)

    @property
    def stride(self) -> int:
        """Variables from one node to the next: state, further states, jerk."""
        return 4 * self.nq + self.nz

    @property
    def size(self) -> int:
        """Number of all variables of the phase."""
        return self.n_const + self.phase.intervals * self.stride + 3 * self.nq + self.nz

    def constants(self) -> np.ndarray:
        """Indices of duration and constants (n_const,)."""
        return self.first + np.arange(self.n_const)

    def node(self, k: int) -> np.ndarray:
        """Indices of the states at node k (3 nq + nz,)."""
        return self.first + self.n_const + k * self.stride + np.arange(3 * self.nq + self.nz)

    def nodes(self) -> np.ndarray:
        """(N + 1, nx) places of all nodes."""
        return self.node(0) + self.stride * np.arange(self.phase.intervals + 1)[:, None]

    def jerks(self) -> np.ndarray:
        """(N, nq) places of all jerks."""
        return self.jerk(0) + self.stride * np.arange(self.phase.intervals)[:, None]

    def jerk(self, k: int) -> np.ndarray:
        """Indices of the jerk between nodes k and k + 1 (nq,)."""
        return self.first + self.n_const + k * self.stride + 3 * self.nq + self.nz + np.arange(self.nq)

    def node_scales(self) -> np.ndarray:
        """Sizes by which the states of a node are divided (3 nq + nz,)."""
        p = self.phase
        return np.concatenate([p.scale(k, self.nq) for k in "qva"] + [p.scale("z", self.nz)])

    def constant_scales(self) -> np.ndarray:
        """Sizes by which duration and constants are divided (n_const,)."""
        return np.array([1.0, *(c[2] for c in self.phase.constants.values())])
