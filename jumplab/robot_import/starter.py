"""A first TOML file for a URDF that nobody has described yet: what was found, and what a person should look at."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jumplab.robot_import.config import ROLES
from jumplab.robot_import.roles import Roles, axis_of, find_roles
from jumplab.robot_import.soles import Sole, find_sole
from jumplab.robot_import.tree import Tree

STANCE_KNEE_RAD = 0.5  # our choice: as the default robot stands
STANCE_TRUNK_RAD = 0.05
STANCE_ROOM_RAD = 0.15  # our choice: from the joint stops


def robot_turn(tree: Tree, roles: Roles) -> np.ndarray:
    """(3, 3) from the axes of the URDF's root to x forward, y left, z up."""
    frame = tree.poses()[roles.trunk].rotation
    forward, up = frame @ axis_of(roles.forward), frame @ axis_of(roles.up)
    return np.stack([forward, np.cross(up, forward), up])


def starter(tree: Tree, urdf: str, name: str, repair: tuple[str, ...] = ()) -> tuple[str, Roles, Sole]:
    """Text of the file, and the roles and the sole that are written into it.

    Parameters
    ----------
    tree : the URDF.  urdf : its path as the file shall name it.  name : of the robot.
    repair : what the person allows to be repaired.

    Raises :class:`jumplab.errors.RobotError` if the URDF has no two legs.
    """
    roles = find_roles(tree)
    pose, turn = tree.poses(), robot_turn(tree, roles)
    at = {role: turn @ pose[tree.joints[roles.joints[role][0]].child].translation for role in ROLES[:3]}
    sole = find_sole(tree, roles.feet[0], turn, float(np.linalg.norm((at["hip_pitch"] - at["ankle_pitch"])[[0, 2]])))
    knee, shoulder = (_inside(tree, pose, turn, roles.joints[r], at_rest)
                      for r, at_rest in (("knee", STANCE_KNEE_RAD), ("shoulder_pitch", 0.0)))  # fmt: skip
    return _text(roles, sole, urdf, name, repair, knee, shoulder), roles, sole


def _inside(tree: Tree, pose: dict, turn: np.ndarray, pair: tuple[str, ...], wish: float) -> float:
    """The angle about the robot's left that is nearest to ``wish`` and well inside the range of both joints [rad]."""
    low, high = -np.inf, np.inf
    for name in pair:
        joint = tree.joints[name]
        sign = float(np.sign((turn @ pose[joint.child].rotation @ joint.axis)[1]))
        ends = sorted(sign * joint.limits.get(k, d) for k, d in (("lower", -np.pi), ("upper", np.pi)))
        low, high = max(low, ends[0]), min(high, ends[1])
    room = min(STANCE_ROOM_RAD, (high - low) / 3)
    return float(np.clip(wish, low + room, high - room)) if low < high else wish


def safe_name(text: str) -> str:
    """A short name of letters, digits, - and _."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text).strip("_")[:40] or "robot"


def _quoted(values) -> str:
    return "[" + ", ".join('"' + str(v).replace("\\", "\\\\").replace('"', '\\"') + '"' for v in values) + "]"


def _pair(values) -> str:
    return "[" + ", ".join(f"{v:.4g}" for v in values) + "]"


def _text(roles: Roles, sole: Sole, urdf: str, name: str, repair, knee: float, shoulder: float) -> str:
    notes = "".join(f"# note: {note}\n" for note in roles.notes)
    joints = "\n".join(f"{role} = {_quoted(roles.joints[role])}" for role in ROLES)
    return f"""# Written by "jumplab robot check": correct what is wrong, then use it as --robot PATH.
{notes}name = "{name}"
urdf = {_quoted([Path(urdf).as_posix()])[1:-1]}

[source]
trunk = "{roles.trunk}"  # link that carries both legs
forward = "{roles.forward}"  # of its frame, in the neutral pose
up = "{roles.up}"
repair = {_quoted(repair)}  # "symmetry", "inertia", "massless": what may be repaired

[joints]  # [left, right]; found by motion; shoulder_pitch = [] holds the arms
{joints}

[locked]  # angle [rad] of joints without a role; 0, or the nearest end of the range, where nothing is said

[feet]  # sole from the origin of the foot link, along the robot's axes: heel and toe, right and left edge, height
links = {_quoted(roles.feet)}
sole_x_m = {_pair(sole.x)}  # {sole.source}
sole_y_m = {_pair(sole.y)}
sole_z_m = {sole.z:.4g}

[stance]  # standing at rest; the rest follows from the CoM above the middle of the sole
knee_rad = {knee:.3g}
trunk_pitch_rad = {STANCE_TRUNK_RAD}
shoulder_rad = {shoulder:.3g}

[actuators]
corner_speed_ratio = 0.5  # assumed: full torque up to this share of the speed limit

# [limits.knee]  # replaces what the URDF says, for a role or for one joint
# effort = 100.0    # [N m]
# velocity = 10.0   # [rad/s]
# lower = 0.0       # [rad]
# upper = 2.0

# [shapes]  # boxes for self-collision; left out, they follow from the leg's length
# trunk_m = [[-0.08, 0.08, 0.10, 0.10, 0.60]]  # rear, front, half width, bottom, top, from the middle of the hips
# thigh_thickness_m = 0.08
"""
