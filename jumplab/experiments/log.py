"""``trials.jsonl``: one line per finished trial, written at once, so that no kill costs more than what was running."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jumplab.errors import InputError
from jumplab.experiments.trial import Trial, TrialKey

NAME = "trials.jsonl"


class TrialLog:
    """The open log of one folder; made by :func:`open_log`.

    Attributes
    ----------
    trials : what the log held when it was opened, by key; damaged and foreign lines are left out.
    """

    def __init__(self, descriptor: int):
        self._descriptor = descriptor
        os.lseek(descriptor, 0, os.SEEK_SET)
        with os.fdopen(os.dup(descriptor), "rb") as file:
            content = file.read()
        self._torn = bool(content) and not content.endswith(b"\n")  # killed in the middle of a line
        self.trials: dict[TrialKey, Trial] = {}
        for line in content.splitlines():
            try:
                trial = Trial.from_line(line)
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                continue
            self.trials[trial.key] = trial

    def add(self, trial: Trial) -> None:
        """Append one trial: a single write of whole lines at the file's end."""
        text = ("\n" if self._torn else "") + trial.line()
        self._torn = True  # until the whole line is there
        data = text.encode()
        while data:
            data = data[os.write(self._descriptor, data) :]
        self._torn = False


@contextmanager
def open_log(folder: str | Path) -> Iterator[TrialLog]:
    """The folder's log, for one process at a time.

    Raises
    ------
    InputError
        If the file cannot be written, or another process has it.
    """
    path = Path(folder) / NAME
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror}); choose a writable folder") from e
    try:
        _lock(descriptor, path)
        try:
            yield TrialLog(descriptor)
        finally:
            if os.fstat(descriptor).st_size == 0:
                path.unlink(missing_ok=True)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror}); free some space, or choose another folder") from e
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"{path}: another 'jumplab trials' is writing it; wait until that is done") from None
    except OSError:  # no locks on this file system: lines are appended whole in any case
        pass
