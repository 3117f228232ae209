"""Sensors of the robot, with their errors, and the controllers' view of its state."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.control.estimator import Estimator, Reading, SensorNoise
from jumplab.control.kinematics import State, rotation, rotations, turned
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.task import GRAVITY

LEVER_M = 0.05  # a moment of a foot's sensor is wrong by as much as a force at this distance
LEVERS = np.repeat([1.0, LEVER_M], 3)


class Sensors:
    """Readings of the true state, exact if every deviation in ``noise`` is zero.

    Biases are drawn once. Foot forces are those of the contact itself, as if the sensor's reading
    were corrected for the foot's own weight and inertia; the accelerometer has no end of its range.
    """

    def __init__(self, noise: SensorNoise, seed: int, gravity: float = GRAVITY):
        # a stream of its own beside the robot's draw
        self.noise = noise
        self._rng = np.random.default_rng([seed, 1])
        self._other = np.random.default_rng([seed, 3])
        self._gyro_bias = noise.gyro_bias * self._rng.standard_normal(3)
        self._accel_bias = noise.accel_bias * self._rng.standard_normal(3)
        self._last_velocity: np.ndarray | None = None
        self._gravity = np.array([0.0, 0.0, -gravity])

    def initial(self, q: np.ndarray) -> np.ndarray:
        """Configuration (nq,) as it is believed to be before the jump: a little tilted."""
        error = self.noise.tilt_rad * self._rng.standard_normal(2)
        return turned(q, pin.exp3(np.array([*error, 0.0])))

    def read(self, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> Reading:
        """Measure the true state (q, v) and the true wrenches (2, 6) under the feet; call it once
        per step.
        """
        n = self.noise
        joints = len(v) - 6
        # in this order: angles, rates, gyro, accelerometer, forces
        errors = self._rng.standard_normal(2 * joints + 8)
        attitude = rotation(q[3:7])
        velocity = attitude @ v[:3]
        gained = np.zeros(3) if self._last_velocity is None else velocity - self._last_velocity
        self._last_velocity = velocity
        force = attitude.T @ (gained / STEP_S - self._gravity)
        angles = q[7:] + n.joint_rad * errors[:joints]
        if n.encoder_step_rad:
            angles = n.encoder_step_rad * np.round(angles / n.encoder_step_rad)
        # in standard deviations of a force
        felt = self._other.standard_normal((2, 6)) * LEVERS
        felt[:, 2] = errors[-2:]
        return Reading(
            angles,
            v[6:] + n.joint_rate * errors[joints:-8],
            v[3:6] + self._gyro_bias + n.gyro * errors[-8:-5],
            force + self._accel_bias + n.accel * errors[-5:-2],
            wrench + n.force * felt,
        )


class Perception:
    """State as the controllers see it: the true one if no sensor errs, otherwise the estimate, see
    :class:`Estimator`.
    """

    def __init__(self, robot: Robot, q: np.ndarray, v: np.ndarray, noise: SensorNoise, seed: int):
        self._sensors = Sensors(noise, seed, robot.gravity)
        self._errors: list[tuple[np.ndarray, ...]] = []  # true and believed states
        exact = noise == SensorNoise()  # then the true state stands for its estimate
        self._estimator = None if exact else Estimator(robot, self._sensors.initial(q), v, noise)

    def __call__(self, state: State) -> State:
        """The true ``state`` as far as the robot knows it."""
        if self._estimator is None:
            return state
        reading = self._sensors.read(*state[:2], state.wrench)
        q, v = self._estimator.update(reading)
        self._errors.append((*state[:2], q, v))
        return State(q, v, reading.foot_wrench)

    def to_json(self) -> dict:
        """Kind of the state and its worst errors, for the settings of a result."""
        if self._estimator is None:
            return {"state": "true"}
        states = map(np.array, zip(*self._errors, strict=True))
        tilt, speed = (float(x.max()) for x in estimation_error(*states))
        return {"state": "estimated", "worst_tilt_error_rad": tilt, "worst_velocity_error": speed}


def estimation_error(
    q: np.ndarray, v: np.ndarray, believed_q: np.ndarray, believed_v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (...) of roll and pitch together [rad], and of the base's velocity in the world [m/s],
    in states (..., nq) and (..., nv).
    """
    true, believed = (rotations(x[..., 3:7]) for x in (q, believed_q))
    # between the two ideas of up, in the trunk's axes
    level = (true[..., 2, :] * believed[..., 2, :]).sum(axis=-1)
    moved = believed @ believed_v[..., :3, None] - true @ v[..., :3, None]
    return np.arccos(np.clip(level, -1.0, 1.0)), np.linalg.norm(moved[..., 0], axis=-1)
