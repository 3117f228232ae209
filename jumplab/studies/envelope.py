"""The jumps that a robot can do: a map over two numbers of the target, each cell a plan by the
direct method, audited.

Every finished cell is a line of ``cells.jsonl``, so that an interrupted map resumes where it
stopped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path

from jumplab.arguments import checked
from jumplab.errors import InputError, Shown
from jumplab.ocp.nlp import unexplained
from jumplab.robot import Robot
from jumplab.stages.planner import Planner, here
from jumplab.studies.atlas import Atlas
from jumplab.studies.grid import MAX_CELLS, plan_cell, plan_rows
from jumplab.studies.study import Plain
from jumplab.task import JumpTask

AXES = "distance_m", "height_m"
OPEN = "no plan found"
BEYOND = "not tried, beyond cells without a plan"


@dataclass(frozen=True)
class Cell:
    """One target, and whether a plan within all limits was found."""

    distance_m: float
    height_m: float
    solved: bool
    # what is used most ("hip torque", "knee speed", "friction"), or why there is no plan
    limiting: str
    share: float  # how much of what the robot has of it is used, 1 at the limit; nan without a plan
    iterations: int = 0
    solve_s: float = 0.0  # CPU time of the plan
    reason: str = ""  # the sentence of the refusal
    side_m: float = 0.0
    yaw_rad: float = 0.0

    @property
    def task(self) -> JumpTask:
        """The target, on level ground."""
        return JumpTask(self.distance_m, self.height_m, side_m=self.side_m, yaw_rad=self.yaw_rad)

    @classmethod
    def of(cls, task: JumpTask, row: Plain | None) -> Cell:
        """The cell of a target from its ``row`` (see :data:`.grid.COLUMNS`); without one it was not
        tried.
        """
        place = task.distance_m, task.height_m
        away = dict(side_m=task.side_m, yaw_rad=task.yaw_rad)
        if row is None:
            return cls(*place, False, BEYOND, math.nan, **away)
        if row["clean"]:
            limits = row["limiting"], row["share"]
        else:
            limits = OPEN, math.nan
        work = row["iterations"] or 0, row["cpu_s"], row["reason"] or ""
        return cls(*place, row["clean"], *limits, *work, **away)


@dataclass(frozen=True)
class Envelope(Shown):
    """The map: values of both axes, by default distances (m,) and heights (n,), and all cells, row
    by row.
    """

    robot: str
    distances: tuple[float, ...]
    heights: tuple[float, ...]
    cells: tuple[Cell, ...]
    axes: tuple[str, str] = AXES  # fields of the target that the values are

    @property
    def highest(self) -> Cell | None:
        """The solved cell with the greatest height, the farthest of those; None if there is no
        jump.
        """
        return self._greatest("height_m", "distance_m")

    @property
    def farthest(self) -> Cell | None:
        """The solved cell with the greatest distance, the highest of those."""
        return self._greatest("distance_m", "height_m")

    def _greatest(self, *names: str) -> Cell | None:
        solved = (c for c in self.cells if c.solved)
        return max(solved, key=attrgetter(*names), default=None)


@checked
def envelope(
    robot: Robot,
    distances: Sequence[float],
    heights: Sequence[float],
    *,
    axes: tuple[str, str] = AXES,
    fixed: JumpTask | None = None,
    folder: str | Path | None = None,
    jobs: int | None = 1,
    atlas: Atlas | None = None,
    progress: bool | None = None,
) -> Envelope:
    """Plan the whole map: ``distances`` (m,) and ``heights`` (n,) of its cells [m], rising.

    They may be other numbers of the target: ``axes=("side_m", "distance_m")`` and
    ``fixed=JumpTask(0, 0.4)`` map the sides and distances of jumps of one height,
    ``axes=("yaw_rad", "height_m")`` turns and heights; a ``fixed`` target may also have a platform
    or another gravity.

    Finished cells are kept in ``folder``, and not planned again. ``atlas`` is one of this robot
    (:class:`jumplab.Atlas`) to begin with; ``jobs`` and ``progress`` as of :func:`.open_study`.
    Raises :class:`InputError` if the grid is empty or too large, the atlas is of another robot, or
    the folder holds something else.
    """
    if not 0 < len(distances) * len(heights) <= MAX_CELLS:
        raise InputError(
            f"the map has {len(distances)} x {len(heights)} cells, must be 1 to {MAX_CELLS}"
        )
    start = fixed or JumpTask(0.0, heights[0] if axes[1] == "height_m" else 0.4)
    across, up = axes
    rows = [[replace(start, **{across: x, up: y}) for x in distances] for y in heights]
    planner = Planner(robot, keep=True, atlas=atlas)
    if atlas is not None:
        atlas.require(planner.stage("direct"))
    known = "direct", robot.hash, atlas and atlas.hash
    work = partial(cell_row, planner)
    results = plan_rows(
        rows, work, known, "clean", folder, "envelope", jobs=jobs, progress=progress
    )
    cells = tuple(Cell.of(*result) for result in results)
    return Envelope(robot.name, distances, heights, cells, axes)


def cell_row(planner: Planner, task: JumpTask) -> Plain:
    """The row of a cell, see :func:`.grid.plan_cell`; why there is no plan is not asked."""
    with unexplained():
        return plan_cell(here(planner), task)[0]
