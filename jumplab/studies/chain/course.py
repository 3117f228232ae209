"""What a chain of jumps shall achieve: how far each time, how high, onto what; and the ground that belongs to it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, InputError, RobotError, quoted
from jumplab.robot import Robot
from jumplab.robot.reach import Reach
from jumplab.robot.stance import check_stance
from jumplab.sim.scene import REACH_M, Block, Scene
from jumplab.stages.srmp.reachable import check_reachable
from jumplab.stages.whole_body.planner import platform_edge_m
from jumplab.stages.whole_body.settings import Limits
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


@dataclass(frozen=True)
class Course:
    """Targets of a chain; make one with :meth:`of`, which reads and checks numbers."""

    distances_m: tuple[float, ...]  # travel of the feet in each jump, toe to toe
    heights_m: tuple[float, ...]  # rise of the CoM in each flight
    platforms_m: tuple[float, ...]  # height of each landing surface above the ground that the chain begins on

    @classmethod
    def of(cls, distances_m: Iterable[Any], height_m: Any, platforms_m: Iterable[Any] | None = None) -> Course:
        """A course from what somebody typed: one height for all jumps or one per jump; level ground without platforms.

        Raises :class:`InputError` if there is no jump, if lists differ in length, or if a number cannot be meant.
        """
        distances = _numbers("distances", distances_m)
        count = len(distances)
        if not 1 <= count <= MOST_JUMPS:
            raise InputError(f"a chain has 1 ... {MOST_JUMPS} jumps, this one has {count}; give one distance per jump")
        heights = _numbers("heights", [height_m] if np.ndim(height_m) == 0 else height_m)
        heights = heights * count if len(heights) == 1 else heights
        platforms = (0.0,) * count if platforms_m is None else _numbers("platforms", platforms_m)
        for name, values in (("heights", heights), ("platforms", platforms)):
            if len(values) != count:
                raise InputError(f"{len(values)} {name} for {count} distances: give one per jump")
        course = cls(distances, heights, platforms)
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

    @cached_property
    def goals_m(self) -> tuple[float, ...]:
        """Where the toes should be after each jump, from where they stand at first [m]."""
        return tuple(np.cumsum(self.distances_m).tolist())

    def task(self, k: int, distance_m: float | None = None) -> JumpTask:
        """Target of jump ``k`` (counted from 0), with another distance if given."""
        distance = self.distances_m[k] if distance_m is None else distance_m
        rise = self.platforms_m[k] - (0.0, *self.platforms_m)[k]  # above the surface that it starts from
        return JumpTask(distance, self.heights_m[k], round(rise, 9))

    def edges(self, robot: Robot) -> tuple[tuple[float, float], ...]:
        """(x, height) where the ground changes its height, x from the toes' first place [m]."""
        jumps = zip(map(self.task, range(self.count)), (0.0, *self.goals_m), self.platforms_m, strict=False)
        return tuple((x + platform_edge_m(task, robot), top) for task, x, top in jumps if task.platform_m)

    def check(self, robot: Robot, reach: Reach) -> None:
        """Raise :class:`InputError` if a platform overlaps with a place where the robot stands, and
        :class:`InfeasibleError` if a jump is beyond the robot's reach, by closed forms."""
        self._check_platforms(robot)
        for k in range(self.count):
            try:
                check_reachable(self.task(k), reach, robot)
            except InfeasibleError as e:
                raise InfeasibleError(f"jump {k + 1} of {self.count}: {e}") from e

    def _check_platforms(self, robot: Robot) -> None:
        """Between two places of different height both soles need room beside the edge; see :func:`platform_edge_m`."""
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
