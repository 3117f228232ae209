"""Boxes around the links, and how far apart a face of one keeps another."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from jumplab.models.spatial import SpatialState

# by which the corner of a box gives way, so that the distance has a slope everywhere
ROUNDED_M = 1e-3


@dataclass(frozen=True, eq=False)
class Box:
    """The box around a link's collision shape, in the frame of its body."""

    name: str
    body: int
    centre: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3), columns
    half: np.ndarray  # (3,) half sizes [m]

    def reach(self, s: SpatialState, way: ca.SX) -> ca.SX:
        """From its middle as far as it goes along a unit vector ``way`` (3,) [m]."""
        along = s.rotation(self.body) @ ca.DM(self.axes * self.half)
        return sum(ca.sqrt(ca.dot(way, along[:, i]) ** 2 + ROUNDED_M**2) for i in range(3))


@dataclass(frozen=True)
class Pair:
    """Two boxes that a ``face`` of the first keeps apart: 2 i is where its axis i begins, 2 i + 1
    where it ends.
    """

    first: Box
    second: Box
    face: int

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
        a = self.first
        b = self.second
        axis = self.face // 2
        way = s.rotation(a.body) @ ca.DM(a.axes[:, axis] * (1 if self.face % 2 else -1))
        middle = s.point(b.body, b.centre) - s.point(a.body, a.centre)
        return ca.dot(way, middle) - float(a.half[axis]) - b.reach(s, way)


@dataclass(frozen=True)
class Apart:
    """Two links that a face keeps apart, at nodes ``first`` to ``last`` of one phase, by ``more_m``
    than usual; ``before`` is the face that did so before they met.
    """

    phase: int
    first: int
    last: int
    pair: Pair
    more_m: float = 0.0
    before: Pair | None = None
