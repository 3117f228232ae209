"""Guards for what URDF parsers accept in silence: structure, inertials, units and limits, each in
one sentence.

Every function yields sentences ``file: element: value, limit; what to do``, so that all faults of a
file can be listed; :func:`read_tree` raises on the first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.errors import RobotError
from jumplab.robot.changes import MOMENTS
from jumplab.robot_import.urdf import (
    FRAME_KG,
    LIMITS,
    MOVING,
    SIZES,
    Tree,
    mass_of,
    numbers,
    parse,
    slight,
    tensor_of,
    unsolid,
)

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


def read_tree(
    text: str, where: str, path: Path | None = None, repair: Collection[str] = ()
) -> Tree:
    """The tree of a URDF's text; raises :class:`RobotError` with the first of :func:`faults`.

    ``where`` names the file in messages, ``repair`` (words) as there; meshes are near ``path``.
    """
    root = parse(text, where)
    for sentence in faults(root, where, repair):
        raise RobotError(sentence)
    return Tree(root, where, path, "inertia" in repair)


def faults(root: ET.Element, where: str, repair: Collection[str] = ()) -> list[str]:
    """Faults of the whole file: of names and connections, else of inertials, else of units, else of
    shapes.

    ``repair`` may name "inertia" (tensors that no solid has) and "massless" (bodies without mass):
    these are no faults then.
    """
    links = [(link, f"{where}: link {link.get('name')!r}") for link in root.findall("link")]
    out = _structure_faults(root, where)
    out = out or [sentence for link, at in links for sentence in _inertial_faults(link, at)]
    if out:  # what follows reads what was refused
        return out
    if "inertia" not in repair:
        most = slight(root)
        out += [sentence for link, at in links for sentence in _tensor_faults(link, at, most)]
    tree = Tree(root, where, repair_inertia=True)
    if "massless" not in repair:
        out += _massless_bodies(tree)
    out += [sentence for link, at in links for sentence in _shape_faults(link, at)]
    return out or list(_unit_faults(tree))


def notes(root: ET.Element, repair: Collection[str] = ()) -> Iterator[str]:
    """What is left over in a URDF without faults, passed over or mended because no jump would
    notice; ``repair`` as of :func:`faults` (file, repairs).
    """
    for element in root:
        if "xacro" in str(element.tag):
            yield (
                f"the call "
                f"<{element.tag.rpartition('}')[2]}> of a xacro macro is left over, and passed over"
            )
    most = np.inf if "inertia" in repair else slight(root)
    for link in root.findall("link"):
        name = link.get("name")
        if any(numbers(x.get("radius"), 1) == 0 for x in link.findall("collision/geometry/sphere")):
            yield f"link {name!r}: a sphere of radius 0 is taken as a point"
        if mass_of(link) >= FRAME_KG and 0 < (gap := unsolid(tensor_of(link))) <= most:
            yield (
                f"link {name!r}: its inertia, which no solid has, is replaced by the nearest, "
                f"{gap:.2g} kg m^2 apart"
            )
    for joint in root.findall("joint/mimic/.."):
        yield f"joint {joint.get('name')!r} follows {joint.find('mimic').get('joint')!r}: held"
    for joint in root.findall("joint/limit[@effort]/.."):
        if joint.get("type") in MOVING and numbers(joint.find("limit").get("effort"), 1) == 0:
            yield f"joint {joint.get('name')!r} has no motor (effort = 0): held"


def _triples(element: ET.Element | None, at: str, *keys: str) -> Iterator[str]:
    """Attributes that are there, but are not three numbers."""
    for key in keys if element is not None else ():
        text = element.get(key)
        if text is not None and numbers(text, 3) is None:
            yield f"{at} {key} = {text!r} must be three finite numbers"


# structure
# --------------------------------------------------------------------------------------------------
def _structure_faults(root: ET.Element, where: str) -> list[str]:
    """Names, connections and joint types."""
    links = root.findall("link")
    joints = root.findall("joint")
    if not links:
        return [f"{where}: has no <link>; a robot needs a trunk, legs and feet"]
    if not joints:
        return [f"{where}: has {len(links)} links and no <joint>; nothing can move"]
    if len(links) > MOST_LINKS:
        return [f"{where}: has {len(links)} links, a humanoid at most {MOST_LINKS}; is it one?"]
    doubtful = []
    for kind, elements in (("link", links), ("joint", joints)):
        for name, times in Counter(e.get("name") for e in elements).items():
            if not name:
                doubtful.append(f"{where}: {times} <{kind}> without a name; give each its own")
            elif times > 1:
                doubtful.append(f"{where}: {kind} {name!r} is defined {times} times; keep one")
    names = {link.get("name") for link in links}
    wrong = [sentence for joint in joints for sentence in _joint_faults(joint, names, where)]
    return doubtful + (wrong or list(_tree_faults(names, joints, where)))


def _joint_faults(joint: ET.Element, links: set, where: str) -> Iterator[str]:
    at = f"{where}: joint {joint.get('name')!r}"
    kind = joint.get("type")
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
    yield from _triples(joint.find("origin"), f"{at}: origin", "xyz", "rpy")
    axis = joint.find("axis")
    if kind in MOVING and axis is not None:
        direction = numbers(axis.get("xyz"), 3)
        if direction is None:
            yield f"{at}: axis xyz = {axis.get('xyz')!r} must be three finite numbers"
        elif np.linalg.norm(direction) < 1e-6:
            yield f"{at}: axis xyz = {axis.get('xyz')!r} has no direction; give a unit vector"


def _tree_faults(names: set, joints: list[ET.Element], where: str) -> Iterator[str]:
    known = {j.get("name") for j in joints}
    for joint in joints:
        mimic = joint.find("mimic")
        at = f"{where}: joint {joint.get('name')!r}"
        if mimic is None:
            continue
        if mimic.get("joint") not in known:
            yield f"{at} mimics {mimic.get('joint')!r}, which does not exist; correct the name"
        for key in ("multiplier", "offset"):
            if numbers(mimic.get(key, "0"), 1) is None:
                yield f"{at}: mimic {key} = {mimic.get(key)!r} must be a finite number"
    parents = [joint.find("parent").get("link") for joint in joints]
    children = [joint.find("child").get("link") for joint in joints]
    for link, times in Counter(children).items():
        if times > 1:
            above = [
                j.get("name") for j, child in zip(joints, children, strict=True) if child == link
            ]
            above = ", ".join(map(repr, above))
            yield (
                f"{where}: link {link!r} hangs on {times} joints ({above}): a closed loop; cut "
                f"it to leave a tree"
            )
            return
    roots = sorted(names - set(children))
    if not roots:
        yield (
            f"{where}: no link is the root: the joints form a cycle; each robot needs one link "
            f"without a parent"
        )
    elif len(roots) > 1:
        yield (
            f"{where}: {len(roots)} links have no parent ({_quoted(roots)}), Pinocchio keeps one "
            f"tree and drops the rest; connect them"
        )
    else:
        below = list(roots)
        for link in below:
            below += [
                child for child, above in zip(children, parents, strict=True) if above == link
            ]
        if lost := sorted(names - set(below)):
            yield (
                f"{where}: the links {_quoted(lost)} form a cycle apart from the root {roots[0]!r}"
            )


def _quoted(names: list[str]) -> str:
    return ", ".join(map(repr, names[:4]))


# inertials
# --------------------------------------------------------------------------------------------------
def _inertial_faults(link: ET.Element, at: str) -> Iterator[str]:
    inertial = link.find("inertial")
    mass = link.find("inertial/mass")
    tensor = link.find("inertial/inertia")
    if inertial is None:
        return
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
    yield from _triples(inertial.find("origin"), f"{at}: inertial origin", "xyz", "rpy")
    if tensor is None:
        yield f"{at}: <inertial> has no <inertia>; add the six numbers in kg m^2"
        return
    wrong = next((key for key in MOMENTS if numbers(tensor.get(key), 1) is None), None)
    if wrong:
        yield f"{at}: {wrong} = {tensor.get(wrong)!r} must be a finite number of kg m^2"


def _tensor_faults(link: ET.Element, at: str, most: float) -> Iterator[str]:
    """Of an inertia farther than ``most`` [kg m^2] from a solid's, or too large."""
    mass = mass_of(link)
    if mass < FRAME_KG:
        return
    matrix = tensor_of(link)
    low, middle, high = np.linalg.eigvalsh(matrix)
    remedy = (
        "correct <inertia>, or let it be repaired: --repair inertia, or [source] repair = "
        '["inertia"]'
    )
    gyration = np.sqrt(abs(high) / mass)
    gap = unsolid(matrix)
    if low <= 0 and gap > most:
        yield f"{at}: principal moment of inertia {low:.3g} kg m^2 must be positive; {remedy}"
    elif gap > most:
        yield (
            f"{at}: principal moments {low:.3g}, {middle:.3g}, {high:.3g} kg m^2: the largest must "
            f"not exceed the sum of the others, no solid has this; {remedy}"
        )
    elif gyration > GYRATION_M:
        yield (
            f"{at}: moment of inertia {high:.3g} kg m^2 on {mass:g} kg is a radius of gyration of "
            f"{gyration:.3g} m, at most {GYRATION_M:g} is likely; is it in g mm^2 or kg cm^2?"
        )


def _massless_bodies(tree: Tree) -> Iterator[str]:
    """Joints that move no mass themselves, though what hangs on them has some."""
    for joint in tree.joints.values():
        link = joint.child
        at = f"{tree.where}: link {link!r}"
        weighs = tree.body_of(link).mass > 0
        if joint.kind == "fixed" or weighs or not tree.carried(link):
            continue
        if tree.elements[link].find("inertial") is None:
            yield (
                f"{at}: has no <inertial>, and nothing fixed to it has: Pinocchio reads 0 kg, "
                f"PyBullet 1 kg; joint {joint.name!r} needs a body of more than 0 kg"
            )
        else:
            yield f"{at}: mass = 0 kg, the body of joint {joint.name!r} must weigh more than 0 kg"


# units and shapes
# -----------------------------------------------------------------------------------------------
def _unit_faults(tree: Tree) -> Iterator[str]:
    """Total mass and size that no humanoid has in kg and m."""
    mass = tree.mass
    low, high = MASSES_KG
    if not low <= mass <= high:
        guess = "grams? divide by 1000" if mass > high else "tonnes, or are inertials missing?"
        yield (
            f"{tree.where}: weighs {mass:g} kg, a humanoid {low:g} to {high:g}; are the masses "
            f"in {guess}"
        )
    chains = map(tree.chain, tree.elements)
    size = max(sum(np.linalg.norm(j.place.translation) for j in chain) for chain in chains)
    low, high = SIZES_M
    if not low <= size <= high:
        guess = "kilometres, or are the origins missing?"
        if size > high:
            guess = "millimetres? divide by 1000"
        yield (
            f"{tree.where}: the longest chain of joints measures {size:g} m, a humanoid's {low:g} "
            f"to {high:g}; are the origins in {guess}"
        )


def _shape_faults(link: ET.Element, at: str) -> Iterator[str]:
    """Sizes that no shape has, places that are no numbers, meshes without a file."""
    for origin in link.findall("collision/origin"):
        yield from _triples(origin, f"{at}: collision origin", "xyz", "rpy")
    for shape in link.findall("collision/geometry/*"):
        for key, count in SIZES.get(shape.tag, {}).items():
            values = numbers(shape.get(key), count)
            least = 0.0 if shape.tag == "sphere" else np.nextafter(0.0, 1.0)
            if values is None or min(values) < least:
                wanted = "three positive numbers" if count == 3 else "a positive number"
                yield f"{at}: {shape.tag} {key} = {shape.get(key)!r} must be {wanted} of m"
        if shape.tag == "mesh":
            if not shape.get("filename"):
                yield f"{at}: a collision mesh has no filename; add it, or remove the shape"
            yield from _triples(shape, f"{at}: mesh", "scale")


# limits
# --------------------------------------------------------------------------------------------------
def limit_faults(
    joint: ET.Element, where: str, given: dict[str, float] | None = None
) -> Iterator[str]:
    """Faults of the limits of one joint that the jump uses; ``given`` values [rad, N m, rad/s] go
    before those of the file.
    """
    at = f"{where}: joint {joint.get('name')!r}"
    limit = joint.find("limit")
    values = dict(given or {})
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
    if max(abs(low), abs(high)) > MOST_RAD:
        yield f"{span} beyond {MOST_RAD:.1f}: degrees or a placeholder; give the real range in rad"
    elif low > high:
        yield f"{at}: lower = {low:g} rad is above upper = {high:g} rad; swap them"
    elif low == high:
        yield f"{span} empty; give the real range"
    if effort <= 0:
        yield f"{at}: effort = {effort:g} N m must be positive; give the peak torque"
    elif effort > MOST_NM:
        yield (
            f"{at}: effort = {effort:g} N m is above {MOST_NM:g}: a placeholder; give the peak "
            f"torque"
        )
    if speed <= 0:
        yield f"{at}: velocity = {speed:g} rad/s must be positive; give the speed limit"
    elif speed > MOST_RAD_S:
        yield (
            f"{at}: velocity = {speed:g} rad/s is above {MOST_RAD_S:g}: deg/s or a placeholder; "
            f"give the speed limit in rad/s"
        )
