"""Motors: each delivers a commanded torque as well as it can."""

from __future__ import annotations

import numpy as np

from jumplab.robot import Robot

LEAST_VOLTAGE = 0.5  # share that a battery holds, whatever is drawn


class Motors:
    """Turns commanded into delivered torques; ``gain`` is joint -> torque delivered per torque
    commanded.

    A battery sags by ``sag_per_kw``: speed limits and corner speeds fall by that share per power
    [kW] that all joints drew in the step before; what brakes gives nothing back.
    """

    def __init__(self, robot: Robot, gain: dict[str, float], sag_per_kw: float = 0.0):
        self._limits = robot.limits
        self._sag_per_w = sag_per_kw / 1e3
        self._drawn_w = 0.0
        self._gain = np.array([gain.get(name, 1.0) for name in robot.joint_names])

    def deliver(self, tau: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Torque that is delivered for the commanded ``tau`` (nv - 6,) [N m] at true joint rates
        ``rate``.
        """
        left = max(1 - self._sag_per_w * self._drawn_w, LEAST_VOLTAGE)
        low, high = self._limits.range(rate / left)
        given = np.minimum(np.maximum(self._gain * tau, low), high)
        if self._sag_per_w:
            self._drawn_w = float(np.maximum(given * rate, 0.0).sum())
        return given
