"""Published humanoids, each imported without a flag, planned and simulated once: the rows of ``humanoids.json``.

``python -m paper.humanoids FOLDER [--jump]`` in the folder of the notebooks looks for FOLDER/NAME/FILE of every row,
and writes what became of it; ``--jump`` also plans and simulates what has not been yet. Notebook 07 draws the file.
"""

from __future__ import annotations

import json
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as TooLong
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab import api
from jumplab.errors import JumplabError
from jumplab.robot.checkup import examine, first_look
from jumplab.robot.description import Robot
from jumplab.task import JumpTask

TABLE = Path(__file__).with_name("humanoids.json")
LEG = ("hip_pitch", "knee", "ankle_pitch")
SHARES = (0.38, 0.19)  # distance and rise, of the leg's length from hip to ankle
PLAN_S = 400.0  # longest time for one plan with its audit and simulation


def rows() -> list[dict[str, Any]]:
    """The table: name, repository, file, the legs' joints as a person read them, and what became of the robot."""
    return json.loads(TABLE.read_text(encoding="utf-8"))


def imported(path: Path, legs: list[list[str]]) -> tuple[Robot | None, dict[str, Any]]:
    """The robot of a file without any flag, None where it is refused, and what is said of it.

    ``legs`` are the true (left, right) joints of hip pitch, knee and ankle pitch.
    """
    row: dict[str, Any] = {"kg": None, "planner": None, "faults": [], "found": None, "legs right": False}
    try:
        first, row["faults"] = first_look(path)
        if first:
            row["found"] = [list(first.roles.joints[role]) for role in LEG]
            row["legs right"] = row["found"] == legs
            row["notes"] = len(first.roles.notes)
        result = examine(path)
    except JumplabError as e:
        row["faults"] = row["faults"] or [str(e)]
        return None, row
    robot = result.robot
    told = {"kg": round(robot.total_mass, 2), "planner": "planar" if robot.planar else "spatial"}
    return robot, row | told | {"held": len(result.jumper.tree.joints) - len(robot.joint_names)}


def leg_m(robot: Robot) -> float:
    """Length from hip to ankle in the neutral pose [m]."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, pin.neutral(robot.model))
    hip, ankle = (data.oMi[robot.model.getJointId(robot.joints[role][0])].translation for role in LEG[::2])
    return float(np.linalg.norm(hip - ankle))


def jumped(path: Path) -> dict[str, Any]:
    """One jump of the target's shares, planned, audited and played in MuJoCo."""
    robot = examine(path).robot
    distance, rise = (round(share * leg_m(robot), 3) for share in SHARES)
    row: dict[str, Any] = {"distance_m": distance, "rise_m": rise, "clean": None, "landed": None, "reason": ""}
    try:
        plan = api.plan(JumpTask(distance, rise), robot)
        failed = [check.name for check in api.audit(plan).checks if not check.passed]
        row |= {"clean": not failed, "reason": ", ".join(failed)}
        result = api.simulate(plan, engine="mujoco")
        row |= {"landed": result.landed, "reason": row["reason"] or result.reason}
        row["simulated_m"] = round(result.metrics.foot_distance_m, 3)
    except JumplabError as e:
        row["reason"] = str(e)
    return row


def within_time(path: Path) -> dict[str, Any]:
    """:func:`jumped` in a process of its own, given up after :data:`PLAN_S`."""
    with ProcessPoolExecutor(1) as pool:
        work = pool.submit(jumped, path)
        try:
            return work.result(PLAN_S)
        except TooLong:
            for process in list(pool._processes.values()):
                process.kill()
            return {"clean": None, "landed": None, "reason": f"no plan within {PLAN_S:g} s"}
        except Exception as e:  # an internal error is a result as well: the aim is none
            return {"clean": None, "landed": None, "reason": f"internal error: {type(e).__name__}: {e}"}


def main(folder: str, *options: str) -> None:
    """Fill the table from the robots in a folder, a line each."""
    table = rows()
    for row in table:
        path = Path(folder, row["name"], row["file"])
        robot, told = imported(path, row["legs"])
        row["import"] = told
        if robot is not None and "--jump" in options and "jump" not in row:
            row["jump"] = within_time(path)
        print(row["name"], told["legs right"], told["faults"][:1], row.get("jump", ""), flush=True)
        TABLE.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
