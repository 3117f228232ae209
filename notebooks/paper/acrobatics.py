"""What a G1 can do within its motors' curves, and by how much they forbid the rest: the rows of ``acrobatics.json``.

``python -m paper.acrobatics`` in the folder of the notebooks plans every jump of :data:`ASKED` that has no row yet; those
that are planned clean are played back in both engines and both modes. Notebook 07 prints the rows.
"""

from __future__ import annotations

import json
import math
import time
from functools import cache
from pathlib import Path
from typing import Any

from jumplab import api
from jumplab.errors import JumplabError
from jumplab.robot import Robot
from jumplab.sim import INSTALLED
from jumplab.sim.playback import MODES
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask

TABLE = Path(__file__).with_name("acrobatics.json")
# robot, factor on efforts and speeds of all motors, distance, rise, platform [m], turns about +y, method
Asked = tuple[str, float, float, float, float, int, str]
LEAST, MOST = "direct", "three-step"


def rows() -> list[dict[str, Any]]:
    """The table: what was asked, what became of the plan, which limit it uses most, and how it landed."""
    return json.loads(TABLE.read_text(encoding="utf-8"))


@cache
def planner(name: str, factor: float) -> Planner:
    """Of a robot with motors that are stronger, and faster, by a factor."""
    robot = Robot.load(name)
    return Planner(robot if factor == 1 else robot.with_limits(effort=factor, speed=factor))


def attempt(asked: Asked) -> dict[str, Any]:
    """One row: the plan, its audit, and, where that is clean, its simulations."""
    name, factor, distance, height, platform, turns, method = asked
    row: dict[str, Any] = dict(zip(("robot", "factor", "distance_m", "height_m", "platform_m", "turns", "method"), asked))
    task = JumpTask(distance, height, platform_m=platform, rotation_rad=2 * math.pi * turns)
    start = time.process_time()
    try:
        plan = planner(name, factor).plan(task, method=method)
    except JumplabError as e:
        return row | {"clean": False, "said": str(e), "cpu_s": round(time.process_time() - start, 1)}
    report = api.audit(plan)
    used = max((c for c in report.checks if c.group == "joints" and c.unit == "%"), key=lambda c: c.value)
    failed = [f"{c.name}: {c.value:.3g} {c.unit}, at most {c.limit:g}" for c in report.checks if not c.passed]
    row |= {"clean": report.passed, "said": "; ".join(failed), "cpu_s": round(time.process_time() - start, 1)}
    row |= {"used": [used.name, round(used.value, 1), used.note.rpartition("worst: ")[2]]}
    if report.passed:
        row["landed"] = {f"{e} {m}": _landing(plan, e, m) for e in INSTALLED for m in MODES}
    return row


def _landing(plan: Any, engine: str, mode: str) -> list[Any]:
    """Whether a playback landed and its findings passed, distance and rise [m], and why it ended."""
    run = api.simulate(plan, engine=engine, mode=mode)
    sound = run.landed and all(finding.passed for finding in run.checks)
    far, high = run.metrics.foot_distance_m, run.metrics.com_rise_m
    return [sound, far and round(far, 3), high and round(high, 3), run.reason]
