"""Limits of contact forces at a foot, and motion of points of a foot: numbers that hold for NumPy
and for CasADi alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

if TYPE_CHECKING:
    from jumplab.robot.description import Robot

FRICTION = 0.42  # of plans: below the lowest that trials have, so that it holds between the nodes
WAYS = (("+x", 0, 1.0), ("-x", 0, -1.0), ("+y", 1, 1.0), ("-y", 1, -1.0))
WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def pyramid(friction: float) -> np.ndarray:
    """Edges (4, 3) of the friction pyramid, each with a vertical force of one: a force is inside if
    it is a sum of them with factors that are not negative.
    """
    x, y, z = np.eye(3)
    return np.array([z + sign * friction * (x, y)[axis] for _, axis, sign in WAYS])


def wrench_rows(
    friction: float | None = None,
    ahead: float | None = None,
    behind: float | None = None,
    half_width: float | None = None,
    spin: float | None = None,
) -> dict[str, np.ndarray]:
    """Rows r (6,) by name, with r @ [force, moment] >= 0 while a foot sticks and does not tip.

    The wrench is about a point of the sole, in axes that are turned about the vertical as the foot
    is. The CoP is at (-m_y, m_x) / f_z from that point. A limit of None has no rows.

    Parameters
    ----------
    friction : the largest force along x, and along y, over that down [1].
    ahead, behind, half_width : how far the CoP may be from the point, along the foot and across it
        [m].
    spin : the largest moment about the vertical over the force down [m].
    """
    limits = {f"friction {way}": (friction, axis, sign) for way, axis, sign in WAYS}
    limits |= {
        "CoP behind toe": (ahead, 4, -1.0),
        "CoP ahead of heel": (behind, 4, 1.0),
        "CoP left of right edge": (half_width, 3, -1.0),
        "CoP right of left edge": (half_width, 3, 1.0),
        "torsion +": (spin, 5, 1.0),
        "torsion -": (spin, 5, -1.0),
    }
    unit = np.eye(6)
    rows = {"F_z >= 0": unit[2]}
    for name, (share, column, sign) in limits.items():
        if share is not None:
            rows[name] = share * unit[2] - sign * unit[column]
    return rows


def shifted(place: np.ndarray) -> pin.SE3:
    """Axes that are not turned, at ``place`` (3,) [m]."""
    return pin.SE3(np.eye(3), np.array(place, float))


@dataclass(frozen=True, eq=False)
class Anchor:
    """A point of a link: Pinocchio's joint that carries it, and its placement in its frame."""

    joint: int
    placement: pin.SE3

    def place(self, data: pin.Data) -> pin.SE3:
        """Placement in the world, in the state that ``data`` is in."""
        return data.oMi[self.joint] * self.placement

    def slope(
        self, model: pin.Model, data: pin.Data, axes: pin.ReferenceFrame = WORLD
    ) -> np.ndarray:
        """Jacobian (6, nv) of its twist, in some ``axes``, in the state that ``data`` is in."""
        return pin.getFrameJacobian(model, data, self.joint, self.placement, axes)


def on_feet(robot: Robot, point: np.ndarray) -> list[Anchor]:
    """A ``point`` (3,) of the foot links' frames [m], of the left and of the right foot."""
    model = robot.model
    frames = [model.frames[model.getFrameId(name, pin.BODY)] for name in robot.foot.frames]
    return [Anchor(frame.parentJoint, frame.placement * shifted(point)) for frame in frames]


def posed(model: pin.Model, q: np.ndarray | None = None) -> pin.Data:
    """New data of a model at ``q`` (nq,), or with all joints at 0: places of joints and frames,
    Jacobians ``J`` (6, nv) in the world's axes, mass and centre of all that each joint carries.
    """
    data = model.createData()
    q = pin.neutral(model) if q is None else q
    pin.centerOfMass(model, data, q)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    return data


@dataclass(frozen=True, eq=False)
class PointMotion:
    """Motion of a point of a link, in world axes.

    Attributes
    ----------
    place : (3,) [m].  turn : (3, 3) attitude of the link's frame.
    velocity : (6,) of the point, then angular of the link [m/s, rad/s].
    jacobian : (6, nv), velocity = jacobian @ v.
    drift : (6,), acceleration = jacobian @ v' + drift [m/s^2, rad/s^2].
    """

    place: np.ndarray
    turn: np.ndarray
    velocity: np.ndarray
    jacobian: np.ndarray
    drift: np.ndarray


def moving(model: pin.Model, data: pin.Data, q: np.ndarray, v: np.ndarray) -> None:
    """Makes ``data`` ready for :func:`point_motion` at ``q`` (nq,) and ``v`` (nv,)."""
    pin.computeJointJacobians(model, data, q)
    pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))


def point_motion(model: pin.Model, data: pin.Data, anchor: Anchor) -> PointMotion:
    """Motion of an anchor [m, rad, s] in the state that ``data`` is :func:`moving` in."""
    at = anchor.joint, anchor.placement
    place = anchor.place(data)
    jacobian = anchor.slope(model, data)
    velocity = pin.getFrameVelocity(model, data, *at, WORLD).vector
    drift = pin.getFrameClassicalAcceleration(model, data, *at, WORLD).vector
    return PointMotion(place.translation, place.rotation, velocity, jacobian, drift)
