"""The symmetric five-link robot in the sagittal plane, computed from the full robot (Sec. II-C of
the paper).

Left and right limbs are merged: masses and inertias add, and so do the torque limits. Nothing here
is typed in by hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.contact import posed
from jumplab.robot.files import ROLES
from jumplab.robot.motors import MotorLimits, read_only

if TYPE_CHECKING:  # a robot makes this of itself
    from jumplab.robot.description import Robot

PITCH_AXIS = 0.5  # [1] a joint canted by 60 deg and more swings its limb sideways
SAGITTAL_LINKS = ("foot", "shank", "thigh", "trunk", "arm")
SAGITTAL_JOINTS = ("hip", "knee", "ankle", "shoulder")
# hip = thigh - trunk, knee = shank - thigh, ankle = foot - shank, shoulder = arm - trunk  (absolute
# link angles)
# (joint, angle)
JOINT_OF_ANGLES = np.array(
    [[0.0, 0, 1, -1, 0], [0, 1, -1, 0, 0], [1, -1, 0, 0, 0], [0, 0, 0, -1, 1]]
)
# (angle, joint), the trunk's pitch as a fifth joint
ANGLES_OF_JOINTS = np.linalg.inv(np.vstack([JOINT_OF_ANGLES, [0.0, 0, 0, 1, 0]]))
# limits of the massless arm of a robot whose arms are held: it hardly moves and never binds
HELD_ARM = {
    "lower": -0.1,
    "upper": 0.1,
    "speed": 10.0,
    "corner_speed": 5.0,
    "no_load_speed": 10.0,
    "effort": 10.0,
    "armature": 0.0,
    "friction": 0.0,
    "damping": 0.0,
}
# vectors (..., 2) @ TO_COMPLEX are x + iz, which exp(-ia) turns by a about +y
TO_COMPLEX = np.array([1.0, 1j])


def in_xz(values: np.ndarray) -> np.ndarray:
    """x and z (..., 2) of complex x + iz (...)."""
    return np.stack([np.real(values), np.imag(values)], -1)


def rotated(angle: float | np.ndarray, vector: np.ndarray) -> np.ndarray:
    """``vector`` (2,), x and z, turned by ``angle`` (...) about +y: (..., 2)."""
    return in_xz(np.exp(-1j * np.asarray(angle)) * (vector @ TO_COMPLEX))


def box_corners(geometry: Any) -> np.ndarray:
    """(8, 3) corners of the box around a shape of coal, in its own frame [m]."""
    geometry.computeLocalAABB()
    box = geometry.aabb_local
    return np.array([*product(*zip(box.min_, box.max_, strict=True))])


@dataclass(frozen=True)
class SagittalModel(MotorLimits):
    """Five links in the x-z plane; angles are absolute, positive about +y, zero in the robot's
    neutral pose.

    Links are in the order of :data:`SAGITTAL_LINKS`, joints in that of :data:`SAGITTAL_JOINTS`.
    Vectors are (x, z) [m], written in the neutral pose, so a link at angle a has its vectors turned
    by a. The lower joints of the links are toe, ankle, knee and hip, and the shoulder for the arm.

    Limits (4,) are in sagittal signs: ranges and speeds of the weaker side, efforts, armature,
    friction and damping of both sides together.
    """

    mass: np.ndarray  # (5,) both sides summed [kg]
    inertia: np.ndarray  # (5,) about each link's own CoM, both sides summed [kg m^2]
    com: np.ndarray  # (5, 2) CoM from the link's lower joint
    # (5, 2) from the lower joint to the next: toe to ankle, to knee, to hip, to shoulder, to hand
    span: np.ndarray
    heel: np.ndarray  # (2,) from the toe
    sole_center: np.ndarray  # (2,) from the toe
    base: np.ndarray  # (2,) from the hip to the origin of the robot's base link, fixed in the trunk
    # (4, 2) of the left and right joint, its angle = sign * sagittal angle; 1 for arms that are
    # held
    signs: np.ndarray
    # on the links, for clearance: name -> (link index, (x, z) from the link's lower joint)
    points: Mapping

    def __post_init__(self) -> None:
        points = {name: (link, read_only(point)) for name, (link, point) in self.points.items()}
        for name, value in vars(self).items():
            value = MappingProxyType(points) if name == "points" else read_only(value)
            object.__setattr__(self, name, value)  # once: from here on the dataclass is frozen

    def __reduce__(self) -> tuple:
        # so what another process gets is read-only as well
        return SagittalModel, (*(vars(self) | {"points": dict(self.points)}).values(),)

    @property
    def total_mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return float(self.mass.sum())

    def point_arms(self, link: int, point: np.ndarray) -> np.ndarray:
        """(5, 2) array d: a point of ``link`` is at sum over j of R(a_j) d[j] from the toe."""
        arms = np.zeros((5, 2))
        arms[:link] = self.span[:link]
        arms[link] = point
        return arms  # (angle, xz)

    def com_arms(self) -> np.ndarray:
        """(5, 5, 2) array d: CoM of link i from the toe is sum over j of R(a_j) d[i, j]."""
        # (link, angle, xz)
        return np.stack([self.point_arms(i, com) for i, com in enumerate(self.com)])

    @property
    def mean_arms(self) -> np.ndarray:
        """(5,) complex d: the robot's CoM x + iz from the toe is sum over j of exp(-i a_j) d[j]."""
        return read_only(self.mass @ (self.com_arms() @ TO_COMPLEX) / self.total_mass)

    def link_coms(self, angles: np.ndarray) -> np.ndarray:
        """(..., 5, 2) CoM of every link from the toe [m] at absolute link angles (..., 5)."""
        return in_xz(np.exp(-1j * angles) @ (self.com_arms() @ TO_COMPLEX).T)

    def joint_angles(self, angles: np.ndarray) -> np.ndarray:
        """Joint angles (..., 4) from absolute link angles (..., 5); also for rates."""
        return np.asarray(angles) @ JOINT_OF_ANGLES.T

    def link_angles(self, joints: np.ndarray, trunk_pitch: float | np.ndarray) -> np.ndarray:
        """Link angles (..., 5) from joint angles (..., 4) and trunk pitch; also rates."""
        given = np.concatenate([joints, np.asarray(trunk_pitch)[..., None]], -1)
        return given @ ANGLES_OF_JOINTS.T


def _axis_signs(model: pin.Model, data: pin.Data, role: str, pair) -> list[float]:
    """+1 if a joint turns its limb about +y in the neutral pose, -1 if about -y."""
    signs = []
    for name in pair:
        axis = data.J[3:, model.idx_vs[model.getJointId(name)]]
        if abs(axis[1]) < PITCH_AXIS:
            raise RobotError(
                f"role {role}: joint {name!r} turns about {np.round(axis, 3)}, not about the "
                f"pitch axis y"
            )
        signs.append(float(np.sign(axis[1])))
    return signs


def _both(limits: MotorLimits, pair: tuple[str, ...], signs: np.ndarray) -> dict[str, float]:
    """Limits that hold for both sides: the overlap of their ranges, the lower speeds, twice the
    lower effort; and the sums of armature, friction and damping.
    """
    (low, high), (other_low, other_high) = np.sort(
        signs[:, None] * np.stack([limits.lower, limits.upper], -1)
    )
    out = {"lower": max(low, other_low), "upper": min(high, other_high)}
    if not out["lower"] < out["upper"]:
        raise RobotError(
            f"{pair[0]!r} and {pair[1]!r} have no angle in common: {low:g} ... {high:g} and "
            f"{other_low:g} ... {other_high:g} rad about the same axis; correct their limits"
        )
    out |= {key: min(getattr(limits, key)) for key in ("speed", "corner_speed", "no_load_speed")}
    out |= {key: sum(getattr(limits, key)) for key in ("armature", "friction", "damping")}
    return out | {"effort": 2 * min(limits.effort)}


def _arm_tip(
    robot: Robot, data: pin.Data, link: list[int], root: np.ndarray, com: np.ndarray
) -> np.ndarray:
    """(x, z) from ``root`` to the arm's far end: of its shapes, else twice as far as its CoM;
    ``link`` is the row of each joint's link.
    """
    along = (com - root) / max(np.linalg.norm(com - root), 1e-9)
    shapes = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.COLLISION)
    far = []
    for shape in shapes.geometryObjects:
        if link[shape.parentJoint] == 4:
            place = data.oMi[shape.parentJoint] * shape.placement
            corners = map(place.act, box_corners(shape.geometry))
            far += [(corner[[0, 2]] - root) @ along for corner in corners]
    return along * max(far, default=2 * np.linalg.norm(com - root))


def reduce(robot: Robot) -> SagittalModel:
    """Merge the full robot into its sagittal five-link model.

    Raises :class:`RobotError` if a role's joints do not turn about the pitch axis, or share no
    range. Left and right may turn opposite ways.
    """
    model = robot.model
    joints = robot.joints
    foot = robot.foot
    data = posed(model)
    below = {"ankle_pitch": 0, "knee": 1, "hip_pitch": 2, "shoulder_pitch": 4}  # rows of the links
    starts = {model.getJointId(n): i for role, i in below.items() for n in joints[role]}
    link = [3] * model.njoints  # the trunk, where no role begins another one
    total = [pin.Inertia.Zero() for _ in SAGITTAL_LINKS]  # of arms that are held it stays so
    for j in range(1, model.njoints):
        link[j] = starts.get(j, link[model.parents[j]])
        total[link[j]] += data.oMi[j].act(model.inertias[j])
    com = np.array([part.lever[[0, 2]] for part in total])

    def place(role):
        joint = [data.oMi[model.getJointId(name)].translation for name in joints[role]]
        return np.mean(joint, axis=0)[[0, 2]]

    ankle, knee, hip = (place(role) for role in ("ankle_pitch", "knee", "hip_pitch"))
    frame = data.oMf[model.getFrameId(foot.frames[0], pin.BODY)]
    toe, heel = (frame.act(np.array([x, 0.0, foot.sole_z]))[[0, 2]] for x in (foot.toe, foot.heel))
    if joints["shoulder_pitch"]:
        shoulder = place("shoulder_pitch")
        hand = _arm_tip(robot, data, link, shoulder, com[4])
    else:  # held arms: a point to draw the trunk to
        com[4] = shoulder = hip + 2 * (com[3] - hip)
        hand = np.zeros(2)
    lower_joint = np.array([toe, ankle, knee, hip, shoulder])
    span = np.array([ankle - toe, knee - ankle, hip - knee, shoulder - hip, hand])
    signs = np.ones((4, 2))
    rows = [HELD_ARM] * 4
    for i, role in enumerate(ROLES):
        if pair := joints[role]:
            signs[i] = _axis_signs(model, data, role, pair)
            of = robot.limits[[robot.joint_names.index(name) for name in pair]]
            rows[i] = _both(of, pair, signs[i])
    lower_ends = {"toe": 0, "knee": 2, "hip": 3, "shoulder": 4}
    points = {name: (link, np.zeros(2)) for name, link in lower_ends.items()}
    points |= {"heel": (0, heel - toe), "hand": (4, hand), "mid-arm": (4, hand / 2)}
    return SagittalModel(
        mass=[part.mass for part in total],
        inertia=[part.inertia[1, 1] for part in total],
        com=com - lower_joint,
        span=span,
        heel=heel - toe,
        sole_center=(heel - toe) / 2,
        base=data.oMi[1].translation[[0, 2]] - hip,
        signs=signs,
        points=points,
        **{key: np.array([row[key] for row in rows]) for key in HELD_ARM},
    )
