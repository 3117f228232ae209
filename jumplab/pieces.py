"""One repeated small function as a part of a sparse NLP: values and exact derivatives for all repetitions at a time."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np


def scatter(index: np.ndarray, size: int) -> ca.DM:
    """0/1 matrix that adds entry i of a vector to position index[i]."""
    index = np.asarray(index, int)
    return ca.DM.triplet(index.tolist(), list(range(len(index))), ca.DM.ones(len(index)), size, len(index))


def gather(pieces: Sequence[tuple], shape: tuple[int, int]) -> ca.MX:
    """Sparse MX matrix from (values, rows, columns) triples; entries that meet are added."""
    values = ca.vertcat(*(piece[0] for piece in pieces))
    rows, cols = (np.concatenate([piece[k] for piece in pieces]) for k in (1, 2))
    key = cols.astype(np.int64) * shape[0] + rows
    unique, inverse = np.unique(key, return_inverse=True)
    pattern = ca.Sparsity.triplet(*shape, (unique % shape[0]).tolist(), (unique // shape[0]).tolist())
    if len(unique) == len(key):
        return ca.MX(pattern, values[np.argsort(key).tolist()])
    return ca.MX(pattern, scatter(inverse, len(unique)) @ values)


class Piece:
    """What one element contributes to the NLP: its small functions, differentiated once, called for all repetitions."""

    def __init__(self, element, parameters, inputs, weights, keep, first_row):
        self.e, self.keep, self.first_row = element, keep, first_row
        self.n, self.ny = element.index.shape
        self.inputs = [*inputs[:2], ca.repmat(inputs[2], 1, self.n)]
        self.weights = ca.repmat(weights, 1, self.n)
        self.arguments = [element.local, element.data, parameters]
        self.w = ca.SX.sym("w", len(element.costs))
        self.cost_parts = ca.vertcat(ca.SX(0, 1), *(share * ca.sumsqr(y) for _, share, y in element.costs))
        self.g = ca.vertcat(ca.SX(0, 1), *(c for _, c in element.constraints))
        self.total = ca.dot(self.w, self.cost_parts) if element.costs else ca.SX(0)

    def _made(self, name, make):
        """(function, rows, columns), made once for all meshes.

        ``make`` returns the symbols besides the arguments, the column of values, and its sparsity or None.
        """
        if name not in self.e.made:
            symbols, output, sparsity = make()
            function = ca.Function(name, [*self.arguments, *symbols], [output], {"cse": True})
            places = sparsity.get_triplet() if sparsity is not None else ((), ())
            self.e.made[name] = (function, *(np.array(z, int) for z in places))
        return self.e.made[name]

    def _map(self, function, values):
        return function.map(self.n)(*self.inputs, *values)

    def costs(self) -> tuple[ca.MX, ca.MX] | None:
        """(weighted sum, unweighted parts) or None."""
        if not self.e.costs:
            return None
        parts = ca.sum2(self._map(self._made("costs", lambda: ([], self.cost_parts, None))[0], []))
        return ca.dot(self.weights[:, 0], parts), parts

    def gradient(self) -> ca.MX:
        """Local gradients, one under the other."""
        function, *_ = self._made("gradient", lambda: ([self.w], ca.gradient(self.total, self.e.local), None))
        return ca.vec(self._map(function, [self.weights]))

    def rows(self) -> ca.MX:
        """Kept constraint rows."""
        return ca.vec(self._map(self._made("rows", lambda: ([], self.g, None))[0], []))[self.keep.tolist()]

    def jacobian(self) -> tuple:
        """(values, rows, columns) of the kept rows' Jacobian."""

        def make():
            j = ca.jacobian(self.g, self.e.local)
            return [], ca.vertcat(*j.nonzeros()), j.sparsity()

        function, rows, cols = self._made("jacobian", make)
        row_of = np.full(self.g.numel() * self.n, -1)
        row_of[self.keep] = self.first_row + np.arange(len(self.keep))
        i = row_of[(np.arange(self.n)[:, None] * self.g.numel() + rows[None]).ravel()]
        used = i >= 0
        values = ca.vec(self._map(function, []))[np.flatnonzero(used).tolist()]
        return values, i[used], self.e.index[:, cols].ravel()[used]

    def hessian(self, lam_f: ca.MX, lam_g: ca.MX) -> tuple | None:
        """(values, rows, columns) of the upper triangle of the Lagrangian's Hessian, or None if it is zero."""

        def make():
            lam, scale = ca.SX.sym("lam", self.g.numel()), ca.SX.sym("lam_f")
            h = ca.triu(self._curvature(lam, scale))
            return [self.w, lam, scale], ca.vertcat(ca.SX(0, 1), *h.nonzeros()), h.sparsity()

        function, rows, cols = self._made("hessian", make)
        if not len(rows):
            return None
        mine = lam_g[self.first_row : self.first_row + len(self.keep)]
        spread = ca.reshape(scatter(self.keep, self.g.numel() * self.n) @ mine, self.g.numel(), self.n)
        values = self._map(function, [self.weights, spread, ca.repmat(lam_f, 1, self.n)])
        i, j = self.e.index[:, rows].ravel(), self.e.index[:, cols].ravel()
        return ca.vec(values), np.minimum(i, j), np.maximum(i, j)

    def gauss_newton(self) -> tuple | None:
        """(values, rows, columns) of the upper triangle of the costs' Gauss-Newton Hessian, or None if it is zero."""

        def make():
            h = ca.triu(self._squares(1.0)[0])
            return [self.w], ca.vertcat(ca.SX(0, 1), *h.nonzeros()), h.sparsity()

        if not self.e.costs:
            return None
        function, rows, cols = self._made("gauss_newton", make)
        i, j = self.e.index[:, rows].ravel(), self.e.index[:, cols].ravel()
        return ca.vec(self._map(function, [self.weights])), np.minimum(i, j), np.maximum(i, j)

    def _squares(self, scale) -> tuple:
        """(2 w J^T J summed over the costs w |y|^2, [(share, y, J, 2 w) of each])."""
        total, parts = ca.SX(self.ny, self.ny), []
        for k, (_, share, y) in enumerate(self.e.costs):
            jacobian = ca.jacobian(y, self.e.local)
            weight = 2 * scale * self.w[k] * share
            total += weight * (jacobian.T @ jacobian)
            parts.append((share, y, jacobian, weight))
        return total, parts

    def _curvature(self, lam, scale):
        """Hessian of scale * cost + lam . g.

        A cost w |y|^2 contributes 2 w J^T J, and the curvature of y as if y were a constraint with multiplier 2 w y: so
        everything is bent only once, with constant multipliers. (Where w depends on x, there are mixed terms.)
        """
        x, ys, mus = self.e.local, [], []
        extra, parts = self._squares(scale)
        for k, (share, y, jacobian, weight) in enumerate(parts):
            mixed = ca.jacobian(share, x).T @ (2 * scale * self.w[k] * (y.T @ jacobian))
            extra += mixed + mixed.T
            ys, mus = [*ys, y], [*mus, weight * y]
        y, mu = ca.vertcat(ca.SX(0, 1), *ys), ca.vertcat(ca.SX(0, 1), *mus)
        held = ca.SX.sym("mu", y.numel())
        bent = ca.hessian(ca.dot(held, y) + ca.dot(lam, self.g), x)[0]
        symbols = [x, self.e.data, self.arguments[2], lam, held]
        return extra + ca.Function("bent", symbols, [bent])(*symbols[:-1], mu)
