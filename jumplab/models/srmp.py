"""Stage 1's model: the static reaction mass pendulum (Sec. II-A of the paper).

A massless rod of length phi leans by theta_l from a pivot fixed on the ground and carries a barbell, two masses m/2
at distance varphi from the CoM, turned by theta_pl against the rod. Words here: ``lean`` (theta_l), ``length`` (phi),
``turn`` (theta_pl), ``radius`` (varphi). Angles positive about +y.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from jumplab.task import GRAVITY

COORDINATES = ("lean", "length", "turn", "radius")  # theta_l [rad], phi [m], theta_pl [rad], varphi [m]


@dataclass(frozen=True)
class SrmpState:
    """SRMP quantities at one instant as CasADi expressions; q, v, a are (4,) in the order of :data:`COORDINATES`."""

    mass: float
    q: ca.SX
    v: ca.SX
    a: ca.SX
    gravity: float = GRAVITY

    @property
    def com(self) -> ca.SX:
        """CoM from the pivot [m] (2,)."""
        return self.q[1] * ca.vertcat(ca.sin(self.q[0]), ca.cos(self.q[0]))

    @cached_property
    def _polar(self):
        sin, cos = ca.sin(self.q[0]), ca.cos(self.q[0])
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
        return (self.a[1] - self.q[1] * w**2) * along + (self.q[1] * self.a[0] + 2 * self.v[1] * w) * across

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
    def angular_momentum(self) -> ca.SX:
        """L = 2 m_p varphi^2 (omega_l + omega_pl) [kg m^2/s]."""
        return self.inertia * (self.v[0] + self.v[2])

    @property
    def angular_momentum_rate(self) -> ca.SX:
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
        f, c = self.ground_force, self.com
        return self.angular_momentum_rate + c[1] * f[0] - c[0] * f[1]

    @property
    def rod_force(self) -> ca.SX:
        """F_phi = m (phi'' - phi omega^2 + g cos theta) [N]; the paper's undefined F_l."""
        return self.mass * (self.a[1] - self.q[1] * self.v[0] ** 2 + self.gravity * ca.cos(self.q[0]))

    @property
    def barbell_force(self) -> ca.SX:
        """F_varphi = m (varphi'' - varphi (omega_l + omega_pl)^2) [N]."""
        return self.mass * (self.a[3] - self.q[3] * (self.v[0] + self.v[2]) ** 2)
