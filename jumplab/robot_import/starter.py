"""A first TOML file for a URDF that nobody has described yet: what was found, and what a person should look at."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.config import ROLES
from jumplab.robot_import.roles import Roles, find_roles, robot_axes
from jumplab.robot_import.tree import Tree
from jumplab.robot_import.urdf import parse, read_urdf

# None of these numbers is printed by the paper.
SOLE_M = 0.012  # points this near the lowest one belong to the sole
SMALLEST_M = 0.03  # a shape shorter than this is a marker, no sole
# a sole where nothing is known: the default robot's, as shares of the leg's length from hip to ankle
GUESS_X, GUESS_Y, GUESS_Z = (-0.143, 0.2), (-0.071, 0.071), -0.107
STANCE_KNEE_RAD, STANCE_TRUNK_RAD = 0.5, 0.05  # as the default robot stands
STANCE_ROOM_RAD = 0.15  # from the joint stops


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
    pose, found, kinds = tree.poses(), [], set()
    for link in tree.fixed_to(foot):
        points = tree.points(link)
        if len(points):
            found.append((points @ pose[link].rotation.T + pose[link].translation - pose[foot].translation) @ turn.T)
            kinds |= {shape.tag for _, shape in tree.links[link].shapes}
    if found:
        points = np.concatenate(found)
        low = points[points[:, 2] < points[:, 2].min() + SOLE_M]
        (x0, y0, z), (x1, y1, _) = low.min(axis=0).tolist(), low.max(axis=0).tolist()
        if x1 - x0 > SMALLEST_M and y1 - y0 > SMALLEST_M:
            return Sole((x0, x1), (y0, y1), z, f"from its {' and '.join(sorted(kinds))}")
    x, y = (tuple(leg_m * share for share in shares) for shares in (GUESS_X, GUESS_Y))
    return Sole(x, y, leg_m * GUESS_Z, "GUESSED from the leg's length: the foot has no shape that is at hand")


def starter(tree: Tree, urdf: str, name: str, repair: tuple[str, ...] = ()) -> tuple[str, Roles, Sole]:
    """Text of the file, from ``starter.toml.in``, and the roles and the sole that are written into it.

    ``urdf`` is the path as the file shall name it, ``name`` the robot's, ``repair`` what the person allows to be
    repaired. Raises :class:`jumplab.errors.RobotError` if the URDF has no two legs.
    """
    roles, pose = find_roles(tree), tree.poses()
    turn = robot_axes(pose[roles.trunk].rotation, roles.forward, roles.up)
    hip, ankle = (pose[tree.joints[roles.joints[role][0]].child].translation for role in ("hip_pitch", "ankle_pitch"))
    sole = find_sole(tree, roles.feet[0], turn, float(np.linalg.norm((turn @ (hip - ankle))[[0, 2]])))
    knee = _inside(tree, pose, turn, roles.joints["knee"], STANCE_KNEE_RAD)
    shoulder = _inside(tree, pose, turn, roles.joints["shoulder_pitch"], 0.0)
    text = (
        Path(__file__)
        .with_suffix(".toml.in")
        .read_text(encoding="utf-8")
        .format(
            notes="".join(f"# note: {note}\n" for note in roles.notes),
            name=name,
            urdf=_texts([Path(urdf).as_posix()])[1:-1],
            roles=roles,
            repair=_texts(repair),
            joints="\n".join(f"{role} = {_texts(roles.joints[role])}" for role in ROLES),
            feet=_texts(roles.feet),
            sole=sole,
            knee=knee,
            trunk=STANCE_TRUNK_RAD,
            shoulder=shoulder,
        )
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


def _texts(values: tuple[str, ...]) -> str:
    return json.dumps(values, ensure_ascii=False)  # an array of texts is the same in JSON and in TOML


@dataclass(frozen=True)
class Draft:
    """A URDF with a first description: ``text`` is the TOML, ``roles`` and ``sole`` what was found."""

    text: str
    roles: Roles
    sole: Sole


def draft(path: str | Path, repair: tuple[str, ...] = ()) -> Draft:
    """Find the roles in a URDF and write the first TOML file for it; raises :class:`RobotError`."""
    path = Path(path)
    root = parse(read_urdf(path), path.name)
    urdf_checks.check(root, path.name, repair)
    tree = Tree(root, path.name, path, "inertia" in repair)
    return Draft(*starter(tree, str(path.resolve()), safe_name(root.get("name") or path.stem), repair))
