"""Stage 2's costs and constraints, JL-* and JF-* (Sec. IV of the paper), by the same words as those
of the other stages: what a step's QP is made of, row by row, and what can be changed about it.

Every expression takes a :class:`.point.StepPoint` and returns rows that are affine in the step's
unknowns, X = [F_ext^js (12); theta'' (nv)] in launch and theta'' (nv) in flight.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from jumplab.errors import InputError
from jumplab.models.full import SIDES, FullBody, force_target
from jumplab.ocp import Phase, Problem, Term
from jumplab.ocp.changes import check_weight, ends
from jumplab.ocp.problem import limit
from jumplab.robot.contact import wrench_rows
from jumplab.stages.changes import StageChanges
from jumplab.stages.joint_qp.point import Affine, StepPoint
from jumplab.stages.joint_qp.settings import Limits, Options

AXES = ("x", "y", "z", "rx", "ry", "rz")
HELD = [0, 1, 2, 3, 5]  # axes in which a foot on its toe cannot move; PITCH is the other one
PITCH = 4
FIRST = {"launch": 12, "flight": 0}  # phase -> column of x at which theta'' begins


def _both(labels: Iterable[str]) -> list[str]:
    labels = list(labels)
    return [f"{side} {label}" for side in SIDES for label in labels]


def _shared_terms(phase: str, weights: Any, limits: Limits) -> list[Term]:
    """Of both phases: costs towards the posture, dynamics, symmetry, and what joints can do."""

    def joints(p):
        return p.accelerations[6:] - p.target.joints

    def trunk(p):
        return p.accelerations[3:6] - p.target.trunk

    def base(p):
        return (p.forces[:6] - p.target.base_force).named(AXES)

    def mirrored(p):
        rows = p.affine(p.body.symmetry_rows(phase), -p.target.symmetry)
        return rows.named(p.body.robot.joint_names[left - 6] for left, *_ in p.body.pairs[phase])

    def torque(p):
        return p.forces[6:].named(p.body.robot.joint_names)

    def torque_range(p):
        low, high = p.body.motors.range(p.quantities.v[6:])
        return limits.torque_share * low, limits.torque_share * high

    def accelerations(p):
        return p.accelerations[6:].named(p.body.robot.joint_names)

    def joint_range(p):
        return p.target.acceleration_range

    def between(name, equation, unit, of, ends):
        return limit(name, equation, unit, "node", of, lambda p: ends(p)[0], lambda p: ends(p)[1])

    posture = "ours: towards the posture"
    regular = "ours: regulariser", "m/s^2, rad/s^2", "node", "accelerations"
    dynamics = "Sec. IV: base rows, M theta'' + H = J^T F"
    stops = "ours: speed and stops after the step"
    return [
        Term("joints", posture, "rad/s^2", "node", joints, weights.posture),
        Term("trunk turn", posture, "rad/s^2", "node", trunk, weights.trunk),
        Term("acceleration", *regular, weights.acceleration),
        Term("base dynamics", dynamics, "N, N m", "node", base, identity=True),
        Term("symmetry", "Sec. IV: S theta'' = 0", "rad/s^2", "node", mirrored),
        between("torque", "ours: torque, less above the corner speed", "N m", torque, torque_range),
        between("speed and range", stops, "rad/s^2", accelerations, joint_range),
    ]


def launch_terms(o: Options) -> list[Term]:
    """Costs and constraints of the launch, JL-* (Sec. IV-A)."""
    w = o.launch

    def forwards(p, most, usual):
        """Factors of the rows x, y and z: with feet flat, that of x weighs ``most``."""
        return np.array([1.0 if p.target.on_toes else np.sqrt(most / usual), 1.0, 1.0])

    def com(p):
        return forwards(p, w.com_x, w.com) * (p.com_acceleration - p.target.com_acceleration)

    def missing(p):
        """A_f F - B_f (6 rows)."""
        return p.quantities.A_f @ p.wrench - force_target(
            p.body.mass, p.body.gravity, p.target.com_acceleration, p.target.momentum_rate
        )

    def force(p):
        return forwards(p, w.force_x, w.force) * missing(p)[:3]

    def inertia(p):
        missed = p.inertia_acceleration - p.target.inertia_accel
        return np.sqrt(p.target.inertia_weight / w.inertia_toe) * missed

    follow = f"Sec. IV-A: A_c theta'' + B_c - c''_ref; flat feet: {w.com_x:g} forwards"
    linear = f"Sec. IV-A: A_f F - B_f, linear rows; flat feet: {w.force_x:g} forwards"
    turning = "Sec. IV-A: A_f F - B_f, angular rows"
    shape = f"ours: J_rho theta'' + drift - rho''_ref; flat feet: {w.inertia:g}"
    return [
        Term("com", follow, "m/s^2", "node", com, w.com),
        Term("force", linear, "N", "node", force, w.force),
        Term("moment", turning, "N m", "node", lambda p: missing(p)[3:], w.moment),
        Term("inertia", shape, "kg m^2/s^2", "node", inertia, w.inertia_toe),
        Term("wrench", "ours: regulariser", "N, N m", "node", "wrench", w.wrench),
        *contact_terms(o),
        *_shared_terms("launch", w, o.limits),
    ]


def contact_terms(o: Options) -> list[Term]:
    """Constraints of the feet in launch, JL-* (Sec. IV-A): motions, and wrenches [N, N m]."""
    friction = o.limits.friction

    def tiptoe(p):
        missed = p.quantities.tip.drift - p.target.toe_acceleration
        rows = [6 * side + axis for side in (0, 1) for axis in HELD]
        labels = _both([AXES[axis] for axis in HELD])
        return p.affine(p.quantities.J, missed.ravel())[rows].named(labels)

    def pitch(p):
        if p.target.on_toes:
            return p.wrench[[PITCH, 6 + PITCH]].named(SIDES)
        tip = p.quantities.tip
        missed = tip.drift[:, PITCH] - p.target.toe_acceleration[:, PITCH]
        return p.affine(tip.jacobian[:, PITCH], missed).named(SIDES)

    def ground(p):
        foot = p.body.robot.foot
        # on the toes another row holds the CoP there
        ahead, behind = (None, None) if p.target.on_toes else (0.0, foot.toe - foot.heel)
        spin = friction * foot.half_width
        rows = wrench_rows(friction, ahead, behind, foot.half_width, spin)
        return (np.kron(np.eye(2), list(rows.values())) @ p.wrench).named(_both(rows))

    def heel(p):
        x = p.quantities.heel
        return p.affine(x.jacobian[:, 2], x.drift[:, 2]).named(SIDES)

    def least(p):
        return p.target.heel_floor

    foot = "Sec. IV-A: J theta'' + drift = p''_foot"
    flat = "ours: flat foot, or no moment about the toe"
    return [
        Term("tiptoe", foot, "m/s^2, rad/s^2", "node", tiptoe),
        Term("foot pitch or toe moment", flat, "rad/s^2, N m", "node", pitch),
        limit("ground", "ours: F_z >= 0, friction, CoP in the sole", "N, N m", "node", ground),
        limit("heel", "Sec. IV-A: heel above the ground", "m/s^2", "node", heel, least),
    ]


def flight_terms(o: Options) -> list[Term]:
    """Costs and constraints of the flight, JF-* (Sec. IV-B)."""
    w = o.flight

    def foot(p):
        x = p.quantities
        return p.affine(x.J_rd.reshape(6, -1), (x.drift_rd - p.target.foot_accel).ravel())

    def level(p):
        tip = p.quantities.tip
        return p.affine(tip.jacobian[:, PITCH], tip.drift[:, PITCH] - p.target.foot_pitch)

    def inertia(p):
        return p.inertia_acceleration - p.target.inertia_accel

    def ground(p):
        x = p.quantities
        return p.affine(x.vertical("jacobian"), x.vertical("drift")).named(_both(["toe", "heel"]))

    def least(p):
        return p.target.floor

    shape = "Sec. IV-B: J_rho theta'' + drift - rho''_ref"
    return [
        Term("foot", "Sec. IV-B: J_rd theta'' + drift - p''_rd", "m/s^2", "node", foot, w.foot),
        Term(
            "foot level",
            "ours: sole parallel to the ground",
            "rad/s^2",
            "node",
            level,
            w.foot_level,
        ),
        Term("inertia", shape, "kg m^2/s^2", "node", inertia, w.inertia),
        limit("ground", "ours: toe and heel above the ground", "m/s^2", "node", ground, least),
        *_shared_terms("flight", w, o.limits),
    ]


def build_problem(options: Options = Options()) -> Problem:
    """Both QPs as one problem of two phases, each with one step."""
    parts = {"launch": launch_terms(options), "flight": flight_terms(options)}
    phases = tuple(Phase(name, (), 1, (0.0, 1.0), tuple(x)) for name, x in parts.items())
    return Problem("joint qp", phases)


def changed_problem(
    body: FullBody,
    q0: np.ndarray,
    options: Options = Options(),
    changes: StageChanges = StageChanges(),
) -> Problem:
    """Stage 2's problem with own terms, other weights, and terms left out.

    Parameters
    ----------
    body, q0 : the robot, and a configuration (nq,) at which own terms are looked at, at rest.
    changes : own terms are at "node", a cost or a constraint on a :class:`.point.StepPoint`; the
        weights are factors on those of the costs.

    Raises
    ------
    InputError
        In one sentence with the term's name, before anything is solved.
    """

    def look(problem, phase, term, who):
        rest = body.terms(q0, np.zeros(body.nv))
        _look(term, who, StepPoint(body, FIRST[phase], rest, 0.0))
        return ""

    problem = replace(changes, weights={}, off=()).applied(build_problem(options), look)
    weights = {}
    for name, factor in changes.weights.items():
        check_weight(f"weight {name!r} of 'joint qp'", factor, "its factor")
        weights |= {"/".join(cost): factor * usual for cost, usual in problem.costs(name).items()}
    return replace(changes, terms={}, weights=weights).applied(problem)


def _look(term: Term, who: str, p: StepPoint) -> None:
    """Refuse a term that has no place in a step's QP."""
    if term.at != "node" or term.skip != (0, 0):
        raise InputError(
            f"{who}: at = {term.at!r}, skip = {term.skip}, must be 'node' and (0, 0), since every "
            f"step has its own QP"
        )
    rows = rows_of(term, who, p)
    if not term.is_cost:
        ends(who, term, len(rows))


def rows_of(term: Term, who: str, p: StepPoint) -> Affine:
    """A term's rows at a point; refuses (:class:`InputError`) what is no :class:`.point.Affine` or
    not finite; ``who`` is the term in sentences.
    """
    try:
        rows = term.expression(p)
    except (AttributeError, InputError, IndexError, TypeError, ValueError) as e:
        raise InputError(f"{who}: its expression fails ({e})") from e
    if not isinstance(rows, Affine) or rows.offset.shape != rows.matrix.shape[:1] or not len(rows):
        raise InputError(
            f"{who}: its expression is {type(rows).__name__}, must be rows that depend on the "
            f"accelerations, such as p.joint_accelerations.knee"
        )
    if not (np.all(np.isfinite(rows.matrix)) and np.all(np.isfinite(rows.offset))):
        raise InputError(f"{who}: its expression is not finite at t = {p.time:.3f} s")
    return rows
