"""Which coordinates of a robot a program moves: all of them, those of an even motion, or those of a
planar one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.models.spatial import CHART
from jumplab.robot.stance import stance_configuration

if TYPE_CHECKING:
    from jumplab.stages.whole_body.body import Body

BASE = len(CHART)
PITCH = CHART.index("pitch")
IN_PLANE = [0, 2, PITCH]  # x, z, pitch
SAME_RAD = 1e-9  # between the stance and the one that such coordinates can say


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Free coordinates of the chart, and how all of it follows from them: chart = spread @ x +
    rest.

    Attributes
    ----------
    kind : "whole" (every coordinate is free), "even" (the right half mirrors the left one) or
        "plane" (only joints that turn about the pitch axis move besides).
    free : columns of the chart that are free.
    spread, rest : (6 + joints, free), (6 + joints,).
    """

    kind: str
    names: tuple[str, ...]  # of the chart
    free: tuple[int, ...]
    spread: np.ndarray
    rest: np.ndarray

    @property
    def even(self) -> bool:
        """Whether left and right are mirror images: feet, forces and torques of the left side stand
        for both.
        """
        return self.kind != "whole"

    @property
    def plane(self) -> bool:
        """Whether only x, z and pitch of a foot can move."""
        return self.kind == "plane"

    @property
    def sides(self) -> tuple[int, ...]:
        """Feet that the program has forces of."""
        return (0,) if self.even else (0, 1)

    @property
    def size(self) -> int:
        """Number of free coordinates."""
        return len(self.free)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free coordinates."""
        return tuple(self.names[k] for k in self.free)

    @cached_property
    def joints(self) -> list[int]:
        """Free joints, in the order of the joints."""
        return [k - BASE for k in self.free if k >= BASE]

    @property
    def places(self) -> list[int]:
        """Which of x, y, z can change."""
        return [k for k in self.free if k < 3]

    @property
    def turns(self) -> list[int]:
        """Indices of yaw, roll and pitch among the free coordinates, of those that are free."""
        return [i for i, k in enumerate(self.free) if 3 <= k < BASE]

    @property
    def spins(self) -> list[int]:
        """Which components of a moment or of an angular momentum can change."""
        return [1] if self.even else [0, 1, 2]

    @property
    def foot(self) -> list[int]:
        """Which of the six rows of a foot can change: x, y, z, heading, roll, pitch."""
        return IN_PLANE if self.plane else list(range(6))

    def chart(self, x: ca.SX, level: int = 0) -> ca.SX:
        """The chart (6 + joints,), or with ``level`` 1 or more its rates, from the free
        coordinates.
        """
        if not self.even:
            return x[: self.size]
        return ca.sparsify(ca.DM(self.spread)) @ x[: self.size] + (0 if level else self.rest)

    def charts(self, x: np.ndarray, level: int = 0) -> np.ndarray:
        """The same for numbers (n, free): (n, 6 + joints)."""
        return x[:, : self.size] @ self.spread.T + (0.0 if level else self.rest)

    def taken(self, charts: np.ndarray) -> np.ndarray:
        """The free coordinates (..., free) of charts (..., 6 + joints)."""
        return charts[..., list(self.free)]

    def within(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the free coordinates from bounds of the chart (6 + joints,): the tighter of
        both sides.
        """
        same = self.spread.T > 0
        opposite = self.spread.T < 0
        least = np.where(same, low, np.where(opposite, -high, -np.inf)).max(axis=1)
        most = np.where(same, high, np.where(opposite, -low, np.inf)).min(axis=1)
        return least, most


def whole(body: Body) -> Coordinates:
    """Every coordinate."""
    n = len(body.model.names)
    return Coordinates("whole", body.model.names, tuple(range(n)), np.eye(n), np.zeros(n))


def even(body: Body) -> Coordinates:
    """Those of even motions: in the plane for a robot that five links describe, else of its left
    half.

    Every coordinate of a robot whose halves are no mirror images, or whose feet then would not be
    free to move.
    """
    if body.robot.planar:
        return in_plane(body)
    if body.short or not body.mirrored:
        return whole(body)
    return _mirrored(body, "even", set(body.joint_names))


def in_plane(body: Body) -> Coordinates:
    """Those of even motions whose feet stay in their planes: of the legs only joints with a role
    move, and of a robot that five links describe no other ones. Every coordinate of a robot whose
    feet would leave the plane then."""
    if not body.mirrored:
        return whole(body)
    moving = {name for pair in body.robot.joints.values() for name in pair}
    if body.robot.planar:
        return _mirrored(body, "plane", moving)
    legs = {body.joint_names[k - 1] for foot in body.feet for k in body.chain(foot)}
    if not _feet_stay(body, moving & legs):
        return whole(body)
    return _mirrored(body, "plane", moving | set(body.joint_names) - legs)


KINDS = {"whole": whole, "even": even, "plane": in_plane}


def _mirrored(body: Body, kind: str, moving: set[str]) -> Coordinates:
    """Even motions of the ``moving`` joints; the others stay as in the stance, which they have to
    contain.
    """
    model = body.model
    n = len(model.names)
    columns = {k: np.eye(n)[k] for k in IN_PLANE}
    for i, k, sign in model.pairs:
        one, other = (i, k) if i + 1 in model.left_half else (k, i)
        if (i != k or sign > 0) and body.joint_names[one] in moving:
            columns[BASE + one] = np.eye(n)[BASE + one] + (i != k) * sign * np.eye(n)[BASE + other]
    free = tuple(sorted(columns))
    spread = np.array([columns[k] for k in free]).T
    rest = np.where(spread.any(axis=1), 0.0, body.stance)
    rest[[1, 3, 4]] = 0.0
    coordinates = Coordinates(kind, model.names, free, spread, rest)
    again = coordinates.charts(coordinates.taken(body.stance[None]))[0]
    return coordinates if np.abs(again - body.stance).max() < SAME_RAD else whole(body)


def _feet_stay(body: Body, moving: set[str]) -> bool:
    """Whether the legs' ``moving`` joints all turn about y in the stance: then feet keep their
    distance from the plane, heading and roll.
    """
    tree = body.robot.model
    slopes = pin.computeJointJacobians(tree, tree.createData(), stance_configuration(body.robot))
    columns = [BASE + body.joint_names.index(name) for name in moving]
    return bool(np.abs(slopes[3::2][:, columns]).max() < SAME_RAD)
