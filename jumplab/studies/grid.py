"""Plans of a grid: what sweeps, maps and atlases ask of each target, and in which order.

A cell is planned from nothing, or with an atlas: its plan depends on the target alone, not on what
else the grid holds or on what was planned before.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import joblib

from jumplab.auditing.report import AuditReport
from jumplab.errors import InfeasibleError, JumplabError
from jumplab.robot import Robot
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import Planner
from jumplab.studies.study import Plain, key_of, open_study
from jumplab.task import JumpTask

CELLS = "cells.jsonl"
MAX_CELLS = 2500  # an hour or two of work
GIVE_UP = 2  # so many cells in a row without a plan, and the farther ones of the row are not tried
# checks of the audit
USES = {
    "torque at speed": "torque",
    "torque of locked joints": "torque",
    "joint speed": "speed",
    "friction used": "friction",
}
COLUMNS = (
    "planned",
    "clean",
    "failed_checks",
    "limiting",
    "share",
    "planned_distance_m",
    "planned_rise_m",
    "launch_s",
    "flight_s",
    "cost",
    "iterations",
    "cpu_s",
    "wall_s",
    "infeasible",
    "reason",
)


def role_of(robot: Robot, joint: str) -> str:
    """Word for a joint on either side: its role, or its name if it has none."""
    roles = {name: role for role, pair in robot.joints.items() for name in pair}
    word = roles.get(joint, joint).removeprefix("left_").removeprefix("right_")
    return word.replace("_", " ")


def most_used(report: AuditReport, robot: Robot) -> tuple[str, float]:
    """The ability of its robot that a plan uses most, torque at its speed, speed or friction, and
    the used share of it [1].

    A joint with a role is named by it.
    """
    shares = []
    for check in report.checks:
        if what := USES.get(check.name):
            worst = check.note.rpartition("; worst: ")[2]
            name = what if what == "friction" else f"{role_of(robot, worst)} {what}"
            shares.append((check.value / check.limit, name))
    share, name = max(shares)
    return name, float(share)


def plan_cell(
    planner: Planner,
    task: JumpTask,
    method: str = "direct",
    weights: Mapping[str, float] | None = None,
) -> tuple[Plain, JumpPlan | None]:
    """Plan and audit a target: a row of :data:`COLUMNS`, and the plan.

    A target without a plan is a row too, with the reason, and whether that is an
    :class:`InfeasibleError` (``infeasible``). Times [s] are those of the plan, without its audit.
    """
    row = dict.fromkeys(COLUMNS) | dict(planned=False, clean=False, infeasible=False)
    plan = None
    cpu = time.process_time()
    wall = time.perf_counter()
    try:
        plan = planner.plan(task, method, weights=weights)
    except JumplabError as e:
        row |= {"reason": str(e), "infeasible": isinstance(e, InfeasibleError)}
    row |= {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
    if plan is None:
        return row, None
    report = plan.audit
    limiting, share = most_used(report, plan.robot)
    failed = ", ".join(check.name for check in report.failed)
    row |= {
        "planned": True,
        "clean": report.passed,
        "failed_checks": failed,
        "limiting": limiting,
        "share": share,
        "planned_distance_m": plan.planned_distance_m,
        "planned_rise_m": plan.planned_rise_m,
        "launch_s": plan.whole_body.launch_s,
        "flight_s": plan.whole_body.flight_s,
        "cost": plan.whole_body.solution.statistics.objective,
        "iterations": sum(stage.iterations for stage in plan.statistics),
        "reason": f"outside the limits of the audit: {failed}" if failed else None,
    }
    return row, plan


def plan_rows(
    tasks: Sequence[Sequence[JumpTask]],
    work: Callable[[JumpTask], Plain],
    known: Sequence[Any],
    good: str,
    folder: str | Path | None,
    command: str,
    **options: Any,
) -> list[tuple[JumpTask, Plain | None]]:
    """Every target of some rows, each from near to far, with its result; rows side by side.

    ``work`` gives the row of a target, decided by that and by what is ``known`` of it (plain data).
    A row ends after :data:`GIVE_UP` results that are not ``good`` (a column); beyond, results are
    None. They are kept in ``folder``; ``command`` and ``options`` are those of
    :func:`.study.open_study`.
    """
    rows = [[] for _ in tasks]
    path = None if folder is None else Path(folder) / CELLS
    with open_study(path, command, total=sum(map(len, tasks)), **options) as study:
        for column in zip(*tasks, strict=True):
            alive = [
                k
                for k, row in enumerate(rows)
                if len(row) < GIVE_UP or any(x[good] for x in row[-GIVE_UP:])
            ]
            cells = [column[k] for k in alive]
            now = {key_of(*known, task.numbers): joblib.delayed(work)(task) for task in cells}
            for k, result in zip(alive, study.results(now), strict=True):
                rows[k].append(result)
    return [pair for both in zip(tasks, rows, strict=True) for pair in zip_longest(*both)]
