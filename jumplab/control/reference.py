"""The landing to follow, planned in flight for the touchdown that is forecast."""

from __future__ import annotations

from functools import lru_cache
from time import thread_time

import numpy as np

from jumplab.errors import JumplabError
from jumplab.ocp.cache import in_turn
from jumplab.robot import Robot
from jumplab.stages.srmp.landing import LandingPlan, LandingPlanner, touchdown_of_state

# before touchdown a landing is planned: three times what the solve takes on one core of a laptop
LEAD_S = 0.15


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

    ``followed`` is which of both really is, once decided. Nothing is planned where there is a
    ``hindrance``, in words.
    """

    def __init__(self, robot: Robot, source: str, hindrance: str | None = None):
        self._robot = robot
        self._source = source
        self.followed = None if source == "planned" and hindrance is None else "spring"
        names = "planned_at_s", "time_left_s", "solve_s", "in_time"
        self._planned: dict[str, float | None] = dict.fromkeys(names)
        self._reason = hindrance if source == "planned" else None
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
        touchdown = touchdown_of_state(self._robot, q, v)
        began = thread_time()
        plan = None
        try:
            plan = landing_planner(self._robot).plan(touchdown)
        except JumplabError as e:
            self._reason = str(e)
        solve_s = thread_time() - began
        in_time = solve_s <= max(0.0, left)
        self._planned = dict(planned_at_s=time, time_left_s=left, solve_s=solve_s, in_time=in_time)
        self.followed = "spring" if plan is None else "planned"
        return plan

    def to_json(self) -> dict:
        """Account of the landing's plan, for the settings of a result."""
        followed = self.followed or self._source
        return {
            "asked": self._source,
            "followed": followed,
            **self._planned,
            "reason": self._reason,
        }
