"""What the motors can give, and how late they give it."""

from __future__ import annotations

from collections import deque

import numpy as np

from jumplab.robot import Robot


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


class Delay:
    """A line of ``steps`` commands between the controller and the motors; the first command fills it."""

    def __init__(self, steps: int):
        self._line: deque = deque(maxlen=steps + 1)

    def __call__(self, command):
        if not self._line:
            self._line.extend([command] * self._line.maxlen)
        else:
            self._line.append(command)
        return self._line[0]
