"""The numbers that go into an assembled problem and come out of it: data, bounds, guesses,
solutions, multipliers.

Outside they are in physical units, inside divided by their scales.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jumplab.errors import InputError, quoted
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.layout import PhaseLayout
from jumplab.ocp.solution import Multipliers, PhaseGuess, PhaseSolution, resampled

WHERE = {"all": slice(None), "start": slice(1), "inner": slice(1, None), "end": slice(-1, None)}


@dataclass(frozen=True)
class Posed:
    """A problem's numbers for one target, scaled: start (n,), data (p_size,), (lower, upper) of
    variables and rows.
    """

    x0: np.ndarray
    p: np.ndarray
    box: tuple[np.ndarray, np.ndarray]
    rows: tuple[np.ndarray, np.ndarray]

    def beyond(self, g: np.ndarray) -> np.ndarray:
        """Distance of each row (n_rows,) from its bounds, 0 within them."""
        return np.maximum(np.maximum(self.rows[0] - g, g - self.rows[1]), 0.0)

    @property
    def arguments(self) -> dict[str, np.ndarray]:
        """Arguments with which CasADi's solvers are called."""
        bounds = dict(zip(("lbx", "ubx", "lbg", "ubg"), (*self.box, *self.rows), strict=True))
        return {"x0": self.x0, "p": self.p, **bounds}


def pose(
    a: Assembled,
    parameters: Mapping,
    guess: Mapping[str, PhaseGuess],
    references: Mapping | None = None,
    weights: Mapping[str, float] | None = None,
) -> Posed:
    """The numbers of one target (see :class:`Posed`); arguments as of :meth:`.Nlp.solve`.

    Raises :class:`InputError` for whatever does not fit.
    """
    weights = weights or {}
    for name in weights:
        a.problem.costs(name)
    p = _data(a, parameters, references or {}, weights)
    box = variable_bounds(a, parameters)
    return Posed(np.clip(pack(a, guess), *box), p, box, row_bounds(a, parameters))


def _data(a: Assembled, parameters, references, weights) -> np.ndarray:
    """The data vector (p_size,)."""
    problem = a.problem
    unknown = set(parameters) ^ set(problem.parameters)
    if unknown:
        raise InputError(
            f"{problem.name}: parameters {sorted(unknown)} are missing or unknown; it takes "
            f"{list(problem.parameters)}"
        )
    values = []
    for name, size in problem.parameters.items():
        value = parameters[name]
        shape = (size,) if np.ndim(value) else ()
        values.append(
            np.broadcast_to(_fitting(value, shape, f"{problem.name}: parameter {name!r}"), size)
        )
    for owner, t in a.cost_terms:
        weight = weights.get(f"{owner}/{t.name}", weights.get(t.name, t.weight))
        values.append(_fitting([weight], (1,), f"{problem.name}: weight {t.name!r}"))
    for name, layout in a.layouts.items():
        values.append(_node_data(layout, references.get(name, {}), problem.name))
    return np.concatenate(values)


def _fitting(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Finite numbers of a shape, or :class:`InputError`."""
    try:
        x = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{what} = {quoted(value)} is not a number") from None
    if x.shape != shape:
        raise InputError(f"{what} has shape {x.shape}, must be {shape}")
    if not np.all(np.isfinite(x)):
        raise InputError(f"{what} is not finite")
    return x


def _node_data(layout: PhaseLayout, given: Mapping, where: str) -> np.ndarray:
    """Share of the phase and references of every node, one node after the other."""
    known = layout.phase.references
    count = len(layout.nodes)
    odd = sorted(set(given) ^ set(known))
    if odd:
        raise InputError(
            f"{where}: references {odd} of phase {layout.phase.name!r} are missing or unknown; "
            f"it takes {list(known)}"
        )
    rows = [np.linspace(0, 1, count)[None]]
    for ref, size in known.items():
        what = f"{where}: reference {ref!r} of phase {layout.phase.name!r}"
        rows.append(_fitting(given[ref], (size, count), what))
    return np.concatenate(rows).ravel(order="F")


# bounds -------------------------------------------------------------------------------------------
def _resolve(value: Any, parameters: Any, size: int) -> np.ndarray:
    """A bound as numbers (size,): itself, or what it says of the parameters."""
    value = value(parameters) if callable(value) else value
    return np.broadcast_to(np.asarray(value, float).ravel(), (size,))


def row_bounds(a: Assembled, parameters: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of all rows (n_rows,), scaled."""
    low = np.full(a.n_rows, -np.inf)
    high = np.full(a.n_rows, np.inf)
    for rows in a.rows:
        term = rows.term
        count = rows.index.shape[1]
        try:
            low[rows.index] = _resolve(term.lower, parameters, count) / term.scale
            high[rows.index] = _resolve(term.upper, parameters, count) / term.scale
        except ValueError:
            raise InputError(
                f"term {term.name!r} of {a.problem.place(rows.owner)!r}: a bound does not fit its "
                f"expression, whose size is {count}"
            ) from None
    return low, high


def variable_bounds(a: Assembled, parameters: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of all variables (size,), scaled.

    Raises :class:`InputError` if bounds exclude each other.
    """
    low = np.full(a.size, -np.inf)
    high = np.full(a.size, np.inf)
    for layout in a.layouts.values():
        phase = layout.phase
        ends = [phase.duration, *phase.constants.values()]
        for i, (lower, upper, *_), size in zip(
            layout.constants, ends, phase.constant_scales, strict=True
        ):
            low[i] = _resolve(lower, parameters, 1)[0] / size
            high[i] = _resolve(upper, parameters, 1)[0] / size
        for bound in phase.bounds:
            index = layout.of(bound.on)[WHERE[bound.where]]
            scale = phase.scale(bound.on)
            least, most = (_resolve(x, parameters, len(scale)) for x in (bound.lower, bound.upper))
            low[index] = np.maximum(low[index], least / scale)
            high[index] = np.minimum(high[index], most / scale)
            gap = low[index] - high[index]
            if np.any(gap > 0):
                k, i = np.unravel_index(np.argmax(gap), gap.shape)
                node = range(len(layout.of(bound.on)))[WHERE[bound.where]][k]
                raise InputError(
                    f"bound {bound.name!r} of phase {phase.name!r} and another on {bound.on!r} "
                    f"exclude each other at node {node}, component {i}: {low[index[k, i]]:.4g} > "
                    f"{high[index[k, i]]:.4g} (scaled); check the bounds that depend on the target"
                )
    return low, high


# variables ----------------------------------------------------------------------------------------
def pack(a: Assembled, guess: Mapping[str, PhaseGuess]) -> np.ndarray:
    """Start values of all variables (size,), scaled.

    Raises :class:`InputError` for a guess that lacks a phase, has another shape, or is not finite.
    """
    x = np.zeros(a.size)
    for name, layout in a.layouts.items():
        phase = layout.phase
        if name not in guess:
            raise InputError(f"{a.problem.name}: the guess has no phase {name!r}")
        g = guess[name]
        if not (np.isfinite(g.duration) and g.duration > 0):
            raise InputError(
                f"{a.problem.name}: guess of phase {name!r} has the duration {g.duration} s"
            )
        for key in "qvaz":
            if (values := getattr(g, key)) is not None:
                what = f"{a.problem.name}: guess {key!r} of phase {name!r}"
                _fitting(values, layout.of(key).shape, what)
        t = np.linspace(0, g.duration, len(layout.nodes))
        v = np.gradient(g.q, t, axis=0) if g.v is None else g.v
        accel = np.gradient(v, t, axis=0) if g.a is None else g.a
        z = np.zeros((len(t), len(phase.states))) if g.z is None else g.z
        if phase.exact:
            x[layout.jerks] = np.diff(accel, axis=0) / t[1] / phase.scale("j")
        x[layout.nodes] = np.hstack([g.q, v, accel, z]) / phase.node_scales
        constants = [g.duration, *(g.constants.get(c, 0.0) for c in phase.constants)]
        x[layout.constants] = np.array(constants) / phase.constant_scales
    return x


def unpack(a: Assembled, x: np.ndarray) -> dict[str, PhaseSolution]:
    """The phases that a solution vector (size,) means."""
    out = {}
    for name, layout in a.layouts.items():
        phase = layout.phase
        q, v, accel, z = np.split(x[layout.nodes] * phase.node_scales, phase.ends, axis=1)
        duration, *values = (x[layout.constants] * phase.constant_scales).tolist()
        constants = dict(zip(phase.constants, values, strict=True))
        t = np.linspace(0, duration, len(q))
        jerk = np.diff(accel, axis=0) / t[1]
        if phase.exact:
            jerk = x[layout.jerks] * phase.scale("j")
        out[name] = PhaseSolution(t, q, v, accel, jerk, z, duration, constants)
    return out


# multipliers --------------------------------------------------------------------------------------
def _along(a: Assembled) -> Iterator[tuple]:
    """(name, 0 for variables or 1 for rows, indices (K, C), shares of the phase (K,), density) of
    what has multipliers.

    Times its density a multiplier is independent of the mesh: limits along a phase share their
    force among the nodes. Links of the motion have costates, which do not depend on the number of
    nodes; neither do rows at one instant.
    """
    for rows in a.rows:
        term = rows.term
        n = a.layouts[rows.owner].phase.intervals if rows.owner in a.layouts else 1
        share = (rows.nodes + (0.5 if term.at in ("mid", "interval") else 0.0)) / n
        limits = term.at in ("node", "mid") and not term.identity
        yield (rows.owner, term.name), 1, rows.index, share, n if limits else 1
    for name, layout in a.layouts.items():
        n = layout.phase.intervals
        yield (name, "bounds of nodes"), 0, layout.nodes, np.linspace(0, 1, n + 1), n
        yield (name, "bounds of constants"), 0, layout.constants[None], np.zeros(1), 1


def unpack_multipliers(a: Assembled, lam_x: np.ndarray, lam_g: np.ndarray) -> Multipliers:
    """Multipliers of bounds (size,) and rows (n_rows,) by name and share of the phase, so that
    another mesh can begin with them.
    """
    lam = lam_x, lam_g
    return Multipliers(
        {name: (share, lam[which][i] * density) for name, which, i, share, density in _along(a)}
    )


def pack_multipliers(a: Assembled, given: Multipliers) -> tuple[np.ndarray, np.ndarray]:
    """(lam_x (size,), lam_g (n_rows,)) for this mesh from multipliers of the same problem on any
    mesh.
    """
    lam = np.zeros(a.size), np.zeros(a.n_rows)
    for name, which, index, share, density in _along(a):
        # a problem with further terms, or wider ones, begins them with zero
        known = given.rows.get(name)
        if known is not None and known[1].shape[1:] == index.shape[1:]:
            lam[which][index] = resampled(*known, share) / density
    return lam


def binding(
    a: Assembled, posed: Posed, given: Multipliers
) -> Iterator[tuple[tuple[str, str], int, np.ndarray, np.ndarray, np.ndarray]]:
    """((owner, term name), column, shares of the phase (K,), multipliers (K,), limits (K,)) of all
    limits, as scaled; zero where both bounds are one, so that nothing could give way.
    """
    for name, which, index, share, density in _along(a):
        low, high = (bounds[index] for bounds in (posed.box, posed.rows)[which])
        lam = np.where(low < high, given.rows[name][1] / density, 0.0)
        for c in range(lam.shape[1]):
            yield name, c, share, lam[:, c], np.where(lam > 0, high, low)[:, c]


def lagrangian(a: Assembled, posed: Posed, x: np.ndarray, given: Multipliers) -> float:
    """Cost and limits, these times ``given`` multipliers, at the variables ``x`` (size,), scaled.

    At a solution it is the cost; with other numbers in ``posed`` it changes as the least cost does,
    to first order.
    """
    f, g = (y.full().ravel() for y in a.nlp(x, posed.p))
    total = float(f[0])
    lam_x, lam_g = pack_multipliers(a, given)
    for lam, y, (low, high) in ((lam_x, x, posed.box), (lam_g, g, posed.rows)):
        end = np.where(lam > 0, high, low)
        kept = (lam != 0) & np.isfinite(end)
        total += float(lam[kept] @ (y - end)[kept])
    return total
