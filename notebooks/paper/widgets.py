"""Loops with a counter, and whether a notebook is open in an editor, where it can be seen.

A cell that takes long shows what its work says of itself (:mod:`jumplab.show.waiting`); a notebook that papermill
executes shows nothing.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from typing import TypeVar

from jumplab.io.progress import tell

T = TypeVar("T")
SESSION = "JPY_SESSION_NAME"  # set by Jupyter's server for the kernel of a notebook that is open


def watched() -> bool:
    """Whether this code runs in a notebook that is open in JupyterLab, Jupyter Notebook or VS Code."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    in_editor = shell is not None and "__vsc_ipynb_file__" in getattr(shell, "user_ns", {})
    return bool(os.environ.get(SESSION)) or in_editor


def progress(items: Sequence[T], label: str) -> Iterator[T]:
    """The items one by one, told as so many of so many; ``label`` says what is being done with each."""
    for number, item in enumerate(items, 1):
        tell(label, number, len(items))
        yield item
