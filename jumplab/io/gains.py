"""Feedback gains about a motion: a time-varying linear-quadratic regulator of the whole robot.

An error is (dq, dv): dq (nv,) leads from the motion's configuration to the real one
(``pin.difference``: the base's in its own axes, then joints), dv (nv,) is that of the velocities.
About every instant it obeys the derivatives of

    M a + h = S^T tau + J^T f,    J a + J' v = -DAMPING J v - STIFFNESS d

in which J are the twists of the feet that carry at their toes' edge, without pitch where the sole
is not flat, and d are how far they are off: turned, or apart from each other. Where the feet are
together changes nothing. The discrete Riccati equation runs backwards over all instants.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from jumplab.io.motion import Motion
from jumplab.io.whole import Whole

PERIOD_S = 0.005  # between gains
HOLD_S = 2.0  # that the motion's end is held
# of contacts that give way, as MuJoCo's do by default
STIFFNESS = 2500.0  # [1/s^2]
DAMPING = 100.0  # [1/s]
FLAT_RAD = 0.015  # a foot that is tipped by more stands on its toes
PITCH = 4  # row of a twist
# errors that cost as much as the whole torque of a joint: of the base and of joints
TILT_RAD = 0.05
ANGLE_RAD = 0.1
SPEED_M_S = 0.5
SPIN_RAD_S = 1.0
RATE_RAD_S = 3.0
Held = list[tuple[int, pin.SE3, list[int]]]  # joint, point in its frame, rows of the point's twist


class Dynamics:
    """Those of the published robot with its motors, and their derivatives; joints as Pinocchio's.

    Arguments are a configuration q (nq,), a velocity v (nv,) and torques tau (nv - 6,) [m, rad, s,
    N m], and what is :meth:`held`.
    """

    def __init__(self, whole: Whole):
        robot = whole.robot
        self.model = whole.model.copy()
        self.data = self.model.createData()
        motors = [robot.actuators.get(name, {}) for name in self.model.names[2:]]
        self.model.armature[6:] = [motor.get("armature", 0.0) for motor in motors]
        self._damping = np.array([0.0] * 6 + [motor.get("damping", 0.0) for motor in motors])
        self._tips = whole.feet(robot.foot.tip)

    def held(self, q: np.ndarray, carries: np.ndarray) -> Held:
        """Joint, place and rows that the ground holds, of each foot that ``carries`` (2,) names."""
        pin.forwardKinematics(self.model, self.data, q)
        out = []
        for tip, down in zip(self._tips, carries, strict=True):
            tipped = -tip.place(self.data).rotation[2, 0]  # toes down
            if down:
                rows = [row for row in range(6) if row != PITCH or tipped < FLAT_RAD]
                out.append((tip.joint, tip.placement, rows))
        return out

    def jacobians(self, held: Held) -> list[np.ndarray]:
        """Rows (n, nv) of the twists of what is held, of each foot; of the last state."""
        return [
            pin.getFrameJacobian(self.model, self.data, *at, pin.LOCAL)[rows] for *at, rows in held
        ]

    def solved(self, jacobians: list[np.ndarray], right: np.ndarray) -> np.ndarray:
        """Accelerations, and contact forces with their sign turned (nv + rows, ...), of right-hand
        sides of that size, by ``jacobians`` (rows, nv) of each foot.
        """
        rows = np.vstack([np.zeros((0, self.model.nv)), *jacobians])
        none = np.zeros((len(rows), len(rows)))
        return np.linalg.solve(np.block([[self.data.M, rows.T], [rows, none]]), right)

    def accelerations(
        self, q: np.ndarray, v: np.ndarray, tau: np.ndarray, held: Held
    ) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations (nv,) and forces of what is held, with the feet where they are due."""
        model = self.model
        data = self.data
        pin.computeAllTerms(model, data, q, v)
        pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))
        push = np.pad(tau, (6, 0)) - self._damping * v - data.nle
        jacobians = self.jacobians(held)
        due = [
            -pin.getFrameAcceleration(model, data, *at, pin.LOCAL).vector[rows] - DAMPING * j @ v
            for (*at, rows), j in zip(held, jacobians, strict=True)
        ]
        out = self.solved(jacobians, np.concatenate([push, *due]))
        return out[: model.nv], -out[model.nv :]

    def derivatives(
        self, q: np.ndarray, v: np.ndarray, tau: np.ndarray, held: Held
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (nv, 2 nv) of accelerations by errors, and (nv, nv - 6) by torques."""
        model = self.model
        data = self.data
        nv = model.nv
        a, forces = self.accelerations(q, v, tau, held)
        jacobians = self.jacobians(held)
        pushes = pin.StdVec_Force([pin.Force.Zero()] * model.njoints)
        for joint, place, rows in held:
            wrench = np.zeros(6)
            wrench[rows], forces = np.split(forces, [len(rows)])
            pushes[joint] += place.act(pin.Force(wrench))
        pin.computeRNEADerivatives(model, data, q, v, a, pushes)
        by_rates = data.dtau_dv + np.diag(self._damping)
        right = [np.hstack([-data.dtau_dq, -by_rates, np.eye(nv)[:, 6:]])]
        pin.computeForwardKinematicsDerivatives(model, data, q, v, a)
        turns = [(data.oMi[joint] * place).rotation for joint, place, _ in held]
        ways = [turn @ j[:3] for turn, j in zip(turns, jacobians, strict=True)]
        for (*at, rows), turn, j in zip(held, turns, jacobians, strict=True):
            parts = pin.getFrameAccelerationDerivatives(model, data, *at, pin.LOCAL)
            v_q, a_q, a_v, _ = (part[rows] for part in parts)
            error_q = j.copy()
            error_q[:3] -= turn.T @ np.mean(ways, axis=0)
            by_place = -a_q - DAMPING * v_q - STIFFNESS * error_q
            right.append(np.hstack([by_place, -a_v - DAMPING * j, np.zeros((len(rows), nv - 6))]))
        out = self.solved(jacobians, np.vstack(right))[:nv]
        return out[:, : 2 * nv], out[:, 2 * nv :]


def discrete(by_error: np.ndarray, by_torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices (2 nv, 2 nv) and (2 nv, nu) that lead errors over :data:`PERIOD_S`: velocities
    first, then configurations with these.
    """
    nv = len(by_error)
    rates = np.eye(nv, 2 * nv, nv) + PERIOD_S * by_error
    pushed = PERIOD_S * by_torque
    places = np.eye(nv, 2 * nv) + PERIOD_S * rates
    return np.vstack([places, rates]), np.vstack([PERIOD_S * pushed, pushed])


def costs(whole: Whole) -> tuple[np.ndarray, np.ndarray]:
    """Diagonals (2 nv,) and (nv - 6,) of the costs of errors and of torques."""
    n = whole.model.nv - 6
    scales = [np.inf] * 3 + [TILT_RAD] * 3 + [ANGLE_RAD] * n
    scales += [SPEED_M_S] * 3 + [SPIN_RAD_S] * 3 + [RATE_RAD_S] * n
    return np.array(scales) ** -2.0, whole.model.upperEffortLimit[6:] ** -2.0


def riccati(
    a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gain (nu, 2 nv), and value (2 nv, 2 nv) one step before ``value``; costs are diagonals."""
    ahead = value @ b
    gain = np.linalg.solve(np.diag(r) + b.T @ ahead, ahead.T @ a)
    value = np.diag(q) + a.T @ value @ (a - b @ gain)
    return gain, (value + value.T) / 2


def gains(whole: Whole, x: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) [s], and gains (N, nu, 2 nv) for MuJoCo: torques = planned - gain @ error.

    ``x`` is a motion of :meth:`.Whole.frames`. An error is that of ``mj_differentiatePos`` and then
    that of ``qvel``, joints and torques depth-first. After its end the last gain holds.
    """
    dynamics = Dynamics(whole)
    x = x.every(1 / PERIOD_S)
    q, v = whole.states(x)
    order = whole.order
    tau = x.tau[:, np.argsort(order)]
    cost = costs(whole)
    value = np.diag(cost[0])
    out = np.zeros((len(q), len(order), 2 * whole.model.nv), np.float32)
    lasts = np.ones(len(q), int)  # periods
    lasts[-1] += round(HOLD_S / PERIOD_S)
    for k in reversed(range(len(q))):
        held = dynamics.held(q[k], x.contact[k])
        step = discrete(*dynamics.derivatives(q[k], v[k], tau[k], held))
        for _ in range(lasts[k]):
            gain, value = riccati(*step, *cost, value)
        out[k] = (gain @ from_mujoco(q[k], v[k], order))[order]
    return x.t, out


def from_mujoco(q: np.ndarray, v: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Errors (2 nv, 2 nv) in Pinocchio's axes and order of MuJoCo's small ones."""
    nv = len(v)
    back = Rotation.from_quat(q[3:7]).as_matrix().T
    parts = back, np.eye(3), np.eye(len(order))[:, order]
    out = block_diag(*parts, *parts)
    out[nv : nv + 3, 3:6] = pin.skew(v[:3])  # own axes turn with the base
    return out
