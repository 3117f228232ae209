"""The plan of the next jump, made from what is measured while the robot flies or lands, and what it cost."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np

from jumplab.errors import InfeasibleError, JumplabError, SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import configuration
from jumplab.sim.world import STEP_S
from jumplab.stages.planner import JumpPlan, Planner
from jumplab.studies.chain.course import Course, Gauge

LARGEST_BIAS_M = 0.10  # our choice: a robot that misses by more than this has another problem than a wrong model
LARGEST_OFFSET_RAD = 0.10  # our choice: a posture that is farther off the crouch is not the robot standing still


@dataclass(frozen=True)
class Rehearsal:
    """Plans of the whole course from the crouch at rest, made before it begins: where re-plans begin.

    Attributes
    ----------
    plans : one per jump; jumps with equal targets share one.
    """

    plans: tuple[JumpPlan, ...]

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

    All times are simulated [s], since the chain began.

    Attributes
    ----------
    number : of the jump, from 0.
    looked_s : when the state was measured.  air : whether the robot was in the air then.
    foretold_m : where the toes stood, or were going to stand, by that measurement, from where the chain began.
    place_m : the same, less what such forecasts were wrong by in this chain.
    start : (5,) link angles in which the plan begins.  joints : (nv - 6,) the same as joint angles [rad].
    bias_m : what was added to the distance because earlier jumps of this chain missed by it.
    solve_s : what planning was charged: its wall clock, in whole steps, unless another number was given.
    cpu_s : processor time of the same, which an idle core would need.
    plan : None if there is none; ``failure`` says why.
    needed_s : when the robot was first still enough to begin; None if it never was.
    began_s : when it began the jump; None if it never did.
    """

    number: int
    looked_s: float
    air: bool
    foretold_m: float
    place_m: float
    start: np.ndarray
    joints: np.ndarray
    bias_m: float
    solve_s: float
    cpu_s: float
    plan: JumpPlan | None
    failure: str = ""
    needed_s: float | None = None
    began_s: float | None = None

    @property
    def ready_s(self) -> float:
        """When the plan was there: measured, plus what planning took."""
        return self.looked_s + self.solve_s

    @property
    def in_time(self) -> bool:
        """Whether the plan was there when the robot was ready for it."""
        return self.plan is not None and self.needed_s is not None and self.ready_s <= self.needed_s


@dataclass
class Foresight:
    """Plans the next jump of a course from measurements, and remembers what the robot's jumps taught.

    Parameters
    ----------
    course, robot, planner, rehearsal : as planned.
    solve_s : what each plan is charged [s]; its own wall clock if None.
    """

    course: Course
    robot: Robot
    planner: Planner
    rehearsal: Rehearsal | None
    solve_s: float | None = None
    method: str = "three-step"
    _offset: np.ndarray = field(default_factory=lambda: np.zeros(5))
    _missed: dict = field(default_factory=dict)  # jump: by how much it fell short [m]
    _misjudged: list = field(default_factory=list)  # by how much places foretold in the air were too far ahead [m]
    _zero: float | None = None

    def __post_init__(self):
        self._gauge = Gauge(self.robot)
        self._crouch = self.planner.stage("whole body" if self.method == "three-step" else "direct").stance

    def learn_posture(self, q: np.ndarray) -> None:
        """The robot stands still in ``q``: plans begin as far off the crouch as it is there.

        A robot that is heavier or leans sags, and the standing controller brings it to that same posture again.
        """
        offset = self._gauge.posture(q) - self._crouch
        self._offset = np.clip(offset, -LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD)

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

    def look(self, number: int, time_s: float, toe: np.ndarray, air: bool = False,
             last: tuple[Ahead, float] | None = None) -> Ahead:  # fmt: skip
        """Plan jump ``number`` for toes that stand, or in the ``air`` will stand, at ``toe`` (3,) of the world.

        ``last`` is the plan of the jump before, and the place from where it began.
        """
        began, cpu, plan, failure = time.perf_counter(), time.process_time(), None, ""
        if self._zero is None:  # where the chain began, by its own measurement
            self._zero = float(toe[0])
        foretold = float(toe[0]) - self._zero
        place = foretold - (float(np.mean(self._misjudged)) if air and self._misjudged else 0.0)
        if last is not None:
            self._missed[last[0].number] = last[0].plan.task.distance_m - (place + self._zero - last[1])
        start, bias = self._crouch + self._offset, self.bias_m
        try:
            task = self.course.task(number, self.course.goals_m[number] - place + bias)
            if self.rehearsal is None:
                plan = self.planner.plan(task, self.method, start=start)
            else:
                plan = self.planner.replan(self.rehearsal.plans[number], task, start=start)
        except JumplabError as e:
            failure = str(e)
        took, cpu = time.perf_counter() - began, time.process_time() - cpu
        charged = took if self.solve_s is None else self.solve_s
        steps = math.ceil(charged / STEP_S - 1e-9)
        joints = configuration(self.robot, start)[7:]
        return Ahead(number, time_s, air, foretold, place, start, joints, bias, steps * STEP_S, cpu, plan, failure)
