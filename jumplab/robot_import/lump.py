"""Any humanoid's URDF as a jumper: joints without a role held, their links lumped, axes x forward, y left, z up.

The result is a URDF like that of the default robot, which every engine reads the same way: a body per moving joint, all
frames parallel in the neutral pose, boxes for shapes. Names, zeros and directions of the moving joints are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot_import.checks import LIMITS, limit_faults
from jumplab.robot_import.config import table
from jumplab.robot_import.roles import axis_of
from jumplab.robot_import.tree import Tree

# symmetry ------------------------------------------------------------------------------------------
ROUNDING_RAD = 1e-4  # our choice: URDFs print a right angle as 1.5708; axes this close to x, y or z are meant to be
ALIKE_M = 1e-6  # our choice: as strict as the audit's idea of mirrored joints
ALIKE = 1e-6  # our choice: relative, for masses and inertias
MOST_UNLIKE_M = 0.015  # our choice: more than this between left and right is another robot, not a rounding or a cable
MOST_UNLIKE = 0.10  # our choice: share of a body's mass, likewise
DUMMY_KG = 1e-3  # our choice: as in the default robot; zero is refused by MuJoCo
MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Body:
    """Links that move as one, about a joint that moves them (None for the trunk).

    Attributes
    ----------
    name, parent : names of this body and of the one that carries it.
    joint : the joint of the URDF that moves it.
    place : (3,) origin in the robot's axes [m], on the joint's axis; the trunk's is in the plane of symmetry.
    axis : (3,) of the joint, in the robot's axes.
    limits : lower, upper [rad], effort [N m], velocity [rad/s].
    inertia : about ``place``, in the robot's axes.
    links : names of the links that it is made of.
    """

    name: str
    parent: str
    joint: str
    place: np.ndarray
    axis: np.ndarray
    limits: dict
    inertia: pin.Inertia
    links: tuple[str, ...] = field(default=(), compare=False)


def _moments(inertia: pin.Inertia) -> np.ndarray:
    """(4, 4) second moments of mass about the origin: they add, and mirror as points do."""
    about_com = np.trace(inertia.inertia) / 2 * np.eye(3) - inertia.inertia
    lever = np.append(inertia.lever, 1.0)
    out = inertia.mass * np.outer(lever, lever)
    out[:3, :3] += about_com
    return out


def _of_moments(moments: np.ndarray) -> pin.Inertia:
    mass = moments[3, 3]
    lever = moments[:3, 3] / mass
    about_com = moments[:3, :3] - mass * np.outer(lever, lever)
    return pin.Inertia(float(mass), lever, np.trace(about_com) * np.eye(3) - about_com)


def _mirror(moments: np.ndarray) -> np.ndarray:
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    return flip @ moments @ flip


def mirrored(where: str, bodies: list[Body], roles: dict, allowed: bool, changed: dict) -> list[Body]:
    """Left and right as exact mirror images: their means, where they are alike or that is allowed.

    Parameters
    ----------
    where : name of the file, for messages.
    bodies : trunk first.
    roles : role -> (left, right) joint names.
    allowed : True if means may be taken; ``changed`` is told by how much, name -> (amount, unit).

    Raises :class:`RobotError` if the sides differ more than that.
    """
    by_joint = {b.joint: b for b in bodies}
    out = dict(by_joint)
    trunk = bodies[0]
    pairs = [(trunk, trunk)]
    for left, right in _pairs(where, bodies, roles):
        pairs.append((by_joint[left], by_joint[right]))
    worst = {"place": (0.0, "m", trunk.name), "mass": (0.0, "", trunk.name)}
    for left, right in pairs:
        gap = float(np.abs(left.place - MIRROR @ right.place).max())
        own, other = _moments(left.inertia), _mirror(_moments(right.inertia))
        mean = (own + other) / 2
        if left.inertia.mass > 0:
            if min(left.inertia.mass, right.inertia.mass) > 10 * DUMMY_KG:
                gap = max(gap, float(np.abs(left.inertia.lever - MIRROR @ right.inertia.lever).max()))
            heavier = float(abs(own[3, 3] - other[3, 3]) / mean[3, 3])
            spread = float(np.abs(own - other)[:3, :3].max() / max(np.trace(mean[:3, :3]), 1e-12))
            worst["mass"] = max(worst["mass"], (max(heavier, spread), "", left.name), key=lambda x: x[0])
        worst["place"] = max(worst["place"], (gap, "m", left.name), key=lambda x: x[0])
        place = (left.place + MIRROR @ right.place) / 2
        out[left.joint] = replace(left, place=place, inertia=_of_moments(mean) if mean[3, 3] > 0 else left.inertia)
        if right is not left:
            away = _of_moments(_mirror(mean)) if mean[3, 3] > 0 else right.inertia
            out[right.joint] = replace(right, place=MIRROR @ place, inertia=away, axis=_same_axis(left, right))
    return _judge(where, bodies, [out[b.joint] for b in bodies], worst, allowed, changed)


def _same_axis(left: Body, right: Body) -> np.ndarray:
    """The right joint's axis as the exact mirror image of the left one's, either way round."""
    image = -MIRROR @ left.axis
    image = image if image @ right.axis > 0 else -image
    return image if np.linalg.norm(image - right.axis) < 10 * ROUNDING_RAD else right.axis


def _judge(where: str, before: list[Body], after: list[Body], worst: dict, allowed: bool, changed: dict) -> list[Body]:
    (gap, _, at), (share, _, heavy) = worst["place"], worst["mass"]
    if gap > MOST_UNLIKE_M or (share > MOST_UNLIKE):
        what = f"{1e3 * gap:.1f} mm at {at!r}"
        if gap <= MOST_UNLIKE_M:
            what = f"{100 * share:.1f} % in mass or inertia at {heavy!r}"
        raise RobotError(
            f"{where}: left and right differ by {what}, at most {1e3 * MOST_UNLIKE_M:g} mm and {100 * MOST_UNLIKE:g} % "
            f"can be evened out; a symmetric jump is not defined for this robot, or [locked] holds the arms unevenly"
        )
    if gap <= ALIKE_M and share <= ALIKE:
        return after
    if not allowed:
        raise RobotError(
            f"{where}: left and right differ by {1e3 * gap:.3g} mm at {at!r} and {100 * share:.3g} % of mass or "
            f'inertia at {heavy!r}; allow their mean with [source] repair = ["symmetry"]'
        )
    changed["left and right evened out, places"] = (1e3 * gap, "mm")
    changed["left and right evened out, masses"] = (100 * share, "%")
    return after


def _pairs(where: str, bodies: list[Body], roles: dict) -> list[tuple[str, str]]:
    """(left, right) joints that correspond, counted along legs and arms from the trunk."""
    above = {b.name: b for b in bodies}
    out = []
    for role in ("ankle_pitch", "shoulder_pitch"):
        if not roles[role]:
            continue
        chains = []
        for name in roles[role]:
            body = next(b for b in bodies if b.joint == name)
            last = body
            while (child := next((b for b in bodies if b.parent == last.name), None)) is not None:
                last = child
            chain = []
            while last.joint:
                chain.append(last.joint)
                last = above[last.parent]
            chains.append(chain[::-1])
        if len(chains[0]) != len(chains[1]):
            raise RobotError(f"{where}: left and right limbs have {len(chains[0])} and {len(chains[1])} moving joints")
        out += list(zip(*chains, strict=True))
    return out


# lumped ------------------------------------------------------------------------------------------
DUMMY_INERTIA = 1e-6  # [kg m^2] our choice: as in the default robot


@dataclass(frozen=True)
class Lumped:
    """The jumper.

    Attributes
    ----------
    bodies : trunk first, each after the one that carries it.
    foot_offset : (3,) from the foot body's origin to the origin of the told foot link [m].
    changed : what symmetry and repairs changed: name -> (amount, unit).
    held : joint -> angle [rad] of the joints that no longer move.
    """

    bodies: tuple[Body, ...]
    foot_offset: np.ndarray
    changed: dict
    held: dict

    def body(self, joint: str) -> Body:
        """The body that a joint moves."""
        return next(b for b in self.bodies if b.joint == joint)


def held_angles(tree: Tree, config: dict) -> dict[str, float]:
    """Angles of [locked], else 0 or the nearest end of the range, for every joint; active joints ignore theirs."""
    told, out = table(config, "locked"), {}
    for name, value in told.items():
        if name not in tree.joints:
            raise RobotError(f"{tree.where}: [locked] names the joint {name!r}, which the URDF lacks")
        if not isinstance(value, (int, float)) or not np.isfinite(value):
            raise RobotError(f"robot configuration: 'locked.{name}' = {value!r}, must be a finite number")
    for joint in tree.joints.values():
        if joint.kind in ("revolute", "prismatic") and {"lower", "upper"} <= set(joint.limits):
            low, high = sorted((joint.limits["lower"], joint.limits["upper"]))
            out[joint.name] = float(np.clip(0.0, low, high))
        if joint.name in told:
            out[joint.name] = float(told[joint.name])
    for joint in tree.joints.values():  # a follower goes where its leader is held
        if joint.mimic and joint.name not in told:
            leader, factor, offset = joint.mimic
            out[joint.name] = factor * out.get(leader, 0.0) + offset
    return {name: angle for name, angle in out.items() if angle}


def moving_joints(tree: Tree, roles: dict, trunk: str, feet: Sequence[str]) -> list[str]:
    """Names of the joints that jump: those of the roles, and every revolute joint between trunk and feet."""
    moving = [name for pair in roles.values() for name in pair]
    for name in moving:
        if name not in tree.joints:
            raise RobotError(f"{tree.where}: a role names the joint {name!r}, which the URDF lacks")
        joint = tree.joints[name]
        if joint.kind != "revolute" or joint.mimic:
            kind = "a mimic" if joint.mimic else joint.kind
            raise RobotError(
                f"{tree.where}: joint {name!r} has a role, but is {kind}; it must be revolute with a motor of its own"
            )
    for side, foot in enumerate(feet):
        _check_order(tree, roles, trunk, foot, side)
        for joint in tree.path_between(trunk, foot):
            if joint.kind == "revolute" and not joint.mimic and joint.name not in moving:
                moving.append(joint.name)
    return moving


def _check_order(tree: Tree, roles: dict, trunk: str, foot: str, side: int) -> None:
    """Hip, knee and ankle must follow each other between trunk and foot."""
    path = [joint.name for joint in tree.path_between(trunk, foot)]
    leg = [roles[role][side] for role in ("hip_pitch", "knee", "ankle_pitch")]
    missing = [name for name in leg if name not in path]
    if missing:
        raise RobotError(f"{tree.where}: the role joint {missing[0]!r} is not between {trunk!r} and the foot {foot!r}; "
                         f"correct [joints], [feet] links or their order left, right")  # fmt: skip
    if not path.index(leg[0]) < path.index(leg[1]) < path.index(leg[2]):
        found = ", ".join(sorted(leg, key=path.index))
        raise RobotError(f"{tree.where}: between {trunk!r} and {foot!r} come {found}; hip, knee and ankle must "
                         f"follow in this order; correct [joints]")  # fmt: skip


def _groups(tree: Tree, moving: set[str]) -> dict[str, list[str]]:
    """Link -> list of all links rigidly joined with it."""
    group = {name: [name] for name in tree.links}
    for joint in tree.joints.values():
        if joint.name in moving or joint.kind in ("floating", "planar"):
            continue
        a, b = group[joint.parent], group[joint.child]
        if a is not b:
            a += b
            for link in b:
                group[link] = a
    return group


def lump(tree: Tree, config: dict, roles: dict, source: dict, feet: tuple[str, str]) -> Lumped:
    """The jumper of a URDF.

    Parameters
    ----------
    tree : the URDF.
    config : the robot's whole configuration, of which [locked] and [limits] are read here.
    roles : role -> (left, right) joint names.
    source : trunk, forward, up and repair of [source].
    feet : (left, right) links of the soles.

    Raises :class:`RobotError` for names, limits and asymmetries that cannot be meant.
    """
    for link in (source["trunk"], *feet):
        if link not in tree.links:
            raise RobotError(f"{tree.where}: the configuration names the link {link!r}, which the URDF lacks")
    moving = moving_joints(tree, roles, source["trunk"], feet)
    held = held_angles(tree, config)
    pose = tree.poses({k: v for k, v in held.items() if k not in moving})
    frame = pose[source["trunk"]].rotation
    forward, up = frame @ axis_of(source["forward"]), frame @ axis_of(source["up"])
    turn = np.stack([forward, np.cross(up, forward), up])  # root's axes -> the robot's
    hips = [turn @ pose[tree.joints[n].child].translation for n in roles["hip_pitch"]]
    middle = np.array([0.0, (hips[0][1] + hips[1][1]) / 2, 0.0])
    placed = {n: pin.SE3(turn @ p.rotation, turn @ p.translation - middle) for n, p in pose.items()}
    bodies = _bodies(tree, placed, set(moving), source["trunk"], feet, _limits(tree, config, roles, moving))
    _recount(tree, bodies)
    changed = {}
    if "massless" in source["repair"]:
        bodies = _with_mass(bodies, changed)
    bodies = mirrored(tree.where, bodies, roles, "symmetry" in source["repair"], changed)
    offset = placed[feet[0]].translation - next(b for b in bodies if b.name == feet[0]).place
    return Lumped(tuple(bodies), offset, changed, {k: v for k, v in held.items() if k not in moving})


def _limits(tree: Tree, config: dict, roles: dict, moving: list[str]) -> dict[str, dict]:
    """Joint -> limits, those of the configuration first; a table of [limits] names a joint or a role."""
    told = table(config, "limits")
    for name, values in told.items():
        if name not in tree.joints and name not in roles:
            raise RobotError(f"{tree.where}: [limits.{name}] names neither a joint of the URDF nor a role")
        if not isinstance(values, dict) or not set(values) <= set(LIMITS):
            raise RobotError(f"robot configuration: 'limits.{name}' may hold {', '.join(LIMITS)}, got {values!r}")
        for key, value in values.items():
            if not isinstance(value, (int, float)) or not np.isfinite(value):
                raise RobotError(f"robot configuration: 'limits.{name}.{key}' = {value!r}, must be a finite number")
    out = {}
    for name in moving:
        role = next((r for r, pair in roles.items() if name in pair), "")
        values = {k: float(v) for k, v in (told.get(role, {}) | told.get(name, {})).items()}
        for sentence in limit_faults(tree.joints[name].element, tree.where, values):
            raise RobotError(f"{sentence}, or tell it in [limits.{role or name}] of the configuration")
        out[name] = {k: values.get(k, tree.joints[name].limits.get(k)) for k in LIMITS}
    return out


def _snapped(axis: np.ndarray) -> np.ndarray:
    """An axis within rounding of x, y or z as exactly that."""
    exact = np.round(axis)
    near = np.count_nonzero(exact) == 1 and np.linalg.norm(axis - exact) < ROUNDING_RAD
    return exact if near else axis


def _bodies(tree: Tree, placed: dict, moving: set, trunk: str, feet, limits: dict) -> list[Body]:
    group = _groups(tree, moving)
    origin = placed[trunk].translation * [1.0, 0.0, 1.0]
    edges = [tree.joints[name] for name in tree.joints if name in moving]
    bodies = [
        Body(trunk, "", "", origin, np.zeros(3), {}, _sum(tree, placed, group[trunk], origin), tuple(group[trunk]))
    ]
    todo = [(trunk, bodies[0].name)]
    done: set[str] = set()
    while todo:
        link, parent = todo.pop(0)
        for joint in edges:
            ends = [group[joint.parent], group[joint.child]]
            if joint.name in done or not any(g is group[link] for g in ends):
                continue
            away = group[joint.child] if ends[0] is group[link] else group[joint.parent]
            done.add(joint.name)
            name = next((f for f in feet if f in away), joint.child if joint.child in away else joint.parent)
            place = placed[joint.child].translation
            sign = 1.0 if joint.child in away else -1.0  # met from its far end, it turns the other way
            axis = _snapped(sign * placed[joint.child].rotation @ joint.axis)
            inertia = _sum(tree, placed, away, place)
            bodies.append(Body(name, parent, joint.name, place, axis, limits[joint.name], inertia, tuple(away)))
            todo.append((joint.child if joint.child in away else joint.parent, name))
    return bodies


def _sum(tree: Tree, placed: dict, links: list[str], place: np.ndarray) -> pin.Inertia:
    total, back = pin.Inertia.Zero(), pin.SE3(np.eye(3), -place)
    for link in links:
        if tree.links[link].inertia.mass > 0:
            total += (back * placed[link]).act(tree.links[link].inertia)
    return total


def _recount(tree: Tree, bodies: list[Body]) -> None:
    mass = sum(b.inertia.mass for b in bodies)
    if abs(mass - tree.mass) > 1e-9 * tree.mass:
        lost = sorted(set(tree.links) - {link for b in bodies for link in b.links})
        raise RobotError(
            f"{tree.where}: {tree.mass - mass:.3f} kg do not hang on the trunk ({', '.join(map(repr, lost[:4]))}); "
            f"they are joined to it by no joint of a robot"
        )


def _with_mass(bodies: list[Body], changed: dict) -> list[Body]:
    """Bodies without mass get a gram, taken off the trunk."""
    bare = [b for b in bodies if b.inertia.mass < DUMMY_KG]
    grams = sum(DUMMY_KG - b.inertia.mass for b in bare)
    dummy = pin.Inertia(DUMMY_KG, np.zeros(3), DUMMY_INERTIA * np.eye(3))
    trunk = bodies[0].inertia
    lighter = pin.Inertia(trunk.mass - grams, trunk.lever, trunk.inertia)
    if bare:
        changed["mass given to bodies without any"] = (1e3 * grams, "g")
    return [replace(bodies[0], inertia=lighter)] + [replace(b, inertia=dummy) if b in bare else b for b in bodies[1:]]
