"""Do two physics agree on a plan? Its audit, then every engine in both modes: the robot as planned, and perturbed ones.

Engines differ in how feet meet the ground. What a jump owes to that, and not to its plan, shows where they are apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from jumplab.auditing import AuditReport, audit
from jumplab.io import folder as store
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import ENGINES, Metrics, Perturbation, Scene, SensorNoise, simulate_jump
from jumplab.sim.engine import engine_class
from jumplab.sim.playback import MODES
from jumplab.studies import trials as series
from jumplab.studies.trials import Trial, TrialKey, TrialSettings, short_hash
from jumplab.task import JumpTask

SCHEMA, (NAME, PAGE) = "jumplab-certificate-1", store.CERTIFICATE


@dataclass(frozen=True)
class Limits:
    """How far apart engines may be and still agree: for the robot as planned, and in the median of perturbed ones."""

    touchdown_s: float = 0.005  # [s] of touchdown; five control cycles, 1.5 cm of a fall at 3 m/s
    place_m: float = 0.01  # [m] of the toes at touchdown and in the end; a twentieth of a foot
    rise_m: float = 0.01  # [m] of the CoM in flight
    pitch_rad: float = float(np.radians(1.0))  # [rad] of the trunk at touchdown: a foot 1.5 cm off
    yaw_rad: float = float(np.radians(3.0))  # [rad] of the feet in the end: what a playback may miss
    pitch_rate: float = 0.2  # [rad/s] of the trunk at touchdown; a degree more in 0.1 s
    impulse_share: float = 0.1  # [1] of the ground's vertical impulse in the 0.1 s after touchdown, relative
    force_share: float = 0.15  # [1] of its largest 20 ms mean, relative; shorter peaks are made by the engine's step
    verdict_share: float = 0.97  # [1] of perturbed robots that stand in all engines or fall in all, at least


@dataclass(frozen=True)
class Quantity:
    """What is compared: name, unit of ``value`` of a jump's metrics, its field of :class:`Limits`, relative or not."""

    name: str
    unit: str
    limit: str
    value: Callable[[Metrics], float | None]
    relative: bool = False


QUANTITIES = (
    Quantity("time of touchdown", "s", "touchdown_s", lambda m: m.touchdown_s),
    Quantity("toes at touchdown", "m", "place_m", lambda m: m.foot_distance_touchdown_m),
    Quantity("toes in the end", "m", "place_m", lambda m: m.foot_distance_m),
    Quantity("rise of the CoM", "m", "rise_m", lambda m: m.com_rise_m),
    Quantity("trunk pitch at touchdown", "rad", "pitch_rad", lambda m: m.touchdown_trunk_pitch_rad),
    Quantity("trunk pitch rate at touchdown", "rad/s", "pitch_rate", lambda m: m.touchdown_trunk_rate),
    Quantity(
        *("vertical impulse of landing", "N s", "impulse_share"),
        lambda m: m.landing_impulse and m.landing_impulse[1],
        relative=True,
    ),
    Quantity("largest force of landing", "N", "force_share", lambda m: m.landing_force_n, relative=True),
)


AWAY = (
    Quantity("side in the end", "m", "place_m", lambda m: m.side_m),
    Quantity("heading in the end", "rad", "yaw_rad", lambda m: m.yaw_rad),
)


@dataclass(frozen=True)
class Difference:
    """One quantity in all engines; ``apart`` is None where a jump did not get so far."""

    quantity: Quantity
    values: dict[str, float | None]  # by engine
    apart: float | None  # largest minus least, of their mean if the quantity is relative
    limit: float

    @classmethod
    def between(cls, quantity: Quantity, trials: Mapping[str, Trial], limits: Limits) -> Difference:
        """How far apart one robot's jumps are, by engine."""
        values = {name: trial.metrics and quantity.value(trial.metrics) for name, trial in trials.items()}
        found, apart = [x for x in values.values() if x is not None], None
        if len(found) == len(values):
            apart = (max(found) - min(found)) / (abs(float(np.mean(found))) if quantity.relative else 1.0)
        return cls(quantity, values, apart, getattr(limits, quantity.limit))

    @property
    def within(self) -> bool:
        """True if the engines agree."""
        return self.apart is not None and self.apart <= self.limit

    def to_json(self) -> dict[str, Any]:
        """Plain data, in SI units."""
        q, found = self.quantity, dict(apart=self.apart, limit=self.limit, within=self.within)
        return dict(name=q.name, unit=q.unit, relative=q.relative, **self.values, **found)


@dataclass(frozen=True)
class ModeReport:
    """What the engines made of the plan in one mode of playback."""

    mode: str
    planned: dict[str, Trial]  # by engine: the robot as planned, exact sensors, no correction in the air
    robots: dict[str, tuple[Trial, ...]]  # by engine: perturbed robots, the same in each
    settings: TrialSettings  # of those, but for the engine
    limits: Limits
    quantities: tuple[Quantity, ...] = QUANTITIES  # that are compared; out of the plane also :data:`AWAY`

    @property
    def differences(self) -> tuple[Difference, ...]:
        """Of the robot as planned."""
        return tuple(Difference.between(q, self.planned, self.limits) for q in self.quantities)

    @property
    def pairs(self) -> list[dict[str, Trial]]:
        """Every perturbed robot's jump by engine."""
        return [dict(zip(self.robots, jumps, strict=True)) for jumps in zip(*self.robots.values(), strict=True)]

    @property
    def same(self) -> int:
        """How many perturbed robots stand in all engines, or fall in all."""
        return sum(len({trial.landed for trial in pair.values()}) == 1 for pair in self.pairs)

    def apart(self, quantity: Quantity) -> np.ndarray:
        """How far apart each perturbed robot's jumps are, of those that came down in all engines."""
        found = (Difference.between(quantity, pair, self.limits).apart for pair in self.pairs)
        return np.array([x for x in found if x is not None])

    @property
    def failures(self) -> list[str]:
        """Why the engines do not agree on a landing, in sentences."""
        told = [f"{self.mode} mode: {engine} does not land it: {t.reason}"
                for engine, t in self.planned.items() if not t.landed]  # fmt: skip
        for d in self.differences:
            unit = "" if d.quantity.relative else f" {d.quantity.unit}"
            if d.apart is None:
                told.append(f"{self.mode} mode: {d.quantity.name} was not measured in every engine")
            elif not d.within:
                apart = f"the engines are {d.apart:.3g}{unit} apart in {d.quantity.name}"
                told.append(f"{self.mode} mode: {apart}, at most {d.limit:.3g}{unit}")
        for q in self.quantities:
            apart, limit = self.apart(q), getattr(self.limits, q.limit)
            if len(apart) and np.median(apart) > limit:
                middle = f"{np.median(apart):.3g}{'' if q.relative else f' {q.unit}'}"
                told.append(
                    f"{self.mode} mode: perturbed robots are {middle} apart in {q.name} (median), at most {limit:.3g}"
                )
        if self.same < self.limits.verdict_share * len(self.pairs):
            least = f"at least {100 * self.limits.verdict_share:g} % are asked for"
            told.append(f"{self.mode} mode: {self.same} of {len(self.pairs)} perturbed robots fare alike, {least}")
        return told

    def to_json(self) -> dict[str, Any]:
        """Plain data, in SI units."""
        spread = {q.name: self.apart(q) for q in self.quantities}
        robots = [
            {"number": k, "same": len({t.landed for t in pair.values()}) == 1}
            | {name: {"landed": t.landed, "reason": t.reason} for name, t in pair.items()}
            | {"apart": {q.name: Difference.between(q, pair, self.limits).apart for q in self.quantities}}
            for k, pair in enumerate(self.pairs)
        ]
        return {
            "as_planned": {name: {"landed": t.landed, "reason": t.reason} for name, t in self.planned.items()},
            "differences": [d.to_json() for d in self.differences],
            "perturbed": {
                "conditions": {k: v for k, v in self.settings.conditions.items() if k != "playback"},
                "count": len(self.pairs),
                "landed": {name: sum(t.landed for t in jumps) for name, jumps in self.robots.items()},
                "same_verdict": self.same,
                "apart": {name: dict(median=float(np.median(x)), largest=float(x.max())) if len(x) else None
                          for name, x in spread.items()},
                "robots": robots,
            },
        }  # fmt: skip


@dataclass(frozen=True)
class Certificate:
    """The audit of a plan, and what the engines made of it."""

    audit: AuditReport
    modes: tuple[ModeReport, ...]
    task: JumpTask
    robot: Robot
    plan: str  # its hash
    seed: int
    limits: Limits
    resumed: int = 0  # simulations that an earlier run had made

    @property
    def failures(self) -> list[str]:
        """What stands against the plan, in sentences; none if it is certified."""
        checks = [f"the plan fails the audit's check {check.name}" for check in self.audit.failed]
        return [*checks, *(told for mode in self.modes for told in mode.failures)]

    @property
    def passed(self) -> bool:
        """True if audit and engines agree that the plan lands."""
        return self.audit.passed and not self.failures

    def to_json(self) -> dict[str, Any]:
        """The content of ``certificate.json``; depends on plan, seed, code and packages alone."""
        checks = dict(passed=self.audit.passed, checks=len(self.audit.checks))
        return {
            "schema": SCHEMA,
            "passed": self.passed,
            "failures": self.failures,
            "target": asdict(self.task),
            "robot": {"name": self.robot.name, "hash": self.robot.hash},
            "plan": self.plan,
            "seed": self.seed,
            "audit": checks | {"failed": [check.name for check in self.audit.failed]},
            "limits": asdict(self.limits),
            "modes": {mode.mode: mode.to_json() for mode in self.modes},
            "versions": store.versions(),
        }


def certify(
    folder: str | Path,
    n: int = 10,
    seed: int = 0,
    limits: Limits = Limits(),
    *,
    page: Callable[[Certificate], str] | None = None,
    jobs: int | None = None,
    progress: bool | None = None,
) -> Certificate:
    """Audit the plan in ``folder``, and let all engines play it in both modes: as planned, and on ``n`` other robots.

    Parameters
    ----------
    n, seed : perturbed robots, drawn and controlled as those of :func:`jumplab.studies.trials.run_trials`, the same in
        each engine. Finished simulations are kept in ``trials.jsonl``: a stopped run goes on from there.
    page : makes the text of ``certificate.html``, written at one stroke with ``certificate.json``; no page if None.
    jobs, progress : as of :func:`jumplab.studies.trials.run_trials`.

    Raises
    ------
    InputError, RobotError
        For numbers that cannot be meant, a folder without a whole plan, an engine that is not installed, or a robot
        that one of them cannot read.
    """
    series.check_numbers(n, seed, jobs)
    for engine in ENGINES:
        engine_class(engine)
    tape, robot, summary = store.read_plan(folder)
    tape.require_jump()
    task, scene, plan = JumpTask(**summary["target"]), Scene.of_plan(summary, robot), series.plan_hash(summary)
    report = audit(tape, robot, task, edge_m=summary["platform_edge_m"])
    work: dict[TrialKey, series.Task] = {}
    planned, others = {}, {}
    for case in ((mode, engine) for mode in MODES for engine in ENGINES):
        mode, engine = case
        exact = TrialSettings(mode, reaim=False, noise=SensorNoise(), engine=engine)
        planned[case] = TrialKey(0, 0, short_hash(["as planned", exact.hash]), plan)
        work[planned[case]] = joblib.delayed(play_planned)(tape, robot, scene, exact, planned[case])
        settings = TrialSettings(mode, engine=engine)
        others[case] = [TrialKey(seed, index, settings.hash, plan) for index in range(n)]
        work |= {key: joblib.delayed(series.run_trial)(tape, robot, scene, settings, key) for key in others[case]}
    trials, resumed = series.run_series(folder, work, jobs, progress)
    done = dict(zip(work, trials, strict=True))
    modes = tuple(
        ModeReport(
            mode,
            {engine: done[planned[mode, engine]] for engine in ENGINES},
            {engine: tuple(done[key] for key in others[mode, engine]) for engine in ENGINES},
            TrialSettings(mode),
            limits,
            QUANTITIES if task.in_plane else (*QUANTITIES, *AWAY),
        )
        for mode in MODES
    )
    found = Certificate(report, modes, task, robot, plan, seed, limits, resumed)
    store.write_trials(folder, found.to_json(), summary, NAME, {PAGE: page(found)} if page else {})
    return found


def play_planned(tape: Tape, robot: Robot, scene: Scene, settings: TrialSettings, key: TrialKey) -> Trial:
    """Simulate the robot as planned."""
    how = dict(mode=settings.mode, reaim=settings.reaim, engine=settings.engine, scene=scene)
    return Trial(key, Perturbation().to_json(), {}, *series.judged(lambda: simulate_jump(tape, robot, **how))).as_kept()
