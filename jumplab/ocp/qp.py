"""A quadratic program of a few dozen unknowns, row by row with names; solved within a millisecond.

    min over x  1/2 sum of w (a x - b)^2   so that   c x = d,   low <= f x <= high

Rows of one name are a block. Solving says nothing but the answer and whether it can be trusted;
where there is none, :func:`conflict` says which rows stand against each other, and by how much.

>>> import numpy as np
>>> from jumplab.ocp.qp import Qp, QpSolver
>>> qp = Qp(2)
>>> qp.cost("near", np.eye(2), [2.0, 1.0], weight=[1.0, 3.0])
>>> qp.equality("sum", [[1.0, 1.0]], 1.0)
>>> qp.limit("box", np.eye(2), low=0.0, high=0.9, labels=("x", "y"))
>>> print(QpSolver().solve(qp).x.round(6))
[0.5 0.5]

A controller that poses the same program in every cycle keeps one :class:`QpSolver` and makes a new
:class:`Qp` each time; as long as the numbers of rows stay, the solver keeps its memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from proxsuite import proxqp

ROW_TOLERANCE = (
    1e-6  # re-evaluated row error, in the row's own size, above which nothing is believed
)
GIVE_SHARE = 1e-3  # rows that give way by less than this share of the worst are not named
PRICE_SHARE = 0.05  # limits with a price below this are not named
MAX_NAMED = 5
NO_LIMIT = 1e20  # from which on HiGHS takes a side of a row for none
NUMBERS = tuple(map(str, range(1000)))  # labels of rows that have none


class Block(NamedTuple):
    """Rows (m, n) of one name between ``low`` (m,) and ``high`` (m,), each with a label.

    Costs have weights (m,), and their target is both ``low`` and ``high``; ``weight`` is None for
    equalities and limits.
    """

    name: str
    matrix: np.ndarray
    low: np.ndarray
    high: np.ndarray
    weight: np.ndarray | None
    labels: tuple[str, ...]

    @property
    def scale(self) -> np.ndarray:
        """Size (m,) of every row: its largest coefficient or its nearer side, and at least 1."""
        side = np.minimum(np.abs(self.low), np.abs(self.high))
        side = np.where(np.isfinite(side), side, 0.0)  # a row that is free
        return np.maximum(1.0, np.maximum(np.abs(self.matrix).max(axis=1, initial=0.0), side))

    def violation(self, x: np.ndarray) -> np.ndarray:
        """Distance of ``x`` (n,) from the bounds of each row (m,), in the row's own unit; 0 within
        them.
        """
        value = self.matrix @ x
        return np.maximum(np.maximum(self.low - value, value - self.high), 0.0)


class Qp:
    """One program of ``size`` unknowns, put together block by block.

    Attributes
    ----------
    costs, equalities, limits : name -> :class:`Block`.
    """

    def __init__(self, size: int):
        self.size = size
        self.costs: dict[str, Block] = {}
        self.equalities: dict[str, Block] = {}
        self.limits: dict[str, Block] = {}

    def cost(
        self, name: str, matrix: Any, target: Any, weight: Any = 1.0, labels: Iterable[str] = ()
    ) -> None:
        """Add ``weight`` / 2 times the squares of ``matrix`` (m, n) @ x - ``target``; target and
        weight (m,) or a number for all rows.
        """
        self.costs[name] = self._block(name, matrix, target, target, weight, labels)

    def equality(self, name: str, matrix: Any, value: Any, labels: Iterable[str] = ()) -> None:
        """Demand ``matrix`` (m, n) @ x = ``value``, (m,) or a number."""
        self.equalities[name] = self._block(name, matrix, value, value, None, labels)

    def limit(
        self,
        name: str,
        matrix: Any,
        low: Any = -np.inf,
        high: Any = np.inf,
        labels: Iterable[str] = (),
    ) -> None:
        """Demand ``low`` <= ``matrix`` (m, n) @ x <= ``high``, (m,) or numbers."""
        self.limits[name] = self._block(name, matrix, low, high, None, labels)

    def _block(self, name, matrix, low, high, weight, labels) -> Block:
        matrix = np.atleast_2d(np.asarray(matrix, float))
        size = len(matrix)
        labels = tuple(labels) or NUMBERS[:size]
        below = _column(low, size)
        above = below if high is low else _column(high, size)
        weight = None if weight is None else _column(weight, size)
        return Block(name, matrix, below, above, weight, labels)

    @cached_property
    def matrices(self) -> tuple[np.ndarray, ...]:
        """H, g, C, d, F, low and high of  1/2 x' H x + g' x,  C x = d  and  low <= F x <= high."""
        rows, target, _ = self._joined(self.costs)
        weight = [b.weight for b in self.costs.values()]
        weighted = rows * np.concatenate([np.zeros(0), *weight])[:, None]
        equal, value, _ = self._joined(self.equalities)
        return weighted.T @ rows, -weighted.T @ target, equal, value, *self._joined(self.limits)

    def _joined(self, blocks: dict[str, Block]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Matrix (m, n), low and high (m,) of several blocks, one below the other."""
        parts = [(b.matrix, b.low, b.high) for b in blocks.values()]
        nothing = np.zeros((0, self.size)), np.zeros(0), np.zeros(0)
        return tuple(map(np.concatenate, zip(nothing, *parts, strict=True)))

    def constraints(self) -> list[Block]:
        """Equalities, then limits."""
        return [*self.equalities.values(), *self.limits.values()]

    def worst(self, x: np.ndarray) -> tuple[float, str]:
        """The largest violation at ``x`` (n,), and of which row; in the row's own unit, or in its
        size where that is more than the tolerance: large rows have large round-off.
        """
        broken = [(b.violation(x), b) for b in self.constraints()]
        if max((v.max(initial=0.0) for v, _ in broken), default=0.0) > ROW_TOLERANCE:
            broken = [(v / b.scale, b) for v, b in broken]
        v, block = max(broken, key=lambda pair: pair[0].max(initial=0.0))
        row = int(np.argmax(v))
        return float(v[row]), f"{block.name} {block.labels[row]}"


def _column(x: Any, size: int) -> np.ndarray:
    """A column (size,) of a number or a column; np.full takes three times as long."""
    out = np.empty(size)
    out[:] = x
    return out


@dataclass(frozen=True)
class QpAnswer:
    """Result of a solve: ``x`` (n,), iterations, the solver's own word, and whether by that word
    ``x`` is the optimum.
    """

    x: np.ndarray
    iterations: int
    status: str
    solved: bool


class QpSolver:
    """ProxQP's dense solver, kept for programs of one shape.

    Parameters
    ----------
    tolerance : of residuals, absolute; where the cost is nearly flat, 1e-9 leaves more digits of
        the accelerations open than 1e-11, which takes hardly longer.
    iterations : at most.
    infeasible : how clearly a program must have no answer before the search for one ends.

    ``solves`` and ``failures`` count the programs posed, and those without an answer.
    """

    def __init__(self, tolerance: float = 1e-11, iterations: int = 1000, infeasible: float = 1e-12):
        self._settings = dict(eps_abs=tolerance, max_iter=iterations, eps_primal_inf=infeasible)
        self._shape: tuple[int, ...] = ()
        self._solver: Any = None
        self.solves = 0
        self.failures = 0

    def solve(self, qp: Qp) -> QpAnswer:
        """Solve one program; a failure is no error but ``solved`` = False."""
        matrices = qp.matrices
        shape = qp.size, len(matrices[2]), len(matrices[4])
        if shape == self._shape:
            self._solver.update(*matrices)
        else:
            self._shape = shape
            self._solver = proxqp.dense.QP(*shape)
            for name, value in self._settings.items():
                setattr(self._solver.settings, name, value)
            self._solver.init(*matrices)
        self._solver.solve()
        self.solves += 1
        results = self._solver.results
        solved = results.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
        self.failures += not solved
        return QpAnswer(
            np.array(results.x), int(results.info.iter), results.info.status.name, solved
        )


# rows that cannot hold together -------------------------------------------------------------------
@dataclass(frozen=True)
class Conflict:
    """Rows that cannot hold together."""

    # (block, row, amount) that give way in the least total, worst first
    gives: tuple[tuple[str, str, float], ...]
    # (block, row) of the limits that force them to, those of the highest price first
    limits: tuple[tuple[str, str], ...]


def conflict(qp: Qp) -> Conflict | None:
    """The least relaxation of a program without an answer, and what it is paid for; None if its
    rows can hold together.

    The elastic program: the sum of all rows' slacks, each in its row's own size, is minimised. A
    row's multiplier is then the price that the others pay for it: a limit that binds at a price is
    one side of the conflict, a row with slack the other.
    """
    from scipy.optimize import linprog  # slow to import, and rarely needed

    blocks = qp.constraints()
    columns = ("matrix", "low", "high", "scale")
    matrix, low, high, scale = (np.concatenate([getattr(b, k) for b in blocks]) for k in columns)
    names = [(b.name, label) for b in blocks for label in b.labels]
    slack = -np.diag(scale)
    answer = linprog(
        np.concatenate([np.zeros(qp.size), np.ones(len(scale))]),
        np.block([[-matrix, slack], [matrix, slack]]),
        np.nan_to_num(np.concatenate([-low, high]), posinf=NO_LIMIT),
        bounds=[(None, None)] * qp.size + [(0, None)] * len(scale),
    )
    if not answer.success:
        return None
    give = answer.x[qp.size :]
    giving = [k for k in np.argsort(-give) if give[k] > max(GIVE_SHARE * give.max(), 1e-7)]
    if not giving:
        return None
    price = scale * np.abs(answer.ineqlin.marginals).reshape(2, -1).max(axis=0)
    price[: sum(len(b.labels) for b in qp.equalities.values())] = 0.0
    dear = [k for k in np.argsort(-price) if price[k] > PRICE_SHARE and k not in giving]
    gives = tuple((*names[k], float(give[k] * scale[k])) for k in giving[:MAX_NAMED])
    return Conflict(gives, tuple(names[k] for k in dear[:MAX_NAMED]))
