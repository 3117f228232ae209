"""Estimate of the robot's place and motion from its own sensors, inertial unit and legs: an
error-state Kalman filter.

The trunk is integrated from gyro and accelerometer. While a foot carries weight, the point it
stands on does not move: the legs' angles then give the place of the trunk, and through gravity also
its tilt. That feet are part of the state is an idea of Bloesch et al., "State estimation for legged
robots" (2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dposv

from jumplab.control import STEP_S
from jumplab.control.kinematics import LEVEL, Gauge, rotation
from jumplab.robot import Robot
from jumplab.robot.legs import size


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of what is wrong with the sensors; zero means exact.

    White noise is that of one sample at 1 kHz; biases and the error of the first attitude are drawn
    once per run.
    """

    joint_rad: float = 0.0  # [rad] white
    joint_rate: float = 0.0  # [rad/s] white
    encoder_step_rad: float = 0.0  # [rad] quantisation of the joint angles
    tilt_rad: float = 0.0  # [rad] roll and pitch as they are believed to be before the jump
    gyro: float = 0.0  # [rad/s] white
    gyro_bias: float = 0.0  # [rad/s]
    accel: float = 0.0  # [m/s^2] white
    accel_bias: float = 0.0  # [m/s^2]
    force: float = 0.0  # [N] white, each foot

    @classmethod
    def typical(cls) -> SensorNoise:
        """16-bit encoders on gears with some play; a mid-range inertial unit, zeroed at rest."""
        return cls(
            5e-4,
            0.05,
            1e-4,
            tilt_rad=5e-3,
            gyro=0.02,
            gyro_bias=1e-3,
            accel=0.2,
            accel_bias=0.05,
            force=3.0,
        )

    def times(self, factor: float) -> SensorNoise:
        """Sensors that are so much worse."""
        return SensorNoise(**{name: factor * value for name, value in vars(self).items()})

    def __str__(self) -> str:
        if self == SensorNoise():
            return "the true state and foot forces"
        return (
            f"joint angles (±{1000 * self.joint_rad:g} mrad in steps of "
            f"{1000 * self.encoder_step_rad:g}) and rates (±{self.joint_rate:g} rad/s), "
            f"gyro (±{self.gyro:g}, bias ±{self.gyro_bias:g} rad/s), "
            f"accelerometer (±{self.accel:g}, bias ±{self.accel_bias:g} m/s^2), "
            f"foot forces (±{self.force:g} N), "
            f"tilt before the jump (±{1000 * self.tilt_rad:g} mrad)"
        )


@dataclass(frozen=True)
class Reading:
    """One sample of all sensors; ``gyro`` and ``specific_force`` in the trunk's axes."""

    joints: np.ndarray  # (nv - 6,) encoders [rad]
    rates: np.ndarray  # (nv - 6,) [rad/s]
    gyro: np.ndarray  # (3,) angular velocity of the trunk [rad/s]
    # (3,) acceleration of the base's origin minus gravity, mean of the last step [m/s^2]
    specific_force: np.ndarray
    # (2, 6) force and moment on each foot, world axes, at the origin of its link [N, N m]
    foot_wrench: np.ndarray


# The papers print none of these numbers.
LOADED_N = 30.0  # a foot with less may be sliding off the ground ...
SURE = 6.0  # [1] ... or with less than so many standard deviations of a poor sensor
# the foot stands on the lower end of its sole, once the other is higher by this much
TIPPED_M = 0.003
FOOT_WALK = 0.01  # [m/s / sqrt(Hz)] a standing foot creeps 10 mm within a second
# for so long after it met the ground a foot is free to settle by centimetres
SETTLE_S = 0.02
SETTLE_WALK = 0.3
LEG_M = 0.7  # turns an encoder's error into one of the foot
FLOOR = SensorNoise(
    joint_rad=3e-4, gyro=1e-3, accel=0.05, gyro_bias=1e-5, accel_bias=1e-4, tilt_rad=1e-4
)

# parts of the error: attitude (world axes), velocity, place, gyro bias, accelerometer bias, left
# foot, right foot
TURN, SPEED, PLACE, GYRO, ACCEL, *FEET = (slice(i, i + 3) for i in range(0, 21, 3))
SIZE = 21
UNIT = np.eye(3)


class Estimator:
    """State of the full robot, from one :class:`Reading` per millisecond.

    Of ``robot``, as planned, only the geometry is used; it starts in ``q`` (nq,), ``v`` (nv,),
    known but for ``noise.tilt_rad``. ``noise`` is what the sensors are known to be worth.
    """

    def __init__(self, robot: Robot, q: np.ndarray, v: np.ndarray, noise: SensorNoise):
        self._gauge = Gauge(robot)
        foot = robot.foot
        self._gravity = np.array([0.0, 0.0, -robot.gravity])
        self._ends = [np.array([x, foot.center[1], foot.sole_z]) for x in (foot.toe, foot.heel)]
        self._attitude = rotation(q[3:7])
        self._x = np.zeros(SIZE)  # all but the attitude
        self._x[PLACE] = q[:3]
        self._x[SPEED] = self._attitude @ v[:3]
        # of both feet: toe or heel; for how many steps
        self._end = [0, 0]
        self._standing = [0, 0]
        floors = vars(FLOOR)
        n = SensorNoise(**{name: max(x, floors[name]) for name, x in vars(noise).items()})
        large = size(robot)
        self._tipped_m = large.of(TIPPED_M, "m")
        self._settle_s = large.of(SETTLE_S, "s")
        self._leg = (n.joint_rad * large.of(LEG_M, "m")) ** 2 * UNIT  # variance of a foot's place
        self._loaded_n = max(large.of(LOADED_N, "N"), SURE * n.force)
        spread = np.repeat([n.tilt_rad, 1e-3, 1e-3, n.gyro_bias, n.accel_bias, 1e-3, 1e-3], 3)
        self._cov = np.diag(spread**2)
        # how errors grow within a step; what does not change from step to step
        self._step = np.eye(SIZE)
        self._step[PLACE, SPEED] = STEP_S * UNIT
        self._drive = np.zeros(SIZE)
        self._drive[TURN] = (n.gyro * STEP_S) ** 2
        self._drive[SPEED] = (n.accel * STEP_S) ** 2
        # how each foot's place off the leg's is felt; of the tilt, it depends on the arm
        self._senses = np.zeros((2, 3, SIZE))
        self._senses[:, :, PLACE] = -UNIT
        for sense, foot in zip(self._senses, FEET, strict=True):
            sense[:, foot] = UNIT

    def update(self, reading: Reading) -> tuple[np.ndarray, np.ndarray]:
        """Estimated configuration (nq,) and velocity (nv,) at the time of ``reading``."""
        x = self._x
        self._predict(reading.gyro - x[GYRO], reading.specific_force - x[ACCEL])
        points = self._sole_ends(reading.joints)
        for side in (0, 1):
            self._stand(side, points[side], reading.foot_wrench[side, 2] > self._loaded_n)
        quaternion = pin.Quaternion(self._attitude).coeffs()
        speed = self._attitude.T @ x[SPEED]
        q = np.concatenate([x[PLACE], quaternion, reading.joints])
        return q, np.concatenate([speed, reading.gyro - x[GYRO], reading.rates])

    def _predict(self, rate: np.ndarray, force: np.ndarray) -> None:
        """One step of the inertial unit."""
        self._attitude = self._attitude @ pin.exp3(rate * STEP_S)
        push = self._attitude @ force
        self._x[SPEED] += (push + self._gravity) * STEP_S
        self._x[PLACE] += self._x[SPEED] * STEP_S
        step = self._step
        step[SPEED, TURN] = -STEP_S * pin.skew(push)
        step[TURN, GYRO] = step[SPEED, ACCEL] = -STEP_S * self._attitude
        drive = self._drive
        for foot, steps in zip(FEET, self._standing, strict=True):
            walk = SETTLE_WALK if steps * STEP_S < self._settle_s else FOOT_WALK
            drive[foot] = walk**2 * STEP_S
        self._cov = step @ self._cov @ step.T
        self._cov.flat[:: SIZE + 1] += drive

    def _sole_ends(self, joints: np.ndarray) -> np.ndarray:
        """Toe and heel (2, 2, 3) of both feet in the trunk's frame."""
        feet = self._gauge.places(np.concatenate([LEVEL, joints]))
        return np.array([[foot.act(end) for end in self._ends] for foot in feet])

    def _stand(self, side: int, ends: np.ndarray, loaded: bool) -> None:
        """Let a loaded foot correct the estimate; a foot that has just met the ground stands where
        it is.
        """
        if not loaded:
            self._standing[side] = 0
            return
        arms = ends @ self._attitude.T  # (2, 3) world axes, from the trunk
        end = self._end[side]
        lower = int(arms[1, 2] < arms[0, 2])
        tipped = lower != end and abs(arms[1, 2] - arms[0, 2]) > self._tipped_m
        if self._standing[side] == 0 or tipped:
            self._end[side] = end = lower
            self._plant(side, arms[end])
        self._standing[side] += 1
        self._correct(side, arms[end])

    def _plant(self, side: int, arm: np.ndarray) -> None:
        """The foot stands at the trunk's place plus ``arm``, and is as uncertain as that."""
        here = FEET[side]
        self._x[here] = self._x[PLACE] + arm
        sense = np.zeros((3, SIZE))
        sense[:, PLACE] = UNIT
        sense[:, TURN] = -pin.skew(arm)
        self._cov[here, :] = sense @ self._cov
        self._cov[:, here] = self._cov[here, :].T
        self._cov[here, here] = sense @ self._cov @ sense.T + self._leg

    def _correct(self, side: int, arm: np.ndarray) -> None:
        """The foot has not moved: what the leg says against where it should be."""
        sense = self._senses[side]
        sense[:, TURN] = pin.skew(arm)
        missed = arm - (self._x[FEET[side]] - self._x[PLACE])
        seen = self._cov @ sense.T  # (SIZE, 3)
        # of a symmetric positive matrix; np.linalg.solve takes three times as long
        gain = dposv(sense @ seen + self._leg, seen.T)[1].T
        error = gain @ missed
        self._cov -= gain @ seen.T
        self._cov = (self._cov + self._cov.T) / 2
        self._attitude = pin.exp3(error[TURN]) @ self._attitude
        self._x += error
