"""The jumps that a robot can do: a map over two numbers of the target, each cell one solve of the direct planner.

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
import numpy as np

from jumplab.errors import InfeasibleError, InputError, SolverError
from jumplab.io.files import Log, append, made, open_log
from jumplab.io.tape import Tape
from jumplab.ocp.solution import PhaseGuess
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.robot.reach import Reach
from jumplab.sim.playback import Actuators
from jumplab.stages.planner import Planner
from jumplab.stages.reconstruction import planar_motion, planar_quantities
from jumplab.stages.spatial import SpatialLimits, SpatialPlan
from jumplab.stages.srmp.planner import reach_of
from jumplab.stages.srmp.reachable import check_reachable
from jumplab.stages.whole_body import WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.settings import Limits
from jumplab.task import JumpTask

Guess = dict[str, PhaseGuess] | SpatialPlan
Place = tuple[float, ...]  # distance, height and side [m], yaw [rad]
AXES = "distance_m", "height_m"
CELLS = "cells.jsonl"
MAX_ITERATIONS = 160  # solves that succeed need 20 to 110
GIVE_UP = 2  # so many cells in a row without a plan, and the farther ones of the row are not tried
LOADED_N = 50.0  # friction is a quotient, looked at above this force
MAX_CELLS = 2500  # an hour or two of work

OPEN, VERDICT, BEYOND = "no plan found", "refused before solving", "not tried, beyond cells without a plan"


@dataclass(frozen=True)
class Cell:
    """One target, and whether a plan within all limits was found."""

    distance_m: float
    height_m: float
    solved: bool
    limiting: str  # what is used most ("hip torque", "knee speed", "friction"), or why there is no plan
    share: float  # how much of what the planner allows of it is used, 1 at the limit; nan without a plan
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


def usage(plan: WholeBodyPlan, robot: Robot) -> dict[str, float]:
    """Greatest share of every limit that the planner allows: joint torque at its speed, joint speed, friction.

    Ranges are left out: a crouch rests on one in almost every jump, and has no share.
    """
    limits = Limits()
    m, gravity = robot.sagittal, plan.task.gravity
    motion = planar_motion(plan.solution.phases, gravity, robot)
    states = (motion[k] for k in ("angles", "rates", "accels", "toe_acceleration"))
    x = planar_quantities(robot, *states, gravity)
    rates, torques = x["joint_rates"], x["torques"]  # (n, 4)
    left = (m.speed - np.abs(rates)) / (m.speed - m.corner_speed)
    available = limits.torque_share * m.effort * np.where(torques * rates > 0, np.clip(left, 1e-2, 1.0), 1.0)
    out = {}
    for i, joint in enumerate(SAGITTAL_JOINTS):
        if i == 3 and not robot.joints["shoulder_pitch"]:
            continue
        out[f"{joint} torque"] = float(np.max(np.abs(torques[:, i]) / available[:, i]))
        out[f"{joint} speed"] = float(np.max(np.abs(rates[:, i]) / m.speed[i]) / limits.speed_share)
    force = x["ground_wrench"][~motion["flying"]]
    force = force[force[:, 1] > LOADED_N]
    out["friction"] = float(np.max(np.abs(force[:, 0]) / force[:, 1])) / limits.friction
    return out


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
) -> Envelope:
    """Solve the whole map: ``distances`` and ``heights`` of its cells [m], rising.

    They may be other numbers of the target: ``axes=("side_m", "distance_m")`` and ``fixed=JumpTask(0, 0.4)`` map the
    sides and distances of jumps of one height, ``axes=("yaw_rad", "height_m")`` turns and heights.

    Finished cells are kept in ``folder``, and not solved again. ``workers`` are processes that share the rows; ``tell``
    is called with a line per finished row. Raises :class:`InputError` if the grid is empty or too large, or the folder
    holds cells of another robot.
    """
    if not 0 < len(distances) * len(heights) <= MAX_CELLS:
        raise InputError(f"the map has {len(distances)} x {len(heights)} cells, must be 1 to {MAX_CELLS}")
    start = fixed or JumpTask(0.0, heights[0] if axes[1] == "height_m" else 0.4)
    tasks = [[replace(start, **dict(zip(axes, x, strict=True))) for x in product(distances, [y])] for y in heights]
    from jumplab.studies.trials import in_parallel  # the simulator, which pictures of a map do without

    path, rows = None if folder is None else Path(folder) / CELLS, []
    with nullcontext() if path is None else _opened(path, robot) as log:
        done = {} if log is None else log.done
        work = [joblib.delayed(_row)(robot, row, done, path) for row in tasks]
        for row in in_parallel(work, workers, "generator"):
            rows.append(row)
            if tell is not None:
                good, (level, unit) = [getattr(c, axes[0]) for c in row if c.solved], axes[1].split("_")
                far = f", up to {max(good):.2f} {axes[0].split('_')[1]}" if good else ""
                tell(f"{level} {getattr(row[0], axes[1]):.2f} {unit}: {len(good)} of {len(row)} cells{far}")
    cells = tuple(cell for row in rows for cell in row)
    return Envelope(robot.name, tuple(distances), tuple(heights), cells, tuple(axes))


def _row(robot: Robot, tasks: Sequence[JumpTask], done: Mapping[Place, Cell], path: Path | None) -> list[Cell]:
    """Cells of one row, solved from near to far, then back."""
    cells, guesses, guess, failed = [], {}, None, 0
    for i, task in enumerate(tasks):
        cell = Cell.of(task, False, BEYOND, math.nan)
        if cell.place in done:
            cell = done[cell.place]
        else:
            if failed < GIVE_UP:
                cell, guess = _solve(robot, task, guess, cold=True)
                guesses[i] = guess if cell.solved else None
            _keep(cell, robot, path)
        failed = 0 if cell.solved else failed + 1
        cells.append(cell)
    for i in reversed(range(len(cells) - 1)):
        if cells[i].limiting == OPEN and guesses.get(i + 1):
            cells[i], guesses[i] = _solve(robot, tasks[i], guesses[i + 1], cold=False)
            _keep(cells[i], robot, path)
    return cells


_tools: dict[str, tuple[Reach, WholeBodyPlanner]] = {}  # of this process, by the robot's hash


def _solve(robot: Robot, task: JumpTask, guess: Guess | None, *, cold: bool) -> tuple[Cell, Guess | None]:
    """One cell from a neighbour's solution, then, if ``cold``, from the planner's own guess; a guess for the next."""
    if not (task.in_plane and robot.planar):
        return _solve_away(robot, task, guess, cold=cold)
    guess = None if isinstance(guess, SpatialPlan) else guess
    if robot.hash not in _tools:
        # on the fine mesh at once: most cells begin with a neighbour's solution, which is nearer than steps would lead
        options = {"max_iter": MAX_ITERATIONS}
        _tools[robot.hash] = reach_of(robot), WholeBodyPlanner(robot, tracking=False, options=options, refine=False)
    known, planner = _tools[robot.hash]
    try:
        check_reachable(task, known, robot)
    except InfeasibleError as e:
        return Cell.of(task, False, VERDICT, math.nan, reason=str(e)), guess
    reason = ""
    for start in [guess] * bool(guess) + [None] * cold:
        try:
            plan = planner.plan(task, guess=start)
        except SolverError as e:
            reason = str(e)
            continue
        shares, s = usage(plan, robot), plan.solution.statistics
        most = max(shares, key=shares.get)
        cell = Cell.of(task, True, most, shares[most], s.iterations, s.solve_s)
        return cell, plan.solution.guess()
    return Cell.of(task, False, OPEN, math.nan, reason=reason), guess if cold else None


_planners: dict[str, Planner] = {}  # of this process, by the robot's hash


def _solve_away(robot: Robot, task: JumpTask, guess: Guess | None, *, cold: bool) -> tuple[Cell, Guess | None]:
    """The same by the spatial program: from the neighbour's plan, then from where that begins by itself."""
    planner = _planners.setdefault(robot.hash, Planner(robot, keep=True))
    spatial, reason = planner.stage("spatial"), ""
    for near in [guess] * isinstance(guess, SpatialPlan) + [None] * cold:
        try:
            start = ()
            if near is None and robot.planar:
                first = planner.plan(replace(task, side_m=0.0, yaw_rad=0.0), "direct")
                start = first.tape, first.toe_phase_s
            plan = spatial.plan(task, *start, near=near, patient=False)
        except InfeasibleError as e:
            return Cell.of(task, False, VERDICT, math.nan, reason=str(e)), guess
        except SolverError as e:
            reason = str(e)
            continue
        shares, s = tape_usage(spatial.tape(plan), robot, plan.limits), plan.solution.statistics
        most = max(shares, key=shares.get)
        return Cell.of(task, True, most, shares[most], s.iterations, s.solve_s), plan
    return Cell.of(task, False, OPEN, math.nan, reason=reason), guess if cold else None


def tape_usage(tape: Tape, robot: Robot, limits: SpatialLimits) -> dict[str, float]:
    """As :func:`usage`, of a jump out of the plane: of every joint, the more used one of left and right."""
    motors, out = Actuators(robot), {}
    low, high = motors.range(tape.v[:, 6:])
    room = limits.torque_share * np.maximum(np.where(tape.tau > 0, high, -low), 1e-2 * motors.effort)
    shares = {"torque": np.abs(tape.tau) / room, "speed": np.abs(tape.v[:, 6:]) / motors.speed / limits.speed_share}
    for what, share in shares.items():
        for name, most in zip(robot.joint_names, share.max(axis=0).tolist(), strict=True):
            joint = f"{name.removeprefix('left_').removeprefix('right_').replace('_', ' ')} {what}"
            out[joint] = max(most, out.get(joint, 0.0))
    force = tape.f[..., :3].reshape(-1, 3)
    force = force[force[:, 2] > LOADED_N]
    out["friction"] = float(np.max(np.linalg.norm(force[:, :2], axis=1) / force[:, 2])) / limits.friction
    return out


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
