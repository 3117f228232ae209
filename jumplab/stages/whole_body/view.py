"""What an own term of stage 3 sees at a point: the robot's quantities by name, in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca

from jumplab.errors import InputError, quoted
from jumplab.models.planar import PlanarState
from jumplab.ocp.problem import Point
from jumplab.robot.sagittal import SagittalModel
from jumplab.stages.whole_body.terms import WholeBodyTerms


class Joints(NamedTuple):
    """One quantity of every joint, by its role."""

    hip: ca.SX
    knee: ca.SX
    ankle: ca.SX
    shoulder: ca.SX

    def __getattr__(self, name: str) -> ca.SX:
        raise AttributeError(f"there is no joint {name!r}; there are {', '.join(self._fields)}")


@dataclass(frozen=True)
class BodyView:
    """A point of stage 3, ``p.joints.knee`` and so on.

    The model is planar: left and right move alike, so an angle or rate is that of either side, and a torque is that of
    both sides together. Angles are positive about +y; places count from the toes' first place, x forward, z up.
    """

    _terms: WholeBodyTerms
    _point: Point

    @property
    def joints(self) -> Joints:
        """Joint angles hip, knee, ankle, shoulder [rad]."""
        return Joints(*ca.vertsplit(self._terms.state(self._point).joints))

    @property
    def joint_rates(self) -> Joints:
        """Joint rates hip, knee, ankle, shoulder [rad/s]."""
        return Joints(*ca.vertsplit(self._terms.state(self._point).joint_rates))

    @property
    def torques(self) -> Joints:
        """Joint torques hip, knee, ankle, shoulder, both sides together [N m]."""
        return Joints(*ca.vertsplit(self._terms.torques(self._point)))

    @property
    def posture(self) -> ca.SX:
        """Pitch of the trunk, forward positive, turns included [rad]."""
        return self._terms.state(self._point).angles[3]

    @property
    def com(self) -> ca.SX:
        """Centre of mass, x and z (2,) [m]."""
        return self._terms.toe(self._point) + self._terms.state(self._point).com

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity (2,) [m/s]."""
        if not self._terms.flying:
            return self._terms.state(self._point).com_velocity
        c = self._point.c
        return ca.vertcat(c.vel_x, c.vel_z - self._point.p.gravity * self._point.time)

    @property
    def L(self) -> ca.SX:
        """Angular momentum about the CoM, about +y [kg m^2/s]."""
        return self._terms.state(self._point).angular_momentum

    @property
    def inertia(self) -> ca.SX:
        """Pitch inertia about the CoM, rho [kg m^2]."""
        return self._terms.state(self._point).inertia

    @property
    def inertia_rate(self) -> ca.SX:
        """Its rate [kg m^2/s]."""
        return self._terms.state(self._point).inertia_rate

    @property
    def wrench(self) -> ca.SX:
        """The ground's force and its moment about the toe: F_x, F_z [N], M_y [N m] (3,); zero in flight."""
        return ca.SX.zeros(3) if self._terms.flying else self._terms.wrench(self._point)

    def moved(self, model: SagittalModel) -> PlanarState:
        """Another robot in the same motion, its quantities from its own toe: that of stage 3's model, by its links."""
        return PlanarState(model, *(self._terms.links(x) for x in (self._point.q, self._point.v, self._point.a)))

    def point(self, name: str) -> ca.SX:
        """Place (2,) [m] of "toe", "heel", "knee", "hip", "shoulder", "hand" or "mid-arm"."""
        return self._terms.toe(self._point) + self._terms.state(self._point).point(self._known(name))

    def point_velocity(self, name: str) -> ca.SX:
        """Velocity (2,) [m/s] of the same points."""
        state = self._terms.state(self._point)
        return self.com_velocity - state.com_velocity + state.point(self._known(name), 1)

    def _known(self, name: str) -> str:
        points = self._terms.model.points
        if name not in points:
            raise InputError(f"the robot has no point {quoted(name)}; it has {', '.join(points)}")
        return name
