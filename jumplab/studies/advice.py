"""Advice for a jump that is refused: an easier one that has just been planned, and passed its
audit.
"""

from __future__ import annotations

import json
import math
import time
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

from jumplab.errors import InfeasibleError, InputError, JumplabError, SolverError
from jumplab.io.progress import tell
from jumplab.ocp.cache import remembered
from jumplab.ocp.nlp import LEAST_S, left_s, patience, unexplained
from jumplab.robot import Robot
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import USUAL, Planner
from jumplab.stages.whole_body.ground import clear_of_edge_m
from jumplab.task import RANGES, JumpTask

MILDER = 0.6  # of a number that was refused
BEYOND = 1.4  # times the least distance that a platform takes
ON_THE_SPOT = 3  # after so many tries a jump on the level that goes nowhere is the next
# so many easier targets are tried, and none is begun after so long [s of CPU time], or once the
# patience for the target itself is spent and so many times of it besides: a refusal after
# the usual 20 s ends within 25, the last program that was begun included
TRIES = 8
LONGEST_S = 30.0
AFTER = 0.1
THREE_STEPS = ("SRMP", "joint_map")  # where a refusal is none of the method "direct"
NEAR_RECORD = 0.85  # share of a record, from where on a refusal names it
STEPS = 2  # of a run-up for a distance that is too far from a stand
RECORDS = Path(__file__).with_name("records.json")
LEAST_M = 0.03  # of a height; no target may be lower than 0.02 m


def plan_or_advise(
    planner: Planner,
    task: JumpTask,
    method: str = USUAL,
    patience_s: float = math.inf,
    starts: int = 1,
) -> JumpPlan:
    """The plan of a target, as :meth:`jumplab.Planner.plan` (by ``method``, of the cheapest of
    ``starts``); a refusal ends with an easier target that has a plan.

    Planning ends after ``patience_s`` of processor time [s]. Looking for another target takes what
    is left of it, and at most a tenth more, so studies of many targets leave it out.
    """
    began = time.thread_time()
    with patience(patience_s):
        try:
            more = {} if starts == 1 else {"starts": starts}
            return planner.plan(task, method, **more)
        except (InfeasibleError, SolverError) as e:
            refusal = e
            spent_s = patience_s if left_s() <= 0 else None
    longest = (1 + AFTER) * patience_s - (time.thread_time() - began)
    with patience(max(min(longest, LONGEST_S), LEAST_S)):
        raise advised(refusal, planner, task, method, spent_s) from refusal


def advised(
    refusal: JumplabError,
    planner: Planner,
    task: JumpTask,
    method: str = USUAL,
    spent_s: float | None = None,
) -> JumplabError:
    """The ``refusal`` again (same type, same fields), ending with an easier target that has a plan
    which passes its audit, or saying which were tried.

    Each target that is tried is milder than the one before, in one of its numbers. ``spent_s`` is
    the processor time [s] after which planning was given up, if it was.
    """
    with unexplained():
        # little time is left for a jump then, which should not be one of the hard ones again
        advice = _advice(refusal, planner, task, method, steps=1 if spent_s is None else 2)
    if spent_s is not None:
        advice = f"planning was given up after {spent_s:g} s of processor time; {advice}"
    sentence = "; ".join([str(refusal), *_records_near(planner.robot, task), advice])
    return type(refusal)(sentence, **vars(refusal))


def keep_record(robot: Robot, what: str, value: float) -> None:
    """Keep a record of a robot [m, rad] within the usual limits, for refusals to come (see
    :mod:`jumplab.ocp.cache`).
    """
    remembered(["record", what], robot.hash, lambda: value)


def known_record(robot: Robot, what: str) -> float | None:
    """The largest record that was kept, or comes with the package [m, rad]; None without one."""
    known = [_shipped().get(robot.hash, {}).get(what, 0.0)]
    with suppress(LookupError):
        known.append(remembered(["record", what], robot.hash, lambda: {}["no record"]))
    return max(known) or None


@cache
def _shipped() -> dict[str, dict[str, float]]:
    """Records of the robots with a name [m, rad], by their hashes."""
    return json.loads(RECORDS.read_text(encoding="utf-8"))


def _records_near(robot: Robot, task: JumpTask) -> list[str]:
    """Records of a robot that a target comes near to, or exceeds, in words."""
    sentences = []
    for what in ("height_m", "distance_m", "platform_m", "side_m", "yaw_rad"):
        asked = abs(getattr(task, what))
        record = known_record(robot, what) if asked else None
        if record is not None and asked > NEAR_RECORD * record:
            unit = "rad" if what == "yaw_rad" else "m"
            sentences.append(
                f"the record of {robot.name} is a {RANGES[what][0]} of at least {record:.3f} {unit}"
            )
    return sentences


def _advice(
    refusal: JumplabError, planner: Planner, task: JumpTask, method: str, steps: int
) -> str:
    # stage 1's limits are not the robot's
    by_steps = method == "three-step" or getattr(refusal, "stage", "") in THREE_STEPS
    if by_steps and refused(planner, task, "direct") is None:
        return "ask for the method 'direct', which has a plan"
    easier = task
    tried = []
    number = 0
    while number < TRIES:
        last = easier
        for step in range(steps):
            # a lower jump onto a platform is no easier one
            tries = number + step * (not task.platform_m)
            easier = _easier(easier, refusal, tries, planner.robot) or easier
        number += steps
        if easier == last or left_s() <= 0:
            break
        tried.append(words(task, easier))
        tell(f"refused; trying {tried[-1]}")
        refusal = refused(planner, easier, method)
        if refusal is None:
            other = _run_up(planner, task, easier) if steps == 1 else ""  # where time is left
            return f"ask for {tried[-1]}, which has a plan{other}"
    if not tried:
        return "no easier target was tried"
    return f"none of the easier targets that were tried has a plan either: {'; '.join(tried)}"


def _run_up(planner: Planner, task: JumpTask, easier: JumpTask) -> str:
    """The run-up that reaches a distance which is too far from a stand, in words; empty if there is
    none, or no time for it.
    """
    alone = task.standing and task.in_plane and not task.rotation_rad
    if not alone or not abs(easier.distance_m) < task.distance_m or left_s() <= 0:
        return ""
    running = replace(task, takeoff="left", run_up=STEPS)
    run_up = f"a run-up of {STEPS} steps (takeoff='left', run_up={STEPS})"
    tell(f"refused; trying {run_up}")
    if refused(planner, running, USUAL) is not None:
        return ""
    return f"; or for {run_up}, which reaches {task.distance_m:g} m"


def refused(planner: Planner, task: JumpTask, method: str) -> JumplabError | None:
    """Reason why a target has no plan that passes its audit; None if it has one."""
    try:
        plan = planner.plan(task, method)
    except JumplabError as e:
        return e
    return None if plan.audit.passed else SolverError("its plan fails its audit", stage="audit")


def words(task: JumpTask, easier: JumpTask) -> str:
    """Differences of an easier target [m, deg], in a person's words."""
    changes = [
        f"a {name.removesuffix('_m')} of {getattr(easier, name):g} m"
        for name in ("distance_m", "height_m", "platform_m", "side_m")
        if getattr(task, name) != getattr(easier, name)
    ]
    if task.rotation_rad != easier.rotation_rad:
        changes.append("no rotation")
    if task.yaw_rad != easier.yaw_rad:
        changes.append(f"a turn of {math.degrees(easier.yaw_rad):g} deg")
    return " and ".join(changes)


def _easier(task: JumpTask, refusal: JumplabError, tried: int, robot: Robot) -> JumpTask | None:
    """An easier target of a ``robot`` than one that got this ``refusal``, the number ``tried``;
    None if there is none.
    """
    bound = getattr(refusal, "bound", None)
    climbs = task.in_plane and task.standing and task.platform_m > 0
    # an edge may be what is too near, unless the refusal names another number
    near = climbs and 0 <= task.distance_m < clear_of_edge_m(robot)
    if near and getattr(refusal, "number", "distance_m") == "distance_m":
        changes = {"distance_m": clear_of_edge_m(robot)}
    elif bound is None:
        changes = _milder(task, tried)
    else:  # the least distance that its platform takes, or the most that any motion reaches
        x = getattr(task, refusal.number)
        beyond = abs(x) > bound
        factor = math.copysign(MILDER if beyond else BEYOND, x)
        changes = {refusal.number: _milder_m(factor, bound)}
    try:
        easier = replace(task, **changes)
    except InputError:  # beyond what a target can be
        return None
    return None if easier == task else easier


def _milder(task: JumpTask, tried: int) -> dict[str, float]:
    if task.platform_m and tried % 2 == 0:
        return {"platform_m": _milder_m(MILDER, task.platform_m)}
    if tried >= ON_THE_SPOT and (task.distance_m or task.platform_m):
        return {"distance_m": 0.0, "platform_m": 0.0}
    if task.rotation_rad and tried > 1:
        return {"rotation_rad": 0.0}
    height = max(_milder_m(MILDER, task.height_m), LEAST_M)
    # small robots are asked for less than that
    if height < task.height_m and (tried % 2 or (task.distance_m == 0 and task.in_plane)):
        return {"height_m": height}
    return {
        "distance_m": _milder_m(MILDER, task.distance_m),
        "side_m": _milder_m(MILDER, task.side_m),
        "yaw_rad": math.radians(int(MILDER * math.degrees(task.yaw_rad))),
    }


def _milder_m(factor: float, x: float) -> float:
    """A length [m] times a ``factor``, to whole centimetres towards zero."""
    return math.trunc(100 * factor * x + math.copysign(1e-9, x)) / 100
