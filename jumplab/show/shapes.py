"""What a robot looks like on the page: meshes of published robots, made coarser, or a rounded body around its boxes.

Nothing here is simulated or planned with: shapes that collide stay boxes.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from jumplab.errors import RobotError
from jumplab.robot import Robot
from jumplab.robot.description import SHIPPED, files_of
from jumplab.robot_import.config import LEG

TRIANGLES = 45_000  # of all meshes of a robot: plan and simulation together are 4 MB of a page
CELL_M, COARSER = 0.003, 1.3  # points within such a cell become one; while there are too many triangles, it grows
ORIGIN = re.compile(r"lumped by jumplab from a URDF with the SHA-256\n# ([0-9a-f]{64})")
# the rounded body, drawn around boxes; none of these numbers is the robot's
WAIST, CHIN = 0.72, 0.8  # how much narrower a trunk and a head are at the bottom
NECK = 0.3  # share of a head's box that is neck, and of its width
LIMB_ENDS, ARM_ENDS = (1.2, 0.8), (1.0, 0.7)  # radius of a limb at its joint and at the next, in half widths of its box
TRUNK_ROUNDING, SOLE_M = 0.4, 0.008  # share of the smallest half width; radius of the soles' edges
LIMB_M = 0.04  # half width of limbs without a box
HUB_SHARE = 1.25  # radius and half length of the drum around a joint, in half widths
_LATITUDES, _LONGITUDES = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 9), np.arange(16) * np.pi / 8)
BALL = np.stack(
    [np.cos(_LATITUDES) * np.cos(_LONGITUDES), np.cos(_LATITUDES) * np.sin(_LONGITUDES), np.sin(_LATITUDES)], -1
).reshape(-1, 3)


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
    meshes, said = _published(robot)
    return (meshes, said) if meshes else (list(_rounded(robot)), said)


# meshes ---------------------------------------------------------------------------------------------------------
def _published(robot: Robot) -> tuple[list[Part], list[str]]:
    """Meshes of the published robot that this one was made from, if their files are on this machine."""
    told = ORIGIN.search(robot.config_text)
    if told is None:
        return [], []
    try:
        path, config = files_of(SHIPPED[robot.name])
        jumper, like = Robot.imported(path, config or "")
    except (KeyError, RobotError):
        return [], ["drawn from boxes: its meshes are not known on this machine"]
    if told[1] not in jumper.config_text or like.joint_names != robot.joint_names:
        return [], ["drawn from boxes: its meshes here are those of another version"]
    found = []
    for link, (body, place) in jumper.lumped.links.items():
        joint = robot.model.frames[robot.model.getFrameId(body)].parentJoint
        kind = "trunk" if joint == 1 else "rest" if body in robot.foot.frames else "limb"
        for points, triangles in jumper.tree.meshes(link):
            found.append(Part(joint, kind, points @ place.rotation.T + place.translation, triangles, True))
    cell = CELL_M
    while sum(len(part.triangles) for part in found) > TRIANGLES:
        found = [_coarser(part, cell) for part in found]
        cell *= COARSER
    return found, ["published meshes, made coarser" if found else "drawn from boxes: its meshes are missing"]


def _coarser(part: Part, cell_m: float) -> Part:
    """The same surface, all points within a cell of ``cell_m`` made one; triangles without area are left out."""
    _, cells = np.unique(_keys(np.floor(part.points / cell_m).astype(int)), return_inverse=True)
    count = np.bincount(cells)
    points = np.stack([np.bincount(cells, weights=x) / count for x in part.points.T], -1)
    corners = cells[part.triangles]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    _, first = np.unique(_keys(np.sort(corners, axis=1)), return_index=True)
    return Part(part.joint, part.kind, points, corners[np.sort(first)], part.faceted)


def _keys(rows: np.ndarray) -> np.ndarray:
    """One number (n,) for each row of three whole numbers (n, 3), all of which are small."""
    return (rows - rows.min(axis=0, initial=0)) @ np.array([1 << 42, 1 << 21, 1])


# the rounded body -----------------------------------------------------------------------------------------------
def _rounded(robot: Robot) -> Iterator[Part]:
    """Trunk, head, limbs, drums at the joints and feet, from the boxes of the URDF and the places of its joints."""
    boxes, model = _boxes(robot), robot.model
    feet = {model.frames[model.getFrameId(name)].parentJoint for name in robot.foot.frames}
    legs = [[model.getJointId(robot.joints[role][s]) for role in LEG] for s in (0, 1)]
    width = {joint: min(size[:2]) / 2 for joint, _, size in boxes}
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    at = [place.translation for place in data.oMi]
    yield from _trunk([(middle, size) for joint, middle, size in boxes if joint == 1])
    hips = [data.oMi[1].actInv(at[leg[0]]) for leg in legs]
    yield _hull(1, "trunk", hips, [0.9 * width.get(legs[0][0], LIMB_M)] * 2)
    drawn = {joint for leg in legs for joint in leg[:2]}
    for upper, lower in ((a, b) for leg in legs for a, b in itertools.pairwise(leg)):
        carrier = model.parents[lower]
        half = next((width[j] for j in (carrier, upper) if j in width), LIMB_M)
        ends = [data.oMi[carrier].actInv(at[joint]) for joint in (upper, lower)]
        drawn.add(carrier)
        yield _hull(carrier, "limb", ends, half * np.array(LIMB_ENDS))
    for joint, middle, size in boxes:
        if joint in feet:
            ankle = next(leg[2] for leg in legs if leg[2] in model.supports[joint])
            yield from _foot(joint, middle, size, data.oMi[joint].actInv(at[ankle]))
        elif joint != 1 and joint not in drawn:
            yield _arm(joint, middle, size)
    for name in (name for pair in robot.joints.values() for name in pair):
        joint = model.getJointId(name)
        half = HUB_SHARE * width.get(joint, width.get(model.parents[joint], LIMB_M))
        yield _drum(joint, 0.8 * half)


def _boxes(robot: Robot) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Joint, middle (3,), size (3,) [m] of the box around each visual shape of the URDF; none if those are meshes."""
    try:
        shapes = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.VISUAL).geometryObjects
    except ValueError as e:
        if "mesh" not in str(e).lower():
            raise RobotError(f"robot {robot.name}: Pinocchio cannot read its shapes: {str(e).splitlines()[0]}") from e
        return []
    found = []
    for shape in shapes:
        shape.geometry.computeLocalAABB()
        low, high = shape.geometry.aabb_local.min_, shape.geometry.aabb_local.max_
        corners = np.array([*itertools.product(*zip(low, high, strict=True))])
        corners = corners @ shape.placement.rotation.T + shape.placement.translation
        low, high = corners.min(axis=0), corners.max(axis=0)
        found.append((shape.parentJoint, (low + high) / 2, high - low))
    return found


def _trunk(boxes: Sequence[tuple[np.ndarray, np.ndarray]]) -> Iterator[Part]:
    """A torso that is narrower at the waist, a head that is narrower at the chin; what is small stays as it is."""
    largest = max((float(np.prod(size)) for _, size in boxes), default=0.0)
    shoulders = max((m[2] + s[2] / 2 for m, s in boxes if np.prod(s) == largest), default=0.0)
    for middle, size in boxes:
        torso = np.prod(size) == largest
        if middle[2] > shoulders:
            bottom, neck = middle - size * (0, 0, 0.5), NECK * size[2]
            yield _hull(1, "trunk", [bottom, middle], [NECK * size[1]] * 2)
            middle, size = middle - (0, 0, -neck / 2), size - (0, 0, neck)
            yield _hull(1, "trunk", *_cornered(middle, size, 0.9 * min(size) / 2, CHIN))
        else:
            yield _hull(1, "trunk", *_cornered(middle, size, TRUNK_ROUNDING * min(size) / 2, WAIST if torso else 1.0))


def _arm(joint: int, middle: np.ndarray, size: np.ndarray) -> Part:
    """A tapered limb along the longest side of its box."""
    axis = int(np.argmax(size))
    half, way = np.sort(size)[:2].mean() / 2, np.eye(3)[axis] * size[axis] / 2
    near, far = sorted((middle - way, middle + way), key=np.linalg.norm)
    radii = half * np.array(ARM_ENDS)
    inwards = (near - far) / np.linalg.norm(near - far)
    return _hull(joint, "limb", [near, far + radii[1] * inwards], radii)


def _foot(joint: int, middle: np.ndarray, size: np.ndarray, ankle: np.ndarray) -> Iterator[Part]:
    """The sole as a slab, and an instep that falls from the ankle to its middle."""
    yield _hull(joint, "rest", *_cornered(middle, size, SOLE_M))
    front, rear = (middle + size * (x, 0.0, 0.05) for x in (0.22, -0.3))
    yield _hull(joint, "rest", [ankle, front, rear], [0.36 * size[1], 0.45 * size[2], 0.45 * size[2]])


def _drum(joint: int, half: float) -> Part:
    """A short cylinder about a pitch axis."""
    ring = np.stack([np.cos(a := np.arange(24) * np.pi / 12), np.zeros(24), np.sin(a)], -1) * half
    return _hull(joint, "rest", np.concatenate([ring - (0, y, 0) for y in (-half, half)]), np.full(48, 0.003))


def _cornered(middle: np.ndarray, size: np.ndarray, radius: float, low: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Balls (8, 3) in the corners of a box, whose bottom is ``low`` times as wide, and their radii (8,) [m]."""
    signs = np.array([*itertools.product((-1, 1), repeat=3)])
    share = np.where(signs[:, 2:] < 0, [low, low, 1.0], 1.0)
    radii = np.full(8, radius) * np.minimum(share[:, 0], 1.0)
    return middle + signs * (size / 2 * share - radii[:, None]), radii


def _hull(joint: int, kind: str, centers: Iterable[ArrayLike], radii: Iterable[float]) -> Part:
    """The convex hull of balls (n, 3) of ``radii`` (n,) [m], its triangles seen from outside."""
    points = np.concatenate([c + r * BALL for c, r in zip(centers, radii, strict=True)])
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    back = np.einsum("ij,ij->i", outwards, hull.equations[:, :3]) < 0
    faces = np.where(back[:, None], hull.simplices[:, ::-1], hull.simplices)
    kept, rows = np.unique(faces, return_inverse=True)
    return Part(joint, kind, points[kept], rows.reshape(faces.shape))
