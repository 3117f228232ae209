"""Stage 3 as a problem: flat foot, toe (heel up) and flight, joined (Sec. V of the paper), and the direct planner's."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import casadi as ca

from jumplab.ocp.problem import Bound, Phase, Problem, Term
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.robot import SAGITTAL_LINKS as LINKS
from jumplab.stages.whole_body.settings import JERK_SCALE, Contact, Limits, Mesh, Weights
from jumplab.stages.whole_body.terms import WholeBodyTerms
from jumplab.stages.whole_body.view import BodyView

SCALES = {"q": 1.0, "v": 10.0, "a": 100.0, "j": JERK_SCALE, "z": JERK_SCALE}  # peaks of solutions, for conditioning
TRACKED_IN_FLIGHT = {"rho": 1, "rho_rate": 1}  # references and their sizes
TRACKED = {**TRACKED_IN_FLIGHT, "velocity": 2, "L": 1}
ANGLE_BOX_RAD = 8.0  # beyond one and a quarter turns, so that a flip fits
FLIGHT_S = (0.05, 1.5)  # from a hop to a rise of two metres
COM_BOX_M = (-1.5, 2.5, 1.0)  # the CoM at take-off, seen from the toe; scale
SPEED_BOX_M_S = (-6.0, 6.0, 1.0)  # a CoM rise of 1.8 m; scale


def _continuity(left: WholeBodyTerms, right: WholeBodyTerms) -> Term:
    def jump(ends):
        a, b = ends[left.contact].end, ends[right.contact].start
        rows = [(left.links(getattr(a, k)) - right.links(getattr(b, k))) / SCALES[k] for k in "qva"]
        return ca.vertcat(*rows, *([(a.z - b.z) / SCALES["z"]] if a.z.numel() else []))

    return Term(f"{left.contact} to {right.contact}", "WF-L1..L3", "scaled", "problem", jump, identity=True)


def _flat_phase(b: WholeBodyTerms, mesh: Mesh, limits: Limits) -> Phase:
    def stance(parameters):
        return parameters["stance"][1:]

    terms = b.smoothness() + b.limits_of_joints() + b.ground_contact() + b.flat_rows()
    start = (
        Bound("stance", "ours: the paper prints no start", "rad", "q", stance, stance, "start"),
        Bound("at rest", "ours", "rad/s", "v", 0.0, 0.0, "start"),
        Bound("at rest (acceleration)", "ours", "rad/s^2", "a", 0.0, 0.0, "start"),
    )
    return Phase(b.contact.value, LINKS[1:], mesh.flat, limits.flat_s, tuple(terms), start, scales=SCALES)


def _toe_phase(b: WholeBodyTerms, mesh: Mesh, limits: Limits) -> Phase:
    # inner: at the first node the flat foot before it says so already, and a bound on top has multipliers without limit
    low, high = [0.0] + 4 * [-ANGLE_BOX_RAD], [limits.heel_up_rad] + 4 * [ANGLE_BOX_RAD]
    heel = Bound("heel not below ground", "WL-K2", "rad", "q", low, high, "inner")
    terms = b.smoothness() + b.limits_of_joints() + b.ground_contact() + b.toe_rows()
    return Phase(b.contact.value, LINKS, mesh.toe, limits.toe_s, tuple(terms), (heel,), scales=SCALES)


def _flight_phase(b: WholeBodyTerms, mesh: Mesh) -> Phase:
    box = Bound("link angles", "ours: box", "rad", "q", -ANGLE_BOX_RAD, ANGLE_BOX_RAD)
    constants = {"com_x": COM_BOX_M, "com_z": COM_BOX_M, "vel_x": SPEED_BOX_M_S, "vel_z": SPEED_BOX_M_S}
    terms = b.smoothness() + b.limits_of_joints() + b.flight_rows()
    return Phase(
        b.contact.value, LINKS, mesh.flight, FLIGHT_S, tuple(terms), (box,), constants=constants, scales=SCALES
    )


def _ballistic(b: WholeBodyTerms) -> Term:
    def takeoff(ends):
        s, c = b.state(ends["toe"].end), ends["flight"].start.c
        return ca.vertcat(s.com - ca.vertcat(c.com_x, c.com_z), s.com_velocity - ca.vertcat(c.vel_x, c.vel_z))

    return Term("ballistic CoM", "WF-D1", "m, m/s", "problem", takeoff, identity=True)


def _even_jerk(b: WholeBodyTerms, phase: Phase) -> Phase:
    """The phase with the jerks of joints and trunk as further states, which bound how far a jerk may jump."""
    rest = Bound("no jerk before", "ours: flips", "rad/s^3", "z", 0.0, 0.0, "start")
    names = tuple(f"jerk of {name}" for name in (*SAGITTAL_JOINTS, "trunk"))
    bounds = phase.bounds + ((rest,) if b.contact is Contact.FLAT else ())
    return replace(phase, states=names, terms=(*phase.terms, *b.jerk_steps()), bounds=bounds)


def _tracking(b: WholeBodyTerms, phase: Phase) -> Phase:
    """The phase with stage 1's trajectories as references."""
    return replace(phase, terms=(*phase.terms, *b.tracking()), references=TRACKED_IN_FLIGHT if b.flying else TRACKED)


def _durations(weights: Weights) -> Term:
    def off(ends):
        return ca.vertcat(ends["flat"].end.duration, ends["toe"].end.duration) - ends["flat"].end.p.launch_s

    return Term("track durations", "ours: fixed in the paper", "s", "problem", off, weight=weights.track_duration)


def build_problem(
    robot: Robot,
    mesh: Mesh = Mesh(),
    limits: Limits = Limits(),
    weights: Weights = Weights(),
    *,
    tracking: bool = True,
) -> Problem:
    """Flat foot, toe and flight in one problem: stage 3 with ``tracking``, the direct planner without."""
    weights = replace(weights, jerk=weights.tracking_jerk) if tracking else weights
    terms = flat, toe, flight = [WholeBodyTerms(robot, limits, weights, contact) for contact in Contact]
    phases = [_flat_phase(flat, mesh, limits), _toe_phase(toe, mesh, limits), _flight_phase(flight, mesh)]
    phases = [replace(p, view=partial(BodyView, b)) for b, p in zip(terms, phases, strict=True)]
    if limits.jerk_step is not None:
        phases = [_even_jerk(b, phase) for b, phase in zip(terms, phases, strict=True)]
    joints = (_continuity(flat, toe), _continuity(toe, flight), _ballistic(toe))
    parameters = dict(stance=5, distance=1, platform=1, edge=1, takeoff_speed=1, rotation=1, gravity=1)
    if not tracking:
        return Problem("whole body", tuple(phases), joints, parameters)
    phases = [_tracking(b, phase) for b, phase in zip(terms, phases, strict=True)]
    return Problem(
        "whole body", tuple(phases), (*joints, _durations(weights)), parameters | dict(momentum=1, launch_s=2)
    )
