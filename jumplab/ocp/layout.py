"""Indices of a problem's variables in the decision vector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.ocp.problem import Phase, Problem


@dataclass(frozen=True)
class PhaseLayout:
    """Indices of a phase's variables in the decision vector.

    Entries that the phase shares with others point at theirs.

    Attributes
    ----------
    phase : the phase.
    constants, nodes, jerks : indices (1 + constants,), the first one of the duration; (N + 1, nx)
        in the order q, v, a, z; (N, nq), or (N, 0) where jerks are no variables.
    """

    phase: Phase
    constants: np.ndarray
    nodes: np.ndarray
    jerks: np.ndarray

    def of(self, on: str) -> np.ndarray:
        """Indices (N + 1, nq) of "q", "v" or "a", (N + 1, nz) of "z", or (N, nq) of "j"."""
        if on == "j":
            return self.jerks
        return np.split(self.nodes, self.phase.ends, axis=1)["qvaz".index(on)]


def layouts(problem: Problem) -> dict[str, PhaseLayout]:
    """Phase name -> layout of every phase: the only place that knows the order of the variables.

    Phase by phase its duration and constants, then node by node q, v, a and z, and before each
    node but the first a jerk, if jerks are variables.
    """
    index: dict[tuple, int] = {}

    def places(keys):
        return [index.setdefault(key, len(index)) for key in keys]

    out: dict[str, PhaseLayout] = {}
    last: dict[tuple, tuple] = {}  # (group, name) -> key of a variable of the node before
    for phase in problem.phases:
        name = phase.name
        shared = {c: ("shared", x[3]) for c, x in phase.constants.items() if len(x) > 3}
        keys = [shared.get(c, (name, "constant", c)) for c in phase.constants]
        constants = places([(name, "duration"), *keys])
        variables = [(on, c) for on in "qva" for c in phase.coordinates]
        variables += [("z", c) for c in phase.states]
        first = {x: (name, 0, *x) for x in variables}
        first |= {x: last[x] for x in variables if x[0] in phase.shared and x in last}
        nodes = [places(first.values())]
        jerks = []
        for k in range(1, phase.intervals + 1):
            jerks.append(places((name, k, "j", c) for c in phase.coordinates if phase.exact))
            nodes.append(places((name, k, *x) for x in variables))
        last = {x: (name, phase.intervals, *x) for x in variables}
        out[name] = PhaseLayout(phase, *(np.array(x, int) for x in (constants, nodes, jerks)))
    return out
