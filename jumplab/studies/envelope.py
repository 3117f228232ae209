"""The jumps that a robot can do: a map over two numbers of the target, each cell a plan by the direct method, audited.

Rows of equal height are solved side by side; within a row each cell starts from its neighbour's solution, first from
near to far, then, where that failed, from far to near. Every finished cell is a line of ``cells.jsonl``, so that an
interrupted map goes on where it stopped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import joblib

from jumplab.auditing.audit import audit
from jumplab.auditing.report import AuditReport
from jumplab.errors import InfeasibleError, InputError, SolverError
from jumplab.io.files import Log, append, made, open_log
from jumplab.ocp.nlp import EXPLAINED
from jumplab.robot import Robot
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import Planner, here
from jumplab.task import JumpTask

Place = tuple[float, ...]  # distance, height and side [m], yaw [rad]
AXES = "distance_m", "height_m"
CELLS = "cells.jsonl"
USES = {"torque at speed": "torque", "joint speed": "speed", "friction used": "friction"}  # checks of the audit
GIVE_UP = 2  # so many cells in a row without a plan, and the farther ones of the row are not tried
MAX_CELLS = 2500  # an hour or two of work

OPEN, VERDICT, BEYOND = (
    "no plan found",
    "beyond a straight push, and no plan found",
    "not tried, beyond cells without a plan",
)


@dataclass(frozen=True)
class Cell:
    """One target, and whether a plan within all limits was found."""

    distance_m: float
    height_m: float
    solved: bool
    limiting: str  # what is used most ("hip torque", "knee speed", "friction"), or why there is no plan
    share: float  # how much of what the robot has of it is used, 1 at the limit; nan without a plan
    iterations: int = 0
    solve_s: float = 0.0
    reason: str = ""  # the sentence of the refusal
    side_m: float = 0.0
    yaw_rad: float = 0.0

    @classmethod
    def of(cls, task: JumpTask, *found: Any, **more: Any) -> Cell:
        """A cell of a target."""
        return cls(task.distance_m, task.height_m, *found, side_m=task.side_m, yaw_rad=task.yaw_rad, **more)

    @property
    def place(self) -> Place:
        """By which a finished cell is found."""
        return self.distance_m, self.height_m, self.side_m, self.yaw_rad


@dataclass(frozen=True)
class Envelope:
    """The map: values of both axes, by default distances (m,) and heights (n,), and all cells, row by row."""

    robot: str
    distances: tuple[float, ...]
    heights: tuple[float, ...]
    cells: tuple[Cell, ...]
    axes: tuple[str, str] = AXES  # fields of the target that the values are

    @property
    def highest(self) -> Cell | None:
        """The solved cell with the greatest height, the farthest of those; None if there is no jump."""
        return max((c for c in self.cells if c.solved), key=lambda c: (c.height_m, c.distance_m), default=None)

    @property
    def farthest(self) -> Cell | None:
        """The solved cell with the greatest distance, the highest of those."""
        return max((c for c in self.cells if c.solved), key=lambda c: (c.distance_m, c.height_m), default=None)


def most_used(report: AuditReport, robot: Robot) -> tuple[str, float]:
    """What a plan uses most of what its robot has, torque at its speed, speed or friction, and the share of it [1].

    A joint with a role is named by it.
    """
    found, roles = [], {joint: role for role, pair in robot.joints.items() for joint in pair}
    for check in report.checks:
        if what := USES.get(check.name):
            worst = check.note.rpartition("; worst: ")[2]
            joint = roles.get(worst, worst).removeprefix("left_").removeprefix("right_")
            found.append((check.value / check.limit, what if what == "friction" else f"{joint} {what}"))
    share, name = max(found)
    return name.replace("_", " "), float(share)


def envelope(
    robot: Robot,
    distances: Sequence[float],
    heights: Sequence[float],
    *,
    axes: tuple[str, str] = AXES,
    fixed: JumpTask | None = None,
    folder: str | Path | None = None,
    workers: int = 1,
    tell: Callable[[str], None] | None = None,
    atlas: Any | None = None,
) -> Envelope:
    """Solve the whole map: ``distances`` and ``heights`` of its cells [m], rising.

    They may be other numbers of the target: ``axes=("side_m", "distance_m")`` and ``fixed=JumpTask(0, 0.4)`` map the
    sides and distances of jumps of one height, ``axes=("yaw_rad", "height_m")`` turns and heights.

    Finished cells are kept in ``folder``, and not solved again. ``workers`` are processes that share the rows; ``tell``
    is called with a line per finished row; ``atlas`` is one of this robot (:class:`jumplab.Atlas`) to begin with.
    Raises :class:`InputError` if the grid is empty or too large, or folder or atlas are of another robot.
    """
    if not 0 < len(distances) * len(heights) <= MAX_CELLS:
        raise InputError(f"the map has {len(distances)} x {len(heights)} cells, must be 1 to {MAX_CELLS}")
    start = fixed or JumpTask(0.0, heights[0] if axes[1] == "height_m" else 0.4)
    tasks = [[replace(start, **dict(zip(axes, x, strict=True))) for x in product(distances, [y])] for y in heights]
    from jumplab.studies.trials import in_parallel  # the simulator, which pictures of a map do without

    path, rows = None if folder is None else Path(folder) / CELLS, []
    with nullcontext() if path is None else _opened(path, robot) as log:
        done = {} if log is None else log.done
        planner = Planner(robot, keep=True, atlas=atlas)
        work = [joblib.delayed(_row)(planner, row, done, path) for row in tasks]
        for row in in_parallel(work, workers, "generator"):
            rows.append(row)
            if tell is not None:
                good, (level, unit) = [getattr(c, axes[0]) for c in row if c.solved], axes[1].split("_")
                far = f", up to {max(good):.2f} {axes[0].split('_')[1]}" if good else ""
                tell(f"{level} {getattr(row[0], axes[1]):.2f} {unit}: {len(good)} of {len(row)} cells{far}")
    cells = tuple(cell for row in rows for cell in row)
    return Envelope(robot.name, tuple(distances), tuple(heights), cells, tuple(axes))


def _row(planner: Planner, tasks: Sequence[JumpTask], done: Mapping[Place, Cell], path: Path | None) -> list[Cell]:
    """Cells of one row, solved from near to far, then back."""
    cells, guesses, guess, failed = [], {}, None, 0
    for i, task in enumerate(tasks):
        cell = Cell.of(task, False, BEYOND, math.nan)
        if cell.place in done:
            cell = done[cell.place]
        else:
            if failed < GIVE_UP:
                cell, guess = _solve(planner, task, guess, cold=True)
                guesses[i] = guess if cell.solved else None
            _keep(cell, planner.robot, path)
        failed = 0 if cell.solved else failed + 1
        cells.append(cell)
    for i in reversed(range(len(cells) - 1)):
        if cells[i].limiting == OPEN and guesses.get(i + 1):
            cells[i], guesses[i] = _solve(planner, tasks[i], guesses[i + 1], cold=False)
            _keep(cells[i], planner.robot, path)
    return cells


def _solve(planner: Planner, task: JumpTask, near: JumpPlan | None, *, cold: bool) -> tuple[Cell, JumpPlan | None]:
    """One cell as `jumplab plan` plans it, or begun with a neighbour's plan; a plan for the next."""
    planner = here(planner)
    ways = [lambda: planner.plan(task, "direct")] * cold
    if near is not None and not (cold and planner.atlas):
        ways.insert(0, lambda: planner.replan(near, task))
    for way in ways:
        unread = EXPLAINED.set(False)
        try:
            plan = way()
        except InfeasibleError as e:
            return Cell.of(task, False, VERDICT, math.nan, reason=str(e)), near
        except SolverError as e:
            reason, work = str(e), ()
            break  # a re-plan that led nowhere has begun anew as well
        finally:
            EXPLAINED.reset(unread)
        report = audit(plan.tape, plan.robot, task, edge_m=plan.summary["platform_edge_m"])
        work = sum(x.iterations for x in plan.statistics), sum(x.solve_s for x in plan.statistics)
        if report.passed:
            return Cell.of(task, True, *most_used(report, plan.robot), *work), plan
        reason = f"outside the limits of the audit: {', '.join(check.name for check in report.failed)}"
    return Cell.of(task, False, OPEN, math.nan, *work, reason=reason), near if cold else None


# finished cells on file -----------------------------------------------------------------------------------------
@contextmanager
def _opened(path: Path, robot: Robot) -> Iterator[Log[Place, Cell]]:
    def entry(line: dict[str, Any]) -> tuple[Place, Cell]:
        if (owner := line.pop("robot")) != robot.hash:
            raise InputError(f"{path}: belongs to another robot ({owner}, not {robot.hash}); choose another folder")
        cell = Cell(**{k: math.nan if v is None else v for k, v in line.items()})
        return cell.place, cell

    with made(path.parent), open_log(path, "envelope", entry) as log:
        yield log


def _keep(cell: Cell, robot: Robot, path: Path | None) -> None:
    """Add a line, from whichever process; the first one holds the log."""
    if path is not None:
        data = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(cell).items()}
        with open(path, "ab") as file:
            append(file, {"robot": robot.hash, **data})
