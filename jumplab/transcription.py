"""From a :class:`~jumplab.terms.Problem` to a sparse NLP with exact derivatives.

Every term depends on few variables: one node, one interval, or the ends of phases. The NLP is therefore assembled from
small CasADi functions, differentiated once and evaluated for all nodes at a time; the sparse gradient, Jacobian and
Hessian are gathered from theirs. Building takes a fraction of a second, needs no compiler, and the functions can be
shared by all targets, weights and switches, which are parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.elements import Element, ElementBuilder
from jumplab.layout import PhaseLayout
from jumplab.pieces import Piece, gather, scatter
from jumplab.terms import Problem, Term


@dataclass(frozen=True)
class Row:
    """Which term, phase, node and component a constraint row belongs to."""

    owner: str
    term: Term
    node: int
    component: int


class Assembled:
    """The NLP's sparse functions of (x, p), gathered from the elements."""

    def __init__(self, problem: Problem, elements: Sequence[Element] | None = None):
        """``elements`` are those of the same problem on any mesh; built anew if None."""
        self.problem = problem
        self.layouts, at = {}, 0
        for phase in problem.phases:
            self.layouts[phase.name] = PhaseLayout(phase, at)
            at += self.layouts[phase.name].size
        self.size = at
        self.n_par = sum(problem.parameters.values())
        self.elements = elements or ElementBuilder(problem, self.layouts).elements
        self.cost_terms = [(e.owner, term) for e in self.elements for term in e.costs]
        self.n_weight = len(self.cost_terms)
        # p = [parameters; weights; per phase: references (rows) x nodes, column major, preceded by s]
        self.data_first, at = {}, self.n_par + self.n_weight
        for name, layout in self.layouts.items():
            rows = 1 + sum(layout.phase.references.values())
            self.data_first[name] = (at, rows)
            at += rows * (layout.phase.intervals + 1)
        self.p_size = at
        self.rows: list[Row] = []
        self._assemble()

    def on_mesh_of(self, problem: Problem) -> Assembled:
        """The same problem on another mesh, from the same small functions; ``ValueError`` if it is another problem."""
        if problem.on_mesh({name: x.phase.intervals for name, x in self.layouts.items()}) != self.problem:
            raise ValueError(f"{problem.name}: functions of another problem")
        return Assembled(problem, self.elements)

    def _assemble(self):
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.p_size)
        lam_f, rows, weight_at = ca.MX.sym("lam_f"), 0, 0
        pieces = []
        for e in (e.on(self.layouts) for e in self.elements):
            keep = self._add_rows(e)
            weights = p[self.n_par + weight_at : self.n_par + weight_at + len(e.costs)]
            inputs = [
                ca.reshape(x[e.index.ravel().tolist()], e.index.shape[1], len(e.index)),
                self._data(p, e),
                p[: self.n_par],
            ]
            pieces.append(Piece(e, inputs, weights, keep, rows))
            rows, weight_at = rows + len(keep), weight_at + len(e.costs)
        self.n_rows, self._open = rows, (x, p, pieces)
        lam_g = ca.MX.sym("lam_g", rows)
        costs = [c for c in (piece.costs() for piece in pieces) if c is not None]
        f, parts = sum(c[0] for c in costs), ca.vertcat(*(c[1] for c in costs))
        grad = sum(scatter(piece.e.index.ravel(), self.size) @ piece.gradient() for piece in pieces if piece.e.costs)
        g = ca.vertcat(*(piece.rows() for piece in pieces if piece.e.rows))
        jac = gather([piece.jacobian() for piece in pieces if piece.e.rows], (rows, self.size))
        hess = gather([h for h in (piece.hessian(lam_f, lam_g) for piece in pieces) if h], (self.size, self.size))
        self.nlp = ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"])
        self.grad_f = ca.Function("nlp_grad_f", [x, p], [f, grad], ["x", "p"], ["f", "grad_f_x"])
        self.jac_g = ca.Function("nlp_jac_g", [x, p], [g, jac], ["x", "p"], ["g", "jac_g_x"])
        self.hess_lag = ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [hess], ["x", "p", "lam_f", "lam_g"],
                                    ["triu_hess_gamma_x_x"])  # fmt: skip
        self.cost_parts = ca.Function("cost_parts", [x, p], [parts])

    @cached_property
    def gauss_newton(self) -> ca.Function:
        """(x, p) -> upper triangle of the cost's Hessian without the curvature of what it squares."""
        x, p, pieces = self._open
        hess = gather([h for h in (piece.gauss_newton() for piece in pieces) if h], (self.size, self.size))
        return ca.Function("gauss_newton", [x, p], [hess], ["x", "p"], ["triu_hess_f"])

    def _add_rows(self, e) -> np.ndarray:
        """Record the constraint rows of an element; return which of its local rows are kept."""
        keep, size = [], sum(count for _, count in e.rows)
        for r, k in enumerate(e.nodes):
            at = 0
            for term, count in e.rows:
                inside = len(e.nodes) == 1 or term.skip[0] <= r < len(e.nodes) - term.skip[1]
                for i in range(count):
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
