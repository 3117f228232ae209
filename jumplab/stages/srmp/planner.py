"""Solving stage 1 for a target, and sampling the solution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from jumplab.errors import Shown, SolverError
from jumplab.models.srmp import SrmpState
from jumplab.ocp import Nlp, PhaseGuess, PhaseSolution, Solution
from jumplab.ocp.cache import remembered
from jumplab.ocp.nlp import WARM
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, reach, shipped_reach
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp.problem import SYMMETRY_OFF, build_problem
from jumplab.stages.srmp.reachable import check_reachable
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.task import JumpTask


# plan ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class SrmpMotion:
    """Columns that all parts of a jump have; positions from the middle of the sole where it stands or took off."""

    t: np.ndarray  # (n,) since this part began [s]
    com: np.ndarray  # (n, 2) x and z [m]
    com_velocity: np.ndarray  # (n, 2) [m/s]
    com_acceleration: np.ndarray  # (n, 2) [m/s^2]
    L: np.ndarray  # (n,) [kg m^2/s]
    rho: np.ndarray  # (n,) [kg m^2]
    rho_rate: np.ndarray  # (n,) [kg m^2/s]
    rho_accel: np.ndarray  # (n,) [kg m^2/s^2]
    lean: np.ndarray  # (n,) angle of the line from the sole to the CoM against the vertical, theta_l [rad]

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
    foot_com_accel: np.ndarray  # (n, 2) [m/s^2]


@dataclass(frozen=True, repr=False)
class SrmpPlan(Shown):
    """Result of stage 1: sampled launch and flight, the solution itself, the envelope it was kept in, the target."""

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


# planner ------------------------------------------------------------------------------------------
SAMPLE_S = 0.005  # a hundred samples and more over each part
OPTIONS = {  # of ipopt
    "neg_curv_test_tol": 1e-12,  # adds to an indefinite Hessian only if the step itself meets negative curvature
    "bound_mult_init_method": "mu-based",  # first multipliers of limits that fit the barrier
    "mu_init": 0.01,
    "mu_min": 1e-6,  # a hundredth of the tolerances
    "tol": 1e-4,  # as in stage 3; the rows' own tolerance stays
    "compl_inf_tol": 1e-5,
}


def parameters(task: JumpTask, envelope: Reach, start: np.ndarray | None = None) -> dict:
    """Parameter values of the stage-1 problem for a target; ``start`` (4,) instead of the stance."""
    return dict(
        start=envelope.start if start is None else start,
        distance=task.distance_m,
        platform=task.platform_m,
        takeoff_speed=task.takeoff_speed,
        rotation=task.rotation_rad,
        gravity=task.gravity,
    )


def naive_guess(task: JumpTask, envelope: Reach, settings: SrmpSettings) -> dict[str, PhaseGuess]:
    """Start values that know only the target: crouch and rise on a straight line, constant inertia, steady turning."""
    n_flat, n_toe, n = settings.intervals
    phi0, t_f = envelope.start[1], task.flight_time(min(task.platform_m, 0.9 * task.height_m))
    # durations [s], time of the crouch and lean [rad] with the fewest iterations at the hardest targets
    flat_s, toe_s, bottom, reach_rad = 0.5, 0.12, 0.75, 0.45
    share = flat_s / (flat_s + toe_s)
    s = np.concatenate([np.linspace(0, share, n_flat + 1), np.linspace(share, 1, n_toe + 1)])
    crouch = 0.62 * phi0  # a knee bend of about a right angle
    length = np.interp(s, [0, bottom, 1], [phi0, crouch, 0.9 * phi0])
    vel_x = 0.8 * task.distance_m / t_f
    lean = reach_rad * np.tanh(vel_x) * s**2
    radius = np.sqrt(np.clip(envelope.start[3] ** 2 * length / phi0, 0.01, None))
    q = np.stack([lean, length, 0.4 * s, radius], -1)
    flat, toe = q[: n_flat + 1], q[n_flat + 1 :]
    rho = envelope.mass * radius[-1] ** 2
    spin = (task.rotation_rad - 2 * lean[-1]) / t_f
    com_x, com_z = length[-1] * np.sin(lean[-1]), length[-1] * np.cos(lean[-1])
    constants = dict(L=rho * spin, com_x=com_x, com_z=com_z, vel_x=vel_x, vel_z=task.takeoff_speed, leg=0.94 * phi0)
    theta = (lean[-1] + spin * t_f * np.linspace(0, 1, n + 1))[:, None]
    return {
        "flat": PhaseGuess(flat_s, flat, flat * 0, flat * 0),
        "toe": PhaseGuess(toe_s, toe, toe * 0, toe * 0),
        "flight": PhaseGuess(t_f, np.full_like(theta, rho), theta * 0, theta * 0, theta, constants),
    }


def reach_of(robot: Robot, *, keep: bool = False) -> Reach:
    """What the robot can do, see :func:`jumplab.robot.reach.reach`: from the file shipped with it, else sampled.

    With ``keep``, what was sampled is left for later processes.
    """
    if (known := shipped_reach(robot)) is not None or not keep:
        return known or reach(robot)
    return Reach.from_json(remembered("reach", robot.hash, lambda: reach(robot).to_json()))


class SrmpPlanner:
    """Stage 1 for one robot: built once, solved for any target.

    ``keep`` keeps what was built for later processes; ``changes`` are own terms, other weights, and terms left out.
    """

    def __init__(
        self,
        robot: Robot,
        settings: SrmpSettings = SrmpSettings(),
        *,
        keep: bool = False,
        changes: StageChanges = StageChanges(),
    ):
        self.robot, self.settings, self.changes = robot, settings, changes
        self.reach = reach_of(robot, keep=keep)
        key = f"{robot.hash} {settings}" if keep else None
        self.nlp = Nlp(changes.applied(build_problem(robot, settings, self.reach)), OPTIONS, key)
        self._warm = self.nlp.with_options(WARM | OPTIONS)

    def plan(
        self,
        task: JumpTask,
        *,
        guess: dict[str, PhaseGuess] | None = None,
        weights: Mapping[str, float] | None = None,
        off: tuple[str, ...] = SYMMETRY_OFF,
        near: SrmpPlan | None = None,
        start: np.ndarray | None = None,
    ) -> SrmpPlan:
        """Solve for a target; ``near`` is a plan for one close by to begin with, if that works.

        ``start`` is the rod (4,) that the jump begins with, at rest, see :func:`jumplab.robot.reach.rod_of`; that of
        the stance if None.

        Raises
        ------
        InfeasibleError
            Before solving, if closed forms already say that the robot cannot do it.
        SolverError
            If there is no solution; names the violated terms.
        """
        check_reachable(task, self.reach, self.robot, self.settings)
        if near is not None:
            try:
                return self._solve(task, near.solution.guess(), weights, off, False, near.solution.multipliers, start)
            except SolverError:
                pass  # as if there had been none
        return self._solve(task, guess, weights, off, start=start)

    def _solve(self, task: JumpTask, guess, weights, off, explain=True, multipliers=None, start=None) -> SrmpPlan:
        guess = guess or naive_guess(task, self.reach, self.settings)
        weights, off = self.changes.spread(self.nlp.problem, weights), self.changes.still_there(self.nlp.problem, off)
        nlp, data = self.nlp if multipliers is None else self._warm, parameters(task, self.reach, start)
        solution = nlp.solve(data, guess, weights=weights, off=off, explain=explain, multipliers=multipliers)
        return sample_plan(task, solution, self.reach, self.robot.sagittal.total_mass)


# samples ------------------------------------------------------------------------------------------
def sample_plan(task: JumpTask, solution: Solution, envelope: Reach, mass: float) -> SrmpPlan:
    """Sample a stage-1 solution on grids that include both ends of both parts."""
    flat, toe, flight = (solution.phases[k] for k in ("flat", "toe", "flight"))
    t = grid(flat.duration + toe.duration)
    first = t < flat.duration
    later = np.minimum(t[~first] - flat.duration, toe.duration)
    q, v, a = (np.concatenate(pair) for pair in zip(flat.sample(t[first]), toe.sample(later), strict=True))
    launch = SrmpStance(*on_ground(mass, task.gravity, t, q, v, a))
    return SrmpPlan(task, launch, _sample_flight(flight, toe.q[-1, 1], task.gravity), solution, envelope)


def grid(duration: float) -> np.ndarray:
    """Times [s] at most :data:`SAMPLE_S` apart, both ends included."""
    return np.linspace(0, duration, int(np.ceil(duration / SAMPLE_S)) + 1)


@cache
def _pendulum(mass: float, gravity: float) -> ca.Function:
    q, v, a = (ca.SX.sym(n, 4) for n in "qva")
    s = SrmpState(mass, q, v, a, gravity)
    out = [s.com, s.com_velocity, s.com_acceleration, s.angular_momentum, s.angular_momentum_rate]
    out += [s.inertia, s.inertia_rate, s.inertia_accel, s.ground_force, s.pivot_torque]
    return ca.Function("srmp", [q, v, a], out)


def on_ground(mass: float, gravity: float, t: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple:
    """Columns of a :class:`SrmpStance` from times (n,) and coordinates with their rates (n, 4)."""
    out = [x.full().T.squeeze() for x in _pendulum(mass, gravity).map(len(t))(q.T, v.T, a.T)]
    com, com_v, com_a, momentum, rate, rho, rho_v, rho_a, force, torque = out
    up = force[:, 1] > 1.0  # N; at take-off the CoP is 0/0
    cop = np.where(up, -torque / np.where(up, force[:, 1], 1.0), np.nan)
    cop[~up] = cop[up][-1]
    motion = t, com, com_v, com_a, momentum, rho, rho_v, rho_a, q[:, 0]
    return *motion, rate, *force.T, cop, q[:, 0] + q[:, 2], q


def _sample_flight(flight: PhaseSolution, takeoff_length: float, gravity: float) -> SrmpFlight:
    t = grid(flight.duration)
    rho, rho_v, rho_a = (x[:, 0] for x in flight.sample(t))
    c, ones = flight.constants, np.ones_like(t)
    # theta between nodes: the cubic through the node values with the exact rates L / rho
    theta = _cubic(flight.t, flight.z[:, 0], c["L"] / flight.q[:, 0], t)
    rate, accel = c["L"] / rho, -c["L"] * rho_v / rho**2
    leg, leg1, leg2 = _leg_between(takeoff_length, c["leg"], t)
    along = -np.stack([np.sin(theta), np.cos(theta)], -1)
    across = np.stack([along[:, 1], -along[:, 0]], -1)
    foot = leg[:, None] * along
    foot_v = leg1[:, None] * along + (leg * rate)[:, None] * across
    foot_a = (leg2 - leg * rate**2)[:, None] * along + (leg * accel + 2 * leg1 * rate)[:, None] * across
    com = np.stack([c["com_x"] + c["vel_x"] * t, c["com_z"] + c["vel_z"] * t - gravity * t**2 / 2], -1)
    com_v = np.stack([c["vel_x"] * ones, c["vel_z"] - gravity * t], -1)
    com_a = np.stack([0 * ones, -gravity * ones], -1)
    return SrmpFlight(t, com, com_v, com_a, c["L"] * ones, rho, rho_v, rho_a, theta, foot, foot_v, foot_a)


def _leg_between(first: float, last: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Leg length from take-off to touchdown with two derivatives: smooth, only the ends matter, the rod has no mass."""
    s, d = t / t[-1], last - first
    leg = first + d * (10 * s**3 - 15 * s**4 + 6 * s**5)
    leg1 = d * ((30 * s**2 - 60 * s**3 + 30 * s**4) / t[-1])
    return leg, leg1, d * ((60 * s - 180 * s**2 + 120 * s**3) / t[-1] ** 2)


def _cubic(nodes: np.ndarray, values: np.ndarray, rates: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The cubic pieces through values and rates at nodes, at times ``t``."""
    k = np.clip(np.searchsorted(nodes, t, side="right") - 1, 0, len(nodes) - 2)
    h = nodes[k + 1] - nodes[k]
    s = (t - nodes[k]) / h
    rise = values[k + 1] - values[k]
    first, last = h * rates[k], h * rates[k + 1]
    return values[k] + s * (first + s * (3 * rise - 2 * first - last + s * (first + last - 2 * rise)))
