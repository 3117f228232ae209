"""Result of the whole-body program."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jumplab.errors import Shown
from jumplab.io.tape import Tape
from jumplab.ocp.solution import PhaseSolution, Solution
from jumplab.stages.whole_body.apart import used_apart
from jumplab.stages.whole_body.between import used_between
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.program import Program, Solved
from jumplab.stages.whole_body.settings import Limits
from jumplab.stages.whole_body.starts import Attempt
from jumplab.stages.whole_body.tape import make_tape
from jumplab.task import JumpTask

NEAR = 1e-3  # of a limit's size: it binds


@dataclass(frozen=True, repr=False)
class WholeBodyPlan(Shown):
    """Result of the whole-body program.

    Attributes
    ----------
    solution : in the coordinates of the program.
    phases : the same with every coordinate of the robot, as one of ``schedule.whole``.
    edge_m : where the ground steps up or down, ahead of the toes' first place [m].
    limits : that it was made with.
    tape : the 1 kHz tape of the motion.
    used : largest share of the limits that the tape uses, also between the nodes [1].
    start : name of the start that led here.
    attempts : all that were made for the target.
    """

    task: JumpTask
    solution: Solution
    phases: Mapping[str, PhaseSolution]
    schedule: Schedule
    edge_m: float
    limits: Limits
    tape: Tape
    used: float
    start: str
    attempts: tuple[Attempt, ...] = ()

    @classmethod
    def of(cls, program: Program, task: JumpTask, solved: Solved, start: str) -> WholeBodyPlan:
        """The plan that a solution is, with its tape (1 kHz); ``start`` led to it."""
        robot = program.robot
        task = program.found(task, solved)
        surface = program.surface(task)
        phases = solved.phases
        with np.errstate(all="ignore"):  # a tape may diverge; its share is inf
            tape = make_tape(solved.schedule.whole, phases, task.gravity)
            used = max(
                used_between(tape, robot, surface, program.body),
                used_apart(program.body, solved.schedule.apart, list(phases.values()), tape),
            )
        return cls(
            task,
            solved.solution,
            phases,
            solved.schedule,
            surface.edge_m - robot.foot.toe + float(robot.foot.center[0]),
            program.limits,
            tape,
            used,
            start,
        )

    @property
    def binding(self) -> tuple[str, ...]:
        """Limits that bind, by what they are worth: the sum of their multipliers."""
        worth: Counter[str] = Counter()
        kinds = {(r["phase"], r["name"]): r["kind"] for r in self.solution.constraint_report}
        for (owner, name), (_, values) in self.solution.multipliers.rows.items():
            if kinds.get((owner, name)) == "inequality":
                worth[name] += float(np.abs(values).sum())
        return tuple(name for name, x in worth.most_common(5) if x > NEAR)

    @property
    def manner(self) -> dict[str, float]:
        """Manner of the jump, by fields of :class:`.Attempt`, in which plans of several starts
        differ.
        """
        q = self.tape.q[: self.tape.takeoff_index or None]
        swings = [np.ptp(q[:, 1 + column]) for column, _ in self.schedule.body.shoulders]
        heels = [x.q[-1, -1] for name, x in self.solution.phases.items() if name == "toe"]
        return {
            "cost": self.solution.statistics.objective,
            "crouch_m": float(q[0, 2] - q[:, 2].min()),
            "arms_rad": float(max(swings, default=0.0)),
            "heels_rad": float(max(heels, default=0.0)),
        }

    @property
    def launch_s(self) -> float:
        """Time until the feet first leave the ground [s]."""
        durations = [p.duration for p in self.solution.phases.values()]
        flying = [*(p.flying for p in self.schedule.contacts.phases), True]
        return float(sum(durations[: flying.index(True)]))

    @property
    def flight_s(self) -> float:
        """Duration of the first flight [s]; 0 if there is none."""
        pairs = zip(self.solution.phases.values(), self.schedule.contacts.phases, strict=True)
        return next((x.duration for x, p in pairs if p.flying), 0.0)
