"""Kinds of robot files: each is read right, or refused with its true cause. A mini humanoid of 30.8 kg, as URDF and as
MJCF, with one thing changed.
"""

import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from fixtures_robots import refused

from jumplab.io.progress import told_to
from jumplab.robot.files import files_of
from jumplab.robot_import import mjcf
from jumplab.robot_import.checkup import check, examine
from jumplab.robot_import.roles import draft
from jumplab.robot_import.urdf import Tree, parse, read_urdf
from jumplab.stages.whole_body.body import Body

HERE = Path(__file__).parent
URDF = (HERE / "mini.urdf").read_text()
MJCF = (HERE / "mini.xml").read_text()
KNEE = '<motor joint="left_knee" ctrlrange="-160 160"/>'
PELVIS = '<body name="pelvis" pos="0 0 .75"><freejoint/>'
BOX = '<collision><origin xyz="0.03 0 -0.05"/><geometry><box size="0.2 0.08 0.03"/></geometry></collision>'
SOLE = pytest.approx((-0.07, 0.13, -0.065))
SOLE_X = pytest.approx((-0.07, 0.13))
TOLD = "\n".join(f"[limits.{role}]\nvelocity = 20.0" for role in ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch"))
TOLD += "".join(
    f"\n[limits.{side}_{name}]\nvelocity = 20.0"
    for side in ("left", "right")
    for name in ("hip_roll", "hip_yaw", "ankle_roll")
)


def changed(text: str, *pairs: tuple[str, str]) -> str:
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


@pytest.fixture
def put(tmp_path):
    """Writes a file and gives its path."""

    def write(text: str | bytes, name: str = "mini.urdf") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def told(path: Path) -> "object":
    """The robot of an MJCF whose speeds are told."""
    return check(path, draft(path).text + TOLD).robot


def mass(path: Path) -> float:
    """Of a file [kg]."""
    return Tree(parse(read_urdf(path), "x"), "x").mass


def limit(path: Path, joint: str, key: str = "effort") -> float | None:
    element = next(j for j in parse(read_urdf(path), "x").findall("joint") if j.get("name") == joint)
    text = element.find("limit").get(key)
    return None if text is None else float(text)


def notes(path: Path) -> str:
    return "\n".join(draft(path).roles.notes)


# whatever it is called, and however it is written ----------------------------------------------------------------
@pytest.mark.parametrize(("name", "before"), [
    ("a.mjcf", ""), ("a.urdf", "\ufeff"), ("A.XML", "<!-- a > b <robot> -->\n<?xml version='1.0'?>"),
    ("noext", "<!DOCTYPE mujoco>"),
])  # fmt: skip
def test_mjcf_is_recognised_by_its_content(put, name, before):
    path = put(before + MJCF, name)
    assert files_of(path) == (name, path.parent, None)
    root = parse(read_urdf(path), name)
    assert root.get("name") == "mini" and limit(path, "left_knee") == 160


@pytest.mark.parametrize("encoding", ["ISO-8859-1", "GB2312", "UTF-16"])
def test_urdf_in_the_encoding_that_it_declares(put, encoding):
    head = f'<?xml version="1.0" encoding="{encoding}"?><!-- {"Füße" if encoding[0] == "I" else "机器人"} -->'
    path = put(URDF.replace('<?xml version="1.0"?>', head).encode(encoding))
    assert parse(read_urdf(path), "x").get("name") == "mini"


def test_other_encodings_are_named(put):
    path = put(URDF.replace("<robot", "<!-- Füße --><robot").encode("latin-1"))
    assert "declare its encoding in the first line" in refused(lambda: read_urdf(path))
    path = put(URDF.replace("?>", ' encoding="klingon"?>', 1))
    assert "declares the encoding 'klingon', which is unknown" in refused(lambda: read_urdf(path))
    assert "stands behind a comment" in notes(put("<!-- mine -->\n" + URDF))


def test_a_default_namespace_does_no_harm(put):
    assert draft(put(URDF.replace("<robot", '<robot xmlns="http://a.org"'))).roles.trunk == "pelvis"


# MJCF --------------------------------------------------------------------------------------------------------------
MOTORS = {
    "gear, negative": (('ctrlrange="-1.6 1.6" gear="-100"',), 160),
    "two that add": (('ctrlrange="-80 80"', 'ctrlrange="-80 80"'), 160),
    "one each way": (('ctrlrange="-160 0"', 'ctrlrange="0 160"'), 160),
    "one way only": (('ctrlrange="0 160"',), 0),
    "weaker way": (('ctrlrange="-160 160" forcerange="-60 100"',), 60),
    "beside a damper": (('ctrlrange="-160 160"/><damper kv="3" joint="left_knee" ctrlrange="0 1"',), 160),
    "beside one that is off": (('ctrlrange="-160 160"/><position kp="9" joint="left_knee" group="2"',), 160),
}


@pytest.mark.parametrize(("kinds", "effort"), MOTORS.values(), ids=MOTORS)
def test_torque_of_motors(put, kinds, effort):
    motors = "".join(f'<motor joint="left_knee" {kind}/>' for kind in kinds)
    off = ("<worldbody>", '<option actuatorgroupdisable="2"/><worldbody>')
    assert limit(put(changed(MJCF, (KNEE, motors), off), "a.xml"), "left_knee") == effort


def test_servos_tell_no_torque_but_by_their_force_range(put):
    servo = '<position joint="left_knee" kp="100" ctrlrange="-2 2" {}/>'
    path = put(changed(MJCF, (KNEE, servo.format(""))), "a.xml")
    assert limit(path, "left_knee") is None
    assert any("give effort, velocity in [limits.left_knee]" in sentence for sentence in draft(path).faults)
    path = put(changed(MJCF, (KNEE, servo.format('forcerange="-50 80"'))), "a.xml")
    assert limit(path, "left_knee") == 50
    frames = ('<joint name="left_knee"', '<joint actuatorfrcrange="-30 40" name="left_knee"')
    assert limit(put(changed(MJCF, frames), "a.xml"), "left_knee") == 30


def test_a_motor_on_a_tendon_is_not_that_of_the_joint_of_its_number(put):
    motors = "".join(f'<motor name="m{i}" tendon="t" ctrlrange="-7 7"/>' for i in range(5))
    tendon = '<tendon><fixed name="t"><joint joint="left_elbow" coef="1"/></fixed></tendon>'
    path = put(changed(MJCF, ("</actuator>", f"{motors}</actuator>{tendon}")), "a.xml")
    assert limit(path, "left_knee") == 160 and limit(path, "left_elbow") == 30
    assert "the tendons 't' of the joints 'left_elbow' are left out" in notes(path) and "act on no joint" in notes(path)


@pytest.mark.parametrize("base", ["", '<joint name="root" type="free"/>', "planar"])
def test_however_the_base_moves_it_is_free(put, base):
    slide = '<joint name="{0}" type="slide" axis="{1}"/>'
    planar = slide.format("x", "1 0 0") + slide.format("z", "0 0 1") + '<joint name="y" axis="0 1 0"/>'
    path = put(changed(MJCF, ("<freejoint/>", planar if base == "planar" else base)), "a.xml")
    assert mass(path) == pytest.approx(30.8)
    assert ("the joints 'x', 'z', 'y' join the body 'pelvis' to the world" in notes(path)) == (base == "planar")


def test_other_things_in_the_scene_are_left_out(put):
    others = '<geom type="plane" size="5 5 .1"/><body name="ball"><freejoint/><geom size=".1"/></body>'
    others += '<body name="table"><geom type="box" size=".5 .5 .4"/></body>'
    path = put(changed(MJCF, (PELVIS, others + PELVIS)), "a.xml")
    assert mass(path) == pytest.approx(30.8)
    assert "other bodies of the scene are left out: 'ball', 'table'" in notes(path)
    twin = re.search(r'<body name="pelvis".*</body>(?=</worldbody>)', MJCF, re.DOTALL)[0].replace('name="', 'name="b_')
    two = put(changed(MJCF, ("</worldbody>", f"{twin}</worldbody>")), "a.xml")
    assert "'pelvis', 'b_pelvis' of the world have 16 hinges each below them, 2 robots" in refused(lambda: draft(two))


def test_pictures_and_terrain_may_be_missing_and_are_named(put):
    asset = '<asset><texture name="t" type="2d" file="skin.png"/><material name="m" texture="t"/>'
    asset += '<hfield name="h" file="land.png" size="5 5 1 .1"/></asset><worldbody><geom type="hfield" hfield="h"/>'
    path = put(changed(MJCF, ("<worldbody>", asset), ('size=".08', 'material="m" size=".08')), "a.xml")
    assert "the pictures 'land.png', 'skin.png' are not there" in notes(path)


def test_a_mesh_that_is_not_there_costs_a_picture_but_never_mass(put):
    asset = ("<worldbody>", '<asset><mesh name="m" file="lost.stl"/></asset><worldbody>')
    inertial = '<inertial pos="0 0 .2" mass="12" diaginertia=".4 .35 .12"/>'
    shown = ("<freejoint/>", '<freejoint/><geom type="mesh" mesh="m" {}/>')
    path = put(changed(MJCF, asset, (shown[0], shown[1].format(""))), "a.xml")
    assert "the mesh 'lost.stl' of 'pelvis' is not there" in notes(path)
    for name in ("lost.stl", "lost.obj"):
        put("version https://git-lfs.github.com/spec/v1\n", name)
        pointer = put(path.read_text().replace("lost.stl", name), "b.xml")
        assert f"the mesh {name!r} of 'pelvis' is not there or cannot be read: left out" in notes(pointer)
    for weight in ('mass="8"', 'density="600"', ""):
        path = put(changed(MJCF, asset, (inertial, ""), (shown[0], shown[1].format(weight))), "a.xml")
        sentence = refused(lambda path=path: draft(path))
        assert "body 'pelvis': its mass and inertia are those of the mesh 'lost.stl'" in sentence


def test_several_hinges_in_one_body(put):
    text = MJCF
    for side, y in (("left", "0.09"), ("right", "-0.09")):
        hinges = re.findall(rf'<joint name="{side}_hip_\w+"[^>]*/>', text)
        first = rf'<body name="{side}_hip_pitch_link".*?(?=<inertial pos="0 0 -0.13" mass="2.4")'
        body = f'<body name="{side}_thigh" pos="0 {y} -0.06">{"".join(hinges)}'
        text = re.sub(first, body, text, count=1, flags=re.DOTALL)
    text = text.replace("</body></body></body></body></body></body>", "</body></body></body></body>")
    robot = told(put(text, "a.xml"))
    assert len(robot.joint_names) == 14 and robot.planar and robot.total_mass == pytest.approx(26.0)


def test_balls_are_three_hinges_and_angles_count_from_ref(put):
    ball = changed(
        MJCF,
        ('<joint name="left_elbow" axis="0 1 0" range="-2 0"/>', '<joint name="left_elbow" type="ball" range="0 2"/>'),
        ('<motor joint="left_elbow" ctrlrange="-30 30"/>', '<motor joint="left_elbow" gear="0 30" ctrlrange="-1 1"/>'),
    )
    path = put(ball, "a.xml")
    assert limit(path, "left_elbow_y") == 30 and limit(path, "left_elbow_x") == 0
    assert (limit(path, "left_elbow_z", "lower"), limit(path, "left_elbow_z", "upper")) == (-2, 2)
    ref = MJCF
    for side in ("left", "right"):
        knee = f'{side}_knee" axis="0 1 0" range='
        ref = changed(ref, (f'{knee}"0.0 2.3"', f'{knee}".5 2.8" ref=".5"'))
    path = put(ref, "a.xml")
    assert (limit(path, "left_knee", "lower"), limit(path, "left_knee", "upper")) == (0, pytest.approx(2.3))
    assert told(path).foot.heel == pytest.approx(-0.07)


def test_loops_and_couplings_are_named(put):
    equality = (
        '<equality><connect name="rod" body1="left_ankle_roll_link" body2="left_knee_link" anchor="0 0 0"/>'
        '<joint joint1="left_elbow" joint2="left_shoulder_pitch" polycoef="0 2 0 0 0"/></equality>'
    )
    told_ = notes(put(changed(MJCF, ("</worldbody>", f"</worldbody>{equality}")), "a.xml"))
    assert "the equality 'rod' ties 'left_ankle_roll_link' to 'left_knee_link': left out" in told_
    assert "joint 'left_elbow' follows 'left_shoulder_pitch': held" in told_


def rods(text: str, motor: str, equality: str) -> str:
    """Knees without a motor, each with a rod that hangs on the thigh and has one."""
    for side in ("left", "right"):
        shank = f'<body name="{side}_knee_link" pos="0 0 -0.31">'
        rod = f'<body name="{side}_rod" pos=".05 0 0"><joint name="{side}_crank" axis="0 1 0"/><inertial pos="0 0 -.1" '
        rod += 'mass=".1" diaginertia=".001 .001 .0001"/></body>'
        knee = f'<motor joint="{side}_knee" ctrlrange="-160 160"/>'
        tie = equality.format(side=side)
        text = changed(text, (shank, rod + shank), (knee, motor.format(side=side)))
        text = changed(text, ("</worldbody>", f"</worldbody><equality>{tie}</equality>"))
    return text


CRANK = '<motor joint="{side}_crank" ctrlrange="-90 90"/>'


@pytest.mark.parametrize(("tie", "said"), [
    ('<connect name="{side}_bar" body1="{side}_rod" body2="{side}_knee_link" anchor="0 0 -.31"/>',
     "the joints 'left_crank', 'left_knee' of this closed chain move as if it were cut"),
    ('<joint joint1="{side}_knee" joint2="{side}_crank" polycoef="0 .5 .3 0 0"/>',
     "couples the joints 'left_knee', 'left_crank' along a curve: left out, they move as if it"),
], ids=["closed chain", "curve"])  # fmt: skip
def test_a_knee_that_is_moved_by_another_joint_needs_its_effort(put, tie, said):
    path = put(rods(MJCF, CRANK, tie), "a.xml")
    found = draft(path)
    assert found.roles.joints["knee"] == ("left_knee", "right_knee") and said in notes(path)
    if "connect" in tie:
        assert sum("give effort, velocity in [limits.left_knee]" in sentence for sentence in found.faults) == 1
    given = TOLD.replace("[limits.knee]", "[limits.knee]\neffort = 120.0")
    assert check(path, found.text + given).robot.actuators["left_knee"]["effort"] == 120


TENDON = '<tendon><fixed name="t"><joint joint="left_knee" coef="1"/><joint joint="{}" coef="1"/></fixed></tendon>'
PULLED = TENDON + '<equality><tendon tendon1="t"/></equality>'
TIES = {
    "joints along a curve": (
        '<equality><joint joint1="left_knee" joint2="left_hip_pitch" polycoef="0 -2 .5 0 0"/></equality>',
        "the equality 0 ties the joints 'left_knee', 'left_hip_pitch'",
    ),
    "joints by a tendon": (
        PULLED.format("left_ankle_pitch"),
        "the equality 0 ties the joints 'left_knee', 'left_ankle_pitch'",
    ),
    "a bar across the ankle": (
        '<equality><connect name="bar" body1="left_knee_link" body2="left_ankle_roll_link" anchor="0 0 0"/></equality>',
        "the equality 'bar' ties the joints 'left_ankle_pitch', 'left_ankle_roll'",
    ),
    "feet to each other": (
        '<equality><weld name="feet" body1="left_knee_link" body2="right_knee_link"/></equality>',
        "the equality 'feet' ties the joints 'left_hip_pitch', 'left_hip_roll', 'left_hip_yaw', 'left_knee', "
        "'right_hip_pitch', 'right_hip_roll' and 2 more",
    ),
}


@pytest.mark.parametrize(("tie", "sentence"), TIES.values(), ids=TIES.keys())
def test_joints_of_a_jump_that_cannot_move_each_by_itself_are_refused(put, tie, sentence):
    path = put(changed(MJCF, ("</worldbody>", f"</worldbody>{tie}")), "a.xml")
    assert refused(lambda: told(path)) == (
        f"a.xml: {sentence}, and a jump moves each by itself; take it out of the file, and give each joint the range "
        f"and the torque that it has in a serial leg in its place"
    )


def test_ties_to_what_does_not_jump_are_only_named(put):
    """To the world, to a held joint; and a tendon that only pulls."""
    harness = '<equality><weld name="hook" body1="pelvis" body2="world"/></equality>'
    path = put(changed(MJCF, ("</worldbody>", f"</worldbody>{harness}")), "a.xml")
    assert "the equality 'hook' ties 'pelvis' to 'world': left out" in notes(path) and told(path)
    path = put(changed(MJCF, ("</worldbody>", f"</worldbody>{PULLED.format('left_elbow')}")), "a.xml")
    assert "the equality 0 of tendons of the joints 'left_knee', 'left_elbow' is left out" in notes(path) and told(path)
    path = put(changed(MJCF, ("</worldbody>", f"</worldbody>{TENDON.format('left_hip_yaw')}")), "a.xml")
    assert "the tendons 't' of the joints 'left_knee', 'left_hip_yaw' are left out" in notes(path) and told(path)


def test_a_knee_moved_through_a_gear_has_the_motor_of_its_crank(put):
    tie = '<joint joint1="{side}_knee" joint2="{side}_crank" polycoef="0 .5 0 0 0"/>'
    path = put(rods(MJCF, CRANK, tie), "a.xml")
    assert "joint 'left_knee' is moved by the motor of 'left_crank', by a gear of 0.5" in notes(path)
    assert told(path).actuators["left_knee"]["effort"] == 180
    servo = CRANK.replace("motor", "position").replace("90", "2")
    faults = draft(put(rods(MJCF, servo, tie), "a.xml")).faults
    assert any("has a forcerange" in x and "effort, velocity in [limits.left_knee]" in x for x in faults)
    crank = '<link name="{0}_crank"><inertial><mass value="0.1"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" '
    crank += 'iyz="0" izz="1e-4"/></inertial></link><joint name="{0}_crank" type="revolute">'
    crank += '<parent link="{0}_hip_yaw_link"/><child link="{0}_crank"/><axis xyz="0 1 0"/>'
    crank += '<limit lower="0" upper="2" effort="60" velocity="9"/>'
    crank += '<dynamics friction="1"/></joint></robot>'
    text = URDF
    for side in ("left", "right"):
        limits = re.search(rf'<joint name="{side}_knee".*?(<limit [^>]*/>)', text, re.DOTALL)
        mimic = f'{limits[0]}<mimic joint="{side}_crank" multiplier="1.5"/>'
        text = changed(text, (limits[0], mimic), ("</robot>", crank.format(side)))
    knee = examine(put(text)).robot.actuators["left_knee"]
    assert (knee["effort"], knee["speed"], knee["friction"]) == pytest.approx((40, 13.5, 2 / 3))


@pytest.mark.parametrize("upper", [True, False])
def test_a_knee_of_two_joints_has_its_boxes_above_and_below_both(put, upper):
    """One that rolls on another, whichever of both is taken for the knee."""
    text = URDF
    for side in ("left", "right"):
        shin = f'<link name="{side}_shin"><inertial><origin xyz="0 0 -.1"/><mass value="1"/><inertia ixx=".01" '
        shin += f'iyy=".01" izz=".002" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="{side}_low" '
        shin += f'type="revolute"><parent link="{side}_knee_link"/><child link="{side}_shin"/>'
        shin += '<origin xyz="0 0 -.05"/><axis xyz="0 1 0"/>'
        shin += '<limit lower="0" upper="1.5" effort="160" velocity="20"/></joint></robot>'
        ankle = f'<parent link="{side}_knee_link"/><child link="{side}_ankle_pitch_link"/><origin xyz="0 0 -0.31"/>'
        below = ankle.replace("knee_link", "shin").replace("-0.31", "-0.26")
        text = changed(text, ("</robot>", shin), (ankle, below))
    path = put(text)
    given = draft(path).text
    if not upper:
        given = changed(given, ('"left_knee", "right_knee"', '"left_low", "right_low"'))
    robot = check(path, given).robot
    links = {link.get("name"): link for link in parse(robot.urdf, "x").iter("link")}
    long = {name for name in links if links[name].find("collision") is not None and name.startswith("left")}
    assert long == {"left_hip_yaw_link", "left_shin", "left_ankle_roll_link", "left_arm_link"}
    thigh, shin = (links[f"left_{name}"].find("collision/origin").get("xyz") for name in ("hip_yaw_link", "shin"))
    assert [float(x.split()[2]) for x in (thigh, shin)] == pytest.approx([-0.155 if upper else -0.18, -0.13])
    body = Body(robot)
    names = [body.joint_names[k - 1] for k, _ in (*body.shank_points, *body.limb_points[:2])]
    assert set(names) == {"left_low", "right_low"}


def test_losses_of_the_file_are_those_of_the_motors(put):
    joint = ("<joint name=", '<joint armature=".02" damping=".5" frictionloss="1" name=')
    knee = told(put(changed(MJCF, joint), "a.xml")).actuators["left_knee"]
    assert (knee["armature"], knee["friction"], knee["damping"]) == (0.02, 1.0, 0.5)
    limits = 'velocity="20"/></joint>'
    urdf = put(changed(URDF, (limits, limits.replace("</", '<dynamics damping="0.5" friction="-1"/></'))))
    assert examine(urdf).robot.actuators["left_knee"]["damping"] == 0.5
    assert "friction = '-1' of 'left_hip_pitch', 'left_knee', 'right_hip_pitch', 'right_knee' must be" in notes(urdf)
    assert "armature = " not in notes(urdf)
    # of 160 N m at 20 rad/s: what leaves less than a tenth is the line on which the torque falls
    for damping, used in ((6.9, 6.9), (7.4, 0.0)):
        knee = re.sub('(effort="160" velocity="20"/>)', rf'\1<dynamics damping="{damping}"/>', URDF)
        assert examine(put(knee)).robot.actuators["left_knee"]["damping"] == used


def test_what_another_version_or_another_file_has_is_left_out(put):
    """Settings that this MuJoCo does not know, and contact pairs with the floor of a scene."""
    foot = '<geom type="box" pos="0.03 0 -0.05" size="0.1 0.04 0.015" mass="0"/>'
    named = foot.replace("<geom", '<geom name="foot" contype="0" conaffinity="0"')
    marker = '<geom size=".3" mass="0" contype="0" conaffinity="0"/>'
    words = '<option apirate="9"><flag sensornoise="enable"/></option><contact><pair geom1="floor" geom2="foot"/>'
    text = changed(MJCF, ("<worldbody>", f"{words}</contact><worldbody>"))
    path = put(text.replace(foot, named + marker, 1), "a.xml")
    assert "<option> has 'apirate', which this MuJoCo does not know: left out" in notes(path)
    assert "the pairs with 'floor', which is terrain or in another file, are left out" in notes(path)
    assert told(path).foot.heel == pytest.approx(-0.07)
    path = put(changed(MJCF, ("<worldbody>", '<worldbody><body stiff="9"/>')), "a.xml")
    assert "unrecognized attribute: 'stiff'; Element 'body'" in refused(lambda: draft(path))


def test_of_many_meshes_those_of_the_feet_are_read(put, monkeypatch):
    monkeypatch.setattr(mjcf, "MOST_MESHES", 1)
    corners = " ".join(f"{x} {y} {z}" for x in (-0.07, 0.13) for y in (-0.04, 0.04) for z in (-0.065, -0.035))
    assets = f'<asset><mesh name="foot" vertex="{corners}"/><mesh name="trunk" file="lost.stl"/></asset><worldbody>'
    foot = '<geom type="box" pos="0.03 0 -0.05" size="0.1 0.04 0.015" mass="0"/>'
    shown = '<freejoint/><geom type="mesh" mesh="trunk" mass="0"/>'
    text = changed(MJCF, ("<worldbody>", assets), (foot, '<geom type="mesh" mesh="foot" mass="0"/>'))
    path = put(changed(text, ("<freejoint/>", shown)), "a.xml")
    assert "1 of 2 meshes, none of a foot, are not read" in notes(path)
    assert told(path).foot.heel == pytest.approx(-0.07) and mass(path) == pytest.approx(30.8)


def test_meshes_of_hands_are_not_read_where_there_are_many(put, monkeypatch):
    """A finger ends a chain as a foot does; its files are not even looked for."""
    monkeypatch.setattr(mjcf, "MOST_MESHES", 2)
    assets = "".join(f'<mesh name="finger {k}" file="lost {k}.stl"/>' for k in range(3))
    fingers = "".join(f'<geom type="mesh" mesh="finger {k}" mass="0"/>' for k in range(3))
    hand = '<joint name="left_elbow" axis="0 1 0" range="-2 0"/>'
    text = changed(MJCF, ("<worldbody>", f"<asset>{assets}</asset><worldbody>"), (hand, hand + fingers))
    path = put(text, "a.xml")
    said = notes(path)
    assert "3 of 3 meshes, none of a foot, are not read" in said and "lost" not in said
    assert mass(path) == pytest.approx(30.8)


def test_what_is_read_is_said_while_it_is_read(put):
    said = []
    with told_to(lambda what, done, of: said.append(what)):
        read_urdf(put(URDF, "hero.urdf"))
    assert said == ["reading hero.urdf"]


def test_a_scene_is_called_after_its_robot(put):
    put(MJCF, "robot.xml")
    path = put('<mujoco model="mini scene"><include file="robot.xml"/></mujoco>', "scene.xml")
    assert parse(read_urdf(path), "x").get("name") == "mini"
    path = put('<mujoco><include file="robot.xml"/></mujoco>', "scene.xml")
    assert parse(read_urdf(path), "x").get("name") == "mini"


def test_mujoco_leaves_no_log_behind(tmp_path):
    ball = '<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    lines = f"import mujoco, jumplab.sim.mujoco; m = mujoco.MjModel.from_xml_string({ball!r}); d = mujoco.MjData(m)"
    lines += "; d.qvel[0] = 1e30; mujoco.mj_step(m, d)"
    subprocess.run([sys.executable, "-c", lines], cwd=tmp_path, check=True)
    assert not list(tmp_path.iterdir())


# geometry ------------------------------------------------------------------------------------------------------------
def test_an_origin_may_lie_anywhere_on_its_axis(put):
    """A knee 30 mm along its axis, an ankle's roll 15 mm along its own: the same machine."""
    text = URDF
    for joint, link, shift, below in (
        ("right_knee", "right_knee_link", np.array([0.0, 0.03, 0.0]), "right_ankle_pitch"),
        ("right_ankle_roll", "right_ankle_roll_link", np.array([0.015, 0.0, 0.0]), None),
    ):
        text = _shifted(text, rf'<joint name="{joint}" .*?</joint>', shift)
        text = _shifted(text, rf'<link name="{link}">.*?</link>', -shift)
        text = _shifted(text, rf'<joint name="{below}" .*?</joint>', -shift) if below else text
    same_robot(put, text)


def same_robot(put, moved: str) -> None:
    plain, other = (examine(put(x)).robot for x in (URDF, moved))
    assert other.planar and other.foot.heel == pytest.approx(plain.foot.heel)
    for name in ("mass", "inertia", "com", "span", "heel"):
        np.testing.assert_allclose(getattr(other.sagittal, name), getattr(plain.sagittal, name), atol=1e-9)


def _shifted(text: str, pattern: str, shift: np.ndarray) -> str:
    """Every origin within the first match of a pattern moved."""

    def move(xyz: re.Match) -> str:
        return 'origin xyz="{:g} {:g} {:g}"'.format(*(np.array(xyz[1].split(), float) + shift))

    return re.sub(pattern, lambda m: re.sub(r'origin xyz="([^"]+)"', move, m[0]), text, count=1, flags=re.DOTALL)


@pytest.mark.parametrize("shank", ["-0.29", "-0.33"])
def test_toes_are_held_and_belong_to_the_sole(put, shank):
    text = URDF
    for side in ("left", "right"):
        toe = f'<link name="{side}_toe"><inertial><mass value=".1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" '
        toe += 'ixz="0" iyz="0"/></inertial><collision><origin xyz=".03 0 -.01"/><geometry><box size=".06 .08 .03"/>'
        toe += f'</geometry></collision></link><joint name="{side}_toe" type="revolute"><child link="{side}_toe"/>'
        toe += f'<parent link="{side}_ankle_roll_link"/><origin xyz=".13 0 -.04"/><axis xyz="0 1 0"/><limit '
        text = text.replace("</robot>", toe + 'lower="-.5" upper=".5" effort="9" velocity="9"/></joint></robot>')
        ankle = f'<child link="{side}_ankle_pitch_link"/><origin xyz="0 0 '
        text = changed(text, (f"{ankle}-0.31", f"{ankle}{shank}"))
    found = examine(put(text)).robot
    assert found.joints["ankle_pitch"] == ("left_ankle_pitch", "right_ankle_pitch")
    assert (found.foot.heel, found.foot.toe) == pytest.approx((-0.07, 0.19))
    assert "the joints 'left_toe', 'right_toe' beyond the ankles are held" in notes(put(text))


def test_feet_that_are_points_and_legs_that_end_in_wheels(put):
    sphere = '<collision><origin xyz="0 0 -.05"/><geometry><sphere radius=".02"/></geometry></collision>'
    sentence = refused(lambda: draft(put(changed(URDF, (BOX, sphere)))))
    assert "the foot 'left_ankle_roll_link' touches the ground in a point (from its sphere" in sentence
    wheel = '<collision><origin rpy="1.5708 0 0"/><geometry><cylinder radius=".07" length=".04"/></geometry>'
    wheel += "</collision>"
    text = URDF
    for side in ("left", "right"):
        link = f'<link name="{side}_ankle_pitch_link">'
        text = changed(text, (link, link + wheel))
    words = "the legs end in wheels: joint 'right_ankle_pitch' turns without stops"
    for stops, kind in (('lower="-1e6" upper="1e6"', "revolute"), ("", "continuous")):
        endless = text.replace('lower="-0.9" upper="0.7"', stops)
        path = put(endless.replace('ankle_pitch" type="revolute"', f'ankle_pitch" type="{kind}"'))
        assert words in refused(lambda path=path: draft(path))


def test_a_leaning_foot_stands_level(put):
    """Feet that lean by 0.2 rad with all joints at 0 stand flat, in the file's own angles of the ankles."""
    tilted = changed(URDF, ('<origin xyz="0.03 0 -0.05"/><', '<origin xyz="0 0 -.05" rpy="0 .2 0"/><'))
    robot = examine(put(tilted)).robot
    assert not robot.planar and robot.foot.toe == pytest.approx(0.1 + 0.05 * np.sin(0.2), abs=1e-3)
    model = pin.buildModelFromXML(tilted, pin.JointModelFreeFlyer())
    q = pin.neutral(model)
    q[:7] = robot.standing[:7]
    for name, angle in zip(robot.joint_names, robot.standing[7:], strict=True):
        q[model.idx_qs[model.getJointId(name)]] = angle
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    for side in ("left", "right"):
        foot = data.oMi[model.getJointId(f"{side}_ankle_roll")].rotation @ pin.rpy.rpyToMatrix(0, 0.2, 0)
        np.testing.assert_allclose(foot[2, :2], 0, atol=2e-3)


def test_origins_moved_to_one_side_along_their_axes_are_the_same_robot(put):
    """The pitch joints of both hips have their origins 2 cm farther left on their axes."""
    moved = URDF
    for side, y in (("left", 0.09), ("right", -0.09)):
        link = f'<link name="{side}_hip_pitch_link"><inertial><origin xyz="0 {{}} -0.02"'
        hip = f'<child link="{side}_hip_pitch_link"/><origin xyz="0 {{:g}} -0.06"'
        roll = f'<child link="{side}_hip_roll_link"/><origin xyz="0 {{}} 0"'
        pairs = [(text.format(0), text.format(-0.02)) for text in (link, roll)]
        moved = changed(moved, *pairs, (hip.format(y), hip.format(y + 0.02)))
    same_robot(put, moved)
    assert examine(put(moved)).robot.foot == examine(put(URDF)).robot.foot


def test_unlike_ranges_are_named_and_mended_as_advised(put):
    path = put(re.sub(r'(<joint name="right_knee".*?)lower="0.0" upper="2.3"', r'\1lower="-2.3" upper="0"', URDF))
    sentence = refused(lambda: examine(path))
    assert "'left_knee', 'right_knee' turn 0 ... 2.3 and -2.3 ... 0 rad" in sentence and "0 rad in common" in sentence
    given = "[limits.right_knee]\nlower = 0.0\nupper = 2.3"
    assert check(path, draft(path).text + given).robot.sagittal.upper[1] == pytest.approx(2.3)


def test_soles_from_what_is_drawn_and_from_millimetres(put):
    corners = np.array([[x, y, z] for x in (-70, 130) for y in (-40, 40) for z in (-65, -35)], float)
    facets = [(0, 1, 2), (1, 2, 3), (4, 5, 6), (5, 6, 7), (0, 1, 4), (1, 4, 5), (2, 3, 6), (3, 6, 7)]
    rows = b"".join(struct.pack("<12fH", 0, 0, 1, *corners[list(f)].ravel(), 0) for f in facets)
    put(bytes(80) + struct.pack("<I", len(facets)) + rows, "foot.stl")
    mesh = '<collision><geometry><mesh filename="foot.stl"/></geometry></collision>'
    path = put(changed(URDF, (BOX, mesh)))
    assert "the mesh 'foot.stl' is taken in millimetres" in notes(path)
    for text in (path.read_text(), changed(URDF, (BOX, BOX.replace("collision", "visual")))):
        foot = examine(put(text)).robot.foot
        assert (foot.heel, foot.toe, foot.sole_z) == SOLE and foot.half_width == pytest.approx(0.04)


def test_where_it_faces_by_several_signs_and_by_word(put):
    """Knees, hips and ankles without stops, feet centred by 0.1 mm: arms and the root's frame decide."""
    text = changed(URDF, ('xyz="0.03 0 -0.05"', 'xyz="-0.0001 0 -0.05"'))
    for name in ("hip_pitch", "knee", "ankle_pitch"):
        text = re.sub(rf'(\w+_{name}") type="revolute"(.*?)lower="\S+" upper="\S+"', r'\1 type="continuous"\2', text)
    path = put(text)
    found = draft(path)
    assert found.roles.joints["knee"] == ("left_knee", "right_knee") and found.roles.forward == "+x"
    assert "the forward direction is a guess, by the arms' range and the root's x axis" in notes(path)
    turned = check(path, found.text.replace('# facing = "-x"', 'facing = "-x"')).robot
    assert turned.joints["knee"] == ("right_knee", "left_knee") and turned.sagittal.upper[1] == pytest.approx(2.3)
    sideways = found.text.replace('# facing = "-x"', 'facing = "+y"')
    assert "'source.facing' = '+y' must be +x or -x" in refused(lambda: check(path, sideways))
    swapped = re.sub(r'\["(left_\w+)", "(right_\w+)"\]', r'["\2", "\1"]', found.text)
    assert "is named as the left one, but lies on the right" in refused(lambda: check(path, swapped))


# masses, limits, words -----------------------------------------------------------------------------------------------
def test_no_repair_mends_units(put):
    text = changed(URDF, ('ixx="0.036000000000000004" iyy="0.036000000000000004"', 'ixx="40" iyy="40"'))
    for repair in ((), ("inertia",)):
        sentence = refused(lambda repair=repair: draft(put(text), repair))
        assert "moment of inertia 40 kg m^2 on 1.8 kg is a radius of gyration of 4.71 m" in sentence


def test_a_held_joint_may_share_its_name_with_a_link(put):
    same = re.sub(r'"(left|right)_hand_link"', r'"\1_elbow"', URDF)
    assert len(examine(put(same)).robot.joint_names) == 14


def test_a_robot_whose_z_axis_points_down(put):
    def turned(m: re.Match) -> str:
        return f'{m[1]}="{m[2]} {-float(m[3]):g} {-float(m[4]):g}"'

    found = draft(put(re.sub(r'(<origin xyz|<axis xyz)="(\S+) (\S+) (\S+)"', turned, URDF)))
    assert (found.roles.up, found.roles.forward) == ("-z", "+x") and found.roles.joints["knee"][0] == "left_knee"


def test_a_trunk_without_mass_is_refused(put):
    path = put(changed(URDF, ('<mass value="12"/>', '<mass value="0"/>')))
    assert "the trunk 'pelvis' and all that is held on it weigh 0 kg" in refused(lambda: examine(path))


def test_bodies_without_mass_are_mended_as_advised(put):
    path = put(re.sub(r'(<link name="\w+_hip_roll_link">)<inertial>.*?</inertial>', r"\1", URDF))
    assert "or let it have a gram: --repair massless" in refused(lambda: draft(path))
    assert examine(path, ("massless",)).robot.total_mass == pytest.approx(28.8)


def test_a_joint_without_a_motor_is_held_and_links_share_names_with_joints(put):
    text = changed(URDF, ('effort="40" velocity="16"', 'effort="0" velocity="0"'))
    assert len(examine(put(text)).robot.joint_names) == 12
    same = re.sub(r"(\w+)_link\"", r'\1"', URDF)
    robot = examine(put(same)).robot
    assert robot.foot.frames == ("left_ankle_roll", "right_ankle_roll") and robot.planar


def test_what_is_advised_is_enough(put):
    """All that a joint lacks is asked for at once, in a table that can be appended as it is written."""
    text = changed(URDF, ("left_knee", "left.knee"), ("right_knee", "right.knee"))
    text = text.replace('<limit lower="0.0" upper="2.3" effort="160" velocity="20"/>', "<limit/>")
    path = put(text)
    found = draft(path)
    assert [re.search(r"or give (.*) in \[(.*)\]", x).groups() for x in found.faults] == [
        ("effort, velocity", 'limits."left.knee"'),
        ("effort, velocity", 'limits."right.knee"'),
    ]
    assert '# [limits."left.knee"]\n# effort =\n# velocity =\n' in found.text
    both = "".join(f'[limits."{side}.knee"]\neffort = 160.0\nvelocity = 20.0\n' for side in ("left", "right"))
    knee = check(path, found.text + both).robot.actuators["left.knee"]
    assert (knee["lower"], knee["upper"], knee["effort"]) == (0.0, 2.3, 160.0)
    bare = found.text + "[limits.left.knee]\neffort = 1.0\n"
    assert 'names with dots are quoted: [limits."left.knee"]' in refused(lambda: check(path, bare))


@pytest.mark.parametrize(("line", "sentence"), [
    ("[limts.knee]\neffort = 1.0", "robot configuration: [limts] is unknown; did you mean limits?"),
    ("[shapes]\ntigh_thickness_m = 0.1", "robot configuration: [shapes] 'tigh_thickness_m' is unknown; "
                                         "did you mean thigh_thickness_m?"),
    ("[locked]", "; put its lines into the one that is there"),
])  # fmt: skip
def test_misspelt_tables_are_refused(put, line, sentence):
    path = put(URDF)
    assert refused(lambda: check(path, draft(path).text + line)).endswith(sentence)


def with_hind_legs(text: str) -> str:
    """The same with two further legs behind it."""
    leg = re.search(r'<body name="left_hip_pitch_link".*?(?=<body name="right_hip_pitch_link")', text, re.DOTALL)[0]
    hind = [("hl", 0.09), ("hr", -0.09)]
    legs = "".join(leg.replace("left_", f"{x}_").replace("0 0.09 -0.06", f"-.4 {y} -.06") for x, y in hind)
    motors = "".join(re.search(r"(<motor.*?)<motor joint=.left_sh", text)[1].replace("left", x) for x, _ in hind)
    return changed(text, ('<body name="left_arm_link"', legs + '<body name="left_arm_link"'),
                   ("</actuator>", motors + "</actuator>"))  # fmt: skip


FOOT = '<geom type="box" pos="0.03 0 -0.05" size="0.1 0.04 0.015" mass="0"/>'
CORNERS = " ".join(f"{x} {y} {z}" for x in (-100, 100) for y in (-40, 40) for z in (-15, 15))
MESH = f'<asset><mesh name="foot" vertex="{CORNERS}"/></asset><worldbody>'
CAUSES = {
    "MJCF in rad": ([("angle=\"radian\" ", "")], "is 0.07 rad; an MJCF has its angles in degrees"),
    "mesh in mm": (
        [("<worldbody>", MESH), (FOOT, '<geom type="mesh" mesh="foot" pos="0 0 0" mass="0"/>')],
        "the sole of the foot 'left_ankle_roll_link' measures 200 m (from its mesh), the leg 0.62 m; are its shapes",
    ),
    "includes itself": ([("<actuator>", '<include file="a.xml"/><actuator>')], "File 'a.xml' already included"),
    "turn in degrees": ([('xyz="0 0.09 -0.06"', 'xyz="0 0.09 -0.06" rpy="0 0 90"')], "is beyond a turn: degrees?"),
    "telescopic knees": (
        [('knee" axis="0 1 0" range="0.0 2.3"', 'knee" type="slide" axis="0 0 1" range="-.1 .1"')],
        "('left_hip_pitch', 'left_ankle_pitch'), and 'left_knee' is prismatic there",
    ),
    "legs in the middle": (
        [(f'xyz="0 {y} -0.06"', 'xyz="0 0 -0.06"') for y in (0.09, -0.09)],
        "'right_ankle_roll' are none to the left and none to the right of the trunk",
    ),
    "argument of a template": ([('value="12"', 'value="$(arg kg)"')], "is a xacro template; expand it first"),
}


@pytest.mark.parametrize(("pairs", "sentence"), CAUSES.values(), ids=CAUSES)
def test_the_true_cause_is_told(put, pairs, sentence):
    base, name = (MJCF, "a.xml") if pairs[0][0] in MJCF else (URDF, "a.urdf")
    assert sentence in refused(lambda: draft(put(changed(base, *pairs), name)))


def test_a_longer_leg_is_told(put):
    text = re.sub(r'(<joint name="left_ankle_pitch".*?xyz="0 0 )-0.31', r"\1-0.35", URDF)
    assert "and 'right_ankle_roll' end 40 mm from where mirror images do" in refused(lambda: draft(put(text)))


@pytest.mark.parametrize("name", [r"meshes\foot.stl", "meshes/FOOT.STL", "my%20meshes/foot.stl", "$(find a)/foot.stl"])
def test_meshes_are_found_however_they_are_written(put, tmp_path, name):
    corners = [(a, b, c) for a in (-0.1, 0.1) for b in (-0.04, 0.04) for c in (-0.015, 0.015)]
    facets = [struct.pack("<12fH", 0, 0, 0, *corners[i], *corners[i - 1], *corners[i - 3], 0) for i in range(8)]
    for folder in ("meshes", "my meshes", "a"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "foot.stl").write_bytes(bytes(80) + struct.pack("<I", 8) + b"".join(facets))
    path = put(URDF.replace('<box size="0.2 0.08 0.03"/>', f'<mesh filename="{name}"/>'))
    assert draft(path).sole.x == SOLE_X and "from its mesh" in draft(path).sole.source


def test_four_legs_are_refused(put):
    path = put(with_hind_legs(MJCF), "a.xml")
    assert "four legs end on the ground, with the joints 'hr_ankle_roll'" in refused(lambda: draft(path))


SLIDES = "".join(
    f'<link name="{a}"/><joint name="{a}{b}" type="{kind}"><parent link="{a}"/><child link="{b}"/></joint>'
    for a, b, kind in (("world", "x", "prismatic"), ("x", "pelvis", "continuous"))
)
SAME = {
    "left-over world": (('<link name="pelvis">', '<link name="world"/><link name="pelvis">'), "is joined to nothing"),
    "joints at the world": (('<link name="pelvis">', SLIDES + '<link name="pelvis">'), ""),
    "inertias of 0": (('ixx="0.01" iyy="0.01" izz="0.005"', 'ixx="0" iyy="0" izz="0"'), "masses count as points"),
}


@pytest.mark.parametrize(("pair", "note"), SAME.values(), ids=SAME)
def test_what_does_no_harm_is_left_out(put, pair, note):
    path = put(changed(URDF, pair))
    assert note in notes(path) and examine(path).robot.total_mass == pytest.approx(30.8)


def test_includes_beside_the_file_that_includes_them_and_in_chinese_encodings(put, tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "robot.xml").write_text(MJCF)
    (tmp_path / "sub" / "mid.xml").write_text('<mujoco><include file="robot.xml"/></mujoco>')
    path = put('<mujoco model="scene"><include file="sub/mid.xml"/></mujoco>', "scene.xml")
    assert parse(read_urdf(path), "x").get("name") == "mini"
    attached = '<asset><model name="r" file="sub/robot.xml"/></asset><worldbody><frame><attach model="r" body="pelvis"'
    for name in ("host.xml", "host.mjcf"):  # MuJoCo reads only the first by itself
        path = put(f'<mujoco>{attached} prefix="r_"/></frame></worldbody></mujoco>', name)
        assert limit(path, "r_left_knee") == 160
    text = '<?xml version="1.0" encoding="GBK"?>' + MJCF.replace("left_", "左")
    assert limit(put(text.encode("gbk"), "b.xml"), "左knee") == 160


def test_a_robot_is_called_like_a_file(put):
    path = put(URDF)
    text = draft(path).text.replace('name = "mini"', 'name = "../x"')
    assert "'name' = '../x' must be a plain file name" in refused(lambda: check(path, text))


@pytest.mark.parametrize("name", ["base\\pelvis", 'base "A"', "骨盆", "a.b", "{a}", "100%"])
def test_any_name_is_written_as_valid_toml(put, name):
    path = put(URDF.replace('"pelvis"', f'"{name.replace(chr(34), "&quot;")}"'))
    assert examine(path).robot.planar
