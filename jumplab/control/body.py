"""The whole body at one state: what follows from joint accelerations and foot wrenches, and the
rows that any choice of them has to obey.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter

import numpy as np
import pinocchio as pin

from jumplab.control.kinematics import rotation
from jumplab.io.tape import AIR, FLAT, TOE
from jumplab.ocp.qp import Qp, QpSolver
from jumplab.robot import Robot
from jumplab.robot.contact import Anchor, on_feet, point_motion, wrench_rows
from jumplab.robot.legs import size

PERIOD_STEPS = 2  # 500 Hz
WRENCH_SCALE = 100.0  # [N] unit of the wrench variables, so that all unknowns are of order 1 to 10
# [kg m^2] pitch inertia of the landed robot, turns a momentum rate into rad/s^2
NOMINAL_INERTIA = 5.0
AXES = np.arange(3)
PITCH = 4  # row of a foot's twist that is free on its toe
SEEN = attrgetter("place", "turn", "velocity", "drift", "jacobian")  # of a foot's motion
SPIN_FRICTION = 0.04  # [m] friction coefficient times the mean lever of the sole, about 0.07 m
SPIN_HALF_WIDTH_M = 0.05  # of that sole: narrow ones turn on their edges under less
REST_S = 0.01  # in which a joint comes to rest on its stop
TOLERANCE = 1e-6  # of residuals in N m, N and (r)m/s^2, far below what a motor can resolve
MAX_ITERATIONS = 300  # ten times what the hardest recorded QP took
SURELY_NONE = 1e-4  # ProxQP's own; residuals of programs that have no answer


class WholeBody:
    """Quantities at one state (:meth:`update`); unknowns are x = (accelerations (nv), wrench left,
    wrench right).

    Wrenches act at a point of each foot, the middle of the sole unless told, world axes, force then
    moment, in units of :data:`WRENCH_SCALE` for the robot's size.

    Attributes
    ----------
    size : of the robot, by which its controllers scale their numbers.
    unknowns : (nx, nx), rows of the unknowns themselves.
    com, com_velocity : (3,) [m, m/s];  momentum : (3,) angular momentum about the CoM [kg m^2/s].
    trunk : (3, 3) attitude of the base.
    soles : (2, 3) the feet's points;  attitudes : (2, 3, 3);  twists : (2, 6).
    sole_rows, sole_drift : (2, 6, nx) and (2, 6), acceleration of the point = rows @ x + drift.
    force_rows : (3, nx), CoM acceleration = rows @ x + gravity.
    momentum_rows : (3, nx), rate of ``momentum``.
    """

    def __init__(self, robot: Robot):
        self._model = robot.model
        self._data = self._model.createData()
        self._middles = on_feet(robot, robot.foot.center)
        self.motors = robot.limits
        self.size = size(robot)
        self._unit = self.size.of(WRENCH_SCALE, "N")
        self._inertia = self.size.of(NOMINAL_INERTIA, "kg m^2")
        self.nv = self._model.nv
        self.nx = self.nv + 12
        self.mass = robot.total_mass
        self.gravity = self._model.gravity.linear.copy()
        self.unknowns = np.eye(self.nx)
        self.sole_rows = np.zeros((2, 6, self.nx))
        self.force_rows = np.zeros((3, self.nx))
        self.momentum_rows = np.zeros((3, self.nx))
        self._dynamics = np.zeros((self.nv, self.nx))

    def update(self, q: np.ndarray, v: np.ndarray, anchors: Sequence[Anchor] | None = None) -> None:
        """Evaluate everything at ``q`` (nq,) and ``v`` (nv,), before :meth:`set_contact`; with the
        wrenches at other ``anchors`` of both feet than the soles' middles.
        """
        model = self._model
        data = self._data
        pin.computeAllTerms(model, data, q, v)
        pin.forwardKinematics(model, data, q, v, np.zeros(self.nv))
        self.com = data.com[0].copy()
        self.com_velocity = data.vcom[0].copy()
        self.momentum = data.hg.angular.copy()
        self.trunk = data.oMi[1].rotation.copy()
        self._dynamics[:, : self.nv] = data.M
        self._offset = data.nle.copy()
        feet = [SEEN(point_motion(model, data, anchor)) for anchor in anchors or self._middles]
        self.soles, self.attitudes, self.twists, self.sole_drift, jacobians = map(
            np.array, zip(*feet, strict=True)
        )
        self.sole_rows[:, :, : self.nv] = jacobians

    def set_contact(self, contact: np.ndarray) -> None:
        """Let only the feet flagged in ``contact`` (2,) transmit wrenches."""
        for side in (0, 1):
            at = self.nv + 6 * side
            unit = self._unit * contact[side]
            self._dynamics[:, at : at + 6] = -unit * self.sole_rows[side, :, : self.nv].T
            self.force_rows[AXES, at + AXES] = unit / self.mass
            self.momentum_rows[:, at : at + 3] = unit * pin.skew(self.soles[side] - self.com)
            self.momentum_rows[AXES, at + 3 + AXES] = unit

    def program(
        self,
        v: np.ndarray,
        corners: np.ndarray,
        leaning: np.ndarray | None = None,
    ) -> Qp:
        """A QP without wishes: the base's dynamics, the motors at the rates of ``v`` (nv,), and the
        ground's ``corners``, see :func:`corner_rows`.

        Joints that are ``leaning`` (nv - 6,) on a stop come to rest on it within :data:`REST_S`;
        the stop adds to the torques of their motors.
        """
        offset = self._offset
        qp = Qp(self.nx)
        qp.equality("base", self._dynamics[:6], -offset[:6])
        low, high = self.motors.range(v[6:])
        rows = self._dynamics[6:].copy()
        low -= offset[6:]
        high -= offset[6:]
        if leaning is not None:
            rows[leaning] = self.unknowns[6 : self.nv][leaning]
            low[leaning] = high[leaning] = -v[6:][leaning] / REST_S
        qp.limit("motors", rows, low, high)
        qp.limit("ground", corners, 0.0)
        return qp

    def balance(
        self, qp: Qp, com: np.ndarray, momentum: np.ndarray, weights: tuple[np.ndarray, float]
    ) -> None:
        """Wish for an acceleration of the CoM (3,) [m/s^2] and a rate of the angular momentum (3,)
        [N m]; the latter's weight is of that over a nominal inertia.
        """
        qp.cost("CoM", self.force_rows, com - self.gravity, weights[0])
        rows = self.momentum_rows / self._inertia
        qp.cost("momentum", rows, momentum / self._inertia, weights[1])

    def com_wish(
        self, com: np.ndarray, speed: np.ndarray, push: np.ndarray, rate: np.ndarray | float
    ) -> np.ndarray:
        """Acceleration (3,) of the CoM [m/s^2], towards a planned place ``com`` (3,), its ``speed``
        (3,) and the rate ``push`` (3,) of that, by a critically damped ``rate`` [rad/s].
        """
        off = rate**2 * (com - self.com) + 2 * rate * (speed - self.com_velocity)
        return push + off

    def trunk_wish(
        self, v: np.ndarray, q: np.ndarray, speed: np.ndarray, gained: np.ndarray, rate: float
    ) -> np.ndarray:
        """Angular acceleration (3,) of the trunk in its own axes at a velocity ``v`` (nv,), towards
        a planned ``q`` (nq,), ``speed`` (nv,) and its rate ``gained`` (nv,), by a critically damped
        ``rate`` [rad/s].
        """
        off = self.trunk.T @ rotation(q[3:7])
        missing = off @ speed[3:6] - v[3:6]
        return off @ gained[3:6] + rate**2 * pin.log3(off) + 2 * rate * missing

    def torque(self, x: np.ndarray) -> np.ndarray:
        """Joint torques (nv - 6,) that go with the unknowns ``x`` (nx,) [N m]."""
        return self._dynamics[6:] @ x + self._offset[6:]

    def gravity_torque(self, contact: np.ndarray) -> np.ndarray:
        """Joint torques (nv - 6,) that hold the weight on the feet flagged in ``contact`` (2,) if
        nothing moves [N m].
        """
        x = np.zeros(self.nx)
        share = self.mass * -self.gravity[2] / self._unit / max(1, int(np.sum(contact)))
        x[self.nv + 2 :: 6] = share * np.asarray(contact)
        return self.torque(x)


def solver() -> QpSolver:
    """A solver for programs of one controller."""
    return QpSolver(TOLERANCE, MAX_ITERATIONS, SURELY_NONE)


def corner_rows(robot: Robot, friction: float, length: float, width: float) -> np.ndarray:
    """Rows r (k, nx) with r @ x >= 0: friction [1], CoP within these shares of the sole's length
    and width [1], and turning friction of both wrenches.
    """
    foot = robot.foot
    half = length * (foot.toe - foot.heel) / 2
    spin = SPIN_FRICTION
    if not robot.planar:
        spin *= foot.half_width / SPIN_HALF_WIDTH_M
    inside = friction / np.sqrt(2)  # a pyramid within the cone
    one = np.array([*wrench_rows(inside, half, half, width * foot.half_width, spin).values()])
    return np.hstack([np.zeros((2 * len(one), robot.model.nv)), np.kron(np.eye(2), one)])


class Footing:
    """Points on which wrenches act, and rows of the ground, by how feet stand: flat with the CoP
    within these shares of the sole, or on the toe; those in the air as flat ones.
    """

    def __init__(self, robot: Robot, friction: float, length: float, width: float):
        flat = robot.foot.center, length, width
        ways = {AIR: flat, TOE: (robot.foot.tip, 0.0, 1.0), FLAT: flat}
        self._feet = {}
        for way, (point, *shares) in ways.items():
            corners = np.split(corner_rows(robot, friction, *shares), 2)
            self._feet[way] = list(zip(on_feet(robot, point), corners, strict=True))

    def of(self, stand: tuple[int, int]) -> tuple[Sequence[Anchor], np.ndarray]:
        """Anchors of both feet, and corner rows (k, nx), where they ``stand`` so."""
        feet = [self._feet[way][side] for side, way in enumerate(stand)]
        anchors, corners = zip(*feet, strict=True)
        return anchors, np.vstack(corners)
