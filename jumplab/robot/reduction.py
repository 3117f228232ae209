"""How well the five links of the sagittal plane stand for the full robot, measured on random symmetric motions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.sagittal import SagittalModel
from jumplab.robot.stance import com_from_toe, configuration

if TYPE_CHECKING:  # a robot is checked by this before anybody gets it
    from jumplab.robot.description import Robot

SAMPLES = 24  # fixed random postures over the whole joint range
RATE_RAD_S = 3.0  # of every link, for the momentum
COM_LIMIT_M = 2e-3  # twice what the audit allows the CoM in flight; canted axes beyond it are refused
SHARE_LIMIT = 0.01  # [1] of pitch inertia, and of momentum


@dataclass(frozen=True)
class ReductionError:
    """Largest difference between the sagittal and the full model; the shares are of the largest value seen."""

    mass_kg: float
    com_m: float
    inertia_kgm2: float
    momentum_kgm2_s: float
    inertia_share: float
    momentum_share: float


def reduction_error(robot: Robot) -> ReductionError:
    """Compare mass, CoM, pitch inertia and angular momentum of both models on random symmetric motions."""
    s, data, rng = robot.sagittal, robot.model.createData(), np.random.default_rng(8)
    com, full, flat = [], [], []
    for _ in range(SAMPLES):
        joints = s.lower + rng.uniform(0.05, 0.95, 4) * (s.upper - s.lower)
        angles = s.link_angles(joints, rng.uniform(-0.3, 0.8))
        rates = rng.uniform(-RATE_RAD_S, RATE_RAD_S, 5)
        pin.ccrba(robot.model, data, configuration(robot, angles), _velocity(robot, angles, rates))
        com.append(data.com[0][[0, 2]] - com_from_toe(robot, angles))
        full.append((data.Ig.inertia[1, 1], data.hg.angular[1]))
        flat.append(_planar(s, angles, rates))
    off, top = np.abs(np.subtract(full, flat)).max(axis=0), np.abs(full).max(axis=0)
    mass = abs(robot.total_mass - s.total_mass)
    return ReductionError(mass, float(np.abs(com).max()), *off.tolist(), *(off / top).tolist())


def _planar(s: SagittalModel, angles: np.ndarray, rates: np.ndarray) -> tuple[float, float]:
    """Pitch inertia and angular momentum about the CoM of the five links; vectors as x + iz, turned by exp(-ia)."""
    arms, turn = s.com_arms() @ [1, 1j], np.exp(-1j * angles)
    r, v = (x - s.mass @ x / s.total_mass for x in (arms @ turn, arms @ (-1j * rates * turn)))
    return s.inertia.sum() + s.mass @ np.abs(r) ** 2, s.inertia @ rates - s.mass @ (r.conj() * v).imag


def _velocity(robot: Robot, angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Rates (nv,) of the full robot: toe at rest, links turning at ``rates``."""
    s, v, turn = robot.sagittal, np.zeros(robot.model.nv), np.exp(-1j * angles[:4])
    base = np.array([*s.span[:3], s.base]) @ [1, 1j] @ (-1j * rates[:4] * turn) / turn[3]
    v[0], v[2], v[4] = base.real, base.imag, rates[3]
    joints = s.joint_angles(rates)
    for name, row, sign in robot.role_signs():
        v[robot.model.idx_vs[robot.model.getJointId(name)]] = sign * joints[row]
    return v


def check_reduction(robot: Robot) -> ReductionError:
    """The error, or :class:`RobotError` where the sagittal plane is no model of this robot."""
    error = reduction_error(robot)
    worst = max(error.inertia_share, error.momentum_share)
    if error.com_m > COM_LIMIT_M or worst > SHARE_LIMIT:
        raise RobotError(
            f"robot {robot.name}: its legs do not move in the sagittal plane: against the full robot the CoM is off by "
            f"{1e3 * error.com_m:.2f} mm, inertia or momentum by {100 * worst:.2f} %, at most {1e3 * COM_LIMIT_M:g} mm "
            f"and {100 * SHARE_LIMIT:g} % can be planned with; hold canted joints with [locked], or straighten "
            f"their axes"
        )
    return error
