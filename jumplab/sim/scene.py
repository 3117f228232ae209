"""What the robot stands and lands on, boxes with even tops and real edges; and what it touches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.sim.kinematics import Gauge, rotation
from jumplab.task import JumpTask

REACH_M = 20.0  # half-size of "endless" ground, far beyond any jump
THICKNESS_M = 1.0  # deeper than any contact can push a foot in one step
UNEVEN_M = 5e-3  # by how much the ground may miss a corner of a sole at the start
GRAVEL_WIDE_M = 1.0  # to both sides together
STRAIGHT_RAD = 1e-9  # a heading that differs from +x by rounding alone is straight ahead
GAP_M = 0.02  # least room between the soles at the start and at the landing, where the ground of one is to differ


@dataclass(frozen=True)
class Contacts:
    """What touched in one step."""

    wrench: np.ndarray  # (2, 6) force and moment on each foot, world axes, at the origin of the foot link [N, N m]
    touching: frozenset[str]  # the robot's links that press on the ground
    colliding: frozenset[tuple[str, str]]  # pairs of the robot's links that press on each other


@dataclass(frozen=True)
class Block:
    """One box: from ``x_from`` to ``x_to`` along the jump, as wide as the world unless told, with an even ``top`` [m].

    It is turned about the point of its top at (``pivot_m``, 0): by ``roll_rad`` about the direction of the jump, then
    by ``pitch_rad`` to its left; a positive pitch goes downhill.
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

    @property
    def turn(self) -> np.ndarray:
        """(3, 3) how it is turned."""
        return pin.rpy.rpyToMatrix(self.roll_rad, self.pitch_rad, 0.0)

    @property
    def even(self) -> bool:
        """Whether its top is level."""
        return self.pitch_rad == self.roll_rad == 0

    def height_at(self, x: float, y: float = 0.0) -> float:
        """Height of the plane of its top [m]."""
        if self.even:
            return self.top
        a, b, c = self.turn[:, 2]
        return self.top - (a * (x - self.pivot_m) + b * y) / c


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
    def slope(cls, pitch_rad: float, roll_rad: float = 0.0) -> Scene:
        """Endless ground that is tilted about the start; a positive pitch goes downhill."""
        return cls("slope", (Block(-REACH_M, REACH_M, pitch_rad=pitch_rad, roll_rad=roll_rad),))

    @classmethod
    def ledge(cls, x_from: float, drop: float) -> Scene:
        """Ground that ends at ``x_from`` [m], and lower ground, by ``drop`` [m], beyond."""
        if x_from <= 0 or drop <= 0:
            raise InputError(f"ledge at {x_from:g} m, {drop:g} m high: both numbers must be positive")
        return cls("ledge", (Block(-REACH_M, x_from), Block(x_from, REACH_M, -drop)))

    @classmethod
    def stairs(cls, x_from: float, rise: float, going: float, count: int) -> Scene:
        """``count`` steps from ``x_from`` on, each ``rise`` higher (lower if negative) and ``going`` long [m]."""
        if x_from <= 0 or rise == 0 or going <= 0 or count < 1:
            told = f"stairs at {x_from:g} m, {count} steps of {rise:g} m rise and {going:g} m going"
            raise InputError(f"{told}: place, going and count must be positive, and the rise not zero")
        ends = [x_from + going * k for k in range(count)]
        steps = zip(ends, [*ends[1:], REACH_M], range(1, count + 1), strict=True)
        thick = THICKNESS_M + count * abs(rise)
        return cls("stairs", (Block(-REACH_M, x_from), *(Block(a, b, k * rise, thick) for a, b, k in steps)))

    @classmethod
    def gravel(cls, x_from: float, x_to: float, height: float, seed: int = 0, stone: float = 0.1) -> Scene:
        """Flat ground with square stones of size ``stone`` from ``x_from`` to ``x_to``, up to ``height`` high [m]."""
        if not 0 < x_from < x_to or height <= 0 or stone <= 0:
            told = f"gravel from {x_from:g} to {x_to:g} m, stones of {stone:g} m, {height:g} m high"
            raise InputError(f"{told}: it must begin ahead of the robot, and all lengths be positive")
        columns, rows = max(1, round((x_to - x_from) / stone)), round(GRAVEL_WIDE_M / stone)
        heights = np.random.default_rng(seed).uniform(0.0, height, (columns, rows))
        tiles = [Block(x_from + i * stone, x_from + (i + 1) * stone, float(top), THICKNESS_M,
                       j * stone - GRAVEL_WIDE_M / 2, (j + 1) * stone - GRAVEL_WIDE_M / 2)
                 for (i, j), top in np.ndenumerate(heights)]  # fmt: skip
        return cls("gravel", (Block(-REACH_M, REACH_M), *tiles))

    @classmethod
    def mat(cls, x_from: float, soft_m: float) -> Scene:
        """Flat ground, and a mat from ``x_from`` [m] on, into which flat soles sink by ``soft_m``."""
        if x_from <= 0 or soft_m <= 0:
            raise InputError(f"mat at {x_from:g} m, {soft_m:g} m soft: both numbers must be positive")
        return cls("mat", (Block(-REACH_M, x_from), Block(x_from, REACH_M, soft_m=soft_m)))

    @classmethod
    def of_plan(cls, summary: Mapping[str, Any], robot: Robot) -> Scene:
        """The ground that a plan was made for, from its ``summary``: flat, or two levels that meet at the edge."""
        top = summary["target"]["platform_m"]
        if top == 0:
            return cls.flat()
        edge = summary["platform_edge_m"] + robot.foot.toe - float(robot.foot.center[0])  # soles' middle at x = 0
        along = JumpTask(**summary["target"]).along_rad
        return cls("platform", (Block(-REACH_M, edge, 0.0), Block(edge, REACH_M, top)), along)

    @classmethod
    def of_run(cls, report: Mapping[str, Any], summary: Mapping[str, Any], robot: Robot) -> Scene:
        """The ground of a simulation, from its ``report``, the content of ``simulation.json``, or that of its plan."""
        told = report.get("settings", {}).get("ground")
        return cls.of_plan(summary, robot) if told is None else cls.told(told)

    @classmethod
    def told(cls, data: Mapping[str, Any]) -> Scene:
        """The scene of plain data, those of :func:`dataclasses.asdict`."""
        return cls(data["name"], tuple(Block(**block) for block in data["blocks"]), data["along_rad"])

    @property
    def plain(self) -> bool:
        """Whether all of it is hard and level."""
        return all(block.even and not block.soft_m for block in self.blocks)

    def seen_along(self, heading_rad: float, robot: Robot, q: np.ndarray) -> Scene:
        """The ground seen along a heading: itself if all is straight ahead, else what is under the soles of ``q``."""
        if max(abs(heading_rad), abs(self.along_rad)) < STRAIGHT_RAD:
            return self
        soles = Gauge(robot).soles(q)
        x = float(np.cos(self.along_rad) * soles[0] + np.sin(self.along_rad) * soles[1])
        return Scene(self.name, (Block(-REACH_M, REACH_M, self.top_at(x)),))

    def boxes(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """(half sizes (3,), centre (3,), quaternion (4,) x y z w) of the blocks [m]."""
        c, s, out = np.cos(self.along_rad), np.sin(self.along_rad), []
        turn = np.array([0.0, 0.0, np.sin(self.along_rad / 2), np.cos(self.along_rad / 2)])
        for b in self.blocks:
            half = np.array([b.x_to - b.x_from, b.y_to - b.y_from, b.thickness]) / 2
            middle = np.array([(b.x_to + b.x_from) / 2, (b.y_to + b.y_from) / 2, b.top - b.thickness / 2])
            quaternion = turn
            if not b.even:
                pivot = np.array([b.pivot_m, 0.0, b.top])
                middle = pivot + b.turn @ (middle - pivot)
                quaternion = (pin.Quaternion(turn[3], *turn[:3]) * pin.Quaternion(b.turn)).coeffs()
            place = [c * middle[0] - s * middle[1], s * middle[0] + c * middle[1], middle[2]]
            out.append((half, np.array(place), quaternion))
        return out

    def within(self, x_from: float, x_to: float, half_width: float) -> Scene:
        """What of the ground lies between these places [m] along the jump, for pictures."""
        sides = dict(y_from=-half_width, y_to=half_width)
        cut = [(b, max(b.x_from, x_from), min(b.x_to, x_to)) for b in self.blocks]
        kept = [replace(b, x_from=a, x_to=e, **{k: np.clip(getattr(b, k), -half_width, half_width) for k in sides})
                for b, a, e in cut if a < e]  # fmt: skip
        return replace(self, blocks=tuple(kept))

    def top_at(self, x: float, y: float = 0.0) -> float:
        """Height of the highest surface at ``x``, and ``y`` to the left of the jump [m]."""
        here = self._at(x, y)
        return -REACH_M if here is None else here.height_at(x, y)

    def _at(self, x: float, y: float) -> Block | None:
        here = [b for b in self.blocks if b.x_from <= x <= b.x_to and b.y_from <= y <= b.y_to]
        return max(here, key=lambda b: b.height_at(x, y), default=None)

    def below(self, point: np.ndarray) -> Block | None:
        """The highest block at a ``point`` (2,) of the world."""
        return self._at(*self._along(point))

    def normal_at(self, point: np.ndarray) -> np.ndarray:
        """(3,) upward, across the top below a ``point`` (2,) of the world."""
        block = self.below(point)
        up = np.array([0.0, 0.0, 1.0]) if block is None else block.turn[:, 2]
        return pin.rpy.rpyToMatrix(0.0, 0.0, self.along_rad) @ up

    def depth_of(self, points: np.ndarray) -> float:
        """How deep the lowest of some ``points`` (k, 3) of the world lies in soft ground; zero in hard one [m]."""
        depths = [0.0]
        for point in points:
            block = self.below(point[:2])
            if block is not None and block.soft_m:
                depths.append(block.height_at(*self._along(point[:2])) - float(point[2]))
        return max(depths)

    def _along(self, point: np.ndarray) -> tuple[float, float]:
        c, s = np.cos(self.along_rad), np.sin(self.along_rad)
        return float(c * point[0] + s * point[1]), float(c * point[1] - s * point[0])

    def landing_moved(
        self, robot: Robot, ends: tuple[np.ndarray, np.ndarray], lift_m: float, pitch_rad: float, roll_rad: float
    ) -> Scene:
        """The scene with all that lies nearer to the landing than to the start lifted, and turned about the landing.

        ``ends`` are the configurations (nq,) in which the robot starts and lands. Raises :class:`InputError` if the
        soles stand at both on the same ground.
        """
        start, end = (_corners(robot, q) for q in ends)
        way = (end.mean(axis=0) - start.mean(axis=0))[:2]
        scene = self
        if len(self.blocks) == 1 and self.blocks[0] == Block(-REACH_M, REACH_M):
            scene = replace(self, along_rad=float(np.arctan2(way[1], way[0])))
        first, last = (np.array([scene._along(corner) for corner in corners]) for corners in (start, end))
        gap = last[:, 0].min() - first[:, 0].max()
        if gap < GAP_M:
            said = f"the soles land {np.hypot(*way):.2f} m from where they start, on the same ground"
            raise InputError(f"{said}, which cannot differ only for the landing; jump farther, or leave ground_* away")
        edge, pivot = float(first[:, 0].max() + gap / 2), float(last[:, 0].mean())
        blocks = [replace(b, x_to=min(b.x_to, edge)) for b in scene.blocks if b.x_from < edge]
        moved = dict(pitch_rad=pitch_rad, roll_rad=roll_rad, pivot_m=pivot)
        beyond = [b for b in scene.blocks if b.x_to > edge]
        blocks += [replace(b, x_from=max(b.x_from, edge), top=b.top + lift_m, **moved) for b in beyond]
        return replace(scene, name=f"{scene.name}, landing moved", blocks=tuple(blocks))

    def height_of(self, q: np.ndarray, robot: Robot, planned: Scene) -> float:
        """How much higher the ground is than the blocks of the ``planned`` scene, under the soles of ``q`` [m]."""
        soles = Gauge(robot).soles(q)
        real, meant = self.below(soles[:2]), planned.below(soles[:2])
        return 0.0 if real is None or meant is None else self.top_at(*self._along(soles)) - real.soft_m - meant.top

    def seated(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """The configuration (nq,) of a start on level ground, turned with the ground and let down as far as it is soft.

        Raises :class:`InputError` if a corner of a sole is not on the ground then, or the CoM not above the soles.
        """
        middle = Gauge(robot).soles(q)
        under, q = self.below(middle[:2]), q.copy()
        if under is not None and not under.even:
            level = pin.rpy.rpyToMatrix(0.0, 0.0, self.along_rad)
            turn = level @ under.turn @ level.T
            q[:3] = middle + turn @ (q[:3] - middle)
            q[3:7] = pin.Quaternion(turn @ rotation(q[3:7])).coeffs()
        corners, said = _corners(robot, q), f"scene {self.name}: the robot cannot stand on it at the start"
        off = [z - self.top_at(*self._along((x, y))) for x, y, z in corners]
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) > UNEVEN_M:
            gap = f"a corner of its soles is {1e3 * off[worst]:+.0f} mm above the ground, at most {1e3 * UNEVEN_M:g}"
            raise InputError(f"{said}, {gap}; let the ground be even around x = 0, at z = 0")
        com = Gauge(robot).com(q)[:2]
        beyond = max((corners[:, :2].min(axis=0) - com).max(), (com - corners[:, :2].max(axis=0)).max())
        if beyond > 0:
            edge = f"its CoM is {1e3 * beyond:.0f} mm beyond the edge of its soles"
            raise InputError(f"{said}, {edge}; take a gentler slope")
        q[2] -= 0.0 if under is None else under.soft_m
        return q


def _corners(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Corners (8, 3) of both soles [m]."""
    gauge = Gauge(robot)
    pin.framesForwardKinematics(gauge.model, gauge.data, q)
    return np.array([gauge.data.oMf[frame].act(corner) for frame in gauge.frames for corner in robot.foot.corners])
