"""Public clips of people who jump, retargeted by kinematics: judged, mended, audited and simulated."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import jumplab as jl
from jumplab.auditing.clip import ALLOWED, ClipReport
from jumplab.errors import JumplabError
from jumplab.io.clip import ENDINGS
from jumplab.sim import ENGINES
from jumplab.studies.mend import Mended
from paper import logs

LOG = Path(__file__).with_name("mending.jsonl")
# what a mended clip keeps: joints [rad] rms, footholds [m], and of each flight its rise [m] or its time [1]
JOINTS_RAD, FOOTHOLD_M, RISE_M, FLIGHT = 0.25, 0.07, 0.05, 0.15


def study(folder: str | Path, path: Path = LOG, robot: str = "g1") -> None:
    """Judge and mend every clip of a folder, audit and simulate what comes out; a row each, written after every clip.

    Clips that the log has are passed over. ``python -m paper.mending DIR`` calls it.
    """
    with logs.keep(path, itemgetter("clip"), robot=jl.Robot.load(robot)) as log:
        for clip in sorted(x for x in Path(folder).iterdir() if x.suffix in ENDINGS and x.stem not in log.done):
            log.add(row_of(clip, robot))


def row_of(clip: Path, robot: str) -> dict[str, Any]:
    """Result of one clip: its measures before and after, the parts that were kept, or why it cannot be mended.

    Its processor time counts from the file to the plan with its audit, functions of the robot's program made before.
    """
    began = time.process_time()
    before = jl.judge(clip, robot)
    row = {"clip": before.clip.name, "before": _measures(before), "cpu_s": None}
    try:
        mended = jl.mend(before)
    except JumplabError as e:
        return row | {"mended": False, "reason": str(e), "cpu_s": time.process_time() - began}
    row |= {"mended": True, "factor": mended.factor, "span_s": mended.span_s}
    report = mended.plan.audit
    row |= {"cpu_s": time.process_time() - began}
    row |= {"audit": report.passed, "audit_failed": [c.name for c in report.failed], "changes": mended.changes}
    return row | {"after": _measures(jl.judge(mended.plan)), "binding": mended.binding, "landed": _played(mended)}


def _measures(report: ClipReport) -> dict[str, float]:
    return {f"{c.name} [{c.unit}]": c.value for c in report.checks}


def _played(mended: Mended) -> dict[str, bool | None]:
    """By engine, whether the simulated robot lands; None where the clip has no flight."""
    plan = mended.plan
    return {engine: jl.simulate(plan, engine=engine).landed if plan.tape.flights else None for engine in ENGINES}


def failing(measures: Mapping[str, float]) -> list[str]:
    """Names of the measures that are beyond what judging allows."""
    limits = {name: ALLOWED[name.rpartition(" [")[0]] for name in measures}
    signs = {name: -1 if limit.at_least else 1 for name, limit in limits.items()}
    return [name for name, x in measures.items() if signs[name] * (x - limits[name].limit) > 0]


def causes(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A line per measure: how many clips are beyond what judging allows, before and after mending."""
    mended = [row for row in rows if row["mended"]]
    clips = {"all before": [r["before"] for r in rows], "mended, before": [r["before"] for r in mended]}
    clips["mended, after"] = [r["after"] for r in mended]
    counts = {title: Counter(name for x in some for name in failing(x)) for title, some in clips.items()}
    return [{"beyond": name} | {title: count[name] for title, count in counts.items()} for name in rows[0]["before"]]


def stored(path: Path = LOG) -> list[dict[str, Any]]:
    """The kept rows."""
    return logs.rows(path)


def kept(row: Mapping[str, Any]) -> dict[str, Any]:
    """A line of the table: what a clip kept, and whether that is near enough (see the constants above)."""
    line = {"clip": row["clip"], "CPU [s]": row["cpu_s"]}
    if not row["mended"]:
        return line | {"meets": False, "reason": row["reason"]}
    changes = {x["what"]: x for x in row["changes"]}
    joints, hold = (changes[f"{name}"]["change"] for name in ("joints, rms [rad]", "footholds, largest [m]"))
    flights = [name for name in changes if name.startswith("flight")]
    stays = []
    for name in flights:
        rise = changes.get(name.replace("flight", "rise").replace("[s]", "[m]"))
        by_time = abs(changes[name]["change"]) <= FLIGHT * changes[name]["clip"]
        by_rise = rise is not None and abs(rise["change"]) <= RISE_M
        stays.append("time" if by_time else "rise" if by_rise else "")
    played = all(x is not False for x in row["landed"].values())
    near = joints <= JOINTS_RAD and hold <= FOOTHOLD_M and all(stays)
    shown = {name: " / ".join(f"{changes[x][name]:.2f}" for x in flights) for name in ("clip", "mended")}
    return line | {
        "meets": bool(row["audit"] and near and played),
        "audit": row["audit"],
        "joints [rad]": joints,
        "footholds [m]": hold,
        "flight, clip [s]": shown["clip"],
        "flight, mended [s]": shown["mended"],
        "keeps": " / ".join(x or "neither" for x in stays),
        "lands": ", ".join(name for name, landed in row["landed"].items() if landed) or "not played",
    }


if __name__ == "__main__":
    study(sys.argv[1])
