"""Stage 1's landing: CoM and angular momentum from touchdown to standing (LD-*, Sec. III and VI-A of the paper).

The paper takes its landing trajectory from an earlier work and does not repeat it. This one is ours, on the same
reaction mass pendulum and with the same terms as the launch: CoP inside the sole, friction, unilateral force, leg force
and inertia envelope of the robot, smooth, of free duration. It begins right after the impact (see
:mod:`jumplab.srmp.touchdown`) and ends at rest in the stance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pinocchio as pin
from scipy.optimize import root

from jumplab.errors import InfeasibleError, SolverError
from jumplab.models.srmp import COORDINATES
from jumplab.ocp import Nlp, PhaseGuess, PhaseSolution, Statistics
from jumplab.ocp.problem import Bound, Phase, Point, Problem, Term
from jumplab.robot import Robot
from jumplab.robot.reach import FORCE_SHARE, Reach, reach
from jumplab.robot.stance import com_from_toe, configuration
from jumplab.stages.srmp.planner import SrmpPlan, launch_function
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.srmp.terms import cop_terms, launch_terms, srmp_state
from jumplab.task import GRAVITY

# touchdown ------------------------------------------------------------------------------------------
TRUNK_RAD = 0.15  # our choice: middle of what stage 3 allows at touchdown
KNEE_GUESS_RAD = 1.0  # our choice: start of the search, likewise
POSTURE_TOLERANCE_M = 1e-6  # our choice: far below anything that matters for an impact


@dataclass(frozen=True)
class Touchdown:
    """Whole-body quantities at the start of a landing, sagittal plane.

    Attributes
    ----------
    com, com_velocity : (2,) x and z from the middle between the soles [m, m/s].
    L : angular momentum about the CoM, about +y [kg m^2/s].
    rho : pitch inertia about the CoM [kg m^2].
    trunk_pitch : [rad].
    """

    com: np.ndarray
    com_velocity: np.ndarray
    L: float
    rho: float
    trunk_pitch: float = TRUNK_RAD


def touchdown_of_plan(plan: SrmpPlan, robot: Robot, *, impact: bool = True) -> Touchdown:
    """Touchdown of a stage-1 plan.

    Stage 1 has no posture, so for the impact the legs are bent until the CoM is where the plan has it, feet flat, trunk
    and arms as usual at touchdown; the whole body moves as one with the plan's velocity and angular momentum.

    Parameters
    ----------
    impact : False keeps the velocities of the flight.

    Raises
    ------
    InfeasibleError
        If the legs cannot put the CoM there.
    """
    flight = plan.flight
    com, velocity, momentum, rho = -flight.foot_com[-1], flight.com_velocity[-1], flight.L[-1], float(flight.rho[-1])
    if impact:
        angles = _posture(robot, com)
        q = configuration(robot, angles, toe=-robot.sagittal.sole_center)
        velocity, momentum = _after_impact(robot, q, _rigid_motion(robot, q, velocity, momentum))
    return Touchdown(com, velocity, float(momentum), rho)


def touchdown_of_state(robot: Robot, q: np.ndarray, v: np.ndarray, *, impact: bool = True) -> Touchdown:
    """Touchdown from a state of the full robot, planned or measured.

    Parameters
    ----------
    q, v : (nq,), (nv,) in Pinocchio's conventions.
    impact : True if the soles still move; they are stopped.
    """
    model, data = robot.model, robot.model.createData()
    pin.ccrba(model, data, q, v)
    pin.framesForwardKinematics(model, data, q)
    sole = np.mean([data.oMf[model.getFrameId(n)].act(robot.foot.center) for n in robot.foot.frames], axis=0)
    com, inertia, trunk = data.com[0].copy(), float(data.Ig.inertia[1, 1]), data.oMi[1].rotation
    velocity, momentum = data.hg.linear[[0, 2]] / robot.total_mass, float(data.hg.angular[1])
    if impact:
        velocity, momentum = _after_impact(robot, q, v)
    pitch = float(np.arctan2(trunk[0, 2], trunk[2, 2]))
    return Touchdown((com - sole)[[0, 2]], velocity.copy(), float(momentum), inertia, pitch)


def _posture(robot: Robot, com: np.ndarray) -> np.ndarray:
    """Link angles (5,) with flat feet that put the CoM at ``com`` (2,) from the middle of the sole."""
    model, shoulder = robot.sagittal, robot.stance["shoulder_rad"]

    def angles(legs):
        return np.array([0.0, *legs, TRUNK_RAD, TRUNK_RAD + shoulder])

    def miss(legs):
        return com_from_toe(robot, angles(legs)) - model.sole_center - com

    found = root(miss, [KNEE_GUESS_RAD / 2, -KNEE_GUESS_RAD / 2])
    if not np.max(np.abs(found.fun)) < POSTURE_TOLERANCE_M:
        raise InfeasibleError(
            f"touchdown with the CoM {com[0]:+.3f} m ahead of and {com[1]:.3f} m above the soles: the legs of "
            f"{robot.name} do not reach that; plan with a shorter leg at touchdown"
        )
    return angles(found.x)


def _rigid_motion(robot: Robot, q: np.ndarray, velocity: np.ndarray, momentum: float) -> np.ndarray:
    """Velocity (nv,) of the robot moving as one body with CoM velocity (2,) and angular momentum."""
    model, data = robot.model, robot.model.createData()
    v = np.zeros(model.nv)
    pin.ccrba(model, data, q, v)
    base = pin.XYZQUATToSE3(q[:7])
    spin = np.array([0.0, momentum / data.Ig.inertia[1, 1], 0.0])
    linear = np.array([velocity[0], 0.0, velocity[1]]) + np.cross(spin, base.translation - data.com[0])
    v[:3], v[3:6] = base.rotation.T @ linear, base.rotation.T @ spin
    return v


def _after_impact(robot: Robot, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, float]:
    """CoM velocity (2,) and angular momentum once both feet stand, v+ = v - M^-1 J^T (J M^-1 J^T)^-1 J v."""
    model, data = robot.model, robot.model.createData()
    pin.computeAllTerms(model, data, q, v)
    mass = np.triu(data.M) + np.triu(data.M, 1).T
    frames = [model.getFrameId(n) for n in robot.foot.frames]
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    jacobian = np.vstack([pin.computeFrameJacobian(model, data, q, f, axes) for f in frames])  # (12, nv)
    gain = np.linalg.solve(mass, jacobian.T)  # (nv, 12)
    after = v - gain @ np.linalg.lstsq(jacobian @ gain, jacobian @ v, rcond=1e-9)[0]
    pin.ccrba(model, data, q, after)
    return data.hg.linear[[0, 2]] / robot.total_mass, float(data.hg.angular[1])


# landing ------------------------------------------------------------------------------------------
SHARED = ("jerk", "L rate", "trunk range", "unilateral", "friction", "leg force", "inertia envelope", "L range")
SCALES = {"q": 1.0, "v": [5.0, 3.0, 5.0, 2.0], "a": [50.0, 30.0, 50.0, 20.0], "j": [1000.0, 500.0, 1000.0, 500.0]}
SAMPLE_S = 0.005  # our choice: a hundred samples and more over the landing


@dataclass(frozen=True)
class LandingSettings:
    """Weights and bounds of the landing; the paper prints none, all are our choice."""

    intervals: int = 32  # steps of about 30 ms; twice as many move the CoM by less than 5 mm
    duration_s: tuple[float, float] = (0.5, 1.2)  # from a quick knee bend to a slow one
    cop_margin_m: float = 0.018  # inside the sole's edges: what the landing controller itself keeps
    press_share: float = 0.7  # of the weight, least vertical force: soles that are hardly loaded slip and tip
    force_gain: float = 1.0 / FORCE_SHARE  # a landing may use the whole peak torque, it lasts a tenth of a second
    w_jerk: float = 0.03  # [1], of the launch's weighted jerk: the catch has to be quick
    w_momentum_rate: float = 5e-4  # [1 / (N m)^2 / s]; a quarter of the launch's, L must be gone soon
    w_acceleration: float = 2e-2  # [1 / (m/s^2)^2 / s] of the CoM: an even push, peak force low
    w_cop: float = 20.0  # [1 / m^2 / s] distance from the middle of the sole: room for the controller
    w_posture: float = 50.0  # [1 / rad^2 / s] trunk against its pitch in the stance; ties L to the trunk's way back
    w_time: float = 0.1  # [1 / s^2]


@dataclass(frozen=True)
class LandingPlan:
    """A planned landing, sampled; positions from the middle between the soles.

    Attributes
    ----------
    t : (N,) since touchdown [s].
    com, com_velocity, com_acceleration : (N, 2) x and z [m, m/s, m/s^2].
    L, L_rate : (N,) [kg m^2/s, N m];  rho : (N,) [kg m^2];  F_x, F_z : (N,) [N];  cop_x : (N,) [m].
    touchdown : the state it began in;  statistics : what the solve cost;  solution : its nodes.
    """

    t: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    com_acceleration: np.ndarray
    L: np.ndarray
    L_rate: np.ndarray
    rho: np.ndarray
    F_x: np.ndarray
    F_z: np.ndarray
    cop_x: np.ndarray
    touchdown: Touchdown
    statistics: Statistics
    solution: PhaseSolution

    @property
    def duration_s(self) -> float:
        """From touchdown to standing [s]."""
        return float(self.t[-1])

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, float]:
        """CoM (2,), its velocity (2,) and L at ``time`` since touchdown; the last sample holds for ever."""
        x, z, dx, dz, momentum = (
            np.interp(time, self.t, column) for column in (*self.com.T, *self.com_velocity.T, self.L)
        )
        return np.array([x, z]), np.array([dx, dz]), float(momentum)

    def feed_forward(self, time: float) -> tuple[np.ndarray, float]:
        """CoM acceleration (2,) [m/s^2] and dL/dt [N m] at ``time`` since touchdown; zero once the robot stands.

        A controller that follows only :meth:`at` pushes with little more than the weight until it lags behind.
        """
        if time >= self.duration_s:
            return np.zeros(2), 0.0
        x, z, rate = (np.interp(time, self.t, column) for column in (*self.com_acceleration.T, self.L_rate))
        return np.array([x, z]), float(rate)


def _own_terms(mass: float, envelope: Reach, s: LandingSettings) -> list[Term]:
    """Costs and constraints that the launch does not have."""
    upright = float(envelope.start[0] + envelope.start[2])

    def room(p: Point):
        speed = ca.polyval(ca.DM(envelope.speed_fit), p.q[1])
        return ca.vertcat(speed - p.v[1], speed + p.v[1])

    def cop(p: Point):
        return -srmp_state(p, mass).pivot_torque / (mass * GRAVITY)

    def acceleration(p: Point):
        return srmp_state(p, mass).com_acceleration

    return [
        Term("CoM acceleration", "ours: a soft catch", "m/s^2", "node", acceleration, weight=s.w_acceleration),
        Term("CoP from the middle", "ours, times F_z / m g", "m", "node", cop, weight=s.w_cop),
        Term("trunk upright", "ours", "rad", "node", lambda p: p.q[0] + p.q[2] - upright, weight=s.w_posture),
        Term("landing time", "ours", "s", "end", lambda p: p.duration, weight=s.w_time),
        Term("leg speed", "ours: from the joint speeds", "m/s", "node", room, lower=0.0, upper=np.inf, skip=(1, 0)),
        Term("L at touchdown", "after the impact", "kg m^2/s", "start",
             lambda p: srmp_state(p, mass).angular_momentum - p.p.L, scale=10.0),
        Term("L at rest", "standing", "kg m^2/s", "end", lambda p: srmp_state(p, mass).angular_momentum, scale=10.0),
    ]  # fmt: skip


def build_landing(robot: Robot, settings: LandingSettings, envelope: Reach) -> Problem:
    """The landing as a problem of one phase; parameters: start (lean, length, turn, radius), their rates, L."""
    mass = robot.sagittal.total_mass
    strong = replace(envelope, force_fit=settings.force_gain * envelope.force_fit)
    base = SrmpSettings()
    shared = [t for t in launch_terms(mass, strong, base) if t.name in SHARED]
    weights = {"jerk": settings.w_jerk, "L rate": settings.w_momentum_rate}
    shared = [replace(t, weight=weights.get(t.name, t.weight)) if t.is_cost else t for t in shared]
    # what is measured at touchdown is a fact: constraints that its fixed part alone decides begin one node later
    shared = [
        replace(t, skip=(1, 0)) if t.name in ("trunk range", "inertia envelope", "L range") else t for t in shared
    ]
    press = settings.press_share * mass * GRAVITY
    shared = [replace(t, lower=press) if t.name == "unilateral" else t for t in shared]
    heel, toe = envelope.cop
    sole = cop_terms(mass, heel + settings.cop_margin_m, toe - settings.cop_margin_m)
    low, high = envelope.length
    unset = np.inf

    def start(parameters):
        return parameters["start"]

    def rates(sign):
        return lambda parameters: np.array([*parameters["rates"], sign * unset, sign * unset])

    bounds = (
        Bound("touchdown", "flight's end", "rad, m", "q", start, start, "start"),
        Bound("touchdown rates", "after the impact", "1/s", "v", rates(-1), rates(1), "start"),
        Bound("state box", "SL-B1", "rad, m", "q", [-0.8, low, -2.5, 0.1], [0.8, high, 2.5, 1.0], "inner"),
        Bound("stance", "standing", "rad, m", "q", [0.0, envelope.start[1], -unset, envelope.start[3]],
              [0.0, envelope.start[1], unset, envelope.start[3]], "end"),
        Bound("at rest", "standing", "1/s", "v", [0.0, 0.0, -unset, 0.0], [0.0, 0.0, unset, 0.0], "end"),
        Bound("at rest (acceleration)", "standing", "1/s^2", "a", 0.0, 0.0, "end"),
    )  # fmt: skip
    phase = Phase("landing", COORDINATES, settings.intervals, settings.duration_s,
                  (*shared, *sole, *_own_terms(mass, envelope, settings)), bounds, scales=SCALES)  # fmt: skip
    return Problem("landing", (phase,), (), dict(start=4, rates=2, L=1, gravity=1))


class LandingPlanner:
    """Landings of one robot: built once, solved from any touchdown."""

    def __init__(self, robot: Robot, settings: LandingSettings = LandingSettings(), options: dict | None = None):
        self.robot, self.settings, self.reach = robot, settings, reach(robot)
        self._mass, self._margin = robot.sagittal.total_mass, SrmpSettings().inertia_margin
        self.nlp = Nlp(build_landing(robot, settings, self.reach), options)

    def plan(self, touchdown: Touchdown, *, gravity: float = GRAVITY, guess: PhaseGuess | None = None) -> LandingPlan:
        """Plan from ``touchdown`` to standing.

        Parameters
        ----------
        touchdown : velocities right after the impact.
        guess : another landing's ``solution.guess()``; a knee bend if None.

        Raises
        ------
        SolverError
            If there is no such landing: the message names what would have to give (CoP, friction, leg force).
        """
        data = self._parameters(touchdown)
        solution = self.nlp.solve({**data, "gravity": gravity}, {"landing": guess or self._guess(data)})
        phase = solution.phases["landing"]
        return _sample(phase, touchdown, solution.statistics, self._mass, gravity)

    def catch(self, q: np.ndarray, v: np.ndarray) -> LandingPlan | None:
        """Landing from a state of the full robot at the first touch, None if there is none; see :meth:`plan`."""
        try:
            return self.plan(touchdown_of_state(self.robot, q, v))
        except SolverError:
            return None

    def _parameters(self, touchdown: Touchdown) -> dict:
        (x, z), (dx, dz) = touchdown.com, touchdown.com_velocity
        lean, length = np.arctan2(x, z), np.hypot(x, z)
        along, across = np.array([np.sin(lean), np.cos(lean)]), np.array([np.cos(lean), -np.sin(lean)])
        low, high = (np.polyval(f, length) for f in (self.reach.inertia_low_fit, self.reach.inertia_high_fit))
        inside = 2 * self._margin * (high - low)
        rho = np.clip(
            touchdown.rho, low + inside, high - inside
        )  # the envelope is sampled, the robot may be just outside
        start = np.array([lean, length, touchdown.trunk_pitch - lean, np.sqrt(rho / self._mass)])
        return dict(start=start, rates=np.array([dx, dz]) @ np.array([across / length, along]).T, L=touchdown.L)

    def _guess(self, data: dict) -> PhaseGuess:
        """Sink and rise: leg length and lean with the given speeds, everything else straight to the stance."""
        n, first, last = self.settings.intervals, data["start"], self.reach.start
        duration = 0.8  # our choice
        s = np.linspace(0, 1, n + 1)[:, None]
        q = first + (last - first) * (3 * s**2 - 2 * s**3)
        q[:, 1:2] += duration * data["rates"][1] * s * (1 - s) ** 4
        q[:, 0:1] += duration * data["rates"][0] * s * (1 - s) ** 4
        q[:, 1] = np.clip(q[:, 1], *self.reach.length)
        return PhaseGuess(duration, q)


def _sample(phase: PhaseSolution, touchdown: Touchdown, statistics, mass: float, gravity: float) -> LandingPlan:
    t = np.linspace(0, phase.duration, int(np.ceil(phase.duration / SAMPLE_S)) + 1)
    q, v, a = phase.sample(t)
    out = [x.full().T.squeeze() for x in launch_function(mass, gravity).map(len(t))(q.T, v.T, a.T)]
    com, com_v, com_a, momentum, rate, rho, _, _, force, torque = out
    return LandingPlan(t, com, com_v, com_a, momentum, rate, rho, force[:, 0], force[:, 1], -torque / force[:, 1],
                       touchdown, statistics, phase)  # fmt: skip
