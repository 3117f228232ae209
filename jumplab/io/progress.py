"""Messages on the progress of long work, for any display: the command line, a notebook.

>>> with told_to(print):
...     tell("simulating", 12, 200)
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

# what is done, how much of it is, of how much (0: not known)
Listener = Callable[[str, int, int], None]
_LISTENERS: list[Listener] = []


def tell(what: str, done: int = 0, of: int = 0) -> None:
    """Say what is being done; costs next to nothing where nobody listens."""
    for listener in _LISTENERS:
        listener(what, done, of)


@contextlib.contextmanager
def told_to(listener: Listener) -> Iterator[None]:
    """Within the block, ``listener`` is called whenever work says what it is doing."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)
