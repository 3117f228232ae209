"""Stage 1's landing: CoM and angular momentum from touchdown to standing (LD-*, Sec. III and VI-A of the paper).

The paper takes its landing trajectory from an earlier work and does not repeat it. This one is ours, on the same
reaction mass pendulum and with the same terms as the launch: CoP inside the sole, friction, unilateral force, leg force
and inertia envelope of the robot, smooth, of free duration. It begins right after the impact and ends at rest in the
stance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.models.srmp import COORDINATES
from jumplab.ocp import Nlp, PhaseGuess, PhaseSolution, Statistics
from jumplab.ocp.problem import Bound, Phase, Point, Problem, Term
from jumplab.robot import Robot
from jumplab.robot.reach import SETTINGS, Reach
from jumplab.stages.srmp.planner import SrmpStance, grid, on_ground, reach_of
from jumplab.stages.srmp.problem import SCALES, cop_terms, launch_terms, limit, srmp_state
from jumplab.stages.srmp.settings import SrmpSettings

# touchdown ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Touchdown:
    """Whole-body quantities at the start of a landing, sagittal plane."""

    com: np.ndarray  # (2,) x and z from the middle between the soles [m]
    com_velocity: np.ndarray  # (2,) [m/s]
    L: float  # angular momentum about the CoM, about +y [kg m^2/s]
    rho: float  # pitch inertia about the CoM [kg m^2]
    trunk_pitch: float = 0.15  # [rad]; the middle of what stage 3 allows at touchdown


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
        velocity, momentum = after_impact(robot, q, v)
    pitch = float(np.arctan2(trunk[0, 2], trunk[2, 2]))
    return Touchdown((com - sole)[[0, 2]], velocity, momentum, inertia, pitch)


def after_impact(robot: Robot, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, float]:
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
GUESS_S = 0.8  # duration that the solver begins with


@dataclass(frozen=True)
class LandingSettings:
    """Weights and bounds of the landing; the paper prints none of these numbers."""

    intervals: int = 32  # steps of about 30 ms; twice as many move the CoM by less than 5 mm
    duration_s: tuple[float, float] = (0.5, 1.2)  # from a quick knee bend to a slow one
    lean_rad: tuple[float, float] = (-0.8, 0.8)  # box on theta_l
    cop_margin_m: float = 0.018  # inside the sole's edges: what the landing controller itself keeps
    press_share: float = 0.7  # of the weight, least vertical force: soles that are hardly loaded slip and tip
    force_gain: float = 1.0 / SETTINGS.force_share  # the whole peak torque: a landing lasts a tenth of a second
    w_jerk: float = 0.03  # [1], of the launch's weighted jerk: the catch has to be quick
    w_momentum_rate: float = 5e-4  # [1 / (N m)^2 / s]; a quarter of the launch's, L must be gone soon
    w_acceleration: float = 2e-2  # [1 / (m/s^2)^2 / s] of the CoM: an even push, peak force low
    w_cop: float = 20.0  # [1 / m^2 / s] distance from the middle of the sole: room for the controller
    w_posture: float = 50.0  # [1 / rad^2 / s] trunk against its pitch in the stance; ties L to the trunk's way back
    w_time: float = 0.1  # [1 / s^2]


@dataclass(frozen=True)
class LandingPlan(SrmpStance):
    """A planned landing, sampled."""

    touchdown: Touchdown  # the state it began in
    statistics: Statistics  # what the solve cost
    solution: PhaseSolution  # its nodes

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, float]:
        """CoM (2,), its velocity (2,) and L at ``time`` since touchdown; the last sample holds for ever."""
        columns = (*self.com.T, *self.com_velocity.T, self.L)
        x, z, dx, dz, momentum = (np.interp(time, self.t, column) for column in columns)
        return np.array([x, z]), np.array([dx, dz]), float(momentum)

    def feed_forward(self, time: float) -> tuple[np.ndarray, float]:
        """CoM acceleration (2,) [m/s^2] and dL/dt [N m] at ``time`` since touchdown; zero once the robot stands.

        A controller that follows only :meth:`at` pushes with little more than the weight until it lags behind.
        """
        if time >= self.t[-1] or self.com_acceleration is None:
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
        return -srmp_state(p, mass).pivot_torque / (mass * p.p.gravity)

    def acceleration(p: Point):
        return srmp_state(p, mass).com_acceleration

    def momentum(p: Point):
        return srmp_state(p, mass).angular_momentum

    def jump(p: Point):
        return momentum(p) - p.p.L

    return [
        Term("CoM acceleration", "ours: a soft catch", "m/s^2", "node", acceleration, weight=s.w_acceleration),
        Term("CoP from the middle", "ours, times F_z / m g", "m", "node", cop, weight=s.w_cop),
        Term("trunk upright", "ours", "rad", "node", lambda p: p.q[0] + p.q[2] - upright, weight=s.w_posture),
        Term("landing time", "ours", "s", "end", lambda p: p.duration, weight=s.w_time),
        limit("leg speed", "ours: from the joint speeds", "m/s", "node", room, 0.0, skip=(1, 0)),
        Term("L at touchdown", "after the impact", "kg m^2/s", "start", jump, scale=10.0),
        Term("L at rest", "standing", "kg m^2/s", "end", momentum, scale=10.0),
    ]


def _shared_terms(mass: float, envelope: Reach, s: LandingSettings, base: SrmpSettings) -> list[Term]:
    """Terms of the launch, some of them changed."""
    # what is measured at touchdown is a fact: constraints that its fixed part alone decides begin one node later
    changes = {name: {"skip": (1, 0)} for name in ("trunk range", "inertia envelope", "L range")}
    changes |= {"jerk": {"weight": s.w_jerk}, "L rate": {"weight": s.w_momentum_rate}, "friction": {}, "leg force": {}}
    changes["unilateral"] = {"lower": lambda parameters: s.press_share * mass * parameters["gravity"]}
    strong = replace(envelope, force_fit=s.force_gain * envelope.force_fit)
    return [replace(t, **changes[t.name]) for t in launch_terms(mass, strong, base) if t.name in changes]


def build_landing(robot: Robot, settings: LandingSettings, envelope: Reach) -> Problem:
    """The landing as a problem of one phase; parameters: start (lean, length, turn, radius), their rates, L."""
    mass, base, s, free = robot.sagittal.total_mass, SrmpSettings(), settings, np.inf
    heel, toe = envelope.cop
    sole = cop_terms(mass, heel + s.cop_margin_m, toe - s.cop_margin_m)
    terms = (*_shared_terms(mass, envelope, s, base), *sole, *_own_terms(mass, envelope, s))

    def start(parameters):
        return parameters["start"]

    def rates(sign):
        return lambda parameters: np.array([*parameters["rates"], sign * free, sign * free])

    low, high = zip(s.lean_rad, envelope.length, base.turn_rad, base.radius_m, strict=True)
    first, last = ([0.0, envelope.start[1], turn, envelope.start[3]] for turn in (-free, free))
    bounds = (
        Bound("touchdown", "flight's end", "rad, m", "q", start, start, "start"),
        Bound("touchdown rates", "after the impact", "1/s", "v", rates(-1), rates(1), "start"),
        Bound("state box", "SL-B1", "rad, m", "q", low, high, "inner"),
        Bound("stance", "standing", "rad, m", "q", first, last, "end"),
        Bound("at rest", "standing", "1/s", "v", [0.0, 0.0, -free, 0.0], [0.0, 0.0, free, 0.0], "end"),
        Bound("at rest (acceleration)", "standing", "1/s^2", "a", 0.0, 0.0, "end"),
    )
    phase = Phase("landing", COORDINATES, s.intervals, s.duration_s, terms, bounds, scales=SCALES)
    return Problem("landing", (phase,), (), {"start": 4, "rates": 2, "L": 1, "gravity": 1})


class LandingPlanner:
    """Landings of one robot: built once, solved from any touchdown."""

    def __init__(self, robot: Robot, settings: LandingSettings = LandingSettings()):
        self.robot, self.settings, self.reach = robot, settings, reach_of(robot)
        self._mass, self._margin = robot.sagittal.total_mass, SrmpSettings().inertia_margin
        self.nlp = Nlp(build_landing(robot, settings, self.reach))

    def plan(self, touchdown: Touchdown, *, guess: PhaseGuess | None = None) -> LandingPlan:
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
        data, gravity = self._parameters(touchdown), self.robot.gravity
        solution = self.nlp.solve({**data, "gravity": gravity}, {"landing": guess or self._guess(data)})
        phase = solution.phases["landing"]
        t = grid(phase.duration)
        columns = on_ground(self._mass, gravity, t, *phase.sample(t))
        return LandingPlan(*columns, touchdown, solution.statistics, phase)

    def _parameters(self, touchdown: Touchdown) -> dict:
        (x, z), (dx, dz) = touchdown.com, touchdown.com_velocity
        lean, length = np.arctan2(x, z), np.hypot(x, z)
        along, across = np.array([np.sin(lean), np.cos(lean)]), np.array([np.cos(lean), -np.sin(lean)])
        low, high = (np.polyval(f, length) for f in (self.reach.inertia_low_fit, self.reach.inertia_high_fit))
        inside = 2 * self._margin * (high - low)
        # the envelope is sampled, the robot may be just outside
        rho = np.clip(touchdown.rho, low + inside, high - inside)
        start = np.array([lean, length, touchdown.trunk_pitch - lean, np.sqrt(rho / self._mass)])
        return dict(start=start, rates=np.array([dx, dz]) @ np.array([across / length, along]).T, L=touchdown.L)

    def _guess(self, data: dict) -> PhaseGuess:
        """Sink and rise: leg length and lean with the given speeds, everything else straight to the stance."""
        first, last = data["start"], self.reach.start
        s = np.linspace(0, 1, self.settings.intervals + 1)[:, None]
        q = first + (last - first) * (3 * s**2 - 2 * s**3)
        q[:, :2] += GUESS_S * data["rates"] * s * (1 - s) ** 4
        q[:, 1] = np.clip(q[:, 1], *self.reach.length)
        return PhaseGuess(GUESS_S, q)
