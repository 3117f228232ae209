"""The landing basin: from which wrong states at the apex of the flight a planned jump still
lands.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path

import joblib
import numpy as np
import pinocchio as pin

from jumplab.control import STEP_S
from jumplab.control.kinematics import Gauge, about_vertical, rotation, turned
from jumplab.errors import InputError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import Perturbation, Ranges
from jumplab.studies.study import Plain, check_numbers, short_hash
from jumplab.studies.trials import (
    PlanOnFile,
    Trial,
    TrialKey,
    TrialReport,
    TrialSettings,
    run_trial,
)

SHUFFLE_SEED = 0  # of the grid's order, so that any first part of it is a fair sample


@dataclass(frozen=True)
class WrongApex:
    """A wrong state at the apex of the last flight."""

    speed_factor: float = 1.0  # on the horizontal velocity of the whole robot [1]
    pitch_rad: float = 0.0  # turn of the whole robot about its CoM, forward along ``direction_rad``
    height_m: float = 0.0  # shift of the whole robot upward
    # from the heading in which the jump shall land; a quarter turn tips it to its left
    direction_rad: float = 0.0

    def apex(self, tape: Tape, robot: Robot) -> tuple[int, np.ndarray, np.ndarray]:
        """Step of the apex of ``tape``, and the disturbed q (nq,), v (nv,) of ``robot`` there."""
        gauge = Gauge(robot)
        rows = range(len(tape.t))[tape.flights[-1]]
        sinking = (k for k in rows if gauge.motion(tape.q[k], tape.v[k]).velocity[2] <= 0)
        row = next(sinking, rows[-1])
        now = gauge.motion(tape.q[row], tape.v[row])
        v = tape.v[row].copy()
        speed = now.velocity
        seen = about_vertical(gauge.heading(tape.q[-1]) + self.direction_rad)
        turn = seen @ pin.rpy.rpyToMatrix(0.0, self.pitch_rad, 0.0) @ seen.T
        q = turned(tape.q[row], turn)
        q[:3] = now.com + turn @ (q[:3] - now.com) + [0.0, 0.0, self.height_m]
        # the base twist is written in base axes and so has turned with the robot; the flight of its
        # CoM must not
        v[:3] += rotation(q[3:7]).T @ (
            speed * [self.speed_factor, self.speed_factor, 1.0] - turn @ speed
        )
        return round(float(tape.t[row]) / STEP_S), q, v


@dataclass(frozen=True)
class BasinState:
    """One state of the grid: how it differs from the planned apex, and the floor's friction."""

    speed_factor: float  # on the horizontal velocity [1]
    pitch_deg: float  # turn of the whole robot [degrees]
    height_m: float  # shift upward [m]
    friction: float  # coefficient of the soles on the ground [1]


@dataclass(frozen=True)
class BasinGrid:
    """Values of each number of a :class:`BasinState`; all combinations are tried."""

    speed_factor: tuple[float, ...] = (0.8, 0.9, 1.0, 1.1, 1.2)
    pitch_deg: tuple[float, ...] = (-10.0, -5.0, 0.0, 5.0, 10.0)
    height_m: tuple[float, ...] = (-0.1, 0.0, 0.1)
    friction: tuple[float, ...] = (0.5, 0.75, 1.0)

    @property
    def states(self) -> tuple[BasinState, ...]:
        """All states, in an order that is random but always the same."""
        states = [BasinState(*row) for row in product(*asdict(self).values())]
        return tuple(states[k] for k in np.random.default_rng(SHUFFLE_SEED).permutation(len(states)))


@dataclass(frozen=True, repr=False)
class BasinReport(TrialReport):
    """States of one basin; each one is a trial whose ``features`` are those of its
    :class:`BasinState`.
    """

    grid: BasinGrid = field(default_factory=BasinGrid)

    @property
    def conditions(self) -> dict[str, str]:
        """As of any trials, but the robot is as planned."""
        known = super().conditions
        del known["drawn uniformly, each link and joint by itself"]
        return known | {"robot": "as planned, put into its flight's apex with a wrong state"}

    def to_json(self) -> Plain:
        """The content of ``basin.json``."""
        report = super().to_json()
        del report["settings"]["ranges"], report["seed"]  # nothing is drawn
        del report["landed_metrics"]  # travel is from the apex
        failed = [t.features | {"reason": t.reason} for t in self.failed]
        states = len(self.grid.states)
        return report | {"grid": asdict(self.grid), "states": states, "failed": failed}


def landing_basin(
    folder: str | Path,
    n: int | None = None,
    settings: TrialSettings = TrialSettings(),
    grid: BasinGrid = BasinGrid(),
    *,
    jobs: int | None = None,
    progress: bool | None = None,
) -> BasinReport:
    """Drop the robot of the plan in ``folder`` from every state of ``grid`` (225 of them); write
    ``trials.jsonl`` and ``basin.json``.

    The robot is as planned, but for the friction; ``settings.ranges`` is not used. ``n`` states are
    tried in their random order, all if None. The rest is as in
    :func:`jumplab.studies.trials.run_trials`, which also says what is raised; so is an ``n`` of
    more than the grid has.
    """
    states = grid.states
    count = len(states) if n is None else n
    check_numbers(count, 0, jobs)
    if count > len(states):
        raise InputError(f"n = {count} is too large; the basin has {len(states)} states")
    if settings.feedback:
        raise InputError("feedback corrects the launch, but the basin's states begin in flight; leave out feedback")
    plan = PlanOnFile.read(folder)
    known = replace(settings, ranges=Ranges()).hash
    work = {}
    for state in states[:count]:  # whatever the grid, equal states are equal trials
        name = short_hash(["basin", known, asdict(state)])
        key = TrialKey(0, int(name[:8], 16), name, plan.hash)
        work[key.name] = joblib.delayed(drop)(plan, settings, key, state)
    with plan.study(total=count, jobs=jobs, progress=progress) as study:
        trials = study.results(work)
    target = dict(plan.summary["target"])
    report = BasinReport(tuple(trials), 0, settings, plan.hash, target, study.resumed, grid)
    plan.write("basin.json", report.to_json())
    return report


def drop(plan: PlanOnFile, settings: TrialSettings, key: TrialKey, state: BasinState) -> Trial:
    """Simulate one ``state`` (speeds [1], pitch [degrees], height [m]) from the apex on."""
    wrong = WrongApex(state.speed_factor, float(np.radians(state.pitch_deg)), state.height_m)
    floor = Perturbation(key.robot_seed, friction=state.friction, noise=settings.noise)
    trial = run_trial(plan, settings, key, floor, wrong)
    return replace(trial, features=asdict(state))
