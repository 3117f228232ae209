"""Feet and ground: slip, penetration, pressure, friction; and what else may collide (coal)."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product

import coal
import numpy as np
import pinocchio as pin

from jumplab.auditing.replay import Replay, norm
from jumplab.auditing.report import METHOD, Measure

OVER = "block"  # that the robot goes over


def places(r: Replay) -> Iterator[Measure]:
    """Places of the soles: slip, turn, heights over ground and platform."""
    t = r.tape.t
    points = r.sole_points
    slip, turn, hover = np.zeros((3, *r.carrying.shape))
    for k, rows in r.stands:
        toe = r.toe_corners[rows, k]
        left = r.foot_rotation[rows, k, :, 1]  # level, heel up or not
        slip[rows, k] = norm((toe - toe[0])[..., :2]).max(axis=-1)
        turn[rows, k] = np.abs(np.arctan2(np.cross(left[0], left)[:, 2], left[:, :2] @ left[0, :2]))
        # every motion begins on the ground at zero
        level = r.surface(r.along(toe[:1])) if rows.start else 0.0
        hover[rows, k] = np.abs(toe[..., 2] - level).max(axis=-1)
    above = (points[..., 2] - r.surface(r.along(points))).min(axis=-1)  # (N, K)
    middle = np.zeros(len(t), bool)
    for rows in r.flights:
        share = (t[rows] - t[rows][0]) / np.ptp(t[rows])
        middle[rows] = (share >= METHOD.mid_flight[0]) & (share <= METHOD.mid_flight[1])
    yield "toe slip", slip
    yield "foot turn", turn
    yield "toe on the ground", hover
    yield "penetration", -above
    if middle.any():
        yield "foot clearance", above[middle], t[middle]


def pressure_points(r: Replay) -> tuple[np.ndarray, np.ndarray]:
    """CoP on the ground (N, K, 2) [m], nan without load, and torsion about it (N, K) [N m]."""
    fx, fy, fz, mx, my, mz = np.moveaxis(r.tape.f, -1, 0)
    up = np.where(fz > r.method.cop_force_n, fz, np.nan)
    # where a foot stands on a step its CoP is up there
    down = r.surface(r.along(r.toe_corners.mean(axis=2))) - r.foot[..., 2]
    dx = (down * fx - my) / up
    dy = (down * fy + mx) / up
    return r.foot[..., :2] + np.stack([dx, dy], axis=-1), mz - (dx * fy - dy * fx)


def pressure(r: Replay) -> Iterator[Measure]:
    """Pressure under the soles: CoP, friction, and that the ground never pulls."""
    load = r.tape.f[..., 2]
    loaded = load > r.method.cop_force_n
    cop, torsion = pressure_points(r)
    toe, heel = (x[..., :2].mean(axis=2) for x in (r.toe_corners, r.heel_corners))
    heading = r.foot_rotation[..., :2, 0]  # (N, K, 2) heel to toe
    heading = heading / np.maximum(norm(heading), 1e-9)[..., None]
    side = np.stack([-heading[..., 1], heading[..., 0]], axis=-1)
    ahead = ((cop - toe) * heading).sum(-1)  # of the toe edge
    length = ((toe - heel) * heading).sum(-1)  # of the sole, seen from above
    aside = np.abs(((cop - toe) * side).sum(-1)) - [(s.left - s.right) / 2 for s in r.soles]
    outside = np.maximum.reduce([ahead, -ahead - length, aside])
    raised = 1e3 * r.heel_corners[..., 2].min(axis=-1) > r.method.heel_up_mm
    some = loaded.any(axis=1)  # rows with something to check
    twist = np.abs(torsion) / (
        METHOD.friction * r.method.torsion_arm_m * np.where(loaded, load, 1.0)
    )
    used = norm(r.tape.f[..., :2]) / np.maximum(load, r.method.friction_force_n)
    yield "CoP in the sole", np.where(loaded, outside, -np.inf)[some], r.tape.t[some]
    yield "CoP at the toe", np.where(loaded & raised, np.abs(ahead), 0.0)
    yield "torsional friction", np.where(loaded, twist, 0.0)
    yield "friction used", used
    yield "ground only pushes", -load


def collisions(r: Replay) -> Iterator[Measure]:
    """Measures of the group "collision": links that are no neighbours, body and surroundings."""
    geometry = r.geometry.copy()
    parents = r.model.parents
    shapes = list(enumerate(s.parentJoint for s in geometry.geometryObjects))
    inner = [
        (i, k)
        for (i, a), (k, b) in combinations(shapes, 2)
        if a != b and parents[a] != b and parents[b] != a
    ]
    feet = {r.model.frames[k].parentJoint for k in r.frames}
    blocks = [(geometry.addGeometryObject(x), x.name) for x in _surroundings(r)]
    # feet stand on all but what they go over
    outer = [
        (i, block)
        for (block, name), (i, a) in product(blocks, shapes)
        if a not in feet or name == OVER
    ]
    for pair in inner + outer:
        geometry.addCollisionPair(pin.CollisionPair(*pair))
    rows = np.unique([*range(0, len(r.tape.t), METHOD.collision_step), len(r.tape.t) - 1])
    data = r.model.createData()
    geometry_data = geometry.createData()
    gaps = []
    for q in r.tape.q[rows]:
        pin.computeDistances(r.model, data, geometry, geometry_data, q)
        gaps.append([d.min_distance for d in geometry_data.distanceResults])
    names = [shape.name for shape in geometry.geometryObjects]
    pairs = [f"{names[i]} - {names[k]}" for i, k in inner + outer]
    inside, outside = np.split(np.array(gaps), [len(inner)], axis=1)
    yield "self-collision", inside, r.tape.t[rows], None, pairs[: len(inner)]
    yield "body clearance", outside, r.tape.t[rows], None, pairs[len(inner) :]


def _surroundings(r: Replay) -> Iterator[pin.GeometryObject]:
    """The lower surface as a half space, the higher one, if there is one, as a block, and a block
    that the robot goes over.
    """
    low, high = sorted((0.0, r.platform))
    below = coal.Halfspace(np.array([0.0, 0.0, 1.0]), low)
    yield pin.GeometryObject("ground", 0, 0, pin.SE3.Identity(), below)
    if high - low > 1e-6:
        towards = r.heading if r.platform > 0 else -r.heading
        size = METHOD.block_m
        turn = pin.rpy.rpyToMatrix(0.0, 0.0, r.course_rad)
        centre = turn @ np.array([r.edge + towards * size / 2, 0.0, high - size / 2])
        block = coal.Box(size, size, size)
        yield pin.GeometryObject("platform", 0, 0, pin.SE3(turn, centre), block)
    if r.over:
        first, last, top = r.over
        block = coal.Box(last - first, METHOD.block_m, top)
        centre = np.array([r.toes + (first + last) / 2, 0.0, top / 2])
        yield pin.GeometryObject(OVER, 0, 0, pin.SE3(np.eye(3), centre), block)
