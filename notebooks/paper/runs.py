"""The simulated experiments of Sec. VI: several jumps at once, their table; and many trials that ran beforehand."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import joblib
import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim import ENGINES, Perturbation, SimulationResult, simulate_jump
from jumplab.sim.result import STAND_S
from jumplab.studies.study import in_parallel
from jumplab.studies.trials import PlanOnFile, Trial, TrialSettings, run_trials, wilson
from jumplab.task import JumpTask
from paper import logs
from paper.basin import landing_basin

LOG = Path(__file__).with_name("trials.jsonl")
ROBOTS = 100  # drawn in each engine: if all of them land, at least 96 % do (Wilson's interval of 95 %)


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
    said = []
    for text, asked, value in rows:
        said.append({"quantity": text, "asked or allowed": asked} | {name: value(run) for name, run in runs.items()})
    return said


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
    return dict(zip(jumps, in_parallel(work, jobs, "generator"), strict=True))


def on_softer_ground(
    tape: Tape, robot: Robot, times_s: Sequence[float], *, jobs: int | None = None
) -> dict[float, SimulationResult]:
    """Simulate ``tape`` in MuJoCo, on grounds in which a penetration fades in each of ``times_s`` [s]."""
    work = [joblib.delayed(_on_ground)(tape, robot, time_s) for time_s in times_s]
    return dict(zip(times_s, in_parallel(work, jobs, "generator"), strict=True))


def _on_ground(tape: Tape, robot: Robot, time_s: float) -> SimulationResult:
    from jumplab.sim.mujoco import HARD

    return simulate_jump(tape, robot, engine="mujoco", contact=replace(HARD, time_s=time_s))


def study(folder: str | Path, path: Path = LOG) -> None:
    """Many robots and the whole landing basin for the plan in ``folder``, in every engine, kept as one row each.

    Trials in the folder's log are not simulated again. ``python -m paper.runs DIR`` calls it.
    """
    rows = []
    robot = PlanOnFile.read(folder).robot
    for engine in ENGINES:
        settings = TrialSettings(engine=engine)
        for trial in run_trials(folder, ROBOTS, settings=settings).trials:
            drawn = settings.draw(robot, trial.key.robot_seed)
            rows.append(row(engine, replace(trial, features=features(drawn, robot))))
        rows += [row(engine, trial) for trial in landing_basin(folder, None, settings).trials]
    logs.write(path, rows, folder=folder)


def features(drawn: Perturbation, robot: Robot) -> dict[str, float]:
    """A perturbed robot in a few numbers, all relative to the planned one.

    friction [1], delay_s [s], mass [1] (whole robot), com_x_m and com_y_m [m] (whole robot, in its
    stance), leg_motors [1] (mean gain of hip, knee and ankle pitch motors, minus 1).
    """
    q = stance_configuration(robot)
    real = drawn.robot(robot)
    here, planned = (
        pin.centerOfMass(r.model, r.model.createData(), q, False).copy() for r in (real, robot)
    )
    legs = [name for role in ("hip_pitch", "knee", "ankle_pitch") for name in robot.joints[role]]
    return {
        "friction": drawn.friction,
        "delay_s": drawn.delay_s,
        "mass": real.total_mass / robot.total_mass - 1,
        "com_x_m": float(here[0] - planned[0]),
        "com_y_m": float(here[1] - planned[1]),
        "leg_motors": float(np.mean([drawn.motor_gain.get(name, 1.0) for name in legs])) - 1,
    }


def row(engine: str, trial: Trial) -> dict[str, Any]:
    """Row of a trial: its draw in a few numbers, the verdict, the travel and rise of one that landed."""
    m, seen = trial.metrics, {name: float(f"{x:.4g}") for name, x in trial.features.items()}
    kept = {"engine": engine, "number": trial.key.index, "features": seen, "landed": trial.landed}
    if not trial.landed or m is None:
        return {**kept, "reason": trial.reason}
    return {**kept, "foot_distance_m": round(m.foot_distance_m, 5), "com_rise_m": round(m.com_rise_m, 5)}


def stored(engine: str, feature: str, path: Path = LOG) -> list[SimpleNamespace]:
    """Kept trials of one engine, in the order of their numbers: those whose draw has ``feature``.

    "delay_s" is of the robots, "speed_factor" of the basin's states.
    """
    here = (
        SimpleNamespace(**{"foot_distance_m": None, **r})
        for r in logs.rows(path)
        if r["engine"] == engine and feature in r["features"]
    )
    return sorted(here, key=lambda r: r.number)


def origin(path: Path = LOG, feature: str = "") -> tuple[str, str]:
    """Mode in which the kept robots whose draw has ``feature`` jumped (by default all), and their plan in words; what
    has no stamp is of the former version.
    """
    stamps = [stamp for row, stamp in logs.lines(path) if not feature or feature in row["features"]]
    if stamps[0]:
        return TrialSettings().mode, "plan of the direct program"
    return "whole-body", "plan of the five-link program of the former version"


def shares(trials: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Number of trials that land, by name, with Wilson's 95 % interval [%]."""
    rows = []
    for name, here in trials.items():
        landed, count = sum(t.landed for t in here), len(here)
        low, high = (100 * x for x in wilson(landed, count))
        row = {"engine": name, "tried": count, "land": landed, "share [%]": 100 * landed / count}
        rows.append(row | {"from [%]": low, "to [%]": high})
    return rows


if __name__ == "__main__":
    study(sys.argv[1])
