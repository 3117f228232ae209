"""A URDF: from a path to XML that is worth reading, and from there to a tree of links and joints.

The parsers of Pinocchio and PyBullet print to the console, guess, or return an empty robot where a file is cut short,
is a web page, or is not a URDF at all. Here each of these is said in one sentence. The tree is not yet a jumping robot.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from importlib import import_module, metadata
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError

MAX_BYTES = 20_000_000  # the largest published URDF is under 1 MB; meshes do not belong here
PACKAGE = "example-robot-data"  # the optional package of published robots (extra "robots")
DESCRIPTIONS = "robot_descriptions"  # the optional package that downloads one at a time (extra "descriptions")
PACKAGE_FOLDER = "cmeel.prefix/share/example-robot-data/robots"
ROOTS = {
    "sdf": "an SDF file, not a URDF",
    "mujoco": "a MuJoCo model, not a URDF",
    "COLLADA": "a COLLADA mesh, not a URDF",
    "html": "a web page (HTML), not a URDF",
}
MOVING = ("revolute", "continuous", "prismatic")
LIMITS = ("lower", "upper", "effort", "velocity")
CORNER, NO_LOAD = (
    "corner",
    "no_load",
)  # [rad/s] up to which the whole effort is there, and from which none; not in URDFs
OWN = ("armature", "friction", "damping")  # of a motor at its joint [kg m^2, N m, N m s/rad], as no URDF tells it
MOTOR = (CORNER, NO_LOAD, *OWN)
TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
SIZES = {"box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": {"radius": 1, "length": 1}}
SIZES["capsule"] = SIZES["cylinder"]
KNOWN = (*SIZES, "mesh")
FRAME_KG = 5e-4  # lighter links are frames, whose tensor nobody measured; it is ignored
TRIANGLE = 1e-3  # relative, by which a moment may exceed the sum of the others: rounding must not refuse a robot
LEFTOVER_M = 0.01  # radius of gyration of the whole robot: a link's tensor that is wrong by less is mended with a note
SOLE_M = 0.012  # points this near the lowest one belong to the sole
THINNEST = 1e-3  # share of the largest second moment that a repaired inertia keeps: a plate, width over thickness 30


def numbers(text: str | None, count: int) -> np.ndarray | None:
    """``count`` finite numbers of an attribute, or None."""
    try:
        values = np.array([float(x) for x in (text or "").split()])
    except ValueError:
        return None
    return values if len(values) == count and np.all(np.isfinite(values)) else None


def locate(name: str, beside: Path) -> Path:
    """Path of a URDF: relative to the folder ``beside``, or of a package.

    ``example-robot-data:folder/file.urdf``; or ``robot_descriptions:h1_description``, where another file of the same
    repository may be named instead of the robot's own: ``robot_descriptions:h1_description:folder/file.urdf``.
    """
    package, colon, inside = name.partition(":")
    if colon and package == DESCRIPTIONS:
        return described(*inside.split(":", 1))
    if not (colon and package == PACKAGE):
        return beside / name
    if not have_published():
        said = f"{name}: the package {PACKAGE} with the published robots is not installed"
        raise RobotError(f"{said}; pip install 'jumplab[robots]'")
    return Path(str(metadata.distribution(PACKAGE).locate_file(f"{PACKAGE_FOLDER}/{inside}")))


def described(name: str, file: str | None = None) -> Path:
    """Path of the URDF or MJCF that the package ``robot_descriptions`` has under ``name``, such as "g1_description".

    ``file`` is another one in that robot's repository. That package downloads a robot once, and keeps it. Raises
    :class:`RobotError` if it is not installed, knows no such robot, has it as a xacro template only, or
    cannot fetch it.
    """
    try:
        known = import_module("robot_descriptions._descriptions").DESCRIPTIONS
    except ModuleNotFoundError:
        said = "the package robot_descriptions is not installed; pip install 'jumplab[descriptions]'"
        raise RobotError(f"robot description {name!r}: {said}") from None
    if name not in known:
        near = get_close_matches(name, known, 3, 0.5)
        said = f"; did you mean {', '.join(near)}?" if near else ""
        raise RobotError(f"robot description {name!r}: robot_descriptions has no robot of that name{said}")
    try:
        module = import_module(f"robot_descriptions.{name}")
    except Exception as e:  # git and the net fail in many ways
        why = (str(e).strip().splitlines() or [type(e).__name__])[-1].strip()
        raise RobotError(f"robot description {name!r}: robot_descriptions cannot fetch it ({why})") from e
    if file is not None:
        return Path(module.REPOSITORY_PATH, file)
    path = getattr(module, "URDF_PATH", getattr(module, "MJCF_PATH", None))
    if path is None:
        raise RobotError(f"robot description {name!r}: is a xacro template only; expand it, and check the URDF")
    return Path(path)


def have_published() -> bool:
    """True if the package with the published robots is installed."""
    return any(metadata.distributions(name=PACKAGE))


def read_urdf(path: str | Path) -> str:
    """The text of a URDF file. Raises :class:`RobotError` if it cannot be one."""
    path = Path(path)
    try:
        if path.is_dir():
            raise RobotError(f"{path}: is a folder; name the URDF file inside it")
        if (size := path.stat().st_size) > MAX_BYTES:
            most = f"a URDF has at most {MAX_BYTES / 1e6:.0f}; name the URDF, not a mesh"
            raise RobotError(f"{path}: has {size / 1e6:.0f} MB, {most}")
        text = decode(path.read_bytes(), str(path))
    except FileNotFoundError:
        raise RobotError(f"{path}: there is no such file; give the path of a URDF") from None
    except (OSError, ValueError) as e:
        raise RobotError(f"{path}: cannot be read ({type(e).__name__}); give the path of a readable URDF") from e
    first = re.match(r"(?:\s|<\?.*?\?>|<!--.*?-->)*<([\w:]+)", text, re.DOTALL)  # URDFs may hold a <mujoco> of settings
    if first is None or first[1] != "mujoco":
        return text
    from jumplab.robot_import.mjcf import as_urdf

    return as_urdf(path)


def decode(raw: bytes, where: str) -> str:
    """Bytes as the text of a URDF; refuses what is no text, or text of another kind."""
    if not raw.strip():
        raise RobotError(f"{where}: the file is empty (0 of {len(raw)} bytes are text); copy or download it again")
    if raw[:2] in (b"\x1f\x8b", b"PK"):
        raise RobotError(f"{where}: is a compressed archive, not a URDF; unpack it first")
    try:
        text, at = raw.decode("utf-8-sig"), raw.find(b"\0")
    except UnicodeDecodeError as e:
        text, at = "", e.start
    if at >= 0:
        raise RobotError(f"{where}: is binary (byte {at} is no UTF-8 text); a URDF is an XML text")
    if text.startswith("version https://git-lfs.github.com/spec"):
        raise RobotError(f"{where}: is a Git LFS pointer of {len(raw)} bytes, not the file itself; run 'git lfs pull'")
    return text


def parse(text: str, where: str) -> ET.Element:
    """Root element of a URDF's text. Raises :class:`RobotError` with the place of the fault."""
    if re.match(r"\s*<(!doctype\s+html|html)", text, re.IGNORECASE):
        raise RobotError(f"{where}: is {ROOTS['html']}; download the raw file")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise RobotError(f"{where}: declares a DOCTYPE or entities, which can expand without limit; remove them")
    xacro = f"{where}: is a xacro template; expand it first: 'xacro robot.xacro > robot.urdf'"
    try:
        root = ET.fromstring(text)
    except ET.ParseError as e:
        line, column = e.position
        said = str(e).partition(":")[0]
        if "unbound prefix" in said and "xacro:" in text:
            raise RobotError(xacro) from None
        ends = text.rstrip().endswith("</robot>")
        kind = "is not well-formed XML" if ends else "ends before </robot>; it is cut short or is no URDF"
        raise RobotError(f"{where}: line {line}, column {column}: {kind} ({said})") from None
    # a "${...}" in a simulator's plug-in or a call left over beside whole links does no harm
    parts = [e for kind in ("link", "joint") for part in root.findall(kind) for e in part.iter()]
    left = [e for e in (parts or root.iter()) if "xacro" in str(e.tag)]
    if left or any("${" in v for e in parts for v in e.attrib.values()):
        raise RobotError(xacro)
    tag = str(root.tag).rpartition("}")[2]
    if tag != "robot":
        raise RobotError(f"{where}: the root element is <{tag}>, {ROOTS.get(tag, 'a URDF begins with <robot>')}")
    return root


# the tree -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Link:
    """One link."""

    name: str
    weighed: bool  # the URDF says something of its mass
    inertia: pin.Inertia  # in its own frame; zero without mass
    shapes: list[tuple[ET.Element, ET.Element]] = field(repr=False)  # (<collision>, the shape in it)
    seen: list[tuple[ET.Element, ET.Element]] = field(repr=False)  # (<visual>, the mesh in it)


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
    coupled: bool  # another joint, on another limb, follows it
    element: ET.Element = field(repr=False, compare=False)

    @property
    def driven(self) -> bool:
        """True if it turns by a motor of its own, between two stops or without."""
        own = self.mimic is None and not self.coupled and self.limits.get("effort") != 0
        return self.kind in ("revolute", "continuous") and own

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


def tensor_of(element: ET.Element) -> np.ndarray:
    """(3, 3) of an ``<inertia>`` [kg m^2]."""
    xx, xy, xz, yy, yz, zz = (float(element.get(key)) for key in TENSOR)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _link(e: ET.Element, most: float) -> Link:
    inertial, total = e.find("inertial"), pin.Inertia.Zero()
    mass = 0.0 if inertial is None else float(inertial.find("mass").get("value"))
    if mass > 0:
        place, matrix = _place(inertial), tensor_of(inertial.find("inertia"))
        if most == np.inf or mass < FRAME_KG or 0 < unsolid(matrix) <= most:
            matrix = repaired(matrix)
        total = pin.Inertia(mass, place.translation, place.rotation @ matrix @ place.rotation.T)
    shapes = [(c, s) for c in e.findall("collision") for s in c.findall("geometry/*") if s.tag in KNOWN]
    seen = [(v, s) for v in e.findall("visual") for s in v.findall("geometry/mesh")]
    return Link(e.get("name"), inertial is not None, total, shapes, seen)


def unsolid(matrix: np.ndarray) -> float:
    """How far an inertia is from the nearest that a solid can have [kg m^2]; 0 for those of solids."""
    low, middle, high = np.linalg.eigvalsh(matrix)
    solid = low > 0 and high <= (low + middle) * (1 + TRIANGLE)
    return 0.0 if solid else max(float(np.abs(repaired(matrix) - matrix).max()), 1e-15)


def slight(root: ET.Element) -> float:
    """The largest error of a link's inertia that no jump would notice, by the mass of all links [kg m^2]."""
    return LEFTOVER_M**2 * sum(float(mass.get("value")) for mass in root.findall("link/inertial/mass"))


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
    return Joint(name, kind, parent, child, _place(e), unit, limits, follows, False, e)


class Tree:
    """Links and joints of a URDF whose names, connections and inertials have passed the checks.

    ``where`` is the name of the file for messages, ``path`` the file itself, near which meshes are looked for;
    ``repair_inertia`` replaces inertias that no solid has by the nearest possible ones.
    """

    def __init__(self, root: ET.Element, where: str, path: Path | None = None, repair_inertia: bool = False):
        self.where, self.path = where, path
        most = np.inf if repair_inertia else slight(root)
        self.links = {e.get("name"): _link(e, most) for e in root.findall("link")}
        self.joints = {e.get("name"): _joint(e) for e in root.findall("joint")}
        self.above = {j.child: j for j in self.joints.values()}
        for follower in [j for j in self.joints.values() if j.mimic]:
            leader = self.joints[follower.mimic[0]]
            if leader not in self.chain(follower.child) and follower not in self.chain(leader.child):
                self.joints[leader.name] = self.above[leader.child] = replace(leader, coupled=True)
        self.root = next(name for name in self.links if name not in self.above)
        self.below = {name: [j for j in self.joints.values() if j.parent == name] for name in self.links}

    @property
    def mass(self) -> float:
        """Mass of all links [kg]."""
        return float(sum(link.inertia.mass for link in self.links.values()))

    def carried(self, link: str) -> float:
        """Mass of a link and of all that hangs on it [kg]."""
        return self.links[link].inertia.mass + sum(self.carried(j.child) for j in self.below[link])

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
            place, local = _place(collision), self._mesh(shape)[0] if shape.tag == "mesh" else _corners(shape)
            found.append(local @ place.rotation.T + place.translation)
        return np.concatenate(found)

    def sole(self, foot: str, turn: np.ndarray) -> np.ndarray:
        """(n, 3) the lowest points of a foot, all links fixed to it, from its origin along the axes ``turn`` (3, 3)."""
        pose, found = self.poses(), [np.zeros((0, 3))]
        for link in self.fixed_to(foot):
            inside = self.points(link) @ pose[link].rotation.T + pose[link].translation
            found.append((inside - pose[foot].translation) @ turn.T)
        points = np.concatenate(found)
        return points[points[:, 2] < points[:, 2].min(initial=np.inf) + SOLE_M]

    def meshes(self, link: str) -> list[tuple[np.ndarray, np.ndarray]]:
        """Points (n, 3) in a link's frame and triangles (m, 3) of the meshes seen of it, where they are found."""
        found = [(_place(visual), *self._mesh(shape)) for visual, shape in self.links[link].seen]
        corners = [[[m.tri_indices(k)[i] for i in range(3)] for k in range(m.num_tris)] if m else [] for *_, m in found]
        moved = [points @ place.rotation.T + place.translation for place, points, _ in found]
        return [(x, np.array(f)) for x, f in zip(moved, corners, strict=True) if f]

    def _mesh(self, shape: ET.Element) -> tuple[np.ndarray, Any]:
        """(n, 3) vertices of a mesh, and the mesh, from beside the URDF or above it; None if it is not there."""
        inside = shape.get("filename").split("://", 1)[-1].lstrip("/")
        told = filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))
        folders = [*(self.path.resolve().parents if self.path else ()), *map(Path, told)]
        places = (folder / part for folder in folders for part in (inside, inside.split("/", 1)[-1]))
        file = next((place for place in places if place.is_file()), None)
        if file is None:
            return np.zeros((0, 3)), None
        import coal

        try:
            mesh = coal.MeshLoader(coal.BV_AABB).load(str(file), np.ones(3))
        except (RuntimeError, ValueError):  # a pointer to a mesh that was not downloaded, or a format of its own
            return np.zeros((0, 3)), None
        return np.array(mesh.vertices()) * numbers(shape.get("scale", "1 1 1"), 3), mesh


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
