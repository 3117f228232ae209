"""Guards for what URDF parsers accept in silence: structure, inertials, units and limits, each in one sentence.

Every function yields sentences ``file: element: value, limit; what to do``, so that all faults of a file can be listed;
:func:`check` raises on the first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.errors import RobotError
from jumplab.robot_import.urdf import numbers

# urdf_shapes ------------------------------------------------------------------------------------------
SIZES = {"box": (("size", 3),), "sphere": (("radius", 1),), "cylinder": (("radius", 1), ("length", 1)),
         "capsule": (("radius", 1), ("length", 1))}  # fmt: skip


def shape_faults(root: ET.Element, where: str) -> Iterator[str]:
    """Sizes that no shape has, places that are no numbers, meshes without a file."""
    for link in root.findall("link"):
        at = f"{where}: link {link.get('name')!r}"
        for collision in link.findall("collision"):
            origin, geometry = collision.find("origin"), collision.find("geometry")
            for key in ("xyz", "rpy"):
                text = None if origin is None else origin.get(key)
                if text is not None and numbers(text, 3) is None:
                    yield f"{at}: collision origin {key} = {text!r} must be three finite numbers"
            for shape in () if geometry is None else geometry:
                yield from _sizes(shape, at)


def _sizes(shape: ET.Element, at: str) -> Iterator[str]:
    for key, count in SIZES.get(shape.tag, ()):
        values = numbers(shape.get(key), count)
        if values is None or np.any(values <= 0):
            wanted = "three positive numbers" if count == 3 else "a positive number"
            yield f"{at}: {shape.tag} {key} = {shape.get(key)!r} must be {wanted} of m"
    if shape.tag == "mesh":
        if not shape.get("filename"):
            yield f"{at}: a collision mesh has no filename; add it, or remove the shape"
        if shape.get("scale") is not None and numbers(shape.get("scale"), 3) is None:
            yield f"{at}: mesh scale = {shape.get('scale')!r} must be three finite numbers"


# urdf_checks ------------------------------------------------------------------------------------------
TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
MASS_KG = (0.5, 400.0)  # our choice: from a hand-sized humanoid to twice the heaviest published one
SIZE_M = (0.1, 5.0)  # our choice: largest distance between two joints in the neutral pose, likewise
GYRATION_M = 1.0  # our choice: radius of gyration of one link; the longest published limb link has 0.2 m
FRAME_KG = 5e-4  # our choice: links lighter than half a gram are frames, whose tensor nobody measured; it is ignored
TRIANGLE_SLACK = 1e-3  # our choice: relative; rounding to four digits must not refuse a robot
EFFORT_NM = 2000.0  # our choice: five times the strongest published electric humanoid joint
SPEED_RAD_S = 60.0  # our choice: twice the fastest published humanoid joint; above it, deg/s or a placeholder
ANGLE_RAD = 4 * np.pi  # our choice: beyond two turns, degrees or a placeholder


def check(root: ET.Element, where: str, repair: Collection[str] = ()) -> None:
    """Raise :class:`RobotError` with the first fault of structure, inertials or size that is not to be repaired."""
    for sentence in faults(root, where, repair):
        raise RobotError(sentence)


def faults(root: ET.Element, where: str, repair: Collection[str] = ()) -> Iterator[str]:
    """Faults of the whole file: of names and connections, else of inertials, else of units, else of shapes.

    ``repair`` may name "inertia" (tensors that no solid has) and "massless" (bodies without mass): these are no faults
    then.
    """
    for group in (structure_faults, partial(inertial_faults, repair=repair), unit_faults, shape_faults):
        found = list(group(root, where))
        yield from found
        if found:  # the next group reads what this one refused
            return


# structure ------------------------------------------------------------------------------------------------------
def structure_faults(root: ET.Element, where: str) -> Iterator[str]:
    """Names, connections and joint types."""
    links, joints = root.findall("link"), root.findall("joint")
    if not links:
        yield f"{where}: has no <link>; a robot needs a trunk, legs and feet"
        return
    if not joints:
        yield f"{where}: has {len(links)} links and no <joint>; nothing can move"
        return
    yield from _name_faults(links, "link", where)
    yield from _name_faults(joints, "joint", where)
    names = {link.get("name") for link in links}
    bad = False
    for joint in joints:
        for sentence in _joint_faults(joint, names, where):
            bad = True
            yield sentence
    if not bad:
        yield from _tree_faults(names, joints, where)


def _name_faults(elements, kind: str, where: str) -> Iterator[str]:
    count = Counter(e.get("name") for e in elements)
    for name, times in count.items():
        if not name:
            yield f"{where}: {times} <{kind}> without a name; give each its own"
        elif times > 1:
            yield f"{where}: {kind} {name!r} is defined {times} times; keep one"


def _joint_faults(joint: ET.Element, links: set, where: str) -> Iterator[str]:
    at = f"{where}: joint {joint.get('name')!r}"
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
    kind = joint.get("type")
    if kind not in TYPES:
        yield f"{at}: type {kind!r} is unknown; URDF has {', '.join(TYPES)}"
    origin = joint.find("origin")
    for key in ("xyz", "rpy"):
        text = None if origin is None else origin.get(key)
        if text is not None and numbers(text, 3) is None:
            yield f"{at}: origin {key} = {text!r} must be three finite numbers"
    axis = joint.find("axis")
    if kind in ("revolute", "continuous", "prismatic") and axis is not None:
        direction = numbers(axis.get("xyz"), 3)
        if direction is None:
            yield f"{at}: axis xyz = {axis.get('xyz')!r} must be three finite numbers"
        elif np.linalg.norm(direction) < 1e-6:
            yield f"{at}: axis xyz = {axis.get('xyz')!r} has no direction; give a unit vector"


def _tree_faults(names: set, joints, where: str) -> Iterator[str]:
    known = {j.get("name") for j in joints}
    for joint in joints:
        mimic = joint.find("mimic")
        if mimic is not None and mimic.get("joint") not in known:
            yield (f"{where}: joint {joint.get('name')!r} mimics {mimic.get('joint')!r}, which does not exist; "
                   f"correct the name")  # fmt: skip
    children = Counter(j.find("child").get("link") for j in joints)
    for link, times in children.items():
        if times > 1:
            above = ", ".join(repr(j.get("name")) for j in joints if j.find("child").get("link") == link)
            yield f"{where}: link {link!r} hangs on {times} joints ({above}): a closed loop; cut it to leave a tree"
            return
    roots = sorted(names - set(children))
    if not roots:
        yield f"{where}: no link is the root: the joints form a cycle; each robot needs one link without a parent"
    elif len(roots) > 1:
        yield (f"{where}: {len(roots)} links have no parent ({', '.join(map(repr, roots[:4]))}), Pinocchio keeps one "
               f"tree and drops the rest; connect them")  # fmt: skip
    else:
        seen, todo = {roots[0]}, [roots[0]]
        below: dict[str, list[str]] = {}
        for joint in joints:
            below.setdefault(joint.find("parent").get("link"), []).append(joint.find("child").get("link"))
        while todo:
            new = below.get(todo.pop(), [])
            seen.update(new)
            todo += new
        lost = sorted(names - seen)
        if lost:
            yield f"{where}: the links {', '.join(map(repr, lost[:4]))} form a cycle apart from the root {roots[0]!r}"


# inertials ------------------------------------------------------------------------------------------------------
def inertia_matrix(element: ET.Element) -> np.ndarray | None:
    """(3, 3) of an ``<inertia>``, or None if a number is missing or not finite."""
    values = [numbers(element.get(k), 1) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
    if any(v is None for v in values):
        return None
    xx, xy, xz, yy, yz, zz = (float(v[0]) for v in values)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertial_faults(root: ET.Element, where: str, repair: Collection[str] = ()) -> Iterator[str]:
    """Masses and inertias of every link, and bodies that weigh nothing."""
    bad = False
    for link in root.findall("link"):
        inertial = link.find("inertial")
        if inertial is not None:
            for sentence in _inertial_faults(inertial, f"{where}: link {link.get('name')!r}", "inertia" not in repair):
                bad = True
                yield sentence
    if bad or "massless" in repair:
        return
    for joint, links in moved_bodies(root).items():
        if sum(link_mass(link) for link in links) <= 0:
            name, child = joint.get("name"), links[0].get("name")
            if links[0].find("inertial") is None:
                yield (f"{where}: link {child!r}: has no <inertial>, and nothing fixed to it has: Pinocchio reads 0 "
                       f"kg, PyBullet 1 kg; joint {name!r} needs a body of more than 0 kg")  # fmt: skip
            else:
                yield f"{where}: link {child!r}: mass = 0 kg, the body of joint {name!r} must weigh more than 0 kg"


def _inertial_faults(inertial: ET.Element, at: str, strict: bool) -> Iterator[str]:
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None:
        yield f"{at}: <inertial> has no <mass>, which Pinocchio reads as no inertial at all; add it"
        return
    value = numbers(mass.get("value"), 1)
    if value is None:
        yield f"{at}: mass = {mass.get('value')!r} must be a finite number of kg"
        return
    if value[0] < 0:
        yield f"{at}: mass = {value[0]:g} kg must not be negative; correct <mass>"
        return
    origin = inertial.find("origin")
    for key in ("xyz", "rpy"):
        text = None if origin is None else origin.get(key)
        if text is not None and numbers(text, 3) is None:
            yield f"{at}: inertial origin {key} = {text!r} must be three finite numbers"
    if tensor is None:
        yield f"{at}: <inertial> has no <inertia>; add the six numbers in kg m^2"
        return
    matrix = inertia_matrix(tensor)
    if matrix is None:
        shown = {k: tensor.get(k) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
        key, text = next((k, v) for k, v in shown.items() if numbers(v, 1) is None)
        yield f"{at}: {key} = {text!r} must be a finite number of kg m^2"
    elif strict and value[0] >= FRAME_KG:
        yield from _tensor_faults(matrix, float(value[0]), at)


def _tensor_faults(matrix: np.ndarray, mass: float, at: str) -> Iterator[str]:
    moments = np.linalg.eigvalsh(matrix)
    if moments[0] <= 0:
        yield (f"{at}: principal moment of inertia {moments[0]:.3g} kg m^2 must be positive; correct <inertia>, or let "
               f"it be repaired with [source] repair = [\"inertia\"]")  # fmt: skip
    elif moments[2] > (moments[0] + moments[1]) * (1 + TRIANGLE_SLACK):
        yield (f"{at}: principal moments {moments[0]:.3g}, {moments[1]:.3g}, {moments[2]:.3g} kg m^2: the largest must "
               f"not exceed the sum of the others, no solid has this; correct <inertia>, or let it be repaired with "
               f"[source] repair = [\"inertia\"]")  # fmt: skip
    elif np.sqrt(moments[2] / mass) > GYRATION_M:
        yield (
            f"{at}: moment of inertia {moments[2]:.3g} kg m^2 on {mass:g} kg is a radius of gyration of "
            f"{np.sqrt(moments[2] / mass):.3g} m, at most {GYRATION_M:g} is likely; is it in g mm^2 or kg cm^2?"
        )


def link_mass(link: ET.Element) -> float:
    """Mass of one link [kg], 0 without ``<inertial>``."""
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value"))


def moved_bodies(root: ET.Element) -> dict[ET.Element, list[ET.Element]]:
    """Joint that moves -> its child link and all links fixed to that."""
    links = {link.get("name"): link for link in root.findall("link")}
    fixed: dict[str, list[str]] = {}
    for joint in root.findall("joint"):
        if joint.get("type") == "fixed":
            fixed.setdefault(joint.find("parent").get("link"), []).append(joint.find("child").get("link"))
    bodies = {}
    for joint in root.findall("joint"):
        if joint.get("type") != "fixed":
            names = [joint.find("child").get("link")]
            for name in names:
                names += fixed.get(name, [])
            bodies[joint] = [links[n] for n in names]
    return bodies


def total_mass(root: ET.Element) -> float:
    """Mass of all links, read from the XML alone [kg]."""
    return float(sum(link_mass(link) for link in root.findall("link")))


def recount(root: ET.Element, mass_kg: float, where: str) -> None:
    """Raise if an engine's robot does not weigh what the XML says."""
    said = total_mass(root)
    if abs(said - mass_kg) > 1e-6 * max(said, 1.0):
        raise RobotError(
            f"{where}: the links weigh {said:.4f} kg in the XML and {mass_kg:.4f} kg in Pinocchio; a part was dropped"
        )


# units ----------------------------------------------------------------------------------------------------------
def unit_faults(root: ET.Element, where: str) -> Iterator[str]:
    """Total mass and size that no humanoid has in kg and m."""
    mass = total_mass(root)
    if not MASS_KG[0] <= mass <= MASS_KG[1]:
        guess = "grams? divide by 1000" if mass > MASS_KG[1] else "tonnes, or are inertials missing?"
        yield f"{where}: weighs {mass:g} kg, a humanoid {MASS_KG[0]:g} to {MASS_KG[1]:g}; are the masses in {guess}"
    reach = {}
    for joint in root.findall("joint"):
        origin = joint.find("origin")
        xyz = None if origin is None else numbers(origin.get("xyz"), 3)
        reach[joint.find("child").get("link")] = (
            joint.find("parent").get("link"), 0.0 if xyz is None else float(np.linalg.norm(xyz)))  # fmt: skip

    def depth(link):
        total = 0.0
        while link in reach:
            link, step = reach[link][0], reach[link][1]
            total += step
        return total

    deepest = max((depth(link) for link in reach), default=0.0)
    if not SIZE_M[0] <= deepest <= SIZE_M[1]:
        guess = "millimetres? divide by 1000" if deepest > SIZE_M[1] else "kilometres, or are the origins missing?"
        yield (f"{where}: the longest chain of joints measures {deepest:g} m, a humanoid's {SIZE_M[0]:g} to "
               f"{SIZE_M[1]:g}; are the origins in {guess}")  # fmt: skip


LIMITS = ("lower", "upper", "effort", "velocity")


# limits ---------------------------------------------------------------------------------------------------------
def limit_faults(joint: ET.Element, where: str, told: dict[str, float] | None = None) -> Iterator[str]:
    """Faults of the limits of one joint that the jump uses; ``told`` values go before those of the file."""
    at, limit = f"{where}: joint {joint.get('name')!r}", joint.find("limit")
    values = dict(told or {})
    if limit is None and len(values) < len(LIMITS):
        yield f"{at}: has no <limit>; add {', '.join(k for k in LIMITS if k not in values)}"
        return
    for key in LIMITS:
        if key in values:
            continue
        text = limit.get(key)
        value = numbers(text, 1)
        if text is None:
            yield f"{at}: <limit> has no {key}, which Pinocchio reads as 0; add it"
            return
        if value is None:
            yield f"{at}: {key} = {text!r} must be a finite number"
            return
        values[key] = float(value[0])
    yield from value_faults(values, at)


def value_faults(v: dict[str, float], at: str) -> Iterator[str]:
    """Faults of lower, upper [rad], effort [N m] and velocity [rad/s]; ``at`` names file and joint."""
    low, high, effort, speed = v["lower"], v["upper"], v["effort"], v["velocity"]
    if max(abs(low), abs(high)) > ANGLE_RAD:
        yield (f"{at}: range {low:g} ... {high:g} rad is beyond {ANGLE_RAD:.1f}: degrees or a placeholder; give the "
               f"real range in rad")  # fmt: skip
    elif low > high:
        yield f"{at}: lower = {low:g} rad is above upper = {high:g} rad; swap them"
    elif low == high:
        yield f"{at}: range {low:g} ... {high:g} rad is empty; give the real range"
    if effort <= 0:
        yield f"{at}: effort = {effort:g} N m must be positive; give the peak torque"
    elif effort > EFFORT_NM:
        yield f"{at}: effort = {effort:g} N m is above {EFFORT_NM:g}: a placeholder; give the peak torque"
    if speed <= 0:
        yield f"{at}: velocity = {speed:g} rad/s must be positive; give the speed limit"
    elif speed > SPEED_RAD_S:
        yield (f"{at}: velocity = {speed:g} rad/s is above {SPEED_RAD_S:g}: deg/s or a placeholder; give the speed "
               f"limit in rad/s")  # fmt: skip
