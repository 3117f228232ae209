"""Times of planning, sort by sort, in one run on one machine: medians over some targets, and ratios.

Times are processor time: ``solver_s`` of all attempts, ``plan_s`` of the whole call, its tape and
checks included. Ratios are of ``solver_s`` against the jumps straight ahead of the same run. Every
plan that was timed is audited afterwards.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import joblib
import numpy as np

from jumplab.auditing.audit import audit
from jumplab.errors import InputError, JumplabError
from jumplab.io.folder import versions
from jumplab.robot import Robot
from jumplab.stages.planner import Planner
from jumplab.studies.atlas import Atlas
from jumplab.studies.study import Plain
from jumplab.task import JumpTask

TASK = JumpTask(1.0, 0.5)  # the paper's target
NEARER_M = 0.05  # of the neighbour from whose plan a re-plan begins
ATLAS = (0.8, 1.0)  # its two distances and heights, as shares of the task's
# targets: shares of the task's distance and height, way to the left as a share of the distance,
# turn about the vertical [deg], flips
AHEAD = (
    (0.8, 0.8, 0, 0, 0),
    (0.85, 0.9, 0, 0, 0),
    (0.9, 0.8, 0, 0, 0),
    (0.95, 1, 0, 0, 0),
    (1, 0.9, 0, 0, 0),
    (1, 1, 0, 0, 0),
)
ASIDE = (
    (0, 0.8, 0.4, 0, 0),
    (0.2, 0.8, -0.1, 60, 0),
    (0.3, 0.6, 0, 90, 0),
    (0.5, 0.6, 0, 45, 0),
    (0.5, 0.6, 0.2, 0, 0),
    (0.4, 0.8, 0.2, -45, 0),
)
FLIPS = (
    (0, 0.8, 0, 0, 1),
    (0, 1, 0, 0, 1),
    (0.2, 1, 0, 0, 1),
    (0, 0.8, 0, 0, -1),
    (0, 1, 0, 0, -1),
    (0.2, 1, 0, 0, -1),
)
BASE = "ahead"  # the sort that ratios are of
FROM_ATLAS = "ahead, from an atlas"
STEPS = "ahead, three steps"  # only of robots that five links describe
SORTS = {
    BASE: AHEAD,
    "ahead, re-planned": AHEAD,
    FROM_ATLAS: AHEAD,
    STEPS: AHEAD,
    "aside": ASIDE,
    "aside, re-planned": ASIDE,
    "flips": FLIPS,
}
MEASURED = ("solver_s", "plan_s", "iterations")
COLUMNS = {
    "sort": "",
    "targets": "targets",
    "planned": "planned",
    "clean": "clean",
    "solver_s": "solver, CPU [s]",
    "plan_s": "with tape, CPU [s]",
    "iterations": "iterations",
    "ratio": "ratio",
}


def targets(task: JumpTask, sort: str) -> list[JumpTask]:
    """The targets of a ``sort`` (see :data:`SORTS`), around one ``task``."""
    return [
        replace(
            task,
            distance_m=far * task.distance_m,
            height_m=high * task.height_m,
            side_m=left * task.distance_m,
            yaw_rad=float(np.radians(turn)),
            rotation_rad=2 * np.pi * flips,
        )
        for far, high, left, turn, flips in SORTS[sort]
    ]


def bench(
    robot: str = "bhr",
    task: JumpTask = TASK,
    repeats: int = 3,
    *,
    sorts: Sequence[str] = tuple(SORTS),
    most: int | None = None,
    say: Callable[[str], None] = print,
) -> Plain:
    """Time all ``sorts`` of :data:`SORTS`, each target (or the first ``most``) ``repeats`` times; plain types.

    Returns
    -------
    dict with ``rows`` (see :func:`rows`), robot, target, repeats, machine, and ``raw``: sort -> one
    dict for each plan with target, solver_s, plan_s, iterations, stages, clean, or with the reason
    for which there is none.

    Raises
    ------
    InputError
        For fewer repeats than 1, or a sort that does not exist.
    """
    if repeats < 1:
        raise InputError(f"repeats = {repeats}: it takes 1 or more")
    if unknown := [name for name in sorts if name not in SORTS]:
        raise InputError(f"sort {unknown[0]!r}: there are {', '.join(SORTS)}")
    jumper = Robot.load(robot)
    raw = {}
    for name in sorts:
        if name == STEPS and not jumper.planar:
            continue
        tasks = targets(task, name)[:most]
        say(f"{name}: {len(tasks)} targets, {repeats} times each")
        planner = Planner(jumper)
        if name == FROM_ATLAS:
            axes = [[share * x for share in ATLAS] for x in (task.distance_m, task.height_m)]
            planner = Planner(jumper, atlas=Atlas.build(jumper, *axes, keep=False))
        _timed(planner, name, tasks[0], 1)  # the first call of anything is not timed
        raw[name] = [row for target in tasks for row in _timed(planner, name, target, repeats)]
    machine = {
        "processor": platform.machine(),
        "system": platform.system(),
        "cpus": joblib.cpu_count(),
        "load": os.getloadavg()[0],
        "versions": versions(),
    }
    head = {"robot": jumper.name, "target": vars(task), "repeats": repeats}
    return {**head, "rows": rows(raw), "raw": raw, "machine": machine}


def _timed(planner: Planner, sort: str, target: JumpTask, repeats: int) -> list[Plain]:
    """One row for each time that a target is planned; one with the reason if there is no plan."""
    place = {k: x for k, x in vars(target).items() if x}
    method = "three-step" if sort == STEPS else "usual"
    near = None
    timed = []
    try:
        if sort.endswith("re-planned"):
            near = planner.plan(replace(target, distance_m=target.distance_m - NEARER_M))
        for _ in range(repeats):
            began = time.process_time()
            plan = planner.replan(near, target) if near else planner.plan(target, method)
            plan_s = time.process_time() - began
            stages = [(x.stage, x.solve_s) for x in plan.statistics]
            row = {
                "target": place,
                "solver_s": sum(solve_s for _, solve_s in stages),
                "plan_s": plan_s,
                "iterations": sum(x.iterations for x in plan.statistics),
                "stages": stages,
                "clean": audit(plan.tape, plan.robot, target).passed,
            }
            timed.append(row)
    except JumplabError as e:
        return [{"target": place, "reason": str(e)}]
    return timed


def rows(raw: Mapping[str, Sequence[Plain]]) -> list[Plain]:
    """One row for each sort: targets, planned, clean, medians of solver and plan [s] and of
    iterations, ratio.

    Times of a target are medians over its repeats; the ratio is that of the medians to the jumps
    straight ahead.
    """
    table = []
    base = None
    for name, plans in raw.items():
        by_target: dict[str, list[Plain]] = {}
        for row in plans:
            by_target.setdefault(json.dumps(row["target"], sort_keys=True), []).append(row)
        good = [repeats for repeats in by_target.values() if "reason" not in repeats[0]]
        medians = {
            key: float(np.median([np.median([row[key] for row in each]) for each in good])) if good else None
            for key in MEASURED
        }
        if name == BASE:
            base = medians["solver_s"]
        counts = {
            "sort": name,
            "targets": len(by_target),
            "planned": len(good),
            "clean": sum(all(row["clean"] for row in each) for each in good),
        }
        ratio = medians["solver_s"] / base if base and good else None
        table.append({**counts, **medians, "ratio": ratio})
    return table
