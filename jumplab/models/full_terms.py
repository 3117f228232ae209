"""What stage 2's model says of one state: names, shapes and units of its quantities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

CROSS = np.zeros((3, 9))  # x @ CROSS is the matrix of "x cross", row by row
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    CROSS[_k, 3 * _j + _i], CROSS[_k, 3 * _i + _j] = 1.0, -1.0


def skew(x: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) with skew(x) @ y = x cross y, for vectors (..., 3)."""
    return (x @ CROSS).reshape(*x.shape, 3)


class FullTerms(NamedTuple):
    """Every quantity of the nine-link robot that the QPs need, at one (q, v); feet are ordered left, right.

    In each "drift" the acceleration is that of theta'' = 0, so ``x'' = J_x theta'' + drift``.

    Attributes
    ----------
    q, v : configuration (nq,) and rates (nv,).
    base_rotation : of the base link (3, 3).
    M, H : inertia matrix M^js (nv, nv) and bias force H^js (nv,), gravity included [SI].
    com, com_velocity : c and its rate (3,) [m, m/s].
    A_c, B_c : Jacobian (3, nv) and drift (3,) of the CoM.
    momentum : linear then centroidal angular momentum (6,) [kg m/s, kg m^2/s]; ``momentum[4]`` is L.
    A_h, B_h : centroidal momentum matrix (6, nv) and drift (6,).
    rho : pitch inertia about the CoM, rho_total [kg m^2].
    J_rho, drift_rho : its Jacobian (nv,) and drift [kg m^2/s^2].
    toe, heel, sole : places of the middles of the soles' front edge, rear edge, and of the sole itself (2, 3) [m].
    toe_velocity, heel_velocity, sole_velocity : (2, 3) [m/s].
    J_toe, drift_toe : Jacobian (2, 6, nv), linear then angular, and drift (2, 6) of the tiptoes; J^js of the paper.
    J_heel, drift_heel : linear Jacobian (2, 3, nv) and drift (2, 3) of the heels.
    foot_com, foot_com_rate : sole minus CoM, p_rd, and its rate (2, 3).
    J_rd, drift_rd : Jacobian (2, 3, nv) and drift (2, 3) of p_rd.
    foot_rotation : rotation matrices of the feet (2, 3, 3).
    foot_spin : angular velocity of the feet, world axes (2, 3) [rad/s].
    """

    q: np.ndarray
    v: np.ndarray
    base_rotation: np.ndarray
    M: np.ndarray
    H: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    A_c: np.ndarray
    B_c: np.ndarray
    momentum: np.ndarray
    A_h: np.ndarray
    B_h: np.ndarray
    rho: float
    J_rho: np.ndarray
    drift_rho: float
    toe: np.ndarray
    heel: np.ndarray
    sole: np.ndarray
    toe_velocity: np.ndarray
    heel_velocity: np.ndarray
    sole_velocity: np.ndarray
    J_toe: np.ndarray
    drift_toe: np.ndarray
    J_heel: np.ndarray
    drift_heel: np.ndarray
    foot_com: np.ndarray
    foot_com_rate: np.ndarray
    J_rd: np.ndarray
    drift_rd: np.ndarray
    foot_rotation: np.ndarray
    foot_spin: np.ndarray

    @property
    def J(self) -> np.ndarray:
        """J^js (12, nv): both tiptoes, so that the ground acts on the robot as J^T F."""
        return self.J_toe.reshape(12, -1)

    @property
    def A_f(self) -> np.ndarray:
        """A_f (6, 12): A_f F is the rate of linear momentum without gravity, then of centroidal angular momentum."""
        left, right = skew(self.toe - self.com)
        out = np.concatenate([np.eye(6), np.eye(6)], 1)
        out[3:, :3], out[3:, 6:9] = left, right
        return out

    @property
    def rho_rate(self) -> float:
        """d rho / dt [kg m^2/s]."""
        return float(self.J_rho @ self.v)

    @property
    def foot_pitch(self) -> np.ndarray:
        """Pitch of the feet (2,) [rad]; positive is heel up."""
        return pitch_of(self.foot_rotation)


class FullMotion(NamedTuple):
    """What feedback needs to know at one (q, v): names and values as in :class:`FullTerms`, at less than half the cost.

    ``rho_rate`` is d rho / dt [kg m^2/s].
    """

    q: np.ndarray
    v: np.ndarray
    base_rotation: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    momentum: np.ndarray
    rho: float
    rho_rate: float
    toe: np.ndarray
    heel: np.ndarray
    toe_velocity: np.ndarray
    heel_velocity: np.ndarray
    foot_com: np.ndarray
    foot_com_rate: np.ndarray
    foot_rotation: np.ndarray
    foot_spin: np.ndarray

    @property
    def foot_pitch(self) -> np.ndarray:
        """Pitch of the feet (2,) [rad]; positive is heel up."""
        return pitch_of(self.foot_rotation)


def pitch_of(rotation: np.ndarray) -> np.ndarray:
    """Pitch (n,) of rotations (n, 3, 3) about +y [rad]."""
    return np.arctan2(-rotation[:, 2, 0], rotation[:, 0, 0])


def force_target(mass: float, gravity: float, com_acceleration: np.ndarray, momentum_rate: np.ndarray) -> np.ndarray:
    """B_f (6,): what A_f F must be for a CoM acceleration (3,) and a rate of centroidal angular momentum (3,)."""
    lift = np.array([0.0, 0.0, gravity])
    return np.concatenate([mass * (np.asarray(com_acceleration) + lift), momentum_rate])
