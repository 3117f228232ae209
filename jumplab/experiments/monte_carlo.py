"""Many perturbed robots jump the same plan: in parallel, resumable, and the same whatever the order.

A trial is decided by its key alone (seed, number, settings, plan), and every finished one is kept at once. A run that
is stopped therefore goes on where it was, and gives what it would have given undisturbed.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from jumplab import store
from jumplab.errors import InputError
from jumplab.experiments.log import open_log
from jumplab.experiments.trial import SCHEMA, Trial, TrialKey, TrialSettings, plan_hash, run_trial
from jumplab.simulation import Scene, SimulationResult, simulate_jump

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
    jumps : by name, the arguments of :func:`jumplab.simulation.simulate_jump`, all named.
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
