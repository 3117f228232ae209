"""Many perturbed robots jump the same plan: in parallel, resumable, and the same whatever the
order.

A trial is decided by its key alone (seed, number, settings, plan), and every finished one is kept
at once. A run that is stopped therefore resumes where it was, and gives what it would have given
undisturbed.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from scipy.stats import binomtest

from jumplab import reading
from jumplab.arguments import checked
from jumplab.control.launch import check_mode
from jumplab.control.servo import servo_of
from jumplab.errors import Shown, SolverError
from jumplab.io import folder as store
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import (
    CONTACTS,
    DEFAULT_ENGINE,
    Disturbance,
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
from jumplab.studies.study import Plain, Study, Task, check_numbers, key_of, open_study, short_hash
from jumplab.task import JumpTask

SCHEMA = "jumplab-trials-1"
NAME = "trials.jsonl"
CONFIDENCE = 0.95
# what is corrected: without, with
LAUNCH = (
    "open loop on two feet; on one, CoM, L, trunk and the other foot are led back to the plan",
    "CoM and angular momentum are led back to the plan",
)
REAIM = "no", "the legs turn in the air against errors of trunk, speed and momentum, about all axes"
STEP = "none", "whenever the robot would come to rest beyond its soles"
KNOWN = (
    "plan, planned robot, lengths of links, ground, gravity, time, where the jump begins and its "
    "heading"
)


@dataclass(frozen=True)
class PlanOnFile:
    """The plan in a folder, as simulations play it; what they give is kept beside it."""

    folder: Path
    tape: Tape
    robot: Robot
    scene: Scene
    summary: Mapping[str, Any]

    @classmethod
    def read(cls, folder: str | Path) -> PlanOnFile:
        """The plan of a ``folder`` (that of ``jumplab plan``); raises :class:`InputError` if it
        holds no whole one.
        """
        tape, robot, summary = store.read_plan(folder)
        return cls(Path(folder), tape, robot, Scene.of_plan(summary, robot), summary)

    @property
    def hash(self) -> str:
        """Short hash of all that a trial takes from here: tape, robot, ground."""
        names = self.summary["manifest"]["files"], self.summary["target"]
        over = self.summary.get("over") or ()
        return short_hash([*names, self.summary.get("platform_edge_m"), *over])

    def study(self, **options: Any) -> AbstractContextManager[Study]:
        """A study of trials, kept in ``trials.jsonl``; options as of :func:`.study.open_study`."""
        store.ensure_writable(self.folder)
        return open_study(self.folder / NAME, "trials", Trial, **options)

    def trials(self, settings: TrialSettings, seed: int, numbers: Iterable[int]) -> dict[str, Task]:
        """The trials of some ``numbers`` (from 0), as a study's work."""
        known = settings.hash, self.hash
        keys = [TrialKey(seed, number, *known) for number in numbers]
        return {key.name: joblib.delayed(run_trial)(self, settings, key) for key in keys}

    def write(self, name: str, report: Mapping[str, Any], pages: Mapping[str, str] = {}) -> None:
        """Write a ``report`` and ``pages`` (text by name) beside the plan, if that is still the one
        in the folder.
        """
        store.write_trials(self.folder, report, self.summary, name, pages)


# one trial
# ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class TrialSettings:
    """Settings of a Monte Carlo: the draws of its robots, and the playback of their jumps."""

    mode: str = "position"  # the servo that plays the tape until touchdown
    reaim: bool = True  # put the legs in the air to where they can catch the robot
    # on what the controllers are told
    noise: SensorNoise = field(default_factory=SensorNoise.typical)
    ranges: Ranges = field(default_factory=Ranges)  # half-widths of the draws
    engine: str = DEFAULT_ENGINE  # or "mujoco"
    step: bool = False  # allow recovery steps where the feet alone cannot catch the robot
    feedback: bool = False  # correct the launch; open loop otherwise, but on one foot
    contact: str = CONTACTS[0]  # how the ground gives way

    def __post_init__(self):
        servo_of(self.mode)
        if self.feedback:
            check_mode(self.mode)
        engine_class(self.engine).contact_of(self.contact)

    @property
    def conditions(self) -> dict[str, str]:
        """In sentences: what differs from robot to robot, what corrects it, what is measured, what
        is known exactly.
        """
        return {
            "playback": f"{self.mode} mode ({servo_of(self.mode).told}) in "
            f"{engine_class(self.engine).title}, {self.contact} contact",
            "launch": LAUNCH[self.feedback],
            "re-aim": REAIM[self.reaim],
            "recovery step": STEP[self.step],
            "drawn uniformly, each link and joint by itself": str(self.ranges),
            "measured (one standard deviation)": str(self.noise),
            "known exactly": KNOWN,
        }

    def draw(self, robot: Robot, seed: int) -> Perturbation:
        """The robot of a ``seed``, with its sensors."""
        return Perturbation.draw(robot, seed, self.ranges, self.noise)

    def simulate(self, plan: PlanOnFile, drawn: Perturbation, **options: Any) -> SimulationResult:
        """The jump of a ``drawn`` robot; ``options`` as of :func:`jumplab.sim.simulate_jump`."""
        names = ["mode", "reaim", "step", "engine", "contact"]
        if self.feedback:  # on one foot also without being asked
            names.append("feedback")
        options |= {name: getattr(self, name) for name in names}
        options |= {"scene": plan.scene, "perturbation": drawn}
        return simulate_jump(plan.tape, plan.robot, **options)

    @property
    def hash(self) -> str:
        """Short hash of these settings, and of the code and the packages that shape an outcome."""
        return key_of(SCHEMA, asdict(self))


@dataclass(frozen=True)
class TrialKey:
    """Key of all that decides a trial's outcome, bit for bit: equal keys, equal trials."""

    seed: int
    index: int
    settings: str
    plan: str

    @property
    def robot_seed(self) -> int:
        """Seed of this trial's robot and of its sensor noise."""
        return int(np.random.SeedSequence([self.seed, self.index]).generate_state(1)[0])

    @property
    def name(self) -> str:
        """By which the trial is found in a log."""
        return short_hash(asdict(self))


@dataclass(frozen=True)
class Trial:
    """One finished trial."""

    key: TrialKey  # what it was
    # every drawn number, as :meth:`jumplab.sim.Perturbation.to_json` gives them
    perturbation: Plain
    features: dict[str, float]  # the case in a few numbers, where a study gives them
    landed: bool  # the verdict; a run that fails one of its checks has not landed
    reason: str  # and why
    metrics: Metrics | None  # all numbers of the jump; None if the engine lost the robot
    signs: tuple[Sign, ...] = ()  # of a failure, the earliest of each cause, in order of time

    @property
    def cause(self) -> str:
        """Cause by which a failure is counted: the one whose sign came first."""
        return self.signs[0].cause if self.signs else "other"

    def to_json(self) -> Plain:
        """The trial as the log keeps it."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Trial:
        """Inverse of :meth:`to_json` (a line of the log); raises KeyError or TypeError if the data
        are not ours.
        """
        data = dict(data)
        if (metrics := data["metrics"]) is not None:
            lists = {k: tuple(v) for k, v in metrics.items() if isinstance(v, list)}
            data["metrics"] = Metrics(**metrics | lists)
        data["key"] = TrialKey(**data["key"])
        data["signs"] = tuple(Sign(**sign) for sign in data["signs"])
        return cls(**data)


def run_trial(
    plan: PlanOnFile,
    settings: TrialSettings,
    key: TrialKey,
    drawn: Perturbation | None = None,
    disturbance: Disturbance | None = None,
) -> Trial:
    """Draw the robot of ``key``, unless it is ``drawn``, and let it jump (tape, robot and scene of)
    a ``plan``, from the apex of the flight if there is a ``disturbance``; raises
    :class:`InputError` if the tape is not this robot's (see :func:`jumplab.sim.simulate_jump`).
    """
    drawn = drawn or settings.draw(plan.robot, key.robot_seed)
    play = partial(settings.simulate, plan, drawn, disturbance=disturbance)
    return Trial(key, drawn.to_json(), {}, *judged(play))


def judged(
    simulate: Callable[[], SimulationResult],
) -> tuple[bool, str, Metrics | None, tuple[Sign, ...]]:
    """Verdict on a jump: whether it counts as landed, the reason, its metrics and the signs of its
    failure.

    A run that fails one of its checks has not landed.
    """
    try:
        result = simulate()
    # the engine lost the robot: a failure like any other, and counted as one
    except SolverError as e:
        return False, str(e), None, ()
    if result.checks_passed:
        return result.landed, result.reason, result.metrics, signs(result)
    failed = [str(finding) for finding in result.checks if not finding.passed]
    doubts = "; ".join(failed) or "nothing was checked"
    reason = f"failed checks of the run: {doubts}; the run's own verdict: {result.reason}"
    return False, reason, result.metrics, ()


# a series of trials
# ------------------------------------------------------------------------------------------
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
        """Number of robots that landed, in one line."""
        low, high = self.interval
        steps = f" ({self.stepped} with recovery steps)" if self.settings.step else ""
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
    def failed(self) -> list[Trial]:
        """Those that did not."""
        return [t for t in self.trials if not t.landed]

    @property
    def stepped(self) -> int:
        """Number of those that landed with recovery steps."""
        landed = [t.metrics for t in self.trials if t.landed and t.metrics]
        return sum(m.recovery_step_s is not None for m in landed)

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
        """Number of failures for each reason, the most frequent first; numbers and sides are left
        out.
        """
        reasons = (re.sub(r"[+-]?\d+(\.\d+)?", "...", t.reason) for t in self.failed)
        kinds = Counter(re.sub("left_|right_", "", reason) for reason in reasons)
        return dict(kinds.most_common())

    @property
    def causes(self) -> dict[str, int]:
        """Number of failures for each cause, see :func:`jumplab.sim.signs`, the most frequent
        first.
        """
        return dict(Counter(t.cause for t in self.failed).most_common())

    def values(self, name: str) -> np.ndarray:
        """One metric (M,) of the trials that landed."""
        return np.array([getattr(t.metrics, name) for t in self.trials if t.landed])

    def rows(self) -> list[Plain]:
        """Lines of a table: how many landed, or failed for which reason and by which first sign."""
        low, high = self.interval
        share = f"{self.success_rate:.1%} ({low:.1%} ... {high:.1%})"
        counts = {**self.reasons, **{f"began with: {x}": n for x, n in self.causes.items()}}
        rows = [{"outcome": "landed", "robots": self.landed, "share, 95 % interval": share}]
        return rows + [{"outcome": outcome, "robots": n} for outcome, n in counts.items()]

    def to_json(self) -> Plain:
        """The content of ``trials.json``; depends on the trials alone, not on how or when they were
        run.
        """
        names = ["foot_distance_m", "com_rise_m"]
        names += [] if JumpTask.of(self.target).in_plane else ["side_m", "yaw_rad"]
        measured = {}
        for name in names:
            x = self.values(name)
            three = np.percentile(x, [0, 50, 100]).tolist() if len(x) else None
            measured[name] = three and dict(zip(("least", "median", "largest"), three, strict=True))
        counts = {"trials": self.count, "landed": self.landed, "failed": len(self.failed)}
        if self.settings.step:
            counts["landed_with_a_step"] = self.stepped
        return {
            "schema": SCHEMA,
            "success_rate": self.success_rate,
            "success_interval": self.interval,
            "confidence": CONFIDENCE,
            "method": "wilson",
            "counts": counts,
            "reasons": self.reasons,
            "causes": self.causes,
            "failed": {t.key.index: t.reason for t in self.failed},
            "landed_metrics": measured,
            "target": self.target,
            "seed": self.seed,
            "settings": {**asdict(self.settings), "hash": self.trials[0].key.settings},
            "conditions": self.conditions,
            "plan": self.plan,
            "versions": store.versions(),
        }


def wilson(landed: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval (low, high) of a success rate [1]."""
    low, high = binomtest(landed, count).proportion_ci(CONFIDENCE, method="wilson")
    return float(low), float(high)


@checked
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
    """Let ``n`` perturbed robots jump the plan in ``folder`` (one that is whole); write
    ``trials.jsonl`` and ``trials.json`` there.

    The first ``keep_falls`` that failed are run once more, each into a result folder of its own,
    ``falls/NUMBER``, for pictures and films. Trials that the folder already has are not run again;
    the first ones of a larger ``n`` are the same. ``jobs`` are processes, one per core if None;
    ``progress`` is a bar on stderr, only on a terminal if None. Raises :class:`InputError` for
    numbers that cannot be meant, or a folder without a whole plan, or one to read only.
    """
    check_numbers(n, seed, jobs)
    plan = PlanOnFile.read(folder)
    with plan.study(total=n, jobs=jobs, progress=progress) as study:
        trials = study.results(plan.trials(settings, seed, range(n)))
    target = dict(plan.summary["target"])
    report = TrialReport(tuple(trials), seed, settings, plan.hash, target, study.resumed)
    plan.write("trials.json", report.to_json())
    for trial in [t for t in report.failed if t.metrics is not None][:keep_falls]:
        place = reading.below(folder, "falls", str(trial.key.index))
        store.write_plan(place, plan.tape, plan.robot, plan.summary)
        drawn = settings.draw(plan.robot, trial.key.robot_seed)
        fall = settings.simulate(plan, drawn)
        store.write_simulation(place, fall, store.read_plan(place)[2])
    return report
