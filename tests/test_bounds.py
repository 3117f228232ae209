"""Bounds for every motion: they hold for point masses at their best, for postures and for plans at hand."""

import contextlib
import dataclasses
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump, planner
from fixtures_robots import needs_published
from paper import records
from scipy.optimize import linprog

import jumplab as jl
from jumplab.errors import InfeasibleError, InputError, JumplabError
from jumplab.robot.contact import on_feet
from jumplab.stages.whole_body import Limits, WholeBodyPlanner
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.bounds import most, reach_and_start
from jumplab.studies import advice
from jumplab.task import RANGES

STEPS = 60  # of a push


@pytest.fixture(scope="module")
def body():
    return Body(jl.Robot.load())


def farthest(reach, start, task, friction, push_s, takeoff, landing):
    """The way of the soles by the best forces on the CoM that keep to friction, between these heights [m]."""
    h, g = push_s / STEPS, task.gravity
    until = h * (STEPS - np.arange(STEPS) - 0.5)  # v at the end is the sum of h a, x that of h until a
    speed = np.full(STEPS, h)
    flight_s = (task.takeoff_speed + np.sqrt(task.takeoff_speed**2 + 2 * g * (takeoff - landing))) / g
    none = np.zeros(STEPS)
    # unknowns are forces over the mass, along x and up
    same = np.array([np.append(none, speed), np.append(none, h * until)])
    up = task.takeoff_speed + g * push_s, takeoff - start[2] + g * push_s**2 / 2
    eye = np.eye(STEPS)
    rows = [np.hstack([sign * eye, -friction * eye]) for sign in (1, -1)] + [np.append(h * until, none)]
    lean = np.sqrt(reach**2 - takeoff**2) - start[0]
    least = np.append(np.zeros(2 * STEPS), lean)
    ends = [(None, None)] * STEPS + [(0, None)] * STEPS
    best = linprog(-np.append(h * until + flight_s * speed, none), np.vstack(rows), least, same, up, ends)
    return start[0] - best.fun + np.sqrt(reach**2 - landing**2) if best.success else -np.inf


def test_no_forces_within_friction_carry_a_point_farther_than_the_bound(body):
    """A linear program over all pushes finds nearly as much as the bound, never more."""
    limits = Limits()
    reach, start = reach_and_start(body)
    for rise in (0.05, 0.4):
        task = jl.JumpTask(1.0, rise)
        heights = np.array([0.4, 0.6, 0.75]) * reach
        push_s = limits.flat_s[1] + limits.toe_s[1]
        ways = [
            farthest(reach, start, task, limits.friction, push_s, takeoff, landing)
            for takeoff in heights
            for landing in heights / 3
        ]
        bound = most(body, limits, task, "distance_m")
        assert 0.8 * bound < max(ways) <= bound


def test_no_posture_reaches_farther_than_its_links(body):
    reach, start = reach_and_start(body)
    tree = body.robot.model
    data = tree.createData()
    draw = np.random.default_rng(46)
    low, high = tree.lowerPositionLimit[7:], tree.upperPositionLimit[7:]
    for _ in range(200):
        q = np.concatenate([draw.normal(size=3), [0, 0, 0, 1], draw.uniform(low, high)])
        for i, k, sign in body.model.pairs:  # both legs alike, so the toes are side by side
            q[7 + k] = sign * q[7 + i]
        com = pin.centerOfMass(tree, data, q)
        tips = [data.oMi[x.joint].act(x.placement.translation) for x in on_feet(body.robot, body.robot.foot.tip)]
        assert np.linalg.norm(com - np.mean(tips, axis=0)) <= reach + 1e-9
    assert np.linalg.norm(start) < reach


@pytest.mark.parametrize("target", [(1.0, 0.5), (0.6, 0.3)])
def test_no_plan_of_the_default_robot_beats_a_bound(body, target):
    plan = jump(*target, method="direct")
    assert plan.planned_rise_m <= most(body, Limits(), plan.task, "height_m")
    assert plan.planned_distance_m <= most(body, Limits(), plan.task, "distance_m")
    reach, _ = reach_and_start(body)
    assert plan.planned_apex_m <= reach + plan.planned_rise_m


@needs_published
@pytest.mark.parametrize(("robot", "rise"), [("g1_legs", 0.2), ("talos", 0.08)])
def test_no_plan_of_a_published_robot_beats_a_bound(robot, rise):
    plan = jl.plan(jl.JumpTask(0.3, rise), robot)
    body = Body(plan.robot)
    for what, planned in (("height_m", plan.planned_rise_m), ("distance_m", plan.planned_distance_m)):
        assert planned <= most(body, Limits(), plan.task, what)


def test_bounds_grow_with_what_they_are_made_of(body):
    task = jl.JumpTask(1.0, 0.2)
    usual = most(body, Limits(), task, "distance_m")
    assert most(body, Limits(friction=0.3), task, "distance_m") < usual
    assert most(body, Limits(flat_s=(0.25, 0.5)), task, "distance_m") < usual
    assert most(body, Limits(), jl.JumpTask(1.0, 0.4), "distance_m") > usual
    assert most(body, Limits(), jl.JumpTask(1.0, 0.2, platform_m=0.4), "distance_m") < usual
    weak = Body(body.robot.with_limits(effort=0.5))
    assert most(weak, Limits(), task, "height_m") < most(body, Limits(), task, "height_m")
    assert most(body, Limits(), task, "yaw_rad") == np.inf


@pytest.mark.parametrize(
    ("task", "number", "sentence"),
    [
        (jl.JumpTask(3.0, 0.02), "distance_m",
         r"a travel of 3 m with a rise of 0.02 m is impossible for robot bhr: .* 2.95 m"),
        (jl.JumpTask(-3.0, 0.02), "distance_m", "a travel of 3 m with a rise of 0.02 m is impossible"),
        (jl.JumpTask(0.0, 0.02, side_m=3.0), "side_m", "a travel of 3 m"),
        (jl.JumpTask(1.0, 0.05, platform_m=1.0), "platform_m", "a platform of 1 m with a rise of 0.05 m is impossible"),
    ],
)  # fmt: skip
def test_what_is_beyond_a_bound_is_refused_before_anything_is_solved(task, number, sentence, monkeypatch):
    monkeypatch.setattr(WholeBodyPlanner, "plan", None)
    with pytest.raises(InfeasibleError, match=sentence) as e:
        jl.Planner(jl.Robot.load(), limits={"flat_s": (0.25, 0.6)}).plan(task)
    assert e.value.number == number and e.value.bound < max(abs(task.distance_m), abs(task.side_m), task.platform_m)


def test_a_refusal_names_the_record_that_is_near(bhr, monkeypatch):
    other = bhr.with_limits(effort=0.99)  # nobody else keeps a record of it
    assert advice.known_record(other, "height_m") is None
    advice.keep_record(other, "height_m", 0.9)
    assert advice.known_record(other, "height_m") == 0.9
    monkeypatch.setattr(advice, "TRIES", 0)
    no = InfeasibleError("no plan")
    said = [str(advice.advised(no, jl.Planner(other), jl.JumpTask(0.0, rise))) for rise in (0.7, 0.8)]
    assert "record" not in said[0] and "the record of bhr is a height of at least 0.900 m" in said[1]


def recorded():
    """Records on file, each with its robot; those of robots that are not here are left out."""
    for row in records.rows():
        with contextlib.suppress(JumplabError):
            yield row, jl.Robot.load(row["robot"])


def test_refusals_name_the_records_on_file_of_robots_with_a_name(monkeypatch):
    """A tenth more than each record, and none of a robot that was changed."""
    assert advice.RECORDS.read_text(encoding="utf-8") == records.shipped()
    monkeypatch.setattr(advice, "TRIES", 0)
    no = InfeasibleError("no plan")
    told = 0
    for row, robot in recorded():
        if row["value"] is None or 1.1 * row["value"] > RANGES[row["what"]][2]:
            continue
        said = []
        for x in (robot, robot.with_mass(factor=1.01)):
            planner = SimpleNamespace(robot=x)
            asked = jl.JumpTask(0.0, 0.02 if row["what"] != "height_m" else 1.1 * row["value"])
            task = dataclasses.replace(asked, **{row["what"]: 1.1 * row["value"]})
            said.append(str(advice.advised(no, planner, task)))
        assert f"at least {row['value']:.3f}" in said[0] and "the record of" not in said[1], row
        told += 1
    assert told >= 2


def test_no_record_on_file_beats_a_bound():
    """Each with the rest of its target as it was planned; a distance is bounded with its rise."""
    count = 0
    for row, robot in recorded():
        what = row["what"]
        if row["value"] is None or what == "yaw_rad":
            continue
        near = records.JumpTask(0.0, row["rise_m"])
        assert row["value"] <= most(Body(robot), Limits(), near, what), row
        assert row["rise_m"] <= most(Body(robot), Limits(), near, "height_m"), row
        count += 1
    assert count >= 3


@needs_published
@pytest.mark.slow  # two plans on finer meshes
def test_the_cheapest_of_several_starts_counts_and_the_others_say_how_they_differ():
    plan = jl.plan(jl.JumpTask(0.3, 0.2), "bhr", starts=7)
    told = [x for x in plan.attempts if x.cost is not None]
    assert [x.start for x in told][:2] == ["schedule", "stance"] and len(told) == 7
    costs = [x.cost for x in told]
    assert plan.whole_body.solution.statistics.objective == min(costs) < 0.85 * max(costs)
    first, dear = told[0], told[int(np.argmax(costs))]
    assert abs(first.heels_rad - dear.heels_rad) > 0.03 and min(first.crouch_m, dear.crouch_m) > 0.1
    assert jl.audit(plan).passed


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"starts": 0}, "starts = 0 must be 1 to 10"),
        ({"starts": 11}, "starts = 11 must be 1 to 10"),
        ({"starts": 2, "method": "three-step"}, "compares several starts, and only in jumps from a stand without"),
        ({"starts": "many"}, "starts must be a whole number"),
    ],
)
def test_starts_that_make_no_sense_are_refused(options, sentence):
    with pytest.raises(InputError, match=sentence):
        planner().plan(jl.JumpTask(0.5, 0.2), **options)
