"""Roles found by motion, and legs that are no legs."""

import random
import tomllib
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from fixtures_robots import VARIANTS, joint, link, one_axis_ankle, refused, root, torso

from jumplab.errors import RobotError
from jumplab.robot_import.checkup import check
from jumplab.robot_import.feet import find_sole
from jumplab.robot_import.roles import draft, find_roles
from jumplab.robot_import.urdf import Tree, parse, read_urdf, repaired

LEGS = {
    "hip_pitch": ("left_hip_pitch", "right_hip_pitch"),
    "knee": ("left_knee", "right_knee"),
    "ankle_pitch": ("left_ankle_pitch", "right_ankle_pitch"),
}


def tree(robot: ET.Element) -> Tree:
    return Tree(robot, "my.urdf")


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: v.__name__)
def test_roles_of_every_variant(variant):
    roles = find_roles(tree(ET.fromstring(variant()[0])))
    assert {k: v for k, v in roles.joints.items() if k != "shoulder_pitch"} == LEGS
    last = "ankle_link" if variant is one_axis_ankle else "foot"  # the foot is then fixed to it
    assert roles.feet == (f"left_{last}", f"right_{last}")
    assert roles.trunk == ("pelvis" if variant is torso else "trunk")
    assert (roles.forward, roles.up) == ("+x", "+z")


def test_names_do_not_matter():
    robot = root()
    for i, element in enumerate(robot.findall("joint")):
        element.set("name", f"j{i}")
    roles = find_roles(tree(robot))
    assert roles.joints["knee"] == tuple(
        j.get("name") for j in robot.findall("joint") if j.find("child").get("link") in ("left_shank", "right_shank")
    )


def test_a_robot_that_looks_the_other_way():
    """Knees that bend about -y make -x the front, and the right side the left."""
    robot = root()
    for side in ("left", "right"):
        for name in ("hip_pitch", "knee", "ankle_pitch"):
            j = joint(robot, f"{side}_{name}")
            j.find("axis").set("xyz", "0 -1 0")
    roles = find_roles(tree(robot))
    assert roles.forward == "-x" and roles.joints["knee"] == ("right_knee", "left_knee")
    assert any("backwards" in note for note in roles.notes)  # the toes still point along +x


def test_canted_shoulders_are_held_and_said():
    robot = root()
    for side, sign in (("left", 1), ("right", -1)):
        joint(robot, f"{side}_shoulder_pitch").find("axis").set("xyz", f"0 0.9613 {sign * 0.2756}")
    roles = find_roles(tree(robot))
    assert roles.joints["shoulder_pitch"] == ()
    assert roles.notes[0].startswith("the arms are held: the first joint, 'right_shoulder_pitch', turns 16.0 deg off")


def test_antennas_are_no_arms():
    robot = root()
    for side in ("left", "right"):
        link(robot, f"{side}_arm").find("inertial/mass").set("value", "0.3")
    roles = find_roles(tree(robot))
    assert roles.joints["shoulder_pitch"] == ()
    assert roles.notes[0] == (
        "the arms are held: what the joint 'right_shoulder_pitch' swings weighs 0.8% of the robot"
    )
    assert find_roles(tree(root())).joints["shoulder_pitch"] == ("left_shoulder_pitch", "right_shoulder_pitch")


def test_fingers_are_no_feet():
    """The hand of a robot without legs has three joints about the pitch axis below each shoulder."""
    robot = root()
    for side in ("left", "right"):
        for name in ("ankle_link", "foot"):
            inertial = link(robot, f"{side}_{name}").find("inertial")
            inertial.find("mass").set("value", "0.004")
            for key in ("ixx", "iyy", "izz"):
                inertial.find("inertia").set(key, "1e-6")
    assert "no pair of mirrored legs" in refused(lambda: find_roles(tree(robot)))


def with_knees(change) -> ET.Element:
    """The default robot with both knees changed."""
    robot = root()
    for side in ("left", "right"):
        change(joint(robot, f"{side}_knee"))
    return robot


def with_knee(kind: str) -> ET.Element:
    return with_knees(lambda j: j.set("type", kind))


def weak(j: ET.Element) -> None:
    j.find("limit").set("effort", "0")


def stiff(j: ET.Element) -> None:
    j.set("type", "fixed"), j.remove(j.find("axis"))


def coupled(j: ET.Element) -> None:
    ET.SubElement(j, "mimic", joint=j.get("name").replace("knee", "hip_pitch"))


def drafted(robot: ET.Element, folder):
    """(path, draft) of a robot written into a folder."""
    path = folder / "my.urdf"
    path.write_bytes(ET.tostring(robot))
    return path, draft(path)


def one_leg() -> ET.Element:
    robot, drop = root(), ["right_hip_yaw"]
    for name in drop:
        j = joint(robot, name)
        child = j.find("child").get("link")
        robot.remove(j), robot.remove(link(robot, child))
        drop += [x.get("name") for x in robot.findall("joint") if x.find("parent").get("link") == child]
    return robot


def led_by_nobody(name: str) -> ET.Element:
    """The default robot with both joints of a leg led by joints that it lacks."""
    robot = root()
    for side in ("left", "right"):
        ET.SubElement(joint(robot, f"{side}_{name}"), "mimic", joint="motor")
    return robot


NOBODY = "mimics 'motor', which does not exist; correct the name"
PLACE = "but has the place of a knee, which must be revolute with a range and a motor of its own"
SENTENCES = [
    (with_knee("fixed"), f"my.urdf: joint 'right_knee' is of type 'fixed', {PLACE}"),
    (with_knees(weak), f"my.urdf: joint 'right_knee' has effort = 0 N m, {PLACE}"),
    (with_knee("prismatic"), f"my.urdf: joint 'right_knee' is of type 'prismatic', {PLACE}"),
    (with_knees(coupled), f"my.urdf: joint 'right_knee' mimics 'right_hip_pitch', {PLACE}"),
    (led_by_nobody("knee"), f"my.urdf: joint 'right_knee' {NOBODY}"),
    (led_by_nobody("hip_yaw"), f"my.urdf: joint 'left_hip_yaw' {NOBODY}"),
    (one_leg(), "my.urdf: one leg only: the chain that ends with joint 'left_ankle_roll' has no mirror image among 9 "
                "links; a jumper needs two legs"),
    (with_knees(stiff), "my.urdf: no pair of mirrored legs with three revolute pitch joints (hip, knee, ankle) was "
                        "found; the most on one chain about +-y are 2 ('left_hip_pitch', 'left_ankle_pitch')"),
]  # fmt: skip


SENTENCE_IDS = ["fixed", "torque", "prismatic", "mimic", "nobody's knee", "nobody's yaw", "one", "none"]


@pytest.mark.parametrize(("robot", "sentence"), SENTENCES, ids=SENTENCE_IDS)
def test_legs_that_are_no_legs(robot, sentence):
    assert refused(lambda: find_roles(tree(robot))) == sentence


def test_sole_from_boxes_spheres_or_nothing():
    robot = root()
    box = find_sole(tree(robot), "left_foot", np.eye(3), 0.7)
    assert (*box.x, *box.y, box.z) == pytest.approx((-0.1, 0.14, -0.05, 0.05, -0.075)) and box.source == "from its box"
    foot = link(robot, "left_foot")
    for shape in (*foot.findall("collision"), *foot.findall("visual")):
        foot.remove(shape)
    guess = find_sole(tree(robot), "left_foot", np.eye(3), 0.7)
    assert guess.source.startswith("GUESSED") and guess.z == pytest.approx(-0.075, abs=1e-3)
    for x in (-0.05, 0.12):
        for y in (-0.03, 0.03):
            shape = ET.SubElement(foot, "collision")
            ET.SubElement(shape, "origin", xyz=f"{x} {y} -0.06")
            ET.SubElement(ET.SubElement(shape, "geometry"), "sphere", radius="0.005")
    ball = find_sole(tree(robot), "left_foot", np.eye(3), 0.7)
    assert (*ball.x, *ball.y, ball.z) == pytest.approx((-0.05, 0.12, -0.03, 0.03, -0.065))


def test_joints_without_stops_get_a_range_that_is_told(tmp_path):
    """Knees that turn for ever bend backwards, as a person's; a fast ankle roll is counted as slower."""
    robot = with_knee("continuous")
    for side in ("left", "right"):
        [joint(robot, f"{side}_knee").find("limit").attrib.pop(key) for key in ("lower", "upper")]
    joint(robot, "right_knee").find("axis").set("xyz", "0 -1 0")
    joint(robot, "left_ankle_roll").find("limit").set("velocity", "100")
    path, found = drafted(robot, tmp_path)
    assert found.roles.assumed == {
        "left_knee": {"lower": 0.0, "upper": 2.3},
        "right_knee": {"lower": -2.3, "upper": 0.0},
        "left_ankle_roll": {"velocity": 60.0},
    }
    assert set(found.roles.notes) == {
        "joint 'left_knee': lower = 0, upper = 2.3 assumed, the URDF has no usable ones; correct [limits.left_knee]",
        "joint 'right_knee': lower = -2.3, upper = 0 assumed, the URDF has no usable ones; correct [limits.right_knee]",
        "joint 'left_ankle_roll': velocity = 60 assumed, the URDF has no usable ones; correct [limits.left_ankle_roll]",
    }
    assert found.faults == () and check(path, found.text).robot.sagittal.upper[1] == 2.3


def test_hips_that_are_coupled_are_held(tmp_path):
    """A right hip yaw that follows the left one is held, and so is the left one."""
    robot = root()
    ET.SubElement(joint(robot, "right_hip_yaw"), "mimic", joint="left_hip_yaw")
    path, found = drafted(robot, tmp_path)
    assert found.roles.notes == ("joint 'right_hip_yaw' follows 'left_hip_yaw': held",)
    moving = set(check(path, found.text).robot.joint_names)
    assert not moving & {"left_hip_yaw", "right_hip_yaw"} and {"left_hip_roll", "right_hip_roll"} <= moving


def test_a_finger_that_follows_nobody_is_held(tmp_path):
    """Hands are held anyway: the name that is missing is said, and the robot is read."""
    robot = root()
    finger = ET.SubElement(robot, "link", name="finger")
    inertial = ET.SubElement(finger, "inertial")
    ET.SubElement(inertial, "mass", value="0.01")
    ET.SubElement(inertial, "inertia", ixx="1e-6", ixy="0", ixz="0", iyy="1e-6", iyz="0", izz="1e-6")
    bend = ET.SubElement(robot, "joint", name="finger_bend", type="revolute")
    for end, name in (("parent", "left_arm"), ("child", "finger")):
        ET.SubElement(bend, end, link=name)
    ET.SubElement(bend, "origin", xyz="0 0 -0.4")
    ET.SubElement(bend, "limit", lower="0", upper="1", effort="1", velocity="1")
    ET.SubElement(bend, "mimic", joint="index_q1", offset="0.5")
    path, found = drafted(robot, tmp_path)
    assert found.roles.notes == ("joint 'finger_bend' follows 'index_q1', which does not exist: held",)
    result = check(path, found.text)
    assert result.lumped.held == {"finger_bend": 0.5} and "finger_bend" not in result.robot.joint_names


def test_a_foot_beside_its_pitch_axis_origin_keeps_its_width(tmp_path):
    """The origin of a link may lie anywhere on its joint's axis: H1's lies at the edge of the foot."""
    robot = ET.fromstring(one_axis_ankle()[0])
    for side, sign in (("left", 1), ("right", -1)):
        pitch = joint(robot, f"{side}_ankle_pitch").find("origin")
        x, y, z = map(float, pitch.get("xyz").split())
        pitch.set("xyz", f"{x} {y - 0.04 * sign} {z}")
        for origin in link(robot, f"{side}_foot").iter("origin"):
            x, y, z = map(float, origin.get("xyz").split())
            origin.set("xyz", f"{x} {y + 0.04 * sign} {z}")
    path, found = drafted(robot, tmp_path)
    assert check(path, found.text).robot.foot.half_width == pytest.approx(0.05)


def test_a_robot_of_mujoco_is_the_same_robot():
    """Masses and centre of mass as MuJoCo has them, in a posture."""
    path = Path(__file__).parent / "mini.xml"
    found = Tree(parse(read_urdf(path), path.name), path.name)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[7:] = angles = np.linspace(-0.5, 0.8, model.nq - 7)
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    mujoco.mj_forward(model, data)
    ours = found.model
    q = pin.neutral(ours)
    for i, x in enumerate(angles):
        q[ours.idx_qs[ours.getJointId(model.joint(i + 1).name)]] = x
    com = pin.centerOfMass(ours, ours.createData(), q)
    assert found.mass == pytest.approx(30.8) and com == pytest.approx(data.subtree_com[0], abs=1e-9)
    roles = find_roles(found)
    assert {k: roles.joints[k] for k in LEGS} == LEGS
    assert draft(path).faults[0] == (
        "mini.xml: joint 'left_hip_pitch': MJCF has no speed limits; give velocity in [limits.left_hip_pitch] of the "
        "configuration"
    )


def test_what_mujoco_cannot_read(tmp_path):
    (tmp_path / "a.xml").write_text("<mujoco><worldbody><body name='a'><joint/></body></worldbody></mujoco>")
    assert refused(lambda: read_urdf(tmp_path / "a.xml")).startswith("a.xml: MuJoCo cannot read this MJCF file: ")


def test_starter_is_a_configuration_that_stands_inside_the_ranges(tmp_path):
    """Forearms that only bend forward, the other way round on the right side."""
    robot = root()
    for side, sign in (("left", 1), ("right", -1)):
        j = joint(robot, f"{side}_shoulder_pitch")
        j.find("axis").set("xyz", f"0 {sign} 0")
        j.find("limit").attrib.update(lower=str(min(-2.3 * sign, 0.0)), upper=str(max(-2.3 * sign, 0.0)))
    (tmp_path / "a \\ b.urdf").write_bytes(ET.tostring(robot))
    made = draft(tmp_path / "a \\ b.urdf", ("inertia",))
    found = tomllib.loads(made.text)
    assert found["joints"]["knee"] == list(made.roles.joints["knee"]) and found["source"]["repair"] == ["inertia"]
    stance = found["stance"]
    assert stance["shoulder_rad"] == pytest.approx(-0.15) and stance["knee_rad"] == pytest.approx(0.5)


def test_repaired_inertia_is_that_of_a_solid():
    for moments in ([1.0, 1.0, 10.0], [0.0, 0.0, 0.0], [-1.0, 2.0, 2.0]):
        values = np.linalg.eigvalsh(repaired(np.diag(moments)))
        assert values[0] > 0 and values[2] <= values[0] + values[1]
    good = np.diag([1.0, 1.1, 1.2])
    np.testing.assert_allclose(repaired(good), good)


def test_damaged_files_never_end_in_a_traceback(tmp_path):
    """Random damage to a good URDF: a robot or a sentence, nothing else."""
    rng, values = (
        random.Random(8),
        ("", "nan", "-1", "0", "1e9", "abc", "1 2 3", "0 0 0", "fixed", "continuous", "trunk"),
    )
    path, outcomes = tmp_path / "my.urdf", set()
    for _ in range(25):
        robot = root()
        for _ in range(rng.choice((1, 1, 2))):
            parent, child = rng.choice([(a, b) for a in robot.iter() for b in a])
            if rng.random() < 0.3 or not child.attrib:
                parent.remove(child)
            else:
                child.set(rng.choice(sorted(child.attrib)), rng.choice(values))
        path.write_text(ET.tostring(robot, encoding="unicode"))
        try:
            outcomes.add(check(path, draft(path).text).robot.name)
        except RobotError as e:
            assert "\n" not in str(e) and len(str(e)) < 500
            outcomes.add("refused")
    assert "refused" in outcomes and len(outcomes) > 1
