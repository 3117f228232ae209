"""The table under each experiment of Sec. VI: what came of a jump, beside what was asked or allowed."""

from __future__ import annotations

from collections.abc import Mapping

from jumplab.sim import SimulationResult
from jumplab.sim.recorder import STAND_S
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
