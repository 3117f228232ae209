"""Many perturbed robots jump the same plan: in parallel, resumable, and the same whatever the order.

A trial is decided by its key alone (seed, number, settings, plan), and every finished one is kept at once. A run that
is stopped therefore goes on where it was, and gives what it would have given undisturbed.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pinocchio as pin
from scipy.stats import binomtest
from tqdm import tqdm

from jumplab.errors import InputError, SolverError
from jumplab.io import folder as store
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim import (
    DEFAULT_ENGINE,
    Metrics,
    Perturbation,
    Ranges,
    Scene,
    SensorNoise,
    SimulationResult,
    simulate_jump,
)
from jumplab.sim.engine import engine_class
from jumplab.sim.playback import MODES
from jumplab.sim.result import STAND_S
from jumplab.task import JumpTask


# outcome ------------------------------------------------------------------------------------------
def outcomes(runs: Mapping[str, SimulationResult], task: JumpTask) -> list[dict]:
    """One row per quantity, one column per run, and what was asked: ready for :func:`jumplab.show.table`."""
    rows = [
        ("travel of the feet [m]", task.distance_m, lambda r: r.metrics.foot_distance_m),
        ("rise of the CoM in flight [m]", task.height_m, lambda r: r.metrics.com_rise_m),
        ("CoM, end above start [m]", task.platform_m, lambda r: round(float(r.com[-1, 2] - r.com[0, 2]), 3) + 0.0),
        ("on its feet after touchdown [s]", STAND_S, lambda r: r.metrics.standing_s),
        ("torque / limit before touchdown", 1.0, lambda r: r.metrics.max_torque_ratio_before_touchdown),
        ("speed / limit before touchdown", 1.0, lambda r: r.metrics.max_speed_ratio_before_touchdown),
        ("links pressed on each other [s]", 0.0, lambda r: r.metrics.self_collision_s),
        ("lands", True, lambda r: r.landed),
    ]
    return [{"quantity": text, "asked or allowed": asked} | {name: value(run) for name, run in runs.items()}
            for text, asked, value in rows]  # fmt: skip


# trial ------------------------------------------------------------------------------------------
SCHEMA = "jumplab-trials-1"
SHAPING = (
    "jumplab",
    "casadi",
    "numpy",
    "pin",
    "proxsuite",
    "pybullet",
    "mujoco",
)  # whose versions decide a trial's outcome
LOOKING = ("cli", "show")  # rooms of the package that decide nothing about a jump
HASH_DIGITS = 16  # 64 bits: enough to tell settings apart
LEG_ROLES = ("hip_pitch", "knee", "ankle_pitch")


@dataclass(frozen=True)
class TrialSettings:
    """How the robots of a Monte Carlo are drawn and made to jump.

    Attributes
    ----------
    mode : "position" or "pd", how the tape is played until touchdown.
    reaim : turn the legs in the air against the trunk's measured pitch error.
    noise : on what the controllers are told.
    ranges : half-widths of the draws.
    engine : "bullet" or "mujoco".
    """

    mode: str = "position"
    reaim: bool = True
    noise: SensorNoise = field(default_factory=SensorNoise)
    ranges: Ranges = field(default_factory=Ranges)
    engine: str = DEFAULT_ENGINE

    def __post_init__(self):
        if self.mode not in MODES:
            raise InputError(f"mode {self.mode!r}: must be one of {', '.join(MODES)}")
        engine_class(self.engine)

    @property
    def hash(self) -> str:
        """Short hash of these settings, of the package's own code and of the packages that shape an outcome."""
        known = store.versions()
        return _hash([SCHEMA, asdict(self), _code(), {name: known[name] for name in SHAPING}])


@dataclass(frozen=True)
class TrialKey:
    """What decides a trial's outcome, bit for bit: equal keys, equal trials."""

    seed: int
    index: int
    settings: str
    plan: str

    @property
    def robot_seed(self) -> int:
        """Seed of this trial's robot and of its sensor noise."""
        return int(np.random.SeedSequence([self.seed, self.index]).generate_state(1)[0])


@dataclass(frozen=True)
class Trial:
    """One finished trial.

    Attributes
    ----------
    key : what it was.
    perturbation : every drawn number, as :meth:`jumplab.sim.Perturbation.to_json` gives them.
    features : the drawn robot in a few numbers, see :func:`features`.
    landed, reason : the verdict, and why; a run that fails a check of its honesty has not landed.
    metrics : all numbers of the jump; None if the engine lost the robot.
    """

    key: TrialKey
    perturbation: dict[str, Any]
    features: dict[str, float]
    landed: bool
    reason: str
    metrics: Metrics | None

    def line(self) -> str:
        """The trial as one line of JSON, newline included."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, allow_nan=False) + "\n"

    @classmethod
    def from_line(cls, line: str | bytes) -> Trial:
        """Inverse of :meth:`line`; raises ValueError, KeyError or TypeError if the line is damaged or not ours."""
        data = json.loads(line)
        if data.pop("schema") != SCHEMA:
            raise ValueError("another schema")
        metrics = data.pop("metrics")
        if metrics is not None:
            metrics = Metrics(**{k: tuple(v) if isinstance(v, list) else v for k, v in metrics.items()})
        return cls(key=TrialKey(**data.pop("key")), metrics=metrics, **data)


def run_trial(tape: Tape, robot: Robot, scene: Scene, settings: TrialSettings, key: TrialKey) -> Trial:
    """Draw the robot of ``key`` and let it jump.

    Raises
    ------
    InputError
        If the tape is not this robot's.
    """
    drawn = Perturbation.draw(robot, key.robot_seed, settings.ranges, settings.noise)
    how = dict(mode=settings.mode, reaim=settings.reaim, engine=settings.engine)
    verdict = judged(lambda: simulate_jump(tape, robot, perturbation=drawn, scene=scene, **how))
    trial = Trial(key, drawn.to_json(), features(drawn, robot), *verdict)
    return Trial.from_line(trial.line())  # the very thing that a resumed run reads


def judged(simulate: Callable[[], SimulationResult]) -> tuple[bool, str, Metrics | None]:
    """Whether a jump counts as landed, why (not), and its metrics: a run that fails a check of its honesty does not."""
    try:
        result = simulate()
    except SolverError as e:  # the engine lost the robot: a failure like any other, and counted as one
        return False, str(e), None
    doubts = [str(finding) for finding in result.checks if not finding.passed]
    if result.checks_passed:
        return result.landed, result.reason, result.metrics
    doubts = "; ".join(doubts) or "nothing was checked"
    return False, f"not honest: {doubts}; the run's own verdict: {result.reason}", result.metrics


def features(drawn: Perturbation, robot: Robot) -> dict[str, float]:
    """A perturbed robot in a few numbers, all relative to the planned one.

    Returns
    -------
    friction [1], delay_s [s], mass [1] (whole robot), com_x_m and com_y_m [m] (whole robot, in its stance),
    leg_motors [1] (mean gain of hip, knee and ankle pitch motors, minus 1).
    """
    q, real = stance_configuration(robot), drawn.robot(robot)
    shift = _com(real, q) - _com(robot, q)
    legs = [drawn.motor_gain.get(name, 1.0) for role in LEG_ROLES for name in robot.joints[role]]
    return {
        "friction": drawn.friction,
        "delay_s": drawn.delay_s,
        "mass": real.total_mass / robot.total_mass - 1,
        "com_x_m": float(shift[0]),
        "com_y_m": float(shift[1]),
        "leg_motors": float(np.mean(legs)) - 1,
    }


def plan_hash(summary: Mapping[str, Any]) -> str:
    """Short hash of all that a trial takes from a plan's folder: tape, robot, ground."""
    return _hash([summary["manifest"]["files"], summary["target"], summary.get("platform_edge_m")])


def _com(robot: Robot, q: np.ndarray) -> np.ndarray:
    return pin.centerOfMass(robot.model, robot.model.createData(), q, False).copy()


def _code() -> str:
    """Hash of the package's source: trials of other code are not these trials."""
    root = Path(store.__file__).parent.parent
    files = sorted(f for f in root.rglob("*.py") if f.relative_to(root).parts[0] not in LOOKING)
    return _hash([[str(f.relative_to(root)), hashlib.sha256(f.read_bytes()).hexdigest()] for f in files])


def _hash(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:HASH_DIGITS]


# log ------------------------------------------------------------------------------------------
NAME = "trials.jsonl"


class TrialLog:
    """The open log of one folder; made by :func:`open_log`.

    Attributes
    ----------
    trials : what the log held when it was opened, by key; damaged and foreign lines are left out.
    """

    def __init__(self, descriptor: int):
        self._descriptor = descriptor
        os.lseek(descriptor, 0, os.SEEK_SET)
        with os.fdopen(os.dup(descriptor), "rb") as file:
            content = file.read()
        self._torn = bool(content) and not content.endswith(b"\n")  # killed in the middle of a line
        self.trials: dict[TrialKey, Trial] = {}
        for line in content.splitlines():
            try:
                trial = Trial.from_line(line)
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                continue
            self.trials[trial.key] = trial

    def add(self, trial: Trial) -> None:
        """Append one trial: a single write of whole lines at the file's end."""
        text = ("\n" if self._torn else "") + trial.line()
        self._torn = True  # until the whole line is there
        data = text.encode()
        while data:
            data = data[os.write(self._descriptor, data) :]
        self._torn = False


@contextmanager
def open_log(folder: str | Path) -> Iterator[TrialLog]:
    """The folder's log, for one process at a time.

    Raises
    ------
    InputError
        If the file cannot be written, or another process has it.
    """
    path = Path(folder) / NAME
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror}); choose a writable folder") from e
    try:
        _lock(descriptor, path)
        try:
            yield TrialLog(descriptor)
        finally:
            if os.fstat(descriptor).st_size == 0:
                path.unlink(missing_ok=True)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror}); free some space, or choose another folder") from e
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"{path}: another 'jumplab trials' is writing it; wait until that is done") from None
    except OSError:  # no locks on this file system: lines are appended whole in any case
        pass


# monte_carlo ------------------------------------------------------------------------------------------
CONFIDENCE = 0.95
LOOK_S = 0.5  # our choice: how often a worker looks whether its parent still lives
Task = tuple[Callable, tuple, dict]  # as :func:`joblib.delayed` makes it
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?")


@dataclass(frozen=True)
class TrialReport:
    """All trials of one seed, settings and plan, in the order of their numbers.

    Attributes
    ----------
    trials : finished trials.
    seed, settings, plan : what they share; ``plan`` is the hash of the plan.
    target : of the plan, as its summary says it.
    resumed : how many were taken from an earlier run.
    """

    trials: tuple[Trial, ...]
    seed: int
    settings: TrialSettings
    plan: str
    target: dict[str, float]
    resumed: int = 0

    @property
    def count(self) -> int:
        """Number of trials."""
        return len(self.trials)

    @property
    def landed(self) -> int:
        """Number of those that landed."""
        return sum(t.landed for t in self.trials)

    @property
    def success_rate(self) -> float:
        """Share that landed."""
        return self.landed / self.count

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate."""
        return wilson(self.landed, self.count)

    @property
    def reasons(self) -> dict[str, int]:
        """How often robots failed for which reason, the most frequent first; numbers and sides are left out."""
        return dict(Counter(kind_of(t.reason) for t in self.trials if not t.landed).most_common())

    def values(self, name: str) -> np.ndarray:
        """One metric (M,) of the trials that landed."""
        return np.array([getattr(t.metrics, name) for t in self.trials if t.landed])

    def to_json(self) -> dict[str, Any]:
        """The content of ``trials.json``; depends on the trials alone, not on how or when they were run."""
        return {
            "schema": SCHEMA,
            "success_rate": self.success_rate,
            "success_interval": self.interval,
            "confidence": CONFIDENCE,
            "method": "wilson",
            "counts": {"trials": self.count, "landed": self.landed, "failed": self.count - self.landed},
            "reasons": self.reasons,
            "failed": {t.key.index: t.reason for t in self.trials if not t.landed},
            "landed_metrics": {name: _spread(self.values(name)) for name in ("foot_distance_m", "com_rise_m")},
            "target": self.target,
            "seed": self.seed,
            "settings": {**asdict(self.settings), "hash": self.trials[0].key.settings},
            "plan": self.plan,
            "versions": store.versions(),
        }


def wilson(landed: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate."""
    interval = binomtest(landed, count).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def kind_of(reason: str) -> str:
    """A reason without its numbers and sides, so that equal kinds can be counted."""
    return _NUMBER.sub("...", reason).replace("left_", "").replace("right_", "")


def run_trials(
    folder: str | Path,
    n: int,
    seed: int = 0,
    settings: TrialSettings = TrialSettings(),
    *,
    jobs: int | None = None,
    progress: bool | None = None,
) -> TrialReport:
    """Let ``n`` perturbed robots jump the plan in ``folder``; write ``trials.jsonl`` and ``trials.json`` there.

    Trials that the folder already has are not run again.

    Parameters
    ----------
    folder : result folder of a plan.
    n : number of trials; the first ones of a larger number are the same.
    seed : of the whole series.
    jobs : processes; one per core if None.
    progress : a bar on stderr; only on a terminal if None.

    Raises
    ------
    InputError
        If ``n`` or ``seed`` cannot be meant, or the folder holds no whole plan or cannot be written.
    """
    check_numbers(n, seed, jobs)
    tape, robot, summary = store.read_plan(folder)
    scene, plan, known = Scene.of_plan(summary, robot), plan_hash(summary), settings.hash
    keys = [TrialKey(seed, index, known, plan) for index in range(n)]
    work = {key: joblib.delayed(run_trial)(tape, robot, scene, settings, key) for key in keys}
    trials, resumed = run_series(folder, work, jobs, progress)
    report = TrialReport(trials, seed, settings, plan, dict(summary["target"]), resumed)
    store.write_trials(folder, report.to_json(), summary, "trials.json")
    return report


def run_series(
    folder: str | Path, work: Mapping[TrialKey, Task], jobs: int | None, progress: bool | None
) -> tuple[tuple[Trial, ...], int]:
    """Do the ``work`` that the folder's log does not have yet, and keep it there.

    Returns
    -------
    All trials in the order of ``work``, and how many of them the log had.
    """
    store.ensure_writable(folder)
    with open_log(folder) as log:
        done = {key: log.trials[key] for key in work if key in log.trials}
        resumed = len(done)
        missing = [task for key, task in work.items() if key not in done]
        hide = not (sys.stderr.isatty() if progress is None else progress)
        with tqdm(total=len(work), initial=resumed, disable=hide, unit="jump", dynamic_ncols=True) as bar:
            for trial in in_parallel(missing, min(jobs or joblib.cpu_count(), max(len(missing), 1))):
                log.add(trial)
                done[trial.key] = trial
                bar.set_postfix_str(f"{sum(t.landed for t in done.values())} of {len(done)} landed", refresh=False)
                bar.update()
    return tuple(done[key] for key in work), resumed


def simulate_many(jumps: Mapping[str, Mapping[str, Any]], *, jobs: int | None = None) -> dict[str, SimulationResult]:
    """Several jumps at once, on several cores.

    Parameters
    ----------
    jumps : by name, the arguments of :func:`jumplab.sim.simulate_jump`, all named.
    jobs : processes; one per core if None.

    Returns
    -------
    Results by the same names, as that function gives them one by one.
    """
    work = [joblib.delayed(simulate_jump)(**arguments) for arguments in jumps.values()]
    jobs = min(jobs or joblib.cpu_count(), max(len(work), 1))
    return dict(zip(jumps, in_parallel(work, jobs, "list"), strict=True))


def in_parallel(work: Iterable[Task], jobs: int, order: str = "generator_unordered") -> Iterable[Any]:
    """Results, as they come unless ``order`` says otherwise."""
    options = {} if jobs == 1 else {"backend": "loky", "initializer": _serve, "initargs": (os.getpid(),)}
    return joblib.Parallel(jobs, return_as=order, max_nbytes=None, **options)(work)


def _serve(parent: int) -> None:
    """A worker's habits: Ctrl-C is its parent's affair, and without the parent there is nothing left to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()


def _leave_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)


def check_numbers(n: int, seed: int, jobs: int | None) -> None:
    """Raise :class:`InputError` unless these numbers can be meant."""
    for name, value, least in (("n", n, 1), ("seed", seed, 0), ("jobs", 1 if jobs is None else jobs, 1)):
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(f"{name} must be a whole number, got {value!r}")
        if value < least:
            raise InputError(f"{name} = {value} is too small; it must be at least {least}")


def _spread(values: np.ndarray) -> dict[str, float] | None:
    if not len(values):
        return None
    return {"least": float(values.min()), "median": float(np.median(values)), "largest": float(values.max())}
