"""Positions, velocities and torques of a jump by the names of its joints, and as a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jumplab.errors import InputError, Shown, quoted
from jumplab.io.motion import Motion, Record
from jumplab.robot import Robot

SIDES = "left", "right"
# short names of a robot's roles
ROLES = {"hip": "hip_pitch", "ankle": "ankle_pitch", "shoulder": "shoulder_pitch"}


# columns of tables: of the base, and of each joint, with their first column in a record
BASE = tuple(f"base_{name}" for name in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"))
OF_JOINTS = {"position_rad": ("q", 7), "velocity_rad_s": ("v", 6), "torque_N_m": ("tau", 0)}


COM = ("com_x_m", "com_y_m", "com_z_m")
FORCES = tuple(f"{foot}_foot_force_{x}_N" for foot in SIDES for x in "xyz")


class Rows(Shown, tuple):
    """Rows of a table, mappings or dataclasses, which a notebook shows as one."""

    __slots__ = ()

    def line(self) -> str:
        """Number of rows."""
        return f"{len(self)} rows"

    __repr__ = tuple.__repr__


def table_of(motion: Motion, joints: Sequence[str], com: np.ndarray) -> dict[str, np.ndarray]:
    """Columns (N,) of a motion by name: position, velocity and torque of every joint, in the
    motion's order of ``joints``, then the base's place and quaternion, the ``com`` (N, 3) [m], and,
    where they are known, the forces on the feet [N].
    """
    table = {}
    for kind, (name, first) in OF_JOINTS.items():
        columns = getattr(motion, name)[:, first:].T
        table |= {f"{joint}_{kind}": x for joint, x in zip(joints, columns, strict=True)}
    table |= dict(zip((*BASE, *COM), (*motion.q[:, :7].T, *com.T), strict=True))
    if motion.wrench is not None:
        table |= dict(zip(FORCES, motion.wrench[..., :3].reshape(-1, 6).T, strict=True))
    return table


class Columns(Mapping[str, np.ndarray]):
    """Columns of a log by name: of a joint (N,), of a role such as "knee" (N, 2), left first, and
    of one of its sides, such as "left_knee" (N,), whatever the joint is called.
    """

    def __init__(self, values: np.ndarray, robot: Robot, unit: str):
        self._values = values
        self.unit = unit
        self._joints = {name: k for k, name in enumerate(robot.joint_names)}
        pairs = {role: [self._joints[name] for name in pair] for role, pair in robot.joints.items()}
        self._pairs = {role: pair for role, pair in pairs.items() if pair}
        short = {name: self._pairs[role] for name, role in ROLES.items() if role in self._pairs}
        roles = self._pairs | short
        sides = {
            f"{side}_{x}": pair[k] for x, pair in roles.items() for k, side in enumerate(SIDES)
        }
        self._columns = sides | roles | self._joints

    def __getitem__(self, name: str) -> np.ndarray:
        if not isinstance(name, str) or name not in self._columns:
            known = ", ".join([*self._pairs, *self._joints])
            raise InputError(f"there is no joint {quoted(name)}; there are {known}")
        return self._values[:, self._columns[name]]

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __iter__(self) -> Iterator[str]:
        return iter(self._joints)

    def __len__(self) -> int:
        return len(self._joints)

    def __repr__(self) -> str:
        return f"<Columns [{self.unit}]: {', '.join(self)}; pairs {', '.join(self._pairs)}>"


class Named:
    """A plan or a simulation, with a ``robot``, and a ``tape`` or itself a record."""

    __slots__ = ()

    @property
    def _record(self) -> Record:
        return getattr(self, "tape", self)

    def _columns(self, values: np.ndarray, unit: str) -> Columns:
        if self.robot is None:
            raise InputError("the robot of these logs is unknown; read them with jl.load")
        return Columns(values, self.robot, unit)

    @property
    def angle(self) -> Columns:
        """Angles [rad]: ``angle["left_knee"]`` (N,), of both sides ``angle["knee"]`` (N, 2)."""
        return self._columns(self._record.q[:, 7:], "rad")

    @property
    def speed(self) -> Columns:
        """Joint speeds [rad/s], named as :attr:`angle`."""
        return self._columns(self._record.v[:, 6:], "rad/s")

    @property
    def torque(self) -> Columns:
        """Joint torques [N m], named as :attr:`angle`."""
        return self._columns(self._record.tau, "N m")

    @property
    def plots(self) -> Any:
        """Pictures of it: ``plots.torques()``, ``plots.joints()``; see ``dir(plots)``."""
        return Shown.pictures().Plots(self)

    def to_frame(self) -> Any:
        """A ``pandas.DataFrame`` over time [s]: phase, and the columns of :func:`table_of`.

        Raises :class:`InputError` where pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InputError("a frame needs pandas: pip install 'jumplab[pandas]'") from None
        x = Motion.of(self._record)
        table = {"phase": x.phase} | table_of(x, list(self.angle), self.com)
        return pandas.DataFrame(table, index=pandas.Index(x.t, name="time_s"))
