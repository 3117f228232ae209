"""Where the robot is and how it moves, from its own sensors: an error-state Kalman filter, inertial unit and legs.

The trunk is integrated from gyro and accelerometer. While a foot carries weight, the point it stands on does not move:
the legs' angles then tell where the trunk is, and through gravity also how it is tilted. That feet are part of the
state is an idea of Bloesch et al., "State estimation for legged robots" (2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, rotation, solved, turned
from jumplab.sim.perturbation import SensorNoise
from jumplab.task import GRAVITY


@dataclass(frozen=True)
class Reading:
    """One sample of all sensors; ``gyro`` and ``specific_force`` in the trunk's axes."""

    joints: np.ndarray  # (nv - 6,) encoders [rad]
    rates: np.ndarray  # (nv - 6,) [rad/s]
    gyro: np.ndarray  # (3,) angular velocity of the trunk [rad/s]
    specific_force: np.ndarray  # (3,) acceleration of the base's origin minus gravity, mean of the last step [m/s^2]
    foot_wrench: np.ndarray  # (2, 6) force and moment on each foot, world axes, at the origin of its link [N, N m]


class Sensors:
    """Readings of the true state, exact if every deviation in ``noise`` is zero.

    Biases are drawn once. Foot forces are those of the contact itself, as if the sensor's reading were corrected for
    the foot's own weight and inertia; the accelerometer has no end of its range.
    """

    def __init__(self, noise: SensorNoise, seed: int, gravity: float = GRAVITY):
        self.noise, self._rng = noise, np.random.default_rng([seed, 1])  # a stream of its own beside the robot's draw
        self._other = np.random.default_rng([seed, 3])
        self._gyro_bias = noise.gyro_bias * self._rng.standard_normal(3)
        self._accel_bias = noise.accel_bias * self._rng.standard_normal(3)
        self._last_velocity: np.ndarray | None = None
        self._gravity = np.array([0.0, 0.0, -gravity])

    def initial(self, q: np.ndarray) -> np.ndarray:
        """Configuration (nq,) as it is believed to be before the jump: roll and pitch a little off."""
        error = self.noise.tilt_rad * self._rng.standard_normal(2)
        return turned(q, pin.exp3(np.array([*error, 0.0])))

    def read(self, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> Reading:
        """Measure the true state (q, v) and the true wrenches (2, 6) under the feet; call it once per step."""
        n, draw = self.noise, self._rng.standard_normal
        attitude = rotation(q[3:7])
        velocity = attitude @ v[:3]
        gained = np.zeros(3) if self._last_velocity is None else velocity - self._last_velocity
        self._last_velocity = velocity
        force = attitude.T @ (gained / STEP_S - self._gravity)
        joints = q[7:] + n.joint_rad * draw(len(q) - 7)
        if n.encoder_step_rad:
            joints = n.encoder_step_rad * np.round(joints / n.encoder_step_rad)
        return Reading(
            joints,
            v[6:] + n.joint_rate * draw(len(v) - 6),
            v[3:6] + self._gyro_bias + n.gyro * draw(3),
            force + self._accel_bias + n.accel * draw(3),
            self._felt(wrench, draw(2)),
        )

    def _felt(self, wrench: np.ndarray, vertical: np.ndarray) -> np.ndarray:
        """Foot wrenches (2, 6) as measured; ``vertical`` (2,) is what is drawn for the forces up."""
        error = self._other.standard_normal((2, 6)) * np.repeat([1.0, LEVER_M], 3)
        error[:, 2] = vertical
        return wrench + self.noise.force * error


# The papers print none of these numbers.
LEVER_M = 0.05  # a moment of a foot's sensor is wrong by as much as a force at this distance
LOADED_N = 30.0  # a foot with less may be sliding off the ground ...
SURE = 6.0  # [1] ... or with less than so many standard deviations of a poor sensor
TIPPED_M = 0.003  # the foot stands on the lower end of its sole, once the other is higher by this much
FOOT_WALK = 0.01  # [m/s / sqrt(Hz)] a standing foot creeps 10 mm within a second
SETTLE_S, SETTLE_WALK = 0.02, 0.3  # for so long after it met the ground a foot is free to settle by centimetres
LEG_M = 0.7  # turns an encoder's error into one of the foot
FLOOR = SensorNoise(joint_rad=3e-4, gyro=1e-3, accel=0.05, gyro_bias=1e-5, accel_bias=1e-4, tilt_rad=1e-4)

# parts of the error: attitude (world axes), velocity, place, gyro bias, accelerometer bias, left foot, right foot
TURN, SPEED, PLACE, GYRO, ACCEL, *FEET = (slice(i, i + 3) for i in range(0, 21, 3))
SIZE = 21


class Estimator:
    """State of the full robot, from one :class:`Reading` per millisecond.

    Of ``robot``, as planned, only the geometry is used; it starts in ``q`` (nq,), ``v`` (nv,), known but for
    ``noise.tilt_rad``. ``noise`` is what the sensors are known to be worth.
    """

    def __init__(self, robot: Robot, q: np.ndarray, v: np.ndarray, noise: SensorNoise):
        self._gauge, foot, self._gravity = Gauge(robot), robot.foot, np.array([0.0, 0.0, -robot.gravity])
        self._ends = [np.array([x, foot.center[1], foot.sole_z]) for x in (foot.toe, foot.heel)]
        self._attitude = rotation(q[3:7])
        self._place, self._velocity = q[:3].copy(), self._attitude @ v[:3]
        self._gyro_bias, self._accel_bias = np.zeros(3), np.zeros(3)
        self._foot, self._end, self._standing = np.zeros((2, 3)), [0, 0], [0, 0]  # toe or heel; for how many steps
        self._noise = SensorNoise(**{name: max(getattr(noise, name), floor) for name, floor in vars(FLOOR).items()})
        n = self._noise
        self._loaded_n = max(LOADED_N, SURE * n.force)
        spread = np.repeat([n.tilt_rad, 1e-3, 1e-3, n.gyro_bias, n.accel_bias, 1e-3, 1e-3], 3)
        self._cov = np.diag(spread**2)
        self._step, self._drive = np.eye(SIZE), np.zeros(SIZE)

    def update(self, reading: Reading) -> tuple[np.ndarray, np.ndarray]:
        """Estimated configuration (nq,) and velocity (nv,) at the time of ``reading``."""
        rate = reading.gyro - self._gyro_bias
        self._predict(rate, reading.specific_force - self._accel_bias)
        points = self._sole_ends(reading.joints)
        for side in (0, 1):
            self._stand(side, points[side], reading.foot_wrench[side, 2] > self._loaded_n)
        quaternion = pin.Quaternion(self._attitude).coeffs()
        q = np.concatenate([self._place, quaternion, reading.joints])
        v = np.concatenate([self._attitude.T @ self._velocity, reading.gyro - self._gyro_bias, reading.rates])
        return q, v

    def _predict(self, rate: np.ndarray, force: np.ndarray) -> None:
        """One step of the inertial unit."""
        self._attitude = self._attitude @ pin.exp3(rate * STEP_S)
        push = self._attitude @ force
        self._velocity = self._velocity + (push + self._gravity) * STEP_S
        self._place = self._place + self._velocity * STEP_S
        step, n = self._step, self._noise
        step[SPEED, TURN] = -STEP_S * pin.skew(push)
        step[TURN, GYRO] = step[SPEED, ACCEL] = -STEP_S * self._attitude
        step[PLACE, SPEED] = STEP_S * np.eye(3)
        self._drive[TURN], self._drive[SPEED] = (n.gyro * STEP_S) ** 2, (n.accel * STEP_S) ** 2
        for side in (0, 1):
            walk = SETTLE_WALK if self._standing[side] * STEP_S < SETTLE_S else FOOT_WALK
            self._drive[FEET[side]] = walk**2 * STEP_S
        self._cov = step @ self._cov @ step.T
        self._cov[np.diag_indices(SIZE)] += self._drive

    def _sole_ends(self, joints: np.ndarray) -> np.ndarray:
        """Toe and heel (2, 2, 3) of both feet in the trunk's frame."""
        q = np.concatenate([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], joints])
        data = self._gauge.data
        pin.framesForwardKinematics(self._gauge.model, data, q)
        return np.array([[data.oMf[frame].act(end) for end in self._ends] for frame in self._gauge.frames])

    def _stand(self, side: int, ends: np.ndarray, loaded: bool) -> None:
        """Let a loaded foot correct the estimate; a foot that has just met the ground stands where it is."""
        if not loaded:
            self._standing[side] = 0
            return
        arms = ends @ self._attitude.T  # (2, 3) world axes, from the trunk
        end, lower = self._end[side], int(arms[1, 2] < arms[0, 2])
        tipped = lower != end and abs(arms[1, 2] - arms[0, 2]) > TIPPED_M
        if self._standing[side] == 0 or tipped:
            self._end[side] = end = lower
            self._plant(side, arms[end])
        self._standing[side] += 1
        self._correct(side, arms[end])

    def _plant(self, side: int, arm: np.ndarray) -> None:
        """The foot stands at the trunk's place plus ``arm``, and is as uncertain as that."""
        self._foot[side] = self._place + arm
        here, sense = FEET[side], np.zeros((3, SIZE))
        sense[:, PLACE], sense[:, TURN] = np.eye(3), -pin.skew(arm)
        self._cov[here, :] = sense @ self._cov
        self._cov[:, here] = self._cov[here, :].T
        self._cov[here, here] = sense @ self._cov @ sense.T + (self._noise.joint_rad * LEG_M) ** 2 * np.eye(3)

    def _correct(self, side: int, arm: np.ndarray) -> None:
        """The foot has not moved: what the leg says against where it should be."""
        sense = np.zeros((3, SIZE))
        sense[:, TURN], sense[:, PLACE], sense[:, FEET[side]] = pin.skew(arm), -np.eye(3), np.eye(3)
        missed = arm - (self._foot[side] - self._place)
        seen = self._cov @ sense.T  # (SIZE, 3)
        gain = solved(sense @ seen + (self._noise.joint_rad * LEG_M) ** 2 * np.eye(3), seen.T).T
        error = gain @ missed
        self._cov -= gain @ seen.T
        self._cov = (self._cov + self._cov.T) / 2
        self._attitude = pin.exp3(error[TURN]) @ self._attitude
        self._velocity, self._place = self._velocity + error[SPEED], self._place + error[PLACE]
        self._gyro_bias, self._accel_bias = self._gyro_bias + error[GYRO], self._accel_bias + error[ACCEL]
        self._foot += error[FEET[0].start :].reshape(2, 3)


class Perception:
    """What the controllers are told: the truth if no sensor errs, otherwise the estimate, see :class:`Estimator`."""

    def __init__(self, robot: Robot, q: np.ndarray, v: np.ndarray, noise: SensorNoise, seed: int):
        self._sensors, self._tilt, self._speed = Sensors(noise, seed, robot.gravity), 0.0, 0.0
        exact = noise == SensorNoise()  # then the true state stands for its estimate
        self._estimator = None if exact else Estimator(robot, self._sensors.initial(q), v, noise)

    def __call__(self, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Configuration (nq,), velocity (nv,) and foot wrenches (2, 6) as far as the robot knows them."""
        if self._estimator is None:
            return q, v, wrench
        reading = self._sensors.read(q, v, wrench)
        believed_q, believed_v = self._estimator.update(reading)
        tilt, speed = estimation_error(q, v, believed_q, believed_v)
        self._tilt, self._speed = max(self._tilt, tilt), max(self._speed, speed)
        return believed_q, believed_v, reading.foot_wrench

    def to_json(self) -> dict:
        """What the settings of a result say."""
        if self._estimator is None:
            return {"state": "true"}
        return {"state": "estimated", "worst_tilt_error_rad": self._tilt, "worst_velocity_error": self._speed}


def estimation_error(
    q: np.ndarray, v: np.ndarray, believed_q: np.ndarray, believed_v: np.ndarray
) -> tuple[float, float]:
    """Error of roll and pitch together [rad], and of the base's velocity in the world [m/s]."""
    true, believed = (rotation(x[3:7]) for x in (q, believed_q))
    tilt = np.arccos(np.clip(true[2] @ believed[2], -1.0, 1.0))  # between the two ideas of up, in the trunk's axes
    return float(tilt), float(np.linalg.norm(believed @ believed_v[:3] - true @ v[:3]))
