"""Many plans: a grid of targets, robots and weights, over processes or a cluster, resumed where it stopped, one table.

Every finished case is one line of ``cases.jsonl``, written whole or not at all; a sweep that was killed goes on with
the cases that have no line yet. When all have one, ``table.csv`` holds them in order.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from functools import cache
from itertools import product
from pathlib import Path

import joblib
from tqdm import tqdm

from jumplab.auditing.audit import audit
from jumplab.errors import InputError, JumplabError
from jumplab.io.folder import ensure_writable, locked, write_file
from jumplab.robot import Robot
from jumplab.stages.planner import METHODS, Planner
from jumplab.stages.whole_body import build_problem
from jumplab.stages.whole_body.planner import platform_edge_m
from jumplab.task import JumpTask

CASES, TABLE = "cases.jsonl", "table.csv"
MAX_CASES = 100_000  # our choice: a day on a hundred processors; more is a typing error
COLUMNS = ("distance_m", "height_m", "platform_m", "robot", "weights", "method", "planned", "clean", "failed_checks",
           "planned_distance_m", "planned_rise_m", "launch_s", "flight_s", "cost", "iterations", "cpu_s", "wall_s",
           "reason")  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One plan of a sweep; ``weights`` are those of stage 3 that differ from the usual, name -> value."""

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
    count = 1
    for axis in axes:
        count *= len(axis)
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
    for stage in ("reach", "direct") if method == "direct" else ("srmp", "whole body"):
        planner.stage(stage)
    return planner


def run_case(case: Case) -> dict:
    """Plan one case and audit the plan; a case without a plan is a row too, with the reason."""
    row = dict.fromkeys(COLUMNS) | asdict(case) | {"planned": False, "clean": False}
    task = JumpTask(case.distance_m, case.height_m, case.platform_m)
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        planner = _planner(case.robot, case.method)
        cpu, wall = time.process_time(), time.perf_counter()  # building is not the case's
        plan = planner.plan(task, case.method, weights=case.weights)
    except JumplabError as e:
        return row | {"reason": str(e), "cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    edge = platform_edge_m(task, plan.robot) if case.platform_m else None
    passport = audit(plan.tape, plan.robot, task, edge_m=edge)
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
        "cpu_s": cpu,
        "wall_s": wall,
    }


def run(cases: list[Case], out: str | Path, *, jobs: int = -1, cluster: str | None = None,
        progress: bool | None = None) -> list[dict]:  # fmt: skip
    """Plan all cases that have no line in ``out`` yet, and write the table.

    Parameters
    ----------
    cases : from :func:`grid`.  out : folder; made if it is not there.
    jobs : processes; -1 for as many as there are processors.
    cluster : address of a Dask scheduler that does the work instead, for instance "tcp://host:8786".
    progress : a bar; by default on a terminal only.

    Returns
    -------
    One row per case, in their order, with the columns of :data:`COLUMNS`.

    Raises
    ------
    InputError
        If a robot cannot be read, the folder holds another sweep, or there is no such cluster.
    """
    _check_weights(cases)
    hashes = {name: Robot.load(name).hash for name in sorted({case.robot for case in cases})}
    folder = ensure_writable(out)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        done = _resume(folder / CASES, cases, hashes)
        left = [case for case in cases if case.key() not in done]
        with (
            _backend(cluster),
            tqdm(
                total=len(cases), initial=len(done), unit="plan", disable=None if progress is None else not progress
            ) as bar,
            open(folder / CASES, "ab", buffering=0) as file,
        ):
            for key, row in _work(left, jobs, cluster):
                file.write(_line({"case": key, "row": row}))
                os.fsync(file.fileno())
                done[key] = row
                bar.update()
        rows = [done[case.key()] for case in cases]
        write_file(folder / TABLE, _csv(rows).encode())
    return rows


def _check_weights(cases: list[Case]) -> None:
    """Refuse weights of terms that stage 3 does not have, or that are no number, before anything is planned."""
    for case in cases:
        if case.weights:
            problem = build_problem(Robot.load(case.robot), tracking=case.method == "three-step")
            known = {t.name for _, t in problem.terms() if t.is_cost}
            for name, value in case.weights.items():
                if name not in known:
                    listed = ", ".join(sorted(known))
                    raise InputError(f"weight {name!r}: stage 3 has no such cost; it has {listed}")
                if not 0 <= value < math.inf:
                    raise InputError(f"weight {name!r} = {value:g}: it must be a number of 0 or more")


def _keyed(case: Case) -> tuple[str, dict]:
    return case.key(), run_case(case)


def _work(left: list[Case], jobs: int, cluster: str | None) -> Iterator[tuple[str, dict]]:
    if not left:
        return iter(())
    if jobs == 1 and cluster is None:
        return map(_keyed, left)
    workers = joblib.Parallel(jobs, return_as="generator_unordered")
    return workers(joblib.delayed(_keyed)(case) for case in left)


def _backend(cluster: str | None):
    """Where joblib sends the work: processes of this machine, or a Dask cluster."""
    if cluster is None:
        return joblib.parallel_config("loky", inner_max_num_threads=1)
    if not cluster:
        return nullcontext()
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs Dask: install jumplab[cluster]") from None
    try:
        client = Client(cluster, timeout="10s")
    except (OSError, ValueError, TimeoutError) as e:
        raise InputError(f"no Dask scheduler answers at {cluster!r} ({type(e).__name__})") from None
    return joblib.parallel_config("dask", client=client)


# ------------------------------------------------------------------------------------------ what is on file


def _line(data: Mapping) -> bytes:
    return (json.dumps(data, sort_keys=True) + "\n").encode()


def _resume(path: Path, cases: list[Case], hashes: Mapping[str, str]) -> dict[str, dict]:
    """Rows of an earlier run of the same sweep, by key; a last line that was cut off is forgotten."""
    wanted = [case.key() for case in cases]
    head = {"sweep": hashlib.sha256("\n".join(wanted).encode()).hexdigest(), "robots": dict(hashes)}
    if not path.exists():
        write_file(path, _line(head))
        return {}
    whole, _, rest = path.read_bytes().rpartition(b"\n")
    try:
        first, *lines = (json.loads(line) for line in whole.splitlines())
        found = {line["case"]: line["row"] for line in lines}
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{str(path)!r} is no log of a sweep; choose another folder") from None
    if first != head:
        raise InputError(
            f"{str(path.parent)!r} holds a sweep of other targets, robots or weights; choose another folder"
        )
    if rest:
        write_file(path, whole + b"\n")
    return {key: row for key, row in found.items() if key in set(wanted)}


def _csv(rows: list[dict]) -> str:
    out = io.StringIO(newline="")
    table = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    table.writeheader()
    for row in rows:
        weights = " ".join(f"{name}={value:g}" for name, value in sorted(row["weights"].items()))
        table.writerow({**row, "weights": weights})
    return out.getvalue()
