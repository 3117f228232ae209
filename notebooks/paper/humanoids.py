"""Published humanoids, each imported without a flag, planned and simulated once: the rows of ``humanoids.json``.

``python -m paper.humanoids FOLDER [--jump]`` in the folder of the notebooks looks for FOLDER/NAME/FILE of every row,
and writes what became of it; ``--jump`` also plans and simulates what has not been yet. Notebook 07 draws the file.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab import api
from jumplab.control.servo import SERVOS
from jumplab.errors import JumplabError
from jumplab.robot.description import Robot
from jumplab.robot_import.checkup import examine, first_look
from jumplab.sim import INSTALLED
from jumplab.task import JumpTask
from paper import logs

TABLE = Path(__file__).with_name("humanoids.json")
LEG = ("hip_pitch", "knee", "ankle_pitch")
SHARES = (0.38, 0.19)  # distance and rise, of the leg's length from hip to ankle
SMALLER = (0.5, 0.25)  # of both, where the whole jump has no clean plan or does not land
LEAST_M = 0.02  # of a rise that can be asked for
PLAN_S = 300.0  # longest processor time for one plan with its audit and simulation


def rows() -> list[dict[str, Any]]:
    """The table: name, repository, file, the legs' joints as a person read them, and what became of the robot."""
    return logs.table(TABLE)


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
    return robot, row | told | {"held": len(result.tree.joints) - len(robot.joint_names)}


def leg_m(robot: Robot) -> float:
    """Length from hip to ankle in the neutral pose [m]."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, pin.neutral(robot.model))
    hip, ankle = (data.oMi[robot.model.getJointId(robot.joints[role][0])].translation for role in LEG[::2])
    return float(np.linalg.norm(hip - ankle))


def jumped(path: Path, size: float = 1.0) -> dict[str, Any]:
    """One jump of the target's shares, planned, audited and played in both engines, in the first mode that lands in
    both.
    """
    robot = examine(path).robot
    distance, rise = (round(size * share * leg_m(robot), 3) for share in SHARES)
    rise = max(rise, LEAST_M)
    row: dict[str, Any] = {"distance_m": distance, "rise_m": rise, "clean": None, "landed": None, "reason": ""}
    try:
        plan = api.plan(JumpTask(distance, rise), robot)
        failed = [check.name for check in api.audit(plan).checks if not check.passed]
        row |= {"clean": not failed, "reason": ", ".join(failed)}
        for mode in SERVOS:  # a leg that passes a straight line of two axes is not held by angles alone
            runs = [api.simulate(plan, engine=engine, mode=mode) for engine in INSTALLED]
            row |= {"landed": all(run.landed for run in runs), "mode": mode}
            if row["landed"]:
                break
        worst = min(runs, key=lambda run: run.landed)
        row["reason"] = row["reason"] or worst.reason
        if worst.metrics.foot_distance_m is not None:  # it touched down
            row["simulated_m"] = round(worst.metrics.foot_distance_m, 3)
    except JumplabError as e:
        row["reason"] = str(e)
    return row


def largest(path: Path, first: dict[str, Any] | None) -> dict[str, Any]:
    """The largest of three jumps that is clean and lands, and why no larger one; ``first`` is what became of the whole
    one if that was asked before.
    """
    first = first or within_time(jumped, path)
    if (first["clean"] and first["landed"]) or "smaller" in first:
        return first
    for size in SMALLER:
        row = within_time(partial(jumped, size=size), path)
        if row["clean"] and row["landed"]:
            return row | {"size": size, "whole": first["reason"]}
    return first | {"smaller": "neither"}


def within_time(work_on: Callable[[Path], dict[str, Any]], path: Path, longest_s: float = PLAN_S) -> dict[str, Any]:
    """Result of ``work_on`` in a process of its own, given up after ``longest_s`` [s] of processor time."""
    limit = resource.RLIMIT_CPU, (int(longest_s), int(longest_s))
    with ProcessPoolExecutor(1, initializer=resource.setrlimit, initargs=limit) as pool:
        work = pool.submit(work_on, path)
        try:
            return work.result()
        except BrokenProcessPool:
            return {"clean": None, "landed": None, "reason": f"no plan within {longest_s:g} s of one core"}
        except Exception as e:  # an internal error is a result as well: the aim is none
            return {"clean": None, "landed": None, "reason": f"internal error: {type(e).__name__}: {e}"}


def verdicts(table: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per robot for a table: mass, roles, program, jump, and the first reason where something is refused."""
    out = []
    for row in table:
        told, jump = row["import"], row.get("jump", {})
        lands = jump.get("clean") and jump.get("landed")
        reason = (told["faults"] or [jump.get("whole", "") if lands else jump.get("reason", "")])[0]
        landed = {True: "lands", False: "does not land"}.get(jump.get("landed"), "none" if jump else "not tried")
        target = f"{jump['distance_m']:.2f} m, {jump['rise_m']:.2f} m: " if "distance_m" in jump else ""
        line = {"robot": row["name"], "kg": told["kg"] or "", "roles": "right" if told["legs right"] else "none"}
        out.append(line | {"program": told["planner"] or "", "jump": target + landed, "reason": reason})
    return out


def main(folder: str, *options: str) -> None:
    """Fill the table from the robots in a folder, a line each."""
    table = rows()
    for row in sorted(table, key=lambda row: row.get("import", {}).get("planner") != "planar"):  # quick ones first
        path = Path(folder, row["name"], row["file"])
        robot, told = imported(path, row["legs"])
        row["import"] = told
        if robot is not None and "--jump" in options:
            row["jump"] = largest(path, row.get("jump"))
        print(row["name"], told["legs right"], told["faults"][:1], row.get("jump", ""), flush=True)
        logs.write_table(TABLE, table)


if __name__ == "__main__":
    main(*sys.argv[1:])
