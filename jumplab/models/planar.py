"""Stage 3's model: five links in the sagittal plane, rooted at the toe (Sec. II-C of the paper).

Configuration: absolute angles of foot, shank, thigh, trunk and arm, positive about +y. Every position is a sum of one
vector per angle, so velocities and accelerations need one pass (Newton-Euler), and the toe can be fixed (launch) or
follow from the ballistic CoM (flight) without any contact equation. :func:`lagrangian` is an independent derivation
that tests compare with.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.robot.sagittal import JOINT_OF_ANGLES, SagittalModel
from jumplab.task import GRAVITY


def _dot(vectors: np.ndarray, columns) -> list:
    """Sum over j of (2,) numbers times CasADi (2, 1) columns given as (x, z) pairs, skipping zeros."""
    x, z = 0, 0
    for (dx, dz), ((xx, xz), (zx, zz)) in zip(vectors, columns, strict=True):
        if dx:
            x, z = x + dx * xx, z + dx * zx
        if dz:
            x, z = x + dz * xz, z + dz * zz
    return [x, z]


@dataclass(frozen=True)
class PlanarState:
    """All planar quantities at one instant, as CasADi expressions; positions are relative to the toe.

    Parameters
    ----------
    model : the sagittal robot.
    angles, rates, accels : (5,) absolute link angles and derivatives [rad, rad/s, rad/s^2].
    gravity : [m/s^2].
    """

    model: SagittalModel
    angles: ca.SX
    rates: ca.SX
    accels: ca.SX
    gravity: float = GRAVITY

    @cached_property
    def _turn(self):
        """Per angle the columns of R, R' w and R' a - R w^2 as ((xx, xz), (zx, zz))."""
        place, velocity, acceleration = [], [], []
        for j in range(5):
            c, s = ca.cos(self.angles[j]), ca.sin(self.angles[j])
            w, a = self.rates[j], self.accels[j]
            place.append(((c, s), (-s, c)))
            velocity.append(((-s * w, c * w), (-c * w, -s * w)))
            p, q = -s * a - c * w * w, c * a - s * w * w
            acceleration.append(((p, q), (-q, p)))
        return place, velocity, acceleration

    @cached_property
    def _links(self):
        arms = self.model.com_arms()
        return [[_dot(arms[i], turn) for turn in self._turn] for i in range(5)]

    def point(self, name_or_arms, order: int = 0):
        """(x, z) of a named point or (5, 2) arms from the toe; ``order`` 1, 2 gives velocity, acceleration."""
        arms = name_or_arms
        if isinstance(name_or_arms, str):
            arms = self.model.point_arms(*self.model.points[name_or_arms])
        return ca.vertcat(*_dot(arms, self._turn[order]))

    @cached_property
    def _com(self):
        arms = np.einsum("i,ijk->jk", self.model.mass, self.model.com_arms()) / self.model.total_mass
        return [_dot(arms, turn) for turn in self._turn]

    @property
    def com(self):
        """CoM from the toe [m] (2,)."""
        return ca.vertcat(*self._com[0])

    @property
    def com_velocity(self):
        """CoM velocity relative to the toe [m/s] (2,)."""
        return ca.vertcat(*self._com[1])

    @property
    def com_acceleration(self):
        """CoM acceleration relative to the toe [m/s^2] (2,)."""
        return ca.vertcat(*self._com[2])

    def _relative(self, order):
        return [[x - self._com[order][0], z - self._com[order][1]] for x, z in (link[order] for link in self._links)]

    @cached_property
    def angular_momentum(self):
        """Centroidal angular momentum L about +y [kg m^2/s]."""
        spin = ca.dot(ca.DM(self.model.inertia), self.rates)
        pairs = zip(self.model.mass, self._relative(0), self._relative(1), strict=True)
        return spin + sum(m * (r[1] * v[0] - r[0] * v[1]) for m, r, v in pairs)

    @cached_property
    def angular_momentum_rate(self):
        """dL/dt [N m]."""
        spin = ca.dot(ca.DM(self.model.inertia), self.accels)
        pairs = zip(self.model.mass, self._relative(0), self._relative(2), strict=True)
        return spin + sum(m * (r[1] * a[0] - r[0] * a[1]) for m, r, a in pairs)

    @cached_property
    def inertia(self):
        """Pitch inertia about the CoM, rho = rho_R + rho_I [kg m^2]; rho_I, the links' own, is constant."""
        pairs = zip(self.model.mass, self._relative(0), strict=True)
        return float(self.model.inertia.sum()) + sum(m * (r[0] ** 2 + r[1] ** 2) for m, r in pairs)

    @cached_property
    def inertia_rate(self):
        """d rho / dt [kg m^2/s]."""
        pairs = zip(self.model.mass, self._relative(0), self._relative(1), strict=True)
        return 2 * sum(m * (r[0] * v[0] + r[1] * v[1]) for m, r, v in pairs)

    @cached_property
    def joints(self):
        """Joint angles hip, knee, ankle, shoulder [rad] (4,)."""
        return ca.DM(JOINT_OF_ANGLES) @ self.angles

    @cached_property
    def joint_rates(self):
        """Joint rates [rad/s] (4,)."""
        return ca.DM(JOINT_OF_ANGLES) @ self.rates

    def torques(self, toe_acceleration=(0.0, 0.0)):
        """Joint torques hip, knee, ankle, shoulder, both sides summed [N m] (4,); needs no ground wrench."""
        ax, az = toe_acceleration[0], toe_acceleration[1] + self.gravity
        model = self.model

        def moment(joint_arms, links):
            px, pz = _dot(joint_arms, self._turn[0])
            total = 0
            for i in links:
                (x, z), _, (bx, bz) = self._links[i]
                total += model.inertia[i] * self.accels[i]
                total += model.mass[i] * ((z - pz) * (bx + ax) - (x - px) * (bz + az))
            return total  # what the links need about that joint

        arms = [model.point_arms(i, np.zeros(2)) for i in range(5)]  # lower joints: toe, ankle, knee, hip, shoulder
        return ca.vertcat(-moment(arms[3], (3, 4)), -moment(arms[2], (2, 3, 4)), -moment(arms[1], (1, 2, 3, 4)),
                          moment(arms[4], (4,)))  # fmt: skip

    def ground_wrench(self):
        """(3,) F_x, F_z [N] and moment about the toe [N m] on the robot while the toe stands still."""
        m = self.model.total_mass
        (cx, cz), (ax, az) = self._com[0], self._com[2]
        fx, fz = m * ax, m * (az + self.gravity)
        return ca.vertcat(fx, fz, self.angular_momentum_rate + cz * fx - cx * fz)


def symbols() -> tuple[ca.SX, ca.SX, ca.SX]:
    """Fresh symbols for angles, rates and accelerations, (5,) each."""
    return ca.SX.sym("angle", 5), ca.SX.sym("rate", 5), ca.SX.sym("accel", 5)


def evaluator(model: SagittalModel, gravity: float = GRAVITY) -> ca.Function:
    """CasADi function (angles, rates, accels, toe_acceleration) -> every planar quantity, for sampling and tests."""
    a, w, b = symbols()
    toe = ca.SX.sym("toe_acceleration", 2)
    s = PlanarState(model, a, w, b, gravity)
    sole = model.point_arms(0, model.sole_center)
    outputs = {
        "com": s.com,
        "com_velocity": s.com_velocity,
        "com_acceleration": s.com_acceleration,
        "L": s.angular_momentum,
        "L_rate": s.angular_momentum_rate,
        "rho": s.inertia,
        "rho_rate": s.inertia_rate,
        "joints": s.joints,
        "joint_rates": s.joint_rates,
        "torques": s.torques((toe[0], toe[1])),
        "ground_wrench": s.ground_wrench(),
        "sole": s.point(sole),
        "heel": s.point("heel"),
    }
    return ca.Function("planar", [a, w, b, toe], list(outputs.values()), ["angles", "rates", "accels", "toe"],
                       list(outputs))  # fmt: skip


def lagrangian(model: SagittalModel, gravity: float = GRAVITY) -> ca.Function:
    """Independent derivation: Lagrange's equations in theta = [x; z; pitch; q] (Sec. II-C), base at the hip.

    Returns a function (theta, theta_rate, theta_accel) -> (M theta'' + H) of size 7; x, z are the hip's position.
    """
    theta, rate, accel = (ca.SX.sym(n, 7) for n in ("theta", "rate", "accel"))
    hip, pitch, q = theta[:2], theta[2], theta[3:]
    thigh = pitch + q[0]
    shank = thigh + q[1]
    angles = [shank + q[2], shank, thigh, pitch, pitch + q[3]]
    turn = [((ca.cos(x), ca.sin(x)), (-ca.sin(x), ca.cos(x))) for x in angles]
    to_hip = model.point_arms(3, np.zeros(2))
    kinetic, potential = 0, 0
    for i, arms in enumerate(model.com_arms()):
        place = hip + ca.vertcat(*_dot(arms - to_hip, turn))
        speed = ca.jacobian(place, theta) @ rate
        spin = ca.jacobian(angles[i], theta) @ rate
        kinetic += model.mass[i] * ca.dot(speed, speed) / 2 + model.inertia[i] * spin**2 / 2
        potential += model.mass[i] * gravity * place[1]
    momentum = ca.gradient(kinetic, rate)
    force = ca.jacobian(momentum, rate) @ accel + ca.jacobian(momentum, theta) @ rate
    force += ca.gradient(potential - kinetic, theta)
    return ca.Function("lagrangian", [theta, rate, accel], [force], ["theta", "rate", "accel"], ["force"])
