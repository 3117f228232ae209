"""PyBullet, without the line that it prints when it is imported."""

from __future__ import annotations

import os
from types import ModuleType


def _import_quietly() -> ModuleType:
    """Import pybullet with file descriptor 2, to which its C code greets, muted for the moment."""
    try:
        keep, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # no standard error to protect
        import pybullet

        return pybullet
    try:
        os.dup2(nowhere, 2)
        import pybullet
    finally:
        os.dup2(keep, 2)
        os.close(keep)
        os.close(nowhere)
    return pybullet


bullet = _import_quietly()
