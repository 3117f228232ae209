"""Result folders: written whole or not at all, checked when read.

A plan's folder holds ``plan.npz`` (the tape), ``robot.urdf`` and ``robot.toml`` (the robot it was
planned for) and ``summary.json``, which comes last and whose ``manifest`` carries the SHA-256 of
the others. Later results of that plan (audit, simulation, trials) lie beside it.

New files are first written into ``.staging`` inside the folder. Renaming that to ``.commit`` is the
one moment at which the new result exists; its files then replace the old ones. Killed before that
moment, the old result stands; killed after it, the next reader or writer moves the rest. Readers
and writers take turns by a lock on the folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from jumplab import reading
from jumplab.arguments import checked
from jumplab.errors import InputError, as_path
from jumplab.io.files import ensure_writable as ensure_writable
from jumplab.io.files import locked, made, settle
from jumplab.io.files import write_file as write_file
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.task import GRAVITY

Summary = Mapping[str, Any]
SCHEMA = "jumplab-result-1"
# whose versions a result names; by the last three notebooks draw and pose their own programs
PACKAGES = """jumplab casadi pin proxsuite coal pybullet mujoco numpy scipy matplotlib cvxpy
    clarabel""".split()
# the same sources, built for later Pythons under another name
BUILDS = {"pybullet-arm64": "pybullet"}
PLAN = "plan.npz"
URDF = "robot.urdf"
CONFIG = "robot.toml"
SUMMARY = "summary.json"
HASHED = {PLAN: "arrays", URDF: "robot", CONFIG: "robot"}  # and their kinds
# of exports: name of the format -> file or folder, frames a second that its usual readers expect
FORMATS = {
    "csv": ("joints.csv", 1000.0),
    "npz": ("motion.npz", 1000.0),
    "urdf-replay": ("replay", 100.0),
    "unitree-csv": ("unitree.csv", 30.0),
    "gmr-pkl": ("gmr.pkl", 30.0),
    "mjlab-npz": ("mjlab.npz", 50.0),
    "beyondmimic-npz": ("beyondmimic.npz", 50.0),
    "holosoma-npz": ("holosoma.npz", 50.0),
    "unilab-npz": ("unilab.npz", 50.0),
    "protomotions": ("protomotions.motion", 30.0),
    "isaaclab-npz": ("isaaclab.npz", 50.0),
    "asap-pkl": ("asap.pkl", 30.0),
    "sonic-pkl": ("sonic.pkl", 50.0),
    "bones-csv": ("bones.csv", 120.0),
    "mujoco": ("mujoco", 1000.0),
}
# formats with an object on which a motion ends, and behind the name of the file its mesh
WITH_OBJECT = ("holosoma-npz", "unilab-npz")
MESH = "_platform.obj"
MESHES = tuple(FORMATS[name][0].removesuffix(".npz") + MESH for name in WITH_OBJECT)
EXPORTS = (*(file for file, _ in FORMATS.values()), *MESHES)
# what a new simulation makes untrue and therefore removes, and what a new plan does
OF_SIMULATION = ("jump.html", *(f"simulated_{name}" for name in EXPORTS))
CERTIFICATE = ("certificate.json", "certificate.html")
OF_PLAN = (
    SUMMARY,
    "plan.html",
    "passport.json",
    "simulation.npz",
    "simulation.json",
    "trials.jsonl",
    "trials.json",
    "basin.json",
    "margins.json",
    *CERTIFICATE,
    *EXPORTS,
    *OF_SIMULATION,
)
_STAGING = ".staging"
_COMMIT = ".commit"


@contextlib.contextmanager
def transaction(folder: str | Path) -> Iterator[Path]:
    """Yield an empty staging folder; if the block ends well, its files replace those of ``folder``
    all at once.

    If the block raises, or the process is killed before its end, ``folder`` is what it was before.
    Raises :class:`InputError` if ``folder`` cannot be written.
    """
    folder = as_path(folder, "a result folder")
    staging = folder / _STAGING
    with made(folder), locked(folder):
        _finish(folder)
        reading.refuse_link(staging)
        shutil.rmtree(staging, ignore_errors=True)  # left by a writer that was killed
        staging.mkdir()
        try:
            yield staging
            # else it is part of a larger one
            if not {_STAGING, _COMMIT} & set(folder.resolve().parts):
                settle()
            staging.rename(folder / _COMMIT)
            _finish(folder)
        finally:
            # Ctrl-C after the renaming: the new result exists, so let it be complete
            _finish(folder)
            shutil.rmtree(staging, ignore_errors=True)


def _finish(folder: Path) -> None:
    """Put what is committed in its place, the summary last. Needs the lock; may be repeated."""
    commit = reading.below(folder, _COMMIT)
    if not commit.is_dir():
        return
    names = {p.name for p in commit.iterdir()}
    stale = [n for n in names if n.endswith(".json")]
    stale += OF_PLAN if PLAN in names else ()
    stale += OF_SIMULATION if "simulation.npz" in names else ()
    for name in stale:
        _remove(folder / name)
    for name in sorted(names, key=lambda n: (n != PLAN, n == SUMMARY, n.endswith(".json"), n)):
        if (folder / name).is_dir():  # a folder takes no other's place
            _remove(folder / name)
        os.replace(commit / name, folder / name)
    commit.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@cache  # a sweep audits thousands of plans
def versions() -> dict[str, str]:
    """Version of Python and of every package that shapes a result."""
    numbers = {"python": platform.python_version(), **dict.fromkeys(PACKAGES, "not installed")}
    for build in (*BUILDS, *PACKAGES):
        with contextlib.suppress(metadata.PackageNotFoundError):
            numbers[BUILDS.get(build, build)] = metadata.version(build)
    return numbers


def to_json(data: Any) -> str:
    """JSON of :func:`plain` data."""
    return json.dumps(plain(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def plain(x: Any) -> Any:
    """Plain data for JSON of nested mappings, sequences, NumPy values, paths; None for what is not
    finite.
    """
    if isinstance(x, Mapping):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, np.ndarray | np.generic):
        return plain(x.tolist())
    if isinstance(x, list | tuple):
        return [plain(v) for v in x]
    if isinstance(x, float):
        return x if math.isfinite(x) else None
    return str(x) if isinstance(x, Path) else x


def sha256(path: Path) -> str:
    """SHA-256 of a file of a result folder, in hexadecimal digits."""
    return hashlib.sha256(reading.content(path, "arrays", link=False)).hexdigest()


@checked
def write_plan(
    folder: str | Path,
    tape: Tape,
    robot: Robot,
    summary: Summary,
    complete: Callable[[Path], Any] | None = None,
) -> Any:
    """Write a plan's folder; what an older plan left there, with its passport and simulation, goes.

    ``summary`` becomes ``summary.json``, with a ``manifest`` added: versions, robot, hashes of the
    files. ``complete`` is called with the folder before others see it, to add files to it
    (``write_audit``); what it returns is returned.
    """
    with transaction(folder) as staging:
        tape.save(staging / PLAN)
        (staging / URDF).write_bytes(robot.urdf.encode())
        (staging / CONFIG).write_bytes(robot.config_text.encode())
        manifest = {
            **summary.get("manifest", {}),
            "schema": SCHEMA,
            "versions": versions(),
            "robot": {"name": robot.name, "hash": robot.hash},
            "files": {name: sha256(staging / name) for name in HASHED},
        }
        (staging / SUMMARY).write_text(to_json({**summary, "manifest": manifest}), encoding="utf-8")
        return complete(staging) if complete else None


@checked
def write_simulation(folder: str | Path, result: Any, summary: Summary) -> None:
    """Write a simulation (two files, by its ``save``) beside the plan that ``summary`` was read
    with.

    Raises :class:`InputError` if the folder cannot be written, or has come to hold another plan.
    """
    if not {"planned_distance_m", "planned_rise_m", "manifest"} <= set(summary):
        raise InputError(
            "the summary of the plan is incomplete; pass the one that "
            "jumplab.io.folder.read_plan returns"
        )
    planned = {name: summary[name] for name in ("planned_distance_m", "planned_rise_m")}
    with _beside(folder, summary) as staging:
        result.save(staging, extra=planned)


def write_trials(
    folder: str | Path,
    report: Mapping[str, Any],
    summary: Summary,
    name: str,
    pages: Mapping[str, str] | None = None,
) -> None:
    """Write file ``name``, and ``pages`` of text by name, beside the plan that ``summary`` was read
    with.

    Raises as :func:`write_simulation`.
    """
    with _beside(folder, summary) as staging:
        for file, text in (pages or {}).items():
            (staging / file).write_text(text, encoding="utf-8")
        (staging / name).write_text(to_json(report), encoding="utf-8")


@contextlib.contextmanager
def _beside(folder: str | Path, summary: Summary) -> Iterator[Path]:
    """A transaction on the folder of the plan that ``summary`` was read with."""
    with transaction(folder) as staging:
        if _read_summary(Path(folder))["manifest"]["files"] != summary["manifest"]["files"]:
            raise InputError(
                f"{str(folder)!r} has been planned again in the meantime; simulate the new plan"
            )
        yield staging


def _read_summary(folder: Path) -> dict[str, Any]:
    path = folder / SUMMARY
    if not path.is_file():
        raise InputError(
            f"{str(folder)!r} holds no finished plan ({SUMMARY} is missing); make one with "
            "'jumplab plan'"
        )
    summary = read_json(path)
    manifest = summary.get("manifest")
    files = manifest.get("files") if isinstance(manifest, dict) else None
    known = isinstance(files, dict) and manifest.get("schema") == SCHEMA
    if not known or not all(isinstance(files.get(name), str) for name in HASHED):
        raise InputError(f"{path}: not a summary of schema {SCHEMA!r}; plan the jump again")
    if not isinstance(summary.get("target"), dict):
        raise InputError(f"{path}: lacks the 'target' of the jump; plan the jump again")
    return summary


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; raises :class:`InputError` if it is missing or damaged."""
    try:
        data = json.loads(reading.content(path, "report", link=False))
    except (OSError, ValueError, RecursionError) as e:
        raise InputError(f"{path}: not a readable JSON file ({type(e).__name__})") from e
    if not isinstance(data, dict):
        raise InputError(f"{path}: not a JSON object")
    return data


def read_plan(folder: str | Path) -> tuple[Tape, Robot, dict[str, Any]]:
    """Read a plan's folder: the tape, the robot it was planned for, under the target's gravity, and
    the summary.

    Raises :class:`InputError` if the folder holds no finished plan, or a file is damaged or not the
    one that the summary names.
    """
    folder = as_path(folder, "a result folder")
    try:
        if not folder.is_dir():
            raise InputError(
                f"there is no folder {str(folder)!r}; make a plan with 'jumplab plan --out' first"
            )
        if reading.below(folder, _COMMIT).is_dir():  # a writer was killed
            with locked(folder):
                _finish(folder)
        with locked(folder, shared=True):
            summary = _read_summary(folder)
            files = {
                name: reading.content(folder / name, kind, link=False)
                for name, kind in HASHED.items()
            }
            for name, raw in files.items():
                if hashlib.sha256(raw).hexdigest() != summary["manifest"]["files"][name]:
                    raise InputError(
                        f"{folder / name}: changed or damaged since it was written; plan the jump "
                        "again"
                    )
            robot = Robot.from_text(files[URDF].decode(), files[CONFIG].decode()).under_gravity(
                summary["target"].get("gravity", GRAVITY)
            )
            return Tape.from_bytes(files[PLAN], folder / PLAN), robot, summary
    except (OSError, ValueError) as e:
        reason = (e.strerror if isinstance(e, OSError) else str(e)) or type(e).__name__
        raise InputError(f"the plan in {str(folder)!r} cannot be read ({reason})") from e
