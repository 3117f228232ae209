"""What the motors are told, what they can give, and how late they give it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jumplab.robot import Robot

if TYPE_CHECKING:
    from jumplab.sim.world import World

POSITION_GAIN = 0.1  # [1] an error decays in 10 ms, ten control cycles; the torque limit decides the rest
VELOCITY_GAIN = 1.0  # [1] the wished rate is met within a cycle, as by the inner loop of a drive


class Actuators:
    """Torque limits of all joints at a given speed.

    Full torque up to the corner speed, then a line to zero at the speed limit; against the motion the full torque
    remains, as in any electric drive.
    """

    def __init__(self, robot: Robot):
        rows = [robot.actuators[name] for name in robot.joint_names]
        self.effort, self.speed, corner, self.lower, self.upper = (
            np.array([row[key] for row in rows]) for key in ("effort", "speed", "corner_speed", "lower", "upper")
        )
        self._slope = 1 / (self.speed - corner)

    def range(self, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest torque (nv - 6,) [N m] at the joint rates ``rate`` [rad/s]."""
        lower = -self.effort * np.clip((self.speed + rate) * self._slope, 0.0, 1.0)
        upper = self.effort * np.clip((self.speed - rate) * self._slope, 0.0, 1.0)
        return lower, upper

    def either_way(self, rate: np.ndarray) -> np.ndarray:
        """Torque (nv - 6,) [N m] that is available in both directions: the limit given to position servos."""
        return self.effort * np.clip((self.speed - np.abs(rate)) * self._slope, 0.0, 1.0)


@dataclass(frozen=True)
class Command:
    """What the motors are told for one step: a position servo's target, or a torque."""

    q: np.ndarray | None = None  # (nv - 6,) [rad]
    rate: np.ndarray | None = None  # (nv - 6,) [rad/s]
    tau: np.ndarray | None = None  # (nv - 6,) [N m]
    share: float = 1.0  # of the torque limit, for the servo


class Delay:
    """A line of ``steps`` commands between the controller and the motors; the first command fills it."""

    def __init__(self, steps: int):
        self._line: deque = deque(maxlen=steps + 1)

    def __call__(self, command: Command) -> Command:
        self._line.extend([command] * (1 if self._line else self._line.maxlen))
        return self._line[0]


class Motors:
    """Turns commands into torques within the limits; ``gain`` is joint -> torque delivered per torque commanded."""

    def __init__(self, robot: Robot, gain: dict[str, float]):
        self.actuators = Actuators(robot)
        self._gain = np.array([gain.get(name, 1.0) for name in robot.joint_names])
        self._servo = False

    def apply(self, world: World, command: Command, rate: np.ndarray) -> np.ndarray | None:
        """Give ``command`` to the engine at true joint rates ``rate``; returns the torque, None for a servo."""
        if command.tau is None:
            self._servo = True
            limit = command.share * self.actuators.either_way(rate) * np.minimum(self._gain, 1.0)
            world.command_position(command.q, command.rate, limit, POSITION_GAIN, VELOCITY_GAIN)
            return None
        if self._servo:
            world.release()
            self._servo = False
        tau = np.clip(self._gain * command.tau, *self.actuators.range(rate))
        world.command_torque(tau)
        return tau
