"""Which joint is which, found from how it moves its links, never from its name."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from jumplab.errors import RobotError
from jumplab.robot_import.tree import Joint, Tree

PARALLEL = 0.999  # our choice: axes canted by less than 2.6 deg count as pitch
SAME_M = 0.02  # our choice: how far from mirror images two limbs may stand
BACKWARD_M = 0.01  # our choice: feet whose middle is this far behind the ankle seem to be put on backwards
STEEP = 0.9  # our choice: cosine between the leg, hip to ankle, and the vertical
ARM_SHARE = 0.5  # our choice: a joint that swings less than half of the arm's mass is no shoulder
AXES = {"x": np.array([1.0, 0, 0]), "y": np.array([0, 1.0, 0]), "z": np.array([0, 0, 1.0])}
LEG = ("hip_pitch", "knee", "ankle_pitch")


@dataclass(frozen=True)
class Roles:
    """What was found.

    Attributes
    ----------
    trunk : link that carries both legs.
    forward, up : axes of the trunk's frame in the neutral pose, such as "+x", "+z".
    joints : role -> (left, right); shoulder_pitch is () where the arms are held.
    feet : (left, right) links moved by the last joints of the legs.
    notes : what a person should know, one sentence each.
    """

    trunk: str
    forward: str
    up: str
    joints: dict[str, tuple[str, ...]]
    feet: tuple[str, str]
    notes: tuple[str, ...]


def axis_of(text: str) -> np.ndarray:
    """Unit vector of a signed axis such as "+x" or "-y"."""
    return AXES[text[-1]] * (-1.0 if text[0] == "-" else 1.0)


def _signed(vector: np.ndarray) -> str:
    i = int(np.argmax(np.abs(vector)))
    return ("-" if vector[i] < 0 else "+") + "xyz"[i]


@dataclass(frozen=True)
class _Limb:
    """Two mirrored chains of joints, on the negative and on the positive side of the lateral axis."""

    chains: tuple[list[Joint], list[Joint]]
    branch: str


class _Finder:
    def __init__(self, tree: Tree, angles: dict[str, float] | None = None):
        self.tree, self.pose = tree, tree.poses(angles)
        self.at = {j.name: self.pose[j.child].translation for j in tree.joints.values()}
        self.axis = {j.name: self.pose[j.child].rotation @ j.axis for j in tree.joints.values()}

    def usable(self, joint: Joint) -> bool:
        return joint.kind == "revolute" and joint.mimic is None

    def limbs(self, lateral: np.ndarray, every_kind: bool) -> list[_Limb]:
        """Pairs of chains whose tips mirror each other across the plane between the hips."""
        tips = [self._moving(link, every_kind) for link in self.tree.links if not self.tree.below[link]]
        unique = {c[-1].name: c for c in tips if c}
        chains = [c for c in unique.values() if not any(c[-1] in o[:-1] for o in unique.values())]
        out = []
        for a, b in combinations(chains, 2):
            if len(a) != len(b):
                continue
            gap = self.at[b[-1].name] - self.at[a[-1].name]
            side = float(gap @ lateral)
            if abs(side) < SAME_M or np.linalg.norm(gap - side * lateral) > SAME_M:
                continue
            shared = sum(x is y for x, y in zip(a, b, strict=True))
            whole = self.tree.path_between(a[-1].child, b[-1].child)
            first = next(j for j in whole if j in self.tree.chain(b[-1].child))
            pair = (a[shared:], b[shared:]) if side > 0 else (b[shared:], a[shared:])
            if pair[0]:
                out.append(_Limb(pair, first.parent))
        return out

    def _moving(self, link: str, every_kind: bool) -> list[Joint]:
        chain = self.tree.chain(link)
        if every_kind:
            return [
                j for j in chain if j.kind != "floating" and (j.kind != "fixed" or j.element.find("axis") is not None)
            ]
        return [j for j in chain if self.usable(j)]

    def pitch(self, chain: list[Joint], lateral: np.ndarray) -> list[Joint]:
        return [j for j in chain if abs(self.axis[j.name] @ lateral) > PARALLEL]

    def triple(self, chain: list[Joint], lateral: np.ndarray) -> tuple[Joint, ...] | None:
        """Hip, knee, ankle: the three pitch joints with the longest shorter segment between them."""

        def shorter(three):
            place = [self.at[j.name] for j in three]
            flat = [p - (p @ lateral) * lateral for p in place]
            return min(np.linalg.norm(flat[1] - flat[0]), np.linalg.norm(flat[2] - flat[1]))

        threes = list(combinations(self.pitch(chain, lateral), 3))
        best = max(threes, key=shorter, default=None)
        return best if best and shorter(best) > 1e-3 else None

    def legs(self, every_kind: bool = False):
        """(lateral, up, limb, triples) of the legs: the lowest mirrored pair with hip, knee and ankle; or None."""
        for l_axis, u_axis in (("y", "z"), ("x", "z"), ("z", "y"), ("x", "y"), ("y", "x"), ("z", "x")):
            lateral, found = AXES[l_axis], []
            for limb in self.limbs(lateral, every_kind):
                threes = [self.triple(chain, lateral) for chain in limb.chains]
                if None in threes:
                    continue
                leg = self.at[threes[0][2].name] - self.at[threes[0][0].name]
                up = -AXES[u_axis] * np.sign(leg @ AXES[u_axis])
                if l_axis in "yx" and u_axis == "z":
                    up = AXES["z"]
                if leg @ -up > STEEP * np.linalg.norm(leg):
                    found.append((self.at[threes[0][2].name] @ up, up, limb, threes))
            if found:
                _, up, limb, threes = min(found, key=lambda x: x[0])
                return lateral, up, limb, threes
        return None


def find_roles(tree: Tree, angles: dict[str, float] | None = None) -> Roles:
    """Find legs, knees, feet, arms and the forward direction; raises :class:`RobotError` with what is missing.

    Parameters
    ----------
    tree : the robot as its URDF tells it.
    angles : joints that are held, and where [rad]; the others are at 0.
    """
    finder = _Finder(tree, angles)
    found = finder.legs()
    if found is None:
        _explain(finder)
    lateral, up, limb, threes = found
    knee = threes[0][1]
    middle = knee.limits.get("lower", 0.0) + knee.limits.get("upper", 0.0)
    left = lateral * np.sign(finder.axis[knee.name] @ lateral) * (np.sign(middle) or 1.0)
    forward = np.cross(left, up)
    order = (1, 0) if left @ lateral > 0 else (0, 1)
    legs = {role: tuple(threes[i][k].name for i in order) for k, role in enumerate(LEG)}
    feet = tuple(_foot(finder, threes[i], limb.chains[i], lateral) for i in order)
    notes = []
    shoulder = _shoulders(finder, lateral, limb, order, notes)
    frame = finder.pose[limb.branch].rotation.T
    ahead = [_ahead(finder, f, legs["ankle_pitch"][k], forward) for k, f in enumerate(feet)]
    if max(ahead) < -BACKWARD_M:
        notes.append(
            f"the feet point backwards ({max(ahead):.3f} m) for a robot whose knees bend backwards; check forward"
        )
    return Roles(limb.branch, _signed(frame @ forward), _signed(frame @ up), legs | {"shoulder_pitch": shoulder}, feet,
                 tuple(notes))  # fmt: skip


def _foot(finder: _Finder, three, chain: list[Joint], lateral: np.ndarray) -> str:
    """The link that stands: behind the ankle, before any toe joint (a pitch joint beyond the ankle)."""
    at = chain.index(three[2])
    while at + 1 < len(chain) and abs(finder.axis[chain[at + 1].name] @ lateral) < PARALLEL:
        at += 1
    return chain[at].child


def _ahead(finder: _Finder, foot: str, ankle: str, forward: np.ndarray) -> float:
    """How far the foot reaches ahead of the ankle minus how far behind, half of it [m]."""
    points = finder.tree.points(foot)
    if not len(points):
        points = finder.tree.links[foot].inertia.lever[None]
    pose = finder.pose[foot]
    x = (points @ pose.rotation.T + pose.translation - finder.at[ankle]) @ forward
    return float((x.max() + x.min()) / 2)


def _below_mass(tree: Tree, link: str) -> float:
    return tree.links[link].inertia.mass + sum(_below_mass(tree, j.child) for j in tree.below[link])


def _shoulders(finder: _Finder, lateral, legs: _Limb, order, notes: list[str]) -> tuple[str, ...]:
    """The first pitch joints of the heaviest mirrored pair of limbs that are no legs, or () with a note."""
    firsts = {c[0].name for c in legs.chains}
    arms = [x for x in finder.limbs(lateral, False) if not firsts & {c[0].name for c in x.chains}]
    if not arms:
        notes.append("no arms were found: the shoulder is left out")
        return ()
    limb = max(arms, key=lambda x: _below_mass(finder.tree, x.chains[0][0].child))
    whole = _below_mass(finder.tree, limb.chains[0][0].child)
    for a, b in zip(*limb.chains, strict=True):
        if len(finder.pitch([a, b], lateral)) == 2 and _below_mass(finder.tree, a.child) >= ARM_SHARE * whole:
            return tuple((a, b)[i].name for i in order)
    first = limb.chains[0][0]
    cant = np.degrees(np.arccos(min(1.0, abs(finder.axis[first.name] @ lateral))))
    notes.append(f"the arms are held: the first joint, {first.name!r}, turns {cant:.1f} deg off the pitch axis, and "
                 f"none behind it swings half of the arm about that axis")  # fmt: skip
    return ()


def _explain(finder: _Finder) -> None:
    """Raise with the reason why there are no two legs."""
    tree, where = finder.tree, finder.tree.where
    every = finder.legs(every_kind=True)
    if every is not None:
        for three in every[3]:
            for role, joint in zip(LEG, three, strict=True):
                if not finder.usable(joint):
                    kind = f"mimics {joint.mimic[0]!r}" if joint.mimic else f"is of type {joint.kind!r}"
                    raise RobotError(
                        f"{where}: joint {joint.name!r} {kind}, but has the place of a {role.replace('_', ' ')}, which "
                        f"must be revolute with a range and a motor of its own"
                    )
    ends = [finder._moving(link, False) for link in tree.links if not tree.below[link]]
    legged = {c[-1].name: c for c in ends if c and finder.triple(c, AXES["y"])}
    low = {n: c for n, c in legged.items() if _hangs(finder, c)}
    if len(low) == 1:
        name = next(iter(low))
        raise RobotError(
            f"{where}: one leg only: the chain that ends with joint {name!r} has no mirror image among "
            f"{len(tree.links)} links; a jumper needs two legs"
        )
    best = max((finder.pitch(c, AXES["y"]) for c in ends if c), key=len, default=[])
    names = ", ".join(repr(j.name) for j in best[:4]) or "none"
    raise RobotError(
        f"{where}: no pair of mirrored legs with three revolute pitch joints (hip, knee, ankle) was found; the most on "
        f"one chain about +-y are {len(best)} ({names})"
    )


def _hangs(finder: _Finder, chain: list[Joint]) -> bool:
    three = finder.triple(chain, AXES["y"])
    leg = finder.at[three[2].name] - finder.at[three[0].name]
    return leg[2] < -STEEP * np.linalg.norm(leg)
