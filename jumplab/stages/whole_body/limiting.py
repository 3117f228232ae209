"""Limits of the robot that a motion lies at, and those that hold it back where there is no plan."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from jumplab.errors import SolverError
from jumplab.ocp.problem import Phase
from jumplab.stages.whole_body.mode import held_joints
from jumplab.stages.whole_body.terms import HOLDING, TORQUE_SPEED

if TYPE_CHECKING:
    from jumplab.stages.whole_body.program import Program

NAMED = 2  # joints at most, each of at least so large a share of the most that one is worth
SHARE = 0.3


def limit_of(
    phase: Phase, program: Program, term: str, column: int, way: int
) -> tuple[str, str] | None:
    """A limit in words and its joint, upper or lower (``way`` 1, -1); None for those of numbers
    that nobody has set.
    """
    if term == "bounds of constants":
        return (f"duration of {phase.name}", "") if column == 0 else None
    if term == TORQUE_SPEED:
        return term, program.body.joint_names[program.free.joints[column]]
    if term == HOLDING:
        held, locked = held_joints(program.body, program.free)
        names = [program.body.joint_names[k] for k in held] + [x.name for x in locked]
        return "torque", names[column]
    if term != "bounds of nodes":
        return term, ""
    count = len(phase.coordinates)
    if column < 3 * count:
        kind = ("upper stop" if way > 0 else "lower stop", "speed", None)[column // count]
        return kind and (kind, phase.coordinates[column % count])
    _, of, joint = phase.states[column - 3 * count].partition("torque of ")
    return ("torque", joint) if of else None


def held_back(program: Program, failure: SolverError) -> str:
    """The joints whose limits hold back the best compromise of a failed search, in words with the
    limits; "" if none does, or if nobody looked.
    """
    phases = {p.name: p for p in program.nlp.problem.phases}
    worth = Counter()
    for (owner, term), column, _, lam, limit in failure.limits:
        size = lam * np.where(np.isfinite(limit), np.abs(limit), 0.0)
        for way in (1, -1):
            key = owner in phases and limit_of(phases[owner], program, term, column, way)
            if key and key[1] in program.robot.actuators:
                worth[key] += float(np.maximum(way * size, 0.0).sum())
    most = max(worth.values(), default=0.0)
    words = []
    for (limit, joint), x in worth.most_common(NAMED):
        if x <= SHARE * most:
            break
        a = program.robot.actuators[joint]
        if limit.endswith("stop"):
            words.append(f"the {limit} of joint {joint!r}, {a[limit.split()[0]]:.3g} rad")
        elif limit == "speed":
            words.append(f"the speed of joint {joint!r}, {a['speed']:.3g} rad/s")
        else:
            at = f" up to {a['speed']:.3g} rad/s" * (limit == TORQUE_SPEED)
            words.append(f"the torque of joint {joint!r}, {a['effort']:.3g} N m{at}")
    return " and ".join(words)
