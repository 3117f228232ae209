"""Descriptions that are no robot, each with the sentence that says so."""

import pytest
from fixtures_robots import refused

from jumplab.errors import RobotError
from jumplab.robot import Robot
from jumplab.robot.files import SHIPPED
from jumplab.robot.stance import stance_angles


# descriptions that are no robot ---------------------------------------------------------------------------------
def test_unknown_robot(tmp_path):
    with pytest.raises(RobotError) as e:
        Robot.load("asimo")
    known = ", ".join(SHIPPED)
    assert str(e.value) == f"robot 'asimo': neither a shipped robot ({known}) nor a readable TOML file"
    assert e.value.exit_code == 2
    for name in (str(tmp_path), "", "a\0b", "x" * 5000):
        with pytest.raises(RobotError, match=r"neither a shipped robot \(bhr, .*\) nor a readable TOML file$"):
            Robot.load(name)


def changed(robot, old, new=""):
    assert old in robot.config_text
    return Robot.from_text(robot.urdf, robot.config_text.replace(old, new, 1))


@pytest.mark.parametrize("line, entry", [
    ('name = "bhr"', "name"),
    ('knee = ["left_knee", "right_knee"]', "joints.knee"),
    ("sole_x_m = [-0.10, 0.14]", "feet.sole_x_m"),
    ("knee_rad = 0.5", "stance.knee_rad"),
    ("corner_speed_ratio = 0.5", "actuators.corner_speed_ratio"),
])  # fmt: skip
def test_missing_entries(bhr, line, entry):
    assert refused(lambda: changed(bhr, line)) == f"robot configuration: the entry {entry!r} is missing"


WRONG = [
    ('"left_knee"', '"left_elbow"', "robot bhr: role knee names the joint 'left_elbow', "
     "which the URDF lacks; correct the name"),
    ('"left_foot"', '"left_shoe"', "robot bhr: the foot link 'left_shoe' is not in the URDF; correct the name"),
    ("corner_speed_ratio = 0.5", "corner_speed_ratio = 1.0",
     "robot configuration: corner_speed_ratio = 1 must lie between 0 and 1"),
    ("corner_speed_ratio = 0.5", "corner_speed_ratio = 0.5\ncorner_speed_ratios = { left_knee = 1.5 }",
     "robot bhr: corner_speed_ratios: left_knee = 1.5 must name a joint, and lie between 0 and 1"),
    ("corner_speed_ratio = 0.5", "corner_speed_ratio = 0.5\ncorner_speed_ratios = { neck = 0.5 }",
     "robot bhr: corner_speed_ratios: neck = 0.5 must name a joint, and lie between 0 and 1"),
    ("[-0.10, 0.14]", "[0.14, -0.10]",
     "robot configuration: the sole [0.14, -0.1] x [-0.05, 0.05] m has no area; give [heel, toe] and [right, left]"),
    ("knee_rad = 0.5", "knee_rad = nan", "robot configuration: 'stance.knee_rad' = nan, must be a finite number"),
]  # fmt: skip


@pytest.mark.parametrize("old, new, sentence", WRONG)
def test_wrong_entries(bhr, old, new, sentence):
    assert refused(lambda: changed(bhr, old, new)) == sentence


def test_files_that_cannot_be_read(bhr, tmp_path):
    config = tmp_path / "robot.toml"
    config.write_text("name = ")
    assert "robot.toml: not a TOML file: " in refused(Robot.load, str(config), by=RobotError)
    config.write_text(bhr.config_text)
    missing = tmp_path / "bhr.urdf"
    assert refused(lambda: Robot.load(config)) == f"{missing}: there is no such file; give the path of a URDF"
    (tmp_path / "bhr.urdf").write_text("<robot")
    with pytest.raises(RobotError, match=r"^bhr.urdf: line 1, column 0: ends before </robot>; "):
        Robot.load(str(config))
    (tmp_path / "bhr.urdf").write_text(bhr.urdf.replace('velocity="20"', 'velocity="400"', 1))
    with pytest.raises(RobotError, match=r"^bhr\.urdf: joint '\w+': velocity = 400 rad/s is above 60: "):
        Robot.load(str(config))
    with pytest.raises(RobotError, match=r"^robot bhr: joint '\w+': the limit 'velocity' must be a number, got 'fast'"):
        Robot.from_text(bhr.urdf.replace('velocity="20"', 'velocity="fast"', 1), bhr.config_text)
    (tmp_path / "bhr.urdf").write_text(bhr.urdf)
    assert Robot.load(str(config)).hash == bhr.hash


def test_a_posture_that_cannot_stand(bhr):
    assert refused(lambda: stance_angles(changed(bhr, "[-0.10, 0.14]", "[2.0, 2.2]"))) == (
        "robot bhr: with the knee at 0.5 rad and the trunk at 0.05 rad no lean of the shank brings the CoM above the "
        "middle of the sole; change [stance] in its configuration"
    )


def test_a_role_must_turn_about_the_pitch_axis(bhr):
    with pytest.raises(RobotError, match="left_hip_roll"):
        _ = changed(bhr, '["left_knee", "right_knee"]', '["left_hip_roll", "right_hip_roll"]').sagittal
