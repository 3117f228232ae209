"""Optional in-flight correction: legs aimed at the ground whatever the trunk does. Off for the paper's claim."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.simulation.scene import Scene
from jumplab.simulation.world import STEP_S
from jumplab.task import GRAVITY
from jumplab.trajectory import Tape

START_HEIGHT_M = 0.30  # our choice: soles this far above the ground; earlier, the correction fights the swing itself
RATE = 12.0  # [rad/s] our choice: 0.8 rad within the last 0.2 m at 3 m/s, two thirds of the speed limit of the hip
# our choice: in a flip the legs open at their speed limits and the touchdown is forecast, so the correction comes with
# the opening and not after it: it begins this long before the ground is due, gently enough for hips at their limit
FLIP_START_S, FLIP_RATE = 0.12, 4.0  # [s], [rad/s]
LARGEST_RAD = 0.8  # our choice: beyond 45 degrees the planned landing posture is lost anyway
FASTEST_FALL = 1.0  # [m/s] our choice: below it the foothold says little about the moment
NEWTON_STEPS = 2  # two equations, nearly linear
HIP_ANKLE = (0, 2)  # rows of jumplab.robot.SAGITTAL_JOINTS
PROBE_RAD = 1e-4  # of the finite differences


class Reaim:
    """Turns hips and ankles so that the soles meet the ground flat, and where they can catch the robot.

    That is where the angular momentum about the soles' middle, L + m (z v_x + ahead v_z), is the planned one: an impact
    under the soles does not change it, and what is left of it afterwards tips the robot over. A rule that knows the
    forward speed alone puts the feet of a robot that is also pitched, low or turning too far ahead.

    The posture at touchdown is predicted as the tape's last one, with the trunk as far off its planned pitch as it is
    now. Without any error the correction is zero.
    """

    def __init__(self, robot: Robot, tape: Tape, scene: Scene):
        self._model, self._data, self._foot = robot.model, robot.model.createData(), robot.foot
        self._scene = scene
        self._frames = [self._model.getFrameId(name) for name in robot.foot.frames]  # names checked by Robot
        sides = [[(robot.joint_names.index(n), s) for n, row, s in robot.role_signs() if row == i] for i in HIP_ANKLE]
        self._rows = [[7 + row for row, _ in side] for side in sides]
        self._signs = [np.array([sign for _, sign in side]) for side in sides]  # left and right may turn opposite ways
        self._end = tape.q[-1].copy()
        ahead, self._tilt, height = self._aim(self._end)
        self._mass = robot.total_mass
        speed, momentum = self._motion(tape.q[-1], tape.v[-1])
        self._moment = momentum / self._mass + height * speed[0] + ahead * speed[2]
        self._now = np.zeros(len(robot.joint_names))

    def _motion(self, q, v) -> tuple[np.ndarray, float]:
        """CoM velocity (3,), and angular momentum about the pitch axis."""
        pin.ccrba(self._model, self._data, q, v)
        return self._data.hg.linear / self._mass, float(self._data.hg.angular[1])

    def _sole_middle(self, q) -> np.ndarray:
        pin.framesForwardKinematics(self._model, self._data, q)
        return np.mean([self._data.oMf[frame].act(self._foot.center) for frame in self._frames], axis=0)

    def _aim(self, q) -> np.ndarray:
        """Middle of the soles ahead of the CoM [m], the soles' pitch [rad], CoM above the soles [m]."""
        com = pin.centerOfMass(self._model, self._data, q, False).copy()
        middle = self._sole_middle(q)
        feet = [self._data.oMf[frame].rotation for frame in self._frames]
        tilt = np.mean([np.arctan2(-foot[2, 0], foot[2, 2]) for foot in feet])
        return np.array([middle[0] - com[0], tilt, com[2] - middle[2]])

    def correction(self, q: np.ndarray, v: np.ndarray, error: float, opening: float | None = None) -> np.ndarray:
        """Angles (nv - 6,) to add to the tape [rad]; call it once per step, it moves at :data:`RATE` at most.

        Parameters
        ----------
        q, v : measured state.
        error : of the trunk's pitch at touchdown, as now or as forecast [rad], within half a turn.
        opening : in a flip, the time until touchdown [s].
        """
        middle = self._sole_middle(q)
        near = middle[2] - self._scene.top_at(middle[0]) < START_HEIGHT_M
        if near or (opening is not None and opening < FLIP_START_S):
            most = (RATE if near else FLIP_RATE) * STEP_S
            self._now = self._now + np.clip(self.wish(q, v, error) - self._now, -most, most)
        return self._now

    def wish(self, q: np.ndarray, v: np.ndarray, pitch_error: float) -> np.ndarray:
        """Correction (nv - 6,) with which the predicted touchdown has the soles flat and well placed."""
        speed, momentum = self._motion(q, v)
        com = self._data.com[0].copy()
        guess = self._end.copy()
        turn = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, pitch_error, 0.0))
        guess[3:7] = (turn * pin.Quaternion(guess[6], guess[3], guess[4], guess[5])).coeffs()
        for _ in range(NEWTON_STEPS):
            here = self._aim(guess)
            drop = com[2] - here[2] - self._scene.top_at(self._sole_middle(q)[0])
            fall = np.sqrt(max(speed[2] ** 2 + 2 * GRAVITY * drop, FASTEST_FALL**2))
            goal = np.array([(momentum / self._mass + here[2] * speed[0] - self._moment) / fall, self._tilt])
            slope = np.empty((2, 2))
            for column, (rows, signs) in enumerate(zip(self._rows, self._signs, strict=True)):
                probe = guess.copy()
                probe[rows] += PROBE_RAD * signs
                slope[:, column] = (self._aim(probe) - here)[:2] / PROBE_RAD
            turns = np.linalg.solve(slope, goal - here[:2])
            for rows, signs, angle in zip(self._rows, self._signs, turns, strict=True):
                guess[rows] += angle * signs
        return np.clip(guess[7:] - self._end[7:], -LARGEST_RAD, LARGEST_RAD)  # zero but for hips and ankles


def pitch_of(q: np.ndarray) -> float:
    """Pitch of the trunk in configuration ``q`` [rad]."""
    x, y, z, w = q[3:7]
    return float(np.arctan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y)))
