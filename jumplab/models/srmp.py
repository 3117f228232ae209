"""Stage 1's model: the static reaction mass pendulum (Sec. II-A of the paper).

A massless rod of length phi leans by theta_l from a pivot fixed on the ground and carries a
barbell, two masses m/2 at distance varphi from the CoM, turned by theta_pl against the rod. Words
here: ``lean`` (theta_l), ``length`` (phi), ``turn`` (theta_pl), ``radius`` (varphi). Angles
positive about +y.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from jumplab.task import GRAVITY

# theta_l [rad], phi [m], theta_pl [rad], varphi [m]
COORDINATES = ("lean", "length", "turn", "radius")


@dataclass(frozen=True)
class SrmpState:
    """SRMP quantities at one instant as CasADi expressions; q, v, a are (4,) in the order of
    :data:`COORDINATES`.
    """

    mass: float
    q: ca.SX
    v: ca.SX
    a: ca.SX
    gravity: float = GRAVITY

    @property
    def lean(self) -> ca.SX:
        """Angle of the rod against the vertical, theta_l, forward positive [rad]."""
        return self.q[0]

    @property
    def length(self) -> ca.SX:
        """Length of the rod, phi [m]."""
        return self.q[1]

    @property
    def posture(self) -> ca.SX:
        """Pitch of the trunk, theta_l + theta_pl, forward positive [rad]."""
        return self.q[0] + self.q[2]

    @property
    def com(self) -> ca.SX:
        """CoM from the pivot [m] (2,)."""
        return self.q[1] * self._polar[0]

    @cached_property
    def _polar(self):
        sin = ca.sin(self.q[0])
        cos = ca.cos(self.q[0])
        return ca.vertcat(sin, cos), ca.vertcat(cos, -sin)  # along the rod, across it

    @property
    def com_velocity(self) -> ca.SX:
        """CoM velocity [m/s] (2,)."""
        along, across = self._polar
        return self.v[1] * along + self.q[1] * self.v[0] * across

    @property
    def com_acceleration(self) -> ca.SX:
        """CoM acceleration [m/s^2] (2,)."""
        along, across = self._polar
        w = self.v[0]
        return (self.a[1] - self.q[1] * w**2) * along + (
            self.q[1] * self.a[0] + 2 * self.v[1] * w
        ) * across

    @property
    def inertia(self) -> ca.SX:
        """rho = 2 m_p varphi^2 [kg m^2] (Eq. 4)."""
        return self.mass * self.q[3] ** 2

    @property
    def inertia_rate(self) -> ca.SX:
        """d rho / dt [kg m^2/s]."""
        return 2 * self.mass * self.q[3] * self.v[3]

    @property
    def inertia_accel(self) -> ca.SX:
        """d^2 rho / dt^2 [kg m^2/s^2]."""
        return 2 * self.mass * (self.v[3] ** 2 + self.q[3] * self.a[3])

    @property
    def L(self) -> ca.SX:
        """L = 2 m_p varphi^2 (omega_l + omega_pl) [kg m^2/s]."""
        return self.inertia * (self.v[0] + self.v[2])

    @property
    def L_rate(self) -> ca.SX:
        """dL/dt, which is also the torque tau_pl on the barbell [N m]."""
        return self.inertia * (self.a[0] + self.a[2]) + self.inertia_rate * (self.v[0] + self.v[2])

    @property
    def ground_force(self) -> ca.SX:
        """F_x, F_z on the robot [N] (2,)."""
        acc = self.com_acceleration
        return self.mass * ca.vertcat(acc[0], acc[1] + self.gravity)

    @property
    def pivot_torque(self) -> ca.SX:
        """tau_l, the ground's moment about the pivot [N m]; equals -X_CoP F_z."""
        f = self.ground_force
        c = self.com
        return self.L_rate + c[1] * f[0] - c[0] * f[1]

    @property
    def wrench(self) -> ca.SX:
        """The ground's force on the robot and its moment about the pivot: F_x, F_z [N], M_y [N m]
        (3,).
        """
        return ca.vertcat(self.ground_force, self.pivot_torque)

    @property
    def rod_force(self) -> ca.SX:
        """F_phi = m (phi'' - phi omega^2 + g cos theta) [N]; the paper's undefined F_l."""
        return self.mass * (
            self.a[1] - self.q[1] * self.v[0] ** 2 + self.gravity * ca.cos(self.q[0])
        )

    @property
    def barbell_force(self) -> ca.SX:
        """F_varphi = m (varphi'' - varphi (omega_l + omega_pl)^2) [N]."""
        return self.mass * (self.a[3] - self.q[3] * (self.v[0] + self.v[2]) ** 2)


@dataclass(frozen=True, slots=True)
class SrmpFlightState:
    """The pendulum in the air: its rod has no mass, so that CoM, inertia and angular momentum
    are all there is; places are from the pivot that it left.
    """

    lean: ca.SX  # of the line from foot to CoM against the vertical, theta, turns included [rad]
    inertia: ca.SX  # pitch inertia about the CoM, rho [kg m^2]
    inertia_rate: ca.SX  # [kg m^2/s]
    L: ca.SX  # angular momentum about the CoM, constant [kg m^2/s]
    takeoff_com: ca.SX  # (2,) [m]
    takeoff_velocity: ca.SX  # (2,) [m/s]
    air_time: ca.SX  # since take-off [s]
    gravity: ca.SX  # [m/s^2]

    @property
    def com(self) -> ca.SX:
        """CoM (2,) [m]."""
        t = self.air_time
        return (
            self.takeoff_com + self.takeoff_velocity * t - ca.vertcat(0, self.gravity * t * t / 2)
        )

    @property
    def com_velocity(self) -> ca.SX:
        """CoM velocity (2,) [m/s]."""
        return self.takeoff_velocity - ca.vertcat(0, self.gravity * self.air_time)

    @property
    def wrench(self) -> ca.SX:
        """The ground's force and moment (3,): zero in the air [N, N m]."""
        return ca.SX.zeros(3)
