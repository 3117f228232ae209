"""Many plans: a grid of targets, robots and weights, over processes or a cluster, resumed where it stopped, one table.

Every finished case is one line of ``cases.jsonl``; a sweep that was killed goes on with the cases that have no line
yet. When all have one, ``table.csv`` holds them in order.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from tqdm import tqdm

from jumplab.auditing.audit import audit
from jumplab.errors import InputError, JumplabError, quoted
from jumplab.io.files import Log, ensure_writable, locked, made, open_log, settle, write_file
from jumplab.io.progress import tell
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.stages.planner import METHODS, JumpPlan, Planner
from jumplab.studies.atlas import Atlas
from jumplab.studies.trials import served
from jumplab.task import JumpTask

CASES, TABLE = "cases.jsonl", "table.csv"
MAX_CASES = 100_000  # a day on a hundred processors; more is a typing error
BATCH = 25  # cases that one process takes at a time, in a large sweep
KEPT = 2  # planners that a process keeps: robots run slowest, so a batch has one robot or two
ATLAS_STEPS = {"distance_m": 0.3, "height_m": 0.15}  # [m] between the nodes of a sweep's atlas, at most
_HEAD = "head"  # key of the log's first line, which says of what sweep it is
COLUMNS = (
    *("distance_m", "height_m", "platform_m", "robot", "weights", "method", "planned", "clean", "failed_checks"),
    *("planned_distance_m", "planned_rise_m", "launch_s", "flight_s", "cost", "iterations", "cpu_s", "wall_s"),
    "reason",
)


@dataclass(frozen=True)
class Case:
    """One plan of a sweep; ``weights`` are those that differ from the usual, named as in :class:`jumplab.Planner`."""

    distance_m: float
    height_m: float
    platform_m: float = 0.0
    robot: str = "bhr"
    weights: Mapping[str, float] = field(default_factory=dict)
    method: str = "direct"

    def key(self) -> str:
        """What tells this case from all others."""
        return json.dumps(asdict(self), sort_keys=True)


def grid(
    distances: Sequence[float],
    heights: Sequence[float],
    platforms: Sequence[float] = (0.0,),
    robots: Sequence[str] = ("bhr",),
    weights: Sequence[Mapping[str, float]] = ({},),
    method: str = "direct",
) -> list[Case]:
    """All combinations, distances running fastest; refuses none, too many, and impossible targets or methods."""
    if method not in METHODS:
        raise InputError(f"method {method!r}: choose one of {', '.join(METHODS)}")
    axes = (robots, weights, platforms, heights, distances)
    count = math.prod(map(len, axes))
    if not 1 <= count <= MAX_CASES:
        raise InputError(f"the sweep has {count} cases; it takes 1 to {MAX_CASES}")
    out = []
    for robot, weight, platform, height, distance in product(*axes):
        JumpTask(float(distance), float(height), float(platform))
        out.append(Case(float(distance), float(height), float(platform), robot, dict(weight), method))
    if len({case.key() for case in out}) < len(out):
        raise InputError("the sweep has the same case twice; give every value once")
    return out


VARIED = {  # what of a robot a sweep varies -> the robot with a factor on it
    "mass": lambda robot, x: robot.with_mass(factor=x),
    "effort": lambda robot, x: robot.with_limits(effort=x),
    "speed": lambda robot, x: robot.with_limits(speed=x),
    "leg": lambda robot, x: robot.with_legs(x),
}


def varied(robots: Sequence[str], factors: Sequence[Mapping[str, float]]) -> list[str]:
    """Names of robots, each with all the factors on :data:`VARIED`, such as "bhr mass=1.1 leg=0.9"."""
    unknown = next((what for each in factors for what in each if what not in VARIED), None)
    if unknown is not None:
        raise InputError(f"a sweep varies {', '.join(VARIED)} of a robot, not {quoted(unknown)}")
    told = ["".join(f" {what}={x:g}" for what, x in each.items() if x != 1.0) for each in factors]
    return [robot + words for robot in robots for words in told]


@cache
def _robot(name: str) -> Robot:
    """A robot by its name in a sweep, see :func:`varied`."""
    first, _, last = name.rpartition(" ")
    what, equals, factor = last.partition("=")
    return VARIED[what](_robot(first), float(factor)) if equals and what in VARIED else Robot.load(name)


@lru_cache(KEPT)
def _planner(robot: str, method: str, atlas: Path | None = None) -> Planner:
    """A planner with its stages built, kept while its robot is at work; ``atlas`` is the folder of one."""
    planner = Planner(_robot(robot), keep=True, atlas=atlas and Atlas.load(atlas))
    planner.prepared(method)
    return planner


def run_case(case: Case) -> dict[str, Any]:
    """Plan one case and audit the plan; a case without a plan is a row too, with the reason."""
    return _planned(case)[0]


def _planned(case: Case, atlas: Path | None = None) -> tuple[dict[str, Any], JumpPlan | None]:
    """The row of a case, and its plan; ``atlas`` is the folder of an atlas of its robot to begin with."""
    row = dict.fromkeys(COLUMNS) | asdict(case) | {"planned": False, "clean": False}
    task = JumpTask(case.distance_m, case.height_m, case.platform_m)
    plan, cpu, wall = None, time.process_time(), time.perf_counter()
    try:
        planner = _planner(case.robot, case.method, atlas)
        cpu, wall = time.process_time(), time.perf_counter()  # building is not the case's
        plan = planner.plan(task, case.method, weights=case.weights)
    except JumplabError as e:
        row["reason"] = str(e)
    row |= {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
    if plan is None:
        return row, None
    passport = audit(plan.tape, plan.robot, task, edge_m=plan.summary["platform_edge_m"])
    row |= {
        "planned": True,
        "clean": passport.passed,
        "failed_checks": ", ".join(check.name for check in passport.failed),
        "planned_distance_m": plan.planned_distance_m,
        "planned_rise_m": plan.planned_rise_m,
        "launch_s": plan.whole_body.launch_s,
        "flight_s": plan.whole_body.flight_s,
        "cost": plan.whole_body.solution.statistics.objective,
        "iterations": sum(stage.iterations for stage in plan.statistics),
    }
    return row, plan


def run(
    cases: list[Case],
    out: str | Path,
    *,
    jobs: int = -1,
    cluster: str | None = None,
    progress: bool | None = None,
    atlas: bool = False,
    tapes_hz: float | None = None,
) -> list[dict[str, Any]]:
    """Plan all ``cases`` of a :func:`grid` that have no line in the folder ``out`` yet, and write the table.

    Returns one row per case, in their order, with the :data:`COLUMNS`. Raises :class:`InputError` if a robot cannot be
    read, the folder holds another sweep, an option has no effect, or there is no such cluster.

    Parameters
    ----------
    jobs : processes, -1 for one per processor.
    cluster : address of a Dask scheduler, such as "tcp://host:8786", that does the work instead.
    progress : a bar; by default on a terminal only.
    atlas : build a small :class:`jumplab.Atlas` of every robot first, and begin direct plans with it.
    tapes_hz : also keep the motions, so many rows a second, in ``tapes/``: see :func:`_shard`.
    """
    if atlas and any(case.method != "direct" for case in cases):
        raise InputError("an atlas holds direct plans: choose the method 'direct', or leave it away")
    if tapes_hz is not None and not 1 <= tapes_hz <= 1000:
        raise InputError(f"tapes_hz = {tapes_hz:g} Hz is outside 1 ... 1000 Hz")
    _check_weights(cases)
    hashes = {name: _robot(name).hash for name in sorted({case.robot for case in cases})}
    folder = ensure_writable(out)
    how = {"atlas": atlas, "tapes_hz": tapes_hz} if atlas or tapes_hz else {}
    with _backend(cluster), made(folder), _opened(folder, cases, hashes, how) as (log, head):
        places = {name: _atlas(folder / "atlas" / str(k), cases, name, jobs) for k, name in enumerate(hashes) if atlas}
        done = {case.key(): log.done.get(case.key()) for case in cases}
        left = [(k, case) for k, case in enumerate(cases) if done[case.key()] is None]
        size = min(BATCH, 1 + len(left) // 50)
        batches = [left[k : k + size] for k in range(0, len(left), size)]
        hide = None if progress is None else not progress
        with tqdm(total=len(cases), initial=len(cases) - len(left), unit="plan", disable=hide) as bar:
            work = joblib.Parallel(jobs, return_as="generator_unordered")
            for rows in work(joblib.delayed(_batch)(batch, places, folder, tapes_hz) for batch in batches):
                if log.empty:
                    log.add(head)
                for key, row in rows:
                    log.add({"case": key, "row": row})
                    done[key] = row
                bar.update(len(rows))
                tell("planned", len(cases) - list(done.values()).count(None), len(cases))
        settle()
        write_file(folder / TABLE, _csv(list(done.values())).encode())
    return list(done.values())


def _batch(
    cases: Sequence[tuple[int, Case]], atlases: Mapping[str, Path], folder: Path, tapes_hz: float | None
) -> list[tuple[str, dict[str, Any]]]:
    """Rows of some cases with their keys; their motions go into one file of ``tapes/``."""
    rows, tapes = [], {}
    for number, case in cases:
        row, plan = _planned(case, atlases.get(case.robot))
        rows.append((case.key(), row))
        if plan is not None and tapes_hz:
            tapes[number] = plan.tape
    if tapes:
        write_file(folder / "tapes" / f"{cases[0][0]:06d}.npz", _shard(tapes, tapes_hz))
    return rows


def _shard(tapes: Mapping[int, Tape], hz: float) -> bytes:
    """Motions one after the other, as a file of ``numpy.load``.

    ``case`` (n,) are their lines in the table, from 0; motion i has the rows first[i] to first[i + 1] of ``t``, ``q``,
    ``v``, ``tau`` and ``flying``, in the units and the order of a plan's tape, as float32.
    """
    parts, first = [], [0]
    for tape in tapes.values():
        rows = np.unique(np.searchsorted(tape.t, np.arange(0.0, tape.t[-1], 1 / hz)).clip(0, len(tape.t) - 1))
        parts.append([x[rows].astype(np.float32) for x in (tape.t, tape.q, tape.v, tape.tau)])
        parts[-1].append(tape.phase[rows] == "flight")
        first.append(first[-1] + len(rows))
    names = ("t", "q", "v", "tau", "flying")
    columns = {name: np.concatenate(x) for name, x in zip(names, zip(*parts, strict=True), strict=True)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, case=np.array(list(tapes)), first=np.array(first), **columns)
    return buffer.getvalue()


def _atlas(folder: Path, cases: Sequence[Case], robot: str, jobs: int) -> Path:
    """Folder of an atlas that spans the level targets of a robot; built unless it is there."""
    ours = [case for case in cases if case.robot == robot]
    axes = []
    for name, step in ATLAS_STEPS.items():
        low, high = (extreme(getattr(case, name) for case in ours) for extreme in (min, max))
        axes.append(np.unique(np.linspace(low, high, 1 + math.ceil((high - low) / step - 1e-9))))
    Atlas.build(_robot(robot), *axes, folder=folder, jobs=jobs)
    return folder


def _check_weights(cases: list[Case]) -> None:
    """Refuse weights of terms that a stage does not have, or that are no number, before anything is planned."""
    for robot, method, weights in dict.fromkeys((c.robot, c.method, tuple(c.weights.items())) for c in cases):
        if weights:
            _planner(robot, method).prepared(method, dict(weights))


def _backend(cluster: str | None) -> AbstractContextManager:
    """Where joblib sends the work: processes of this machine, or a Dask cluster."""
    if not cluster:
        return joblib.parallel_config("loky", inner_max_num_threads=1, **served())
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs Dask: install jumplab[cluster]") from None
    try:
        client = Client(cluster, timeout="10s")
    except (OSError, ValueError, TimeoutError) as e:
        raise InputError(f"no Dask scheduler answers at {cluster!r} ({type(e).__name__})") from None
    return joblib.parallel_config("dask", client=client)


@contextmanager
def _opened(
    folder: Path, cases: list[Case], hashes: Mapping[str, str], how: Mapping[str, Any]
) -> Iterator[tuple[Log[str, dict[str, Any]], dict]]:
    """The folder's log, if it is one of this very sweep, and the line that it begins with."""

    def entry(line: Any) -> tuple[str, dict[str, Any]]:
        return (line["case"], line["row"]) if "case" in line else (_HEAD, {"sweep": line["sweep"], **line})

    wanted = "\n".join(case.key() for case in cases)
    head = {"sweep": hashlib.sha256(wanted.encode()).hexdigest(), "robots": dict(hashes), **how}
    with locked(folder), open_log(folder / CASES, "sweep", entry) as log:
        if not log.empty and _HEAD not in log.done:
            raise InputError(f"{str(folder / CASES)!r} is no log of a sweep; choose another folder")
        if not log.empty and log.done[_HEAD] != head:
            other = "a sweep of other targets, robots, weights or options"
            raise InputError(f"{str(folder)!r} holds {other}; choose another folder")
        yield log, head


def _csv(rows: list[dict[str, Any]]) -> str:
    out = io.StringIO(newline="")
    table = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    table.writeheader()
    for row in rows:
        weights = " ".join(f"{name}={value:g}" for name, value in sorted(row["weights"].items()))
        table.writerow({**row, "weights": weights})
    return out.getvalue()
