"""A library of clips: jumps of one robot to all sides, each planned, audited, landed alike by all
engines, exported.

Every clip is a folder, put in its place whole: a library that was stopped goes on with those
missing or failed.
"""

from __future__ import annotations

import math
import os
import shutil
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import joblib
import numpy as np
import pinocchio as pin

from jumplab import reading
from jumplab.arguments import checked
from jumplab.auditing import write_audit
from jumplab.errors import InputError, JumplabError
from jumplab.io import export
from jumplab.io import folder as store
from jumplab.io.files import locked, made
from jumplab.io.motion import Motion
from jumplab.robot import Robot
from jumplab.sim import DEFAULT_ENGINE, ENGINES, Scene, SimulationResult, simulate_jump
from jumplab.sim.engine import engine_class
from jumplab.stages.planner import Planner, here
from jumplab.studies.certify import ModeReport
from jumplab.studies.study import Plain, in_parallel, key_of
from jumplab.studies.trials import Trial, judged
from jumplab.task import JumpTask

SCHEMA = "jumplab-clips-1"
INDEX = "index.json"
ROW = "clip.json"
MODE = "position"
# signals may stop what is written below a folder of that name
STAGING = ".staging"
SHOWN = ("landed", "foot_distance_m", "side_m", "yaw_rad", "com_rise_m", "standing_s")
LIBRARY = tomllib.loads(Path(__file__).with_name("clips.toml").read_text(encoding="utf-8"))


def leg_m(robot: Robot) -> float:
    """Length of a leg from hip to knee to ankle [m]."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, pin.neutral(robot.model))
    joints = [robot.joints[role][0] for role in ("hip_pitch", "knee", "ankle_pitch")]
    places = [data.oMi[robot.model.getJointId(joint)].translation for joint in joints]
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def targets(robot: Robot) -> dict[str, JumpTask]:
    """Name -> target of every clip of the :data:`LIBRARY`, to the centimetre."""
    leg = leg_m(robot)
    tasks = {}
    for kind, rows in LIBRARY.items():
        for number, (*lengths, yaw) in enumerate(rows, 1):
            distance, height, platform, side = (round(leg * x, 2) for x in lengths)
            away = {"side_m": side, "yaw_rad": math.radians(yaw)}
            tasks[f"{kind}-{number}"] = JumpTask(distance, height, platform, **away)
    return tasks


@checked
def make_clips(
    robot: Robot,
    out: str | Path,
    format_name: str = "mjlab-npz",
    *,
    fps: float | None = None,
    only: Sequence[str] | None = None,
    jobs: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, list[Plain]]:
    """Make the library of a robot in the folder ``out``: per clip a folder (plan, simulation,
    clip), and an index.

    A clip passes if its plan passes the audit, and lands in every engine, all of them within
    the limits of :data:`.certify.LIMITS` of each other. It shows the simulated jump, from stand to
    stand, in the default engine.

    Parameters
    ----------
    format_name, fps : as of :func:`jumplab.io.export.write`.
    only : names of :func:`targets`; by default all.
    jobs : processes, by default one per core.
    say : is called with a line per clip.

    Raises :class:`InputError` for formats, names or a folder that cannot be meant, or if an engine
    is not installed.
    """
    export.rate_of(format_name, fps)
    tasks = targets(robot)
    unknown = [name for name in only or () if name not in tasks]
    if unknown:
        raise InputError(f"there is no clip {unknown[0]!r}; choose from {', '.join(tasks)}")
    for engine in ENGINES:
        engine_class(engine)
    out = store.ensure_writable(out)
    planner = Planner(robot, keep=True)
    chosen = {name: task for name, task in tasks.items() if not only or name in only}
    work = [
        joblib.delayed(_clip)(planner, name, task, out, format_name, fps)
        for name, task in chosen.items()
    ]
    rows: dict[bool, list[Plain]] = {True: [], False: []}
    head = {
        "schema": SCHEMA,
        "robot": {"name": robot.name, "hash": robot.hash},
        "format": format_name,
        "fps": fps,
    }
    with made(out), locked(out, wait_s=0.0):  # one library at a time
        try:
            for row in in_parallel(work, jobs, "generator"):
                rows[row["passed"]].append(row)
                words = "passed" if row["passed"] else f"left out, {row['reasons'][0]}"
                say(f"{row['name']}: {words}")
        finally:
            shutil.rmtree(out / STAGING, ignore_errors=True)
        clips = {"clips": rows[True], "left_out": rows[False]}
        store.settle()
        store.write_file(out / INDEX, store.to_json(head | clips).encode())
    return clips


def _clip(
    planner: Planner, name: str, task: JumpTask, out: Path, format_name: str, fps: float | None
) -> Plain:
    """The row of one clip, which is made unless its folder holds one that passed; a failed one
    leaves its plan.
    """
    robot = planner.robot
    folder = reading.below(out, name)
    key = key_of("clip", robot.hash, asdict(task))
    row = store.read_json(folder / ROW) if (folder / ROW).is_file() else {}
    if not (row.get("passed") and row.get("key") == key):
        head = {"name": name, "target": asdict(task), "robot": robot.hash, "key": key}
        staging = reading.below(out, STAGING, name)
        shutil.rmtree(staging, ignore_errors=True)  # left by a run that was killed
        with made(staging):
            row = head | {"versions": store.versions()} | _judged(here(planner), task, staging)
            (staging / ROW).write_text(store.to_json(row), encoding="utf-8")
            shutil.rmtree(folder, ignore_errors=True)
            os.replace(staging, folder)
    if row["passed"]:
        file = export.default_name(format_name, "simulation")
        motion = Motion.of_simulation_file(folder, robot)
        row |= {"file": str(Path(name, file)), "duration_s": motion.duration}
        export.write(format_name, motion, robot, folder / file, fps=fps)
    return row


def _judged(planner: Planner, task: JumpTask, folder: Path) -> Plain:
    """Plan, audit and simulate a jump into ``folder``: the verdict, its reasons, and what was
    measured by engine.
    """
    try:
        plan = planner.plan(task)
    except JumplabError as e:
        return {"passed": False, "reasons": [str(e)], "measured": {}}
    report = store.write_plan(folder, plan.tape, plan.robot, plan.summary, complete=write_audit)
    scene = Scene.of_plan(plan.summary, plan.robot)
    trials = {}
    for engine in ENGINES:

        def play(engine: str = engine) -> SimulationResult:
            result = simulate_jump(plan.tape, plan.robot, mode=MODE, scene=scene, engine=engine)
            if engine == DEFAULT_ENGINE:
                store.write_simulation(folder, result, store.read_plan(folder)[2])
            return result

        trials[engine] = Trial(None, {}, {}, *judged(play))
    reasons = [f"the plan fails the audit's check {check.name}" for check in report.failed]
    reasons += ModeReport(MODE, trials, (), task.in_plane).failures
    measured = {
        name: {key: getattr(trial.metrics, key) for key in SHOWN}
        for name, trial in trials.items()
        if trial.metrics is not None
    }
    checks = len(report.checks)
    return {"passed": not reasons, "reasons": reasons, "measured": measured, "audit": checks}
