"""Broken URDFs, each with the exact sentence that refuses it."""

import re
from xml.etree import ElementTree as ET

import pytest
from fixtures_robots import refused
from paper import bhr_table as table

from jumplab.robot.files import decode
from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.urdf import Tree, locate, parse, read_urdf

GOOD = table.URDF_PATH.read_text()
FILE = "my.urdf"
END = "</robot>"
SHANK = '<link name="left_shank">'
KNEE = '<joint name="left_knee" type="revolute">'
KNEE_LIMIT = '<limit lower="0" upper="2.4" effort="210" velocity="20" />'


def changed(old: str, new: str, after: str = "") -> str:
    """GOOD with the first ``old`` behind the text ``after`` replaced."""
    assert after in GOOD
    start = GOOD.index(after)
    assert old in GOOD[start:], f"{old!r} is not in the robot"
    return GOOD[:start] + GOOD[start:].replace(old, new, 1)


def collision(old: str, new: str) -> str:
    """GOOD with a change in the left shank's collision shape."""
    start = GOOD.index("<collision>", GOOD.index(SHANK))
    assert old in GOOD[start:]
    return GOOD[:start] + GOOD[start:].replace(old, new, 1)


def without(pattern: str, after: str = "") -> str:
    """GOOD without the first match of a pattern behind the text ``after``."""
    start = GOOD.index(after)
    rest, count = re.subn(pattern, "", GOOD[start:], count=1, flags=re.DOTALL)
    assert count == 1
    return GOOD[:start] + rest


def added(text: str) -> str:
    return GOOD.replace(END, text + END)


def limited(**values) -> str:
    limits = {"lower": "0", "upper": "2.4", "effort": "210", "velocity": "20"} | values
    text = " ".join(f'{k}="{v}"' for k, v in limits.items() if v is not None)
    return changed(KNEE_LIMIT, f"<limit {text} />", KNEE)


BOMB = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
KILOGRAMS = re.compile(r'mass value="([^"]+)"')
ORIGINS = re.compile(r'(<(?:parent|child) link="[^"]+" />\s*)+<origin xyz="([^"]+)"')


def grams() -> str:
    return KILOGRAMS.sub(lambda m: f'mass value="{1000 * float(m[1]):g}"', GOOD)


def scaled(factor: float) -> str:
    root = ET.fromstring(GOOD)
    for origin in root.findall("joint/origin"):
        origin.set("xyz", " ".join(f"{factor * float(x):g}" for x in origin.get("xyz").split()))
    return ET.tostring(root, encoding="unicode")


def cycle() -> str:
    """The trunk becomes a child of the left foot: no root is left."""
    joint = '<joint name="back" type="fixed"><parent link="left_foot"/><child link="trunk"/></joint>'
    return added(joint)


def island() -> str:
    links = '<link name="a"/><link name="b"/>'
    joints = (
        '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
        '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint>'
    )
    return added(links + joints)


FILES = [
    ("empty", b"", "my.urdf: the file is empty (0 of 0 bytes are text); copy or download it again"),
    ("gzip", b"\x1f\x8b\x08robot", "my.urdf: is a compressed archive, not a URDF; unpack it first"),
    ("binary", b"solid\xff\xfe", "my.urdf: is binary (byte 5 is no UTF-8 text); a URDF is an XML text"),
    ("zeros", b"<robot>\0\0", "my.urdf: is binary (byte 7 is no UTF-8 text); a URDF is an XML text"),
    ("lfs", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
     "my.urdf: is a Git LFS pointer of 56 bytes, not the file itself; run 'git lfs pull'"),
]  # fmt: skip

TEXTS = [
    ("html", "<!DOCTYPE html><html></html>", "is a web page (HTML), not a URDF; download the raw file"),
    ("entity bomb", BOMB + GOOD.split("?>")[1],
     "declares a DOCTYPE or entities, which can expand without limit; remove them"),
    ("truncated", GOOD[:4000],
     "line 135, column 4: ends before </robot>; it is cut short or is no URDF (unclosed token)"),
    ("no XML", "the robot", "line 1, column 0: ends before </robot>; it is cut short or is no URDF (syntax error)"),
    ("malformed", GOOD.replace("<mass ", "<mass <", 1),
     "line 6, column 12: is not well-formed XML (not well-formed (invalid token))"),
    ("xacro", '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="a"/></robot>',
     "is a xacro template; expand it first: 'xacro robot.xacro > robot.urdf'"),
    ("xacro, not declared", "<robot><xacro:include filename='a'/></robot>",
     "is a xacro template; expand it first: 'xacro robot.xacro > robot.urdf'"),
    ("xacro expression", changed('value="19.994"', 'value="${m}"'),
     "is a xacro template; expand it first: 'xacro robot.xacro > robot.urdf'"),
    ("sdf", "<sdf><model/></sdf>", "the root element is <sdf>, an SDF file, not a URDF"),
    ("mjcf", "<mujoco/>", "the root element is <mujoco>, a MuJoCo model, not a URDF"),
    ("other XML", "<svg/>", "the root element is <svg>, a URDF begins with <robot>"),
    # structure
    ("no links", "<robot/>", "has no <link>; a robot needs a trunk, legs and feet"),
    ("no joints", '<robot><link name="a"/></robot>', "has 1 links and no <joint>; nothing can move"),
    ("nameless link", changed(' name="left_shank"', ""), "1 <link> without a name; give each its own"),
    ("duplicate link", added('<link name="trunk"/>'), "link 'trunk' is defined 2 times; keep one"),
    ("duplicate joint", changed('name="right_knee" type', 'name="left_knee" type'),
     "joint 'left_knee' is defined 2 times; keep one"),
    ("no parent", without('<parent link="left_thigh" />', KNEE),
     "joint 'left_knee': has no parent link; add <parent link=...>"),
    ("unknown parent", changed('parent link="left_thigh"', 'parent link="thigh"', KNEE),
     "joint 'left_knee': its parent link 'thigh' does not exist; correct the name"),
    ("self-joint", changed('parent link="left_thigh"', 'parent link="left_shank"', KNEE),
     "joint 'left_knee': joins the link 'left_shank' to itself; correct parent or child"),
    ("unknown type", changed(KNEE, KNEE.replace("revolute", "hinge")),
     "joint 'left_knee': type 'hinge' is unknown; URDF has revolute, continuous, prismatic, fixed, floating, planar"),
    ("two numbers", changed('xyz="0 0 -0.35"', 'xyz="0 -0.35"', KNEE),
     "joint 'left_knee': origin xyz = '0 -0.35' must be three finite numbers"),
    ("axis zero", changed('axis xyz="0 1 0"', 'axis xyz="0 0 0"', KNEE),
     "joint 'left_knee': axis xyz = '0 0 0' has no direction; give a unit vector"),
    ("mimic by a word", changed(KNEE_LIMIT, KNEE_LIMIT + '<mimic joint="left_hip_pitch" multiplier="x"/>', KNEE),
     "joint 'left_knee': mimic multiplier = 'x' must be a finite number"),
    ("loop", added('<joint name="rod" type="fixed"><parent link="left_foot"/><child link="right_foot"/></joint>'),
     "link 'right_foot' hangs on 2 joints ('right_ankle_roll', 'rod'): a closed loop; cut it to leave a tree"),
    ("cycle", cycle(),
     "the links 'left_ankle_link', 'left_arm', 'left_foot', 'left_hip_roll_link', 'left_hip_yaw_link', 'left_shank' "
     "and 9 more form a cycle: each robot needs one link without a parent"),
    ("two roots", added('<link name="table"><inertial/></link>'),
     "2 links have no parent ('table', 'trunk'), Pinocchio keeps one tree and drops the rest; connect them"),
    ("island", island(), "the links 'a', 'b' form a cycle apart from the root 'trunk'"),
    # inertials
    ("no inertial", without("<inertial>.*?</inertial>", SHANK),
     "link 'left_shank': has no <inertial>, and nothing fixed to it has: Pinocchio reads 0 kg, PyBullet 1 kg; "
     "joint 'left_knee' needs a body of more than 0 kg, or let it have a gram: --repair massless, or [source] repair = "
     '["massless"]'),
    ("mass zero", changed('value="3"', 'value="0"', SHANK),
     "link 'left_shank': mass = 0 kg, the body of joint 'left_knee' must weigh more than 0 kg, or let it have a "
     'gram: --repair massless, or [source] repair = ["massless"]'),
    ("no mass", without("<mass [^>]*>", SHANK),
     "link 'left_shank': <inertial> has no <mass>, which Pinocchio reads as no inertial at all; add it"),
    ("mass NaN", changed('value="3"', 'value="nan"', SHANK),
     "link 'left_shank': mass = 'nan' must be a finite number of kg"),
    ("mass negative", changed('value="3"', 'value="-3"', SHANK),
     "link 'left_shank': mass = -3 kg must not be negative; correct <mass>"),
    ("no inertia", without("<inertia [^>]*>", SHANK),
     "link 'left_shank': <inertial> has no <inertia>; add the six numbers in kg m^2"),
    ("inertia incomplete", changed(' iyz="0"', "", SHANK),
     "link 'left_shank': iyz = None must be a finite number of kg m^2"),
    ("inertial origin", changed('origin xyz="', 'origin xyz="a ', SHANK),
     "link 'left_shank': inertial origin xyz = 'a 0 0 -0.14' must be three finite numbers"),
    ("inertia negative", changed('ixx="', 'ixx="-', SHANK),
     "link 'left_shank': principal moment of inertia -0.0319 kg m^2 must be positive; correct <inertia>, or let it be "
     'repaired: --repair inertia, or [source] repair = ["inertia"]'),
    ("triangle", changed('ixx="', 'ixx="1', SHANK),
     "link 'left_shank': principal moments 0.00245, 0.0319, 10 kg m^2: the largest must not exceed the sum of the "
     'others, no solid has this; correct <inertia>, or let it be repaired: --repair inertia, or [source] repair = '
     '["inertia"]'),
    ("g mm^2", changed('ixx="1e-06" ixy="0" ixz="0" iyy="1e-06" iyz="0" izz="1e-06"',
                       'ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"'),
     "link 'left_hip_yaw_link': moment of inertia 1 kg m^2 on 0.001 kg is a radius of gyration of 31.6 m, at most 1 is "
     "likely; is it in g mm^2 or kg cm^2?"),
    # shapes
    ("box flat", collision('0.07 0.07 0.225', '0.07 0 0.225'),
     "link 'left_shank': box size = '0.07 0 0.225' must be three positive numbers of m"),
    ("shape lost", collision("0.03 0 -0.1975", "0.03 left -0.1975"),
     "link 'left_shank': collision origin xyz = '0.03 left -0.1975' must be three finite numbers"),
    # units
    ("grams", grams().replace('ixx="', 'ixx="1').replace('iyy="', 'iyy="1').replace('izz="', 'izz="1'),
     "weighs 42000 kg, a humanoid 0.5 to 400; are the masses in grams? divide by 1000"),
    ("millimetres", scaled(1000),
     "the longest chain of joints measures 1141.47 m, a humanoid's 0.1 to 5; are the origins in millimetres? divide by "
     "1000"),
    ("no origins", scaled(0),
     "the longest chain of joints measures 0 m, a humanoid's 0.1 to 5; are the origins in kilometres, or are the "
     "origins missing?"),
]  # fmt: skip

LIMITS = [
    ("no limit", without("<limit [^>]*>", KNEE), "has no <limit>; add lower, upper, effort, velocity"),
    ("no effort", limited(effort=None), "<limit> has no effort, which Pinocchio reads as 0; add it"),
    ("word", limited(upper="max"), "upper = 'max' must be a finite number"),
    ("swapped", limited(lower="2.4", upper="0"), "lower = 2.4 rad is above upper = 0 rad; swap them"),
    ("empty", limited(upper="0"), "range 0 ... 0 rad is empty; give the real range"),
    ("degrees", limited(upper="137"),
     "range 0 ... 137 rad is beyond 12.6: degrees or a placeholder; give the real range in rad"),
    ("no torque", limited(effort="0"), "effort = 0 N m must be positive; give the peak torque"),
    ("torque placeholder", limited(effort="1e9"),
     "effort = 1e+09 N m is above 2000: a placeholder; give the peak torque"),
    ("no speed", limited(velocity="0"), "velocity = 0 rad/s must be positive; give the speed limit in rad/s"),
    ("deg/s", limited(velocity="400"),
     "velocity = 400 rad/s is above 60: deg/s or a placeholder; give the speed limit in rad/s"),
]  # fmt: skip


@pytest.mark.parametrize(("raw", "sentence"), [x[1:] for x in FILES], ids=[x[0] for x in FILES])
def test_files_that_are_no_text(raw, sentence):
    assert refused(lambda: decode(raw, FILE)) == sentence


@pytest.mark.parametrize(("text", "sentence"), [x[1:] for x in TEXTS], ids=[x[0] for x in TEXTS])
def test_texts_that_are_no_robot(text, sentence):
    assert refused(lambda: urdf_checks.read_tree(text, FILE)) == f"{FILE}: {sentence}"


@pytest.mark.parametrize(("text", "sentence"), [x[1:] for x in LIMITS], ids=[x[0] for x in LIMITS])
def test_limits_that_no_joint_has(text, sentence):
    tree = urdf_checks.read_tree(text, FILE)  # the rest of the file is good
    assert list(urdf_checks.limit_faults(tree, "left_knee")) == [f"{FILE}: joint 'left_knee': {sentence}"]


def test_a_good_robot_has_no_fault():
    tree = urdf_checks.read_tree(GOOD, FILE)
    assert [sentence for joint in tree.joints for sentence in urdf_checks.limit_faults(tree, joint)] == []


def test_what_a_cad_leaves_over_is_a_note():
    """A macro call beside whole links, a sphere of radius 0, an inertia that is wrong by rounding or by little."""
    text = GOOD.replace("<robot ", '<robot xmlns:xacro="http://ros.org/wiki/xacro" ', 1)
    text = text.replace(END, '<xacro:sensors side="left"/>' + END)
    point = '<collision><geometry><sphere radius="0.0"/></geometry></collision></link>'
    text = text.replace("</link>", point, 1)
    link = next(e for e in ET.fromstring(text).findall("link") if e.get("name") == "left_shank")
    ixx = float(link.find("inertial/inertia").get("ixx"))
    text = text.replace(f'ixx="{ixx:g}"', f'ixx="{ixx + 0.006:.6g}"')
    notes = list(urdf_checks.notes(urdf_checks.read_tree(text, FILE)))
    assert notes[:2] == [
        "the call <sensors> of a xacro macro is left over, and ignored",
        "link 'trunk': a sphere of radius 0 is taken as a point",
    ]
    assert [note.split(",")[0] for note in notes[2:]] == [
        "link 'left_shank': its inertia",
        "link 'right_shank': its inertia",
    ]


def test_a_mesh_that_was_not_downloaded_is_not_there(tmp_path, monkeypatch):
    """A pointer of Git LFS is no mesh; packages are also looked for where ROS_PACKAGE_PATH says."""
    mesh = '<mesh filename="package://feet/meshes/foot.stl"/>'
    text = re.sub(r"<collision>.*?</collision>", "", GOOD[GOOD.index('<link name="left_foot">') :], flags=re.DOTALL)
    text = GOOD[: GOOD.index('<link name="left_foot">')] + text.replace(
        "</link>", f"<collision><geometry>{mesh}</geometry></collision></link>", 1
    )
    (tmp_path / "ros" / "feet" / "meshes").mkdir(parents=True)
    file, path = tmp_path / "ros" / "feet" / "meshes" / "foot.stl", tmp_path / "robot" / "my.urdf"
    tree = Tree(parse(text, FILE), FILE, path)
    corners = ("0 0 0", "1 0 0", "0 1 0")
    facet = "facet normal 0 0 1\nouter loop\n" + "".join(f"vertex {c}\n" for c in corners) + "endloop\nendfacet\n"
    file.write_text(f"solid foot\n{facet}endsolid foot\n")
    ((_, mesh),) = tree.shapes("left_foot")
    assert len(tree.corners(mesh)) == 0
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ros"))
    assert len(tree.corners(mesh)) == 3
    file.write_text("version https://git-lfs.github.com/spec/v1\n")
    assert len(tree.corners(mesh)) == 0


@pytest.mark.parametrize(("name", "sentence"), [
    ("no.urdf", "there is no such file; give the path of a URDF"),
    ("", "is a folder; name the URDF file inside it"),
    ("big.urdf", "has 30 MB, a URDF has at most 20; name the URDF, not a mesh"),
])  # fmt: skip
def test_paths_that_hold_no_file(tmp_path, name, sentence):
    if name == "big.urdf":
        with open(tmp_path / name, "wb") as file:
            file.truncate(30_000_000)
    assert refused(lambda: read_urdf(tmp_path / name)) == f"{tmp_path / name}: {sentence}"


def test_place_of_a_urdf(tmp_path):
    assert locate("a.urdf", tmp_path) == tmp_path / "a.urdf"
    assert read_urdf(table.URDF_PATH) == GOOD
