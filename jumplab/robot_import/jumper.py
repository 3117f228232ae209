"""From a published URDF and a person's TOML file to the pair of texts that every stage reads.

A configuration with a table [source] describes a robot in a file of others: its URDF is checked,
lumped and written anew, and so is the configuration. Both results stand on their own, so a result
folder can carry them.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from itertools import product
from pathlib import PurePath
from xml.etree import ElementTree as ET

import coal
import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.forms import filled
from jumplab.robot.contact import shifted
from jumplab.robot.description import Robot
from jumplab.robot.files import (
    STANCE,
    TABLES,
    check_entries,
    entry,
    numbers,
    roles_table,
    table,
)
from jumplab.robot_import.lump import CORNER, MOTOR, NO_LOAD, SAME, Body, Lumped, RoleJoints, lump
from jumplab.robot_import.roles import AXES, opposite
from jumplab.robot_import.urdf import LIMITS, MOVING, Tree
from jumplab.robot_import.write import HERE, add, add_joint, add_link, add_origin

# None of these numbers is printed by the paper. Boxes have the default robot's proportions, as
# shares of the leg's length from hip to ankle: the trunk's rear, front, half width, bottom and top,
# from the middle between the hips.
TRUNK_BOX = (-0.115, 0.115, 0.2, 0.14, 1.0)
THICKNESS = {"thigh": 0.125, "shank": 0.10, "arm": 0.10, "foot": 0.04}
REPAIRS = ("inertia", "massless")
# what a configuration with [source] may hold beside what every robot's has
SOURCE_TABLES = TABLES | {
    "source": ("trunk", "forward", "up", "facing", "repair"),
    "joints": (*TABLES["joints"], "free"),
    "feet": (*TABLES["feet"], "level_rad"),
    "locked": (),
    "limits": (),
    "assumed": (),
    "shapes": ("trunk_m", "boxes_m", *(f"{part}_thickness_m" for part in THICKNESS)),
}
GAP = 0.14  # share of each limb's length, kept free at both ends
ARM_REACH = 1.86  # length of an arm's box, in distances from the shoulder to the arm's CoM
RATIOS = {CORNER: "corner_speed_ratios", NO_LOAD: "no_load_ratios"}  # in [actuators]
DIAGONAL = 1e-9  # [kg m^2] below, a product of inertia is rounding
STEP_RAD = 0.02  # of the sweep for collisions; the range is cut one step early
FREE_M = 0.008  # distance kept between thigh and trunk
# of a joint whose limits are not known
ANY = {"lower": -np.pi, "upper": np.pi, "effort": 0.0, "velocity": 0.0}
Boxes = list[tuple[np.ndarray, np.ndarray]]  # (centre, size) in the frame of a body [m]


def make_jumper(tree: Tree, config: dict) -> tuple[Robot, Lumped]:
    """Lump and rewrite: a robot that every stage can read, and its bodies; raises
    :class:`RobotError`.

    ``tree`` is that of a URDF, and ``config`` a configuration with a table [source].
    """
    check_entries(config, SOURCE_TABLES)
    name = entry(config, "name", kind=str)
    if not name or name.startswith(".") or PurePath(name).name != name:
        raise RobotError(
            f"robot configuration: 'name' = {name!r} must be a plain file name: pictures and files "
            f"of the robot are called so"
        )
    source = source_of(config)
    forward = source["forward"]
    facing = entry(config, "source", "facing", kind=str, default="") or forward
    if facing != forward:
        config = _turned(config, forward, facing)
        source["forward"] = facing
    roles = roles_table(config)
    feet = tuple(entry(config, "feet", "links", kind=str, count=2))
    lumped = lump(tree, config, roles, source, feet)
    sole = _sole(tree, config, lumped.place(feet[0]).translation)
    boxes = _boxes(config, roles, lumped, sole)
    _cut_hips(lumped, roles, boxes)
    text = _urdf(name, lumped, roles, boxes)
    config_text = _toml(config, roles, feet, sole, tree.text, lumped) + _published(
        tree, lumped, boxes
    )
    return Robot(text, config_text), lumped


def source_of(config: dict) -> dict:
    """trunk, forward, up, repair of [source]; raises :class:`RobotError`."""
    out = {"trunk": entry(config, "source", "trunk", kind=str)}
    for key, default in (("forward", "+x"), ("up", "+z")):
        out[key] = entry(config, "source", key, kind=str, default=default)
        if out[key] not in AXES:
            raise RobotError(
                f"robot configuration: 'source.{key}' = {out[key]!r} must be one of +x -x +y -y "
                f"+z -z"
            )
    if out["forward"][1] == out["up"][1]:
        raise RobotError(
            f"robot configuration: forward {out['forward']} and up {out['up']} must be different "
            f"axes"
        )
    repair = table(config, "source").get("repair", [])
    out["repair"] = repair if isinstance(repair, list) else [repair]
    for word in out["repair"]:
        if word not in REPAIRS:
            raise RobotError(
                f"robot configuration: 'source.repair' accepts {', '.join(REPAIRS)}, got {word!r}"
            )
    return out


def _turned(config: dict, forward: str, facing: str) -> dict:
    """The configuration of a robot that faces the other way than was found: its pairs, soles and
    assumed ranges are turned about.
    """
    if facing != opposite(forward):
        raise RobotError(
            f"robot configuration: 'source.facing' = {facing!r} must be {forward} or "
            f"{opposite(forward)}, the two directions in which it can walk"
        )
    new = copy.deepcopy(config)
    new["joints"] |= {role: list(pair[::-1]) for role, pair in roles_table(config).items()}
    feet = new["feet"]
    feet["links"] = entry(config, "feet", "links", kind=str, count=2)[::-1]
    for side in ("sole_x_m", "sole_y_m"):
        low, high = entry(config, "feet", side, count=2)
        feet[side] = [-high, -low]
    new["stance"]["shoulder_rad"] = -entry(config, "stance", "shoulder_rad")
    for limits in table(new, "assumed").values():
        if {"lower", "upper"} <= set(limits):
            limits |= {"lower": -limits["upper"], "upper": -limits["lower"]}
    return new


def _sole(tree: Tree, config: dict, offset: np.ndarray) -> dict[str, float]:
    """The sole in the frame of the foot body, whose link is ``offset`` (3,) [m] from it."""
    ahead, left, up = offset
    x = np.array(entry(config, "feet", "sole_x_m", count=2)) + ahead
    y = np.array(entry(config, "feet", "sole_y_m", count=2)) + left
    z = entry(config, "feet", "sole_z_m") + up
    half = (y[1] - y[0]) / 2 - abs(y[0] + y[1]) / 2  # the part that is symmetric about the ankle
    if not (x[0] < 0.0 < x[1] and half > 0 and z < 0):
        raise tree.error(
            f"the sole {np.round(x, 3)} x {np.round(y, 3)} m, {z:.3f} m from the ankle, "
            f"must lie below it and reach to both sides of it: the foot stands on its heel or its "
            f"toes, or [feet] is wrong; give the sole there along level axes, and level_rad, the "
            f"ankles' pitch at which these are level"
        )
    return {"heel": float(x[0]), "toe": float(x[1]), "half": float(half), "z": float(z)}


def _cut_hips(lumped: Lumped, roles: RoleJoints, boxes: dict[str, Boxes]) -> None:
    """Cut hip ranges to where boxes of thigh and trunk meet; canted hips keep theirs."""
    cut = 0.0
    for leg in lumped.legs(roles):
        hip, *_ = leg
        thigh, _ = _thigh_and_shank(lumped, *leg)
        trunk = _solids(lumped.trunk, boxes, hip, 0.0)
        for end in ("lower", "upper") if abs(hip.axis[1]) == 1 else ():
            last = hip.limits[end]
            grid = np.linspace(0.0, last, max(int(abs(last) / STEP_RAD), 1) + 1)
            meets = [_gap(trunk, _solids(thigh, boxes, hip, x)) <= FREE_M for x in grid]
            if any(meets):
                hip.limits[end] = float(grid[max(meets.index(True) - 1, 0)])
                cut = max(cut, abs(hip.limits[end] - last))
    if cut:
        lumped.changed["hip range cut, thigh meets trunk"] = (cut, "rad")


def _solids(body: Body, boxes: dict[str, Boxes], joint: Body, angle: float) -> list[tuple]:
    """Boxes of a body for coal, turned by an angle [rad] about a joint, with their places."""
    turn = pin.exp3(joint.axis * angle)
    return [
        (coal.Box(*size), coal.Transform3s(turn, turn @ (body.place + centre - joint.place)))
        for centre, size in boxes[body.name]
    ]


def _gap(one: list[tuple], other: list[tuple]) -> float:
    """Least distance [m] between two sets of solids."""
    request = coal.DistanceRequest()
    pairs = product(one, other)
    return min(coal.distance(*a, *b, request, coal.DistanceResult()) for a, b in pairs)


# the URDF
# --------------------------------------------------------------------------------------------------
def _urdf(name: str, lumped: Lumped, roles: RoleJoints, boxes: dict[str, Boxes]) -> str:
    robot = ET.Element("robot", name=name)
    trunk, *others = lumped.bodies.values()
    hip = np.mean([hip.place for hip, _, _ in lumped.legs(roles)], axis=0)
    _add_trunk(robot, trunk, boxes[trunk.name], hip - trunk.place)
    for body in others:
        _add_body(robot, body.name, body.inertia, boxes[body.name])
        turn = pin.exp3(-body.level * body.axis)
        place = pin.SE3(turn, body.place - lumped.bodies[body.parent].place)
        limits = {key: body.limits[key] for key in LIMITS}
        ends = body.parent, body.name
        add_joint(robot, body.joint, "revolute", ends, place, body.axis, limits)
    ET.indent(robot)
    return f'<?xml version="1.0"?>\n{ET.tostring(robot, encoding="unicode")}\n'


def _published(tree: Tree, lumped: Lumped, boxes: dict[str, Boxes]) -> str:
    """The table [published]: the robot with all its joints, fixed links as one."""
    trunk = lumped.trunk
    model = tree.model
    joints = [joint for joint in tree.joints.values() if joint.kind in MOVING]
    moving = {model.getJointId(joint.name): joint for joint in joints}
    # what floats, and carries the trunk
    todo = [k for k in model.supports[tree.carrier[trunk.name]] if k not in moving][-1:]
    root = tree.bodies[tree.carrier[trunk.name]][0]
    robot = ET.Element("robot", name="published")
    for carrier in todo:
        link, *_ = tree.bodies[carrier]
        below = [k for k in model.children[carrier] if k in moving]
        for k in below:
            joint = moving[k]
            kind = joint.kind.replace("continuous", "revolute")
            ends = link, joint.child
            limits = ANY | joint.limits
            add_joint(robot, joint.name, kind, ends, model.jointPlacements[k], joint.axis, limits)
        todo += below
        boxed = next((part for part in tree.bodies[carrier] if part in boxes), None)
        place = shifted(lumped.bodies[boxed].place) if boxed else HERE
        axes = lumped.placed[link].inverse() * place
        _add_body(robot, link, model.inertias[carrier], boxes.get(boxed, []), axes=axes)
    ET.indent(robot)
    place = shifted(-trunk.place) * lumped.placed[root]
    return filled(
        "robot_import/published.toml.in",
        trunk=root,
        xyz=0.0 + place.translation,
        rpy=0.0 + pin.rpy.matrixToRpy(place.rotation),
        urdf=ET.tostring(robot, encoding="unicode"),
        held=lumped.held,
    )


def _add_body(
    robot: ET.Element,
    name: str,
    inertia: pin.Inertia,
    boxes: Boxes,
    seen: Sequence = (),
    axes: pin.SE3 = HERE,
) -> None:
    """A link with boxes that collide, and boxes only ``seen``, along ``axes`` in it."""
    link = add_link(robot, name, inertia)
    for kind, shown in (("visual", [*boxes, *seen]), ("collision", boxes)):
        for centre, size in shown:
            shape = add(link, kind)
            add_origin(shape, axes * shifted(centre))
            add(add(shape, "geometry"), "box", size=size)


def _add_trunk(robot: ET.Element, body: Body, boxes: Boxes, hip: np.ndarray) -> None:
    """The trunk, with a box for the eye from the hips up; as two links where its principal axes are
    tilted: PyBullet needs those of its base link upright.
    """
    centre, size = min(boxes, key=lambda b: b[0][2] - b[1][2] / 2)
    bottom = centre[2] - size[2] / 2
    spine = []
    if bottom > hip[2]:
        middle = np.array([hip[0], 0.0, (bottom + hip[2]) / 2])
        spine.append((middle, np.array([size[0] / 2, size[1] / 2, bottom - hip[2]])))
    inertia = body.inertia
    matrix = inertia.inertia
    if np.abs(np.triu(matrix, 1)).max() <= DIAGONAL:
        _add_body(robot, body.name, inertia, boxes, spine)
        return
    low, middle, high = np.linalg.eigvalsh(matrix)
    even = 0.5 * min(low, low + middle - high)  # what is left is still a solid's
    if even <= 0:
        raise RobotError(
            f"link {body.name!r} and what is fixed to it: principal moments {low:.3g}, "
            f"{middle:.3g}, {high:.3g} "
            f"kg m^2 belong to no solid; correct <inertia>, or let it be repaired with [source] "
            f'repair = ["inertia"]'
        )
    rest = f"{body.name}_rest"
    upright = even * np.eye(3)
    half = pin.Inertia(inertia.mass / 2, inertia.lever, upright)
    _add_body(robot, body.name, half, boxes, spine)
    add_link(robot, rest, pin.Inertia(inertia.mass / 2, inertia.lever, matrix - upright))
    add_joint(robot, f"{rest}_fixed", "fixed", (body.name, rest))


# boxes
# --------------------------------------------------------------------------------------------------
def _boxes(
    config: dict, roles: RoleJoints, lumped: Lumped, sole: dict[str, float]
) -> dict[str, Boxes]:
    """Boxes of trunk, and of left and right thigh, shank, foot and arm, by the name of the body."""
    legs = lumped.legs(roles)
    leg = float(np.linalg.norm((legs[0][0].place - legs[0][2].place)[[0, 2]]))
    width = {}
    for part, share in THICKNESS.items():
        width[part] = entry(config, "shapes", f"{part}_thickness_m", default=share * leg)
        if width[part] <= 0:
            raise RobotError(
                f"robot configuration: 'shapes.{part}_thickness_m' = {width[part]:g} must be "
                f"positive"
            )
    trunk = lumped.trunk
    middle = np.mean([hip.place for hip, _, _ in legs], axis=0) - trunk.place
    out = {trunk.name: _trunk_boxes(config, leg, middle)}
    long = sole["toe"] - sole["heel"]
    centre = np.array([(sole["toe"] + sole["heel"]) / 2, 0.0, sole["z"] + width["foot"] / 2])
    for hip, knee, ankle in legs:
        thigh, shank = _thigh_and_shank(lumped, hip, knee, ankle)
        foot = [ankle, *lumped.beyond(ankle)][-1]
        out[thigh.name] = _limb(thigh, hip.place, knee.place, width["thigh"])
        out[shank.name] = _limb(shank, shank.place, ankle.place, width["shank"])
        out[foot.name] = [(centre, np.array([long, 2 * sole["half"], width["foot"]]))]
        while foot.parent:
            foot = lumped.bodies[foot.parent]
            out.setdefault(foot.name, [])
    out |= _given_boxes(config, set(lumped.bodies))
    arms = {b.name: _arm(lumped, b, width["arm"]) for b in lumped.bodies.values()}
    return arms | out


def _thigh_and_shank(lumped: Lumped, hip: Body, knee: Body, ankle: Body) -> tuple[Body, Body]:
    """The bodies of a leg that have its two long boxes: of a knee of two joints, such as one that
    rolls, neither is the short link between them.
    """
    thigh = lumped.bodies[knee.parent]
    while thigh is not hip and _bends(thigh, knee, hip):
        thigh = lumped.bodies[thigh.parent]
    shank = lumped.bodies[ankle.parent]
    while shank is not knee and not _bends(shank, knee, ankle):
        shank = lumped.bodies[shank.parent]
    return thigh, shank


def _bends(body: Body, knee: Body, end: Body) -> bool:
    """Whether a joint turns as a knee does, nearer to it than to the other ``end`` of its limb."""
    far = np.linalg.norm(body.place - end.place)
    return abs(body.axis @ knee.axis) > SAME and np.linalg.norm(body.place - knee.place) < far


def _given_boxes(config: dict, links: set[str]) -> dict[str, Boxes]:
    """Boxes of links that the configuration gives as [rear, front, right, left, bottom, top] from
    the link's joint, in the robot's axes [m]: of a waist that moves, and of what it carries.
    """
    out = {}
    for name in table(table(config, "shapes"), "boxes_m"):
        ends = np.reshape(entry(config, "shapes", "boxes_m", name, count=6), (3, 2))
        if name not in links or np.any(ends[:, 0] >= ends[:, 1]):
            raise RobotError(
                f"robot configuration: 'shapes.boxes_m.{name}' must name a link that moves, with "
                f"the first number of each pair below the second"
            )
        out[name] = [_box(ends)]
    return out


def _box(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and size (3,) [m] of a box from its lower and upper ends (3, 2)."""
    return ends.mean(axis=1), np.ptp(ends, axis=1)


def _arm(lumped: Lumped, body: Body, width: float) -> Boxes:
    """A box around a body of an arm; none if it is short, or carries the arm beside the trunk."""
    further = lumped.beyond(body)
    lever = body.inertia.lever
    if not further:
        return [(lever, np.maximum(ARM_REACH * np.abs(lever), width))]
    way = further[0].place - body.place
    if body.parent == lumped.trunk.name or np.linalg.norm(way) < 2 * width:
        return []
    return [(way / 2, np.maximum((1 - 2 * GAP) * np.abs(way), width))]


def _limb(body: Body, start: np.ndarray, end: np.ndarray, width: float) -> Boxes:
    """An upright box between two joints at ``start`` and ``end`` (3,) in the robot's axes."""
    middle = (start + end) / 2 - body.place
    middle[1] = end[1] - body.place[1]
    return [(middle, np.array([width, width, abs(start[2] - end[2]) * (1 - 2 * GAP)]))]


def _trunk_boxes(config: dict, leg: float, hip: np.ndarray) -> Boxes:
    given = table(config, "shapes").get("trunk_m", [[leg * share for share in TRUNK_BOX]])
    try:
        ends = [np.reshape([x[0], x[1], -x[2], x[2], x[3], x[4]], (3, 2)) for x in given]
        good = bool(ends) and np.all([np.isfinite(x) & (x[:, :1] < x[:, 1:]) for x in ends])
    except (TypeError, ValueError, IndexError):
        good = False
    if not good:
        raise RobotError(
            f"robot configuration: 'shapes.trunk_m' = {given!r} must be a list of [rear, front, "
            f"half width, bottom, top]"
        )
    return [(hip + centre, size) for centre, size in map(_box, ends)]


# the configuration
# ----------------------------------------------------------------------------------------------
def _toml(
    config: dict, roles: RoleJoints, feet: tuple, sole: dict[str, float], urdf: str, lumped: Lumped
) -> str:
    rest = numbers(config, "rest")
    if unknown := sorted(rest.keys() - {b.joint for b in lumped.bodies.values()}):
        raise RobotError(
            f"robot configuration: [rest] names the joint {unknown[0]!r}, which does not move; "
            f"correct or remove it"
        )
    motors = {}
    for key in MOTOR:
        limits = {b.joint: b.limits for b in lumped.bodies.values() if key in b.limits}
        # speeds as shares of the speed limit
        values = {
            joint: x[key] / (x["velocity"] if key in RATIOS else 1) for joint, x in limits.items()
        }
        motors[RATIOS.get(key, key)] = values
    return filled(
        "robot_import/jumper.toml.in",
        name=entry(config, "name", kind=str),
        sha256=hashlib.sha256(urdf.encode()).hexdigest(),
        held=lumped.held,
        joints=roles,
        links=feet,
        sole=sole,
        stance={key: entry(config, "stance", key) for key in STANCE},
        rest=rest,
        corner=entry(config, "actuators", "corner_speed_ratio"),
        motors=motors,
    )
