"""Between the words of a problem and the numbers of its NLP: start values, bounds and multipliers, whole arrays at a
time."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError
from jumplab.ocp.derivatives import Element, ElementBuilder, Piece, gather, scatter
from jumplab.ocp.problem import Bound, PhaseLayout, Problem, Term
from jumplab.ocp.solution import Multipliers, PhaseGuess, PhaseSolution


# transcription ------------------------------------------------------------------------------------------
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


# packing ------------------------------------------------------------------------------------------
def resolve(value: Any, parameters: Any, size: int) -> np.ndarray:
    """A bound as numbers (size,): itself, or what it says of the parameters."""
    value = value(parameters) if callable(value) else value
    return np.broadcast_to(np.asarray(value, float).ravel(), (size,))


def is_off(owner: str, name: str, off: Container[str]) -> bool:
    """Whether a term or bound is left out."""
    return name in off or f"{owner}/{name}" in off


@dataclass(frozen=True)
class RowGroup:
    """All rows of one term: ``index`` (K, C) in the row vector, ``nodes`` (K,), ``share`` (K,) of the phase."""

    owner: str
    term: Term
    index: np.ndarray
    nodes: np.ndarray
    share: np.ndarray
    intervals: int  # 0 for terms that join phases


def group_rows(a: Assembled) -> tuple[RowGroup, ...]:
    """The rows of an assembled problem by term."""
    found: dict[tuple, list] = {}
    for i, row in enumerate(a.rows):
        found.setdefault((row.owner, row.term.name), []).append(i)
    out = []
    for (owner, _), places in found.items():
        first = a.rows[places[0]]
        count = 1 + max(a.rows[i].component for i in places)
        index = np.array(places).reshape(-1, count)
        nodes = np.array([a.rows[i].node for i in places[::count]])
        n = a.layouts[owner].phase.intervals if owner in a.layouts else 0
        half = 0.5 if first.term.at in ("mid", "interval") else 0.0
        out.append(RowGroup(owner, first.term, index, nodes, (nodes + half) / max(n, 1), n))
    return tuple(out)


def row_bounds(
    groups: Sequence[RowGroup], n_rows: int, parameters: Any, off: Container[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of all rows (n_rows,), scaled."""
    low, high = np.full(n_rows, -np.inf), np.full(n_rows, np.inf)
    for g in groups:
        if not is_off(g.owner, g.term.name, off):
            count = g.index.shape[1]
            low[g.index] = resolve(g.term.lower, parameters, count) / g.term.scale
            high[g.index] = resolve(g.term.upper, parameters, count) / g.term.scale
    return low, high


def variable_bounds(a: Assembled, parameters: Any, off: Container[str]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of all variables (size,), scaled; refuses bounds that exclude each other."""
    low, high = np.full(a.size, -np.inf), np.full(a.size, np.inf)
    for layout in a.layouts.values():
        phase = layout.phase
        ends = [phase.duration, *(c[:2] for c in phase.constants.values())]
        for i, (lo, hi), s in zip(layout.constants(), ends, layout.constant_scales(), strict=True):
            low[i], high[i] = resolve(lo, parameters, 1)[0] / s, resolve(hi, parameters, 1)[0] / s
        for bound in phase.bounds:
            if not is_off(phase.name, bound.name, off):
                _apply(a.problem, layout, bound, parameters, low, high)
    return low, high


def _apply(problem: Problem, layout: PhaseLayout, bound: Bound, parameters, low, high) -> None:
    nq = layout.nq
    first = {"q": 0, "v": nq, "a": 2 * nq, "z": 3 * nq, "j": 0}[bound.on]
    size = layout.nz if bound.on == "z" else nq
    index = layout.jerks() if bound.on == "j" else layout.nodes()[:, first : first + size]
    where = {"all": slice(None), "start": slice(0, 1), "inner": slice(1, None),
             "end": slice(layout.phase.intervals, None)}[bound.where]  # fmt: skip
    index = index[where]
    scale = layout.phase.scale(bound.on, size)
    low[index] = np.maximum(low[index], resolve(bound.lower, parameters, size) / scale)
    high[index] = np.minimum(high[index], resolve(bound.upper, parameters, size) / scale)
    gap = low[index] - high[index]
    if np.any(gap > 0):
        k, i = np.unravel_index(np.argmax(gap), gap.shape)
        node = k + where.indices(layout.phase.intervals + 1)[0]
        which = f"bound {bound.name!r} of phase {layout.phase.name!r} and another on {bound.on!r}"
        text = f"at node {node}, component {i}: {low[index[k, i]]:.4g} > {high[index[k, i]]:.4g} (scaled)"
        raise InputError(f"{which} exclude each other {text}; look at those that depend on the target")


# values ---------------------------------------------------------------------------------------------------------
def _checked_guess(problem: Problem, guess, layout) -> PhaseGuess:
    name, n = layout.phase.name, layout.phase.intervals
    if name not in guess:
        raise InputError(f"{problem.name}: the guess has no phase {name!r}")
    g = guess[name]
    for key, size in (("q", layout.nq), ("v", layout.nq), ("a", layout.nq), ("z", layout.nz)):
        x = getattr(g, key)
        what = f"{problem.name}: guess {key!r} of phase {name!r}"
        if x is not None and np.shape(x) != (n + 1, size):
            raise InputError(f"{what} has shape {np.shape(x)}, must be {(n + 1, size)}")
        if x is not None and not np.all(np.isfinite(x)):
            raise InputError(f"{what} is not finite")
    if not (np.isfinite(g.duration) and g.duration > 0):
        raise InputError(f"{problem.name}: guess of phase {name!r} has the duration {g.duration} s")
    return g


def pack(a: Assembled, guess: Mapping[str, PhaseGuess]) -> np.ndarray:
    """Start values of all variables (size,), scaled."""
    x = np.zeros(a.size)
    for layout in a.layouts.values():
        phase, n = layout.phase, layout.phase.intervals
        g = _checked_guess(a.problem, guess, layout)
        t = np.linspace(0, g.duration, n + 1)
        v = np.gradient(g.q, t, axis=0) if g.v is None else g.v
        accel = np.gradient(v, t, axis=0) if g.a is None else g.a
        z = np.zeros((n + 1, layout.nz)) if g.z is None else g.z
        x[layout.jerks()] = np.diff(accel, axis=0) / (g.duration / n) / phase.scale("j", layout.nq)
        x[layout.nodes()] = np.concatenate([g.q, v, accel, z], axis=1) / layout.node_scales()
        constants = [g.duration, *(g.constants.get(c, 0.0) for c in phase.constants)]
        x[layout.constants()] = np.array(constants) / layout.constant_scales()
    return x


def unpack(a: Assembled, x: np.ndarray) -> dict[str, PhaseSolution]:
    """The phases that a solution vector (size,) means."""
    out = {}
    for name, layout in a.layouts.items():
        n, nq, phase = layout.phase.intervals, layout.nq, layout.phase
        nodes = x[layout.nodes()] * layout.node_scales()
        jerk = x[layout.jerks()] * phase.scale("j", nq)
        constants = x[layout.constants()] * layout.constant_scales()
        q, v, accel, z = np.split(nodes, [nq, 2 * nq, 3 * nq], axis=1)
        duration = float(constants[0])
        named = {c: float(value) for c, value in zip(phase.constants, constants[1:], strict=True)}
        out[name] = PhaseSolution(np.linspace(0, duration, n + 1), q, v, accel, jerk, z, duration, named)
    return out


# multipliers ----------------------------------------------------------------------------------------------------
def unpack_multipliers(a: Assembled, groups: Sequence[RowGroup], lam_x: np.ndarray, lam_g: np.ndarray) -> Multipliers:
    """Multipliers of rows and bounds by name and share of the phase, so that another mesh can begin with them."""
    rows = {(g.owner, g.term.name): (g.share, lam_g[g.index] * _density(g)) for g in groups}
    nodes = {n: lam_x[x.nodes()] * x.phase.intervals for n, x in a.layouts.items()}
    return Multipliers(rows, nodes, {n: lam_x[x.constants()] for n, x in a.layouts.items()})


def pack_multipliers(a: Assembled, groups: Sequence[RowGroup], given: Multipliers) -> tuple[np.ndarray, np.ndarray]:
    """(lam_x, lam_g) for this mesh from multipliers of the same problem on any mesh."""
    lam_x, lam_g = np.zeros(a.size), np.zeros(a.n_rows)
    for g in groups:
        share, values = given.rows[g.owner, g.term.name]
        lam_g[g.index] = _resampled(share, values, g.share) / _density(g)
    for name, layout in a.layouts.items():
        n, nodes = layout.phase.intervals, given.nodes[name]
        at = np.linspace(0, 1, n + 1)
        lam_x[layout.nodes()] = _resampled(np.linspace(0, 1, len(nodes)), nodes, at) / n
        lam_x[layout.constants()] = given.constants[name]
    return lam_x, lam_g


def _density(g: RowGroup) -> float:
    """What makes a multiplier independent of the mesh: limits along a phase share their force among the nodes.

    Links of the motion have costates, which do not depend on the number of nodes; neither do rows at one instant.
    """
    return float(g.intervals) if g.term.at in ("node", "mid") and not g.term.identity else 1.0


def _resampled(old, values, new) -> np.ndarray:
    """Columns of ``values`` (K, C) given at ``old`` (K,), by straight lines at ``new``."""
    if len(old) == len(new):
        return values
    right = np.clip(np.searchsorted(old, new), 1, len(old) - 1)
    part = np.clip((new - old[right - 1]) / (old[right] - old[right - 1]), 0.0, 1.0)[:, None]
    return values[right - 1] * (1 - part) + values[right] * part
