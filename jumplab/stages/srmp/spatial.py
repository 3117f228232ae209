"""Stage 1 in three dimensions: CoM, momentum and inertias of a jump to the side and with a turn (Sec. III, by analogy).

The rod of the paper becomes a point mass at c, the barbell a body with the angles roll, pitch and yaw, one inertia
about all level axes and one about the vertical: L = (rho_p roll', rho_p pitch', rho_y yaw'), as in the plane
L = rho (omega_l + omega_pl). The ground acts with a force, at a CoP, and with a spin torque about it. In flight L stays
while body and legs turn with omega = L / rho about all three axes. Places count from the middle between the standing
soles, x forward, y to the left, z up. Weights, limits and reach are those of the plane (:mod:`.settings`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial

import casadi as ca
import numpy as np

from jumplab.errors import InputError
from jumplab.ocp import Nlp, PhaseGuess, Solution
from jumplab.ocp.derivatives import chain
from jumplab.ocp.problem import Bound, Phase, Point, Problem, Term
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, YawReach, yaw_reach
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp.planner import OPTIONS, SrmpMotion, SrmpPlan, cubic, grid, leg_between, reach_of
from jumplab.stages.srmp.problem import GAUSS, limit
from jumplab.stages.srmp.settings import SpatialSrmpSettings
from jumplab.task import GRAVITY, JumpTask

COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw", "level inertia", "yaw inertia")
SCALES = {"q": 1.0, "v": [3.0] * 3 + [5.0] * 3 + [20.0, 5.0], "a": [30.0] * 3 + [50.0] * 3 + [200.0, 50.0]}
SCALES |= {"j": [500.0] * 3 + [1000.0] * 3 + [5000.0, 1000.0]}
FLIGHT_SCALES = {"q": 1.0, "v": [20.0, 5.0], "a": [200.0, 50.0], "j": [5000.0, 1000.0]}
SIGNS = np.array([[x, y] for x in (1.0, -1.0) for y in (1.0, -1.0)])


# model ----------------------------------------------------------------------------------------------------------
class Pendulum:
    """The pendulum at one instant of the launch, as CasADi expressions of its coordinates (8,) and their rates."""

    __slots__ = (
        *("mass", "com", "com_velocity", "com_acceleration", "attitude", "inertia", "inertia_rate", "inertia_accel"),
        *("L", "L_rate", "force", "moment", "length", "length_rate"),
    )

    def __init__(self, mass: float, q: ca.SX, v: ca.SX, a: ca.SX, gravity: float | ca.SX = GRAVITY):
        self.mass, self.com, self.com_velocity, self.com_acceleration = mass, q[:3], v[:3], a[:3]  # [kg], [m], ...
        self.attitude, spin, level = q[3:6], v[3:6], [6, 6, 7]
        self.inertia, self.inertia_rate, self.inertia_accel = q[6:], v[6:], a[6:]  # level and yaw [kg m^2] (2,)
        self.L = q[level] * spin  # about the CoM [kg m^2/s] (3,)
        self.L_rate = q[level] * a[3:6] + v[level] * spin  # [N m] (3,)
        self.force = mass * (a[:3] + ca.vertcat(0, 0, gravity))  # of the ground [N] (3,)
        self.moment = self.L_rate + ca.cross(self.com, self.force)  # of the ground about the origin [N m] (3,)
        self.length = ca.norm_2(self.com)  # phi [m]
        self.length_rate = ca.dot(self.com, self.com_velocity) / self.length  # [m/s]

    @property
    def wrench(self) -> ca.SX:
        """The ground's force and its moment about the middle between the soles (6,) [N, N m]."""
        return ca.vertcat(self.force, self.moment)

    @property
    def cop(self) -> ca.SX:
        """Where the ground's force acts on it, (-M_y, M_x) / F_z (2,) [m]; 0/0 at take-off."""
        return ca.vertcat(-self.moment[1], self.moment[0]) / self.force[2]

    @property
    def spin_torque(self) -> ca.SX:
        """The ground's moment about the vertical through the CoP, F . M / F_z [N m]; 0/0 at take-off."""
        return ca.dot(self.force, self.moment) / self.force[2]


def at(p: Point, mass: float) -> Pendulum:
    """The pendulum at a point; made once."""
    if "pendulum" not in p.memo:
        p.memo["pendulum"] = Pendulum(mass, p.q, p.v, p.a, p.p.gravity)
    return p.memo["pendulum"]


class Flight:
    """The same in flight: what the constants and the inertias say at a point."""

    __slots__ = ("L", "com", "com_velocity", "foot", "inertia", "inertia_rate", "yaw")

    def __init__(self, p: Point):
        c, t = p.c, p.time
        place, self.L = ca.vertcat(c.com_x, c.com_y, c.com_z), ca.vertcat(c.L_x, c.L_y, c.L_z)
        speed, fall = ca.vertcat(c.vel_x, c.vel_y, c.vel_z), ca.vertcat(0, 0, -p.p.gravity)
        self.com, self.com_velocity = place + speed * t + fall * t * t / 2, speed + fall * t
        self.inertia, self.inertia_rate, self.yaw, self.foot = p.q, p.v, p.z[0], p.z[1:]  # foot: unit, from the CoM


def spin(L: ca.SX, inertia: ca.SX) -> ca.SX:
    """omega = L / rho (3,) [rad/s], with the level and the yaw inertia (2,)."""
    return ca.vertcat(L[0] / inertia[0], L[1] / inertia[0], L[2] / inertia[1])


# problem --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Body:
    """Numbers of the robot that the terms need."""

    mass: float  # [kg]
    reach: Reach
    yaw: YawReach

    def range_of(self, phi: ca.SX, margin: float) -> tuple[ca.SX, ca.SX]:
        """Lowest and highest inertias (2,) at leg length ``phi``."""
        fits = (self.reach.inertia_low_fit, self.yaw.low_fit), (self.reach.inertia_high_fit, self.yaw.high_fit)
        low, high = (ca.vertcat(*(ca.polyval(ca.DM(fit), phi) for fit in pair)) for pair in fits)
        return low + margin * (high - low), high - margin * (high - low)

    def usual(self, phi: ca.SX, heel_up: bool) -> ca.SX:
        """Inertias (2,) that postures of this leg length usually have."""
        level = self.reach.usual_toe_fit if heel_up else self.reach.usual_flat_fit
        return ca.vertcat(ca.polyval(ca.DM(level), phi), ca.polyval(ca.DM(self.yaw.usual_fit), phi))


def launch_terms(b: Body, s: SpatialSrmpSettings, heel_up: bool) -> list[Term]:
    """Costs of the launch, SL-J*, and what legs and postures can do."""
    now, reach = partial(at, mass=b.mass), b.reach
    jerk = ca.DM(np.sqrt([s.w_level_jerk] * 2 + [s.w_jerk[1]] + [s.w_jerk[2]] * 3 + [s.w_inertia_jerk_launch] * 2))

    def room(p):
        low, high = b.range_of(now(p).length, s.inertia_margin)
        return ca.vertcat(now(p).inertia - low, high - now(p).inertia)

    def unusual(p):
        return now(p).inertia - b.usual(now(p).length, heel_up)

    def strength(p):
        force, speed = (ca.polyval(ca.DM(fit), now(p).length) for fit in (reach.force_fit, reach.speed_fit))
        fade = (speed - now(p).length_rate) / ((1 - s.corner_speed) * speed)
        return ca.vertcat(force - now(p).force[2], force * fade - now(p).force[2])

    def extension(p):
        return s.speed_share * ca.polyval(ca.DM(reach.speed_fit), now(p).length) - now(p).length_rate

    def turn(p):
        c = now(p).com
        return ca.vertcat(p.q[3] + ca.atan2(c[1], c[2]), p.q[4] - ca.atan2(c[0], c[2]))

    def node(name, equation, unit, of, weight):
        return Term(name, equation, unit, "node", of, weight=weight)

    scale = b.mass * GRAVITY
    return [
        Term("jerk", "SL-J1", "weighted", "mid", lambda p: jerk * p.j, weight=1.0),
        node("CoM velocity", "SL-J2", "m/s", lambda p: now(p).com_velocity, s.w_velocity),
        node("L rate", "SL-J3", "N m", lambda p: now(p).L_rate, s.w_momentum_rate),
        node("turn", "SL-J4: against the leg", "rad", turn, s.w_turn),
        node("usual inertia", "ours: rho(phi)", "kg m^2", lambda p: unusual(p)[0], s.w_usual_inertia),
        node("usual yaw inertia", "ours: rho(phi)", "kg m^2", lambda p: unusual(p)[1], s.w_usual_yaw_inertia),
        limit("inertia envelope", "SL-P4: rho(phi)", "kg m^2", "node", room, 0.0),
        limit("leg force", "SL-B1; ours: from the joint torques", "N", "node", strength, 0.0, scale=scale),
        limit("leg speed", "SL-B1; ours: from the joint speeds", "m/s", "node", extension, 0.0),
    ]


def ground_terms(b: Body, s: SpatialSrmpSettings, heel_up: bool) -> list[Term]:
    """What the ground can do: push, within friction, under flat feet or, heels up, at the toes."""
    now, mg, cop = partial(at, mass=b.mass), b.mass * GRAVITY, b.reach.cop
    low, high = cop[1] - s.toe_band_m if heel_up else cop[0] + s.cop_margin_m, cop[1]
    wide, slack = (1 - 2 * s.foot_share) * b.yaw.half_stance_m, s.toe_slack_n_m if heel_up else 0.0

    def cone(p):
        f = now(p).force
        return s.friction * f[2] - ca.DM(SIGNS) @ f[:2]

    def twist(p):
        # friction that is used up by the horizontal force turns nothing; times F_z, as the CoP
        f, turn = now(p).force, ca.dot(now(p).force, now(p).moment)
        left = b.yaw.half_stance_m * f[2] * cone(p)
        return ca.vertcat(left - turn, left + turn)

    def sole(p):
        f, m = now(p).force, now(p).moment
        return ca.vertcat(slack - m[1] - low * f[2], slack + high * f[2] + m[1], wide * f[2] - m[0], wide * f[2] + m[0])

    def node(name, equation, unit, of, scale):
        return limit(name, equation, unit, "node", of, 0.0, scale=scale, skip=(0, 1))

    return [
        node("unilateral", "ours", "N", lambda p: now(p).force[2], mg),
        node("friction", "ours", "N", cone, mg),
        node("spin torque", "ours: feet twist, times F_z", "N^2 m", twist, 0.1 * mg**2),
        node("CoP", "SL-P2, times F_z", "N m", sole, 0.1 * mg),
        limit("CoP (mid)", "SL-P2, between nodes", "N m", "mid", sole, 0.0, scale=0.1 * mg),
    ]


def squat_terms(b: Body, s: SpatialSrmpSettings) -> list[Term]:
    """Flat feet do not let the CoM sink below what hip and ankle bear, ours."""
    (slope, offset), easy = b.reach.low_com_fit, ca.DM(b.reach.easy_com_fit)

    def deep(p):
        below = ca.polyval(easy, p.q[0]) + s.crouch_room_m - p.q[2]
        return (below + ca.sqrt(below**2 + s.crouch_smoothing_m**2)) / 2

    def height(p):
        return p.q[2] - slope * p.q[0] - offset - s.crouch_room_m

    return [
        Term("crouch depth", "ours: flat feet", "m", "node", deep, weight=s.w_deep_crouch),
        limit("CoM not too low", "ours: flat feet", "m", "node", height, 0.0, scale=0.1),
    ]


def takeoff_terms(b: Body, s: SpatialSrmpSettings) -> list[Term]:
    """The end of the launch, SL-E*: the asked speed, and no wrench."""
    now, mg = partial(at, mass=b.mass), b.mass * GRAVITY
    length = b.reach.length[0], s.takeoff_length * b.reach.start[1]
    return [
        Term("L at take-off", "SL-J3", "kg m^2/s", "end", lambda p: now(p).L, weight=s.w_momentum_end),
        Term("take-off speed", "SL-E2", "m/s", "end", lambda p: p.v[2] - p.p.takeoff_speed),
        Term("force zero", "SL-E3", "N", "end", lambda p: now(p).force, scale=mg),
        Term("L rate zero", "SL-E4, E6", "N m", "end", lambda p: now(p).L_rate, scale=0.1 * mg),
        limit("take-off length", "SL-B1 at the end; ours", "m", "end", lambda p: now(p).length, *length),
        limit("posture range", "SL-P1", "rad", "end", lambda p: p.q[4], *s.posture_end),
    ]


def flight_terms(b: Body, s: SpatialSrmpSettings) -> list[Term]:
    """Costs and constraints of the flight, SF-*: what L and the inertias turn, and where the feet come down."""

    def yaw(left, right, step):
        rates = [w / chain(left.q, left.v, left.a, left.j, x * step)[0][1] for x, w in GAUSS]
        return right.z[0] - left.z[0] - step * left.c.L_z * sum(rates)

    def foot(left, right, step):
        # the implicit midpoint rule turns the unit vector and keeps its length
        omega = spin(Flight(left).L, chain(left.q, left.v, left.a, left.j, step / 2)[0])
        return right.z[1:] - left.z[1:] - step / 2 * ca.cross(omega, left.z[1:] + right.z[1:])

    def goal(p):
        return Flight(p).com + p.c.leg * p.z[1:] - ca.vertcat(p.p.distance, p.p.side, p.p.platform)

    def capture(p):
        c, n = ca.cos(p.p.yaw), ca.sin(p.p.yaw)
        ahead = (p.c.leg * p.z[1:] - s.capture_slope_s * Flight(p).com_velocity)[:2] - s.capture_offset_m * ca.vertcat(
            c, n
        )
        return ca.vertcat(c * ahead[0] + n * ahead[1], c * ahead[1] - n * ahead[0])

    def end(name, equation, unit, of, low, high, **more):
        return limit(name, equation, unit, "end", of, low, high, **more)

    rate, window, usual = s.touchdown_inertia_rate, s.side_window_m, s.touchdown_inertia
    return [
        Term("inertia acceleration", "SF-J1", "kg m^2/s^2", "node", lambda p: p.a, weight=s.w_inertia_accel),
        Term("inertia jerk", "SF-J1", "kg m^2/s^3", "mid", lambda p: p.j, weight=s.w_inertia_jerk),
        Term("yaw", "SF-D1 about the vertical", "rad", "interval", yaw, identity=True),
        Term("rotation", "SF-D1 about level axes", "1", "interval", foot, identity=True),
        end("inertia rate at touchdown", "ours", "kg m^2/s", lambda p: p.v, -rate, rate, scale=10.0),
        end("inertia at touchdown", "ours", "kg m^2", lambda p: p.q - b.usual(p.c.leg, True), *usual),
        Term("touchdown of the feet", "SL-E1: place and height", "m", "end", goal),
        Term("heading at touchdown", "ours: that of the feet", "rad", "end", lambda p: p.z[0] - p.p.yaw),
        end("falling at touchdown", "ours", "m/s", lambda p: Flight(p).com_velocity[2], -np.inf, 0.0),
        end("lean at touchdown", "ours", "1", lambda p: -p.z[3], np.cos(s.touchdown_lean), np.inf),
        end("capture window", "ours; replaces SF-E1", "m", capture, -window, window, scale=0.1),
    ]


def joining_terms(b: Body, s: SpatialSrmpSettings) -> list[Term]:
    """Links of the phases, SF-L*; ``e`` has the ends of each."""

    def continuity(e):
        a, c = e["flat"].end, e["toe"].start
        return ca.vertcat(*((getattr(a, k) - getattr(c, k)) / ca.DM(SCALES[k]) for k in "qva"))

    def takeoff(e):
        a, c = at(e["toe"].end, b.mass), e["flight"].start
        f, scales = Flight(c), [ca.DM(FLIGHT_SCALES[k]) for k in "qva"]
        inertia = (a.inertia - c.q, a.inertia_rate - c.v, a.inertia_accel - c.a)
        links = [a.com - f.com, a.com_velocity - f.com_velocity, (a.L - f.L) / 10, a.attitude[2] - f.yaw]
        links += [a.com + a.length * f.foot, *(x / scale for x, scale in zip(inertia, scales, strict=True))]
        return ca.vertcat(*links)

    def launch_time(e):
        return e["flat"].end.duration + e["toe"].end.duration

    return [
        Term("launch time", "SL-J5", "s", "problem", launch_time, weight=s.w_time),
        Term("flat to toe", "ours: heel up", "scaled", "problem", continuity, identity=True),
        Term("take-off", "SF-L1..L4, Sec. III", "scaled", "problem", takeoff, identity=True),
    ]


def _phases(b: Body, s: SpatialSrmpSettings) -> tuple[Phase, ...]:
    def start(parameters):
        return parameters["start"]

    free, reach = np.inf, b.reach
    low = [-free, -free, 0.0, -s.roll_rad, reach.posture[0], -s.yaw_rad, 0.0, 0.0]
    high = [free, free, free, s.roll_rad, reach.posture[1], s.yaw_rad, free, free]
    box = Bound("state box", "SL-B1, SL-P1", "rad, m", "q", low, high, "inner")
    rest = (
        Bound("start", "SL-P3: the stance", "rad, m", "q", start, start, "start"),
        *(Bound(f"at rest ({k})", "ours", "scaled", k, 0.0, 0.0, "start") for k in "va"),
    )
    flat, tip = (
        (*launch_terms(b, s, up), *ground_terms(b, s, up), *more(b, s))
        for up, more in ((False, squat_terms), (True, takeoff_terms))
    )
    shared = dict(scales=SCALES, view=partial(at, mass=b.mass))
    width, lowest = reach.inertia[1] - reach.inertia[0], np.array([reach.inertia[0], b.yaw.range[0]])
    top = np.array([reach.inertia[0] + s.flight_inertia * width, b.yaw.range[1]])
    share = np.array([1.0, (b.yaw.range[1] - b.yaw.range[0]) / width])
    rates = (("v", "rate", s.inertia_rate * share), ("a", "acceleration", s.inertia_accel * share))
    bounds = (
        Bound("inertia range", "SF-B1", "kg m^2", "q", lowest + s.inertia_margin * width * share, top),
        *(Bound(f"inertia {name} range", "SF-B1", f"of {k}", k, -most, most) for k, name, most in rates),
    )

    def shortest(parameters):
        fold = s.touchdown_fold_per_m * max(0.0, parameters["platform"])
        return (s.touchdown_length[0] - fold) * reach.start[1]

    constants = {f"{k}_{x}": (*r, u) for k, r, u in (("com", s.com_m, 1), ("vel", s.speed_m_s, 1)) for x in "xyz"}
    constants |= {f"L_{x}": (*s.momentum, 10.0) for x in "xyz"}
    constants["leg"] = shortest, s.touchdown_length[1] * reach.start[1], 1.0
    states = ("yaw", "foot_x", "foot_y", "foot_z")
    more = dict(states=states, constants=constants, scales=FLIGHT_SCALES, view=Flight)
    names, n = ("level inertia", "yaw inertia"), s.spatial_intervals
    return (
        Phase("flat", COORDINATES, n[0], s.flat_s, flat, (*rest, box), **shared),
        Phase("toe", COORDINATES, n[1], s.toe_s, tip, (box,), **shared),
        Phase("flight", names, n[2], (0.05, 2.0), tuple(flight_terms(b, s)), bounds, **more),
    )


def build_problem(b: Body, settings: SpatialSrmpSettings = SpatialSrmpSettings()) -> Problem:
    """Stage 1 in three dimensions as one problem over launch and flight."""
    names = ("distance", "side", "yaw", "platform", "takeoff_speed", "gravity")
    joined = tuple(joining_terms(b, settings))
    return Problem("spatial SRMP", _phases(b, settings), joined, {"start": 8, **dict.fromkeys(names, 1)})


# plan -----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class SpatialSrmpStance(SrmpMotion):
    """The launch: vectors have three columns, inertias two, level and about the vertical."""

    yaw: np.ndarray  # (n,) that the body as a whole has turned, the integral of L_z / rho_y [rad]
    L_rate: np.ndarray  # (n, 3) [N m]
    force: np.ndarray  # (n, 3) of the ground [N]
    moment: np.ndarray  # (n, 3) of the ground about the middle between the soles [N m]
    cop: np.ndarray  # (n, 2) [m]
    spin_torque: np.ndarray  # (n,) about the vertical through the CoP [N m]

    @property
    def cop_x(self) -> np.ndarray:
        """CoP ahead of the middle of the soles (n,) [m]."""
        return self.cop[:, 0]


@dataclass(frozen=True)
class SpatialSrmpFlight(SrmpMotion):
    """The flight, likewise; L constant."""

    yaw: np.ndarray  # as in launch
    foot_com: np.ndarray  # (n, 3) middle between the soles relative to the CoM [m]
    foot_com_rate: np.ndarray  # (n, 3) [m/s]
    foot_com_accel: np.ndarray  # (n, 3) [m/s^2]


@dataclass(frozen=True)
class SpatialSrmpPlan(SrmpPlan):
    """Result of stage 1 out of the plane."""

    launch: SpatialSrmpStance
    flight: SpatialSrmpFlight
    body: Body  # what it knew of the robot


class SpatialSrmpPlanner:
    """Stage 1 in three dimensions for one robot: built once, solved for any target that does not turn over.

    ``keep`` keeps what was built for later processes; ``changes`` are own terms, other weights, and terms left out.
    """

    def __init__(
        self,
        robot: Robot,
        settings: SpatialSrmpSettings = SpatialSrmpSettings(),
        *,
        keep: bool = False,
        changes: StageChanges = StageChanges(),
    ):
        self.robot, self.settings, self.changes = robot, settings, changes
        self.body = b = Body(robot.total_mass, reach_of(robot, keep=keep), yaw_reach(robot))
        key = f"{robot.hash} {settings}" if keep else None
        self.nlp = Nlp(changes.applied(build_problem(b, settings)), OPTIONS, key)

    def plan(self, task: JumpTask, *, weights: Mapping[str, float] | None = None) -> SpatialSrmpPlan:
        """Solve for a target.

        Raises
        ------
        InputError
            If the target turns over in the air: this pendulum counts turns about the vertical alone.
        SolverError
            If there is no solution; names the violated terms.
        """
        if task.rotation_rad:
            raise InputError(
                f"rotation = {np.degrees(task.rotation_rad):g} deg: stage 1 in three dimensions has no flips; ask for "
                f"no rotation, or for the method 'direct'"
            )
        weights = self.changes.spread(self.nlp.problem, weights)
        names = dict(distance=task.distance_m, side=task.side_m, yaw=task.yaw_rad, platform=task.platform_m)
        data = dict(start=self.start, takeoff_speed=task.takeoff_speed, gravity=task.gravity, **names)
        return sampled(task, self.nlp.solve(data, self.guess(task), weights=weights), self.body)

    @property
    def start(self) -> np.ndarray:
        """Coordinates (8,) of the stance."""
        lean, length, turn, radius = self.body.reach.start
        level = self.body.mass * radius**2
        return np.array(
            [length * np.sin(lean), 0, length * np.cos(lean), 0, lean + turn, 0, level, self.body.yaw.stance]
        )

    def guess(self, task: JumpTask) -> dict[str, PhaseGuess]:
        """Crouch and rise on a straight line, constant inertias, steady turning."""
        n_flat, n_toe, n = self.settings.spatial_intervals
        t_f, flat_s, toe_s = task.flight_time(min(task.platform_m, 0.9 * task.height_m)), 0.5, 0.12
        share = flat_s / (flat_s + toe_s)
        s = np.concatenate([np.linspace(0, share, n_flat + 1), np.linspace(share, 1, n_toe + 1)])
        q = np.tile(self.start, (len(s), 1))
        length = np.interp(s, [0, 0.75, 1], np.array([1, 0.62, 0.9]) * self.body.reach.start[1])
        speed = 0.8 * np.array([task.distance_m, task.side_m]) / t_f
        lean = 0.45 * np.tanh(speed) * s[:, None] ** 2
        q[:, :2], q[:, 4] = length[:, None] * np.sin(lean), q[:, 4] + 0.3 * s
        q[:, 2], q[:, 5] = np.sqrt(length**2 - np.sum(q[:, :2] ** 2, axis=1)), 0.1 * np.clip(task.yaw_rad, -3, 3) * s**2
        yaw, end = np.linspace(q[-1, 5], task.yaw_rad, n + 1), q[-1]
        constants = {f"com_{x}": v for x, v in zip("xyz", end, strict=False)} | dict(vel_x=speed[0], vel_y=speed[1])
        constants |= dict(vel_z=task.takeoff_speed, leg=0.94 * self.body.reach.start[1], L_x=0.0, L_y=0.0)
        constants["L_z"] = end[7] * (yaw[-1] - yaw[0]) / t_f
        foot = np.tile(-end[:3] / np.linalg.norm(end[:3]), (n + 1, 1))
        still = np.zeros((n + 1, 2))
        parts = {"flat": (flat_s, q[: n_flat + 1]), "toe": (toe_s, q[n_flat + 1 :])}
        return {k: PhaseGuess(t, x, 0 * x, 0 * x) for k, (t, x) in parts.items()} | {
            "flight": PhaseGuess(t_f, still + end[6:], still, still, np.column_stack([yaw, foot]), constants)
        }


# samples --------------------------------------------------------------------------------------------------------
@cache
def _evaluator(mass: float, gravity: float) -> ca.Function:
    q, v, a = (ca.SX.sym(n, 8) for n in "qva")
    s = Pendulum(mass, q, v, a, gravity)
    out = [s.com, s.com_velocity, s.com_acceleration, s.L, s.inertia, s.inertia_rate, s.inertia_accel]
    lean = ca.acos(ca.fmin(s.com[2] / s.length, 1))
    return ca.Function("pendulum", [q, v, a], [*out, ca.vertcat(lean, q[5]), s.L_rate, s.force, s.moment])


def sampled(task: JumpTask, solution: Solution, body: Body) -> SpatialSrmpPlan:
    """Sample a solution on grids that include both ends of launch and flight."""
    flat, toe, flight = (solution.phases[k] for k in ("flat", "toe", "flight"))
    t = grid(flat.duration + toe.duration)
    first = t < flat.duration
    later = np.minimum(t[~first] - flat.duration, toe.duration)
    parts = (np.concatenate(x).T for x in zip(flat.sample(t[first]), toe.sample(later), strict=True))
    columns = [x.full().T for x in _evaluator(body.mass, task.gravity).map(len(t))(*parts)]
    columns[7:8], force, moment = columns[7].T, *columns[-2:]
    up = force[:, 2] > 1.0  # N; at take-off CoP and spin torque are 0/0
    down = np.where(up, force[:, 2], 1.0)
    cop, turn = np.stack([-moment[:, 1], moment[:, 0]], -1) / down[:, None], np.sum(force * moment, axis=1) / down
    cop[~up], turn[~up] = cop[up][-1], 0.0
    launch = SpatialSrmpStance(t, *columns, cop, turn)
    length = float(np.linalg.norm(toe.q[-1, :3]))
    return SpatialSrmpPlan(task, launch, _flown(flight, length, task.gravity), solution, body.reach, body)


def _flown(flight, length: float, gravity: float) -> SpatialSrmpFlight:
    t, c = grid(flight.duration), flight.constants
    rho, rate, accel = flight.sample(t)
    place, speed, L = (np.array([c[f"{k}_{x}"] for x in "xyz"]) for k in ("com", "vel", "L"))
    fall, ones, level = np.array([0.0, 0.0, -gravity]), np.ones((len(t), 1)), [0, 0, 1]
    omega, alpha = L / rho[:, level], -L * rate[:, level] / rho[:, level] ** 2
    nodes = L / flight.q[:, level]
    slopes = [nodes[:, 2], *np.cross(nodes, flight.z[:, 1:]).T]
    z = [cubic(flight.t, x, dx, t) for x, dx in zip(flight.z.T, slopes, strict=True)]
    foot = np.stack(z[1:], -1)
    foot /= np.linalg.norm(foot, axis=1, keepdims=True)
    foot1 = np.cross(omega, foot)
    foot2 = np.cross(alpha, foot) + np.cross(omega, foot1)
    leg, leg1, leg2 = (x[:, None] for x in leg_between(length, c["leg"], t))
    com, time = place + speed * t[:, None] + fall * t[:, None] ** 2 / 2, t[:, None]
    lean = np.arccos(np.minimum(-foot[:, 2], 1.0))
    motion = t, com, speed + fall * time, fall * ones, L * ones, rho, rate, accel, lean, z[0]
    return SpatialSrmpFlight(
        *motion, leg * foot, leg1 * foot + leg * foot1, leg2 * foot + 2 * leg1 * foot1 + leg * foot2
    )
