"""What the controllers are told: the truth, plus noise if asked for."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.simulation.perturbation import SensorNoise


class Sensors:
    """Measured state and foot forces with white noise; exact if every deviation in ``noise`` is zero.

    Foot forces are ideal: the contact forces themselves, as if the sensor's reading were corrected for the foot's own
    weight and inertia.
    """

    def __init__(self, noise: SensorNoise, seed: int):
        self._noise, self._rng = noise, np.random.default_rng([seed, 1])  # a stream of its own beside the robot's draw
        self._exact = noise == SensorNoise()

    def state(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measured configuration (nq,) and velocity (nv,) for the true ones."""
        if self._exact:
            return q, v
        n, joints = self._noise, len(q) - 7
        draw = self._rng.standard_normal(9 + 2 * joints)
        turn = pin.Quaternion(pin.exp3(n.tilt_rad * draw[:3]))
        attitude = pin.Quaternion(q[6], q[3], q[4], q[5]) * turn
        q, v = q.copy(), v.copy()
        q[3:7] = attitude.coeffs()
        q[7:] += n.joint_rad * draw[9 : 9 + joints]
        v[:3] += n.velocity * draw[3:6]
        v[3:6] += n.gyro * draw[6:9]
        v[6:] += n.joint_rate * draw[9 + joints :]
        return q, v

    def vertical_forces(self, wrench: np.ndarray) -> np.ndarray:
        """Measured vertical force (2,) under each foot [N] for the true wrenches (2, 6)."""
        force = wrench[:, 2]
        return force if self._exact else force + self._noise.force * self._rng.standard_normal(2)
