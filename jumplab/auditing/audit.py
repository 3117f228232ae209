"""The audit itself: replay the tape, then ask every group of checks."""

from __future__ import annotations

import dataclasses
import math
import platform
from importlib import metadata

from jumplab.auditing import collision, contact, description, dynamics, joints, kinematics, target
from jumplab.auditing.replay import open_tape, replay
from jumplab.auditing.report import AuditReport
from jumplab.errors import InputError, quoted, require_type
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.task import JumpTask

PACKAGES = ("jumplab", "pin", "coal", "casadi", "numpy")
GROUPS = (kinematics, dynamics, contact, joints, target, collision, description)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _manifest(tape: Tape, robot: Robot, task: JumpTask | None) -> dict:
    return {
        "robot": robot.name,
        "robot_hash": robot.hash,
        "target": dataclasses.asdict(task) if task else None,
        "samples": len(tape.t),
        "versions": {"python": platform.python_version(), **{p: _version(p) for p in PACKAGES}},
    }


def audit(tape: Tape, robot: Robot, task: JumpTask | None = None, *, edge_m: float | None = None) -> AuditReport:
    """Audit a finished plan with nothing but its tape and the robot's URDF.

    Every quantity is recomputed with Pinocchio on the tape's own 1 kHz grid. A tape with numbers that are not finite,
    or with phases out of order, gets a passport with these two checks alone.

    Parameters
    ----------
    tape : launch and flight of the full robot.
    robot : its URDF and configuration.
    task : what was asked; without it the checks of distance, rise, turns and start are left out, g is 9.8 and the
        landing surface is where the soles are at the end.
    edge_m : where the landing surface of another height begins, ahead of the toes' first place [m]; by default 5 cm
        behind the landing soles if it is higher, 5 cm ahead of the toes if it is lower.

    Raises
    ------
    InputError
        If the tape belongs to another robot (joints, sizes or contact frames differ).
    """
    require_type(tape, Tape, "the tape to audit")
    require_type(robot, Robot, "its robot")
    if task is not None:
        require_type(task, JumpTask, "the target")
    number = isinstance(edge_m, int | float) and not isinstance(edge_m, bool)
    if edge_m is not None and not (number and math.isfinite(edge_m)):
        raise InputError(f"edge_m must be a finite number of metres, got {quoted(edge_m)}")
    open_tape(tape, robot, task)
    checks = kinematics.form(tape)
    if all(c.passed for c in checks):
        r = replay(tape, robot, task, edge_m)
        checks += [c for group in GROUPS for c in group.checks(r)]
    return AuditReport(tuple(checks), _manifest(tape, robot, task))
