"""A target close by that stage 1 can plan, told when the one that was asked for has no plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from jumplab.errors import InputError, JumplabError, SolverError
from jumplab.task import JumpTask

STEPS = (4, 10)  # our choice: the closed forms pass targets that are so many steps too hard, seldom more
STEP_M = 0.01  # our choice: targets are told in centimetres
DISTANCE_STEP_M = 0.05  # our choice: distance has the widest range of the three


def nearest(task: JumpTask, failure: SolverError, plan: Callable[[JumpTask], object]) -> SolverError:
    """``failure`` again, ending with a target close to ``task`` that ``plan`` was able to plan, if one was found."""
    for better, words in _easier(task, " ".join(failure.violations)):
        try:
            plan(better)
        except JumplabError:
            continue
        text = f"{failure}; {words} can be planned"
        return SolverError(text, stage=failure.stage, status=failure.status, violations=failure.violations)
    return failure


def _easier(task: JumpTask, violations: str) -> Iterator[tuple[JumpTask, str]]:
    """Easier targets, the least change first, along the number that the violated terms point to."""
    for k in STEPS:
        try:
            if "take-off speed" in violations:
                height = math.floor((task.height_m - k * STEP_M) / STEP_M + 1e-9) * STEP_M
                yield replace(task, height_m=height), f"the same target with a height of {height:.2f} m"
            elif task.platform_m > 0 and ("touchdown" in violations or "take-off length" in violations):
                platform = math.floor((task.platform_m - k * STEP_M) / STEP_M + 1e-9) * STEP_M
                yield replace(task, platform_m=platform), f"the same target with a platform of {platform:.2f} m"
            else:
                distance = math.copysign(max(abs(task.distance_m) - k * DISTANCE_STEP_M, 0.0), task.distance_m)
                yield replace(task, distance_m=distance), f"the same target with a distance of {distance:.2f} m"
        except InputError:  # beyond what a target can be
            return
