"""Acrobatics of a G1 within its maker's motor curves: the rows of ``acrobatics.jsonl``.

``python -m paper.acrobatics [KIND ...]`` in the folder of the notebooks plans and audits what :data:`ASKED` has and the
log lacks, plays each clean plan back in both engines, and can be stopped and started again; ``python -m
paper.acrobatics table`` prints the counts. Notebook 07 prints the rows.
"""

from __future__ import annotations

import json
import math
import sys
import time
from functools import cache
from itertools import chain, count, repeat, zip_longest
from operator import itemgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from jumplab import api
from jumplab.auditing import AuditReport
from jumplab.control.kinematics import pitch_of
from jumplab.errors import JumplabError
from jumplab.robot import Robot
from jumplab.show.tables import Table, table
from jumplab.sim import INSTALLED, Ranges, Scene
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body.ground import clear_of_edge_m
from jumplab.studies.trials import TrialKey, TrialSettings, run_trial
from jumplab.task import JumpTask
from paper import logs

LOG = Path(__file__).with_name("acrobatics.jsonl")
ROBOT = "g1"
SEED = 42
KINDS = "ahead", "side", "quarter turn", "half turn", "platform", "perturbed", "flip", "weaker"
TARGETS = 14, 9, 9, 9, 9  # of the first kinds
FAR = 3.0  # times the rise, the farthest that is asked: shallower jumps slip
PERTURBED = 100  # robots, of each flip in :data:`THROWN`
MANY = 250  # of kind "perturbed"
# lower ones leave robots that differ from their model little time to turn over
THROWN = ("backflip, robust plan, 0 m ahead, 0.5 m up", "front flip, 0.1 m ahead, 0.5 m up")
COLUMNS = {
    "kind": "kind",
    "asked": "targets",
    "planned": "planned",
    "clean": "audit passed",
    "landed": "landed in both engines",
    "perturbed": "robots that differ, by engine",
    "cpu_s": "CPU of a plan, median [s]",
    "iterations": "iterations, median",
}


def targets() -> dict[str, list[dict[str, Any]]]:
    """Kind -> fields of :class:`.JumpTask`; where motors are weaker, also factors ``effort`` and ``speed``, and
    ``robust`` of a plan that allows for other robots.
    """
    rng = np.random.default_rng(SEED)

    def drawn(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 2)

    near = clear_of_edge_m(Robot.load(ROBOT))
    asked: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    for kind, number in zip(KINDS, TARGETS, strict=False):
        for k in count():
            if len(asked[kind]) == number:
                break
            rise = drawn(0.1, 0.35)  # onto a platform that high, at most 0.3 m, by 0.15 m more
            far = drawn(0.1, min(0.9, FAR * rise))
            way = 1.0 if k % 2 else -1.0
            found = {
                "ahead": {"distance_m": far, "height_m": rise},
                "side": {"distance_m": 0.0, "height_m": rise, "side_m": way * min(far, 0.3)},
                "quarter turn": {"distance_m": far / 2, "height_m": rise, "yaw_rad": way * math.pi / 2},
                "half turn": {"distance_m": 0.0, "height_m": max(rise, 0.2), "yaw_rad": way * math.pi},
                "platform": {
                    "distance_m": max(far, near),
                    "height_m": round(rise + 0.15, 2),
                    "platform_m": min(rise, 0.3),
                },
            }
            if found[kind] not in asked[kind]:
                asked[kind].append(found[kind])
    asked["perturbed"].append({"distance_m": 0.4, "height_m": 0.2})
    backflip = {"rotation_rad": -2 * math.pi, "distance_m": 0.0, "height_m": 0.5}
    asked["flip"].append(backflip | {"robust": True})
    for turns, far in ((-1, 0.0), (1, 0.1)):
        over = {"rotation_rad": turns * 2 * math.pi, "distance_m": far}
        asked["flip"] += [over | {"height_m": rise} for rise in (0.3, 0.35, 0.4, 0.45, 0.5)]
        asked["weaker"] += [
            over | {"height_m": rise, "effort": share, "speed": share}
            for rise in (0.3, 0.4, 0.5)
            for share in (0.95, 0.9, 0.85, 0.8)
        ]
    return asked


def key(kind: str, target: dict[str, Any]) -> str:
    """The name of a row in the log."""
    return f"{kind}: " + json.dumps(target, sort_keys=True)


@cache
def planner(effort: float, speed: float) -> Planner:
    """Of a robot with motors that are stronger, and faster, by factors."""
    robot = Robot.load(ROBOT)
    return Planner(robot if effort == speed == 1 else robot.with_limits(effort=effort, speed=speed), keep=True)


def attempt(kind: str, target: dict[str, Any]) -> dict[str, Any]:
    """One row: the plan, its audit, and, where that is clean, its simulations and those of robots that differ."""
    task = dict(target)
    factors = task.pop("effort", 1.0), task.pop("speed", 1.0)
    allows = Ranges() if task.pop("robust", False) else None
    row: dict[str, Any] = {"kind": kind, **target, "effort": factors[0], "speed": factors[1]}
    row |= {"planned": False, "clean": False, "said": ""}
    start = time.process_time()
    try:
        jump = JumpTask(**task)
        plan = api.plan(jump, ROBOT, robust=allows) if allows else planner(*factors).plan(jump)
    except JumplabError as e:
        return row | {"said": str(e), "cpu_s": round(time.process_time() - start, 2)}
    attempts = plan.whole_body.attempts
    row |= {"planned": True, "cpu_s": round(time.process_time() - start, 2)}
    row |= {"solve_s": round(sum(x.cpu_s for x in attempts), 2), "iterations": sum(x.iterations for x in attempts)}
    report = api.audit(plan)
    row |= {"clean": report.passed, "used": fullest(report)}
    row["said"] = "; ".join(f"{c.name}: {c.value:.3g} {c.unit}, at most {c.limit:g}" for c in report.failed)
    if report.passed and kind != "weaker":
        row["landed"] = {engine: landing(plan, engine) for engine in INSTALLED}
    if report.passed and kind == "flip":
        row["re-aimed"] = {engine: landing(plan, engine, reaim=True) for engine in INSTALLED}
    robots = MANY if kind == "perturbed" else PERTURBED if kind == "flip" and named(row) in THROWN else 0
    if robots and report.passed:
        row["perturbed"] = {engine: thrown(plan, engine, robots) for engine in INSTALLED}
    return row


def fullest(report: AuditReport) -> list[Any]:
    """The limit of the joints that is used most: name, share [%], joint."""
    used = max((c for c in report.checks if c.group == "joints" and c.unit.startswith("%")), key=lambda c: c.value)
    return [used.name, round(used.value, 1), used.note.rpartition("worst: ")[2]]


def landing(plan: Any, engine: str, **how: Any) -> list[Any]:
    """Whether a playback landed and its findings passed, distance and rise [m], and why it ended."""
    run = api.simulate(plan, engine=engine, **how)
    far, high = run.metrics.foot_distance_m, run.metrics.com_rise_m
    return [run.landed and run.checks_passed, far and round(far, 3), high and round(high, 3), run.reason]


def thrown(plan: Any, engine: str, robots: int) -> list[bool]:
    """Of ``robots`` that differ from their model, whether each one lands, turned over where the plan is."""
    settings = TrialSettings(engine=engine)
    there = SimpleNamespace(tape=plan.tape, robot=plan.robot, scene=Scene.flat())
    keys = (TrialKey(0, k, settings.hash, "") for k in range(robots))
    trials = [run_trial(there, settings, k) for k in keys]
    turned = float(np.unwrap(pitch_of(plan.tape.q))[-1])
    return [t.landed and abs(t.metrics.touchdown_trunk_pitch_rad - turned) < math.pi / 2 for t in trials]


# what the log says
# ---------------------------------------------------------------------------------------------------------------------
def rows() -> list[dict[str, Any]]:
    """The log: what was asked, what became of the plan, which limit it uses most, and how it landed."""
    return [line["row"] for line in logs.rows(LOG)]


def lands(row: dict[str, Any]) -> bool:
    """Whether a plan passes its audit and lands in every engine that was asked."""
    return row["clean"] and all(found[0] for found in row["landed"].values())


def landings(row: dict[str, Any]) -> str:
    """Counts of robots that differ and land, engine by engine; empty where none was asked."""
    return ", ".join(f"{sum(x)} of {len(x)}" for x in row.get("perturbed", {}).values())


def counts(found: list[dict[str, Any]]) -> Table:
    """A row per kind of jump with the motors as made."""
    out = []
    for kind in KINDS[:-1]:
        some = [row for row in found if row["kind"] == kind]
        planned = [row for row in some if row["planned"]]
        line = {"kind": kind, "asked": len(some), "planned": len(planned)}
        line |= {"clean": sum(row["clean"] for row in some), "landed": sum(map(lands, some))}
        line["perturbed"] = "; ".join(filter(None, map(landings, some)))
        medians = {k: float(np.median([row[k] for row in planned])) for k in ("cpu_s", "iterations") if planned}
        out.append(line | medians)
    return table(out, COLUMNS)


def flips(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per flip: its plan, its fullest limit, how it lands, and with how much weaker motors it has a plan."""
    out = []
    weaker = [row for row in found if row["kind"] == "weaker"]
    for row in (row for row in found if row["kind"] == "flip"):
        same = [x for x in weaker if x["clean"] and named(x) == named(row)]
        asked = any(named(x) == named(row) for x in weaker)
        least = f"{min([x['effort'] for x in same], default=1.0):.0%}" if asked else ""
        line = {"flip": named(row), "plan": "clean" if row["clean"] else row["said"].split(";")[0]}
        line["fullest limit"] = "{}, {:.0f} %, {}".format(*row["used"]) if "used" in row else ""
        for column, how in (("lands", "landed"), ("re-aimed", "re-aimed")):
            runs = row.get(how, {}).values()
            line[column] = f"{sum(x[0] for x in runs)} of {len(runs)}" if runs else ""
        line["of robots that differ"] = landings(row)
        out.append(line | {"also clean with motors of": least})
    return out


def named(row: dict[str, Any]) -> str:
    """A flip in words."""
    turn = "front flip" if row["rotation_rad"] > 0 else "backflip"
    turn += ", robust plan" if row.get("robust") else ""
    return f"{turn}, {row['distance_m']:g} m ahead, {row['height_m']:g} m up"


def main(*kinds: str) -> None:
    """Do what is missing, or print the counts."""
    if kinds == ("table",):
        print(counts(rows()))
        return
    with logs.keep(LOG, itemgetter("key")) as log:
        asked = [[(kind, target) for target in some] for kind, some in targets().items() if kind in (kinds or KINDS)]
        for kind, target in chain.from_iterable(map(filter, repeat(None), zip_longest(*asked))):  # some of each
            if (name := key(kind, target)) not in log.done:
                row = attempt(kind, target)
                log.add({"key": name, "row": row})
                print(name, row["clean"], row["said"][:200], row.get("landed"), row["cpu_s"], flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
