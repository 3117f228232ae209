"""Which links can meet, found from the robot's shapes, and how far apart a face of one keeps the other."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.models.spatial import SpatialModel, SpatialState
from jumplab.robot import Robot

SAMPLES = 400  # postures within the joints' ranges, in which every pair that can meet is seen to
NEAR_M = 0.01  # so close they count as meeting there
STANDING_M = 0.005  # that a face keeps two links apart in the stance, to be of use
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


def pairs(robot: Robot, model: SpatialModel, bodies: set[int], stance: np.ndarray) -> list[Pair]:
    """Pairs of links among ``bodies`` that can meet, each with the face that rules out the fewest postures.

    A pair that no face keeps apart in the ``stance`` (nq,) is left out.
    """
    found, geometry = boxes(robot, model)
    above = [b.parent for b in model.bodies]
    for i, k in combinations(range(len(found)), 2):
        a, b = found[i].body, found[k].body
        neighbours = a == b or (b and above[b] == a) or (a and above[a] == b)
        if not neighbours and {a, b} <= bodies:
            geometry.addCollisionPair(pin.CollisionPair(i, k))
    if not len(geometry.collisionPairs):
        return []
    apart, turns, places = _postures(model, geometry, stance)
    out = []
    for (i, k), distance in zip(((p.first, p.second) for p in geometry.collisionPairs), apart.T, strict=True):
        if distance.min() < NEAR_M:
            free = distance > NEAR_M
            ways = [w for w in _faces(found[i], found[k]) + _faces(found[k], found[i]) if _open(w, turns, places)[0]]
            kept = [np.sum(_open(way, turns[free], places[free])) for way in ways]
            out += [ways[int(np.argmax(kept))]] if ways else []
    return out


def _postures(model: SpatialModel, geometry: pin.GeometryModel, stance: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of the stance and of postures all over the joints' ranges: distances of the pairs (n, k), attitudes of the bodies
    (n, bodies, 3, 3) and their places (n, bodies, 3)."""
    tree = model.model
    data, shapes, q = tree.createData(), geometry.createData(), np.array(stance)
    low, high = tree.lowerPositionLimit[7:], tree.upperPositionLimit[7:]
    primes = [n for n in range(2, 20 * len(low) + 10) if all(n % d for d in range(2, n))][: len(low)]
    apart, turns, places = [], [], []
    for k in range(SAMPLES):  # multiples of irrational numbers fill the box evenly
        if k:
            q[7:] = low + (high - low) * ((k * np.sqrt(primes)) % 1.0)
        pin.computeDistances(tree, data, geometry, shapes, q)
        apart.append([d.min_distance for d in shapes.distanceResults])
        turns.append([data.oMi[j].rotation @ b.own for j, b in enumerate(model.bodies, start=1)])
        places.append([data.oMi[j].translation.copy() for j in range(1, tree.njoints)])
    return np.array(apart), np.array(turns), np.array(places)


def _faces(a: Box, b: Box) -> list[Pair]:
    return [Pair(a, b, sign * a.axes[:, i], a.half[i]) for i in range(3) for sign in (-1.0, 1.0)]


def _open(pair: Pair, turns: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Whether the face keeps the pair apart in each posture (n,)."""
    return _gaps(pair, turns, places) > STANDING_M


def _gaps(pair: Pair, turns: np.ndarray, places: np.ndarray) -> np.ndarray:
    """:meth:`Pair.gap` in postures (n, bodies, 3, 3), (n, bodies, 3), with sharp corners (n,)."""
    a, b = pair.first, pair.second
    way = turns[:, a.body] @ pair.way
    middle = places[:, b.body] + turns[:, b.body] @ b.centre - places[:, a.body] - turns[:, a.body] @ a.centre
    along = turns[:, b.body] @ (b.axes * b.half)
    spread = np.abs(np.einsum("ni,nij->nj", way, along)).sum(1)
    return np.einsum("ni,ni->n", way, middle) - pair.reach - spread
