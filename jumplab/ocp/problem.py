"""The words of an optimal-control problem, and where its variables stand. Start reading here.

A :class:`Problem` is a row of phases. In a :class:`Phase` some coordinates move for an unknown time, in equal steps of
constant jerk: at every node stand coordinate, rate and acceleration (q, v, a), in every step a jerk j, and one step
leads exactly to the next node. A :class:`Term` is one named cost or constraint: a function of a :class:`Point`. A
:class:`Bound` is a box on variables. All units are physical; scales are for conditioning only.

From rest to a goal with the least jerk:

>>> import numpy as np
>>> from jumplab.ocp import Bound, Nlp, Phase, PhaseGuess, Problem, Term
>>> smooth = Term("jerk", "ours: a smooth motion", "m/s^3", "mid", lambda p: p.j, weight=1.0)
>>> goal = Term("goal", "ours", "m", "end", lambda p: p.q - p.p.goal)
>>> rest = tuple(Bound(f"rest {k}", "ours", unit, k, 0.0, 0.0, "start") for k, unit in (("q", "m"), ("v", "m/s")))
>>> problem = Problem("move", (Phase("go", ("x",), 30, (1.0, 1.0), (smooth, goal), rest),), parameters={"goal": 1})
>>> solution = Nlp(problem).solve({"goal": 2.0}, {"go": PhaseGuess(1.0, np.zeros((31, 1)))})
>>> print(f"{solution.phases['go'].q[-1, 0]:.3f} m")
2.000 m

A further wish is a further term: :func:`jumplab.ocp.changed`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError

PLACES = ("node", "mid", "interval", "start", "end", "problem")


@dataclass
class Point:
    """What a term sees: one instant of one phase, in physical units.

    Attributes
    ----------
    q, v, a, j : (nq,) coordinate, rate, acceleration and jerk (jerk only at "mid" and "interval" points).
    z : (nz,) further states of the phase; at "mid" points those of the left node.
    duration : of the phase [s];  s : elapsed share of the phase, 0 to 1.
    c, p : by name, the phase's further constants, and the problem's parameters.
    ref : this node's references by name; at "mid" and "interval" those of the left node, zero at "problem" points.
    memo : scratch space, so that several terms can share one model evaluation.
    view : of the phase, see :class:`Phase`; what it knows by name is an attribute of the point.
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
    view: Callable[[Point], Any] | None = None

    @property
    def time(self) -> ca.SX:
        """Time since the phase began [s]."""
        return self.s * self.duration

    def __getattr__(self, name: str) -> Any:
        view = self.__dict__.get("view")
        if view is None or name.startswith("_"):
            raise AttributeError(f"a point has no {name!r}")
        if "view" not in self.memo:
            self.memo["view"] = view(self)
        seen = self.memo["view"]
        names = [n for n in dir(type(seen)) if not n.startswith("_")]
        if name not in names:
            raise AttributeError(f"a point of this phase has no {name!r}; it has {', '.join(names)}, time, duration")
        return getattr(seen, name)


@dataclass(frozen=True)
class Term:
    """One named cost or constraint: the square of an expression with a weight, or an expression with bounds.

    Attributes
    ----------
    name : unique in its phase.
    equation : where it comes from: an id of the paper's equations, or "ours" with the reason.
    unit : of the expression.
    at : "node" (all nodes), "mid" (middle of every step), "interval" (called with left, right, step), "start", "end",
        or "problem" (called with a dict of phase name -> namespace(start, end)).
    expression : function of a :class:`Point` that returns a column.
    weight : of a cost [1/unit^2], at "node" and "mid" integrated over time [1/(unit^2 s)]; None for a constraint.
    lower, upper : of a constraint; numbers, columns, or functions of the parameter dict, read when solving.
    scale : nominal size of a constraint's expression.
    skip : how many nodes to leave out at the start and at the end of the phase (constraints at "node" only).
    identity : it only says that the motion is one motion (links, integration); no limit that could give way.
    group : terms of one group and place are differentiated as one function, which pays where they share much of it.
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
    group: str = ""

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
    """A box on the variables of a phase.

    Attributes
    ----------
    name, equation, unit, lower, upper : as in :class:`Term`.
    on : "q", "v", "a", "j" or "z".
    where : "all", "start", "end" or "inner" (all but the first node).
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
    """One phase: coordinates that move in steps of constant jerk, for a time that is free within bounds.

    Attributes
    ----------
    coordinates : names of the coordinates.
    intervals : number of equal steps.
    duration : (lower, upper) [s]; numbers or functions of the parameter dict.
    terms, bounds : costs, constraints and boxes.
    states : names of further node variables, tied by "interval" terms.
    constants : name -> (lower, upper, scale), unknown constants of the phase besides its duration; with a fourth entry,
        a key: constants of the same key are one unknown in all phases.
    references : name -> size, data given per node when solving.
    scales : nominal sizes of q, v, a, j and z; 1 where not given.
    view : makes of a :class:`Point` an object with the quantities that people think in, one attribute each.
    integrated : names of the coordinates whose acceleration is linear from node to node; the others follow from terms
        at every node. None: all, by exact steps with the jerk as a variable.
    shared : which of "q", "v", "a", "z" the first node has in common with the last node of the phase before, by the
        names of the variables; these are the same unknowns, so no row joins them.
    kind : phases of one kind and with the same terms are made of the same functions, whatever their names.
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
    view: Callable[[Point], Any] | None = None
    integrated: tuple[str, ...] | None = None
    shared: str = ""
    kind: str = ""

    def __post_init__(self):
        names = [x.name for x in (*self.terms, *self.bounds)]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise InputError(f"phase {self.name!r}: two terms are called {twice[0]!r}; names must be unique in a phase")

    def scale(self, key: str) -> np.ndarray:
        """Nominal sizes (nq,) of "q", "v", "a" or "j", or (nz,) of "z"."""
        size = len(self.states if key == "z" else self.coordinates)
        return np.broadcast_to(np.asarray(self.scales.get(key, 1.0), float), (size,))


@dataclass(frozen=True)
class Problem:
    """Phases, the terms at "problem" that join them, and the names and sizes of the parameters.

    ``own`` are the terms that :func:`jumplab.ocp.changed` added: (phase, name) -> hash of the expression.
    """

    name: str
    phases: tuple[Phase, ...]
    joints: tuple[Term, ...] = ()
    parameters: dict = field(default_factory=dict)
    own: dict[tuple[str, str], str] = field(default_factory=dict)

    def terms(self) -> list[tuple[str, Term]]:
        """(phase name, term) of every term, in order; joining terms carry the problem's name."""
        return [(p.name, t) for p in self.phases for t in p.terms] + [(self.name, t) for t in self.joints]

    def bounds(self) -> list[tuple[str, Bound]]:
        """(phase name, bound) of every bound, in order."""
        return [(p.name, b) for p in self.phases for b in p.bounds]

    def place(self, owner: str) -> str:
        """A phase as sentences name it, "problem/phase"; the problem's name for terms that join phases."""
        return self.name if owner == self.name else f"{self.name}/{owner}"

    def check_names(self, names: Iterable[str], what: str) -> None:
        """Raise :class:`InputError` if a name, "name" or "phase/name", is no term or bound of this problem."""
        owned = [(owner, x.name) for owner, x in (*self.terms(), *self.bounds())]
        short, full = {name for _, name in owned}, {f"{owner}/{name}" for owner, name in owned}
        for name in names:
            if name not in short | full:
                listed = ", ".join(sorted(short))
                raise InputError(f"{what} {name!r}: the problem {self.name!r} has no such term; it has {listed}")

    def table(self) -> list[dict]:
        """One row per term and bound: stage, phase, name, kind, at, unit, equation, value (weight or bounds)."""
        rows = []
        for owner, x in (*self.terms(), *self.bounds()):
            kind = "bound" if isinstance(x, Bound) else "cost" if x.is_cost else "constraint"
            at = f"{x.on} {x.where}" if kind == "bound" else x.at
            value = f"weight {x.weight:g}" if kind == "cost" else f"{_text(x.lower)} ... {_text(x.upper)}"
            row = dict(stage=self.name, phase=owner, name=x.name, kind=kind, at=at, unit=x.unit)
            rows.append(row | dict(equation=x.equation, value=value))
        return rows


def _text(bound) -> str:
    if callable(bound):
        return "from the target"
    values = np.atleast_1d(np.asarray(bound, float))
    return f"{values[0]:g}" if np.all(values == values[0]) else "[" + " ".join(f"{x:g}" for x in values) + "]"


@dataclass(frozen=True)
class PhaseLayout:
    """Where the variables of a phase stand in the decision vector; the only place that knows their order.

    First its duration and constants; then node by node q, v, a and z, and after each node but the last a jerk, if
    jerks are variables. Entries that the phase shares with others point at theirs.

    Attributes
    ----------
    phase : the phase.  nq, nx : numbers of coordinates, and of variables of a node.
    size : number of the variables that are new with this phase.
    constants, nodes, jerks : indices (1 + constants,), (N + 1, nx), (N, nq) or (N, 0).
    constant_scales, node_scales : sizes by which constants and nodes are divided (1 + constants,), (nx,).
    """

    phase: Phase
    nq: int
    nx: int
    size: int
    constants: np.ndarray
    nodes: np.ndarray
    jerks: np.ndarray
    constant_scales: np.ndarray
    node_scales: np.ndarray

    @classmethod
    def of(
        cls, phase: Phase, first: int, before: PhaseLayout | None = None, known: dict[str, int] | None = None
    ) -> PhaseLayout:
        """The layout of a phase whose first new variable has the index ``first``.

        ``before`` is the layout of the phase before; ``known`` maps keys of constants to indices and is added to.
        """
        known = {} if known is None else known
        nq, steps = len(phase.coordinates), phase.intervals
        nx = 3 * nq + len(phase.states)
        constants, at = [first], first + 1
        for entry in phase.constants.values():
            key = entry[3] if len(entry) > 3 else None
            if key in known:
                constants.append(known[key])
                continue
            constants.append(at)
            if key is not None:
                known[key] = at
            at += 1
        start = np.full(nx, -1)
        if before is not None and phase.shared:
            place = {x: i for i, x in enumerate(_variables(before.phase))}
            for column, x in enumerate(_variables(phase)):
                if x[0] in phase.shared and x in place:
                    start[column] = before.nodes[-1, place[x]]
        own = start < 0
        start[own] = at + np.arange(own.sum())
        at += int(own.sum())
        nj = nq if phase.integrated is None else 0
        grid = at + np.arange(steps * (nj + nx)).reshape(steps, nj + nx)
        nodes = np.vstack([start, grid[:, nj:]])
        size = at + grid.size - first
        constant_scales = np.array([1.0, *(c[2] for c in phase.constants.values())])
        node_scales = np.concatenate([phase.scale(k) for k in "qvaz"])
        return cls(phase, nq, nx, size, np.array(constants), nodes, grid[:, :nj], constant_scales, node_scales)


def _variables(phase: Phase) -> list[tuple[str, str]]:
    """(group, name) of the variables of a node, in their order."""
    return [*((k, name) for k in "qva" for name in phase.coordinates), *(("z", name) for name in phase.states)]


def layouts(problem: Problem) -> dict[str, PhaseLayout]:
    """Phase name -> layout of all phases of a problem, one after the other."""
    out: dict[str, PhaseLayout] = {}
    first, before, known = 0, None, {}
    for phase in problem.phases:
        before = out[phase.name] = PhaseLayout.of(phase, first, before, known)
        first += before.size
    return out
