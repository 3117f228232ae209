"""Plans that allow for other robots: sampled robots against the whole model, and the margins that move."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from fixtures_core import jump, planner
from fixtures_robots import needs_published
from paper.margins import ranges_at

import jumplab as jl
from jumplab.errors import InputError
from jumplab.models.spatial import SpatialModel
from jumplab.ocp.problem import Point
from jumplab.sim import Perturbation, Ranges, Scene, simulate_jump
from jumplab.stages.changes import settled
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Limits
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.instant import Instant
from jumplab.studies import robust

TASK = jl.JumpTask(1.0, 0.5)


@pytest.fixture(scope="module")
def plans(bhr):
    return jump(1.0, 0.5, method="direct"), jl.plan(TASK, bhr, robust=Ranges())


@pytest.fixture(scope="module")
def sideways(bhr):
    task = jl.JumpTask(0.2, 0.3, side_m=0.2)
    return planner().plan(task), jl.plan(task, bhr, robust=Ranges())


def ends_of(plan, model):
    """Capture point (2,) of another robot in a finished plan, as the term has it, in numbers."""
    schedule, found = plan.whole_body.schedule, {}
    for k, (name, x) in enumerate(plan.whole_body.solution.phases.items()):
        nodes = {key: ca.SX(ca.DM(getattr(x, key)[-1])) for key in "qvaz"}
        more = {"c": SimpleNamespace(**x.constants), "p": SimpleNamespace(gravity=9.8)}
        view = partial(Instant, schedule.modes[k])
        end = Point(**nodes, **more, j=None, duration=ca.SX(x.duration), s=ca.SX(1), ref=None, view=view)
        found[name] = SimpleNamespace(end=end)
    return np.array(ca.evalf(robust.capture_point(model, Body(plan.robot), found))).ravel()


def test_a_robot_as_planned_has_the_capture_point_of_the_tape(bhr, plans, sideways):
    """From the 1 kHz tape: CoM, its speed and L there, by Pinocchio."""
    import pinocchio as pin

    for plan in (*plans, *sideways):
        tape, data = plan.tape, bhr.model.createData()
        pin.ccrba(bhr.model, data, tape.q[-1], tape.v[-1])
        pin.framesForwardKinematics(bhr.model, data, tape.q[-1])
        sole = np.mean([data.oMf[bhr.model.getFrameId(f)].act(bhr.foot.center) for f in bhr.foot.frames], axis=0)
        (x, y, z), (vx, vy, vz) = data.com[0] - sole, data.hg.linear / bhr.total_mass
        spin = data.hg.angular / bhr.total_mass
        speed = (spin[1] + z * vx - (x + robust.BRAKE_S * vx) * vz) / z
        sideways = (-spin[0] + z * vy - (y + robust.BRAKE_S * vy) * vz) / z
        expected = [x + speed * np.sqrt(z / 9.8), y + sideways * np.sqrt(z / 9.8)]
        assert ends_of(plan, SpatialModel(bhr.model)) == pytest.approx(expected, abs=1e-3)


def test_samples_and_their_opposites_are_the_planned_robot_on_average(bhr):
    models = robust.sampled(bhr, Ranges())
    assert len(models) == 2 * robust.SAMPLES
    mean = np.mean([[body.mass for body in m.bodies] for m in models], axis=0)
    assert mean == pytest.approx([body.mass for body in SpatialModel(bhr.model).bodies], rel=1e-3)
    heavy = robust.sampled(bhr, Ranges.none(payload_kg=(2.0, 2.0)))
    assert [m.mass - bhr.total_mass for m in heavy] == pytest.approx([2.0] * len(heavy))
    (alone,) = robust.sampled(bhr, Ranges.none(friction=(0.4, 0.4)))
    assert alone.mass == pytest.approx(bhr.total_mass)


def test_a_robust_plan_brings_sampled_robots_to_rest_nearer_to_the_middle(bhr, plans, sideways):
    """Ahead along x, to the side along both axes."""
    for pair, axes in ((plans, [0]), (sideways, [0, 1])):
        spread = [[ends_of(plan, model)[axes] for model in robust.sampled(bhr, Ranges())] for plan in pair]
        plain, found = (np.sqrt(np.mean(np.square(x))) for x in spread)
        assert found < 0.8 * plain
        assert jl.audit(pair[1]).passed
    effort = [
        np.abs(plan.tape.tau).max(axis=0) / [bhr.actuators[n]["effort"] for n in bhr.joint_names] for plan in plans
    ]
    assert effort[1].max() <= 1.15 * effort[0].max()


@pytest.mark.slow
@needs_published
def test_a_robot_of_many_joints_has_robust_plans(monkeypatch):
    monkeypatch.setattr(robust, "SAMPLES", 2)  # trees of many joints take long to differentiate
    task, g1 = jl.JumpTask(0.2, 0.15), jl.Robot.load("g1_arms")
    plans = jl.plan(task, g1), jl.plan(task, g1, robust=Ranges())
    spread = [[ends_of(plan, model) for model in robust.sampled(g1, Ranges())] for plan in plans]
    plain, found = (np.sqrt(np.mean(np.square(x))) for x in spread)
    assert found < 0.9 * plain
    assert jl.audit(plans[1]).passed


def test_limits_that_robots_lose_are_not_planned_with(bhr):
    ranges = Ranges.none(friction=(0.4, 0.4), torque_loss=(0.0, 0.1), speed_loss=(0.0, 0.05))
    made = Planner(bhr, **robust.robust_changes(TASK, bhr, ranges, {"limits": {"body_clearance_m": 0.06}}))
    assert made.limits.friction == pytest.approx(0.36) and made.limits.torque_share == pytest.approx(0.765)
    assert made.limits.speed_share == pytest.approx(0.855) and made.limits.body_clearance_m == 0.06
    own = robust.robust_changes(TASK, bhr, ranges, {"limits": {"torque_share": 0.8}})
    assert Planner(bhr, **own).limits.torque_share == 0.8


def test_a_flip_allows_for_other_robots_by_a_slow_opening(bhr):
    """Its own rows say where the soles belong; what was asked for besides stays, and own limits win."""
    flip, given = replace(TASK, rotation_rad=-2 * np.pi), {"limits": {"body_clearance_m": 0.06}, "off": ["jerk"]}
    found = robust.robust_changes(flip, bhr, Ranges(), given)
    assert found["off"] == ["jerk"] and "terms" not in found
    assert found["limits"]["opening_speed_share"] == robust.OPENING_SHARE < Limits().of_flip().opening_speed_share
    assert found["limits"]["torque_share"] == pytest.approx(0.85 * 0.95 / 1.05)  # motors and masses differ by 5 %
    assert settled(Limits, found["limits"], flip=True) == replace(
        Limits().of_flip(),
        friction=0.38,
        body_clearance_m=0.06,
        opening_speed_share=robust.OPENING_SHARE,
        opening_torque_share=robust.OPENING_TORQUE_SHARE,
        touchdown_ankle_stroke=robust.ANKLE_STROKE_RAD,
        torque_share=found["limits"]["torque_share"],
    )
    own = robust.robust_changes(flip, bhr, Ranges(), {"limits": {"opening_speed_share": 0.5}})
    assert own["limits"]["opening_speed_share"] == 0.5
    jump = robust.robust_changes(TASK, bhr, Ranges(), {})
    assert jump["limits"]["opening_speed_share"] == Limits().opening_speed_share
    assert jump["limits"]["torque_share"] == Limits().torque_share


@pytest.mark.parametrize(
    "task, ranges, words",
    [
        (TASK, "wide", "robust must be a Ranges"),
        (TASK, Ranges.none(delay_s=(0.0, 0.004)), "robust: none of these ranges changes a plan; it allows for mass"),
    ],
)
def test_what_no_plan_can_allow_for_is_refused(bhr, task, ranges, words):
    with pytest.raises(InputError, match=words):
        jl.plan(task, bhr, robust=ranges)


def test_own_limits_win_even_those_that_are_the_usual_ones(bhr):
    weak = Ranges.none(torque_loss=(0.0, 0.1))
    found = [
        robust.robust_changes(TASK, bhr, weak, {"limits": own})["limits"]["torque_share"]
        for own in ({}, {"torque_share": 0.85}, Limits(), replace(Limits(), torque_share=0.7))
    ]
    assert found == pytest.approx([0.765, 0.85, 0.765, 0.7])
    flip = jl.JumpTask(0.0, 0.5, rotation_rad=-2 * np.pi)
    own = {"friction": 0.45, "opening_speed_share": 1.0}
    assert own.items() <= robust.robust_changes(flip, bhr, Ranges(), {"limits": own})["limits"].items()


NO_CHANGES = (
    ({"off": "jerk"}, "off must be a list of names, got 'jerk'"),
    ({"terms": {"whole body": 3}}, "own terms of 'whole body' must be a list"),
)


@pytest.mark.parametrize("changes, words", NO_CHANGES)
def test_what_is_no_change_is_refused(bhr, changes, words):
    with pytest.raises(InputError, match=words):
        robust.robust_changes(TASK, bhr, Ranges(), changes)


@pytest.mark.slow
def test_a_robot_that_falls_with_the_plain_plan_stands_with_the_robust_one(bhr, plans):
    from jumplab.studies.trials import TrialKey

    drawn = Perturbation.draw(bhr, TrialKey(0, 2, "", "").robot_seed, ranges_at("com_m", 0.75))
    plain, found = (simulate_jump(plan.tape, bhr, perturbation=drawn, scene=Scene.flat()) for plan in plans)
    assert not plain.landed and found.landed and found.checks_passed
