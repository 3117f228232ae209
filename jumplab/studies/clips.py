"""A library of clips: jumps of one robot to all sides, each planned, audited, landed alike by all engines, exported.

Every clip is a folder, put in its place whole: a library that was stopped goes on with those missing or failed.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pinocchio as pin

from jumplab.auditing import audit, write_audit
from jumplab.errors import InputError, JumplabError
from jumplab.io import export
from jumplab.io import folder as store
from jumplab.io.files import made
from jumplab.io.motion import Motion
from jumplab.robot import Robot
from jumplab.sim import DEFAULT_ENGINE, ENGINES, Scene, SimulationResult, simulate_jump
from jumplab.sim.engine import engine_class
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import USUAL, Planner, here
from jumplab.studies.certify import AWAY, QUANTITIES, Limits, ModeReport
from jumplab.studies.trials import Trial, TrialSettings, in_parallel, judged
from jumplab.task import JumpTask

SCHEMA, INDEX, ROW = "jumplab-clips-1", "index.json", "clip.json"
MODE, STAGING = "position", ".staging"  # signals may stop what is written below a folder of that name
# kind -> (distance, rise, platform, side) in lengths of a leg, and the turn [deg], of every clip. None of these is
# printed by the paper; a G1 can do them all
LIBRARY = {
    "forward": [(d, h, 0.0, 0.0, 0.0) for d, h in
                ((0.2, 0.2), (0.3, 0.25), (0.4, 0.3), (0.5, 0.25), (0.5, 0.35), (0.6, 0.3), (0.7, 0.35), (0.7, 0.25))],
    "back": [(-d, 0.25, 0.0, 0.0, 0.0) for d in (0.1, 0.2, 0.3, 0.4)],
    "height": [(0.0, h, 0.0, 0.0, 0.0) for h in (0.15, 0.2, 0.3, 0.35, 0.4)],
    "platform": [(d, h, top, 0.0, 0.0) for d, h, top in
                 ((0.55, 0.35, 0.1), (0.6, 0.4, 0.15), (0.6, 0.45, 0.2), (0.6, 0.2, -0.15), (0.6, 0.15, -0.3))],
    "side": [(0.0, 0.25, 0.0, side, 0.0) for side in (0.15, -0.15, 0.3, -0.3)],
    "turn": [(0.0, 0.3, 0.0, 0.0, yaw) for yaw in (20.0, -20.0, 40.0, -40.0)],
}  # fmt: skip


@dataclass(frozen=True)
class Clips:
    """What :func:`make_clips` leaves: one row per target, as ``index.json`` has them."""

    rows: tuple[dict[str, Any], ...]  # those that passed
    left_out: tuple[dict[str, Any], ...]  # the others, each with its ``reasons``

    def to_json(self) -> dict[str, Any]:
        """Plain data, in SI units."""
        return {"clips": list(self.rows), "left_out": list(self.left_out)}


def leg_m(robot: Robot) -> float:
    """Length of a leg from hip to knee to ankle [m]."""
    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    hip, knee, ankle = (
        data.oMi[model.getJointId(robot.joints[role][0])].translation for role in ("hip_pitch", "knee", "ankle_pitch")
    )
    return float(np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle))


def targets(robot: Robot) -> dict[str, JumpTask]:
    """Name -> target of every clip of the :data:`LIBRARY`, to the centimetre."""
    leg, out = leg_m(robot), {}
    for kind, rows in LIBRARY.items():
        for number, (*lengths, yaw) in enumerate(rows, 1):
            distance, height, platform, side = (round(leg * x, 2) for x in lengths)
            how = {"side_m": side, "yaw_rad": math.radians(yaw)}
            out[f"{kind}-{number}"] = JumpTask(distance, height, platform, **how)
    return out


def make_clips(
    robot: Robot,
    out: str | Path,
    format_name: str = "mjlab-npz",
    *,
    fps: float | None = None,
    only: Sequence[str] | None = None,
    jobs: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Clips:
    """Make the library of a robot in the folder ``out``: per clip a folder with plan, simulation, clip; and an index.

    A clip passes if its plan is clean in the audit, and lands in every engine, all of them within the limits of
    :class:`.certify.Limits` of each other. It shows the simulated jump, from stand to stand, in the default engine.

    Parameters
    ----------
    format_name, fps : as of :func:`jumplab.io.export.write`.
    only : names of :func:`targets`; by default all.
    jobs : processes, by default one per core.
    say : is called with a line per clip.

    Raises :class:`InputError` for formats, names or a folder that cannot be meant, or if an engine is not installed.
    """
    export.rate_of(format_name, fps)
    tasks = targets(robot)
    unknown = [name for name in only or () if name not in tasks]
    if unknown:
        raise InputError(f"there is no clip {unknown[0]!r}; choose of {', '.join(tasks)}")
    for engine in ENGINES:
        engine_class(engine)
    out, planner, rows = store.ensure_writable(out), Planner(robot, keep=True), {}
    chosen = {name: task for name, task in tasks.items() if not only or name in only}
    work = [joblib.delayed(_clip)(planner, name, task, out, format_name, fps) for name, task in chosen.items()]
    for row in in_parallel(work, jobs, "generator"):
        rows[row["name"]] = row
        say(f"{row['name']}: {'passed' if row['passed'] else 'left out, ' + row['reasons'][0]}")
    parts = [tuple(row for row in rows.values() if row["passed"] is passed) for passed in (True, False)]
    head = {"schema": SCHEMA, "robot": {"name": robot.name, "hash": robot.hash}, "format": format_name, "fps": fps}
    shutil.rmtree(out / STAGING, ignore_errors=True)
    store.settle()
    store.write_file(out / INDEX, store.to_json(head | Clips(*parts).to_json()).encode())
    return Clips(*parts)


def _clip(
    planner: Planner, name: str, task: JumpTask, out: Path, format_name: str, fps: float | None
) -> dict[str, Any]:
    """The row of one clip, which is made unless its folder holds one that passed; a failed one leaves its plan."""
    robot, folder, file = planner.robot, out / name, export.default_name(format_name, "simulation")
    said = {"name": name, "target": asdict(task), "robot": robot.hash, "versions": store.versions()}
    row = store.read_json(folder / ROW) if (folder / ROW).is_file() else {}
    if not row.get("passed") or any(row[key] != value for key, value in said.items()):
        staging = out / STAGING / name
        shutil.rmtree(staging, ignore_errors=True)  # left by a run that was killed
        with made(staging):
            row = said | _judged(here(planner), task, staging)
            (staging / ROW).write_text(store.to_json(row), encoding="utf-8")
            shutil.rmtree(folder, ignore_errors=True)
            os.replace(staging, folder)
    if row["passed"]:
        motion = Motion.of_simulation_file(folder, robot)
        row |= {"file": str(Path(name, file)), "duration_s": motion.duration}
        export.write(format_name, motion, robot, folder / file, fps=fps)
    return row


def _planned(planner: Planner, task: JumpTask) -> tuple[JumpPlan | None, str]:
    """A plan by the usual method or, where that is not clean, in the plane in three steps.

    The first clean one, else the last. If there is none, the reason why the last method found none.
    """
    found, reason = None, ""
    by_steps = planner.robot.planar and task.in_plane
    for method in (USUAL, "three-step") if by_steps else (USUAL,):
        try:
            found = planner.plan(task, method)
        except JumplabError as e:
            reason = str(e)
        else:
            if audit(found.tape, found.robot, found.task).passed:
                break
    return found, reason


def _judged(planner: Planner, task: JumpTask, folder: Path) -> dict[str, Any]:
    """Plan, audit and simulate a jump into ``folder``: the verdict, its reasons, and what was measured by engine."""
    row, runs = {"passed": False, "reasons": [], "measured": {}}, {}
    plan, reason = _planned(planner, task)
    if plan is None:
        return row | {"reasons": [reason]}
    report = store.write_plan(folder, plan.tape, plan.robot, plan.summary, complete=write_audit)
    scene = Scene.of_plan(plan.summary, plan.robot)

    def play(engine: str) -> SimulationResult:
        runs[engine] = simulate_jump(plan.tape, plan.robot, mode=MODE, scene=scene, engine=engine)
        return runs[engine]

    trials = {name: Trial(None, {}, {}, *judged(lambda name=name: play(name))) for name in ENGINES}
    quantities = QUANTITIES if task.in_plane else (*QUANTITIES, *AWAY)
    told = ModeReport(MODE, trials, {}, TrialSettings(MODE), Limits(), quantities).failures
    reasons = [f"the plan fails the audit's check {check.name}" for check in report.failed] + told
    if DEFAULT_ENGINE in runs:
        store.write_simulation(folder, runs[DEFAULT_ENGINE], store.read_plan(folder)[2])
    shown = ("landed", "foot_distance_m", "side_m", "yaw_rad", "com_rise_m", "standing_s")
    measured = {name: {key: getattr(run.metrics, key) for key in shown} for name, run in runs.items()}
    return {"passed": not reasons, "reasons": reasons, "measured": measured, "audit": len(report.checks)}
