"""Exact sparse derivatives: each place of a problem is one small function, differentiated once, called everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError
from jumplab.ocp.problem import Phase, PhaseLayout, Point, Problem, Term

JERK_CHAIN = "jerk chain"  # the term that every phase has
END_OF_PHASE = 1e-9  # share of a phase, far below one interval
MATRICES = ("jacobian", "hessian", "gauss_newton")  # of the symmetric ones the upper triangle
FUNCTIONS = ("costs", "gradient", "rows", *MATRICES)  # that an element may be asked for
SAID = 300  # characters of another error that a sentence quotes
LARGE = 1500  # operations; in the derivatives of more the search takes seconds, and saves a few per cent of a solve
BENT = 20_000  # operations of a cost, beyond which its second derivatives, which take minutes to make, are left out
RARE = ("gauss_newton",)  # evaluated a few times a plan: the search for common subexpressions would not pay


def chain(q: Any, v: Any, a: Any, j: Any, h: Any) -> tuple[Any, Any, Any]:
    """Exact triple-integrator step of length ``h`` under constant jerk: new (q, v, a)."""
    return q + h * v + h * h / 2 * a + h**3 / 6 * j, v + h * a + h * h / 2 * j, a + h * j


@dataclass
class Formulas:
    """One element in symbols: its variables, its data (share of the phase, references, step), the parameters.

    ``costs`` are (share, column), meaning share |column|^2; ``rows`` are scaled columns.
    """

    local: ca.SX
    data: ca.SX
    parameters: ca.SX
    costs: list[tuple]
    rows: list[ca.SX]

    def __post_init__(self):
        self.w, self.lam_f = ca.SX.sym("w", len(self.costs)), ca.SX.sym("lam_f")  # weights, multiplier of the cost
        self.parts = ca.vertcat(ca.SX(0, 1), *(share * ca.sumsqr(y) for share, y in self.costs))
        self.g = ca.vertcat(ca.SX(0, 1), *self.rows)
        self.lam = ca.SX.sym("lam", self.g.numel())  # multipliers of the rows

    def make(self, name: str) -> tuple[ca.Function, np.ndarray, np.ndarray]:
        """One of :data:`FUNCTIONS`: (function of a column of values, and of a matrix its values' rows, columns)."""
        cost = ca.dot(self.w, self.parts) if self.costs else ca.SX(0)
        more, expression = {
            "costs": lambda: ([], self.parts),
            "gradient": lambda: ([self.w], ca.gradient(cost, self.local)),
            "rows": lambda: ([], self.g),
            "jacobian": lambda: ([], ca.jacobian(self.g, self.local)),
            "hessian": lambda: ([self.w, self.lam, self.lam_f], ca.triu(self._curvature())),
            "gauss_newton": lambda: ([self.w], ca.triu(self._squares(1.0)[0])),
        }[name]()
        rows, cols = (), ()
        if name in MATRICES:
            rows, cols = expression.sparsity().get_triplet()
            expression = ca.vertcat(ca.SX(0, 1), *expression.nonzeros())
        arguments = [self.local, self.data, self.parameters, *more]
        shared = name not in RARE and (name not in MATRICES or ca.n_nodes(ca.vertcat(self.g, self.parts)) < LARGE)
        function = ca.Function(name, arguments, [expression], {"cse": shared})
        return function, np.array(rows, int), np.array(cols, int)

    def _squares(self, scale) -> tuple:
        """(2 w J^T J summed over the costs w |y|^2, [(share, y, J, 2 w) of each])."""
        total, parts = ca.SX(self.local.numel(), self.local.numel()), []
        for k, (share, y) in enumerate(self.costs):
            jacobian, weight = ca.jacobian(y, self.local), 2 * scale * self.w[k] * share
            total += weight * (jacobian.T @ jacobian)
            parts.append((share, y, jacobian, weight))
        return total, parts

    def _curvature(self):
        """Hessian of the Lagrangian, lam_f * cost + lam . g.

        A cost w |y|^2 contributes 2 w J^T J, and the curvature of y as if y were a constraint with multiplier 2 w y: so
        everything is bent only once, with constant multipliers. (Where w depends on x, there are mixed terms.) Costs of
        more than :data:`BENT` operations count as straight.
        """
        x, (extra, parts) = self.local, self._squares(self.lam_f)
        for k, (share, y, jacobian, _) in enumerate(parts):
            mixed = ca.jacobian(share, x).T @ (2 * self.lam_f * self.w[k] * (y.T @ jacobian))
            extra += mixed + mixed.T
        parts = [part for part in parts if ca.n_nodes(part[1]) < BENT]
        y = ca.vertcat(ca.SX(0, 1), *(y for _, y, _, _ in parts))
        mu = ca.vertcat(ca.SX(0, 1), *(w * y for _, y, _, w in parts))
        held = ca.SX.sym("mu", y.numel())
        bent = ca.hessian(ca.dot(held, y) + ca.dot(self.lam, self.g), x)[0]
        symbols = [x, self.data, self.parameters, self.lam, held]
        return extra + ca.Function("bent", symbols, [bent])(*symbols[:-1], mu)


@dataclass
class Element:
    """One small function, repeated: its terms, and what is made of them for all meshes."""

    owner: str  # phase
    place: str  # where in it, as in :class:`~jumplab.ocp.problem.Term`
    costs: list[Term]
    rows: list[tuple[Term, int]]  # constraint terms, each with its number of rows
    formulas: Formulas | None = None  # None if all functions are already made
    made: dict = field(default_factory=dict)  # name -> (function, rows, columns), see :class:`Formulas`

    def placed(self, part: Part) -> Element:
        """The same functions for another part of the same words."""
        constraints = [t for t in part.terms if not t.is_cost]
        counts = [(t, n) for t, (_, n) in zip(constraints, self.rows, strict=True)]
        return Element(part.owner, part.place, [t for t in part.terms if t.is_cost], counts, self.formulas, self.made)

    def function(self, name: str) -> tuple[ca.Function, np.ndarray, np.ndarray]:
        """One of :data:`FUNCTIONS`, made when it is first asked for."""
        if name not in self.made:
            self.made[name] = self.formulas.make(name)
        return self.made[name]

    def on(self, layouts: dict[str, PhaseLayout]) -> tuple[range, np.ndarray]:
        """(nodes at which it is called, its variables (n, ny) each time) on a mesh."""
        if self.place == "problem":
            parts = [y for x in layouts.values() for y in (x.constants, x.nodes[0], x.nodes[-1])]
            return range(1), np.concatenate(parts)[None]
        layout = layouts[self.owner]
        n = layout.phase.intervals
        nodes = {"node": range(n + 1), "start": range(1), "end": range(n, n + 1), "interval": range(n)}[self.place]
        parts = [np.broadcast_to(layout.constants, (len(nodes), len(layout.constants))), layout.nodes[nodes]]
        if self.place == "interval":
            parts += [layout.jerks, layout.nodes[1:]]
        return nodes, np.concatenate(parts, axis=1)


@dataclass
class Part:
    """One place of a problem with its terms: what an :class:`Element` is made of."""

    owner: str  # phase, or the problem's name for terms that join phases
    place: str
    terms: list[Term]

    def words(self, problem: Problem) -> list:
        """What its functions depend on besides the expressions: equal words, equal functions.

        The mesh and the values of bounds and weights are data. Phases of one kind may have the same words.
        """
        phases = [p for p in problem.phases if self.owner in (p.name, problem.name)]
        said = [
            (
                p.kind or p.name,
                p.coordinates,
                p.states,
                p.integrated,
                {name: c[2] for name, c in p.constants.items()},
                p.references,
                p.scales,
            )
            for p in phases
        ]
        terms = [
            (t.name, t.equation, t.at, t.is_cost, t.scale, problem.own.get((self.owner, t.name))) for t in self.terms
        ]
        return [problem.name, problem.parameters, self.place, said, terms]


class ElementBuilder:
    """Makes the symbolic points of each phase and evaluates the terms on them; how many nodes there are is open."""

    def __init__(self, problem: Problem, layouts: dict[str, PhaseLayout]):
        self.problem, self.layouts = problem, layouts
        symbols = {name: ca.SX.sym(name, size) for name, size in problem.parameters.items()}
        self.parameters, self.parameter_vector = SimpleNamespace(**symbols), ca.vertcat(ca.SX(0, 1), *symbols.values())
        self._points: dict[str, tuple] = {}

    @property
    def parts(self) -> list[Part]:
        """All places that have terms, in order."""
        out = []
        for phase in self.problem.phases:
            for place in ("node", "start", "end"):
                out += _grouped(phase.name, place, [t for t in phase.terms if t.at == place])
            links = [] if phase.integrated == () else [chain_term(phase)]
            between = [*links, *(t for t in phase.terms if t.at in ("mid", "interval"))]
            out += _grouped(phase.name, "interval", between)
        return out + _grouped(self.problem.name, "problem", list(self.problem.joints))

    @property
    def elements(self) -> list[Element]:
        """The elements of all parts; parts of equal words share their functions."""
        known: dict[str, Element] = {}
        out = []
        for part in self.parts:
            words = repr(part.words(self.problem))
            if words not in known:
                known[words] = self.build(part)
            out.append(known[words].placed(part))
        return out

    def build(self, part: Part) -> Element:
        """The element of one part."""
        if part.place == "problem":
            return self._joints(part)
        if part.owner not in self._points:
            self._points[part.owner] = self._phase(self.layouts[part.owner])
        node, span, data, seen, spans = self._points[part.owner]
        local = span if part.place == "interval" else node
        return self._element(part, local, data, seen, spans)

    def _point(self, layout, state, jerk, constants, s, refs):
        nq, phase = layout.nq, layout.phase
        x, const = ca.DM(layout.node_scales) * state, ca.DM(layout.constant_scales) * constants
        names = SimpleNamespace(**{n: const[1 + i] for i, n in enumerate(phase.constants)})
        ends = np.cumsum([0, *phase.references.values()]).tolist()
        ref = SimpleNamespace(**{n: refs[ends[i] : ends[i + 1]] for i, n in enumerate(phase.references)})
        j = jerk * ca.DM(phase.scale("j")) if jerk is not None else None
        q, v, a, z = x[:nq], x[nq : 2 * nq], x[2 * nq : 3 * nq], x[3 * nq :]
        return Point(q, v, a, j, z, const[0], s, names, self.parameters, ref, view=phase.view)

    def _phase(self, layout):
        """Variables of a node and of a step, data, and what terms at each place see and span, of one phase."""
        phase, nx, nref = layout.phase, layout.nx, sum(layout.phase.references.values())
        constants, refs, s = ca.SX.sym("const", len(layout.constants)), ca.SX.sym("ref", nref), ca.SX.sym("s")
        state, right, jerk = ca.SX.sym("x", nx), ca.SX.sym("x_next", nx), ca.SX.sym("j", layout.jerks.shape[1])
        share = ca.SX.sym("share")  # of the phase, between two nodes
        step, data = constants[0] * share, ca.vertcat(s, refs, share)
        here = self._point(layout, state, None, constants, s, refs)
        left = self._point(layout, state, None if phase.integrated is not None else jerk, constants, s, refs)
        after = self._point(layout, right, None, constants, s + share, refs)
        if phase.integrated is not None:
            left.j = (after.a - left.a) / step
        mid = replace(left, s=s + share / 2, memo={})
        mid.q, mid.v, mid.a = chain(left.q, left.v, left.a, left.j, step / 2)
        seen = {"node": (here,), "start": (here,), "end": (here,), "mid": (mid,), "interval": (left, after, step)}
        inner = 1 - 0.5 * ((s < END_OF_PHASE) + (s > 1 - END_OF_PHASE))  # trapezoid rule: both ends count half
        spans = {"node": step * inner, "mid": step}
        node, span = ca.vertcat(constants, state), ca.vertcat(constants, state, jerk, right)
        return node, span, data, seen, spans

    def _joints(self, part: Part) -> Element:
        ends, symbols = {}, []
        for name, layout in self.layouts.items():
            nx, refs = layout.nx, ca.SX.zeros(sum(layout.phase.references.values()))
            constants, *nodes = ca.SX.sym("const", len(layout.constants)), ca.SX.sym("x0", nx), ca.SX.sym("x1", nx)
            start, end = (self._point(layout, x, None, constants, float(s), refs) for s, x in enumerate(nodes))
            ends[name] = SimpleNamespace(start=start, end=end)
            symbols += [constants, *nodes]
        return self._element(part, ca.vertcat(*symbols), ca.SX(0, 1), {"problem": (ends,)}, {})

    def _element(self, part: Part, local, data, seen, spans) -> Element:
        """Terms evaluated on the points that they see; costs count for the share of the phase that they span."""
        costs, rows, counts = [], [], []
        for t in part.terms:
            y = _column(self.problem.place(part.owner), t, seen[t.at])
            if t.is_cost:
                costs.append((spans.get(t.at, 1.0), y))
            else:
                rows.append(y / t.scale)
                counts.append((t, y.numel()))
        formulas = Formulas(local, data, self.parameter_vector, costs, rows)
        return Element(part.owner, part.place, [t for t in part.terms if t.is_cost], counts, formulas)


def _grouped(owner: str, place: str, terms: list[Term]) -> list[Part]:
    """Terms of one place by their groups."""
    groups = dict.fromkeys(t.group for t in terms)
    return [Part(owner, place, [t for t in terms if t.group == group]) for group in groups]


def _column(place: str, term: Term, seen: Sequence) -> ca.SX:
    """What a term makes of the points that it sees, as a column; refuses whatever is none, by the term's name."""
    who = f"term {term.name!r} of {place!r}"
    try:
        y = term.expression(*seen)
        y = ca.SX(ca.vertcat(*y) if isinstance(y, list | tuple) else y)
    except Exception as e:  # whatever a user's function may raise
        what = " ".join(str(e).split()) or type(e).__name__
        raise InputError(f"{who}: its expression cannot be evaluated ({type(e).__name__}: {what[:SAID]})") from e
    if y.shape[1] != 1 or y.shape[0] == 0:
        raise InputError(f"{who}: its expression has the shape {y.shape}; it must return a column of one row or more")
    return y


def chain_term(phase: Phase) -> Term:
    """The exact step under constant jerk from node to node, as a term of every phase.

    Without jerk variables it is a linear acceleration, of the integrated coordinates alone.
    """
    if phase.integrated is not None:
        which = [phase.coordinates.index(name) for name in phase.integrated]

        def linear(left, right, step):
            rate = right.v - left.v - step * (left.a + right.a) / 2
            place = right.q - left.q - step * left.v - step**2 * (2 * left.a + right.a) / 6
            return ca.vertcat((rate / phase.scale("v"))[which], (place / phase.scale("q"))[which])

        return Term(JERK_CHAIN, "state equation, Sec. III-A, V-A", "scaled", "interval", linear, identity=True)

    def defect(left, right, step):
        reached = chain(left.q, left.v, left.a, left.j, step)
        off = zip("qva", (right.q, right.v, right.a), reached, strict=True)
        return ca.vertcat(*((there - x) / phase.scale(key) for key, there, x in off))

    return Term(JERK_CHAIN, "state equation, Sec. III-A, V-A", "scaled", "interval", defect, identity=True)


def scatter(index: np.ndarray, size: int) -> ca.DM:
    """0/1 matrix (size, len(index)) that adds entry i of a vector to position index[i]."""
    index = np.asarray(index, int)
    return ca.DM.triplet(index.tolist(), list(range(len(index))), ca.DM.ones(len(index)), size, len(index))


def gather(entries: Sequence[tuple], shape: tuple[int, int]) -> ca.MX:
    """Sparse MX matrix from (values, rows, columns) triples; entries that meet are added."""
    values = ca.vertcat(*(x[0] for x in entries))
    rows, cols = (np.concatenate([x[k] for x in entries]) for k in (1, 2))
    key = cols.astype(np.int64) * shape[0] + rows
    unique, inverse = np.unique(key, return_inverse=True)
    pattern = ca.Sparsity.triplet(*shape, (unique % shape[0]).tolist(), (unique // shape[0]).tolist())
    if len(unique) == len(key):
        return ca.MX(pattern, values[np.argsort(key).tolist()])
    return ca.MX(pattern, scatter(inverse, len(unique)) @ values)


@dataclass
class Block:
    """What one element contributes to the NLP: its small functions, called for all repetitions."""

    e: Element
    index: np.ndarray  # (n, ny) its variables
    keep: np.ndarray  # which of its rows, over all repetitions, are in the NLP
    first_row: int  # where they begin there
    inputs: tuple  # MX columns for every repetition, as the weights
    weights: ca.MX

    def __post_init__(self):
        self.n, self.count = len(self.index), sum(count for _, count in self.e.rows)

    def __call__(self, name: str, *more: ca.MX) -> ca.MX:
        """Values (.., n) of one of :data:`FUNCTIONS`."""
        return self.e.function(name)[0].map(self.n)(*self.inputs, *more)

    def jacobian(self) -> tuple:
        """(values, rows, columns) of the rows' Jacobian."""
        _, rows, cols = self.e.function("jacobian")
        row_of = np.full(self.count * self.n, -1)
        row_of[self.keep] = self.first_row + np.arange(len(self.keep))
        i = row_of[(np.arange(self.n)[:, None] * self.count + rows[None]).ravel()]
        used = i >= 0
        return ca.vec(self("jacobian"))[np.flatnonzero(used).tolist()], i[used], self.index[:, cols].ravel()[used]

    def hessian(self, lam_f: ca.MX, lam_g: ca.MX) -> tuple:
        """(values, rows, columns) of the upper triangle of the Lagrangian's Hessian."""
        mine = lam_g[self.first_row : self.first_row + len(self.keep)]
        spread = ca.reshape(scatter(self.keep, self.count * self.n) @ mine, self.count, self.n)
        return self.upper("hessian", self.weights, spread, ca.repmat(lam_f, 1, self.n))

    def upper(self, name: str, *more: ca.MX) -> tuple:
        """(values, rows, columns) of the upper triangle of a symmetric matrix, "hessian" or "gauss_newton"."""
        _, rows, cols = self.e.function(name)
        i, j = self.index[:, rows].ravel(), self.index[:, cols].ravel()
        values = ca.vec(self(name, *more))
        met = (i == j) & np.tile(rows != cols, self.n)  # two local variables that are one: both halves count
        if met.any():
            values = values * ca.DM(np.where(met, 2.0, 1.0))
        return values, np.minimum(i, j), np.maximum(i, j)
