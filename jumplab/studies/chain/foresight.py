"""The plan of the next jump, made from what is measured while the robot flies or lands, and what
the jumps so far have taught.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jumplab.control import STEP_S
from jumplab.control.controller import Controller
from jumplab.errors import InfeasibleError, JumplabError, SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import stance_angles
from jumplab.stages.planner import USUAL, JumpPlan, Planner
from jumplab.stages.reconstruction import to_link_angles
from jumplab.studies.chain.course import Course, placed, seen_from, step_of
from jumplab.task import JumpTask

# [m, rad] a robot that misses by more than this has another problem than a wrong model
LARGEST_BIAS = 0.10
# a posture that is farther off the crouch is not the robot standing still
LARGEST_OFFSET_RAD = 0.10


def _turned(step: np.ndarray) -> np.ndarray:
    """A step (3,) whose turn is within half a turn."""
    return np.array([*step[:2], math.remainder(step[2], math.tau)])


def posture(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Absolute link angles (5,) of ``q`` (nq,) with the feet taken as flat, mean of left and right
    [rad].
    """
    zero = np.zeros((1, robot.model.nv))
    angles = to_link_angles(robot, q[None], zero, zero)[0][0]
    angles[0] = 0.0
    return angles


def rehearse(course: Course, planner: Planner, method: str = USUAL) -> tuple[JumpPlan, ...]:
    """Plans (K,) of the whole course from the crouch at rest, where plans on the way begin; jumps
    with equal targets share one.

    Raises :class:`InfeasibleError` with the number of a jump that has no plan.
    """
    plans: dict[JumpTask, JumpPlan] = {}
    for k, task in enumerate(course.tasks, 1):
        try:
            plans[task] = plans.get(task) or planner.plan(task, method)
        except (InfeasibleError, SolverError) as e:
            raise InfeasibleError(f"jump {k} of {course.count}: {e}") from e
    return tuple(plans[task] for task in course.tasks)


@dataclass
class Ahead:
    """One plan of a chain; times are simulated [s], since the chain began, places from where the
    toes stood then.
    """

    number: int  # of the jump, from 0
    looked_s: float  # when the state was measured
    air: bool  # whether the robot was in the air then
    # (3,) x, y and heading that the feet had, or were going to have, by that measurement
    foretold: np.ndarray
    place: np.ndarray  # (3,) the same, less what such forecasts were wrong by in this chain
    start: np.ndarray  # (5,) link angles in which the plan begins [rad]
    # (3,) what was added to way and turn because earlier jumps of this chain missed by it
    bias: np.ndarray
    # what planning was charged: its wall clock, in whole steps, unless another number was given
    solve_s: float = 0.0
    cpu_s: float = 0.0  # processor time of the same, which an idle core would need
    plan: JumpPlan | None = None
    failure: str = ""  # why there is no plan
    needed_s: float | None = None  # when the robot was first still enough to begin
    began_s: float | None = None  # when it began the jump ...
    began_at: np.ndarray | None = None  # ... and where its feet were then (3,), in the world
    controller: Controller | None = None  # of the jump

    @property
    def place_m(self) -> float:
        """Predicted place of the feet ahead, corrected [m]."""
        return float(self.place[0])

    @property
    def ready_s(self) -> float:
        """When the plan was there: measured, plus what planning took."""
        return self.looked_s + self.solve_s

    @property
    def spare_s(self) -> float | None:
        """Time from the arrival of the plan until it was needed [s]; negative if it was late, None
        if it was never needed.
        """
        return None if self.needed_s is None else self.needed_s - self.ready_s

    @property
    def in_time(self) -> bool:
        """Whether the plan was there when the robot was ready for it."""
        return self.plan is not None and self.spare_s is not None and self.spare_s >= 0


@dataclass
class Foresight:
    """Plans the next jump of a course from measurements, and remembers what the robot's jumps
    taught.

    ``solve_s`` is what a plan is charged [s], see :func:`jumplab.studies.chain.run_chain`.
    """

    course: Course
    robot: Robot
    planner: Planner
    rehearsal: Sequence[JumpPlan]
    solve_s: float | None = None

    def __post_init__(self):
        self._start = stance_angles(self.robot)
        self._missed: dict[int, np.ndarray] = {}  # jump: by how much way and turn (3,) fell short
        # by how much poses (3,) foretold in the air were too far
        self._misjudged: list[np.ndarray] = []
        self._zero: np.ndarray | None = None  # where the chain began, by its own measurement

    def learn_posture(self, q: np.ndarray) -> None:
        """Plans begin as far off the crouch as the robot, heavier perhaps, stands still in ``q``
        (nq,).
        """
        crouch = stance_angles(self.robot)
        offset = posture(self.robot, q) - crouch
        self._start = crouch + np.clip(offset, -LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD)

    def learn_place(self, last: Ahead, plans: list[Ahead], pose: np.ndarray) -> None:
        """Jump ``last`` brought the feet to ``pose`` (3,) in the world, as the next ``plans``
        foretold.
        """
        self._learn_shortfall(last, pose)
        place = seen_from(self._zero, pose)
        self._misjudged += [_turned(p.foretold - place) for p in plans if p.air]

    def _learn_shortfall(self, last: Ahead, pose: np.ndarray) -> None:
        shortfall = step_of(last.plan.task) - seen_from(last.began_at, pose)
        self._missed[last.number] = _turned(shortfall)

    @property
    def bias(self) -> np.ndarray:
        """Mean (3,) of what the jumps so far fell short by [m, rad]."""
        if not self._missed:
            return np.zeros(3)
        return np.clip(np.mean([*self._missed.values()], axis=0), -LARGEST_BIAS, LARGEST_BIAS)

    def look(
        self,
        number: int,
        time_s: float,
        pose: np.ndarray,
        air: bool = False,
        last: Ahead | None = None,
    ) -> Ahead:
        """Plan jump ``number`` for feet that have, or in the ``air`` will have, the ``pose`` (3,)
        in the world.

        It is x and y of the toes, or on a course with sides and turns of the soles' middle [m], and
        the heading [rad]. ``last`` is the plan of the jump before.
        """
        wall = time.perf_counter()
        cpu = time.process_time()
        if self._zero is None:
            self._zero = np.array(pose, float)
        foretold = seen_from(self._zero, pose)
        place = foretold - (np.mean(self._misjudged, axis=0) if air and self._misjudged else 0.0)
        if last is not None:
            self._learn_shortfall(last, placed(self._zero, place))
        ahead = Ahead(number, time_s, air, foretold, place, self._start, self.bias)
        try:
            ahead.plan = self._plan(ahead)
        except JumplabError as e:
            ahead.failure = str(e)
        took = time.perf_counter() - wall if self.solve_s is None else self.solve_s
        ahead.solve_s = math.ceil(took / STEP_S - 1e-9) * STEP_S
        ahead.cpu_s = time.process_time() - cpu
        return ahead

    def _plan(self, ahead: Ahead) -> JumpPlan:
        task = self.course.tasks[ahead.number]
        step = seen_from(ahead.place, self.course.goals[ahead.number])
        turn = np.array([0.0, 0.0, task.yaw_rad])  # perhaps more than half a turn
        way, side, yaw = _turned(step - turn) + turn + ahead.bias
        task = replace(task, distance_m=way, side_m=side, yaw_rad=yaw)
        return self.planner.replan(self.rehearsal[ahead.number], task, start=ahead.start)
