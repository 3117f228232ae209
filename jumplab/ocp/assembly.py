"""A problem as one sparse NLP (:class:`Assembled`), and the numbers that go into it and come out of it.

All variables and rows are divided by their scales here; guesses, bounds and solutions outside are in physical units.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError
from jumplab.ocp.derivatives import Block, Element, ElementBuilder, gather, scatter
from jumplab.ocp.problem import PhaseLayout, Problem, Term, layouts
from jumplab.ocp.solution import Multipliers, PhaseGuess, PhaseSolution, resampled


@dataclass(frozen=True)
class Row:
    """Which term, phase, node and component a constraint row belongs to."""

    owner: str
    term: Term
    node: int
    component: int


class Assembled:
    """The NLP's sparse functions of variables x and data p, gathered from the elements.

    Attributes
    ----------
    layouts : phase name -> where its variables stand in x;  size : number of variables.
    p_size : size of p = [parameters; weights; per phase (share of the phase, references) of every node].
    rows, n_rows : what each constraint row is, and their number.
    nlp, grad_f, jac_g, hess_lag : cost and rows with derivatives, as ipopt wants them;  cost_parts : unweighted costs.
    """

    def __init__(self, problem: Problem, elements: Sequence[Element] | None = None):
        """``elements`` are those of the same problem on any mesh; built anew if None."""
        self.problem = problem
        self.layouts = layouts(problem)
        self.size = sum(layout.size for layout in self.layouts.values())
        self.n_par = sum(problem.parameters.values())
        self.elements = elements or ElementBuilder(problem, self.layouts).elements
        self.cost_terms = [(e.owner, term) for e in self.elements for term in e.costs]
        self.n_weight = len(self.cost_terms)
        self.data_first, self.p_size = {}, self.n_par + self.n_weight
        for name, layout in self.layouts.items():
            rows = 1 + sum(layout.phase.references.values())
            self.data_first[name] = (self.p_size, rows)
            self.p_size += rows * (layout.phase.intervals + 1)
        self.rows: list[Row] = []
        self._x, self._p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.p_size)
        self._blocks = list(self._make_blocks())
        self.n_rows = len(self.rows)
        self._assemble()

    def _make_blocks(self):
        x, p, weight_at = self._x, self._p, self.n_par
        for e in self.elements:
            nodes, index = e.on(self.layouts)
            first_row, keep = len(self.rows), self._add_rows(e, nodes)
            weights = p[weight_at : weight_at + len(e.costs)]
            weight_at += len(e.costs)
            local, n = ca.reshape(x[index.ravel().tolist()], index.shape[1], len(index)), len(index)
            inputs = (local, self._data(p, e, nodes), ca.repmat(p[: self.n_par], 1, n))
            yield Block(e, index, keep, first_row, inputs, ca.repmat(weights, 1, n))

    def _add_rows(self, e: Element, nodes: range) -> np.ndarray:
        """Record the constraint rows of an element; return which of its local rows are kept."""
        keep, local = [], [(term, i) for term, count in e.rows for i in range(count)]
        for r, node in enumerate(nodes):
            for c, (term, i) in enumerate(local):
                if term.skip[0] <= r < len(nodes) - term.skip[1]:
                    keep.append(r * len(local) + c)
                    self.rows.append(Row(e.owner, term, node, i))
        return np.array(keep, int)

    def _data(self, p: ca.MX, e: Element, nodes: range) -> ca.MX:
        if e.place == "problem":
            return ca.MX(0, 1)
        first, rows = self.data_first[e.owner]
        index = first + rows * np.array(nodes)[:, None] + np.arange(rows)
        share = ca.DM.ones(1, len(nodes)) / self.layouts[e.owner].phase.intervals
        return ca.vertcat(ca.reshape(p[index.ravel().tolist()], rows, len(nodes)), share)

    def _assemble(self) -> None:
        x, p, lam_f, lam_g = self._x, self._p, ca.MX.sym("lam_f"), ca.MX.sym("lam_g", self.n_rows)
        priced, bound = [b for b in self._blocks if b.e.costs], [b for b in self._blocks if b.e.rows]
        parts = [ca.sum2(b("costs")) for b in priced]
        f = sum(ca.dot(b.weights[:, 0], part) for b, part in zip(priced, parts, strict=True))
        g = ca.vertcat(*(ca.vec(b("rows"))[b.keep.tolist()] for b in bound))
        grad = sum(scatter(b.index.ravel(), self.size) @ ca.vec(b("gradient", b.weights)) for b in priced)
        jac = gather([b.jacobian() for b in bound], (self.n_rows, self.size))
        hess = gather([b.hessian(lam_f, lam_g) for b in self._blocks], (self.size, self.size))
        names, of_hessian = ["x", "p"], ["x", "p", "lam_f", "lam_g"]
        self.nlp = ca.Function("nlp", [x, p], [f, g], names, ["f", "g"])
        self.grad_f = ca.Function("nlp_grad_f", [x, p], [f, grad], names, ["f", "grad_f_x"])
        self.jac_g = ca.Function("nlp_jac_g", [x, p], [g, jac], names, ["g", "jac_g_x"])
        self.hess_lag = ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [hess], of_hessian, ["triu_hess_gamma_x_x"])
        self.cost_parts = ca.Function("cost_parts", [x, p], [ca.vertcat(*parts)])

    @cached_property
    def gauss_newton(self) -> ca.Function:
        """(x, p) -> upper triangle of the cost's Hessian without the curvature of what it squares."""
        hess = gather([b.upper("gauss_newton", b.weights) for b in self._blocks if b.e.costs], (self.size, self.size))
        return ca.Function("gauss_newton", [self._x, self._p], [hess], ["x", "p"], ["triu_hess_f"])

    def held_hessian(self, hold: float) -> ca.Function:
        """In place of ``hess_lag``: the Gauss-Newton Hessian and ``hold`` for every (scaled) variable.

        It is bent the wrong way nowhere, and costs a fraction of the exact one.
        """
        exact = self.hess_lag
        given = x, p, lam_f, _ = [ca.MX.sym(exact.name_in(i), exact.sparsity_in(i)) for i in range(exact.n_in())]
        found = lam_f * self.gauss_newton(x, p) + hold * ca.DM.eye(self.size)
        return ca.Function("nlp_hess_l", given, [found], exact.name_in(), exact.name_out())

    @cached_property
    def groups(self) -> list[tuple[str, Term, np.ndarray]]:
        """The rows by term: (owner, term, their indices (K, C)), at K places C components."""
        found: dict[tuple, list] = {}
        for i, row in enumerate(self.rows):
            found.setdefault((row.owner, row.term.name), []).append(i)
        firsts = ((self.rows[i[0]], 1 + max(self.rows[k].component for k in i), i) for i in found.values())
        return [(row.owner, row.term, np.array(i).reshape(-1, count)) for row, count, i in firsts]


@dataclass(frozen=True)
class Posed:
    """A problem's numbers for one target, scaled: start (n,), data (p_size,), (lower, upper) of variables and rows."""

    x0: np.ndarray
    p: np.ndarray
    box: tuple[np.ndarray, np.ndarray]
    rows: tuple[np.ndarray, np.ndarray]

    def beyond(self, g: np.ndarray) -> np.ndarray:
        """How far each row (n_rows,) lies outside its bounds."""
        return np.maximum(np.maximum(self.rows[0] - g, g - self.rows[1]), 0.0)


def pose(
    a: Assembled,
    parameters: Mapping,
    guess: Mapping[str, PhaseGuess],
    references: Mapping | None = None,
    weights: Mapping[str, float] | None = None,
    off: tuple[str, ...] = (),
) -> Posed:
    """The numbers of one target, arguments as of :meth:`jumplab.ocp.nlp.Nlp.solve`; refuses what does not fit."""
    weights = dict(weights or {})
    a.problem.check_names([*weights, *off], "weight or switch")
    costs = {name for owner, t in a.cost_terms for name in (t.name, f"{owner}/{t.name}")}
    for name in weights:
        if name not in costs:
            raise InputError(f"{a.problem.name}: {name!r} is a constraint and has no weight; switch it off instead")
    p, box = _data_vector(a, parameters, references or {}, weights, off), variable_bounds(a, parameters, off)
    return Posed(np.clip(pack(a, guess), *box), p, box, row_bounds(a, parameters, off))


def _data_vector(a: Assembled, parameters, references, weights, off) -> np.ndarray:
    problem = a.problem
    unknown = set(parameters) ^ set(problem.parameters)
    if unknown:
        takes = list(problem.parameters)
        raise InputError(f"{problem.name}: parameters {sorted(unknown)} do not fit; it takes {takes}")
    values = [_parameter(problem, n, parameters[n], size) for n, size in problem.parameters.items()]
    own = [weights.get(f"{owner}/{t.name}", weights.get(t.name, t.weight)) for owner, t in a.cost_terms]
    weight = [0.0 if _is_off(owner, t.name, off) else w for (owner, t), w in zip(a.cost_terms, own, strict=True)]
    columns = [_references(problem.name, x, references.get(name, {})) for name, x in a.layouts.items()]
    vector = np.concatenate([*values, weight, *columns])
    if not np.all(np.isfinite(vector)):
        raise InputError(f"{problem.name}: a parameter or weight is not finite")
    return vector


def _parameter(problem: Problem, name: str, value: Any, size: int) -> np.ndarray:
    try:
        x = np.asarray(value, float).ravel()
    except (TypeError, ValueError):
        raise InputError(f"{problem.name}: parameter {name!r} = {value!r} is not a number") from None
    if len(x) not in (1, size):
        raise InputError(f"{problem.name}: parameter {name!r} has {len(x)} values, it takes {size}")
    return np.broadcast_to(x, (size,))


def _references(where: str, layout: PhaseLayout, given: Mapping) -> np.ndarray:
    """Share of the phase and references of every node, one node after the other."""
    name, n, known = layout.phase.name, layout.phase.intervals, layout.phase.references
    odd = sorted(set(given) ^ set(known))
    if odd:
        raise InputError(f"{where}: references {odd} of phase {name!r} do not fit; it takes {list(known)}")
    rows = [np.linspace(0, 1, n + 1)[None]]
    for ref, size in known.items():
        x = np.asarray(given[ref], float)
        if x.shape != (size, n + 1) or not np.all(np.isfinite(x)):
            raise InputError(f"{where}: reference {ref!r} of phase {name!r} must be finite, {(size, n + 1)}")
        rows.append(x)
    return np.concatenate(rows).ravel(order="F")


def _resolve(value: Any, parameters: Any, size: int) -> np.ndarray:
    """A bound as numbers (size,): itself, or what it says of the parameters."""
    value = value(parameters) if callable(value) else value
    return np.broadcast_to(np.asarray(value, float).ravel(), (size,))


def _is_off(owner: str, name: str, off: Container[str]) -> bool:
    return name in off or f"{owner}/{name}" in off


def row_bounds(a: Assembled, parameters: Any, off: Container[str]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of all rows (n_rows,), scaled; none for terms that are ``off``."""
    low, high = np.full(a.n_rows, -np.inf), np.full(a.n_rows, np.inf)
    for owner, term, index in a.groups:
        if not _is_off(owner, term.name, off):
            for side, bound in ((low, term.lower), (high, term.upper)):
                try:
                    side[index] = _resolve(bound, parameters, index.shape[1]) / term.scale
                except ValueError:
                    rows, who = index.shape[1], f"term {term.name!r} of {a.problem.place(owner)!r}"
                    raise InputError(f"{who}: a bound does not fit its expression, whose size is {rows}") from None
    return low, high


def variable_bounds(a: Assembled, parameters: Any, off: Container[str]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of all variables (size,), scaled; refuses bounds that exclude each other."""
    low, high = np.full(a.size, -np.inf), np.full(a.size, np.inf)
    for layout in a.layouts.values():
        phase = layout.phase
        ends = [phase.duration, *(c[:2] for c in phase.constants.values())]
        for i, (lo, hi), s in zip(layout.constants, ends, layout.constant_scales, strict=True):
            low[i], high[i] = _resolve(lo, parameters, 1)[0] / s, _resolve(hi, parameters, 1)[0] / s
        for bound in phase.bounds:
            if not _is_off(phase.name, bound.name, off):
                _tighten(layout, bound, parameters, low, high)
    return low, high


def _tighten(layout: PhaseLayout, bound, parameters, low, high) -> None:
    """Apply one bound to the vectors ``low`` and ``high``."""
    nq, phase = layout.nq, layout.phase
    index, n = layout.jerks, phase.intervals
    if bound.on != "j":
        first = nq * "qvaz".index(bound.on)
        index = layout.nodes[:, first : layout.nx if bound.on == "z" else first + nq]
    where = {"all": slice(None), "start": slice(0, 1), "inner": slice(1, None), "end": slice(n, None)}[bound.where]
    index, scale = index[where], phase.scale(bound.on)
    low[index] = np.maximum(low[index], _resolve(bound.lower, parameters, len(scale)) / scale)
    high[index] = np.minimum(high[index], _resolve(bound.upper, parameters, len(scale)) / scale)
    gap = low[index] - high[index]
    if np.any(gap > 0):
        k, i = np.unravel_index(np.argmax(gap), gap.shape)
        node = k + where.indices(n + 1)[0]
        which = f"bound {bound.name!r} of phase {phase.name!r} and another on {bound.on!r}"
        text = f"at node {node}, component {i}: {low[index[k, i]]:.4g} > {high[index[k, i]]:.4g} (scaled)"
        raise InputError(f"{which} exclude each other {text}; look at those that depend on the target")


def _checked_guess(problem: Problem, guess: Mapping[str, PhaseGuess], layout: PhaseLayout) -> PhaseGuess:
    name, n, nq = layout.phase.name, layout.phase.intervals, layout.nq
    if name not in guess:
        raise InputError(f"{problem.name}: the guess has no phase {name!r}")
    g = guess[name]
    for key, x in (("q", g.q), ("v", g.v), ("a", g.a), ("z", g.z)):
        shape = (n + 1, layout.nx - 3 * nq if key == "z" else nq)
        what = f"{problem.name}: guess {key!r} of phase {name!r}"
        if x is not None and np.shape(x) != shape:
            raise InputError(f"{what} has shape {np.shape(x)}, must be {shape}")
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
        z = np.zeros((n + 1, len(phase.states))) if g.z is None else g.z
        if layout.jerks.size:
            x[layout.jerks] = np.diff(accel, axis=0) / (g.duration / n) / phase.scale("j")
        x[layout.nodes] = np.concatenate([g.q, v, accel, z], axis=1) / layout.node_scales
        constants = [g.duration, *(g.constants.get(c, 0.0) for c in phase.constants)]
        x[layout.constants] = np.array(constants) / layout.constant_scales
    return x


def unpack(a: Assembled, x: np.ndarray) -> dict[str, PhaseSolution]:
    """The phases that a solution vector (size,) means."""
    out = {}
    for name, layout in a.layouts.items():
        nq, phase = layout.nq, layout.phase
        q, v, accel, z = np.split(x[layout.nodes] * layout.node_scales, [nq, 2 * nq, 3 * nq], axis=1)
        duration, *values = (x[layout.constants] * layout.constant_scales).tolist()
        constants = dict(zip(phase.constants, values, strict=True))
        t = np.linspace(0, duration, phase.intervals + 1)
        jerk = x[layout.jerks] * phase.scale("j") if layout.jerks.size else np.diff(accel, axis=0) / t[1]
        out[name] = PhaseSolution(t, q, v, accel, jerk, z, duration, constants, phase.integrated is None)
    return out


def _along(a: Assembled) -> Iterator[tuple]:
    """(name, 0 for variables or 1 for rows, indices (K, C), shares of the phase (K,), density) of what has multipliers.

    Times its density a multiplier is independent of the mesh: limits along a phase share their force among the nodes.
    Links of the motion have costates, which do not depend on the number of nodes; neither do rows at one instant.
    """
    for owner, term, index in a.groups:
        n = a.layouts[owner].phase.intervals if owner in a.layouts else 1
        share = np.array([a.rows[i].node for i in index[:, 0]]) + (0.5 if term.at in ("mid", "interval") else 0.0)
        limits = term.at in ("node", "mid") and not term.identity
        yield (owner, term.name), 1, index, share / n, float(n) if limits else 1.0
    for name, layout in a.layouts.items():
        n = layout.phase.intervals
        yield (name, "bounds of nodes"), 0, layout.nodes, np.linspace(0, 1, n + 1), n
        yield (name, "bounds of constants"), 0, layout.constants[None], np.zeros(1), 1.0


def unpack_multipliers(a: Assembled, lam_x: np.ndarray, lam_g: np.ndarray) -> Multipliers:
    """Multipliers of bounds and rows by name and share of the phase, so that another mesh can begin with them."""
    lam = lam_x, lam_g
    return Multipliers({name: (share, lam[which][i] * density) for name, which, i, share, density in _along(a)})


def pack_multipliers(a: Assembled, given: Multipliers) -> tuple[np.ndarray, np.ndarray]:
    """(lam_x, lam_g) for this mesh from multipliers of the same problem on any mesh."""
    lam = np.zeros(a.size), np.zeros(a.n_rows)
    for name, which, index, share, density in _along(a):
        known = given.rows.get(name)  # a problem with further terms, or wider ones, begins them with zero
        if known is not None and known[1].shape[1:] == index.shape[1:]:
            lam[which][index] = resampled(*known, share) / density
    return lam
