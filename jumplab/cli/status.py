"""The line on a terminal that says what a command is doing, as soon as it has not ended at once."""

import sys
import threading
import time
from contextlib import AbstractContextManager, ExitStack
from typing import Any

from jumplab.io.progress import told_to

FIRST_S, REDRAW_S = 0.4, 0.2  # what ends sooner says nothing; later, the line is kept up to date
WIDTH = 110  # longer ones would wrap on most terminals, and could not be redrawn


class Status(AbstractContextManager):
    """Within the block, a line on stderr if that is a terminal; bars of tqdm have it for themselves."""

    def __init__(self, command: str):
        self._command, self._doing, self._ended = command, "starting", threading.Event()
        self._out, self._began, self._stack = sys.stderr, time.monotonic(), ExitStack()
        self._thread = threading.Thread(target=self._draw, daemon=True)

    def __enter__(self) -> "Status":
        if self._out.isatty():
            self._stack.enter_context(told_to(self._hear))
            self._thread.start()
        return self

    def __exit__(self, *raised: Any) -> None:
        self._stack.close()
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join(1.0)

    def _hear(self, what: str, done: int, of: int) -> None:
        self._doing = f"{what} {done} of {of}" if of else what

    def _draw(self) -> None:
        wait, drawn = FIRST_S, False
        while not self._ended.wait(wait):
            bars = getattr(getattr(sys.modules.get("tqdm.std"), "tqdm", None), "_instances", ())
            if all(bar.disable for bar in list(bars)):
                text = f"jumplab {self._command}: {self._doing}, {time.monotonic() - self._began:.0f} s"
                self._out.write(f"\r{text[:WIDTH]}\x1b[K")
                self._out.flush()
                drawn = True
            wait = REDRAW_S
        if drawn:
            self._out.write("\r\x1b[K")
            self._out.flush()
