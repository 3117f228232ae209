"""The symmetric five-link robot in the sagittal plane, computed from the full robot (Sec. II-C of the paper).

Left and right limbs are merged: masses and inertias add, and so do the torque limits. Nothing here is typed in by hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import product
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot_import.config import ROLES

PITCH_AXIS = 0.5  # [1] a joint canted by 60 deg and more swings its limb sideways
SAGITTAL_LINKS = ("foot", "shank", "thigh", "trunk", "arm")
SAGITTAL_JOINTS = ("hip", "knee", "ankle", "shoulder")
# hip = thigh - trunk, knee = shank - thigh, ankle = foot - shank, shoulder = arm - trunk  (absolute link angles)
JOINT_OF_ANGLES = np.array([[0.0, 0, 1, -1, 0], [0, 1, -1, 0, 0], [1, -1, 0, 0, 0], [0, 0, 0, -1, 1]])  # (joint, angle)
# limits of the massless arm of a robot whose arms are held: it hardly moves and never binds
HELD_ARM = {"lower": -0.1, "upper": 0.1, "speed": 10.0, "corner_speed": 5.0, "no_load_speed": 10.0, "effort": 10.0}
HELD_ARM |= {"armature": 0.0, "friction": 0.0, "damping": 0.0}


def read_only(values: Any) -> np.ndarray:
    """A copy as an array that refuses to be written to."""
    array = np.array(values)
    array.flags.writeable = False
    return array


def rotated(angle: float | np.ndarray, vector: np.ndarray) -> np.ndarray:
    """``vector`` (2,), x and z, turned by ``angle`` (...) about +y: (..., 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1]], -1)


@dataclass(frozen=True)
class SagittalModel:
    """Five links in the x-z plane; angles are absolute, positive about +y, zero in the robot's neutral pose.

    Links are in the order of :data:`SAGITTAL_LINKS`, joints in that of :data:`SAGITTAL_JOINTS`. Vectors are (x, z) [m],
    written in the neutral pose, so a link at angle a has its vectors turned by a. The lower joints of the links are
    toe, ankle, knee and hip, and the shoulder for the arm.
    """

    mass: np.ndarray  # (5,) both sides summed [kg]
    inertia: np.ndarray  # (5,) about each link's own CoM, both sides summed [kg m^2]
    com: np.ndarray  # (5, 2) CoM from the link's lower joint
    span: np.ndarray  # (5, 2) from the lower joint to the next: toe to ankle, to knee, to hip, to shoulder, to hand
    heel: np.ndarray  # (2,) from the toe
    sole_center: np.ndarray  # (2,) from the toe
    base: np.ndarray  # (2,) from the hip to the origin of the robot's base link, fixed in the trunk
    signs: np.ndarray  # (4, 2) of the left and right joint, its angle = sign * sagittal angle; 1 for arms that are held
    lower: np.ndarray  # (4,) [rad] limits in sagittal signs, of the weaker side
    upper: np.ndarray  # (4,) [rad]
    speed: np.ndarray  # (4,) [rad/s]
    effort: np.ndarray  # (4,) of both sides together [N m]
    corner_speed: np.ndarray  # (4,) [rad/s] up to which the effort is there
    no_load_speed: np.ndarray  # (4,) [rad/s] from which there is none
    armature: np.ndarray  # (4,) of both sides' motors together [kg m^2]
    friction: np.ndarray  # (4,) dry, of both together [N m]
    damping: np.ndarray  # (4,) of both together [N m s/rad]
    points: Mapping  # on the links, for clearance: name -> (link index, (x, z) from the link's lower joint)

    def __post_init__(self) -> None:
        points = {name: (link, read_only(point)) for name, (link, point) in self.points.items()}
        for field in fields(self):
            value = MappingProxyType(points) if field.name == "points" else read_only(getattr(self, field.name))
            object.__setattr__(self, field.name, value)  # once: from here on the dataclass is frozen

    def __reduce__(self) -> tuple:
        values = {field.name: getattr(self, field.name) for field in fields(self)} | {"points": dict(self.points)}
        return SagittalModel, tuple(values.values())  # so what another process gets is read-only as well

    @property
    def total_mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return float(self.mass.sum())

    @property
    def heavy_motors(self) -> bool:
        """Whether armature or friction of any motor is known."""
        return bool(self.armature.any() or self.friction.any() or self.damping.any())

    def point_arms(self, link: int, point: np.ndarray) -> np.ndarray:
        """(5, 2) array d: a point fixed in ``link`` sits at sum over j of R(a_j) d[j] from the toe."""
        arms = np.zeros((5, 2))
        arms[:link] = self.span[:link]
        arms[link] = point
        return arms  # (angle, xz)

    def com_arms(self) -> np.ndarray:
        """(5, 5, 2) array d: CoM of link i from the toe is sum over j of R(a_j) d[i, j]."""
        return np.stack([self.point_arms(i, com) for i, com in enumerate(self.com)])  # (link, angle, xz)

    def link_coms(self, angles: np.ndarray) -> np.ndarray:
        """(..., 5, 2) CoM of every link from the toe [m] at absolute link angles (..., 5)."""
        arms = self.com_arms()
        links = [sum(rotated(angles[..., j], arms[i, j]) for j in range(i + 1)) for i in range(5)]
        return np.stack(links, -2)

    def joint_angles(self, angles: np.ndarray) -> np.ndarray:
        """Joint angles (..., 4) hip, knee, ankle, shoulder from absolute link angles (..., 5); also for their rates."""
        return np.asarray(angles) @ JOINT_OF_ANGLES.T

    def link_angles(self, joints: np.ndarray, trunk_pitch: float | np.ndarray) -> np.ndarray:
        """Absolute link angles (..., 5) from joint angles (..., 4) and trunk pitch; also for their rates."""
        hip, knee, ankle, shoulder = np.moveaxis(np.asarray(joints, float), -1, 0)
        thigh = trunk_pitch + hip
        shank = thigh + knee
        return np.stack([shank + ankle, shank, thigh, trunk_pitch + np.zeros_like(hip), trunk_pitch + shoulder], -1)


def _members(model: pin.Model, joints: Mapping) -> list[list[int]]:
    """Pinocchio joint indices whose bodies belong to foot, shank, thigh, trunk and arm."""
    pitch = {joint: role for role, pair in joints.items() for joint in pair}
    part_below = {"hip_pitch": "thigh", "knee": "shank", "ankle_pitch": "foot", "shoulder_pitch": "arm"}
    part = {1: "trunk"}
    for j in range(2, model.njoints):
        role = pitch.get(model.names[j])
        part[j] = part_below[role] if role else part[model.parents[j]]
    return [[j for j in part if part[j] == name] for name in SAGITTAL_LINKS]


def _axis_signs(model: pin.Model, data: pin.Data, role: str, pair) -> list[float]:
    """+1 if a joint turns its limb about +y in the neutral pose, -1 if about -y: found by motion, not by name."""
    signs = []
    for name in pair:
        joint = model.getJointId(name)
        jacobian = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)  # (6, nv)
        axis = jacobian[3:, model.idx_vs[joint]]
        if abs(axis[1]) < PITCH_AXIS:
            raise RobotError(f"role {role}: joint {name!r} turns about {np.round(axis, 3)}, not about the pitch axis y")
        signs.append(float(np.sign(axis[1])))
    return signs


def _limits(actuators: Mapping, pair, signs) -> dict[str, float]:
    """What both sides can do: the overlap of their ranges, the lower speeds, twice the lower effort.

    And what they take: armature, friction and damping of both.
    """
    both = [actuators[name] for name in pair]
    ranges = [sorted((s * a["lower"], s * a["upper"])) for a, s in zip(both, signs, strict=True)]
    out = {"lower": max(r[0] for r in ranges), "upper": min(r[1] for r in ranges)}
    if not out["lower"] < out["upper"]:
        raise RobotError(
            f"{pair[0]!r} and {pair[1]!r} have no angle in common: {ranges[0][0]:g} ... {ranges[0][1]:g} and "
            f"{ranges[1][0]:g} ... {ranges[1][1]:g} rad about the same axis; correct their limits"
        )
    out |= {key: min(a[key] for a in both) for key in ("speed", "corner_speed", "no_load_speed")}
    out |= {key: both[0][key] + both[1][key] for key in ("armature", "friction", "damping")}
    return out | {"effort": 2 * min(a["effort"] for a in both)}


def _limb_tip(model: pin.Model, data: pin.Data, urdf: str, members: list[int], root, com) -> np.ndarray:
    """(x, z) from ``root`` to a limb's far end: of its collision shapes; without any, at twice the CoM's distance."""
    along = (com - root) / max(np.linalg.norm(com - root), 1e-9)
    shapes = pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION)
    reach = []
    for shape in shapes.geometryObjects:
        if shape.parentJoint in members:
            shape.geometry.computeLocalAABB()
            box = shape.geometry.aabb_local
            corners = np.array(list(product(*zip(box.min_, box.max_, strict=True))))
            world = [(data.oMi[shape.parentJoint] * shape.placement).act(c)[[0, 2]] for c in corners]
            reach.append(max((np.array(world) - root) @ along))
    return along * (max(reach) if reach else 2 * np.linalg.norm(com - root))


def reduce(model: pin.Model, joints: Mapping, foot: Any, actuators: Mapping, urdf: str) -> SagittalModel:
    """Merge the full robot into its sagittal five-link model.

    Parameters
    ----------
    model : Pinocchio model with a free-flyer base.  urdf : the robot's XML, for its collision shapes.
    joints : role -> (left, right) joint names; () for held arms.  foot : :class:`.description.Foot`.
    actuators : joint name -> its numbers, as :attr:`.description.Robot.actuators`.

    Raises :class:`RobotError` if a role's joints do not turn about the pitch axis, or share no range. Left and right
    may turn opposite ways.
    """
    data, q = model.createData(), pin.neutral(model)
    pin.computeJointJacobians(model, data, q)
    pin.framesForwardKinematics(model, data, q)
    parts = _members(model, joints)
    mass, com, inertia = np.zeros(5), np.zeros((5, 2)), np.zeros(5)
    for i, members in enumerate(parts):
        bodies = [data.oMi[j].act(model.inertias[j]) for j in members]
        if bodies:  # none: arms that are held
            total = pin.Inertia.Zero()
            for body in bodies:
                total += body
            mass[i], com[i] = total.mass, total.lever[[0, 2]]
            # products along y drop out of the pitch axis, so the two sides may simply be added
            levers = [np.sum((b.lever[[0, 2]] - com[i]) ** 2) for b in bodies]
            inertia[i] = sum(b.inertia[1, 1] + b.mass * lever for b, lever in zip(bodies, levers, strict=True))

    def place(role):
        return np.mean([data.oMi[model.getJointId(n)].translation[[0, 2]] for n in joints[role]], axis=0)

    ankle, knee, hip = (place(r) for r in ("ankle_pitch", "knee", "hip_pitch"))
    held = not joints["shoulder_pitch"]
    shoulder = hip + 2 * (com[3] - hip) if held else place("shoulder_pitch")  # held arms: a point to draw the trunk to
    frame = data.oMf[model.getFrameId(foot.frames[0])]
    toe, heel = (frame.act(np.array([x, 0.0, foot.sole_z]))[[0, 2]] for x in (foot.toe, foot.heel))
    hand = np.zeros(2) if held else _limb_tip(model, data, urdf, parts[4], shoulder, com[4])
    if held:
        com[4] = shoulder
    lower_joint = np.array([toe, ankle, knee, hip, shoulder])
    span = np.array([ankle - toe, knee - ankle, hip - knee, shoulder - hip, hand])
    pairs = [joints[role] for role in ROLES]
    signs = [_axis_signs(model, data, role, joints[role]) or [1.0, 1.0] for role in ROLES]
    rows = [_limits(actuators, pair, sign) if pair else HELD_ARM for pair, sign in zip(pairs, signs, strict=True)]
    points = {name: (link, np.zeros(2)) for name, link in (("toe", 0), ("knee", 2), ("hip", 3), ("shoulder", 4))}
    points |= {"heel": (0, heel - toe), "hand": (4, hand), "mid-arm": (4, hand / 2)}
    return SagittalModel(
        mass=mass,
        inertia=inertia,
        com=com - lower_joint,
        span=span,
        heel=heel - toe,
        sole_center=(heel - toe) / 2,
        base=data.oMi[1].translation[[0, 2]] - hip,
        signs=np.array(signs),
        points=points,
        **{key: np.array([row[key] for row in rows]) for key in HELD_ARM},
    )
