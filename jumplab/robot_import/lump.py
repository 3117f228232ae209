"""Any humanoid's URDF as a jumper: joints without a role held, their links lumped, axes x forward, y left, z up.

The result has a body per moving joint, with all frames parallel in the neutral pose. Names, zeros and directions of the
moving joints are kept.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot_import.checks import limit_faults
from jumplab.robot_import.config import entry, table
from jumplab.robot_import.roles import LEG, robot_axes
from jumplab.robot_import.urdf import CORNER, LIMITS, MOTOR, NO_LOAD, OWN, Tree

RoleJoints = dict[str, tuple[str, ...]]
MIRROR = np.diag([1.0, -1.0, 1.0])
DUMMY = pin.Inertia(1e-3, np.zeros(3), 1e-6 * np.eye(3))  # as in the default robot; MuJoCo refuses zero


# how much left and right may differ; the paper prints none of these numbers
AXIS_RAD = 1e-4  # URDFs print a right angle as 1.5708; axes this close to x, y or z are meant to be
ALIKE = 1e-6  # [m] and relative: as strict as the audit's idea of mirrored joints
CAD_M, CAD_SHARE = 0.005, 0.01  # of places, and of a body's mass or inertia: what a CAD export leaves is evened out
PAIR_M = 0.10  # farther apart two joints are no counterparts
SOURCE = "source"  # of a motor's numbers, in words
MOST_ARMATURE = 10.0  # [kg m^2] a tenth of it is much, reflected by the gears of a humanoid's hip
SAME = 0.98  # cosine between a joint's axis and the mirror image of its counterpart's


@dataclass(frozen=True)
class Body:
    """Links that move as one, about a joint that moves them ("" for the trunk)."""

    name: str
    parent: str  # name of the body that carries it
    joint: str  # of the URDF
    place: np.ndarray  # (3,) origin in the robot's axes [m], on the joint's axis; the trunk's in the plane of symmetry
    axis: np.ndarray  # (3,) of the joint, in the robot's axes
    limits: dict[str, float]  # lower, upper [rad], effort [N m], velocity [rad/s]; of MOTOR what is told
    inertia: pin.Inertia  # about ``place``, in the robot's axes


@dataclass(frozen=True)
class Lumped:
    """The jumper."""

    bodies: tuple[Body, ...]  # trunk first, each after the one that carries it
    foot_offset: np.ndarray  # (3,) from the foot body's origin to the origin of the told foot link [m]
    changed: dict[str, tuple[float, str]]  # what evening out and repairs changed: name -> (amount, unit)
    held: dict[str, float]  # joint -> angle [rad] of the joints that no longer move
    links: dict[str, tuple[str, pin.SE3]]  # link of the URDF -> body it belongs to, and its place there
    placed: dict[str, pin.SE3]  # link -> its place in the robot's axes, those joints held and all others at 0

    def body(self, joint: str) -> Body:
        """The body that a joint moves."""
        return next(b for b in self.bodies if b.joint == joint)


def lump(tree: Tree, config: dict, roles: RoleJoints, source: dict, feet: tuple[str, str]) -> Lumped:
    """The jumper of a URDF; raises :class:`RobotError` for names, limits and asymmetries that cannot be meant.

    Of ``config`` the tables [locked] and [limits] are read here; ``roles`` are role -> (left, right) joint names,
    ``source`` is trunk, forward, up and repair of [source], ``feet`` are the (left, right) links of the soles.
    """
    for link in (source["trunk"], *feet):
        if link not in tree.links:
            raise RobotError(f"{tree.where}: the configuration names the link {link!r}, which the URDF lacks")
    moving = _moving_joints(tree, roles, source["trunk"], feet, _free(config))
    held = {name: angle for name, angle in _held_angles(tree, config).items() if angle and name not in moving}
    pose = tree.poses(held)
    turn = robot_axes(pose[source["trunk"]].rotation, source["forward"], source["up"])
    hips = [turn @ pose[tree.joints[n].child].translation for n in roles["hip_pitch"]]
    middle = np.array([0.0, (hips[0][1] + hips[1][1]) / 2, 0.0])
    placed = {n: pin.SE3(turn @ p.rotation, turn @ p.translation - middle) for n, p in pose.items()}
    edges = entry(config, "feet", "sole_y_m", count=2)
    bodies = _bodies(tree, placed, source["trunk"], feet, _limits(tree, config, roles, moving), sum(edges) / 2)
    changed = {}
    if "massless" in source["repair"]:
        bodies = _with_mass(bodies, changed)
    bodies = _mirrored(bodies, changed)
    offset = placed[feet[0]].translation - next(b for b in bodies if b.name == feet[0]).place
    links, group = {}, _groups(tree, moving)
    for body in bodies:
        here = {n: pin.SE3(placed[n].rotation, placed[n].translation - body.place) for n in group[body.name]}
        links |= {name: (body.name, place) for name, place in here.items()}
    return Lumped(tuple(bodies), offset, changed, held, links, placed)


# what moves, and how far ----------------------------------------------------------------------------------------
def _free(config: dict) -> list[str]:
    """Names of further joints that move: of arms and waist."""
    names = table(config, "joints").get("free", [])
    return entry(config, "joints", "free", kind=str, count=len(names)) if isinstance(names, list) and names else []


def _moving_joints(
    tree: Tree, roles: RoleJoints, trunk: str, feet: Sequence[str], free: Sequence[str] = ()
) -> list[str]:
    """Names of the joints that jump: those of the roles, ``free`` ones, every revolute joint between trunk and feet."""
    moving = list(dict.fromkeys([*(name for pair in roles.values() for name in pair), *free]))
    for name in moving:
        if name not in tree.joints:
            raise RobotError(f"{tree.where}: a role names the joint {name!r}, which the URDF lacks")
        joint = tree.joints[name]
        if not joint.driven:
            said = f"{tree.where}: joint {name!r} has a role, but is {'a mimic' if joint.mimic else joint.kind}"
            raise RobotError(f"{said}; it must be revolute with a motor of its own")
    for side, foot in enumerate(feet):
        path, leg = tree.path_between(trunk, foot), [roles[role][side] for role in LEG]
        names = [j.name for j in path]
        missing = next((name for name in leg if name not in names), None)
        if missing:
            said = f"{tree.where}: the role joint {missing!r} is not between {trunk!r} and the foot {foot!r}"
            raise RobotError(f"{said}; correct [joints], [feet] links or their order left, right")
        found = sorted(leg, key=names.index)
        if found != leg or len(set(leg)) < 3:
            said = f"{tree.where}: between {trunk!r} and {foot!r} come {', '.join(found)}"
            raise RobotError(f"{said}; hip, knee and ankle must follow in this order; correct [joints]")
        moving += [j.name for j in path if j.driven and j.name not in moving]
    return moving


def _held_angles(tree: Tree, config: dict) -> dict[str, float]:
    """Joint -> angle of [locked], else 0 or the nearest end of the range."""
    told, out = {}, {}
    for name in table(config, "locked"):
        if name not in tree.joints:
            raise RobotError(f"{tree.where}: [locked] names the joint {name!r}, which the URDF lacks")
        told[name] = entry(config, "locked", name)
    for joint in tree.joints.values():
        if joint.kind in ("revolute", "prismatic") and {"lower", "upper"} <= set(joint.limits):
            out[joint.name] = float(np.clip(0.0, *sorted((joint.limits["lower"], joint.limits["upper"]))))
    out |= told
    for joint in tree.joints.values():  # a follower goes where its leader is held
        if joint.mimic and joint.name not in told:
            leader, factor, offset = joint.mimic
            out[joint.name] = factor * out.get(leader, 0.0) + offset
    return out


def _limits(tree: Tree, config: dict, roles: RoleJoints, moving: list[str]) -> dict[str, dict[str, float]]:
    """Joint -> limits, those of the configuration first; a table of [limits] names a joint or a role."""
    told = {}
    for name, values in table(config, "limits").items():
        if name not in tree.joints and name not in roles:
            raise RobotError(f"{tree.where}: [limits.{name}] names neither a joint of the URDF nor a role")
        if not isinstance(values, dict) or not set(values) <= {*LIMITS, *MOTOR, SOURCE}:
            may = ", ".join((*LIMITS, *MOTOR, SOURCE))
            raise RobotError(f"robot configuration: 'limits.{name}' may hold {may}, got {values!r}")
        told[name] = {key: entry(config, "limits", name, key) for key in values if key != SOURCE}
        entry(config, "limits", name, SOURCE, kind=str, default="")
    out = {}
    for name in moving:
        role = next((r for r, pair in roles.items() if name in pair), "")
        values = told.get(role, {}) | told.get(name, {})
        for sentence in limit_faults(tree.joints[name].element, tree.where, values):
            raise RobotError(f"{sentence}, or tell it in [limits.{role or name}] of the configuration")
        out[name] = {key: values.get(key, tree.joints[name].limits.get(key)) for key in LIMITS}
        if sentence := _motor_fault(values, out[name]):
            raise RobotError(f"{tree.where}: joint {name!r}: {sentence}; correct [limits.{role or name}]")
        out[name] |= {key: values[key] for key in MOTOR if key in values}
    return out


def _motor_fault(told: dict[str, float], limits: dict[str, float]) -> str:
    """What is wrong with what is told of a motor, in a sentence; empty if nothing is."""
    speed, effort = limits["velocity"], limits["effort"]
    free = told.get(NO_LOAD, speed)
    if free < speed:
        return f"no_load = {free:g} rad/s is below the speed limit, {speed:g} rad/s, at which it would give no torque"
    if CORNER in told and not 0 < told[CORNER] < free:
        end = "no-load speed" if NO_LOAD in told else "speed limit"
        return f"corner = {told[CORNER]:g} rad/s must lie between 0 and the {end}, {free:g} rad/s"
    for key in OWN:
        if told.get(key, 0.0) < 0:
            return f"{key} = {told[key]:g} must not be negative"
    if told.get("armature", 0.0) > MOST_ARMATURE:
        return f"armature = {told['armature']:g} kg m^2 is more than {MOST_ARMATURE:g} kg m^2, that of no joint"
    lost = told.get("friction", 0.0) + told.get("damping", 0.0) * speed
    if lost >= effort:
        return f"friction and damping take {lost:g} N m at the speed limit, and the effort is {effort:g} N m"
    return ""


# bodies ---------------------------------------------------------------------------------------------------------
def _groups(tree: Tree, moving: Collection[str]) -> dict[str, list[str]]:
    """Link -> list of all links rigidly joined with it, the same object for all of them."""
    group = {name: [name] for name in tree.links}
    for joint in tree.joints.values():
        a, b = group[joint.parent], group[joint.child]
        if joint.name not in moving and joint.kind not in ("floating", "planar") and a is not b:
            a += b
            group |= dict.fromkeys(b, a)
    return group


def _bodies(
    tree: Tree, placed: dict[str, pin.SE3], trunk: str, feet: Sequence[str], limits: dict[str, dict], beside: float
) -> list[Body]:
    """The trunk, then outwards a body for each joint of ``limits``; all their mass must hang on the trunk.

    The middle of the left sole is ``beside`` [m] the origin of its link, to the left.
    """
    group, left = _groups(tree, limits), [joint for joint in tree.joints.values() if joint.name in limits]
    origin = placed[trunk].translation * [1.0, 0.0, 1.0]
    bodies = [Body(trunk, "", "", origin, np.zeros(3), {}, _sum(tree, placed, group[trunk], origin))]
    todo, lost = [(trunk, trunk)], set(tree.links) - set(group[trunk])
    while todo:
        link, parent = todo.pop(0)
        here = group[link]
        for joint in [j for j in left if here is group[j.parent] or here is group[j.child]]:
            left.remove(joint)
            outwards = here is group[joint.parent]  # met from its far end, a joint turns the other way
            next_link, sign = (joint.child, 1.0) if outwards else (joint.parent, -1.0)
            away, place = group[next_link], placed[joint.child].translation
            name = next((foot for foot in feet if foot in away), next_link)
            axis = _snapped(sign * placed[joint.child].rotation @ joint.axis)
            if name in feet and abs(axis[1]) == 1:  # an origin may lie anywhere on its axis: in the middle of the sole
                middle = placed[name].translation[1] + (beside if name == feet[0] else -beside)
                place = np.array([place[0], middle, place[2]])
            inertia = _sum(tree, placed, away, place)
            bodies.append(Body(name, parent, joint.name, place, axis, limits[joint.name], inertia))
            todo.append((next_link, name))
            lost -= set(away)
    missing = tree.mass - sum(b.inertia.mass for b in bodies)
    if abs(missing) > 1e-9 * tree.mass:
        said = f"{tree.where}: {missing:.3f} kg do not hang on the trunk ({', '.join(map(repr, sorted(lost)[:4]))})"
        raise RobotError(f"{said}; they are joined to it by no joint of a robot")
    return bodies


def _snapped(axis: np.ndarray) -> np.ndarray:
    """An axis within rounding of x, y or z as exactly that."""
    exact = np.round(axis)
    near = np.count_nonzero(exact) == 1 and np.linalg.norm(axis - exact) < AXIS_RAD
    return exact if near else axis


def _sum(tree: Tree, placed: dict[str, pin.SE3], links: list[str], place: np.ndarray) -> pin.Inertia:
    total, back = pin.Inertia.Zero(), pin.SE3(np.eye(3), -place)
    for link in links:
        if tree.links[link].inertia.mass > 0:
            total += (back * placed[link]).act(tree.links[link].inertia)
    return total


def _with_mass(bodies: list[Body], changed: dict) -> list[Body]:
    """Bodies without mass get a gram, taken off the trunk."""
    bare = {b.name: replace(b, inertia=DUMMY) for b in bodies if b.inertia.mass < DUMMY.mass}
    given, trunk = [DUMMY.mass - b.inertia.mass for b in bodies if b.name in bare], bodies[0].inertia
    grams = float(np.cumsum([0.0, *given])[-1])  # rounds alike on every Python
    if bare:
        changed["mass given to bodies without any"] = (1e3 * grams, "g")
    lighter = replace(bodies[0], inertia=pin.Inertia(trunk.mass - grams, trunk.lever, trunk.inertia))
    return [lighter, *(bare.get(b.name, b) for b in bodies[1:])]


# left and right -------------------------------------------------------------------------------------------------
def _mirrored(bodies: list[Body], changed: dict) -> list[Body]:
    """Left and right as exact mirror images, their means, if they differ no more than a CAD export leaves."""
    out, gap, share = {}, 0.0, 0.0  # largest differences [m], [1]
    for left, right in _pairs(bodies):
        middle, gaps = (left.place + MIRROR @ right.place) / 2, [left.place - MIRROR @ right.place]
        here, away = left.inertia, right.inertia
        if here.mass > 0:
            own, other = here.toPseudoInertia().toMatrix(), _image(away.toPseudoInertia().toMatrix())
            mean = (own + other) / 2
            if min(here.mass, away.mass) > 10 * DUMMY.mass:
                gaps.append(here.lever - MIRROR @ away.lever)
            spread = np.abs(own - other)[:3, :3].max() / max(np.trace(mean[:3, :3]), 1e-12)
            share = max(share, abs(own[3, 3] - other[3, 3]) / mean[3, 3], spread)
            here, away = _inertia(mean), _inertia(_image(mean))
        gap = max(gap, np.abs(gaps).max())
        out[left.joint] = replace(left, place=middle, inertia=here)
        if right is not left:
            out[right.joint] = replace(right, place=MIRROR @ middle, inertia=away, axis=_same_axis(left, right))
    even = gap <= CAD_M and share <= CAD_SHARE
    done = "evened out" if even else "differ, left as they are"
    if max(gap, share) > ALIKE:
        changed[f"left and right {done}, places"] = (1e3 * float(gap), "mm")
        changed[f"left and right {done}, masses"] = (100 * float(share), "%")
    return [out.get(b.joint, b) for b in bodies] if even else bodies


def _image(moments: np.ndarray) -> np.ndarray:
    """Mirror image of a (4, 4) pseudo-inertia: second moments of mass mirror as points do."""
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    return flip @ moments @ flip


def _inertia(moments: np.ndarray) -> pin.Inertia:
    return pin.PseudoInertia.FromMatrix(moments).toInertia()


def _same_axis(left: Body, right: Body) -> np.ndarray:
    """The right joint's axis as the exact mirror image of the left one's, either way round."""
    image = -MIRROR @ left.axis
    image = image if image @ right.axis > 0 else -image
    return image if np.linalg.norm(image - right.axis) < 10 * AXIS_RAD else right.axis


def _pairs(bodies: list[Body]) -> list[tuple[Body, Body]]:
    """(left, right) bodies that mirror each other, from the trunk outwards; one in the middle is its own image."""
    image, out = {bodies[0].name: bodies[0].name}, [(bodies[0], bodies[0])]
    for body in bodies[1:]:
        if body.name in image:
            continue
        flipped = -MIRROR @ body.axis
        like = [b for b in bodies[1:] if b.parent == image.get(body.parent) and abs(flipped @ b.axis) > SAME]
        near = [(float(np.abs(MIRROR @ b.place - body.place).max()), b.name, b) for b in like]
        gap, _, other = min(near, default=(np.inf, "", body))
        if gap < PAIR_M:
            image |= {body.name: other.name, other.name: body.name}
            out.append((body, other) if body.place[1] >= other.place[1] else (other, body))
    return out


def beyond(bodies: Sequence[Body], body: Body) -> list[Body]:
    """The bodies that hang on a body, one on the other."""
    child = next((b for b in bodies if b.parent == body.name), None)
    return [] if child is None else [child, *beyond(bodies, child)]
