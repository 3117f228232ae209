"""A problem as one sparse NLP (:class:`Assembled`): its parts' small functions, called at every
node and gathered.

All variables and rows are divided by their scales here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from jumplab.ocp import cache
from jumplab.ocp.derivatives import Part, parts
from jumplab.ocp.layout import layouts
from jumplab.ocp.problem import Problem, Term


@dataclass(frozen=True)
class Rows:
    """The rows of one constraint: C components at each of K nodes (K,); ``index`` (K, C) in g."""

    owner: str
    term: Term
    nodes: np.ndarray
    index: np.ndarray


class Assembled:
    """The NLP's sparse functions of variables x and data p, gathered from the parts.

    ``key`` : if given, what is made is kept, see :func:`jumplab.ocp.cache.functions`.

    Attributes
    ----------
    layouts : phase name -> where its variables stand in x.
    size, n_rows, p_size : numbers of variables, rows and data; p = [parameters; weights; per phase
        (share of the phase, references) of every node].
    rows, cost_terms : what the rows are; (owner, term) of every cost.
    nlp, grad_f, jac_g, hess_lag : cost and rows with derivatives, as ipopt needs them.
    functions_of_nlp : these four by name, see :func:`nlp_functions`.
    cost_parts, gauss_newton : unweighted costs; upper triangle of the cost's Hessian without the
        curvature of what it squares.
    """

    def __init__(self, problem: Problem, key: str | None = None):
        self.problem = problem
        self.layouts = layouts(problem)
        self.size = 1 + max(int(x.nodes.max()) for x in self.layouts.values())
        self.parts = parts(problem)
        self.functions = cache.functions(problem, self.parts, key)
        self.cost_terms = [(part.owner, term) for part in self.parts for term in part.costs]
        sizes = [sum(problem.parameters.values()), len(self.cost_terms)]
        for layout in self.layouts.values():
            sizes.append((1 + sum(layout.phase.references.values())) * len(layout.nodes))
        self.data_at = np.cumsum([0, *sizes]).tolist()
        self.p_size = self.data_at[-1]
        x = ca.MX.sym("x", self.size)
        p = ca.MX.sym("p", self.p_size)
        self.rows: list[Rows] = []
        self.n_rows = 0
        blocks = list(self._blocks(x, p))
        lam_f = ca.MX.sym("lam_f")
        lam_g = ca.MX.sym("lam_g", self.n_rows)
        priced = [b for b in blocks if b.part.costs]
        bound = [b for b in blocks if b.part.constraints]
        costs = [ca.sum2(b("costs")[0]) for b in priced]
        f = sum(ca.dot(b.weights[:, 0], part) for b, part in zip(priced, costs, strict=True))
        g = ca.vertcat(*(ca.vec(ca.vertcat(*b("rows")))[b.kept] for b in bound))
        slopes = [b.gradient() for b in priced]
        grad = ca.densify(gather(slopes, (self.size, 1))) if priced else ca.MX.zeros(self.size, 1)
        jac = gather([b.jacobian() for b in bound], (self.n_rows, self.size))
        multipliers = ca.vertcat(lam_g, 0)
        square = (self.size, self.size)
        hess = gather([b.hessian(lam_f, multipliers) for b in blocks], square)
        squares = gather([b.upper("gauss_newton", b.weights) for b in priced], square)
        self.functions_of_nlp = nlp_functions((x, p, lam_f, lam_g), f, g, grad, jac, hess)
        self.nlp, self.grad_f, self.jac_g, self.hess_lag = self.functions_of_nlp.values()
        self.cost_parts = ca.Function("cost_parts", [x, p], [ca.vertcat(*costs)])
        self.gauss_newton = ca.Function("gauss_newton", [x, p], [squares])

    def _blocks(self, x: ca.MX, p: ca.MX) -> Iterator[Block]:
        """All parts at their nodes; adds to ``rows`` and ``n_rows``."""
        parameters, weights, *data = ca.vertsplit(p, self.data_at)
        data = {
            name: ca.reshape(column, -1, len(layout.nodes))
            for (name, layout), column in zip(self.layouts.items(), data, strict=True)
        }
        weight = 0
        for part, functions in zip(self.parts, self.functions, strict=True):
            nodes, index = part.on(self.layouts)
            n = len(nodes)
            number = self._number(part, functions, nodes)
            part_weights = weights[weight : weight + len(part.costs)]
            weight += len(part.costs)
            local = ca.reshape(x[index.ravel().tolist()], -1, n)
            given = ca.MX(0, n)
            if part.owner in data:
                step = ca.DM.ones(1, n) / self.layouts[part.owner].phase.intervals
                given = ca.vertcat(data[part.owner][:, nodes.tolist()], step)
            inputs = (local, given, ca.repmat(parameters, 1, n))
            yield Block(part, functions, index, number, inputs, ca.repmat(part_weights, 1, n))

    def _number(self, part: Part, functions: dict[str, ca.Function], nodes) -> np.ndarray:
        """Numbers (n, count) of the rows of a part at ``nodes`` (n,), -1 where one is left out."""
        if not part.constraints:
            return np.empty((len(nodes), 0), int)
        f = functions["rows"]
        counts = [f.size1_out(i) for i in range(f.n_out())]
        skips = np.array([t.skip for t in part.constraints])
        first, last = np.repeat(skips, counts, axis=0).T
        place = np.arange(len(nodes))[:, None]
        kept = (place >= first) & (place < len(nodes) - last)
        number = np.where(kept, self.n_rows - 1 + np.cumsum(kept).reshape(kept.shape), -1)
        self.n_rows += int(kept.sum())
        columns = np.split(number, np.cumsum(counts)[:-1], axis=1)
        for term, index in zip(part.constraints, columns, strict=True):
            stay = index[:, 0] >= 0
            self.rows.append(Rows(part.owner, term, nodes[stay], index[stay]))
        return number

    def held_hessian(self, hold: float) -> ca.Function:
        """In place of ``hess_lag``: the Gauss-Newton Hessian and ``hold`` for every (scaled)
        variable.

        It has no direction of negative curvature, and costs a fraction of the exact one.
        """
        exact = self.hess_lag
        given = x, p, lam_f, _ = exact.mx_in()
        held = lam_f * self.gauss_newton(x, p) + hold * ca.DM.eye(self.size)
        return ca.Function("nlp_hess_l", given, [held], exact.name_in(), exact.name_out())


def nlp_functions(
    symbols: Sequence[ca.MX], f: ca.MX, g: ca.MX, grad: ca.MX, jac: ca.MX, hess: ca.MX
) -> dict[str, ca.Function]:
    """Cost and rows with their derivatives as CasADi's solvers take them.

    ``symbols`` are x (n,), p, lam_f, lam_g (m,); ``f`` the cost, ``g`` (m,) the rows, ``grad``
    (n,), ``jac`` (m, n), ``hess`` (n, n) the upper triangle of the Lagrangian's Hessian.
    """
    first = symbols[:2]
    names = ["x", "p"]
    more = [*names, "lam_f", "lam_g"]
    return {
        "nlp": ca.Function("nlp", first, [f, g], names, ["f", "g"]),
        "grad_f": ca.Function("nlp_grad_f", first, [f, grad], names, ["f", "grad_f_x"]),
        "jac_g": ca.Function("nlp_jac_g", first, [g, jac], names, ["g", "jac_g_x"]),
        "hess_lag": ca.Function("nlp_hess_l", symbols, [hess], more, ["triu_hess_gamma_x_x"]),
    }


def ipopt(functions: Mapping[str, ca.Function], options: Mapping) -> ca.Function:
    """A quiet ipopt with four functions (of :func:`nlp_functions`): all derivatives are given."""
    quiet = ("print_time", "error_on_fail", "show_eval_warnings", "calc_lam_p")
    derivatives = {name: f for name, f in functions.items() if name != "nlp"}
    given = {"ipopt": dict(options), "no_nlp_grad": True, **derivatives}
    return ca.nlpsol("solver", "ipopt", functions["nlp"], given | dict.fromkeys(quiet, False))


def scatter(index: np.ndarray, size: int) -> ca.DM:
    """0/1 matrix (size, len(index)) that adds entry i of a vector to position index[i]."""
    n = len(index)
    return ca.DM.triplet(np.asarray(index).tolist(), list(range(n)), ca.DM.ones(n), size, n)


def gather(entries: Sequence[tuple], shape: tuple[int, int]) -> ca.MX:
    """Sparse MX matrix from (values, rows, columns) triples; entries that meet are added."""
    if not entries:
        return ca.MX(*shape)
    values = ca.vertcat(*(x[0] for x in entries))
    rows, columns = (np.concatenate([x[k] for x in entries]) for k in (1, 2))
    places, which = np.unique(columns * shape[0] + rows, return_inverse=True)
    columns, rows = np.divmod(places, shape[0])
    pattern = ca.Sparsity.triplet(*shape, rows.tolist(), columns.tolist())
    return ca.MX(pattern, scatter(which, len(places)) @ values)


@dataclass(frozen=True)
class Block:
    """Contribution of one part to the NLP: its functions, called at all of its nodes."""

    part: Part
    functions: dict[str, ca.Function]
    index: np.ndarray  # (n, ny) its variables
    number: np.ndarray  # (n, count) its rows in the NLP, -1 for those that are left out
    inputs: tuple  # MX, one column per node, as the weights
    weights: ca.MX

    @property
    def kept(self) -> list[int]:
        """Which of its rows, over all nodes, are in the NLP."""
        return np.flatnonzero(self.number >= 0).tolist()

    def __call__(self, name: str, *more: ca.MX) -> list[ca.MX]:
        """All outputs of one of the functions, a matrix per node side by side."""
        return self.functions[name].map(len(self.index)).call([*self.inputs, *more])

    def _entries(self, name: str, *more: ca.MX) -> tuple[ca.MX, np.ndarray, np.ndarray]:
        """(values, local rows, columns in x) of a matrix's entries at all nodes, (n, entries)."""
        rows, columns = map(np.array, self.functions[name].sparsity_out(0).get_triplet())
        return ca.vec(self(name, *more)[0].nz[:]), rows.astype(int), columns.astype(int)

    def gradient(self) -> tuple:
        """(values, rows, columns) of the costs' gradient."""
        rows = self.index.ravel()
        return ca.vec(self("gradient", self.weights)[0]), rows, np.zeros_like(rows)

    def jacobian(self) -> tuple:
        """(values, rows, columns) of the rows' Jacobian."""
        values, rows, columns = self._entries("jacobian")
        number = self.number[:, rows].ravel()
        kept = np.flatnonzero(number >= 0)
        return values[kept.tolist()], number[kept], self.index[:, columns].ravel()[kept]

    def hessian(self, lam_f: ca.MX, lam_g: ca.MX) -> tuple:
        """(values, rows, columns) of the upper triangle of the Lagrangian's Hessian.

        The last one of ``lam_g`` (n_rows + 1,) is that of rows that are left out.
        """
        multipliers = lam_g[self.number.ravel().tolist()]
        lam = ca.reshape(multipliers, self.number.shape[1], len(self.index))
        return self.upper("hessian", self.weights, lam, ca.repmat(lam_f, 1, len(self.index)))

    def upper(self, name: str, *more: ca.MX) -> tuple:
        """(values, rows, columns) of the upper triangle of a symmetric matrix, "hessian" or
        "gauss_newton".
        """
        values, rows, columns = self._entries(name, *more)
        i = self.index[:, rows].ravel()
        j = self.index[:, columns].ravel()
        # two local variables that are one: both halves count
        met = (i == j) & np.tile(rows != columns, len(self.index))
        if met.any():
            values = values * ca.DM(np.where(met, 2.0, 1.0))
        return values, np.minimum(i, j), np.maximum(i, j)
