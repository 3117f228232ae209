"""What can be found in a URDF that nobody has described yet: roles, soles, and a first TOML file to
look through.

Which joint is which is found from how it moves its links, never from its name.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import combinations, takewhile
from pathlib import Path
from typing import NoReturn

import numpy as np

from jumplab.robot.files import LEG, ROLES
from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.checks import MOST_RAD_S
from jumplab.robot_import.urdf import MOVING, Joint, Tree, read_urdf
from jumplab.robot_import.write import filled, quote

# None of these numbers is printed by the paper.
SWINGS = 0.6  # cosine: joints canted by up to 53 deg swing a leg
# cosine: shoulders canted by less than 2.6 deg swing arms in the plane; others are held
PARALLEL = 0.999
# share of the robot's height within which the ankles are above the lowest joint: arms end higher
LOWEST = 0.15
# a knee whose range is as even as this says nothing of where the robot faces: its feet do
EVEN_RAD = 0.3
SAME_M = 0.02  # how far from mirror images two limbs may stand
# ranges of joints that turn without stops, or whose stops nobody told: a person's, nearly
ASSUMED_RAD = {
    "hip_pitch": (-2.0, 0.6),
    "knee": (0.0, 2.3),
    "ankle_pitch": (-0.9, 0.7),
    "shoulder_pitch": (-2.0, 2.0),
    "other": (-0.4, 0.4),
}
BACKWARD_M = 0.01  # feet whose middle is this far behind the ankle seem to be put on backwards
STEEP = 0.9  # cosine between the leg, hip to ankle, and the vertical
SMALLEST_M = 0.03  # a shape shorter than this is a marker, no sole
# a sole where nothing is known: the default robot's, as shares of the leg's length from hip to
# ankle
GUESS_X = (-0.143, 0.2)
GUESS_Y = (-0.071, 0.071)
GUESS_Z = -0.107
STANCE_KNEE_RAD = 0.5  # as the default robot stands
STANCE_TRUNK_RAD = 0.05
STANCE_ROOM_RAD = 0.15  # from the joint stops
AXES = {
    sign + name: row
    for sign, s in (("+", 1.0), ("-", -1.0))
    for name, row in zip("xyz", s * np.eye(3), strict=True)
}
# axes of the root across the robot and up, in the order in which they are tried
GUESSES = ("+y+z", "+x+z", "+z+y", "+z-y", "+x+y", "+x-y", "+y+x", "+y-x", "+z+x", "+z-x")

Chain = list[Joint]


@dataclass(frozen=True)
class Roles:
    """What was found; ``assumed`` are limits that the URDF lacks, as in a table [limits]."""

    trunk: str  # link that carries both legs
    forward: str  # axis of the trunk's frame in the neutral pose, such as "+x"
    up: str
    # role -> (left, right); shoulder_pitch is () where the arms are held
    joints: dict[str, tuple[str, ...]]
    feet: tuple[str, str]  # (left, right) links moved by the last joints of the legs
    assumed: dict[str, dict[str, float]]
    notes: tuple[str, ...]  # what a person should know, one sentence each


def robot_axes(frame: np.ndarray, forward: str, up: str) -> np.ndarray:
    """(3, 3) from the axes of the URDF's root to x forward, y left, z up.

    ``frame`` (3, 3) is the trunk's, in which ``forward`` and ``up`` are signed axes such as "+x" or
    "-y".
    """
    ahead = frame @ AXES[forward]
    above = frame @ AXES[up]
    return np.stack([ahead, np.cross(above, ahead), above])


class _Finder:
    """Chains of joints, if the axes ``lateral`` and ``up`` (3,) lead across the robot and up."""

    def __init__(self, tree: Tree, guess: str, every_kind: bool = False):
        self.tree = tree
        self.lateral = AXES[guess[:2]]
        self.up = AXES[guess[2:]]
        self.at = {name: tree.pose[j.child].translation for name, j in tree.joints.items()}
        self.axis = {name: tree.pose[j.child].rotation @ j.axis for name, j in tree.joints.items()}
        self.tips = self._tips(every_kind)
        self.legs = self._legs()

    def _tips(self, every_kind: bool) -> list[Chain]:
        """Chains of the joints that could have a role, or look like it, to all last links."""

        def counts(j: Joint) -> bool:
            axis = j.kind == "fixed" and j.element.find("axis") is not None
            return j.driven or (every_kind and (j.kind in (*MOVING, "planar") or axis))

        carrying = {joint.parent for joint in self.tree.joints.values()}
        ends = [link for link in self.tree.elements if link not in carrying]
        chains = [[j for j in self.tree.chain(link) if counts(j)] for link in ends]
        return [chain for chain in chains if chain]

    def limbs(self) -> list[tuple[Chain, Chain]]:
        """Pairs of chains whose tips mirror each other across the plane between the hips, on the
        negative and on the positive side of the lateral axis.
        """
        unique = {c[-1]: c for c in self.tips}
        inner = {joint for chain in self.tips for joint in chain[:-1]}
        chains = [chain for tip, chain in unique.items() if tip not in inner]
        out = []
        for a, b in combinations(chains, 2):
            gap = self.at[b[-1].name] - self.at[a[-1].name]
            side = float(gap @ self.lateral)
            mirrored = abs(side) >= SAME_M >= np.linalg.norm(gap - side * self.lateral)
            shared = sum(x is y for x, y in zip(a, b, strict=False))
            if mirrored and shared < len(a) == len(b):
                pair = (a[shared:], b[shared:])
                out.append(pair if side > 0 else pair[::-1])
        return out

    def turning(self, joint: Joint) -> float:
        """Cosine [1] between a joint's axis and the lateral one."""
        return abs(self.axis[joint.name] @ self.lateral)

    def pitch(self, chain: Chain) -> Chain:
        """Joints of a chain about the lateral axis, more or less (by :data:`SWINGS`)."""
        return [joint for joint in chain if self.turning(joint) > SWINGS]

    def triple(self, chain: Chain) -> tuple[Joint, ...]:
        """Hip, knee, ankle: the three pitch joints with the longest shorter segment between them,
        canted ones last; () if there are none.
        """

        def shorter(three: tuple[Joint, ...]) -> float:
            flat = np.array([self.at[j.name] for j in three]) * (1 - np.abs(self.lateral))
            turning = np.prod([self.turning(j) for j in three])
            return turning * min(np.linalg.norm(np.diff(flat, axis=0), axis=1))

        best = max(combinations(self.pitch(chain), 3), key=shorter, default=())
        return best if best and shorter(best) > 1e-3 else ()

    def along(self, three: tuple[Joint, ...]) -> bool:
        """True if the leg hangs (from hip to ankle), and ends where the robot does."""
        if not three:
            return False
        hip, _, ankle = (self.at[joint.name] for joint in three)
        heights = np.array([*self.at.values()]) @ self.up
        low = ankle @ self.up < heights.min() + LOWEST * np.ptp(heights)
        return low and (hip - ankle) @ self.up > STEEP * np.linalg.norm(hip - ankle)

    def _legs(self) -> list[tuple[tuple[Joint, ...], Chain]]:
        """(hip, knee, ankle) and chain of both legs: the lowest mirrored pair; [] without any."""
        pairs = [[(self.triple(chain), chain) for chain in limb] for limb in self.limbs()]
        pairs = [pair for pair in pairs if self.along(pair[0][0]) and pair[1][0]]
        return min(pairs, key=lambda pair: self.at[pair[0][0][2].name] @ self.up, default=[])

    def foot(self, three: tuple[Joint, ...], chain: Chain) -> str:
        """The link that stands: behind the ankle, before any toe joint (a further pitch joint)."""
        beyond = chain[chain.index(three[2]) + 1 :]
        still = takewhile(lambda joint: self.turning(joint) < SWINGS, beyond)
        return [three[2], *still][-1].child

    def ahead(self, forward: np.ndarray) -> float:
        """How far the feet reach ahead of the ankles minus how far behind, half of it [m], if they
        look along ``forward`` (3,).
        """
        out = []
        for three, chain in self.legs:
            foot = self.foot(three, chain)
            axes = np.stack([forward, np.cross(self.up, forward), self.up])
            x = self.tree.sole(foot, axes)[:, 0]
            if not len(x):
                x = [self.tree.pose[foot].rotation @ self.tree.body_of(foot).lever @ forward]
            away = (self.tree.pose[foot].translation - self.at[three[2].name]) @ forward
            out.append(float((np.max(x) + np.min(x)) / 2 + away))
        return max(out)

    def shoulders(self, notes: list[str]) -> tuple[Joint, ...]:
        """The first pitch joints of the heaviest mirrored pair of limbs that are no legs, on the
        side of the lateral axis last; or () with a note.
        """
        firsts = {chain[0] for _, chain in self.legs}
        arms = [limb for limb in self.limbs() if not firsts & {chain[0] for chain in limb}]
        if not arms:
            notes.append("no arms were found: the shoulder is left out")
            return ()
        heaviest = max(arms, key=lambda limb: self.tree.carried(limb[0][0].child))
        pair = tuple(chain[0] for chain in heaviest)
        cosine = min(map(self.turning, pair))
        if cosine > PARALLEL:
            return pair
        notes.append(
            f"the arms are held: the first joint, {pair[0].name!r}, turns "
            f"{np.degrees(np.arccos(cosine)):.1f} deg off the pitch axis"
        )
        return ()


def find_roles(tree: Tree) -> Roles:
    """Legs, knees, feet, arms and forward direction; else a :class:`RobotError` says why."""
    finders = (_Finder(tree, guess) for guess in GUESSES)
    finder = next((finder for finder in finders if finder.legs), None) or _explain(tree)
    knee = finder.legs[0][0][1]
    middle = knee.limits.get("lower", 0.0) + knee.limits.get("upper", 0.0)
    left = finder.lateral * np.sign(finder.axis[knee.name] @ finder.lateral)
    left = left * (np.sign(middle) or 1.0)
    if abs(middle) < EVEN_RAD and finder.ahead(np.cross(left, finder.up)) < 0:
        left = -left
    forward = np.cross(left, finder.up)
    order = slice(None, None, -1 if left @ finder.lateral > 0 else 1)
    notes = []
    pairs = [*zip(*(three for three, _ in finder.legs), strict=True), finder.shoulders(notes)]
    joints = {
        role: tuple(joint.name for joint in pair[order])
        for role, pair in zip(ROLES, pairs, strict=True)
    }
    feet = tuple(finder.foot(*leg) for leg in finder.legs)[order]
    if (reach := finder.ahead(forward)) < -BACKWARD_M:
        notes.append(
            f"the feet point backwards ({reach:.3f} m) for a robot whose knees bend backwards; "
            f"check forward"
        )
    ways = [tree.chain(foot) for foot in feet]
    trunk = [tree.root, *(j.child for j in ways[0] if j in ways[1])][-1]
    frame = tree.pose[trunk].rotation
    ahead, above = (
        max(AXES, key=lambda name: frame @ AXES[name] @ x) for x in (forward, finder.up)
    )
    assumed = _assumed(finder, leg_joints(tree, trunk, feet), joints, left)
    for name, limits in assumed.items():
        values = ", ".join(f"{key} = {value:g}" for key, value in limits.items())
        notes.append(
            f"joint {name!r}: {values} assumed, the URDF has none that can be meant; correct "
            f"[limits.{name}]"
        )
    return Roles(trunk, ahead, above, joints, feet, assumed, tuple(notes))


def _assumed(
    finder: _Finder, in_legs: list[str], joints: dict, left: np.ndarray
) -> dict[str, dict[str, float]]:
    """Ranges [rad] of joints without any, by role; speeds [rad/s] of others, not too high."""
    roles = dict.fromkeys(in_legs, "other")
    roles |= {name: role for role, pair in joints.items() for name in pair}
    out = {}
    for name, role in roles.items():
        given = finder.tree.joints[name].limits
        limits = {}
        if not {"lower", "upper"} <= set(given):
            low, high = ASSUMED_RAD[role]
            ends = (low, high) if finder.axis[name] @ left > 0 else (0.0 - high, 0.0 - low)
            limits |= zip(("lower", "upper"), ends, strict=True)
        if role == "other" and MOST_RAD_S < given.get("velocity", 0.0) <= 2 * MOST_RAD_S:
            limits["velocity"] = MOST_RAD_S
        if limits:
            out[name] = limits
    return out


def leg_joints(tree: Tree, trunk: str, feet: tuple[str, str]) -> list[str]:
    """Names of the driven joints between a trunk and both feet (left, right)."""
    return [j.name for foot in feet for j in tree.path_between(trunk, foot) if j.driven]


def _explain(tree: Tree) -> NoReturn:
    """Raise with the reason why there are no two legs."""
    finders = (_Finder(tree, guess, every_kind=True) for guess in GUESSES)
    legs = next((finder.legs for finder in finders if finder.legs), [])
    for three, _ in legs:
        for role, joint in zip(LEG, three, strict=True):
            if not joint.driven:
                kind = f"is of type {joint.kind!r}"
                if joint.limits.get("effort") == 0:
                    kind = "has effort = 0 N m"
                elif joint.mimic:
                    kind = f"mimics {joint.mimic[0]!r}"
                raise tree.error(
                    f"joint {joint.name!r} {kind}, but has the place of a "
                    f"{role.replace('_', ' ')}, which must be revolute with a range and a motor "
                    f"of its own"
                )
    finder = _Finder(tree, GUESSES[0])
    hanging = {chain[-1].name for chain in finder.tips if finder.along(finder.triple(chain))}
    if len(hanging) == 1:
        raise tree.error(
            f"one leg only: the chain that ends with joint {hanging.pop()!r} has no "
            f"mirror image among {len(tree.elements)} links; a jumper needs two legs"
        )
    best = max(map(finder.pitch, finder.tips), key=len, default=[])
    shown = ", ".join(repr(j.name) for j in best[:4]) or "none"
    raise tree.error(
        f"no pair of mirrored legs with three revolute pitch joints (hip, knee, "
        f"ankle) was found; the most on one chain about +-y are {len(best)} ({shown})"
    )


# the first description
# ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sole:
    """Rectangle along the robot's axes, from the foot link's origin [m], and its source."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: float
    source: str


def find_sole(tree: Tree, foot: str, turn: np.ndarray, leg_m: float) -> Sole:
    """Sole of the left foot, from whatever shapes its links have: boxes, spheres, or meshes that
    are at hand.

    ``turn`` (3, 3) leads from the root's axes to the robot's; from ``leg_m``, the length from hip
    to ankle, a sole is guessed if the link ``foot`` has no shape.
    """
    low = tree.sole(foot, turn)
    if len(low):
        x, y, z = zip(low.min(axis=0).tolist(), low.max(axis=0).tolist(), strict=True)
        if min(x[1] - x[0], y[1] - y[0]) > SMALLEST_M:
            links = [link for link in tree.bodies[tree.carrier[foot]] if len(tree.points(link))]
            kinds = sorted({shape.tag for link in links for _, shape in tree.shapes(link)})
            return Sole(x, y, z[0], f"from its {' and '.join(kinds)}")
    x, y = (tuple(leg_m * share for share in shares) for shares in (GUESS_X, GUESS_Y))
    source = "GUESSED from the leg's length: the foot has no shape that is at hand"
    return Sole(x, y, leg_m * GUESS_Z, source)


def starter(
    tree: Tree, urdf: str, name: str, repair: tuple[str, ...] = ()
) -> tuple[str, Roles, Sole]:
    """Text of a first TOML file, from ``starter.toml.in``, and the roles and the sole that are
    written into it.

    ``urdf`` is the path as the file shall name it, ``name`` the robot's, ``repair`` what the person
    allows to be repaired. Raises :class:`RobotError` if the URDF has no two legs.
    """
    roles = find_roles(tree)
    turn = robot_axes(tree.pose[roles.trunk].rotation, roles.forward, roles.up)
    hip, _, ankle = (tree.pose[tree.joints[roles.joints[r][0]].child].translation for r in LEG)
    leg_m = float(np.linalg.norm((turn @ (hip - ankle))[[0, 2]]))
    sole = find_sole(tree, roles.feet[0], turn, leg_m)
    assumed = "".join(
        f"\n[limits.{quote(joint)}]  # assumed\n"
        + "".join(f"{key} = {x:g}\n" for key, x in limits.items())
        for joint, limits in roles.assumed.items()
    )
    text = filled(
        "starter.toml.in",
        notes="".join(f"# note: {note}\n" for note in roles.notes),
        name=name,
        urdf=quote(Path(urdf).as_posix()),
        roles=roles,
        repair=quote(repair),
        joints="\n".join(f"{role} = {quote(roles.joints[role])}" for role in ROLES),
        feet=quote(roles.feet),
        sole=sole,
        knee=_inside(tree, turn[1], roles.joints["knee"], STANCE_KNEE_RAD),
        trunk=STANCE_TRUNK_RAD,
        assumed=assumed,
        shoulder=_inside(tree, turn[1], roles.joints["shoulder_pitch"], 0.0),
    )
    return text, roles, sole


def _inside(tree: Tree, left: np.ndarray, pair: tuple[str, ...], wish: float) -> float:
    """The angle about ``left`` (3,) nearest to ``wish``, well inside both ranges [rad]."""
    low = -np.inf
    high = np.inf
    for joint in (tree.joints[name] for name in pair):
        sign = np.sign(left @ tree.pose[joint.child].rotation @ joint.axis)
        ends = joint.limits.get("lower", -np.pi), joint.limits.get("upper", np.pi)
        low = max(low, min(sign * np.array(ends)))
        high = min(high, max(sign * np.array(ends)))
    room = min(STANCE_ROOM_RAD, (high - low) / 3)
    return float(np.clip(wish, low + room, high - room)) if low < high else wish


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
    tree = urdf_checks.read_tree(read_urdf(path), path.name, path, repair)
    # a short name of letters, digits, - and _
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", tree.xml.get("name") or path.stem).strip("_")[:40]
    text, roles, sole = starter(tree, str(path.resolve()), name or "robot", repair)
    roles = replace(roles, notes=(*urdf_checks.notes(tree.xml, repair), *roles.notes))
    names = [name for pair in roles.joints.values() for name in pair]
    names += leg_joints(tree, roles.trunk, roles.feet)
    wrong = [
        f"{sentence}, or tell it in [limits.{name}] of the configuration"
        for name in dict.fromkeys(names)
        for sentence in urdf_checks.limit_faults(
            tree.joints[name].element, path.name, roles.assumed.get(name)
        )
    ]
    return Draft(text, roles, sole, tuple(wrong))
