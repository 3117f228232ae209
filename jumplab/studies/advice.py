"""What to ask for instead of a jump that is refused: an easier one that has just been planned, and audited clean."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from jumplab.auditing import audit
from jumplab.errors import InfeasibleError, InputError, JumplabError, SolverError
from jumplab.io.progress import tell
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask

SHARES = (0.9, 0.7, 0.45, 0.25)  # of the bound, or of what was asked for
BOTH = (0.7, 0.5, 0.3)  # of distance and height at once, when one number alone does not help
HIGHER = (3.0, 4.0)  # times the least height that a flip's rotation takes
LONGEST_S = 12.0  # after so long no further target is tried
LEAST_M, NUMBERS = 0.05, {"distance_m": "distance", "height_m": "height", "platform_m": "platform", "side_m": "side"}


def plan_or_advise(planner: Planner, task: JumpTask, method: str = "three-step") -> JumpPlan:
    """The plan of a target, as :meth:`jumplab.Planner.plan`; a refusal ends with an easier target that has a plan.

    Looking for that takes some seconds, so studies of many targets leave it out.
    """
    try:
        return planner.plan(task, method)
    except (InfeasibleError, SolverError) as e:
        raise advised(e, planner, task, method) from e


def advised(refusal: JumplabError, planner: Planner, task: JumpTask, method: str = "three-step") -> JumplabError:
    """The ``refusal`` again, ending with an easier target that has a clean plan, or saying that none was found."""
    began = time.monotonic()
    if method == "three-step" and isinstance(refusal, SolverError) and _clean(planner, task, "direct"):
        return _ending(refusal, "ask for the method 'direct', which has a plan")
    for easier in dict.fromkeys(_easier(task, refusal)):
        if time.monotonic() - began > LONGEST_S:
            break
        tell(f"refused; trying {words(task, easier)}")
        if _clean(planner, easier, method):
            return _ending(refusal, f"ask for {words(task, easier)}, which has a plan")
    return _ending(refusal, "none of the easier targets that were tried has a plan either")


def _clean(planner: Planner, task: JumpTask, method: str) -> bool:
    """Whether a target has a plan that passes its audit."""
    try:
        plan = planner.plan(task, method)
    except JumplabError:
        return False
    return audit(plan.tape, plan.robot, task, edge_m=plan.summary["platform_edge_m"]).passed


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


def _easier(task: JumpTask, refusal: JumplabError) -> Iterator[JumpTask]:
    """Easier targets, the least change first, along the number that the refusal points to."""
    for changes in _changes(task, refusal):
        try:
            other = replace(task, **changes)
        except InputError:  # beyond what a target can be
            continue
        if other != task:
            yield other


def _changes(task: JumpTask, refusal: JumplabError) -> Iterator[dict[str, float]]:
    violated = " ".join(getattr(refusal, "violations", ()))
    number, bound = getattr(refusal, "number", ""), getattr(refusal, "bound", None)
    if not number:
        low = "touchdown" in violated or "take-off length" in violated
        number = "height_m" if "take-off speed" in violated else "platform_m" if task.platform_m > 0 and low else ""
    if number == "rotation_rad" and bound is not None:
        yield from ({"height_m": _rounded(share * bound, up=True)} for share in HIGHER)
        yield {"rotation_rad": 0.0}
    elif number in NUMBERS:
        most = getattr(task, number) if bound is None else math.copysign(bound, getattr(task, number))
        yield from ({number: _rounded(share * most)} for share in SHARES)
    if number != "distance_m" and task.distance_m:
        yield from ({"distance_m": _rounded(share * task.distance_m)} for share in SHARES)
    if not task.in_plane:
        far, wide, turn = task.distance_m, task.side_m, math.degrees(task.yaw_rad)
        yield from ({"distance_m": _rounded(s * far), "side_m": _rounded(s * wide),
                     "yaw_rad": math.radians(round(s * turn))} for s in BOTH)  # fmt: skip
    for share in BOTH:
        yield {
            "distance_m": _rounded(share * task.distance_m),
            "height_m": max(_rounded(share * task.height_m), LEAST_M),
        }
    yield {"distance_m": 0.0, "height_m": max(_rounded(BOTH[-1] * task.height_m), LEAST_M), "platform_m": 0.0}
    if task.rotation_rad:
        yield {"rotation_rad": 0.0}


def _rounded(x: float, up: bool = False) -> float:
    """To whole centimetres, towards zero unless ``up``."""
    return math.copysign((math.ceil if up else math.floor)(100 * abs(x) + (-1e-9 if up else 1e-9)) / 100, x) + 0.0
