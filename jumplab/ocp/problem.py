"""Where the variables of a phase stand in the decision vector: the one place that knows the order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import casadi as ca
import numpy as np

from jumplab.errors import InputError

# terms ------------------------------------------------------------------------------------------
PLACES = ("node", "mid", "interval", "start", "end", "problem")


@dataclass
class Point:
    """What a term sees: one instant of one phase, in physical units.

    Attributes
    ----------
    q, v, a, j : (nq,) coordinate, rate, acceleration and jerk (jerk only at "mid" and "interval" points).
    z : (nz,) further states of the phase.
    duration : of the phase [s];  s : elapsed share of the phase, 0 to 1;  c : the phase's further constants by name.
    p : the problem's parameters by name;  ref : this node's references by name (at "mid" and "interval" those of the
        left node, zero at "problem" points; z likewise is the left node's at "mid").
    memo : scratch space, so that several terms can share one model evaluation.
    """

    q: ca.SX
    v: ca.SX
    a: ca.SX
    j: ca.SX
    z: ca.SX
    duration: ca.SX
    s: ca.SX
    c: SimpleNamespace
    p: SimpleNamespace
    ref: SimpleNamespace
    memo: dict = field(default_factory=dict)

    @property
    def time(self) -> ca.SX:
        """Time since the phase began [s]."""
        return self.s * self.duration


@dataclass(frozen=True)
class Term:
    """One named cost or constraint.

    Attributes
    ----------
    name : unique in its phase.
    equation : where it comes from: an id of the paper's equations, or "ours" with the reason.
    unit : of the expression.
    at : "node" (all nodes), "mid" (middle of every interval), "interval" (called with left, right, step), "start",
        "end", or "problem" (called with a dict of phase name -> namespace(start, end)).
    expression : function of a :class:`Point` that returns a column.
    weight : cost if set, [1/unit^2] ("node", "mid": integrated over time, so also [1/s]); constraint if None.
    lower, upper : bounds of a constraint; numbers, columns, or functions of the parameter dict, read when solving.
    scale : nominal size of a constraint's expression, for conditioning only.
    skip : how many nodes to leave out at the start and at the end of the phase (constraints at "node" only).
    identity : the constraint only says that the motion is one motion (links, integration); it is never a limit that
        could give way, and an elastic re-solve keeps it.
    """

    name: str
    equation: str
    unit: str
    at: str
    expression: Callable
    weight: float | None = None
    lower: object = 0.0
    upper: object = 0.0
    scale: float = 1.0
    skip: tuple[int, int] = (0, 0)
    identity: bool = False

    def __post_init__(self):
        if self.skip != (0, 0) and (self.is_cost or self.at != "node"):
            raise InputError(
                f"term {self.name!r}: skip is for constraints at 'node'; a cost at {self.at!r} has no use of it"
            )
        if self.at not in PLACES:
            raise InputError(f"term {self.name!r}: at = {self.at!r}, must be one of {', '.join(PLACES)}")

    @property
    def is_cost(self) -> bool:
        """True for a cost, False for a constraint."""
        return self.weight is not None


@dataclass(frozen=True)
class Bound:
    """Box bound on the variables of a phase: ``on`` is "q", "v", "a", "j" or "z"; values as in :class:`Term`.

    ``where`` is "all", "start", "end" or "inner" (all but the first node).
    """

    name: str
    equation: str
    unit: str
    on: str
    lower: object
    upper: object
    where: str = "all"


@dataclass(frozen=True)
class Phase:
    """One phase: coordinates with jerk chains, a duration, further states and constants, terms and bounds.

    Attributes
    ----------
    coordinates : names of the chain coordinates.
    intervals : number of equal steps.
    duration : (lower, upper) [s]; numbers or functions of the parameter dict.
    states : names of further node variables, tied by "interval" terms.
    constants : name -> (lower, upper, scale), unknown constants of the phase besides its duration.
    references : name -> size, data given per node when solving.
    scales : nominal sizes of q, v, a, j and z, for conditioning.
    """

    name: str
    coordinates: tuple[str, ...]
    intervals: int
    duration: tuple
    terms: tuple[Term, ...]
    bounds: tuple[Bound, ...] = ()
    states: tuple[str, ...] = ()
    constants: dict = field(default_factory=dict)
    references: dict = field(default_factory=dict)
    scales: dict = field(default_factory=dict)

    def __post_init__(self):
        names = [x.name for x in (*self.terms, *self.bounds)]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise InputError(f"phase {self.name!r}: two terms are called {twice[0]!r}; names must be unique in a phase")

    def scale(self, key: str, size: int) -> np.ndarray:
        """(size,) nominal sizes of the variables ``key``."""
        return np.broadcast_to(np.asarray(self.scales.get(key, 1.0), float), (size,))


@dataclass(frozen=True)
class Problem:
    """Phases, the terms that join them, and the names and sizes of the parameters."""

    name: str
    phases: tuple[Phase, ...]
    joints: tuple[Term, ...] = ()
    parameters: dict = field(default_factory=dict)

    def terms(self) -> list[tuple[str, Term]]:
        """(phase name, term) of every term, in order; joining terms carry the problem's name."""
        return [(p.name, t) for p in self.phases for t in p.terms] + [(self.name, t) for t in self.joints]

    def term_names(self) -> set[str]:
        """Names by which terms and bounds can be switched or reweighted: "name" or "phase/name"."""
        pairs = [(owner, t.name) for owner, t in self.terms()]
        pairs += [(p.name, b.name) for p in self.phases for b in p.bounds]
        return {name for _, name in pairs} | {f"{owner}/{name}" for owner, name in pairs}

    def check_names(self, names: Iterable[str], what: str) -> None:
        """Raise :class:`InputError` if a name is not a term or bound of this problem."""
        known = self.term_names()
        for name in names:
            if name not in known:
                listed = ", ".join(sorted(n for n in known if "/" not in n))
                raise InputError(f"{what} {name!r}: the problem {self.name!r} has no such term; it has {listed}")

    def with_terms(self, phase: str, *extra: Term) -> Problem:
        """A copy with further terms in one phase (for experiments in a notebook)."""
        if phase not in {p.name for p in self.phases}:
            raise InputError(f"{self.name}: no phase {phase!r}; it has {', '.join(p.name for p in self.phases)}")
        phases = tuple(replace(p, terms=p.terms + extra) if p.name == phase else p for p in self.phases)
        return replace(self, phases=phases)

    def on_mesh(self, intervals: Mapping[str, int]) -> Problem:
        """A copy with other numbers of intervals, phase name -> intervals; the terms are the same objects."""
        return replace(self, phases=tuple(replace(p, intervals=intervals[p.name]) for p in self.phases))

    def table(self) -> list[dict]:
        """One row per term and bound: phase, name, kind, at, unit, equation, weight or bounds."""
        rows = []
        for owner, t in self.terms():
            kind = "cost" if t.is_cost else "constraint"
            size = f"weight {t.weight:g}" if t.is_cost else f"{_text(t.lower)} ... {_text(t.upper)}"
            rows.append(
                dict(phase=owner, name=t.name, kind=kind, at=t.at, unit=t.unit, equation=t.equation, value=size)
            )
        for p in self.phases:
            for b in p.bounds:
                size = f"{_text(b.lower)} ... {_text(b.upper)}"
                rows.append(dict(phase=p.name, name=b.name, kind="bound", at=f"{b.on} {b.where}", unit=b.unit,
                                 equation=b.equation, value=size))  # fmt: skip
        return rows


def _text(bound) -> str:
    if callable(bound):
        return "from the target"
    values = np.atleast_1d(np.asarray(bound, float))
    return f"{values[0]:g}" if np.all(values == values[0]) else "[" + " ".join(f"{x:g}" for x in values) + "]"


# layout ------------------------------------------------------------------------------------------
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
