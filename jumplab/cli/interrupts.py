"""Ctrl-C and SIGTERM: a command ends within two seconds, with 130 or 143, and leaves no partial
result.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType

import psutil

from jumplab.io import files

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
UNCHANGED = "interrupted; what was there before is unchanged"
LEAVE_S = 0.4  # for what libraries do at the end of a process
# after this long without an end, the process is ended from outside of what it is doing
PATIENCE_S = 0.8


class Stopped(KeyboardInterrupt):
    """Raised wherever a command is when it is told to stop."""


class Interrupts:
    """Heeds both signals while a command runs.

    CasADi loses exceptions that are raised within its callbacks: the solve then merely fails, and
    the planner tries another way. So the process is ended if it does not end by itself. From the
    moment at which results are put in their places (:func:`jumplab.io.files.settle`), it is too
    late to stop.

    Parameters
    ----------
    alone : the process has nothing else to do, and may be ended.
    """

    def __init__(self, alone: bool):
        self.number: int | None = None  # of the signal that was heard
        self._alone = alone
        self._settled = False
        self._over = threading.Event()

    @contextlib.contextmanager
    def heeded(self) -> Iterator[None]:
        """Within the block, signals are heard; a Ctrl-C that was ignored before stays so."""
        numbers = [n for n in CODES if n == signal.SIGTERM or signal.getsignal(n) != signal.SIG_IGN]
        before = {number: signal.signal(number, self._hear) for number in numbers}
        shown = sys.stderr, sys.unraisablehook
        files.AT_SETTLE.append(self._settle)
        try:
            yield
        finally:
            self._over.set()
            sys.stderr, sys.unraisablehook = shown
            files.AT_SETTLE.remove(self._settle)
            for number, handler in before.items():
                signal.signal(number, signal.SIG_IGN if self._alone else handler)

    def _settle(self) -> None:
        self._settled = True
        if self.number is not None:  # heard, and lost in a solve whose outcome counts for nothing
            raise Stopped

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self._over.is_set() or self._settled or self.number is not None:
            return
        self.number = number
        threading.Thread(target=self._insist, args=(sys.stderr,), daemon=True).start()
        # CasADi and half-ended libraries would print messages too
        sys.stderr = open(os.devnull, "w")
        sys.unraisablehook = lambda _: None
        raise Stopped

    def _insist(self, stderr) -> None:
        if not self._over.wait(PATIENCE_S) and self._alone:
            if self.number == signal.SIGINT:
                print(f"jumplab: {UNCHANGED}", file=stderr, flush=True)
            end_soon(CODES[self.number], 0.0)


def end_soon(code: int, leave_s: float = LEAVE_S) -> None:
    """Let the process end by itself, without those that it has started; with the exit ``code``, if
    it has not ended after ``leave_s`` [s].
    """

    def end() -> None:
        time.sleep(leave_s)
        os._exit(code)

    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            # tidies up behind the others, then ends by itself
            if "resource_tracker" not in " ".join(child.cmdline()):
                child.kill()
    threading.Thread(target=end, daemon=True).start()
