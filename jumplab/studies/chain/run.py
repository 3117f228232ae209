"""Chains in the simulation: jump, land, plan meanwhile, jump again, by one robot or by many that differ."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import joblib
import numpy as np

from jumplab.errors import InputError, SolverError, quoted, require_type
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim import DEFAULT_ENGINE, SLIGHT, STEP_S, Perturbation, Ranges, SensorNoise
from jumplab.sim.loop import Run
from jumplab.sim.pilot import LANDINGS
from jumplab.stages.planner import USUAL, Planner
from jumplab.studies.chain.course import Course, crouched
from jumplab.studies.chain.pilot import ChainPilot, Foresight, Rehearsal
from jumplab.studies.chain.result import ChainedJump, ChainResult
from jumplab.studies.trials import CONFIDENCE, check_numbers, in_parallel, wilson

LOOK_S = -0.3  # just before the apex of a rise of 0.3 m; foretells the toes' place to 2 mm
REVISE_S = 0.1  # the impact is over, the feet lie flat and still
EARLIEST_LOOK_S = -1.0  # longer than any flight


def run_chain(
    course: Course,
    robot: Robot,
    *,
    planner: Planner | None = None,
    rehearsal: Rehearsal | None = None,
    rehearse: bool = True,
    perturbation: Perturbation | None = None,
    solve_s: float | None = None,
    look_s: float = LOOK_S,
    revise_s: float | None = REVISE_S,
    landing: str = "spring",
    method: str = USUAL,
    engine: str = DEFAULT_ENGINE,
) -> ChainResult:
    """Let a simulated robot jump a course, planning every jump from what is measured on the way.

    The robot waits in a crouch, where it measures its own posture. Planning is charged as simulated time: a plan is
    there so much later, and the robot holds its crouch if that is late. A chain that fails is a result too. Raises
    :class:`InputError` or :class:`InfeasibleError`, before anything moves, if the course cannot be jumped, or the robot
    or a setting makes no sense.

    Parameters
    ----------
    robot : as planned; the simulated one differs from it by ``perturbation``.
    planner : of :func:`jumplab.studies.chain.crouched` ``(robot)``, with own terms or not; a new one if None.
    rehearsal : the course's plans from the crouch, with which re-plans begin; made now if None and ``rehearse``.
        Without, every plan begins from nothing.
    perturbation : of the simulated robot. With noise, where the feet stand is odometry, which drifts in every impact.
    solve_s : what each plan is charged [s]; its own wall clock if None.
    look_s : when the next jump is planned, after touchdown [s]; negative: so long before the touchdown that is due.
    revise_s : when a plan made in the air is made again, after touchdown [s]; never if None. The robot waits for
        neither: it begins with the latest plan that is there.
    landing : "planned" or "spring", see :func:`jumplab.sim.simulate_jump`.
    engine : as in :func:`jumplab.sim.simulate_jump`.
    method : as of :meth:`jumplab.Planner.plan`.
    """
    _check(course, robot, perturbation, landing, solve_s, look_s, revise_s)
    waiting = crouched(robot)
    planner = planner or Planner(waiting, keep=True)
    if planner.robot.hash != waiting.hash:
        raise InputError(f"the planner is for {planner.robot.name} in another posture; make it for crouched(robot)")
    method = planner.chosen(method)
    course.check(waiting)
    if rehearsal is None and rehearse:
        rehearsal = Rehearsal.of(course, planner, method)
    run = Run(waiting, perturbation, course.scene(waiting), engine)
    foresight = Foresight(course, waiting, planner, rehearsal, solve_s, method)
    known = run.perturbation.known_delay_s, run.perturbation.noise.force
    pilot = ChainPilot(foresight, run.scene, landing, look_s, revise_s, *known)
    run.play(pilot, stance_configuration(waiting), np.zeros(waiting.model.nv))
    settings = dict(look_s=look_s, revise_s=revise_s, landing=landing, solve_s=solve_s, method=method)
    drawn, rehearsed = run.perturbation.to_json(), rehearsal is not None
    settings |= dict(rehearsed=rehearsed, perception=run.perception, perturbation=drawn)
    return ChainResult(course, waiting, run.scene, _jumps(run, pilot), pilot.reason, settings)


def _jumps(run: Run, chain: ChainPilot) -> tuple[ChainedJump, ...]:
    """The jumps of a chain that has been run; the last may not have begun."""
    jumps = []
    for k in range(len(run.recorders)):
        plans, begun = tuple(chain.plans[k]) if k < len(chain.plans) else (), k < len(chain.began)
        landing, solves = (chain.pilots[k].ahead.to_json(), chain.pilots[k].solves) if begun else (None, (0, 0))
        log = run.result(k, solves, landing=landing, mode="position", reaim=True, disturbance=None)
        start_s, used = (chain.began[k] * STEP_S if k else 0.0), (chain.used[k] if begun else None)
        jumps.append(ChainedJump(k, start_s, used, plans, log))
    return tuple(jumps)


def _check(course, robot, perturbation, landing, solve_s, look_s, revise_s) -> None:
    require_type(course, Course, "the course")
    require_type(robot, Robot, "the robot")
    if not robot.planar:
        raise InputError(f"robot {robot.name}: chains wait in a crouch of five links, which do not describe it")
    if perturbation is not None:
        require_type(perturbation, Perturbation, "the perturbation")
    if not isinstance(landing, str) or landing not in LANDINGS:
        raise InputError(f"landing {quoted(landing)}: choose one of {', '.join(LANDINGS)}")
    solve_s, revise_s = (0.0 if x is None else x for x in (solve_s, revise_s))
    rows = ("solve_s", solve_s, 0.0, 60.0), ("look_s", look_s, EARLIEST_LOOK_S, 2.0), ("revise_s", revise_s, 0.0, 2.0)
    for name, value, low, high in rows:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise InputError(f"{name} = {quoted(value)} s is outside {low:g} ... {high:g} s")


RANGES = {"slight": SLIGHT, "wide": Ranges()}  # by the names of the command line
_ready: dict[tuple, tuple[Planner, Rehearsal | None]] = {}  # of this process: one course of one robot


@dataclass(frozen=True)
class ChainTrial:
    """One robot's chain in a few numbers; per jump, as far as it came."""

    seed: int
    stood: bool
    reason: str  # why not
    errors_m: tuple[float, ...] = ()
    heading_errors_rad: tuple[float, ...] = ()
    travels_m: tuple[float, ...] = ()
    air_s: tuple[float | None, ...] = ()  # None where it never touched down
    waits_s: tuple[float, ...] = ()  # for its plan, before each jump but the first
    # made on the way: jump (from 0), air, solve_s, cpu_s, and spare_s from being there to being needed (None: never)
    plans: tuple[dict[str, Any], ...] = ()

    @classmethod
    def of(cls, seed: int, result: ChainResult) -> ChainTrial:
        """What is kept of a chain."""
        names = ("air", "solve_s", "cpu_s", "spare_s")
        plans = tuple({"jump": p.number} | {n: getattr(p, n) for n in names} for p in result.replans)
        measured = result.errors_m, result.heading_errors_rad, result.travels_m
        numbers = (tuple(map(float, x)) for x in measured)
        air = tuple(j.air_s for j in result.jumps)
        return cls(seed, result.stood, result.reason, *numbers, air, result.waits_s, plans)


@dataclass(frozen=True)
class ChainReport:
    """Chains of many robots, in the order of their seeds."""

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
        said = {"target": asdict(self.course), "runs": len(self.trials), "confidence": CONFIDENCE}
        said |= {name: getattr(self, name) for name in ("stood", "interval", "replans", "in_time")}
        said |= {"jumps": len(self.waits_s), "begun_without_waiting": int(np.sum(self.waits_s <= 0))}
        said["largest_error_m"] = float(np.abs(self.errors_m).max()) if len(self.errors_m) else None
        return said | {"trials": [asdict(t) for t in self.trials]}


def run_chains(
    course: Course,
    robot: Robot,
    n: int,
    seed: int = 0,
    *,
    ranges: Ranges = SLIGHT,
    noise: SensorNoise | None = None,
    jobs: int | None = None,
    **how: Any,
) -> ChainReport:
    """Let ``n`` robots jump the course, drawn by the seeds ``seed``, ``seed + 1``, and so on.

    ``ranges`` and ``noise`` are those of :meth:`jumplab.sim.Perturbation.draw`, ``how`` further arguments of
    :func:`run_chain`. With more than one of ``jobs`` processes (one per core if None), what planning takes is measured
    beside the others' work.
    """
    check_numbers(n, seed, jobs)
    drawn = [Perturbation.draw(robot, seed + k, ranges, noise or SensorNoise()) for k in range(n)]
    work = [joblib.delayed(_trial)(course, robot, seed + k, one, how) for k, one in enumerate(drawn)]
    return ChainReport(course, tuple(in_parallel(work, jobs, "generator")))


def _trial(course: Course, robot: Robot, seed: int, drawn: Perturbation, how: dict) -> ChainTrial:
    planner, rehearsal = _prepared(course, robot, how)
    try:
        own = how | dict(planner=planner, rehearsal=rehearsal, perturbation=drawn)
        result = run_chain(course, robot, **own)
    except SolverError as e:  # the engine lost the robot: a failure like any other, and counted as one
        return ChainTrial(seed, False, str(e))
    return ChainTrial.of(seed, result)


def _prepared(course: Course, robot: Robot, how: dict) -> tuple[Planner, Rehearsal | None]:
    """Planner and rehearsal of this process, made by its first trial."""
    method, rehearse = how.get("method", USUAL), how.get("rehearse", True)
    planner = how.get("planner")
    key = robot.hash, course, method, rehearse, planner and planner.token
    if key not in _ready:
        _ready.clear()
        planner = planner or Planner(crouched(robot), keep=True)
        course.check(planner.robot)
        _ready[key] = planner, Rehearsal.of(course, planner, method) if rehearse else None
    return _ready[key]
