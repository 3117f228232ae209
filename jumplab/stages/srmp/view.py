"""What an own term of stage 1 sees at a point: the rod's quantities by name, in SI units."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from jumplab.models.srmp import SrmpState
from jumplab.ocp.problem import Point


def srmp_state(p: Point, mass: float) -> SrmpState:
    """The pendulum at one instant; evaluated once for all terms that look there."""
    if "srmp" not in p.memo:
        p.memo["srmp"] = SrmpState(mass, p.q, p.v, p.a, p.p.gravity)
    return p.memo["srmp"]


@dataclass(frozen=True)
class RodView:
    """A point of the launch, ``p.com`` and so on; places count from the middle of the standing sole, z is up."""

    _mass: float
    _point: Point

    @property
    def _state(self) -> SrmpState:
        return srmp_state(self._point, self._mass)

    @property
    def lean(self) -> ca.SX:
        """Angle of the rod against the vertical, theta_l, forward positive [rad]."""
        return self._point.q[0]

    @property
    def length(self) -> ca.SX:
        """Length of the rod, phi [m]."""
        return self._point.q[1]

    @property
    def posture(self) -> ca.SX:
        """Pitch of the trunk, theta_l + theta_pl, forward positive [rad]."""
        return self._point.q[0] + self._point.q[2]

    @property
    def com(self) -> ca.SX:
        """Centre of mass, x and z (2,) [m]."""
        return self._state.com

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity (2,) [m/s]."""
        return self._state.com_velocity

    @property
    def com_acceleration(self) -> ca.SX:
        """Its acceleration (2,) [m/s^2]."""
        return self._state.com_acceleration

    @property
    def L(self) -> ca.SX:
        """Angular momentum about the CoM, about +y [kg m^2/s]."""
        return self._state.angular_momentum

    @property
    def L_rate(self) -> ca.SX:
        """Its rate [N m]."""
        return self._state.angular_momentum_rate

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
        """The ground's force on the robot and its moment about the middle of the sole: F_x, F_z [N], M_y [N m] (3,)."""
        return ca.vertcat(self._state.ground_force, self._state.pivot_torque)


@dataclass(frozen=True)
class RodFlightView:
    """A point of the flight; places count from the middle of the sole that the robot left. It has no trunk."""

    _point: Point

    @property
    def lean(self) -> ca.SX:
        """Angle of the line from the foot to the CoM against the vertical, theta, turns included [rad]."""
        return self._point.z[0]

    @property
    def com(self) -> ca.SX:
        """Centre of mass, x and z (2,) [m]."""
        t, c = self._point.time, self._point.c
        return ca.vertcat(c.com_x + c.vel_x * t, c.com_z + c.vel_z * t - self._point.p.gravity * t * t / 2)

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity (2,) [m/s]."""
        c = self._point.c
        return ca.vertcat(c.vel_x, c.vel_z - self._point.p.gravity * self._point.time)

    @property
    def L(self) -> ca.SX:
        """Angular momentum about the CoM, constant in flight, about +y [kg m^2/s]."""
        return self._point.c.L

    @property
    def inertia(self) -> ca.SX:
        """Pitch inertia about the CoM, rho [kg m^2]."""
        return self._point.q[0]

    @property
    def inertia_rate(self) -> ca.SX:
        """Its rate [kg m^2/s]."""
        return self._point.v[0]

    @property
    def wrench(self) -> ca.SX:
        """The ground's force and moment (3,): zero in the air [N, N m]."""
        return ca.SX.zeros(3)
