"""Stage 1's landing: CoM and angular momentum from touchdown to standing (LD-*, Sec. III and VI-A
of the paper).

The paper takes its landing trajectory from an earlier work and does not repeat it. This one is
ours, on the same reaction mass pendulum and with the same terms as the launch: CoP inside the sole,
friction, unilateral force, leg force and inertia envelope of the robot, smooth, of free duration.
It begins right after the impact and ends at rest in the stance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import itemgetter
from typing import Any

import casadi as ca
import numpy as np

from jumplab.models.full import FullBody, FullTerms
from jumplab.models.srmp import COORDINATES
from jumplab.ocp import Nlp, PhaseGuess, Statistics
from jumplab.ocp.cache import in_turn
from jumplab.ocp.problem import Bound, Phase, Problem, Term, limit
from jumplab.robot import Robot
from jumplab.robot.reach import FORCE_SHARE, Reach, reach
from jumplab.stages.srmp.planner import SrmpStance, grid, on_ground
from jumplab.stages.srmp.problem import SCALES, cop_terms, launch_terms, rod_at
from jumplab.stages.srmp.settings import Range, SrmpSettings

# touchdown
# ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Touchdown:
    """Whole-body quantities at the start of a landing, sagittal plane."""

    com: np.ndarray  # (2,) x and z from the middle between the soles [m]
    com_velocity: np.ndarray  # (2,) [m/s]
    L: float  # angular momentum about the CoM, about +y [kg m^2/s]
    rho: float  # pitch inertia about the CoM [kg m^2]
    trunk_pitch: float = 0.15  # [rad]; the middle of what stage 3 allows at touchdown


def touchdown_of_state(
    robot: Robot, q: np.ndarray, v: np.ndarray, *, impact: bool = True
) -> Touchdown:
    """Touchdown from a state of the full robot, planned or measured.

    Parameters
    ----------
    q, v : (nq,), (nv,) in Pinocchio's conventions.
    impact : True if the soles still move; they are stopped.
    """
    body = FullBody(robot)
    x = body.terms(q, v)
    if impact:
        x = body.terms(q, after_impact(x))
    pitch = float(np.arctan2(x.base_rotation[0, 2], x.base_rotation[2, 2]))
    com = (x.com - x.sole.place.mean(axis=0))[[0, 2]]
    return Touchdown(com, x.com_velocity[[0, 2]], float(x.momentum[4]), x.rho, pitch)


def after_impact(x: FullTerms) -> np.ndarray:
    """Rates (nv,) once both feet stand: v+ = v - M^-1 J^T (J M^-1 J^T)^-1 J v."""
    gain = np.linalg.solve(x.M, x.J.T)  # (nv, 12)
    return x.v - gain @ np.linalg.lstsq(x.J @ gain, x.J @ x.v, rcond=1e-9)[0]


# landing ------------------------------------------------------------------------------------------
GUESS_S = 0.8  # duration that the solver begins with


@dataclass(frozen=True)
class LandingSettings:
    """Weights and bounds of the landing; the paper prints none of these numbers."""

    intervals: int = 32  # steps of about 30 ms; twice as many move the CoM by less than 5 mm
    duration_s: Range = (0.5, 1.2)  # from a quick knee bend to a slow one
    lean_rad: Range = (-0.8, 0.8)  # box on theta_l
    cop_margin_m: float = 0.018  # inside the sole's edges: what the landing controller itself keeps
    # of the weight, least vertical force: soles that are hardly loaded slip and tip
    press_share: float = 0.7
    # the whole peak torque: a landing lasts a tenth of a second
    force_gain: float = 1.0 / FORCE_SHARE
    w_jerk: float = 0.03  # [1], of the launch's weighted jerk: the catch has to be quick
    # [1 / (N m)^2 / s]; a quarter of the launch's, L must be gone soon
    w_momentum_rate: float = 5e-4
    w_acceleration: float = 2e-2  # [1 / (m/s^2)^2 / s] of the CoM: an even push, peak force low
    # [1 / m^2 / s] of the CoP from its place at rest: a margin for the controller
    w_cop: float = 20.0
    # [1 / rad^2 / s] trunk against its pitch in the stance; ties L to the trunk's way back
    w_posture: float = 50.0
    w_time: float = 0.1  # [1 / s^2]


@dataclass(frozen=True)
class LandingPlan(SrmpStance):
    """A planned landing, sampled."""

    touchdown: Touchdown  # the state it began in
    statistics: Statistics  # what the solve cost

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, float]:
        """CoM (2,), its velocity (2,) and L at ``time`` since touchdown; the last sample holds for
        ever.
        """
        now = self._row(time)
        return now[:2], now[2:4], float(now[4])

    def feed_forward(self, time: float) -> tuple[np.ndarray, float]:
        """CoM acceleration (2,) [m/s^2] and dL/dt [N m] at ``time`` since touchdown; zero once the
        robot stands.

        A controller that follows only :meth:`at` pushes with little more than the weight until it
        lags behind.
        """
        if time >= self.t[-1]:
            return np.zeros(2), 0.0
        now = self._row(time)
        return now[5:7], float(now[7])

    @cached_property
    def _rows(self) -> np.ndarray:
        columns = self.com, self.com_velocity, self.L, self.com_acceleration, self.L_rate
        return np.column_stack(columns)

    def _row(self, time: float) -> np.ndarray:
        """CoM, its velocity, L, CoM acceleration and rate of L (8,) at a ``time``."""
        after = min(max(int(np.searchsorted(self.t, time)), 1), len(self.t) - 1)
        begin, end = self.t[after - 1 : after + 1]
        share = min(max((time - begin) / (end - begin), 0.0), 1.0)
        before = self._rows[after - 1]
        return before + share * (self._rows[after] - before)


def landing_terms(mass: float, envelope: Reach, s: LandingSettings) -> list[Term]:
    """Costs and constraints of the landing, LD-*: those of the launch, some of them changed, and
    its own.
    """
    base = SrmpSettings()
    upright = float(envelope.start[0] + envelope.start[2])
    # what is measured at touchdown is a fact: constraints that its fixed part alone decides begin
    # one node later
    later = {"skip": (1, 0)}
    press = {"lower": lambda parameters: s.press_share * mass * parameters["gravity"]}
    changes = {
        "trunk range": later,
        "inertia envelope": later,
        "L range": later,
        "jerk": {"weight": s.w_jerk},
        "L rate": {"weight": s.w_momentum_rate},
        "friction": {},
        "leg force": {},
        "unilateral": press,
    }
    strong = replace(envelope, force_fit=s.force_gain * envelope.force_fit)
    shared = [t for t in launch_terms(mass, strong, base) if t.name in changes]

    def room(p):
        speed = ca.polyval(ca.DM(envelope.speed_fit), p.q[1])
        return ca.vertcat(speed - p.v[1], speed + p.v[1])

    ahead = envelope.start[1] * np.sin(envelope.start[0])  # of the CoM at rest

    def cop(p):
        return -p.pivot_torque / (mass * p.p.gravity) - ahead

    def lean(p):
        return p.posture - upright

    def touched(p):
        return p.L - p.p.L

    heel, toe = envelope.cop
    unit = "kg m^2/s"
    return [
        *(replace(t, **changes[t.name]) for t in shared),
        *cop_terms(mass, heel + s.cop_margin_m, toe - s.cop_margin_m),
        Term(
            "CoM acceleration",
            "ours: a soft catch",
            "m/s^2",
            "node",
            "com_acceleration",
            s.w_acceleration,
        ),
        Term("CoP from its place at rest", "ours, times F_z / m g", "m", "node", cop, s.w_cop),
        Term("trunk upright", "ours", "rad", "node", lean, s.w_posture),
        Term("landing time", "ours", "s", "end", "duration", s.w_time),
        limit("leg speed", "ours: from the joint speeds", "m/s", "node", room, skip=(1, 0)),
        Term("L at touchdown", "after the impact", unit, "start", touched, scale=10.0),
        Term("L at rest", "standing", unit, "end", "L", scale=10.0),
    ]


def build_landing(robot: Robot, settings: LandingSettings, envelope: Reach) -> Problem:
    """The landing as a problem of one phase; parameters: start (lean, length, turn, radius), their
    rates, L.
    """
    base = SrmpSettings()
    free = np.inf
    start = itemgetter("start")  # of the parameters

    def rates(sign):
        return lambda parameters: np.array([*parameters["rates"], sign * free, sign * free])

    low, high = zip(settings.lean_rad, envelope.length, base.turn_rad, base.radius_m, strict=True)
    lean, length, _, radius = envelope.start
    first, last = ([lean, length, turn, radius] for turn in (-free, free))
    still = np.array([0.0, 0.0, free, 0.0])  # turning is what L at rest stops
    bounds = (
        Bound("touchdown", "flight's end", "rad, m", "q", start, start, "start"),
        Bound("touchdown rates", "after the impact", "1/s", "v", rates(-1), rates(1), "start"),
        Bound("state box", "SL-B1", "rad, m", "q", low, high, "inner"),
        Bound("stance", "standing", "rad, m", "q", first, last, "end"),
        Bound("at rest", "standing", "1/s", "v", -still, still, "end"),
        Bound("at rest (acceleration)", "standing", "1/s^2", "a", 0.0, 0.0, "end"),
    )
    terms = tuple(landing_terms(envelope.mass, envelope, settings))
    rod = {"scales": SCALES, "view": partial(rod_at, envelope.mass)}
    phase = Phase(
        "landing", COORDINATES, settings.intervals, settings.duration_s, terms, bounds, **rod
    )
    return Problem("landing", (phase,), (), {"start": 4, "rates": 2, "L": 1, "gravity": 1})


class LandingPlanner:
    """Landings of one robot: built once, solved from any touchdown."""

    @in_turn
    def __init__(self, robot: Robot, settings: LandingSettings = LandingSettings()):
        self.robot = robot
        self.settings = settings
        self.reach = reach(robot)
        self.nlp = Nlp(build_landing(robot, settings, self.reach))

    @in_turn
    def plan(self, touchdown: Touchdown) -> LandingPlan:
        """Plan from ``touchdown``, with velocities right after the impact, to standing.

        Raises
        ------
        SolverError
            If there is no such landing: the message names what would have to give (CoP, friction,
            leg force).
        """
        data = self._parameters(touchdown)
        gravity = self.robot.gravity
        solution = self.nlp.solve(data | {"gravity": gravity}, {"landing": self._guess(data)})
        phase = solution.phases["landing"]
        t = grid(phase.duration)
        columns = on_ground(self.reach.mass, gravity, t, *phase.sample(t))
        return LandingPlan(*columns, touchdown, solution.statistics)

    def _parameters(self, touchdown: Touchdown) -> dict[str, Any]:
        """Parameters of the problem: the touchdown in the pendulum's coordinates."""
        lean = np.arctan2(*touchdown.com)
        length = np.hypot(*touchdown.com)
        fits = self.reach.inertia_low_fit, self.reach.inertia_high_fit
        low, high = (np.polyval(fit, length) for fit in fits)
        inside = 2 * SrmpSettings().inertia_margin * (high - low)
        # the envelope is sampled, the robot may be just outside
        rho = np.clip(touchdown.rho, low + inside, high - inside)
        radius = np.sqrt(rho / self.reach.mass)
        along = np.array([np.sin(lean), np.cos(lean)])
        across = np.array([np.cos(lean), -np.sin(lean)])
        return dict(
            start=np.array([lean, length, touchdown.trunk_pitch - lean, radius]),
            rates=np.array([across / length, along]) @ touchdown.com_velocity,
            L=touchdown.L,
        )

    def _guess(self, data: dict[str, Any]) -> PhaseGuess:
        """Sink and rise: leg length and lean with the given speeds, everything else straight to the
        stance.
        """
        first = data["start"]
        s = np.linspace(0, 1, self.settings.intervals + 1)[:, None]
        q = first + (self.reach.start - first) * (3 * s**2 - 2 * s**3)
        q[:, :2] += GUESS_S * data["rates"] * s * (1 - s) ** 4
        q[:, 1] = np.clip(q[:, 1], *self.reach.length)
        return PhaseGuess(GUESS_S, q)
