"""Quantities of the robot at a point of the whole-body program by name, for own terms; SI units."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from jumplab.errors import InputError, quoted
from jumplab.models.names import ByJoint
from jumplab.models.spatial import SpatialModel, SpatialState, cross
from jumplab.ocp.problem import Point
from jumplab.stages.whole_body.contacts import SIDES
from jumplab.stages.whole_body.coordinates import BASE, PITCH
from jumplab.stages.whole_body.terms import WholeBodyTerms


@dataclass(frozen=True)
class BodyView:
    """A point of the whole-body program, ``p.joints.left_knee`` and so on.

    Vectors (3,) are in the axes of the start: x forward, y to the left, z up. Places count from the middle between the
    soles in their first place; angles are positive about +y. In a jump straight ahead of a robot whose halves are alike
    left and right move alike, and what points to the side is zero.
    """

    _terms: WholeBodyTerms
    _point: Point

    @property
    def _state(self) -> SpatialState:
        return self._terms.state(self._point)

    @property
    def joints(self) -> ByJoint:
        """Joint angles [rad]: ``.left_knee`` (1,), ``.knee`` of left and right (2,)."""
        return ByJoint(self._terms.robot, self._terms.chart(self._point.q)[BASE:])

    @property
    def joint_rates(self) -> ByJoint:
        """Joint rates [rad/s]."""
        return ByJoint(self._terms.robot, self._terms.chart(self._point.v, 1)[BASE:])

    @property
    def torques(self) -> ByJoint:
        """Joint torques [N m]."""
        return ByJoint(self._terms.robot, self._terms.all_torques(self._point))

    @property
    def attitude(self) -> ca.SX:
        """Yaw, roll and pitch of the base (3,), turns included [rad]."""
        return self._terms.chart(self._point.q)[3:BASE]

    @property
    def posture(self) -> ca.SX:
        """Pitch of the base, forward positive, turns included [rad]."""
        return self._terms.chart(self._point.q)[PITCH]

    @property
    def com(self) -> ca.SX:
        """Centre of mass (3,) [m]."""
        return self._state.com

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity (3,) [m/s]."""
        return self._state.com_velocity

    @property
    def L(self) -> ca.SX:
        """Angular momentum about the CoM (3,) [kg m^2/s]."""
        return self._state.angular_momentum

    @property
    def inertia(self) -> ca.SX:
        """Inertia of all bodies as one, about the CoM (3, 3) [kg m^2]; the paper's rho is ``p.inertia[1, 1]``."""
        return self._state.inertia

    @property
    def feet_forces(self) -> list[ca.SX]:
        """Force of the ground on the left and on the right foot in the axes of its foothold [N]; zero in the air."""
        return [self._terms.foot_force(self._point, side) for side in (0, 1)]

    @property
    def wrench(self) -> ca.SX:
        """The ground's force on the robot, and its moment about the origin (6,) [N, N m]; zero in flight."""
        terms, total = self._terms, ca.SX.zeros(6)
        for side in terms.sides:
            place, yaw = terms.foothold(self._point, side)
            c, s = ca.cos(yaw), ca.sin(yaw)
            for local, f in zip(terms.points[side], terms.point_forces(self._point, side), strict=True):
                force = ca.vertcat(c * f[0] - s * f[1], s * f[0] + c * f[1], f[2])
                arm = place + ca.vertcat(c * local[0] - s * local[1], s * local[0] + c * local[1], 0)
                total += ca.vertcat(force, cross(arm, force))
        if terms.free.even:  # the right foot is the left one's mirror image
            total *= ca.DM([2, 0, 2, 0, 2, 0])
        return total

    def point(self, name: str) -> ca.SX:
        """Place (3,) [m] of "left_toe", "left_heel", "left_sole", "left_hand", the right ones, or a joint's origin.

        Raises :class:`InputError` with the names that exist.
        """
        return self._state.point(*self._anchor(name))

    def point_velocity(self, name: str) -> ca.SX:
        """Velocity (3,) [m/s] of the same points."""
        body, local = self._anchor(name)
        return self._state.rotation(body) @ self._state.own_rates(body, local)[0]

    def _anchor(self, name: str) -> tuple[int, np.ndarray]:
        """Body that carries a point, and where it is in that body's frame (3,)."""
        body = self._terms.body
        known = {joint: (1 + k, np.zeros(3)) for k, joint in enumerate(body.joint_names)}
        for i, (side, foot) in enumerate(zip(SIDES, body.feet, strict=True)):
            heel = body.corners[i, 2:].mean(axis=0)
            known |= {f"{side}_toe": (foot, body.tips[i]), f"{side}_heel": (foot, heel)}
            known[f"{side}_sole"] = foot, body.middles[i]
            for shoulder in body.robot.joints.get("shoulder_pitch", ())[i : i + 1]:
                arm = 1 + body.joint_names.index(shoulder)
                hands = [x for x in body.limb_points[2:] if arm in body.chain(x[0])]
                known |= {f"{side}_hand": x for x in hands[:1]}
        if name not in known:
            raise InputError(f"the robot has no point {quoted(name)}; it has {', '.join(sorted(known))}")
        return known[name]

    def moved(self, model: SpatialModel) -> SpatialState:
        """Another robot, whose tree has the same joints, in the same motion."""
        q, v = self._terms.chart(self._point.q), self._terms.chart(self._point.v, 1)
        return SpatialState(model, q, v, v, self._point.p.gravity)
