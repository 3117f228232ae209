"""What can be found in a URDF that nobody has described yet: roles, soles, and a first TOML file to look through.

Which joint is which is found from how it moves its links, never from its name.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import NoReturn

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.checks import PLAUSIBLE
from jumplab.robot_import.config import LEG, ROLES, filled, texts
from jumplab.robot_import.urdf import MOVING, Joint, Tree, parse, read_urdf

# None of these numbers is printed by the paper.
SWINGS = 0.6  # cosine: joints canted by up to 53 deg swing a leg
PARALLEL = 0.999  # cosine: shoulders canted by less than 2.6 deg swing arms in the plane; others are held
LOWEST = 0.15  # share of the robot's height within which the ankles are above the lowest joint: arms end higher
EVEN_RAD = 0.3  # a knee whose range is as even as this says nothing of where the robot faces: its feet do
SAME_M = 0.02  # how far from mirror images two limbs may stand
# ranges of joints that turn without stops, or whose stops nobody told: a person's, nearly
ASSUMED_RAD = {"hip_pitch": (-2.0, 0.6), "knee": (0.0, 2.3), "ankle_pitch": (-0.9, 0.7), "other": (-0.4, 0.4)}
ASSUMED_RAD["shoulder_pitch"] = (-2.0, 2.0)
BACKWARD_M = 0.01  # feet whose middle is this far behind the ankle seem to be put on backwards
STEEP = 0.9  # cosine between the leg, hip to ankle, and the vertical
SMALLEST_M = 0.03  # a shape shorter than this is a marker, no sole
# a sole where nothing is known: the default robot's, as shares of the leg's length from hip to ankle
GUESS_X, GUESS_Y, GUESS_Z = (-0.143, 0.2), (-0.071, 0.071), -0.107
STANCE_KNEE_RAD, STANCE_TRUNK_RAD = 0.5, 0.05  # as the default robot stands
STANCE_ROOM_RAD = 0.15  # from the joint stops
AXES = dict(zip("xyz", np.eye(3), strict=True))


@dataclass(frozen=True)
class Roles:
    """What was found; ``assumed`` are limits of joints for which the URDF has none, as in a table [limits]."""

    trunk: str  # link that carries both legs
    forward: str  # axis of the trunk's frame in the neutral pose, such as "+x"
    up: str
    joints: dict[str, tuple[str, ...]]  # role -> (left, right); shoulder_pitch is () where the arms are held
    feet: tuple[str, str]  # (left, right) links moved by the last joints of the legs
    assumed: dict[str, dict[str, float]]
    notes: tuple[str, ...]  # what a person should know, one sentence each


def robot_axes(frame: np.ndarray, forward: str, up: str) -> np.ndarray:
    """(3, 3) from the axes of the URDF's root to x forward, y left, z up.

    ``frame`` (3, 3) is the trunk's, in which ``forward`` and ``up`` are signed axes such as "+x" or "-y".
    """
    ahead, above = (frame @ AXES[text[-1]] * (-1.0 if text[0] == "-" else 1.0) for text in (forward, up))
    return np.stack([ahead, np.cross(above, ahead), above])


def _signed(vector: np.ndarray) -> str:
    i = int(np.argmax(np.abs(vector)))
    return ("-" if vector[i] < 0 else "+") + "xyz"[i]


Chain = list[Joint]
Limb = tuple[Chain, Chain]  # mirror images, on the negative and on the positive side of the lateral axis


class _Finder:
    def __init__(self, tree: Tree):
        self.tree, self.pose = tree, tree.poses()
        self.at = {j.name: self.pose[j.child].translation for j in tree.joints.values()}
        self.axis = {j.name: self.pose[j.child].rotation @ j.axis for j in tree.joints.values()}

    def moving(self, link: str, every_kind: bool = False) -> Chain:
        """Joints above a link that could have a role, or that look like it."""
        chain = self.tree.chain(link)
        if every_kind:
            kinds = (*MOVING, "planar")
            return [j for j in chain if j.kind in kinds or (j.kind == "fixed" and j.element.find("axis") is not None)]
        return [j for j in chain if j.driven]

    def tips(self, every_kind: bool = False) -> list[Chain]:
        """The chains of all links that carry nothing."""
        chains = [self.moving(link, every_kind) for link in self.tree.links if not self.tree.below[link]]
        return [chain for chain in chains if chain]

    def limbs(self, lateral: np.ndarray, every_kind: bool = False) -> list[Limb]:
        """Pairs of chains whose tips mirror each other across the plane between the hips."""
        unique = {c[-1].name: c for c in self.tips(every_kind)}
        chains = [c for c in unique.values() if not any(c[-1] in o[:-1] for o in unique.values())]
        out = []
        for a, b in combinations(chains, 2):
            gap = self.at[b[-1].name] - self.at[a[-1].name]
            side = float(gap @ lateral)
            if len(a) != len(b) or abs(side) < SAME_M or np.linalg.norm(gap - side * lateral) > SAME_M:
                continue
            shared = sum(x is y for x, y in zip(a, b, strict=True))
            if shared < len(a):
                out.append((a[shared:], b[shared:]) if side > 0 else (b[shared:], a[shared:]))
        return out

    def pitch(self, chain: Chain, lateral: np.ndarray) -> Chain:
        """Joints of a chain that turn about the lateral axis, more or less."""
        return [j for j in chain if abs(self.axis[j.name] @ lateral) > SWINGS]

    def triple(self, chain: Chain, lateral: np.ndarray) -> tuple[Joint, Joint, Joint] | None:
        """Hip, knee, ankle: the three pitch joints with the longest shorter segment between them, canted ones last."""

        def shorter(three: tuple[Joint, Joint, Joint]) -> float:
            flat = np.array([self.at[j.name] for j in three]) * (1 - np.abs(lateral))
            turning = np.prod([abs(self.axis[j.name] @ lateral) for j in three])
            return turning * min(np.linalg.norm(np.diff(flat, axis=0), axis=1))

        best = max(combinations(self.pitch(chain, lateral), 3), key=shorter, default=None)
        return best if best and shorter(best) > 1e-3 else None

    def along(self, three: tuple[Joint, Joint, Joint], up: np.ndarray) -> bool:
        """True if the leg hangs from hip to ankle, and ends where the robot does."""
        leg, heights = self.at[three[2].name] - self.at[three[0].name], np.array([x @ up for x in self.at.values()])
        low = self.at[three[2].name] @ up < heights.min() + LOWEST * np.ptp(heights)
        return low and leg @ -up > STEEP * np.linalg.norm(leg)

    def legs(self, every_kind: bool = False) -> tuple | None:
        """(lateral, up, limb, triples) of the legs: the lowest mirrored pair with hip, knee and ankle; or None."""
        for l_axis, u_axis in ("yz", "xz", "zy", "xy", "yx", "zx"):
            lateral, found = AXES[l_axis], []
            for limb in self.limbs(lateral, every_kind):
                threes = [self.triple(chain, lateral) for chain in limb]
                if None in threes:
                    continue
                hip, ankle = self.at[threes[0][0].name], self.at[threes[0][2].name]
                up = AXES[u_axis] * (1.0 if u_axis == "z" else np.sign((hip - ankle) @ AXES[u_axis]))
                if self.along(threes[0], up):
                    found.append((lateral, up, limb, threes, ankle @ up))
            if found:
                return min(found, key=lambda x: x[-1])[:-1]
        return None


def find_roles(tree: Tree) -> Roles:
    """Find legs, knees, feet, arms and the forward direction; raises :class:`RobotError` with what is missing."""
    finder = _Finder(tree)
    lateral, up, limb, threes = finder.legs() or _explain(finder)
    knee = threes[0][1]
    middle = knee.limits.get("lower", 0.0) + knee.limits.get("upper", 0.0)
    left = lateral * np.sign(finder.axis[knee.name] @ lateral) * (np.sign(middle) or 1.0)
    if abs(middle) < EVEN_RAD:
        ahead = np.cross(left, up)
        soles = [(_foot(finder, x, chain, lateral), x[2].name) for x, chain in zip(threes, limb, strict=True)]
        reach = [_ahead(finder, *sole, ahead, up) for sole in soles]
        left = left * (1.0 if max(reach) >= 0 else -1.0)
    forward = np.cross(left, up)
    order = (1, 0) if left @ lateral > 0 else (0, 1)
    joints = {role: tuple(threes[i][k].name for i in order) for k, role in enumerate(LEG)}
    feet = tuple(_foot(finder, threes[i], limb[i], lateral) for i in order)
    notes = []
    joints["shoulder_pitch"] = _shoulders(finder, lateral, limb, order, notes)
    ankles = joints["ankle_pitch"]
    ahead = max(_ahead(finder, foot, ankle, forward, up) for foot, ankle in zip(feet, ankles, strict=True))
    if ahead < -BACKWARD_M:
        notes.append(f"the feet point backwards ({ahead:.3f} m) for a robot whose knees bend backwards; check forward")
    trunk = tree.joining(*feet)
    frame = finder.pose[trunk].rotation.T
    assumed = _assumed(finder, trunk, feet, joints, left)
    for name, limits in assumed.items():
        told = ", ".join(f"{key} = {value:g}" for key, value in limits.items())
        notes.append(f"joint {name!r}: {told} assumed, the URDF has none that can be meant; correct [limits.{name}]")
    return Roles(trunk, _signed(frame @ forward), _signed(frame @ up), joints, feet, assumed, tuple(notes))


def _assumed(finder: _Finder, trunk: str, feet: tuple, joints: dict, left: np.ndarray) -> dict[str, dict[str, float]]:
    """Ranges [rad] of joints that have none, by their role; speeds [rad/s] of joints beside the roles, not too high."""
    out, roles, fastest = {}, {name: role for role, pair in joints.items() for name in pair}, PLAUSIBLE.speed_rad_s
    roles = {j.name: "other" for foot in feet for j in finder.tree.path_between(trunk, foot) if j.driven} | roles
    for joint in (finder.tree.joints[name] for name in roles):
        low, high = ASSUMED_RAD[roles[joint.name]]
        ends = (low, high) if finder.axis[joint.name] @ left > 0 else (0.0 - high, 0.0 - low)
        lost = not {"lower", "upper"} <= set(joint.limits)
        limits = dict(zip(("lower", "upper"), ends, strict=True)) if lost else {}
        if roles[joint.name] == "other" and fastest < joint.limits.get("velocity", 0.0) <= 2 * fastest:
            limits["velocity"] = fastest
        if limits:
            out[joint.name] = limits
    return out


def _foot(finder: _Finder, three: tuple, chain: Chain, lateral: np.ndarray) -> str:
    """The link that stands: behind the ankle, before any toe joint (a pitch joint beyond the ankle)."""
    at = chain.index(three[2])
    while at + 1 < len(chain) and abs(finder.axis[chain[at + 1].name] @ lateral) < SWINGS:
        at += 1
    return chain[at].child


def _ahead(finder: _Finder, foot: str, ankle: str, forward: np.ndarray, up: np.ndarray) -> float:
    """How far the foot reaches ahead of the ankle minus how far behind, half of it [m]."""
    pose = finder.pose[foot]
    points = finder.tree.sole(foot, np.stack([forward, np.cross(up, forward), up]))[:, 0]
    if not len(points):
        points = (pose.rotation @ finder.tree.links[foot].inertia.lever)[None] @ forward
    return float((points.max() + points.min()) / 2 + (pose.translation - finder.at[ankle]) @ forward)


def _shoulders(
    finder: _Finder, lateral: np.ndarray, legs: Limb, order: tuple[int, int], notes: list[str]
) -> tuple[str, ...]:
    """The first pitch joints of the heaviest mirrored pair of limbs that are no legs, or () with a note."""
    firsts = {c[0].name for c in legs}
    arms = [x for x in finder.limbs(lateral) if not firsts & {c[0].name for c in x}]
    if not arms:
        notes.append("no arms were found: the shoulder is left out")
        return ()
    pair = [limb[0] for limb in max(arms, key=lambda x: finder.tree.carried(x[0][0].child))]
    cosine = min(abs(finder.axis[joint.name] @ lateral) for joint in pair)
    if cosine > PARALLEL:
        return tuple(pair[i].name for i in order)
    cant = np.degrees(np.arccos(cosine))
    notes.append(f"the arms are held: the first joint, {pair[0].name!r}, turns {cant:.1f} deg off the pitch axis")
    return ()


def _explain(finder: _Finder) -> NoReturn:
    """Raise with the reason why there are no two legs."""
    tree, where, lateral = finder.tree, finder.tree.where, AXES["y"]
    every = finder.legs(every_kind=True)
    for three in every[3] if every else ():
        for role, joint in zip(LEG, three, strict=True):
            if not joint.driven:
                kind = f"mimics {joint.mimic[0]!r}" if joint.mimic else f"is of type {joint.kind!r}"
                kind = "has effort = 0 N m" if joint.limits.get("effort") == 0 else kind
                said = f"{where}: joint {joint.name!r} {kind}, but has the place of a {role.replace('_', ' ')}"
                raise RobotError(f"{said}, which must be revolute with a range and a motor of its own")
    tips = finder.tips()
    hanging = [c for c in tips if (three := finder.triple(c, lateral)) and finder.along(three, AXES["z"])]
    names = {c[-1].name for c in hanging}
    if len(names) == 1:
        said = f"{where}: one leg only: the chain that ends with joint {names.pop()!r} has no mirror image"
        raise RobotError(f"{said} among {len(tree.links)} links; a jumper needs two legs")
    best = max((finder.pitch(c, lateral) for c in tips), key=len, default=[])
    shown = ", ".join(repr(j.name) for j in best[:4]) or "none"
    said = f"{where}: no pair of mirrored legs with three revolute pitch joints (hip, knee, ankle) was found"
    raise RobotError(f"{said}; the most on one chain about +-y are {len(best)} ({shown})")


# the first description ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sole:
    """Rectangle along the robot's axes, from the origin of the foot link [m]; ``source`` says where it comes from."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: float
    source: str


def find_sole(tree: Tree, foot: str, turn: np.ndarray, leg_m: float) -> Sole:
    """Sole of the left foot, from whatever shapes its links have: boxes, spheres, or meshes that are at hand.

    ``turn`` (3, 3) leads from the root's axes to the robot's; from ``leg_m``, the length from hip to ankle, a sole is
    guessed if the link ``foot`` has no shape.
    """
    low, links = tree.sole(foot, turn), tree.fixed_to(foot)
    if len(low):
        kinds = {shape.tag for link in links if len(tree.points(link)) for _, shape in tree.links[link].shapes}
        (x0, y0, z), (x1, y1, _) = low.min(axis=0).tolist(), low.max(axis=0).tolist()
        if x1 - x0 > SMALLEST_M and y1 - y0 > SMALLEST_M:
            return Sole((x0, x1), (y0, y1), z, f"from its {' and '.join(sorted(kinds))}")
    x, y = (tuple(leg_m * share for share in shares) for shares in (GUESS_X, GUESS_Y))
    return Sole(x, y, leg_m * GUESS_Z, "GUESSED from the leg's length: the foot has no shape that is at hand")


def starter(tree: Tree, urdf: str, name: str, repair: tuple[str, ...] = ()) -> tuple[str, Roles, Sole]:
    """Text of a first TOML file, from ``starter.toml.in``, and the roles and the sole that are written into it.

    ``urdf`` is the path as the file shall name it, ``name`` the robot's, ``repair`` what the person allows to be
    repaired. Raises :class:`RobotError` if the URDF has no two legs.
    """
    roles, pose = find_roles(tree), tree.poses()
    turn = robot_axes(pose[roles.trunk].rotation, roles.forward, roles.up)
    hip, ankle = (pose[tree.joints[roles.joints[role][0]].child].translation for role in ("hip_pitch", "ankle_pitch"))
    sole = find_sole(tree, roles.feet[0], turn, float(np.linalg.norm((turn @ (hip - ankle))[[0, 2]])))
    text = filled(
        "starter.toml.in",
        notes="".join(f"# note: {note}\n" for note in roles.notes),
        name=name,
        urdf=texts([Path(urdf).as_posix()])[1:-1],
        roles=roles,
        repair=texts(repair),
        joints="\n".join(f"{role} = {texts(roles.joints[role])}" for role in ROLES),
        feet=texts(roles.feet),
        sole=sole,
        knee=_inside(tree, pose, turn, roles.joints["knee"], STANCE_KNEE_RAD),
        trunk=STANCE_TRUNK_RAD,
        assumed="".join(
            f"\n[limits.{texts([name])[1:-1]}]  # assumed\n" + "".join(f"{key} = {x:g}\n" for key, x in limits.items())
            for name, limits in roles.assumed.items()
        ),
        shoulder=_inside(tree, pose, turn, roles.joints["shoulder_pitch"], 0.0),
    )
    return text, roles, sole


def _inside(tree: Tree, pose: dict[str, pin.SE3], turn: np.ndarray, pair: tuple[str, ...], wish: float) -> float:
    """The angle about the robot's left that is nearest to ``wish`` and well inside the range of both joints [rad]."""
    low, high = -np.inf, np.inf
    for joint in map(tree.joints.get, pair):
        sign = float(np.sign((turn @ pose[joint.child].rotation @ joint.axis)[1]))
        ends = sorted(sign * joint.limits.get(k, d) for k, d in (("lower", -np.pi), ("upper", np.pi)))
        low, high = max(low, ends[0]), min(high, ends[1])
    room = min(STANCE_ROOM_RAD, (high - low) / 3)
    return float(np.clip(wish, low + room, high - room)) if low < high else wish


def safe_name(text: str) -> str:
    """A short name of letters, digits, - and _."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text).strip("_")[:40] or "robot"


@dataclass(frozen=True)
class Draft:
    """A URDF with a first description: ``text`` is the TOML, ``roles`` and ``sole`` what was found.

    ``faults`` are those of the limits of the joints that were found, one sentence each.
    """

    text: str
    roles: Roles
    sole: Sole
    faults: tuple[str, ...]


def draft(path: str | Path, repair: tuple[str, ...] = ()) -> Draft:
    """Find the roles in a URDF and write the first TOML file for it; raises :class:`RobotError`."""
    path = Path(path)
    root = parse(read_urdf(path), path.name)
    urdf_checks.check(root, path.name, repair)
    tree = Tree(root, path.name, path, "inertia" in repair)
    text, roles, sole = starter(tree, str(path.resolve()), safe_name(root.get("name") or path.stem), repair)
    roles = replace(roles, notes=(*urdf_checks.notes(root, repair), *roles.notes))
    names = [name for pair in roles.joints.values() for name in pair]
    names += [j.name for foot in roles.feet for j in tree.path_between(roles.trunk, foot) if j.driven]
    wrong = [
        f"{sentence}, or tell it in [limits.{name}] of the configuration"
        for name in dict.fromkeys(names)
        for sentence in urdf_checks.limit_faults(tree.joints[name].element, path.name, roles.assumed.get(name))
    ]
    return Draft(text, roles, sole, tuple(wrong))
