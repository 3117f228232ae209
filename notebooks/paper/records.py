"""Records of the robots by name: the rows of ``records.jsonl``.

``python -m paper.records`` in the folder of the notebooks seeks what :data:`LOG` lacks, a line a record, and can be
stopped and started again; at its end it writes the file from which refusals name records. ``python -m paper.records
table`` prints the log. A record is a lower bound, found by a local solver.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Any

from jumplab.errors import JumplabError
from jumplab.io.files import write_file
from jumplab.robot import Robot
from jumplab.robot.files import SHIPPED
from jumplab.show.tables import Table, table
from jumplab.stages.whole_body import Limits
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.bounds import most
from jumplab.studies.advice import RECORDS
from jumplab.studies.record import record
from jumplab.task import JumpTask
from paper import logs

LOG = Path(__file__).with_name("records.jsonl")
WHAT = ("height_m", "distance_m", "side_m", "platform_m", "yaw_rad")
BOUNDED = ("distance_m", "side_m", "platform_m", "height_m")
BINDING = 3  # limits that a row names
COLUMNS = {
    "robot": "robot",
    "height_m": "rise in flight [m]",
    "standing": "apex against standing [m]",
    "distance_m": "distance [m]",
    "bound": "no motion with its rise farther than [m]",
    "side_m": "to the side [m]",
    "platform_m": "platform [m]",
    "yaw_rad": "turn [rad]",
    "ends": "limits that end the rise",
}


def row(name: str, what: str) -> dict[str, Any]:
    """The record of a robot in plain data; ``reason`` where there is none."""
    began = time.process_time()
    found: dict[str, Any] = {"robot": name, "what": what, "value": None}
    try:
        robot = Robot.load(name)
        found |= {"hash": robot.hash, "planar": robot.planar}
        best = record(robot, what)
        ends = dict.fromkeys(f"{x.joint.replace('_', ' ')} {x.limit}".strip() for x in best.limits)
        found |= {
            "value": round(best.value, 4),
            "bound": round(best.bound, 4) if math.isfinite(best.bound) else None,  # a turn has none
            "rise_m": round(best.plan.planned_rise_m, 4),
            "apex_m": round(best.plan.planned_apex_m, 4),
            "starts": {word: x if x == x else None for word, x in best.found.items()},
            "alike": best.alike,
            "clean": best.audit.passed,
            "ends": list(ends)[:BINDING],
            "share": round(best.share, 3),
            "landed": {engine: run.landed for engine, run in best.runs.items()},
        }
    except JumplabError as e:
        found["reason"] = str(e)
    return found | {"cpu_s": round(time.process_time() - began, 1)}


def rows() -> list[dict[str, Any]]:
    """The records on file."""
    return [line["row"] for line in logs.rows(LOG)]


def missing(done: Any) -> Iterator[tuple[str, str]]:
    """Records that the log lacks, first those of robots that are planned in the plane."""
    planar = {}
    for name in SHIPPED:
        with suppress(JumplabError):  # its description is not installed
            planar[name] = Robot.load(name).planar
    cases = [(name, what) for what in WHAT for name in planar]
    for name, what in sorted(cases, key=lambda case: not planar[case[0]]):
        if f"{name} {what}" not in done:
            yield name, what


def shipped() -> str:
    """Text of the file that refusals read: the records in full numbers by the robots' hashes."""
    by: dict[str, dict[str, float]] = {}
    for x in rows():
        if x["value"] is not None:
            by.setdefault(x["hash"], {})[x["what"]] = x["value"]
    lines = (f" {json.dumps(robot)}: {json.dumps(by[robot])}" for robot in sorted(by))
    return "{\n" + ",\n".join(lines) + "\n}\n"


def records_table() -> Table:
    """The records of each robot, a row a robot, each with the share of it that lands in both engines."""
    by: dict[str, dict[str, dict[str, Any]]] = {}
    for x in rows():
        by.setdefault(x["robot"], {})[x["what"]] = x
    out = []
    for name, found in by.items():
        high = found.get("height_m", {})
        line = {"robot": name, "standing": high.get("apex_m"), "ends": ", ".join(high.get("ends", ()))}
        line["bound"] = found.get("distance_m", {}).get("bound")
        for what, x in found.items():
            if x["value"] is not None:
                lands = f"{x['share']:.0%}" if x["landed"] and all(x["landed"].values()) else "falls"
                line[what] = f"{x['value']:.3g} ({lands})"
        out.append(line)
    return table(out, COLUMNS, digits=3)


def bounds_table(robot: Robot, rises_m: Sequence[float]) -> Table:
    """Bounds that no motion of a robot exceeds, a row a rise."""
    body = Body(robot)
    rows = []
    for rise in rises_m:
        task = JumpTask(0.0, rise)
        rows.append({"rise [m]": rise} | {what: most(body, Limits(), task, what) for what in BOUNDED})
    return table(rows, digits=3)


def main() -> None:
    """Seek what is missing, or print the table."""
    if sys.argv[1:] == ["table"]:
        print(records_table())
        return
    with logs.keep(LOG, itemgetter("key")) as log:
        for name, what in missing(log.done):
            found = row(name, what)
            log.add({"key": f"{name} {what}", "row": found})
            print(found, flush=True)
    write_file(RECORDS, shipped().encode())


if __name__ == "__main__":
    main()
