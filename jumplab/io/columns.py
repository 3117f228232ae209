"""Positions, velocities and torques of a jump by the names of its joints, and as one table for pandas."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from jumplab.errors import InputError
from jumplab.io.tape import Tape
from jumplab.robot import Robot

if TYPE_CHECKING:
    from jumplab.io.motion import Record

ROLES = {"hip": "hip_pitch", "ankle": "ankle_pitch", "shoulder": "shoulder_pitch"}  # short names of a robot's roles


class Columns(Mapping[str, np.ndarray]):
    """Columns of a log by name: of a joint (N,), of a role such as "knee" (N, 2), left, then right."""

    def __init__(self, values: np.ndarray, robot: Robot, unit: str):
        self._values, self.unit = values, unit
        self._at = {name: k for k, name in enumerate(map(str, robot.joint_names))}
        self._pairs = {role: [self._at[name] for name in pair] for role, pair in robot.joints.items() if pair}

    def __getitem__(self, name: str) -> np.ndarray:
        if name in self._at:
            return self._values[:, self._at[name]]
        role = ROLES.get(name, name)
        if role not in self._pairs:
            raise InputError(f"there is no joint {name!r}; there are {', '.join([*self._pairs, *self._at])}")
        return self._values[:, self._pairs[role]]

    def __contains__(self, name: object) -> bool:
        return name in self._at or ROLES.get(name, name) in self._pairs

    def __iter__(self) -> Iterator[str]:
        return iter(self._at)

    def __len__(self) -> int:
        return len(self._at)

    def __repr__(self) -> str:
        return f"<Columns [{self.unit}]: {', '.join(self._at)}; pairs {', '.join(self._pairs)}>"


class Named:
    """A plan or a simulation whose columns have names; it has a ``tape``, or is a record itself, and a ``robot``."""

    __slots__ = ()

    @property
    def _record(self) -> Record:
        return getattr(self, "tape", self)

    def _columns(self, values: np.ndarray, unit: str) -> Columns:
        if self.robot is None:
            raise InputError("these logs do not know their robot; read them with jl.load")
        return Columns(values, self.robot, unit)

    @property
    def angle(self) -> Columns:
        """Joint angles [rad], (N,) per joint: ``angle["left_knee"]``, or both sides of a role: ``angle["knee"]``."""
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
        """Pictures of it: ``plots.torques()``, ``plots.joints()`` and others, see ``dir(plots)``."""
        return import_module("jumplab.show.cards").Plots(self)

    def to_frame(self) -> Any:
        """A ``pandas.DataFrame`` over time [s]: phase, base, then position, velocity and torque of every joint.

        Raises :class:`InputError` where pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InputError("a frame needs pandas: pip install pandas") from None
        x, table = self._record, {"phase": self._record.phase}
        base = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
        table |= {f"base_{name}": x.q[:, k] for k, name in enumerate(base)}
        for kind, columns in (
            ("position_rad", self.angle),
            ("velocity_rad_s", self.speed),
            ("torque_N_m", self.torque),
        ):
            table |= {f"{name}_{kind}": column for name, column in columns.items()}
        return pandas.DataFrame(table, index=pandas.Index(x.t, name="time_s"))


def com_height(record: Tape | Any) -> np.ndarray:
    """Height of the CoM (N,) [m], of a tape or of a simulation."""
    if isinstance(record, Tape):
        return (record.extra["com"] if "com" in record.extra else record.extra["planar_com"])[:, -1]
    return record.com[:, 2]
