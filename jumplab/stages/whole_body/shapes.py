"""Which links can meet, found from the robot's shapes, and how far apart a face of one keeps the other."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.models.spatial import SpatialModel, SpatialState
from jumplab.robot import Robot

ROUNDED_M = 1e-3  # by which the corner of a box gives way, so that the distance has a slope everywhere


@dataclass(frozen=True)
class Box:
    """A link's collision shape, or the box around it, in the frame of its body."""

    name: str
    body: int
    centre: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3), columns
    half: np.ndarray  # (3,) half sizes [m]


@dataclass(frozen=True)
class Pair:
    """Two boxes that a face of the first keeps apart: ``way`` (3,) points out of it, at ``reach`` from its centre."""

    first: Box
    second: Box
    way: np.ndarray  # in the frame of the first one's body
    reach: float
    face: int  # which of the first one's six

    @property
    def name(self) -> str:
        """Both links."""
        return f"{self.first.name} and {self.second.name}"

    @property
    def key(self) -> str:
        """Both links, and the face."""
        return f"{self.name} apart, face {self.face}"

    def gap(self, s: SpatialState) -> ca.SX:
        """Distance of the second box from the plane of that face [m]; negative behind it."""
        a, b = self.first, self.second
        way = s.rotation(a.body) @ ca.DM(self.way)
        middle = s.point(b.body, b.centre) - s.point(a.body, a.centre)
        along = s.rotation(b.body) @ ca.DM(b.axes * b.half)
        spread = sum(ca.sqrt(ca.dot(way, along[:, i]) ** 2 + ROUNDED_M**2) for i in range(3))
        return ca.dot(way, middle) - self.reach - spread


def boxes(robot: Robot, model: SpatialModel) -> tuple[list[Box], pin.GeometryModel]:
    """The boxes of all links, in the order of the robot's collision shapes, and these."""
    tree, out = model.model, []
    geometry = pin.buildGeomFromUrdfString(tree, robot.urdf, pin.GeometryType.COLLISION)
    for shape in geometry.geometryObjects:
        shape.geometry.computeLocalAABB()
        low, high = shape.geometry.aabb_local.min_, shape.geometry.aabb_local.max_
        own, place = model.bodies[shape.parentJoint - 1].own, shape.placement
        centre = model.local(shape.parentJoint, place.act((low + high) / 2))
        out.append(Box(shape.name, shape.parentJoint - 1, centre, own.T @ place.rotation, (high - low) / 2))
    return out, geometry


def candidates(robot: Robot, model: SpatialModel, found: list[Box]) -> list[tuple[int, int]]:
    """Pairs of links (indices of their boxes) that are no neighbours."""
    above = [b.parent for b in model.bodies]
    out = []
    for i, k in combinations(range(len(found)), 2):
        a, b = found[i].body, found[k].body
        if not (a == b or (b and above[b] == a) or (a and above[a] == b)):
            out.append((i, k))
    return out


def faces(a: Box, b: Box) -> list[Pair]:
    """What each face of the first box makes of the pair."""
    ways = [(i, sign) for i in range(3) for sign in (-1.0, 1.0)]
    return [Pair(a, b, sign * a.axes[:, i], a.half[i], n) for n, (i, sign) in enumerate(ways)]


def gaps(pair: Pair, turns: np.ndarray, places: np.ndarray) -> np.ndarray:
    """:meth:`Pair.gap` in postures (n, bodies, 3, 3), (n, bodies, 3), with sharp corners (n,)."""
    a, b = pair.first, pair.second
    way = turns[:, a.body] @ pair.way
    middle = places[:, b.body] + turns[:, b.body] @ b.centre - places[:, a.body] - turns[:, a.body] @ a.centre
    along = turns[:, b.body] @ (b.axes * b.half)
    spread = np.abs(np.einsum("ni,nij->nj", way, along)).sum(1)
    return np.einsum("ni,ni->n", way, middle) - pair.reach - spread
