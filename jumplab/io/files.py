"""Files that are written whole or not at all, locks, and the resumable log: a line of JSON per
finished piece of work.

Locks are those of the system, on the folder or the log itself: readers share, a writer is alone,
and a process that dies gives them back. (The package filelock shares only through a database, and
leaves a file of its own in the folder.)
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import tempfile
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from jumplab import reading
from jumplab.errors import InputError, as_path

Parse = Callable[[Any], tuple[Hashable, Any]]  # key and value of a line's data
LOCK_WAIT_S = 20.0  # a write lasts well under a second: after a longer wait something hangs
LOCK_LOOK_S = 0.005  # between two looks whether a lock is free
AT_SETTLE: list[Callable[[], None]] = []  # functions to call, see settle


def settle() -> None:
    """Called just before results are in place: who would stop the work raises here, or never."""
    for call in list(AT_SETTLE):
        call()


@contextlib.contextmanager
def _refusals(folder: Path) -> Iterator[None]:
    """Say in a sentence (:class:`InputError`) that ``folder`` is a file, or is refused by the
    system.
    """
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise InputError(f"{str(folder)!r} is a file; choose a folder")
    try:
        yield
    except OSError as e:
        reason = e.strerror or type(e).__name__
        raise InputError(
            f"the folder {str(folder)!r} cannot be written ({reason}); choose another one"
        ) from e


@contextlib.contextmanager
def made(folder: Path) -> Iterator[None]:
    """Make ``folder`` with its parents; the new ones go again if the block fails.

    Raises :class:`InputError` if ``folder`` is a file, or the system refuses anything here or in
    the block.
    """
    with _refusals(folder):
        new = [p for p in (folder, *folder.parents) if not os.path.exists(p)]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            yield
        except BaseException:
            for p in new:
                with contextlib.suppress(OSError):
                    p.rmdir()
            raise


def ensure_writable(folder: str | Path) -> Path:
    """Check that ``folder`` can be written into, or made; raises as :func:`made`.

    It is not made for that: another process might see it, and it would go again.
    """
    folder = as_path(folder, "a result folder")
    with _refusals(folder):
        with contextlib.suppress(FileNotFoundError):
            folder.stat()  # refuses names that the system cannot have
        there = next(filter(os.path.exists, (folder, *folder.parents)))
        tempfile.TemporaryFile(dir=there).close()
    return folder


def write_file(path: str | Path, content: bytes, mode: int = 0o644) -> Path:
    """Write one file whole or not at all, and make its folder; raises :class:`InputError`."""
    path = as_path(path, "a file")
    if path.is_dir():
        raise InputError(f"{str(path)!r} is a folder; name a file")
    with made(path.parent):
        handle, half = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                # readable by all; temporary files are private by default
                os.fchmod(file.fileno(), mode)
                file.write(content)
            os.replace(half, path)
        except BaseException:
            Path(half).unlink(missing_ok=True)
            raise
    return path


@contextlib.contextmanager
def locked(folder: Path, *, shared: bool = False, wait_s: float = LOCK_WAIT_S) -> Iterator[None]:
    """Hold the lock of an existing folder; readers share it, a writer has it alone.

    Raises :class:`InputError` if another process keeps it for longer than ``wait_s`` [s], counted
    in looks, so that on a busy machine it waits longer. A file system that knows no locks grants it
    always: the hashes in the manifest then still show a mix.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        looks = wait_s / LOCK_LOOK_S
        while not _try_lock(fd, fcntl.LOCK_SH if shared else fcntl.LOCK_EX):
            looks -= 1
            if looks < 0:
                raise InputError(
                    f"another jumplab is writing into {str(folder)!r}; wait, or choose another "
                    "folder"
                )
            time.sleep(LOCK_LOOK_S)
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


# log ------------------------------------------------------------------------------------------
class Log:
    """An open log; made by :func:`open_log`.

    ``done`` is what its lines say, the last one of equal keys; damaged and foreign lines are left
    out. ``empty`` is True if it had no line at all.
    """

    def __init__(self, file: BinaryIO, parse: Parse):
        file.seek(0)
        self._file = file
        self.done = {}
        line = b"\n"
        at = 0  # where the line begins
        # one that is longer than any of ours comes in pieces, which are no JSON either
        while piece := file.readline(reading.LINE_BYTES):
            at, line = file.tell() - len(piece), piece
            if line.endswith(b"\n"):
                with contextlib.suppress(
                    ValueError, KeyError, TypeError, AttributeError, RecursionError
                ):
                    key, value = parse(json.loads(line))
                    self.done[key] = value
        if line.startswith(b"{") and not line.endswith(b"\n"):  # killed in the middle of a line
            file.truncate(at)
            line = b"\n"
        elif not line.endswith(b"\n"):
            file.write(b"\n")
        self.empty = at == 0 and line == b"\n"

    def add(self, data: Mapping[str, Any]) -> None:
        """Append one line of JSON; it is on the disk when this returns."""
        self._file.write(json.dumps(data, allow_nan=False).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())


@contextlib.contextmanager
def open_log(path: str | Path, command: str, parse: Parse) -> Iterator[Log]:
    """The log at ``path``, for one process at a time; it is made if it is missing, and goes if
    nothing is added.

    ``command`` of jumplab writes such logs; ``parse`` gives key and value of a line's data, or
    raises ValueError, KeyError or TypeError if it is not ours. Raises :class:`InputError` if the
    file cannot be written, or another process has it.
    """
    path = Path(path)
    reading.refuse_link(path)
    try:
        file = os.fdopen(
            os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | reading.SAFE, 0o644), "a+b"
        )
    except OSError as e:
        raise InputError(
            f"{path}: cannot be written ({e.strerror}); choose a writable folder"
        ) from e
    try:
        with file:
            reading.check(file, path, "log")
            if not _try_lock(file.fileno(), fcntl.LOCK_EX):
                raise InputError(
                    f"{path}: another 'jumplab {command}' is writing it; wait until that is done"
                )
            try:
                yield Log(file, parse)
            finally:
                if os.fstat(file.fileno()).st_size == 0:
                    path.unlink(missing_ok=True)
    except OSError as e:
        raise InputError(
            f"{path}: cannot be written ({e.strerror}); free some space, or choose another folder"
        ) from e
