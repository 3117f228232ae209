"""Other limits, masses and legs in the text of a robot's URDF, and a remark on each for its TOML
file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import numpy as np
import tomlkit

from jumplab.arguments import real
from jumplab.errors import InputError, nearest, quoted
from jumplab.robot.files import LEG, ROLES
from jumplab.robot.sagittal import SAGITTAL_JOINTS

if TYPE_CHECKING:
    from jumplab.robot.description import Robot

MOST = 1e9  # factor or number of a changed robot
UNITS = {"effort": "N m", "speed": "rad/s", "lower": "rad", "upper": "rad"}
ENDS = {"lower": "upper", "upper": "lower"}  # of a range, and the other one
GEARED = {"armature": 2, "friction": 1, "damping": 2}  # powers of a gear's ratio that they go with
# [kg m^2 / (N m)^1.5] armature over peak torque^1.5: by gears alone it grows with the square of the
# torque, with larger motors more slowly; the G1's three motors give 1.7e-5 to 2.9e-5
ROTORS = 2.2e-5, 1.5
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def limits(robot: Robot, factors: Mapping, ranges: Mapping) -> tuple[str, list[str], str]:
    """The URDF with other limits, the remarks (none where nothing changes), and the TOML with other
    efforts of joints that are held.

    Parameters
    ----------
    factors : "effort", "speed" -> factor, or joint or role -> factor.  ranges : joint or role ->
        lower, upper [rad], effort [N m], speed [rad/s].

    Raises :class:`RobotError` as :meth:`.Robot.with_limits` says.
    """
    held = {joint.name: {"effort": joint.effort} for joint in robot.locked}
    old = {name: robot.actuators[name] for name in robot.joint_names} | held
    new: dict[str, dict[str, float]] = {name: {} for name in old}
    for what, given in factors.items():
        if not isinstance(given, Mapping):
            factor = _number(robot, f"the factor on {what}", given)
            given = dict.fromkeys((name for name in old if what in old[name]), factor)
        for key, names in _joints(robot, given, f"the factors on {what}", held):
            _check_held(robot, key, what, held)
            factor = _number(robot, f"the factor on {what} of {key!r}", given[key])
            for name in names:
                new[name][what] = old[name][what] * factor
    signs = {name: sign for name, _, sign in robot.role_signs()}
    for key, names in _joints(robot, ranges, "the ranges", held):
        asked = ranges[key]
        if not (isinstance(asked, Mapping) and asked and set(asked) <= set(UNITS)):
            raise robot.error(
                f"the limits of {key!r} must be a mapping of lower, upper [rad], effort [N m] or "
                f"speed [rad/s], got {quoted(asked)}"
            )
        for end, value in asked.items():
            _check_held(robot, key, end, held)
            what = f"{end} of {key!r} [{UNITS[end]}]"
            value = _number(robot, what, value, positive=end not in ENDS)
            for name in names:
                # it turns against its role
                turned = end in ENDS and key not in robot.joint_names and signs[name] < 0
                new[name][ENDS[end] if turned else end] = -value if turned else value
    root = _parsed(robot)
    remarks = _limited(root, {name: new[name] for name in robot.joint_names}, old)
    config_text = robot.config_text
    if held:
        config = tomlkit.parse(config_text)
        published = ET.fromstring(config["published"]["urdf"])
        if moved := _limited(published, {name: new[name] for name in held}, old):
            remarks += moved
            text = tomlkit.string(_text(published), multiline=True, literal=True)
            config["published"]["urdf"] = text
            config_text = tomlkit.dumps(config)
    return _text(root), remarks, config_text


def _limited(root: ET.Element, new: Mapping, old: Mapping) -> list[str]:
    """Set ``new`` limits of joints in a URDF that differ from ``old`` ones; a remark on each."""
    remarks = []
    for joint in root.findall("joint"):
        name = joint.get("name")
        for what, value in new.get(name, {}).items():
            before = old[name][what]
            text = f"{value:.12g}"
            if float(text) != before:
                joint.find("limit").set("velocity" if what == "speed" else what, text)
                remarks.append(f"{what} of joint {name!r}, {before:.12g} -> {text} {UNITS[what]}")
    return remarks


def _check_held(robot: Robot, key: str, what: str, held: Mapping) -> None:
    if key in held and what != "effort":
        raise robot.error(
            f"the {what} of joint {key!r} cannot change: it is held, so only its effort counts"
        )


def masses(
    robot: Robot, links: str | Sequence[str] | None, mass_kg: float | None, factor: float | None
) -> tuple[str, list[str]]:
    """The URDF with other masses [kg], inertias scaled alike, and the remarks: none where nothing
    changes.

    Raises :class:`RobotError` as :meth:`.Robot.with_mass` says.
    """
    if (mass_kg is None) == (factor is None):
        raise robot.error("give either mass_kg or factor to change a mass, and not both")
    root = _parsed(robot)
    remarks = []
    bodies = _bodies(root)
    weights = {
        link: sum(float(part.find("mass").get("value")) for part in parts)
        for link, parts in bodies.items()
    }
    if links is None:
        links = [link for link, mass in weights.items() if mass > 0]
    names = links if isinstance(links, list | tuple) and links else [links]
    for link in names:
        if not isinstance(link, str) or link not in bodies:
            raise robot.error(
                f"cannot change the mass of {quoted(link)}: there is no such link; it has "
                f"{nearest(bodies, link)}"
            )
    for link in dict.fromkeys(names):
        old = weights[link]
        if not old > 0:
            raise robot.error(f"the link {link!r} has no mass, so its inertia cannot scale with it")
        if factor is None:
            share = _number(robot, f"mass_kg of {link!r}", mass_kg) / old
        else:
            share = _number(robot, f"the factor on the mass of {link!r}", factor)
        if f"{old * share:.12g}" != f"{old:.12g}":
            for part in bodies[link]:
                scale(part.find("mass"), ("value",), share)
                scale(part.find("inertia"), MOMENTS, share)
            remarks.append(f"mass of link {link!r}, {old:.12g} -> {old * share:.12g} kg")
    return _text(root), remarks


def gears(robot: Robot, ratios: Mapping) -> str:
    """The TOML with what the motors take of other gears: joint or role -> factor on the ratio [1].

    Raises :class:`RobotError` as :meth:`.Robot.with_gears` says.
    """
    config = tomlkit.parse(robot.config_text)
    for key, names in _joints(robot, ratios, "the gears"):
        ratio = _number(robot, f"the factor on the gear of {key!r}", ratios[key])
        for name in names:
            for what, power in GEARED.items():
                if lost := robot.actuators[name][what]:
                    rows = config["actuators"].setdefault(what, {})
                    rows[name] = float(f"{lost * ratio**power:.12g}")
    return tomlkit.dumps(config)


def rotors(robot: Robot, factor: float) -> str:
    """The TOML with an estimated armature, ``factor`` [1] times :data:`ROTORS`, of motors that have
    none.

    Raises :class:`RobotError` as :meth:`.Robot.with_rotors` says.
    """
    scale, power = ROTORS
    factor = _number(robot, "the factor on rotors", factor)
    config = tomlkit.parse(robot.config_text)
    without = {name: x["effort"] for name, x in robot.actuators.items() if not x["armature"]}
    if not without:
        raise robot.error("the armature of all its motors is known; leave out with_rotors")
    rows = config["actuators"].setdefault("armature", {})
    rows |= {name: float(f"{factor * scale * x**power:.4g}") for name, x in without.items()}
    return tomlkit.dumps(config)


def legs(robot: Robot, factor: float, thigh: float, shank: float) -> tuple[str, list[str]]:
    """The URDF with thighs and shanks ``factor`` [1] times as long, each by its own besides,
    stretched from their joint on to the next, and the remarks.

    Raises :class:`RobotError` as :meth:`.Robot.with_legs` says.
    """
    both = _number(robot, "the factor on the legs", factor)
    factors = [
        both * _number(robot, f"the factor on the {part}", x)
        for part, x in (("thighs", thigh), ("shanks", shank))
    ]
    root = _parsed(robot)
    remarks = []
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    links = {link.get("name"): link for link in root.findall("link")}
    ends = [
        pair for roles in pairwise(LEG) for pair in zip(*map(robot.joints.get, roles), strict=True)
    ]
    for (name, end), factor in zip(ends, np.repeat(factors, 2), strict=True):
        link = joints[name].find("child").get("link")
        hanging = [j for j in joints.values() if j.find("parent").get("link") == link]
        origin = joints[end].find("origin")
        x, y, z = (abs(float(number)) for number in origin.get("xyz").split())
        origins = (*links[link].iter("origin"), origin)
        turns = " ".join(element.get("rpy", "") for element in origins).split()
        if joints[end] not in hanging or z < max(x, y) or any(map(float, turns)):
            raise robot.error(
                f"the link {link!r} does not run along its own z; stretch it in its URDF"
            )
        if factor != 1.0:
            _stretch(links[link], hanging, factor)
            remarks.append(f"length of link {link!r}, {z:.12g} -> {z * factor:.12g} m")
    return _text(root), remarks


def _stretch(link: ET.Element, joints: Sequence[ET.Element], factor: float) -> None:
    """A link along its z, in place: its mass stays, and spreads as the shapes do."""
    places = [(origin, "xyz") for x in (link, *joints) for origin in x.iter("origin")]
    for element, key in (*places, *((box, "size") for box in link.iter("box"))):
        x, y, z = map(float, element.get(key).split())
        element.set(key, f"{x:.12g} {y:.12g} {factor * z:.12g}")
    moments = link.find("inertial/inertia")
    xx, yy, zz = (float(moments.get(key)) for key in ("ixx", "iyy", "izz"))
    along = (xx + yy - zz) / 2  # the mass' second moment along z
    for key, moment in (("ixx", xx), ("iyy", yy)):
        moments.set(key, f"{moment + (factor**2 - 1) * along:.12g}")
    scale(moments, ("ixz", "iyz"), factor)


def _bodies(root: ET.Element) -> dict[str, list[ET.Element]]:
    """Link -> its <inertial>; of an imported trunk, written as two links, both."""
    bodies = {link.get("name"): link.findall("inertial") for link in root.findall("link")}
    fixed = {joint.get("name") for joint in root.findall("joint[@type='fixed']")}
    for name in list(bodies):
        if f"{name}_rest_fixed" in fixed and f"{name}_rest" in bodies:
            bodies[name] += bodies.pop(f"{name}_rest")
    return bodies


def _joints(
    robot: Robot, given: Mapping, where: str, held: Sequence[str] = ()
) -> list[tuple[str, Sequence[str]]]:
    """(name as given, its joints); roles come first, so that a joint's own number counts."""
    if not isinstance(given, Mapping):
        raise robot.error(f"{where} must be a mapping from joints or roles, got {quoted(given)}")
    roles = dict(zip((*SAGITTAL_JOINTS, *ROLES), ROLES * 2, strict=True))
    pairs = []
    for key in given:
        if key in robot.joint_names or key in held:
            pairs.append((key, (key,)))
        elif key not in roles:
            raise robot.error(
                f"{where} name {quoted(key)}, which is neither a role "
                f"({', '.join(SAGITTAL_JOINTS)}) nor a joint ({nearest(robot.joint_names, key)})"
            )
        elif not robot.joints[roles[key]]:
            raise robot.error(
                f"{where} name {key!r}, but no joint has this role: the arms are held; leave it out"
            )
        else:
            pairs.insert(0, (key, robot.joints[roles[key]]))
    return pairs


def _number(robot: Robot, what: str, value: Any, positive: bool = True) -> float:
    try:
        number = real(value, what)
    except InputError:
        number = math.inf
    if not abs(number) < MOST or (positive and not number > 0):
        wanted = "a positive number" if positive else "a finite number"
        raise robot.error(f"{what} must be {wanted}, got {quoted(value)}")
    return number


def scale(element: ET.Element, attributes: Sequence[str], factor: float) -> None:
    """Multiply numbers of an element, in place, written with twelve digits; ``factor`` [1]."""
    for key in attributes:
        element.set(key, f"{float(element.get(key)) * factor:.12g}")


def _parsed(robot: Robot) -> ET.Element:
    return ET.fromstring(robot.urdf, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))


def _text(root: ET.Element) -> str:
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'
