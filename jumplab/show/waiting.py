"""The bar under a cell of a notebook that takes long: what is being done, how much of it, and since when."""

from __future__ import annotations

import html
import os
import sys
import time
from typing import Any

from jumplab.io.progress import told_to

FIRST_S, REDRAW_S = 1.5, 0.25  # a cell that ends sooner shows nothing; later, the bar is kept up to date


class Waiting:
    """Shows, below the cell that runs, what long work says of itself; gone when the cell has ended."""

    def __init__(self, shell: Any):
        self._began, self._drawn_s, self._bar, self._listening = 0.0, 0.0, None, None
        self._counted: tuple[str, int, int] | None = None
        shell.events.register("pre_run_cell", self._begin)
        shell.events.register("post_run_cell", self._end)

    def _begin(self, *_: Any) -> None:
        self._end()
        self._began, self._drawn_s, self._counted = time.monotonic(), 0.0, None
        self._listening = told_to(self._hear)
        self._listening.__enter__()

    def _end(self, *_: Any) -> None:
        if self._listening is not None:
            self._listening.__exit__(None, None, None)
        if self._bar is not None:
            self._bar.update({"text/html": "", "text/plain": ""}, raw=True)
        self._listening = self._bar = None

    def _hear(self, what: str, done: int, of: int) -> None:
        if of:
            self._counted = (what, done, of)
        passed = time.monotonic() - self._began
        if passed < FIRST_S or passed - self._drawn_s < REDRAW_S:
            return
        from IPython.display import DisplayHandle

        self._drawn_s = passed
        amount, told = "", [] if of else [what]
        if self._counted is not None:  # what is done just now may be a part of it
            name, done, of = self._counted
            amount, told = f' value="{done}" max="{of}"', [f"{name} {done} of {of}", *told]
        text = ", ".join(told)
        bar = f"<progress{amount}></progress> {html.escape(text)}, {passed:.0f} s"
        shown = {"text/html": bar, "text/plain": f"{text}, {passed:.0f} s"}
        if self._bar is None:
            self._bar = DisplayHandle()
            self._bar.display(shown, raw=True)
        else:
            self._bar.update(shown, raw=True)


def show_waiting() -> Waiting | None:
    """Show bars from here on, if this is an open notebook; None elsewhere, and where the notebook is only executed."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if shell is None or not hasattr(shell, "kernel") or os.environ.get("JPY_SESSION_NAME") == "":
        return None
    if not hasattr(shell, "_jumplab_waiting"):
        shell._jumplab_waiting = Waiting(shell)
    return shell._jumplab_waiting
