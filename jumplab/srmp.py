"""Stage 1: momentum, inertia and CoP trajectories of the reaction mass pendulum (Sec. III of the paper).

Launch and flight are one nonlinear program joined at take-off, because nothing in the printed launch problem ties its
final angular momentum to the rotation that the flight needs. The printed sequence is kept in :func:`plan_as_printed`.
Every term carries the paper's equation or says that it is ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from jumplab.models.srmp import COORDINATES, SrmpState
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, reach
from jumplab.solver import Nlp, PhaseGuess, Solution
from jumplab.task import GRAVITY, JumpTask
from jumplab.terms import Bound, Phase, Point, Problem, Term

GAUSS = ((0.5 - np.sqrt(15) / 10, 5 / 18), (0.5, 8 / 18), (0.5 + np.sqrt(15) / 10, 5 / 18))  # three points on [0, 1]


@dataclass(frozen=True)
class SrmpSettings:
    """Weights and bounds of stage 1. The paper prints none; all are our choice, integrated over time where they run."""

    intervals: tuple[int, int, int] = (28, 12, 40)  # flat foot, toe, flight
    friction: float = 0.45  # as in stage 3
    cop_margin_m: float = 0.015  # inside the sole's edges
    flat_s: tuple[float, float] = (0.25, 0.90)  # duration of the flat-foot part of the launch, as in stage 3
    toe_s: tuple[float, float] = (0.08, 0.15)  # duration of its toe part (heel up, CoP at the toe), as in stage 3
    posture_end: tuple[float, float] = (0.2, 0.8)  # trunk at take-off [rad]: leaning into the jump, so it bends first
    speed_share: float = 0.90  # of the extension speed, as in stage 3
    corner_speed: float = 0.5  # share of the extension speed up to which the full leg force is there
    momentum: tuple[float, float] = (-45.0, 45.0)  # box on L [kg m^2/s]: a backflip needs about -35
    inertia_margin: float = 0.05  # share of the envelope's width kept free on either side
    takeoff_lean: tuple[float, float] = (-0.5, 0.7)  # [rad]
    inertia_rate: float = 40.0  # box on d rho/dt [kg m^2/s]: all limbs at half of their speed limits
    inertia_accel: float = 600.0  # box on d^2 rho/dt^2
    touchdown_inertia_rate: float = 8.0  # the limbs come nearly to rest before touchdown
    touchdown_length: tuple[float, float] = (0.80, 0.95)  # share of the standing phi: knees bent to absorb the fall
    capture_offset_m: float = 0.02  # sole centre ahead of the CoM at touchdown, offset + slope v_x, as in stage 3
    capture_slope_s: float = 0.13
    capture_window_m: tuple[float, float] = (-0.03, 0.02)
    w_jerk: tuple[float, float, float, float] = (2e-5, 2e-5, 1e-4, 2e-4)  # SL-J1; the barbell's turn weighs more
    w_posture_end: float = 1.0  # SL-J2
    w_velocity: float = 2.0  # SL-J2
    w_momentum_end: float = 0.01  # SL-J3
    w_momentum_rate: float = 2e-3  # SL-J3
    w_turn: float = 0.5  # SL-J4
    w_time: float = 2.0  # SL-J5
    w_inertia_accel: float = 1e-4  # SF-J1
    w_inertia_jerk: float = 1e-7  # SF-J1


TOE_BAND_M = 0.005  # our choice: the toe part's CoP lies within this distance of the toe edge
SCALES = {"q": 1.0, "v": [5.0, 3.0, 5.0, 2.0], "a": [50.0, 30.0, 50.0, 20.0], "j": [1000.0, 500.0, 1000.0, 500.0]}
FLIGHT_SCALES = {"q": 1.0, "v": 20.0, "a": 200.0, "j": 5000.0}


@dataclass(frozen=True)
class SrmpLaunch:
    """Stage 1's launch on a fixed grid; positions from the pivot, the middle of the sole at its initial place.

    t (n,) [s]; com, com_velocity, com_acceleration (n, 2) [m ...]; L [kg m^2/s]; L_rate [N m]; rho [kg m^2] with rate and
    accel; F_x, F_z [N]; cop_x [m]; lean, posture (theta_l + theta_pl) [rad]; coordinates (n, 4).
    """

    t: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    com_acceleration: np.ndarray
    L: np.ndarray
    L_rate: np.ndarray
    rho: np.ndarray
    rho_rate: np.ndarray
    rho_accel: np.ndarray
    F_x: np.ndarray
    F_z: np.ndarray
    cop_x: np.ndarray
    lean: np.ndarray
    posture: np.ndarray
    coordinates: np.ndarray


@dataclass(frozen=True)
class SrmpFlight:
    """Stage 1's flight on a fixed grid, t from take-off: as :class:`SrmpLaunch`, L constant.

    lean : angle of the line from foot to CoM against the vertical [rad] (theta_l of the flight);
    foot_com : middle of the sole relative to the CoM (n, 2) [m], with rate and acceleration.
    """

    t: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    com_acceleration: np.ndarray
    L: np.ndarray
    rho: np.ndarray
    rho_rate: np.ndarray
    rho_accel: np.ndarray
    lean: np.ndarray
    foot_com: np.ndarray
    foot_com_rate: np.ndarray
    foot_com_accel: np.ndarray


@dataclass(frozen=True)
class SrmpPlan:
    """Result of stage 1: sampled launch and flight, the solution itself, the envelope it was kept in, the target."""

    task: JumpTask
    launch: SrmpLaunch
    flight: SrmpFlight
    solution: Solution
    reach: Reach
    touchdown_length_m: float

    @property
    def launch_s(self) -> float:
        """Duration of the launch [s]."""
        return float(self.launch.t[-1])

    @property
    def toe_s(self) -> float:
        """Duration of the launch's last part, heel up and CoP at the toe [s]."""
        return self.solution.phases["toe"].duration

    @property
    def flight_s(self) -> float:
        """Duration of the flight [s]."""
        return float(self.flight.t[-1])


# the problem -----------------------------------------------------------------------------------------------------
def _state(p: Point, mass: float) -> SrmpState:
    if "srmp" not in p.memo:
        p.memo["srmp"] = SrmpState(mass, p.q, p.v, p.a, p.p.gravity)
    return p.memo["srmp"]


def launch_terms(mass: float, reach: Reach, s: SrmpSettings) -> list[Term]:
    """Costs and constraints all along the launch, SL-* (Sec. III-A)."""

    def at(p):
        return _state(p, mass)

    def inertia_box(p):
        low, high = (ca.polyval(ca.DM(fit), p.q[1]) for fit in (reach.inertia_low_fit, reach.inertia_high_fit))
        margin = s.inertia_margin * (high - low)
        return ca.vertcat(at(p).inertia - low - margin, high - margin - at(p).inertia)

    def cone(p):
        f = at(p).ground_force
        return ca.vertcat(s.friction * f[1] - f[0], s.friction * f[1] + f[0])

    def strength(p):
        """Leg force-velocity line: full force up to a share of the extension speed, none at the speed itself."""
        force, speed = (ca.polyval(ca.DM(fit), p.q[1]) for fit in (reach.force_fit, reach.speed_fit))
        fade = (speed - p.v[1]) / ((1 - s.corner_speed) * speed)
        return ca.vertcat(force - at(p).ground_force[1], force * fade - at(p).ground_force[1])

    def extension(p):
        return s.speed_share * ca.polyval(ca.DM(reach.speed_fit), p.q[1]) - p.v[1]

    mg, inf = mass * GRAVITY, np.inf
    return [
        Term("jerk", "SL-J1", "weighted", "mid", lambda p: ca.DM(np.sqrt(s.w_jerk)) * p.j, weight=1.0),
        Term("CoM velocity", "SL-J2", "m/s", "node", lambda p: at(p).com_velocity, weight=s.w_velocity),
        Term("L rate", "SL-J3", "N m", "node", lambda p: at(p).angular_momentum_rate, weight=s.w_momentum_rate),
        Term("turn", "SL-J4", "rad", "node", lambda p: p.q[2], weight=s.w_turn),
        Term("trunk range", "SL-P1, as path", "rad", "node", lambda p: p.q[0] + p.q[2], lower=reach.posture[0],
             upper=reach.posture[1]),
        Term("inertia envelope", "SL-P4, SL-E5; ours: rho(phi)", "kg m^2", "node", inertia_box, lower=0.0, upper=inf),
        Term("L range", "SL-P5", "kg m^2/s", "node", lambda p: at(p).angular_momentum, lower=s.momentum[0],
             upper=s.momentum[1], scale=10.0),
        Term("unilateral", "ours", "N", "node", lambda p: at(p).ground_force[1], lower=0.0, upper=inf, scale=mg, skip=(0, 1)),
        Term("friction", "ours", "N", "node", cone, lower=0.0, upper=inf, scale=mg, skip=(0, 1)),
        Term("leg force", "SL-B1 on F; ours: from the joint torques", "N", "node", strength, lower=0.0, upper=inf, scale=mg),
        Term("leg speed", "SL-B1; ours: from the joint speeds", "m/s", "node", extension, lower=0.0, upper=inf),
    ]  # fmt: skip


def _cop(mass: float, low: float, high: float) -> Term:
    """SL-P2 multiplied by F_z, so that it holds at take-off too, where the printed quotient is 0/0."""

    def room(p):
        f, torque = _state(p, mass).ground_force, _state(p, mass).pivot_torque
        return ca.vertcat(-torque - low * f[1], high * f[1] + torque)

    return Term("CoP", "SL-P2, times F_z", "N m", "node", room, lower=0.0, upper=np.inf, scale=0.1 * mass * GRAVITY,
                skip=(0, 1))  # fmt: skip


def takeoff_terms(mass: float, s: SrmpSettings) -> list[Term]:
    """Costs and constraints at the end of the launch, SL-J2, J3 and SL-E* (Sec. III-A)."""

    def at(p):
        return _state(p, mass)

    mg, posture = mass * GRAVITY, s.posture_end
    return [
        Term("posture at take-off", "SL-J2", "rad", "end", lambda p: p.q[0] + p.q[2], weight=s.w_posture_end),
        Term("L at take-off", "SL-J3", "kg m^2/s", "end", lambda p: at(p).angular_momentum, weight=s.w_momentum_end),
        Term("take-off speed", "SL-E2", "m/s", "end", lambda p: at(p).com_velocity[1] - p.p.takeoff_speed),
        Term("rod force zero", "SL-E3", "N", "end", lambda p: at(p).rod_force, scale=mg),
        Term("pivot torque zero", "SL-E4", "N m", "end", lambda p: at(p).pivot_torque, scale=0.1 * mg),
        Term("L rate zero", "SL-E6", "N m", "end", lambda p: at(p).angular_momentum_rate, scale=0.1 * mg),
        Term("posture range", "SL-P1", "rad", "end", lambda p: p.q[0] + p.q[2], lower=posture[0], upper=posture[1]),
    ]


def _launch_phases(mass: float, reach: Reach, s: SrmpSettings) -> tuple[Phase, Phase]:
    def start(parameters):
        return parameters["start"]

    low, high = reach.length
    box = Bound("state box", "SL-B1", "rad, m", "q", [s.takeoff_lean[0], low, -2.5, 0.1],
                [s.takeoff_lean[1], high, 2.5, 1.0], "inner")  # fmt: skip
    bounds = (
        Bound("start posture", "SL-P3; ours: the stance", "rad, m", "q", start, start, "start"),
        Bound("at rest", "ours", "1/s", "v", 0.0, 0.0, "start"),
        Bound("at rest (acceleration)", "ours", "1/s^2", "a", 0.0, 0.0, "start"),
        box,
    )
    heel, toe, margin = *reach.cop, s.cop_margin_m
    along = launch_terms(mass, reach, s)
    flat = Phase("flat", COORDINATES, s.intervals[0], s.flat_s, (*along, _cop(mass, heel + margin, toe - margin)), bounds,
                 scales=SCALES)  # fmt: skip
    tip = Phase("toe", COORDINATES, s.intervals[1], s.toe_s,
                (*along, _cop(mass, toe - TOE_BAND_M, toe), *takeoff_terms(mass, s)), (box,), scales=SCALES)  # fmt: skip
    return flat, tip


def flight_terms(s: SrmpSettings) -> list[Term]:
    """Costs and constraints of the flight, SF-* (Sec. III-B); coordinate rho = rho_R + rho_I, state theta."""

    def rotation(left, right, step):
        total = 0
        for share, weight in GAUSS:
            h = share * step
            rho = left.q + h * left.v + h**2 / 2 * left.a + h**3 / 6 * left.j
            total += weight * left.c.L / rho
        return right.z - left.z - step * total

    return [
        Term("inertia acceleration", "SF-J1", "kg m^2/s^2", "node", lambda p: p.a, weight=s.w_inertia_accel),
        Term("inertia jerk", "SF-J1", "kg m^2/s^3", "mid", lambda p: p.j, weight=s.w_inertia_jerk),
        Term("rotation", "SF-D1", "rad", "interval", rotation),
        Term("inertia rate at touchdown", "ours", "kg m^2/s", "end", lambda p: p.v, lower=-s.touchdown_inertia_rate,
             upper=s.touchdown_inertia_rate, scale=10.0),
        Term("touchdown height", "ours: t_f from both CoM heights", "m", "end", _touchdown_height),
    ]  # fmt: skip


def _foot_ahead(p: Point):
    """Sole centre ahead of the CoM at touchdown [m], by the angle theta of the foot-CoM line."""
    return -p.c.leg * ca.sin(p.z[0] - p.p.rotation)


def _touchdown_height(p: Point):
    t = p.duration
    com = p.c.com_z + p.c.vel_z * t - p.p.gravity * t * t / 2
    return com - p.p.platform - p.c.leg * ca.cos(p.z[0] - p.p.rotation)


def _flight_phase(reach: Reach, s: SrmpSettings) -> Phase:
    stance = reach.start[1]
    low, high = reach.inertia
    margin = s.inertia_margin * (high - low)
    bounds = (
        Bound("inertia range", "SF-B1", "kg m^2", "q", low + margin, high - margin),
        Bound("inertia rate range", "SF-B1", "kg m^2/s", "v", -s.inertia_rate, s.inertia_rate),
        Bound("inertia acceleration range", "SF-B1", "kg m^2/s^2", "a", -s.inertia_accel, s.inertia_accel),
    )
    leg = (s.touchdown_length[0] * stance, s.touchdown_length[1] * stance, 1.0)
    constants = {"L": (*s.momentum, 10.0), "com_x": (-1.0, 1.0, 1.0), "com_z": (0.0, 2.0, 1.0), "vel_x": (-5.0, 5.0, 1.0),
                 "vel_z": (0.0, 6.0, 1.0), "leg": leg}  # fmt: skip
    return Phase("flight", ("inertia",), s.intervals[2], (0.05, 2.0), tuple(flight_terms(s)), bounds, states=("theta",),
                 constants=constants, scales=FLIGHT_SCALES)  # fmt: skip


def joining_terms(mass: float, s: SrmpSettings) -> list[Term]:
    """Links at take-off (SF-L1..4), jump length and landing condition over both phases."""

    def continuity(e):
        a, b = e["flat"].end, e["toe"].start
        return ca.vertcat(*((x - y) / ca.DM(scale) for x, y, scale in ((a.q, b.q, 1.0), (a.v, b.v, 5.0), (a.a, b.a, 50.0))))

    def inertia_link(e):
        a, b = _state(e["toe"].end, mass), e["flight"].start
        return ca.vertcat(a.inertia - b.q[0], (a.inertia_rate - b.v[0]) / 20, (a.inertia_accel - b.a[0]) / 200)

    def ballistic(e):
        a, c = _state(e["toe"].end, mass), e["flight"].start.c
        position, velocity = a.com, a.com_velocity
        return ca.vertcat(position - ca.vertcat(c.com_x, c.com_z), velocity - ca.vertcat(c.vel_x, c.vel_z))

    def length(e):
        c, end = e["flight"].start.c, e["flight"].end
        return c.com_x + c.vel_x * end.duration + _foot_ahead(end) - end.p.distance

    def capture(e):
        end = e["flight"].end
        return _foot_ahead(end) - s.capture_offset_m - s.capture_slope_s * end.c.vel_x

    return [
        Term("launch time", "SL-J5", "s", "problem", lambda e: e["flat"].end.duration + e["toe"].end.duration,
             weight=s.w_time),
        Term("flat to toe", "ours: heel up", "scaled", "problem", continuity),
        Term("lean link", "SF-L1", "rad", "problem", lambda e: e["toe"].end.q[0] - e["flight"].start.z[0]),
        Term("inertia link", "SF-L2..L4", "kg m^2 ...", "problem", inertia_link),
        Term("momentum link", "SF-D1: L constant", "kg m^2/s", "problem",
             lambda e: _state(e["toe"].end, mass).angular_momentum - e["flight"].start.c.L, scale=10.0),
        Term("ballistic CoM", "Sec. III", "m, m/s", "problem", ballistic),
        Term("jump length", "SL-E1, foot to foot", "m", "problem", length),
        Term("capture window", "ours; replaces SF-E1", "m", "problem", capture, lower=s.capture_window_m[0],
             upper=s.capture_window_m[1], scale=0.1),
        Term("symmetric landing", "SF-E1 (about the pivot)", "rad", "problem",
             lambda e: e["flight"].end.z[0] + e["toe"].end.q[0] - e["flight"].end.p.rotation),
    ]  # fmt: skip


SYMMETRY_OFF = ("symmetric landing",)  # about the pivot it lands too far ahead (falls); the capture window replaces it
PARAMETERS = dict(start=4, distance=1, platform=1, takeoff_speed=1, rotation=1, gravity=1)


def build_problem(robot: Robot, settings: SrmpSettings = SrmpSettings(), envelope: Reach | None = None) -> Problem:
    """Stage 1 as one problem over launch and flight."""
    envelope, mass = envelope or reach(robot), robot.sagittal.total_mass
    phases = (*_launch_phases(mass, envelope, settings), _flight_phase(envelope, settings))
    return Problem("SRMP", phases, tuple(joining_terms(mass, settings)), dict(PARAMETERS))


# solving ---------------------------------------------------------------------------------------------------------
def parameters(task: JumpTask, envelope: Reach) -> dict:
    """Parameter values of the stage-1 problem for a target."""
    return dict(start=envelope.start, distance=task.distance_m, platform=task.platform_m,
                takeoff_speed=task.takeoff_speed, rotation=task.rotation_rad, gravity=task.gravity)  # fmt: skip


def naive_guess(task: JumpTask, envelope: Reach, settings: SrmpSettings) -> dict[str, PhaseGuess]:
    """Start values that know only the target: crouch and rise on a straight line, constant inertia, steady turning."""
    n_flat, n_toe, n = settings.intervals
    phi0, t_f = envelope.start[1], task.flight_time(min(task.platform_m, 0.9 * task.height_m))
    flat_s, toe_s = 0.6, 0.12  # our choice
    share = flat_s / (flat_s + toe_s)
    s = np.concatenate([np.linspace(0, share, n_flat + 1), np.linspace(share, 1, n_toe + 1)])
    crouch = 0.62 * phi0  # our choice: a knee bend of about a right angle
    length = np.interp(s, [0, 0.65, 1], [phi0, crouch, 0.9 * phi0])
    vel_x = 0.8 * task.distance_m / t_f
    lean = 0.3 * np.tanh(vel_x) * s**2
    radius = np.sqrt(np.clip(envelope.start[3] ** 2 * length / phi0, 0.01, None))
    q = np.stack([lean, length, 0.4 * s, radius], -1)
    rho = envelope.mass * radius[-1] ** 2
    spin = (task.rotation_rad - 2 * lean[-1]) / t_f
    flight = PhaseGuess(t_f, np.full((n + 1, 1), rho), np.zeros((n + 1, 1)), np.zeros((n + 1, 1)),
                        (lean[-1] + spin * t_f * np.linspace(0, 1, n + 1))[:, None],
                        dict(L=rho * spin, com_x=length[-1] * np.sin(lean[-1]), com_z=length[-1] * np.cos(lean[-1]),
                             vel_x=vel_x, vel_z=task.takeoff_speed, leg=0.88 * phi0))  # fmt: skip
    flat, toe = q[: n_flat + 1], q[n_flat + 1 :]
    return {"flat": PhaseGuess(flat_s, flat, flat * 0, flat * 0), "toe": PhaseGuess(toe_s, toe, toe * 0, toe * 0),
            "flight": flight}  # fmt: skip


class SrmpPlanner:
    """Stage 1 for one robot: built once, solved for any target."""

    def __init__(self, robot: Robot, settings: SrmpSettings = SrmpSettings(), options: dict | None = None):
        self.robot, self.settings, self.reach = robot, settings, reach(robot)
        self.nlp = Nlp(build_problem(robot, settings, self.reach), options)

    def plan(self, task: JumpTask, *, guess=None, weights=None, off: tuple[str, ...] = SYMMETRY_OFF) -> SrmpPlan:
        """Solve for a target; raises :class:`SolverError` with the violated terms if there is no solution."""
        guess = guess or naive_guess(task, self.reach, self.settings)
        solution = self.nlp.solve(parameters(task, self.reach), guess, weights=weights, off=off)
        return sample_plan(task, solution, self.reach, self.robot.sagittal.total_mass)


# sampling --------------------------------------------------------------------------------------------------------
def sample_plan(task: JumpTask, solution: Solution, envelope: Reach, mass: float, step_s: float = 0.005) -> SrmpPlan:
    """Sample a stage-1 solution on grids of about ``step_s`` that include both ends of both phases."""
    flat, toe, flight = (solution.phases[k] for k in ("flat", "toe", "flight"))
    launch_s = flat.duration + toe.duration
    t = np.linspace(0, launch_s, int(np.ceil(launch_s / step_s)) + 1)
    quantities = _launch_function(mass, task.gravity).map(len(t))
    first = t < flat.duration
    later = np.minimum(t[~first] - flat.duration, toe.duration)
    q, v, a = (np.concatenate(pair) for pair in zip(flat.sample(t[first]), toe.sample(later), strict=True))
    out = [x.full().T.squeeze() for x in quantities(q.T, v.T, a.T)]
    com, com_v, com_a, momentum, rate, rho, rho_v, rho_a, force, torque = out
    up = force[:, 1] > 1.0  # N; at take-off the CoP is 0/0
    cop = np.where(up, -torque / np.where(up, force[:, 1], 1.0), np.nan)
    cop[~up] = cop[up][-1]
    launched = SrmpLaunch(t, com, com_v, com_a, momentum, rate, rho, rho_v, rho_a, force[:, 0], force[:, 1], cop,
                          q[:, 0], q[:, 0] + q[:, 2], q)  # fmt: skip
    return SrmpPlan(task, launched, _sample_flight(task, flight, toe.q[-1, 1], step_s), solution, envelope,
                    flight.constants["leg"])  # fmt: skip


def _launch_function(mass, gravity):
    q, v, a = (ca.SX.sym(n, 4) for n in "qva")
    s = SrmpState(mass, q, v, a, gravity)
    return ca.Function("srmp", [q, v, a], [s.com, s.com_velocity, s.com_acceleration, s.angular_momentum,
                                           s.angular_momentum_rate, s.inertia, s.inertia_rate, s.inertia_accel,
                                           s.ground_force, s.pivot_torque])  # fmt: skip


def _sample_flight(task, flight, takeoff_length, step_s) -> SrmpFlight:
    t = np.linspace(0, flight.duration, int(np.ceil(flight.duration / step_s)) + 1)
    rho, rho_v, rho_a = (x[:, 0] for x in flight.sample(t))
    c, ones = flight.constants, np.ones_like(t)
    nodes = flight.t
    # theta between nodes: the cubic through the node values with the exact rates L / rho
    theta = CubicHermiteSpline(nodes, flight.z[:, 0], c["L"] / flight.q[:, 0])(t)
    rate, accel = c["L"] / rho, -c["L"] * rho_v / rho**2
    # leg length from take-off to touchdown: smooth, only the ends matter (the rod has no mass)
    s = t / flight.duration
    blend, blend1, blend2 = (10 * s**3 - 15 * s**4 + 6 * s**5, (30 * s**2 - 60 * s**3 + 30 * s**4) / flight.duration,
                             (60 * s - 180 * s**2 + 120 * s**3) / flight.duration**2)  # fmt: skip
    d = c["leg"] - takeoff_length
    leg, leg1, leg2 = takeoff_length + d * blend, d * blend1, d * blend2
    along = -np.stack([np.sin(theta), np.cos(theta)], -1)
    across = np.stack([along[:, 1], -along[:, 0]], -1)
    foot = leg[:, None] * along
    foot_v = leg1[:, None] * along + (leg * rate)[:, None] * across
    foot_a = (leg2 - leg * rate**2)[:, None] * along + (leg * accel + 2 * leg1 * rate)[:, None] * across
    com = np.stack([c["com_x"] + c["vel_x"] * t, c["com_z"] + c["vel_z"] * t - task.gravity * t**2 / 2], -1)
    com_v = np.stack([c["vel_x"] * ones, c["vel_z"] - task.gravity * t], -1)
    com_a = np.stack([0 * ones, -task.gravity * ones], -1)
    return SrmpFlight(t, com, com_v, com_a, c["L"] * ones, rho, rho_v, rho_a, theta, foot, foot_v, foot_a)
