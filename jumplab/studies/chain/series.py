"""Chains of many robots that differ, in plain rows: what ``chain.json`` keeps of a series."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import joblib

from jumplab.arguments import checked
from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.sim import SLIGHT, Perturbation, Ranges, SensorNoise
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import USUAL, Planner, here
from jumplab.studies.chain.course import Course, crouched
from jumplab.studies.chain.foresight import rehearse
from jumplab.studies.chain.result import ChainResult
from jumplab.studies.chain.run import run_chain
from jumplab.studies.study import Plain, check_numbers, in_parallel
from jumplab.studies.trials import CONFIDENCE, wilson

RANGES = {"slight": SLIGHT, "wide": Ranges()}  # by the names of the command line
PER_JUMP = "errors_m", "heading_errors_rad", "travels_m", "air_s", "waits_s", "plans"


@checked
def run_chains(
    course: Course,
    robot: Robot,
    n: int,
    seed: int = 0,
    *,
    ranges: Ranges = SLIGHT,
    noise: SensorNoise | None = None,
    jobs: int | None = None,
    **arguments: Any,
) -> Plain:
    """Let ``n`` robots jump the course, drawn by the seeds ``seed``, ``seed + 1``, and so on.

    ``ranges`` and ``noise`` are those of :meth:`jumplab.sim.Perturbation.draw`, ``arguments``
    further ones of :func:`run_chain`. With more than one of ``jobs`` processes (one per core if
    None), what planning takes is measured beside the others' work. Returns the :func:`counts` of
    all robots, the course as ``target``, and one :func:`row` per robot in ``trials``.
    """
    check_numbers(n, seed, jobs)
    planner = arguments.pop("planner", None) or Planner(crouched(robot), keep=True)
    work = []
    for number in range(seed, seed + n):
        drawn = Perturbation.draw(robot, number, ranges, noise or SensorNoise())
        work.append(joblib.delayed(_trial)(course, robot, planner, number, drawn, arguments))
    trials = list(in_parallel(work, jobs, "generator"))
    return {"target": course.to_json()} | counts(trials) | {"trials": trials}


def row(seed: int, result: ChainResult) -> Plain:
    """One robot's chain in a few numbers, each per jump as far as it came.

    ``air_s`` is None where it never touched down; ``waits_s`` are for a plan, before each jump but
    the first. ``plans`` made on the way have the jump (from 0), air, solve_s, cpu_s, and spare_s
    from being there to being needed (None: never).
    """
    names = ("air", "solve_s", "cpu_s", "spare_s")
    return {
        "seed": seed,
        "stood": result.stood,
        "reason": result.reason,
        "errors_m": result.errors_m.tolist(),
        "heading_errors_rad": result.heading_errors_rad.tolist(),
        "travels_m": result.travels_m.tolist(),
        "air_s": [jump.air_s for jump in result.jumps],
        "waits_s": list(result.waits_s),
        "plans": [
            {"jump": p.number} | {name: getattr(p, name) for name in names} for p in result.replans
        ],
    }


def counts(rows: Sequence[Plain]) -> Plain:
    """Numbers of robots that stood to the end (with Wilson's 95 % interval of their share), of
    plans that were made on the way and were there when they were needed, and of jumps that began
    without waiting for a plan; and the largest error of the robots that stood [m].
    """
    standing = [x for x in rows if x["stood"]]
    spare_s = [plan["spare_s"] for x in rows for plan in x["plans"]]
    waits_s = [wait_s for x in rows for wait_s in x["waits_s"]]
    return {
        "runs": len(rows),
        "confidence": CONFIDENCE,
        "stood": len(standing),
        "interval": wilson(len(standing), len(rows)),
        "replans": len(spare_s),
        "in_time": sum(spare is not None and spare >= 0 for spare in spare_s),
        "jumps": len(waits_s),
        "begun_without_waiting": sum(wait_s <= 0 for wait_s in waits_s),
        "largest_error_m": max((abs(e) for x in standing for e in x["errors_m"]), default=None),
    }


def _trial(
    course: Course, robot: Robot, planner: Planner, seed: int, drawn: Perturbation, arguments: Plain
) -> Plain:
    planner = here(planner)
    rehearsal = _rehearsed(course, planner, arguments.get("method", USUAL))
    given = dict(planner=planner, rehearsal=rehearsal, perturbation=drawn)
    try:
        result = run_chain(course, robot, **given, **arguments)
    # the engine lost the robot: a failure like any other, and counted as one
    except SolverError as e:
        return {"seed": seed, "stood": False, "reason": str(e)} | dict.fromkeys(PER_JUMP, ())
    return row(seed, result)


@lru_cache(1)
def _rehearsed(course: Course, planner: Planner, method: str) -> tuple[JumpPlan, ...]:
    """The rehearsal of this process, made by its first trial."""
    course.check(planner.robot)
    return rehearse(course, planner, method)
