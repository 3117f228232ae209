"""Jumps in three dimensions: planned, on tape exact, audited, played back, re-planned, refused."""

import json
from dataclasses import asdict, replace
from functools import cache, partial
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

import jumplab as jl
from jumplab.auditing import audit
from jumplab.auditing.replay import replay
from jumplab.auditing.report import LIMITS, METHOD
from jumplab.cli.common import misses
from jumplab.cli.main import main
from jumplab.errors import InfeasibleError, InputError, SolverError
from jumplab.ocp.problem import Point
from jumplab.robot.stance import configuration, stance_angles
from jumplab.sim import STEP_S, Disturbance
from jumplab.sim.kinematics import Gauge, headed, pitch_of, planned_pitch, rotation
from jumplab.sim.playback import Actuators, Playback
from jumplab.sim.scene import Scene
from jumplab.sim.servo import Servo
from jumplab.stages.planner import Planner
from jumplab.stages.spatial import SpatialLimits, SpatialWeights, shapes
from jumplab.stages.spatial.start import spread
from jumplab.stages.spatial.tape import ACCELERATION_GAP, FRICTION, LOADED_N, RATE_GAP, holds_between
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


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_soles_come_down_steeply_enough_to_stick(task):
    plan = jump(task)
    gauge, data = Gauge(plan.robot), plan.robot.model.createData()
    pin.forwardKinematics(plan.robot.model, data, plan.tape.q[-1], plan.tape.v[-1])
    used = []
    for frame in gauge.frames:
        arm = pin.updateFramePlacement(plan.robot.model, data, frame).rotation @ plan.robot.foot.center
        twist = pin.getFrameVelocity(plan.robot.model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        speed = twist.linear + np.cross(twist.angular, arm)
        used.append(np.abs(speed[:2]).max() / -speed[2])
    assert 0.2 < max(used) < SpatialLimits().touchdown_slope + 1e-3  # and it matters to these targets


def test_audit_sees_another_goal():
    plan = jump(TURN)
    other = replace(TURN, side_m=-0.12, yaw_rad=TURN.yaw_rad + 0.01)
    failed = {c.name: c.value for c in audit(plan.tape, plan.robot, other).failed}
    assert failed == {"place": pytest.approx(20, abs=2), "heading": pytest.approx(10, abs=1)}


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["position", "pd"])
@pytest.mark.parametrize("engine", ["bullet", "mujoco"])
@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_playback_lands_in_its_place_and_heading(task, engine, mode):
    result = run(task, mode, engine)
    m = result.metrics
    assert result.landed and result.checks_passed, result.reason
    assert np.hypot(m.foot_distance_m - task.distance_m, m.side_m - task.side_m) < 0.02
    assert abs(m.yaw_rad - task.yaw_rad) < np.radians(3)
    assert abs(m.com_rise_m - task.height_m) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["bullet", "mujoco"])
@pytest.mark.parametrize("task, tipped_rad", [(SIDE, 0.1), (SIDE, -0.1), (TURN, 0.1), (TURN, -0.1)])
def test_lands_on_one_foot_before_the_other(task, tipped_rad, engine):
    """Tipped sideways in flight, one sole meets the ground 2 cm before the other; the robot stands all the same."""
    result = jl.simulate(jump(task), engine=engine, disturbance=Disturbance(1.0, tipped_rad, direction_rad=np.pi / 2))
    loaded = (result.foot_wrench[:, :, 2] > 30.0) & (result.phase == "landing")[:, None]
    left, right = (result.t[np.argmax(foot)] for foot in loaded.T)
    assert 0.004 < (right - left) * np.sign(tipped_rad) < 0.03, (left, right)
    assert result.landed and result.checks_passed, result.reason


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


def test_a_plan_that_passes_limits_between_the_nodes_is_settled_and_then_solved_again_on_a_finer_mesh(monkeypatch):
    last, verdicts = planner().stage("spatial"), iter([False, True, False, False, True, False, False, False])
    coarse = jump(SIDE).whole_body
    first = last.plan(SIDE, near=coarse).solution
    monkeypatch.setattr("jumplab.stages.spatial.planner.holds_between", lambda tape, robot: next(verdicts))
    settled, finer, kept = (last.plan(SIDE, near=coarse).solution for _ in range(3))
    assert [len(x.j) for x in settled.phases.values()] == [12, 12, 16]
    assert settled.statistics.objective < first.statistics.objective
    assert [len(x.j) for x in finer.phases.values()] == [18, 18, 24]
    assert kept.statistics.objective == first.statistics.objective  # neither is any better: the first stands


def test_limits_between_the_nodes_are_seen(bhr):
    tape = jump(SIDE).tape
    assert holds_between(tape, bhr)
    assert [LIMITS[f"{x} against {y}"].limit for x, y in (("rates", "positions"), ("accelerations", "rates"))] == [
        RATE_GAP,
        ACCELERATION_GAP,
    ]
    assert (FRICTION, LOADED_N) == (LIMITS["friction used"].limit, METHOD.friction_force_n)
    row, effort = len(tape.t) // 3, bhr.actuators["left_ankle_pitch"]["effort"]
    for name, column, change in (("tau", bhr.joint_names.index("left_ankle_pitch"), effort), ("v", 12, 0.05)):
        moved = getattr(tape, name).copy()
        moved[row, column] += 2 * change
        assert not holds_between(replace(tape, **{name: moved}), bhr), name
    pushed = tape.f.copy()
    pushed[row, 0, 1] += FRICTION * pushed[row, 0, 2]
    assert not holds_between(replace(tape, f=pushed), bhr)


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


def test_platforms_that_would_lie_under_a_sole_are_refused():
    with pytest.raises(InfeasibleError) as e:
        planner().plan(replace(SIDE, platform_m=0.2), "direct")
    said = "platform = 0.2 m at a distance of 0.3 m: the two surfaces would meet under a sole of bhr; that takes "
    assert str(e.value) == said + "a distance of at least 0.35 m"
    planner().stage("spatial").parameters(replace(SIDE, side_m=0.35, platform_m=0.2))


def test_it_begins_in_the_posture_in_which_the_robot_waits(bhr):
    start = stance_angles(bhr, 0.6)
    plan = planner().plan(SIDE, "direct", start=start)
    assert plan.tape.q[0, 7:] == pytest.approx(configuration(bhr, start)[7:], abs=1e-3)
    assert plan.planned_side_m == pytest.approx(0.3, abs=2e-3) and np.abs(plan.tape.v[0]).max() < 1e-3


def test_a_refusal_names_a_smaller_target_that_is_planned(monkeypatch):
    last, tried, known = planner().stage("spatial"), [], jump(SIDE).whole_body

    def solved(nlp, task, begin, how):
        tried.append((task.side_m, nlp is last._quick))
        if task.side_m > 0.5:
            raise SolverError("spatial: no plan", stage="spatial", violations=("flight/capture window by 1 m",))
        return replace(known, task=task)

    monkeypatch.setattr(last, "_solved", solved)
    with pytest.raises(SolverError) as e:
        last.plan(replace(SIDE, side_m=0.9))
    assert tried == [(0.9, False), (0.9, False), (0.81, True), (0.63, True), (0.45, True)]
    said = "spatial: no plan; at this height, 0 m ahead and 0.45 m to the left with a turn of 0 deg is planned"
    assert str(e.value) == said and e.value.violations


def test_where_there_is_a_motion_it_is_looked_for_from_a_smaller_target(monkeypatch):
    last, known = planner().stage("spatial"), jump(SIDE).whole_body

    def solved(nlp, task, begin, how):
        if nlp is last.nlp:
            raise SolverError("the search did not settle")
        return replace(known, task=task)

    monkeypatch.setattr(last, "_solved", solved)
    assert last.plan(replace(SIDE, side_m=0.9)).task.side_m == 0.9


def test_the_servo_asks_for_the_planned_torques_if_it_knows_what_each_foot_carries(bhr):
    tape = jump(SIDE).tape
    servo, player = Servo(bhr, substeps=10**6), Playback(tape, bhr)
    effort, worst = Actuators(bhr).effort, {True: 0.0, False: 0.0}
    for row in range(50, tape.takeoff_index - 5, 50):
        step = round(float(tape.t[row]) / STEP_S)
        command = player.command(step, tape.q[row], tape.v[row], np.zeros(len(effort)))
        assert command.wrench is not None and command.tau is None
        for knows in worst:
            told = command if knows else replace(command, wrench=None)
            off = servo.torque(told, tape.q[row], tape.v[row]) - player._tau[step]
            worst[knows] = max(worst[knows], float(np.abs(off / effort).max()))
    assert worst[True] < 0.03 < worst[False] / 2  # on the toes their line moves a little in the plan


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


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [JumpTask(0.0, 0.4, 0.1, side_m=0.6), JumpTask(0.5, 0.45, 0.15, side_m=0.4), JumpTask(0.5, 0.4, 0.15, yaw_rad=0.5)],
)
def test_platforms_lie_along_the_travel(task):
    plan = jump(task)
    assert jl.audit(plan).passed
    result = jl.simulate(plan)
    assert result.landed and abs(result.q[-1, 2] - plan.tape.q[0, 2] - task.platform_m) < 0.02
    m = result.metrics
    assert np.hypot(m.foot_distance_m - task.distance_m, m.side_m - task.side_m) < 0.02


def test_errors_are_told_by_axis():
    values = {"foot_distance_m": [0.19, 0.22], "side_m": [-0.1, -0.07], "yaw_rad": [1.0, 1.1]}
    said = "forward -10.0 ... +20.0 mm, side +0.0 ... +30.0 mm, heading -2.7 ... +3.0 deg"
    assert misses(asdict(TURN), values.__getitem__) == said


def test_a_wrong_apex_has_a_direction(bhr):
    """Tipped to the left, faster along the way: the velocity of the CoM and its place are otherwise the same."""
    tape, gauge = jump(TURN).tape, Gauge(bhr)
    _, q, v = Disturbance().apex(tape, bhr)
    _, tipped, faster = Disturbance(1.2, 0.1, direction_rad=np.pi / 2).apex(tape, bhr)
    assert gauge.com(tipped) == pytest.approx(gauge.com(q), abs=1e-9)
    assert gauge.com_velocity(tipped, faster) == pytest.approx(gauge.com_velocity(q, v) * [1.2, 1.2, 1.0], abs=1e-9)
    axis = TURN.yaw_rad + np.pi / 2  # of the heading; turned about the axis a quarter turn to its left, it tips left
    turn = pin.log3(rotation(tipped[3:7]) @ rotation(q[3:7]).T)
    assert turn == pytest.approx(0.1 * np.array([-np.sin(axis), np.cos(axis), 0.0]), abs=1e-3)


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
    aside = replace(scene, along_rad=np.pi / 2)
    assert aside.seen_along(0.0, bhr, q).top_at(3.0) == 0.0  # its edge is 0.5 m to the left, the soles at 0.3 m
    assert aside.seen_along(0.0, bhr, headed(q, -1.5)).top_at(3.0) == 0.0
    half, centre, turn = aside.boxes()[1]
    middle = (0.5 + 20.0) / 2
    assert centre == pytest.approx([0.0, middle, 0.1], abs=1e-12) and half[0] == pytest.approx(20.0 - middle)
    assert rotation(turn) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert scene.seen_along(0.0, bhr, q) is scene
    assert scene.seen_along(1.0, bhr, q).top_at(3.0) == 0.0
    q[0] += 1.0
    assert scene.seen_along(1.0, bhr, q).top_at(-3.0) == 0.2
