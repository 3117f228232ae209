"""Audit of a result folder, and the file it leaves there."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import tempfile
import tomllib
from pathlib import Path

from jumplab.auditing.audit import audit
from jumplab.auditing.report import AuditReport
from jumplab.errors import InputError, as_path
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.task import JumpTask

PASSPORT_NAME = "passport.json"
FILE_MODE = 0o644  # readable by all, like the plan beside it; temporary files are private by default


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"{path}: cannot be read ({type(e).__name__}); plan the jump again into this folder") from e


def read_robot(folder: str | Path) -> Robot:
    """The robot that a result folder carries: ``robot.urdf`` and ``robot.toml``. Raises InputError if damaged."""
    folder = Path(folder)
    try:
        return Robot.from_text(_text(folder / "robot.urdf"), _text(folder / "robot.toml"))
    except (tomllib.TOMLDecodeError, TypeError, IndexError, AttributeError) as e:
        raise InputError(f"{folder / 'robot.toml'}: no robot configuration ({e}); plan the jump again") from e


def read_summary(folder: str | Path) -> dict:
    """The planner's ``summary.json``; empty if the folder has none. Raises InputError if it is damaged."""
    path = Path(folder) / "summary.json"
    if not path.exists():
        return {}
    try:
        data = json.loads(_text(path))
    except json.JSONDecodeError as e:
        raise InputError(f"{path}: not a JSON file (line {e.lineno}); plan the jump again into this folder") from e
    if not isinstance(data, dict):
        raise InputError(f"{path}: must hold a JSON object, holds {type(data).__name__}")
    return data


def task_of(summary: dict) -> JumpTask | None:
    """The target that a summary names under ``target``; None if it names none."""
    target = summary.get("target")
    if not isinstance(target, dict) or not {"distance_m", "height_m"} <= set(target):
        return None
    known = {f.name for f in dataclasses.fields(JumpTask)}
    return JumpTask(**{k: v for k, v in target.items() if k in known})


def edge_of(summary: dict) -> float | None:
    """Where a summary says that the landing surface begins (``platform_edge_m``); None if it does not."""
    edge = summary.get("platform_edge_m")
    return float(edge) if isinstance(edge, (int, float)) and math.isfinite(edge) else None


def write_atomically(path: Path, text: str) -> None:
    """Write a text file so that a reader sees the old one or the new one, never a part; raises InputError."""
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            os.fchmod(file.fileno(), FILE_MODE)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror}); choose a folder that you may write to") from e
    finally:
        if temporary:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)


def write_audit(folder: str | Path, task: JumpTask | None = None, *, into: str | Path | None = None) -> AuditReport:
    """Audit the plan in a result folder and write ``passport.json`` beside it (or into another folder).

    Reads ``plan.npz``, ``robot.urdf``, ``robot.toml`` and, for the target and the manifest, ``summary.json``.

    Parameters
    ----------
    folder : result folder of a plan.
    task : what was asked; by default the target in ``summary.json``.
    into : where the file goes; the folder itself if None.

    Raises
    ------
    InputError
        If a file is missing or damaged, or the folder cannot be written to.
    """
    folder = as_path(folder, "a result folder")
    tape = Tape.load(folder / "plan.npz")
    robot = read_robot(folder)
    summary = read_summary(folder)
    passport = audit(tape, robot, task or task_of(summary), edge_m=edge_of(summary) if task is None else None)
    digest = hashlib.sha256((folder / "plan.npz").read_bytes()).hexdigest()
    passport = dataclasses.replace(passport, manifest={**passport.manifest, "plan_sha256": digest, "planner": summary})
    place = folder if into is None else as_path(into, "the passport's folder")
    write_atomically(place / PASSPORT_NAME, passport.to_json())
    return passport
