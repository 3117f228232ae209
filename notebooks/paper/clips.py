"""A library of clips: jumps of one robot to all sides, each planned, audited, landed alike by all
engines, exported.

Every clip is a folder, put in its place whole: a library that was stopped goes on with those that
are missing.
"""

from __future__ import annotations

import math
import os
import shutil
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import joblib

from jumplab import reading
from jumplab.arguments import checked
from jumplab.auditing import write_audit
from jumplab.errors import InputError, JumplabError, quoted
from jumplab.io import export
from jumplab.io import folder as store
from jumplab.io.files import locked, made
from jumplab.io.motion import Motion
from jumplab.robot import SHIPPED, Robot
from jumplab.robot.files import files_of
from jumplab.robot.legs import segments_m
from jumplab.show.viewer import Page
from jumplab.sim import DEFAULT_ENGINE, ENGINES, Scene, SimulationResult, simulate_jump
from jumplab.sim.engine import engine_class
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import Planner, here
from jumplab.stages.whole_body import Contacts
from jumplab.studies.study import Plain, in_parallel, key_of
from jumplab.studies.sweep import VARIED
from jumplab.studies.trials import Trial, judged
from jumplab.task import JumpTask
from paper.certify import ModeReport

SCHEMA = "jumplab-clips-2"
INDEX = "index.json"
PAGE = "index.html"
LICENCE = "LICENSE.txt"
ROW = "clip.json"
# of playback, tried in this order: a clip is the motion in the first one in which it passes
MODES = "position", "whole-body"
# signals may stop what is written below a folder of that name
STAGING = ".staging"
SHOWN = ("landed", "foot_distance_m", "side_m", "yaw_rad", "com_rise_m", "standing_s")
LIBRARY = tomllib.loads(Path(__file__).with_name("clips.toml").read_text(encoding="utf-8"))
TARGET = "distance", "height"  # what of a target varies: its lengths along the ground, its rise
# ... and of the robot; other legs would be another robot's clips
ROBOT = "mass", "effort", "speed"
SPLIT = "training", "held-out"
# of the different targets of a kind one in so many is held out, beginning with this one
EVERY = 5
FIRST = 1
WORDS = """Clips of the robot {name}, made by jumplab {jumplab}.

Every motion is computed from a description of the robot; none is a recording of a person.

Motions, plans, simulations and pictures: BSD 3-Clause License, as jumplab has it. Makers of
libraries may replace this sentence by another licence.

Robot: {source}.
Files that describe it (robot.urdf and robot.toml in every folder, and exports with a robot in them)
are under the licence that it has there.
"""


@dataclass(frozen=True)
class Target:
    """Target of one clip of a library, before a robot is known; numbers as in ``clips.toml``.

    Attributes
    ----------
    kind : of the :data:`LIBRARY`.
    row : (distance, rise, platform, side, turn, and of flips rotation) [leg, deg], or options of
        the contact schedule ``kind`` [leg].
    split : one of :data:`SPLIT`.
    """

    kind: str
    row: Sequence[float] | Mapping[str, Any]
    split: str

    def of(self, robot: Robot, distance: float = 1.0, height: float = 1.0) -> JumpTask | Contacts:
        """The target of a robot, lengths to the centimetre: a jump, or a schedule.

        ``distance`` and ``height`` are factors on lengths along the ground and on the rise [1]; a
        schedule has no rise.
        """
        leg_m = sum(segments_m(robot))
        if isinstance(self.row, Mapping):
            options = {
                key: round(leg_m * distance * x, 2) if key.endswith("_m") else x
                for key, x in self.row.items()
            }
            return getattr(Contacts, self.kind)(robot, **options)
        *lengths, yaw, pitch = (*self.row, 0)[:6]
        factors = distance, height, 1.0, distance
        ahead, rise, platform, side = (
            round(leg_m * k * x, 2) for k, x in zip(factors, lengths, strict=True)
        )
        turns = {"rotation_rad": math.radians(pitch), "yaw_rad": math.radians(yaw)}
        return JumpTask(ahead, rise, platform, side_m=side, **turns)


def targets() -> dict[str, Target]:
    """Name -> target of every clip of the :data:`LIBRARY`."""
    found = {}
    for kind, rows in LIBRARY.items():
        different: list[Any] = []
        for number, row in enumerate(rows, 1):
            mirrored = (
                {key: x for key, x in row.items() if key != "foot"}
                if isinstance(row, Mapping)
                else [*row[:3], *map(abs, row[3:5]), *row[5:]]
            )
            if mirrored not in different:
                different.append(mirrored)
            held_out = different.index(mirrored) % EVERY == FIRST
            found[f"{kind}-{number}"] = Target(kind, row, SPLIT[held_out])
    return found


def variants(
    robot: Robot, only: Sequence[str] = (), vary: Sequence[Mapping[str, float]] = ()
) -> list[tuple[str, Target, Mapping[str, float], Robot, JumpTask | Contacts]]:
    """(name, target, factors, robot, what is planned) of every clip: all targets or ``only`` some,
    as they are and with the factors of ``vary``, unless these change nothing.

    Raises :class:`InputError` for names of targets or factors that do not exist.
    """
    known = targets()
    if unknown := [name for name in only if name not in known]:
        listed = ", ".join(f"{kind} 1-{len(rows)}" for kind, rows in LIBRARY.items())
        raise InputError(f"there is no clip {quoted(unknown[0])}; names are KIND-NUMBER: {listed}")
    names = *TARGET, *ROBOT
    if strange := [what for each in vary for what in each if what not in names]:
        raise InputError(f"clips vary by {', '.join(names)}, not by {quoted(strange[0])}")
    clips = []
    seen = set()
    for factors in ({}, *vary):
        other = robot
        for what in ROBOT:
            other = VARIED[what](other, factors[what]) if what in factors else other
        lengths = {what: factors[what] for what in TARGET if what in factors}
        words = "".join(f"_{what}={x:g}" for what, x in factors.items())
        for name, target in known.items():
            task = target.of(other, **lengths)
            key = name, other.hash, repr(task)
            if (not only or name in only) and key not in seen:
                seen.add(key)
                clips.append((name + words, target, factors, other, task))
    return clips


@checked
def make_clips(
    robot: Robot,
    out: str | Path,
    format_name: str = "mjlab-npz",
    *,
    fps: float | None = None,
    only: Sequence[str] | None = None,
    vary: Sequence[Mapping[str, float]] = (),
    draw: Callable[[Path, Robot, Motion, Scene], str] | None = None,
    page: Callable[[Plain], Page] | None = None,
    jobs: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, list[Plain]]:
    """Make the library of a robot in the folder ``out``: per clip a folder (plan, simulation,
    clip), an index that is written after every clip, and a licence.

    A clip passes if its plan passes the audit, and in one of :data:`MODES` of playback lands in
    every engine, all of them within the limits of :data:`.certify.LIMITS` of each other. It shows
    the simulated jump, from stand to stand, in that mode and the default engine; its row names the
    mode. A clip that failed is not tried again unless the code, the robot or the target has
    changed, or its name is among ``only``.

    Parameters
    ----------
    format_name, fps : as of :func:`jumplab.io.export.write`.
    only : names of :func:`targets`; by default all.
    vary : of each target further clips, with factors [1] on its "distance" or "height", or on
        "mass", "effort" or "speed" of the robot; on the same side of the split as the target.
    draw : draws a picture of a clip into its folder, and returns the name of the file.
    page : makes ``index.html`` of the index.
    jobs : processes, by default one per core.
    say : is called with a line per clip.

    Raises :class:`InputError` for formats, names, factors or a folder that cannot be meant, or if
    an engine is not installed.
    """
    export.rate_of(format_name, fps)
    clips = variants(robot, only or (), vary)
    for engine in ENGINES:
        engine_class(engine)
    out = store.ensure_writable(out)
    planners = {other.hash: Planner(other, keep=True) for *_, other, _ in clips}
    make = partial(_clip, out=out, format_name=format_name, fps=fps, again=bool(only), draw=draw)
    work = []
    for name, target, factors, other, task in clips:
        told = {"name": name, "kind": target.kind, "split": target.split, "factors": factors}
        work.append(joblib.delayed(make)(planners[other.hash], told, task))
    head = {
        "schema": SCHEMA,
        "robot": {"name": robot.name, "hash": robot.hash},
        "format": format_name,
        "fps": fps,
        "targets": len(clips),
    }
    rows: dict[bool, list[Plain]] = {True: [], False: []}
    library = {"clips": rows[True], "left_out": rows[False]}
    with made(out), locked(out, wait_s=0.0):  # one library at a time
        try:
            for row in in_parallel(work, jobs, "generator"):
                rows[row["passed"]].append(row)
                store.settle()
                store.write_file(out / LICENCE, _licence(robot).encode())
                store.write_file(out / INDEX, store.to_json(head | library).encode())
                if page:
                    store.write_file(out / PAGE, page(head | library).html.encode())
                words = "passed" if row["passed"] else f"left out, {row['reasons'][0]}"
                say(f"{row['name']}: {words}")
        finally:
            shutil.rmtree(out / STAGING, ignore_errors=True)
    return library


def _licence(robot: Robot) -> str:
    """Licence of the clips, and where their robot is from."""
    source = f"{files_of(robot.name)[0]}, of jumplab" if robot.name in SHIPPED else "see robot.toml"
    if ":" in source:
        package, _, file = source.removesuffix(", of jumplab").partition(":")
        source = f"{file.replace(':', '/')} of the Python package {package}"
    return WORDS.format(name=robot.name, jumplab=store.versions()["jumplab"], source=source)


def _clip(
    planner: Planner,
    told: Plain,
    task: JumpTask | Contacts,
    *,
    out: Path,
    format_name: str,
    fps: float | None,
    again: bool,
    draw: Callable[[Path, Robot, Motion, Scene], str] | None,
) -> Plain:
    """The row of one clip, which is made unless its folder holds one with the same key; one that
    failed is made ``again`` if asked, and leaves its plan.
    """
    robot = planner.robot
    folder = reading.below(out, told["name"])
    target = task.numbers if isinstance(task, JumpTask) else asdict(task)
    key = key_of("clip", SCHEMA, MODES, robot.hash, target)
    row = store.read_json(folder / ROW) if (folder / ROW).is_file() else {}
    if row.get("key") != key or (again and not row.get("passed")):
        head = {"target": target, "robot": robot.hash, "key": key}
        staging = reading.below(out, STAGING, told["name"])
        shutil.rmtree(staging, ignore_errors=True)  # left by a run that was killed
        with made(staging):
            row = told | head | {"versions": store.versions()}
            row |= _judged(here(planner), task, staging)
            (staging / ROW).write_text(store.to_json(row), encoding="utf-8")
            shutil.rmtree(folder, ignore_errors=True)
            os.replace(staging, folder)
    row |= told
    if row["passed"]:
        file = export.default_name(format_name, "simulation")
        motion = Motion.of_simulation_file(folder, robot)
        row |= {"file": str(Path(row["name"], file)), "duration_s": motion.duration}
        export.write(format_name, motion, robot, folder / file, fps=fps)
        if draw:
            scene = Scene.of_plan(store.read_plan(folder)[2], robot)
            row["picture"] = str(Path(row["name"], draw(folder, robot, motion, scene)))
    return row


def _judged(planner: Planner, task: JumpTask | Contacts, folder: Path) -> Plain:
    """Plan, audit and simulate a jump into ``folder``: the verdict, its reasons, and what was
    measured by engine.
    """
    try:
        plan = planner.plan(task) if isinstance(task, JumpTask) else planner.follow(task)
    except JumplabError as e:
        return {"planned": False, "passed": False, "reasons": [str(e)], "measured": {}}
    report = store.write_plan(folder, plan.tape, plan.robot, plan.summary, complete=write_audit)
    failed = [f"the plan fails the audit's check {check.name}" for check in report.failed]
    reasons = list(failed)
    runs = []
    for mode in MODES[:1] if failed else MODES:
        runs.append(_played(plan, mode))
        found = runs[-1][0].failures
        reasons += found
        if not found:
            break
    passed = not failed and not found
    played, shown = runs[-1 if passed else 0]
    if shown is not None:
        store.write_simulation(folder, shown, store.read_plan(folder)[2])
    measured = {
        name: {key: getattr(trial.metrics, key) for key in SHOWN}
        for name, trial in played.planned.items()
        if trial.metrics is not None
    }
    row = {"planned": True, "passed": passed, "reasons": [] if passed else reasons}
    return row | {"mode": played.mode, "measured": measured, "audit": len(report.checks)}


def _played(plan: JumpPlan, mode: str) -> tuple[ModeReport, SimulationResult | None]:
    """Comparison of the engines for a plan in one mode; and the jump in the default engine, None
    if that lost the robot.
    """
    scene = Scene.of_plan(plan.summary, plan.robot)
    results = {}

    def play(engine: str) -> SimulationResult:
        played = simulate_jump(plan.tape, plan.robot, mode=mode, scene=scene, engine=engine)
        results[engine] = played
        return played

    trials = {name: Trial(None, {}, {}, *judged(partial(play, name))) for name in ENGINES}
    return ModeReport(mode, trials, (), plan.task.in_plane), results.get(DEFAULT_ENGINE)
