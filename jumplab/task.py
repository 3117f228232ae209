"""Target of a jump, and ballistic consequences of it alone (Sec. III of the paper)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from jumplab.arguments import checked, real
from jumplab.errors import InputError, Shown, quoted

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
FEET = ("left", "right", "both")
MOST_STEPS = 30  # steps or jumps in a row; a program of more is too large to solve


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
    takeoff, landing : the feet that leave last and come down first, "left", "right" or "both"; on
        one foot, the other one follows. To the side they may then be 5 cm off.
    run_up : steps before take-off, from the stand. Then, as with one foot, ``distance_m`` counts
        from where the feet leave: it is what the last flight covers.
    """

    distance_m: float
    height_m: float
    platform_m: float = 0.0
    rotation_rad: float = 0.0
    gravity: float = GRAVITY
    side_m: float = 0.0
    yaw_rad: float = 0.0
    takeoff: str = "both"
    landing: str = "both"
    run_up: int = 0

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
        self._check_feet()

    def _check_feet(self) -> None:
        """Refuse feet and steps that cannot be."""
        for name in ("takeoff", "landing"):
            word = getattr(self, name)
            if not isinstance(word, str) or word not in FEET:
                raise InputError(f"{name} = {quoted(word)}: choose one of {', '.join(FEET)}")
        steps = real(self.run_up, "run_up")
        if not (0 <= steps <= MOST_STEPS and steps.is_integer()):
            raise InputError(
                f"run_up = {quoted(self.run_up)} must be a whole number of steps, 0 to {MOST_STEPS}"
            )
        object.__setattr__(self, "run_up", int(steps))
        if self.standing:
            return
        if self.rotation_rad or self.yaw_rad:
            turn = "rotation" if self.rotation_rad else "yaw"
            raise InputError(
                f"{turn}: only a jump from a stand, off both feet and onto both, turns; leave out "
                f"takeoff, landing and run_up, or the {turn}"
            )
        if self.run_up and self.distance_m < 0:
            raise InputError(
                f"run_up = {self.run_up} with a distance of {self.distance_m:g} m: a run-up goes "
                f"ahead, so the distance must be 0 or more"
            )

    @property
    def standing(self) -> bool:
        """Whether the jump is from a stand, off both feet and onto both."""
        return self.takeoff == self.landing == "both" and not self.run_up

    @property
    def numbers(self) -> dict[str, Any]:
        """Its fields by name, as files and keys of studies have them: of a jump from a stand
        without feet and steps.
        """
        left_out = ("takeoff", "landing", "run_up") if self.standing else ()
        names = (f.name for f in fields(self) if f.name not in left_out)
        return {name: getattr(self, name) for name in names}

    @classmethod
    @checked
    def of(cls, data: Mapping[str, Any]) -> Self:
        """The target in plain ``data`` (its fields by name, SI), as summaries of plans have it;
        numbers of other versions are left out.

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
        straight ahead or back, and behind steps or a take-off from one foot.
        """
        aside = self.side_m and self.standing
        return math.atan2(self.side_m, self.distance_m) if aside else 0.0

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
