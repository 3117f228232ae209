"""The paper's model of stage 3: five links in the sagittal plane, rooted at the toe (Sec. II-C).

Configuration: absolute angles of foot, shank, thigh, trunk and arm, positive about +y. Every
position is a sum of one vector per angle. Tests compare it with an independent derivation.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.robot import Robot
from jumplab.robot.motors import SLIDING_RATE
from jumplab.robot.sagittal import JOINT_OF_ANGLES, SagittalModel
from jumplab.task import GRAVITY

LINKS = range(5)


def about_y(arm: ca.SX, force: ca.SX) -> ca.SX:
    """Moment about +y of a force (2,) at the end of an arm (2,), both x and z."""
    return arm[1] * force[0] - arm[0] * force[1]


@dataclass(frozen=True)
class PlanarState:
    """All planar quantities at one instant, as CasADi expressions; positions are relative to the
    toe.
    """

    model: SagittalModel
    angles: ca.SX  # (5,) absolute link angles [rad]
    rates: ca.SX  # (5,) [rad/s]
    accels: ca.SX  # (5,) [rad/s^2]
    gravity: float = GRAVITY  # [m/s^2]

    @cached_property
    def _turns(self) -> list[list[ca.SX]]:
        """Per order of differentiation in time, the rotation (2, 2) by each angle."""
        orders = [[], [], []]
        for angle, w, a in zip(*map(ca.vertsplit, (self.angles, self.rates, self.accels)), strict=True):
            c = ca.cos(angle)
            s = ca.sin(angle)
            turn = ca.vertcat(ca.horzcat(c, s), ca.horzcat(-s, c))
            across = ca.vertcat(ca.horzcat(-s, c), ca.horzcat(-c, -s))
            for order, matrix in zip(orders, (turn, w * across, a * across - w**2 * turn), strict=True):
                order.append(matrix)
        return orders

    def point(self, name_or_arms: str | np.ndarray, order: int = 0) -> ca.SX:
        """(x, z) of a named point or (5, 2) arms from the toe; ``order`` 1, 2 gives velocity,
        acceleration [m], [m/s], [m/s^2].
        """
        arms = name_or_arms
        if isinstance(name_or_arms, str):
            arms = self.model.point_arms(*self.model.points[name_or_arms])
        return sum(turn @ ca.DM(arm) for turn, arm in zip(self._turns[order], arms, strict=True))

    @cached_property
    def _links(self) -> list[list[ca.SX]]:
        """Per order, the CoM of each link (2,)."""
        return [[self.point(arms, order) for arms in self.model.com_arms()] for order in range(3)]

    @cached_property
    def _com(self) -> list[ca.SX]:
        share = self.model.mass / self.model.total_mass
        return [sum(s * x for s, x in zip(share, links, strict=True)) for links in self._links]

    @property
    def com(self) -> ca.SX:
        """CoM from the toe [m] (2,)."""
        return self._com[0]

    @property
    def com_velocity(self) -> ca.SX:
        """CoM velocity relative to the toe [m/s] (2,)."""
        return self._com[1]

    @property
    def com_acceleration(self) -> ca.SX:
        """CoM acceleration relative to the toe [m/s^2] (2,)."""
        return self._com[2]

    def _from_com(self, order: int) -> list[ca.SX]:
        """CoM of each link (2,) from that of all, or its rates."""
        return [x - self._com[order] for x in self._links[order]]

    def _moment(self, about: ca.SX, links: Iterable[int], lift: ca.SX | None) -> ca.SX:
        """Moment (about +y) that links need about a point (2,): ``lift`` (2,) is the toe's
        acceleration less gravity's; None in free fall, where gravity does nothing.
        """
        m = self.model
        pushed = self._from_com(2) if lift is None else [x + lift for x in self._links[2]]
        inertial = sum(float(m.inertia[i]) * self.accels[i] for i in links)
        arms = {i: self._links[0][i] - about for i in links}
        return inertial + sum(float(m.mass[i]) * about_y(arm, pushed[i]) for i, arm in arms.items())

    @cached_property
    def angular_momentum(self) -> ca.SX:
        """Centroidal angular momentum L about +y [kg m^2/s]."""
        moving = zip(self.model.mass, self._from_com(0), self._from_com(1), strict=True)
        spins = ca.dot(ca.DM(self.model.inertia), self.rates)
        return spins + sum(float(m) * about_y(arm, speed) for m, arm, speed in moving)

    @cached_property
    def angular_momentum_rate(self) -> ca.SX:
        """dL/dt [N m]."""
        return self._moment(self.com, LINKS, None)

    @cached_property
    def inertia(self) -> ca.SX:
        """Pitch inertia about the CoM, rho = rho_R + rho_I [kg m^2]; rho_I, the links' own, is
        constant.
        """
        arms = zip(self.model.mass, self._from_com(0), strict=True)
        return float(self.model.inertia.sum()) + sum(float(m) * ca.sumsqr(x) for m, x in arms)

    @cached_property
    def inertia_rate(self) -> ca.SX:
        """d rho / dt [kg m^2/s]."""
        moving = zip(self.model.mass, self._from_com(0), self._from_com(1), strict=True)
        return 2 * sum(float(m) * ca.dot(arm, speed) for m, arm, speed in moving)

    @cached_property
    def joints(self) -> ca.SX:
        """Joint angles hip, knee, ankle, shoulder [rad] (4,)."""
        return ca.DM(JOINT_OF_ANGLES) @ self.angles

    @cached_property
    def joint_rates(self) -> ca.SX:
        """Joint rates [rad/s] (4,)."""
        return ca.DM(JOINT_OF_ANGLES) @ self.rates

    def torques(self, toe_acceleration: tuple[float, float] | None = (0.0, 0.0)) -> ca.SX:
        """Motor torques hip, knee, ankle, shoulder, both sides summed [N m] (4,); needs no ground
        wrench.

        They move the links, and :meth:`motors`. ``toe_acceleration`` (x, z) [m/s^2]; None if the
        CoM falls freely.
        """
        lift = None
        if toe_acceleration is not None:
            x, z = toe_acceleration
            lift = ca.vertcat(x, z + self.gravity)

        def moment(first, *links):  # about the lower joint of the first link
            arms = self.model.point_arms(first, np.zeros(2))
            return self._moment(self.point(arms), (first, *links), lift)

        links = ca.vertcat(-moment(3, 4), -moment(2, 3, 4), -moment(1, 2, 3, 4), moment(4))
        return links + self.motors() if self.model.armature.any() or self.model.lossy else links

    def motors(self) -> ca.SX:
        """Torques (4,) that the motors take themselves: armature, damping, dry friction [N m]."""
        m = self.model
        rate = self.joint_rates
        accel = ca.DM(JOINT_OF_ANGLES) @ self.accels
        sliding = ca.DM(m.friction) * ca.tanh(rate / SLIDING_RATE)
        return ca.DM(m.armature) * accel + ca.DM(m.damping) * rate + sliding

    def ground_wrench(self) -> ca.SX:
        """(3,) F_x, F_z [N] and moment about the toe [N m] on the robot while the toe stands still."""
        lift = ca.vertcat(0, self.gravity)
        force = self.model.total_mass * (self.com_acceleration + lift)
        return ca.vertcat(force, self._moment(ca.SX.zeros(2), LINKS, lift))


def symbols() -> tuple[ca.SX, ca.SX, ca.SX]:
    """Fresh symbols for angles, rates and accelerations, (5,) each."""
    return ca.SX.sym("angle", 5), ca.SX.sym("rate", 5), ca.SX.sym("accel", 5)


def evaluator(model: SagittalModel, gravity: float = GRAVITY) -> ca.Function:
    """CasADi function (angles, rates, accels, toe_acceleration) -> every planar quantity, for
    sampling and tests.
    """
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


def planar_quantities(
    robot: Robot,
    angles: np.ndarray,
    rates: np.ndarray,
    accels: np.ndarray,
    toe_acceleration: np.ndarray,
    gravity: float,
) -> dict[str, np.ndarray]:
    """Planar quantities at n instants: name -> (n, size) or (n,).

    Inputs are (n, 5), (n, 5), (n, 5), (n, 2); names as in :func:`evaluator`.
    """
    values = evaluator(robot.sagittal, gravity).map(len(angles))(
        angles=angles.T, rates=rates.T, accels=accels.T, toe=toe_acceleration.T
    )
    return {name: value.full().T.squeeze() for name, value in values.items()}
