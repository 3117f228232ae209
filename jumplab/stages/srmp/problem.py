"""Stage 1 as a problem: named costs and constraints, and the phases flat foot, toe (heel up) and
flight, joined at take-off (Sec. III of the paper); pure, nothing here solves.
"""

from __future__ import annotations

from functools import partial
from operator import itemgetter

import casadi as ca
import numpy as np

from jumplab.models.srmp import COORDINATES, SrmpFlightState, SrmpState
from jumplab.ocp.derivatives import chain
from jumplab.ocp.problem import Bound, Phase, Point, Problem, Term, limit
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, reach
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.task import GRAVITY

FLIGHT_S = (0.05, 2.0)
QUARTERS = (0.25, 0.5, 0.75)
# three points on [0, 1]
GAUSS = ((0.5 - np.sqrt(15) / 10, 5 / 18), (0.5, 8 / 18), (0.5 + np.sqrt(15) / 10, 5 / 18))
SCALES = {
    "q": 1.0,
    "v": [5.0, 3.0, 5.0, 2.0],
    "a": [50.0, 30.0, 50.0, 20.0],
    "j": [1000.0, 500.0, 1000.0, 500.0],
}
FLIGHT_SCALES = {"q": 1.0, "v": 20.0, "a": 200.0, "j": 5000.0}


def rod_at(mass: float, p: Point) -> SrmpState:
    """The pendulum at a point on the ground."""
    return SrmpState(mass, p.q, p.v, p.a, p.p.gravity)


def flight_at(p: Point) -> SrmpFlightState:
    """The pendulum at a point in the air."""
    c = p.c
    begun = ca.vertcat(c.com_x, c.com_z), ca.vertcat(c.vel_x, c.vel_z)
    return SrmpFlightState(p.z[0], p.q[0], p.v[0], c.L, *begun, p.time, p.p.gravity)


# launch ------------------------------------------------------------------------------------------
def launch_terms(mass: float, reach: Reach, s: SrmpSettings) -> list[Term]:
    """Costs and constraints all along the launch, SL-* (Sec. III-A)."""
    mg = mass * GRAVITY
    roots = ca.DM(np.sqrt(s.w_jerk))

    def inertia_room(p):
        low, high = (
            ca.polyval(ca.DM(fit), p.q[1])
            for fit in (reach.inertia_low_fit, reach.inertia_high_fit)
        )
        margin = s.inertia_margin * (high - low)
        return ca.vertcat(p.inertia - low - margin, high - margin - p.inertia)

    def cone(p):
        f = p.ground_force
        return ca.vertcat(s.friction * f[1] - f[0], s.friction * f[1] + f[0])

    return [
        Term("jerk", "SL-J1", "weighted", "mid", lambda p: roots * p.j, 1.0),
        Term("CoM velocity", "SL-J2", "m/s", "node", "com_velocity", s.w_velocity),
        Term("L rate", "SL-J3", "N m", "node", "L_rate", s.w_momentum_rate),
        Term("turn", "SL-J4", "rad", "node", lambda p: p.q[2], s.w_turn),
        limit("trunk range", "SL-P1, as path", "rad", "node", "posture", *reach.posture),
        limit("inertia envelope", "SL-P4, SL-E5; ours: rho(phi)", "kg m^2", "node", inertia_room),
        limit("L range", "SL-P5", "kg m^2/s", "node", "L", *s.momentum, scale=10.0),
        limit(
            "unilateral", "ours", "N", "node", lambda p: p.ground_force[1], scale=mg, skip=(0, 1)
        ),
        limit("friction", "ours", "N", "node", cone, scale=mg, skip=(0, 1)),
        *leg_terms(mass, reach, s),
    ]


def leg_terms(mass: float, reach: Reach, s: SrmpSettings) -> list[Term]:
    """Limits of the legs all along the launch, SL-B1 (Sec. III-A): force [N] and speed [m/s]."""

    def strength(p):
        """Leg force-velocity line: full force up to a share of the extension speed, none at the
        speed itself.
        """
        force, speed = (
            ca.polyval(ca.DM(fit), p.q[1]) for fit in (reach.force_fit, reach.speed_fit)
        )
        fade = (speed - p.v[1]) / ((1 - s.corner_speed) * speed)
        return ca.vertcat(force - p.ground_force[1], force * fade - p.ground_force[1])

    def extension(p):
        return s.speed_share * ca.polyval(ca.DM(reach.speed_fit), p.q[1]) - p.v[1]

    torques = "SL-B1 on F; ours: from the joint torques"
    return [
        limit("leg force", torques, "N", "node", strength, scale=mass * GRAVITY),
        limit("leg speed", "SL-B1; ours: from the joint speeds", "m/s", "node", extension),
    ]


def reach_terms(reach: Reach, s: SrmpSettings, heel_up: bool) -> list[Term]:
    """Terms that keep the pendulum among the robot's postures: usual inertia, and with flat feet a
    CoM not too low.
    """
    fit = ca.DM(reach.usual_toe_fit if heel_up else reach.usual_flat_fit)
    slope, offset = reach.low_com_fit

    def unusual(p):
        return p.inertia - ca.polyval(fit, p.q[1])

    def height(p):
        return p.com[1] - slope * p.com[0] - offset

    def deep(p):
        below = ca.polyval(ca.DM(reach.easy_com_fit), p.com[0]) - p.com[1]
        return (below + ca.sqrt(below**2 + s.crouch_smoothing_m**2)) / 2

    def between(left, right, step):
        # the CoM only touches this limit, at the bottom of the crouch: with nodes alone it would
        # pass between two
        inside = [chain(left.q, left.v, left.a, left.j, share * step)[0] for share in QUARTERS]
        return ca.vertcat(*(q[1] * (ca.cos(q[0]) - slope * ca.sin(q[0])) - offset for q in inside))

    usual = Term("usual inertia", "ours: rho(phi)", "kg m^2", "node", unusual, s.w_usual_inertia)
    low = "ours: flat feet"
    flat = [
        Term("crouch depth", low, "m", "node", deep, s.w_deep_crouch),
        limit("CoM not too low", low, "m", "node", height, scale=0.1),
        limit("CoM not too low (between)", low, "m", "interval", between, scale=0.1),
    ]
    return [usual] if heel_up else [usual, *flat]


def cop_terms(mass: float, low: float, high: float, slack: float = 0.0) -> list[Term]:
    """SL-P2 multiplied by F_z, so that it holds at take-off too, where the printed quotient is 0/0.

    ``slack`` [N m] is allowed on either side; it matters only where F_z vanishes.
    """

    def room(p):
        f = p.ground_force
        return ca.vertcat(slack - p.pivot_torque - low * f[1], slack + high * f[1] + p.pivot_torque)

    scale = 0.1 * mass * GRAVITY
    return [
        limit("CoP", "SL-P2, times F_z", "N m", "node", room, scale=scale, skip=(0, 1)),
        limit("CoP (mid)", "SL-P2, between nodes", "N m", "mid", room, scale=scale),
    ]


def takeoff_terms(mass: float, reach: Reach, s: SrmpSettings) -> list[Term]:
    """Costs and constraints at the end of the launch, SL-J2, J3 and SL-E* (Sec. III-A)."""
    mg = mass * GRAVITY
    length = reach.length[0], s.takeoff_length * reach.start[1]

    def speed(p):
        return p.com_velocity[1] - p.p.takeoff_speed

    return [
        Term("posture at take-off", "SL-J2", "rad", "end", "posture", s.w_posture_end),
        Term("L at take-off", "SL-J3", "kg m^2/s", "end", "L", s.w_momentum_end),
        Term("take-off speed", "SL-E2", "m/s", "end", speed),
        Term("rod force zero", "SL-E3", "N", "end", "rod_force", scale=mg),
        Term("pivot torque zero", "SL-E4", "N m", "end", "pivot_torque", scale=0.1 * mg),
        Term("L rate zero", "SL-E6", "N m", "end", "L_rate", scale=0.1 * mg),
        limit("take-off length", "SL-B1 at the end; ours", "m", "end", lambda p: p.q[1], *length),
        limit("posture range", "SL-P1", "rad", "end", "posture", *s.posture_end),
    ]


# flight ------------------------------------------------------------------------------------------
def flight_terms(s: SrmpSettings, reach: Reach | None = None) -> list[Term]:
    """Costs and constraints of the flight, SF-* (Sec. III-B); coordinate rho = rho_R + rho_I, state
    theta.

    With ``reach``, also the inertia at touchdown is one that the robot usually has at that leg
    length.
    """

    def rotation(left, right, step):
        total = 0
        for share, weight in GAUSS:
            total += weight * left.c.L / chain(left.q, left.v, left.a, left.j, share * step)[0]
        return right.z - left.z - step * total

    def unusual(p):
        return p.q - ca.polyval(ca.DM(reach.usual_toe_fit), p.c.leg)

    def height(p):
        t = p.duration
        com = p.c.com_z + p.c.vel_z * t - p.p.gravity * t * t / 2
        return com - p.p.platform - p.c.leg * ca.cos(_foot_angle(p))

    def climb(p):
        return p.c.vel_z - p.p.gravity * p.duration

    rate = s.touchdown_inertia_rate
    lean = s.touchdown_lean
    below = "ours: foot below the CoM"
    usual = limit(
        "inertia at touchdown", "ours: rho(phi)", "kg m^2", "end", unusual, *s.touchdown_inertia
    )
    return [
        *([] if reach is None else [usual]),
        Term("inertia acceleration", "SF-J1", "kg m^2/s^2", "node", "a", s.w_inertia_accel),
        Term("inertia jerk", "SF-J1", "kg m^2/s^3", "mid", "j", s.w_inertia_jerk),
        Term("rotation", "SF-D1", "rad", "interval", rotation, identity=True),
        limit("inertia rate at touchdown", "ours", "kg m^2/s", "end", "v", -rate, rate, scale=10.0),
        Term("touchdown height", "ours: t_f from both CoM heights", "m", "end", height),
        limit("falling at touchdown", "ours: not on the way up", "m/s", "end", climb, -np.inf, 0.0),
        limit("lean at touchdown", below, "rad", "end", _foot_angle, -lean, lean),
    ]


def _foot_angle(p: Point) -> ca.SX:
    """Angle theta of the line from foot to CoM at touchdown [rad], whole turns taken off."""
    return p.z[0] - p.p.rotation


def _foot_ahead(p: Point) -> ca.SX:
    """Sole centre ahead of the CoM at touchdown [m]."""
    return -p.c.leg * ca.sin(_foot_angle(p))


# both ------------------------------------------------------------------------------------------
def joining_terms(s: SrmpSettings) -> list[Term]:
    """Links of the phases and at take-off (SF-L1..4), and :func:`landing_terms`; ``e`` has the ends
    of every phase.
    """

    def launch_time(e):
        return e["flat"].end.duration + e["toe"].end.duration

    def inertia_link(e):
        a = e["toe"].end
        b = e["flight"].start
        return ca.vertcat(
            a.inertia - b.q[0], (a.inertia_rate - b.v[0]) / 20, (a.inertia_accel - b.a[0]) / 200
        )

    def lean_link(e):
        return e["toe"].end.q[0] - e["flight"].start.z[0]

    def momentum_link(e):
        return e["toe"].end.L - e["flight"].start.c.L

    def ballistic(e):
        a = e["toe"].end
        c = e["flight"].start.c
        return ca.vertcat(
            a.com - ca.vertcat(c.com_x, c.com_z), a.com_velocity - ca.vertcat(c.vel_x, c.vel_z)
        )

    link = {"identity": True}
    keeps = "SF-D1: L constant"
    return [
        Term("launch time", "SL-J5", "s", "problem", launch_time, s.w_time),
        Term("lean link", "SF-L1", "rad", "problem", lean_link, **link),
        Term("inertia link", "SF-L2..L4", "kg m^2 ...", "problem", inertia_link, **link),
        Term("momentum link", keeps, "kg m^2/s", "problem", momentum_link, scale=10.0, **link),
        Term("ballistic CoM", "Sec. III", "m, m/s", "problem", ballistic, **link),
        *landing_terms(s),
    ]


def landing_terms(s: SrmpSettings) -> list[Term]:
    """Jump length [m] and landing condition; ``e`` as in :func:`joining_terms`."""

    def length(e):
        c = e["flight"].start.c
        end = e["flight"].end
        return c.com_x + c.vel_x * end.duration + _foot_ahead(end) - end.p.distance

    def capture(e):
        end = e["flight"].end
        return _foot_ahead(end) - s.capture_offset_m - s.capture_slope_s * end.c.vel_x

    instead = "ours; replaces SF-E1"  # about the pivot it lands too far ahead, and falls
    return [
        Term("jump length", "SL-E1, foot to foot", "m", "problem", length),
        limit("capture window", instead, "m", "problem", capture, *s.capture_window_m, scale=0.1),
    ]


# phases ------------------------------------------------------------------------------------------
def _launch_phases(mass: float, reach: Reach, s: SrmpSettings) -> tuple[Phase, Phase]:
    """Flat foot and toe: the same terms all along; the CoP inside the sole, then in a band at the
    toe edge.
    """

    start = itemgetter("start")  # of the parameters
    low, high = zip(s.takeoff_lean, reach.length, s.turn_rad, s.radius_m, strict=True)
    box = Bound("state box", "SL-B1", "rad, m", "q", low, high, "inner")
    bounds = (
        Bound("start posture", "SL-P3; ours: the stance", "rad, m", "q", start, start, "start"),
        Bound("at rest", "ours", "1/s", "v", 0.0, 0.0, "start"),
        Bound("at rest (acceleration)", "ours", "1/s^2", "a", 0.0, 0.0, "start"),
        box,
    )
    heel, toe = reach.cop
    along = launch_terms(mass, reach, s)
    flat = (
        *along,
        *reach_terms(reach, s, False),
        *cop_terms(mass, heel + s.cop_margin_m, toe),
    )
    edge = cop_terms(mass, toe - s.toe_band_m, toe, s.toe_slack_n_m)
    tip = (*along, *reach_terms(reach, s, True), *edge, *takeoff_terms(mass, reach, s))
    rod = {"scales": SCALES, "view": partial(rod_at, mass)}
    return (
        Phase("flat", COORDINATES, s.intervals[0], s.flat_s, flat, bounds, **rod),
        Phase("toe", COORDINATES, s.intervals[1], s.toe_s, tip, (box,), shared="qva", **rod),
    )


def _flight_phase(reach: Reach, s: SrmpSettings) -> Phase:
    stance = reach.start[1]
    low, high = reach.inertia
    margin = s.inertia_margin * (high - low)
    most = min(high - margin, low + s.flight_inertia * (high - low))
    accel = s.inertia_accel
    bounds = (
        Bound("inertia range", "SF-B1", "kg m^2", "q", low + margin, most),
        Bound("inertia rate range", "SF-B1", "kg m^2/s", "v", -s.inertia_rate, s.inertia_rate),
        Bound("inertia acceleration range", "SF-B1", "kg m^2/s^2", "a", -accel, accel),
    )

    def shortest(parameters):
        fold = s.touchdown_fold_per_m * max(0.0, parameters["platform"])
        return (s.touchdown_length[0] - fold) * stance

    constants = {
        "L": (*s.momentum, 10.0),
        **{name: (*s.com_m, 1.0) for name in ("com_x", "com_z")},
        **{name: (*s.speed_m_s, 1.0) for name in ("vel_x", "vel_z")},
        "leg": (shortest, s.touchdown_length[1] * stance, 1.0),
    }
    return Phase(
        "flight",
        ("inertia",),
        s.intervals[2],
        FLIGHT_S,
        tuple(flight_terms(s, reach)),
        bounds,
        states=("theta",),
        constants=constants,
        scales=FLIGHT_SCALES,
        view=flight_at,
    )


def build_problem(
    robot: Robot, settings: SrmpSettings = SrmpSettings(), envelope: Reach | None = None
) -> Problem:
    """Stage 1 as one problem over launch and flight."""
    envelope = envelope or reach(robot)
    mass = robot.sagittal.total_mass
    phases = *_launch_phases(mass, envelope, settings), _flight_phase(envelope, settings)
    numbers = "distance", "platform", "takeoff_speed", "rotation", "gravity"
    sizes = {"start": 4} | dict.fromkeys(numbers, 1)
    return Problem("SRMP", phases, tuple(joining_terms(settings)), sizes)
