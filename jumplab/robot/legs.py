"""Inverse kinematics of the legs: the joints that bring the feet to their places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from jumplab.robot.contact import Anchor, on_feet, posed
from jumplab.robot.files import LEG
from jumplab.robot.stance import stance_configuration

if TYPE_CHECKING:
    from jumplab.robot.description import Robot

# of the robot on which numbers in SI units were found: thigh and shank, and all of it
LEG_M = 0.7
MASS_KG = 42.0
# kg, m and s of units
UNITS = {
    "m": (0, 1, 0),
    "s": (0, 0, 1),
    "m/s": (0, 1, -1),
    "rad/s": (0, 0, -1),
    "rad/s^2": (0, 0, -2),
    "N": (1, 1, -2),
    "N m": (1, 2, -2),
    "N m s": (1, 2, -1),
    "kg m^2": (1, 2, 0),
    # of weights, over time
    "1/s": (0, 0, -1),
    "s^-2": (0, 0, -2),
    "m^-2": (0, -2, 0),
    "m^-2/s": (0, -2, -1),
    "(m/s)^-2": (0, -2, 2),
    "(m/s)^-2/s": (0, -2, 1),
    "(rad/s^2)^-2": (0, 0, 4),
    "(rad/s^2)^-2/s": (0, 0, 3),
    "(rad/s^3)^-2/s": (0, 0, 5),
    "N^-2/s": (-2, -2, 3),
    "(N m)^-2/s": (-2, -4, 3),
}
LOCAL = pin.ReferenceFrame.LOCAL
BASE = 6  # columns of the base


@dataclass(frozen=True)
class Size:
    """Ratios of a robot's length and mass to those of the robot on which numbers were found [1].

    Under the same gravity, alike robots move alike if times grow by the root of the length
    (Froude's law).
    """

    length: float
    mass: float

    def of(self, value: float | np.ndarray, unit: str) -> Any:
        """A ``value`` [``unit``, one of :data:`UNITS`] that was found for the one robot, as it is
        for this one.
        """
        kg, m, s = UNITS[unit]
        return value * (self.mass**kg * self.length ** (m + s / 2))

    def scaled(self, settings: Any, units: Mapping[str, str]) -> Any:
        """A dataclass of ``settings`` with the numbers, and tuples of them, that have ``units``
        [name -> one of :data:`UNITS`] as they are for this robot.
        """
        moved = {}
        for name, unit in units.items():
            value = getattr(settings, name)
            many = isinstance(value, tuple)
            moved[name] = tuple(self.of(x, unit) for x in value) if many else self.of(value, unit)
        return replace(settings, **moved)


def size(robot: Robot) -> Size:
    """The size of a ``robot``, by its mass, and by thigh and shank between the pitch axes."""
    ratios = sum(segments_m(robot)) / LEG_M, robot.total_mass / MASS_KG
    # without the last digits, so that the one robot has the numbers as they stand
    return Size(*(round(x, 9) for x in ratios))


def segments_m(robot: Robot) -> tuple[float, float]:
    """Lengths of thigh and shank of the left leg, between its pitch axes [m]."""
    data = posed(robot.model)
    joints = [robot.model.getJointId(robot.joints[role][0]) for role in LEG]
    places = np.array([data.oMi[joint].translation[[0, 2]] for joint in joints])
    thigh, shank = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return float(thigh), float(shank)


def leg_columns(robot: Robot) -> list[np.ndarray]:
    """Columns of the rates that move each foot alone, of the left and of the right leg; of longer
    legs the six that move it best in the stance.

    A waist above both hips, where the base is the trunk, belongs to neither.
    """
    from scipy.linalg import qr  # slow to import

    model = robot.model
    data = posed(model, stance_configuration(robot))
    feet = [anchor.joint for anchor in on_feet(robot, np.zeros(3))]
    out = []
    for foot, other in zip(feet, feet[::-1], strict=True):
        chain = sorted(set(model.supports[foot]) - set(model.supports[other]))
        columns = np.array([model.idx_vs[joint] for joint in chain])
        slope = pin.getJointJacobian(model, data, foot, LOCAL)[:, columns]
        out.append(np.sort(columns[qr(slope, pivoting=True)[2][:6]]))
    return out


def give_of(robot: Robot) -> np.ndarray:
    """Weight with which each column (nv,) moves: joints of legs 1, others and the base 0."""
    give = np.zeros(robot.model.nv)
    give[np.concatenate(leg_columns(robot))] = 1.0
    return give


def bring_feet(
    model: pin.Model,
    data: pin.Data,
    q: np.ndarray,
    goals: Mapping[Anchor, pin.SE3],
    give: np.ndarray,
    *,
    limits: tuple[np.ndarray, np.ndarray] | None = None,
    damping: float = 0.0,
    most_rad: float = np.inf,
    steps: int = 10,
    near: float = 1e-10,
) -> tuple[np.ndarray, np.ndarray]:
    """The configuration (nq,) near ``q`` (nq,) whose feet are at ``goals``, and what they miss.

    Newton's method, each step the least motion in shares of what columns give.

    Parameters
    ----------
    goals : placement in the world, by anchor.
    give : (nv,) how readily each column moves [1]; 0 stays where it is.
    limits : least and largest joint angles (nq - 7,) [rad].
    damping : of the steps [m^2, rad^2], where legs are nearly straight.  most_rad : most of a step.
    steps : at most.  near : what feet may miss [m, rad].

    Returns the configuration, and (anchors, 6) of each foot's way left, in its axes [m, rad].
    """
    q = q.copy()
    for left in range(steps, -1, -1):
        pin.computeJointJacobians(model, data, q)
        missed = [a.place(data).actInv(goal) for a, goal in goals.items()]
        ways = np.array([pin.log6(x).vector for x in missed])
        if not left or np.abs(ways).max() < near:
            break
        rows = [a.slope(model, data, LOCAL) for a in goals]
        step = least_motion(np.concatenate(rows), ways.ravel(), give, damping)
        q = pin.integrate(model, q, np.clip(step, -most_rad, most_rad))
        if limits is not None:
            q[7:] = np.clip(q[7:], *limits)
    return q, ways


def least_motion(
    rows: np.ndarray, missed: np.ndarray, give: np.ndarray, damping: float = 0.0
) -> np.ndarray:
    """The least x (nv,), in shares of what columns ``give`` (nv,), with rows (k, nv) @ x = missed
    (k,), or as near as can be; ``damping`` as of :func:`bring_feet`.
    """
    slope = rows * give
    inner = slope @ slope.T + damping * np.eye(len(missed))
    return give * (slope.T @ np.linalg.lstsq(inner, missed, rcond=None)[0])
