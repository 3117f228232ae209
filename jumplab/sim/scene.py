"""Ground to stand and to land on, boxes with even tops and real edges; and contacts with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.arguments import checked, shaped
from jumplab.control.kinematics import Gauge, about_vertical, turned
from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.task import JumpTask

REACH_M = 20.0  # half-size of "endless" ground, far beyond any jump
THICKNESS_M = 1.0  # deeper than any contact can push a foot in one step
UNEVEN_M = 5e-3  # by how much the ground may miss a corner of a sole at the start
STRAIGHT_RAD = 1e-9  # a heading that differs from +x by rounding alone is straight ahead
# least distance between the soles at the start and at the landing, where the ground of one is to
# differ
GAP_M = 0.02


@checked
@dataclass(frozen=True)
class Block:
    """One box: from ``x_from`` to ``x_to`` along the jump, as wide as the world unless told, with
    an even ``top`` [m].

    It is turned about the point of its top at (``pivot_m``, 0): by ``roll_rad`` about the direction
    of the jump, then by ``pitch_rad`` to its left; a positive pitch goes downhill.
    """

    x_from: float
    x_to: float
    top: float = 0.0
    thickness: float = THICKNESS_M
    y_from: float = -REACH_M
    y_to: float = REACH_M
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    pivot_m: float = 0.0
    soft_m: float = 0.0  # how deep the weight presses flat soles into it

    @cached_property
    def turn(self) -> np.ndarray:
        """(3, 3) how it is turned."""
        return pin.rpy.rpyToMatrix(self.roll_rad, self.pitch_rad, 0.0)

    @cached_property
    def _up(self) -> list[float]:
        """(3,) across its top."""
        return self.turn[:, 2].tolist()

    @property
    def even(self) -> bool:
        """Whether its top is level."""
        return self.pitch_rad == self.roll_rad == 0

    def height_at(self, x: float | np.ndarray, y: float | np.ndarray = 0.0) -> float | np.ndarray:
        """Height of the plane of its top at ``x``, and ``y`` to the left of the jump [m]; arrays
        (...) for arrays.
        """
        a, b, c = self._up
        return self.top - (a * (x - self.pivot_m) + b * y) / c

    def carries(self, x: float | np.ndarray, y: float | np.ndarray) -> bool | np.ndarray:
        """Whether it lies below places (...) at ``x``, and ``y`` to the left of the jump [m]."""
        return (self.x_from <= x) & (x <= self.x_to) & (self.y_from <= y) & (y <= self.y_to)


NOTHING = Block(-REACH_M, REACH_M, -REACH_M)  # where there is no ground


@checked
@dataclass(frozen=True)
class Scene:
    """A named list of blocks. The robot starts with the middle of its soles at x = 0 on a top at z
    = 0.

    Blocks lie one behind the other along the direction ``along_rad``, seen from above; x is counted
    along it.
    """

    name: str
    blocks: tuple[Block, ...]
    along_rad: float = 0.0

    @classmethod
    def flat(cls) -> Scene:
        """Endless ground."""
        return cls.level("flat", {})

    @classmethod
    def level(cls, name: str, tops: Mapping[float, float], along_rad: float = 0.0) -> Scene:
        """Level ground at z = 0 that from each place [m] on has another height [m], such as the
        ditch {0.3: -1.0, 0.8: 0.0}, the platform {0.5: 0.4} or the stairs {0.3: 0.1, 0.6: 0.2}.

        Slopes, mats and stones are blocks of their own, see :class:`Block`. Raises
        :class:`InputError` unless the places are ahead of the robot, one after the other.
        """
        edges = [-REACH_M, *tops, REACH_M]
        if any(x <= 0 for x in tops) or any(a >= b for a, b in pairwise(edges)):
            places = ", ".join(f"{x:g}" for x in tops)
            raise InputError(
                f"{name} at {places} m: its places must be ahead of the robot, one after the other"
            )
        heights = [0.0, *tops.values()]
        blocks = [Block(a, b, top) for (a, b), top in zip(pairwise(edges), heights, strict=True)]
        return cls(name, tuple(blocks), along_rad)

    @classmethod
    def of_plan(cls, summary: Mapping[str, Any], robot: Robot) -> Scene:
        """The ground that a plan was made for, from its ``summary``: flat, or two levels that meet
        at the edge; with the block that it goes over.
        """
        toes = robot.foot.toe - float(robot.foot.center[0])  # soles' middle at x = 0
        try:
            top = summary["target"]["platform_m"]
            if over := summary.get("over"):
                first, last, height = over
                block = Block(toes + first, toes + last, height, height)
                return cls("block", (*cls.flat().blocks, block))
            if top == 0:
                return cls.flat()
            along_rad = JumpTask.of(summary["target"]).along_rad
            edge = summary["platform_edge_m"] + toes
        except (KeyError, TypeError) as e:
            raise InputError(
                f"the summary is not that of a plan ({e}); plan the jump again"
            ) from None
        return cls.level("platform", {edge: top}, along_rad)

    @classmethod
    def of_run(cls, report: Mapping[str, Any], summary: Mapping[str, Any], robot: Robot) -> Scene:
        """The ground of a simulation, from its ``report``, the content of ``simulation.json``, or
        that of its plan.
        """
        ground = report.get("settings", {}).get("ground")
        return cls.of_plan(summary, robot) if ground is None else cls.from_json(ground)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Scene:
        """The scene of plain data, those of :func:`dataclasses.asdict`."""
        try:
            blocks = tuple(Block(**block) for block in data["blocks"])
            return cls(data["name"], blocks, data["along_rad"])
        except (KeyError, TypeError) as e:
            raise InputError(f"the scene is damaged ({e})") from None

    @property
    def plain(self) -> bool:
        """Whether all of it is hard and level."""
        return all(block.even and not block.soft_m for block in self.blocks)

    def seen_along(self, heading_rad: float, robot: Robot, q: np.ndarray) -> Scene:
        """The ground seen along a heading: itself if all is straight ahead, else what is under the
        soles of ``q``.
        """
        if max(abs(heading_rad), abs(self.along_rad)) < STRAIGHT_RAD:
            return self
        x, _ = self.along(Gauge(robot).soles(shaped(q, (robot.model.nq,), "q")))
        return Scene(self.name, (Block(-REACH_M, REACH_M, self.top_at(x)),))

    def boxes(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """(half sizes (3,), centre (3,), quaternion (4,) x y z w) of the blocks [m]."""
        turn = about_vertical(self.along_rad)
        out = []
        for b in self.blocks:
            ends = [b.x_from, b.y_from, b.top - b.thickness], [b.x_to, b.y_to, b.top]
            pivot = [b.pivot_m, 0.0, b.top]
            centre = turn @ (pivot + b.turn @ (np.mean(ends, axis=0) - pivot))
            half = np.ptp(ends, axis=0) / 2
            out.append((half, centre, pin.Quaternion(turn @ b.turn).coeffs()))
        return out

    def within(self, x_from: float, x_to: float, half_width: float) -> Scene:
        """The ground between these places [m] along the jump, for pictures."""
        kept = []
        for b in self.blocks:
            x = np.clip([b.x_from, b.x_to], x_from, x_to).tolist()
            y = np.clip([b.y_from, b.y_to], -half_width, half_width).tolist()
            if x[0] < x[1]:
                kept.append(replace(b, x_from=x[0], x_to=x[1], y_from=y[0], y_to=y[1]))
        return replace(self, blocks=tuple(kept))

    def top_at(self, x: float, y: float = 0.0) -> float:
        """Height of the highest surface at ``x``, and ``y`` to the left of the jump [m]."""
        tops = [b.height_at(x, y) for b in self.blocks if b.carries(x, y)]
        return float(max(tops, default=NOTHING.top))

    def _highest(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the highest block at ``places`` (..., 2) along the jump and to its left [m]: its
        number (...), that after the last where there is no ground, and the height (...) of its
        top [m].
        """
        x, y = np.moveaxis(places, -1, 0)
        tops = [np.where(b.carries(x, y), b.height_at(x, y), -np.inf) for b in self.blocks]
        tops = np.array([*tops, np.full(x.shape, NOTHING.top)])
        number = tops.argmax(axis=0)
        return number, np.take_along_axis(tops, number[None], axis=0)[0]

    def below(self, point: np.ndarray) -> tuple[Block, float]:
        """The highest block at a ``point`` (3,) of the world, and the height of its top [m]."""
        number, top = self._highest(self.along(shaped(point, (3,), "the point")))
        return (*self.blocks, NOTHING)[number], float(top)

    def normals_at(self, points: np.ndarray) -> np.ndarray:
        """(k, 3) upward, across the tops below ``points`` (k, 3) of the world."""
        number, _ = self._highest(self.along(points))
        normals = np.array([block.turn[:, 2] for block in (*self.blocks, NOTHING)])
        return normals[number] @ about_vertical(self.along_rad).T

    def depth_of(self, points: np.ndarray, soft: bool = True) -> np.ndarray:
        """Depth (...) below the ground's surface of the lowest of k ``points`` (..., k, 3) of the
        world [m]; in ``soft`` ground alone, where that is asked.
        """
        number, top = self._highest(self.along(points))
        deep = top - points[..., 2]
        if soft:
            deep = np.where(np.array([b.soft_m for b in (*self.blocks, NOTHING)])[number], deep, 0)
        return deep.max(axis=-1, initial=0.0)

    def along(self, points: np.ndarray) -> np.ndarray:
        """Places (..., 2) of ``points`` (..., 3) along the heading of the landing, and to its left
        [m].
        """
        if points.shape[-1:] != (3,):
            raise InputError(f"points must have the shape (..., 3), got {points.shape}")
        return points @ about_vertical(self.along_rad)[:, :2]

    def landing_moved(
        self,
        robot: Robot,
        ends: tuple[np.ndarray, np.ndarray],
        lift_m: float,
        pitch_rad: float,
        roll_rad: float,
    ) -> Scene:
        """The scene with all that lies nearer to the landing than to the start lifted, and turned
        about the landing.

        ``ends`` are the configurations (nq,) in which the robot starts and lands. Raises
        :class:`InputError` if the soles stand at both on the same ground.
        """
        start, end = (Gauge(robot).corners(shaped(q, (robot.model.nq,), "q")) for q in ends)
        way = (end.mean(axis=0) - start.mean(axis=0))[:2]
        scene = self
        if len(self.blocks) == 1 and self.blocks[0] == Block(-REACH_M, REACH_M):
            scene = replace(self, along_rad=float(np.arctan2(way[1], way[0])))
        first, last = (scene.along(corners)[:, 0] for corners in (start, end))
        gap = min(last) - max(first)
        if gap < GAP_M:
            raise InputError(
                f"the soles land {np.hypot(*way):.2f} m from where they start, so ground_* would "
                f"also change the ground of the start; jump farther, or leave out ground_*"
            )
        edge = max(first) + gap / 2
        blocks = [replace(b, x_to=min(b.x_to, edge)) for b in scene.blocks if b.x_from < edge]
        turn = dict(pitch_rad=pitch_rad, roll_rad=roll_rad, pivot_m=float(np.mean(last)))
        blocks += [
            replace(b, x_from=max(b.x_from, edge), top=b.top + lift_m, **turn)
            for b in scene.blocks
            if b.x_to > edge
        ]
        return replace(scene, name=f"{scene.name}, landing moved", blocks=tuple(blocks))

    def height_of(self, q: np.ndarray, robot: Robot, planned: Scene) -> float:
        """Height of the ground over the blocks of the ``planned`` scene, under the soles of ``q``
        [m].
        """
        soles = Gauge(robot).soles(shaped(q, (robot.model.nq,), "q"))
        real, height = self.below(soles)
        return height - real.soft_m - planned.below(soles)[0].top

    def seated(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """The configuration (nq,) of a start on level ground, turned with the ground and let down
        as far as it is soft.

        Raises :class:`InputError` if a corner of a sole is not on the ground then, or the CoM not
        above the soles.
        """
        q = shaped(q, (robot.model.nq,), "q")
        gauge = Gauge(robot)
        middle = gauge.soles(q)
        under, _ = self.below(middle)
        if not under.even:
            along = about_vertical(self.along_rad)
            turn = along @ under.turn @ along.T
            q = turned(q, turn)
            q[:3] = middle + turn @ (q[:3] - middle)
        corners = gauge.corners(q)
        refused = f"scene {self.name}: the robot cannot stand on it at the start"
        gap = max(corners[:, 2] - self._highest(self.along(corners))[1], key=abs)
        if abs(gap) > UNEVEN_M:
            raise InputError(
                f"{refused}, a corner of its soles is {1e3 * gap:+.0f} mm above the "
                f"ground, at most {1e3 * UNEVEN_M:g}; let the ground be even around x = 0, at z = 0"
            )
        offsets = gauge.com(q) - [corners.max(axis=0), corners.min(axis=0)]
        beyond = (offsets * [[1.0], [-1.0]])[:, :2].max()
        if beyond > 0:
            raise InputError(
                f"{refused}, its CoM is {1e3 * beyond:.0f} mm beyond the edge of its soles; "
                "take a gentler slope"
            )
        q[2] -= under.soft_m
        return q
