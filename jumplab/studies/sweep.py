"""Many plans: a grid of targets, robots and weights, over processes or a cluster, resumed where it
stopped, one table.

Every finished case is one line of ``cases.jsonl``; a sweep that was killed goes on with the cases
that have no line yet. When all have one, ``table.csv`` holds them in order.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from jumplab import reading
from jumplab.arguments import checked
from jumplab.errors import InputError, JumplabError, quoted
from jumplab.io.files import ensure_writable, settle, write_file
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.stages.planner import METHODS, Planner
from jumplab.studies import grid as grids
from jumplab.studies.atlas import Atlas
from jumplab.studies.study import Plain, key_of, on_cluster, open_study, short_hash
from jumplab.task import JumpTask

CASES = "cases.jsonl"
TABLE = "table.csv"
TAPES = "tapes"
MAX_CASES = 100_000  # a day on a hundred processors; more is a typing error
KEPT = 2  # planners that a process keeps: robots run slowest, so there are one or two at a time
# [m] between the nodes of a sweep's atlas, at most
ATLAS_STEPS = {"distance_m": 0.3, "height_m": 0.15}
PLACE = "distance_m", "height_m", "platform_m"
COLUMNS = (*PLACE, "robot", "weights", "method", *grids.COLUMNS, "tape")


@dataclass(frozen=True)
class Case:
    """One plan of a sweep; ``weights`` are those that differ from the usual, named as in
    :class:`jumplab.Planner`.
    """

    task: JumpTask
    robot: str = "bhr"
    weights: Mapping[str, float] = field(default_factory=dict)
    method: str = "direct"

    def key(self, *more: Any) -> str:
        """Key of this case, different for all others; it depends on ``more``, too."""
        weights = dict(self.weights)
        return key_of(self.method, robot_of(self.robot).hash, weights, self.task.numbers, *more)


@checked
def grid(
    distances: Sequence[float],
    heights: Sequence[float],
    platforms: Sequence[float] = (0.0,),
    robots: Sequence[str] = ("bhr",),
    weights: Sequence[Mapping[str, float]] = ({},),
    method: str = "direct",
) -> list[Case]:
    """All combinations of targets [m], robots and weights, distances running fastest; raises
    :class:`InputError` for none, too many, and impossible targets or methods.
    """
    if method not in METHODS:
        raise InputError(f"method {method!r}: choose one of {', '.join(METHODS)}")
    axes = (robots, weights, platforms, heights, distances)
    count = math.prod(map(len, axes))
    if not 1 <= count <= MAX_CASES:
        raise InputError(f"the sweep has {count} cases; it takes 1 to {MAX_CASES}")
    cases = [
        Case(JumpTask(distance, height, platform), robot, dict(weight), method)
        for robot, weight, platform, height, distance in product(*axes)
    ]
    if len({case.key() for case in cases}) < len(cases):
        raise InputError("the sweep has the same case twice; give every value once")
    return cases


VARIED = {  # what of a robot a sweep varies -> the robot with a factor on it
    "mass": lambda robot, x: robot.with_mass(factor=x),
    "effort": lambda robot, x: robot.with_limits(effort=x),
    "speed": lambda robot, x: robot.with_limits(speed=x),
    "leg": lambda robot, x: robot.with_legs(x),
}


@checked
def varied(robots: Sequence[str], factors: Sequence[Mapping[str, float]]) -> list[str]:
    """Names of robots, each with all the factors [1] on :data:`VARIED`, such as "bhr mass=1.1"."""
    unknown = next((what for each in factors for what in each if what not in VARIED), None)
    if unknown is not None:
        raise InputError(f"a sweep varies {', '.join(VARIED)} of a robot, not {quoted(unknown)}")
    words = ["".join(f" {what}={x:g}" for what, x in each.items() if x != 1.0) for each in factors]
    return [robot + each for robot in robots for each in words]


@cache
def robot_of(name: str) -> Robot:
    """A robot by its name in a sweep, see :func:`varied`."""
    first, _, last = name.rpartition(" ")
    what, equals, factor = last.partition("=")
    return (
        VARIED[what](robot_of(first), float(factor))
        if equals and what in VARIED
        else Robot.load(name)
    )


@lru_cache(KEPT)
def _planner(robot: str, method: str, atlas: Path | None = None) -> Planner:
    """A planner with its stages built, kept while its robot is at work; ``atlas`` is the folder of
    one.
    """
    planner = Planner(robot_of(robot), keep=True, atlas=atlas and Atlas.load(atlas))
    with suppress(JumplabError):  # the case will say it
        planner.prepared(method)
    return planner


def run_case(
    case: Case, atlas: Path | None = None, tape: Path | None = None, tape_hz: float | None = None
) -> Plain:
    """Plan one case and audit the plan; a case without a plan is a row too, with the reason.

    ``atlas`` is the folder of an atlas of its robot to begin with; the motion goes to the file
    ``tape``, with ``tape_hz`` rows a second [Hz].
    """
    planner = _planner(case.robot, case.method, atlas)
    row, plan = grids.plan_cell(planner, case.task, case.method, case.weights)
    place = {name: getattr(case.task, name) for name in PLACE}
    which = {"robot": case.robot, "weights": dict(case.weights), "method": case.method}
    kept = tape is not None and plan is not None
    if kept:
        write_file(tape, _thinned(plan.tape, tape_hz))
    return place | which | row | {"tape": f"{TAPES}/{tape.name}" if kept else None}


@checked
def run(
    cases: list[Case],
    out: str | Path,
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    progress: bool | None = None,
    atlas: bool = False,
    tapes_hz: float | None = None,
) -> list[Plain]:
    """Plan all ``cases`` of a :func:`grid` that have no line in the folder ``out`` yet, and write
    the table.

    Returns one row per case, in their order, with the :data:`COLUMNS`. Raises :class:`InputError`
    if a robot cannot be read, the folder holds something else, an option has no effect, or there is
    no such cluster.

    Parameters
    ----------
    jobs, progress : as of :func:`.study.open_study`.
    cluster : as of :func:`.study.on_cluster`.
    atlas : build a small :class:`jumplab.Atlas` of every robot first, and begin direct plans with
        it.
    tapes_hz : also keep the motions, so many rows a second [Hz]: see :func:`_thinned`.
    """
    if atlas and any(case.method != "direct" for case in cases):
        raise InputError(
            "an atlas holds direct plans only; choose the method 'direct', or leave out the atlas"
        )
    if tapes_hz is not None and not 1 <= tapes_hz <= 1000:
        raise InputError(f"tapes_hz = {tapes_hz:g} Hz is outside 1 ... 1000 Hz")
    _check_weights(cases)
    folder = ensure_writable(out)
    robots = dict.fromkeys(case.robot for case in cases if atlas)
    places = {x: _atlas(reading.below(folder, "atlas"), cases, x, jobs) for x in robots}
    work = {}
    tapes = {}
    for case in cases:
        place = places.get(case.robot)
        name = case.key(tapes_hz, place and place.name)
        tapes[name] = tapes_hz and reading.below(folder, TAPES) / f"{name}.npz"
        work[name] = joblib.delayed(run_case)(case, place, tapes[name], tapes_hz)
    study = open_study(folder / CASES, "sweep", total=len(cases), jobs=jobs, progress=progress)
    with on_cluster(cluster) if cluster else nullcontext(), study as study:
        try:
            rows = study.results(work)
        finally:
            for name in tapes.keys() - study.done.keys() if tapes_hz else ():
                tapes[name].unlink(missing_ok=True)  # written, but stopped before its line
        settle()
        write_file(folder / TABLE, _csv(rows).encode())
    return rows


def _thinned(tape: Tape, hz: float) -> bytes:
    """A motion as a file of ``numpy.load``.

    It has ``t``, ``q``, ``v``, ``tau`` and ``flying``, in the units and the order of a plan's tape,
    as float32.
    """
    times = np.arange(0.0, tape.t[-1], 1 / hz)
    rows = np.unique(np.searchsorted(tape.t, times).clip(0, len(tape.t) - 1))
    columns = {n: getattr(tape, n)[rows].astype(np.float32) for n in ("t", "q", "v", "tau")}
    np.savez_compressed(buffer := io.BytesIO(), flying=tape.phase[rows] == "flight", **columns)
    return buffer.getvalue()


def _atlas(folder: Path, cases: Sequence[Case], robot: str, jobs: int | None) -> Path:
    """Folder of an atlas that spans the level targets of a robot; built unless it is there."""
    ours = [case.task for case in cases if case.robot == robot]
    axes = []
    for name, step in ATLAS_STEPS.items():
        low, high = (extreme(getattr(task, name) for task in ours) for extreme in (min, max))
        axes.append(np.linspace(low, high, 1 + math.ceil((high - low) / step - 1e-9)).tolist())
    place = reading.below(folder, short_hash([robot_of(robot).hash, axes]))
    Atlas.build(robot_of(robot), *axes, folder=place, jobs=jobs, progress=False)
    return place


def _check_weights(cases: list[Case]) -> None:
    """Refuse weights of terms that a stage does not have, or that are no number, before anything is
    planned.
    """
    for robot, method, weights in dict.fromkeys(
        (c.robot, c.method, tuple(c.weights.items())) for c in cases
    ):
        if weights:
            _planner(robot, method).prepared(method, dict(weights))


def _csv(rows: list[Plain]) -> str:
    out = io.StringIO(newline="")
    table = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    table.writeheader()
    for row in rows:
        weights = " ".join(f"{name}={value:g}" for name, value in sorted(row["weights"].items()))
        table.writerow({**row, "weights": weights})
    return out.getvalue()
