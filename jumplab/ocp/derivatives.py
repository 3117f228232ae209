"""Exact sparse derivatives: each place of a problem is one small function, differentiated once,
called everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError
from jumplab.ocp.layout import PhaseLayout
from jumplab.ocp.problem import Phase, Point, Problem, Term

JERK_CHAIN = "jerk chain"  # the term that every phase has
END_OF_PHASE = 1e-9  # share of a phase, far below one interval
QUOTED = 300  # characters of another error that a sentence quotes
# operations of a cost, beyond which its second derivatives, which take minutes to make, are left
# out
BENT = 20_000


def chain(q: Any, v: Any, a: Any, j: Any, h: Any) -> tuple[Any, Any, Any]:
    """Exact triple-integrator step of length ``h`` [s] under constant jerk: new (q, v, a)."""
    return q + h * v + h * h / 2 * a + h**3 / 6 * j, v + h * a + h * h / 2 * j, a + h * j


@dataclass(frozen=True)
class Part:
    """Terms of one place of a problem that are differentiated as one function.

    ``owner`` is the phase, or the problem's name for terms that join phases; ``place`` is "node",
    "start", "end", "interval" or "problem".
    """

    owner: str
    place: str
    terms: tuple[Term, ...]

    @property
    def costs(self) -> list[Term]:
        """Those of its terms that are costs."""
        return [t for t in self.terms if t.is_cost]

    @property
    def constraints(self) -> list[Term]:
        """Those of its terms that are constraints."""
        return [t for t in self.terms if not t.is_cost]

    def words(self, problem: Problem) -> list:
        """Words for all that its functions depend on besides the expressions: equal words, equal
        functions.

        The mesh and the values of bounds and weights are data. Phases of one kind may have the same
        words.
        """
        phases = [
            [
                p.kind or p.name,
                p.coordinates,
                p.states,
                p.integrated,
                {name: c[2] for name, c in p.constants.items()},
                p.references,
                p.scales,
            ]
            for p in problem.phases
            if self.owner in (p.name, problem.name)
        ]
        terms = [
            [t.name, t.equation, t.at, t.is_cost, t.scale, problem.own.get((self.owner, t.name))]
            for t in self.terms
        ]
        return [problem.name, problem.parameters, self.place, phases, terms]

    def on(self, layouts: dict[str, PhaseLayout]) -> tuple[np.ndarray, np.ndarray]:
        """(nodes (n,) at which it is called, its variables (n, ny) each time) on a mesh."""
        if self.place == "problem":
            ends = [(x.constants, x.nodes[0], x.nodes[-1]) for x in layouts.values()]
            return np.zeros(1, int), np.concatenate([y for end in ends for y in end])[None]
        layout = layouts[self.owner]
        every = np.arange(layout.phase.intervals + 1)
        of_place = {"node": every, "start": every[:1], "end": every[-1:], "interval": every[:-1]}
        nodes = of_place[self.place]
        blocks = [np.tile(layout.constants, (len(nodes), 1)), layout.nodes[nodes]]
        if self.place == "interval":
            blocks += [layout.jerks, layout.nodes[1:]]
        return nodes, np.hstack(blocks).astype(int)


def parts(problem: Problem) -> list[Part]:
    """All places of a problem that have terms, in order; terms of one group stand together."""
    out = []

    def add(owner, place, terms):
        for group in dict.fromkeys(t.group for t in terms):
            out.append(Part(owner, place, tuple(t for t in terms if t.group == group)))

    for phase in problem.phases:
        for place in ("node", "start", "end"):
            add(phase.name, place, [t for t in phase.terms if t.at == place])
        links = [] if phase.integrated == () else [chain_term(phase)]
        add(phase.name, "interval", links + [t for t in phase.terms if t.at in ("mid", "interval")])
    add(problem.name, "problem", problem.joints)
    return out


@dataclass(frozen=True)
class Formulas:
    """One part in symbols: its variables, its data (share of the phase, references, step), the
    parameters.

    ``costs`` are (share, column), meaning share |column|^2; ``rows`` are scaled columns.
    """

    local: ca.SX
    data: ca.SX
    parameters: ca.SX
    costs: list[tuple]
    rows: list[ca.SX]

    def functions(self) -> dict[str, ca.Function]:
        """Its functions by name, all of (variables, data, parameters), and some of more.

        "costs" : the costs without their weights.  "rows" : one column per constraint.
        "gradient" : of the costs, of their weights.  "jacobian" : of the rows.
        "gauss_newton" : upper triangle, 2 w J^T J summed over costs w |y|^2, of the weights.
        "hessian" : upper triangle for the Lagrangian lam_f * cost + lam . rows, of (weights, lam,
        lam_f). Costs of more than :data:`BENT` operations count as straight there.
        """
        x = self.local
        weights = ca.SX.sym("w", len(self.costs))
        lam_f = ca.SX.sym("lam_f")
        g = ca.vertcat(ca.SX(0, 1), *self.rows)
        lam = ca.SX.sym("lam", g.numel())
        formulas = {}
        bent = ca.dot(lam, g)
        hessian = ca.SX(x.numel(), x.numel())
        if self.costs:
            values = [share * ca.sumsqr(y) for share, y in self.costs]
            total = ca.dot(weights, ca.vertcat(*values))
            squares = ca.SX(x.numel(), x.numel())
            for w, (share, y), value in zip(ca.vertsplit(weights), self.costs, values, strict=True):
                slope = ca.jacobian(y, x)
                square = 2 * w * share * (slope.T @ slope)
                squares += square
                if ca.n_nodes(y) < BENT:
                    bent += lam_f * w * value
                else:
                    hessian += lam_f * square
            formulas["costs"] = [], [ca.vertcat(*values)]
            formulas["gradient"] = [weights], [ca.densify(ca.gradient(total, x))]
            formulas["gauss_newton"] = [weights], [ca.triu(squares)]
        if self.rows:
            formulas["rows"] = [], self.rows
            formulas["jacobian"] = [], [ca.jacobian(g, x)]
        hessian += ca.hessian(bent, x)[0]
        formulas["hessian"] = [weights, lam, lam_f], [ca.triu(hessian)]
        given = [x, self.data, self.parameters]
        return {name: ca.Function(name, given + more, y) for name, (more, y) in formulas.items()}


class Formulator:
    """Evaluates the terms of a problem on symbolic points; how many nodes there are is open."""

    def __init__(self, problem: Problem):
        self.problem = problem
        symbols = {name: ca.SX.sym(name, size) for name, size in problem.parameters.items()}
        self._parameters = SimpleNamespace(**symbols)
        self._vector = ca.vertcat(ca.SX(0, 1), *symbols.values())
        self._phases = {p.name: p for p in problem.phases}
        self._known: dict[str, tuple] = {}  # of phases; their points share what models compute

    def formulas(self, part: Part) -> Formulas:
        """The terms of a part in symbols; costs count for the time [s] that they span."""
        if part.owner not in self._known:
            phase = self._phases.get(part.owner)
            self._known[part.owner] = self._within(phase) if phase else self._ends()
        variables, data, seen, spans = self._known[part.owner]
        values = [_column(self.problem.place(part.owner), t, seen[t.at]) for t in part.terms]
        costs = []
        rows = []
        # common operations are sought here: derivatives have thirty times as many, and share fewer
        for t, y in zip(part.terms, ca.cse(values), strict=True):
            if t.is_cost:
                costs.append((spans.get(t.at, 1.0), y))
            else:
                rows.append(y / t.scale)
        return Formulas(variables[part.place], data, self._vector, costs, rows)

    def _point(self, phase: Phase, state, constants, s, refs) -> Point:
        """An instant of a phase, from scaled variables."""
        nx = len(phase.node_scales)
        q, v, a, z = ca.vertsplit(ca.DM(phase.node_scales) * state, [0, *phase.ends, nx])
        duration, *values = ca.vertsplit(ca.DM(phase.constant_scales) * constants)
        constants = dict(zip(phase.constants, values, strict=True))
        given = vars(self._parameters)
        given = given | {name: x for name, x in constants.items() if name in given}
        edges = np.cumsum([0, *phase.references.values()]).tolist()
        columns = [refs[i:k] for i, k in pairwise(edges)]
        ref = SimpleNamespace(**dict(zip(phase.references, columns, strict=True)))
        names, parameters = SimpleNamespace(**constants), SimpleNamespace(**given)
        return Point(q, v, a, None, z, duration, s, names, parameters, ref, view=phase.view)

    def _within(self, phase: Phase) -> tuple:
        """Variables by place, data, and what terms at each place see and span, of one phase."""
        nx = len(phase.node_scales)
        constants = ca.SX.sym("const", len(phase.constant_scales))
        refs = ca.SX.sym("ref", sum(phase.references.values()))
        s = ca.SX.sym("s")
        state = ca.SX.sym("x", nx)
        right = ca.SX.sym("x_next", nx)
        jerk = ca.SX.sym("j", len(phase.coordinates) if phase.exact else 0)
        share = ca.SX.sym("share")  # of the phase, between two nodes
        step = constants[0] * share
        here = self._point(phase, state, constants, s, refs)
        left = replace(here, memo={})
        after = self._point(phase, right, constants, s + share, refs)
        left.j = jerk * ca.DM(phase.scale("j")) if phase.exact else (after.a - left.a) / step
        mid = replace(left, s=s + share / 2, memo={})
        mid.q, mid.v, mid.a = chain(left.q, left.v, left.a, left.j, step / 2)
        seen = dict.fromkeys(("node", "start", "end"), (here,))
        seen |= {"mid": (mid,), "interval": (left, after, step)}
        # trapezoid rule: both ends count half
        inner = 1 - 0.5 * ((s < END_OF_PHASE) + (s > 1 - END_OF_PHASE))
        variables = dict.fromkeys(("node", "start", "end"), ca.vertcat(constants, state))
        variables["interval"] = ca.vertcat(constants, state, jerk, right)
        return variables, ca.vertcat(s, refs, share), seen, {"node": step * inner, "mid": step}

    def _ends(self) -> tuple:
        """The same of both ends of all phases, for terms that join them."""
        ends = {}
        symbols = []
        for name, phase in self._phases.items():
            refs = ca.SX.zeros(sum(phase.references.values()))
            constants = ca.SX.sym("const", len(phase.constant_scales))
            states = [ca.SX.sym(x, len(phase.node_scales)) for x in ("x0", "x1")]
            start, end = (
                self._point(phase, x, constants, float(s), refs) for s, x in enumerate(states)
            )
            ends[name] = SimpleNamespace(start=start, end=end)
            symbols += [constants, *states]
        return {"problem": ca.vertcat(*symbols)}, ca.SX(0, 1), {"problem": (ends,)}, {}


def _column(place: str, term: Term, seen: Sequence) -> ca.SX:
    """Column (rows, 1) of a term's expression at the points that it sees. Raises
    :class:`InputError`, with the term's name, if it cannot be evaluated or is no column.
    """
    who = f"term {term.name!r} of {place!r}"
    try:
        y = term.expression(*seen)
        y = ca.SX(ca.vertcat(*y) if isinstance(y, list | tuple) else y)
    except Exception as e:  # whatever a user's function may raise
        what = " ".join(str(e).split()) or type(e).__name__
        raise InputError(
            f"{who}: its expression cannot be evaluated ({type(e).__name__}: {what[:QUOTED]})"
        ) from e
    if y.shape[1] != 1 or y.shape[0] == 0:
        raise InputError(
            f"{who}: its expression has the shape {y.shape}; it must return a column of one row or "
            "more"
        )
    return y


def chain_term(phase: Phase) -> Term:
    """The exact step under constant jerk from node to node, as a term of every phase.

    Without jerk variables it is a linear acceleration, of the integrated coordinates alone.
    """

    def missed(left, right, step):
        reached = chain(left.q, left.v, left.a, left.j, step)
        pairs = zip("qva", (right.q, right.v, right.a), reached, strict=True)
        place, rate, accel = ((there - x) / phase.scale(key) for key, there, x in pairs)
        if phase.exact:
            return ca.vertcat(place, rate, accel)
        which = [phase.coordinates.index(name) for name in phase.integrated]
        return ca.vertcat(rate[which], place[which])

    return Term(
        JERK_CHAIN, "state equation, Sec. III-A, V-A", "scaled", "interval", missed, identity=True
    )
