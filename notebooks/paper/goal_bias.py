"""The paper's remark that a missed target "can be solved by adding bias to the optimisation's goal" (Sec. VI-B).

``python -m paper.goal_bias`` in the folder of the notebooks does so with the robots that :data:`LOG` lacks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, InputError, SolverError
from jumplab.robot import Robot
from jumplab.sim import Perturbation, Scene, SimulationResult, simulate_jump
from jumplab.stages.planner import JumpPlan, Planner
from jumplab.task import JumpTask
from paper import logs

LOG, ROBOTS, GOAL = Path(__file__).with_name("bias.jsonl"), 24, JumpTask(1.0, 0.5)
TOLERANCE = 0.02  # share of the goal
LEAST_TOLERANCE_M = 0.005  # where 2 % of the goal is less, as in a jump on the spot
TRIES = 6  # "a few jumps"; the correction usually needs two or three


@dataclass(frozen=True)
class BiasedJump:
    """One jump on the way to the goal.

    Attributes
    ----------
    target : what was planned.
    distance_m, rise_m : what the simulated robot did; the distance of a jump that fell is that at touchdown.
    distance_error_m, rise_error_m : the same minus the goal.
    landed, reason : the verdict, and why.
    hit : landed, with both errors within the tolerance.
    """

    target: JumpTask
    distance_m: float
    rise_m: float
    distance_error_m: float
    rise_error_m: float
    landed: bool
    reason: str
    hit: bool


@dataclass(frozen=True)
class GoalBias:
    """A goal that has been reached.

    Attributes
    ----------
    goal : what was wished.
    jumps : all jumps, the last of which hit it.
    plan, result : of the last jump.
    """

    goal: JumpTask
    jumps: tuple[BiasedJump, ...]
    plan: JumpPlan
    result: SimulationResult

    @property
    def bias_m(self) -> tuple[float, float]:
        """Correction that the goal needed: distance, height [m]."""
        target = self.jumps[-1].target
        return target.distance_m - self.goal.distance_m, target.height_m - self.goal.height_m


def reach_goal(
    goal: JumpTask,
    planner: Planner,
    *,
    perturbation: Perturbation | None = None,
    mode: str = "position",
    reaim: bool = False,
    method: str = "three-step",
    tolerance: float = TOLERANCE,
    tries: int = TRIES,
    simulate: Callable[..., SimulationResult] = simulate_jump,
) -> GoalBias:
    """Jump, see by how much the goal was missed, shift the target by that, and jump again.

    A metre more in the target is taken for a metre more in the jump. The ground is always that of the goal: a platform
    does not move with the target.

    Parameters
    ----------
    goal : what distance and rise of the simulated jump shall be.
    planner : of the robot as it is believed to be; kept for all tries.
    perturbation : how the simulated robot differs from it.
    mode, reaim : see :func:`jumplab.sim.simulate_jump`.
    method : of planning, see :meth:`jumplab.stages.planner.Planner.plan`.
    tolerance : allowed error as a share of the goal [1].
    tries : most jumps, the first of which has no bias.
    simulate : what makes a jump of a tape.

    Raises
    ------
    InputError
        If tolerance or tries cannot be meant, or the goal itself cannot.
    InfeasibleError
        If the goal is not hit within ``tries``, or the biased target cannot be planned, or the feet never come down.
    SolverError
        If a plan fails otherwise.
    """
    if not 0 < tolerance <= 1:
        raise InputError(f"tolerance = {tolerance:g} is outside 0 ... 1; 0.02 is 2 % of the goal")
    if isinstance(tries, bool) or not isinstance(tries, int) or tries < 1:
        raise InputError(f"tries = {tries!r}: must be a whole number, at least 1")
    jumps: list[BiasedJump] = []
    target, scene = goal, None
    for _ in range(tries):
        plan = _plan(planner, target, method, jumps)
        scene = scene or Scene.of_plan(plan.summary, planner.robot)
        result = simulate(plan.tape, planner.robot, mode=mode, perturbation=perturbation, scene=scene, reaim=reaim)
        jumps.append(_judge(goal, target, result, tolerance))
        if jumps[-1].hit:
            return GoalBias(goal, tuple(jumps), plan, result)
        target = replace(
            goal,
            distance_m=target.distance_m - jumps[-1].distance_error_m,
            height_m=target.height_m - jumps[-1].rise_error_m,
        )
    raise InfeasibleError(
        f"the goal was not hit within {tries} jumps; {_last(jumps)}; allow more tries, or a larger "
        f"tolerance than {tolerance:.1%}"
    )


def _plan(planner: Planner, target: JumpTask, method: str, jumps: list[BiasedJump]) -> JumpPlan:
    try:
        return planner.plan(target, method)
    except (InputError, InfeasibleError) as e:
        if not jumps:
            raise
        raise InfeasibleError(
            f"the target {target.distance_m:.3f} m with a rise of {target.height_m:.3f} m, which the "
            f"goal's bias asks for, cannot be planned ({e}); {_last(jumps)}"
        ) from e


def _judge(goal: JumpTask, target: JumpTask, result: SimulationResult, tolerance: float) -> BiasedJump:
    m = result.metrics
    distance = m.foot_distance_m if m.landed else m.foot_distance_touchdown_m
    if distance is None or m.com_rise_m is None:
        raise InfeasibleError(f"there is no error to correct: planned for {target.distance_m:.3f} m, {m.reason}")
    errors = distance - goal.distance_m, m.com_rise_m - goal.height_m
    allowed = (max(tolerance * abs(x), LEAST_TOLERANCE_M) for x in (goal.distance_m, goal.height_m))
    hit = m.landed and all(abs(error) <= most for error, most in zip(errors, allowed, strict=True))
    return BiasedJump(target, distance, m.com_rise_m, *errors, m.landed, m.reason, hit)


def _last(jumps: list[BiasedJump]) -> str:
    j = jumps[-1]
    said = "landed" if j.landed else j.reason
    return (
        f"the last one, planned for {j.target.distance_m:.3f} m and {j.target.height_m:.3f} m, reached "
        f"{j.distance_m:.3f} m and {j.rise_m:.3f} m ({said})"
    )


# ---------------------------------------------------------------------------------------------- many robots


def study(path: Path = LOG, robots: Sequence[int] = range(1, ROBOTS + 1)) -> None:
    """Correct one robot after another, each drawn from the usual ranges by its number; a row each."""
    planner = Planner(Robot.load())
    with logs.keep(path, itemgetter("robot"), robot=planner.robot) as log:
        for seed in robots:
            if seed not in log.done:
                log.add({"robot": seed} | corrected(GOAL, planner, Perturbation.draw(planner.robot, seed)))


def corrected(goal: JumpTask, planner: Planner, different: Perturbation) -> dict[str, Any]:
    """Result of one robot, in plain data: its first jump, the number of its jumps, and whether the last hit the goal.
    """
    runs: list[SimulationResult] = []

    def simulate(*args: Any, **options: Any) -> SimulationResult:
        runs.append(simulate_jump(*args, **options))
        return runs[-1]

    row: dict[str, Any] = {"hit": True, "reason": ""}
    try:
        reach_goal(goal, planner, perturbation=different, simulate=simulate)
    except (InfeasibleError, SolverError) as e:
        row = {"hit": False, "reason": str(e)}
    first = runs[0].metrics
    row |= {"jumps": len(runs), "landed": [run.landed for run in runs]}
    if first.foot_distance_m is not None:
        row["missed_mm"] = [1e3 * (first.foot_distance_m - goal.distance_m), 1e3 * (first.com_rise_m - goal.height_m)]
    return row


def told(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Number of robots that land at once, median and worst of their miss [mm], number that hit the goal, and their
    jumps.
    """
    first = [abs(row["missed_mm"][0]) for row in rows if row["landed"][0]]
    hit = [row["jumps"] for row in rows if row["hit"]]
    return {
        "robots": len(rows),
        "land at once": len(first),
        "miss, median [mm]": float(np.median(first)),
        "miss, worst [mm]": max(first),
        "hit": len(hit),
        "jumps, median": float(np.median(hit)),
    }


if __name__ == "__main__":
    study()
