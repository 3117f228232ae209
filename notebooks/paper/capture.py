"""Landings that are too fast: ever farther jumps, where their capture point lies at touchdown, and which of them stand.

``python -m paper.capture`` in the folder of the notebooks makes ``capture.jsonl``; the page on validity has its line.
"""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from jumplab import api
from jumplab.robot import Robot
from jumplab.sim import INSTALLED, simulate_jump
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask
from paper import logs

LOG = Path(__file__).with_name("capture.jsonl")
FAR_M, RISE_M = np.linspace(0.2, 2.44, 15), 0.33


def study(path: Path = LOG) -> None:
    """Plan and play each jump of ``bhr``; a row each, written at once; what the log has is not done again."""
    planner = Planner(Robot.load("bhr"))
    with logs.keep(path, itemgetter("distance_m"), robot=planner.robot) as log:
        for far_m in FAR_M.round(2).tolist():
            if far_m not in log.done:
                log.add({"distance_m": far_m} | _row(planner, JumpTask(far_m, RISE_M)))


def _row(planner: Planner, task: JumpTask) -> dict[str, Any]:
    plan = planner.plan(task)
    audit = api.audit(plan)
    stands = {engine: simulate_jump(plan.tape, plan.robot, engine=engine).landed for engine in INSTALLED}
    return {"clean": audit.passed, "capture [%]": round(audit.capture.value, 1), "stands": stands}


def line(path: Path = LOG) -> str:
    """Distances of the point off the soles, in jumps that land in both engines, and in those that land in neither."""
    rows = logs.rows(path)
    shares = {count: [r["capture [%]"] for r in rows if sum(r["stands"].values()) == count] for count in (0, 1, 2)}
    fall = f"those with {min(shares[0]):.0f} % and more in neither" if shares[0] else "and none falls in both"
    one = f", {len(shares[1])} in one" if shares[1] else ""
    return (
        f"Of {len(rows)} jumps of `bhr` from {rows[0]['distance_m']:g} to {rows[-1]['distance_m']:g} m with a rise of "
        f"{RISE_M:g} m, those with the point up to {max(shares[2]):.0f} % of the CoM's height off the soles land in "
        f"both engines{one}, {fall}."
    )


if __name__ == "__main__":
    study()
    print(line())
