"""Contact schedules: what they say of feet and places, the usual ones, and those that cannot be."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from fixtures_core import refused

from jumplab.errors import InputError
from jumplab.ocp.layout import layouts
from jumplab.robot import Robot
from jumplab.robot.stance import leg_length
from jumplab.stages.whole_body import ContactPhase, Contacts, Limits, Mesh, Place, Weights, motions
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import INTERVALS, RUN_ON_STEPS, STEP_SHARE, TIMES, jump_contacts
from jumplab.stages.whole_body.coordinates import whole
from jumplab.stages.whole_body.ground import surface_of_schedule
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.terms import over_block
from jumplab.task import JumpTask

LEAP = "LR L lR R r - L LR"


def phases(words: str, **how) -> tuple[ContactPhase, ...]:
    """A phase of half a second for each word."""
    return tuple(ContactPhase(word, (0.1, 1.0), 0.5, **how) for word in words.split())


def one(word: str) -> ContactPhase:
    return phases(word)[0]


def schedule(words: str, places: int = 0, **how) -> Contacts:
    return Contacts(phases(words), tuple(Place(0.3 + 0.1 * k) for k in range(places)), **how)


def reached(contacts: Contacts) -> list[float]:
    """Places ahead [m]."""
    return [p.ahead_m for p in contacts.places]


def letters(contacts: Contacts) -> str:
    return " ".join(p.feet for p in contacts.phases)


# what a schedule says -----------------------------------------------------------------------------
def test_letters_are_feet_and_how_they_stand():
    modes = [one(word).modes for word in ("LR", "lR", "Lr", "l", "R", "-")]
    flat, toe = "flat", "toe"
    assert modes == [{0: flat, 1: flat}, {0: toe, 1: flat}, {0: flat, 1: toe}, {0: toe}, {1: flat}, {}]
    assert [one(word).flying for word in ("LR", "-")] == [False, True]


def test_phases_have_names_of_their_own():
    assert [p.name for p in schedule("LR lr - LR", 2).phases] == ["1 LR", "2 lr", "3 -", "4 LR"]
    named = ContactPhase("LR", (0.1, 1.0), 0.5, name="push"), ContactPhase("L", (0.1, 1.0), 0.5)
    assert [p.name for p in Contacts(named).phases] == ["push", "2 L"]


def test_a_foot_that_comes_down_has_a_new_contact():
    """A heel that rises or comes down again leaves the foot where it is."""
    leap = schedule(LEAP, 3)
    assert leap.landings == ((0, 0), (0, 1), (2, 1), (6, 0), (7, 1))
    found = []
    for k, p in enumerate(leap.phases):
        found.append({side: leap.contact_of(k, side) for side in p.modes})
    assert found == [{0: 0, 1: 1}, {0: 0}, {0: 0, 1: 2}, {1: 2}, {1: 2}, {}, {0: 3}, {0: 3, 1: 4}]
    stands = schedule("LR lr LR L LR", 1)
    assert stands.landings == ((0, 0), (0, 1), (4, 1)) and stands.contact_of(2, 1) == 1


def stairs(words: str, *heights: float) -> Contacts:
    return Contacts(phases(words), tuple(Place(0.3, up_m=up) for up in heights))


@pytest.mark.parametrize(
    ("heights", "surface"),
    [((), (0.0, 0)), ((0.0, 0.0), (0.0, 0)), ((-0.3, -0.3), (-0.3, 0)), ((0.0, 0.0, 0.2, 0.2), (0.2, 2))],
)
def test_the_ground_has_one_step(heights, surface):
    words = "LR" + " - LR" * (len(heights) // 2)
    assert stairs(words, *heights).surface == surface


# the usual ones -----------------------------------------------------------------------------------
def usual(robot) -> dict[str, tuple[Contacts, str, list[float], float]]:
    """Name -> (schedule, its letters, its places in steps of usual length, how high they are [m]).

    Off an edge a step is longer by a sole.
    """
    off = 1 + (robot.foot.toe - robot.foot.heel) / (STEP_SHARE * leg_length(robot))
    return {
        "hop": (Contacts.hop(robot), "LR L l - LR", [1, 1], 0.0),
        "hop off the right": (Contacts.hop(robot, foot="right"), "LR R r - LR", [1, 1], 0.0),
        "hop onto the same": (Contacts.hop(robot, same=True), "LR L l - L LR", [1, 1], 0.0),
        "run up": (Contacts.run_up(robot), "LR L lR R r - LR", [1, 2.6, 2.6], 0.0),
        "two steps": (Contacts.run_up(robot, 2), "LR L lR R Lr L l - LR", [1, 1.9, 3.5, 3.5], 0.0),
        "leap": (Contacts.leap(robot), LEAP, [1, 2.4, 2.4], 0.0),
        "bound": (Contacts.bound(robot), "LR lr - LR lr - LR", [1, 1, 2, 2], 0.0),
        "step off": (Contacts.step_off(robot, 0.3), "LR L l - LR", [off, off], -0.3),
        "drop jump": (Contacts.drop_jump(robot, 0.3), "LR L l - LR lr - LR", [off, off, off + 1, off + 1], -0.3),
        "hurdle": (Contacts.hurdle(robot), LEAP, [1, 2.8, 2.8], 0.0),
    }


def test_the_usual_schedules_have_their_letters_and_places(bhr):
    step = STEP_SHARE * leg_length(bhr)
    for name, (contacts, said, ahead, up) in usual(bhr).items():
        assert letters(contacts) == said, name
        assert contacts.ends == "rest", name
        assert reached(contacts) == pytest.approx([step * x for x in ahead]), name
        assert {p.up_m for p in contacts.places} == {up} and contacts.surface == (up, 0), name
        assert {(p.left_m, p.turn_rad) for p in contacts.places} == {(0.0, 0.0)}, name
        later = contacts.landings[2:]
        assert len(later) == len(contacts.places), name
        assert all(a.ahead_m <= b.ahead_m for a, b in pairwise(contacts.places)), name


def test_lengths_may_be_told(bhr):
    assert reached(Contacts.hop(bhr, 0.1)) == [0.1, 0.1]
    bound, off = Contacts.bound(bhr, 3, 0.2), Contacts.drop_jump(bhr, 0.3, 0.4, 0.5)
    assert reached(bound) == pytest.approx([0.2, 0.2, 0.4, 0.4, 0.6, 0.6])
    assert reached(off) == pytest.approx([0.4, 0.4, 0.9, 0.9])


def test_phases_take_times_that_suit_the_legs(bhr):
    """Twice the time under a quarter of gravity; a solve begins within the bounds."""
    unit = np.sqrt(leg_length(bhr) / bhr.gravity)
    kinds = {"LR": "two feet", "L": "one foot", "r": "toes", "lr": "toes", "lR": "toes", "-": "-"}
    for feet, kind in kinds.items():
        p = ContactPhase.usual(feet, bhr)
        assert (*p.time_s, p.guess_s) == pytest.approx([x * unit for x in TIMES[kind]]), feet
        assert p.time_s[0] <= p.guess_s <= p.time_s[1] and p.intervals == INTERVALS[kind]
        slow = ContactPhase.usual(feet, bhr.under_gravity(bhr.gravity / 4))
        assert slow.guess_s == pytest.approx(2 * p.guess_s)


def test_a_standing_jump_ends_in_flight():
    limits = Limits()
    contacts = jump_contacts(limits, Mesh(12, 6, 10))
    assert letters(contacts) == "LR lr -" and contacts.ends == "touchdown"
    found = [(p.name, p.time_s, p.intervals) for p in contacts.phases]
    assert found == [("flat", limits.flat_s, 12), ("toe", limits.toe_s, 6), ("flight", limits.flight_s, 10)]


# as a problem -------------------------------------------------------------------------------------
def test_phases_share_what_does_not_jump(bhr):
    """Forces and accelerations jump at a landing; the rows of shared quantities stand only once."""
    limits, weights = Limits(), Weights()
    phases = Schedule(Body(bhr), Contacts.leap(bhr), limits, weights).problem().phases
    assert [p.shared for p in phases] == ["", "qvaz", "qv", "qvaz", "qvaz", "qvaz", "qv", "qv"]
    skips = [{t.name: t.skip[0] for t in p.terms} for p in phases]
    levels = "in place", "still", "held"
    stood, landed, joined = (1, 1, 0), (0, 0, 0), (1, 1, 1)
    for k, side, expected in (
        (1, "left", joined), (2, "left", stood), (2, "right", landed), (3, "right", joined), (6, "left", landed),
        (7, "left", stood), (7, "right", landed),
    ):  # fmt: skip
        assert tuple(skips[k][f"{side} foot {level}"] for level in levels) == expected, (k, side)
    assert [x["base forces"] for x in skips] == [0, 1, 0, 1, 1, 1, 0, 0]


def test_footholds_are_one_unknown_in_all_phases_of_a_contact(bhr):
    body = Body(bhr)
    place = Place(0.3, 0.05, 0.2, 0.0, (0.01, 0.02), 0.1)
    contacts = Contacts.of("LR L LR lr LR", bhr, [place])
    schedule = Schedule(body, contacts, Limits(), Weights())
    x, y, z = body.places[1]
    moved = [(x + 0.29, x + 0.31), (y + 0.03, y + 0.07), (z, z), (0.1, 0.3)]
    np.testing.assert_allclose(schedule.foothold(2), moved, atol=1e-12)
    np.testing.assert_allclose(schedule.foothold(1), [(x, x), (y, y), (z, z), (0.0, 0.0)])
    found = layouts(schedule.problem())
    at = {}
    for phase in schedule.problem().phases:
        at[phase.name] = dict(zip(phase.constants, found[phase.name].constants[1:].tolist(), strict=True))
    assert at["1 LR"]["left_x"] == at["2 L"]["left_x"] == at["5 LR"]["left_x"]
    assert at["3 LR"]["right_x"] == at["4 lr"]["right_x"] == at["5 LR"]["right_x"]
    assert at["1 LR"]["right_x"] != at["3 LR"]["right_x"]


@pytest.mark.parametrize("beside", (0.0, 0.05, 0.25))
def test_the_roof_over_a_block_covers_it_and_ends_before_the_footholds(bhr, beside):
    """The block, whatever the distance of the footholds; these where they are not right at the block."""
    first, last, top = block = (0.4, 0.45, 0.2)
    body, limits = Body(bhr), Limits()
    term = over_block(Mode(body, limits, Weights(), "-", whole(body)), block, beside)

    def height(ahead: float) -> np.ndarray:
        """That each link needs."""
        place = ca.DM([float(body.places[:, 0].mean()) + ahead, 0.0, 0.0])
        below = SimpleNamespace(tree=SimpleNamespace(point=lambda *spot: place))
        return term.lower - np.array(term.expression(below)).ravel()

    over = np.array([height(x) for x in np.linspace(first, last, 6)])
    assert over.min() > top and over.max() < 2 * (top + limits.body_clearance_m + body.shank_m)
    down = np.array([height(last + x) for x in np.linspace(0.0, 0.5, 50)])
    assert (np.diff(down, axis=0) < 1e-4).all() and down[-1].max() < 1e-3
    if beside > 0.1:
        assert max(height(first - beside).max(), height(last + beside).max()) < 2e-3  # a sole can stand there


def test_starts_are_lower_over_feet_apart_alone(bhr):
    schedule = Schedule(Body(bhr), Contacts.hurdle(bhr, 0.2), Limits(), Weights())
    assert motions.along(schedule, JumpTask(0.0, 0.2)).missed < motions.REACHED
    stood = motions.along(Schedule(Body(bhr), Contacts.of("LR", bhr), Limits(), Weights()), JumpTask(0.0, 0.2))
    np.testing.assert_allclose(stood.charts[0][:, 2], Body(bhr).stance[2], atol=1e-9)
    jump = Schedule(Body(bhr), jump_contacts(Limits(), Mesh()), Limits(), Weights())
    straight, turned = (motions.along(jump, JumpTask(0.0, 0.2, yaw_rad=yaw)).charts[-1] for yaw in (0.0, np.pi / 2))
    np.testing.assert_allclose(turned[:, 2], straight[:, 2], atol=1e-9)


# refused ------------------------------------------------------------------------------------------
WRITE = "write L and R for flat feet, l and r for toes, left before right, or '-' for flight"
WAIT = "a schedule must begin at rest on flat feet, where the robot can wait; begin with 'LR'"
ALONE = "the schedule begins on one foot without a place for the"
AFTER = "a foot lands only after it has left the ground"
STEP = "the ground can have only one step up or down: "
STEP += "give all places after it the same up_m, and all before it none"
CAME = "feet come down 2 times (left in phase '4 LR', right in phase '4 LR')"


def long(low: float, high: float) -> tuple[ContactPhase, ...]:
    return (ContactPhase("LR", (low, high), 0.5),)


BOTH = "phase '1 LR': time_s must be (low, high) and guess_s a number, both in seconds"
TIME = "phase '1 LR': its time of {} s must be positive, and in order"
WHOLE = "phase '1 LR': intervals = {} must be a whole number of 2 or more"
HIGH = "phase '3 LR': the left foot comes down 0.2 m high, in places at the heights {} m; "
REFUSED = [
    (lambda: Contacts(()), "a contact schedule needs at least one phase"),
    (lambda: Contacts(("LR",)), "an entry of phases must be a ContactPhase, got 'LR'"),
    (lambda: schedule("LR RL"), f"phase '2 RL': feet = 'RL'; {WRITE}"),
    (lambda: schedule("LR both"), f"phase '2 both': feet = 'both'; {WRITE}"),
    (lambda: Contacts((ContactPhase(3, (0.2, 0.5), 0.3),)), f"phase '1 3': feet = 3; {WRITE}"),
    (lambda: Contacts((ContactPhase("LR", (0.2,), 0.3),)), BOTH),
    (lambda: Contacts((ContactPhase("LR", (0.2, 0.5), float("nan")),)), BOTH),
    (lambda: Contacts.hop(Robot.load(), foot="both"), "foot = 'both': choose left or right"),
    (lambda: Contacts(long(0.5, 0.3)), TIME.format("0.5 to 0.3")),
    (lambda: Contacts(long(0.0, 0.3)), TIME.format("0 to 0.3")),
    (lambda: Contacts(long(0.1, np.inf)), TIME.format("0.1 to inf")),
    (lambda: Contacts(phases("LR", intervals=1)), WHOLE.format(1)),
    (lambda: Contacts(phases("LR", intervals=2.5)), WHOLE.format(2.5)),
    (lambda: schedule("LR L L LR", 1),
     "phase '3 L': the same feet are on the ground as in the phase before; make one phase of them"),
    (lambda: schedule("lr - LR", 2), f"phase '1 lr': {WAIT}"),
    (lambda: schedule("Lr - LR", 2), f"phase '1 Lr': {WAIT}"),
    (lambda: schedule("- LR", 2), f"phase '1 -': {WAIT}"),
    (lambda: Contacts(phases("LR L", name="go")), "two phases are called 'go'; names must be unique in a schedule"),
    (lambda: schedule("LR -", ends="flight"), "ends = 'flight': choose 'rest' or 'touchdown'"),
    (lambda: schedule("LR -"), "phase '2 -': a schedule that ends with 'rest' has to end on the ground"),
    (lambda: schedule("LR - LR", 2, ends="touchdown"),
     "phase '3 LR': a schedule that ends with 'touchdown' has to end in flight"),
    (lambda: schedule("L LR", 1), f"phase '1 L': {ALONE} right one; begin with 'LR'"),
    (lambda: schedule("R - R", 1), f"phase '1 R': {ALONE} left one; begin with 'LR'"),
    (lambda: schedule("LR lr - LR", 1), f"places: 1 given, but {CAME}; {AFTER}"),
    (lambda: schedule("LR lr LR", 2), f"places: 2 given, but feet come down 0 times (none); {AFTER}"),
    (lambda: stairs("LR - LR", 0.2, 0.3), HIGH.format("0.2, 0.3") + STEP),
    (lambda: stairs("LR - LR - LR", 0.2, 0.2, 0.0, 0.0), HIGH.format("0.2, 0.2, 0, 0") + STEP),
]  # fmt: skip


@pytest.mark.parametrize(("make", "sentence"), REFUSED)
def test_refused(make, sentence):
    assert refused(make) == sentence


def test_a_flight_onto_lower_ground_lasts_as_long_as_its_fall(bhr):
    """With the speed at take-off of a level flight; its longest time is longer as well, other flights stay."""
    level = Contacts.hop(bhr).phases[3]
    speed = bhr.gravity * level.guess_s / 2
    for schedule in (Contacts.step_off(bhr, 0.3), Contacts.drop_jump(bhr, 0.3)):
        down = schedule.phases[3]
        fallen = speed * down.guess_s - bhr.gravity * down.guess_s**2 / 2
        assert fallen == pytest.approx(-0.3)
        assert down.time_s[0] == level.time_s[0]
        assert down.time_s[1] - level.time_s[1] == pytest.approx(down.guess_s - level.guess_s)
    again = Contacts.drop_jump(bhr, 0.3).phases[6]
    assert (again.time_s, again.guess_s) == (level.time_s, level.guess_s)


def test_a_block_lies_ahead_on_level_ground(bhr):
    over = Contacts.hurdle(bhr, 0.2)
    assert letters(over) == LEAP
    first, last, top = over.over
    step, sole = STEP_SHARE * leg_length(bhr), bhr.foot.toe - bhr.foot.heel
    _, down, on = over.places
    assert top == 0.2 and step < first < last < down.ahead_m - sole
    assert on.ahead_m - down.ahead_m == pytest.approx(RUN_ON_STEPS * step)  # it does not stop over one foot
    assert over.phases[-2].time_s[1] < 0.5 * Contacts.leap(bhr).phases[-2].time_s[1]
    for wrong in ((0.5, 0.4, 0.2), (0.4, 0.5), (0.4, np.nan, 0.2), (0.4, 0.5, np.inf), (0.4, 0.5, -0.1)):
        assert "over" in refused(replace, over, over=wrong)
    assert "give (from, to, top) of a block" in refused(Contacts.hurdle, bhr, -0.2)
    under = replace(over, over=(last, last + 0.5, top))
    with pytest.raises(InputError, match=r"foot would come down from .*, on the block from .*; make its ahead_m"):
        surface_of_schedule(Body(bhr), Limits(), under, JumpTask(0.0, 0.2))
    with pytest.raises(InputError, match=r"the left foot would come down from -0.* to 0\.00 m, on the block"):
        surface_of_schedule(Body(bhr), Limits(), replace(over, over=(-0.1, last, top)), JumpTask(0.0, 0.2))
    lower = tuple(replace(place, up_m=-0.1) for place in over.places[1:])
    assert "a block lies on level ground" in refused(replace, over, places=(*over.places[:1], *lower))
