"""The landing to follow: planned in flight for the touchdown that is forecast, and in a flip again while it goes on.

The impact of a flip leaves the robot elsewhere than its plan expected. From the measured state the rest is planned as
the landing was; that takes its time too, so the robot follows the older plan until the newer one is there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import thread_time

import numpy as np
import pinocchio as pin

from jumplab.errors import JumplabError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, rotation, turned, yaw_of
from jumplab.sim.scene import Scene
from jumplab.stages.srmp.landing import LandingPlan, LandingPlanner, Touchdown, touchdown_of_state

# The paper prints none of these numbers.
LEAD_S = 0.15  # before touchdown a landing is planned: three times what the solve takes on one core of a laptop
KEPT_PLANNERS = 4  # robots of one session; a planner holds a few megabytes
FIRST_S = 0.15  # after touchdown it is planned again; before, the soles of flips are tilted, and a plan knows flat ones
EVERY_S = 0.10  # twice what a solve takes
UNTIL_S = 1.2  # the longest landing that is planned; afterwards the controller leads to the stance
LATENCY_S = 0.05  # before a new plan is followed, about what its solve takes
OFF_M = 0.03  # of the capture point; less is what the controller's own feedback mends
LEAST_HEIGHT_M = 0.3  # of the CoM, where the capture point of a squatting robot is still told


@dataclass(frozen=True)
class LandingReference:
    """A landing to follow, sampled; CoM from the middle between the soles. What is None is not fed forward."""

    t: np.ndarray  # (N,) time since touchdown [s]; the last sample holds for ever
    com: np.ndarray  # (N, 2) x and z [m]
    com_velocity: np.ndarray  # (N, 2) [m/s]
    L: np.ndarray  # (N,) angular momentum about the pitch axis [kg m^2/s]
    com_acceleration: np.ndarray | None = None  # (N, 2) [m/s^2]; given with the next, or not at all
    L_rate: np.ndarray | None = None  # (N,) [N m]

    at, feed_forward = LandingPlan.at, LandingPlan.feed_forward


@dataclass(frozen=True)
class Rest:
    """The rest of a landing."""

    plan: Reference
    began: float  # the plan's time zero, since touchdown [s]

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, float]:
        """CoM (2,), its velocity (2,) and L at ``time`` since touchdown."""
        return self.plan.at(max(time - self.began, 0.0))

    def feed_forward(self, time: float) -> tuple[np.ndarray, float]:
        """CoM acceleration (2,) and rate of L at ``time`` since touchdown."""
        return self.plan.feed_forward(max(time - self.began, 0.0))


Reference = LandingReference | LandingPlan | Rest  # or whatever knows ``at`` and ``feed_forward``
LandingSource = Reference | Callable[[np.ndarray, np.ndarray], Reference | None]
_planners: dict[tuple[str, float], LandingPlanner] = {}


def landing_planner(robot: Robot) -> LandingPlanner:
    """The landing planner of ``robot``, built once (0.3 s)."""
    key = robot.hash, robot.gravity
    if key not in _planners:
        while len(_planners) >= KEPT_PLANNERS:
            del _planners[next(iter(_planners))]
        _planners[key] = LandingPlanner(robot)
    return _planners[key]


def _landing(robot: Robot, touchdown: Touchdown) -> tuple[LandingPlan | None, str | None, float]:
    """Stage 1's landing, or None and the reason why there is none; and the time of the solve [s]."""
    planner, began = landing_planner(robot), thread_time()
    try:
        plan, reason = planner.plan(touchdown), None
    except JumplabError as e:
        plan, reason = None, str(e)
    return plan, reason, thread_time() - began


class Forecast:
    """The touchdown that a measured flight leads to; the last row of the planned ``tape`` is the posture to land in."""

    def __init__(self, robot: Robot, tape: Tape, scene: Scene):
        self._gauge, self._scene = Gauge(robot), scene
        self._q, self._v = tape.q[-1].copy(), tape.v[-1].copy()
        com, soles = self._gauge.com(self._q), self._gauge.soles(self._q)
        self._above, self._ahead = float(com[2] - soles[2]), float(soles[0] - com[0])

    def time_left(self, q: np.ndarray, v: np.ndarray) -> float:
        """Time until the soles meet the ground [s], from a measured state in flight; inf if they never do."""
        data = self._gauge.data
        pin.centerOfMass(self._gauge.model, data, q, v)
        (x, _, z), (vx, _, vz) = data.com[0], data.vcom[0]
        left, gravity = 0.0, self._gauge.robot.gravity
        for _ in range(2):  # the ground's height depends on where, and so on when
            drop = z - self._above - self._scene.top_at(x + vx * left + self._ahead)
            root = vz**2 + 2 * gravity * drop
            if root < 0:
                return np.inf
            left = (vz + np.sqrt(root)) / gravity
        return float(left)

    def state(
        self, q: np.ndarray, v: np.ndarray, turn: np.ndarray, correction: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Configuration (nq,) and velocity (nv,) at touchdown, forecast from a measured state in flight.

        The trunk will be off its planned attitude by ``turn`` (3, 3), and ``correction`` (nv - 6,) will have been added
        to the tape by then. The forecast is seen along the heading that the robot will have.
        """
        model, data = self._gauge.model, self._gauge.data
        pin.ccrba(model, data, q, v)
        own = pin.rpy.rpyToMatrix(0.0, 0.0, -yaw_of(turn))
        speed, momentum = own @ data.vcom[0], float((own @ data.hg.angular)[1])
        speed[2] -= self._gauge.robot.gravity * self.time_left(q, v)
        end, rates = turned(self._q, own @ turn), self._v.copy()
        if correction is not None:
            end[7:] += correction
        # the body turns as fast as its momentum says at the joint rates of the tape, and its CoM flies on
        attitude = rotation(end[3:7])
        pin.ccrba(model, data, end, rates)
        spin = np.array([0.0, (momentum - data.hg.angular[1]) / data.Ig.inertia[1, 1], 0.0])
        rates[3:6] += attitude.T @ spin
        pin.centerOfMass(model, data, end, rates)
        rates[:3] += attitude.T @ (speed - data.vcom[0])
        return end, rates


@dataclass
class LandingAhead:
    """Where the landing controller's reference comes from, and what became of it."""

    source: str  # "planned" in flight by stage 1, "spring" (spring-dampers to the stance) or "given" by the caller
    followed: str | None = None  # really, once decided; "spring" also if the planner found no landing
    planned_s: float | None = None
    time_left_s: float | None = None
    solve_s: float | None = None
    reason: str | None = None

    def plan(self, robot: Robot, q: np.ndarray, v: np.ndarray, time: float, time_left: float) -> LandingPlan | None:
        """Stage 1's landing from the forecast touchdown (q, v), None if there is none."""
        self.planned_s, self.time_left_s = time, time_left
        plan, self.reason, self.solve_s = _landing(robot, touchdown_of_state(robot, q, v))
        self.followed = "spring" if plan is None else "planned"
        return plan

    def to_json(self) -> dict:
        """What the settings of a result say."""
        in_time = None if self.solve_s is None else self.solve_s <= max(0.0, self.time_left_s)
        times = dict(planned_at_s=self.planned_s, time_left_s=self.time_left_s, solve_s=self.solve_s, in_time=in_time)
        return dict(asked=self.source, followed=self.followed or self.source, **times, reason=self.reason)


class Replan:
    """Hands out the landing to follow: the one from before the touchdown, or the latest one planned after it.

    ``made`` counts plans, ``refused`` states from which stage 1 found none; ``slowest_s`` is the longest solve [s].
    """

    def __init__(self, robot: Robot):
        self._robot, self._due = robot, FIRST_S
        self._next: Rest | None = None
        self.made, self.refused, self.slowest_s = 0, 0, 0.0

    def follow(self, time: float, q: np.ndarray, v: np.ndarray, reference: Reference) -> Reference:
        """What to follow at ``time`` since touchdown [s] from the measured state; ``reference`` is followed so far."""
        if self._next is not None and time >= self._next.began + LATENCY_S - STEP_S / 2:
            reference, self._next = self._next, None
        if self._due - STEP_S / 2 <= time <= UNTIL_S:
            self._due += EVERY_S
            now = touchdown_of_state(self._robot, q, v, impact=False)
            com, velocity, _ = reference.at(time)
            rate = np.sqrt(self._robot.gravity / max(now.com[1], LEAST_HEIGHT_M))  # the capture point is x + v_x / rate
            if abs(now.com[0] - com[0] + (now.com_velocity[0] - velocity[0]) / rate) > OFF_M:
                plan, _, spent_s = _landing(self._robot, now)
                if plan is None:  # from here stage 1 knows no landing; the older one is the best there is
                    self.refused += 1
                else:
                    self._next, self.made = Rest(plan, time), self.made + 1
                self.slowest_s = max(self.slowest_s, spent_s)
        return reference

    def to_json(self) -> dict:
        """What the settings of a result say."""
        return {"made": self.made, "refused": self.refused, "slowest_s": self.slowest_s}
