"""Course of a chain of jumps: distance, height and platform of each; and the ground that belongs to
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jumplab.arguments import checked
from jumplab.control.kinematics import about_vertical
from jumplab.errors import InputError, RobotError
from jumplab.robot import Robot
from jumplab.robot.stance import check_stance
from jumplab.sim.scene import Scene
from jumplab.stages.whole_body import Limits
from jumplab.stages.whole_body.ground import platform_edge_m
from jumplab.task import JumpTask

# half-way to the bottom of a landing: soon reached, quick to launch
CROUCH = {"knee_rad": 1.0, "trunk_pitch_rad": 0.2}
MOST_JUMPS = 50  # two minutes of simulated time; more is surely a typo


def crouched(robot: Robot) -> Robot:
    """The robot whose standing posture is a crouch; itself if its joints do not allow that one.

    Planners begin there, landings end there, and the standing controller holds it: all of them ask
    the robot.
    """
    other = robot.with_stance(**CROUCH)
    try:
        check_stance(other)
    except RobotError:
        return robot
    return other


def placed(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Pose after a ``step`` (3,) from a ``pose`` (3,): x, y [m] and heading [rad]; the step is as
    seen from the first pose.
    """
    return pose + about_vertical(pose[2]) @ step


def step_of(task: JumpTask) -> np.ndarray:
    """(3,) way ahead and to the left [m], and turn [rad], of a jump."""
    return np.array([task.distance_m, task.side_m, task.yaw_rad])


def seen_from(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The step (3,) that leads from a ``pose`` (3,) to an ``other``."""
    return about_vertical(-pose[2]) @ (other - pose)


@dataclass(frozen=True)
class Course:
    """Targets of a chain, each from where the one before it ends; :meth:`of` reads and checks
    numbers.
    """

    tasks: tuple[JumpTask, ...]

    @classmethod
    @checked
    def of(
        cls,
        distances_m: Sequence[float],
        height_m: float | Sequence[float],
        platforms_m: Sequence[float] | None = None,
        sides_m: Sequence[float] | None = None,
        turns_rad: Sequence[float] | None = None,
    ) -> Course:
        """A course of K jumps from numbers of each [m, rad]: one height for all jumps or one
        per jump; platforms above the first ground, else level; straight ahead without sides and
        turns.

        Raises :class:`InputError` if there is no jump, if lists differ in length, or if a number
        cannot be meant.
        """
        count = len(distances_m)
        if not 1 <= count <= MOST_JUMPS:
            raise InputError(
                f"a chain has 1 ... {MOST_JUMPS} jumps, this one has {count}; "
                f"give one distance per jump"
            )
        heights = np.atleast_1d(height_m).tolist()
        heights = heights * count if len(heights) == 1 else heights
        given = {"platforms": platforms_m, "sides": sides_m, "turns": turns_rad}
        rows = {"heights": heights} | {
            name: [0.0] * count if x is None else x for name, x in given.items()
        }
        for name, values in rows.items():
            if len(values) != count:
                raise InputError(f"{len(values)} {name} for {count} distances: give one per jump")
        if any(rows["platforms"]) and any([*rows["sides"], *rows["turns"]]):
            raise InputError(
                "platforms need a straight course; leave out the platforms, or the sides and turns"
            )
        # above the surface that each jump starts from
        rows["platforms"] = np.diff(rows["platforms"], prepend=0.0).round(9).tolist()
        tasks = []
        jumps = zip(distances_m, *rows.values(), strict=True)
        for k, (*numbers, side, turn) in enumerate(jumps, 1):
            try:
                tasks.append(JumpTask(*numbers, side_m=side, yaw_rad=turn))
            except InputError as e:
                raise InputError(f"jump {k} of {count}: {e}") from e
        return cls(tuple(tasks))

    @property
    def count(self) -> int:
        """Number of jumps."""
        return len(self.tasks)

    @property
    def in_plane(self) -> bool:
        """Whether it goes straight ahead or back; then places are those of the toes, else of the
        soles' middle.
        """
        return all(task.in_plane for task in self.tasks)

    @property
    def platforms_m(self) -> list[float]:
        """(K,) height of each landing surface above the ground that the chain begins on [m]."""
        return np.cumsum([task.platform_m for task in self.tasks]).round(9).tolist()

    @cached_property
    def goals(self) -> np.ndarray:
        """(K, 3) x, y [m] and heading [rad] of the feet after each jump as wanted, from where they
        stand at first.
        """
        poses = [np.zeros(3)]
        for task in self.tasks:
            poses.append(placed(poses[-1], step_of(task)))
        return np.array(poses[1:])

    @property
    def goals_m(self) -> list[float]:
        """(K,) how far ahead the feet should be after each jump, from where they stand at first
        [m].
        """
        return self.goals[:, 0].tolist()

    def to_json(self) -> dict[str, list[float]]:
        """Plain data, a number per jump [m, rad]."""
        return {
            "distances_m": [task.distance_m for task in self.tasks],
            "heights_m": [task.height_m for task in self.tasks],
            "platforms_m": self.platforms_m,
            "sides_m": [task.side_m for task in self.tasks],
            "turns_rad": [task.yaw_rad for task in self.tasks],
        }

    def edges(self, robot: Robot) -> list[tuple[float, float]]:
        """(x, height) where the ground changes its height, x from the toes' first place [m]."""
        places = zip(self.tasks, (0.0, *self.goals_m), self.platforms_m, strict=False)
        return [
            (start + platform_edge_m(task, robot), top)
            for task, start, top in places
            if task.platform_m
        ]

    def check(self, robot: Robot) -> None:
        """Raise :class:`InputError` if a platform overlaps with a place (see :attr:`goals`) where
        the robot stands.

        Between two places of different height both soles need space beside the edge; see
        :func:`platform_edge_m`.
        """
        if not any(self.platforms_m):
            return
        least = 2 * Limits().edge_before_heel_m - robot.sagittal.heel[0]
        for k, (task, top) in enumerate(zip(self.tasks, self.platforms_m, strict=True), 1):
            number = f"jump {k} of {self.count}"
            distance = task.distance_m
            rise = task.platform_m
            if distance < 0:
                raise InputError(
                    f"{number}: {distance:g} m goes back over the platforms; "
                    f"chains with platforms go forward, backward jumps stay on the level"
                )
            if rise and distance < least:
                what = f"{top:g} m high" if rise > 0 else f"down at {top:g} m"
                raise InputError(
                    f"{number}: the surface {what} would begin under the sole that stands "
                    f"{distance:g} m before it; place them {least:.2f} m apart or more, toe to toe"
                )

    def scene(self, robot: Robot) -> Scene:
        """The ground: level, or blocks that meet at the :meth:`edges` (x [m], height [m])."""
        zero = robot.foot.toe - float(robot.foot.center[0])  # soles' middle at x = 0
        tops = {zero + x: top for x, top in self.edges(robot)}
        return Scene.level("platforms", tops) if tops else Scene.flat()
