"""One line on what is being done, and since when: on a terminal, or under a notebook's cell."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any, TextIO

from tqdm import tqdm

from jumplab.io.progress import told_to

# what ends sooner shows nothing; later, the line is kept up to date
FIRST_S = 1.0
REDRAW_S = 0.25
TICK_S = 0.5
WIDTH = 110  # a longer line would wrap on most terminals


@contextlib.contextmanager
def waiting(out: TextIO, head: str = "", first: str = "") -> Iterator[None]:
    """Within the block, what long work says of itself is a line of ``out``, gone at the end;
    ``first`` is there at once, before it says anything.

    A thread of its own keeps it up to date: a solve, or a robot's meshes, say nothing for long.
    """
    count = ""
    with tqdm(
        desc=head + first if first else None,
        file=out,
        bar_format="{desc}, {elapsed_s:.0f} s",
        leave=False,
        ncols=WIDTH,
        nrows=20,
        delay=0.0 if first else FIRST_S,
        mininterval=REDRAW_S,
        miniters=0,
    ) as bar:

        def hear(what: str, done: int, of: int) -> None:
            nonlocal count
            if of:  # what is done later may be a part of it
                count = f"{what} {done} of {of}"
            words = filter(None, (count, "" if of else what))
            bar.set_description_str(head + ", ".join(words), refresh=False)
            bar.update(0)

        ended = threading.Event()

        def keep() -> None:
            while not ended.wait(TICK_S):
                if bar.desc:
                    bar.update(0)

        clock = threading.Thread(target=keep, daemon=True)
        with told_to(hear):
            clock.start()
            try:
                yield
            finally:
                ended.set()
                clock.join()


def on_terminal(command: str) -> contextlib.AbstractContextManager:
    """Show the progress of a ``command`` on stderr, if that is a terminal."""
    out = sys.stderr
    if not out.isatty():
        return contextlib.nullcontext()
    return waiting(out, f"jumplab {command}: ", "loading")  # imports take seconds on busy machines


class _UnderCell:
    """Takes a terminal's text, and shows its last line below the cell that runs."""

    handle: Any = None

    def write(self, text: str) -> None:
        from IPython.display import display

        line = {"text/plain": text.strip()}
        if self.handle is None:
            self.handle = display(line, raw=True, display_id=True)
        else:
            self.handle.update(line, raw=True)

    def flush(self) -> None:
        """Nothing waits to be written."""


def show_waiting() -> None:
    """Show such a line from here on, if this is a notebook that is open in an editor."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    open_notebook = hasattr(shell, "kernel") and os.environ.get("JPY_SESSION_NAME") != ""
    if open_notebook and not hasattr(shell, "_jumplab_waiting"):
        shell._jumplab_waiting = cell = contextlib.ExitStack()

        def begin(*_: Any) -> None:
            cell.close()
            cell.enter_context(waiting(_UnderCell()))

        shell.events.register("pre_run_cell", begin)
        shell.events.register("post_run_cell", lambda *_: cell.close())
