"""Robots that no plane describes: canted hips, legs of five joints, uneven sides; from posture to landing."""

from itertools import pairwise, product

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import refused
from fixtures_robots import canted, config, joint, one_axis_ankle, pitch_first, root, text, write
from scipy.optimize import linprog

import jumplab as jl
from jumplab.errors import InfeasibleError, RobotError
from jumplab.robot import Robot
from jumplab.robot.files import read_toml
from jumplab.robot.reduction import mirror
from jumplab.robot.stance import holding, knees, stance_configuration
from jumplab.robot_import.checks import read_tree
from jumplab.robot_import.jumper import make_jumper
from jumplab.robot_import.roles import draft
from jumplab.sim import simulate_jump
from jumplab.stages.whole_body import Contacts, Limits, Mesh, Place, Weights, WholeBodyPlanner
from jumplab.stages.whole_body import motions as beginning
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import jump_contacts
from jumplab.stages.whole_body.problem import Schedule
from jumplab.studies.chain import Course, run_chain

CANT_RAD = 0.44  # 25 degrees


def wide(angle_rad: float) -> tuple[str, str]:
    """Canted hips whose roll joints have room to turn inward."""
    robot = canted(angle_rad)[0]
    return robot.replace('lower="-0.06"', 'lower="-0.4"').replace('upper="0.06"', 'upper="0.4"'), config("wide")


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Robot:
    return Robot.load(write(tmp_path_factory.mktemp("wide"), wide, CANT_RAD))


def five() -> tuple[str, str]:
    """Legs of five joints, and arms that swing without a role."""
    urdf, toml = one_axis_ankle()
    pair = '["left_shoulder_pitch", "right_shoulder_pitch"]'
    return urdf.replace('name="one_axis_ankle"', 'name="five"'), toml.replace("one_axis_ankle", "five").replace(
        f"shoulder_pitch = {pair}", f"shoulder_pitch = []\nfree = {pair}"
    )


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> Robot:
    return Robot.load(write(tmp_path_factory.mktemp("five"), five))


def soles(robot: Robot, q: np.ndarray) -> list[pin.SE3]:
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, q)
    return [data.oMf[model.getFrameId(n)] * pin.SE3(np.eye(3), robot.foot.center) for n in robot.foot.frames]


@pytest.mark.parametrize("name", ["robot", "short"])
def test_it_stands_on_flat_feet_below_its_centre(name, request):
    robot = request.getfixturevalue(name)
    assert not robot.planar
    q = stance_configuration(robot)
    for sole in soles(robot, q):
        assert abs(sole.translation[[0, 2]]).max() < 1e-5
        np.testing.assert_allclose(sole.rotation, np.eye(3), atol=1e-5)
    com = pin.centerOfMass(robot.model, robot.model.createData(), q)
    assert abs(com[0]) < 1e-5
    bends = [sign * q[7 + k] + angle for k, sign, angle in knees(robot)]
    assert np.mean(bends) == pytest.approx(robot.stance["knee_rad"], abs=1e-5)


def test_joints_that_mirror_each_other_are_found(robot):
    pairs = [(robot.joint_names[i], robot.joint_names[k], s) for i, k, s in mirror(robot.model)]
    names = {"hip_yaw": -1, "hip_roll": -1, "hip_pitch": 1, "knee": 1, "ankle_pitch": 1, "ankle_roll": -1}
    assert set(pairs) == {(f"left_{n}", f"right_{n}", s) for n, s in (names | {"shoulder_pitch": 1}).items()}


def test_a_knee_may_be_bent_where_its_angle_is_zero(robot):
    robot = Robot.from_text(robot.urdf, robot.config_text)
    turned = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])
    for side in ("left", "right"):
        j = robot._model.getJointId(f"{side}_knee")
        robot._model.jointPlacements[j].rotation = turned
    assert [angle for _, _, angle in knees(robot)] == pytest.approx([0.3, 0.3], abs=1e-9)


def schedule_of(robot: Robot, contacts: Contacts | None = None) -> Schedule:
    limits = Limits()
    contacts = contacts or jump_contacts(limits, Mesh())
    return Schedule(Body(robot), contacts, limits, Weights())


def seen(schedule: Schedule, motion: beginning.Motion) -> list[np.ndarray]:
    """Configurations of each phase."""
    return [schedule.body.model.to_pinocchio(x, 0 * x, 0 * x)[0] for x in motion.charts]


@pytest.mark.parametrize("name", ["robot", "short"])
def test_a_solve_begins_with_feet_that_stay_and_land_where_they_should(name, request):
    robot = request.getfixturevalue(name)
    task, schedule = jl.JumpTask(distance_m=0.4, height_m=0.2), schedule_of(robot)
    motion = beginning.along(schedule, task)
    flat, toe, air = seen(schedule, motion)
    first, last = ([s.translation for s in soles(robot, q)] for q in (flat[0], air[-1]))
    way = np.mean(last, axis=0) - np.mean(first, axis=0)
    np.testing.assert_allclose(way, [0.4, 0.0, 0.0], atol=0.02)
    tip = np.array([(robot.foot.toe - robot.foot.heel) / 2, 0.0, 0.0])
    launch = np.array([[s.act(tip) for s in soles(robot, q)] for q in (*flat, *toe)])
    off = np.abs(launch - launch[0]).max()
    # canted hips turn in less far; others are moved until they are near enough for a start
    assert off < (0.08 if name == "robot" else 1e-3)
    assert (motion.missed > 1e-3) == (off > 1e-3) and motion.missed < beginning.REACHED
    com = [pin.centerOfMass(robot.model, robot.model.createData(), q)[2] for q in air]
    assert max(com) - com[0] == pytest.approx(0.2, abs=0.05)
    np.testing.assert_array_equal(motion.charts[0][0], schedule.body.stance)


def test_a_start_in_the_stance_is_carried_along(short):
    task, schedule = jl.JumpTask(distance_m=0.4, height_m=0.2), schedule_of(short)
    motion, still = (make(schedule, task) for make in (beginning.along, beginning.still))
    for mine, known in zip(still.charts, motion.charts, strict=True):
        np.testing.assert_array_equal(mine[:, [0, 1, 3]], known[:, [0, 1, 3]])
        same, stance = (np.delete(x, [0, 1, 3], axis=-1) for x in (mine, schedule.body.stance))
        np.testing.assert_array_equal(same, np.tile(stance, (len(mine), 1)))


def test_start_values_of_a_motion_share_nodes_and_carry_the_robot(short):
    task, schedule = jl.JumpTask(distance_m=0.4, height_m=0.2), schedule_of(short)
    motion = beginning.along(schedule, task)
    found = beginning.guess(schedule, task, motion)
    assert list(found) == [p.name for p in schedule.contacts.phases]
    nv, parts = schedule.modes[0].nv, list(found.values())
    for one, other in pairwise(parts):
        for k in "qva":
            left, right = getattr(one, k)[-1, :nv], getattr(other, k)[0, :nv]
            # both postures of a shared node are near enough for a start, found from another side each
            np.testing.assert_allclose(right, left, atol=1e-3 if k == "q" else 1e-9)
    for k, (part, duration) in enumerate(zip(parts, motion.durations, strict=True)):
        b = schedule.modes[k]
        assert part.duration == duration and part.z.shape == (len(part.q), len(b.states))
        push, torques = np.split(part.z, [b.n_forces], axis=1)
        assert push.sum(axis=1) == pytest.approx(0.0 if b.flying else b.body.mg) and not torques.any()
    heels = parts[1].q[:, nv:]
    assert heels[0] == pytest.approx(0.0, abs=1e-6) and np.all(np.diff(heels, axis=0) > 0)
    model, q = short.model, seen(schedule, motion)[1][-1]
    com = pin.centerOfMass(model, model.createData(), q)
    assert [parts[2].constants[f"com_{x}"] for x in "xyz"] == pytest.approx(com, abs=1e-9)


def test_legs_keep_off_the_angle_that_locks_them(tmp_path):
    """Between axes of yaw and roll the hip's pitch locks a leg at 90 degrees: what its foot can do goes with its
    cosine. Other joints, and hips that roll before they pitch, lock nothing within their stops.
    """
    robot = Robot.load(write(tmp_path, pitch_first))
    body = Body(robot)
    names, stance = list(body.joint_names), body.stance[6:]
    low, high = body.unlocked
    k = names.index("left_hip_pitch")
    least = np.arccos(0.1 * np.cos(stance[k]))
    assert low[k] == pytest.approx(-least, abs=0.021) and -np.pi / 2 < low[k] == low[names.index("right_hip_pitch")]
    others = [i for i, name in enumerate(names) if "hip_pitch" not in name]
    assert np.isinf(low[others]).all() and np.isinf(high).all() and np.isinf(Body(Robot.load("bhr")).unlocked).all()
    plan = jl.plan(jl.JumpTask(0.0, 0.3, side_m=0.15), robot)
    bent = plan.tape.q[:, 7 + k].min()
    assert plan.audit.passed and abs(bent - low[k]) < 0.03  # it crouches as far as it may


def test_short_legs_do_not_stand_on_one_foot(short):
    contacts = Contacts.of("LR L LR", short, [Place(0.1)])
    said = "robot five: a leg has fewer than six joints, so it cannot be planned to stand on one foot"
    assert refused(WholeBodyPlanner, short, contacts=contacts) == said


def test_coordinates_that_follow_are_those_of_legs_and_base(robot, short):
    """On both feet the legs; short ones leave the base no side, yaw, roll. In flight the base."""
    for one, legs in ((robot, 6), (short, 5)):
        schedule = schedule_of(one)
        names = [set(p.coordinates) - set(p.integrated) for p in schedule.problem().phases]
        base = {"y", "yaw", "roll"} if legs == 5 else set()
        feet = {n for n in one.joint_names if "shoulder" not in n}
        assert len(feet) == 2 * legs and names[0] == names[1] == feet | base
        assert names[2] == {"x", "y", "z", "yaw", "roll", "pitch"}


def test_what_moves_besides_and_how_it_rests_is_told():
    toml = config("x", shoulders="[]").replace(
        "[feet]", 'free = ["left_shoulder_pitch", "right_shoulder_pitch"]\n[feet]'
    )
    rest = "[rest]\nleft_shoulder_pitch = -0.3\nright_shoulder_pitch = -0.3\n"
    robot, _ = make_jumper(read_tree(text(root()), "my.urdf"), read_toml(toml + rest, "config"))
    assert len(robot.joint_names) == 14 and not robot.planar and dict(robot.rest)["left_shoulder_pitch"] == -0.3
    assert stance_configuration(robot)[[13, 20]] == pytest.approx([-0.3, -0.3])
    with pytest.raises(
        RobotError, match=r"^robot configuration: \[rest\] names the joint 'neck', which does not move; correct"
    ):
        make_jumper(read_tree(text(root()), "my.urdf"), read_toml(toml + "[rest]\nneck = 0.1\n", "config"))


@pytest.mark.parametrize("cant_rad", [0.1, 0.44, 0.79])
def test_legs_with_any_hip_are_found(tmp_path, cant_rad):
    path = tmp_path / "any.urdf"
    path.write_text(canted(cant_rad)[0])
    roles = draft(path).roles
    assert roles.joints["hip_pitch"] == ("left_hip_pitch", "right_hip_pitch")
    assert roles.joints["knee"] == ("left_knee", "right_knee") and roles.forward == "+x"


def test_feet_tell_where_a_robot_faces_whose_knees_turn_both_ways(tmp_path):
    robot = root()
    for side in ("left", "right"):
        limit = joint(robot, f"{side}_knee").find("limit")
        limit.set("lower", "-2.4"), limit.set("upper", "2.4")
    path = tmp_path / "both.urdf"
    path.write_text(text(robot))
    assert draft(path).roles.forward == "+x"


def test_what_needs_five_links_is_refused(robot):
    assert refused(run_chain, Course.of([0.3, 0.3], 0.3), robot) == (
        "robot wide: a chain needs a planar model of five links, in whose crouch the robot waits; choose a robot that "
        "has one"
    )
    said = "robot wide: start has the angles of five links, which do not describe this robot; leave out start, and the "
    said += "plan begins in the stance"
    assert refused(jl.Planner(robot).plan, jl.JumpTask(0.3, 0.2), start=np.zeros(5)) == said


def test_what_cannot_hold_its_own_weight_is_refused_before_any_solve(robot):
    """The share is the least: random ground forces that balance the robot ask for more; half the effort, twice it."""
    q = stance_configuration(robot)
    share, joint, torque = holding(robot, q, 0.42)
    assert torque == pytest.approx(share * robot.actuators[joint]["effort"]) and 0.01 < share < 0.5
    assert holding(robot.with_limits(effort=0.5), q, 0.42)[0] == pytest.approx(2 * share)
    assert holding(robot.under_gravity(1.62), q, 0.42)[0] == pytest.approx(share * 1.62 / 9.8)
    model, data, sole = robot.model, robot.model.createData(), robot.foot
    effort, frames = (
        np.array([robot.actuators[n]["effort"] for n in robot.joint_names]),
        map(model.getFrameId, sole.frames),
    )
    pin.computeJointJacobians(model, data, q), pin.updateFramePlacements(model, data)
    corners = []
    for frame, corner in product(frames, sole.corners):
        near = model.frames[frame].copy()
        near.name, near.placement = "corner", near.placement * pin.SE3(np.eye(3), corner)
        grown = model.copy()
        k = grown.addFrame(near)
        corners.append(pin.computeFrameJacobian(grown, grown.createData(), q, k, pin.LOCAL_WORLD_ALIGNED)[:3])
    pushes, weight = np.concatenate(corners).T, pin.computeGeneralizedGravity(model, data, q)
    level, rng = 0.42 / np.sqrt(2), np.random.default_rng(3)
    cone = np.kron(np.eye(8), [[1, 0, -level], [-1, 0, -level], [0, 1, -level], [0, -1, -level]])
    how = dict(A_ub=cone, b_ub=np.zeros(32), A_eq=pushes[:6], b_eq=weight[:6], bounds=[(-600, 600)] * 24)
    for _ in range(20):  # forces on the corners that balance the robot
        given = linprog(rng.normal(size=24), **how)
        assert given.success and np.max(np.abs(weight[6:] - pushes[6:] @ given.x) / effort) >= share - 1e-9
    # more than 1 / 0.9: with ankles so weak it stands nearer to them, where hips bear more
    weak = robot.with_limits(effort=0.9 * share)
    with pytest.raises(
        InfeasibleError, match=r"^robot wide cannot hold the posture in which it begins: .* needs 1\.2 times its"
    ):
        jl.Planner(weak).plan(jl.JumpTask(0.3, 0.2))


@pytest.mark.slow
def test_planned_clean_and_landed(robot):
    task, target = jl.JumpTask(0.5, 0.3), (0.5, 0.3)
    plan = jl.plan(task, robot)
    assert {row.stage.split(",")[0] for row in plan.statistics} == {"direct"}
    assert len(plan.statistics) == len(plan.whole_body.attempts)
    assert plan.planned_side_m == pytest.approx(0, abs=1e-3)
    assert jl.audit(plan).passed
    run = simulate_jump(plan.tape, robot, mode="pd")
    assert run.landed and run.metrics.foot_distance_m == pytest.approx(target[0], abs=0.02)
    near = jl.Planner(robot)
    again = near.replan(near.plan(task), jl.JumpTask(target[0] + 0.03, target[1]))
    assert jl.audit(again).passed and again.planned_distance_m == pytest.approx(target[0] + 0.03, abs=2e-3)
