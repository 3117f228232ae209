"""Many perturbed robots jump the same course, in parallel; each is decided by its seed (and its plans by the clock)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import joblib
import numpy as np

from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.sim import SLIGHT, Perturbation, Ranges, SensorNoise
from jumplab.stages.planner import Planner
from jumplab.studies.chain.course import Course, crouched
from jumplab.studies.chain.foresight import Rehearsal
from jumplab.studies.chain.result import ChainResult
from jumplab.studies.chain.simulation import run_chain
from jumplab.studies.trials import CONFIDENCE, check_numbers, in_parallel, wilson

RANGES = {"slight": SLIGHT, "wide": Ranges()}  # by the names of the command line
_ready: dict[tuple, tuple[Planner, Rehearsal | None]] = {}  # of this process: one course of one robot


@dataclass(frozen=True)
class ChainTrial:
    """One robot's chain in a few numbers; per jump, as far as it came.

    Attributes
    ----------
    seed : of the robot.
    stood, reason : the verdict, and why not.
    errors_m, travels_m, air_s : per jump that began; ``air_s`` None where it never touched down.
    waits_s : before each jump but the first, how long the robot waited for its plan [s].
    plans : made on the way, each with its jump (from 0), whether it was made in the air, what it took by the clock and
        of a processor [s], and how long before it was needed it was there [s], negative if late, None if never needed.
    """

    seed: int
    stood: bool
    reason: str
    errors_m: tuple[float, ...] = ()
    travels_m: tuple[float, ...] = ()
    air_s: tuple[float | None, ...] = ()
    waits_s: tuple[float, ...] = ()
    plans: tuple[dict[str, Any], ...] = ()

    @classmethod
    def of(cls, seed: int, result: ChainResult) -> ChainTrial:
        """What is kept of a chain."""
        plans = tuple({"jump": p.number, "air": p.air, "solve_s": p.solve_s, "cpu_s": p.cpu_s,
                       "spare_s": None if p.needed_s is None else p.needed_s - p.ready_s}
                      for p in result.replans)  # fmt: skip
        numbers = (tuple(map(float, x)) for x in (result.errors_m, result.travels_m))
        air = tuple(j.air_s for j in result.jumps)
        return cls(seed, result.stood, result.reason, *numbers, air, result.waits_s, plans)


@dataclass(frozen=True)
class ChainReport:
    """Chains of many robots.

    Attributes
    ----------
    course : what they jumped.  trials : in the order of their seeds.
    """

    course: Course
    trials: tuple[ChainTrial, ...]

    @property
    def stood(self) -> int:
        """How many stood to the end."""
        return sum(t.stood for t in self.trials)

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the share that stood."""
        return wilson(self.stood, len(self.trials))

    @property
    def replans(self) -> int:
        """How many plans were made on the way."""
        return sum(len(t.plans) for t in self.trials)

    @property
    def in_time(self) -> int:
        """How many of them were there when they were needed."""
        return sum(p["spare_s"] is not None and p["spare_s"] >= 0 for t in self.trials for p in t.plans)

    @property
    def waits_s(self) -> np.ndarray:
        """How long robots waited for a plan before each jump but the first [s]."""
        return np.array([w for t in self.trials for w in t.waits_s])

    @property
    def errors_m(self) -> np.ndarray:
        """Distance errors of all jumps of the chains that stood [m]."""
        return np.array([e for t in self.trials if t.stood for e in t.errors_m])

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        errors = self.errors_m
        return {
            "target": asdict(self.course), "runs": len(self.trials), "stood": self.stood, "interval": self.interval,
            "confidence": CONFIDENCE, "replans": self.replans, "in_time": self.in_time,
            "jumps": len(self.waits_s), "begun_without_waiting": int(np.sum(self.waits_s <= 0)),
            "largest_error_m": float(np.abs(errors).max()) if len(errors) else None,
            "trials": [asdict(t) for t in self.trials],
        }  # fmt: skip


def run_chains(course: Course, robot: Robot, n: int, seed: int = 0, *, ranges: Ranges = SLIGHT,
               noise: SensorNoise | None = None, jobs: int | None = None, **how: Any) -> ChainReport:  # fmt: skip
    """Let ``n`` robots jump the course, drawn by the seeds ``seed``, ``seed + 1``, and so on.

    Parameters
    ----------
    ranges, noise : of the draws, see :meth:`jumplab.sim.Perturbation.draw`.
    jobs : processes; one per core if None. With more than one, what planning takes is measured beside the others' work.
    how : further arguments of :func:`run_chain`.
    """
    check_numbers(n, seed, jobs)
    work = [
        joblib.delayed(_trial)(course, robot, s, ranges, noise or SensorNoise(), how) for s in range(seed, seed + n)
    ]
    return ChainReport(course, tuple(in_parallel(work, min(jobs or joblib.cpu_count(), n), "list")))


def _trial(course: Course, robot: Robot, seed: int, ranges: Ranges, noise: SensorNoise, how: dict) -> ChainTrial:
    planner, rehearsal = _prepared(course, robot, how)
    drawn = Perturbation.draw(robot, seed, ranges, noise)
    try:
        return ChainTrial.of(seed, run_chain(course, robot, planner=planner, rehearsal=rehearsal, perturbation=drawn,
                                             **how))  # fmt: skip
    except SolverError as e:  # the engine lost the robot: a failure like any other, and counted as one
        return ChainTrial(seed, False, str(e))


def _prepared(course: Course, robot: Robot, how: dict) -> tuple[Planner, Rehearsal | None]:
    """Planner and rehearsal of this process, made by its first trial."""
    method, rehearse = how.get("method", "three-step"), how.get("rehearse", True)
    key = robot.hash, course, method, rehearse
    if key not in _ready:
        _ready.clear()
        planner = Planner(crouched(robot), keep=True)
        course.check(planner.robot, planner.stage("reach"))
        _ready[key] = planner, Rehearsal.of(course, planner, method) if rehearse else None
    return _ready[key]
