"""The audit itself: replay a tape, ask every group of checks, leave the report in a folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path

from jumplab.arguments import checked
from jumplab.auditing import contact, dynamics, motion
from jumplab.auditing.replay import open_tape, replay
from jumplab.auditing.report import LIMITS, AuditReport, Check, Limit, Measure, of_size
from jumplab.errors import InputError, as_path
from jumplab.io.files import write_file
from jumplab.io.folder import CONFIG, PLAN, SUMMARY, URDF, read_json, sha256, versions
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
    tape: Tape, robot: Robot, task: JumpTask | None = None, *, edge_m: float | None = None
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
    """
    open_tape(tape, robot, task)
    checks = _checks(motion.form(tape))
    capture = []
    if all(c.passed for c in checks):
        r = replay(tape, robot, task, edge_m)
        limits = of_size(robot)[1]
        checks += _checks((measure for group in GROUPS for measure in group(r)), limits)
        capture = _checks(motion.capture(r))
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


def write_audit(folder: str | Path, *, into: str | Path | None = None) -> AuditReport:
    """Audit the plan in a result folder and write ``passport.json`` beside it (or into another
    folder).

    Reads ``plan.npz``, ``robot.urdf``, ``robot.toml`` and, for the target and the manifest,
    ``summary.json`` if it is there; takes no lock, since the folder may be one that is being
    written. Raises :class:`InputError` if a file is missing or damaged, or the folder cannot be
    written to.
    """
    tell("audit")
    folder = as_path(folder, "a result folder")
    tape = Tape.load(folder / PLAN)
    humanoid = Robot.from_text(_text(folder / URDF), _text(folder / CONFIG))
    summary = read_json(folder / SUMMARY) if (folder / SUMMARY).exists() else {}
    task = _task_of(summary)
    edge = summary.get("platform_edge_m") if task else None
    report = audit(tape, humanoid, task, edge_m=edge)
    manifest = {**report.manifest, "plan_sha256": sha256(folder / PLAN), "planner": summary}
    report = dataclasses.replace(report, manifest=manifest)
    write_file(
        (folder if into is None else as_path(into, "the passport's folder")) / REPORT,
        report.to_json().encode(),
    )
    return report


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(
            f"{path}: cannot be read ({type(e).__name__}); plan the jump again into this folder"
        ) from e


def _task_of(summary: dict) -> JumpTask | None:
    """The target that a summary names under ``target``; None if it names none."""
    target = summary.get("target")
    if not isinstance(target, dict) or not {"distance_m", "height_m"} <= set(target):
        return None
    known = {f.name for f in dataclasses.fields(JumpTask)}
    return JumpTask(**{k: v for k, v in target.items() if k in known})
