"""What a benchmark's numbers should reach, in words and limits; plans from ever denser atlases."""

from __future__ import annotations

from collections.abc import Mapping
from time import process_time
from typing import Any

import numpy as np

from jumplab.auditing import audit
from jumplab.robot import Robot
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import WholeBodyPlanner
from jumplab.studies.atlas import Atlas
from jumplab.task import JumpTask

# name in the report of jumplab.studies.bench -> (words, limit, aim); ratios of CPU times
GOALS = {
    "atlas_over_direct": ("plan from an atlas / direct NLP's solve", 0.10, None),
    "replan_over_direct": ("re-plan of a neighbouring target / direct NLP's solve", 0.12, None),
    "warm_over_direct": ("three steps, warm / direct NLP's solve", 0.35, 0.25),
    "three_over_direct_gn": ("three steps, warm / direct NLP begun with Gauss-Newton steps", 1.0, None),
    "cold_over_direct": ("new process to finished plan / direct NLP's build and solve", 1.5, None),
    "process_s": ("new process, functions on file, to the audit's end [s]", 1.2, None),
    "peak_memory_gib": ("peak memory of a new process [GiB]", 0.6, None),
    "node_growth_error": ("cost of an iteration: largest distance from a straight line over the nodes", 0.2, None),
}


def goals(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row per goal for a table: the number in words, its value, limit and aim, and whether it is reached."""
    rows = []
    for name, (words, limit, aim) in GOALS.items():
        value = found[name]
        verdict = "not measured here" if value is None else "reached" if value <= limit else "not reached"
        rows.append({"number": words, "value": value, "limit": limit, "aim": aim, "verdict": verdict})
    return rows


AREA_M = (0.4, 0.2)  # distance and height around the target that every atlas spans
SPACINGS = (1, 2, 4)  # intervals along each side
TARGETS = 6


def density(robot: Robot, task: JumpTask) -> list[dict[str, Any]]:
    """Plans from atlases of the same area and ever more nodes: what they take, and how much dearer than the best.

    The best is what ipopt finds from there, to its tolerance.
    """
    rng, body = np.random.default_rng(0), WholeBodyPlanner(robot, tracking=False, refine=False)
    low = max(task.distance_m - AREA_M[0] / 2, 0.0), max(task.height_m - AREA_M[1] / 2, 0.1)
    places = np.array(low) + rng.uniform(0.0, 1.0, (TARGETS, 2)) * AREA_M
    rows = []
    for count in SPACINGS:
        axes = [np.linspace(x, x + size, count + 1) for x, size in zip(low, AREA_M, strict=True)]
        atlas = Atlas.build(robot, *axes)
        planner, clean, took, dearer = Planner(robot, atlas=atlas), 0, [], []
        planner.plan(JumpTask(*places[0]))  # the first call of anything is not timed
        for place in places:
            other, began = JumpTask(*place), process_time()
            plan = planner.plan(other)
            took.append(process_time() - began)
            best = body.plan(other, near=plan.whole_body, settle=False).solution.statistics.objective
            dearer.append(plan.whole_body.solution.statistics.objective / best - 1)
            clean += audit(plan.tape, plan.robot, other).passed
        step = [round(size / count, 3) for size in AREA_M]
        row = {"nodes": len(atlas.nodes), "apart": f"{step[0]:g} x {step[1]:g}", "cpu_ms": 1e3 * float(np.median(took))}
        row |= {"dearer": 100 * float(np.median(dearer)), "most": 100 * max(dearer), "clean": clean, "of": TARGETS}
        rows.append(row)
    return rows
