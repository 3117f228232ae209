"""The spatial program as a problem: flat foot, toes and flight of the whole robot, joined."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np

from jumplab.models.spatial import CHART
from jumplab.ocp.problem import Bound, Phase, Problem, Term
from jumplab.robot import Robot
from jumplab.stages.spatial.settings import SPATIAL_MESH, SpatialLimits, SpatialWeights
from jumplab.stages.spatial.terms import SpatialTerms
from jumplab.stages.spatial.view import SpatialView
from jumplab.stages.whole_body.problem import COM_BOX_M, FLIGHT_S, SCALES, SPEED_BOX_M_S
from jumplab.stages.whole_body.settings import Contact, Mesh

ANGLE_BOX_RAD = 15.0  # beyond two full turns
RATE_BOX = 30.0  # [rad/s, m/s] of the base
TORQUE_SCALE, FALL_SCALE = 100.0, 10.0  # [N m], [m/s^2] for conditioning
JOINED_SCALE = 0.01  # a jump of 5 um between two phases would be a centimetre a second on the tape
SPIN_BOX = (-100.0, 100.0, 1.0)  # [kg m^2/s] angular momentum in flight; scale


def _boxes(b: SpatialTerms) -> tuple[Bound, ...]:
    """Ranges, speeds and torques of the joints; forces that only push."""
    lim, m, base = b.limits, b.motors, len(b.coordinates) - b.model.joints
    wide = np.full(base, ANGLE_BOX_RAD)
    wide[-2] = lim.roll_rad
    low, high = m["lower"] + lim.range_margin_rad, m["upper"] - lim.range_margin_rad
    least = -np.inf if b.flying or b.robot.planar else lim.straight_knee_rad
    for k, sign, angle in b.knees:
        bent = sorted((sign * (least - angle), sign * (lim.knee_rad - angle)))
        low[k], high[k] = max(low[k], bent[0]), min(high[k], bent[1])
    rates = np.concatenate([np.full(base, RATE_BOX), lim.speed_share * m["speed"]])
    torques, free = lim.torque_share * m["effort"], np.full(b.n_forces or 3, np.inf)
    least = np.zeros(b.n_forces) if b.n_forces else -free
    return (
        Bound("joint range", "ours: stops", "rad", "q", np.concatenate([-wide, low]), np.concatenate([wide, high])),
        Bound("joint speed", "ours: limit", "rad/s", "v", -rates, rates),
        Bound(
            "forces and torques",
            "ours: limit",
            "N, N m",
            "z",
            np.concatenate([least, -torques]),
            np.concatenate([free, torques]),
        ),
    )


def _scales(b: SpatialTerms) -> dict:
    free = np.full(3, FALL_SCALE) if b.flying else np.full(b.n_forces, b.mg / 8)
    return SCALES | {"z": np.concatenate([free, np.full(b.model.joints, TORQUE_SCALE)])}


def _flat_phase(b: SpatialTerms, mesh: Mesh) -> Phase:
    def stance(parameters):
        return parameters["stance"]

    legs = {j for k in b.feet for j in b.chain(k)}
    rest = np.array([np.inf if k - len(CHART) + 1 in legs else 0.0 for k in range(len(b.coordinates))])
    start = (
        Bound("stance", "ours: the paper prints no start", "rad", "q", stance, stance, "start"),
        Bound("at rest", "ours", "rad/s", "v", 0.0, 0.0, "start"),
        # where the legs' accelerations follow from feet in place, no second condition is wanted at this end
        Bound("at rest (acceleration)", "ours", "rad/s^2", "a", -rest, rest, "start"),
    )
    terms = (*b.smoothness(), *b.dynamics(), b.motor_lines(), *b.launch_rows(), b.body_clearance(), *b.link_distances())
    return Phase(
        b.contact.value,
        b.coordinates,
        mesh.flat,
        b.limits.flat_s,
        terms,
        (*_boxes(b), *start),
        b.states,
        scales=_scales(b),
    )


def _toe_phase(b: SpatialTerms, mesh: Mesh) -> Phase:
    gone = np.concatenate([np.zeros(b.n_forces), np.full(b.model.joints, np.inf)])
    off = Bound("no force at take-off", "SL-E3, E4, E6 for the whole body", "N", "z", -gone, gone, "end")
    terms = (*b.smoothness(), *b.dynamics(), b.motor_lines(), *b.launch_rows(), b.body_clearance(), *b.link_distances())
    return Phase(
        b.contact.value, b.coordinates, mesh.toe, b.limits.toe_s, terms, (*_boxes(b), off), b.states, scales=_scales(b)
    )


def _flight_phase(b: SpatialTerms, mesh: Mesh) -> Phase:
    constants = {
        f"{kind}_{x}": box for kind, box in (("com", COM_BOX_M), ("vel", SPEED_BOX_M_S), ("L", SPIN_BOX)) for x in "xyz"
    }
    terms = (
        *b.smoothness(),
        *b.dynamics(),
        b.motor_lines(),
        *b.flight_rows(),
        b.body_clearance(),
        *b.link_distances(),
        *b.touchdown_rows(),
    )
    return Phase(
        b.contact.value, b.coordinates, mesh.flight, FLIGHT_S, terms, _boxes(b), b.states, constants, scales=_scales(b)
    )


def _joined() -> Term:
    def jump(ends):
        a, b = ends["flat"].end, ends["toe"].start
        return ca.vertcat(*((getattr(a, k) - getattr(b, k)) / SCALES[k] for k in "qva"))

    return Term("flat to toe", "WF-L1..L3", "scaled", "problem", jump, scale=JOINED_SCALE, identity=True)


def _released(toe: SpatialTerms) -> tuple[Term, Term]:
    def jump(ends):
        a, b = ends["toe"].end, ends["flight"].start
        rows = [(getattr(a, k)[3:] - getattr(b, k)) / SCALES[k] for k in "qv"]
        return ca.vertcat(*rows, (a.a[len(CHART) :] - b.a[3:]) / SCALES["a"])

    def takeoff(ends):
        s, c = toe.state(ends["toe"].end), ends["flight"].start.c
        place, speed = ca.vertcat(c.com_x, c.com_y, c.com_z), ca.vertcat(c.vel_x, c.vel_y, c.vel_z)
        return ca.vertcat(s.com - place, s.com_velocity - speed)

    return (
        Term("toe to flight", "WF-L1..L3", "scaled", "problem", jump, scale=JOINED_SCALE, identity=True),
        Term("ballistic CoM", "WF-D1", "m, m/s", "problem", takeoff, identity=True),
    )


def build_problem(
    robot: Robot,
    mesh: Mesh = SPATIAL_MESH,
    limits: SpatialLimits = SpatialLimits(),
    weights: SpatialWeights = SpatialWeights(),
) -> Problem:
    """Flat foot, toes and flight in one problem."""
    flat, toe, flight = (SpatialTerms(robot, limits, weights, contact) for contact in Contact)
    made = (flat, _flat_phase(flat, mesh)), (toe, _toe_phase(toe, mesh)), (flight, _flight_phase(flight, mesh))
    phases = tuple(replace(phase, view=partial(SpatialView, b)) for b, phase in made)
    parameters = dict(stance=len(flat.coordinates), distance=1, side=1, yaw=1, platform=1, edge=1, along=2)
    parameters |= dict(takeoff_speed=1, rotation=1, gravity=1, **({} if robot.planar else {"straight": 1}))
    return Problem("spatial", phases, (_joined(), *_released(toe)), parameters)
