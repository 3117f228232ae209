"""Solving stage 1 for a target, and sampling the solution."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import casadi as ca
import numpy as np

from jumplab.errors import Shown, SolverError
from jumplab.models.srmp import SrmpState
from jumplab.ocp import Nlp, PhaseGuess, PhaseSolution, Solution
from jumplab.ocp.cache import in_turn
from jumplab.ocp.nlp import WARM
from jumplab.ocp.solution import quintic
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, reach
from jumplab.robot.sagittal import in_xz
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp.problem import build_problem
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.task import JumpTask


# plan ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class SrmpMotion:
    """Columns that all parts of a jump have; positions from the middle of the sole where it stands
    or took off.
    """

    t: np.ndarray  # (n,) since this part began [s]
    com: np.ndarray  # (n, 2) x and z [m]
    com_velocity: np.ndarray  # (n, 2) [m/s]
    com_acceleration: np.ndarray  # (n, 2) [m/s^2]
    L: np.ndarray  # (n,) [kg m^2/s]
    rho: np.ndarray  # (n,) [kg m^2]
    rho_rate: np.ndarray  # (n,) [kg m^2/s]
    rho_accel: np.ndarray  # (n,) [kg m^2/s^2]
    # (n,) angle of the line from the sole to the CoM against the vertical, theta_l [rad]
    lean: np.ndarray

    @property
    def duration_s(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.t[-1])


@dataclass(frozen=True)
class SrmpStance(SrmpMotion):
    """Launch or landing, on the ground."""

    L_rate: np.ndarray  # (n,) [N m]
    F_x: np.ndarray  # (n,) [N]
    F_z: np.ndarray  # (n,) [N]
    cop_x: np.ndarray  # (n,) [m]
    posture: np.ndarray  # (n,) theta_l + theta_pl [rad]
    coordinates: np.ndarray  # (n, 4)


@dataclass(frozen=True)
class SrmpFlight(SrmpMotion):
    """Stage 1's flight, L constant."""

    foot_com: np.ndarray  # (n, 2) middle of the sole relative to the CoM [m]
    foot_com_rate: np.ndarray  # (n, 2) [m/s]


@dataclass(frozen=True, repr=False)
class SrmpPlan(Shown):
    """Result of stage 1: sampled launch and flight, the solution itself, the envelope it was kept
    in, the target.
    """

    task: JumpTask
    launch: SrmpStance
    flight: SrmpFlight
    solution: Solution
    reach: Reach

    @property
    def launch_s(self) -> float:
        """Duration of the launch [s]."""
        return self.launch.duration_s

    @property
    def toe_s(self) -> float:
        """Duration of the launch's last part, heel up and CoP at the toe [s]."""
        return self.solution.phases["toe"].duration

    @property
    def flight_s(self) -> float:
        """Duration of the flight [s]."""
        return self.flight.duration_s

    def at(self, launch_t: np.ndarray, flight_t: np.ndarray) -> SrmpPlan:
        """The same plan at other times (n,) since launch and flight began [s]."""
        return sample_plan(self.task, self.solution, self.reach, launch_t, flight_t)


# planner ------------------------------------------------------------------------------------------
SAMPLE_S = 0.005  # a hundred samples and more over each part
OPTIONS = {  # of ipopt
    # adds to an indefinite Hessian only if the step itself meets negative curvature
    "neg_curv_test_tol": 1e-12,
    "bound_mult_init_method": "mu-based",  # first multipliers of limits that fit the barrier
    "mu_init": 0.01,
    "mu_min": 1e-6,  # a hundredth of the tolerances
    "tol": 1e-4,  # as in stage 3; the rows' own tolerance stays
    "compl_inf_tol": 1e-5,
}


def parameters(task: JumpTask, envelope: Reach, start: np.ndarray | None = None) -> dict:
    """Parameters of stage 1's problem for a target; ``start`` (4,) instead of the stance."""
    return dict(
        start=envelope.start if start is None else start,
        distance=task.distance_m,
        platform=task.platform_m,
        takeoff_speed=task.takeoff_speed,
        rotation=task.rotation_rad,
        gravity=task.gravity,
    )


def naive_guess(task: JumpTask, envelope: Reach, settings: SrmpSettings) -> dict[str, PhaseGuess]:
    """Start values that know only the target: the stance, which leans over, then a flight with its
    inertia, steadily turning.
    """
    n_flat, n_toe, n = settings.intervals
    _, length, _, radius = envelope.start
    flight_s = task.flight_time(min(task.platform_m, 0.9 * task.height_m))
    vel_x = 0.8 * task.distance_m / flight_s
    lean = 0.45 * np.tanh(vel_x)  # [rad] at take-off, and as far back at touchdown
    spin = (task.rotation_rad - 2 * lean) / flight_s
    rho = envelope.mass * radius**2
    constants = dict(
        L=rho * spin,
        com_x=length * np.sin(lean),
        com_z=0.9 * length,
        vel_x=vel_x,
        vel_z=task.takeoff_speed,
        leg=0.94 * length,
    )

    def leaning(duration, first, last, intervals):
        q = np.tile(envelope.start, (intervals + 1, 1))
        q[:, 0] += lean * np.linspace(first, last, intervals + 1) ** 2
        return PhaseGuess(duration, q, 0 * q, 0 * q)

    theta = lean + spin * flight_s * np.linspace(0.0, 1.0, n + 1)[:, None]
    return {
        "flat": leaning(0.5, 0.0, 0.8, n_flat),
        "toe": leaning(0.12, 0.8, 1.0, n_toe),
        "flight": PhaseGuess(
            flight_s, np.full_like(theta, rho), 0 * theta, 0 * theta, theta, constants
        ),
    }


class SrmpPlanner:
    """Stage 1 for one robot: built once, solved for any target.

    ``keep`` keeps what was built for later processes; ``changes`` are own terms, other weights, and
    terms left out.
    """

    @in_turn
    def __init__(
        self,
        robot: Robot,
        settings: SrmpSettings = SrmpSettings(),
        *,
        keep: bool = False,
        changes: StageChanges = StageChanges(),
    ):
        self.robot = robot
        self.settings = settings
        self.changes = changes
        self.reach = reach(robot)
        key = f"{robot.hash} {settings}" if keep else None
        self.nlp = Nlp(changes.applied(build_problem(robot, settings, self.reach)), OPTIONS, key)
        self._warm = self.nlp.with_options(WARM | OPTIONS)

    @in_turn
    def plan(
        self,
        task: JumpTask,
        *,
        weights: Mapping[str, float] = MappingProxyType({}),
        near: SrmpPlan | None = None,
        start: np.ndarray | None = None,
    ) -> SrmpPlan:
        """Solve for a target; ``near`` is a plan for one close by to begin with, if that works.

        ``start`` is the rod (4,) that the jump begins with, at rest, see
        :func:`jumplab.robot.reach.rod_of`; that of the stance if None.

        Raises
        ------
        SolverError
            If there is no solution; names the violated terms.
        """
        data = parameters(task, self.reach, start)
        weights = self.changes.spread(self.nlp.problem, weights)
        if near is not None:
            options = dict(weights=weights, multipliers=near.solution.multipliers, explain=False)
            with suppress(SolverError):  # as if there had been none
                solution = self._warm.solve(data, near.solution.guess(), **options)
                return sample_plan(task, solution, self.reach)
        guess = naive_guess(task, self.reach, self.settings)
        return sample_plan(task, self.nlp.solve(data, guess, weights=weights), self.reach)


# samples ------------------------------------------------------------------------------------------
def sample_plan(
    task: JumpTask,
    solution: Solution,
    envelope: Reach,
    launch_t: np.ndarray | None = None,
    flight_t: np.ndarray | None = None,
) -> SrmpPlan:
    """Sample a stage-1 solution at times (n,) since launch and flight began [s], by default on
    grids that include both ends.
    """
    flat, toe, flight = solution.phases.values()
    t = grid(flat.duration + toe.duration) if launch_t is None else launch_t
    first = t < flat.duration
    later = np.minimum(t[~first] - flat.duration, toe.duration)
    motion = np.concatenate([flat.sample(t[first]), toe.sample(later)], axis=1)
    launch = SrmpStance(*on_ground(envelope.mass, task.gravity, t, *motion))
    t = grid(flight.duration) if flight_t is None else flight_t
    flown = _sample_flight(flight, toe.q[-1, 1], task.gravity, t)
    return SrmpPlan(task, launch, flown, solution, envelope)


def grid(duration: float) -> np.ndarray:
    """Times [s] at most :data:`SAMPLE_S` apart, both ends included."""
    return np.linspace(0, duration, int(np.ceil(duration / SAMPLE_S)) + 1)


@cache
def _pendulum(mass: float, gravity: float) -> ca.Function:
    q, v, a = (ca.SX.sym(n, 4) for n in "qva")
    s = SrmpState(mass, q, v, a, gravity)
    out = [s.com, s.com_velocity, s.com_acceleration, s.L, s.L_rate]
    out += [s.inertia, s.inertia_rate, s.inertia_accel, s.ground_force, s.pivot_torque]
    return ca.Function("srmp", [q, v, a], out)


def on_ground(
    mass: float, gravity: float, t: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple:
    """Columns of a :class:`SrmpStance` from times (n,) and coordinates with their rates (n, 4)."""
    out = [x.full().T.squeeze() for x in _pendulum(mass, gravity).map(len(t))(q.T, v.T, a.T)]
    com, com_v, com_a, momentum, rate, rho, rho_v, rho_a, force, torque = out
    up = force[:, 1] > 1.0  # N; at take-off the CoP is 0/0
    cop = np.where(up, -torque / np.where(up, force[:, 1], 1.0), np.nan)
    cop[~up] = cop[up][-1]
    motion = t, com, com_v, com_a, momentum, rho, rho_v, rho_a, q[:, 0]
    return *motion, rate, *force.T, cop, q[:, 0] + q[:, 2], q


def _sample_flight(
    flight: PhaseSolution, takeoff_length: float, gravity: float, t: np.ndarray
) -> SrmpFlight:
    from scipy.interpolate import CubicHermiteSpline  # slow to import

    rho, rho_v, rho_a = (x[:, 0] for x in flight.sample(t))
    c = flight.constants
    # theta between nodes: the cubic through the node values with the exact rates L / rho
    theta = CubicHermiteSpline(flight.t, flight.z[:, 0], c["L"] / flight.q[:, 0])(t)
    # only the ends of the leg's length matter, the rod has no mass
    ends = [(takeoff_length, c["leg"]), (0.0, 0.0), (0.0, 0.0)]
    leg, leg_rate, _ = quintic(ends, flight.duration, t)
    way = -1j * np.exp(-1j * theta)  # from CoM to foot, x + iz
    fall = np.array([0.0, -gravity])
    velocity = np.array([c["vel_x"], c["vel_z"]])
    time = t[:, None]
    com = np.array([c["com_x"], c["com_z"]]) + velocity * time + fall * time**2 / 2
    motion = com, velocity + fall * time, np.broadcast_to(fall, com.shape), np.full_like(t, c["L"])
    foot = in_xz(leg * way), in_xz((leg_rate - 1j * leg * c["L"] / rho) * way)
    return SrmpFlight(t, *motion, rho, rho_v, rho_a, theta, *foot)
