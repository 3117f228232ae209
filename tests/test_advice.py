"""Advice of refusals: the easier target has a plan, whoever refuses and whatever was asked.

JUMPLAB_REFUSALS=60 sets how many advices are followed; the everyday run makes do with a few.
"""

import os
import random
import re
from functools import cache

import pytest
from fixtures_core import refused
from fixtures_robots import needs_published

import jumplab as jl
from jumplab.errors import InfeasibleError, InputError, JumplabError, SolverError
from jumplab.ocp.nlp import left_s, patience
from jumplab.studies import advice
from jumplab.task import JumpTask

REFUSALS = int(os.environ.get("JUMPLAB_REFUSALS", "2"))
ASKED = re.compile(r"; ask for (.+), which has a plan$")


class Fake:
    """A planner that can do any jump up to half a metre far and 0.3 m high."""

    robot = jl.Robot.load()

    def __init__(self):
        self.asked = []

    def plan(self, task, method):
        self.asked.append(task)
        if abs(task.distance_m) > 0.5:
            raise SolverError("too far", stage="SRMP")
        if task.height_m > 0.3:
            raise InfeasibleError("too high")
        return task


def error_of(task, monkeypatch, planner):
    monkeypatch.setattr(advice, "refused", lambda p, t, m: SolverError("no") if m == "direct" else raised(p.plan, t, m))
    with pytest.raises(JumplabError) as e:
        advice.plan_or_advise(planner, task)
    return e.value


def test_an_easier_target_is_never_higher(monkeypatch):
    """Small robots are asked for less than the least height that is tried for others."""
    fake = Fake()
    e = error_of(JumpTask(2.0, 0.025), monkeypatch, fake)
    assert {task.height_m for task in fake.asked} == {0.025} and len(fake.asked) > 2
    assert str(e).endswith("; ask for a distance of 0.43 m, which has a plan")


def raised(call, *given):
    try:
        call(*given)
    except JumplabError as e:
        return e
    return None


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (
            JumpTask(0.0, 0.9),
            "too high; the record of bhr is a height of at least 0.960 m; ask for a height of 0.19 m, which has a plan",
        ),
        (JumpTask(0.6, 0.2), "too far; ask for a distance of 0.36 m, which has a plan"),
        (JumpTask(-0.6, 0.2), "too far; ask for a distance of -0.36 m, which has a plan"),
        (JumpTask(0.8, 0.5), "too far; ask for a distance of 0.48 m and a height of 0.3 m, which has a plan"),
    ],
)
def test_an_easier_target_that_works_is_named(monkeypatch, task, sentence):
    error = error_of(task, monkeypatch, Fake())
    assert str(error) == sentence and error.exit_code == 3


def test_what_was_known_of_the_refusal_stays_known(monkeypatch):
    error = error_of(JumpTask(0.8, 0.3), monkeypatch, Fake())
    assert (error.stage, error.exit_code) == ("SRMP", 3)


def test_where_nothing_helps_it_says_so(monkeypatch):
    planner = Fake()
    planner.plan = lambda task, method: (_ for _ in ()).throw(SolverError("no", stage="SRMP"))
    sentence = str(error_of(JumpTask(0.2, 0.3), monkeypatch, planner))
    begin = "no; none of the easier targets that were tried has a plan either: a distance of 0.12 m; a distance of "
    assert sentence.startswith(f"{begin}0.12 m and a height of 0.18 m; ") and sentence.count("; ") > 5


def test_patience_is_a_number_of_seconds(monkeypatch):
    """A search that has taken longer ends with the best that it has, and says so."""
    planner = Fake()
    planner.plan = lambda task, method: (_ for _ in ()).throw(SolverError("no"))
    monkeypatch.setattr(advice, "refused", lambda p, t, m: None)
    with pytest.raises(SolverError) as e:
        advice.plan_or_advise(planner, JumpTask(0.2, 0.3), patience_s=1e-9)
    given_up = "no; planning was given up after 1e-09 s of processor time; ask for a distance of 0.12 m "
    assert str(e.value) == f"{given_up}and a height of 0.18 m, which has a plan"  # far easier: little time is left
    for far, easier in ((0.6, "a platform of 0.07 m"), (0.2, "a distance of 0.52 m and a platform of 0.12 m")):
        high = JumpTask(far, 0.3, platform_m=0.2)
        said = refused(advice.plan_or_advise, planner, high, patience_s=1e-9, by=SolverError)
        assert said.endswith(f"; ask for {easier}, which has a plan")
    with pytest.raises(InputError, match="patience_s must be a positive number of seconds, got 0"):
        jl.plan(JumpTask(0.2, 0.3), patience_s=0)


def test_a_refusal_and_its_advice_share_the_patience(monkeypatch):
    """By default both end within 25 s of a process: the search after 20, the advice after 22 in all."""
    planner, left = Fake(), []
    planner.plan = lambda task, method: left.append(left_s()) or (_ for _ in ()).throw(SolverError("no"))
    monkeypatch.setattr("jumplab.stages.planner.Planner.plan", lambda self, *a, **k: planner.plan(*a, **k))
    for asked, most in (({}, 20.0), ({"patience_s": 5.0}, 5.0)):
        left.clear()
        with pytest.raises(SolverError, match=r"^no; none of the easier targets that were tried has a plan either"):
            jl.plan(JumpTask(0.2, 0.3), planner.robot, **asked)
        assert most - 1 < left[0] <= most
        assert len(left) > 3 and 1.1 * most - 2 < min(left[1:]) <= max(left[1:]) <= 1.1 * most


def test_a_schedule_has_more_patience_by_default(monkeypatch):
    left = []
    monkeypatch.setattr("jumplab.stages.planner.Planner.follow", lambda *a, **k: left.append(left_s()) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        jl.plan(contacts="hop=0.2")
    assert 38 < left[0] <= 40


def test_a_solve_ends_when_patience_is_spent(bhr, monkeypatch):
    monkeypatch.setattr("jumplab.stages.whole_body.program.LEAST_S", 1e-3)
    with patience(1e-9), pytest.raises(SolverError, match="CpuTime"):
        jl.Planner(bhr).plan(JumpTask(0.5, 0.3), "direct")


def follow(task, text):
    """The target and the method that an advice names."""
    changes, method = {}, "usual"
    for name, key in (
        ("distance", "distance_m"),
        ("height", "height_m"),
        ("platform", "platform_m"),
        ("side", "side_m"),
    ):
        if found := re.search(rf"a {name} of (-?[\d.]+) m", text):
            changes[key] = float(found[1])
    if "no rotation" in text:
        changes["rotation_rad"] = 0.0
    if "the method 'direct'" in text:
        method = "direct"
    return advice.replace(task, **changes), method


@cache
def planner_of(name):
    return jl.Planner(robot_of(name), keep=True)


def robot_of(name):
    """A shipped robot, or the default one with weaker motors."""
    return jl.Robot.load("bhr").with_limits(effort=0.75, speed=0.85) if name == "weak" else jl.Robot.load(name)


@pytest.mark.slow
@needs_published
def test_refusals_of_five_robots_are_followed():
    """Random targets beyond what they can do; each advice is followed by a planner that has not seen it before."""
    rng, followed, tried = random.Random(7), 0, 0
    robots = ["bhr", "alexander", "g1_legs", "talos", "weak"]
    while followed < REFUSALS and tried < 4 * REFUSALS:
        name, tried = robots[tried % len(robots)], tried + 1
        far = 3.0 if name in ("bhr", "weak") else 1.5
        task = JumpTask(round(rng.uniform(-1.0, far), 2), round(rng.uniform(0.3, 1.4), 2), rng.choice([0.0, 0.0, 0.2]))
        try:
            advice.plan_or_advise(planner_of(name), task)
        except (InfeasibleError, SolverError) as e:
            if found := ASKED.search(str(e)):
                other, method = follow(task, found[1])
                plan = jl.Planner(robot_of(name)).plan(other, method)
                assert jl.audit(plan).passed, (name, task, found[1])
                followed += 1
            else:
                assert "; none of the easier targets that were tried has a plan either: " in str(e)
    print(f"{followed} advices of {tried} targets followed")
    assert followed == REFUSALS
