"""The plan of the next jump, made from what is measured while the robot flies or lands, and what it cost."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from jumplab.errors import InfeasibleError, JumplabError, SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import configuration
from jumplab.sim import STEP_S
from jumplab.stages.planner import JumpPlan, Planner, to_link_angles
from jumplab.studies.chain.course import Course

LARGEST_BIAS_M = 0.10  # a robot that misses by more than this has another problem than a wrong model
LARGEST_OFFSET_RAD = 0.10  # a posture that is farther off the crouch is not the robot standing still


def posture(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Absolute link angles (5,) of ``q`` with the feet taken as flat, mean of left and right [rad]."""
    zero = np.zeros((1, robot.model.nv))
    angles = to_link_angles(robot, q[None], zero, zero)[0][0]
    angles[0] = 0.0
    return angles


@dataclass(frozen=True)
class Rehearsal:
    """Plans of the whole course from the crouch at rest, made before it begins: where re-plans begin."""

    plans: tuple[JumpPlan, ...]  # one per jump; jumps with equal targets share one

    @classmethod
    def of(cls, course: Course, planner: Planner, method: str = "three-step") -> Rehearsal:
        """Plan every jump of the course; raises what the planner raises, with the number of the jump."""
        known: dict = {}
        for k in range(course.count):
            task = course.task(k)
            try:
                known[task] = known[task] if task in known else planner.plan(task, method)
            except (InfeasibleError, SolverError) as e:
                raise InfeasibleError(f"jump {k + 1} of {course.count}: {e}") from e
        return cls(tuple(known[course.task(k)] for k in range(course.count)))


@dataclass
class Ahead:
    """One plan of a chain, from the measurement it is made of to the instant at which the robot begins it.

    All times are simulated [s], since the chain began; places count from where the toes stood then.
    """

    number: int  # of the jump, from 0
    looked_s: float  # when the state was measured
    air: bool  # whether the robot was in the air then
    foretold_m: float  # where the toes stood, or were going to stand, by that measurement
    place_m: float  # the same, less what such forecasts were wrong by in this chain
    start: np.ndarray  # (5,) link angles in which the plan begins [rad]
    joints: np.ndarray  # (nv - 6,) the same as joint angles [rad]
    bias_m: float  # what was added to the distance because earlier jumps of this chain missed by it
    solve_s: float  # what planning was charged: its wall clock, in whole steps, unless another number was given
    cpu_s: float  # processor time of the same, which an idle core would need
    plan: JumpPlan | None
    failure: str = ""  # why there is no plan
    needed_s: float | None = None  # when the robot was first still enough to begin
    began_s: float | None = None  # when it began the jump

    @property
    def ready_s(self) -> float:
        """When the plan was there: measured, plus what planning took."""
        return self.looked_s + self.solve_s

    @property
    def in_time(self) -> bool:
        """Whether the plan was there when the robot was ready for it."""
        return self.plan is not None and self.needed_s is not None and self.ready_s <= self.needed_s


class Foresight:
    """Plans the next jump of a course from measurements, and remembers what the robot's jumps taught.

    Each plan is charged ``solve_s`` [s]; its own wall clock if None.
    """

    def __init__(
        self,
        course: Course,
        robot: Robot,
        planner: Planner,
        rehearsal: Rehearsal | None,
        solve_s: float | None = None,
        method: str = "three-step",
    ):
        self.course, self.robot, self.planner, self.rehearsal = course, robot, planner, rehearsal
        self._solve_s, self._method, self._offset = solve_s, method, np.zeros(5)
        self._missed: dict[int, float] = {}  # jump: by how much it fell short [m]
        self._misjudged: list[float] = []  # by how much places foretold in the air were too far ahead [m]
        self._zero: float | None = None  # where the chain began, by its own measurement [m]
        self._crouch = planner.stage("whole body" if method == "three-step" else "direct").stance

    def learn_posture(self, q: np.ndarray) -> None:
        """The robot stands still in ``q``: plans begin as far off the crouch as it is there.

        A robot that is heavier or leans sags, and the standing controller brings it to that same posture again.
        """
        self._offset = np.clip(posture(self.robot, q) - self._crouch, -LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD)

    def learn_place(self, last: Ahead, began_x: float, plans: list[Ahead], toe: np.ndarray) -> None:
        """Jump ``last`` began with the toes at ``began_x`` of the world and has brought them to ``toe``.

        ``plans`` are those of the next jump: what they foretold in the air can now be compared.
        """
        self._missed[last.number] = last.plan.task.distance_m - (float(toe[0]) - began_x)
        self._misjudged += [p.foretold_m - (float(toe[0]) - self._zero) for p in plans if p.air]

    @property
    def bias_m(self) -> float:
        """Mean of what the jumps so far fell short by [m]."""
        return float(np.clip(np.mean([*self._missed.values()] or [0.0]), -LARGEST_BIAS_M, LARGEST_BIAS_M))

    def look(
        self, number: int, time_s: float, toe: np.ndarray, air: bool = False, last: tuple[Ahead, float] | None = None
    ) -> Ahead:
        """Plan jump ``number`` for toes that stand, or in the ``air`` will stand, at ``toe`` (3,) of the world.

        ``last`` is the plan of the jump before, and the place from where it began.
        """
        began, cpu, plan, failure = time.perf_counter(), time.process_time(), None, ""
        if self._zero is None:
            self._zero = float(toe[0])
        foretold = float(toe[0]) - self._zero
        place = foretold - (float(np.mean(self._misjudged)) if air and self._misjudged else 0.0)
        if last is not None:
            self._missed[last[0].number] = last[0].plan.task.distance_m - (place + self._zero - last[1])
        start, bias = self._crouch + self._offset, self.bias_m
        try:
            task = self.course.task(number, self.course.goals_m[number] - place + bias)
            if self.rehearsal is None:
                plan = self.planner.plan(task, self._method, start=start)
            else:
                plan = self.planner.replan(self.rehearsal.plans[number], task, start=start)
        except JumplabError as e:
            failure = str(e)
        took, cpu = time.perf_counter() - began, time.process_time() - cpu
        charged = math.ceil((took if self._solve_s is None else self._solve_s) / STEP_S - 1e-9) * STEP_S
        joints = configuration(self.robot, start)[7:]
        return Ahead(number, time_s, air, foretold, place, start, joints, bias, charged, cpu, plan, failure)
