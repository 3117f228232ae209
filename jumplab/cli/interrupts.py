"""Ctrl-C and SIGTERM: a command ends within two seconds, with 130 or 143, and what it was working on is no result."""

import contextlib
import os
import signal
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from types import FrameType

from jumplab.io import files

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
UNCHANGED = "interrupted; what was there before is unchanged"
AGAIN_S = 0.05  # how often it is looked whether the exception got lost
LEAVE_S = 0.4  # for what libraries do at the end of a process
PATIENCE_S = 1.1  # after this long without an end, the process is ended from outside of what it is doing


class Stopped(KeyboardInterrupt):
    """Raised wherever a command is when it is told to stop."""


class Interrupts:
    """Heeds both signals while a command runs.

    CasADi loses exceptions that are raised within its callbacks: the solve then merely fails, and the planner would try
    another way. So the exception is raised again for as long as it has died without ending the command. From the
    moment at which results are put in their places (:func:`jumplab.io.files.settle`), it is too late to stop.

    Parameters
    ----------
    alone : the process has nothing else to do, and may be ended.
    """

    def __init__(self, alone: bool):
        self.number: int | None = None  # of the signal that was heard
        self._alone, self._settled, self._over = alone, False, False
        self._raised: weakref.ref[Stopped] | None = None
        self._stderr, self._hook = sys.stderr, sys.unraisablehook

    @property
    def code(self) -> int:
        """Exit code of what was heard."""
        return CODES[self.number]

    @contextlib.contextmanager
    def heeded(self) -> Iterator[None]:
        """Within the block, signals are heard; a Ctrl-C that was ignored before stays so."""
        numbers = [n for n in CODES if n == signal.SIGTERM or signal.getsignal(n) != signal.SIG_IGN]
        before = {number: signal.signal(number, self._hear) for number in numbers}
        files.AT_SETTLE.append(self._settle)
        try:
            yield
        finally:
            self._over, sys.stderr, sys.unraisablehook = True, self._stderr, self._hook
            files.AT_SETTLE.remove(self._settle)
            for number, handler in before.items():
                signal.signal(number, signal.SIG_IGN if self._alone else handler)

    def _settle(self) -> None:
        self._settled = True
        if self.number is not None:  # heard, and lost in a solve whose outcome counts for nothing
            self._stop()

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self._over or (self._settled and self.number is None):
            return
        if self.number is None:
            self.number = number
            sys.stderr = open(os.devnull, "w")  # CasADi and half-ended libraries would speak of it too
            sys.unraisablehook = lambda _: None
            threading.Thread(target=self._insist, daemon=True).start()
            self._stop()
        elif self._raised is None or self._raised() is None:
            self._stop()

    def _stop(self) -> None:
        stopped = Stopped()
        self._raised = weakref.ref(stopped)
        raise stopped

    def _insist(self) -> None:
        end = time.monotonic() + PATIENCE_S
        while not self._over and time.monotonic() < end:
            time.sleep(AGAIN_S)
            if self._raised is None or self._raised() is None:
                signal.pthread_kill(threading.main_thread().ident, self.number)
        if self._alone and not self._over:
            if self.number == signal.SIGINT:
                print(f"jumplab: {UNCHANGED}", file=self._stderr, flush=True)
            end_children()
            os._exit(self.code)


def end_soon(code: int) -> None:
    """Let the process end by itself, without those that it has started; at once, if it has not ended soon."""

    def end() -> None:
        time.sleep(LEAVE_S)
        os._exit(code)

    end_children()
    threading.Thread(target=end, daemon=True).start()


def end_children() -> None:
    """Kill the processes that this one has started."""
    import psutil

    children = psutil.Process().children(recursive=True)
    for child in children:
        with contextlib.suppress(psutil.Error):
            if "resource_tracker" not in " ".join(child.cmdline()):  # tidies up behind the others, then ends by itself
                child.kill()
