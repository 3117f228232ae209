"""Robots in files of somebody else: the front door registers what reads them, since the core
knows no importer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_registered: list[Callable[..., Any]] = []


def register(importer: Callable[..., Any], check: Callable[..., None]) -> None:
    """Let ``importer(name_or_path, repair)`` make robots of what is no pair of files yet, and
    ``check(urdf, config_text, where)`` refuse pairs by the same rules; without ``where`` it is a
    robot of this package's own making, whose motors may be what no file has.
    """
    _registered[:] = importer, check


def check(urdf: str, config_text: str, where: str = "") -> None:
    """Let the registered check refuse a pair of texts; ``where`` names the URDF's file."""
    _registered[1](urdf, config_text, where)


def load(name_or_path: Any, repair: tuple[str, ...]) -> Any:
    """The :class:`.Robot` that the registered importer makes of a file; raises what it raises."""
    return _registered[0](name_or_path, repair)
