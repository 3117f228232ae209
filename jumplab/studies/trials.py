"""Many perturbed robots jump the same plan: in parallel, resumable, and the same whatever the order.

A trial is decided by its key alone (seed, number, settings, plan), and every finished one is kept at once. A run that
is stopped therefore goes on where it was, and gives what it would have given undisturbed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pinocchio as pin
from scipy.stats import binomtest
from tqdm import tqdm

from jumplab.errors import InputError, Shown, SolverError
from jumplab.io import folder as store
from jumplab.io.files import Log, open_log
from jumplab.io.progress import tell
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
    Sign,
    SimulationResult,
    signs,
    simulate_jump,
)
from jumplab.sim.engine import engine_class
from jumplab.sim.launch import check_mode
from jumplab.sim.playback import MODES
from jumplab.task import JumpTask

SCHEMA, NAME = "jumplab-trials-1", "trials.jsonl"
CONFIDENCE = 0.95
KNOWN = "plan, planned robot, lengths of links, ground, gravity, time, where the jump begins and its heading"
LOOK_S = 0.5  # how often a worker looks whether its parent still lives
# whose versions decide a trial's outcome, and which sources of this package do: trials of others are not these trials
SHAPING = ("jumplab", "casadi", "numpy", "pin", "proxsuite", "pybullet", "mujoco")
SOURCES = (
    *("errors.py", "task.py", "robot_import", "robot", "io", "ocp", "models", "stages", "sim"),
    *("studies/trials.py", "studies/basin.py"),
)
Task = tuple[Callable, tuple, dict]  # as :func:`joblib.delayed` makes it


def short_hash(data: Any) -> str:
    """64 bits of a hash of JSON data, enough to tell settings apart."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _code(root: Path = Path(__file__).parent.parent) -> str:
    parts = [root / part for part in SOURCES]
    files = sorted(f for part in parts for f in (part.rglob("*.py") if part.is_dir() else [part]))
    return short_hash([[str(f.relative_to(root)), hashlib.sha256(f.read_bytes()).hexdigest()] for f in files])


def plan_hash(summary: Mapping[str, Any]) -> str:
    """Short hash of all that a trial takes from a plan's folder: tape, robot, ground."""
    return short_hash([summary["manifest"]["files"], summary["target"], summary.get("platform_edge_m")])


# one trial ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class TrialSettings:
    """How the robots of a Monte Carlo are drawn and made to jump."""

    mode: str = "position"  # or "pd": how the tape is played until touchdown
    reaim: bool = True  # put the legs in the air to where they can catch the robot
    noise: SensorNoise = field(default_factory=SensorNoise.typical)  # on what the controllers are told
    ranges: Ranges = field(default_factory=Ranges)  # half-widths of the draws
    engine: str = DEFAULT_ENGINE  # or "mujoco"
    step: bool = False  # allow one recovery step where the feet alone cannot catch the robot
    feedback: bool = False  # correct the launch; open loop otherwise

    def __post_init__(self):
        if self.mode not in MODES:
            raise InputError(f"mode {self.mode!r}: must be one of {', '.join(MODES)}")
        if self.feedback:
            check_mode(self.mode)
        engine_class(self.engine)

    @property
    def conditions(self) -> dict[str, str]:
        """In sentences: what differs from robot to robot, what corrects it, what is measured, what is known exactly."""
        aim = (
            "the legs turn in the air against errors of trunk, speed and momentum, about all axes"
            if self.reaim
            else "no"
        )
        return {
            "playback": f"{self.mode} mode in {engine_class(self.engine).title}",
            "launch": "CoM and angular momentum are led back to the plan" if self.feedback else "open loop",
            "re-aim": aim,
            "recovery step": "one, if the robot would come to rest beyond its soles" if self.step else "none",
            "drawn uniformly, each link and joint by itself": str(self.ranges),
            "measured (one standard deviation)": str(self.noise),
            "known exactly": KNOWN,
        }

    @property
    def hash(self) -> str:
        """Short hash of these settings, and of the code and the packages that shape an outcome."""
        known = store.versions()
        return short_hash([SCHEMA, asdict(self), _code(), {name: known[name] for name in SHAPING}])


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
    """One finished trial."""

    key: TrialKey  # what it was
    perturbation: dict[str, Any]  # every drawn number, as :meth:`jumplab.sim.Perturbation.to_json` gives them
    features: dict[str, float]  # the drawn robot in a few numbers, see :func:`features`
    landed: bool  # the verdict; a run that fails a check of its honesty has not landed
    reason: str  # and why
    metrics: Metrics | None  # all numbers of the jump; None if the engine lost the robot
    signs: tuple[Sign, ...] = ()  # of a failure, the earliest of each cause, in order of time

    @property
    def cause(self) -> str:
        """What a failure is counted as: the cause whose sign came first."""
        return self.signs[0].cause if self.signs else "other"

    def to_json(self) -> dict[str, Any]:
        """The trial as the log keeps it."""
        return {"schema": SCHEMA, **asdict(self)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Trial:
        """Inverse of :meth:`to_json`; raises ValueError, KeyError or TypeError if the data are not ours."""
        data = dict(data)
        if data.pop("schema") != SCHEMA:
            raise ValueError("another schema")
        metrics = data.pop("metrics")
        if metrics is not None:
            metrics = Metrics(**{k: tuple(v) if isinstance(v, list) else v for k, v in metrics.items()})
        signs = tuple(Sign(**sign) for sign in data.pop("signs", ()))
        return cls(key=TrialKey(**data.pop("key")), metrics=metrics, signs=signs, **data)

    def as_kept(self) -> Trial:
        """The very trial that a resumed run reads."""
        return Trial.from_json(json.loads(json.dumps(self.to_json())))


def run_trial(tape: Tape, robot: Robot, scene: Scene, settings: TrialSettings, key: TrialKey) -> Trial:
    """Draw the robot of ``key`` and let it jump; raises :class:`InputError` if the tape is not this robot's."""
    how = _how(robot, settings, key)
    drawn, verdict = how["perturbation"], judged(lambda: simulate_jump(tape, robot, scene=scene, **how))
    return Trial(key, drawn.to_json(), features(drawn, robot), *verdict).as_kept()


def _how(robot: Robot, settings: TrialSettings, key: TrialKey) -> dict[str, Any]:
    drawn = Perturbation.draw(robot, key.robot_seed, settings.ranges, settings.noise)
    how = dict(mode=settings.mode, reaim=settings.reaim, step=settings.step, feedback=settings.feedback)
    return how | dict(engine=settings.engine, perturbation=drawn)


def judged(simulate: Callable[[], SimulationResult]) -> tuple[bool, str, Metrics | None, tuple[Sign, ...]]:
    """Whether a jump counts as landed, why (not), its metrics and the signs of its failure.

    A run that fails a check of its honesty has not landed.
    """
    try:
        result = simulate()
    except SolverError as e:  # the engine lost the robot: a failure like any other, and counted as one
        return False, str(e), None, ()
    if result.checks_passed:
        return result.landed, result.reason, result.metrics, signs(result)
    doubts = "; ".join(str(finding) for finding in result.checks if not finding.passed) or "nothing was checked"
    return False, f"not honest: {doubts}; the run's own verdict: {result.reason}", result.metrics, ()


def features(drawn: Perturbation, robot: Robot) -> dict[str, float]:
    """A perturbed robot in a few numbers, all relative to the planned one.

    friction [1], delay_s [s], mass [1] (whole robot), com_x_m and com_y_m [m] (whole robot, in its stance), leg_motors
    [1] (mean gain of hip, knee and ankle pitch motors, minus 1).
    """
    q, real = stance_configuration(robot), drawn.robot(robot)
    here, planned = (pin.centerOfMass(r.model, r.model.createData(), q, False).copy() for r in (real, robot))
    legs = [name for role in ("hip_pitch", "knee", "ankle_pitch") for name in robot.joints[role]]
    return {
        "friction": drawn.friction,
        "delay_s": drawn.delay_s,
        "mass": real.total_mass / robot.total_mass - 1,
        "com_x_m": float(here[0] - planned[0]),
        "com_y_m": float(here[1] - planned[1]),
        "leg_motors": float(np.mean([drawn.motor_gain.get(name, 1.0) for name in legs])) - 1,
    }


# a series of trials ------------------------------------------------------------------------------------------
@dataclass(frozen=True, repr=False)
class TrialReport(Shown):
    """A series of trials, and what they share."""

    trials: tuple[Trial, ...]  # in the order of their numbers
    seed: int
    settings: TrialSettings
    plan: str  # its hash
    target: dict[str, float]  # of the plan, as its summary says it
    resumed: int = 0  # how many were taken from an earlier run

    def line(self) -> str:
        """How many landed."""
        low, high = self.interval
        steps = f" ({self.stepped} with a recovery step)" if self.settings.step else ""
        return f"{self.landed} of {self.count} land{steps}, 95 % interval {low:.1%} ... {high:.1%}"

    @property
    def conditions(self) -> dict[str, str]:
        """Under which they jumped, in sentences: those of :class:`TrialSettings`."""
        return self.settings.conditions

    @property
    def count(self) -> int:
        """Number of trials."""
        return len(self.trials)

    @property
    def landed(self) -> int:
        """Number of those that landed."""
        return sum(t.landed for t in self.trials)

    @property
    def stepped(self) -> int:
        """Number of those that landed with a recovery step."""
        return sum(t.landed and bool(t.metrics) and t.metrics.recovery_step_s is not None for t in self.trials)

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
        numbers, sides = r"[+-]?\d+(\.\d+)?", "left_|right_"
        kinds = (re.sub(sides, "", re.sub(numbers, "...", t.reason)) for t in self.trials if not t.landed)
        return dict(Counter(kinds).most_common())

    @property
    def causes(self) -> dict[str, int]:
        """How many failures each cause explains, see :func:`jumplab.sim.signs`, the most frequent first."""
        return dict(Counter(t.cause for t in self.trials if not t.landed).most_common())

    def values(self, name: str) -> np.ndarray:
        """One metric (M,) of the trials that landed."""
        return np.array([getattr(t.metrics, name) for t in self.trials if t.landed])

    @property
    def in_plane(self) -> bool:
        """Whether the plan goes straight ahead or back."""
        return JumpTask(**self.target).in_plane

    def to_json(self) -> dict[str, Any]:
        """The content of ``trials.json``; depends on the trials alone, not on how or when they were run."""
        kinds = {"least": np.min, "median": np.median, "largest": np.max}
        measured = {
            name: {kind: float(of(x)) for kind, of in kinds.items()} if len(x := self.values(name)) else None
            for name in ("foot_distance_m", "com_rise_m", *(() if self.in_plane else ("side_m", "yaw_rad")))
        }
        return {
            "schema": SCHEMA,
            "success_rate": self.success_rate,
            "success_interval": self.interval,
            "confidence": CONFIDENCE,
            "method": "wilson",
            "counts": {"trials": self.count, "landed": self.landed, "failed": self.count - self.landed}
            | ({"landed_with_a_step": self.stepped} if self.settings.step else {}),
            "reasons": self.reasons,
            "causes": self.causes,
            "failed": {t.key.index: t.reason for t in self.trials if not t.landed},
            "landed_metrics": measured,
            "target": self.target,
            "seed": self.seed,
            "settings": {**asdict(self.settings), "hash": self.trials[0].key.settings},
            "conditions": self.conditions,
            "plan": self.plan,
            "versions": store.versions(),
        }


def wilson(landed: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate."""
    interval = binomtest(landed, count).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def run_trials(
    folder: str | Path,
    n: int,
    seed: int = 0,
    settings: TrialSettings = TrialSettings(),
    *,
    jobs: int | None = None,
    progress: bool | None = None,
    keep_falls: int = 0,
) -> TrialReport:
    """Let ``n`` perturbed robots jump the plan in ``folder``; write ``trials.jsonl`` and ``trials.json`` there.

    The first ``keep_falls`` that failed are run once more, each into a result folder of its own, ``falls/NUMBER``, for
    pictures and films. Trials that the folder already has are not run again; the first ones of a larger ``n`` are the
    same. ``jobs`` are processes, one per core if None; ``progress`` is a bar on stderr, only on a terminal if None.
    Raises :class:`InputError` for numbers that cannot be meant, or a folder without a whole plan, or one to read only.
    """
    check_numbers(n, seed, jobs)
    tape, robot, summary = store.read_plan(folder)
    tape.require_jump()
    scene, plan, known = Scene.of_plan(summary, robot), plan_hash(summary), settings.hash
    keys = [TrialKey(seed, index, known, plan) for index in range(n)]
    work = {key: joblib.delayed(run_trial)(tape, robot, scene, settings, key) for key in keys}
    trials, resumed = run_series(folder, work, jobs, progress)
    report = TrialReport(trials, seed, settings, plan, dict(summary["target"]), resumed)
    store.write_trials(folder, report.to_json(), summary, "trials.json")
    for trial in [t for t in trials if not t.landed and t.metrics is not None][:keep_falls]:
        own = Path(folder, "falls", str(trial.key.index))
        store.write_plan(own, tape, robot, summary)
        fall = simulate_jump(tape, robot, scene=scene, **_how(robot, settings, trial.key))
        store.write_simulation(own, fall, store.read_plan(own)[2])
    return report


def check_numbers(n: int, seed: int, jobs: int | None) -> None:
    """Raise :class:`InputError` unless these numbers can be meant."""
    for name, value, least in (("n", n, 1), ("seed", seed, 0), ("jobs", 1 if jobs is None else jobs, 1)):
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(f"{name} must be a whole number, got {value!r}")
        if value < least:
            raise InputError(f"{name} = {value} is too small; it must be at least {least}")


def trial_log(folder: str | Path) -> AbstractContextManager[Log[TrialKey, Trial]]:
    """The trials that ``folder`` has, see :func:`jumplab.io.files.open_log`."""
    return open_log(Path(folder) / NAME, "trials", lambda data: ((trial := Trial.from_json(data)).key, trial))


def run_series(
    folder: str | Path, work: Mapping[TrialKey, Task], jobs: int | None, progress: bool | None
) -> tuple[tuple[Trial, ...], int]:
    """Do the ``work`` that the folder's log does not have yet, and keep it there.

    Returns all trials in the order of ``work``, and how many of them the log had.
    """
    store.ensure_writable(folder)
    with trial_log(folder) as log:
        done = {key: log.done[key] for key in work if key in log.done}
        resumed = len(done)
        missing = [task for key, task in work.items() if key not in done]
        hide = None if progress is None else not progress
        with tqdm(total=len(work), initial=resumed, disable=hide, unit="jump", dynamic_ncols=True) as bar:
            for trial in in_parallel(missing, jobs):
                log.add(trial.to_json())
                done[trial.key] = trial
                bar.set_postfix_str(f"{sum(t.landed for t in done.values())} of {len(done)} landed", refresh=False)
                bar.update()
    return tuple(done[key] for key in work), resumed


# processes ------------------------------------------------------------------------------------------
def in_parallel(work: Sequence[Task], jobs: int | None, order: str = "generator_unordered") -> Iterator[Any]:
    """Results, as they come unless ``order`` says otherwise; in ``jobs`` processes, by default one per core."""
    jobs = min(jobs or joblib.cpu_count(), max(len(work), 1))
    options = {} if jobs == 1 else {"backend": "loky", **served()}
    results = joblib.Parallel(jobs, return_as=order, max_nbytes=None, **options)(work)
    tell("done", 0, len(work))
    for number, result in enumerate(results, 1):
        yield result
        tell("done", number, len(work))


def _serve(parent: int) -> None:
    """A worker's habits: Ctrl-C is its parent's affair, and without the parent there is nothing left to do."""

    def leave_with_it() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_S)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=leave_with_it, daemon=True).start()


def served() -> dict[str, Any]:
    """Arguments of joblib for workers that heed their parent alone."""
    return {"initializer": _serve, "initargs": (os.getpid(),)}
