"""Torque that the joints' motors can give at a speed, their losses, and what all may draw."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

# [rad/s] from about here on dry friction is there in full: a step would have no slope to plan with
SLIDING_RATE = 0.1


def read_only(values: Any) -> np.ndarray:
    """A copy as an array that refuses to be written to."""
    array = np.array(values)
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class MotorLimits:
    """Ranges and motors of joints as columns (n,), one row a joint.

    A motor gives its effort up to the corner speed, then less along a line that ends at the no-load
    speed; against the motion it always gives its effort, as any electric drive does.
    """

    lower: np.ndarray  # [rad]
    upper: np.ndarray  # [rad]
    speed: np.ndarray  # [rad/s]
    effort: np.ndarray  # [N m]
    corner_speed: np.ndarray  # [rad/s]
    no_load_speed: np.ndarray  # [rad/s]
    armature: np.ndarray  # [kg m^2]
    friction: np.ndarray  # [N m] dry
    damping: np.ndarray  # [N m s/rad]

    def __post_init__(self) -> None:
        for f in fields(MotorLimits):  # once: from here on the dataclass is frozen
            object.__setattr__(self, f.name, read_only(getattr(self, f.name)))

    def __getitem__(self, rows: list[int] | np.ndarray) -> MotorLimits:
        """Those of some joints."""
        return MotorLimits(*(getattr(self, f.name)[rows] for f in fields(MotorLimits)))

    @cached_property
    def slope(self) -> np.ndarray:
        """Torque lost per speed (n,) beyond the corner speed [N m s/rad]: a motor that drives gives
        at most slope (no_load_speed - rate).
        """
        return read_only(self.effort / (self.no_load_speed - self.corner_speed))

    def range(self, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest torque (..., n) [N m] at joint rates (..., n) [rad/s]."""
        # np.clip takes three times as long
        slope = self.slope
        least = np.minimum(np.maximum(slope * (self.no_load_speed + rates), 0.0), self.effort)
        most = np.minimum(np.maximum(slope * (self.no_load_speed - rates), 0.0), self.effort)
        return -least, most

    @cached_property
    def lossy(self) -> bool:
        """Whether the friction of any motor is known."""
        return bool(self.friction.any() or self.damping.any())

    def lost(self, rates: np.ndarray) -> np.ndarray:
        """Torque (..., n) [N m] that motors lose to their own friction at joint rates (..., n), in
        the sense of the rate: friction tanh(rate / :data:`SLIDING_RATE`) + damping rate.
        """
        return self.friction * np.tanh(np.asarray(rates) / SLIDING_RATE) + self.damping * rates


@dataclass(frozen=True)
class Bus:
    """Electrical limits of all joints' motors together, as far as a robot's table [bus] gives them.

    Attributes
    ----------
    power_w : that they may draw at once [W]; inf where none is given.
    regeneration : share [1] of what braking joints give that the others can use.
    losses : (n,) of the windings [W/(N m)^2].
    rms : (n,) root mean square of the torque over a motion that a winding stands [N m], or inf.
    """

    power_w: float
    regeneration: float
    losses: np.ndarray
    rms: np.ndarray

    def drawn(self, tau: Any, rates: Any, xp: Any = np, smooth_w: float = 0.0) -> Any:
        """Power of each joint (..., n) [W] at torques ``tau`` and ``rates`` (..., n), with the
        module ``xp`` that has their sqrt; its kink rounded over ``smooth_w``.
        """
        shaft = tau * rates
        braked = (xp.sqrt(shaft**2 + smooth_w**2) - shaft) / 2
        return shaft + (1 - self.regeneration) * braked + self.losses * tau**2
