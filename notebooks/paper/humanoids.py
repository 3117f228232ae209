"""Published humanoids, each imported without a flag, planned and simulated once: the rows of ``humanoids.json``.

``python -m paper.humanoids FOLDER [--jump] [--bounds]`` in the folder of the notebooks looks for FOLDER/NAME/FILE of
every row, and writes what became of it; ``--jump`` also plans and simulates what has not been yet, ``--bounds`` looks
for the highest jump on the spot of those that are planned in the plane. Notebook 07 draws the file.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab import api
from jumplab.control.servo import SERVOS
from jumplab.errors import JumplabError
from jumplab.ocp.nlp import EXPLAINED
from jumplab.robot.description import Robot
from jumplab.robot.reach import Reach, reach
from jumplab.robot_import.checkup import examine, first_look
from jumplab.sim import INSTALLED
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import METHODS, Planner
from jumplab.stages.srmp import SrmpSettings
from jumplab.task import GRAVITY, MAX_HEIGHT_M, JumpTask
from paper import logs

TABLE = Path(__file__).with_name("humanoids.json")
LEG = ("hip_pitch", "knee", "ankle_pitch")
SHARES = (0.38, 0.19)  # distance and rise, of the leg's length from hip to ankle
SMALLER = (0.5, 0.25)  # of both, where the whole jump has no clean plan or does not land
LEAST_M = 0.02  # of a rise that can be asked for
STEP = 1.15  # between the rises that are tried
AHEAD = 0.5, 1.0, 2.0  # rises; jumps so far ahead are tried as a beginning of one on the spot
PLAN_S = 300.0  # longest processor time for one plan with its audit and simulation
LADDER_S = 1800.0  # and for all plans of a ladder


def rows() -> list[dict[str, Any]]:
    """The table: name, repository, file, the legs' joints as a person read them, and what became of the robot."""
    return logs.table(TABLE)


# [1] the rod's swing adds to a straight push; stage 1 was seen up to 5.6 % beyond it
SWING_GAIN = 1.06


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


def straight_push(envelope: Reach) -> float:
    """CoM rise [m] by a straight push of the legs, m v dv = (F(phi, v) - m g) dphi from rest in the deepest crouch."""
    s = SrmpSettings()
    phi = np.linspace(envelope.length[0], min(s.takeoff_length * envelope.start[1], envelope.length[1]), 200)
    force, speed = (np.polyval(fit, phi) for fit in (envelope.force_fit, envelope.speed_fit))
    square, best, stroke = 0.0, 0.0, phi[-1] - phi[0]
    for f, v, step in zip(force[1:], speed[1:], np.diff(phi), strict=True):
        fade = np.clip((v - np.sqrt(square)) / ((1 - s.corner_speed) * v), 0.0, 1.0)
        square = max(square + 2 * step * (f * fade / envelope.mass - GRAVITY), 0.0)
        best = max(best, min(np.sqrt(square), s.speed_share * v))
    by_force = stroke * (force.mean() / (envelope.mass * GRAVITY) - 1)
    return float(max(min((SWING_GAIN * best) ** 2 / (2 * GRAVITY), by_force), 0.0))


def bounded(path: Path) -> dict[str, Any]:
    """Greatest rise of a robot on the spot for which a plan is found, on a ladder of rises :data:`STEP` apart.

    From above what a straight push may give, the ladder is gone down to the first rung with a clean plan by either
    method, and from there up again, each plan begun with the one below or with a jump ahead. ``refused`` has the
    reasons, by method, why there is none on the rung above.
    """
    EXPLAINED.set(False)  # nobody reads why
    planner = Planner(examine(path).robot)
    push = straight_push(reach(planner.robot))
    rungs = [round(push * STEP**power, 4) for power in range(-8, 7)]
    rungs = [rise for rise in rungs if LEAST_M <= rise <= MAX_HEIGHT_M]
    level, plan, refused = len(rungs), None, {}
    while level and plan is None:
        level -= 1
        plan, refused[level] = _tried({m: partial(planner.plan, _up(rungs[level]), m) for m in METHODS})
    if plan is None:
        return {"push_m": round(push, 4), "rise_m": None, "above_m": rungs[0], "refused": refused[0]}
    while level + 1 < len(rungs):
        task = _up(rungs[level + 1])
        ways = {"begun with the plan below": partial(planner.replan, plan, task)}
        ways |= {f"begun with {x:g} times the rise ahead": partial(_eased, planner, task, x) for x in AHEAD}
        higher, beside = _tried(ways)
        if higher is None:
            break
        level, plan = level + 1, higher
    above, why = (rungs[level + 1], refused[level + 1] | beside) if level + 1 < len(rungs) else (None, {})
    return {"push_m": round(push, 4), "rise_m": rungs[level], "above_m": above, "refused": why}


def _eased(planner: Planner, task: JumpTask, share: float) -> JumpPlan:
    """A jump on the spot, begun with one ``share`` times its rise ahead."""
    return planner.replan(planner.plan(replace(task, distance_m=share * task.height_m), "direct"), task)


def _up(rise_m: float) -> JumpTask:
    return JumpTask(0.0, rise_m)


def _tried(ways: dict[str, Callable[[], Any]]) -> tuple[Any, dict[str, str]]:
    """The first plan that is clean, and nothing else; or None and by way why there is none."""
    reasons = {}
    for name, way in ways.items():
        try:
            plan = way()
        except JumplabError as e:
            reasons[name] = str(e)
            continue
        failed = api.audit(plan).failed
        if not failed:
            return plan, {}
        reasons[name] = ", ".join(check.name for check in failed)
    return None, reasons


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


def heights(table: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per robot whose highest jump on the spot was looked for: that, and where no method found one."""
    found = [(row["name"], row["highest"]) for row in table if "rise_m" in row.get("highest", {})]
    words = "straight push [m]", "highest clean plan [m]", "no clean plan found at [m]"
    return [
        {"robot": name, **dict(zip(words, (h[k] for k in ("push_m", "rise_m", "above_m")), strict=True))}
        for name, h in found
    ]


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
        if robot is not None and robot.planar and "--bounds" in options and "highest" not in row:
            row["highest"] = within_time(bounded, path, LADDER_S)
        print(
            row["name"], told["legs right"], told["faults"][:1], row.get("jump", ""), row.get("highest", ""), flush=True
        )
        logs.write_table(TABLE, table)


if __name__ == "__main__":
    main(*sys.argv[1:])
