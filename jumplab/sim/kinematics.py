"""What a configuration of the full robot says: attitude and pitch of the trunk, places of CoM and soles."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from eigenpy import PartialPivLU

from jumplab.robot import Robot


def solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The x of ``matrix`` (n, n) x = ``right`` (n,) or (n, k).

    By Eigen: the last digit of NumPy's own depends on its version, whose newest is not the same on every Python.
    """
    return PartialPivLU(matrix).solve(right)


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a quaternion (4,), x y z w."""
    x, y, z, w = quaternion
    return pin.Quaternion(w, x, y, z).toRotationMatrix()


def inertial(mass: float, com: np.ndarray, quaternion: np.ndarray, moments: np.ndarray) -> pin.Inertia:
    """Inertia of a link in its frame, from its CoM (3,) there [m], and moments (3,) about axes that are turned."""
    turn = rotation(np.asarray(quaternion))
    return pin.Inertia(float(mass), np.asarray(com), turn @ np.diag(moments) @ turn.T)


def turned(q: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """A copy of ``q`` (nq,) with its base turned in place by ``turn`` (3, 3), world axes."""
    out = q.copy()
    out[3:7] = (pin.Quaternion(turn) * pin.Quaternion(q[6], q[3], q[4], q[5])).coeffs()
    return out


def yaw_of(turn: np.ndarray) -> float:
    """How far a rotation (3, 3) turns about the vertical, whatever it tilts besides [rad]."""
    z, w = pin.Quaternion(turn).coeffs()[2:]
    return float(2 * np.arctan2(z if w >= 0 else -z, abs(w)))


def pitch_of(q: np.ndarray) -> np.ndarray:
    """Pitch (...) of the trunk in its own heading, in configurations ``q`` (..., nq), within half a turn [rad]."""
    x, y, z, w = np.moveaxis(q[..., 3:7], -1, 0)
    return np.arctan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))


def planned_pitch(q: np.ndarray) -> np.ndarray:
    """Pitch (N,) of the base along a tape, continuous through full turns [rad]."""
    return np.unwrap(pitch_of(q))


def headed(q: np.ndarray, heading_rad: float) -> np.ndarray:
    """Configurations (..., nq) as somebody sees them who looks along ``heading_rad``; ``q`` itself if that is zero."""
    if heading_rad == 0:
        return q
    out, (c, s), half = q.copy(), (np.cos(heading_rad), np.sin(heading_rad)), -heading_rad / 2
    out[..., 0], out[..., 1] = c * q[..., 0] + s * q[..., 1], c * q[..., 1] - s * q[..., 0]
    (x, y, z, w), cz, sz = np.moveaxis(q[..., 3:7], -1, 0), np.cos(half), np.sin(half)
    out[..., 3:7] = np.stack([cz * x - sz * y, cz * y + sz * x, cz * z + sz * w, cz * w - sz * z], -1)
    return out


class Gauge:
    """Reads places and speeds from states of one robot."""

    def __init__(self, robot: Robot):
        self.robot, self.model, self.data = robot, robot.model, robot.model.createData()
        self.frames = [robot.model.getFrameId(name) for name in robot.foot.frames]  # names checked by Robot

    def soles(self, q: np.ndarray) -> np.ndarray:
        """Mean of both soles' middles (3,) [m]."""
        return self._on_feet(q, self.robot.foot.center)

    def toe(self, q: np.ndarray) -> np.ndarray:
        """Middle between the toes (3,) [m]."""
        return self._on_feet(q, self.robot.foot.tip)

    def places(self, q: np.ndarray) -> list[pin.SE3]:
        """Placements of both feet."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return [self.data.oMf[frame].copy() for frame in self.frames]

    def _on_feet(self, q: np.ndarray, point: np.ndarray) -> np.ndarray:
        pin.framesForwardKinematics(self.model, self.data, q)
        return np.mean([self.data.oMf[frame].act(point) for frame in self.frames], axis=0)

    def heading(self, q: np.ndarray) -> float:
        """Where the feet point, seen from above, within half a turn of +x [rad]."""
        pin.framesForwardKinematics(self.model, self.data, q)
        x, y = np.sum([self.data.oMf[frame].rotation[:2, 0] for frame in self.frames], axis=0)
        return float(np.arctan2(y, x))

    def com(self, q: np.ndarray) -> np.ndarray:
        """CoM (3,) [m]."""
        return pin.centerOfMass(self.model, self.data, q, False).copy()

    def com_velocity(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Velocity of the CoM (3,) [m/s]."""
        pin.centerOfMass(self.model, self.data, q, v, False)
        return self.data.vcom[0].copy()

    def com_ahead(self, q: np.ndarray, v: np.ndarray, left_s: float) -> np.ndarray:
        """CoM (3,) in ``left_s`` of free flight [m]."""
        speed = self.com_velocity(q, v)
        return self.com(q) + speed * left_s - np.array([0.0, 0.0, self.robot.gravity * left_s**2 / 2])
