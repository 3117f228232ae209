"""Robots made from the default one by hand: other proportions, axes, ankles, arms and base links."""

import pickle
from dataclasses import fields
from functools import partial
from xml.etree import ElementTree as ET

import fixtures_core
import numpy as np
import pinocchio as pin
import pytest
from paper import bhr_table as table

from jumplab.errors import RobotError
from jumplab.robot import Robot
from jumplab.robot.sagittal import SagittalModel
from jumplab.robot.stance import com_from_toe, configuration
from jumplab.robot_import.urdf import have_published

needs_published = pytest.mark.skipif(not have_published(), reason="the published robots are not installed")
GOOD = table.URDF_PATH.read_text()
CONFIG = """
name = "{name}"
urdf = "{name}.urdf"
[source]
trunk = "{trunk}"
forward = "{forward}"
up = "{up}"
repair = []
[joints]
hip_pitch = ["left_hip_pitch", "right_hip_pitch"]
knee = ["left_knee", "right_knee"]
ankle_pitch = ["left_ankle_pitch", "right_ankle_pitch"]
shoulder_pitch = {shoulders}
[feet]
links = ["left_foot", "right_foot"]
sole_x_m = [{heel}, {toe}]
sole_y_m = [-{half}, {half}]
sole_z_m = {z}
[stance]
knee_rad = 0.5
trunk_pitch_rad = 0.05
shoulder_rad = 0.0
[actuators]
corner_speed_ratio = 0.5
"""
refused = partial(fixtures_core.refused, by=RobotError)
SWINGING = '["left_shoulder_pitch", "right_shoulder_pitch"]'


def config(name: str, size: float = 1.0, **values) -> str:
    told = {"trunk": "trunk", "forward": "+x", "up": "+z", "shoulders": SWINGING, "heel": -0.1 * size,
            "toe": 0.14 * size, "half": 0.05 * size, "z": -0.075 * size}  # fmt: skip
    return CONFIG.format(name=name, **(told | values))


def root() -> ET.Element:
    return ET.fromstring(GOOD)


def text(robot: ET.Element) -> str:
    return ET.tostring(robot, encoding="unicode")


def joint(robot: ET.Element, name: str) -> ET.Element:
    return next(j for j in robot.findall("joint") if j.get("name") == name)


def link(robot: ET.Element, name: str) -> ET.Element:
    return next(x for x in robot.findall("link") if x.get("name") == name)


def _scale(element: ET.Element, key: str, factor: float) -> None:
    element.set(key, " ".join(f"{factor * float(x):.12g}" for x in element.get(key).split()))


def plain() -> tuple[str, str]:
    """The default robot through the whole of what is done to a stranger's robot."""
    return GOOD, config("plain")


def mirrored() -> tuple[str, str]:
    """Every pitch joint of the right side turns the other way."""
    robot = root()
    for name in ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch"):
        j = joint(robot, f"right_{name}")
        j.find("axis").set("xyz", "0 -1 0")
        limit = j.find("limit")
        low, high = limit.get("lower"), limit.get("upper")
        limit.set("lower", f"{-float(high)}")
        limit.set("upper", f"{-float(low)}")
    return text(robot), config("mirrored")


def child(size: float = 0.6) -> tuple[str, str]:
    """All lengths times ``size``; masses, torques and speeds as a body of the same material has them."""
    robot = root()
    for origin in robot.iter("origin"):
        _scale(origin, "xyz", size)
    for box in robot.iter("box"):
        _scale(box, "size", size)
    for mass in robot.iter("mass"):
        _scale(mass, "value", size**3)
    for inertia in robot.iter("inertia"):
        for key in ("ixx", "iyy", "izz"):
            _scale(inertia, key, size**5)
    for limit in robot.iter("limit"):
        _scale(limit, "effort", size**4)
    return text(robot), config("child", size)


def one_axis_ankle() -> tuple[str, str]:
    """No ankle roll."""
    robot = root()
    for side in ("left", "right"):
        joint(robot, f"{side}_ankle_roll").set("type", "fixed")
    return text(robot), config("one_axis_ankle")


def _swapped(at: str) -> str:
    """Roll and pitch of hips or ankles in the other order."""
    robot = root()
    for side in ("left", "right"):
        pitch, roll = joint(robot, f"{side}_{at}_pitch"), joint(robot, f"{side}_{at}_roll")
        for tag in ("axis", "limit"):
            a, b = pitch.find(tag), roll.find(tag)
            pitch.remove(a), roll.remove(b)
            pitch.append(b), roll.append(a)
        pitch.set("name", f"{side}_{at}_roll"), roll.set("name", f"{side}_{at}_pitch")
    return text(robot)


def roll_first() -> tuple[str, str]:
    """Ankle roll above ankle pitch."""
    return _swapped("ankle"), config("roll_first")


def pitch_first() -> tuple[str, str]:
    """Hip pitch above hip roll, below hip yaw: with level thighs two axes are one line."""
    return _swapped("hip"), config("pitch_first")


def heavy_arms(mass_kg: float = 5.0) -> tuple[str, str]:
    """Arms of 5 kg instead of 2."""
    robot = root()
    for side in ("left", "right"):
        inertial = link(robot, f"{side}_arm").find("inertial")
        share = mass_kg / float(inertial.find("mass").get("value"))
        _scale(inertial.find("mass"), "value", share)
        for key in ("ixx", "iyy", "izz"):
            _scale(inertial.find("inertia"), key, share)
        _scale(joint(robot, f"{side}_shoulder_pitch").find("limit"), "effort", share)
    return text(robot), config("heavy_arms")


def held_arms() -> tuple[str, str]:
    """No usable shoulder."""
    return GOOD, config("held_arms", shoulders="[]")


def _fixed(robot: ET.Element, parent: str, child: str, kind: str = "fixed", **origin: str) -> ET.Element:
    """A further joint, called by its child."""
    j = ET.SubElement(robot, "joint", name=f"to_{child}", type=kind)
    ET.SubElement(j, "parent", link=parent), ET.SubElement(j, "child", link=child)
    ET.SubElement(j, "origin", **origin)
    return j


def arm_base() -> tuple[str, str]:
    """The root is the left arm: the shoulder is met from its far end."""
    robot = root()
    shoulder = joint(robot, "left_shoulder_pitch")
    place = shoulder.find("origin").get("xyz")
    ET.SubElement(robot, "link", name="socket")
    shoulder.find("parent").set("link", "left_arm")
    shoulder.find("child").set("link", "socket")
    shoulder.find("origin").set("xyz", "0 0 0")
    shoulder.find("axis").set("xyz", "0 -1 0")
    _fixed(robot, "socket", "trunk", xyz=" ".join(f"{-float(x)}" for x in place.split()))
    return text(robot), config("arm_base")


def waist(chest_kg: float = 2.0) -> tuple[str, str]:
    """The root is a chest above a waist joint; the legs hang on a pelvis below it."""
    robot = root()
    chest = ET.SubElement(robot, "link", name="chest")
    inertial = ET.SubElement(chest, "inertial")
    ET.SubElement(inertial, "origin", xyz="0.02 0 0.1")
    ET.SubElement(inertial, "mass", value=str(chest_kg))
    ET.SubElement(inertial, "inertia", ixx="0.01", ixy="0", ixz="0.002", iyy="0.012", iyz="0", izz="0.008")
    j = _fixed(robot, "chest", "trunk", "revolute", xyz="0 0 0")
    j.set("name", "waist")
    ET.SubElement(j, "axis", xyz="0 1 0")
    ET.SubElement(j, "limit", lower="-0.5", upper="0.5", effort="100", velocity="5")
    return text(robot), config("waist") + "[locked]\nwaist = -0.1\n"


def torso(effort: float = 100.0) -> tuple[str, str]:
    """The legs hang on a pelvis; a waist of ``effort`` [N m], which no jump moves, carries trunk and arms."""
    robot = root()
    pelvis = ET.SubElement(robot, "link", name="pelvis")
    inertial = ET.SubElement(pelvis, "inertial")
    ET.SubElement(inertial, "origin", xyz="0 0 0.02")
    ET.SubElement(inertial, "mass", value="3")
    ET.SubElement(inertial, "inertia", ixx="0.02", ixy="0", ixz="0", iyy="0.01", iyz="0", izz="0.02")
    for j in robot.findall("joint"):
        if j.get("name").endswith(("_hip_yaw", "_hip_roll", "_hip_pitch")) and j.find("parent").get("link") == "trunk":
            j.find("parent").set("link", "pelvis")
    j = _fixed(robot, "pelvis", "trunk", "revolute", xyz="0 0 0")
    j.set("name", "waist")
    ET.SubElement(j, "axis", xyz="0 1 0")
    ET.SubElement(j, "limit", lower="-0.5", upper="0.5", effort=str(effort), velocity="5")
    return text(robot), config("torso", trunk="pelvis")


def sideways() -> tuple[str, str]:
    """The whole robot hangs on a root that is turned by 90 degrees: its trunk looks along +y of the root."""
    robot = root()
    ET.SubElement(robot, "link", name="turned")
    _fixed(robot, "turned", "trunk", xyz="0.3 0.2 0.1", rpy="0 0 1.5707963267948966")
    return text(robot), config("sideways", trunk="turned", forward="+y")


def canted(angle_rad: float) -> tuple[str, str]:
    """Both hips canted, as mirror images."""
    robot = root()
    for side, sign in (("left", 1), ("right", -1)):
        axis = f"0 {np.cos(angle_rad):.12f} {sign * np.sin(angle_rad):.12f}"
        joint(robot, f"{side}_hip_pitch").find("axis").set("xyz", axis)
    return text(robot), config("canted")


VARIANTS = (plain, mirrored, child, one_axis_ankle, roll_first, heavy_arms, held_arms, arm_base, waist, torso, sideways)


def write(folder, variant, *args) -> str:
    """Write a variant's two files into a folder; path of its TOML."""
    urdf, toml = variant(*args)
    path = folder / f"{variant.__name__}.toml"
    path.write_text(toml)
    (folder / f"{variant.__name__}.urdf").write_text(urdf)
    return str(path)


def alike(robot: Robot, other: Robot) -> bool:
    """Same texts, same physics."""
    same = robot.hash == other.hash and robot.model == other.model and robot.actuators == other.actuators
    names = [f.name for f in fields(SagittalModel) if f.name != "points"]
    return same and all(np.array_equal(getattr(robot.sagittal, n), getattr(other.sagittal, n)) for n in names)


def through_processes(robot: Robot) -> Robot:
    robot.sagittal, robot.actuators, robot.hash  # noqa: B018  (filled in, then sent)
    return pickle.loads(pickle.dumps(robot))


# how well the five links stand for the full robot -------------------------------------------------------------------
SAMPLES = 24  # fixed random postures over the whole joint range
RATE_RAD_S = 3.0  # of every link, for the momentum


def reduction_error(robot: Robot) -> np.ndarray:
    """Largest differences (4,) of five links and full robot on random symmetric motions: mass [kg], CoM [m], pitch
    inertia [kg m^2], angular momentum [kg m^2/s].
    """
    s, model, rng = robot.sagittal, robot.model, np.random.default_rng(8)
    data, rows = model.createData(), []
    for _ in range(SAMPLES):
        joints = s.lower + rng.uniform(0.05, 0.95, 4) * (s.upper - s.lower)
        angles = s.link_angles(joints, rng.uniform(-0.3, 0.8))
        rates = rng.uniform(-RATE_RAD_S, RATE_RAD_S, 5)
        pin.ccrba(model, data, configuration(robot, angles), _velocity(robot, angles, rates))
        inertia, momentum = _planar(s, angles, rates)
        com = np.abs(data.com[0][[0, 2]] - com_from_toe(robot, angles)).max()
        rows.append((com, data.Ig.inertia[1, 1] - inertia, data.hg.angular[1] - momentum))
    return np.array([abs(robot.total_mass - s.total_mass), *np.abs(rows).max(axis=0)])


def _planar(s: SagittalModel, angles: np.ndarray, rates: np.ndarray) -> tuple[float, float]:
    """Pitch inertia and angular momentum about the CoM of the five links; vectors as x + iz, turned by exp(-ia)."""
    arms, turn = s.com_arms() @ [1, 1j], np.exp(-1j * angles)
    r, v = (x - s.mass @ x / s.total_mass for x in (arms @ turn, arms @ (-1j * rates * turn)))
    return s.inertia.sum() + s.mass @ np.abs(r) ** 2, s.inertia @ rates - s.mass @ (r.conj() * v).imag


def _velocity(robot: Robot, angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Rates (nv,) of the full robot: toe at rest, links turning at ``rates``."""
    s, model, turn = robot.sagittal, robot.model, np.exp(-1j * angles[:4])
    v = np.zeros(model.nv)
    base = np.array([*s.span[:3], s.base]) @ [1, 1j] @ (-1j * rates[:4] * turn) / turn[3]
    v[0], v[2], v[4] = base.real, base.imag, rates[3]
    joints = s.joint_angles(rates)
    for name, row, sign in robot.role_signs():
        v[model.idx_vs[model.getJointId(name)]] = sign * joints[row]
    return v
