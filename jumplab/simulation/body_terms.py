"""Dynamics of the full robot with two soles on the ground, as the landing controller needs them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration


class BodyTerms:
    """Quantities at one state (``update``); unknowns are x = (accelerations, wrench left, wrench right).

    Wrenches act at the middle of each sole, world axes, force then moment, in units of ``wrench_scale``.

    Attributes
    ----------
    mass : [kg];  standing_height : CoM above the soles in the stance [m];  pitch_rest : trunk pitch there [rad].
    posture_rest : (nv - 6,) joint angles of the stance.
    com, com_velocity : (3,) [m, m/s];  momentum : (3,) angular momentum about the CoM [kg m^2/s].
    trunk : (3, 3) attitude of the base;  soles : (2, 3) their middles;  attitudes : (2, 3, 3);  twists : (2, 6).
    sole_rows, sole_drift : (2, 6, nx) and (2, 6), acceleration of the sole = rows @ x + drift.
    base_rows, base_offset : (6, nx) and (6,), the unactuated dynamics: rows @ x + offset = 0.
    torque_rows, torque_offset : (nv - 6, nx) and (nv - 6,), torque = rows @ x + offset.
    force_rows : (3, nx), CoM acceleration = rows @ x + gravity;  momentum_rows : (3, nx), rate of ``momentum``.
    """

    def __init__(self, robot: Robot, wrench_scale: float):
        self._model, self._data, self._scale = robot.model, robot.model.createData(), wrench_scale
        self._frames = [self._model.getFrameId(name) for name in robot.foot.frames]  # names checked by Robot
        self._center = robot.foot.center
        self.nv = self._model.nv
        self.nx = self.nv + 12
        self.mass = robot.total_mass
        self.gravity = self._model.gravity.linear.copy()
        rest = stance_configuration(robot)
        self.posture_rest = rest[7:].copy()
        self.pitch_rest = float(robot.stance["trunk_pitch_rad"])
        pin.centerOfMass(self._model, self._data, rest)
        self.standing_height = float(self._data.com[0][2])
        nv, nx = self.nv, self.nx
        self.soles, self.attitudes, self.twists = np.zeros((2, 3)), np.zeros((2, 3, 3)), np.zeros((2, 6))
        self.sole_rows, self.sole_drift = np.zeros((2, 6, nx)), np.zeros((2, 6))
        self.force_rows, self.momentum_rows = np.zeros((3, nx)), np.zeros((3, nx))
        self._dynamics, self._zero = np.zeros((nv, nx)), np.zeros(nv)

    def update(self, q: np.ndarray, v: np.ndarray) -> None:
        """Evaluate everything at (q, v), before :meth:`set_contact`."""
        model, data = self._model, self._data
        pin.computeAllTerms(model, data, q, v)
        pin.forwardKinematics(model, data, q, v, self._zero)
        self.com, self.com_velocity = data.com[0].copy(), data.vcom[0].copy()
        self.momentum = data.hg.angular.copy()
        self.trunk = data.oMi[1].rotation.copy()
        self._dynamics[:, : self.nv] = data.M
        self.base_rows, self.torque_rows = self._dynamics[:6], self._dynamics[6:]
        self.base_offset, self.torque_offset = data.nle[:6], data.nle[6:]
        for side, frame in enumerate(self._frames):
            self._sole(side, frame)

    def set_contact(self, contact: np.ndarray) -> None:
        """Let only the feet flagged in ``contact`` (2,) transmit wrenches."""
        for side in (0, 1):
            at = slice(self.nv + 6 * side, self.nv + 6 * side + 6)
            on = self._scale * float(contact[side])
            self._dynamics[:, at] = -on * self.sole_rows[side, :, : self.nv].T
            self.force_rows[:, at][:, :3] = on / self.mass * np.eye(3)
            self.momentum_rows[:, at] = on * np.hstack([pin.skew(self.soles[side] - self.com), np.eye(3)])

    def _sole(self, side: int, frame: int) -> None:
        """Kinematics of one sole's middle, world axes."""
        model, data, axes = self._model, self._data, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        place = pin.updateFramePlacement(model, data, frame)
        arm = place.rotation @ self._center
        jacobian = pin.getFrameJacobian(model, data, frame, axes)
        jacobian[:3] -= pin.skew(arm) @ jacobian[3:]
        velocity = pin.getFrameVelocity(model, data, frame, axes)
        drift = pin.getFrameClassicalAcceleration(model, data, frame, axes)
        w, spin = velocity.angular, pin.skew(velocity.angular)
        self.soles[side], self.attitudes[side] = place.translation + arm, place.rotation
        self.twists[side] = np.concatenate([velocity.linear + spin @ arm, w])
        self.sole_rows[side, :, : self.nv] = jacobian
        linear = drift.linear + pin.skew(drift.angular) @ arm + spin @ (spin @ arm)
        self.sole_drift[side] = np.concatenate([linear, drift.angular])

    def torque(self, x: np.ndarray) -> np.ndarray:
        """Joint torques (nv - 6,) that go with the unknowns ``x`` [N m]."""
        return self.torque_rows @ x + self.torque_offset

    def gravity_torque(self, contact: np.ndarray) -> np.ndarray:
        """Joint torques (nv - 6,) that hold the weight on the standing feet if nothing moves [N m]."""
        x = np.zeros(self.nx)
        share = self.mass * -self.gravity[2] / self._scale / max(1, int(np.sum(contact)))
        for side in np.flatnonzero(contact):
            x[self.nv + 6 * side + 2] = share
        return self.torque(x)
