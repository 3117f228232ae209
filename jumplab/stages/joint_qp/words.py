"""Reasons for a step of stage 2 without an answer, in the words of the field."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from jumplab.errors import SolverError
from jumplab.ocp import Phase
from jumplab.ocp.qp import ROW_TOLERANCE, Conflict, Qp, QpAnswer, conflict
from jumplab.stages.joint_qp.terms import AXES

WORDS = {  # term, perhaps of a phase -> what it says
    "base dynamics": "forces and moments in balance",
    "tiptoe": "toes that stay where they stand",
    "foot pitch or toe moment": "soles that stay flat, or no moment about the toes",
    "symmetry": "left and right alike",
    "inertia": "the inertia that stage 1 asks for",
    "heel": "heels above the ground",
    "torque": "torque limits",
    "speed and range": "speed limits and ranges of the joints",
    "launch/ground": "ground that only pushes, under the sole and within friction",
    "flight/ground": "toes and heels above the ground",
}


def checked(phase: Phase, qp: Qp, answer: QpAnswer, t: float) -> float:
    """The largest row error of an answer, relative to the rows' sizes.

    Raises :class:`SolverError` for an answer that cannot be trusted, with phase, time ``t`` [s],
    what would give way and by how much, and which limits stand against it.
    """
    finite = np.all(np.isfinite(answer.x))
    missed, row = qp.worst(answer.x) if finite else (np.inf, "")
    if answer.solved and missed <= ROW_TOLERANCE:
        return missed
    failed = {"stage": "joint_map", "status": answer.status}
    where = f"stage 2: at t = {t:.3f} s of the {phase.name}"
    if clash := conflict(qp):
        gives = giving(phase, clash)
        text = (
            f"{where} no joint motion follows stage 1; the nearest one misses {' and '.join(gives)}"
        )
        if held := holding(phase, clash):
            text += f", held back by {' and '.join(held)}"
        raise SolverError(text, violations=gives, **failed)
    miss = f"misses '{row}' by {missed:.2g} of its size" if finite else "is not a finite one"
    text = f"the search for a joint motion did not settle ({answer.status}): one exists, but"
    raise SolverError(f"{where} {text} the answer {miss}", **failed)


def giving(phase: Phase, clash: Conflict) -> tuple[str, ...]:
    """Terms that give way, one short line per term and unit: "'meaning of the term' by amount unit
    (row, row)".
    """
    units = {term.name: term.unit.split(", ") for term in phase.terms}
    groups = defaultdict(list)
    for name, row, amount in clash.gives:
        kinds = units.get(name, [""])
        axis = row.split()[-1]
        unit = kinds[-1 if axis in AXES[3:] else 0] if axis in AXES else " or ".join(kinds)
        groups[name, unit].append((amount, row))
    return tuple(
        f"'{_words(phase, name)}' by {f'{max(rows)[0]:.3g} {unit}'.strip()} "
        f"({', '.join(sorted(row for _, row in rows))})"
        for (name, unit), rows in groups.items()
    )


def holding(phase: Phase, clash: Conflict) -> list[str]:
    """Which limits stand against it, one entry per term."""
    names = defaultdict(list)
    for name, row in clash.limits:
        names[name].append(row)
    return [f"{_words(phase, name)} ({', '.join(sorted(rows))})" for name, rows in names.items()]


def _words(phase: Phase, name: str) -> str:
    return WORDS.get(f"{phase.name}/{name}", WORDS.get(name, name))
