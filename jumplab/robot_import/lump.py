"""Any humanoid's URDF as a jumper: joints without a role held, their links lumped, axes x forward,
y left, z up.

The result has a body per moving joint, with all frames parallel in the neutral pose. Names, zeros
and directions of the moving joints are kept.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.contact import posed, shifted
from jumplab.robot.files import LEG, entry, table
from jumplab.robot.reduction import MIRROR
from jumplab.robot_import.checks import limit_faults
from jumplab.robot_import.roles import leg_joints, robot_axes
from jumplab.robot_import.urdf import FRAME_KG, LIMITS, OWN, Joint, Tree, link_poses, links_of
from jumplab.robot_import.write import key, listed

RoleJoints = dict[str, tuple[str, ...]]
IMAGE = np.outer([1.0, -1.0, 1.0, 1.0], [1.0, -1.0, 1.0, 1.0])  # times a (4, 4) pseudo-inertia
# as in the default robot; MuJoCo refuses zero
DUMMY = pin.Inertia(1e-3, np.zeros(3), 1e-6 * np.eye(3))
# [rad/s] up to which the whole effort is there, and from which none; not in URDFs
CORNER = "corner"
NO_LOAD = "no_load"
MOTOR = (CORNER, NO_LOAD, *OWN)
SOURCE = "source"  # of a motor's numbers, in words
MOST_ARMATURE = 10.0  # [kg m^2] a tenth of it is much, reflected by the gears of a humanoid's hip
# of the effort, that losses of a file take at the speed limit: more is no loss, but the line on
# which a motor's torque falls with its speed, which counts already
MOST_LOST = 0.9
# how much left and right may differ; the paper prints none of these numbers
AXIS_RAD = 1e-4  # URDFs print a right angle as 1.5708; axes this close to x, y or z are meant to be
ALIKE = 1e-6  # [m] and relative: as strict as the audit's idea of mirrored joints
CAD_M = 0.005  # of places: what a CAD export leaves is evened out
# of a body's mass or inertia: a shank with a screw more, or a bracket that was not mirrored, has up
# to 3.3 % more in public files, less than anybody knows of an inertia
CAD_SHARE = 0.04
LIGHT = 0.02  # of the robot's mass: in a lighter body differences count by as much less
PAIR_M = 0.10  # farther apart two joints are no counterparts
COMMON = 0.5  # of the narrower range, that left and right share at least
SAME = 0.98  # cosine between a joint's axis and the mirror image of its counterpart's


@dataclass(frozen=True)
class Body:
    """Links that move as one, about a joint that moves them ("" for the trunk)."""

    name: str
    parent: str  # name of the body that carries it
    joint: str  # of the URDF
    # (3,) origin in the robot's axes [m], on the joint's axis; the trunk's in the plane of symmetry
    place: np.ndarray
    axis: np.ndarray  # (3,) of the joint, in the robot's axes
    # lower, upper [rad], effort [N m], velocity [rad/s]; of MOTOR what is known
    limits: dict[str, float]
    inertia: pin.Inertia  # about ``place``, in the robot's axes
    level: float = 0.0  # angle of its joint [rad] at which it is as described here


@dataclass(frozen=True)
class Lumped:
    """The jumper."""

    bodies: dict[str, Body]  # by name, trunk first, each after the one that carries it
    # what evening out and repairs changed: name -> (amount, unit)
    changed: dict[str, tuple[float, str]]
    held: dict[str, float]  # joint -> angle [rad] of the joints that no longer move
    links: dict[str, str]  # link of the URDF -> body it belongs to
    # link -> its place in the robot's axes, those joints held, soles level and all others at 0
    placed: dict[str, pin.SE3]

    @property
    def trunk(self) -> Body:
        """The body that carries all others."""
        return next(iter(self.bodies.values()))

    def legs(self, roles: RoleJoints) -> list[list[Body]]:
        """The bodies that hip, knee and ankle move, of the left and of the right leg."""
        of = {body.joint: body for body in self.bodies.values()}
        return [[of[roles[role][side]] for role in LEG] for side in range(2)]

    def place(self, link: str) -> pin.SE3:
        """Place of a link in the frame of its body [m]."""
        return shifted(-self.bodies[self.links[link]].place) * self.placed[link]

    def beyond(self, body: Body) -> list[Body]:
        """The bodies that hang on a body, one on the other (the first of several)."""
        child = next((b for b in self.bodies.values() if b.parent == body.name), None)
        return [] if child is None else [child, *self.beyond(child)]


def lump(
    tree: Tree, config: dict, roles: RoleJoints, source: dict, feet: tuple[str, str]
) -> Lumped:
    """The jumper of a URDF; raises :class:`RobotError` for names, limits and asymmetries that
    cannot be meant.

    Of ``config`` the tables [locked] and [limits] are read here; ``roles`` are role -> (left,
    right) joint names, ``source`` is trunk, forward, up and repair of [source], ``feet`` are the
    (left, right) links of the soles.
    """
    trunk = source["trunk"]
    if lost := [link for link in (trunk, *feet) if link not in tree.elements]:
        raise tree.error(
            f"the configuration names the link {lost[0]!r}, which the {tree.format} lacks; "
            f"correct the name"
        )
    moving = _moving_joints(tree, config, roles, trunk, feet)
    _check_ties(tree, moving)
    held = _held_angles(tree, config, moving)
    model = tree.holding(held, moving)
    pose = link_poses(model)
    turn = robot_axes(pose[trunk].rotation, source["forward"], source["up"])
    hips = [turn @ pose[tree.joints[n].child].translation for n in roles["hip_pitch"]]
    if hips[0][1] <= hips[1][1]:
        left, right = roles["hip_pitch"]
        raise tree.error(
            f"joint {left!r} is named as the left one, but lies on the right of {right!r} where "
            f"the trunk faces {source['forward']}; turn all pairs round by [source] facing, or "
            f"correct [joints]"
        )
    middle = _between_legs(tree, trunk, feet, pose, turn[1])
    model.jointPlacements[1] = pin.SE3(turn, np.array([0.0, -middle, 0.0]))
    levels = _levelled(tree, config, roles, model)
    placed = link_poses(model)
    edges = entry(config, "feet", "sole_y_m", count=2)
    changed = {}
    configured = _configured_limits(tree, config, roles)
    limits = {name: _limits(tree, configured, roles, name, changed) for name in moving}
    bodies, links = _bodies(tree, model, placed, trunk, feet, limits, sum(edges) / 2)
    if bodies[0].inertia.mass < FRAME_KG:
        raise tree.error(
            f"the trunk {trunk!r} and all that is held on it weigh {bodies[0].inertia.mass:g} kg; "
            f"give its link a mass, or name another [source] trunk"
        )
    _check_ranges(tree, bodies, roles)
    bodies = [replace(body, level=levels.get(body.joint, 0.0)) for body in bodies]
    bodies = _with_mass(bodies, changed)
    bodies = _mirrored(bodies, changed)
    return Lumped({b.name: b for b in bodies}, changed, held, links, placed)


def _between_legs(
    tree: Tree, trunk: str, feet: Sequence[str], pose: dict[str, pin.SE3], left: np.ndarray
) -> float:
    """Place of the plane between the legs, along the axis ``left`` (3,) [m].

    It lies amid the first two joints whose axes turn least about that one: along its axis, an
    origin may lie anywhere.
    """
    legs = ([j for j in tree.path_between(trunk, foot) if j.driven] for foot in feet)

    def turning(pair: tuple[Joint, ...]) -> float:
        return round(abs(left @ pose[pair[0].child].rotation @ pair[0].axis), 2)

    pair = min(zip(*legs, strict=False), key=turning)
    return float(sum(left @ pose[joint.child].translation for joint in pair) / 2)


def _levelled(tree: Tree, config: dict, roles: RoleJoints, model: pin.Model) -> dict[str, float]:
    """Angles of the ankles [rad] at which the soles are level, which are 0 in ``model`` afterwards;
    {} if they are 0 in the file.
    """
    pitch = entry(config, "feet", "level_rad", default=0.0)
    data = posed(model)
    axes = data.J[3:].T
    out = {}
    for name in roles["ankle_pitch"] if pitch else ():
        joint = model.getJointId(name)
        out[name] = float(pitch * np.sign(axes[model.idx_vs[joint], 1]))
        turned = pin.exp3(out[name] * tree.joints[name].axis)
        model.jointPlacements[joint] = model.jointPlacements[joint] * pin.SE3(turned, np.zeros(3))
    return out


# what moves, and how far
# ----------------------------------------------------------------------------------------
def _moving_joints(
    tree: Tree, config: dict, roles: RoleJoints, trunk: str, feet: Sequence[str]
) -> list[str]:
    """The joints that jump: of roles, [joints] free, and between trunk and feet."""
    moving = [name for pair in roles.values() for name in pair]
    free = table(config, "joints").get("free")
    if isinstance(free, list) and free:
        moving += entry(config, "joints", "free", kind=str, count=len(free))
    for name in moving:
        if name not in tree.joints:
            raise tree.error(
                f"a role names the joint {name!r}, which the {tree.format} lacks; correct the name"
            )
        joint = tree.joints[name]
        if not joint.driven:
            kind = "a mimic" if joint.mimic else joint.kind
            raise tree.error(
                f"joint {name!r} has a role, but is {kind}; it must be revolute with "
                f"a motor of its own"
            )
    for side, foot in enumerate(feet):
        names = [j.name for j in tree.path_between(trunk, foot)]
        leg = [roles[role][side] for role in LEG]
        if missing := [name for name in leg if name not in names]:
            raise tree.error(
                f"the role joint {missing[0]!r} is not between {trunk!r} and the "
                f"foot {foot!r}; correct [joints], [feet] links or their order left, right"
            )
        ordered = sorted(leg, key=names.index)
        if ordered != leg or len(set(leg)) < 3:
            raise tree.error(
                f"between {trunk!r} and {foot!r} come {', '.join(ordered)}; hip, "
                f"knee and ankle must follow in this order; correct [joints]"
            )
    return list(dict.fromkeys(moving + leg_joints(tree, trunk, feet)))


def _check_ties(tree: Tree, moving: Collection[str]) -> None:
    """Raise if a file ties joints that jump: a chain that is closed by a way of other joints, such
    as cranks and rods, is only another drive of the leg; one without any decides how the leg moves.
    """
    for tie in tree.xml.iterfind("tie"):
        ways = [[e.get("joint") for e in way] for way in tie]
        jump = [name for way in ways for name in way if name in moving]
        if jump and all(not way or {*way} & {*moving} for way in ways):
            raise tree.error(
                f"{tie.get('by')} ties the joints {listed(jump)}, and a jump moves each by itself; "
                f"take it out of the file, and give each joint the range and the torque that it "
                f"has in a serial leg in its place"
            )


def _held_angles(tree: Tree, config: dict, moving: Collection[str]) -> dict[str, float]:
    """Joint -> angle [rad] of those held off 0: of [locked], else in the range nearest to 0."""
    locked = table(config, "locked")
    out = {}
    for joint in tree.joints.values():
        ends = [joint.limits[end] for end in ("lower", "upper") if end in joint.limits]
        if joint.kind in ("revolute", "prismatic") and len(ends) == 2:
            out[joint.name] = float(np.clip(0.0, *sorted(ends)))
    for name in locked:
        if name not in tree.joints:
            raise tree.error(
                f"[locked] names the joint {name!r}, which the {tree.format} lacks; correct the "
                f"name"
            )
        out[name] = entry(config, "locked", name)
    for joint in tree.joints.values():  # a follower goes where its leader is held
        if joint.mimic and joint.name not in locked:
            leader, factor, offset = joint.mimic
            out[joint.name] = factor * out.get(leader, 0.0) + offset
    return {name: angle for name, angle in out.items() if angle and name not in moving}


def _check_ranges(tree: Tree, bodies: list[Body], roles: RoleJoints) -> None:
    """Raise if left and right of a role have little of their ranges in common."""
    of = {body.joint: body for body in bodies}
    for pair in roles.values():
        ends = []  # about the axis to the left [rad]
        for body in (of[name] for name in pair):
            turned = np.sign(body.axis[1]) or 1.0
            ends.append(sorted((turned * body.limits["lower"], turned * body.limits["upper"])))
        if not ends:
            continue
        low, high = np.transpose(ends)
        common = high.min() - low.max()
        if common < COMMON * (high - low).min():
            ranges = " and ".join(f"{a:.3g} ... {b:.3g}" for a, b in ends)
            tables = " or ".join(f"[limits.{key(name)}]" for name in pair)
            raise tree.error(
                f"the joints {listed(pair)} turn {ranges} rad about the axis to the left, which "
                f"have {max(common, 0.0):.3g} rad in common: one has a wrong axis or range; "
                f"correct it, or give its lower, upper in {tables}"
            )


def _configured_limits(tree: Tree, config: dict, roles: RoleJoints) -> dict[str, dict[str, float]]:
    """The numbers of [limits], and where it has none those of [assumed], by joint or role."""
    limits = {}
    may = (*LIMITS, *MOTOR, SOURCE)
    for title in ("assumed", "limits"):
        for name, values in table(config, title).items():
            if name not in tree.joints and name not in roles:
                dotted = [key(j) for j in tree.joints if j.startswith(f"{name}.")]
                hint = f"; names with dots are quoted: [{title}.{dotted[0]}]" if dotted else ""
                raise tree.error(
                    f"[{title}.{key(name)}] names neither a joint of the {tree.format} nor a "
                    f"role{hint}"
                )
            if not isinstance(values, dict) or not set(values) <= set(may):
                raise RobotError(
                    f"robot configuration: '{title}.{name}' may hold {', '.join(may)}, got "
                    f"{values!r}"
                )
            entry(config, title, name, SOURCE, kind=str, default="")
            numbers = {part: entry(config, title, name, part) for part in values if part != SOURCE}
            limits[name] = limits.get(name, {}) | numbers
    return limits


def _limits(
    tree: Tree, configured: dict[str, dict], roles: RoleJoints, joint: str, changed: dict
) -> dict[str, float]:
    """The limits of a joint, those that are ``configured`` before those of the file; with the
    losses of the file, if its motor can overcome them.
    """
    # a joint that is called like a role goes before it
    role = next((r for r, pair in roles.items() if joint in pair and r not in tree.joints), "")
    values = configured.get(role, {}) | configured.get(joint, {})
    where = f"limits.{key(role or joint)}"
    for sentence in limit_faults(tree, joint, values, where):
        raise RobotError(sentence)
    limits = tree.joints[joint].limits | values
    if sentence := _motor_fault(limits):
        raise tree.error(f"joint {joint!r}: {sentence}; correct [{where}]")
    with_losses = tree.joints[joint].losses | limits
    if not (sentence := _motor_fault(with_losses, MOST_LOST)):
        return with_losses
    used = len(with_losses) - len(limits)
    changed[f"joint {joint!r}: losses of the file not used, {sentence}"] = (used, "numbers")
    return limits


def _motor_fault(limits: dict[str, float], most: float = 1.0) -> str:
    """Fault of a motor's numbers, in a sentence; empty if they have none. At the speed limit its
    losses take less than ``most`` of its effort [1].
    """
    speed = limits["velocity"]
    effort = limits["effort"]
    free = limits.get(NO_LOAD, speed)
    corner = limits.get(CORNER, free / 2)
    losses = {part: limits.get(part, 0.0) for part in OWN}
    armature, friction, damping = losses.values()
    lost = friction + damping * speed
    if free < speed:
        return (
            f"no_load = {free:g} rad/s is below the speed limit, {speed:g} rad/s, at which it "
            f"would give no torque"
        )
    if not 0 < corner < free:
        end = "no-load speed" if NO_LOAD in limits else "speed limit"
        return f"corner = {corner:g} rad/s must lie between 0 and the {end}, {free:g} rad/s"
    if negative := [f"{part} = {x:g}" for part, x in losses.items() if x < 0]:
        return f"{negative[0]} must not be negative"
    if armature > MOST_ARMATURE:
        return (
            f"armature = {armature:g} kg m^2 must be at most {MOST_ARMATURE:g} kg m^2, as joints "
            f"have"
        )
    if lost >= most * effort:
        return (
            f"friction and damping take {lost:g} N m at the speed limit, and the effort is "
            f"{effort:g} N m"
        )
    return ""


# bodies
# --------------------------------------------------------------------------------------------------
def _bodies(
    tree: Tree,
    model: pin.Model,
    placed: dict[str, pin.SE3],
    trunk: str,
    feet: Sequence[str],
    limits: dict[str, dict],
    beside: float,
) -> tuple[list[Body], dict[str, str]]:
    """The trunk, then outwards a body for each joint of ``limits``, and the body of each link; all
    their mass must hang on the trunk.

    The middle of the left sole is ``beside`` [m] the origin of its link, to the left; that of the
    right one is opposite.
    """
    data = posed(model)
    axes = data.J[3:].T
    carriers = {link: model.frames[i].parentJoint for link, i in links_of(model).items()}
    bodies = []
    names = {}
    todo = [(trunk, "", "")]
    for link, parent, joint in todo:
        carrier = carriers[link]
        name = next((foot for foot in feet if carriers[foot] == carrier), link)
        place = placed[trunk].translation * [1.0, 0.0, 1.0]
        axis = np.zeros(3)
        if joint:
            turning = model.getJointId(joint)
            place = data.oMi[turning].translation
            # from its far end it turns the other way
            sign = 1.0 if tree.joints[joint].child == link else -1.0
            axis = _snapped(sign * axes[model.idx_vs[turning]])
        # an origin may lie anywhere on its axis: in the middle of the sole
        if name in feet and abs(axis[1]) == 1:
            middle = placed[feet[0]].translation[1] + beside
            place = np.array([place[0], middle if name == feet[0] else -middle, place[2]])
        inertia = (shifted(-place) * data.oMi[carrier]).act(model.inertias[carrier])
        bodies.append(Body(name, parent, joint, place, axis, limits.get(joint, {}), inertia))
        names[carrier] = name
        for further in (j for j in tree.joints.values() if j.name in limits and j.name != joint):
            for near, far in permutations((further.parent, further.child)):
                if carriers[near] == carrier:
                    todo.append((far, name, further.name))
    links = {link: names[carrier] for link, carrier in carriers.items() if carrier in names}
    missing = tree.mass - sum(b.inertia.mass for b in bodies)
    if abs(missing) > 1e-9 * tree.mass:
        lost = sorted(carriers.keys() - links)
        raise tree.error(
            f"{missing:.3f} kg do not hang on the trunk ({listed(lost)}); connect them to it by "
            f"joints of a robot, or remove them"
        )
    return bodies, links


def _snapped(axis: np.ndarray) -> np.ndarray:
    """An axis within rounding of x, y or z as exactly that."""
    exact = np.round(axis)
    near = np.count_nonzero(exact) == 1 and np.linalg.norm(axis - exact) < AXIS_RAD
    return exact if near else axis


def _with_mass(bodies: list[Body], changed: dict) -> list[Body]:
    """Bodies without mass get a gram, taken off the trunk."""
    given = {b.name: DUMMY.mass - b.inertia.mass for b in bodies if b.inertia.mass < DUMMY.mass}
    if not given:
        return bodies
    grams = float(np.cumsum([*given.values()])[-1])  # rounds alike on every Python
    changed["mass given to bodies without any"] = (1e3 * grams, "g")
    trunk = bodies[0].inertia
    lighter = pin.Inertia(trunk.mass - grams, trunk.lever, trunk.inertia)
    heavier = [replace(b, inertia=DUMMY) if b.name in given else b for b in bodies[1:]]
    return [replace(bodies[0], inertia=lighter), *heavier]


# left and right
# -------------------------------------------------------------------------------------------------
def _mirrored(bodies: list[Body], changed: dict) -> list[Body]:
    """Left and right as mirror images, their means, if they differ as a CAD export does."""
    moved = {body.name: body for body in bodies}
    images = _images(bodies)
    for name, image in images.items():
        if moved[name].place[1] >= moved[image].place[1]:
            moved[image] = _opposite(moved[name], moved[image])
    evened = dict(moved)
    gaps = []  # [m]
    shares = []  # [1]
    light = LIGHT * sum(body.inertia.mass for body in bodies)
    for name, image in images.items():
        body = moved[name]
        other = moved[image]
        gaps.append(body.place - MIRROR * other.place)
        if min(body.inertia.mass, other.inertia.mass) > 10 * DUMMY.mass:
            gaps.append(body.inertia.lever - MIRROR * other.inertia.lever)
        one, two = (x.inertia.toPseudoInertia().toMatrix() for x in (body, other))
        mean = (one + IMAGE * two) / 2
        apart = np.abs(one - IMAGE * two)
        counts = min(1.0, mean[3, 3] / light)
        shares.append(counts * apart[3, 3] / mean[3, 3])
        shares.append(counts * apart[:3, :3].max() / max(np.trace(mean[:3, :3]), 1e-12))
        axis = MIRROR * other.axis * np.sign(MIRROR * other.axis @ body.axis)
        left = body.place[1] >= other.place[1]
        evened[name] = replace(
            body,
            place=(body.place + MIRROR * other.place) / 2,
            inertia=pin.PseudoInertia.FromMatrix(mean).toInertia(),
            axis=body.axis if left or np.linalg.norm(axis - body.axis) >= 10 * AXIS_RAD else axis,
        )
    gap = float(np.abs(gaps).max())
    share = float(max(shares))
    even = gap <= CAD_M and share <= CAD_SHARE
    done = "evened out" if even else "differ, left as they are"
    if max(gap, share) > ALIKE:
        changed[f"left and right {done}, places"] = (1e3 * gap, "mm")
        changed[f"left and right {done}, masses"] = (100 * share, "%")
    return list((evened if even else moved).values())


def _opposite(left: Body, right: Body) -> Body:
    """The right body with its origin, which may lie anywhere on its axis, opposite to the left
    one's.
    """
    along = float((left.place - MIRROR * right.place) @ left.axis)
    if abs(along) <= CAD_M or left is right:  # which is evened out
        return right
    place = right.place + MIRROR * (along * left.axis)
    inertia = shifted(right.place - place).act(right.inertia)
    return replace(right, place=place, inertia=inertia)


def _images(bodies: list[Body]) -> dict[str, str]:
    """The body that mirrors each one, by their names; one in the middle is its own image."""
    trunk, *others = bodies
    images = {trunk.name: trunk.name}
    for body in others:
        like = []
        for other in others if body.name not in images else ():
            way = MIRROR * other.place - body.place
            # an origin may lie anywhere on its axis, but no body is its own counterpart by that
            along = 0.0 if other is body else way @ body.axis
            across = np.abs(way - along * body.axis).max()
            alike = abs(MIRROR * body.axis @ other.axis) > SAME and across < PAIR_M
            if alike and other.parent == images.get(body.parent):
                like.append((np.abs(way).max(), other.name))
        if like:
            _, image = min(like)
            images |= {body.name: image, image: body.name}
    return images
