"""Stage 3 as a problem: flat foot, toe (heel up) and flight, joined (Sec. V of the paper), and the direct planner's."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from jumplab.ocp.problem import Bound, Phase, Problem, Term
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.robot import SAGITTAL_LINKS as LINKS
from jumplab.stages.whole_body.settings import Limits, Mesh, Weights
from jumplab.stages.whole_body.terms import WholeBodyTerms

SCALES = {
    "q": 1.0,
    "v": 10.0,
    "a": 100.0,
    "j": 2000.0,
    "z": 2000.0,
}  # our choice: peaks seen in solutions, for conditioning


TRACKED = {"rho": 1, "rho_rate": 1, "velocity": 2, "L": 1}  # references in launch; the first two also in flight
TRACKED_IN_FLIGHT = {"rho": 1, "rho_rate": 1}
ANGLE_BOX_RAD = 8.0  # our choice: beyond one and a quarter turns, so that a flip fits
FLIGHT_S = (0.05, 1.5)  # our choice: from a hop to a rise of two metres
COM_BOX_M = (-1.5, 2.5)  # our choice: the CoM at take-off, seen from the toe
SPEED_BOX_M_S = (-6.0, 6.0)  # our choice: a CoM rise of 1.8 m


def _with_foot(x):
    """(5,) link angles or rates; in the flat phase the foot's are zero."""
    return ca.vertcat(0, x) if x.numel() == 4 else x


def _continuity(left: str, right: str) -> Term:
    def jump(ends):
        a, b = ends[left].end, ends[right].start
        scaled = ((a.q, b.q, "q"), (a.v, b.v, "v"), (a.a, b.a, "a"))
        rows = [(_with_foot(x) - _with_foot(y)) / SCALES[key] for x, y, key in scaled]
        return ca.vertcat(*rows, *([(a.z - b.z) / SCALES["z"]] if a.z.numel() else []))

    return Term(f"{left} to {right}", "WF-L1..L3", "scaled", "problem", jump, identity=True)


def _flat_phase(b: WholeBodyTerms, mesh: Mesh, limits: Limits) -> Phase:
    def stance(parameters):
        return parameters["stance"][1:]

    terms = b.smoothness(False) + b.limits_of_joints(False) + b.ground_contact() + b.flat_rows()
    start = (Bound("stance", "ours: the paper prints no start", "rad", "q", stance, stance, "start"),
             Bound("at rest", "ours", "rad/s", "v", 0.0, 0.0, "start"),
             Bound("at rest (acceleration)", "ours", "rad/s^2", "a", 0.0, 0.0, "start"))  # fmt: skip
    return Phase("flat", LINKS[1:], mesh.flat, limits.flat_s, tuple(terms), start, scales=SCALES)


def _toe_phase(b: WholeBodyTerms, mesh: Mesh, limits: Limits) -> Phase:
    # inner: at the first node the flat foot before it says so already, and a bound on top has multipliers without limit
    low, high = [0.0] + 4 * [-ANGLE_BOX_RAD], [limits.heel_up_rad] + 4 * [ANGLE_BOX_RAD]
    heel = Bound("heel not below ground", "WL-K2", "rad", "q", low, high, "inner")
    terms = b.smoothness(False) + b.limits_of_joints(False) + b.ground_contact() + b.toe_rows()
    return Phase("toe", LINKS, mesh.toe, limits.toe_s, tuple(terms), (heel,), scales=SCALES)


def _flight_phase(b: WholeBodyTerms, mesh: Mesh, limits: Limits) -> Phase:
    box = Bound("link angles", "ours: box", "rad", "q", -ANGLE_BOX_RAD, ANGLE_BOX_RAD)
    constants = {"com_x": (*COM_BOX_M, 1.0), "com_z": (*COM_BOX_M, 1.0), "vel_x": (*SPEED_BOX_M_S, 1.0),
                 "vel_z": (*SPEED_BOX_M_S, 1.0)}  # fmt: skip
    terms = b.smoothness(True) + b.limits_of_joints(True) + b.flight_rows()
    return Phase("flight", LINKS, mesh.flight, FLIGHT_S, tuple(terms), (box,), constants=constants, scales=SCALES)


def _ballistic(b: WholeBodyTerms) -> Term:
    def takeoff(ends):
        s, c = b.state(ends["toe"].end), ends["flight"].start.c
        return ca.vertcat(s.com - ca.vertcat(c.com_x, c.com_z), s.com_velocity - ca.vertcat(c.vel_x, c.vel_z))

    return Term("ballistic CoM", "WF-D1", "m, m/s", "problem", takeoff, identity=True)


def _even_jerk(b: WholeBodyTerms, *phases: Phase) -> list[Phase]:
    """The phases with the jerks of joints and trunk as further states, which bound how far a jerk may jump."""
    rest = Bound("no jerk before", "ours: flips", "rad/s^3", "z", 0.0, 0.0, "start")
    names = tuple(f"jerk of {name}" for name in (*SAGITTAL_JOINTS, "trunk"))
    return [
        replace(
            p,
            states=names,
            terms=p.terms + tuple(b.jerk_steps()),
            bounds=p.bounds + ((rest,) if p is phases[0] else ()),
        )
        for p in phases
    ]


def _durations(weights: Weights) -> Term:
    def difference(ends):
        return ca.vertcat(ends["flat"].end.duration, ends["toe"].end.duration) - ends["flat"].end.p.launch_s

    return Term(
        "track durations", "ours: fixed in the paper", "s", "problem", difference, weight=weights.track_duration
    )


def build_problem(robot: Robot, mesh: Mesh = Mesh(), limits: Limits = Limits(), weights: Weights = Weights(), *,
                  tracking: bool = True) -> Problem:  # fmt: skip
    """Flat foot, toe and flight in one problem: stage 3 with ``tracking``, the direct planner without."""
    b = WholeBodyTerms(robot, limits, weights)
    flat, toe, flight = _flat_phase(b, mesh, limits), _toe_phase(b, mesh, limits), _flight_phase(b, mesh, limits)
    if limits.jerk_step is not None:
        flat, toe, flight = _even_jerk(b, flat, toe, flight)
    joints = (_continuity("flat", "toe"), _continuity("toe", "flight"), _ballistic(b))
    parameters = dict(stance=5, distance=1, platform=1, edge=1, takeoff_speed=1, rotation=1, gravity=1)
    if not tracking:
        return Problem("direct", (flat, toe, flight), joints, parameters)
    phases = (replace(flat, terms=flat.terms + tuple(b.tracking(False)), references=TRACKED),
              replace(toe, terms=toe.terms + tuple(b.toe_tracking()), references=TRACKED),
              replace(flight, terms=flight.terms + tuple(b.tracking(True)), references=TRACKED_IN_FLIGHT))  # fmt: skip
    return Problem("whole body", phases, (*joints, _durations(weights)), parameters | dict(momentum=1, launch_s=2))
