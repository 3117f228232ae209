"""Other limits, masses and legs in the text of a robot's URDF, and a remark on each for its TOML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.errors import RobotError, quoted
from jumplab.robot.sagittal import SAGITTAL_JOINTS
from jumplab.robot_import.config import ROLES

if TYPE_CHECKING:
    from jumplab.robot.description import Robot

ATTRIBUTES = {"effort": "effort", "speed": "velocity", "lower": "lower", "upper": "upper"}  # of a URDF's <limit>
UNITS = {"effort": "N m", "speed": "rad/s", "lower": "rad", "upper": "rad"}
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def limits(robot: Robot, factors: Mapping, ranges: Mapping) -> tuple[str, list[str]]:
    """The URDF with other limits, and the remarks: none where nothing changes.

    Parameters
    ----------
    factors : "effort", "speed" -> factor, or joint or role -> factor.  ranges : joint or role -> lower, upper [rad].

    Raises :class:`RobotError` as :meth:`.Robot.with_limits` says.
    """
    new: dict[str, dict[str, float]] = {name: {} for name in robot.joint_names}
    for what, given in factors.items():
        one_each = isinstance(given, Mapping)
        told = given if one_each else dict.fromkeys(robot.joint_names, given)
        for key, names in _joints(robot, told, f"the factors on {what}"):
            whose = f"{what} of {key!r}" if one_each else what
            factor = _number(robot, f"the factor on {whose}", told[key], positive=True)
            for name in names:
                new[name][what] = robot.actuators[name][what] * factor
    signs = {name: sign for name, _, sign in robot.role_signs()}
    for key, names in _joints(robot, ranges, "the ranges"):
        for end, angle in _ends(robot, key, ranges[key]).items():
            for name in names:
                other = key not in robot.joint_names and signs[name] < 0  # it turns against its role
                new[name][{"lower": "upper", "upper": "lower"}[end] if other else end] = -angle if other else angle
    root, remarks = _parsed(robot), []
    for joint in root.findall("joint"):
        name = joint.get("name")
        for what, value in new.get(name, {}).items():
            old, text = robot.actuators[name][what], f"{value:.12g}"
            if float(text) != old:
                joint.find("limit").set(ATTRIBUTES[what], text)
                remarks.append(f"{what} of joint {name!r}, {old:.12g} -> {text} {UNITS[what]}")
    return _text(root), remarks


def masses(
    robot: Robot, links: str | Sequence[str] | None, mass_kg: float | None, factor: float | None
) -> tuple[str, list[str]]:
    """The URDF with other masses, inertias scaled alike, and the remarks: none where nothing changes.

    Raises :class:`RobotError` as :meth:`.Robot.with_mass` says.
    """
    if (mass_kg is None) == (factor is None):
        raise RobotError(f"robot {robot.name}: a mass is changed by mass_kg or by factor, give one of them")
    root, remarks = _parsed(robot), []
    bodies = _bodies(root)
    if links is None:
        links = [name for name, parts in bodies.items() if any(float(x.find("mass").get("value")) > 0 for x in parts)]
    names = links if isinstance(links, list | tuple) and links else [links]
    for link in names:
        if not isinstance(link, str) or link not in bodies:
            known = ", ".join(bodies)
            raise RobotError(f"robot {robot.name}: there is no link {quoted(link)} to weigh otherwise; it has {known}")
    for link in dict.fromkeys(names):
        parts = bodies[link]
        old = sum(float(part.find("mass").get("value")) for part in parts)
        if not old > 0:
            raise RobotError(f"robot {robot.name}: the link {link!r} has no mass, so its inertia cannot scale with it")
        if factor is None:
            share = _number(robot, f"mass_kg of {link!r}", mass_kg, positive=True) / old
        else:
            share = _number(robot, f"the factor on the mass of {link!r}", factor, positive=True)
        if f"{old * share:.12g}" != f"{old:.12g}":
            for part in parts:
                scale(part.find("mass"), ("value",), share)
                scale(part.find("inertia"), MOMENTS, share)
            remarks.append(f"mass of link {link!r}, {old:.12g} -> {old * share:.12g} kg")
    return _text(root), remarks


def legs(robot: Robot, factor: float) -> tuple[str, list[str]]:
    """The URDF with longer or shorter thighs and shanks, stretched from their joint on to the next, and the remarks.

    Raises :class:`RobotError` as :meth:`.Robot.with_legs` says.
    """
    factor = _number(robot, "the factor on the legs", factor, positive=True)
    root, remarks = _parsed(robot), []
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    links = {link.get("name"): link for link in root.findall("link")}
    for here, there in pairwise(ROLES[:3]):
        for name, end in zip(robot.joints[here], robot.joints[there], strict=True):
            link = joints[name].find("child").get("link")
            way = np.array(joints[end].find("origin").get("xyz").split(), float)
            turned = [x.get("rpy") for x in (*links[link].iter("origin"), joints[end].find("origin"))]
            upright = not np.any([np.array(x.split(), float) for x in turned if x])
            if joints[end].find("parent").get("link") != link or not upright or abs(way[2]) < np.abs(way).max():
                said = f"robot {robot.name}: the link {link!r} does not run along its own z"
                raise RobotError(f"{said}; stretch it in its URDF")
            if factor != 1.0:
                _stretched(links[link], [j for j in joints.values() if j.find("parent").get("link") == link], factor)
                remarks.append(f"length of link {link!r}, {abs(way[2]):.12g} -> {abs(way[2]) * factor:.12g} m")
    return _text(root), remarks


def _stretched(link: ET.Element, joints: Sequence[ET.Element], factor: float) -> None:
    """A link along its z, in place: its mass stays, and spreads as the shapes do."""
    for origin in (*link.iter("origin"), *(joint.find("origin") for joint in joints)):
        x, y, z = map(float, origin.get("xyz").split())
        origin.set("xyz", f"{x:.12g} {y:.12g} {factor * z:.12g}")
    for box in link.iter("box"):
        *sides, height = map(float, box.get("size").split())
        box.set("size", " ".join(f"{x:.12g}" for x in (*sides, factor * height)))
    moments = link.find("inertial/inertia")
    xx, yy, zz = (float(moments.get(key)) for key in ("ixx", "iyy", "izz"))
    along = (xx + yy - zz) / 2  # the mass' second moment along z
    moments.set("ixx", f"{xx + (factor**2 - 1) * along:.12g}")
    moments.set("iyy", f"{yy + (factor**2 - 1) * along:.12g}")
    scale(moments, ("ixz", "iyz"), factor)


def _bodies(root: ET.Element) -> dict[str, list[ET.Element]]:
    """Link -> its <inertial>; of an imported trunk, written as two links, both."""
    fixed = {j.get("name"): j.find("child").get("link") for j in root.findall("joint") if j.get("type") == "fixed"}
    found = {link.get("name"): link.findall("inertial") for link in root.findall("link")}
    for name in list(found):
        if fixed.get(f"{name}_rest_fixed") == f"{name}_rest":
            found[name] += found.pop(f"{name}_rest")
    return found


def _joints(robot: Robot, told: Mapping, where: str) -> list[tuple[str, Sequence[str]]]:
    """(name as told, its joints), roles before joints, so that a joint's own number comes last and counts."""
    if not isinstance(told, Mapping):
        raise RobotError(f"robot {robot.name}: {where} must be a mapping from joints or roles, got {quoted(told)}")
    roles = dict(zip(SAGITTAL_JOINTS, ROLES, strict=True)) | dict(zip(ROLES, ROLES, strict=True))
    found = []
    for key in told:
        if key in robot.joint_names:
            found.append((key, (key,)))
        elif key not in roles:
            known = f"{', '.join(SAGITTAL_JOINTS)}, or the joints {', '.join(robot.joint_names)}"
            raise RobotError(f"robot {robot.name}: {where} name {quoted(key)}, which is none of the roles {known}")
        elif not robot.joints[roles[key]]:
            raise RobotError(f"robot {robot.name}: {where} name {key!r}, a role without joints: its arms are held")
        else:
            found.insert(0, (key, robot.joints[roles[key]]))
    return found


def _ends(robot: Robot, key: str, told: Any) -> dict[str, float]:
    """lower, upper [rad], those that are told."""
    if not isinstance(told, Mapping) or not told or not set(told) <= {"lower", "upper"}:
        raise RobotError(f"robot {robot.name}: the range of {key!r} has lower and upper [rad], got {quoted(told)}")
    return {end: _number(robot, f"{end} of {key!r} [rad]", angle) for end, angle in told.items()}


def _number(robot: Robot, what: str, value: Any, positive: bool = False) -> float:
    good = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not good or not np.isfinite(value) or (positive and not value > 0):
        wanted = "a positive number" if positive else "a finite number"
        raise RobotError(f"robot {robot.name}: {what} must be {wanted}, got {quoted(value)}")
    return float(value)


def scale(element: ET.Element, attributes: Sequence[str], factor: float) -> None:
    """Multiply numbers of an element, in place, written with twelve digits."""
    for key in attributes:
        element.set(key, f"{float(element.get(key)) * factor:.12g}")


def _parsed(robot: Robot) -> ET.Element:
    return ET.fromstring(robot.urdf, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))


def _text(root: ET.Element) -> str:
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'
