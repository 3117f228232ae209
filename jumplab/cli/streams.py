"""Standard streams that never change what a command does: missing, closed or full ones lose the
text alone.
"""

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO


class Patient:
    """A text stream without the errors of writing; ``lost`` gets the reason of the first one.

    A reader that has gone is no reason: the rest is not needed.
    """

    def __init__(self, stream: TextIO, lost: list[str]):
        self._stream = stream
        self._lost = lost

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, or drop the text."""
        return self._kept(lambda: self._stream.write(text)) or len(text)

    def flush(self) -> None:
        """Flush, or drop what waits."""
        self._kept(self._stream.flush)

    def _kept(self, work: Any) -> Any:
        try:
            return work()
        except UnicodeEncodeError:
            raise
        except (OSError, ValueError) as e:  # ValueError: it is closed
            if isinstance(e, OSError) and e.errno != errno.EPIPE:
                self._lost.append(e.strerror or type(e).__name__)
            try:  # what waits in it goes there as well, now and when Python ends
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)
            except (OSError, ValueError):
                self._stream = open(os.devnull, "w")
            return None


@contextmanager
def patient_streams() -> Iterator[list[str]]:
    """Within the block, stdout and stderr are :class:`Patient`; yields why output was lost."""
    before = sys.stdout, sys.stderr
    lost: list[str] = []
    for name, reasons in (("stdout", lost), ("stderr", [])):
        stream = getattr(sys, name) or open(os.devnull, "w")
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a path need not be printable
        setattr(sys, name, Patient(stream, reasons))
    try:
        yield lost
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before
