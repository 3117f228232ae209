"""What a robot looks like in 3-D: meshes of published robots, made coarser, or a rounded body
around its boxes.

Nothing here is simulated or planned with: shapes that collide stay boxes.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from jumplab.errors import RobotError
from jumplab.robot import Robot
from jumplab.robot.files import LEG, SHIPPED
from jumplab.robot_import.checkup import examine
from jumplab.show.style import PHASE_COLORS, tint

LIMB_SHARE = 0.5  # strength of a colour on limbs, whose trunk has all of it
REST_COLOR = "#42474F"  # feet and joints, whose colour stays
PAINTS = {
    phase: {"trunk": tint(c, 1.0), "limb": tint(c, LIMB_SHARE), "rest": tint(REST_COLOR, 1.0)}
    for phase, c in PHASE_COLORS.items()
}
TRIANGLES = 45_000  # of all meshes of a robot: plan and simulation together are 4 MB of a page
# points within such a cell become one; while there are too many triangles, it grows
CELL_M = 0.003
COARSER = 1.3
ORIGIN = re.compile(r"lumped by jumplab from a URDF with the SHA-256\n# ([0-9a-f]{64})")
# the body that is drawn where there are no meshes; none of these numbers is the robot's
LIMB_M = 0.04  # radius of limbs
JOINT_M = 0.045  # radius of the balls at the joints
ROUNDING = 0.2  # radius of the edges of boxes, in the least width
_CIRCLE = np.exp(1j * np.arange(16) * np.pi / 8)
_HEIGHTS = np.exp(1j * np.linspace(-np.pi / 2, np.pi / 2, 9))
BALL = np.array([(a.real * h.real, a.imag * h.real, h.imag) for h in _HEIGHTS for a in _CIRCLE])


@dataclass(frozen=True)
class Part:
    """A surface that moves with a joint."""

    joint: int
    kind: str  # "trunk" and "limb", whose colour tells the phase, or "rest"
    points: np.ndarray  # (n, 3) in the joint's frame [m]
    triangles: np.ndarray  # (m, 3) rows of ``points``
    faceted: bool = False  # triangles are seen as flat; else they are parts of a round surface


def parts_of(robot: Robot) -> tuple[list[Part], list[str]]:
    """The parts of a robot, and what there is to say of where they come from."""
    meshes, notes = _published(robot)
    boxes = [] if meshes else rounded_boxes(robot)
    return meshes or [*boxes, *_skeleton(robot, boxes)], notes


class Trace(NamedTuple):
    """Where a robot is at N states."""

    # (N, njoints - 1, 7) of the joints, the base first: x y z [m], then the quaternion x y z w
    joints: np.ndarray
    feet: np.ndarray  # (N, 2, 4, 4) homogeneous transforms of left and right foot link [m]
    com: np.ndarray  # (N, 3) [m]


def trace(robot: Robot, states: np.ndarray) -> Trace:
    """Joints, feet and CoM at states (N, nq)."""
    model = robot.model
    data = model.createData()
    frames = [model.getFrameId(name, pin.FrameType.BODY) for name in robot.foot.frames]
    rows = []
    for q in states:
        com = pin.centerOfMass(model, data, q).copy()
        joints = [pin.SE3ToXYZQUAT(data.oMi[j]) for j in range(1, model.njoints)]
        feet = [pin.updateFramePlacement(model, data, frame).homogeneous for frame in frames]
        rows.append((joints, feet, com))
    return Trace(*(np.array(column) for column in zip(*rows, strict=True)))


def pressure_points(
    wrench: np.ndarray, feet: np.ndarray, height: np.ndarray | float, least_n: float
) -> np.ndarray:
    """Centres of pressure (N, 2, 3) [m] of wrenches (N, 2, 6) on feet at (N, 2, 3) [m], on ground
    of ``height`` (N, 2) [m].

    NaN where a foot is pressed with ``least_n`` [N] or less.
    """
    pressed = np.where(wrench[..., 2] > least_n, wrench[..., 2], np.nan)
    above = feet[..., 2] - height
    # the moment about this point of the ground has no horizontal part
    x = feet[..., 0] - (wrench[..., 4] + above * wrench[..., 0]) / pressed
    y = feet[..., 1] + (wrench[..., 3] - above * wrench[..., 1]) / pressed
    return np.stack([x, y, height + 0 * pressed], axis=-1)


# meshes
# ----------------------------------------------------------------------------------------------
def _published(robot: Robot) -> tuple[list[Part], list[str]]:
    """Meshes of the published robot that this one was made from, if they are on this machine."""
    origin = ORIGIN.search(robot.config_text)
    if origin is None:
        return [], []
    try:
        like = examine(SHIPPED[robot.name])
    except (KeyError, RobotError):
        return [], ["drawn from boxes: its meshes are not known on this machine"]
    jumper = like.jumper
    if origin[1] not in jumper.config_text or like.robot.joint_names != robot.joint_names:
        return [], ["drawn from boxes: its meshes here are those of another version"]
    parts = []
    for link, body in jumper.lumped.links.items():
        place = jumper.lumped.place(link)
        joint = robot.model.frames[robot.model.getFrameId(body, pin.FrameType.BODY)].parentJoint
        for points, triangles in jumper.tree.meshes(link):
            moved = points @ place.rotation.T + place.translation
            parts.append(Part(joint, _kind(robot, joint), moved, triangles, True))
    if not parts:
        return [], ["drawn from boxes: its meshes are missing"]
    cell = CELL_M
    while sum(len(part.triangles) for part in parts) > TRIANGLES:
        parts = [_coarser(part, cell) for part in parts]
        cell *= COARSER
    return parts, ["published meshes, made coarser"]


def _coarser(part: Part, cell_m: float) -> Part:
    """The same surface, all points within a cell of ``cell_m`` [m] one, without empty triangles."""
    grid = np.floor(part.points / cell_m)
    cells = np.unique(grid, axis=0, return_inverse=True)[1]
    count = np.bincount(cells)
    points = np.stack([np.bincount(cells, weights=x) / count for x in part.points.T], -1)
    corners = np.unique(cells[part.triangles], axis=0)
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    return replace(part, points=points, triangles=corners)


def _kind(robot: Robot, joint: int) -> str:
    frames = [
        robot.model.frames[robot.model.getFrameId(name, pin.FrameType.BODY)]
        for name in robot.foot.frames
    ]
    feet = [frame.parentJoint for frame in frames]
    return "trunk" if joint == 1 else "rest" if joint in feet else "limb"


# boxes, and what is drawn between them
# ----------------------------------------------------------------------------------------------
def rounded_boxes(robot: Robot) -> list[Part]:
    """The boxes around the shapes of a robot's URDF, with round edges; none if these are meshes.

    Raises :class:`RobotError` if Pinocchio cannot read the shapes.
    """
    kind = pin.GeometryType.VISUAL
    try:
        geometry = pin.buildGeomFromUrdfString(robot.model, robot.urdf, kind)
    except ValueError as e:
        if "mesh" in str(e).lower():
            return []
        reason = str(e).splitlines()[0]
        raise RobotError(f"robot {robot.name}: Pinocchio cannot read its shapes: {reason}") from e
    parts = []
    for shape in geometry.geometryObjects:
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        radius = ROUNDING * min(box.max_ - box.min_)
        ends = zip(box.min_ + radius, box.max_ - radius, strict=True)
        corners = np.array(list(itertools.product(*ends)))
        points = (corners[:, None] + radius * BALL).reshape(-1, 3)
        place = shape.placement
        moved = points @ place.rotation.T + place.translation
        parts.append(_hull(shape.parentJoint, _kind(robot, shape.parentJoint), moved))
    return parts


def _skeleton(robot: Robot, boxes: list[Part]) -> Iterator[Part]:
    """What holds the boxes together: through the trunk, from joint to joint of a leg, and balls."""
    model = robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    middles = [part.points.mean(axis=0) for part in boxes if part.joint == 1]
    if middles:
        yield _hull(1, "trunk", np.concatenate([x + LIMB_M * BALL for x in middles]))
    joints = {role: [model.getJointId(n) for n in pair] for role, pair in robot.joints.items()}
    for upper, lower in itertools.pairwise(LEG):
        for start, end in zip(joints[upper], joints[lower], strict=True):
            carrier = model.parents[end]
            place = data.oMi[carrier]
            ends = [place.actInv(data.oMi[joint].translation) for joint in (start, end)]
            yield _hull(carrier, "limb", np.concatenate([x + LIMB_M * BALL for x in ends]))
    for joint in itertools.chain(*joints.values()):
        yield _hull(joint, "rest", JOINT_M * BALL)


def _hull(joint: int, kind: str, points: np.ndarray) -> Part:
    """The convex hull of points (n, 3), its triangles seen from outside."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    back = np.einsum("ij,ij->i", outwards, hull.equations[:, :3]) < 0
    faces = np.where(back[:, None], hull.simplices[:, ::-1], hull.simplices)
    kept, rows = np.unique(faces, return_inverse=True)
    return Part(joint, kind, points[kept], rows.reshape(faces.shape))
