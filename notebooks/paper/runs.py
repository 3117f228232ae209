"""The simulated experiments of Sec. VI: several jumps at once, their table, and how far a landing basin has come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib

from jumplab.io import folder as store
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import SimulationResult, simulate_jump
from jumplab.sim.result import STAND_S
from jumplab.studies.basin import BasinGrid, state_keys
from jumplab.studies.trials import TrialSettings, in_parallel, plan_hash, trial_log
from jumplab.task import JumpTask


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
    return dict(zip(jumps, in_parallel(work, jobs, "list"), strict=True))


def on_softer_ground(
    tape: Tape, robot: Robot, times_s: Sequence[float], *, jobs: int | None = None
) -> dict[float, SimulationResult]:
    """Simulate ``tape`` in MuJoCo, on grounds in which a penetration fades in each of ``times_s`` [s]."""
    work = [joblib.delayed(_on_ground)(tape, robot, time_s) for time_s in times_s]
    return dict(zip(times_s, in_parallel(work, jobs, "list"), strict=True))


def _on_ground(tape: Tape, robot: Robot, time_s: float) -> SimulationResult:
    from jumplab.sim.mujoco import SOFTNESS, MujocoEngine

    MujocoEngine.softness = replace(SOFTNESS, time_s=time_s)
    try:
        return simulate_jump(tape, robot, engine="mujoco")
    finally:
        MujocoEngine.softness = SOFTNESS


def states_kept(folder: str | Path, settings: TrialSettings = TrialSettings(), grid: BasinGrid | None = None) -> int:
    """How many states of ``grid`` (by default the usual one) the plan in ``folder`` has been dropped from.

    Raises
    ------
    InputError
        If the folder holds no whole plan, or its log cannot be read.
    """
    plan = plan_hash(store.read_plan(folder)[2])
    with trial_log(folder) as log:
        return sum(key in log.done for key in state_keys((grid or BasinGrid()).states, settings, plan))
