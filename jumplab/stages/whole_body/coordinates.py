"""Which coordinates of a robot a program moves: all of them, those of an even motion, or those of a planar one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.models.spatial import CHART

if TYPE_CHECKING:
    from jumplab.stages.whole_body.terms import Body

BASE = len(CHART)
IN_PLANE = [CHART.index(x) for x in ("x", "z", "pitch")]
SAME_RAD = 1e-9  # between the stance and the one that such coordinates can say
X, Z, PITCH = 0, 2, 5  # of the six rows of a foot: place, heading, roll, pitch


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Free coordinates of the chart, and how all of it follows from them: chart = spread @ x + rest.

    Attributes
    ----------
    kind : "whole" (every coordinate is free), "even" (the right half mirrors the left one) or "plane" (only joints that
        turn about the pitch axis move besides).
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
        """Whether left and right are mirror images: feet, forces and torques of the left side stand for both."""
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

    @cached_property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free coordinates."""
        return tuple(self.names[k] for k in self.free)

    @cached_property
    def joints(self) -> list[int]:
        """Free joints, in the order of the joints."""
        return [k - BASE for k in self.free if k >= BASE]

    @cached_property
    def places(self) -> list[int]:
        """Which of x, y, z can change."""
        return [k for k in self.free if k < 3]

    @cached_property
    def turns(self) -> list[int]:
        """Where yaw, roll and pitch stand among the free coordinates, those that are."""
        return [i for i, k in enumerate(self.free) if 3 <= k < BASE]

    @cached_property
    def spins(self) -> list[int]:
        """Which components of a moment or of an angular momentum can change."""
        return [1] if self.even else [0, 1, 2]

    @cached_property
    def foot(self) -> list[int]:
        """Which of the six rows of a foot can change: x, y, z, heading, roll, pitch."""
        return [X, Z, PITCH] if self.plane else list(range(6))

    def chart(self, x: ca.SX, level: int = 0) -> ca.SX:
        """The chart (6 + joints,), or with ``level`` 1 or more its rates, from the free coordinates."""
        if self.kind == "whole":
            return x[: self.size]
        rows = []
        for weights, rest in zip(self.spread, self.rest, strict=True):
            column = np.flatnonzero(weights)
            value = ca.SX(0 if level else rest)
            for k in column:
                value = (x[int(k)] if weights[k] > 0 else -x[int(k)]) + value
            rows.append(value)
        return ca.vertcat(*rows)

    def charts(self, x: np.ndarray, level: int = 0) -> np.ndarray:
        """The same for numbers (n, free): (n, 6 + joints)."""
        return x[:, : self.size] @ self.spread.T + (0.0 if level else self.rest)

    def taken(self, charts: np.ndarray) -> np.ndarray:
        """The free coordinates (..., free) of charts (..., 6 + joints)."""
        return charts[..., list(self.free)]

    def within(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the free coordinates from bounds of the chart (6 + joints,): the tighter of both sides."""
        down, up = self.spread.T > 0, self.spread.T < 0
        from_low = np.where(down, low, np.where(up, -high, -np.inf)).max(axis=1)
        from_high = np.where(down, high, np.where(up, -low, np.inf)).min(axis=1)
        return from_low, from_high


def whole(body: Body) -> Coordinates:
    """Every coordinate."""
    n = len(body.model.names)
    return Coordinates("whole", body.model.names, tuple(range(n)), np.eye(n), np.zeros(n))


def even(body: Body) -> Coordinates:
    """Those of even motions: in the plane for a robot that five links describe, else of its left half.

    Every coordinate of a robot whose halves are no mirror images, or whose feet then would not be free to move.
    """
    if body.robot.planar:
        return in_plane(body)
    if body.short or not body.mirrored or len({i for pair in body.model.pairs for i in pair[:2]}) < body.model.joints:
        return whole(body)
    return _mirrored(body, "even", set(body.joint_names))


def in_plane(body: Body) -> Coordinates:
    """Those of even motions whose feet stay in their planes: of the legs only joints with a role move, and of a robot
    that five links describe no other ones. Every coordinate of a robot whose feet would leave the plane then."""
    mirrored = body.robot.planar or body.mirrored
    if not mirrored or len({i for pair in body.model.pairs for i in pair[:2]}) < body.model.joints:
        return whole(body)
    moving = {name for pair in body.robot.joints.values() for name in pair}
    if not body.robot.planar:
        legs = {k - 1 for foot in body.feet for k in body.chain(foot)}
        moving |= {name for k, name in enumerate(body.joint_names) if k not in legs}
    found = _mirrored(body, "plane", moving)
    return found if body.robot.planar or _feet_stay(body, found) else whole(body)


def _mirrored(body: Body, kind: str, moving: set[str]) -> Coordinates:
    """Even motions of the ``moving`` joints; the others stay as in the stance, which they have to contain."""
    model = body.model
    n, left = len(model.names), set(model.left_half)
    columns, links = [np.eye(n)[k] for k in IN_PLANE], list(IN_PLANE)
    rest = np.where(np.isin(np.arange(n), IN_PLANE), 0.0, body.stance)
    rest[[1, 3, 4]] = 0.0
    for i, k, sign in model.pairs:
        one, other = (i, k) if i + 1 in left else (k, i)
        if (i == k and sign < 0) or model.names[BASE + one] not in moving:
            continue
        column = np.zeros(n)
        column[BASE + one], column[BASE + other] = 1.0, sign if i != k else 1.0
        rest[[BASE + one, BASE + other]] = 0.0
        columns.append(column)
        links.append(BASE + one)
    order = np.argsort(links)
    free, spread = tuple(int(links[i]) for i in order), np.array(columns)[order].T
    found = Coordinates(kind, model.names, free, spread, rest)
    again = found.charts(found.taken(body.stance[None]))[0]
    return found if np.abs(again - body.stance).max() < SAME_RAD else whole(body)


def _feet_stay(body: Body, free: Coordinates) -> bool:
    """Whether feet keep their distance from the plane, heading and roll whatever the free coordinates are."""
    tree, rng = body.model.model, np.random.default_rng(0)
    data, seen = tree.createData(), []
    for x in rng.uniform(-1.0, 1.0, (8, free.size)):
        q = body.model.to_pinocchio(free.charts(x[None]), *np.zeros((2, 1, len(body.stance))))[0][0]
        pin.framesForwardKinematics(tree, data, q)
        frames = [data.oMf[tree.getFrameId(name)] for name in body.robot.foot.frames]
        seen.append([(f.act(body.robot.foot.tip)[1], f.rotation[0, 1], f.rotation[2, 1]) for f in frames])
    return bool(np.ptp(seen, axis=0).max() < SAME_RAD)
