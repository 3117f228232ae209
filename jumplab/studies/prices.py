"""Gain of a record per unit of each limit: prices by multipliers, each checked by a record with the
limit moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jumplab.errors import RobotError, Shown, SolverError
from jumplab.io.progress import tell
from jumplab.robot import Robot
from jumplab.stages.whole_body import Limits
from jumplab.stages.whole_body.program import Program, Solved
from jumplab.stages.whole_body.starts import RECORD, Asked, from_solved
from jumplab.stages.whole_body.terms import FAR, TORQUE_SPEED, WORTH
from jumplab.stages.whole_body.terms import RECORD as RECORD_TERM
from jumplab.studies.grid import role_of
from jumplab.task import JumpTask

if TYPE_CHECKING:
    from jumplab.studies.record import Record

ACTIVE = 1e-3  # [m, m/s, rad] that a limit at a node is worth at least, to be one that binds
MOVED = 0.005  # share by which torques, speeds, masses and legs are moved
# by which stops are moved; the T1's hip gains a tenth more than its price from half a degree
RANGE_RAD = math.radians(0.2)
STOPS = {"upper stop": 1, "lower stop": -1}
END = {1: "upper", -1: "lower"}
MOTOR = {"torque": ("effort", "N m"), "speed": ("speed", "rad/s")}
SEEN = 2e-5  # [m, rad] of a record, which solves find again
WHOLE_UNITS = "deg", "0.01"
MORE = 1.01  # times the worth of what is sought, in the second of two records that make prices
FRICTION_STEP = 0.005


@dataclass(frozen=True)
class Price:
    """Gain of a record per unit of one limit.

    Attributes
    ----------
    limit, unit : of what, for how much of it ("N m", "0.01").
    price : of that unit by the multipliers, in the unit of the record.
    checked : the same by a record with the limit moved by ``moved`` units; nan if none was found.
    stays : whether the same limits bind then; where others do, a price holds for less.
    """

    limit: str
    unit: str
    price: float
    checked: float
    moved: float
    stays: bool

    @property
    def gap(self) -> float:
        """By how much the check differs from the price, as a share of it; of the least that is
        seen where it is next to nothing.
        """
        return abs(self.checked - self.price) / max(abs(self.price), SEEN / self.moved)

    @property
    def step(self) -> float:
        """One per cent of the limit, in its unit; of an angle and of friction the unit itself."""
        return 1.0 if self.unit in WHOLE_UNITS else self.moved * 0.01 / MOVED

    @property
    def step_words(self) -> str:
        """That in words."""
        return self.unit if self.unit in WHOLE_UNITS else f"1 % ({self.step:.2g} {self.unit})"


@dataclass(frozen=True, repr=False)
class Prices(Shown):
    """The prices of a record, the highest first."""

    what: str
    robot: str
    unit: str
    rows: tuple[Price, ...]

    def line(self) -> str:
        """Number of prices, and their agreement with the checks."""
        kept = [row.gap for row in self.rows if row.stays]
        return (
            f"{self.robot}, {self.what}: {len(self.rows)} prices; of {len(kept)} limits, which may "
            f"be moved without others taking over, the checks differ by {max(kept, default=0):.1%} "
            f"at most"
        )


@dataclass(frozen=True)
class _Move:
    """A limit that is moved: who then jumps, within what, by how many units."""

    limit: str
    unit: str
    moved: float
    robot: Robot
    limits: Limits


def _moves(record: Record, most: int) -> Iterator[_Move]:
    """The limits that bind, and what each record depends on: friction, mass, legs."""
    robot = record.program.robot
    limits = record.program.limits
    motors = robot.actuators
    kinds = {"torque": ("torque",), "speed": ("speed",), TORQUE_SPEED: ("torque", "speed")}
    pairs = [(kind, x.joint) for x in record.limits for kind in kinds.get(x.limit, (x.limit,))]
    pairs = [pair for pair in dict.fromkeys(pairs) if pair[1] in motors]
    for kind, joint in pairs[:most]:
        signs = _both(record.program, joint)
        word = f"{role_of(robot, joint)} {kind}"
        if kind in STOPS:
            way = STOPS[kind]
            ranges = {
                name: {END[way * sign]: motors[name][END[way * sign]] + way * sign * RANGE_RAD}
                for name, sign in signs.items()
            }
            wider = robot.with_limits(joints=ranges)
            yield _Move(word, "deg", math.degrees(RANGE_RAD), wider, limits)
        else:
            what, unit = MOTOR[kind]
            stronger = robot.with_limits(**{what: dict.fromkeys(signs, 1 + MOVED)})
            yield _Move(word, unit, MOVED * motors[joint][what], stronger, limits)
    more = replace(limits, friction=limits.friction + FRICTION_STEP)
    yield _Move("friction", "0.01", FRICTION_STEP / 0.01, robot, more)
    heavier = robot.with_mass(factor=1 + MOVED)
    yield _Move("mass, everywhere", "kg", MOVED * robot.total_mass, heavier, limits)
    with suppress(RobotError):  # legs that nobody can stretch
        longer = robot.with_legs(1 + MOVED)
        leg_m = record.program.body.leg_m
        yield _Move("thighs and shanks", "cm", 100 * MOVED * leg_m, longer, limits)


def _both(program: Program, joint: str) -> dict[str, int]:
    """A joint and the one on the other side, which an even motion moves alike, with its sign."""
    names = program.body.model.names
    column = program.free.spread[:, program.free.free_names.index(joint)]
    return {names[k]: int(np.sign(column[k])) for k in np.flatnonzero(column)}


class Pricer:
    """Gains of a record where numbers of its program change, by multipliers.

    They say what a limit is worth in the sum of record and effort; how that grows with the worth of
    the record alone is what it buys. So two records of different worth make a price, with the
    effort's part gone.
    """

    def __init__(self, program: Program, task: JumpTask, solved: Solved):
        terms = solved.solution.problem.terms()
        usual = next(t.weight for _, t in terms if t.name == RECORD_TERM)
        other = Asked(task, weights={RECORD_TERM: MORE * usual})
        second = program.solve(other, RECORD, from_solved(program, solved))
        self.program = program
        self.records = (Asked(task), solved), (other, second)
        self.costs = [program.cost_of(*x) for x in self.records]
        # of the cost by what is sought, which is nearly a straight line
        self.slope = -(MORE - 1) * WORTH * (1 - _sought(program, solved) / FAR)
        rises = program.sought[0] == "takeoff_speed"  # a rise goes with its square
        self.by = _sought(program, solved) / task.gravity if rises else 1.0

    def reached(self, solved: Solved) -> float:
        """The number that is sought, to first order about the record [m, rad]."""
        return self.by * _sought(self.program, solved)

    def buys(self, moved: Program) -> float:
        """By how much more is reached by the same program with other numbers [m, rad]."""
        saved = [moved.cost_of(*x) - cost for x, cost in zip(self.records, self.costs, strict=True)]
        return self.by * (saved[1] - saved[0]) / self.slope


def priced(record: Record, most: int) -> Prices:
    """The prices of a record [m or rad of it per unit of each limit]."""
    program = record.program
    task = record.plan.task
    pricer = Pricer(program, task, record.solved)
    active = _active(program, task, record.solved)
    rows = []
    for move in _moves(record, most):
        tell(f"price of {move.limit}")
        moved = replace(program.like(move.robot), limits=move.limits)
        price = pricer.buys(moved) / move.moved
        checked = math.nan
        stays = False
        with suppress(SolverError):
            solved = moved.solve(Asked(task), RECORD, from_solved(moved, record.solved))
            checked = (pricer.reached(solved) - pricer.reached(record.solved)) / move.moved
            stays = _active(moved, task, solved) == active
        rows.append(Price(move.limit, move.unit, price, checked, move.moved, stays))
    rows.sort(key=lambda row: -abs(row.price * row.moved))
    return Prices(record.what, record.plan.robot.name, record.unit, tuple(rows))


def _active(program: Program, task: JumpTask, solved: Solved) -> set[tuple]:
    """The limits that bind, node by node."""
    return {
        (name, column, int(k))
        for name, column, _, lam, limit in program.limits_of(Asked(task), solved)
        for k in np.flatnonzero(np.abs(lam) * np.minimum(np.abs(limit), 1.0) > ACTIVE * WORTH)
    }


def _sought(program: Program, solved: Solved) -> float:
    """The number that is sought, in the words of the program."""
    return next(iter(solved.solution.phases.values())).constants[program.sought[0]]
