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
from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.config import entry, optional, roles_table, table
from jumplab.robot_import.lump import Body, Lumped, lump
from jumplab.robot_import.tree import Tree
from jumplab.robot_import.urdf import parse

# clearance ------------------------------------------------------------------------------------------
STEP_RAD = 0.02  # our choice: of the sweep; the range is cut one step early
FREE_M = 0.008  # our choice: distance kept between thigh and trunk


def free_range(urdf: str, hips: tuple[str, str]) -> tuple[float, float] | None:
    """(lower, upper) of the left hip's own angle [rad] within which neither thigh touches the trunk; None if all is.

    Both hips are turned together, by mirrored angles, every other joint at 0. The range is that around 0.
    """
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    shapes = pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION)
    thighs = [set(_thigh(model, model.getJointId(name))) for name in hips]
    trunk = [i for i, s in enumerate(shapes.geometryObjects) if s.parentJoint == 1]
    legs = [i for i, s in enumerate(shapes.geometryObjects) if any(s.parentJoint in t for t in thighs)]
    for i in trunk:
        for k in legs:
            shapes.addCollisionPair(pin.CollisionPair(i, k))
    if not len(shapes.collisionPairs):
        return None
    data, places = model.createData(), shapes.createData()
    left = model.getJointId(hips[0])
    low, high = (float(x[model.idx_qs[left]]) for x in (model.lowerPositionLimit, model.upperPositionLimit))
    signs = _signs(model, data, hips)

    def free(angle: float) -> bool:
        q = pin.neutral(model)
        for name, sign in zip(hips, signs, strict=True):
            q[model.idx_qs[model.getJointId(name)]] = sign * signs[0] * angle
        pin.computeDistances(model, data, shapes, places, q)
        return min(d.min_distance for d in places.distanceResults) > FREE_M

    ends = []
    for end in (low, high):
        grid = np.linspace(0.0, end, max(int(abs(end) / STEP_RAD), 1) + 1)
        met = next((i for i, angle in enumerate(grid) if not free(angle)), None)
        ends.append(end if met is None else float(grid[max(met - 1, 0)]))
    return None if ends == [low, high] else (ends[0], ends[1])


def _thigh(model: pin.Model, hip: int) -> list[int]:
    """The hip's body and those below it up to the first that carries a shape of its own leg: the thigh."""
    out = [hip]
    for joint in range(hip + 1, model.njoints):
        if model.parents[joint] in out and len(out) < 3 and not _is_pitch(model, joint):
            out.append(joint)
    return out


def _is_pitch(model: pin.Model, joint: int) -> bool:
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    return abs(pin.getJointJacobian(model, data, joint, pin.LOCAL_WORLD_ALIGNED)[4, model.idx_vs[joint]]) > 0.9


def _signs(model: pin.Model, data: pin.Data, names) -> list[float]:
    pin.computeJointJacobians(model, data, pin.neutral(model))
    joints = [model.getJointId(n) for n in names]
    return [float(np.sign(pin.getJointJacobian(model, data, j, pin.LOCAL_WORLD_ALIGNED)[4, model.idx_vs[j]]))
            for j in joints]  # fmt: skip


# jumper ------------------------------------------------------------------------------------------
REPAIRS = ("inertia", "massless", "symmetry")
DIAGONAL = 1e-9  # [kg m^2] our choice: below, a product of inertia is rounding
# shapes, as shares of the leg's length from hip to ankle; our choice: the proportions of the default robot
TRUNK_BOX = (-0.115, 0.115, 0.2, 0.14, 1.0)  # rear, front, half width, bottom, top, from the middle between the hips
THICKNESS = {"thigh": 0.125, "shank": 0.10, "arm": 0.10, "foot": 0.04}
GAP = 0.14  # of each limb's length, kept free at both ends


@dataclass(frozen=True)
class Jumper:
    """A robot that every stage can read, and what was done to get it.

    Attributes
    ----------
    urdf, config_text : the two texts.
    lumped : the bodies.
    tree : the URDF as it was.
    """

    urdf: str
    config_text: str
    lumped: Lumped
    tree: Tree


def source_table(config: dict) -> dict:
    """trunk, forward, up, repair of [source]."""
    source = table(config, "source")
    out = {"trunk": entry(config, "source", "trunk", kind=str)}
    for key, default in (("forward", "+x"), ("up", "+z")):
        value = optional(config, default, "source", key, kind=str)
        if value not in [s + a for s in "+-" for a in "xyz"]:
            raise RobotError(f"robot configuration: 'source.{key}' = {value!r} must be one of +x -x +y -y +z -z")
        out[key] = value
    if out["forward"][1] == out["up"][1]:
        raise RobotError(f"robot configuration: forward {out['forward']} and up {out['up']} must be different axes")
    repair = source.get("repair", [])
    unknown = [r for r in repair if r not in REPAIRS] if isinstance(repair, list) else [repair]
    if unknown:
        raise RobotError(f"robot configuration: 'source.repair' knows {', '.join(REPAIRS)}, got {unknown[0]!r}")
    return out | {"repair": tuple(repair)}


def make_jumper(urdf: str, config: dict, where: str, path: Path | None = None) -> Jumper:
    """Check, lump and rewrite; raises :class:`RobotError`.

    Parameters
    ----------
    urdf : text of the URDF.
    config : the configuration, with a table [source].
    where, path : name of the URDF for messages, and the file itself, near which meshes are looked for.
    """
    source = source_table(config)
    root = parse(urdf, where)
    urdf_checks.check(root, where, source["repair"])
    tree = Tree(root, where, path, "inertia" in source["repair"])
    roles = roles_table(config)
    feet = tuple(entry(config, "feet", "links", kind=str, count=2))
    lumped = lump(tree, config, roles, source, feet)
    sole = _sole(config, lumped, where)
    lumped = _cut_hips(lumped, roles, _urdf(config, roles, lumped, sole))
    text = _urdf(config, roles, lumped, sole)
    return Jumper(text, _toml(config, roles, feet, sole, urdf, lumped), lumped, tree)


def _cut_hips(lumped: Lumped, roles: dict, urdf: str) -> Lumped:
    """Hip ranges cut to where the boxes of thigh and trunk meet."""
    hips = roles["hip_pitch"]
    free = free_range(urdf, hips)
    if free is None:
        return lumped
    left, right = (lumped.body(name) for name in hips)
    mirrored = free if left.axis @ right.axis > 0 else (-free[1], -free[0])
    new = {}
    for name, (low, high) in ((left.name, free), (right.name, mirrored)):
        limits = next(b for b in lumped.bodies if b.name == name).limits
        new[name] = limits | {"lower": max(limits["lower"], low), "upper": min(limits["upper"], high)}
    bodies = tuple(replace(b, limits=new.get(b.name, b.limits)) for b in lumped.bodies)
    cut = max(abs(free[0] - left.limits["lower"]), abs(free[1] - left.limits["upper"]))
    return replace(lumped, bodies=bodies, changed=lumped.changed | {"hip range cut, thigh meets trunk": (cut, "rad")})


def _sole(config: dict, lumped: Lumped, where: str) -> dict:
    """The sole in the frame of the foot body: told from the foot link's origin, along the robot's axes."""
    x, y = (np.array(entry(config, "feet", k, count=2)) for k in ("sole_x_m", "sole_y_m"))
    z = entry(config, "feet", "sole_z_m")
    x, y, z = x + lumped.foot_offset[0], y + lumped.foot_offset[1], z + lumped.foot_offset[2]
    half = (y[1] - y[0]) / 2 - abs(y[0] + y[1]) / 2  # the part that is symmetric about the ankle
    if not (x[0] < 0.0 < x[1] and half > 0 and z < 0):
        raise RobotError(
            f"{where}: the sole {np.round(x, 3)} x {np.round(y, 3)} m, {z:.3f} m from the ankle, must lie below it and "
            f"reach to both sides of it; correct [feet]"
        )
    return {"heel": float(x[0]), "toe": float(x[1]), "half": float(half), "z": float(z)}


# the URDF -------------------------------------------------------------------------------------------------------
def _numbers(*values: float) -> str:
    return " ".join(f"{0.0 + v:.12g}" for v in values)


def _link(robot: ET.Element, name: str, inertia: pin.Inertia, boxes=(), seen=()) -> None:
    """A link with boxes that collide and are seen, and boxes that are only seen."""
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_numbers(*inertia.lever), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_numbers(inertia.mass))
    m = inertia.inertia
    keys = {"ixx": m[0, 0], "ixy": m[0, 1], "ixz": m[0, 2], "iyy": m[1, 1], "iyz": m[1, 2], "izz": m[2, 2]}
    ET.SubElement(inertial, "inertia", {k: _numbers(0.0 if abs(v) < 1e-15 else v) for k, v in keys.items()})
    for kind, shapes in (("visual", [*boxes, *seen]), ("collision", boxes)):
        for centre, size in shapes:
            shape = ET.SubElement(link, kind)
            ET.SubElement(shape, "origin", xyz=_numbers(*centre), rpy="0 0 0")
            ET.SubElement(ET.SubElement(shape, "geometry"), "box", size=_numbers(*size))


def _joint(robot: ET.Element, body: Body, above: Body) -> None:
    joint = ET.SubElement(robot, "joint", name=body.joint, type="revolute")
    ET.SubElement(joint, "parent", link=above.name)
    ET.SubElement(joint, "child", link=body.name)
    ET.SubElement(joint, "origin", xyz=_numbers(*(body.place - above.place)), rpy="0 0 0")
    ET.SubElement(joint, "axis", xyz=_numbers(*body.axis))
    ET.SubElement(joint, "limit", {k: _numbers(v) for k, v in body.limits.items()})


def _urdf(config: dict, roles: dict, lumped: Lumped, sole: dict) -> str:
    robot = ET.Element("robot", name=entry(config, "name", kind=str))
    boxes, by_name = _boxes(config, roles, lumped, sole), {b.name: b for b in lumped.bodies}
    for body in lumped.bodies:
        if body.joint:
            _link(robot, body.name, body.inertia, boxes.get(body.name, ()))
            _joint(robot, body, by_name[body.parent])
        else:
            hips = [lumped.body(name).place for name in roles["hip_pitch"]]
            _trunk(robot, body, boxes.get(body.name, ()), np.mean(hips, axis=0) - body.place)
    ET.indent(robot)
    return f'<?xml version="1.0"?>\n{ET.tostring(robot, encoding="unicode")}\n'


def _spine(boxes, hip: np.ndarray) -> list:
    """A box from the hips to the lowest box of the trunk, for the eye: without it, trunks seem to float."""
    centre, size = min(boxes, key=lambda b: b[0][2] - b[1][2] / 2)
    bottom = centre[2] - size[2] / 2
    if bottom <= hip[2]:
        return []
    return [(np.array([hip[0], 0.0, (bottom + hip[2]) / 2]), [0.5 * size[0], 0.5 * size[1], bottom - hip[2]])]


def _trunk(robot: ET.Element, body: Body, boxes, hip: np.ndarray) -> None:
    """The trunk, as two links where its principal axes are tilted: PyBullet wants those of its base link upright."""
    inertia, rest = body.inertia, None
    matrix = inertia.inertia
    if np.abs(matrix - np.diag(np.diag(matrix))).max() > DIAGONAL:
        low, middle, high = np.linalg.eigvalsh(matrix)
        even = 0.5 * min(low, low + middle - high) * np.eye(3)  # what is left is still a solid's
        if even[0, 0] <= 0:
            raise RobotError(
                f"link {body.name!r} and what is fixed to it: principal moments {low:.3g}, {middle:.3g}, {high:.3g} "
                f"kg m^2 belong to no solid; correct <inertia>, or let it be repaired with [source] repair = "
                f'["inertia"]'
            )
        rest = pin.Inertia(inertia.mass / 2, inertia.lever, matrix - even)
        inertia = pin.Inertia(inertia.mass / 2, inertia.lever, even)
    _link(robot, body.name, inertia, boxes, _spine(boxes, hip))
    if rest is not None:
        name = f"{body.name}_rest"
        _link(robot, name, rest)
        joint = ET.SubElement(robot, "joint", name=f"{name}_fixed", type="fixed")
        ET.SubElement(joint, "parent", link=body.name)
        ET.SubElement(joint, "child", link=name)


def _boxes(config: dict, roles: dict, lumped: Lumped, sole: dict) -> dict[str, list]:
    """body -> (centre, size) of boxes in its frame: trunk, and left and right thigh, shank, foot, arm."""
    out: dict[str, list] = {}
    places = {role: [lumped.body(n).place for n in pair] for role, pair in roles.items()}
    leg = float(np.linalg.norm((places["hip_pitch"][0] - places["ankle_pitch"][0])[[0, 2]]))
    hip = np.mean(places["hip_pitch"], axis=0)
    width = {part: optional(config, share * leg, "shapes", f"{part}_thickness_m") for part, share in THICKNESS.items()}
    for part, thickness in width.items():
        if thickness <= 0:
            raise RobotError(f"robot configuration: 'shapes.{part}_thickness_m' = {thickness:g} must be positive")
    for side in (0, 1):
        knee, ankle = (lumped.body(roles[r][side]) for r in ("knee", "ankle_pitch"))
        foot = next(b for b in lumped.bodies if b.name == lumped_foot(lumped, ankle))
        _limb(out, knee.parent, lumped, places["hip_pitch"][side], knee.place, width["thigh"])
        _limb(out, knee.name, lumped, knee.place, ankle.place, width["shank"])
        size = [sole["toe"] - sole["heel"], 2 * sole["half"], width["foot"]]
        centre = [(sole["toe"] + sole["heel"]) / 2, 0.0, sole["z"] + width["foot"] / 2]
        out[foot.name] = [(centre, size)]
        if roles["shoulder_pitch"]:
            arm = lumped.body(roles["shoulder_pitch"][side])
            lever = arm.inertia.lever
            out[arm.name] = [_stick(lever, 2 * lever, width["arm"], -lever * 0.7)]
    trunk = lumped.bodies[0]
    default = [(leg * np.array(TRUNK_BOX)).tolist()]
    rows = table(config, "shapes").get("trunk_m", default)
    if not (isinstance(rows, list) and rows and all(map(_is_box, rows))):
        raise RobotError(
            f"robot configuration: 'shapes.trunk_m' = {rows!r} must be a list of [rear, front, half width, bottom, top]"
        )
    for rear, front, half, bottom, top in rows:
        centre = hip + np.array([(rear + front) / 2, 0.0, (bottom + top) / 2]) - trunk.place
        centre[1] = 0.0
        out.setdefault(trunk.name, []).append((centre, [front - rear, 2 * half, top - bottom]))
    return out


def _is_box(row) -> bool:
    numbers = isinstance(row, list) and len(row) == 5 and all(type(x) in (int, float) for x in row)
    return numbers and bool(np.all(np.isfinite(row))) and row[0] < row[1] and row[2] > 0 and row[3] < row[4]


def lumped_foot(lumped: Lumped, ankle: Body) -> str:
    """Name of the last body of a leg."""
    name = ankle.name
    while (child := next((b for b in lumped.bodies if b.parent == name), None)) is not None:
        name = child.name
    return name


def _limb(out: dict, name: str, lumped: Lumped, start: np.ndarray, end: np.ndarray, width: float) -> None:
    body = next(b for b in lumped.bodies if b.name == name)
    middle = (start + end) / 2 - body.place
    middle[1] = end[1] - body.place[1]
    out[name] = [(middle, [width, width, abs(start[2] - end[2]) * (1 - 2 * GAP)])]


def _stick(lever: np.ndarray, tip: np.ndarray, width: float, spare: np.ndarray):
    """A box along the main direction of an arm, from near its joint to its tip."""
    size = np.maximum(np.abs(tip) - np.abs(spare) * 0.2, width)
    return tip / 2, size


# the configuration ----------------------------------------------------------------------------------------------
def _list(values) -> str:
    return "[" + ", ".join(f'"{v}"' if isinstance(v, str) else f"{v:.12g}" for v in values) + "]"


def _toml(config: dict, roles: dict, feet, sole: dict, urdf: str, lumped: Lumped) -> str:
    stance = {k: entry(config, "stance", k) for k in ("knee_rad", "trunk_pitch_rad", "shoulder_rad")}
    corner = entry(config, "actuators", "corner_speed_ratio")
    held = ", ".join(f"{k} = {v:g}" for k, v in sorted(lumped.held.items())) or "all at 0"
    lines = [
        f"# {entry(config, 'name', kind=str)}, lumped by jumplab from a URDF with the SHA-256",
        f"# {hashlib.sha256(urdf.encode()).hexdigest()}; held joints: {held}",
        f'name = "{entry(config, "name", kind=str)}"', 'urdf = "robot.urdf"', "", "[joints]",
        *(f"{role} = {_list(pair)}" for role, pair in roles.items()),
        "", "[feet]", f"links = {_list(feet)}", f"sole_x_m = {_list([sole['heel'], sole['toe']])}",
        f"sole_y_m = {_list([-sole['half'], sole['half']])}", f"sole_z_m = {sole['z']:.12g}",
        "", "[stance]", *(f"{k} = {v:.12g}" for k, v in stance.items()),
        "", "[actuators]", f"corner_speed_ratio = {corner:.12g}", "",
    ]  # fmt: skip
    return "\n".join(lines)
