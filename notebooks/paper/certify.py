"""Do two physics agree on a plan? Its audit, then every engine in some modes: the robot as planned,
and perturbed ones; and the robot as planned on contacts as each engine has them by default.

Engines differ in how feet meet the ground. Their differences show which part of a jump depends on
that, and not on its plan.

They also depend on the servos: drives that hold angles let a robot on one foot tip a little
differently on each ground, where servos that measure the base do not. A certificate is therefore
one of a plan in the modes that it names, and of all of these: a user asks for those in which the
plan will be played. The limits are the same in every mode.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from jumplab.arguments import checked
from jumplab.auditing import AuditReport, audit
from jumplab.control.servo import servo_of
from jumplab.errors import InputError, quoted
from jumplab.io import folder as store
from jumplab.robot import Robot
from jumplab.show.style import LANDING, VERMILION, describe_task
from jumplab.show.tables import table
from jumplab.show.viewer import Page, page_of
from jumplab.sim import ENGINES, Perturbation, SensorNoise
from jumplab.sim.engine import engine_class
from jumplab.studies.study import Plain, Task, check_numbers, short_hash
from jumplab.studies.trials import PlanOnFile, Trial, TrialKey, TrialSettings, run_trial
from jumplab.task import JumpTask

MODES = "position", "pd"  # usual ones, which need no more than joints measure
SCHEMA = "jumplab-certificate-1"
(NAME, PAGE) = store.CERTIFICATE
# of perturbed robots, in whichever mode and engine
CONDITIONS = {name: x for name, x in TrialSettings().conditions.items() if name != "playback"}


TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
LIMITS = TABLE["limits"]


@dataclass(frozen=True)
class Quantity:
    """Quantity to compare: name and unit, a field of a jump's metrics, one of :data:`LIMITS`."""

    name: str
    unit: str
    metric: str
    limit: str
    relative: bool = False  # to its mean

    def of(self, trial: Trial) -> float | None:
        """Its value in one jump [its unit]; None if that did not get so far."""
        value = trial.metrics and getattr(trial.metrics, self.metric)
        return value[1] if isinstance(value, tuple) else value  # of an impulse, the vertical part

    def apart(self, trials: Iterable[Trial]) -> float | None:
        """Largest minus least [its unit], of their mean if it is relative [1]; None unless all got
        so far.
        """
        values = [self.of(trial) for trial in trials]
        if None in values:
            return None
        return (max(values) - min(values)) / (abs(float(np.mean(values))) if self.relative else 1)

    def with_unit(self, value: float) -> str:
        """A difference [its unit] as text; relative ones have no unit."""
        return f"{value:.3g}" if self.relative else f"{value:.3g} {self.unit}"


QUANTITIES = tuple(Quantity(**x) for x in TABLE["quantities"])
AWAY = tuple(Quantity(**x) for x in TABLE["away"])  # of a jump out of the plane, besides


# of a table of differences, by their keys
COLUMNS = {"name": "as planned", "unit": "unit"} | {engine: engine for engine in ENGINES}
COLUMNS |= {"apart": "apart", "relative": "of the mean", "limit": "at most", "within": "agree"}
COLUMNS |= {"median": "robots, median", "largest": "largest"}


@dataclass(frozen=True)
class ModeReport:
    """Results of the engines for the plan in one mode of playback."""

    mode: str
    # by engine: the robot as planned, exact sensors, no correction in the air
    planned: dict[str, Trial]
    pairs: tuple[dict[str, Trial], ...]  # every perturbed robot's jump by engine
    in_plane: bool  # whether the jump stays there

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities to compare."""
        return QUANTITIES if self.in_plane else (*QUANTITIES, *AWAY)

    @cached_property
    def differences(self) -> list[Plain]:
        """A row per quantity, by the keys of :data:`COLUMNS`: of the robot as planned in each
        engine, how far apart (None where a jump did not get so far), and at most; then median and
        largest of perturbed robots that came down in all engines, if there are any.
        """
        rows = []
        for q in self.quantities:
            every = (q.apart(pair.values()) for pair in self.pairs)
            others = [x for x in every if x is not None]
            apart = q.apart(self.planned.values())
            limit = LIMITS[q.limit]
            row = {
                "name": q.name,
                "unit": q.unit,
                "relative": q.relative,
                **{engine: q.of(trial) for engine, trial in self.planned.items()},
                "apart": apart,
                "limit": limit,
                "within": apart is not None and apart <= limit,
                "median": float(np.median(others)) if others else None,
                "largest": max(others, default=None),
            }
            rows.append(row)
        return rows

    @property
    def unlike(self) -> dict[int, dict[str, Trial]]:
        """The perturbed robots, by number, that stand in one engine and fall in another."""
        return {
            k: pair
            for k, pair in enumerate(self.pairs)
            if len({trial.landed for trial in pair.values()}) > 1
        }

    @property
    def same(self) -> int:
        """Number of perturbed robots that stand in all engines, or fall in all."""
        return len(self.pairs) - len(self.unlike)

    @property
    def landed(self) -> dict[str, int]:
        """Number of perturbed robots that land, by engine."""
        return {name: sum(pair[name].landed for pair in self.pairs) for name in self.planned}

    @property
    def agree(self) -> bool:
        """Whether the engines agree that it lands."""
        return not self.failures

    @property
    def failures(self) -> list[str]:
        """Reasons why the engines do not agree on a landing, in sentences."""
        sentences = [
            f"{engine} does not land it: {t.reason}"
            for engine, t in self.planned.items()
            if not t.landed
        ]
        for q, row in zip(self.quantities, self.differences, strict=True):
            if row["apart"] is None:
                sentences.append(f"{q.name} was not measured in every engine")
            elif not row["within"]:
                sentences.append(
                    f"the engines differ by {q.with_unit(row['apart'])} in {q.name} (limit "
                    f"{q.with_unit(row['limit'])})"
                )
            if (row["median"] or 0.0) > row["limit"]:
                sentences.append(
                    f"for perturbed robots the engines differ by {q.with_unit(row['median'])} in "
                    f"{q.name} (median, limit {q.with_unit(row['limit'])})"
                )
        if self.same < LIMITS["verdict_share"] * len(self.pairs):
            sentences.append(
                f"{self.same} of {len(self.pairs)} perturbed robots have the same outcome in every "
                f"engine, must be at least {100 * LIMITS['verdict_share']:g} %"
            )
        return [f"{self.mode} mode: {sentence}" for sentence in sentences]

    def to_json(self) -> Plain:
        """Plain data, in SI units."""
        robots = []
        for k, pair in enumerate(self.pairs):
            apart = {q.name: q.apart(pair.values()) for q in self.quantities}
            row = {"number": k, "same": k not in self.unlike, "apart": apart}
            robots.append(row | _verdicts(pair))
        return {
            "agree": self.agree,
            "as_planned": _verdicts(self.planned),
            "differences": self.differences,
            "perturbed": {
                "conditions": CONDITIONS,
                "count": len(self.pairs),
                "landed": self.landed,
                "same_verdict": self.same,
                "apart": {
                    row["name"]: {key: row[key] for key in ("median", "largest")}
                    for row in self.differences
                },
                "robots": robots,
            },
        }


def _verdicts(trials: Mapping[str, Trial]) -> dict[str, Plain]:
    return {name: {"landed": t.landed, "reason": t.reason} for name, t in trials.items()}


@dataclass(frozen=True)
class Certificate:
    """The audit of a plan, and what the engines made of it."""

    audit: AuditReport
    modes: tuple[ModeReport, ...]
    # by engine: the robot as planned, in the first mode, on the engine's own contacts
    usual: Mapping[str, Trial]
    task: JumpTask
    robot: Robot
    plan: str  # its hash
    seed: int
    resumed: int = 0  # simulations that an earlier run had made

    @property
    def failures(self) -> list[str]:
        """Reasons against a certificate for the plan, in sentences; none if it is certified."""
        checks = [f"the plan fails the audit's check {check.name}" for check in self.audit.failed]
        falls = [
            f"usual contact: {engine} does not land it: {trial.reason}"
            for engine, trial in self.usual.items()
            if not trial.landed
        ]
        return checks + [sentence for mode in self.modes for sentence in mode.failures] + falls

    @property
    def scope(self) -> str:
        """The modes that it is about, in words."""
        return " and ".join(mode.mode for mode in self.modes) + " mode"

    @property
    def passed(self) -> bool:
        """True if audit and engines, in every one of its modes, agree that the plan lands."""
        return not self.failures

    def to_json(self) -> Plain:
        """The content of ``certificate.json``; depends on plan, seed, code and packages alone."""
        checks = dict(passed=self.audit.passed, checks=len(self.audit.checks))
        return {
            "schema": SCHEMA,
            "passed": self.passed,
            "failures": self.failures,
            "target": self.task.numbers,
            "robot": {"name": self.robot.name, "hash": self.robot.hash},
            "plan": self.plan,
            "seed": self.seed,
            "audit": checks | {"failed": [check.name for check in self.audit.failed]},
            "limits": LIMITS,
            "modes": {mode.mode: mode.to_json() for mode in self.modes},
            "usual_contact": _verdicts(self.usual),
            "versions": store.versions(),
        }


def _as_planned(plan: PlanOnFile, mode: str, engine: str, **how: Any) -> dict[str, Task]:
    """The robot as planned, with exact sensors and no correction in the air, as a study's work."""
    exact = TrialSettings(mode, reaim=False, noise=SensorNoise(), engine=engine, **how)
    key = TrialKey(0, 0, short_hash(["as planned", exact.hash]), plan.hash)
    return {key.name: joblib.delayed(run_trial)(plan, exact, key, Perturbation())}


@checked
def certify(
    folder: str | Path,
    n: int = 10,
    seed: int = 0,
    *,
    modes: Sequence[str] = MODES,
    jobs: int | None = None,
    progress: bool | None = None,
) -> Certificate:
    """Audit the plan in ``folder``, and let all engines play it in some modes: as planned, and on
    ``n`` other robots (the same in all).

    Parameters
    ----------
    n, seed, jobs, progress : as of :func:`jumplab.studies.trials.run_trials`. Finished simulations
        are kept in ``trials.jsonl``: a stopped run resumes from there.
    modes : of playback ("position", "pd", "whole-body") in each of which the engines have to agree;
        the first one is also played on usual contacts.

    Raises
    ------
    InputError, RobotError
        For numbers that cannot be meant, a folder without a whole plan, an engine that is not
        installed, or a robot that one of them cannot read.
    """
    check_numbers(n, seed, jobs)
    if not modes or len(set(modes)) < len(modes):
        raise InputError(f"modes = {quoted(modes)}: give one or more, each of them once")
    for mode in modes:
        servo_of(mode)
    for engine in ENGINES:
        engine_class(engine)
    plan = PlanOnFile.read(folder)
    task = JumpTask.of(plan.summary["target"])
    ground = {"edge_m": plan.summary["platform_edge_m"], "over": plan.summary.get("over")}
    report = audit(plan.tape, plan.robot, task, **ground)
    reports = []
    total = ((n + 1) * len(modes) + 1) * len(ENGINES)
    with plan.study(total=total, jobs=jobs, progress=progress) as study:
        for mode in modes:
            trials = {}
            for engine in ENGINES:
                work = _as_planned(plan, mode, engine)
                work |= plan.trials(TrialSettings(mode, engine=engine), seed, range(n))
                trials[engine] = study.results(work)
            jumps = zip(*trials.values(), strict=True)
            first, *pairs = (dict(zip(ENGINES, jump, strict=True)) for jump in jumps)
            reports.append(ModeReport(mode, first, tuple(pairs), task.in_plane))
        softly = partial(_as_planned, plan, modes[0], contact="usual")
        usual = {engine: study.results(softly(engine))[0] for engine in ENGINES}
    where = task, plan.robot, plan.hash, seed, study.resumed
    certificate = Certificate(report, tuple(reports), usual, *where)
    plan.write(NAME, certificate.to_json(), {PAGE: certificate_page(certificate).html})
    return certificate


def certificate_page(certificate: Certificate) -> Page:
    """A page without scripts of how far the engines are apart, by ``certify.html``."""
    return page_of(
        Path(__file__).with_suffix(".html"),
        f"Certificate: {describe_task(certificate.task)}",
        certificate=certificate,
        conditions=CONDITIONS,
        color=LANDING if certificate.passed else VERMILION,
        tables=[table(x.differences, COLUMNS, digits=3)._repr_html_() for x in certificate.modes],
    )
