"""Robots in files of somebody else: the front door registers what reads them, since the core
knows no importer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_importers: list[Callable[..., Any]] = []


def register(importer: Callable[..., Any]) -> None:
    """Let ``importer(name_or_path, repair)`` make robots of what is no pair of files yet."""
    _importers[:] = [importer]


def load(name_or_path: Any, repair: tuple[str, ...]) -> Any:
    """The :class:`.Robot` that the registered importer makes of a file; raises what it raises."""
    (importer,) = _importers
    return importer(name_or_path, repair)
