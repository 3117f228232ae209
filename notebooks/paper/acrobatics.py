"""What a G1 can do within its motors' curves, and by how much they forbid the rest: the rows of ``acrobatics.json``.

``python -m paper.acrobatics`` in the folder of the notebooks plans every jump of :data:`ASKED` that has no row yet;
those that are planned clean are played back in both engines, those on file in mode "whole-body". Notebook 07 prints
the rows.
"""

from __future__ import annotations

import math
import time
from functools import cache
from pathlib import Path
from typing import Any

from jumplab import api
from jumplab.errors import JumplabError
from jumplab.robot import Robot
from jumplab.sim import INSTALLED
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask
from paper import logs

TABLE = Path(__file__).with_name("acrobatics.json")
# robot, factors on efforts and on speeds of all motors, distance, rise, platform [m], turns about +y, method
Asked = tuple[str, float, float, float, float, float, int, str]
KEYS = "robot", "effort", "speed", "distance_m", "height_m", "platform_m", "turns", "method"
FARTHEST = {"Farthest": "distance_m", "Highest platform": "platform_m", "Highest": "height_m"}
ASKED: list[Asked] = [
    ("g1", 1.0, 1.0, 0.6, 0.3, 0.0, 0, "direct"),
    ("g1", 1.0, 1.0, 0.5, 0.35, 0.2, 0, "direct"),
    ("g1", 1.0, 1.0, 0.9, 0.3, 0.0, 0, "direct"),
    ("g1", 1.0, 1.0, 0.7, 0.4, 0.0, 0, "direct"),
    ("g1", 1.0, 1.0, 0.5, 0.45, 0.3, 0, "direct"),
    ("g1", 1.0, 1.0, 0.2, 0.27, 0.0, 1, "direct"),
    ("g1", 1.0, 1.0, 0.0, 0.35, 0.0, -1, "direct"),
    ("g1", 1.0, 1.0, 0.0, 0.35, 0.0, -1, "three-step"),
    ("g1", 1.0, 2.0, 0.0, 0.35, 0.0, -1, "direct"),
    ("g1", 2.0, 1.0, 0.0, 0.35, 0.0, -1, "direct"),
    ("g1", 2.0, 2.0, 0.0, 0.35, 0.0, -1, "direct"),
]


def rows() -> list[dict[str, Any]]:
    """The table: what was asked, what became of the plan, which limit it uses most, and how it landed."""
    return logs.table(TABLE)


@cache
def planner(name: str, effort: float, speed: float) -> Planner:
    """Of a robot with motors that are stronger, and faster, by factors."""
    robot = Robot.load(name)
    return Planner(robot if effort == speed == 1 else robot.with_limits(effort=effort, speed=speed))


def attempt(asked: Asked) -> dict[str, Any]:
    """One row: the plan, its audit, and, where that is clean, its simulations."""
    name, effort, speed, distance, height, platform, turns, method = asked
    row: dict[str, Any] = dict(zip(KEYS, asked, strict=True))
    task = JumpTask(distance, height, platform_m=platform, rotation_rad=2 * math.pi * turns)
    start = time.process_time()
    try:
        plan = planner(name, effort, speed).plan(task, method=method)
    except JumplabError as e:
        return row | {"clean": False, "said": str(e), "cpu_s": round(time.process_time() - start, 1)}
    report = api.audit(plan)
    used = max((c for c in report.checks if c.group == "joints" and c.unit.startswith("%")), key=lambda c: c.value)
    failed = [f"{c.name}: {c.value:.3g} {c.unit}, at most {c.limit:g}" for c in report.checks if not c.passed]
    row |= {"clean": report.passed, "said": "; ".join(failed), "cpu_s": round(time.process_time() - start, 1)}
    row |= {"used": [used.name, round(used.value, 1), used.note.rpartition("worst: ")[2]]}
    if report.passed:
        row["landed"] = {engine: _landing(plan, engine) for engine in INSTALLED}
    return row


def _landing(plan: Any, engine: str) -> list[Any]:
    """Whether a playback landed and its findings passed, distance and rise [m], and why it ended."""
    run = api.simulate(plan, engine=engine)
    sound = run.landed and all(finding.passed for finding in run.checks)
    far, high = run.metrics.foot_distance_m, run.metrics.com_rise_m
    return [sound, far and round(far, 3), high and round(high, 3), run.reason]


def named(row: dict[str, Any]) -> str:
    """A jump in words."""
    turn = {-1: "backflip, ", 0: "", 1: "front flip, "}[row["turns"]]
    step = f", onto {row['platform_m']:g} m" if row["platform_m"] else ""
    way = f"{row['distance_m']:g} m ahead, " if row["distance_m"] else ""
    return f"{turn}{way}{row['height_m']:g} m up{step}"


def verdicts(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per row: what was asked of which motors, and what became of it."""
    out = []
    for row in found:
        landed = list(row.get("landed", {}).values())
        name, share, joint = row.get("used", ("", 0.0, ""))
        fullest = f"{name}, {share:.0f} %, {joint}" if name else ""
        line = {
            "robot": row["robot"],
            "jump": named(row),
            "motors": motors(row),
        }
        line |= {"plan": "clean" if row["clean"] else row["said"].split(";")[0], "fullest limit": fullest}
        out.append(line | {"lands": f"{sum(x[0] for x in landed)} of {len(landed)}" if landed else ""})
    return out


def motors(row: dict[str, Any]) -> str:
    """What was asked of them, in words."""
    changed = [f"{name} x {row[name]:g}" for name in ("effort", "speed") if row[name] != 1]
    return ", ".join(changed) or "as made"


def told(found: list[dict[str, Any]]) -> list[str]:
    """What the table says: the farthest jump and the highest platform, and of each flip which motors do it, and by how
    much those that do not fall short."""
    sound = [row for row in found if row["clean"] and all(landing[0] for landing in row["landed"].values())]
    made = [row for row in sound if motors(row) == "as made" and not row["turns"]]
    lines = [f"{what}: {named(max(made, key=lambda row, key=key: row[key]))}" for what, key in FARTHEST.items() if made]
    for turns in (-1, 1):
        for row in (row for row in found if row["turns"] == turns):
            short = row["said"].partition("): ")[2].partition("; they leave")[0]
            became = "lands" if row in sound else short or row["said"] or "does not land"
            lines.append(f"{named(row)}, {row['method']}, motors {motors(row)}: {became}")
    return [line[0].upper() + line[1:] for line in lines]


def main() -> None:
    """Fill the table."""
    done = rows() if TABLE.exists() else []
    for asked in ASKED:
        if not any(all(row[k] == x for k, x in zip(KEYS, asked, strict=True)) for row in done):
            done.append(attempt(asked))
            logs.write_table(TABLE, done)
            print(*asked, done[-1]["clean"], done[-1]["said"], done[-1].get("landed"), flush=True)


if __name__ == "__main__":
    main()
