"""Robots that a name loads: one jump of each, played in every engine and mode, and the map of what it can do.

``python -m paper.shipped [NAME ...]`` in the folder of the notebooks measures what ``shipped.jsonl`` lacks of the
robots as they are now; those whose package is not there keep their rows. Notebook 07 draws the file.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

from jumplab import api
from jumplab.control.servo import SERVOS
from jumplab.errors import JumplabError, RobotError
from jumplab.robot.description import Robot
from jumplab.robot.files import SHIPPED
from jumplab.sim import INSTALLED
from jumplab.studies.envelope import Cell, Envelope, envelope
from jumplab.task import JumpTask
from paper import logs
from paper.humanoids import SHARES, leg_m

LOG = Path(__file__).with_name("shipped.jsonl")
FAR, HIGH = (0.0, 0.25, 0.5, 0.75, 1.0), (0.1, 0.2, 0.3, 0.4, 0.5)  # of the map, in lengths of the leg
# of joints that a map names: what robots share -> in their files' names
SHARED = {"waist": ("waist", "torso"), "hip roll": (" hr ",), "arm": (" arm ",)}
LESS = (1.0, 0.75, 0.5, 0.25)  # of SHARES, the first that is clean and stands in every engine


def rows() -> dict[str, dict[str, Any]]:
    """By robot: its hash, planner, mass, the jump with its playbacks, and the cells of the map; the last row counts."""
    found = {row["robot"]: row for row in logs.rows(LOG)}
    return {name: found[name] for name in SHIPPED if name in found}


def measured(robot: Robot) -> dict[str, Any]:
    """The row of one robot."""
    tried = (jumped(robot, size) for size in LESS)
    jump = next((j for j in tried if j["clean"] and all(_stands(j, engine) for engine in INSTALLED)), None)
    leg = leg_m(robot)
    far, high = ([round(share * leg, 3) for share in shares] for shares in (FAR, HIGH))
    cells = [
        [c.distance_m, c.height_m, c.solved, c.limiting, round(c.share, 3) if c.solved else None]
        for c in envelope(robot, far, high).cells
    ]
    planner = "planar" if robot.planar else "spatial"
    told = {"hash": robot.hash, "planner": planner, "kg": round(robot.total_mass, 1), "leg_m": round(leg, 3)}
    return told | {"jump": jump, "distances_m": far, "heights_m": high, "cells": cells}


def _stands(jump: dict[str, Any], engine: str) -> bool:
    return any(jump["runs"][f"{engine}, {mode}"]["stands"] for mode in SERVOS)


def jumped(robot: Robot, size: float) -> dict[str, Any]:
    """A jump of ``size`` times the shares of the leg: whether it is clean, and what became of its playbacks."""
    distance, rise = (round(size * share * leg_m(robot), 2) for share in SHARES)
    row: dict[str, Any] = {"distance_m": distance, "rise_m": rise, "clean": False, "runs": {}}
    try:
        plan = api.plan(JumpTask(distance, rise), robot)
    except JumplabError as e:
        return row | {"reason": str(e)}
    row["clean"] = api.audit(plan).passed
    for engine, mode in product(INSTALLED, SERVOS):
        run = api.simulate(plan, engine=engine, mode=mode)
        row["runs"][f"{engine}, {mode}"] = {
            "stands": run.landed,
            "reason": run.reason,
            "distance_m": run.metrics.foot_distance_m and round(run.metrics.foot_distance_m, 3),
            "rise_m": run.metrics.com_rise_m and round(run.metrics.com_rise_m, 3),
        }
    return row


def mapped(row: Mapping[str, Any]) -> Envelope:
    """The map in a row, as :func:`jumplab.envelope` gives it."""
    cells = (Cell(*cell[:3], _same(cell[3]), float("nan") if cell[4] is None else cell[4]) for cell in row["cells"])
    return Envelope(row["robot"], tuple(row["distances_m"]), tuple(row["heights_m"]), tuple(cells))


def _same(limit: str) -> str:
    """A limit in words that robots share, whatever their files call the joint."""
    joint = next((joint for joint, names in SHARED.items() if any(x in f" {limit.lower()}" for x in names)), None)
    return f"{joint} torque" if joint and limit.endswith("torque") else limit


def verdicts() -> list[dict[str, Any]]:
    """A line per robot: its jump, how many of the playbacks stand, and the ends of its map with what limits them."""
    lines = []
    for name, row in rows().items():
        found = mapped(row)
        jump = row["jump"]
        line: dict[str, Any] = {"robot": name, "kg": row["kg"], "program": row["planner"]}
        line["jump"] = f"{jump['distance_m']:.2f} m, {jump['rise_m']:.2f} m" if jump else "none found"
        line["stands"] = f"{sum(r['stands'] for r in jump['runs'].values())} of {len(jump['runs'])}" if jump else ""
        for what, end in ("highest", found.highest), ("farthest", found.farthest):
            line[what] = f"{end.distance_m:.2f} m, {end.height_m:.2f} m ({end.limiting})" if end else "no jump found"
        lines.append(line)
    return lines


def main(*names: str) -> None:
    """Measure what the log lacks."""
    with logs.keep(LOG, itemgetter("robot", "hash")) as log:
        for name in names or SHIPPED:
            try:
                robot = Robot.load(name)
            except RobotError as e:
                print(name, e, flush=True)
                continue
            key = name, robot.hash
            if key not in log.done:
                log.add({"robot": name} | measured(robot))
            print(name, log.done[key]["jump"], flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
