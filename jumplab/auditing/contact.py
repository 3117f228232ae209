"""Feet and ground: slip, penetration, clearance, centre of pressure, friction; and what else may collide (coal)."""

from __future__ import annotations

from itertools import combinations

import coal
import numpy as np
import pinocchio as pin

from jumplab.auditing.replay import Replay
from jumplab.auditing.report import LIMITS, METHOD, Check


def checks(r: Replay) -> list[Check]:
    """All checks of the group "contact"."""
    return [*_geometry(r), *_pressure(r)]


def _geometry(r: Replay) -> list[Check]:
    t, feet, toe, points = r.tape.t, r.tape.contact_frames, r.toe_corners, r.sole_points  # (N, K, 2, 3), (N, K, P, 3)
    left = r.foot_rotation[..., 1]  # level, heel up or not (N, K, 3)
    slip, turned, hover = (np.zeros(r.carrying.shape) for _ in range(3))
    for k, rows in r.stands:
        at, way = toe[rows, k], left[rows, k]
        slip[rows, k] = np.linalg.norm((at - at[0])[..., :2], axis=-1).max(axis=-1)
        first = np.broadcast_to(way[0], way.shape)
        turned[rows, k] = np.abs(np.arctan2(np.cross(first, way)[..., 2], (first * way)[..., :2].sum(-1)))
        level = r.surface(r.along(at[:1])) if rows.start else 0.0  # every motion begins on the ground at zero
        hover[rows, k] = np.abs(at[..., 2] - level).max(axis=-1)
    above = 1e3 * (points[..., 2] - r.surface(r.along(points))).min(axis=-1)  # (N, K)
    middle = np.zeros(len(t), bool)
    for rows in r.flights:
        share = (t[rows] - t[rows][0]) / np.ptp(t[rows])
        middle[rows] = (share >= METHOD.mid_flight[0]) & (share <= METHOD.mid_flight[1])
    clear = [LIMITS["foot clearance"].worst(above[middle], t[middle], feet)] if middle.any() else []
    return [
        LIMITS["toe slip"].worst(1e3 * slip, t, feet),
        LIMITS["foot turn"].worst(1e3 * turned, t, feet),
        LIMITS["toe on the ground"].worst(1e3 * hover, t, feet),
        LIMITS["penetration"].worst(-above, t, feet),
        *clear,
    ]


def _pressure_points(r: Replay) -> tuple[np.ndarray, np.ndarray]:
    """CoP on the ground (N, K, 2) [m], nan without load, and torsion about it (N, K) [N m]."""
    force, moment = r.tape.f[..., :3], r.tape.f[..., 3:]
    up = np.where(force[..., 2] > METHOD.cop_force_n, force[..., 2], np.nan)
    ground = r.surface(r.along(r.toe_corners.mean(axis=2)))  # where a foot stands on a step its CoP is up there
    down = ground - r.foot[..., 2]  # from the frame's origin to it
    dx = (down * force[..., 0] - moment[..., 1]) / up
    dy = (down * force[..., 1] + moment[..., 0]) / up
    torsion = moment[..., 2] - (dx * force[..., 1] - dy * force[..., 0])
    return r.foot[..., :2] + np.stack([dx, dy], axis=-1), torsion


def _pressure(r: Replay) -> list[Check]:
    t, feet, force, friction = r.tape.t, r.tape.contact_frames, r.tape.f, LIMITS["friction used"].limit
    load = force[..., 2]
    cop, torsion = _pressure_points(r)
    heading = r.foot_rotation[..., :2, 0]
    heading = heading / np.maximum(np.linalg.norm(heading, axis=-1, keepdims=True), 1e-9)  # (N, K, 2) heel to toe
    side = np.stack([-heading[..., 1], heading[..., 0]], axis=-1)
    toe, heel = (x[..., :2].mean(axis=2) for x in (r.toe_corners, r.heel_corners))
    ahead = ((cop - toe) * heading).sum(-1)  # of the toe edge
    length = ((toe - heel) * heading).sum(-1)  # of the sole, seen from above
    aside = np.abs(((cop - toe) * side).sum(-1)) - np.array([(s.left - s.right) / 2 for s in r.soles])
    outside = np.maximum.reduce([ahead, -ahead - length, aside])
    raised = 1e3 * r.heel_corners[..., 2].min(axis=-1) > METHOD.heel_up_mm
    loaded = load > METHOD.cop_force_n
    some = loaded.any(axis=1)  # rows with something to check
    beyond, tipped = np.where(loaded, outside, -np.inf), np.where(loaded & raised, np.abs(ahead), 0.0)
    used = np.linalg.norm(force[..., :2], axis=-1) / np.maximum(load, METHOD.friction_force_n)
    twist = np.abs(torsion) / (friction * METHOD.torsion_arm_m * np.where(loaded, load, 1.0))
    return [
        LIMITS["CoP in the sole"].worst(1e3 * beyond[some], t[some], feet),
        LIMITS["CoP at the toe"].worst(1e3 * tipped, t, feet),
        LIMITS["torsional friction"].worst(100 * np.where(loaded, twist, 0.0), t, feet, friction=friction),
        LIMITS["friction used"].worst(used, t, feet),
        LIMITS["ground only pushes"].worst(-load, t, feet),
    ]


def collisions(r: Replay) -> list[Check]:
    """All checks of the group "collision": links that are no neighbours, and the body and its surroundings."""
    geometry = r.geometry.copy()
    _add_self_pairs(r, geometry)
    n_self = len(geometry.collisionPairs)
    _add_surroundings(r, geometry)
    rows = np.unique([*range(0, len(r.tape.t), METHOD.collision_step), len(r.tape.t) - 1])
    data, shapes, gap = r.model.createData(), geometry.createData(), []
    for q in r.tape.q[rows]:
        pin.computeDistances(r.model, data, geometry, shapes, q)
        gap.append([1e3 * d.min_distance for d in shapes.distanceResults])
    gap, name = np.array(gap), [shape.name for shape in geometry.geometryObjects]
    pairs = [f"{name[p.first]} - {name[p.second]}" for p in geometry.collisionPairs]
    return [
        LIMITS["self-collision"].worst(gap[:, :n_self], r.tape.t[rows], pairs[:n_self]),
        LIMITS["body clearance"].worst(gap[:, n_self:], r.tape.t[rows], pairs[n_self:]),
    ]


def _add_self_pairs(r: Replay, geometry: pin.GeometryModel) -> None:
    """Pairs of different links, neither of which is the other's parent joint."""
    joint, parents = [shape.parentJoint for shape in geometry.geometryObjects], r.model.parents
    for (i, a), (k, b) in combinations(enumerate(joint), 2):
        if a != b and parents[a] != b and parents[b] != a:
            geometry.addCollisionPair(pin.CollisionPair(i, k))


def _add_surroundings(r: Replay, geometry: pin.GeometryModel) -> None:
    """The lower surface as a half space, the higher one as a block; pairs with every link but the feet."""
    feet = {r.model.frames[r.model.getFrameId(str(n))].parentJoint for n in r.tape.contact_frames}
    bodies = [i for i, s in enumerate(geometry.geometryObjects) if s.parentJoint not in feet]
    low, high = sorted((0.0, r.platform))
    below = coal.Halfspace(np.array([0.0, 0.0, 1.0]), low)
    blocks = [pin.GeometryObject("ground", 0, 0, pin.SE3.Identity(), below)]
    if high - low > 1e-6:
        towards, size = r.heading if r.platform > 0 else -r.heading, METHOD.block_m
        turn = pin.rpy.rpyToMatrix(0.0, 0.0, r.task.along_rad if r.task else 0.0)
        centre = turn @ np.array([r.edge + towards * size / 2, 0.0, high - size / 2])
        blocks.append(pin.GeometryObject("platform", 0, 0, pin.SE3(turn, centre), coal.Box(size, size, size)))
    for block in blocks:
        index = geometry.addGeometryObject(block)
        for i in bodies:
            geometry.addCollisionPair(pin.CollisionPair(i, index))
