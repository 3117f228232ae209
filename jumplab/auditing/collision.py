"""Distances between links that are not neighbours, and between the body and its surroundings (coal)."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from jumplab.auditing import limits as lim
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check, worst

GROUP = "collision"
EVERY = 2  # samples: the fastest hand moves 2 cm in 2 ms, and contact between links lasts longer than that
BLOCK_M = 20.0  # size of the ground and platform blocks, larger than any jump
WORLD_JOINT = 0


def _pair_name(geometry, pair) -> str:
    shapes = [geometry.geometryObjects[i].name for i in (pair.first, pair.second)]
    return " - ".join(shapes)


def _add_self_pairs(r: Replay, geometry) -> None:
    """Pairs of different links, neither of which is the other's parent joint."""
    shapes, parents = geometry.geometryObjects, r.model.parents
    for i in range(len(shapes)):
        for k in range(i + 1, len(shapes)):
            a, b = shapes[i].parentJoint, shapes[k].parentJoint
            if a != b and parents[a] != b and parents[b] != a:
                geometry.addCollisionPair(pin.CollisionPair(i, k))


def _add_surroundings(r: Replay, geometry) -> None:
    """The lower surface as a half space, the higher one as a block; pairs with every link but the feet."""
    feet = {r.model.frames[r.model.getFrameId(str(n))].parentJoint for n in r.tape.contact_frames}
    bodies = [i for i, s in enumerate(geometry.geometryObjects) if s.parentJoint not in feet]
    low, high = sorted((0.0, r.platform))
    below = coal.Halfspace(np.array([0.0, 0.0, 1.0]), low)
    blocks = [pin.GeometryObject("ground", WORLD_JOINT, 0, pin.SE3.Identity(), below)]
    if high - low > 1e-6:
        towards = r.heading if r.platform > 0 else -r.heading
        centre = np.array([r.edge + towards * BLOCK_M / 2, 0.0, high - BLOCK_M / 2])
        box = coal.Box(BLOCK_M, BLOCK_M, BLOCK_M)
        blocks.append(pin.GeometryObject("platform", WORLD_JOINT, 0, pin.SE3(np.eye(3), centre), box))
    for block in blocks:
        index = geometry.addGeometryObject(block)
        for i in bodies:
            geometry.addCollisionPair(pin.CollisionPair(i, index))


def _distances(r: Replay, geometry, rows: np.ndarray) -> np.ndarray:
    """(len(rows), pairs) signed distances [m]."""
    data, shapes = r.model.createData(), geometry.createData()
    out = np.empty((len(rows), len(geometry.collisionPairs)))
    for at, i in enumerate(rows):
        pin.computeDistances(r.model, data, geometry, shapes, r.tape.q[i])
        out[at] = [d.min_distance for d in shapes.distanceResults]
    return out


def checks(r: Replay) -> list[Check]:
    """All checks of this group."""
    geometry = r.geometry.copy()
    _add_self_pairs(r, geometry)
    n_self = len(geometry.collisionPairs)
    _add_surroundings(r, geometry)
    rows = np.unique([*range(0, len(r.tape.t), EVERY), len(r.tape.t) - 1])
    gap = 1e3 * _distances(r, geometry, rows)
    names = [_pair_name(geometry, p) for p in geometry.collisionPairs]
    t = r.tape.t[rows]
    return [
        worst(GROUP, "self-collision", gap[:, :n_self], t, lim.SELF_DISTANCE_MM, "mm",
              "smallest distance between links that are not neighbours (negative: overlap)", at_least=True,
              labels=names[:n_self]),
        worst(GROUP, "body clearance", gap[:, n_self:], t, lim.BODY_CLEARANCE_MM, "mm",
              "smallest distance of anything but the feet from ground and platform", at_least=True,
              labels=names[n_self:]),
    ]  # fmt: skip
