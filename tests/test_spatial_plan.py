"""Jumps in three dimensions: planned, on tape exact, audited, played back, re-planned, refused."""

import json
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

import jumplab as jl
from jumplab.auditing import audit
from jumplab.auditing.replay import replay
from jumplab.cli.main import main
from jumplab.errors import InfeasibleError, InputError
from jumplab.ocp.problem import Point
from jumplab.sim.kinematics import Gauge, headed, pitch_of, planned_pitch, rotation
from jumplab.sim.scene import Scene
from jumplab.stages.planner import Planner
from jumplab.stages.spatial import SpatialLimits, SpatialWeights, shapes
from jumplab.stages.spatial.start import spread
from jumplab.stages.spatial.terms import SpatialTerms
from jumplab.stages.spatial.view import SpatialView
from jumplab.stages.whole_body.settings import Contact
from jumplab.task import JumpTask

SIDE = JumpTask(0.0, 0.4, side_m=0.3)
TURN = JumpTask(0.2, 0.4, side_m=-0.1, yaw_rad=np.pi / 3)


@cache
def planner() -> Planner:
    return Planner(jl.Robot.load())


@cache
def jump(task: JumpTask):
    return planner().plan(task, "direct")


@cache
def run(task: JumpTask, mode: str, engine: str):
    return jl.simulate(jump(task), mode=mode, engine=engine)


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_tape_is_exact_physics_between_the_nodes(task):
    plan = jump(task)
    r = replay(plan.tape, plan.robot, task)
    assert np.abs(r.base_residual).max() < 1e-6 * r.weight  # all six rows, at every millisecond
    assert np.abs(r.momentum[r.flight] - r.momentum[r.flight][0]).max() < 1e-6  # all three components
    toes = r.toe_corners[r.launch]
    assert np.abs(toes - toes[0]).max() < 1e-6
    assert np.abs(r.tau - plan.tape.tau).max() < 1e-6


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_audit_is_clean_and_the_goal_is_reached(task):
    plan = jump(task)
    report = audit(plan.tape, plan.robot, task)
    assert report.passed, report.table()
    assert "left/right posture" not in [c.name for c in report.checks]
    assert report["place"].value < 2 and report["heading"].value < 2
    found = plan.planned_distance_m, plan.planned_side_m, plan.planned_yaw_rad, plan.planned_rise_m
    assert found == pytest.approx((task.distance_m, task.side_m, task.yaw_rad, task.height_m), abs=2e-3)


def test_audit_sees_another_goal():
    plan = jump(TURN)
    other = replace(TURN, side_m=-0.12, yaw_rad=TURN.yaw_rad + 0.01)
    failed = {c.name: c.value for c in audit(plan.tape, plan.robot, other).failed}
    assert failed == {"place": pytest.approx(20, abs=2), "heading": pytest.approx(10, abs=1)}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["bullet", "mujoco"])
@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_playback_lands_in_its_place_and_heading(task, engine):
    result = run(task, "pd", engine)
    m = result.metrics
    assert result.landed and result.checks_passed, result.reason
    assert np.hypot(m.foot_distance_m - task.distance_m, m.side_m - task.side_m) < 0.02
    assert abs(m.yaw_rad - task.yaw_rad) < np.radians(3)
    assert abs(m.com_rise_m - task.height_m) < 0.02


def test_mirrored_target_has_the_mirrored_plan_of_its_feet():
    left, right = jump(SIDE), jump(replace(SIDE, side_m=-0.3))
    assert right.whole_body.solution.statistics.objective == pytest.approx(
        left.whole_body.solution.statistics.objective, rel=0.02
    )
    assert right.planned_side_m == pytest.approx(-left.planned_side_m, abs=2e-3)


def test_neighbour_is_planned_from_the_plan():
    before = jump(SIDE)
    after = planner().replan(before, replace(SIDE, side_m=0.31))
    first, again = (p.whole_body.solution.statistics.iterations for p in (before, after))
    assert again < first / 2
    assert [row.stage for row in after.statistics] == ["spatial"]
    assert audit(after.tape, after.robot, after.task).passed


def test_own_weights_and_terms_reach_it(bhr):
    def still(p):
        return ca.vertcat(p.joint_rates.left_shoulder_pitch, p.joint_rates.right_shoulder_pitch)

    arms = jl.Term("still arms", "ours", "rad/s", "node", still, weight=1.0)
    mine = Planner(bhr, terms={"spatial/launch": [arms], "spatial/flight": [arms]})
    plan = mine.plan(SIDE, "direct", weights={"spatial/flight/torque": 0.01})
    assert plan.weights["whole body"]["flight/torque"] == 0.01
    assert plan.weights["whole body"]["flight/still arms"] == 1.0
    rows = [6 + bhr.joint_names.index(f"{side}_shoulder_pitch") for side in ("left", "right")]
    swings = [np.abs(p.tape.v[:, rows]).max() for p in (jump(SIDE), plan)]
    assert swings[1] < swings[0] / 2


def test_points_know_the_robot_by_name(bhr):
    b = SpatialTerms(bhr, SpatialLimits(), SpatialWeights(), Contact.FLIGHT)
    names = {"q": b.coordinates, "v": b.coordinates, "a": b.coordinates, "z": b.states}
    known = {key: ca.SX.sym(key, len(x)) for key, x in names.items()}
    constants = SimpleNamespace(**{f"{k}_{x}": ca.SX.sym(k + x) for k in ("com", "vel", "L") for x in "xyz"})
    time, more = ca.SX.sym("t"), SimpleNamespace(gravity=9.8)
    p = Point(**known, j=None, duration=time, s=1.0, c=constants, p=more, ref=None, view=partial(SpatialView, b))
    assert ca.is_equal(p.joints.left_knee, known["q"][3 + b.joint_names.index("left_knee")])
    assert p.com.shape == p.com_velocity.shape == p.L.shape == p.attitude.shape == p.origin("left_knee").shape == (3, 1)
    assert len(vars(p.torques)) == b.model.joints and all(x.is_zero() for x in p.feet_forces)
    with pytest.raises(InputError) as e:
        p.origin("elbow")
    assert str(e.value).startswith("the robot has no joint 'elbow'; it has left_hip_yaw, left_hip_roll")


def test_names_that_do_not_exist_are_refused():
    with pytest.raises(InputError, match="the problem 'spatial' has no such term"):
        planner().plan(SIDE, "direct", weights={"spatial/flight/torq": 0.01})


def test_start_and_platform_that_cannot_be_are_refused():
    with pytest.raises(InputError) as e:
        planner().plan(SIDE, "direct", start=np.zeros(5))
    assert str(e.value) == "a jump to the side or with a turn begins in the stance; leave its start away"
    with pytest.raises(InfeasibleError) as e:
        planner().plan(replace(SIDE, platform_m=0.2), "direct")
    said = (
        "platform = 0.2 m at a distance of 0 m: the two surfaces would meet under a sole of bhr; that takes a distance "
    )
    assert str(e.value) == said + "of at least 0.29 m"


def test_targets_out_of_the_plane_are_checked():
    assert JumpTask(0.5, 0.4).in_plane and not SIDE.in_plane and not TURN.in_plane
    for wrong, sentence in (
        ({"side_m": 4}, "side = 4 m is outside -3 ... 3 m"),
        ({"yaw_rad": 7}, "yaw = 7 rad is outside -6.28319 ... 6.28319 rad"),
        ({"yaw_rad": "left"}, "yaw must be a number in rad, got 'left'"),
    ):
        with pytest.raises(InputError) as e:
            JumpTask(0.5, 0.4, **wrong)
        assert str(e.value) == sentence


@pytest.mark.slow
def test_command_line_plans_and_simulates_a_turn(tmp_path, capsys):
    out = str(tmp_path / "turn")
    asked = ("--distance-m", "0.2", "--height-m", "0.4", "--side-m", "-0.1", "--yaw-deg", "60", "--method", "direct")
    assert main(["plan", *asked, "--out", out]) == 0
    assert "planned: distance 0.200 m, rise 0.400 m, side -0.100 m, turn 60.0 deg" in capsys.readouterr().out
    assert main(["simulate", out]) == 0
    told = json.loads((tmp_path / "turn" / "simulation.json").read_text())
    assert told["side_m"] == pytest.approx(-0.1, abs=0.02) and told["yaw_rad"] == pytest.approx(np.pi / 3, abs=0.06)
    target = json.loads((tmp_path / "turn" / "summary.json").read_text())["target"]
    assert JumpTask(**target) == TURN


# what it is made of -----------------------------------------------------------------------------------------------
def test_wrenches_are_spread_over_the_corners(bhr):
    b = SpatialTerms(bhr, SpatialLimits(), SpatialWeights(), Contact.FLAT)
    data = b.model.model.createData()
    pin.framesForwardKinematics(b.model.model, data, b.model.to_pinocchio(*(x[None] for x in (b.stance,) * 3))[0][0])
    f = np.zeros((1, 2, 6))
    f[:, :, 2] = b.mg / 2
    for i, name in enumerate(bhr.foot.frames):  # the middle of each sole carries half of the weight
        arm = b.places[i] - data.oMf[b.model.model.getFrameId(name)].translation
        f[0, i, 3:] = np.cross(arm, f[0, i, :3])
    found = spread(b, b.stance[None], f)[0]
    assert found.min() >= 0 and found.sum() == pytest.approx(b.mg, rel=1e-3)


def test_pairs_that_can_meet_are_found_and_kept_apart(bhr):
    b = SpatialTerms(bhr, SpatialLimits(), SpatialWeights(), Contact.FLIGHT)
    names = {frozenset((p.first.name, p.second.name)) for p in b.pairs}
    assert frozenset(("trunk_1", "left_thigh_0")) in names  # pelvis and thigh meet within the joints' ranges
    assert frozenset(("left_foot_0", "right_foot_0")) in names
    assert frozenset(("left_thigh_0", "left_shank_0")) not in names  # neighbours
    boxes, _ = shapes.boxes(bhr, b.model)
    assert len(boxes) == len({box.name for box in boxes})


def test_headed_turns_the_robot_about_the_vertical(bhr):
    rng, gauge = np.random.default_rng(0), Gauge(bhr)
    q = pin.randomConfiguration(bhr.model, -np.ones(bhr.model.nq), np.ones(bhr.model.nq))
    q[7:] = rng.uniform(-0.2, 0.2, len(q) - 7)
    seen, turn = headed(q, 0.7), pin.rpy.rpyToMatrix(0.0, 0.0, -0.7)
    assert headed(q, 0.0) is q
    assert rotation(seen[3:7]) == pytest.approx(turn @ rotation(q[3:7]), abs=1e-12)
    assert gauge.com(seen) == pytest.approx(turn @ gauge.com(q), abs=1e-12)
    assert np.array_equal(headed(np.stack([q, q]), 0.7)[1], seen)


def test_pitch_is_told_in_the_own_heading():
    yaw, pitch = np.linspace(0, 3, 200), np.linspace(0, -2 * np.pi, 200)
    q = np.zeros((200, 7))
    for row, (y, p) in enumerate(zip(yaw, pitch, strict=True)):
        q[row, 3:] = pin.Quaternion(pin.rpy.rpyToMatrix(0, 0, y) @ pin.rpy.rpyToMatrix(0, p, 0)).coeffs()
    assert planned_pitch(q) == pytest.approx(pitch, abs=1e-9)
    assert pitch_of(q[50]) == pytest.approx(pitch[50])


def test_ground_is_seen_along_the_heading(bhr):
    scene, q = Scene.platform(0.5, 0.2), np.array(jump(SIDE).tape.q[-1])
    assert scene.seen_along(0.0, bhr, q) is scene
    assert scene.seen_along(1.0, bhr, q).top_at(3.0) == 0.0
    q[0] += 1.0
    assert scene.seen_along(1.0, bhr, q).top_at(-3.0) == 0.2
