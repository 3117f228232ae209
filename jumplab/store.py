"""Result folders: written whole or not at all, checked when read.

A plan's folder holds ``plan.npz`` (the tape), ``robot.urdf`` and ``robot.toml`` (the robot it was planned for) and
``summary.json``, which comes last and whose ``manifest`` carries the SHA-256 of the others. What is said about that
plan later (passport, simulation) lies beside it.

New files are first written into ``.staging`` inside the folder. Renaming that to ``.commit`` is the one moment at which
the new result exists; its files then replace the old ones. Killed before that moment, the old result stands; killed
after it, the next reader or writer moves the rest. Readers and writers take turns by a lock on the folder itself, which
the system releases when a process dies.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import math
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from jumplab.errors import InputError, as_path, needs
from jumplab.robot import Robot
from jumplab.trajectory import Tape

T = TypeVar("T")
SCHEMA = "jumplab-result-1"
PLAN, URDF, CONFIG, SUMMARY = "plan.npz", "robot.urdf", "robot.toml", "summary.json"
HASHED = (PLAN, URDF, CONFIG)
# Statements about one plan, which a new plan makes untrue and therefore removes.
OF_SIMULATION = ("jump.html", "simulated_joints.csv", "simulated_motion.npz", "simulated_motion_clip.npz",
                 "simulated_replay")  # what a new simulation makes untrue  # fmt: skip
DERIVED = ("passport.json", "simulation.npz", "simulation.json", "trials.jsonl", "trials.json", "basin.json",
           "plan.html", "joints.csv", "motion.npz", "motion_clip.npz", "replay", *OF_SIMULATION)  # fmt: skip
PACKAGES = ("jumplab", "casadi", "pin", "cvxpy", "clarabel", "proxsuite", "pybullet", "numpy", "scipy", "matplotlib")
LOCK_WAIT_S = 20.0  # our choice: a write lasts well under a second, so a longer wait means that something hangs
_STAGING, _COMMIT = ".staging", ".commit"


def versions() -> dict[str, str]:
    """Version of Python and of every package that shapes a result."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def to_json(data: Any) -> str:
    """JSON text of nested mappings, sequences, NumPy values and paths; numbers that are not finite become null."""
    return json.dumps(_plain(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, np.ndarray | np.generic):
        return _plain(x.tolist())
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, float):
        return x if math.isfinite(x) else None
    return str(x) if isinstance(x, Path) else x


def sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def ensure_writable(folder: str | Path) -> Path:
    """Check that results can be written into ``folder``, and leave no trace.

    Raises
    ------
    InputError
        If ``folder`` is a file, or cannot be made, or cannot be written.
    """
    folder = as_path(folder, "a result folder")
    with _explained(folder):
        made = _make(folder)
        try:
            with tempfile.TemporaryFile(dir=folder):
                pass
        finally:
            _unmake(made)
    return folder


@contextlib.contextmanager
def _explained(folder: Path) -> Iterator[None]:
    """Turn what the system says about ``folder`` into one sentence."""
    try:
        yield
    except OSError as e:
        reason = e.strerror or type(e).__name__
        raise InputError(f"the folder {str(folder)!r} cannot be written ({reason}); choose another one") from e


def _make(folder: Path) -> list[Path]:
    """Make ``folder`` with its parents; return those that are new, innermost first."""
    new = [p for p in (folder, *folder.parents) if not p.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except BaseException as e:
        _unmake(new)
        if isinstance(e, ValueError):  # a zero byte in the name
            raise InputError(f"{str(folder)!r} cannot be the name of a folder ({e}); choose another one") from e
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{str(folder)!r} is a file; choose a folder") from e
        raise
    return new


def _unmake(folders: list[Path]) -> None:
    for p in folders:
        with contextlib.suppress(OSError, ValueError):
            p.rmdir()


@contextlib.contextmanager
def locked(folder: Path, *, shared: bool = False, wait_s: float = LOCK_WAIT_S) -> Iterator[None]:
    """Hold the lock of an existing folder; readers share it, a writer has it alone.

    A file system that knows no locks grants it always: the hashes in the manifest then still tell a mix.

    Raises
    ------
    InputError
        If another process keeps it for longer than ``wait_s`` [s].
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        deadline = time.monotonic() + wait_s
        while not _try_lock(fd, fcntl.LOCK_SH if shared else fcntl.LOCK_EX):
            if time.monotonic() > deadline:
                raise InputError(f"another jumplab is writing into {str(folder)!r}; wait, or choose another folder")
            time.sleep(0.005)
        yield
    finally:
        os.close(fd)


def _try_lock(fd: int, kind: int) -> bool:
    try:
        fcntl.flock(fd, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # no locks on this file system
        pass
    return True


@contextlib.contextmanager
def transaction(folder: str | Path) -> Iterator[Path]:
    """Yield an empty staging folder; if the block ends well, its files replace those of ``folder`` all at once.

    If the block raises, or the process is killed before its end, ``folder`` is what it was before.

    Raises
    ------
    InputError
        If ``folder`` cannot be written.
    """
    folder = as_path(folder, "a result folder")
    with _explained(folder):
        made = _make(folder)
        staging = folder / _STAGING
        try:
            with locked(folder):
                _finish(folder)
                shutil.rmtree(staging, ignore_errors=True)  # left by a writer that was killed
                staging.mkdir()
                try:
                    yield staging
                    _commit(folder)
                finally:
                    shutil.rmtree(staging, ignore_errors=True)
        except BaseException:
            _unmake(made)
            raise


def _commit(folder: Path) -> None:
    try:
        (folder / _STAGING).rename(folder / _COMMIT)
        _finish(folder)
    except BaseException:  # Ctrl-C between the two: the new result exists, so let it be complete
        _finish(folder)
        raise


def _finish(folder: Path) -> None:
    """Move what is committed to its place: the plan first, the summary last. Needs the lock; may be repeated."""
    commit = folder / _COMMIT
    if not commit.is_dir():
        return
    names = {p.name for p in commit.iterdir()}
    stale = {n for n in names if n.endswith(".json")}
    if PLAN in names:
        stale |= {SUMMARY, *DERIVED}
    if "simulation.npz" in names:
        stale |= set(OF_SIMULATION)
    for name in sorted(stale):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
        (folder / name).unlink(missing_ok=True)
    for name in sorted(names, key=lambda n: (n != PLAN, n == SUMMARY, n.endswith(".json"), n)):
        os.replace(commit / name, folder / name)
    commit.rmdir()


def write_file(path: str | Path, content: bytes) -> Path:
    """Write one file, whole or not at all, and make its folder; raises :class:`InputError` if that cannot be."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{str(path)!r} is a folder; name a file")
    with _explained(path.parent), contextlib.ExitStack() as undo:
        undo.callback(_unmake, _make(path.parent))
        handle, half = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
        undo.callback(Path(half).unlink, missing_ok=True)
        with os.fdopen(handle, "wb") as file:
            os.fchmod(file.fileno(), 0o644)  # readable by all; temporary files are private by default
            file.write(content)
        os.replace(half, path)
        undo.pop_all()
    return path


def write_plan(
    folder: str | Path,
    tape: Tape,
    robot: Robot,
    summary: Mapping[str, Any],
    complete: Callable[[Path], T] | None = None,
) -> T | None:
    """Write a plan's folder; what an older plan left there, with its passport and simulation, goes.

    Parameters
    ----------
    summary : becomes ``summary.json``, with a ``manifest`` added: versions, robot, hashes of the files.
    complete : called with the folder before anybody else sees it, to add files to it (``write_passport``).

    Returns
    -------
    What ``complete`` returned.
    """
    needs(tape, Tape, "the tape to write")
    needs(robot, Robot, "its robot")
    needs(summary, Mapping, "the summary")
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


class Simulation(Protocol):
    """What :func:`write_simulation` needs of a simulation's result."""

    def save(self, folder: Path, extra: dict | None = None) -> None: ...


def write_simulation(folder: str | Path, result: Simulation, summary: Mapping[str, Any]) -> None:
    """Write ``simulation.npz`` and ``simulation.json`` beside the plan that ``summary`` was read with.

    Raises
    ------
    InputError
        If the folder cannot be written, or has come to hold another plan.
    """
    needs(summary, Mapping, "the summary")
    if not {"planned_distance_m", "planned_rise_m", "manifest"} <= set(summary):
        raise InputError("the summary is not one that a plan was read with; take it from store.read_plan")
    folder = as_path(folder, "a result folder")
    planned = {name: summary[name] for name in ("planned_distance_m", "planned_rise_m")}
    with transaction(folder) as staging:
        _same_plan(folder, summary)
        result.save(staging, extra=planned)


def write_trials(folder: str | Path, report: Mapping[str, Any], summary: Mapping[str, Any], name: str) -> None:
    """Write file ``name`` beside the plan that ``summary`` was read with; raises as :func:`write_simulation`."""
    with transaction(folder) as staging:
        _same_plan(Path(folder), summary)
        (staging / name).write_text(to_json(report), encoding="utf-8")


def _same_plan(folder: Path, summary: Mapping[str, Any]) -> None:
    if read_summary(folder)["manifest"]["files"] != summary["manifest"]["files"]:
        raise InputError(f"{str(folder)!r} has been planned again in the meantime; simulate the new plan")


def read_summary(folder: Path) -> dict[str, Any]:
    """Read and check ``summary.json``; the lock is the caller's affair."""
    path = folder / SUMMARY
    if not path.is_file():
        raise InputError(f"{str(folder)!r} holds no finished plan ({SUMMARY} is missing); make one with 'jumplab plan'")
    summary = read_json(path)
    manifest = summary.get("manifest")
    files = manifest.get("files") if isinstance(manifest, dict) and manifest.get("schema") == SCHEMA else None
    if not isinstance(files, dict) or not all(isinstance(files.get(name), str) for name in HASHED):
        raise InputError(f"{path}: not a summary of schema {SCHEMA!r}; plan the jump again")
    return summary


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; raises :class:`InputError` in one sentence if it is missing or damaged."""
    try:
        data = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as e:
        raise InputError(f"{path}: not a readable JSON file ({type(e).__name__})") from e
    if not isinstance(data, dict):
        raise InputError(f"{path}: not a JSON object")
    return data


def read_plan(folder: str | Path) -> tuple[Tape, Robot, dict[str, Any]]:
    """Read a plan's folder: the tape, the robot it was planned for, and the summary.

    Raises
    ------
    InputError
        If the folder holds no finished plan, or if a file is damaged or not the one that the summary speaks of.
    """
    folder = as_path(folder, "a result folder")
    try:
        if not folder.is_dir():
            raise InputError(f"there is no folder {str(folder)!r}; make a plan with 'jumplab plan --out' first")
        if (folder / _COMMIT).is_dir():
            with locked(folder):
                _finish(folder)
        with locked(folder, shared=True):
            summary = read_summary(folder)
            for name in HASHED:
                if sha256(folder / name) != summary["manifest"]["files"][name]:
                    raise InputError(f"{folder / name}: changed or damaged since it was written; plan the jump again")
            urdf, config = ((folder / name).read_bytes().decode() for name in (URDF, CONFIG))
            return Tape.load(folder / PLAN), Robot.from_text(urdf, config), summary
    except (OSError, ValueError) as e:
        reason = (e.strerror if isinstance(e, OSError) else str(e)) or type(e).__name__
        raise InputError(f"the plan in {str(folder)!r} cannot be read ({reason})") from e
