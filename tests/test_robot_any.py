"""Robots that nobody described beforehand: lumped, reduced, planned, in three engines."""

import re

import numpy as np
import pinocchio as pin
import pytest
from fixtures_robots import (
    GOOD,
    VARIANTS,
    arm_base,
    canted,
    child,
    config,
    held_arms,
    joint,
    link,
    mirrored,
    plain,
    reduction_error,
    refused,
    root,
    text,
    waist,
    write,
)

from jumplab.auditing.audit import audit
from jumplab.errors import RobotError
from jumplab.robot import Robot
from jumplab.robot.contact import on_feet, posed
from jumplab.robot.files import read_toml
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.robot_import.checks import read_tree
from jumplab.robot_import.jumper import make_jumper
from jumplab.sim import INSTALLED, Scene, engine_class, simulate_jump
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Limits
from jumplab.task import JumpTask


def load(folder, variant, *args) -> Robot:
    return Robot.load(write(folder, variant, *args))


def made(urdf: str, toml: str) -> Robot:
    return make_jumper(read_tree(urdf, "my.urdf"), read_toml(toml, "config"))[0]


# the models -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: v.__name__)
def test_sagittal_model_is_the_full_robot(tmp_path, variant):
    robot = load(tmp_path, variant)
    assert reduction_error(robot).max() < 1e-9


def test_canted_hips_leave_the_plane(tmp_path):
    """The error of five links grows by the square of the angle, and is seen."""
    robots = [load(tmp_path, canted, angle_rad) for angle_rad in (0.01, 0.04, 0.3)]
    small, large, _ = (reduction_error(robot)[1] for robot in robots)
    assert 1e-6 < small < 1e-4 < large < 1e-3 and large == pytest.approx(16 * small, rel=0.1)
    assert [robot.planar for robot in robots[::2]] == [True, False]


def test_a_robot_whose_sides_differ_is_left_as_it_is():
    robot, lumped = make_jumper(read_tree(wider_left(), "my.urdf"), read_toml(config("x"), "config"))
    said = "left and right differ, left as they are, places"
    assert lumped.changed[said][0] == pytest.approx(50.0)
    assert not robot.planar


@pytest.mark.parametrize("variant", [mirrored, arm_base], ids=lambda v: v.__name__)
def test_other_ways_to_write_the_same_robot(tmp_path, bhr, variant):
    robot = load(tmp_path, variant)
    for name in ("mass", "inertia", "com", "upper", "effort", "speed"):
        np.testing.assert_allclose(getattr(robot.sagittal, name), getattr(bhr.sagittal, name), atol=1e-12)
    np.testing.assert_allclose(robot.sagittal.lower[1:], bhr.sagittal.lower[1:], atol=1e-12)
    assert robot.sagittal.lower[0] == pytest.approx(bhr.sagittal.lower[0], abs=0.03)  # cut to the boxes
    assert "[source]" not in robot.config_text  # it stands on its own
    np.testing.assert_allclose(stance_angles(robot), stance_angles(bhr), atol=1e-12)


def test_held_joints_move_their_links(tmp_path):
    """A waist held at -0.1 rad: the chest's CoM is where Pinocchio puts it in the URDF as it was."""
    urdf, _ = waist()
    robot, model = load(tmp_path, waist), pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    q = pin.neutral(model)
    q[model.idx_qs[model.getJointId("waist")]] = -0.1
    data = model.createData()
    pin.centerOfMass(model, data, q)
    trunk = data.oMi[model.getJointId("waist")]
    ours = robot.model.createData()
    np.testing.assert_allclose(
        pin.centerOfMass(robot.model, ours, pin.neutral(robot.model)), trunk.actInv(data.com[0]), atol=1e-12
    )
    assert "waist" not in robot.joint_names


@pytest.mark.parametrize("engine", INSTALLED)
@pytest.mark.parametrize("variant", [waist, held_arms], ids=lambda v: v.__name__)
def test_engines_agree_on_the_lumped_robot(tmp_path, variant, engine):
    robot = load(tmp_path, variant)
    with engine_class(engine)(robot, pin.neutral(robot.model)) as world:
        q, v = world.state()
        assert world.read_back()["inertia_error"] < 1e-6
    np.testing.assert_allclose(q, pin.neutral(robot.model), atol=1e-12)
    assert np.abs(v).max() == 0


def test_hips_bend_no_further_than_the_boxes_allow(tmp_path):
    fat = config("fat") + "[shapes]\ntrunk_m = [[-0.15, 0.2, 0.14, 0.05, 0.75]]\n"
    (tmp_path / "fat.toml").write_text(fat)
    (tmp_path / "fat.urdf").write_text(text(root()))
    robot = Robot.load(str(tmp_path / "fat.toml"))
    assert -1.6 < robot.sagittal.lower[0] < -0.3
    assert robot.sagittal.lower[0] > load(tmp_path, plain).sagittal.lower[0]


def test_a_stance_at_the_end_of_a_range_is_refused(tmp_path):
    (tmp_path / "s.urdf").write_text(text(root()))
    (tmp_path / "s.toml").write_text(config("s").replace("shoulder_rad = 0.0", "shoulder_rad = 1.19"))
    assert refused(lambda: Robot.load(str(tmp_path / "s.toml"))) == (
        "robot s: standing, shoulder is at 1.190 rad, less than 0.04 from the end of its range -3 ... 1.2; no plan can "
        "start there; with shoulder_rad = 0 in [stance] the robot can stand"
    )


# the chain ------------------------------------------------------------------------------------------------------
def stiff_child() -> tuple[str, str]:
    """Six tenths of the size, no ankle roll, arms held."""
    urdf = re.sub(r'(_ankle_roll" type=)"revolute"', r'\1"fixed"', child()[0])
    return urdf, config("stiff_child", 0.6, shoulders="[]")


def weak(role: str, effort: float, name: str = "weak", **values) -> tuple[str, str]:
    """Little torque in one role, on other soles."""
    robot = root()
    for side in ("left", "right"):
        joint(robot, f"{side}_{role}").find("limit").set("effort", str(effort))
    return text(robot), config(name, **values)


def long_toes() -> tuple[str, str]:
    """Ankles that would need 118 % of their torque to hold the CoM above the middle of the soles."""
    return weak("ankle_pitch", 14.0, "long_toes", heel=-0.04, toe=0.2)


def test_motors_that_cannot_hold_the_stance_are_refused_with_the_file(tmp_path):
    """Ankles are spared by where the CoM stands; knees whose effort is that of a motor before its gear are not."""
    with pytest.raises(RobotError) as refusal:
        load(tmp_path, weak, "knee", 9.0)
    assert re.fullmatch(
        r"robot weak cannot hold the posture in which it begins: however the ground's forces are shared, joint "
        r"(left|right)_knee needs \d\.\d times its effort, [\d.]+ N m of 9; if these are motors' efforts before their "
        r"gears, give those of the joints in \[limits\]",
        str(refusal.value),
    )
    load(tmp_path, weak, "ankle_pitch", 3.0)


@pytest.mark.slow
@pytest.mark.parametrize("engine", INSTALLED)
def test_weak_ankles_jump_and_stand(tmp_path, engine):
    """With a planned landing and with spring-dampers; feet come down for where the CoM will stand above them."""
    robot = load(tmp_path, long_toes)
    plan = Planner(robot).plan(JumpTask(0.2, 0.1))
    tape = plan.tape
    assert audit(tape, plan.robot, plan.task).passed
    model, data = robot.model, robot.model.createData()
    stands = pin.centerOfMass(model, data, stance_configuration(robot))[0]  # ahead of the middle of the soles
    com = pin.centerOfMass(model, data, tape.q[-1], tape.v[-1]).copy()
    feet = on_feet(robot, robot.foot.center)
    sole = np.mean([foot.place(posed(model, tape.q[-1])).translation for foot in feet], axis=0)
    lim = Limits()
    caught = (sole - com)[0] + stands - lim.capture_offset_m - lim.capture_slope_s * data.vcom[0][0]
    assert abs(caught) <= lim.capture_window_m + 1e-3 and stands < -0.04
    for landing in ("planned", "spring"):
        assert simulate_jump(tape, robot, engine=engine, landing=landing).landed, landing


@pytest.mark.slow
def test_planned_clean_and_landed(tmp_path):
    plan = Planner(load(tmp_path, stiff_child)).plan(JumpTask(0.3, 0.2))
    report = audit(plan.tape, plan.robot, plan.task)
    assert [c.name for c in report.checks if not c.passed] == []
    result = simulate_jump(plan.tape, plan.robot, scene=Scene.of_plan(plan.summary, plan.robot)).to_json()
    assert result["landed"], result["reason"]
    assert result["foot_distance_m"] == pytest.approx(0.3, abs=0.01)


@pytest.mark.slow
def test_mirrored_axes_give_the_same_plan(tmp_path):
    a, b = (Planner(load(tmp_path, v)).plan(JumpTask(0.5, 0.3), "direct") for v in (plain, mirrored))
    assert a.statistics[0].iterations == b.statistics[0].iterations
    np.testing.assert_allclose(a.tape.extra["planar_angles"], b.tape.extra["planar_angles"], atol=1e-9)
    knee = list(a.tape.joint_names).index("right_knee")
    np.testing.assert_allclose(a.tape.q[:, 7 + knee], -b.tape.q[:, 7 + knee], atol=1e-9)


# configurations that cannot be meant ----------------------------------------------------------------------------
def heavier_left() -> str:
    """By 10 g, and 2 mm ahead of the right leg."""
    robot = root()
    link(robot, "left_shank").find("inertial/mass").set("value", "3.01")
    joint(robot, "left_hip_yaw").find("origin").set("xyz", "0.002 0.1 -0.43")
    return text(robot)


def wider_left() -> str:
    robot = root()
    joint(robot, "left_hip_yaw").find("origin").set("xyz", "0.05 0.1 -0.43")
    return text(robot)


def prismatic() -> str:
    robot = root()
    joint(robot, "left_knee").set("type", "prismatic")
    return text(robot)


STONE = """<link name="stone"><inertial><mass value="2.5"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
<joint name="free" type="floating"><parent link="trunk"/><child link="stone"/></joint></robot>"""


REFUSED = [
    (GOOD.replace("</robot>", STONE), config("x"),
     "my.urdf: 2.500 kg do not hang on the trunk ('stone'); connect them to it by joints of a robot, or remove them"),
    (GOOD, config("x", trunk="pelvis"),
     "my.urdf: the configuration names the link 'pelvis', which the URDF lacks; correct the name"),
    (GOOD, config("x", forward="ahead"),
     "robot configuration: 'source.forward' = 'ahead' must be one of +x -x +y -y +z -z"),
    (GOOD, config("x", forward="+z"), "robot configuration: forward +z and up +z must be different axes"),
    (GOOD, config("x").replace("repair = []", 'repair = ["all"]'),
     "robot configuration: 'source.repair' accepts inertia, massless, got 'all'"),
    (GOOD, config("x") + "[locked]\nneck = 0.1\n",
     "my.urdf: [locked] names the joint 'neck', which the URDF lacks; correct the name"),
    (GOOD, config("x") + '[locked]\nleft_knee = "bent"\n',
     "robot configuration: 'locked.left_knee' = 'bent', must be a finite number"),
    (GOOD, config("x") + "[limits.neck]\neffort = 1.0\n",
     "my.urdf: [limits.neck] names neither a joint of the URDF nor a role"),
    (GOOD, config("x") + "[limits.knee]\ntorque = 1.0\n",
     "robot configuration: 'limits.knee' may hold lower, upper, effort, velocity, corner, no_load, armature, "
     "friction, damping, source, got {'torque': 1.0}"),
    (GOOD, config("x") + "[limits.knee]\nvelocity = 20.0\ncorner = 20.0\n",
     "my.urdf: joint 'left_knee': corner = 20 rad/s must lie between 0 and the speed limit, 20 rad/s; correct "
     "[limits.knee]"),
    (GOOD, config("x") + "[limits.knee]\neffort = -1.0\n",
     "my.urdf: joint 'left_knee': effort = -1 N m must be positive; give the peak torque, or give effort in "
     "[limits.knee] of the configuration"),
    (GOOD, config("x") + "[shapes]\ntrunk_m = [[1.0, 0.0, 0.1, 0.0, 1.0]]\n",
     "robot configuration: 'shapes.trunk_m' = [[1.0, 0.0, 0.1, 0.0, 1.0]] must be a list of [rear, front, half width, "
     "bottom, top]"),
    (GOOD, config("x") + "[shapes]\nthigh_thickness_m = 0.0\n",
     "robot configuration: 'shapes.thigh_thickness_m' = 0 must be positive"),
    (GOOD, config("x", toe=-0.05),
     "my.urdf: the sole [-0.1  -0.05] x [-0.05  0.05] m, -0.075 m from the ankle, must lie below it and reach to both "
     "sides of it: the foot stands on its heel or its toes, or [feet] is wrong; give the sole there along level axes, "
     "and level_rad, the ankles' pitch at which these are level"),
    (GOOD, config("x").replace('["left_knee", "right_knee"]', '["right_knee", "left_knee"]'),
     "my.urdf: the role joint 'right_knee' is not between 'trunk' and the foot 'left_foot'; correct [joints], [feet] "
     "links or their order left, right"),
    (GOOD, config("x").replace('"right_knee"]', '"right_hip_yaw"]'),
     "my.urdf: between 'trunk' and 'right_foot' come right_hip_yaw, right_hip_pitch, right_ankle_pitch; hip, knee and "
     "ankle must follow in this order; correct [joints]"),
    (GOOD, config("x").replace('knee = ["left_knee"', 'knee = ["left_hip_yaw"'),
     "my.urdf: between 'trunk' and 'left_foot' come left_hip_yaw, left_hip_pitch, left_ankle_pitch; hip, knee and "
     "ankle must follow in this order; correct [joints]"),
    (prismatic(), config("x"),
     "my.urdf: joint 'left_knee' has a role, but is prismatic; it must be revolute with a motor of its own"),
]  # fmt: skip


@pytest.mark.parametrize(("urdf", "toml", "sentence"), REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_meant_is_refused(urdf, toml, sentence):
    assert refused(lambda: made(urdf, toml)) == sentence


def test_small_differences_of_the_sides_are_evened_out():
    robot, lumped = make_jumper(read_tree(heavier_left(), "my.urdf"), read_toml(config("x"), "config"))
    masses = [robot.model.inertias[robot.model.getJointId(f"{side}_knee")].mass for side in ("left", "right")]
    assert masses == pytest.approx([3.005, 3.005], abs=1e-12)
    hips = [robot.model.jointPlacements[robot.model.getJointId(f"{side}_hip_yaw")] for side in ("left", "right")]
    np.testing.assert_allclose([hip.translation[:2] for hip in hips], [[0.001, 0.1], [0.001, -0.1]], atol=1e-12)
    assert robot.total_mass == pytest.approx(42.01, abs=1e-9)
    assert lumped.changed["left and right evened out, masses"][0] == pytest.approx(0.333, abs=1e-3)


def test_differences_of_a_light_body_count_little():
    """10 % of the inertia of a gram do not keep a robot of 42 kg from being even; five times a shank's do."""
    for name, key, inertia, done in (
        ("left_hip_yaw_link", "iyy", "1.1e-06", True),
        ("left_shank", "iyy", "0.038", True),
        ("left_shank", "izz", "0.012", False),
    ):
        robot = root()
        link(robot, name).find("inertial/inertia").set(key, inertia)
        _, lumped = make_jumper(read_tree(text(robot), "my.urdf"), read_toml(config("x"), "config"))
        changed = lumped.changed
        assert any("differ, left as they are" in said for said in changed) is not done, (name, changed)
