"""The words of an optimal-control problem. Start reading here.

A :class:`Problem` is a row of phases. In a :class:`Phase` some coordinates move for an unknown
time, in equal steps of constant jerk: at every node stand coordinate, rate and acceleration (q, v,
a), in every step a jerk j, and one step leads exactly to the next node. A :class:`Term` is one
named cost or constraint: a function of a :class:`Point`. A :class:`Bound` is a box on variables.
All units are physical; scales are for conditioning only.

From rest to a goal with the least jerk:

>>> import numpy as np
>>> from jumplab.ocp import Bound, Nlp, Phase, PhaseGuess, Problem, Term
>>> smooth = Term("jerk", "ours", "m/s^3", "mid", lambda p: p.j, weight=1.0)
>>> goal = Term("goal", "ours", "m", "end", lambda p: p.q - p.p.goal)
>>> rest = (Bound("place", "ours", "m", "q", 0, 0, "start"),
...         Bound("speed", "ours", "m/s", "v", 0, 0, "start"))
>>> phase = Phase("go", ("x",), 30, (1.0, 1.0), (smooth, goal), rest)
>>> nlp = Nlp(Problem("move", (phase,), parameters={"goal": 1}))
>>> solution = nlp.solve({"goal": 2.0}, {"go": PhaseGuess(1.0, np.zeros((31, 1)))})
>>> print(f"{solution.phases['go'].q[-1, 0]:.3f} m")
2.000 m

A further wish is a further term: :func:`jumplab.ocp.changed`.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError, nearest, quoted

PLACES = ("node", "mid", "interval", "start", "end", "problem")


@dataclass
class Point:
    """Quantities that a term can use: one instant of one phase, in physical units.

    Attributes
    ----------
    q, v, a, j : (nq,) coordinate, rate, acceleration, jerk (that only at "mid" and "interval").
    z : (nz,) further states of the phase; at "mid" points those of the left node.
    duration : of the phase [s];  s : elapsed share of the phase, 0 to 1.
    c, p : by name, the phase's further constants, and the problem's parameters.
    ref : this node's references by name; at "mid" and "interval" those of the left node, zero at
        "problem" points.
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
            raise AttributeError(
                f"a point of this phase has no {name!r}; it has {', '.join(names)}, time, duration"
            )
        return getattr(seen, name)


@dataclass(frozen=True)
class Term:
    """One named cost or constraint: the square of an expression with a weight, or an expression
    with bounds.

    Attributes
    ----------
    name : unique in its phase.
    equation : where it comes from: an id of the paper's equations, or "ours" with the reason.
    unit : of the expression.
    at : "node" (all nodes), "mid" (middle of every step), "interval" (called with left, right,
        step), "start", "end", or "problem" (called with a dict of phase name -> namespace(start,
        end)).
    expression : function of a :class:`Point` that returns a column, or the name of a quantity that
        the point has ("L", "joints.knee").
    weight : of a cost [1/unit^2], at "node" and "mid" integrated over time [1/(unit^2 s)]; None for
        a constraint.
    lower, upper : of a constraint; numbers, columns, or functions of the parameter dict, read when
        solving.
    scale : nominal size of a constraint's expression.
    skip : how many nodes to leave out at the start and at the end of the phase (constraints at
        "node" only).
    identity : it only says that the motion is one motion (links, integration); no limit that could
        give way.
    group : terms of one group and place are differentiated as one function, which pays where they
        share much of it.
    """

    name: str
    equation: str
    unit: str
    at: str
    expression: Callable | str
    weight: float | None = None
    lower: object = 0.0
    upper: object = 0.0
    scale: float = 1.0
    skip: tuple[int, int] = (0, 0)
    identity: bool = False
    group: str = ""

    def __post_init__(self):
        if isinstance(self.expression, str):
            quantity = attrgetter(self.expression)
            object.__setattr__(self, "expression", lambda p: quantity(p))
        if not isinstance(self.skip, tuple):
            raise InputError(f"term {self.name!r}: skip must be a tuple, got {quoted(self.skip)}")
        if self.skip != (0, 0) and (self.is_cost or self.at != "node"):
            raise InputError(
                f"term {self.name!r}: skip = {self.skip} is only for constraints at 'node', not "
                f"for a {'cost' if self.is_cost else 'constraint'} at {self.at!r}; leave out skip"
            )
        if not isinstance(self.at, str) or self.at not in PLACES:
            raise InputError(
                f"term {self.name!r}: at = {quoted(self.at)}, must be one of {', '.join(PLACES)}"
            )

    @property
    def is_cost(self) -> bool:
        """True for a cost, False for a constraint."""
        return self.weight is not None


def limit(
    name: str,
    equation: str,
    unit: str,
    at: str,
    of: Callable | str,
    low: object = 0.0,
    high: object = np.inf,
    **more: Any,
) -> Term:
    """A constraint low <= of <= high; arguments otherwise as attributes of :class:`Term`."""
    return Term(name, equation, unit, at, of, lower=low, upper=high, **more)


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
    """One phase: coordinates that move in steps of constant jerk, for a time that is free within
    bounds.

    Attributes
    ----------
    coordinates : names of the coordinates.
    intervals : number of equal steps.
    duration : (lower, upper) [s]; numbers or functions of the parameter dict.
    terms, bounds : costs, constraints and boxes.
    states : names of further node variables, tied by "interval" terms.
    constants : name -> (lower, upper, scale), unknown constants of the phase besides its duration;
        with a fourth entry, a key: constants of the same key are one unknown in all phases. One
        with the name of a parameter takes its place in the terms of the phase.
    references : name -> size, data given per node when solving.
    scales : nominal sizes of q, v, a, j and z; 1 where not given.
    view : makes of a :class:`Point` an object with the quantities that people think in, one
        attribute each.
    integrated : names of the coordinates whose acceleration is linear from node to node; the others
        follow from terms at every node. None: all, by exact steps with the jerk as a variable.
    shared : which of "q", "v", "a", "z" the first node has in common with the last node of the
        phase before, by the names of the variables; these are the same unknowns, so no row joins
        them.
    kind : phases of one kind and with the same terms are made of the same functions, whatever their
        names.
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
            raise InputError(
                f"phase {self.name!r}: two terms are called {twice[0]!r}; names must be unique in "
                "a phase"
            )

    def scale(self, key: str) -> np.ndarray:
        """Nominal sizes (nq,) of "q", "v", "a" or "j", or (nz,) of "z"."""
        size = len(self.states if key == "z" else self.coordinates)
        return np.broadcast_to(np.asarray(self.scales.get(key, 1.0), float), (size,))

    @property
    def node_scales(self) -> np.ndarray:
        """Nominal sizes (nx,) of the variables of a node: q, v, a, z."""
        return np.concatenate([self.scale(key) for key in "qvaz"])

    @property
    def constant_scales(self) -> np.ndarray:
        """Nominal sizes (1 + constants,) of the duration and the constants."""
        return np.array([1.0, *(c[2] for c in self.constants.values())])

    @property
    def ends(self) -> list[int]:
        """Ends of q, v and a among the variables of a node."""
        return [k * len(self.coordinates) for k in (1, 2, 3)]

    @property
    def exact(self) -> bool:
        """Whether jerks are variables, which lead exactly from node to node."""
        return self.integrated is None


@dataclass(frozen=True)
class Problem:
    """Phases, the terms at "problem" that join them, and the names and sizes of the parameters.

    ``own`` are the terms that :func:`jumplab.ocp.changed` added: (phase, name) -> hash of the
    expression.
    """

    name: str
    phases: tuple[Phase, ...]
    joints: tuple[Term, ...] = ()
    parameters: dict = field(default_factory=dict)
    own: dict[tuple[str, str], str] = field(default_factory=dict)

    def terms(self) -> list[tuple[str, Term]]:
        """(phase name, term) of every term, in order; joining terms carry the problem's name."""
        return [(p.name, t) for p in self.phases for t in p.terms] + [
            (self.name, t) for t in self.joints
        ]

    def bounds(self) -> list[tuple[str, Bound]]:
        """(phase name, bound) of every bound, in order."""
        return [(p.name, b) for p in self.phases for b in p.bounds]

    def place(self, owner: str) -> str:
        """A phase as sentences name it, "problem/phase"; the problem's name for terms that join
        phases.
        """
        return self.name if owner == self.name else f"{self.name}/{owner}"

    def items(self) -> list[tuple[str, Term | Bound]]:
        """(phase name, term or bound) of all of them, in order, terms first."""
        return [*self.terms(), *self.bounds()]

    def check_names(self, names: Iterable[str]) -> None:
        """Raise :class:`InputError` if a name, "name" or "phase/name", is no term or bound here."""
        for name in names:
            if not any(is_named(owner, x, (name,)) for owner, x in self.items()):
                raise InputError(
                    f"weight or switch {quoted(name)}: the problem {self.name!r} has no such term; "
                    f"it has {nearest({x.name for _, x in self.items()}, name)}"
                )

    def costs(self, name: str) -> dict[tuple[str, str], float]:
        """(phase, term) -> weight of the costs that a name means, "term" or "phase/term".

        Raises :class:`InputError` for a name that is no cost's.
        """
        self.check_names([name])
        named = [(owner, t) for owner, t in self.terms() if is_named(owner, t, (name,))]
        costs = {(owner, t.name): t.weight for owner, t in named if t.is_cost}
        if not costs:
            raise InputError(
                f"{self.name}: {name!r} is a constraint and has no weight; switch it off instead"
            )
        return costs

    def table(self) -> list[dict]:
        """One row per term and bound: stage, phase, name, kind, at, unit, equation, value (weight
        or bounds).
        """
        rows = []
        for owner, x in self.items():
            kind = "bound" if isinstance(x, Bound) else "cost" if x.is_cost else "constraint"
            at = f"{x.on} {x.where}" if kind == "bound" else x.at
            value = f"{_text(x.lower)} ... {_text(x.upper)}"
            if kind == "cost":
                value = f"weight {x.weight:g}"
            row = dict(stage=self.name, phase=owner, name=x.name, kind=kind, at=at, unit=x.unit)
            rows.append(row | dict(equation=x.equation, value=value))
        return rows


def is_named(owner: str, item: Term | Bound, names: Container[str]) -> bool:
    """Whether a term or bound of a phase is among ``names``, as "name" or as "phase/name"."""
    return item.name in names or f"{owner}/{item.name}" in names


def _text(bound: object) -> str:
    if callable(bound):
        return "from target or state"
    values = [f"{x:g}" for x in np.atleast_1d(np.asarray(bound, float))]
    return values[0] if len(set(values)) == 1 else f"[{' '.join(values)}]"
