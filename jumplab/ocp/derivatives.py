"""Exact sparse derivatives: each place of a problem is one small function, differentiated once, called everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from jumplab.ocp.problem import PhaseLayout, Point, Problem, Term

END_OF_PHASE = 1e-9  # share of a phase, far below one interval
FUNCTIONS = ("costs", "gradient", "rows", "jacobian", "hessian", "gauss_newton")  # that an element may be asked for
RARE = ("gauss_newton",)  # evaluated a few times a plan: the search for common subexpressions would not pay


def chain(q: Any, v: Any, a: Any, j: Any, h: Any) -> tuple[Any, Any, Any]:
    """Exact triple-integrator step of length ``h`` under constant jerk: new (q, v, a)."""
    return q + h * v + h * h / 2 * a + h**3 / 6 * j, v + h * a + h * h / 2 * j, a + h * j


class Formulas:
    """One element in symbols, from which its functions are made.

    Their arguments are the element's variables, its data (share of the phase, references, step), the parameters, and as
    needed the weights of the costs, the multipliers of the rows, and the multiplier of the cost.
    """

    def __init__(self, local, data, parameters, costs, rows):
        """``costs`` are (share, column), meaning share |column|^2; ``rows`` scaled columns."""
        self.local, self.costs, self.ny = local, costs, local.numel()
        self.arguments = [local, data, parameters]
        self.w = ca.SX.sym("w", len(costs))
        self.parts = ca.vertcat(ca.SX(0, 1), *(share * ca.sumsqr(y) for share, y in costs))
        self.g = ca.vertcat(ca.SX(0, 1), *rows)

    def make(self, name: str) -> tuple[ca.Function, np.ndarray, np.ndarray]:
        """One of :data:`FUNCTIONS` as (function of a column of values, their rows, their columns)."""
        symbols, output, sparsity = getattr(self, f"_{name}")()
        function = ca.Function(name, [*self.arguments, *symbols], [output], {"cse": name not in RARE})
        places = sparsity.get_triplet() if sparsity is not None else ((), ())
        return function, *(np.array(z, int) for z in places)

    def _costs(self):
        return [], self.parts, None

    def _gradient(self):
        return [self.w], ca.gradient(ca.dot(self.w, self.parts) if self.costs else ca.SX(0), self.local), None

    def _rows(self):
        return [], self.g, None

    def _jacobian(self):
        j = ca.jacobian(self.g, self.local)
        return [], ca.vertcat(*j.nonzeros()), j.sparsity()

    def _hessian(self):
        """Upper triangle of the Lagrangian's Hessian."""
        lam, scale = ca.SX.sym("lam", self.g.numel()), ca.SX.sym("lam_f")
        h = ca.triu(self._curvature(lam, scale))
        return [self.w, lam, scale], ca.vertcat(ca.SX(0, 1), *h.nonzeros()), h.sparsity()

    def _gauss_newton(self):
        """Upper triangle of the costs' Hessian without their own curvature."""
        h = ca.triu(self._squares(1.0)[0])
        return [self.w], ca.vertcat(ca.SX(0, 1), *h.nonzeros()), h.sparsity()

    def _squares(self, scale) -> tuple:
        """(2 w J^T J summed over the costs w |y|^2, [(share, y, J, 2 w) of each])."""
        total, parts = ca.SX(self.ny, self.ny), []
        for k, (share, y) in enumerate(self.costs):
            jacobian = ca.jacobian(y, self.local)
            weight = 2 * scale * self.w[k] * share
            total += weight * (jacobian.T @ jacobian)
            parts.append((share, y, jacobian, weight))
        return total, parts

    def _curvature(self, lam, scale):
        """Hessian of scale * cost + lam . g.

        A cost w |y|^2 contributes 2 w J^T J, and the curvature of y as if y were a constraint with multiplier 2 w y: so
        everything is bent only once, with constant multipliers. (Where w depends on x, there are mixed terms.)
        """
        x, ys, mus = self.local, [], []
        extra, parts = self._squares(scale)
        for k, (share, y, jacobian, weight) in enumerate(parts):
            mixed = ca.jacobian(share, x).T @ (2 * scale * self.w[k] * (y.T @ jacobian))
            extra += mixed + mixed.T
            ys, mus = [*ys, y], [*mus, weight * y]
        y, mu = ca.vertcat(ca.SX(0, 1), *ys), ca.vertcat(ca.SX(0, 1), *mus)
        held = ca.SX.sym("mu", y.numel())
        bent = ca.hessian(ca.dot(held, y) + ca.dot(lam, self.g), x)[0]
        symbols = [x, self.arguments[1], self.arguments[2], lam, held]
        return extra + ca.Function("bent", symbols, [bent])(*symbols[:-1], mu)


class Element:
    """One small function, repeated: its terms, and what is made of them for all meshes.

    Attributes
    ----------
    owner, place : phase and where in it, as in :class:`~jumplab.ocp.problem.Term`.  ny : number of its variables.
    costs : its cost terms.  rows : its constraint terms, each with its number of rows.
    made : name -> function, rows and columns of its nonzeros.
    """

    def __init__(
        self,
        owner: str,
        place: str,
        ny: int,
        costs: list[Term],
        rows: list[tuple[Term, int]],
        formulas: Formulas | None = None,
        made: dict | None = None,
    ):
        self.owner, self.place, self.ny, self.costs, self.rows = owner, place, ny, costs, rows
        self._formulas, self.made = formulas, made or {}

    def function(self, name: str) -> tuple[ca.Function, np.ndarray, np.ndarray]:
        """One of :data:`FUNCTIONS`, made when it is first asked for."""
        if name not in self.made:
            self.made[name] = self._formulas.make(name)
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


def _column(expression):
    return ca.vertcat(*expression) if isinstance(expression, (list, tuple)) else ca.SX(expression)


class ElementBuilder:
    """Makes the symbolic points of each phase and evaluates the terms on them; how many nodes there are is open."""

    def __init__(self, problem: Problem, layouts: dict[str, PhaseLayout]):
        self.problem, self.layouts = problem, layouts
        symbols = {name: ca.SX.sym(name, size) for name, size in problem.parameters.items()}
        self.parameters, self.parameter_vector = SimpleNamespace(**symbols), ca.vertcat(ca.SX(0, 1), *symbols.values())
        self.elements = [e for layout in layouts.values() for e in self._phase(layout)]
        if problem.joints:
            self.elements.append(self._joints())

    def _point(self, layout, state, jerk, constants, s, refs):
        nq, phase = layout.nq, layout.phase
        x, const = ca.DM(layout.node_scales) * state, ca.DM(layout.constant_scales) * constants
        names = SimpleNamespace(**{n: const[1 + i] for i, n in enumerate(phase.constants)})
        ends = np.cumsum([0, *phase.references.values()]).tolist()
        ref = SimpleNamespace(**{n: refs[ends[i] : ends[i + 1]] for i, n in enumerate(phase.references)})
        j = jerk * ca.DM(phase.scale("j")) if jerk is not None else None
        q, v, a, z = x[:nq], x[nq : 2 * nq], x[2 * nq : 3 * nq], x[3 * nq :]
        return Point(q, v, a, j, z, const[0], s, names, self.parameters, ref)

    def _phase(self, layout):
        phase, nx, nref = layout.phase, layout.nx, sum(layout.phase.references.values())
        constants, refs, s = ca.SX.sym("const", len(layout.constants)), ca.SX.sym("ref", nref), ca.SX.sym("s")
        state, right, jerk = ca.SX.sym("x", nx), ca.SX.sym("x_next", nx), ca.SX.sym("j", layout.nq)
        share = ca.SX.sym("share")  # of the phase, between two nodes
        step, data = constants[0] * share, ca.vertcat(s, refs, share)
        at_node = self._point(layout, state, None, constants, s, refs)
        for place in ("node", "start", "end"):
            terms = [t for t in phase.terms if t.at == place]
            if terms:
                part = step * _trapezoid(s) if place == "node" else 1.0
                out = [_weighted(t, t.expression(at_node), part) for t in terms]
                yield self._element(phase.name, place, ca.vertcat(constants, state), data, out, terms)
        left = self._point(layout, state, jerk, constants, s, refs)
        after = self._point(layout, right, None, constants, s + share, refs)
        q, v, a = chain(left.q, left.v, left.a, left.j, step / 2)
        mid = Point(q, v, a, left.j, left.z, left.duration, s + share / 2, left.c, left.p, left.ref)
        terms, out = [defect_term()], [_defect(phase, left, after, step)]
        for t in phase.terms:
            if t.at == "mid":
                terms.append(t)
                out.append(_weighted(t, t.expression(mid), step))
            elif t.at == "interval":
                terms.append(t)
                out.append(_weighted(t, t.expression(left, after, step), 1.0))
        yield self._element(phase.name, "interval", ca.vertcat(constants, state, jerk, right), data, out, terms)

    def _joints(self):
        ends, symbols = {}, []
        for name, layout in self.layouts.items():
            sizes = {"const": len(layout.constants), "x0": layout.nx, "x1": layout.nx}
            constants, first, last = (ca.SX.sym(n, size) for n, size in sizes.items())
            refs = ca.SX.zeros(sum(layout.phase.references.values()))
            start = self._point(layout, first, None, constants, 0.0, refs)
            ends[name] = SimpleNamespace(start=start, end=self._point(layout, last, None, constants, 1.0, refs))
            symbols += [constants, first, last]
        terms = list(self.problem.joints)
        out = [_weighted(t, t.expression(ends), 1.0) for t in terms]
        return self._element(self.problem.name, "problem", ca.vertcat(*symbols), ca.SX(0, 1), out, terms)

    def _element(self, owner, place, local, data, outputs, terms) -> Element:
        pairs = list(zip(terms, outputs, strict=True))
        costs, rows = [x for x in pairs if x[0].is_cost], [x for x in pairs if not x[0].is_cost]
        formulas = Formulas(local, data, self.parameter_vector, [e for _, e in costs], [e for _, e in rows])
        return Element(owner, place, local.numel(), [t for t, _ in costs], [(t, e.numel()) for t, e in rows], formulas)


def _weighted(term, expression, step):
    """A cost as (share, column), meaning share |column|^2; a constraint as its scaled column."""
    return (step, _column(expression)) if term.is_cost else _column(expression) / term.scale


def _trapezoid(s):
    """Trapezoid rule: a phase's first and last node count half."""
    return 1 - 0.5 * ((s < END_OF_PHASE) + (s > 1 - END_OF_PHASE))


def defect_term() -> Term:
    """The exact step under constant jerk from node to node, as a term."""
    return Term("jerk chain", "state equation, Sec. III-A, V-A", "scaled", "interval", None, identity=True)


def _defect(phase, left, right, step):
    reached = chain(left.q, left.v, left.a, left.j, step)
    return ca.vertcat(*((getattr(right, key) - x) / phase.scale(key) for key, x in zip("qva", reached, strict=True)))


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


class Block:
    """What one element contributes to the NLP: its small functions, called for all repetitions.

    Attributes
    ----------
    e : the element.  index : its variables (n, ny).  keep : which of its rows, over all repetitions, are in the NLP;
        there they begin at ``first_row``.
    """

    def __init__(self, element: Element, index: np.ndarray, inputs, weights, keep: np.ndarray, first_row: int):
        self.e, self.index, self.keep, self.first_row = element, index, keep, first_row
        self.n, self.count = len(index), sum(count for _, count in element.rows)
        self.inputs = [*inputs[:2], ca.repmat(inputs[2], 1, self.n)]
        self.weights = ca.repmat(weights, 1, self.n)

    def _map(self, function, values=()):
        return function.map(self.n)(*self.inputs, *values)

    def costs(self) -> tuple[ca.MX, ca.MX]:
        """(weighted sum, unweighted parts)."""
        parts = ca.sum2(self._map(self.e.function("costs")[0]))
        return ca.dot(self.weights[:, 0], parts), parts

    def gradient(self, size: int) -> ca.MX:
        """Of the costs with respect to all variables (size,)."""
        local = self._map(self.e.function("gradient")[0], [self.weights])
        return scatter(self.index.ravel(), size) @ ca.vec(local)

    def rows(self) -> ca.MX:
        """Constraint rows."""
        return ca.vec(self._map(self.e.function("rows")[0]))[self.keep.tolist()]

    def jacobian(self) -> tuple:
        """(values, rows, columns) of the rows' Jacobian."""
        function, rows, cols = self.e.function("jacobian")
        row_of = np.full(self.count * self.n, -1)
        row_of[self.keep] = self.first_row + np.arange(len(self.keep))
        i = row_of[(np.arange(self.n)[:, None] * self.count + rows[None]).ravel()]
        used = i >= 0
        values = ca.vec(self._map(function))[np.flatnonzero(used).tolist()]
        return values, i[used], self.index[:, cols].ravel()[used]

    def hessian(self, lam_f: ca.MX, lam_g: ca.MX) -> tuple:
        """(values, rows, columns) of the upper triangle of the Lagrangian's Hessian."""
        mine = lam_g[self.first_row : self.first_row + len(self.keep)]
        spread = ca.reshape(scatter(self.keep, self.count * self.n) @ mine, self.count, self.n)
        return self._upper("hessian", [self.weights, spread, ca.repmat(lam_f, 1, self.n)])

    def gauss_newton(self) -> tuple:
        """(values, rows, columns) of the upper triangle of the costs' Gauss-Newton Hessian."""
        return self._upper("gauss_newton", [self.weights])

    def _upper(self, name, arguments) -> tuple:
        function, rows, cols = self.e.function(name)
        i, j = self.index[:, rows].ravel(), self.index[:, cols].ravel()
        return ca.vec(self._map(function, arguments)), np.minimum(i, j), np.maximum(i, j)
