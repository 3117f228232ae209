"""What to ask for instead of a jump that is refused: an easier one that has just been planned, and audited clean."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from jumplab.auditing import audit
from jumplab.errors import InfeasibleError, InputError, JumplabError, SolverError
from jumplab.io.progress import tell
from jumplab.ocp.nlp import EXPLAINED
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import USUAL, Planner
from jumplab.task import JumpTask

NEAR = {"height_m": 0.75, "distance_m": 0.55, "platform_m": 0.6}  # of a bound, which plans do not reach
MILDER = 0.6  # of a number that a solver could not meet
BEYOND = 1.4  # times the least distance that a platform takes
HIGHER = 3.0  # times the least height that a flip's rotation takes
ON_THE_SPOT = 3  # after so many tries a jump on the level that goes nowhere is the next
TRIES, LONGEST_S = 8, 30.0  # so many easier targets are tried, and none is begun after so long [s of CPU time]
THREE_STEPS = ("SRMP", "joint_map")  # where a refusal is none of the method "direct"
LEAST_M = 0.03  # of a height; no target may be lower than 0.02 m
NUMBERS = {"distance_m": "distance", "height_m": "height", "platform_m": "platform", "side_m": "side"}


def plan_or_advise(planner: Planner, task: JumpTask, method: str = USUAL) -> JumpPlan:
    """The plan of a target, as :meth:`jumplab.Planner.plan`; a refusal ends with an easier target that has a plan.

    Looking for that takes some seconds, so studies of many targets leave it out.
    """
    try:
        return planner.plan(task, method)
    except (InfeasibleError, SolverError) as e:
        raise advised(e, planner, task, method) from e


def advised(refusal: JumplabError, planner: Planner, task: JumpTask, method: str = USUAL) -> JumplabError:
    """The ``refusal`` again, ending with an easier target that has a clean plan, or saying that none was found.

    Each target that is tried is changed in the number that the one before was refused for.
    """
    explained, began = EXPLAINED.set(False), time.process_time()  # an explanation costs as much as a solve
    try:
        found = _advice(refusal, planner, task, method, began)
    finally:
        EXPLAINED.reset(explained)
    return _ending(refusal, found)


def _advice(refusal: JumplabError, planner: Planner, task: JumpTask, method: str, began: float) -> str:
    easier, said = task, refusal
    by_steps = getattr(refusal, "stage", "") in THREE_STEPS
    by_steps |= isinstance(refusal, InfeasibleError) and method == "three-step"  # stage 1's limits are not the robot's
    if by_steps and _refused(planner, task, "direct") is None:
        return "ask for the method 'direct', which has a plan"
    for number in range(TRIES):
        easier = _easier(easier, said, number)
        if easier is None or time.process_time() - began > LONGEST_S:
            break
        tell(f"refused; trying {words(task, easier)}")
        said = _refused(planner, easier, method)
        if said is None:
            return f"ask for {words(task, easier)}, which has a plan"
    return "none of the easier targets that were tried has a plan either"


def _refused(planner: Planner, task: JumpTask, method: str) -> JumplabError | None:
    """Why a target has no plan that passes its audit; None if it has one."""
    try:
        plan = planner.plan(task, method)
    except JumplabError as e:
        return e
    report = audit(plan.tape, plan.robot, task, edge_m=plan.summary["platform_edge_m"])
    return None if report.passed else SolverError("its plan fails its audit", stage="audit")


def _ending(refusal: JumplabError, text: str) -> JumplabError:
    said: Mapping[str, Any] = vars(refusal)
    return type(refusal)(f"{refusal}; {text}", **said)


def words(task: JumpTask, easier: JumpTask) -> str:
    """What is different about an easier target, as a person would say it."""
    names = [(name, word) for name, word in NUMBERS.items() if getattr(task, name) != getattr(easier, name)]
    found = [f"a {word} of {getattr(easier, name):g} m" for name, word in names]
    found += ["no rotation"] if task.rotation_rad != easier.rotation_rad else []
    found += [f"a turn of {math.degrees(easier.yaw_rad):g} deg"] if task.yaw_rad != easier.yaw_rad else []
    return " and ".join(found)


def _easier(task: JumpTask, refusal: JumplabError, tried: int) -> JumpTask | None:
    """An easier target: with the number changed that the ``refusal`` names, or distance and height in turns."""
    name, bound = getattr(refusal, "number", ""), getattr(refusal, "bound", None)
    if name == "rotation_rad":
        higher = None if bound is None else _rounded(HIGHER * bound, up=True)
        changes = {"rotation_rad": 0.0} if higher is None or higher <= task.height_m else {"height_m": higher}
    elif bound is not None:
        most, asked = NEAR[name] * bound, getattr(task, name)
        least = name == "distance_m" and bound > abs(asked)
        changes = {name: _rounded(BEYOND * bound, up=True) if least else math.copysign(_rounded(most), asked)}
    else:
        changes = _milder(task, " ".join(getattr(refusal, "violations", ())), tried)
    try:
        easier = replace(task, **changes)
    except InputError:  # beyond what a target can be
        return None
    return None if easier == task else easier


def _milder(task: JumpTask, violated: str, tried: int) -> dict[str, float]:
    low = "touchdown" in violated or "take-off length" in violated
    if task.platform_m and (low or tried % 2 == 0):
        return {"platform_m": _rounded(MILDER * task.platform_m)}
    if tried >= ON_THE_SPOT and (task.distance_m or task.platform_m):
        return {"distance_m": 0.0, "platform_m": 0.0}
    if task.rotation_rad and tried > 1:
        return {"rotation_rad": 0.0}
    if "take-off speed" in violated or tried % 2 or not (task.distance_m or not task.in_plane):
        return {"height_m": max(_rounded(MILDER * task.height_m), LEAST_M)}
    turned = {} if task.in_plane else {"side_m": _rounded(MILDER * task.side_m),
                                       "yaw_rad": math.radians(int(MILDER * math.degrees(task.yaw_rad)))}  # fmt: skip
    return {"distance_m": _rounded(MILDER * task.distance_m), **turned}


def _rounded(x: float, up: bool = False) -> float:
    """To whole centimetres, towards zero unless ``up``."""
    return math.copysign((math.ceil if up else math.floor)(100 * abs(x) + (-1e-9 if up else 1e-9)) / 100, x) + 0.0
