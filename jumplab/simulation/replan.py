"""A landing planned anew while it goes on: the impact of a flip leaves the robot elsewhere than its plan expected.

The soles of a backflip tilt up, the ankles meet their stop, and for a tenth of a second the ground pushes at the toes
only. What stage 1 planned for flat soles is then off by 5 cm and more, and a controller that still follows it pushes
CoM and trunk towards places that this robot cannot hold. From the measured state the rest is planned as the landing
was: it takes its time too, so the robot follows the older plan until the newer one is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import thread_time

import numpy as np

from jumplab.errors import JumplabError
from jumplab.robot import Robot
from jumplab.simulation.reference import Reference, landing_planner
from jumplab.simulation.world import STEP_S
from jumplab.srmp.touchdown import Touchdown, touchdown_of_state
from jumplab.task import GRAVITY

FIRST_S = 0.15  # our choice: after touchdown; before, the soles of flips are still tilted, and a plan knows flat ones
EVERY_S = 0.10  # our choice: twice what a solve takes
UNTIL_S = 1.2  # our choice: the longest landing that is planned; afterwards the controller leads to the stance
LATENCY_S = 0.05  # our choice: before a new plan is followed, about what its solve takes
OFF_M = 0.03  # our choice: of the capture point; less is what the controller's own feedback mends
LEAST_HEIGHT_M = 0.3  # our choice: of the CoM, where the capture point of a squatting robot is still told


@dataclass(frozen=True)
class Rest:
    """The rest of a landing.

    Attributes
    ----------
    plan : its time begins with zero.
    began : its time zero, since touchdown [s].
    """

    plan: Reference
    began: float

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, float]:
        """CoM (2,), its velocity (2,) and L at ``time`` since touchdown."""
        return self.plan.at(max(time - self.began, 0.0))

    def feed_forward(self, time: float) -> tuple[np.ndarray, float]:
        """CoM acceleration (2,) and rate of L at ``time`` since touchdown."""
        return self.plan.feed_forward(max(time - self.began, 0.0))


class Replan:
    """Hands out the landing to follow: the one from before the touchdown, or the latest one planned after it.

    Attributes
    ----------
    made, refused : counts of plans, and of states from which stage 1 found none.
    slowest_s : the longest solve [s] of processor time.
    """

    def __init__(self, robot: Robot):
        self._robot = robot
        self._next: Rest | None = None
        self._due = FIRST_S
        self.made = self.refused = 0
        self.slowest_s = 0.0

    def follow(self, time: float, q: np.ndarray, v: np.ndarray, reference: Reference) -> Reference:
        """What to follow at ``time`` since touchdown [s] from the measured state; ``reference`` is followed so far."""
        if self._next is not None and time >= self._next.began + LATENCY_S - STEP_S / 2:
            reference, self._next = self._next, None
        if self._due - STEP_S / 2 <= time <= UNTIL_S:
            self._due += EVERY_S
            now = touchdown_of_state(self._robot, q, v, impact=False)
            if abs(_off(now, *reference.at(time)[:2])) > OFF_M:
                self._plan(now, time)
        return reference

    def _plan(self, now: Touchdown, time: float) -> None:
        began = thread_time()
        try:
            self._next = Rest(landing_planner(self._robot).plan(now), time)
            self.made += 1
        except JumplabError:  # from here stage 1 knows no landing; the older one is the best there is
            self.refused += 1
        self.slowest_s = max(self.slowest_s, thread_time() - began)

    def to_json(self) -> dict:
        """What the settings of a result say."""
        return {"made": self.made, "refused": self.refused, "slowest_s": self.slowest_s}


def _off(now: Touchdown, com: np.ndarray, velocity: np.ndarray) -> float:
    """Distance between the capture points x + v_x / sqrt(g / z) of a state and of a plan [m]."""
    rate = np.sqrt(GRAVITY / max(now.com[1], LEAST_HEIGHT_M))
    return float(now.com[0] - com[0] + (now.com_velocity[0] - velocity[0]) / rate)
