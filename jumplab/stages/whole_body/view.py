"""What an own term of the whole-body program sees at a point: the robot's quantities by name, in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import NamedTuple

import casadi as ca

from jumplab.errors import InputError, quoted
from jumplab.models.planar import PlanarState
from jumplab.models.spatial import SpatialModel, SpatialState
from jumplab.ocp.problem import Point
from jumplab.robot_import.config import ROLES
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.terms import WholeBodyTerms


@dataclass(frozen=True)
class _View:
    """A point of a phase of the program."""

    _terms: WholeBodyTerms
    _point: Point

    def moved(self, model: SpatialModel) -> SpatialState:
        """Another robot, whose tree has the same joints, in the same motion."""
        q, v = self._terms.chart(self._point.q), self._terms.chart(self._point.v, 1)
        return SpatialState(model, q, v, v, self._point.p.gravity)


@dataclass(frozen=True)
class SpatialView(_View):
    """A point of the whole-body program, ``p.joints.left_knee`` and so on; vectors (3,) in the axes of the start.

    Places count from the middle between the soles in their first place: x forward, y to the left, z up.
    """

    def _named(self, column: ca.SX) -> SimpleNamespace:
        return SimpleNamespace(**dict(zip(self._terms.body.joint_names, ca.vertsplit(column), strict=True)))

    @property
    def joints(self) -> SimpleNamespace:
        """Joint angles by the names of the joints [rad]."""
        return self._named(self._terms.chart(self._point.q)[BASE:])

    @property
    def joint_rates(self) -> SimpleNamespace:
        """Joint rates [rad/s]."""
        return self._named(self._terms.chart(self._point.v, 1)[BASE:])

    @property
    def torques(self) -> SimpleNamespace:
        """Joint torques [N m]."""
        return self._named(self._terms.all_torques(self._point))

    @property
    def attitude(self) -> ca.SX:
        """Yaw, roll and pitch of the base (3,), turns included [rad]."""
        return self._terms.chart(self._point.q)[3:BASE]

    @property
    def com(self) -> ca.SX:
        """Centre of mass [m]."""
        return self._terms.state(self._point).com

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity [m/s]."""
        return self._terms.state(self._point).com_velocity

    @property
    def L(self) -> ca.SX:
        """Angular momentum about the CoM [kg m^2/s]."""
        return self._terms.state(self._point).angular_momentum

    @property
    def feet_forces(self) -> list[ca.SX]:
        """Force of the ground on the left and on the right foot in the axes of its foothold [N]; zero in the air."""
        return [self._terms.foot_force(self._point, side) for side in (0, 1)]

    def origin(self, joint: str) -> ca.SX:
        """Place of a joint [m]."""
        names = self._terms.body.joint_names
        if joint not in names:
            raise InputError(f"the robot has no joint {quoted(joint)}; it has {', '.join(names)}")
        return self._terms.state(self._point).point(1 + names.index(joint), [0.0, 0.0, 0.0])


class Joints(NamedTuple):
    """One quantity of every joint, by its role."""

    hip: ca.SX
    knee: ca.SX
    ankle: ca.SX
    shoulder: ca.SX

    def __getattr__(self, name: str) -> ca.SX:
        raise AttributeError(f"there is no joint {name!r}; there are {', '.join(self._fields)}")


@dataclass(frozen=True)
class PlaneView(_View):
    """A point of the whole-body program in the plane, ``p.joints.knee`` and so on.

    The model is planar: left and right move alike, so an angle or rate is that of either side, and a torque is that of
    both sides together. Angles are positive about +y; places count from the toes' first place, x forward, z up.
    """

    @property
    def _state(self) -> PlanarState:
        return self._terms.plane_state(self._point)

    @property
    def joints(self) -> Joints:
        """Joint angles hip, knee, ankle, shoulder [rad]."""
        return Joints(*ca.vertsplit(self._state.joints))

    @property
    def joint_rates(self) -> Joints:
        """Joint rates hip, knee, ankle, shoulder [rad/s]."""
        return Joints(*ca.vertsplit(self._state.joint_rates))

    @property
    def torques(self) -> Joints:
        """Joint torques hip, knee, ankle, shoulder, both sides together [N m]."""
        torques, roles = self._terms.all_torques(self._point), zip(ROLES, self._terms.robot.sagittal.signs, strict=True)
        names, joints = self._terms.body.joint_names, self._terms.robot.joints
        rows = [sum(float(s) * torques[names.index(n)] for n, s in zip(joints[r], x, strict=False)) for r, x in roles]
        return Joints(*(ca.SX(x) for x in rows))

    @property
    def posture(self) -> ca.SX:
        """Pitch of the trunk, forward positive, turns included [rad]."""
        return self._state.angles[3]

    @property
    def com(self) -> ca.SX:
        """Centre of mass, x and z (2,) [m]."""
        return self._terms.toe(self._point) + self._state.com

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity (2,) [m/s]."""
        if not self._terms.flying:
            return self._state.com_velocity
        c = self._point.c
        return ca.vertcat(c.vel_x, c.vel_z - self._point.p.gravity * self._point.time)

    @property
    def L(self) -> ca.SX:
        """Angular momentum about the CoM, about +y [kg m^2/s]."""
        return self._state.angular_momentum

    @property
    def inertia(self) -> ca.SX:
        """Pitch inertia about the CoM, rho [kg m^2]."""
        return self._state.inertia

    @property
    def inertia_rate(self) -> ca.SX:
        """Its rate [kg m^2/s]."""
        return self._state.inertia_rate

    @property
    def wrench(self) -> ca.SX:
        """The ground's force and its moment about the toe: F_x, F_z [N], M_y [N m] (3,); zero in flight."""
        if self._terms.flying:
            return ca.SX.zeros(3)
        p, side = self._point, 0
        phi = self._terms.pitch(side, p.q)
        total = ca.SX.zeros(3)
        for place, f in zip(self._terms.points[side], self._terms.point_forces(p, side), strict=True):
            x, z = ca.cos(phi) * place[0], -ca.sin(phi) * place[0]
            total += 2 * ca.vertcat(f[0], f[2], z * f[0] - x * f[2])
        return total

    def point(self, name: str) -> ca.SX:
        """Place (2,) [m] of "toe", "heel", "knee", "hip", "shoulder", "hand" or "mid-arm"."""
        return self._terms.toe(self._point) + self._state.point(self._known(name))

    def point_velocity(self, name: str) -> ca.SX:
        """Velocity (2,) [m/s] of the same points."""
        state = self._state
        return self.com_velocity - state.com_velocity + state.point(self._known(name), 1)

    def _known(self, name: str) -> str:
        points = self._terms.robot.sagittal.points
        if name not in points:
            raise InputError(f"the robot has no point {quoted(name)}; it has {', '.join(points)}")
        return name
