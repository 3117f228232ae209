"""The sagittal five-link model against the full robot, on symmetric postures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.description import Robot
from jumplab.robot.stance import com_from_toe, configuration

SAMPLES = 24  # our choice: fixed random postures over the whole joint range
RATE_RAD_S = 3.0  # our choice: of every link, for the momentum
COM_LIMIT_M = 2e-3  # our choice: twice what the audit allows the CoM in flight; canted axes beyond it are refused
SHARE_LIMIT = 0.01  # our choice: of pitch inertia, and of momentum


@dataclass(frozen=True)
class ReductionError:
    """Largest difference between both models.

    Attributes
    ----------
    mass_kg, com_m, inertia_kgm2, momentum_kgm2_s : absolute.
    inertia_share, momentum_share : of the largest value seen.
    """

    mass_kg: float
    com_m: float
    inertia_kgm2: float
    momentum_kgm2_s: float
    inertia_share: float
    momentum_share: float


def _turned(angle: float, vector) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1]])


def _chain(arms, angles, rates) -> tuple[np.ndarray, np.ndarray]:
    """Place and velocity of the tip of vectors, each turned by its own angle."""
    places = [_turned(a, d) for a, d in zip(angles, arms, strict=True)]
    return sum(places), sum(w * np.array([p[1], -p[0]]) for w, p in zip(rates, places, strict=True))


def reduction_error(robot: Robot, samples: int = SAMPLES) -> ReductionError:
    """Compare mass, CoM, pitch inertia and angular momentum of both models on random symmetric motions."""
    model, s = robot.model, robot.sagittal
    data, rng = model.createData(), np.random.default_rng(8)
    off = {"com": 0.0, "inertia": 0.0, "momentum": 0.0}
    top = {"inertia": 1e-9, "momentum": 1e-9}
    for _ in range(samples):
        joints = s.lower + rng.uniform(0.05, 0.95, 4) * (s.upper - s.lower)
        angles = s.link_angles(joints, rng.uniform(-0.3, 0.8))
        rates = rng.uniform(-RATE_RAD_S, RATE_RAD_S, 5)
        q = configuration(robot, angles)
        pin.ccrba(model, data, q, _velocity(robot, angles, rates))
        flat = _planar(s, angles, rates)
        full = data.com[0][[0, 2]], float(data.Ig.inertia[1, 1]), float(data.hg.angular[1])
        off["com"] = max(off["com"], float(np.abs(full[0] - com_from_toe(robot, angles)).max()))
        for key, a, b in (("inertia", full[1], flat[0]), ("momentum", full[2], flat[1])):
            off[key], top[key] = max(off[key], abs(a - b)), max(top[key], abs(a))
    return ReductionError(abs(robot.total_mass - s.total_mass), off["com"], off["inertia"], off["momentum"],
                          off["inertia"] / top["inertia"], off["momentum"] / top["momentum"])  # fmt: skip


def _planar(s, angles, rates) -> tuple[float, float]:
    """Pitch inertia and angular momentum about the CoM of the five links."""
    both = [_chain(arms, angles, rates) for arms in s.com_arms()]
    place, speed = (np.array(x) for x in zip(*both, strict=True))
    com, drift = s.mass @ place / s.total_mass, s.mass @ speed / s.total_mass
    r, v = place - com, speed - drift
    inertia = s.inertia.sum() + s.mass @ (r**2).sum(axis=1)
    return float(inertia), float(s.inertia @ rates + s.mass @ (r[:, 1] * v[:, 0] - r[:, 0] * v[:, 1]))


def _velocity(robot: Robot, angles, rates) -> np.ndarray:
    """Rates (nv,) of the full robot: toe at rest, links turning at ``rates``."""
    s, v = robot.sagittal, np.zeros(robot.model.nv)
    legs = [0, 1, 2, 3]
    _, base = _chain([*s.span[:3], s.base], angles[legs], rates[legs])
    v[[0, 2]] = _turned(-angles[3], base)
    v[4] = rates[3]
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
