"""Progress bars, shown only while somebody looks.

A notebook that papermill executes keeps everything that its cells print; there bars stay away.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm
from tqdm.notebook import tqdm as notebook_tqdm

T = TypeVar("T")
SESSION = "JPY_SESSION_NAME"  # set by Jupyter's server for the kernel of a notebook that somebody has opened


def watched() -> bool:
    """Whether this code runs in a notebook that is open in JupyterLab, Jupyter Notebook or VS Code."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    in_editor = shell is not None and "__vsc_ipynb_file__" in getattr(shell, "user_ns", {})
    return bool(os.environ.get(SESSION)) or in_editor


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """The items one by one, under a bar while somebody looks, which disappears at the end.

    Parameters
    ----------
    label : what is being counted.
    total : how many there are, where ``len(items)`` does not tell.
    """
    how = dict(desc=label, total=total, leave=False)
    if not watched():
        shown = sys.stderr is not None and sys.stderr.isatty()
        yield from tqdm(items, **how) if shown else items
        return
    from IPython.display import display

    bar = notebook_tqdm(items, display=False, **how)
    place = display(bar.container, display_id=True)
    try:
        yield from bar
    finally:
        place.update({"text/plain": ""}, raw=True)  # a bar that stands still would stay
