"""What is on the ground, when and where: a contact schedule as a value, with the usual ones by name."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from jumplab.errors import InputError, quoted, require_type
from jumplab.robot import Robot
from jumplab.robot.stance import leg_length

SIDES = ("left", "right")
FLIGHT = "-"
# natural times of phases [sqrt(leg / g)] by what carries: bounds of the duration, and where a solve begins
TIMES = {
    "two feet": (1.1, 2.9, 2.1),
    "one foot": (0.4, 2.9, 1.5),
    "toes": (0.15, 0.7, 0.33),
    FLIGHT: (0.5, 1.5, 0.8),
}
INTERVALS = {"two feet": 12, "one foot": 12, "toes": 6, FLIGHT: 12}
STEP_SHARE = 0.33  # of the leg: a step or hop of usual length


def sole_length(robot: Robot) -> float:
    """Length of the sole [m]."""
    return robot.foot.toe - robot.foot.heel


@dataclass(frozen=True)
class ContactPhase:
    """One phase: the feet that carry, and for how long.

    Attributes
    ----------
    feet : "L", "R" for a flat left or right foot, "l", "r" for one on its toes, "-" for flight: "LR", "Lr", "l".
    time_s : (low, high) bounds of the duration [s], which is an unknown.
    guess_s : duration with which a solve begins [s].
    intervals : number of equal steps.
    name : unique in its schedule; made from number and ``feet`` if empty.
    """

    feet: str
    time_s: tuple[float, float]
    guess_s: float
    intervals: int = 12
    name: str = ""

    @property
    def modes(self) -> dict[int, str]:
        """Side (0 left, 1 right) -> "flat" or "toe", of the feet that carry."""
        pairs = [(c, SIDES.index("left" if c in "Ll" else "right")) for c in self.feet if c != FLIGHT]
        return {side: "flat" if c.isupper() else "toe" for c, side in sorted(pairs, key=lambda pair: pair[1])}

    @property
    def flying(self) -> bool:
        """Whether no foot carries."""
        return self.feet == FLIGHT

    @classmethod
    def usual(cls, feet: str, robot: Robot, time_s: tuple[float, float] | None = None) -> ContactPhase:
        """A phase with times and intervals that suit the robot's legs; ``time_s`` instead of its bounds [s]."""
        carried = feet.replace(FLIGHT, "")
        kind = (
            FLIGHT if not carried else "toes" if carried.islower() else "one foot" if len(carried) == 1 else "two feet"
        )
        if len(carried) == 2 and carried != carried.upper():
            kind = "toes"
        unit = math.sqrt(leg_length(robot) / robot.gravity)
        low, high, guess = (x * unit for x in TIMES[kind])
        if time_s is not None:
            low, high = time_s
            guess = min(max(guess, low), high)
        return cls(feet, (low, high), guess, INTERVALS[kind])


@dataclass(frozen=True)
class Place:
    """Where a foot comes down, against where it stood first; and how far the optimiser may move it.

    Attributes
    ----------
    ahead_m, left_m, up_m : way of the foot from its first place [m].
    turn_rad : counter-clockwise seen from above [rad].
    free_m : (ahead, left) by which it may differ, either way [m].
    free_rad : by which the turn may differ, either way [rad].
    """

    ahead_m: float
    left_m: float = 0.0
    turn_rad: float = 0.0
    up_m: float = 0.0
    free_m: tuple[float, float] = (0.0, 0.05)
    free_rad: float = 0.0


@dataclass(frozen=True)
class Contacts:
    """A contact schedule.

    A foot that is on the ground in consecutive phases stays where it is, flat or on its toes; each time it comes down
    again, without speed, it has a new :class:`Place`.

    Attributes
    ----------
    phases : one after the other; the first begins at rest in the stance.
    places : of all contacts after the first ones, in the order of the phases, left before right.
    ends : "rest" (the robot stands still) or "touchdown" (in flight, both flat soles about to meet the ground).

    Raises
    ------
    InputError
        For a schedule that cannot be, in a sentence that names the phase.
    """

    phases: tuple[ContactPhase, ...]
    places: tuple[Place, ...] = ()
    ends: str = "rest"
    landings: tuple[tuple[int, int], ...] = field(init=False)  # (phase, side) of each contact, the first ones included

    def __post_init__(self):
        named = [replace(p, name=p.name or f"{k} {p.feet}") for k, p in enumerate(self._phases(), start=1)]
        object.__setattr__(self, "phases", tuple(named))
        object.__setattr__(self, "places", tuple(self.places))
        self._check_phases()
        landings = [
            (k, side) for k, p in enumerate(named) for side in p.modes if k == 0 or side not in named[k - 1].modes
        ]
        object.__setattr__(self, "landings", tuple(landings))
        self._check_places()
        _ = self.surface

    def _phases(self) -> Iterable[ContactPhase]:
        for p in self.phases:
            require_type(p, ContactPhase, "a phase of the schedule")
        if not self.phases:
            raise InputError("a contact schedule needs at least one phase")
        return self.phases

    def _check_phases(self) -> None:
        for k, p in enumerate(self.phases):
            where = f"phase {p.name!r}"
            letters = p.feet.lower() if isinstance(p.feet, str) else ""
            if letters not in ("l", "r", "lr", FLIGHT):
                raise InputError(
                    f"{where}: feet = {quoted(p.feet)}; write L and R for flat feet, l and r for toes, left before "
                    f"right, or '-' for flight"
                )
            if not (isinstance(p.time_s, tuple) and len(p.time_s) == 2 and 0 < p.guess_s < math.inf):
                raise InputError(f"{where}: time_s must be (low, high) and guess_s a number, both in seconds")
            low, high = p.time_s
            if not 0 < low <= high < math.inf:
                raise InputError(f"{where}: its time of {low:g} to {high:g} s must be positive, and in order")
            if not isinstance(p.intervals, int) or isinstance(p.intervals, bool) or p.intervals < 2:
                raise InputError(f"{where}: intervals = {quoted(p.intervals)} must be a whole number of 2 or more")
            if k and p.feet == self.phases[k - 1].feet:
                raise InputError(f"{where}: the same feet carry as in the phase before; make one phase of them")
        first, last = self.phases[0], self.phases[-1]
        if not first.feet.isupper():
            raise InputError(
                f"phase {first.name!r}: a schedule begins on flat feet, at rest; there is no support to wait on"
            )
        names = [p.name for p in self.phases]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise InputError(f"two phases are called {twice[0]!r}; names must be unique in a schedule")
        if self.ends not in ("rest", "touchdown"):
            raise InputError(f"ends = {quoted(self.ends)}: choose 'rest' or 'touchdown'")
        if last.flying != (self.ends == "touchdown"):
            need = "end in flight" if self.ends == "touchdown" else "end on the ground"
            raise InputError(f"phase {last.name!r}: a schedule that ends with {self.ends!r} has to {need}")

    def _check_places(self) -> None:
        first = len(self.phases[0].modes)
        later = self.landings[first:]
        if first == 1:
            (side,) = self.phases[0].modes
            other = SIDES[1 - side]
            raise InputError(
                f"phase {self.phases[0].name!r}: the schedule begins on one foot; where the {other} one waits "
                f"nobody says; begin with 'LR'"
            )
        if len(self.places) != len(later):
            came = ", ".join(f"{SIDES[side]} in phase {self.phases[k].name!r}" for k, side in later) or "none"
            raise InputError(
                f"places: {len(self.places)} given, but feet come down {len(later)} times ({came}); a foot lands only "
                f"after it has left the ground"
            )

    @property
    def even(self) -> bool:
        """Whether left and right do the same: both carry in the same way, or none, and places are mirror images."""
        if any(p.modes and (len(p.modes) == 1 or len(set(p.modes.values())) > 1) for p in self.phases):
            return False
        pairs = zip(self.places[::2], self.places[1::2], strict=True)
        return all(a == replace(b, left_m=-b.left_m, turn_rad=-b.turn_rad) for a, b in pairs)

    @property
    def surface(self) -> tuple[float, int]:
        """Height of the ground on which the schedule ends [m], and the number of the first place on it.

        Raises :class:`InputError` if places lie on more than one height besides the first.
        """
        heights = [p.up_m for p in self.places]
        height = heights[-1] if heights else 0.0
        first = next((i for i, up in enumerate(heights) if up == height), len(heights))
        if any(up != 0 for up in heights[:first]) or any(up != height for up in heights[first:]):
            told = ", ".join(f"{up:g}" for up in heights)
            raise InputError(
                f"places at the heights {told} m: the ground has one step up or down; "
                f"give all places after it the same up_m, and all before it none"
            )
        return height, first

    def contact_of(self, phase: int, side: int) -> int:
        """Index into :attr:`landings` of the contact that a foot has in a phase."""
        return max(i for i, (k, s) in enumerate(self.landings) if k <= phase and s == side)

    # the usual ones --------------------------------------------------------------------------------------------
    @classmethod
    def of(cls, feet: str, robot: Robot, places: Iterable[Place] = (), *, ends: str = "rest") -> Contacts:
        """A schedule from words such as "LR L l - LR", with times that suit the robot's legs."""
        return cls(tuple(ContactPhase.usual(f, robot) for f in feet.split()), tuple(places), ends)

    @classmethod
    def hop(cls, robot: Robot, ahead_m: float | None = None, *, foot: str = "left", same: bool = False) -> Contacts:
        """Off one foot, and down on both, or with ``same`` on the same one, the other following."""
        if foot not in SIDES:
            raise InputError(f"foot = {quoted(foot)}: choose {' or '.join(SIDES)}")
        d = STEP_SHARE * leg_length(robot) if ahead_m is None else ahead_m
        up, other = ("L", "R") if foot == "left" else ("R", "L")
        land = f"{up} LR" if same else "LR"
        order = (up, other) if same else ("L", "R")
        return cls.of(f"LR {up} {up.lower()} - {land}", robot, [Place(d) for _ in order])

    @classmethod
    def run_up(cls, robot: Robot, steps: int = 1, step_m: float | None = None) -> Contacts:
        """One or more steps, then off one foot, and down on both."""
        d = STEP_SHARE * leg_length(robot) if step_m is None else step_m
        words, places, ahead, last = ["LR"], [], 0.0, "L"
        words.append(last)
        for k in range(steps):
            following = "R" if last == "L" else "L"
            ahead += d if k == 0 else 0.9 * d
            pair = f"{last.lower()}{following}" if last == "L" else f"{following}{last.lower()}"
            words += [pair, following]
            places.append(Place(ahead))
            last = following
        words += [last.lower(), FLIGHT, "LR"]
        places += [Place(ahead + 1.6 * d), Place(ahead + 1.6 * d)]
        return cls.of(" ".join(words), robot, places)

    @classmethod
    def leap(cls, robot: Robot, step_m: float | None = None) -> Contacts:
        """A step, then off the right foot, and down on the left one, the right one following."""
        d = STEP_SHARE * leg_length(robot) if step_m is None else step_m
        return cls.of("LR L lR R r - L LR", robot, [Place(d), Place(2.4 * d), Place(2.4 * d)])

    @classmethod
    def bound(cls, robot: Robot, jumps: int = 2, jump_m: float | None = None) -> Contacts:
        """Jumps off both feet and down on both, one after the other."""
        d = STEP_SHARE * leg_length(robot) if jump_m is None else jump_m
        words = ["LR"] + ["lr", FLIGHT, "LR"] * jumps
        return cls.of(" ".join(words), robot, [Place((1 + k // 2) * d) for k in range(2 * jumps)])

    @classmethod
    def step_off(cls, robot: Robot, drop_m: float, ahead_m: float | None = None) -> Contacts:
        """Off an edge with one foot first, in flight, and down on both, ``drop_m`` lower."""
        d = STEP_SHARE * leg_length(robot) + sole_length(robot) if ahead_m is None else ahead_m
        low = Place(d, up_m=-drop_m)
        return cls.of("LR L l - LR", robot, [low, low])

    @classmethod
    def drop_jump(
        cls, robot: Robot, drop_m: float, ahead_m: float | None = None, jump_m: float | None = None
    ) -> Contacts:
        """Off an edge, down on both feet, and up again at once."""
        d = STEP_SHARE * leg_length(robot) + sole_length(robot) if ahead_m is None else ahead_m
        j = STEP_SHARE * leg_length(robot) if jump_m is None else jump_m
        low, far = Place(d, up_m=-drop_m), Place(d + j, up_m=-drop_m)
        return cls.of("LR L l - LR lr - LR", robot, [low, low, far, far])

    @classmethod
    def hurdle(cls, robot: Robot, step_m: float | None = None) -> Contacts:
        """A step, then off the right foot far ahead onto the left, and on to a stand."""
        d = STEP_SHARE * leg_length(robot) if step_m is None else step_m
        return cls.of("LR L lR R r - L LR", robot, [Place(d), Place(2.8 * d), Place(2.8 * d)])
