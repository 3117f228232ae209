"""The crouch in which a chained robot lands, waits and begins its next jump, and what is measured of it."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.pipeline import to_link_angles
from jumplab.robot import Robot
from jumplab.robot.stance import check_stance
from jumplab.task import GRAVITY

# our choice: half-way between the stance and the bottom of a landing; a jump from there needs 0.70 s instead of 0.86 s,
# and the robot is in it sooner after touchdown
CROUCH = {"knee_rad": 1.0, "trunk_pitch_rad": 0.2}


def crouched(robot: Robot) -> Robot:
    """The robot whose standing posture is a crouch; itself if its joints do not allow that one.

    Planners begin there, landings end there, and the standing controller holds it: all of them ask the robot.
    """
    text = robot.config_text
    for key, value in CROUCH.items():
        text, found = re.subn(rf"(?m)^(\s*{key}\s*=\s*)[-+.\deE]+", rf"\g<1>{value}", text, count=1)
        if not found:
            return robot
    other = Robot.from_text(robot.urdf, text)
    try:
        check_stance(other)
    except RobotError:
        return robot
    return other


class Gauge:
    """Reads from a state of the full robot what a plan needs: where the toes are, and the sagittal posture."""

    def __init__(self, robot: Robot):
        self.robot, self._data = robot, robot.model.createData()
        self._frames = [robot.model.getFrameId(name) for name in robot.foot.frames]  # names checked by Robot
        self._toe = np.array([robot.foot.toe, 0.0, robot.foot.sole_z])

    def toe(self, q: np.ndarray) -> np.ndarray:
        """Middle between the toes (3,) [m]."""
        pin.framesForwardKinematics(self.robot.model, self._data, q)
        return np.mean([self._data.oMf[f].act(self._toe) for f in self._frames], axis=0)

    def heading(self, q: np.ndarray) -> float:
        """Yaw of the feet, mean of both [rad]."""
        pin.framesForwardKinematics(self.robot.model, self._data, q)
        return float(np.mean([np.arctan2(*self._data.oMf[f].rotation[[1, 0], 0]) for f in self._frames]))

    def posture(self, q: np.ndarray) -> np.ndarray:
        """Absolute link angles (5,) with the feet taken as flat, mean of left and right [rad]."""
        zero = np.zeros((1, self.robot.model.nv))
        angles = to_link_angles(self.robot, q[None], zero, zero)[0][0]
        angles[0] = 0.0
        return angles

    def com(self, q: np.ndarray) -> np.ndarray:
        """CoM (3,) [m]."""
        return pin.centerOfMass(self.robot.model, self._data, q, False).copy()

    def com_velocity(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Velocity of the CoM (3,) [m/s]."""
        pin.centerOfMass(self.robot.model, self._data, q, v, False)
        return self._data.vcom[0].copy()

    def com_ahead(self, q: np.ndarray, v: np.ndarray, left_s: float) -> np.ndarray:
        """CoM (3,) in ``left_s`` of free flight [m]."""
        speed = self.com_velocity(q, v)
        return self.com(q) + speed * left_s - np.array([0.0, 0.0, GRAVITY * left_s**2 / 2])
