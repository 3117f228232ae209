"""Why a step of stage 2 has no answer: which rows stand against each other, by how much, in the words of the field."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from jumplab.stages.joint_qp.problem import StepQp

CONFLICT_SHARE = 1e-3  # rows that give way by less than this share of the worst are not named
PRICE_SHARE = 0.05  # limits with a price below this are not named
MAX_NAMED = 5
# block of rows -> what it says, unit of its linear rows, unit of its angular ones
WORDS = {
    "base dynamics": ("forces and moments in balance", "N", "N m"),
    "tiptoe": ("toes that stay where they stand", "m/s^2", "rad/s^2"),
    "foot pitch or toe moment": ("soles that stay flat, or no moment about the toes", "rad/s^2 or N m", ""),
    "symmetry": ("left and right alike", "rad/s^2", ""),
    "inertia": ("the inertia that stage 1 asks for", "kg m^2/s^2", ""),
    "heel": ("heels above the ground", "m/s^2", ""),
    "torque": ("torque limits", "N m", ""),
    "speed and range": ("speed limits and ranges of the joints", "rad/s^2", ""),
}
GROUND = {
    "launch": ("ground that only pushes, under the sole and within friction", "N or N m", ""),
    "flight": ("toes and heels above the ground", "m/s^2", ""),
}
ANGULAR = ("rx", "ry", "rz")


@dataclass(frozen=True)
class Conflict:
    """Rows that cannot hold together."""

    gives: tuple[tuple[str, str, float], ...]  # (block, row, amount) that give way in the least total, worst first
    limits: tuple[tuple[str, str], ...]  # (block, row) of the inequalities that force them to, dearest first


def row_scale(qp: StepQp) -> dict[str, np.ndarray]:
    """Size of every row of E, G and R: largest coefficient times 1, or the right side if larger; at least 1."""
    sides = {"E": np.abs(qp.e), "G": np.abs(qp.h), "R": np.minimum(np.abs(qp.lower), np.abs(qp.upper))}
    return {k: np.maximum(1.0, np.maximum(np.abs(getattr(qp, k)).max(axis=1, initial=0.0), sides[k])) for k in "EGR"}


def _named(qp: StepQp) -> dict[str, list[tuple[str, str]]]:
    """(block, row) of every row of E, G and R."""
    out = {k: [("", "")] * len(qp.layout.labels[k]) for k in "EGR"}
    for block, (matrix, rows) in qp.layout.blocks.items():
        if matrix in out:
            out[matrix][rows] = [(block, x.removeprefix(block).strip()) for x in qp.layout.labels[matrix][rows]]
    return out


def conflict(qp: StepQp) -> Conflict | None:
    """The least relaxation of an infeasible QP, and what it is paid for; None if the rows are compatible.

    Minimise the sum of the slacks, each in its row's own size. A row's multiplier is then the price that the others
    pay for it: an inequality that binds at a price is one side of the conflict, a row with slack the other.
    """
    import cvxpy as cp  # slow to import, and rarely needed

    x, scale = cp.Variable(qp.A.shape[1]), row_scale(qp)
    give = {k: cp.Variable(len(scale[k]), nonneg=True) for k in "EGR" if len(scale[k])}
    g = {k: cp.multiply(scale[k], give[k]) if k in give else np.zeros(0) for k in "EGR"}
    sides = {"G": [qp.G @ x <= qp.h + g["G"]], "R": [qp.R @ x <= qp.upper + g["R"], qp.R @ x >= qp.lower - g["R"]]}
    rows = [cp.abs(qp.E @ x - qp.e) <= g["E"], *sides["G"], *sides["R"]]
    problem = cp.Problem(cp.Minimize(sum(cp.sum(v) for v in give.values())), rows)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # only names are wanted
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:
        return None
    if problem.status not in ("optimal", "optimal_inaccurate"):
        return None
    names = _named(qp)
    slack = [row for k, v in give.items() for row in zip(v.value, v.value * scale[k], names[k], strict=True)]
    worst = max((v for v, _, _ in slack), default=0.0)
    found = sorted((row for row in slack if row[0] > max(CONFLICT_SHARE * worst, 1e-7)), reverse=True)
    if not found:
        return None
    price = [
        (p * s, name)
        for k in "GR"
        for c in sides[k]
        for p, s, name, row in zip(np.abs(c.dual_value), scale[k], names[k], getattr(qp, k), strict=True)
        if row.any()  # a row of zeros is switched off
    ]
    giving = {name for _, _, name in found}
    dear = [name for p, name in sorted(price, reverse=True) if p > PRICE_SHARE and name not in giving]
    gives = tuple((*name, float(amount)) for _, amount, name in found[:MAX_NAMED])
    return Conflict(gives, tuple(dict.fromkeys(dear))[:MAX_NAMED])


def _words(block: str, phase: str) -> tuple[str, str, str]:
    return GROUND[phase] if block == "ground" and phase in GROUND else WORDS.get(block, (block, "", ""))


def _unit(block: str, row: str, phase: str) -> str:
    _, linear, angular = _words(block, phase)
    return angular if angular and row.split()[-1] in ANGULAR else linear


def lines(found: Conflict, phase: str) -> tuple[str, ...]:
    """What gives way, one short line per block and unit: "'what it says' by amount unit (row, row)"."""
    groups: dict[tuple[str, str], list[tuple[float, str]]] = {}
    for block, row, amount in found.gives:
        groups.setdefault((block, _unit(block, row, phase)), []).append((amount, row))
    said = []
    for (block, unit), rows in groups.items():
        amount, names = f"{max(rows)[0]:.3g} {unit}".strip(), ", ".join(sorted(row for _, row in rows))
        said.append(f"'{_words(block, phase)[0]}' by {amount} ({names})")
    return tuple(said)


def sentence(found: Conflict, phase: str, t: float) -> str:
    """Phase, time, what would give way and by how much, which limits stand against it, and what to do."""
    text = f"stage 2: at t = {t:.3f} s of the {phase} no joint motion follows stage 1; the nearest one misses "
    text += " and ".join(lines(found, phase))
    blocks: dict[str, list[str]] = {}
    for block, row in found.limits:
        blocks.setdefault(block, []).append(row)
    if blocks:
        held = (f"{_words(block, phase)[0]} ({', '.join(sorted(rows))})" for block, rows in blocks.items())
        text += f", held back by {' and '.join(held)}"
    return text
