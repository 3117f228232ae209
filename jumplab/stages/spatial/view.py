"""What an own term of the whole-body program sees at a point: the robot's quantities by name, in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca

from jumplab.errors import InputError, quoted
from jumplab.ocp.problem import Point
from jumplab.stages.spatial.coordinates import BASE
from jumplab.stages.spatial.terms import SpatialTerms


@dataclass(frozen=True)
class SpatialView:
    """A point of the whole-body program, ``p.joints.left_knee`` and so on; vectors (3,) in the axes of the start.

    Places count from the middle between the soles in their first place: x forward, y to the left, z up.
    """

    _terms: SpatialTerms
    _point: Point

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
