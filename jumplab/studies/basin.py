"""The landing basin: from which wrong states at the apex of the flight a planned jump still lands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from jumplab.errors import InputError
from jumplab.io import folder as store
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import Disturbance, Perturbation, Ranges, Scene, simulate_landing
from jumplab.studies import trials as series
from jumplab.studies.trials import Trial, TrialKey, TrialReport, TrialSettings, short_hash

SHUFFLE_SEED = 0  # of the grid's order, so that any first part of it is a fair sample


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
    """States of one basin; each one is a trial whose ``features`` are those of its :class:`BasinState`."""

    grid: BasinGrid = field(default_factory=BasinGrid)

    @property
    def conditions(self) -> dict[str, str]:
        """As of any trials, but the robot is as planned."""
        said = {"robot": "as planned, put into its flight's apex with a wrong state"}
        return {name: text for name, text in super().conditions.items() if not name.startswith("drawn")} | said

    def to_json(self) -> dict[str, Any]:
        """The content of ``basin.json``."""
        said = super().to_json()
        del said["settings"]["ranges"], said["seed"]  # nothing is drawn
        del said["landed_metrics"]  # travel is from the apex
        failed = [t.features | {"reason": t.reason} for t in self.trials if not t.landed]
        return said | {"grid": asdict(self.grid), "states": len(self.grid.states), "failed": failed}


def landing_basin(
    folder: str | Path,
    n: int | None = None,
    settings: TrialSettings = TrialSettings(),
    grid: BasinGrid = BasinGrid(),
    *,
    jobs: int | None = None,
    progress: bool | None = None,
) -> BasinReport:
    """Drop the robot of the plan in ``folder`` from every state of ``grid``; write ``trials.jsonl`` and ``basin.json``.

    The robot is as planned, but for the friction; ``settings.ranges`` is not used. ``n`` states are tried in their
    random order, all if None. The rest is as in :func:`jumplab.studies.trials.run_trials`, which also says what is
    raised; so is an ``n`` of more than the grid has.
    """
    states = grid.states
    count = len(states) if n is None else n
    series.check_numbers(count, 0, jobs)
    if count > len(states):
        raise InputError(f"n = {count} is too large; the basin has {len(states)} states")
    if settings.feedback:
        raise InputError("feedback acts in launch, and the basin's states are those of a flight; leave it away")
    tape, robot, summary = store.read_plan(folder)
    scene, plan = Scene.of_plan(summary, robot), series.plan_hash(summary)
    keys = state_keys(states[:count], settings, plan)
    work = {key: joblib.delayed(drop)(tape, robot, scene, settings, key, state) for key, state in keys.items()}
    trials, resumed = series.run_series(folder, work, jobs, progress)
    report = BasinReport(trials, 0, settings, plan, dict(summary["target"]), resumed, grid)
    store.write_trials(folder, report.to_json(), summary, "basin.json")
    return report


def state_keys(states: Sequence[BasinState], settings: TrialSettings, plan: str) -> dict[TrialKey, BasinState]:
    """Each state's name in the log; whatever the grid, equal states are equal trials."""
    code = replace(settings, ranges=Ranges()).hash
    names = [short_hash(["basin", code, asdict(state)]) for state in states]
    return {TrialKey(0, int(n[:8], 16), n, plan): state for n, state in zip(names, states, strict=True)}


def drop(tape: Tape, robot: Robot, scene: Scene, settings: TrialSettings, key: TrialKey, state: BasinState) -> Trial:
    """Simulate one state from the apex on."""
    wrong = Disturbance(state.speed_factor, float(np.radians(state.pitch_deg)), state.height_m)
    floor = Perturbation(key.robot_seed, friction=state.friction, noise=settings.noise)
    how = dict(
        mode=settings.mode,
        reaim=settings.reaim,
        step=settings.step,
        engine=settings.engine,
        perturbation=floor,
        scene=scene,
    )
    verdict = series.judged(lambda: simulate_landing(tape, robot, wrong, **how))
    return Trial(key, floor.to_json(), asdict(state), *verdict).as_kept()
