"""What the robot can measure: encoders, an inertial unit in the trunk, vertical forces under the feet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.simulation.perturbation import SensorNoise
from jumplab.simulation.world import STEP_S
from jumplab.task import GRAVITY

GRAVITY_VECTOR = np.array([0.0, 0.0, -GRAVITY])


@dataclass(frozen=True)
class Reading:
    """One sample of all sensors.

    Attributes
    ----------
    joints, rates : (nv - 6,) encoders [rad, rad/s].
    gyro : (3,) angular velocity of the trunk in its own axes [rad/s].
    specific_force : (3,) mean over the last step of acceleration minus gravity at the base frame's origin, in the
        trunk's axes [m/s^2].
    foot_force : (2,) vertical force under each foot [N].
    """

    joints: np.ndarray
    rates: np.ndarray
    gyro: np.ndarray
    specific_force: np.ndarray
    foot_force: np.ndarray


class Sensors:
    """Readings of the true state; exact if every deviation in ``noise`` is zero.

    Biases are drawn once. Foot forces are those of the contact itself, as if the sensor's reading were corrected for
    the foot's own weight and inertia; the accelerometer has no end of its range.
    """

    def __init__(self, noise: SensorNoise, seed: int):
        self.noise, self._rng = noise, np.random.default_rng([seed, 1])  # a stream of its own beside the robot's draw
        self._gyro_bias = noise.gyro_bias * self._rng.standard_normal(3)
        self._accel_bias = noise.accel_bias * self._rng.standard_normal(3)
        self._last_velocity: np.ndarray | None = None

    @property
    def exact(self) -> bool:
        """True if nothing is noisy, and the true state may stand for its estimate."""
        return self.noise == SensorNoise()

    def initial(self, q: np.ndarray) -> np.ndarray:
        """Configuration (nq,) as it is believed to be before the jump: roll and pitch a little off."""
        error = self.noise.tilt_rad * self._rng.standard_normal(2)
        turn = pin.Quaternion(pin.exp3(np.array([*error, 0.0])))
        start = q.copy()
        start[3:7] = (turn * pin.Quaternion(q[6], q[3], q[4], q[5])).coeffs()
        return start

    def read(self, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> Reading:
        """Measure the true state (q, v) and the true wrenches (2, 6) under the feet; call it once per step."""
        n, draw = self.noise, self._rng.standard_normal
        attitude = pin.Quaternion(q[6], q[3], q[4], q[5]).toRotationMatrix()
        velocity = attitude @ v[:3]
        gained = np.zeros(3) if self._last_velocity is None else velocity - self._last_velocity
        self._last_velocity = velocity
        force = attitude.T @ (gained / STEP_S - GRAVITY_VECTOR)
        joints = q[7:] + n.joint_rad * draw(len(q) - 7)
        if n.encoder_step_rad:
            joints = n.encoder_step_rad * np.round(joints / n.encoder_step_rad)
        return Reading(
            joints,
            v[6:] + n.joint_rate * draw(len(v) - 6),
            v[3:6] + self._gyro_bias + n.gyro * draw(3),
            force + self._accel_bias + n.accel * draw(3),
            wrench[:, 2] + n.force * draw(2),
        )
