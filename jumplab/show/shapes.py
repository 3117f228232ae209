"""The shape of a robot in pictures: meshes of published robots, made coarser, or a rounded body
around its boxes.

Nothing here is simulated or planned with: shapes that collide stay boxes.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from scipy.ndimage import uniform_filter1d

from jumplab.control.kinematics import Gauge
from jumplab.errors import RobotError
from jumplab.io.motion import CONTACT_FORCE_N, Motion
from jumplab.robot import Robot
from jumplab.robot.contact import on_feet
from jumplab.robot.files import LEG, SHIPPED
from jumplab.robot_import.checkup import examine
from jumplab.robot_import.urdf import placed
from jumplab.show.style import PHASE_COLORS, tint
from jumplab.sim.scene import Scene

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
LIMB_M = 0.04  # radius of a limb that has no box
END_SHARE = 0.45  # radius of a limb's ends, in the least width of its box
JOINT_M = np.array([0.042, 0.047, 0.042])  # half sizes of the discs at the joints, about y
FEET_SHARE = 0.75  # of these sizes at the ankles
# radii of the edges of boxes, in the least width: of soles, and of all others
SOLE_ROUNDING = 0.2
ROUNDING = 0.4
HEAD_ROUNDING = 0.5
# the dark front of a head, in half sizes of its box: middle and half sizes
VISOR = np.array([[0.62, 0.0, 0.2], [0.45, 0.8, 0.3]])
_CIRCLE = np.exp(1j * np.arange(16) * np.pi / 8)
_HEIGHTS = np.exp(1j * np.linspace(-np.pi / 2, np.pi / 2, 9))
BALL = np.array([(a.real * h.real, a.imag * h.real, h.imag) for h in _HEIGHTS for a in _CIRCLE])
CORNERS = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
DISC = np.array([(a.real, side, a.imag) for side in (-1.0, 1.0) for a in _CIRCLE])


@dataclass(frozen=True)
class Part:
    """A surface that moves with a joint."""

    joint: int
    kind: str  # "trunk" and "limb", whose colour shows the phase, or "rest"
    points: np.ndarray  # (n, 3) in the joint's frame [m]
    triangles: np.ndarray  # (m, 3) rows of ``points``
    faceted: bool = False  # triangles are seen as flat; else they are parts of a round surface


def parts_of(robot: Robot) -> tuple[list[Part], list[str]]:
    """The parts of a robot, and what there is to say of where they come from."""
    meshes, notes = _published(robot)
    return meshes or rounded_body(robot), notes


class Trace(NamedTuple):
    """Places of a robot's parts at N states."""

    # (N, njoints - 1, 7) of the joints, the base first: x y z [m], then the quaternion x y z w
    joints: np.ndarray
    feet: np.ndarray  # (N, 2, 4, 4) homogeneous transforms of left and right foot link [m]
    com: np.ndarray  # (N, 3) [m]

    def toes(self, robot: Robot) -> np.ndarray:
        """Places of the toes ahead (N,), the mean of both [m]."""
        return (self.feet @ [*robot.foot.tip, 1.0])[..., 0].mean(axis=1)


def trace(robot: Robot, states: np.ndarray) -> Trace:
    """Joints, feet and CoM at states (N, nq)."""
    gauge = Gauge(robot)
    rows = []
    for q in states:
        feet = [foot.homogeneous for foot in gauge.places(q)]
        joints = [pin.SE3ToXYZQUAT(place) for place in list(gauge.data.oMi)[1:]]
        rows.append((joints, feet, gauge.com(q)))
    return Trace(*(np.array(column) for column in zip(*rows, strict=True)))


def pressure_points(
    wrench: np.ndarray, feet: np.ndarray, height: np.ndarray | float, least_n: float
) -> np.ndarray:
    """Centres of pressure (N, 2, 3) [m] of wrenches (N, 2, 6) on feet at (N, 2, 3) [m], on ground
    of ``height`` (N, 2) [m].

    NaN where a foot is pressed with ``least_n`` [N] or less.
    """
    f_x, f_y, f_z, m_x, m_y, _ = np.moveaxis(wrench, -1, 0)
    x, y, z = np.moveaxis(feet, -1, 0)
    pressed = np.where(f_z > least_n, f_z, np.nan)
    above = z - height
    # the moment about this point of the ground has no horizontal part
    ahead = x - (m_y + above * f_x) / pressed
    left = y + (m_x - above * f_y) / pressed
    return np.stack([ahead, left, height + 0 * pressed], axis=-1)


def ground_forces(whole: Motion, rate_hz: float, way: Trace, scene: Scene) -> np.ndarray | None:
    """Centre of pressure and ground force of each foot (N, 2, 6) [m, N], at ``rate_hz`` along the
    ``way``.

    NaN where it does not; None if nothing is known of it. The force is the mean from frame to
    frame, as that of an impact depends on the engine's step.
    """
    if whole.wrench is None:
        return None
    rows = max(1, round(len(whole.t) / (whole.duration * rate_hz)))
    mean = replace(whole, wrench=uniform_filter1d(whole.wrench, rows, axis=0, mode="nearest"))
    wrench = mean.every(rate_hz).wrench[: len(way.feet)]
    feet = way.feet[..., :3, 3]
    top = np.vectorize(scene.top_at, otypes=[float])(feet[..., 0])
    places = pressure_points(wrench, feet, top, CONTACT_FORCE_N)
    return np.concatenate([places, np.where(np.isnan(places), np.nan, wrench[..., :3])], axis=-1)


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
    if origin[1] not in like.robot.config_text or like.robot.joint_names != robot.joint_names:
        return [], ["drawn from boxes: its meshes here are those of another version"]
    parts = []
    for link, body in like.lumped.links.items():
        place = like.lumped.place(link)
        joint = robot.model.frames[robot.model.getFrameId(body, pin.FrameType.BODY)].parentJoint
        for points, triangles in like.tree.meshes(link):
            parts.append(Part(joint, _kind(robot, joint), placed(place, points), triangles, True))
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
    feet = [foot.joint for foot in on_feet(robot, np.zeros(3))]
    return "trunk" if joint == 1 else "rest" if joint in feet else "limb"


# a body around boxes
# ----------------------------------------------------------------------------------------------
class _Box(NamedTuple):
    joint: int
    place: pin.SE3  # of its middle, in the joint's frame [m]
    half: np.ndarray  # (3,) [m]

    @property
    def middle(self) -> np.ndarray:
        """(3,) in the joint's frame [m]."""
        return self.place.translation

    def rounded(self, share: float) -> np.ndarray:
        """Points (n, 3) of the box, the radius of its edges a ``share`` of the least width."""
        radius = share * 2 * self.half.min()
        corners = CORNERS * (self.half - radius)
        return placed(self.place, (corners[:, None] + radius * BALL).reshape(-1, 3))

    def inside(self, share: np.ndarray) -> np.ndarray:
        """Points (n, 3) given in half sizes of the box."""
        return placed(self.place, share * self.half)


def _boxes(robot: Robot) -> Iterator[_Box]:
    """The boxes around the shapes of a robot's URDF; none if these are meshes.

    Raises :class:`RobotError` if Pinocchio cannot read the shapes.
    """
    try:
        geometry = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.VISUAL)
    except ValueError as e:
        if "mesh" in str(e).lower():
            return
        raise robot.error(f"Pinocchio cannot read its shapes: {str(e).splitlines()[0]}") from e
    for shape in geometry.geometryObjects:
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        place = shape.placement * pin.SE3(np.eye(3), (box.max_ + box.min_) / 2)
        yield _Box(shape.parentJoint, place, (box.max_ - box.min_) / 2)


def rounded_body(robot: Robot) -> list[Part]:
    """A body around the boxes of a robot's URDF: limbs that reach from joint to joint, a trunk that
    holds them, discs at the joints that move. All parts are convex.

    Raises :class:`RobotError` if Pinocchio cannot read the shapes.
    """
    model = robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    boxes = defaultdict(list)
    for box in _boxes(robot):
        boxes[box.joint].append(box)
    for role in LEG[1:]:  # thighs and shanks are drawn even without boxes
        for name in robot.joints[role]:
            boxes[model.parents[model.getJointId(name)]] += []
    # a joint without a box is drawn with the next one below that has one, or with its parent
    ends = _ends(model, boxes.keys())
    parts = []
    for joint, joint_boxes in boxes.items():
        kind = _kind(robot, joint)
        if kind == "trunk":
            continue
        width = min((2 * box.half.min() for box in joint_boxes), default=2 * LIMB_M)
        radius = END_SHARE * max(width, LIMB_M)
        rounding = SOLE_ROUNDING if kind == "rest" else ROUNDING
        balls = [
            data.oMi[joint].actInv(data.oMi[end].translation) + radius * BALL
            for end in {joint, *ends[joint]}
        ]
        solid = np.concatenate([*(box.rounded(rounding) for box in joint_boxes), *balls])
        parts.append(_hull(joint, kind, solid))
    return [*parts, *_trunk(robot, data, boxes[1]), *_discs(robot)]


def _ends(model: pin.Model, drawn: Collection[int]) -> dict[int, list[int]]:
    """Joints where a drawn one's limb ends: those above it that are not drawn, up to the trunk, and
    those that it carries.
    """
    ends = {joint: [] for joint in drawn}
    for joint in range(2, model.njoints):
        below = next((j for j in model.subtrees[joint] if j in ends), None)
        if joint not in ends and below is not None:
            ends[below].append(joint)
        above = model.parents[joint]
        if above in ends:
            ends[above].append(joint)
    return ends


def _trunk(robot: Robot, data: pin.Data, boxes: list[_Box]) -> Iterator[Part]:
    """Its boxes, what holds them together, bars between hips and between shoulders, and a face."""
    model = robot.model
    if not boxes:
        return
    limbs = dict.fromkeys(  # the joints of left and right at which they leave the trunk
        tuple(model.supports[model.getJointId(name)][2] for name in pair)
        for pair in robot.joints.values()
        if pair
    )
    bars = [[data.oMi[1].actInv(data.oMi[joint].translation) for joint in pair] for pair in limbs]
    shoulders = max(bar[0][2] for bar in bars)
    top = max(boxes, key=lambda box: box.middle[2])
    above = top.middle[2] - top.half[2] > shoulders - LIMB_M
    has_head = above and top.half.prod() < max(box.half.prod() for box in boxes)
    yield _hull(1, "trunk", np.concatenate([box.middle + LIMB_M * BALL for box in boxes]))
    for box in boxes:
        head = has_head and box is top
        yield _hull(1, "trunk", box.rounded(HEAD_ROUNDING if head else ROUNDING))
    for bar in bars:
        solid = [x + LIMB_M * BALL for x in bar]
        near = min(boxes, key=lambda box: np.linalg.norm(box.middle - np.mean(bar, axis=0)))
        if near.half[1] < abs(bar[0][1]) / 2:  # a waist, which widens to the hips
            solid.append(near.rounded(ROUNDING))
        yield _hull(1, "trunk", np.concatenate(solid))
    if has_head:
        middle, half = VISOR
        yield _hull(1, "rest", top.inside(middle + half * BALL))


def _discs(robot: Robot) -> Iterator[Part]:
    """A disc about y at each joint with a role."""
    for role, pair in robot.joints.items():
        size = JOINT_M * (FEET_SHARE if role == LEG[-1] else 1.0)
        for name in pair:
            yield _hull(robot.model.getJointId(name), "rest", size * DISC)


def _hull(joint: int, kind: str, points: np.ndarray) -> Part:
    """The convex hull of points (n, 3), its triangles seen from outside."""
    corners = coal.StdVec_Vec3s()
    corners.extend(points)
    hull = coal.ConvexBase.convexHull(corners, True, "Qt")
    faces = map(hull.polygons, range(hull.num_polygons))
    triangles = [[face[k] for k in range(3)] for face in faces]
    return Part(joint, kind, np.array(hull.points()), np.array(triangles))
