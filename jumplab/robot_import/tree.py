"""A URDF as a tree of links and joints, before it is a jumping robot: places, masses, shapes, limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.robot_import.urdf import numbers

MOVING = ("revolute", "continuous", "prismatic")
LIMITS = ("lower", "upper", "effort", "velocity")
TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
SIZES = {"box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": {"radius": 1, "length": 1}}
SIZES["capsule"] = SIZES["cylinder"]
KNOWN = (*SIZES, "mesh")
FRAME_KG = 5e-4  # lighter links are frames, whose tensor nobody measured; it is ignored
THINNEST = 1e-3  # share of the largest second moment that a repaired inertia keeps: a plate, width over thickness 30


@dataclass(frozen=True)
class Link:
    """One link."""

    name: str
    weighed: bool  # the URDF says something of its mass
    inertia: pin.Inertia  # in its own frame; zero without mass
    shapes: list[tuple[ET.Element, ET.Element]] = field(repr=False)  # (<collision>, the shape in it)


@dataclass(frozen=True)
class Joint:
    """One joint: ``place`` of the child in the parent at angle 0, ``axis`` in the joint's frame, raw limits."""

    name: str
    kind: str
    parent: str
    child: str
    place: pin.SE3
    axis: np.ndarray
    limits: dict[str, float]
    mimic: tuple[str, float, float] | None
    element: ET.Element = field(repr=False, compare=False)

    @property
    def driven(self) -> bool:
        """True if it turns between two stops by a motor of its own."""
        return self.kind == "revolute" and self.mimic is None

    def turned(self, angle: float) -> pin.SE3:
        """Place of the child in the parent at an angle [rad] or a displacement [m]."""
        if self.kind == "prismatic":
            return self.place * pin.SE3(np.eye(3), self.axis * angle)
        if self.kind in MOVING and angle:
            return self.place * pin.SE3(pin.exp3(self.axis * angle), np.zeros(3))
        return self.place


def _place(element: ET.Element) -> pin.SE3:
    origin = element.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    xyz, rpy = (numbers(origin.get(k, "0 0 0"), 3) for k in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)


def inertia_matrix(element: ET.Element) -> np.ndarray:
    """(3, 3) of an ``<inertia>`` [kg m^2]."""
    xx, xy, xz, yy, yz, zz = (float(element.get(key)) for key in TENSOR)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _link(e: ET.Element, repair: bool) -> Link:
    inertial, total = e.find("inertial"), pin.Inertia.Zero()
    mass = 0.0 if inertial is None else float(inertial.find("mass").get("value"))
    if mass > 0:
        place, matrix = _place(inertial), inertia_matrix(inertial.find("inertia"))
        if repair or mass < FRAME_KG:
            matrix = repaired(matrix)
        total = pin.Inertia(mass, place.translation, place.rotation @ matrix @ place.rotation.T)
    shapes = [(c, s) for c in e.findall("collision") for s in c.findall("geometry/*") if s.tag in KNOWN]
    return Link(e.get("name"), inertial is not None, total, shapes)


def repaired(matrix: np.ndarray) -> np.ndarray:
    """The nearest inertia that a solid can have: its second moments of mass, none of them negative."""
    second = np.trace(matrix) / 2 * np.eye(3) - matrix  # integral of x x^T dm
    values, axes = np.linalg.eigh(second)
    floor = max(THINNEST * values.max(), 1e-12)
    second = (axes * np.maximum(values, floor)) @ axes.T
    return np.trace(second) * np.eye(3) - second


def _joint(e: ET.Element) -> Joint:
    name, kind, parent, child = e.get("name"), e.get("type"), e.find("parent").get("link"), e.find("child").get("link")
    axis, limit, mimic = (e.find(tag) for tag in ("axis", "limit", "mimic"))
    direction = np.array([1.0, 0.0, 0.0]) if axis is None else numbers(axis.get("xyz"), 3)
    told = {key: None if limit is None else numbers(limit.get(key), 1) for key in LIMITS}
    limits = {key: float(value[0]) for key, value in told.items() if value is not None}
    follows = None
    if mimic is not None:
        follows = mimic.get("joint"), float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
    unit = direction / max(np.linalg.norm(direction), 1e-12)
    return Joint(name, kind, parent, child, _place(e), unit, limits, follows, e)


class Tree:
    """Links and joints of a URDF whose names, connections and inertials have passed the checks.

    ``where`` is the name of the file for messages, ``path`` the file itself, near which meshes are looked for;
    ``repair_inertia`` replaces inertias that no solid has by the nearest possible ones.
    """

    def __init__(self, root: ET.Element, where: str, path: Path | None = None, repair_inertia: bool = False):
        self.where, self.path = where, path
        self.links = {e.get("name"): _link(e, repair_inertia) for e in root.findall("link")}
        self.joints = {e.get("name"): _joint(e) for e in root.findall("joint")}
        self.above = {j.child: j for j in self.joints.values()}
        self.root = next(name for name in self.links if name not in self.above)
        self.below = {name: [j for j in self.joints.values() if j.parent == name] for name in self.links}

    @property
    def mass(self) -> float:
        """Mass of all links [kg]."""
        return float(sum(link.inertia.mass for link in self.links.values()))

    def poses(self, angles: dict[str, float] | None = None) -> dict[str, pin.SE3]:
        """Place of every link in the root's frame; joints not named in ``angles`` are at 0."""
        angles, out, todo = angles or {}, {self.root: pin.SE3.Identity()}, [self.root]
        while todo:
            name = todo.pop()
            for joint in self.below[name]:
                out[joint.child] = out[name] * joint.turned(angles.get(joint.name, 0.0))
                todo.append(joint.child)
        return out

    def fixed_to(self, link: str) -> list[str]:
        """A link and all links that are fixed to it from below."""
        out = [link]
        for name in out:
            out += [j.child for j in self.below[name] if j.kind == "fixed"]
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
        shared = len(self.chain(self.joining(start, end)))
        return self.chain(start)[shared:][::-1] + self.chain(end)[shared:]

    def joining(self, a: str, b: str) -> str:
        """The last link that the ways from the root to two links share."""
        shared = [x.child for x, y in zip(self.chain(a), self.chain(b), strict=False) if x is y]
        return [self.root, *shared][-1]

    def points(self, link: str) -> np.ndarray:
        """(n, 3) points in a link's frame whose hull holds its collision shapes; meshes count where they are found."""
        found = [np.zeros((0, 3))]
        for collision, shape in self.links[link].shapes:
            place, local = _place(collision), self._mesh(shape) if shape.tag == "mesh" else _corners(shape)
            found.append(local @ place.rotation.T + place.translation)
        return np.concatenate(found)

    def _mesh(self, shape: ET.Element) -> np.ndarray:
        """(n, 3) vertices of a mesh: from beside the URDF, or from a folder above it; none if it is not there."""
        inside = shape.get("filename").split("://", 1)[-1].lstrip("/")
        folders = self.path.resolve().parents if self.path else ()
        places = (folder / part for folder in folders for part in (inside, inside.split("/", 1)[-1]))
        file = next((place for place in places if place.is_file()), None)
        if file is None:
            return np.zeros((0, 3))
        import coal

        mesh = coal.MeshLoader(coal.BV_AABB).load(str(file), np.ones(3))
        return np.array(mesh.vertices()) * numbers(shape.get("scale", "1 1 1"), 3)


def _corners(shape: ET.Element) -> np.ndarray:
    """(8, 3) corners of the box around a shape, in its own frame [m]."""
    size = np.concatenate([numbers(shape.get(key), count) for key, count in SIZES[shape.tag].items()])
    if shape.tag == "box":
        half = size / 2
    elif shape.tag == "sphere":
        half = size.repeat(3)
    else:
        half = np.array([size[0], size[0], size[1] / 2 + (size[0] if shape.tag == "capsule" else 0.0)])
    return half * np.array([*product((-1, 1), repeat=3)])
