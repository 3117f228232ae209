"""What can be changed about stage 2's QPs by name: own terms, factors on weights, blocks of rows that are left out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Real
from typing import Any

import numpy as np

from jumplab.errors import InputError, quoted, require_type
from jumplab.models.full import FullBody
from jumplab.ocp import Term
from jumplab.stages.joint_qp.own import OwnRows, StepPoint
from jumplab.stages.joint_qp.settings import Options

PHASES = ("launch", "flight")
BASE = "base dynamics"  # ties accelerations to wrenches: without it nothing else means anything


@dataclass(frozen=True)
class Block:
    """Rows of a phase's QP under one name: equation, unit, and of a cost the fields of its weights in the settings."""

    equation: str
    unit: str
    weights: tuple[str, ...] = ()


_COMMON = {
    "joints": Block("ours: towards the posture", "rad/s^2", ("posture",)),
    "trunk turn": Block("ours: towards the posture", "rad/s^2", ("trunk",)),
    "acceleration": Block("ours: regulariser", "m/s^2, rad/s^2", ("acceleration",)),
    BASE: Block("Sec. IV: base rows, M theta'' + H = J^T F", "N, N m"),
    "symmetry": Block("Sec. IV: S theta'' = 0", "rad/s^2"),
    "torque": Block("ours: torque, less above the corner speed", "N m"),
    "speed and range": Block("ours: speed and stops after the step", "rad/s^2"),
}
BLOCKS = {  # phase -> name -> block; "inertia" as in the paper only in flight
    "launch": {
        "com": Block("Sec. IV-A: A_c theta'' + B_c - c''_ref", "m/s^2", ("com_x", "com")),
        "force": Block("Sec. IV-A: A_f F - B_f, linear rows", "N", ("force_x", "force")),
        "moment": Block("Sec. IV-A: A_f F - B_f, angular rows", "N m", ("moment",)),
        "inertia": Block("ours: J_rho theta'' + drift - rho''_ref", "kg m^2/s^2", ("inertia", "inertia_toe")),
        "wrench": Block("ours: regulariser", "N, N m", ("wrench",)),
        "tiptoe": Block("Sec. IV-A: J theta'' + drift = p''_foot", "m/s^2, rad/s^2"),
        "foot pitch or toe moment": Block("ours: flat foot, or no moment about the toe", "rad/s^2, N m"),
        "ground": Block("ours: F_z >= 0, friction, CoP in the sole", "N, N m"),
        "heel": Block("Sec. IV-A: heel above the ground", "m/s^2"),
        **_COMMON,
    },
    "flight": {
        "foot": Block("Sec. IV-B: J_rd theta'' + drift - p''_rd", "m/s^2", ("foot",)),
        "foot level": Block("ours: sole parallel to the ground", "rad/s^2", ("foot_level",)),
        "inertia": Block("Sec. IV-B: J_rho theta'' + drift - rho''_ref", "kg m^2/s^2", ("inertia",)),
        "ground": Block("ours: toe and heel above the ground", "m/s^2"),
        **_COMMON,
    },
}


def changed(
    options: Options,
    body: FullBody,
    q0: np.ndarray,
    terms: Mapping[str, Iterable[Term]] | None = None,
    weights: Mapping[str, float] | None = None,
    off: Sequence[str] = (),
) -> Options:
    """The options with own terms, factors on weights, and blocks left out; themselves if nothing is asked for.

    Parameters
    ----------
    body, q0 : the robot, and a configuration (nq,) at which the terms are looked at, at rest.
    terms : "launch" or "flight" -> own terms at "node", a cost or a constraint on a :class:`StepPoint`.
    weights : "block" or "phase/block" of a cost, own ones too -> factor on its weight; 0 leaves it out.
    off : "block" or "phase/block" to leave out.

    Raises
    ------
    InputError
        In one sentence with the term's or block's name, before anything is solved.
    """
    require_type({} if terms is None else terms, Mapping, "own terms of stage 2")
    require_type({} if weights is None else weights, Mapping, "weights of stage 2")
    own, gone = list(options.terms), set(options.off)
    for phase, extra in (terms or {}).items():
        if phase not in PHASES:
            raise InputError(f"own terms of 'joint qp': no phase {quoted(phase)}; it has {', '.join(PHASES)}")
        for term in (extra,) if isinstance(extra, Term) else extra:
            _check(phase, term, own)
            own.append((phase, term))
    for name, factor in (weights or {}).items():
        if isinstance(factor, bool) or not isinstance(factor, Real) or not 0 <= factor < np.inf:
            raise InputError(
                f"weight {name!r} of 'joint qp' = {quoted(factor)}: its factor must be a number of 0 or more"
            )
        for phase, block in _found(name, own, costs=True):
            if factor == 0:
                gone.add(f"{phase}/{block}")
            else:
                own, options = _scaled(own, options, phase, block, float(factor))
    if isinstance(off, str):
        raise InputError(f"off must be a list of names, got {off!r}")
    for name in off:
        gone |= {f"{phase}/{block}" for phase, block in _found(name, own)}
    if any(name.endswith(BASE) for name in gone):
        raise InputError(f"term {BASE!r} of 'joint qp' links forces and motion; it cannot be switched off")
    gone |= {f"{phase}/{term.name}" for phase, term in own if term.weight == 0}
    new = replace(options, terms=tuple(own), off=tuple(sorted(gone)))
    rest = body.terms(q0, np.zeros(body.nv)) if own else None
    for phase, first in zip(PHASES, (12, 0), strict=True):
        OwnRows(phase, new.own(phase), partial(StepPoint, body, first), rest)
    return new


def _check(phase: str, term: Any, own: list[tuple[str, Term]]) -> None:
    """Refuse a term that stage 2 has no place for."""
    require_type(term, Term, f"an own term of 'joint qp/{phase}'")
    who = f"term {term.name!r} of 'joint qp/{phase}'"
    if term.name in {*BLOCKS[phase], *(t.name for p, t in own if p == phase)}:
        raise InputError(f"{who}: the name is taken; give it one of its own")
    if "/" in term.name:
        raise InputError(f"{who}: a name must not hold a '/'")
    if term.at != "node" or term.skip != (0, 0):
        raise InputError(
            f"{who}: at = {term.at!r}, skip = {term.skip}; every step has its own QP, with at = 'node' and no skip"
        )
    weight = term.weight
    if term.is_cost and (isinstance(weight, bool) or not isinstance(weight, Real) or not 0 <= weight < np.inf):
        raise InputError(f"{who}: weight = {quoted(weight)} must be a number of 0 or more")


def _found(name: Any, own: list[tuple[str, Term]], costs: bool = False) -> list[tuple[str, str]]:
    """(phase, block) of a name, "block" or "phase/block"; only costs if asked for."""
    known = [(p, b, bool(block.weights)) for p in PHASES for b, block in BLOCKS[p].items()]
    known += [(p, t.name, t.is_cost) for p, t in own]
    found = [(p, b, cost) for p, b, cost in known if name in (b, f"{p}/{b}")]
    if not found:
        names = dict.fromkeys(b for _, b, _ in known)
        raise InputError(f"weight or switch {quoted(name)}: 'joint qp' has no such term; it has {', '.join(names)}")
    if costs and not any(cost for *_, cost in found):
        raise InputError(f"'joint qp': {name!r} is a constraint and has no weight; switch it off instead")
    return [(p, b) for p, b, cost in found if cost or not costs]


def _scaled(
    own: list[tuple[str, Term]], options: Options, phase: str, block: str, factor: float
) -> tuple[list[tuple[str, Term]], Options]:
    """Own terms and options with the weight of one block times a factor."""
    if block not in BLOCKS[phase]:
        return [
            (p, replace(t, weight=factor * t.weight) if (p, t.name) == (phase, block) else t) for p, t in own
        ], options
    weights = getattr(options, phase)
    more = {field: factor * getattr(weights, field) for field in BLOCKS[phase][block].weights}
    return own, replace(options, **{phase: replace(weights, **more)})


def terms_table(options: Options | None = None) -> list[dict[str, str]]:
    """One row per block of both QPs: stage, phase, name, kind, at, unit, equation, value (weights or bounds).

    Blocks that are switched off are left out; ``jl.plots.table`` shows it.
    """
    options = options or Options()
    lim, rows = options.limits, []
    bounds = {
        "torque": f"{lim.torque_share} of the motor's line",
        "speed and range": f"{lim.speed_share} of the speed, {lim.range_margin_rad} rad before the stops",
        "heel": f"from {lim.near_ground_m} m on",
    }
    ground = f"friction {lim.friction}, CoP {lim.cop_margin_m} m inside, unilateral {lim.unilateral}"
    for phase in PHASES:
        bounds["ground"] = ground if phase == "launch" else f"below {lim.near_ground_m} m, rising half of the flight"
        for name, block in BLOCKS[phase].items():
            weights = ", ".join(f"{field} {getattr(getattr(options, phase), field):g}" for field in block.weights)
            value = f"weight {weights}" if weights else bounds.get(name, "0 ... 0")
            kind = "cost" if weights else "constraint"
            rows.append(_row(phase, name, kind, block.unit, block.equation, value))
        for term in options.own(phase):
            value = f"weight {term.weight:g}" if term.is_cost else f"{term.lower} ... {term.upper}"
            kind = "cost" if term.is_cost else "constraint"
            rows.append(_row(phase, term.name, kind, term.unit, term.equation, value))
    return [row for row in rows if f"{row['phase']}/{row['name']}" not in options.off]


def _row(phase: str, name: str, kind: str, unit: str, equation: str, value: str) -> dict[str, str]:
    row = {"stage": "joint qp", "phase": phase, "name": name, "kind": kind, "at": "step", "unit": unit}
    return {**row, "equation": equation, "value": value}
