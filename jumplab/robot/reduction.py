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
COM_LIMIT_M = 2e-3  # twice what the audit allows the CoM in flight; canted axes go beyond it
SHARE_LIMIT = 0.01  # [1] of pitch inertia, and of momentum
SAME_M, EXACT_M = 0.02, 1e-6  # between a joint and the mirror image of its counterpart: built alike; evened out
EXACT_SHARE = 1e-5  # of a body's mass, and of its centre [m], to its counterpart's


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
    s, model, rng = robot.sagittal, robot.model, np.random.default_rng(8)
    data = model.createData()
    com, full, flat = [], [], []
    for _ in range(SAMPLES):
        joints = s.lower + rng.uniform(0.05, 0.95, 4) * (s.upper - s.lower)
        angles = s.link_angles(joints, rng.uniform(-0.3, 0.8))
        rates = rng.uniform(-RATE_RAD_S, RATE_RAD_S, 5)
        pin.ccrba(model, data, configuration(robot, angles), _velocity(robot, angles, rates))
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
    s, model, turn = robot.sagittal, robot.model, np.exp(-1j * angles[:4])
    v = np.zeros(model.nv)
    base = np.array([*s.span[:3], s.base]) @ [1, 1j] @ (-1j * rates[:4] * turn) / turn[3]
    v[0], v[2], v[4] = base.real, base.imag, rates[3]
    joints = s.joint_angles(rates)
    for name, row, sign in robot.role_signs():
        v[model.idx_vs[model.getJointId(name)]] = sign * joints[row]
    return v


def mirror(model: pin.Model, most_m: float = SAME_M) -> list[tuple[int, int, float]]:
    """Joints that mirror each other in the x-z plane of the neutral pose: (index, index, sign), indices into v[6:].

    A joint in the middle is its own counterpart; one without any is left out. Mirrored motions have
    ``v[6 + other] = sign * v[6 + one]``. Places may differ by ``most_m`` [m], axes by as many radians.
    """
    data, flip, found = model.createData(), np.array([1.0, -1.0, 1.0]), []
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model))
    axis = [jacobian[3:, model.idx_vs[j]] for j in range(2, model.njoints)]
    place = [data.oMi[j].translation for j in range(2, model.njoints)]
    for i in range(len(axis)):
        gaps = []
        for k in range(len(axis)):
            sign = 1.0 if -flip * axis[i] @ axis[k] > 0 else -1.0
            off = np.abs(flip * place[i] - place[k]).max(), np.abs(-sign * flip * axis[i] - axis[k]).max()
            gaps.append((max(off), k, sign))
        gap, k, sign = min(gaps)
        if gap < most_m and k >= i:
            found.append((i, k, sign))
    return found


def in_plane(robot: Robot) -> bool:
    """Whether five links describe a robot: its moving joints are those of legs and swinging arms, left and right are
    alike, and mass, CoM, inertia and momentum are those of the full robot."""
    model, pairs = robot.model, mirror(robot.model, EXACT_M)
    feet = [model.frames[model.getFrameId(name)].parentJoint for name in robot.foot.frames]
    in_legs = {j for foot in feet for j in model.supports[foot]}
    others = {model.names[j] for j in range(2, model.njoints) if j not in in_legs}
    bodies = [(model.inertias[2 + i], model.inertias[2 + k]) for i, k, _ in pairs]
    even = all(_alike(a, b) for a, b in [(model.inertias[1], model.inertias[1]), *bodies])
    if others - set(robot.joints["shoulder_pitch"]) or len({i for row in pairs for i in row[:2]}) < model.nv - 6:
        return False
    try:
        error = reduction_error(robot)
    except RobotError:
        return False
    return even and error.com_m <= COM_LIMIT_M and max(error.inertia_share, error.momentum_share) <= SHARE_LIMIT


def _alike(left: pin.Inertia, right: pin.Inertia) -> bool:
    """Whether two bodies, in parallel frames, have mirrored masses and centres."""
    off = np.abs(left.lever * [1.0, -1.0, 1.0] - right.lever).max() * left.mass
    return abs(left.mass - right.mass) <= EXACT_SHARE * left.mass and off <= EXACT_SHARE * left.mass
