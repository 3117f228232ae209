"""What the robot stands and lands on, boxes with flat tops and real edges; and what it touches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.sim.kinematics import Gauge
from jumplab.task import JumpTask

REACH_M = 20.0  # half-size of "endless" ground, far beyond any jump
THICKNESS_M = 1.0  # deeper than any contact can push a foot in one step


@dataclass(frozen=True)
class Contacts:
    """What touched in one step."""

    wrench: np.ndarray  # (2, 6) force and moment on each foot, world axes, at the origin of the foot link [N, N m]
    touching: frozenset[str]  # the robot's links that press on the ground
    colliding: frozenset[tuple[str, str]]  # pairs of the robot's links that press on each other


@dataclass(frozen=True)
class Block:
    """One box: from ``x_from`` to ``x_to`` along the jump, as wide as the world, flat ``top`` [m]."""

    x_from: float
    x_to: float
    top: float = 0.0
    thickness: float = THICKNESS_M


@dataclass(frozen=True)
class Scene:
    """A named list of blocks. The robot starts with the middle of its soles at x = 0 on a top at z = 0.

    Blocks lie one behind the other along the direction ``along_rad``, seen from above; x is counted along it.
    """

    name: str
    blocks: tuple[Block, ...]
    along_rad: float = 0.0

    @classmethod
    def flat(cls) -> Scene:
        """Endless ground."""
        return cls("flat", (Block(-REACH_M, REACH_M),))

    @classmethod
    def ditch(cls, x_from: float, x_to: float, depth: float = 1.0) -> Scene:
        """Two grounds with a gap between ``x_from`` and ``x_to`` [m]; a floor ``depth`` below catches a fall."""
        if not 0 < x_from < x_to:
            raise InputError(f"ditch from {x_from:g} to {x_to:g} m: it must begin ahead of the robot and have a width")
        if depth <= 0:
            raise InputError(f"ditch of depth {depth:g} m: the depth must be positive")
        sides = Block(-REACH_M, x_from, 0.0, depth), Block(x_to, REACH_M, 0.0, depth)
        return cls("ditch", (*sides, Block(-REACH_M, REACH_M, -depth)))

    @classmethod
    def platform(cls, x_from: float, height: float) -> Scene:
        """Ground and a platform of ``height`` whose front edge is at ``x_from`` [m]."""
        if x_from <= 0 or height <= 0:
            raise InputError(f"platform at {x_from:g} m, {height:g} m high: both numbers must be positive")
        return cls("platform", (Block(-REACH_M, REACH_M), Block(x_from, REACH_M, height, height)))

    @classmethod
    def of_plan(cls, summary: Mapping[str, Any], robot: Robot) -> Scene:
        """The ground that a plan was made for, from its ``summary``: flat, or two levels that meet at the edge."""
        top = summary["target"]["platform_m"]
        if top == 0:
            return cls.flat()
        edge = summary["platform_edge_m"] + robot.foot.toe - float(robot.foot.center[0])  # soles' middle at x = 0
        along = JumpTask(**summary["target"]).along_rad
        return cls("platform", (Block(-REACH_M, edge, 0.0), Block(edge, REACH_M, top)), along)

    def seen_along(self, heading_rad: float, robot: Robot, q: np.ndarray) -> Scene:
        """The ground seen along a heading: itself if all is straight ahead, else what is under the soles of ``q``."""
        if heading_rad == self.along_rad == 0:
            return self
        soles = Gauge(robot).soles(q)
        x = float(np.cos(self.along_rad) * soles[0] + np.sin(self.along_rad) * soles[1])
        return Scene(self.name, (Block(-REACH_M, REACH_M, self.top_at(x)),))

    def boxes(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """(half sizes (3,), centre (3,), quaternion (4,) x y z w) of the blocks [m]."""
        c, s, out = np.cos(self.along_rad), np.sin(self.along_rad), []
        for b in self.blocks:
            middle = (b.x_from + b.x_to) / 2
            half = np.array([(b.x_to - b.x_from) / 2, REACH_M, b.thickness / 2])
            turn = np.array([0.0, 0.0, np.sin(self.along_rad / 2), np.cos(self.along_rad / 2)])
            out.append((half, np.array([c * middle, s * middle, b.top - b.thickness / 2]), turn))
        return out

    def top_at(self, x: float) -> float:
        """Height of the highest surface at ``x`` [m]."""
        return max((b.top for b in self.blocks if b.x_from <= x <= b.x_to), default=-REACH_M)
