"""Which gears, lengths and masses would make a record larger, by a few priced steps.

At each robot the multipliers of its record say what a change of each free number buys
(:class:`.Pricer`); all are moved a little that way, within their ends, and the record is sought
again. A number whose price changes its sign is moved by less.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jumplab.arguments import fitting
from jumplab.errors import InputError, RobotError, Shown, SolverError, quoted
from jumplab.io.progress import tell
from jumplab.ocp.nlp import unexplained
from jumplab.robot import Robot
from jumplab.robot.legs import segments_m
from jumplab.stages.whole_body.starts import RECORD, SEEKING, Asked, from_solved
from jumplab.studies.prices import Pricer

if TYPE_CHECKING:
    from jumplab.studies.record import Record

GEARS = (0.5, 2.0)  # ends of a gear's ratio, against what it is, where none are given
STEP = 0.08  # share by which a number is moved at first
PROBE = 0.005  # share by which it is moved to have its price
MOST_STEPS = 40
SMALLEST = 0.002  # step that is worth another record
PARTS = "thigh_m", "shank_m"


@dataclass(frozen=True)
class Change:
    """A number of the robot that was free.

    Attributes
    ----------
    number, unit : which ("gear of knee"), in what.
    low, high : its ends.
    before, after : what it was, and what it became.
    buys : of what is sought, by its prices on the way [m, rad].
    """

    number: str
    unit: str
    low: float
    high: float
    before: float
    after: float
    buys: float

    @property
    def ends(self) -> bool:
        """Whether it is at one of its ends, so that more of it would buy more."""
        room = 1e-6 * abs(self.after)
        return min(self.high - self.after, self.after - self.low) <= room


@dataclass(frozen=True, repr=False)
class Improved(Shown):
    """A robot with a larger record.

    Attributes
    ----------
    before, after : records of the robot as it was, and as it became (``after.plan.robot``).
    changes : the numbers that were free, the one that buys most first.
    """

    before: Record
    after: Record
    changes: tuple[Change, ...]

    @property
    def robot(self) -> Robot:
        """The robot that came out."""
        return self.after.plan.robot

    def line(self) -> str:
        """Gain, the changes that make it, and the limits that end the new record, in one line."""
        old, new = self.before, self.after
        changed = [
            f"{x.number} {x.before:.3g} -> {x.after:.3g}{x.unit and ' ' + x.unit}"
            + " (at its end)" * x.ends
            for x in self.changes
            if x.before != x.after
        ]
        ends = list(dict.fromkeys(f"{x.joint} {x.limit}".strip() for x in new.limits))[:3]
        return (
            f"{old.plan.robot.name}: {old.what} at least {old.value:.3f} -> {new.value:.3f} "
            f"{old.unit} by {', '.join(changed) or 'no change'}; then it ends by {', '.join(ends)}"
        )


# the numbers that may change, by their sort, and joint, role or links that they belong to
Free = Mapping[tuple[str, Any], Change]


def improve(record: Record, free: Mapping[str, Any], budget: int = 6) -> Improved:
    """See :meth:`.Record.improve`."""
    numbers = _numbers(record.plan.robot, free)
    if not 0 < budget <= MOST_STEPS:
        raise InputError(f"budget = {budget} records must be 1 to {MOST_STEPS}")
    with unexplained():
        shares, buys = _climbed(record, numbers, budget)
    robot = _changed(record.plan.robot, numbers, shares)
    after = record if (shares == 1).all() else record.again(robot)
    if after.value < record.value:
        after, shares, buys = record, np.ones(len(numbers)), 0 * buys
    rows = [
        replace(x, after=float(s * x.before), buys=float(b))
        for x, s, b in zip(numbers.values(), shares, buys, strict=True)
    ]
    return Improved(record, after, tuple(sorted(rows, key=lambda x: -x.buys)))


def _climbed(record: Record, numbers: Free, budget: int) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the numbers (n,) with the largest record, and what each bought (n,)."""
    low, high = np.array([(x.low / x.before, x.high / x.before) for x in numbers.values()]).T
    shares = np.ones(len(numbers))
    buys = np.zeros(len(numbers))
    steps = np.full(len(numbers), STEP)
    before = np.zeros(len(numbers))
    program, solved = record.program, record.solved
    asked = Asked(record.plan.task)
    prices = None
    for _ in range(budget):
        if prices is None:
            pricer = Pricer(program, asked.task, solved)
            each = (_price(pricer, record, numbers, shares, k) for k in range(len(numbers)))
            prices = np.array(list(each))
            steps = np.where(before * prices < 0, steps / 2, steps)
            before = np.sign(prices)
        moved = np.clip(shares * (1 + before * steps), low, high)
        if np.abs(moved / shares - 1).max() < SMALLEST:
            break
        each = zip(numbers.values(), moved, strict=True)
        tell(f"record with {', '.join(f'{x.number} {s * x.before:.3g}' for x, s in each)}")
        candidate = None
        with suppress(RobotError):
            other = program.like(_changed(record.plan.robot, numbers, moved))
            for start in (RECORD, SEEKING):
                with suppress(SolverError):
                    candidate = other.solve(asked, start, from_solved(other, solved))
                    break
        if candidate is None or pricer.reached(candidate) <= pricer.reached(solved):
            steps = steps / 2
            continue
        buys += prices * (moved / shares - 1)
        shares, program, solved, prices = moved, other, candidate, None
    return shares, buys


def _price(pricer: Any, record: Record, numbers: Free, shares: np.ndarray, k: int) -> float:
    """Gain of the record per share of a number [m, rad]."""
    for step in (PROBE, -PROBE):
        moved = shares.copy()
        moved[k] *= 1 + step
        with suppress(RobotError):
            robot = _changed(record.plan.robot, numbers, moved)
            return pricer.buys(pricer.program.like(robot)) / step
    return 0.0


# the numbers
# ----------------------------------------------------------------------------------------------
def _numbers(robot: Robot, free: Mapping[str, Any]) -> Free:
    """Numbers that may change; raises :class:`InputError` for one that the robot does not have."""
    kinds = ("gear", *PARTS, "mass_kg")
    if not free or set(free) - set(kinds):
        raise InputError(
            f"free = {quoted(free)}: must be a mapping of what may change, from {', '.join(kinds)}"
        )
    out = {}
    for kind, given in free.items():
        if kind == "gear":
            rows = given if isinstance(given, Mapping) else dict.fromkeys(_listed(given), GEARS)
            sizes = {key: 1.0 for key in rows}
        elif kind in PARTS:
            rows = {kind: given}
            sizes = {kind: segments_m(robot)[PARTS.index(kind)]}
        else:
            rows = given if isinstance(given, Mapping) else {None: given}
            sizes = {key: _mass(robot, key) for key in rows}
        for key, ends in rows.items():
            word = kind.partition("_")[0]
            if key not in (kind, None):
                word += f" of {' and '.join(key) if isinstance(key, tuple) else key}"
            low, high = _ends(word, ends)
            size = sizes[key]
            if not low <= size <= high:
                raise InputError(
                    f"{word} is {size:.4g} now, outside the given range {low:g} ... {high:g}; "
                    f"widen it"
                )
            unit = "" if kind == "gear" else kind.rpartition("_")[2]
            out[kind, key] = Change(word, unit, low, high, size, size, 0.0)
    _changed(robot, out, np.full(len(out), 1 + 1e-6))  # refuses names that the robot lacks
    return out


def _listed(given: Any) -> list:
    if not isinstance(given, str | list | tuple) or not given:
        raise InputError(
            f"gear = {quoted(given)}: give joints or roles, or a mapping of them to (low, high)"
        )
    return [given] if isinstance(given, str) else list(given)


def _ends(word: str, ends: Any) -> tuple[float, float]:
    low, high = fitting(ends, tuple[float, float], f"the range of {word}")
    if not 0 < low < high:
        raise InputError(f"the range of {word} must be positive and in order, got {quoted(ends)}")
    return low, high


def _mass(robot: Robot, link: Any) -> float:
    """Of a link, or of the first of several, or of the whole robot [kg]."""
    if link is None:
        return robot.total_mass
    heavier = robot.with_mass(link, factor=2.0)  # refuses links that the robot lacks
    count = len(link) if isinstance(link, tuple) else 1
    return round((heavier.total_mass - robot.total_mass) / count, 9)


def _changed(robot: Robot, numbers: Free, shares: np.ndarray) -> Robot:
    """The robot with its numbers at these ``shares`` (n,) of what they are."""
    moved = [(*key, float(s)) for key, s in zip(numbers, shares, strict=True) if s != 1]
    gears = {key: s for kind, key, s in moved if kind == "gear"}
    legs = {kind.removesuffix("_m"): s for kind, _, s in moved if kind in PARTS}
    robot = robot.with_gears(gears) if gears else robot
    robot = robot.with_legs(**legs) if legs else robot
    for kind, key, share in moved:
        if kind == "mass_kg":
            robot = robot.with_mass(list(key) if isinstance(key, tuple) else key, factor=share)
    return robot
