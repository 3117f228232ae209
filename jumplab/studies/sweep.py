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
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import joblib
from tqdm import tqdm

from jumplab.auditing.audit import audit
from jumplab.errors import InputError, JumplabError
from jumplab.io.files import Log, ensure_writable, locked, made, open_log, settle, write_file
from jumplab.io.progress import tell
from jumplab.robot import Robot
from jumplab.stages.planner import METHODS, Planner
from jumplab.studies.trials import served
from jumplab.task import JumpTask

CASES, TABLE = "cases.jsonl", "table.csv"
MAX_CASES = 100_000  # a day on a hundred processors; more is a typing error
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
    method: str = "three-step"

    def key(self) -> str:
        """What tells this case from all others."""
        return json.dumps(asdict(self), sort_keys=True)


def grid(
    distances: Sequence[float],
    heights: Sequence[float],
    platforms: Sequence[float] = (0.0,),
    robots: Sequence[str] = ("bhr",),
    weights: Sequence[Mapping[str, float]] = ({},),
    method: str = "three-step",
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


@cache
def _planner(robot: str, method: str) -> Planner:
    """A planner with its stages built, once per process."""
    planner = Planner(Robot.load(robot), keep=True)
    planner.prepared(method)
    return planner


def run_case(case: Case) -> dict[str, Any]:
    """Plan one case and audit the plan; a case without a plan is a row too, with the reason."""
    row = dict.fromkeys(COLUMNS) | asdict(case) | {"planned": False, "clean": False}
    task = JumpTask(case.distance_m, case.height_m, case.platform_m)
    plan, cpu, wall = None, time.process_time(), time.perf_counter()
    try:
        planner = _planner(case.robot, case.method)
        cpu, wall = time.process_time(), time.perf_counter()  # building is not the case's
        plan = planner.plan(task, case.method, weights=case.weights)
    except JumplabError as e:
        row["reason"] = str(e)
    row |= {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
    if plan is None:
        return row
    passport = audit(plan.tape, plan.robot, task, edge_m=plan.summary["platform_edge_m"])
    return row | {
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


def run(
    cases: list[Case], out: str | Path, *, jobs: int = -1, cluster: str | None = None, progress: bool | None = None
) -> list[dict[str, Any]]:
    """Plan all ``cases`` of a :func:`grid` that have no line in the folder ``out`` yet, and write the table.

    ``jobs`` are processes, -1 for one per processor; a ``cluster``, the address of a Dask scheduler such as
    "tcp://host:8786", does the work instead. ``progress`` is a bar; by default on a terminal only. Returns one row per
    case, in their order, with the :data:`COLUMNS`. Raises :class:`InputError` if a robot cannot be read, the folder
    holds another sweep, or there is no such cluster.
    """
    _check_weights(cases)
    hashes = {name: Robot.load(name).hash for name in sorted({case.robot for case in cases})}
    folder = ensure_writable(out)
    with _backend(cluster), made(folder), _opened(folder, cases, hashes) as (log, head):
        done = {case.key(): log.done.get(case.key()) for case in cases}
        left = [case for case in cases if done[case.key()] is None]
        hide = None if progress is None else not progress
        with tqdm(total=len(cases), initial=len(cases) - len(left), unit="plan", disable=hide) as bar:
            work = joblib.Parallel(jobs, return_as="generator_unordered")
            for key, row in work(joblib.delayed(_keyed)(case) for case in left):
                if log.empty:
                    log.add(head)
                log.add({"case": key, "row": row})
                done[key] = row
                bar.update()
                tell("planned", len(cases) - list(done.values()).count(None), len(cases))
        settle()
        write_file(folder / TABLE, _csv(list(done.values())).encode())
    return list(done.values())


def _keyed(case: Case) -> tuple[str, dict[str, Any]]:
    return case.key(), run_case(case)


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
    folder: Path, cases: list[Case], hashes: Mapping[str, str]
) -> Iterator[tuple[Log[str, dict[str, Any]], dict]]:
    """The folder's log, if it is one of this very sweep, and the line that it begins with."""

    def entry(line: Any) -> tuple[str, dict[str, Any]]:
        return (line["case"], line["row"]) if "case" in line else (_HEAD, {k: line[k] for k in ("sweep", "robots")})

    wanted = "\n".join(case.key() for case in cases)
    head = {"sweep": hashlib.sha256(wanted.encode()).hexdigest(), "robots": dict(hashes)}
    with locked(folder), open_log(folder / CASES, "sweep", entry) as log:
        if not log.empty and _HEAD not in log.done:
            raise InputError(f"{str(folder / CASES)!r} is no log of a sweep; choose another folder")
        if not log.empty and log.done[_HEAD] != head:
            other = "a sweep of other targets, robots or weights"
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
