"""The audit itself: replay a tape, ask every group of checks, leave the report in a folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from itertools import starmap
from pathlib import Path

from jumplab.arguments import checked
from jumplab.auditing import contact, dynamics, motion
from jumplab.auditing.replay import open_tape, replay
from jumplab.auditing.report import LIMITS, AuditReport, Check, Limit, Measure, of_size
from jumplab.io.folder import PLAN, read_plan, sha256, transaction, versions
from jumplab.io.progress import tell
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.task import JumpTask

REPORT = "passport.json"
GROUPS = (
    motion.rates,
    motion.switch,
    motion.symmetry,
    dynamics.forces,
    dynamics.flight,
    dynamics.takeoff,
    dynamics.energy,
    contact.places,
    contact.pressure,
    dynamics.joints,
    motion.target,
    contact.collisions,
    dynamics.description,
)


@checked
def audit(
    tape: Tape,
    robot: Robot,
    task: JumpTask | None = None,
    *,
    edge_m: float | None = None,
    over: Sequence[float] | None = None,
) -> AuditReport:
    """Audit a finished plan with nothing but its tape and the robot's URDF.

    Every quantity is recomputed with Pinocchio on the tape's own 1 kHz grid; limits are those of
    ``limits.toml``, some of which grow with the robot. A tape with numbers that are not finite, or
    with phases out of order, gets a report with these two checks alone.
    Raises :class:`InputError` if the tape belongs to another robot (joints, sizes or contact frames
    differ).

    Parameters
    ----------
    task : what was asked; without it the checks of distance, rise, turns and start are left out, g
        is 9.8, and the landing surface is where the soles are at the end.
    edge_m : where the landing surface of another height begins, ahead of the toes' first place [m];
        by default 5 cm behind the landing soles if it is higher, 5 cm ahead of the toes if lower.
    over : (from, to, top) of a block that no link may touch, ahead of that place too [m].
    """
    open_tape(tape, robot, task)
    checks = _checks(motion.form(tape))
    capture = []
    if all(c.passed for c in checks):
        r = replay(tape, robot, task, edge_m, over)
        limits = of_size(robot)[1]
        measures = (measure for group in GROUPS for measure in group(r))
        checks += _checks(starmap(r.named, measures), limits)
        capture = _checks(starmap(r.named, motion.capture(r)))
    manifest = {
        "robot": robot.name,
        "robot_hash": robot.hash,
        "target": task.numbers if task else None,
        "samples": len(tape.t),
        "versions": versions(),
    }
    return AuditReport(tuple(checks), manifest, *capture)


def _checks(measures: Iterable[Measure], limits: Mapping[str, Limit] = LIMITS) -> list[Check]:
    return [limits[name].check(*values) for name, *values in measures]


def write_audit(folder: str | Path) -> AuditReport:
    """Audit the plan in a result folder and write ``passport.json`` beside it.

    Raises :class:`InputError` if the folder holds no whole plan, or cannot be written.
    """
    tell("audit")
    tape, robot, summary = read_plan(folder)
    task = JumpTask.of(summary["target"])
    edge_m = summary.get("platform_edge_m")
    report = audit(tape, robot, task, edge_m=edge_m, over=summary.get("over"))
    manifest = {**report.manifest, "plan_sha256": sha256(Path(folder, PLAN)), "planner": summary}
    report = dataclasses.replace(report, manifest=manifest)
    with transaction(folder) as staging:
        (staging / REPORT).write_text(report.to_json(), encoding="utf-8")
    return report
