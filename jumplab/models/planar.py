"""Stage 3's model: five links in the sagittal plane, rooted at the toe (Sec. II-C of the paper).

Configuration: absolute angles of foot, shank, thigh, trunk and arm, positive about +y. Every position is a sum of one
vector per angle, so the toe can be fixed (launch) or follow from the ballistic CoM (flight) without any contact
equation. Moments, momentum and inertia sum m_i times products of two such vectors; the sum over the links is taken
once, in numbers, and what is left are ten differences of angles. Derivatives of that form are cheap, the second ones
above all. Tests compare it with an independent derivation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.robot.description import SLIDING_RATE
from jumplab.robot.sagittal import JOINT_OF_ANGLES, SagittalModel
from jumplab.task import GRAVITY

NEGLIGIBLE = 1e-14  # share of the largest of some coefficients: below it is rounding


def _turned(arms: np.ndarray, turns) -> list:
    """(x, z) of the sum over j of arms (5, 2), each by its CasADi matrix ((xx, xz), (zx, zz)), skipping zeros."""
    x, z = 0, 0
    for (dx, dz), ((xx, xz), (zx, zz)) in zip(arms, turns, strict=True):
        if dx:
            x, z = x + dx * xx, z + dx * zx
        if dz:
            x, z = x + dz * xz, z + dz * zz
    return [x, z]


@dataclass(frozen=True)
class PlanarState:
    """All planar quantities at one instant, as CasADi expressions; positions are relative to the toe."""

    model: SagittalModel
    angles: ca.SX  # (5,) absolute link angles [rad]
    rates: ca.SX  # (5,) [rad/s]
    accels: ca.SX  # (5,) [rad/s^2]
    gravity: float = GRAVITY  # [m/s^2]

    @cached_property
    def _turns(self):
        """Per order of differentiation in time, and per angle, its rotation matrix ((xx, xz), (zx, zz))."""
        place, velocity, acceleration = [], [], []
        for j in range(5):
            c, s = ca.cos(self.angles[j]), ca.sin(self.angles[j])
            w, a = self.rates[j], self.accels[j]
            place.append(((c, s), (-s, c)))
            velocity.append(((-s * w, c * w), (-c * w, -s * w)))
            p, q = -s * a - c * w * w, c * a - s * w * w
            acceleration.append(((p, q), (-q, p)))
        return place, velocity, acceleration

    def point(self, name_or_arms: str | np.ndarray, order: int = 0) -> ca.SX:
        """(x, z) of a named point or (5, 2) arms from the toe; ``order`` 1, 2 gives velocity, acceleration."""
        arms = name_or_arms
        if isinstance(name_or_arms, str):
            arms = self.model.point_arms(*self.model.points[name_or_arms])
        return ca.vertcat(*_turned(arms, self._turns[order]))

    @cached_property
    def _com(self):
        arms = np.einsum("i,ijk->jk", self.model.mass, self.model.com_arms()) / self.model.total_mass
        return [_turned(arms, turns) for turns in self._turns]

    @property
    def com(self) -> ca.SX:
        """CoM from the toe [m] (2,)."""
        return ca.vertcat(*self._com[0])

    @property
    def com_velocity(self) -> ca.SX:
        """CoM velocity relative to the toe [m/s] (2,)."""
        return ca.vertcat(*self._com[1])

    @property
    def com_acceleration(self) -> ca.SX:
        """CoM acceleration relative to the toe [m/s^2] (2,)."""
        return ca.vertcat(*self._com[2])

    # With (x, z) as the number x + i z, link i's CoM is sum_j exp(-i a_j) D_ij. For two such sums with constants D and
    # E and P_jk = sum_i m_i conj(D_ij) E_ik, the moments sum_i m_i (z x'' - x z'') are the sum over j and k of
    # Re(P_jk) (c a_k'' + s a_k'^2) + Im(P_jk) (c a_k'^2 - s a_k''), c and s of a_j - a_k.
    @cached_property
    def _differences(self):
        """(cos, sin) of a_j - a_k for every pair (j, k)."""
        out = {(j, j): (1.0, 0.0) for j in range(5)}
        for j in range(5):
            for k in range(j + 1, 5):
                difference = self.angles[j] - self.angles[k]
                c, s = ca.cos(difference), ca.sin(difference)
                out[j, k], out[k, j] = (c, s), (c, -s)
        return out

    @cached_property
    def _waves(self):
        """Per pair (j, k) the factors of Re(P_jk) and Im(P_jk) in a moment of inertial forces."""
        out = {}
        for (j, k), (c, s) in self._differences.items():
            w2, a = self.rates[k] ** 2, self.accels[k]
            out[j, k] = (a, w2) if j == k else (c * a + s * w2, c * w2 - s * a)
        return out

    def _sum(self, pairs: np.ndarray, factors) -> ca.SX:
        """Sum of Re(P) and Im(P) times their factors, skipping zeros."""
        total, size = 0, np.abs(pairs).max(initial=0.0)
        for at, (real, imaginary) in factors.items():
            for number, factor in ((pairs[at].real, real), (pairs[at].imag, imaginary)):
                if abs(number) > NEGLIGIBLE * size:
                    total = total + float(number) * factor
        return total

    def _arms(self) -> np.ndarray:
        return self.model.com_arms() @ np.array([1.0, 1j])  # (link, angle)

    def _com_arms(self) -> np.ndarray:
        return self.model.mass @ self._arms() / self.model.total_mass  # (angle,)

    def _moment(self, about: np.ndarray, links, ballistic: bool):
        """Moment (about +y) that links need about a point with complex arms (5,): with the toe still, or in free fall.

        Gravity is left out: in free fall it does nothing, and otherwise see :meth:`_weight`.
        """
        links, arms = list(links), self._arms()
        mass, moving = self.model.mass[links], arms[links] - (self._com_arms() if ballistic else 0.0)
        pairs = np.einsum("i,ij,ik->jk", mass, np.conj(arms[links] - about), moving)
        return sum(float(self.model.inertia[i]) * self.accels[i] for i in links) + self._sum(pairs, self._waves)

    def _weight(self, about: np.ndarray, links):
        """(x, z) of the links' masses times their places from a point with complex arms (5,) [kg m]."""
        links = list(links)
        arms = self.model.mass[links] @ (self._arms()[links] - about)
        return _turned(np.stack([arms.real, arms.imag], -1), self._turns[0])

    def _central(self) -> np.ndarray:
        """P of both sums taken from the CoM."""
        arms = self._arms() - self._com_arms()
        return np.einsum("i,ij,ik->jk", self.model.mass, np.conj(arms), arms)

    @cached_property
    def angular_momentum(self) -> ca.SX:
        """Centroidal angular momentum L about +y [kg m^2/s]."""
        factors = {(j, k): (c * self.rates[k], -s * self.rates[k]) for (j, k), (c, s) in self._differences.items()}
        return ca.dot(ca.DM(self.model.inertia), self.rates) + self._sum(self._central(), factors)

    @cached_property
    def angular_momentum_rate(self) -> ca.SX:
        """dL/dt [N m]."""
        return self._moment(self._com_arms(), range(5), True)

    @cached_property
    def inertia(self) -> ca.SX:
        """Pitch inertia about the CoM, rho = rho_R + rho_I [kg m^2]; rho_I, the links' own, is constant."""
        factors = {(j, k): (c, -s) for (j, k), (c, s) in self._differences.items()}
        return float(self.model.inertia.sum()) + self._sum(self._central(), factors)

    @cached_property
    def inertia_rate(self) -> ca.SX:
        """d rho / dt [kg m^2/s]."""
        factors = {(j, k): (s * self.rates[k], c * self.rates[k]) for (j, k), (c, s) in self._differences.items()}
        return 2 * self._sum(self._central(), factors)

    @cached_property
    def joints(self) -> ca.SX:
        """Joint angles hip, knee, ankle, shoulder [rad] (4,)."""
        return ca.DM(JOINT_OF_ANGLES) @ self.angles

    @cached_property
    def joint_rates(self) -> ca.SX:
        """Joint rates [rad/s] (4,)."""
        return ca.DM(JOINT_OF_ANGLES) @ self.rates

    def torques(self, toe_acceleration: tuple[float, float] | None = (0.0, 0.0)) -> ca.SX:
        """Motor torques hip, knee, ankle, shoulder, both sides summed [N m] (4,); needs no ground wrench.

        They move the links, and :meth:`motors`. ``toe_acceleration`` (x, z) [m/s^2]; None if the CoM falls freely.
        """

        def moment(joint, links):
            about = self.model.point_arms(joint, np.zeros(2)) @ np.array([1.0, 1j])
            inertial = self._moment(about, links, toe_acceleration is None)
            if toe_acceleration is None:
                return inertial
            (x, z), (ax, az) = self._weight(about, links), toe_acceleration
            return inertial + z * ax - x * (az + self.gravity)

        # lower joints of the links: toe, ankle, knee, hip, shoulder
        links = ca.vertcat(-moment(3, (3, 4)), -moment(2, (2, 3, 4)), -moment(1, (1, 2, 3, 4)), moment(4, (4,)))
        return links + self.motors() if self.model.heavy_motors else links

    def motors(self) -> ca.SX:
        """Torques (4,) that the motors take themselves: armature, damping, dry friction [N m]."""
        m, rate, accel = self.model, self.joint_rates, ca.DM(JOINT_OF_ANGLES) @ self.accels
        sliding = ca.DM(m.friction) * ca.tanh(rate / SLIDING_RATE)
        return ca.DM(m.armature) * accel + ca.DM(m.damping) * rate + sliding

    def ground_wrench(self) -> ca.SX:
        """(3,) F_x, F_z [N] and moment about the toe [N m] on the robot while the toe stands still."""
        m, toe = self.model.total_mass, np.zeros(5)
        ax, az = self._com[2]
        moment = self._moment(toe, range(5), False) - self._weight(toe, range(5))[0] * self.gravity
        return ca.vertcat(m * ax, m * (az + self.gravity), moment)


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
    inputs = {"angles": a, "rates": w, "accels": b, "toe": toe}
    return ca.Function("planar", list(inputs.values()), list(outputs.values()), list(inputs), list(outputs))
