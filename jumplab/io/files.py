"""Folders that are written whole or not at all.

New files are first written into ``.staging`` inside the folder. Renaming that to ``.commit`` is the one moment at which
the new result exists; its files then replace the old ones. Killed before that moment, the old result stands; killed
after it, the next reader or writer moves the rest. Readers and writers take turns by a lock on the folder itself, which
the system releases when a process dies.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from jumplab.errors import InputError, as_path

PLAN, URDF, CONFIG, SUMMARY = "plan.npz", "robot.urdf", "robot.toml", "summary.json"
HASHED = (PLAN, URDF, CONFIG)
# Statements about one plan, which a new plan makes untrue and therefore removes.
OF_SIMULATION = ("jump.html", "simulated_joints.csv", "simulated_motion.npz", "simulated_motion_clip.npz",
                 "simulated_replay")  # what a new simulation makes untrue  # fmt: skip
DERIVED = ("passport.json", "simulation.npz", "simulation.json", "trials.jsonl", "trials.json", "basin.json",
           "plan.html",
           "joints.csv", "motion.npz", "motion_clip.npz", "replay", *OF_SIMULATION)  # fmt: skip
LOCK_WAIT_S = 20.0  # our choice: a write lasts well under a second, so a longer wait means that something hangs
_STAGING, _COMMIT = ".staging", ".commit"


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
        if (folder / name).is_dir() and not (folder / name).is_symlink():  # a folder takes no other's place
            shutil.rmtree(folder / name)
        os.replace(commit / name, folder / name)
    commit.rmdir()


def recover(folder: Path) -> None:
    """Finish what a writer had committed when it was killed."""
    if (folder / _COMMIT).is_dir():
        with locked(folder):
            _finish(folder)


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
