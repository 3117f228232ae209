"""Guards for what URDF parsers accept in silence: structure, inertials, units and limits, each in
one sentence.

Every function yields sentences ``file: element: value, limit; what to do``, so that all faults of a
file can be listed; :func:`read_tree` raises on the first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.errors import RobotError
from jumplab.robot.changes import MOMENTS
from jumplab.robot_import.urdf import (
    FRAME_KG,
    LIMITS,
    MOVING,
    OWN,
    SIZES,
    Joint,
    Tree,
    finite,
    mass_of,
    numbers,
    parse,
    repaired,
    slight,
    tensor_of,
    unsolid,
)
from jumplab.robot_import.write import listed

TYPES = (*MOVING, "fixed", "floating", "planar")
# what a humanoid can have; the paper prints none of these numbers
MASSES_KG = (0.5, 400.0)  # hand-sized, to twice the heaviest published one
SIZES_M = (0.1, 5.0)  # longest chain of joints in the neutral pose, likewise
MOST_LINKS = 1000  # several times a humanoid's with two hands
GYRATION_M = 1.0  # of one link; the longest published limb link has 0.2 m
MOST_NM = 2000.0  # five times the strongest published electric humanoid joint
# twice the fastest published humanoid pitch joint; above it, deg/s or a placeholder
MOST_RAD_S = 60.0
MOST_RAD = 4 * np.pi  # two turns; beyond them, degrees or a placeholder
MOST_TURN_RAD = 6.5  # of an origin, a little more than a turn
DEGREES_RAD = 0.12  # a whole turn, 6.28 rad, that is taken in degrees
# of a motor: unit, the most that is meant, what more of it is, what to give
MOTOR_LIMITS = {
    "effort": ("N m", MOST_NM, "a placeholder", "peak torque"),
    "velocity": ("rad/s", MOST_RAD_S, "deg/s or a placeholder", "speed limit in rad/s"),
}
CYCLE = ": each robot needs one link without a parent"  # that has no root
# why a joint of an MJCF has none
IN_MJCF = {
    "lower": "has no range",
    "upper": "has no range",
    "effort": "no actuator on it has a forcerange, or a motor's ctrlrange",
    "velocity": "MJCF has no speed limits",
}


def read_tree(
    text: str, where: str, path: Path | None = None, repair: Collection[str] = ()
) -> Tree:
    """The tree of a URDF's text; raises :class:`RobotError` with the first of :func:`faults`.

    ``where`` names the file in messages, ``repair`` (words) as there; meshes are near ``path``.
    """
    root = parse(text, where)
    for sentence in faults(root, where, repair):
        raise RobotError(sentence)
    tree = Tree(root, where, path, "inertia" in repair)
    tree.text = text
    return tree


def faults(root: ET.Element, where: str, repair: Collection[str] = ()) -> list[str]:
    """Faults of the whole file: of names and connections, else of inertials, else of units, else of
    shapes.

    ``repair`` may name "inertia" (tensors that no solid has) and "massless" (bodies without mass):
    these are no faults then.
    """
    links = root.findall("link")
    out = _structure_faults(links, root.findall("joint")) or _named(links, _inertial_faults)
    if not out:  # what follows reads what is refused there
        tree = Tree(root, where, repair_inertia=True)
        most = np.inf if "inertia" in repair else slight(root)
        low, high = SIZES_M  # beyond them, the lengths are wrong, which is found below
        size = length_of(tree)
        longest = min(GYRATION_M, size) if low <= size <= high else GYRATION_M
        out = _named(links, partial(_tensor_faults, most=most, longest=longest))
        out += _massless_bodies(tree) if "massless" not in repair else ()
        out += _named(links, _shape_faults)
        out = out or _unit_faults(tree)
    return [f"{where}: {sentence}" for sentence in out]


def _named(
    elements: list[ET.Element], faults_of: Callable[[ET.Element], Iterable[str]]
) -> list[str]:
    """The faults of all elements, behind what they are called."""
    return [f"{e.tag} {e.get('name')!r}: {fault}" for e in elements for fault in faults_of(e)]


def notes(tree: Tree) -> Iterator[str]:
    """Notes on a URDF without faults: leftovers that are ignored, harmless defects that are
    repaired, and what was found on the way.
    """
    for element in tree.xml:
        if "xacro" in element.tag:
            name = element.tag.rpartition("}")[2]
            yield f"the call <{name}> of a xacro macro is left over, and ignored"
    yield from (note.get("text") for note in tree.xml.findall("note"))
    points = []
    for name, link in tree.elements.items():
        if any(numbers(x.get("radius"), 1) == 0 for x in link.findall("collision/geometry/sphere")):
            yield f"link {name!r}: a sphere of radius 0 is taken as a point"
        if mass_of(link) >= FRAME_KG and 0 < (gap := unsolid(tensor_of(link))) <= tree.mended:
            if np.any(tensor_of(link)):
                yield (
                    f"link {name!r}: its inertia, which no solid has, is replaced by the nearest, "
                    f"{gap:.2g} kg m^2 apart"
                )
            else:
                points.append(name)
    if points:
        yield f"the inertias of {listed(points)} are 0: their masses count as points"
    moving = [joint for joint in tree.joints.values() if joint.kind in MOVING]
    followers = {}  # leader -> joints
    for joint in tree.joints.values():
        if joint.mimic:
            followers.setdefault(joint.mimic[0], []).append(joint.name)
    for leader, names in followers.items():
        lost = "" if leader in tree.joints else ", which does not exist"
        yield f"{_joints(names, 'follows', 'follow')} {leader!r}{lost}: held"
    still = [joint.name for joint in moving if joint.limits.get("effort") == 0 and not joint.mimic]
    if still:
        yield f"{_joints(still, 'has', 'have')} no motor (effort = 0): held"
    yield from _losses(moving)
    yield from dict.fromkeys(tree.notes)


def _joints(names: list[str], one: str, many: str) -> str:
    """Names with a verb."""
    return f"joint {names[0]!r} {one}" if len(names) == 1 else f"the joints {listed(names)} {many}"


def _losses(moving: list[Joint]) -> Iterator[str]:
    """Which of armature, friction and damping the file has, and which cannot be."""
    wrong = {}  # (key, text) -> joints
    for joint in moving:
        dynamics = joint.element.find("dynamics")
        for key, text in dynamics.items() if dynamics is not None else ():
            if key in OWN and finite(dynamics, (key,)).get(key, -1.0) < 0:
                wrong.setdefault((key, text), []).append(joint.name)
    for (key, text), joints in wrong.items():
        yield f"{key} = {text!r} of {listed(joints)} must be a number of 0 or more: not used"
    used = Counter(key for joint in moving for key in joint.losses)
    if used:
        counts = ", ".join(f"{key} of {used[key]} joints" for key in OWN if used[key])
        yield f"the file has losses of the motors: {counts}"


def _triples(element: ET.Element | None, name: str, *keys: str) -> Iterator[str]:
    """Attributes that are there, but are not three numbers."""
    for key in keys if element is not None else ():
        text = element.get(key)
        if text is not None and numbers(text, 3) is None:
            yield f"{name} {key} = {text!r} must be three finite numbers"


# structure
# --------------------------------------------------------------------------------------------------
def _structure_faults(links: list[ET.Element], joints: list[ET.Element]) -> list[str]:
    """Names, connections and joint types."""
    if not links:
        return ["has no <link>; a robot needs a trunk, legs and feet"]
    if not joints:
        return [f"has {len(links)} links and no <joint>; nothing can move"]
    if len(links) > MOST_LINKS:
        return [f"has {len(links)} links, a humanoid at most {MOST_LINKS}; give the file of one"]
    doubtful = []
    for (kind, name), times in Counter((e.tag, e.get("name")) for e in links + joints).items():
        if not name:
            doubtful.append(f"{times} <{kind}> without a name; give each its own")
        elif times > 1:
            doubtful.append(f"{kind} {name!r} is defined {times} times; keep one")
    names = {link.get("name") for link in links}
    wrong = _named(joints, partial(_joint_faults, links=names)) or _named(joints, _mimic_faults)
    return doubtful + (wrong or list(_tree_faults(names, joints)))


def _joint_faults(joint: ET.Element, links: set) -> Iterator[str]:
    kind = joint.get("type")
    ends = []
    for end in ("parent", "child"):
        element = joint.find(end)
        link = None if element is None else element.get("link")
        if not link:
            yield f"has no {end} link; add <{end} link=...>"
        elif link not in links:
            yield f"its {end} link {link!r} does not exist; correct the name"
        ends.append(link)
    if ends[0] and ends[0] == ends[1]:
        yield f"joins the link {ends[0]!r} to itself; correct parent or child"
    if kind not in TYPES:
        yield f"type {kind!r} is unknown; URDF has {', '.join(TYPES)}"
    origin = joint.find("origin")
    yield from _triples(origin, "origin", "xyz", "rpy")
    turn = None if origin is None else numbers(origin.get("rpy"), 3)
    if turn is not None and np.abs(turn).max() > MOST_TURN_RAD:
        yield f"origin rpy = {origin.get('rpy')!r} is beyond a turn: degrees? give rad"
    axis = joint.find("axis")
    if kind in MOVING and axis is not None:
        text = axis.get("xyz")
        direction = numbers(text, 3)
        if direction is None:
            yield f"axis xyz = {text!r} must be three finite numbers"
        elif np.linalg.norm(direction) < 1e-6:
            yield f"axis xyz = {text!r} has no direction; give a unit vector"


def _mimic_faults(joint: ET.Element) -> Iterator[str]:
    mimic = joint.find("mimic")
    for key in ("multiplier", "offset") if mimic is not None else ():
        if numbers(mimic.get(key, "0"), 1) is None:
            yield f"mimic {key} = {mimic.get(key)!r} must be a finite number"


def _tree_faults(names: set, joints: list[ET.Element]) -> Iterator[str]:
    above = {}  # child -> its joints and their parents
    for joint in joints:
        child, parent = (joint.find(end).get("link") for end in ("child", "parent"))
        above.setdefault(child, {})[joint.get("name")] = parent
    for link, hanging in above.items():
        if len(hanging) > 1:
            yield (
                f"link {link!r} hangs on {len(hanging)} joints "
                f"({listed(hanging)}): a closed loop; cut it to leave a tree"
            )
            return
    roots = sorted(names - set(above))
    if len(roots) > 1:
        yield (
            f"{len(roots)} links have no parent ({listed(roots)}), Pinocchio "
            f"keeps one tree and drops the rest; connect them"
        )
        return
    below = list(roots)
    for link in below:
        below += [child for child, hanging in above.items() if link in hanging.values()]
    if lost := listed(sorted(names - set(below))):
        end = f" apart from the root {roots[0]!r}" if roots else CYCLE
        yield f"the links {lost} form a cycle{end}"


# inertials
# --------------------------------------------------------------------------------------------------
def _inertial_faults(link: ET.Element) -> Iterator[str]:
    inertial = link.find("inertial")
    if inertial is None:
        return
    mass = inertial.find("mass")
    tensor = inertial.find("inertia")
    if mass is None:
        yield "<inertial> has no <mass>, which Pinocchio reads as no inertial at all; add it"
    elif (value := numbers(mass.get("value"), 1)) is None:
        yield f"mass = {mass.get('value')!r} must be a finite number of kg"
    elif value[0] < 0:
        yield f"mass = {value[0]:g} kg must not be negative; correct <mass>"
    else:
        yield from _triples(inertial.find("origin"), "inertial origin", "xyz", "rpy")
        if tensor is None:
            yield "<inertial> has no <inertia>; add the six numbers in kg m^2"
        elif wrong := [key for key in MOMENTS if numbers(tensor.get(key), 1) is None]:
            text = tensor.get(wrong[0])
            yield f"{wrong[0]} = {text!r} must be a finite number of kg m^2"


def _tensor_faults(link: ET.Element, most: float, longest: float) -> Iterator[str]:
    """Of an inertia farther than ``most`` [kg m^2] from a solid's, or too large: with a radius of
    gyration above ``longest`` [m], which no repair mends.
    """
    mass = mass_of(link)
    if mass < FRAME_KG:
        return
    matrix = tensor_of(link)
    gap = unsolid(matrix)
    low, middle, high = np.linalg.eigvalsh(repaired(matrix) if 0 < gap <= most else matrix)
    remedy = (
        "correct <inertia>, or let it be repaired: --repair inertia, or [source] repair = "
        '["inertia"]'
    )
    gyration = np.sqrt(abs(high) / mass)
    if low <= 0 and gap > most:
        yield f"principal moment of inertia {low:.3g} kg m^2 must be positive; {remedy}"
    elif gap > most:
        yield (
            f"principal moments {low:.3g}, {middle:.3g}, {high:.3g} kg m^2: the largest must "
            f"not exceed the sum of the others, no solid has this; {remedy}"
        )
    elif gyration > longest:
        yield (
            f"moment of inertia {high:.3g} kg m^2 on {mass:g} kg is a radius of gyration of "
            f"{gyration:.3g} m, at most {longest:.3g} is likely; is it in g mm^2 or kg cm^2?"
        )


def _massless_bodies(tree: Tree) -> Iterator[str]:
    """Joints that move no mass themselves, though what hangs on them has some; but for those of a
    body with several, and of the base, which is free however it is joined to the world.
    """
    remedy = 'or let it have a gram: --repair massless, or [source] repair = ["massless"]'
    for joint in tree.joints.values():
        link = tree.elements[joint.child]
        carried = tree.carried(joint.child)
        weighs = tree.body_of(joint.child).mass > 0 or link.get("between")
        if joint.kind == "fixed" or weighs or not carried or np.isclose(carried, tree.mass):
            continue
        fault = f"mass = 0 kg, the body of joint {joint.name!r} must weigh more than 0 kg"
        if link.find("inertial") is None:
            fault = (
                f"has no <inertial>, and nothing fixed to it has: Pinocchio reads 0 kg, PyBullet "
                f"1 kg; joint {joint.name!r} needs a body of more than 0 kg"
            )
        yield f"link {joint.child!r}: {fault}, {remedy}"


# units and shapes
# -----------------------------------------------------------------------------------------------
def _unit_faults(tree: Tree) -> Iterator[str]:
    """Total mass and size that no humanoid has in kg and m."""
    for value, (low, high), sentence, few, many in (
        (
            tree.mass,
            MASSES_KG,
            "weighs {:g} kg, a humanoid {:g} to {:g}; are the masses in {}",
            "tonnes, or are inertials missing?",
            "grams? divide by 1000",
        ),
        (
            length_of(tree),
            SIZES_M,
            "the longest chain of joints measures {:g} m, a humanoid's {:g} to {:g}; are the "
            "origins in {}",
            "kilometres, or are the origins missing?",
            "millimetres? divide by 1000",
        ),
    ):
        if not low <= value <= high:
            yield sentence.format(value, low, high, many if value > high else few)
    turns = [
        joint.limits["upper"] - joint.limits["lower"]
        for joint in tree.joints.values()
        if joint.kind == "revolute" and {"lower", "upper"} <= set(joint.limits)
    ]
    widest = max(map(abs, turns), default=0.0)
    if tree.format == "MJCF" and 0 < widest < DEGREES_RAD:
        yield (
            f"the widest range of a joint is {widest:.2g} rad; an MJCF has its "
            f'angles in degrees: if these are in rad, add <compiler angle="radian"/>'
        )


def length_of(tree: Tree) -> float:
    """The longest chain of joints [m]."""
    chains = map(tree.chain, tree.elements)
    return max(sum(np.linalg.norm(j.place.translation) for j in chain) for chain in chains)


def _shape_faults(link: ET.Element) -> Iterator[str]:
    """Sizes that no shape has, places that are no numbers, meshes without a file."""
    for origin in link.findall("collision/origin"):
        yield from _triples(origin, "collision origin", "xyz", "rpy")
    for shape in link.findall("collision/geometry/*"):
        for key, count in SIZES.get(shape.tag, {}).items():
            values = numbers(shape.get(key), count)
            least = 0.0 if shape.tag == "sphere" else np.nextafter(0.0, 1.0)
            if values is None or min(values) < least:
                wanted = "three positive numbers" if count == 3 else "a positive number"
                yield f"{shape.tag} {key} = {shape.get(key)!r} must be {wanted} of m"
        if shape.tag == "mesh" and not shape.get("vertex"):
            if not shape.get("filename"):
                yield "a collision mesh has no filename; add it, or remove the shape"
            yield from _triples(shape, "mesh", "scale")


# limits
# --------------------------------------------------------------------------------------------------
def limit_faults(
    tree: Tree, joint: str, given: Mapping[str, float] = MappingProxyType({}), table: str = ""
) -> Iterator[str]:
    """The faults of the limits of one joint that the jump uses, in one sentence, if there are any.

    ``given`` as of :func:`wrong_limits`; the sentence advises the ``table`` of the configuration
    that can hold them.
    """
    if wrong := wrong_limits(tree, joint, given):
        link = ";" if tree.format == "MJCF" else ", or"
        keys = ", ".join(sorted(wrong, key=LIMITS.index))
        advice = f"{link} give {keys} in [{table}] of the configuration" if table else ""
        sentences = "; ".join(dict.fromkeys(wrong.values()))
        yield f"{tree.where}: joint {joint!r}: {sentences}{advice}"


def wrong_limits(
    tree: Tree, joint: str, given: Mapping[str, float] = MappingProxyType({})
) -> dict[str, str]:
    """Limits of a joint that cannot be meant, or are missing, and what is wrong with each.

    ``given`` values [rad, N m, rad/s] go before those of the file.
    """
    limit = tree.joints[joint].element.find("limit")
    texts = {} if limit is None else limit.attrib
    values = tree.joints[joint].limits | given
    absent = [key for key in LIMITS if key not in values and key not in texts]
    names = ", ".join(absent)
    them = "it" if len(absent) == 1 else "them"
    lacking = f"<limit> has no {names}, which Pinocchio reads as 0; add {them}"
    if limit is None:
        lacking = f"has no <limit>; add {names}"
    wrong = {key: IN_MJCF[key] if tree.format == "MJCF" else lacking for key in absent}
    for key in LIMITS:
        if key not in values and key in texts:
            wrong[key] = f"{key} = {texts[key]!r} must be a finite number"
    if sentence := {"lower", "upper"} <= set(values) and _range_fault(**values):
        wrong |= {"lower": sentence, "upper": sentence}
    for key, (unit, most, what, remedy) in MOTOR_LIMITS.items():
        value = values.get(key, 1.0)
        fault = "must be positive" if value <= 0 else f"is above {most:g}: {what}"
        if not 0 < value <= most:
            wrong[key] = f"{key} = {value:g} {unit} {fault}; give the {remedy}"
    return wrong


def _range_fault(lower: float, upper: float, **_: float) -> str:
    """Fault of a range [rad], in words; "" if it has none."""
    span = f"range {lower:g} ... {upper:g} rad is"
    if max(abs(lower), abs(upper)) > MOST_RAD:
        return f"{span} beyond {MOST_RAD:.1f}: degrees or a placeholder; give the real range in rad"
    if lower > upper:
        return f"lower = {lower:g} rad is above upper = {upper:g} rad; swap them"
    return f"{span} empty; give the real range" if lower == upper else ""
