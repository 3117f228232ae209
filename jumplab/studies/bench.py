"""How long planning takes, sort by sort, in one run on one machine: medians over some targets, and ratios.

A sort of planning is a row of :data:`SORTS`: jumps straight ahead, planned anew, from a neighbour's plan, from an atlas
or in three steps; jumps aside; flips. Times are processor time: ``solver_s`` of all attempts, ``plan_s`` of the whole
call, its tape and checks included. Ratios are of ``solver_s`` against the jumps straight ahead of the same run. Every
plan that was timed is audited afterwards.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from tempfile import TemporaryDirectory
from typing import Any

import joblib
import numpy as np

from jumplab.auditing.audit import audit
from jumplab.errors import InputError, JumplabError, SolverError
from jumplab.io.folder import versions
from jumplab.robot import Robot
from jumplab.stages.planner import JumpPlan, Planner
from jumplab.studies.atlas import Atlas
from jumplab.task import JumpTask

TASK = JumpTask(1.0, 0.5)  # the paper's target
NEARER_M = 0.05  # of the neighbour from whose plan a re-plan begins
# targets as shares of the task's distance and height, inside its atlas
AHEAD = ((0.8, 0.8), (0.85, 0.9), (0.9, 0.8), (0.95, 1.0), (1.0, 0.9), (1.0, 1.0))
ATLAS = (0.8, 1.0)  # its two distances and heights, as shares
# distance, height, way to the left as shares of distance, height, distance; turn [deg]
ASIDE = ((0, 0.8, 0.4, 0), (0.2, 0.8, -0.1, 60), (0.3, 0.6, 0, 90), (0.5, 0.6, 0, 45), (0.5, 0.6, 0.2, 0))
ASIDE += ((0.4, 0.8, 0.2, -45),)
FLIPS = ((0, 0.8, 1), (0, 1, 1), (0.2, 1, 1), (0, 0.8, -1), (0, 1, -1), (0.2, 1, -1))  # distance, height; turns
BASE = "ahead"  # the sort that ratios are of
FRESH, KEPT = "new process", "new process, functions on file"
MEASURED = ("solver_s", "plan_s", "iterations")
COLUMNS = {"sort": "", "targets": "targets", "planned": "planned", "clean": "clean", "solver_s": "solver, CPU [s]"}
COLUMNS |= {"plan_s": "with tape, CPU [s]", "iterations": "iterations", "ratio": "ratio"}
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
COLD = """
import time
began = time.perf_counter()
import json, sys
from pathlib import Path
from jumplab.stages.planner import Planner
from jumplab.robot import Robot
from jumplab.task import JumpTask
robot, task = Robot.load(sys.argv[1]), JumpTask(float(sys.argv[2]), float(sys.argv[3]))
plan = Planner(robot, keep=sys.argv[4] == "keep").plan(task)
plan_s, wall_s = time.process_time(), time.perf_counter() - began
solver_s, build_s = sum(x.cpu_s for x in plan.attempts), plan.statistics[0].build_s
iterations = sum(x.iterations for x in plan.attempts)
status = Path("/proc/self/status")  # of this process alone; what rusage says begins with the parent's peak
peak_gib = float(status.read_text().partition("VmHWM:")[2].split()[0]) / 2**20 if status.exists() else None
from jumplab.auditing.audit import audit
clean = audit(plan.tape, robot, task).passed
print(json.dumps(dict(solver_s=solver_s, plan_s=plan_s, wall_s=wall_s, build_s=build_s, iterations=iterations,
                      clean=clean, peak_gib=peak_gib)))
"""


class Bench:
    """The planners of one robot and the targets around one task."""

    def __init__(self, robot: Robot, task: JumpTask):
        self.robot, self.task = robot, task
        self.planner = Planner(self.robot)

    @cached_property
    def atlas(self) -> Planner:
        """A planner with an atlas of four nodes."""
        distances, heights = ([share * x for share in ATLAS] for x in (self.task.distance_m, self.task.height_m))
        return Planner(self.robot, atlas=Atlas.build(self.robot, distances, heights, keep=False))

    @property
    def ahead(self) -> list[JumpTask]:
        """Targets straight ahead."""
        d, h = self.task.distance_m, self.task.height_m
        return [replace(self.task, distance_m=a * d, height_m=b * h) for a, b in AHEAD]

    @property
    def aside(self) -> list[JumpTask]:
        """Targets to the side and with a turn."""
        d, h = self.task.distance_m, self.task.height_m
        ways = [dict(distance_m=a * d, height_m=b * h, side_m=c * d, yaw_rad=np.radians(x)) for a, b, c, x in ASIDE]
        return [replace(self.task, **way) for way in ways]

    @property
    def flips(self) -> list[JumpTask]:
        """Front and back flips."""
        d, h = self.task.distance_m, self.task.height_m
        ways = [dict(distance_m=a * d, height_m=b * h, rotation_rad=2 * np.pi * turns) for a, b, turns in FLIPS]
        return [replace(self.task, **way) for way in ways]

    def anew(self, task: JumpTask) -> Callable[[], JumpPlan]:
        """Plans a target from nothing."""
        return lambda: self.planner.plan(task)

    def again(self, task: JumpTask) -> Callable[[], JumpPlan]:
        """Plans a target from the plan of one a little nearer, which is made first."""
        near = self.planner.plan(replace(task, distance_m=task.distance_m - NEARER_M))
        return lambda: self.planner.replan(near, task)

    def known(self, task: JumpTask) -> Callable[[], JumpPlan]:
        """Plans a target from the atlas."""
        atlas = self.atlas
        return lambda: atlas.plan(task)

    def steps(self, task: JumpTask) -> Callable[[], JumpPlan]:
        """Plans a target in the paper's three steps."""
        return lambda: self.planner.plan(task, "three-step")


@dataclass(frozen=True)
class Sort:
    """One sort of planning: which targets of a :class:`Bench`, and how each is planned."""

    targets: str
    how: str
    planar: bool = False  # only of robots that five links describe


SORTS = {
    BASE: Sort("ahead", "anew"),
    "ahead, re-planned": Sort("ahead", "again"),
    "ahead, from an atlas": Sort("ahead", "known"),
    "ahead, three steps": Sort("ahead", "steps", planar=True),
    "aside": Sort("aside", "anew"),
    "aside, re-planned": Sort("aside", "again"),
    "flips": Sort("flips", "anew"),
}


def bench(
    robot: str = "bhr",
    task: JumpTask = TASK,
    repeats: int = 3,
    *,
    sorts: Sequence[str] = tuple(SORTS),
    processes: bool = True,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Time all ``sorts``, each target ``repeats`` times, and new ``processes``; plain types.

    Returns
    -------
    dict with ``rows`` (see :func:`rows`), robot, target, repeats, machine, and ``raw``: sort -> one dict for each plan
    with target, solver_s, plan_s, iterations, stages, clean, or with the reason for which there is none.

    Raises
    ------
    InputError
        For fewer repeats than 1, or a sort that does not exist.
    """
    if repeats < 1:
        raise InputError(f"repeats = {repeats}: it takes 1 or more")
    if unknown := [name for name in sorts if name not in SORTS]:
        raise InputError(f"sort {unknown[0]!r}: there are {', '.join(SORTS)}")
    found, raw = Bench(Robot.load(robot), task), {}
    for name in sorts:
        sort = SORTS[name]
        if sort.planar and not found.robot.planar:
            continue
        targets, how = getattr(found, sort.targets), getattr(found, sort.how)
        say(f"{name}: {len(targets)} targets, {repeats} times each")
        with suppress(JumplabError):
            how(targets[0])()  # the first call of anything is not timed
        raw[name] = [row for target in targets for row in _timed(how, target, repeats)]
    if processes:
        say("new processes")
        raw |= _processes(robot, task, repeats)
    machine = {"processor": platform.machine(), "system": platform.system(), "cpus": joblib.cpu_count()}
    machine |= {"load": os.getloadavg()[0], "versions": versions()}
    head = {"robot": found.robot.name, "target": vars(task), "repeats": repeats}
    return {**head, "rows": rows(raw), "raw": raw, "machine": machine}


def _timed(how: Callable, target: JumpTask, repeats: int) -> list[dict[str, Any]]:
    """One row for each time that a target is planned; one with the reason if there is no plan."""
    place = {k: x for k, x in vars(target).items() if x}
    out = []
    try:
        plan = how(target)
        for _ in range(repeats):
            began = time.process_time()
            made = plan()
            plan_s, stages = time.process_time() - began, [(x.stage, x.solve_s) for x in made.statistics]
            row = {"target": place, "solver_s": sum(solve_s for _, solve_s in stages), "plan_s": plan_s}
            row |= {"iterations": sum(x.iterations for x in made.statistics), "stages": stages}
            out.append(row | {"clean": audit(made.tape, made.robot, target).passed})
    except JumplabError as e:
        return [{"target": place, "reason": str(e)}]
    return out


def _processes(robot: str, task: JumpTask, repeats: int) -> dict[str, list[dict[str, Any]]]:
    """Plans in new processes that build everything, and in others that find functions on file.

    All find Python's bytecode there.
    """
    out: dict[str, list[dict[str, Any]]] = {FRESH: [], KEPT: []}
    with TemporaryDirectory() as kept:
        environment = os.environ | ONE_THREAD | {"JUMPLAB_CACHE": kept, "PYTHONPYCACHEPREFIX": f"{kept}/bytecode"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        for k in range(repeats + 1):  # the first ones fill the folder
            for name, how in ((FRESH, "fresh"), (KEPT, "keep")):
                place = repr(task.distance_m), repr(task.height_m)
                command = [sys.executable, "-c", COLD, robot, *place, how]
                done = subprocess.run(command, capture_output=True, text=True, env=environment)
                if done.returncode:
                    last = done.stderr.strip().splitlines()[-1]
                    raise SolverError(f"the new process failed: {last}", stage="bench")
                if k:
                    out[name].append({"target": {}, **json.loads(done.stdout)})
    return out


def rows(raw: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """One row for each sort: targets, planned, clean, medians of solver and plan [s] and of iterations, ratio.

    Times of a target are medians over its repeats; the ratio is that of the medians to the jumps straight ahead.
    """
    out, base = [], None
    for name, plans in raw.items():
        targets: dict[str, list] = {}
        for row in plans:
            targets.setdefault(json.dumps(row["target"], sort_keys=True), []).append(row)
        good = [x for x in targets.values() if "reason" not in x[0]]
        each = {key: [float(np.median([row[key] for row in x])) for x in good] for key in MEASURED}
        medians = {key: float(np.median(x)) if x else None for key, x in each.items()}
        base = medians["solver_s"] if name == BASE else base
        ratio = medians["solver_s"] / base if base and good else None
        clean = sum(all(row["clean"] for row in x) for x in good)
        out.append(
            {"sort": name, "targets": len(targets), "planned": len(good), "clean": clean, **medians, "ratio": ratio}
        )
    return out
