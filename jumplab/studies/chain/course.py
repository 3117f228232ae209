"""What a chain of jumps shall achieve: how far each time, how high, onto what; and the ground that belongs to it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from jumplab.errors import InputError, RobotError, quoted
from jumplab.robot import Robot
from jumplab.robot.stance import check_stance
from jumplab.sim.scene import REACH_M, Block, Scene
from jumplab.stages.whole_body import Limits
from jumplab.stages.whole_body.planner import platform_edge_m
from jumplab.task import JumpTask

CROUCH = {"knee_rad": 1.0, "trunk_pitch_rad": 0.2}  # half-way to the bottom of a landing: soon reached, quick to launch
MOST_JUMPS = 50  # two minutes of simulated time; more is surely a typo


def crouched(robot: Robot) -> Robot:
    """The robot whose standing posture is a crouch; itself if its joints do not allow that one.

    Planners begin there, landings end there, and the standing controller holds it: all of them ask the robot.
    """
    other = robot.with_stance(**CROUCH)
    try:
        check_stance(other)
    except RobotError:
        return robot
    return other


def placed(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Where a ``step`` (3,) leads from a ``pose`` (3,): x, y [m] and heading [rad]; the step is as seen from there."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])


def seen_from(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The step (3,) that leads from a ``pose`` to an ``other``."""
    c, s, (x, y, turn) = np.cos(pose[2]), np.sin(pose[2]), other - pose
    return np.array([c * x + s * y, c * y - s * x, turn])


@dataclass(frozen=True)
class Course:
    """Targets of a chain; make one with :meth:`of`, which reads and checks numbers."""

    distances_m: tuple[float, ...]  # travel of the feet in each jump, toe to toe
    heights_m: tuple[float, ...]  # rise of the CoM in each flight
    platforms_m: tuple[float, ...]  # height of each landing surface above the ground that the chain begins on
    sides_m: tuple[float, ...] = ()  # travel of the feet to the left, in the heading in which each jump begins
    turns_rad: tuple[float, ...] = ()  # about the vertical, to the left

    @classmethod
    def of(
        cls,
        distances_m: Iterable[Any],
        height_m: Any,
        platforms_m: Iterable[Any] | None = None,
        sides_m: Iterable[Any] | None = None,
        turns_rad: Iterable[Any] | None = None,
    ) -> Course:
        """A course from what somebody typed: one height for all jumps or one per jump; level ground without platforms,
        straight ahead without sides and turns.

        Raises :class:`InputError` if there is no jump, if lists differ in length, or if a number cannot be meant.
        """
        distances = _numbers("distances", distances_m)
        count = len(distances)
        if not 1 <= count <= MOST_JUMPS:
            raise InputError(f"a chain has 1 ... {MOST_JUMPS} jumps, this one has {count}; give one distance per jump")
        heights = _numbers("heights", [height_m] if np.ndim(height_m) == 0 else height_m)
        heights = heights * count if len(heights) == 1 else heights
        platforms = (0.0,) * count if platforms_m is None else _numbers("platforms", platforms_m)
        away = [() if x is None else _numbers(n, x) for n, x in (("sides", sides_m), ("turns", turns_rad))]
        rows = ("heights", heights), ("platforms", platforms), *zip(("sides", "turns"), away, strict=True)
        for name, values in rows:
            if len(values) not in ((count,) if name in ("heights", "platforms") else (0, count)):
                raise InputError(f"{len(values)} {name} for {count} distances: give one per jump")
        if any(map(any, away)) and any(platforms):
            raise InputError("platforms lie on a straight way: leave them away, or ask for neither sides nor turns")
        course = cls(distances, heights, platforms, *away)
        for k in range(count):
            try:
                course.task(k)
            except InputError as e:
                raise InputError(f"jump {k + 1} of {count}: {e}") from e
        return course

    @property
    def count(self) -> int:
        """Number of jumps."""
        return len(self.distances_m)

    @property
    def in_plane(self) -> bool:
        """Whether it goes straight ahead or back; then places are those of the toes, else of the soles' middle."""
        return not (any(self.sides_m) or any(self.turns_rad))

    def step(self, k: int) -> np.ndarray:
        """(3,) way ahead and to the left [m], and turn [rad], of jump ``k``."""
        return np.array([self.distances_m[k], *(x[k] if x else 0.0 for x in (self.sides_m, self.turns_rad))])

    @cached_property
    def goals(self) -> np.ndarray:
        """(K, 3) x, y [m] and heading [rad] of the feet after each jump as wanted, from where they stand at first."""
        poses = [np.zeros(3)]
        for k in range(self.count):
            poses.append(placed(poses[-1], self.step(k)))
        return np.array(poses[1:])

    @cached_property
    def goals_m(self) -> tuple[float, ...]:
        """How far ahead the feet should be after each jump, from where they stand at first [m]."""
        return tuple(self.goals[:, 0].tolist())

    def task(self, k: int, step: np.ndarray | None = None) -> JumpTask:
        """Target of jump ``k`` (counted from 0), with another step (3,) if given."""
        ahead, side, turn = self.step(k) if step is None else step
        rise = self.platforms_m[k] - (0.0, *self.platforms_m)[k]  # above the surface that it starts from
        return JumpTask(ahead, self.heights_m[k], round(rise, 9), side_m=side, yaw_rad=turn)

    def edges(self, robot: Robot) -> tuple[tuple[float, float], ...]:
        """(x, height) where the ground changes its height, x from the toes' first place [m]."""
        jumps = zip(map(self.task, range(self.count)), (0.0, *self.goals_m), self.platforms_m, strict=False)
        return tuple((x + platform_edge_m(task, robot), top) for task, x, top in jumps if task.platform_m)

    def check(self, robot: Robot) -> None:
        """Raise :class:`InputError` if a platform overlaps with a place where the robot stands.

        Between two places of different height both soles need room beside the edge; see :func:`platform_edge_m`.
        """
        if any(self.platforms_m) and min(self.distances_m) < 0:
            k = int(np.argmin(self.distances_m))
            raise InputError(
                f"jump {k + 1} of {self.count}: {self.distances_m[k]:g} m goes back over the platforms; "
                f"chains with platforms go forward, backward jumps stay on the level"
            )
        least = 2 * Limits().edge_before_heel_m - robot.sagittal.heel[0]
        for k in range(self.count):
            rise, distance = self.task(k).platform_m, self.distances_m[k]
            if rise and distance < least:
                what = f"{self.platforms_m[k]:g} m high" if rise > 0 else f"down at {self.platforms_m[k]:g} m"
                raise InputError(
                    f"jump {k + 1} of {self.count}: the surface {what} would begin under the sole that stands "
                    f"{distance:g} m before it; place them {least:.2f} m apart or more, toe to toe"
                )

    def scene(self, robot: Robot) -> Scene:
        """The ground: level, or blocks that meet at the edges."""
        edges = self.edges(robot)
        if not edges:
            return Scene.flat()
        zero = robot.foot.toe - float(robot.foot.center[0])  # soles' middle at x = 0
        ends = [(-REACH_M, 0.0), *((zero + x, top) for x, top in edges), (REACH_M, 0.0)]
        return Scene("platforms", tuple(Block(a, b, top) for (a, top), (b, _) in pairwise(ends)))


def _numbers(name: str, values: Any) -> tuple[float, ...]:
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise InputError(f"the {name} of a chain must be a list of numbers, got {quoted(values)}")
    out = []
    for k, value in enumerate(values, 1):
        try:
            out.append(float("" if isinstance(value, bool) else value))
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"the {name} of a chain must be numbers in m; number {k} is {quoted(value)}") from None
    return tuple(out)
