"""Landings that are too fast: ever farther jumps, where their capture point lies at touchdown, and which of them stand.

``python -m paper.capture`` in the folder of the notebooks makes ``capture.jsonl``; the page on validity has its lines.
"""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from jumplab import api
from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.sim import INSTALLED, simulate_jump
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask
from paper import logs

LOG = Path(__file__).with_name("capture.jsonl")
ROBOTS = {"bhr": (2.44, 0.33), "g1": (1.04, 0.15)}  # farthest distance and rise [m]
NEAREST_M = 0.2
COUNT = 15  # jumps a robot


def study(path: Path = LOG) -> None:
    """Plan and play each jump of each robot; a row each, written at once; what the log has is not done again."""
    for name, (farthest_m, rise_m) in ROBOTS.items():
        planner = Planner(Robot.load(name))
        with logs.keep(path, itemgetter("robot", "distance_m"), robot=planner.robot) as log:
            for far_m in np.linspace(NEAREST_M, farthest_m, COUNT).round(2).tolist():
                if (name, far_m) not in log.done:
                    log.add({"robot": name, "distance_m": far_m} | _row(planner, JumpTask(far_m, rise_m)))


def _row(planner: Planner, task: JumpTask) -> dict[str, Any]:
    """The capture point [% of the CoM's height] and what landed; of a jump without a plan, the reason."""
    try:
        plan = planner.plan(task)
    except SolverError as e:
        return {"clean": False, "refused": str(e)}
    audit = api.audit(plan)
    stands = {engine: simulate_jump(plan.tape, plan.robot, engine=engine).landed for engine in INSTALLED}
    return {"clean": audit.passed, "capture [%]": round(audit.capture.value, 1), "stands": stands}


def line(name: str, path: Path = LOG) -> str:
    """Of a robot, distances of the point off the soles in jumps that land in both engines, and in neither."""
    rows = [r for r in logs.rows(path) if r["robot"] == name and r["clean"]]
    shares = {count: [r["capture [%]"] for r in rows if sum(r["stands"].values()) == count] for count in (0, 1, 2)}
    fall = f"those with {min(shares[0]):.0f} % and more in neither" if shares[0] else "and none falls in both"
    one = f", {len(shares[1])} in one" if shares[1] else ""
    nearest, *_, farthest = (r["distance_m"] for r in rows)
    return (
        f"Of {len(rows)} jumps of `{name}` from {nearest:g} to {farthest:g} m with a rise of {ROBOTS[name][1]:g} m, "
        f"those with the point up to {max(shares[2]):.0f} % of the CoM's height off the soles land in both "
        f"engines{one}, {fall}."
    )


if __name__ == "__main__":
    study()
    for robot in ROBOTS:
        print(line(robot))
