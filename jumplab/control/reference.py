"""The landing to follow: planned in flight for the touchdown that is forecast, and in a flip again
while it goes on.

The impact of a flip leaves the robot elsewhere than its plan expected. From the measured state the
rest is planned as the landing was; that takes its time too, so the robot follows the older plan
until the newer one is there.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from time import thread_time

import numpy as np

from jumplab.control import STEP_S
from jumplab.errors import JumplabError
from jumplab.ocp.cache import in_turn
from jumplab.robot import Robot
from jumplab.robot.legs import size
from jumplab.stages.srmp.landing import LandingPlan, LandingPlanner, Touchdown, touchdown_of_state

# before touchdown a landing is planned: three times what the solve takes on one core of a laptop
LEAD_S = 0.15
# after touchdown it is planned again; before, the soles of flips are tilted, and a plan knows flat
# ones
FIRST_S = 0.15
EVERY_S = 0.10  # twice what a solve takes
UNTIL_S = 1.2  # the longest landing that is planned; afterwards the controller leads to the stance
LATENCY_S = 0.05  # before a new plan is followed, about what its solve takes
OFF_M = 0.03  # of the capture point; less is what the controller's own feedback mends
LEAST_HEIGHT_M = 0.3  # of the CoM, where the capture point of a squatting robot is still told


@lru_cache(maxsize=4)  # robots of one session; a planner holds a few megabytes
def _planner_of(urdf: str, config_text: str, gravity: float) -> LandingPlanner:
    return LandingPlanner(Robot(urdf, config_text, gravity))


@in_turn
def landing_planner(robot: Robot) -> LandingPlanner:
    """The landing planner of ``robot``, built once (0.3 s)."""
    return _planner_of(robot.urdf, robot.config_text, robot.gravity)


class LandingAhead:
    """The landing to follow, and what became of it: planned in flight by stage 1 (``source``
    "planned"), or none, where spring-dampers lead to the stance ("spring").

    ``followed`` is which of both really is, once decided; with ``again`` the rest is planned anew
    after the touchdown.
    """

    def __init__(self, robot: Robot, source: str, again: bool = False):
        self._robot = robot
        self.source = source
        self.followed = None if source == "planned" else source
        self._planned: dict[str, float | None] = {}
        self._reason: str | None = None
        self._size = size(robot)
        self._due = self._size.of(FIRST_S, "s")
        self._next: LandingPlan | None = None
        # plans made after the touchdown, states from which stage 1 found none, the longest solve
        self.again = dict(made=0, refused=0, slowest_s=0.0) if again else None
        if self.followed is None:
            try:  # now, so that the solve in flight is all that is left to do
                landing_planner(robot)
            except JumplabError as e:  # a robot for which stage 1 has no landing
                self.followed = "spring"
                self._reason = str(e)

    def plan(self, q: np.ndarray, v: np.ndarray, time: float, left: float) -> LandingPlan | None:
        """Stage 1's landing from the forecast touchdown ``q`` (nq,), ``v`` (nv,), None if there is
        none; planned at ``time`` of the jump, ``left`` before that [s].
        """
        plan, self._reason, solve_s = self._solve(touchdown_of_state(self._robot, q, v))
        in_time = solve_s <= max(0.0, left)
        self._planned = dict(planned_at_s=time, time_left_s=left, solve_s=solve_s, in_time=in_time)
        self.followed = "spring" if plan is None else "planned"
        return plan

    def _solve(self, touchdown: Touchdown) -> tuple[LandingPlan | None, str | None, float]:
        """Stage 1's landing, or None and the reason why there is none; and its solve's time [s]."""
        planner = landing_planner(self._robot)
        began = thread_time()
        plan = None
        reason = None
        try:
            plan = planner.plan(touchdown)
        except JumplabError as e:
            reason = str(e)
        return plan, reason, thread_time() - began

    def follow(
        self, time: float, q: np.ndarray, v: np.ndarray, reference: LandingPlan
    ) -> LandingPlan:
        """Reference to follow at ``time`` since touchdown [s] from the measured ``q`` (nq,) and
        ``v`` (nv,); ``reference`` is followed so far.
        """
        if self._next is not None and time >= self._next.t[0] + LATENCY_S - STEP_S / 2:
            reference = self._next
            self._next = None
        if self._due - STEP_S / 2 <= time <= self._size.of(UNTIL_S, "s"):
            self._due += EVERY_S
            now = touchdown_of_state(self._robot, q, v, impact=False)
            com, velocity, _ = reference.at(time)
            # the capture point is x + v_x / rate
            rate = np.sqrt(
                self._robot.gravity / max(now.com[1], self._size.of(LEAST_HEIGHT_M, "m"))
            )
            if abs(
                now.com[0] - com[0] + (now.com_velocity[0] - velocity[0]) / rate
            ) > self._size.of(OFF_M, "m"):
                plan, _, spent_s = self._solve(now)
                # from here stage 1 may know no landing; the older one is the best there is then.
                # It is not asked again: a refusal takes seconds
                self._next = plan and replace(plan, t=plan.t + time)  # since touchdown
                self._due = self._due if plan else np.inf
                self.again["made" if plan else "refused"] += 1
                self.again["slowest_s"] = max(self.again["slowest_s"], spent_s)
        return reference

    def to_json(self) -> dict:
        """Account of the landing's plans, for the settings of a result."""
        planned = dict.fromkeys(("planned_at_s", "time_left_s", "solve_s", "in_time"))
        return {
            "asked": self.source,
            "followed": self.followed or self.source,
            **planned,
            **self._planned,
            "reason": self._reason,
            "again": self.again,
        }
