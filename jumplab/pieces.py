"""One repeated small function as a part of a sparse NLP: values and exact derivatives for all repetitions at a time."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from jumplab.elements import Element


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
    """What one element contributes to the NLP: its small functions, called for all repetitions."""

    def __init__(self, element: Element, inputs, weights, keep, first_row):
        self.e, self.keep, self.first_row = element, keep, first_row
        self.n, self.count = len(element.index), sum(count for _, count in element.rows)
        self.inputs = [*inputs[:2], ca.repmat(inputs[2], 1, self.n)]
        self.weights = ca.repmat(weights, 1, self.n)

    def _map(self, function, values):
        return function.map(self.n)(*self.inputs, *values)

    def costs(self) -> tuple[ca.MX, ca.MX] | None:
        """(weighted sum, unweighted parts) or None."""
        if not self.e.costs:
            return None
        parts = ca.sum2(self._map(self.e.function("costs")[0], []))
        return ca.dot(self.weights[:, 0], parts), parts

    def gradient(self) -> ca.MX:
        """Local gradients, one under the other."""
        return ca.vec(self._map(self.e.function("gradient")[0], [self.weights]))

    def rows(self) -> ca.MX:
        """Kept constraint rows."""
        return ca.vec(self._map(self.e.function("rows")[0], []))[self.keep.tolist()]

    def jacobian(self) -> tuple:
        """(values, rows, columns) of the kept rows' Jacobian."""
        function, rows, cols = self.e.function("jacobian")
        row_of = np.full(self.count * self.n, -1)
        row_of[self.keep] = self.first_row + np.arange(len(self.keep))
        i = row_of[(np.arange(self.n)[:, None] * self.count + rows[None]).ravel()]
        used = i >= 0
        values = ca.vec(self._map(function, []))[np.flatnonzero(used).tolist()]
        return values, i[used], self.e.index[:, cols].ravel()[used]

    def hessian(self, lam_f: ca.MX, lam_g: ca.MX) -> tuple | None:
        """(values, rows, columns) of the upper triangle of the Lagrangian's Hessian, or None if it is zero."""
        function, rows, cols = self.e.function("hessian")
        if not len(rows):
            return None
        mine = lam_g[self.first_row : self.first_row + len(self.keep)]
        spread = ca.reshape(scatter(self.keep, self.count * self.n) @ mine, self.count, self.n)
        return self._upper(self._map(function, [self.weights, spread, ca.repmat(lam_f, 1, self.n)]), rows, cols)

    def gauss_newton(self) -> tuple | None:
        """(values, rows, columns) of the upper triangle of the costs' Gauss-Newton Hessian, or None if it is zero."""
        if not self.e.costs:
            return None
        function, rows, cols = self.e.function("gauss_newton")
        return self._upper(self._map(function, [self.weights]), rows, cols)

    def _upper(self, values, rows, cols) -> tuple:
        i, j = self.e.index[:, rows].ravel(), self.e.index[:, cols].ravel()
        return ca.vec(values), np.minimum(i, j), np.maximum(i, j)
