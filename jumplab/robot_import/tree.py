"""A URDF as a tree of links and joints, before it is a jumping robot: places, masses, shapes, limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.robot_import.checks import FRAME_KG, inertia_matrix, link_mass
from jumplab.robot_import.urdf import numbers

MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Shape:
    """A collision shape: ``kind`` box, cylinder, sphere, capsule or mesh; ``place`` in its link."""

    kind: str
    size: tuple[float, ...]
    place: pin.SE3
    mesh: str = ""

    def corners(self, vertices: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) points in the link frame whose hull holds the shape; a mesh needs its ``vertices`` (m, 3)."""
        if self.kind == "mesh":
            local = np.asarray(vertices) * self.size
        else:
            half = {
                "box": lambda s: np.array(s) / 2,
                "sphere": lambda s: np.full(3, s[0]),
                "cylinder": lambda s: np.array([s[0], s[0], s[1] / 2]),
                "capsule": lambda s: np.array([s[0], s[0], s[1] / 2 + s[0]]),
            }[self.kind](self.size)
            local = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return local @ self.place.rotation.T + self.place.translation


@dataclass(frozen=True)
class Link:
    """One link: its inertia in its own frame (zero if it has none) and its collision shapes."""

    name: str
    inertia: pin.Inertia
    shapes: tuple[Shape, ...]


@dataclass(frozen=True)
class Joint:
    """One joint: ``place`` of the child in the parent at angle 0, ``axis`` in the joint's frame, raw limits."""

    name: str
    kind: str
    parent: str
    child: str
    place: pin.SE3
    axis: np.ndarray
    limits: dict
    mimic: tuple[str, float, float] | None
    element: ET.Element = field(repr=False, compare=False)

    def turned(self, angle: float) -> pin.SE3:
        """Place of the child in the parent at an angle [rad] or a displacement [m]."""
        if self.kind == "prismatic":
            return self.place * pin.SE3(np.eye(3), self.axis * angle)
        if self.kind in ("revolute", "continuous") and angle:
            return self.place * pin.SE3(pin.exp3(self.axis * angle), np.zeros(3))
        return self.place


def _place(element: ET.Element | None) -> pin.SE3:
    origin = None if element is None else element.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    xyz, rpy = (numbers(origin.get(k, "0 0 0"), 3) for k in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)


def _inertia(link: ET.Element, repair: bool) -> pin.Inertia:
    mass = link_mass(link)
    if mass <= 0:
        return pin.Inertia.Zero()
    inertial = link.find("inertial")
    place, matrix = _place(inertial), inertia_matrix(inertial.find("inertia"))
    if repair or mass < FRAME_KG:
        matrix = repaired(matrix)
    return pin.Inertia(mass, place.translation, place.rotation @ matrix @ place.rotation.T)


def repaired(matrix: np.ndarray) -> np.ndarray:
    """The nearest inertia that a solid can have: its second moments of mass, none of them negative."""
    second = np.trace(matrix) / 2 * np.eye(3) - matrix  # integral of x x^T dm
    values, axes = np.linalg.eigh(second)
    floor = max(1e-3 * values.max(), 1e-12)  # our choice: a plate a thirtieth as thick as wide
    second = (axes * np.maximum(values, floor)) @ axes.T
    return np.trace(second) * np.eye(3) - second


def _shape(element: ET.Element) -> Shape | None:
    place, geometry = _place(element), element.find("geometry")
    for found in () if geometry is None else geometry:
        get = found.get
        if found.tag == "box":
            return Shape("box", tuple(float(x) for x in get("size").split()), place)
        if found.tag == "sphere":
            return Shape("sphere", (float(get("radius")),), place)
        if found.tag in ("cylinder", "capsule"):
            return Shape(found.tag, (float(get("radius")), float(get("length"))), place)
        if found.tag == "mesh":
            scale = tuple(float(x) for x in get("scale", "1 1 1").split())
            return Shape("mesh", scale, place, get("filename", ""))
    return None


class Tree:
    """Links and joints of a URDF that :func:`jumplab.robot_import.checks.check` has passed.

    Parameters
    ----------
    root : the root element.
    where : name of the file, for messages.
    path : the file itself, near which meshes are looked for.
    repair_inertia : replace inertias that no solid has by the nearest possible ones.
    """

    def __init__(self, root: ET.Element, where: str, path: Path | None = None, repair_inertia: bool = False):
        self.where, self.path = where, path
        self.links = {
            e.get("name"): Link(
                e.get("name"), _inertia(e, repair_inertia),
                tuple(s for s in map(_shape, e.findall("collision")) if s is not None))
            for e in root.findall("link")
        }  # fmt: skip
        self.joints = {e.get("name"): _joint(e) for e in root.findall("joint")}
        self.above = {j.child: j for j in self.joints.values()}
        self.root = next(name for name in self.links if name not in self.above)
        self.below: dict[str, list[Joint]] = {name: [] for name in self.links}
        for joint in self.joints.values():
            self.below[joint.parent].append(joint)

    def poses(self, angles: dict[str, float] | None = None) -> dict[str, pin.SE3]:
        """Place of every link in the root's frame; joints not named in ``angles`` are at 0."""
        angles, out, todo = angles or {}, {self.root: pin.SE3.Identity()}, [self.root]
        while todo:
            name = todo.pop()
            for joint in self.below[name]:
                out[joint.child] = out[name] * joint.turned(angles.get(joint.name, 0.0))
                todo.append(joint.child)
        return out

    def chain(self, link: str) -> list[Joint]:
        """Joints from the root to a link."""
        out = []
        while link in self.above:
            out.append(self.above[link])
            link = out[-1].parent
        return out[::-1]

    def path_between(self, start: str, end: str) -> list[Joint]:
        """Joints on the way from one link to another, in order."""
        a, b = self.chain(start), self.chain(end)
        shared = 0
        while shared < min(len(a), len(b)) and a[shared] is b[shared]:
            shared += 1
        return a[shared:][::-1] + b[shared:]

    @property
    def mass(self) -> float:
        """Mass of all links [kg]."""
        return float(sum(link.inertia.mass for link in self.links.values()))

    def mesh_file(self, name: str) -> Path | None:
        """A mesh of the URDF on this machine: beside the file, or in a folder above it; None if it is not there."""
        if self.path is None:
            return None
        inside = name.split("://", 1)[-1].lstrip("/")
        rest = inside.split("/", 1)[-1]
        for folder in self.path.resolve().parents:
            for part in (inside, rest):
                if (folder / part).is_file():
                    return folder / part
        return None

    def points(self, link: str) -> np.ndarray:
        """(n, 3) points in a link's frame whose hull holds its collision shapes; meshes count where they are found."""
        found = [np.zeros((0, 3))]
        for shape in self.links[link].shapes:
            if shape.kind != "mesh":
                found.append(shape.corners())
            elif (file := self.mesh_file(shape.mesh)) is not None:
                found.append(shape.corners(_vertices(str(file))))
        return np.concatenate(found)


def _vertices(path: str) -> np.ndarray:
    import coal

    return np.array(coal.MeshLoader(coal.BV_AABB).load(path, np.ones(3)).vertices())


def _joint(e: ET.Element) -> Joint:
    axis = e.find("axis")
    direction = np.array([1.0, 0.0, 0.0]) if axis is None else numbers(axis.get("xyz"), 3)
    limit, mimic = e.find("limit"), e.find("mimic")
    limits = {}
    for key in ("lower", "upper", "effort", "velocity"):
        value = None if limit is None else numbers(limit.get(key), 1)
        if value is not None:
            limits[key] = float(value[0])
    follows = None
    if mimic is not None:
        follows = mimic.get("joint"), float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
    return Joint(e.get("name"), e.get("type"), e.find("parent").get("link"), e.find("child").get("link"),
                 _place(e), direction / max(np.linalg.norm(direction), 1e-12), limits, follows, e)  # fmt: skip


def moving_count(tree: Tree) -> int:
    """Joints of the URDF that could move."""
    return sum(joint.kind in MOVING for joint in tree.joints.values())
