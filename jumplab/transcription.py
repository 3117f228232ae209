"""From a :class:`~jumplab.terms.Problem` to a sparse NLP with exact derivatives.

Every term depends on few variables: one node, one interval, or the ends of phases. The NLP is therefore assembled from
small CasADi functions, differentiated once and evaluated for all nodes at a time; the sparse gradient, Jacobian and
Hessian are gathered from theirs. Building takes a fraction of a second, needs no compiler, and the functions can be
shared by all targets, weights and switches, which are parameters.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from jumplab.layout import PhaseLayout
from jumplab.pieces import Piece, gather, scatter
from jumplab.terms import Point, Problem, Term

END_OF_PHASE = 1e-9  # share of a phase, far below one interval


def chain(q: Any, v: Any, a: Any, j: Any, h: Any) -> tuple[Any, Any, Any]:
    """Exact triple-integrator step of length ``h`` under constant jerk: new (q, v, a)."""
    return q + h * v + h * h / 2 * a + h**3 / 6 * j, v + h * a + h * h / 2 * j, a + h * j


@dataclass(frozen=True)
class Row:
    """Which term, phase, node and component a constraint row belongs to."""

    owner: str
    term: Term
    node: int
    component: int


class Element:
    """One small function, repeated: its terms, its variables in each repetition, its nodes.

    ``place`` is where it stands in the phase ``owner``, as in :class:`~jumplab.terms.Term`; ``made`` keeps what was
    derived from it, for this mesh and others.
    """

    def __init__(self, owner, place, local, data, outputs, terms):
        self.owner, self.place, self.local, self.data = owner, place, local, data
        self.made: dict = {}
        self.costs = [(t, *e) for t, e in zip(terms, outputs, strict=True) if t.is_cost]  # term, share, column
        self.constraints = [(t, e) for t, e in zip(terms, outputs, strict=True) if not t.is_cost]

    def on(self, layouts: dict[str, PhaseLayout]) -> Element:
        """The same functions on a mesh: their variables ``index`` (n, ny), their ``nodes``, ``share`` of a step."""
        new = copy(self)
        if self.place == "problem":
            parts = [(x.constants(), x.node(0), x.node(x.phase.intervals)) for x in layouts.values()]
            new.index, new.nodes, new.share = np.concatenate([x for part in parts for x in part])[None], [0], None
            return new
        layout = layouts[self.owner]
        n = layout.phase.intervals
        new.nodes = {"node": range(n + 1), "start": (0,), "end": (n,), "interval": range(n)}[self.place]
        new.share, ends = 1 / n, [(layout.constants(), layout.node(k)) for k in new.nodes]
        if self.place == "interval":
            ends = [(*e, layout.jerk(k), layout.node(k + 1)) for e, k in zip(ends, new.nodes, strict=True)]
        new.index = np.array([np.concatenate(e) for e in ends])
        return new


def _columns(expression):
    return ca.vertcat(*expression) if isinstance(expression, (list, tuple)) else ca.SX(expression)


class ElementBuilder:
    """Makes the symbolic points of each phase and evaluates the terms on them; how many nodes there are is open."""

    def __init__(self, problem: Problem, layouts: dict[str, PhaseLayout]):
        self.problem, self.layouts = problem, layouts
        self.parameters = SimpleNamespace()
        symbols = []
        for name, size in problem.parameters.items():
            symbol = ca.SX.sym(name, size)
            setattr(self.parameters, name, symbol)
            symbols.append(symbol)
        self.parameter_vector = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
        self.elements = [e for layout in layouts.values() for e in self._phase(layout)]
        if problem.joints:
            self.elements.append(self._joints())

    def _point(self, layout, state, jerk, constants, s, refs):
        nq, phase = layout.nq, layout.phase
        x = ca.DM(layout.node_scales()) * state
        const = ca.DM(layout.constant_scales()) * constants
        names = SimpleNamespace(**{n: const[1 + i] for i, n in enumerate(phase.constants)})
        ref, at = SimpleNamespace(), 0
        for name, size in phase.references.items():
            setattr(ref, name, refs[at : at + size])
            at += size
        j = jerk * ca.DM(phase.scale("j", nq)) if jerk is not None else None
        return Point(
            x[:nq], x[nq : 2 * nq], x[2 * nq : 3 * nq], j, x[3 * nq :], const[0], s, names, self.parameters, ref
        )

    def _phase(self, layout):
        phase = layout.phase
        nx, nref = 3 * layout.nq + layout.nz, sum(layout.phase.references.values())
        constants, refs, s = ca.SX.sym("const", layout.n_const), ca.SX.sym("ref", nref), ca.SX.sym("s")
        state, right, jerk = ca.SX.sym("x", nx), ca.SX.sym("x_next", nx), ca.SX.sym("j", layout.nq)
        share = ca.SX.sym("share")  # of the phase, between two nodes
        step, data = constants[0] * share, ca.vertcat(s, refs, share)
        at_node = self._point(layout, state, None, constants, s, refs)
        for place in ("node", "start", "end"):
            terms = [t for t in phase.terms if t.at == place]
            if terms:
                part = step * _trapezoid(s) if place == "node" else 1.0
                out = [self._weighted(t, _columns(t.expression(at_node)), part) for t in terms]
                yield Element(phase.name, place, ca.vertcat(constants, state), data, out, terms)
        left = self._point(layout, state, jerk, constants, s, refs)
        after = self._point(layout, right, None, constants, s + share, refs)
        q, v, a = chain(left.q, left.v, left.a, left.j, step / 2)
        mid = Point(q, v, a, left.j, left.z, left.duration, s + share / 2, left.c, left.p, left.ref)
        terms, out = [_defect_term()], [_defect(layout, left, after, step)]
        for t in phase.terms:
            if t.at == "mid":
                terms.append(t)
                out.append(self._weighted(t, _columns(t.expression(mid)), step))
            elif t.at == "interval":
                terms.append(t)
                out.append(self._weighted(t, _columns(t.expression(left, after, step)), 1.0))
        yield Element(phase.name, "interval", ca.vertcat(constants, state, jerk, right), data, out, terms)

    def _joints(self):
        ends, symbols = {}, []
        for name, layout in self.layouts.items():
            nx = 3 * layout.nq + layout.nz
            constants, first, last = ca.SX.sym("const", layout.n_const), ca.SX.sym("x0", nx), ca.SX.sym("x1", nx)
            refs = ca.SX.zeros(sum(layout.phase.references.values()))
            ends[name] = SimpleNamespace(
                start=self._point(layout, first, None, constants, 0.0, refs),
                end=self._point(layout, last, None, constants, 1.0, refs),
            )
            symbols += [constants, first, last]
        terms = list(self.problem.joints)
        out = [self._weighted(t, _columns(t.expression(ends)), 1.0) for t in terms]
        return Element(self.problem.name, "problem", ca.vertcat(*symbols), ca.SX(0, 1), out, terms)

    @staticmethod
    def _weighted(term, expression, step):
        """A cost as (share, column), meaning share |column|^2; a constraint as its scaled column."""
        return (step, expression) if term.is_cost else expression / term.scale


def _trapezoid(s):
    """Trapezoid rule: a phase's first and last node count half."""
    return 1 - 0.5 * ((s < END_OF_PHASE) + (s > 1 - END_OF_PHASE))


def _defect_term() -> Term:
    return Term("jerk chain", "state equation, Sec. III-A, V-A", "scaled", "interval", None, identity=True)


def _defect(layout, left, right, step):
    q, v, a = chain(left.q, left.v, left.a, left.j, step)
    p, nq = layout.phase, layout.nq
    return ca.vertcat(
        (right.q - q) / p.scale("q", nq), (right.v - v) / p.scale("v", nq), (right.a - a) / p.scale("a", nq)
    )


class Assembled:
    """The NLP's sparse functions of (x, p), gathered from the elements."""

    def __init__(self, problem: Problem, known: dict | None = None, like: Assembled | None = None):
        """``known`` are the functions of this very problem, its rows and cost terms, from an earlier process.

        ``like`` is the same problem on another mesh, whose small functions are taken over.
        """
        self.problem = problem
        self.layouts, at = {}, 0
        for phase in problem.phases:
            self.layouts[phase.name] = PhaseLayout(phase, at)
            at += self.layouts[phase.name].size
        self.size = at
        self.n_par = sum(problem.parameters.values())
        builder = _builder(problem, self.layouts, like) if known is None else None
        self.builder = builder
        self.cost_terms: list[tuple[str, Term]] = []
        if known is None:
            self.cost_terms = [(e.owner, term) for e in builder.elements for term, *_ in e.costs]
        else:
            terms = {(owner, term.name): term for owner, term in problem.terms()}
            self.cost_terms = [(owner, terms[owner, name]) for owner, name in known["costs"]]
        self.n_weight = len(self.cost_terms)
        # p = [parameters; weights; per phase: references (rows) x nodes, column major, preceded by s]
        self.data_first, at = {}, self.n_par + self.n_weight
        for name, layout in self.layouts.items():
            rows = 1 + sum(layout.phase.references.values())
            self.data_first[name] = (at, rows)
            at += rows * (layout.phase.intervals + 1)
        self.p_size = at
        self.rows: list[Row] = []
        if known is None:
            self._assemble(builder)
        else:
            self._take(known, terms)

    def _take(self, known: dict, terms: dict) -> None:
        terms = terms | {(name, _defect_term().name): _defect_term() for name in self.layouts}
        self.rows = [Row(owner, terms[owner, name], node, i) for owner, name, node, i in known["rows"]]
        self.n_rows = len(self.rows)
        self.nlp, self.grad_f, self.jac_g = known["nlp"], known["grad_f"], known["jac_g"]
        self.hess_lag, self.cost_parts = known["hess_lag"], known["cost_parts"]
        self.gauss_newton = known["gauss_newton"]
        if self.nlp.size1_in(0) != self.size or self.nlp.size1_out(1) != self.n_rows:
            raise ValueError(f"{self.problem.name}: functions of another problem")

    def _assemble(self, builder):
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.p_size)
        lam_f, rows, weight_at = ca.MX.sym("lam_f"), 0, 0
        pieces = []
        for e in (e.on(self.layouts) for e in builder.elements):
            keep = self._add_rows(e)
            weights = p[self.n_par + weight_at : self.n_par + weight_at + len(e.costs)]
            inputs = [
                ca.reshape(x[e.index.ravel().tolist()], e.index.shape[1], len(e.index)),
                self._data(p, e),
                p[: self.n_par],
            ]
            pieces.append(Piece(e, builder.parameter_vector, inputs, weights, keep, rows))
            rows, weight_at = rows + len(keep), weight_at + len(e.costs)
        self.n_rows = rows
        lam_g = ca.MX.sym("lam_g", rows)
        costs = [c for c in (piece.costs() for piece in pieces) if c is not None]
        f, parts = sum(c[0] for c in costs), ca.vertcat(*(c[1] for c in costs))
        grad = sum(scatter(piece.e.index.ravel(), self.size) @ piece.gradient() for piece in pieces if piece.e.costs)
        g = ca.vertcat(*(piece.rows() for piece in pieces if piece.e.constraints))
        jac = gather([piece.jacobian() for piece in pieces if piece.e.constraints], (rows, self.size))
        hess = gather([h for h in (piece.hessian(lam_f, lam_g) for piece in pieces) if h], (self.size, self.size))
        self.nlp = ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"])
        self.grad_f = ca.Function("nlp_grad_f", [x, p], [f, grad], ["x", "p"], ["f", "grad_f_x"])
        self.jac_g = ca.Function("nlp_jac_g", [x, p], [g, jac], ["x", "p"], ["g", "jac_g_x"])
        self.hess_lag = ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [hess], ["x", "p", "lam_f", "lam_g"],
                                    ["triu_hess_gamma_x_x"])  # fmt: skip
        self.cost_parts = ca.Function("cost_parts", [x, p], [parts])
        squares = gather([h for h in (piece.gauss_newton() for piece in pieces) if h], (self.size, self.size))
        self.gauss_newton = ca.Function("gauss_newton", [x, p], [squares], ["x", "p"], ["triu_hess_f"])

    def _add_rows(self, e) -> np.ndarray:
        """Record the constraint rows of an element; return which of its local rows are kept."""
        keep, size = [], sum(c.numel() for _, c in e.constraints)
        for r, k in enumerate(e.nodes):
            at = 0
            for term, expression in e.constraints:
                inside = len(e.nodes) == 1 or term.skip[0] <= r < len(e.nodes) - term.skip[1]
                for i in range(expression.numel()):
                    if inside:
                        keep.append(r * size + at)
                        self.rows.append(Row(e.owner, term, k, i))
                    at += 1
        return np.array(keep, int)

    def _data(self, p, e):
        if e.share is None:
            return ca.MX(0, len(e.nodes))
        first, rows = self.data_first[e.owner]
        index = np.concatenate([first + k * rows + np.arange(rows) for k in e.nodes])
        columns = ca.reshape(p[index.tolist()], rows, len(e.nodes))
        return ca.vertcat(columns, ca.DM.ones(1, len(e.nodes)) * e.share)


def _builder(problem: Problem, layouts, like: Assembled | None) -> ElementBuilder:
    """A builder of this problem; that of ``like`` if it is the same problem but for the mesh."""
    if like is None or like.builder is None:
        return ElementBuilder(problem, layouts)
    if problem.on_mesh({name: x.phase.intervals for name, x in like.layouts.items()}) != like.problem:
        raise ValueError(f"{problem.name}: functions of another problem")
    return like.builder
