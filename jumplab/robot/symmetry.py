"""Left and right of a lumped robot as mirror images of each other, as a symmetric jump needs them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError

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
