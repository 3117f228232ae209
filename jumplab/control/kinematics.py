"""Kinematics of a configuration of the full robot: attitude and pitch of the trunk, places of CoM
and soles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from jumplab.robot import Robot
from jumplab.robot.contact import on_feet

LEVEL = np.eye(7)[6]  # place and quaternion (7,) of a base at the origin, not turned


class State(NamedTuple):
    """Measured state of a robot at one time."""

    q: np.ndarray  # (nq,) configuration
    v: np.ndarray  # (nv,) velocity
    # what the feet feel, or a function that measures it once it is asked for
    feet: np.ndarray | Callable[[], np.ndarray]

    @property
    def wrench(self) -> np.ndarray:
        """(2, 6) force and moment on each foot, world axes, at the origin of the foot link [N, N
        m].
        """
        return self.feet() if callable(self.feet) else self.feet

    def along(self, heading_rad: float) -> State:
        """The same, as seen along a heading."""
        if heading_rad == 0:
            return self
        q = headed(self.q, heading_rad)
        return State(q, self.v, lambda: turned_wrench(self.wrench, heading_rad))


class Motion(NamedTuple):
    """Place and motion of the robot as a whole in one state; world axes."""

    q: np.ndarray  # (nq,) configuration
    com: np.ndarray  # (3,) [m]
    velocity: np.ndarray  # (3,) of the CoM [m/s]
    momentum: np.ndarray  # (3,) angular, about the CoM [kg m^2/s]
    inertia: np.ndarray  # (3, 3) about the CoM [kg m^2]


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a quaternion (4,), x y z w."""
    return pin.Quaternion(np.asarray(quaternion, float)).toRotationMatrix()


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) of many quaternions (..., 4), x y z w."""
    turns = Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix()
    return turns.reshape(*quaternions.shape[:-1], 3, 3)


def turned(q: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """A copy of ``q`` (nq,) with its base turned in place by ``turn`` (3, 3), world axes."""
    out = q.copy()
    out[3:7] = (pin.Quaternion(turn) * pin.Quaternion(q[6], q[3], q[4], q[5])).coeffs()
    return out


def about_vertical(angle_rad: float) -> np.ndarray:
    """Rotation (3, 3) about +z."""
    return pin.rpy.rpyToMatrix(0.0, 0.0, angle_rad)


def yaw_of(turn: np.ndarray) -> float:
    """Angle of a rotation (3, 3) about the vertical, whatever it tilts besides [rad]."""
    z, w = pin.Quaternion(turn).coeffs()[2:]
    return float(2 * np.arctan2(z if w >= 0 else -z, abs(w)))


def pitch_of(q: np.ndarray) -> np.ndarray:
    """Pitch (...) of the trunk in its own heading, in configurations ``q`` (..., nq), within half a
    turn [rad].
    """
    x, y, z, w = np.moveaxis(q[..., 3:7], -1, 0)
    return np.arctan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))


def headed(q: np.ndarray, heading_rad: float) -> np.ndarray:
    """Configurations (..., nq) as seen along ``heading_rad``; ``q`` itself
    if that is zero.
    """
    if heading_rad == 0:
        return q
    out = q.copy()
    out[..., :3] = q[..., :3] @ about_vertical(heading_rad)
    half = -heading_rad / 2
    crossed = q[..., [4, 3, 6, 5]] * [-1.0, 1.0, 1.0, -1.0]
    out[..., 3:7] = np.cos(half) * q[..., 3:7] + np.sin(half) * crossed
    return out


def turned_wrench(wrench: np.ndarray, heading_rad: float) -> np.ndarray:
    """Wrenches (..., 6) as seen along ``heading_rad``."""
    halves = wrench.reshape(*wrench.shape[:-1], 2, 3) @ about_vertical(heading_rad)
    return halves.reshape(wrench.shape)


class Gauge:
    """Reads places and speeds from states of one robot."""

    def __init__(self, robot: Robot):
        self.robot = robot
        self.model = robot.model
        self.data = robot.model.createData()
        self._feet = on_feet(robot, np.zeros(3))

    def places(self, q: np.ndarray) -> list[pin.SE3]:
        """Placements of both feet in ``q`` (nq,)."""
        pin.forwardKinematics(self.model, self.data, q)
        return [foot.place(self.data) for foot in self._feet]

    def feet(self, q: np.ndarray) -> np.ndarray:
        """Homogeneous transforms (N, 2, 4, 4) of both feet in ``q`` (N, nq) [m]."""
        joints = np.empty((len(q), 2, 4, 4))
        for row, there in zip(q, joints, strict=True):
            pin.forwardKinematics(self.model, self.data, row)
            for side, foot in enumerate(self._feet):
                there[side] = self.data.oMi[foot.joint].homogeneous
        return joints @ np.array([foot.placement.homogeneous for foot in self._feet])

    def points(self, q: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Places (2, 3) of a ``point`` (3,) of each foot's frame in ``q`` (nq,) [m]."""
        return np.array([foot.act(point) for foot in self.places(q)])

    def soles(self, q: np.ndarray) -> np.ndarray:
        """Mean of both soles' middles (3,) in ``q`` (nq,) [m]."""
        return self.points(q, self.robot.foot.center).mean(axis=0)

    def toe(self, q: np.ndarray) -> np.ndarray:
        """Middle between the toes (3,) in ``q`` (nq,) [m]."""
        return self.points(q, self.robot.foot.tip).mean(axis=0)

    def corners(self, q: np.ndarray) -> np.ndarray:
        """Corners (8, 3) of both soles in ``q`` (nq,) [m]."""
        corners = self.robot.foot.corners
        return np.array([foot.act(corner) for foot in self.places(q) for corner in corners])

    def heading(self, q: np.ndarray) -> float:
        """Direction in which the feet point in ``q`` (nq,), seen from above, within half a turn of
        +x [rad].
        """
        x, y = np.sum([foot.rotation[:2, 0] for foot in self.places(q)], axis=0)
        return float(np.arctan2(y, x))

    def com(self, q: np.ndarray) -> np.ndarray:
        """CoM (3,) in ``q`` (nq,) [m]."""
        return pin.centerOfMass(self.model, self.data, q, False).copy()

    def motion(self, q: np.ndarray, v: np.ndarray) -> Motion:
        """Motion of the whole robot in ``q`` (nq,) and ``v`` (nv,)."""
        data = self.data
        pin.ccrba(self.model, data, q, v)
        momentum = data.hg
        velocity = momentum.linear / self.robot.total_mass
        return Motion(q, data.com[0].copy(), velocity, momentum.angular.copy(), data.Ig.inertia)

    def motions(self, q: np.ndarray, v: np.ndarray) -> Motion:
        """Motions in states ``q`` (N, nq) and ``v`` (N, nv), a row of each quantity for each."""
        return Motion(*map(np.array, zip(*map(self.motion, q, v), strict=True)))
