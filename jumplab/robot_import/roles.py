"""Roles, soles and a first TOML file to look through, found in a URDF that nobody has described
yet.

Which joint is which is found from how it moves its links, never from its name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, takewhile
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.linalg import norm

from jumplab.errors import RobotError
from jumplab.forms import filled
from jumplab.robot.files import LEG, ROLES
from jumplab.robot_import.checks import (
    MOST_RAD,
    MOST_RAD_S,
    limit_faults,
    notes,
    read_tree,
    wrong_limits,
)
from jumplab.robot_import.feet import Sole, find_sole, refuse_wheel, sole_points, thickness
from jumplab.robot_import.urdf import LIMITS, MOVING, Joint, Tree, across, read_urdf
from jumplab.robot_import.write import key, listed

# None of these numbers is printed by the paper.
SWINGS = 0.6  # cosine: joints canted by up to 53 deg swing a leg
# cosine: shoulders canted by less than 2.6 deg swing arms in the plane; others are held
PARALLEL = 0.999
# share of the robot's height within which the ankles are above the lowest joint: arms end higher
LOWEST = 0.15
# of what the hip carries: lighter ones are fingers of an arm; feet have 6 % or more
LIGHT_FOOT = 0.002
LIGHT_ARM = 0.01  # share of the robot's mass: lighter ones, such as antennas, swing nothing
# a range as even as this says nothing of where the robot faces
EVEN_RAD = 0.3
# nor do feet that reach less farther ahead than behind, as a share of the leg's length
EVEN_FEET = 0.02
FRAME_VOTE = 0.5  # of the root's x, which is ahead by custom; a range has 1, the feet up to 2
SHORTEST_LEG = 0.15  # share of the robot's height: shorter ones are fingers
TOES = 0.25  # of a shank: joints farther beyond the ankle are of the toes
FOOT_LIKE = 0.6  # a pitch joint this near the one before it, in shanks, is of the toes
SAME_M = 0.02  # how far from mirror images two limbs may stand
# ranges of joints that turn without stops, or whose stops are not in the file: a person's, nearly
ASSUMED_RAD = {
    "hip_pitch": (-2.0, 0.6),
    "knee": (0.0, 2.3),
    "ankle_pitch": (-0.9, 0.7),
    "shoulder_pitch": (-2.0, 2.0),
    "other": (-0.4, 0.4),
}
BACKWARD_M = 0.01  # feet whose middle is this far behind the ankle seem to be put on backwards
STEEP = 0.9  # cosine between the leg, hip to ankle, and the vertical
STANCE_KNEE_RAD = 0.5  # as the default robot stands
STANCE_TRUNK_RAD = 0.05
STANCE_ROOM_RAD = 0.15  # from the joint stops
AXES = {
    sign + name: row
    for sign, s in (("+", 1.0), ("-", -1.0))
    for name, row in zip("xyz", s * np.eye(3), strict=True)
}
# axes of the root across the robot and up, in the order in which they are tried
GUESSES = (
    "+y+z",
    "+x+z",
    "+z+y",
    "+z-y",
    "+x+y",
    "+x-y",
    "+y+x",
    "+y-x",
    "+z+x",
    "+z-x",
    "+y-z",
    "+x-z",
)

Chain = list[Joint]


@dataclass(frozen=True)
class Roles:
    """Roles found in a URDF; ``assumed`` are limits that the URDF lacks, as in a table [limits]."""

    trunk: str  # link that carries both legs
    forward: str  # axis of the trunk's frame in the neutral pose, such as "+x"
    up: str
    # role -> (left, right); shoulder_pitch is () where the arms are held
    joints: dict[str, tuple[str, ...]]
    feet: tuple[str, str]  # (left, right) links moved by the last joints of the legs
    assumed: dict[str, dict[str, float]]
    notes: tuple[str, ...]  # what a person should know, one sentence each


def opposite(axis: str) -> str:
    """A signed axis such as "+x", the other way."""
    return axis.translate(str.maketrans("+-", "-+"))


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
        self.tips = self._tips(every_kind)
        self.legs = self._legs()

    def _tips(self, every_kind: bool) -> list[Chain]:
        """Chains of the joints that could have a role, or look like it, to all last links."""

        def counts(j: Joint) -> bool:
            axis = j.kind == "fixed" and j.element.find("axis") is not None
            return j.driven or (every_kind and (axis or j.kind in (*MOVING, "planar")))

        carrying = {joint.parent for joint in self.tree.joints.values()}
        ends = [link for link in self.tree.elements if link not in carrying]
        chains = ([*filter(counts, self.tree.chain(link))] for link in ends)
        return [*filter(None, chains)]

    def limbs(self) -> list[tuple[Chain, Chain]]:
        """Pairs of chains whose tips mirror each other across the plane between the hips, on the
        negative and on the positive side of the lateral axis.
        """
        unique = {c[-1]: c for c in self.tips}
        inner = {joint for chain in self.tips for joint in chain[:-1]}
        chains = [chain for tip, chain in unique.items() if tip not in inner]
        out = []
        for a, b in combinations(chains, 2):
            gap = b[-1].at - a[-1].at
            side = gap @ self.lateral
            # an origin may lie anywhere on its axis
            apart = across(across(gap, self.lateral), b[-1].direction)
            mirrored = abs(side) >= SAME_M >= norm(apart)
            shared = sum(x is y for x, y in zip(a, b, strict=False))
            if mirrored and shared < len(a) == len(b):
                pair = (a[shared:], b[shared:])
                out.append(pair if side > 0 else pair[::-1])
        return out

    def turning(self, joint: Joint) -> float:
        """Cosine [1] between a joint's axis and the lateral one."""
        return abs(joint.direction @ self.lateral)

    def pitch(self, chain: Chain) -> Chain:
        """Joints of a chain about the lateral axis, more or less (by :data:`SWINGS`)."""
        return [joint for joint in chain if self.turning(joint) > SWINGS]

    def triple(self, chain: Chain) -> tuple[Joint, ...]:
        """Hip, knee, ankle: the three pitch joints with the longest shorter segment between them,
        canted ones last, before any of the toes; () if there are none.
        """
        pitch = self.pitch(chain)

        def shorter(three: tuple[Joint, ...]) -> float:
            flat = np.array([j.at for j in three]) * (1 - np.abs(self.lateral))
            turning = np.prod([self.turning(j) for j in three])
            return turning * min(norm(np.diff(flat, axis=0), axis=1))

        best = max(combinations(pitch, 3), key=shorter, default=())
        if not best or shorter(best) <= 1e-3:
            return ()
        hip, knee, ankle = best
        for joint in pitch[pitch.index(knee) + 1 : pitch.index(ankle)]:
            shank = norm(joint.at - knee.at)
            foot = ankle.at - joint.at
            flat = abs(foot @ self.up) < norm(across(foot, self.up))
            if flat and 0 < norm(foot) < FOOT_LIKE * shank:
                return hip, knee, joint
        return best

    def leg_m(self) -> float:
        """Length of a leg from hip to ankle [m]."""
        hip, _, ankle = self.legs[0][0]
        return float(norm(hip.at - ankle.at))

    def along(self, three: tuple[Joint, ...]) -> bool:
        """True if the leg hangs (from hip to ankle), and ends where the robot does, on a foot."""
        if not three:
            return False
        hip, _, ankle = three
        carried = self.tree.carried
        if 0 < carried(ankle.child) < LIGHT_FOOT * carried(hip.child):
            return False
        leg = hip.at - ankle.at
        heights = np.array([joint.at for joint in self.tree.joints.values()]) @ self.up
        tall = np.ptp(heights)
        low = ankle.at @ self.up < heights.min() + LOWEST * tall
        return low and norm(leg) > SHORTEST_LEG * tall and leg @ self.up > STEEP * norm(leg)

    def _legs(self) -> list[tuple[tuple[Joint, ...], Chain]]:
        """(hip, knee, ankle) and chain of both legs: the lowest mirrored pair; [] without any."""
        pairs = [[(self.triple(chain), chain) for chain in limb] for limb in self.limbs()]
        pairs = [pair for pair in pairs if self.along(pair[0][0]) and pair[1][0]]
        return min(pairs, key=lambda pair: pair[0][0][2].at @ self.up, default=[])

    def refuse_four(self) -> None:
        """Raise if other limbs stand as well: arms end higher."""
        firsts = {chain[0] for _, chain in self.legs}
        for limb in self.limbs():
            other = all(self.along(self.triple(chain)) for chain in limb)
            if other and not firsts & {joint for chain in limb for joint in chain}:
                names = listed(x[-1].name for x in (*limb, *(chain for _, chain in self.legs)))
                raise self.tree.error(
                    f"four legs end on the ground, with the joints {names}: jumps are planned for "
                    f"robots with two"
                )

    def foot(self, three: tuple[Joint, ...], chain: Chain) -> str:
        """The link that stands: behind the ankle, before any toe joint (a further pitch joint)."""
        _, knee, ankle = three
        near = TOES * norm(ankle.at - knee.at)

        def of_ankle(joint: Joint) -> bool:
            # an origin may lie anywhere on its axis
            apart = across(joint.at - ankle.at, joint.direction)
            return norm(apart) < near and self.turning(joint) < SWINGS

        still = takewhile(of_ankle, chain[chain.index(ankle) + 1 :])
        return [ankle, *still][-1].child

    def ahead(self, forward: np.ndarray) -> float:
        """Reach of the feet ahead of the ankles minus that behind, halved [m], if they point along
        ``forward`` (3,).
        """
        out = []
        for three, chain in self.legs:
            foot = self.foot(three, chain)
            axes = np.stack([forward, np.cross(self.up, forward), self.up])
            _, around, _ = sole_points(self.tree, foot, axes, thickness(self.leg_m()))
            x = around[:, 0]
            if not len(x):
                x = [self.tree.pose[foot].rotation @ self.tree.body_of(foot).lever @ forward]
            away = (self.tree.pose[foot].translation - three[2].at) @ forward
            out.append(float((np.max(x) + np.min(x)) / 2 + away))
        return max(out)

    def middle(self, joints: Sequence[Joint], left: np.ndarray) -> float:
        """Sign of the middle of the joints' ranges about ``left`` (3,): -1 or 1; 0 if the middle is
        near 0, or if they have no range.
        """
        sums = []
        for joint in joints:
            low, high = (joint.limits.get(end, 0.0) for end in ("lower", "upper"))
            real = max(abs(low), abs(high)) <= MOST_RAD
            sums.append((low + high) * np.sign(joint.direction @ left) * real)
        mean = float(np.mean(sums)) if sums else 0.0
        return float(np.sign(mean)) * (abs(mean) >= EVEN_RAD)

    def leftward(self, notes: list[str]) -> np.ndarray:
        """The axis (3,) to the robot's left: knees bend backwards; those that say nothing leave it
        to the feet, to what hips and arms swing to, and to the root's frame.
        """
        hips = [three[0] for three, _ in self.legs]
        knees = []  # with a second one, as birds have, that bends the other way
        for (hip, _, ankle), chain in self.legs:
            pitch = self.pitch(chain)
            knees += pitch[pitch.index(hip) + 1 : pitch.index(ankle)]
        left = self.lateral
        bent = self.middle(knees, left)
        if bent:
            return left * bent
        ahead = np.cross(left, self.up)
        feet = self.ahead(ahead) / self.leg_m()
        feet = feet if abs(feet) > EVEN_FEET else 0.0
        arms = [joint for chain in self.arms() for joint in self.pitch(chain)]
        votes = {
            "the feet": 2 * np.clip(feet / (3 * EVEN_FEET), -1, 1),
            "the hips' range": -self.middle(hips, left),
            "the arms' range": -self.middle(arms, left),
            "the root's x axis": FRAME_VOTE * round(float(ahead @ AXES["+x"])),
        }
        total = sum(votes.values())
        against = [name for name, vote in votes.items() if vote * total < 0]
        if not feet or against:
            by = " and ".join(name for name, vote in votes.items() if vote * total > 0)
            even = "the feet reach as far ahead as behind"
            notes.append(
                f"the forward direction is a guess, by {by or 'nothing'}: the knees bend both "
                f"ways, and {', '.join(against) + ' disagree' if against else even}; if the "
                f"robot faces the other way, give [source] facing"
            )
        return left if total > 0 else -left

    def arms(self) -> tuple[Chain, ...]:
        """The heaviest mirrored pair of limbs that are no legs, on the side of the lateral axis
        last; () without any.
        """
        firsts = {chain[0] for _, chain in self.legs}
        arms = [limb for limb in self.limbs() if not firsts & {chain[0] for chain in limb}]
        return max(arms, key=lambda limb: self.tree.carried(limb[0][0].child), default=())

    def shoulders(self, notes: list[str]) -> tuple[Joint, ...]:
        """The first joints of the arms, if they turn about the pitch axis; or () with a note."""
        arms = self.arms()
        if not arms:
            notes.append("no arms were found: the shoulder is left out")
            return ()
        pair = tuple(chain[0] for chain in arms)
        share = max(self.tree.carried(joint.child) for joint in pair) / self.tree.mass
        if share < LIGHT_ARM:
            notes.append(
                f"the arms are held: what the joint {pair[0].name!r} swings weighs {share:.1%} of "
                f"the robot"
            )
            return ()
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
    finder.refuse_four()
    for three, _ in finder.legs:
        refuse_wheel(tree, three[2])
    notes = []
    left = finder.leftward(notes)
    forward = np.cross(left, finder.up)
    order = slice(None, None, -1 if left @ finder.lateral > 0 else 1)
    pairs = [*zip(*(three for three, _ in finder.legs), strict=True), finder.shoulders(notes)]
    joints = {
        role: tuple(joint.name for joint in pair[order])
        for role, pair in zip(ROLES, pairs, strict=True)
    }
    feet = tuple(finder.foot(*leg) for leg in finder.legs)[order]
    below = {link for foot in feet for link in tree.below(foot)}
    if toes := [j.name for j in tree.joints.values() if j.driven and j.parent in below]:
        notes.append(
            f"the joints {listed(toes)} beyond the ankles are held, their links belong to the sole"
        )
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
        values = ", ".join(f"{part} = {value:g}" for part, value in limits.items())
        notes.append(
            f"joint {name!r}: {values} assumed, the {tree.format} has no usable ones; correct "
            f"[limits.{key(name)}]"
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
        joint = finder.tree.joints[name]
        limits = {}
        if not {"lower", "upper"} <= set(joint.limits):
            low, high = ASSUMED_RAD[role]
            turned = joint.direction @ left < 0
            limits["lower"] = 0.0 - high if turned else low
            limits["upper"] = 0.0 - low if turned else high
        if role == "other" and MOST_RAD_S < joint.limits.get("velocity", 0.0) <= 2 * MOST_RAD_S:
            limits["velocity"] = MOST_RAD_S
        if limits:
            out[name] = limits
    return out


def leg_joints(tree: Tree, trunk: str, feet: tuple[str, str]) -> list[str]:
    """Names of the driven joints between a trunk and both feet (left, right)."""
    legs = [j for foot in feet for j in tree.path_between(trunk, foot)]
    _check_leaders(tree, legs)
    return [j.name for j in legs if j.driven]


def _check_leaders(tree: Tree, legs: Iterable[Joint]) -> None:
    """Raise if a joint of a leg follows one that is missing; elsewhere such a joint is held."""
    for joint in legs:
        if joint.mimic and joint.mimic[0] not in tree.joints:
            raise tree.error(
                f"joint {joint.name!r} mimics {joint.mimic[0]!r}, which does not exist; correct "
                f"the name"
            )


def _explain(tree: Tree) -> NoReturn:
    """Raise with the reason why there are no two legs."""
    finders = (_Finder(tree, guess, every_kind=True) for guess in GUESSES)
    legs = next((finder.legs for finder in finders if finder.legs), [])
    _check_leaders(tree, (joint for _, chain in legs for joint in chain))
    for three, _ in legs:
        for role, joint in zip(LEG, three, strict=True):
            if not joint.driven:
                kind = f"is of type {joint.kind!r}"
                if joint.limits.get("effort") == 0:
                    kind = (
                        "has effort = 0 N m"
                        if tree.format == "URDF"
                        else "has no actuator both ways"
                    )
                elif joint.mimic:
                    kind = f"mimics {joint.mimic[0]!r}"
                what = f"{'an' if role == 'ankle_pitch' else 'a'} {role.replace('_', ' ')}"
                raise tree.error(
                    f"joint {joint.name!r} {kind}, but has the place of {what}, which must be "
                    f"revolute with a range and a motor of its own"
                )
    for pair in zip(*(chain for _, chain in legs), strict=True) if legs else ():
        for still, moving in (pair, pair[::-1]):
            if moving.driven and not still.driven:
                kind = f"follows {still.mimic[0]!r}" if still.mimic else "has no motor of its own"
                raise tree.error(
                    f"joint {still.name!r} {kind}, while its counterpart {moving.name!r} moves: "
                    f"both legs must have the same joints"
                )
    finder = _Finder(tree, GUESSES[0])
    hanging = {chain[-1]: 0 for chain in finder.tips if finder.along(finder.triple(chain))}
    if len(hanging) == 1:
        raise tree.error(
            f"one leg only: the chain that ends with joint {next(iter(hanging)).name!r} has no "
            f"mirror image among {len(tree.elements)} links; a jumper needs two legs"
        )
    if len(hanging) == 2:
        one, other = hanging
        legs = f"the legs that end with the joints {one.name!r} and {other.name!r}"
        gap = one.at - other.at
        if abs(gap @ finder.lateral) < SAME_M:
            raise tree.error(f"{legs} are none to the left and none to the right of the trunk")
        apart = 1e3 * norm(gap * (1 - np.abs(finder.lateral)))
        raise tree.error(
            f"{legs} end {apart:.0f} mm from where mirror images do, {1e3 * SAME_M:.0f} mm or more "
            f"is another robot's leg; correct the origins of one"
        )
    limbs = [chain for pair in finder.limbs() for chain in pair[::-1]]
    best = max(map(finder.pitch, limbs or finder.tips), key=len, default=[])
    shown = ", ".join(repr(j.name) for j in best[:4]) or "none"
    way = tree.chain(best[-1].child) if best else []
    others = [f"{j.name!r} is {j.kind}" for j in way if j.kind in ("prismatic", "floating")]
    raise tree.error(
        f"no pair of mirrored legs with three revolute pitch joints (hip, knee, "
        f"ankle) was found; the most on one chain about +-y are {len(best)} ({shown})"
        + "".join(f", and {x} there" for x in others[:1])
    )


# the first description
# ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Draft:
    """A URDF with a first description: ``text`` is the TOML, ``roles`` and ``sole`` what was found
    in its ``tree``.

    ``faults`` are those of the limits of the joints that were found, one sentence each.
    """

    text: str
    roles: Roles
    sole: Sole
    tree: Tree
    faults: tuple[str, ...]


def draft(path: str | Path, repair: tuple[str, ...] = ()) -> Draft:
    """Find the roles in a URDF and write the first TOML file for it, from ``starter.toml.in``;
    numbers that it lacks are asked for in comments. Raises :class:`RobotError`, with the notes of
    the file.

    ``repair`` is what the person allows to be repaired.
    """
    path = Path(path)
    tree = read_tree(read_urdf(path), path.name, path, repair)
    try:
        roles = find_roles(tree)
        turn = robot_axes(tree.pose[roles.trunk].rotation, roles.forward, roles.up)
        hip, _, ankle = (tree.joints[roles.joints[role][0]].at for role in LEG)
        leg_m = float(norm((turn @ (hip - ankle))[[0, 2]]))
        sole = find_sole(tree, roles.feet[0], turn, leg_m)
    except RobotError as e:
        for note in notes(tree):
            e.add_note(note)
        raise
    asked = {}  # table -> limits that the file lacks
    faults = []
    names = [name for pair in roles.joints.values() for name in pair]
    for joint in dict.fromkeys(names + leg_joints(tree, roles.trunk, roles.feet)):
        given = roles.assumed.get(joint, {})
        title = f"limits.{key(joint)}"
        if wrong := wrong_limits(tree, joint, given):
            asked[title] = sorted(wrong, key=LIMITS.index)
        faults += limit_faults(tree, joint, given, title)
    # a short name of letters, digits, - and _
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", tree.xml.get("name") or path.stem).strip("_")[:40]
    config = filled(
        "robot_import/starter.toml.in",
        key=key,
        name=name or "robot",
        urdf=path.resolve().as_posix(),
        roles=roles,
        repair=repair,
        sole=sole,
        other=opposite(roles.forward),
        knee=_inside(tree, turn[1], roles.joints["knee"], STANCE_KNEE_RAD),
        trunk=STANCE_TRUNK_RAD,
        asked=asked,
        shoulder=_inside(tree, turn[1], roles.joints["shoulder_pitch"], 0.0),
    )
    roles = replace(roles, notes=(*notes(tree), *roles.notes))
    return Draft(config, roles, sole, tree, tuple(faults))


def _inside(tree: Tree, left: np.ndarray, pair: tuple[str, ...], wish: float) -> float:
    """The angle about ``left`` (3,) nearest to ``wish``, well inside both ranges [rad]."""
    low = -np.inf
    high = np.inf
    for joint in (tree.joints[name] for name in pair):
        sign = np.sign(left @ joint.direction)
        ends = joint.limits.get("lower", -np.pi), joint.limits.get("upper", np.pi)
        low = max(low, min(sign * np.array(ends)))
        high = min(high, max(sign * np.array(ends)))
    room = min(STANCE_ROOM_RAD, (high - low) / 3)
    return float(np.clip(wish, low + room, high - room)) if low < high else wish
