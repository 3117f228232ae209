"""PyBullet, without the line that it prints when it is imported, and how a robot gets into it."""

from __future__ import annotations

import contextlib
import os
import tempfile
from types import ModuleType

from jumplab.errors import RobotError


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


def load_urdf(urdf: str, name: str, client: int, flags: int = 0) -> int:
    """Load the URDF text of robot ``name``, inertias as written there; returns the body's number.

    Raises :class:`RobotError` if PyBullet cannot read it.
    """
    handle, path = tempfile.mkstemp(suffix=".urdf")  # Bullet reads files only
    try:
        with os.fdopen(handle, "w") as file:
            file.write(urdf)
        return bullet.loadURDF(path, flags=flags | bullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client)
    except bullet.error as e:
        raise RobotError(f"robot {name}: PyBullet cannot read the URDF: {e}") from e
    finally:
        with contextlib.suppress(OSError):
            os.remove(path)
