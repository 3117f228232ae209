"""From a published URDF and a person's TOML file to the pair of texts that every stage reads.

A configuration with a table [source] describes somebody else's robot: its URDF is checked, lumped and written anew, and
so is the configuration. Both results stand on their own, so a result folder can carry them.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot_import.checks import check
from jumplab.robot_import.config import entry, filled, roles_table, table, texts
from jumplab.robot_import.lump import Body, Lumped, RoleJoints, beyond, lump
from jumplab.robot_import.roles import LEG
from jumplab.robot_import.urdf import CORNER, LIMITS, MOVING, NO_LOAD, OWN, Tree, parse

REPAIRS = ("inertia", "massless")
STANCE = ("knee_rad", "trunk_pitch_rad", "shoulder_rad")
# None of these numbers is printed by the paper. Boxes have the default robot's proportions, as shares of the leg's
# length from hip to ankle: the trunk's rear, front, half width, bottom and top, from the middle between the hips.
TRUNK_BOX = (-0.115, 0.115, 0.2, 0.14, 1.0)
THICKNESS = {"thigh": 0.125, "shank": 0.10, "arm": 0.10, "foot": 0.04}
GAP = 0.14  # share of each limb's length, kept free at both ends
ARM_REACH = 1.86  # length of an arm's box, in distances from the shoulder to the arm's CoM
DIAGONAL = 1e-9  # [kg m^2] below, a product of inertia is rounding
STEP_RAD = 0.02  # of the sweep for collisions; the range is cut one step early
FREE_M = 0.008  # distance kept between thigh and trunk
ANY = {"lower": -np.pi, "upper": np.pi, "effort": 0.0, "velocity": 0.0}  # of a joint whose limits are not told
Boxes = list[tuple[np.ndarray, np.ndarray]]  # (centre, size) in the frame of a body [m]


@dataclass(frozen=True)
class Jumper:
    """A robot that every stage can read, as two texts; its bodies; and the URDF as it was."""

    urdf: str
    config_text: str
    lumped: Lumped
    tree: Tree


def make_jumper(urdf: str, config: dict, where: str, path: Path | None = None) -> Jumper:
    """Check, lump and rewrite; raises :class:`RobotError`.

    ``urdf`` is a text and ``config`` a configuration with a table [source]; ``where`` names the URDF in messages, and
    meshes are looked for near its ``path``.
    """
    source = _source(config)
    root = parse(urdf, where)
    check(root, where, source["repair"])
    tree = Tree(root, where, path, "inertia" in source["repair"])
    roles = roles_table(config)
    feet = tuple(entry(config, "feet", "links", kind=str, count=2))
    lumped = lump(tree, config, roles, source, feet)
    sole = _sole(config, lumped, where)
    lumped = _cut_hips(lumped, roles, _urdf(config, roles, lumped, sole))
    text = _urdf(config, roles, lumped, sole)
    told = _toml(config, roles, feet, sole, urdf, lumped) + _published(
        tree, lumped, _boxes(config, roles, lumped, sole)
    )
    return Jumper(text, told, lumped, tree)


def _source(config: dict) -> dict:
    """trunk, forward, up, repair of [source]."""
    source = table(config, "source")
    out = {"trunk": entry(config, "source", "trunk", kind=str)}
    for key, default in (("forward", "+x"), ("up", "+z")):
        out[key] = entry(config, "source", key, kind=str, default=default)
        if out[key] not in [s + a for s in "+-" for a in "xyz"]:
            raise RobotError(f"robot configuration: 'source.{key}' = {out[key]!r} must be one of +x -x +y -y +z -z")
    if out["forward"][1] == out["up"][1]:
        raise RobotError(f"robot configuration: forward {out['forward']} and up {out['up']} must be different axes")
    repair = source.get("repair", [])
    unknown = [r for r in repair if r not in REPAIRS] if isinstance(repair, list) else [repair]
    if unknown:
        raise RobotError(f"robot configuration: 'source.repair' knows {', '.join(REPAIRS)}, got {unknown[0]!r}")
    return out | {"repair": tuple(repair)}


def _sole(config: dict, lumped: Lumped, where: str) -> dict[str, float]:
    """The sole in the frame of the foot body: told from the foot link's origin, along the robot's axes."""
    told = (entry(config, "feet", key, count=2) for key in ("sole_x_m", "sole_y_m"))
    x, y = (np.array(pair) + offset for pair, offset in zip(told, lumped.foot_offset[:2], strict=True))
    z = entry(config, "feet", "sole_z_m") + lumped.foot_offset[2]
    half = (y[1] - y[0]) / 2 - abs(y[0] + y[1]) / 2  # the part that is symmetric about the ankle
    if not (x[0] < 0.0 < x[1] and half > 0 and z < 0):
        said = f"{where}: the sole {np.round(x, 3)} x {np.round(y, 3)} m, {z:.3f} m from the ankle"
        raise RobotError(f"{said}, must lie below it and reach to both sides of it; correct [feet]")
    return {"heel": float(x[0]), "toe": float(x[1]), "half": float(half), "z": float(z)}


# the range of the hips ------------------------------------------------------------------------------------------
def _cut_hips(lumped: Lumped, roles: RoleJoints, urdf: str) -> Lumped:
    """Hip ranges around 0 cut to where the boxes of thigh and trunk meet; canted hips keep theirs."""
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    shapes, new, cut = pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION), {}, 0.0
    joint = [shape.parentJoint for shape in shapes.geometryObjects]
    for hip, knee in zip(*(map(lumped.body, roles[role]) for role in ("hip_pitch", "knee")), strict=True):
        thigh = next(model.getJointId(b.joint) for b in lumped.bodies if b.name == knee.parent)
        shapes.removeAllCollisionPairs()
        for i, k in ((i, k) for i, a in enumerate(joint) for k, b in enumerate(joint) if a == 1 and b == thigh):
            shapes.addCollisionPair(pin.CollisionPair(i, k))
        data, places, limits = model.createData(), shapes.createData(), dict(hip.limits)
        for end in ("lower", "upper") if abs(hip.axis[1]) == 1 else ():
            grid, q = np.linspace(0.0, limits[end], max(int(abs(limits[end]) / STEP_RAD), 1) + 1), pin.neutral(model)
            for i, angle in enumerate(grid):
                q[model.idx_qs[model.getJointId(hip.joint)]] = angle
                pin.computeDistances(model, data, shapes, places, q)
                if min(d.min_distance for d in places.distanceResults) <= FREE_M:
                    limits[end] = float(grid[max(i - 1, 0)])
                    break
        cut = max(cut, *(abs(limits[end] - hip.limits[end]) for end in limits))
        new[hip.name] = replace(hip, limits=limits)
    changed = lumped.changed | ({"hip range cut, thigh meets trunk": (cut, "rad")} if cut else {})
    return replace(lumped, bodies=tuple(new.get(b.name, b) for b in lumped.bodies), changed=changed)


# the URDF -------------------------------------------------------------------------------------------------------
def _add(parent: ET.Element, tag: str, **attributes: str | float | np.ndarray) -> ET.Element:
    """An element below ``parent``; numbers are written with twelve digits."""
    for key, value in attributes.items():
        if not isinstance(value, str):
            attributes[key] = " ".join(f"{x:.12g}" for x in 0.0 + np.atleast_1d(value))
    return ET.SubElement(parent, tag, attributes)


def _urdf(config: dict, roles: RoleJoints, lumped: Lumped, sole: dict[str, float]) -> str:
    robot = ET.Element("robot", name=entry(config, "name", kind=str))
    boxes, by_name = _boxes(config, roles, lumped, sole), {b.name: b for b in lumped.bodies}
    trunk, *others = lumped.bodies
    hips = [lumped.body(name).place for name in roles["hip_pitch"]]
    _trunk(robot, trunk, boxes[trunk.name], np.mean(hips, axis=0) - trunk.place)
    for body in others:
        _link(robot, body.name, body.inertia, boxes.get(body.name, []))
        joint = _joint(robot, body.joint, "revolute", body.parent, body.name)
        _add(joint, "origin", xyz=body.place - by_name[body.parent].place, rpy="0 0 0")
        _add(joint, "axis", xyz=body.axis)
        _add(joint, "limit", **{key: body.limits[key] for key in LIMITS})
    ET.indent(robot)
    return f'<?xml version="1.0"?>\n{ET.tostring(robot, encoding="unicode")}\n'


def _published(tree: Tree, lumped: Lumped, boxes: dict[str, Boxes]) -> str:
    """The table [published]: the robot with all its joints, links that are fixed to each other as one, as a URDF."""

    def carrier(link: str) -> str:
        while link in tree.above and tree.above[link].kind == "fixed":
            link = tree.above[link].parent
        return link

    trunk, robot, shapes = lumped.bodies[0], ET.Element("robot", name="published"), {}
    for body in lumped.bodies:
        axes = lumped.placed[carrier(body.name)].inverse() * pin.SE3(np.eye(3), body.place)
        shapes[carrier(body.name)] = (boxes.get(body.name, []), None, axes)
    todo = [trunk.name]
    while (above := tree.above.get(todo[0])) and above.kind in (*MOVING, "fixed"):
        todo = [above.parent]
    for link in todo:
        parts, total = {link: pin.SE3.Identity()}, pin.Inertia.Zero()
        for name in tree.fixed_to(link):
            if tree.links[name].inertia.mass > 0:
                total += parts[name].act(tree.links[name].inertia)
            for below in tree.below[name]:
                parts[below.child] = parts[name] * below.place
                if below.kind in MOVING:
                    joint = _joint(robot, below.name, below.kind.replace("continuous", "revolute"), link, below.child)
                    place = parts[below.child]
                    _add(joint, "origin", xyz=place.translation, rpy=pin.rpy.matrixToRpy(place.rotation))
                    _add(joint, "axis", xyz=below.axis)
                    _add(joint, "limit", **ANY | below.limits)
                    todo.append(below.child)
        _link(robot, link, total, *shapes.get(link, ([],)))
    ET.indent(robot)
    place = pin.SE3(np.eye(3), -trunk.place) * lumped.placed[carrier(trunk.name)]
    return filled(
        "published.toml.in",
        trunk=texts([carrier(trunk.name)])[1:-1],
        xyz=", ".join(f"{x:.12g}" for x in 0.0 + place.translation),
        rpy=", ".join(f"{x:.12g}" for x in 0.0 + pin.rpy.matrixToRpy(place.rotation)),
        urdf=ET.tostring(robot, encoding="unicode"),
        held="\n".join(f"{texts([name])[1:-1]} = {angle:.12g}" for name, angle in sorted(lumped.held.items())),
    )


def _joint(robot: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = _add(robot, "joint", name=name, type=kind)
    _add(joint, "parent", link=parent)
    _add(joint, "child", link=child)
    return joint


def _link(
    robot: ET.Element,
    name: str,
    inertia: pin.Inertia,
    boxes: Boxes,
    seen: Boxes | None = None,
    axes: pin.SE3 | None = None,
) -> None:
    """A link with boxes that collide and are seen, and boxes that are only ``seen``; they lie along ``axes`` in it."""
    axes = axes or pin.SE3.Identity()
    link = _add(robot, "link", name=name)
    inertial = _add(link, "inertial")
    _add(inertial, "origin", xyz=inertia.lever, rpy="0 0 0")
    _add(inertial, "mass", value=inertia.mass)
    m = np.where(np.abs(inertia.inertia) < 1e-15, 0.0, inertia.inertia)
    _add(inertial, "inertia", ixx=m[0, 0], ixy=m[0, 1], ixz=m[0, 2], iyy=m[1, 1], iyz=m[1, 2], izz=m[2, 2])
    for kind, shapes in (("visual", [*boxes, *(seen or [])]), ("collision", boxes)):
        for centre, size in shapes:
            shape = _add(link, kind)
            _add(shape, "origin", xyz=axes.act(centre), rpy=pin.rpy.matrixToRpy(axes.rotation))
            _add(_add(shape, "geometry"), "box", size=size)


def _trunk(robot: ET.Element, body: Body, boxes: Boxes, hip: np.ndarray) -> None:
    """The trunk, as two links where its principal axes are tilted: PyBullet wants those of its base link upright."""
    matrix, half, lever = body.inertia.inertia, body.inertia.mass / 2, body.inertia.lever
    if np.abs(matrix - np.diag(np.diag(matrix))).max() <= DIAGONAL:
        _link(robot, body.name, body.inertia, boxes, _spine(boxes, hip))
        return
    low, middle, high = np.linalg.eigvalsh(matrix)
    even = 0.5 * min(low, low + middle - high) * np.eye(3)  # what is left is still a solid's
    if even[0, 0] <= 0:
        raise RobotError(
            f"link {body.name!r} and what is fixed to it: principal moments {low:.3g}, {middle:.3g}, {high:.3g} "
            f'kg m^2 belong to no solid; correct <inertia>, or let it be repaired with [source] repair = ["inertia"]'
        )
    rest = f"{body.name}_rest"
    _link(robot, body.name, pin.Inertia(half, lever, even), boxes, _spine(boxes, hip))
    _link(robot, rest, pin.Inertia(half, lever, matrix - even), [])
    _joint(robot, f"{rest}_fixed", "fixed", body.name, rest)


def _spine(boxes: Boxes, hip: np.ndarray) -> Boxes:
    """A box from the hips to the lowest box of the trunk, for the eye: without it, trunks seem to float."""
    centre, size = min(boxes, key=lambda b: b[0][2] - b[1][2] / 2)
    bottom = centre[2] - size[2] / 2
    if bottom <= hip[2]:
        return []
    return [(np.array([hip[0], 0.0, (bottom + hip[2]) / 2]), np.array([size[0] / 2, size[1] / 2, bottom - hip[2]]))]


def _boxes(config: dict, roles: RoleJoints, lumped: Lumped, sole: dict[str, float]) -> dict[str, Boxes]:
    """Boxes of trunk, and of left and right thigh, shank, foot and arm, by the name of the body."""
    by_name = {b.name: b for b in lumped.bodies}
    hips, knees, ankles = ([lumped.body(name) for name in roles[role]] for role in LEG)
    leg = float(np.linalg.norm((hips[0].place - ankles[0].place)[[0, 2]]))
    width = {}
    for part, share in THICKNESS.items():
        width[part] = entry(config, "shapes", f"{part}_thickness_m", default=share * leg)
        if width[part] <= 0:
            raise RobotError(f"robot configuration: 'shapes.{part}_thickness_m' = {width[part]:g} must be positive")
    trunk = lumped.bodies[0]
    out = {trunk.name: _trunk_boxes(config, leg, np.mean([hip.place for hip in hips], axis=0) - trunk.place)}
    for hip, knee, ankle in zip(hips, knees, ankles, strict=True):
        foot = [ankle, *beyond(lumped.bodies, ankle)][-1]
        out[knee.parent] = _limb(by_name[knee.parent], hip.place, knee.place, width["thigh"])
        out[knee.name] = _limb(knee, knee.place, ankle.place, width["shank"])
        centre = [(sole["toe"] + sole["heel"]) / 2, 0.0, sole["z"] + width["foot"] / 2]
        out[foot.name] = [(np.array(centre), np.array([sole["toe"] - sole["heel"], 2 * sole["half"], width["foot"]]))]
    legs = {b.name for ankle in ankles for b in [ankle, *beyond(lumped.bodies, ankle)]}
    for body in lumped.bodies[:0:-1]:
        legs |= {body.parent} if body.name in legs else set()
    for body in lumped.bodies[1:]:
        if body.name not in legs and (boxes := _arm(lumped, body, width["arm"])):
            out[body.name] = boxes
    return out


def _arm(lumped: Lumped, body: Body, width: float) -> Boxes:
    """A box around a body of an arm, none where it is short, or carries the rest of the arm beside the trunk."""
    further, lever = beyond(lumped.bodies, body), body.inertia.lever
    if not further:
        return [(lever, np.maximum(ARM_REACH * np.abs(lever), width))]
    way = further[0].place - body.place
    if body.parent == lumped.bodies[0].name or np.linalg.norm(way) < 2 * width:
        return []
    return [(way / 2, np.maximum((1 - 2 * GAP) * np.abs(way), width))]


def _limb(body: Body, start: np.ndarray, end: np.ndarray, width: float) -> Boxes:
    """An upright box between two joints at ``start`` and ``end`` (3,) in the robot's axes."""
    middle = (start + end) / 2 - body.place
    middle[1] = end[1] - body.place[1]
    return [(middle, np.array([width, width, abs(start[2] - end[2]) * (1 - 2 * GAP)]))]


def _trunk_boxes(config: dict, leg: float, hip: np.ndarray) -> Boxes:
    rows, boxes = table(config, "shapes").get("trunk_m", [[leg * share for share in TRUNK_BOX]]), []
    if not (isinstance(rows, list) and rows and all(map(_is_box, rows))):
        said = f"robot configuration: 'shapes.trunk_m' = {rows!r}"
        raise RobotError(f"{said} must be a list of [rear, front, half width, bottom, top]")
    for rear, front, half, bottom, top in rows:
        low, high = np.array([rear, -half, bottom]), np.array([front, half, top])
        boxes.append((hip + (low + high) / 2, high - low))
    return boxes


def _is_box(row: object) -> bool:
    numbers = isinstance(row, list) and len(row) == 5 and all(type(x) in (int, float) for x in row)
    return numbers and bool(np.all(np.isfinite(row))) and row[0] < row[1] and row[2] > 0 and row[3] < row[4]


# the configuration ----------------------------------------------------------------------------------------------
def _toml(config: dict, roles: RoleJoints, feet: tuple, sole: dict[str, float], urdf: str, lumped: Lumped) -> str:
    return filled(
        "jumper.toml.in",
        name=entry(config, "name", kind=str),
        sha256=hashlib.sha256(urdf.encode()).hexdigest(),
        held=", ".join(f"{k} = {v:g}" for k, v in sorted(lumped.held.items())) or "all at 0",
        joints="\n".join(f"{role} = {texts(pair)}" for role, pair in roles.items()),
        links=texts(feet),
        sole=sole,
        stance="\n".join(f"{key} = {entry(config, 'stance', key):.12g}" for key in STANCE) + _rest(config, lumped),
        corner=entry(config, "actuators", "corner_speed_ratio"),
        corners=_corners(lumped) + _motors(lumped),
    )


def _corners(lumped: Lumped) -> str:
    """The table of joints whose corner speed was told, as a share of the speed limit."""
    told = {b.joint: b.limits[CORNER] / b.limits["velocity"] for b in lumped.bodies if CORNER in b.limits}
    rows = "".join(f"{texts([name])[1:-1]} = {ratio:.12g}\n" for name, ratio in told.items())
    return f"\n\n[actuators.corner_speed_ratios]\n{rows.rstrip()}" if rows else ""


def _motors(lumped: Lumped) -> str:
    """The tables of what else was told of motors; the no-load speed as a share of the speed limit."""
    found = []
    for key, ratio in ((NO_LOAD, True), *((own, False) for own in OWN)):
        told = {
            b.joint: b.limits[key] / (b.limits["velocity"] if ratio else 1) for b in lumped.bodies if key in b.limits
        }
        rows = "".join(f"{texts([name])[1:-1]} = {value:.12g}\n" for name, value in told.items())
        name = f"{key}_ratios" if ratio else key
        found += [f"\n\n[actuators.{name}]\n{rows.rstrip()}"] if rows else []
    return "".join(found)


def _rest(config: dict, lumped: Lumped) -> str:
    """The table [rest] of joints that move besides those with a role, if it says anything."""
    told = {name: entry(config, "rest", name) for name in table(config, "rest")}
    unknown = sorted(told.keys() - {b.joint for b in lumped.bodies})
    if unknown:
        raise RobotError(f"robot configuration: [rest] names the joint {unknown[0]!r}, which does not move")
    rows = "".join(f"{texts([name])[1:-1]} = {angle:.12g}\n" for name, angle in told.items())
    return f"\n\n[rest]\n{rows.rstrip()}" if rows else ""
