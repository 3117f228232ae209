"""Guards for what URDF parsers accept in silence: structure, inertials, units and limits, each in one sentence.

Every function yields sentences ``file: element: value, limit; what to do``, so that all faults of a file can be listed;
:func:`check` raises on the first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.errors import RobotError
from jumplab.robot_import.urdf import FRAME_KG, LIMITS, MOVING, SIZES, TENSOR, Tree, numbers, slight, tensor_of, unsolid

TYPES = (*MOVING, "fixed", "floating", "planar")


@dataclass(frozen=True)
class Plausible:
    """What a humanoid can have; the paper prints none of these numbers."""

    mass_kg: tuple[float, float] = (0.5, 400.0)  # hand-sized, to twice the heaviest published one
    size_m: tuple[float, float] = (0.1, 5.0)  # longest chain of joints in the neutral pose, likewise
    gyration_m: float = 1.0  # of one link; the longest published limb link has 0.2 m
    effort_nm: float = 2000.0  # five times the strongest published electric humanoid joint
    speed_rad_s: float = 60.0  # twice the fastest published humanoid pitch joint; above it, deg/s or a placeholder
    angle_rad: float = 4 * np.pi  # two turns; beyond them, degrees or a placeholder


PLAUSIBLE = Plausible()


def check(root: ET.Element, where: str, repair: Collection[str] = ()) -> None:
    """Raise :class:`RobotError` with the first fault of structure, inertials or size that is not to be repaired."""
    for sentence in faults(root, where, repair):
        raise RobotError(sentence)


def faults(root: ET.Element, where: str, repair: Collection[str] = ()) -> list[str]:
    """Faults of the whole file: of names and connections, else of inertials, else of units, else of shapes.

    ``repair`` may name "inertia" (tensors that no solid has) and "massless" (bodies without mass): these are no faults
    then.
    """
    found = _structure_faults(root, where)
    for link in root.findall("link") if not found else ():
        found += _inertial_faults(link, f"{where}: link {link.get('name')!r}")
    if found:  # what follows reads what was refused
        return found
    for link in root.findall("link") if "inertia" not in repair else ():
        found += _tensor_faults(link, f"{where}: link {link.get('name')!r}", slight(root))
    tree = Tree(root, where, repair_inertia=True)
    found += [] if "massless" in repair else _massless_bodies(tree)
    return found + list(_shape_faults(root, where)) or list(_unit_faults(tree))


def notes(root: ET.Element, repair: Collection[str] = ()) -> Iterator[str]:
    """What is left over in a URDF without faults, passed over or mended because no jump would notice."""
    for element in root:
        if "xacro" in str(element.tag):
            yield f"the call <{element.tag.rpartition('}')[2]}> of a xacro macro is left over, and passed over"
    for link in root.findall("link"):
        name, tensor, mass = link.get("name"), link.find("inertial/inertia"), link.find("inertial/mass")
        if any(numbers(x.get("radius"), 1) == 0 for x in link.findall("collision/geometry/sphere")):
            yield f"link {name!r}: a sphere of radius 0 is taken as a point"
        heavy = mass is not None and float(mass.get("value")) >= FRAME_KG
        if heavy and (gap := unsolid(tensor_of(tensor))) and ("inertia" in repair or gap <= slight(root)):
            yield f"link {name!r}: its inertia, which no solid has, is replaced by the nearest, {gap:.2g} kg m^2 apart"
    for joint in root.findall("joint/mimic/.."):
        yield f"joint {joint.get('name')!r} follows {joint.find('mimic').get('joint')!r}: held"
    for joint in root.findall("joint/limit[@effort]/.."):
        if joint.get("type") in MOVING and numbers(joint.find("limit").get("effort"), 1) == 0:
            yield f"joint {joint.get('name')!r} has no motor (effort = 0): held"


def _triple_faults(element: ET.Element | None, at: str, *keys: str) -> Iterator[str]:
    """Attributes that are there, but are not three numbers."""
    for key, text in element.items() if element is not None else ():
        if key in keys and numbers(text, 3) is None:
            yield f"{at} {key} = {text!r} must be three finite numbers"


# structure ------------------------------------------------------------------------------------------------------
def _structure_faults(root: ET.Element, where: str) -> list[str]:
    """Names, connections and joint types."""
    links, joints = root.findall("link"), root.findall("joint")
    if not links:
        return [f"{where}: has no <link>; a robot needs a trunk, legs and feet"]
    if not joints:
        return [f"{where}: has {len(links)} links and no <joint>; nothing can move"]
    names = {link.get("name") for link in links}
    doubtful = [*_name_faults(links, "link", where), *_name_faults(joints, "joint", where)]
    wrong = [sentence for joint in joints for sentence in _joint_faults(joint, names, where)]
    return doubtful + (wrong or list(_tree_faults(names, joints, where)))


def _name_faults(elements: list[ET.Element], kind: str, where: str) -> Iterator[str]:
    for name, times in Counter(e.get("name") for e in elements).items():
        if not name:
            yield f"{where}: {times} <{kind}> without a name; give each its own"
        elif times > 1:
            yield f"{where}: {kind} {name!r} is defined {times} times; keep one"


def _joint_faults(joint: ET.Element, links: set, where: str) -> Iterator[str]:
    at, kind, axis = f"{where}: joint {joint.get('name')!r}", joint.get("type"), joint.find("axis")
    ends = []
    for end in ("parent", "child"):
        element = joint.find(end)
        link = None if element is None else element.get("link")
        if not link:
            yield f"{at}: has no {end} link; add <{end} link=...>"
        elif link not in links:
            yield f"{at}: its {end} link {link!r} does not exist; correct the name"
        ends.append(link)
    if ends[0] and ends[0] == ends[1]:
        yield f"{at}: joins the link {ends[0]!r} to itself; correct parent or child"
    if kind not in TYPES:
        yield f"{at}: type {kind!r} is unknown; URDF has {', '.join(TYPES)}"
    yield from _triple_faults(joint.find("origin"), f"{at}: origin", "xyz", "rpy")
    if kind in MOVING and axis is not None:
        direction = numbers(axis.get("xyz"), 3)
        if direction is None:
            yield f"{at}: axis xyz = {axis.get('xyz')!r} must be three finite numbers"
        elif np.linalg.norm(direction) < 1e-6:
            yield f"{at}: axis xyz = {axis.get('xyz')!r} has no direction; give a unit vector"


def _tree_faults(names: set, joints: list[ET.Element], where: str) -> Iterator[str]:
    known = {j.get("name") for j in joints}
    ends = [(j.find("child").get("link"), j.find("parent").get("link"), j.get("name")) for j in joints]
    for joint in joints:
        mimic, at = joint.find("mimic"), f"{where}: joint {joint.get('name')!r}"
        if mimic is None:
            continue
        if mimic.get("joint") not in known:
            yield f"{at} mimics {mimic.get('joint')!r}, which does not exist; correct the name"
        for key in ("multiplier", "offset"):
            if numbers(mimic.get(key, "0"), 1) is None:
                yield f"{at}: mimic {key} = {mimic.get(key)!r} must be a finite number"
    for link, times in Counter(child for child, _, _ in ends).items():
        if times > 1:
            above = ", ".join(repr(name) for child, _, name in ends if child == link)
            yield f"{where}: link {link!r} hangs on {times} joints ({above}): a closed loop; cut it to leave a tree"
            return
    parent = {child: above for child, above, _ in ends}
    roots = sorted(names - set(parent))
    if not roots:
        yield f"{where}: no link is the root: the joints form a cycle; each robot needs one link without a parent"
    elif len(roots) > 1:
        said = f"{where}: {len(roots)} links have no parent ({', '.join(map(repr, roots[:4]))})"
        yield f"{said}, Pinocchio keeps one tree and drops the rest; connect them"
    else:
        seen, new = set(), {*roots}
        while new:
            seen |= new
            new = {link for link, above in parent.items() if above in new}
        if lost := sorted(names - seen):
            yield f"{where}: the links {', '.join(map(repr, lost[:4]))} form a cycle apart from the root {roots[0]!r}"


# inertials ------------------------------------------------------------------------------------------------------
def _inertial_faults(link: ET.Element, at: str) -> list[str]:
    inertial, mass, tensor = (link.find(path) for path in ("inertial", "inertial/mass", "inertial/inertia"))
    if inertial is None:
        return []
    if mass is None:
        return [f"{at}: <inertial> has no <mass>, which Pinocchio reads as no inertial at all; add it"]
    value = numbers(mass.get("value"), 1)
    if value is None:
        return [f"{at}: mass = {mass.get('value')!r} must be a finite number of kg"]
    if value[0] < 0:
        return [f"{at}: mass = {value[0]:g} kg must not be negative; correct <mass>"]
    found = [*_triple_faults(inertial.find("origin"), f"{at}: inertial origin", "xyz", "rpy")]
    if tensor is None:
        return [*found, f"{at}: <inertial> has no <inertia>; add the six numbers in kg m^2"]
    wrong = next((key for key in TENSOR if numbers(tensor.get(key), 1) is None), None)
    if wrong:
        found.append(f"{at}: {wrong} = {tensor.get(wrong)!r} must be a finite number of kg m^2")
    return found


def _tensor_faults(link: ET.Element, at: str, most: float) -> Iterator[str]:
    """Of a link's inertia, if it is farther than ``most`` [kg m^2] from one that a solid can have, or too large."""
    mass = 0.0 if link.find("inertial") is None else float(link.find("inertial/mass").get("value"))
    if mass < FRAME_KG:
        return
    matrix = tensor_of(link.find("inertial/inertia"))
    low, middle, high = np.linalg.eigvalsh(matrix)
    remedy = 'correct <inertia>, or let it be repaired: --repair inertia, or [source] repair = ["inertia"]'
    gyration, gap = np.sqrt(abs(high) / mass), unsolid(matrix)
    if low <= 0 and gap > most:
        yield f"{at}: principal moment of inertia {low:.3g} kg m^2 must be positive; {remedy}"
    elif gap > most:
        said = f"{at}: principal moments {low:.3g}, {middle:.3g}, {high:.3g} kg m^2"
        yield f"{said}: the largest must not exceed the sum of the others, no solid has this; {remedy}"
    elif gyration > PLAUSIBLE.gyration_m:
        said = f"{at}: moment of inertia {high:.3g} kg m^2 on {mass:g} kg is a radius of gyration of {gyration:.3g} m"
        yield f"{said}, at most {PLAUSIBLE.gyration_m:g} is likely; is it in g mm^2 or kg cm^2?"


def _massless_bodies(tree: Tree) -> Iterator[str]:
    """Joints that move a link without mass, and nothing fixed to it has any; but what hangs on it weighs something."""
    for joint in tree.joints.values():
        at, links = f"{tree.where}: link {joint.child!r}", [tree.links[name] for name in tree.fixed_to(joint.child)]
        if joint.kind == "fixed" or sum(link.inertia.mass for link in links) > 0 or not tree.carried(joint.child):
            continue
        if not tree.links[joint.child].weighed:
            read = f"{at}: has no <inertial>, and nothing fixed to it has: Pinocchio reads 0 kg, PyBullet 1 kg"
            yield f"{read}; joint {joint.name!r} needs a body of more than 0 kg"
        else:
            yield f"{at}: mass = 0 kg, the body of joint {joint.name!r} must weigh more than 0 kg"


# units and shapes -----------------------------------------------------------------------------------------------
def _unit_faults(tree: Tree) -> Iterator[str]:
    """Total mass and size that no humanoid has in kg and m."""
    mass, (low, high) = tree.mass, PLAUSIBLE.mass_kg
    if not low <= mass <= high:
        guess = "grams? divide by 1000" if mass > high else "tonnes, or are inertials missing?"
        yield f"{tree.where}: weighs {mass:g} kg, a humanoid {low:g} to {high:g}; are the masses in {guess}"
    size = max(sum(np.linalg.norm(joint.place.translation) for joint in tree.chain(link)) for link in tree.links)
    low, high = PLAUSIBLE.size_m
    if not low <= size <= high:
        guess = "millimetres? divide by 1000" if size > high else "kilometres, or are the origins missing?"
        said = f"{tree.where}: the longest chain of joints measures {size:g} m, a humanoid's {low:g} to {high:g}"
        yield f"{said}; are the origins in {guess}"


def _shape_faults(root: ET.Element, where: str) -> Iterator[str]:
    """Sizes that no shape has, places that are no numbers, meshes without a file."""
    for link in root.findall("link"):
        at = f"{where}: link {link.get('name')!r}"
        for collision in link.findall("collision"):
            yield from _triple_faults(collision.find("origin"), f"{at}: collision origin", "xyz", "rpy")
        for shape in link.findall("collision/geometry/*"):
            for key, count in SIZES.get(shape.tag, {}).items():
                values = numbers(shape.get(key), count)
                if values is None or np.any(values < 0) or (shape.tag != "sphere" and np.any(values == 0)):
                    wanted = "three positive numbers" if count == 3 else "a positive number"
                    yield f"{at}: {shape.tag} {key} = {shape.get(key)!r} must be {wanted} of m"
            if shape.tag == "mesh" and not shape.get("filename"):
                yield f"{at}: a collision mesh has no filename; add it, or remove the shape"
            yield from _triple_faults(shape if shape.tag == "mesh" else None, f"{at}: mesh", "scale")


# limits ---------------------------------------------------------------------------------------------------------
def limit_faults(joint: ET.Element, where: str, told: dict[str, float] | None = None) -> Iterator[str]:
    """Faults of the limits of one joint that the jump uses; ``told`` values go before those of the file."""
    at, limit, values = f"{where}: joint {joint.get('name')!r}", joint.find("limit"), dict(told or {})
    missing = [key for key in LIMITS if key not in values]
    if limit is None and missing:
        yield f"{at}: has no <limit>; add {', '.join(missing)}"
        return
    for key in missing:
        text = limit.get(key)
        if text is None:
            yield f"{at}: <limit> has no {key}, which Pinocchio reads as 0; add it"
            return
        if (value := numbers(text, 1)) is None:
            yield f"{at}: {key} = {text!r} must be a finite number"
            return
        values[key] = float(value[0])
    low, high, effort, speed = (values[key] for key in LIMITS)
    span = f"{at}: range {low:g} ... {high:g} rad is"
    if max(abs(low), abs(high)) > PLAUSIBLE.angle_rad:
        yield f"{span} beyond {PLAUSIBLE.angle_rad:.1f}: degrees or a placeholder; give the real range in rad"
    elif low > high:
        yield f"{at}: lower = {low:g} rad is above upper = {high:g} rad; swap them"
    elif low == high:
        yield f"{span} empty; give the real range"
    if effort <= 0:
        yield f"{at}: effort = {effort:g} N m must be positive; give the peak torque"
    elif effort > PLAUSIBLE.effort_nm:
        yield f"{at}: effort = {effort:g} N m is above {PLAUSIBLE.effort_nm:g}: a placeholder; give the peak torque"
    told_speed = f"{at}: velocity = {speed:g} rad/s"
    if speed <= 0:
        yield f"{told_speed} must be positive; give the speed limit"
    elif speed > PLAUSIBLE.speed_rad_s:
        yield f"{told_speed} is above {PLAUSIBLE.speed_rad_s:g}: deg/s or a placeholder; give the speed limit in rad/s"
