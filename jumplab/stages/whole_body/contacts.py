"""Contact schedule: the feet on the ground, with their times and places, as a value; the usual
schedules have names.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

from jumplab.arguments import checked
from jumplab.errors import InputError, quoted
from jumplab.robot import Robot
from jumplab.robot.stance import leg_length
from jumplab.stages.whole_body.settings import Limits, Mesh
from jumplab.task import MOST_STEPS, JumpTask

SIDES = ("left", "right")
HOLD = ("x", "y", "z", "yaw")  # of the middle of the toe edge of a foot that carries
FLIGHT = "-"
# natural times of phases [sqrt(leg / g)] by what carries: bounds of the duration, and where a solve
# begins
TIMES = {
    "two feet": (1.1, 2.9, 2.1),
    "one foot": (0.4, 2.9, 1.5),
    "toes": (0.15, 0.7, 0.33),
    FLIGHT: (0.5, 1.5, 0.8),
}
INTERVALS = {"two feet": 12, "one foot": 12, "toes": 6, FLIGHT: 12}
STEP_SHARE = 0.33  # of the leg: a step or hop of usual length
# of a step of usual length, by which the feet of a run-up come down ahead of each other
LONGER = 0.9
# of the leg, from the toes to a block ahead of them, and from it to the heels beyond; its length
BEFORE_BLOCK = 0.3
BLOCK_M = 0.05
# natural time on one foot beyond it, as of :data:`TIMES`: a robot that differs from its model and
# stops over one foot falls
RUN_ON = (0.4, 1.3, 1.04)
RUN_ON_STEPS = 1.3  # of usual length, by which the other foot comes down ahead of that one
FREE_SHARE = 0.5  # of it, by which those before a target may be longer or shorter


def modes_of(feet: str) -> dict[int, str]:
    """Side (0 left, 1 right) -> "flat" or "toe", of ``feet`` as of :class:`ContactPhase`."""
    sides = sorted(("LR".index(c.upper()), c) for c in feet if c != FLIGHT)
    return {side: "flat" if c.isupper() else "toe" for side, c in sides}


@dataclass(frozen=True)
class ContactPhase:
    """One phase: the feet that carry, and for how long.

    Attributes
    ----------
    feet : "L", "R" for a flat left or right foot, "l", "r" for one on its toes, "-" for flight:
        "LR", "Lr", "l".
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
        """Side -> "flat" or "toe", of the feet that carry."""
        return modes_of(self.feet)

    @property
    def flying(self) -> bool:
        """Whether no foot carries."""
        return self.feet == FLIGHT

    @classmethod
    @checked
    def usual(cls, feet: str, robot: Robot) -> ContactPhase:
        """A phase with times [s] and intervals that suit the robot's legs; ``feet`` as above."""
        kind = "toes"
        if feet == feet.upper():
            kind = FLIGHT if feet == FLIGHT else "one foot" if len(feet) == 1 else "two feet"
        unit = math.sqrt(leg_length(robot) / robot.gravity)
        low, high, guess = (x * unit for x in TIMES[kind])
        return cls(feet, (low, high), guess, INTERVALS[kind])


@checked
@dataclass(frozen=True)
class Place:
    """Place where a foot comes down, against where it stood first; and the range within which the
    optimiser may move it.

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


@checked
@dataclass(frozen=True)
class Contacts:
    """A contact schedule.

    A foot that is on the ground in consecutive phases stays where it is, flat or on its toes; each
    time it comes down again, without speed, it has a new :class:`Place`.

    Attributes
    ----------
    phases : one after the other; the first begins at rest in the stance.
    places : of all contacts after the first ones, in the order of the phases, left before right.
    ends : "rest" (the robot stands still) or "touchdown" (in flight, both flat soles about to meet
        the ground).
    first : places of the first contacts, left before right; those of the stance if empty.
    aimed : whether the last flight has the rise of the target, and covers its distance; its places
        count from there, not from where a foot stood first.
    over : (from, to, top) of a block across the way that every link clears, ahead of the toes'
        first place [m]; None if there is none.

    Raises
    ------
    InputError
        For an impossible schedule; the message names the phase.
    """

    phases: tuple[ContactPhase, ...]
    places: tuple[Place, ...] = ()
    ends: str = "rest"
    first: tuple[Place, ...] = ()
    aimed: bool = False
    over: tuple[float, float, float] | None = None
    # (phase, side) of each contact, the first ones included
    landings: tuple[tuple[int, int], ...] = field(init=False)

    def __post_init__(self):
        named = [replace(p, name=p.name or f"{k} {p.feet}") for k, p in enumerate(self.phases, 1)]
        object.__setattr__(self, "phases", tuple(named))
        object.__setattr__(self, "places", tuple(self.places))
        for fault in self._faults():
            raise InputError(fault)
        usual = (Place(0.0, free_m=(0.0, 0.0)),) * len(self.phases[0].modes)
        object.__setattr__(self, "first", tuple(self.first) or usual)
        _ = self.surface

    def _faults(self) -> Iterator[str]:
        """Faults of the schedule, in words; on the way it finds where feet land."""
        phases = self.phases
        if not phases:
            yield "a contact schedule needs at least one phase"
        for k, p in enumerate(phases):
            if fault := _fault_of(p):
                yield f"phase {p.name!r}: {fault}"
            if k and p.feet == phases[k - 1].feet:
                yield (
                    f"phase {p.name!r}: the same feet are on the ground as in the phase before; "
                    f"make one phase of them"
                )
        first = phases[0]
        last = phases[-1]
        if not first.feet.isupper():
            yield (
                f"phase {first.name!r}: a schedule must begin at rest on flat feet, where the "
                f"robot can wait; begin with 'LR'"
            )
        counts = Counter(p.name for p in phases)
        if twice := sorted(name for name, count in counts.items() if count > 1):
            yield f"two phases are called {twice[0]!r}; names must be unique in a schedule"
        if self.over and not (self.over[0] < self.over[1] and self.over[2] > 0):
            yield f"over = {self.over}: give (from, to, top) of a block [m], from < to and top > 0"
        if self.over and any(p.up_m for p in self.places):
            yield "over: a block lies on level ground; leave out up_m, or the block"
        if self.ends not in ("rest", "touchdown"):
            yield f"ends = {quoted(self.ends)}: choose 'rest' or 'touchdown'"
        if last.flying != (self.ends == "touchdown"):
            need = "end on the ground" if last.flying else "end in flight"
            yield f"phase {last.name!r}: a schedule that ends with {self.ends!r} has to {need}"
        if len(first.modes) == 1:
            (side,) = first.modes
            yield (
                f"phase {first.name!r}: the schedule begins on one foot without a place for "
                f"the {SIDES[1 - side]} one; begin with 'LR'"
            )
        before = [{}, *(p.modes for p in phases)]
        landings = [(k, s) for k, p in enumerate(phases) for s in p.modes if s not in before[k]]
        object.__setattr__(self, "landings", tuple(landings))
        if self.first and len(self.first) != len(first.modes):
            yield (
                f"first: {len(self.first)} places given for {len(first.modes)} feet that "
                f"stand; give one per foot"
            )
        later = landings[len(first.modes) :]
        if len(self.places) != len(later):
            came = [f"{SIDES[side]} in phase {phases[k].name!r}" for k, side in later]
            yield (
                f"places: {len(self.places)} given, but feet come down {len(later)} times "
                f"({', '.join(came) or 'none'}); a foot lands only after it has left the ground"
            )

    @property
    def even(self) -> bool:
        """Whether left and right do the same: both carry in the same way, or none, and places are
        mirror images.
        """
        if any(p.feet not in ("LR", "lr", FLIGHT) for p in self.phases):
            return False
        pairs = zip(self.places[::2], self.places[1::2], strict=True)
        return all(a == replace(b, left_m=-b.left_m, turn_rad=-b.turn_rad) for a, b in pairs)

    @property
    def surface(self) -> tuple[float, int]:
        """Height of the ground on which the schedule ends [m], and the number of the first place on
        it.

        Raises :class:`InputError` if places lie on more than one height besides the first.
        """
        heights = [p.up_m for p in self.places]
        height = heights[-1] if heights else 0.0
        first = next((i for i, up in enumerate(heights) if up == height), len(heights))
        wrong = [i for i, up in enumerate(heights) if up != (height if i >= first else 0.0)]
        if wrong:
            listed = ", ".join(f"{up:g}" for up in heights)
            phase, side = self.landings[len(self.phases[0].modes) + wrong[0]]
            raise InputError(
                f"phase {self.phases[phase].name!r}: the {SIDES[side]} foot comes down "
                f"{heights[wrong[0]]:g} m high, in places at the heights {listed} m; the ground "
                f"can have only one step up or down: give all places after it the same up_m, and "
                f"all before it none"
            )
        return height, first

    @property
    def last_flight(self) -> int:
        """Number of the last phase in flight; -1 if there is none."""
        return max((k for k, p in enumerate(self.phases) if p.flying), default=-1)

    @property
    def rebounds(self) -> tuple[int, ...]:
        """Numbers of the flights after which both feet come down flat, where the robot is to be
        caught; none unless it goes on to fly again after one of them.
        """
        pairs = enumerate(pairwise(self.phases))
        caught = tuple(k for k, (p, after) in pairs if p.flying and after.feet == "LR")
        return caught if caught and caught[0] < self.last_flight else ()

    def is_aimed(self, contact: int) -> bool:
        """Whether a contact (index into :attr:`landings`) is one that the target places."""
        return self.aimed and self.landings[contact][0] > self.last_flight

    def contact_of(self, phase: int, side: int) -> int:
        """Index into :attr:`landings` of the contact of a foot (0 left, 1 right) in a phase."""
        return max(i for i, (k, s) in enumerate(self.landings) if k <= phase and s == side)

    @classmethod
    @checked
    def to(cls, task: JumpTask, robot: Robot, flight_s: tuple[float, float]) -> Contacts:
        """The schedule of a target that asks for steps, or for a take-off or a landing on one foot;
        ``flight_s`` bounds the last flight [s].

        The steps may be longer or shorter, but for those towards an edge, and those to a take-off
        off both feet, which stand side by side.
        """
        words = _course(task.takeoff, task.run_up, task.landing).split()
        flight = words.index(FLIGHT)
        d = _step(robot, None)
        free = FREE_SHARE * d * (task.takeoff != "both" and not task.platform_m)
        ahead = [d * (1 + LONGER * k) for k in range(task.run_up)]
        ahead += ahead[-1:] * (task.takeoff == "both")
        steps = [Place(x, free_m=(free, Place.free_m[1])) for x in ahead]
        landed = Place(0.0, task.side_m)
        phases = [ContactPhase.usual(feet, robot) for feet in words]
        phases[flight] = replace(phases[flight], time_s=flight_s)
        return cls(tuple(phases), (*steps, landed, landed), aimed=True)

    @classmethod
    @checked
    def named(cls, words: str, robot: Robot) -> Contacts:
        """One of the usual ones by its name in :data:`NAMED`, with its first number: "leap",
        "hop=0.2" [m], "run_up=2" steps.

        Raises :class:`InputError` for another name, or a number that it cannot have.
        """
        name, equals, text = words.partition("=")
        if name not in NAMED:
            raise InputError(f"contacts {quoted(name)}: choose one of {', '.join(NAMED)}")
        unit, number, needed = NAMED[name]
        try:
            given = [number(text)] if equals or needed else []
        except ValueError:
            raise InputError(
                f"contacts {quoted(words)}: write {name}=N, N a number of {unit}"
            ) from None
        return getattr(cls, name)(robot, *given)

    # the usual ones, with steps of usual length where none is given [m]
    # ------------------------------------------------------------------------------------------
    @classmethod
    def of(
        cls, feet: str, robot: Robot, places: Iterable[Place] = (), *, ends: str = "rest"
    ) -> Contacts:
        """A schedule from words such as "LR L l - LR", with times [s] that suit the robot's legs.

        Raises :class:`InputError` as the class does, as all below.
        """
        phases = tuple(ContactPhase.usual(f, robot) for f in feet.split())
        return cls(phases, tuple(places), ends)._falling(robot.gravity)

    def _falling(self, gravity: float) -> Contacts:
        """The same whose flight onto lower ground takes the time of the fall; a guess of a level
        flight sends the solver astray.
        """
        height, first = self.surface
        if height >= 0:
            return self
        k, _ = self.landings[len(self.first) + first]
        p = self.phases[k - 1]
        half = p.guess_s / 2
        more_s = math.sqrt(half**2 - 2 * height / gravity) - half
        low, high = p.time_s
        longer = replace(p, guess_s=p.guess_s + more_s, time_s=(low, high + more_s))
        return replace(self, phases=(*self.phases[: k - 1], longer, *self.phases[k:]))

    @classmethod
    def hop(
        cls, robot: Robot, ahead_m: float | None = None, *, foot: str = "left", same: bool = False
    ) -> Contacts:
        """Off one foot, and down on both ``ahead_m`` [m] further, or with ``same`` on the same one,
        the other following.
        """
        if foot not in SIDES:
            raise InputError(f"foot = {quoted(foot)}: choose {' or '.join(SIDES)}")
        place = Place(_step(robot, ahead_m))
        return cls.of(_course(foot, 0, foot if same else "both"), robot, [place, place])

    @classmethod
    def run_up(cls, robot: Robot, steps: int = 1, step_m: float | None = None) -> Contacts:
        """``steps`` (0 to 30) of ``step_m`` [m], then off one foot, and down on both."""
        _check_count("steps", steps, 0)
        d = _step(robot, step_m)
        words = _course(SIDES[steps % 2], steps, "both")
        ahead = [d * (1 + LONGER * k) for k in range(steps)]
        jump = (ahead or [0.0])[-1] + 1.6 * d
        return cls.of(words, robot, [Place(x) for x in (*ahead, jump, jump)])

    @classmethod
    def leap(cls, robot: Robot, step_m: float | None = None, *, share: float = 2.4) -> Contacts:
        """A step of ``step_m`` [m], then off the right foot, and down on the left one, the other
        following; ``share`` is how many steps ahead they land.
        """
        d = _step(robot, step_m)
        far = Place(share * d)
        return cls.of(_course("right", 1, "left"), robot, [Place(d), far, far])

    @classmethod
    def hurdle(cls, robot: Robot, height_m: float = 0.0, step_m: float | None = None) -> Contacts:
        """A leap that goes farther, ``step_m`` [m] as there; if ``height_m`` is not 0, over a block
        so high [m] in the middle of it, and on by a step.
        """
        if height_m == 0:
            return cls.leap(robot, step_m, share=2.8)
        d = _step(robot, step_m)
        gap = BEFORE_BLOCK * leg_length(robot)
        block = d + gap, d + gap + BLOCK_M, height_m
        landed = block[1] + gap + robot.foot.toe - robot.foot.heel
        leap = cls.leap(robot, d, share=landed / d)
        step, down, _ = leap.places
        on = replace(down, ahead_m=landed + RUN_ON_STEPS * d)
        low, high, guess = (x * math.sqrt(leg_length(robot) / robot.gravity) for x in RUN_ON)
        *before, alone, last = leap.phases
        alone = replace(alone, time_s=(low, high), guess_s=guess)
        return replace(leap, phases=(*before, alone, last), places=(step, down, on), over=block)

    @classmethod
    def bound(cls, robot: Robot, jumps: int = 2, jump_m: float | None = None) -> Contacts:
        """Jumps of ``jump_m`` [m] off both feet and down on both, in a row."""
        _check_count("jumps", jumps, 1)
        d = _step(robot, jump_m)
        places = [Place((1 + k // 2) * d) for k in range(2 * jumps)]
        return cls.of("LR" + " lr - LR" * jumps, robot, places)

    @classmethod
    def step_off(cls, robot: Robot, drop_m: float, ahead_m: float | None = None) -> Contacts:
        """Off an edge with one foot first, in flight, and down on both, ``drop_m`` [m] lower."""
        low = Place(_past_edge_m(robot, ahead_m), up_m=-drop_m)
        return cls.of(_course("left", 0, "both"), robot, [low, low])

    @classmethod
    def drop_jump(
        cls, robot: Robot, drop_m: float, ahead_m: float | None = None, jump_m: float | None = None
    ) -> Contacts:
        """Off an edge ``drop_m`` [m] down onto both feet, and at once on by ``jump_m`` [m]."""
        low = Place(_past_edge_m(robot, ahead_m), up_m=-drop_m)
        far = replace(low, ahead_m=low.ahead_m + _step(robot, jump_m))
        return cls.of("LR L l - LR lr - LR", robot, [low, low, far, far])


# usual schedules: unit and kind of their first number, and whether they need one
NAMED = {
    "hop": ("metres", float, False),
    "run_up": ("steps", int, False),
    "leap": ("metres", float, False),
    "hurdle": ("metres of height", float, False),
    "bound": ("jumps", int, False),
    "step_off": ("metres", float, True),
    "drop_jump": ("metres", float, True),
}


def jump_contacts(limits: Limits, mesh: Mesh) -> Contacts:
    """The schedule of a standing jump, which ends at touchdown; durations [s] by ``limits``,
    intervals by ``mesh``.
    """
    phases = (
        ContactPhase("LR", limits.flat_s, 0.6, mesh.flat, "flat"),
        ContactPhase("lr", limits.toe_s, 0.1, mesh.toe, "toe"),
        ContactPhase("-", limits.flight_s, 0.5, mesh.flight, "flight"),
    )
    return Contacts(phases, ends="touchdown")


def _course(takeoff: str, steps: int, landing: str) -> str:
    """Words, as of :meth:`Contacts.of`, of ``steps`` from a stand, one foot after the other, a
    take-off and a landing, each on the feet of such words as of :class:`.JumpTask`.
    """
    alone = takeoff in SIDES
    last = SIDES.index(takeoff) if alone else 0
    # the foot that stands first, then those of the steps
    sides = [(last + steps - k) % 2 for k in range(steps + 1)]
    words = ["LR"]
    if steps or alone:
        words.append("LR"[sides[0]])
    for before, side in pairwise(sides):
        words += [("lR", "Lr")[before], "LR"[side]]
    if steps and not alone:
        words.append("LR")
    words += ["lr"[last] if alone else "lr", FLIGHT]
    if landing in SIDES:
        words.append("LR"[SIDES.index(landing)])
    return " ".join([*words, "LR"])


def _step(robot: Robot, given_m: float | None) -> float:
    return STEP_SHARE * leg_length(robot) if given_m is None else given_m


def _check_count(name: str, count: int, least: int) -> None:
    if not least <= count <= MOST_STEPS:
        raise InputError(f"{name} = {quoted(count)} is outside {least} ... {MOST_STEPS}")


def _past_edge_m(robot: Robot, given_m: float | None) -> float:
    """Distance at which feet come down past an edge [m]: ``given_m``, or a step and the sole."""
    return _step(robot, None) + (robot.foot.toe - robot.foot.heel) if given_m is None else given_m


def _fault_of(p: ContactPhase) -> str:
    """Fault of a phase by itself, in words; empty if it has none."""
    letters = p.feet.lower() if isinstance(p.feet, str) else ""
    if letters not in ("l", "r", "lr", FLIGHT):
        return (
            f"feet = {quoted(p.feet)}; write L and R for flat feet, l and r for toes, left before "
            f"right, or '-' for flight"
        )
    if not (isinstance(p.time_s, tuple) and len(p.time_s) == 2 and 0 < p.guess_s < math.inf):
        return "time_s must be (low, high) and guess_s a number, both in seconds"
    low, high = p.time_s
    if not 0 < low <= high < math.inf:
        return f"its time of {low:g} to {high:g} s must be positive, and in order"
    if not isinstance(p.intervals, int) or isinstance(p.intervals, bool) or p.intervals < 2:
        return f"intervals = {quoted(p.intervals)} must be a whole number of 2 or more"
    return ""
