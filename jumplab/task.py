"""Target of a jump, and ballistic consequences of it alone (Sec. III of the paper)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from jumplab.arguments import checked, real
from jumplab.errors import InputError, Shown

GRAVITY = 9.8  # [m/s^2], the paper's value; every model of the package uses it
# [1] that every stage counts on at its nodes; between them, the audit refuses what trials may not
# have
FRICTION = 0.45
# beyond the standing long-jump record for humans with run-up excluded (3.73 m): surely a typo
MAX_DISTANCE_M = 3.0
MAX_HEIGHT_M = 1.5  # beyond any human's CoM rise: surely a typo
MAX_PLATFORM_M = 1.0  # higher than any published standing humanoid jump


# of a target: in words, from, to
RANGES = {
    "distance_m": ("distance", -MAX_DISTANCE_M, MAX_DISTANCE_M),
    "height_m": ("height", 0.02, MAX_HEIGHT_M),
    "platform_m": ("platform", -MAX_PLATFORM_M, MAX_PLATFORM_M),
    "rotation_rad": ("rotation", -4 * math.pi, 4 * math.pi),
    "gravity": ("gravity", 0.5, 30.0),
    "side_m": ("side", -MAX_DISTANCE_M, MAX_DISTANCE_M),
    "yaw_rad": ("yaw", -2 * math.pi, 2 * math.pi),
}
UNITS = {"m": "m", "rad": "rad", "gravity": "m/s^2"}  # by the ends of names


def _number(name: str, value: Any, low: float, high: float, unit: str) -> float:
    x = real(value, name, unit)
    if not low <= x <= high:
        raise InputError(f"{name} = {x:g} {unit} is outside {low:g} ... {high:g} {unit}")
    return x


@dataclass(frozen=True)
class JumpTask(Shown):
    """Target of one jump.

    Attributes
    ----------
    distance_m : travel of the feet, toe to toe [m] (l in the paper; negative is backward).
    height_m : rise of the CoM from the instant the feet leave the ground to the apex [m] (h in the
        paper).
    platform_m : height of the landing surface above the launching surface [m].
    rotation_rad : rotation about +y in flight, 0 or a multiple of 2 pi (theta_tar; -2 pi is a
        backflip).
    gravity : [m/s^2].
    side_m : travel of the middle between the soles to the left [m]; negative is to the right.
    yaw_rad : turn about the vertical, counter-clockwise seen from above [rad]; ``distance_m`` and
        ``side_m`` stay in the axes of the start, and are then those of the middle between the
        soles.
    """

    distance_m: float
    height_m: float
    platform_m: float = 0.0
    rotation_rad: float = 0.0
    gravity: float = GRAVITY
    side_m: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self):
        for name, (words, low, high) in RANGES.items():
            unit = UNITS[name.rpartition("_")[2]]
            value = _number(words, getattr(self, name), low, high, unit)
            object.__setattr__(self, name, value)
        turns = self.rotation_rad / (2 * math.pi)
        if abs(turns - round(turns)) > 1e-6:
            raise InputError(
                f"rotation = {math.degrees(self.rotation_rad):g} deg: the robot lands on its feet "
                f"only after a multiple of 360 deg; nearest is {360 * round(turns):g} deg"
            )

    @classmethod
    @checked
    def of(cls, data: Mapping[str, Any]) -> Self:
        """The target in plain ``data``, as summaries of plans have it; numbers of other versions
        are left out.

        Raises :class:`InputError` if it lacks distance or rise, or for numbers that cannot be
        meant.
        """
        if not {"distance_m", "height_m"} <= data.keys():
            raise InputError("a target has a distance_m and a height_m; plan the jump again")
        return cls(**{f.name: data[f.name] for f in fields(cls) if f.name in data})

    @property
    def in_plane(self) -> bool:
        """Whether the jump stays in the sagittal plane: neither side nor yaw."""
        return self.side_m == 0 and self.yaw_rad == 0

    @property
    def along_rad(self) -> float:
        """Direction of the travel seen from above [rad], along which a platform begins; zero
        straight ahead or back.
        """
        return math.atan2(self.side_m, self.distance_m) if self.side_m else 0.0

    @property
    def takeoff_speed(self) -> float:
        """Vertical CoM speed at take-off, sqrt(2 g h) [m/s] (v_z^exp, Sec. III)."""
        return math.sqrt(2 * self.gravity * self.height_m)

    @checked
    def flight_time(self, com_rise_at_touchdown_m: float = 0.0) -> float:
        """Time in the air [s] when the CoM touches down ``com_rise_at_touchdown_m`` above its
        take-off height.

        Zero gives the paper's 2 v / g. Raises :class:`InputError` if the apex is lower than that.
        """
        v = self.takeoff_speed
        g = self.gravity
        rest = v * v - 2 * g * com_rise_at_touchdown_m
        if not rest >= 0:
            raise InputError(
                f"a CoM rise of {self.height_m:g} m cannot reach a touchdown "
                f"{com_rise_at_touchdown_m:.3f} m above take-off; the rise must be at least that"
            )
        return (v + math.sqrt(rest)) / g
