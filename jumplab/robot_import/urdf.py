"""A URDF: from a path to XML that is worth reading, and from there to a tree of links and joints.

The parsers of Pinocchio and PyBullet print to the console, guess, or return an empty robot where a
file is cut short, is a web page, or is not a URDF at all. Here each of these is said in one
sentence. The tree is not yet a jumping robot.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import import_module, metadata
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree as ET

import coal
import numpy as np
import pinocchio as pin

from jumplab import reading
from jumplab.errors import RobotError
from jumplab.io.progress import tell
from jumplab.robot.changes import MOMENTS
from jumplab.robot.contact import posed
from jumplab.robot.files import read_text
from jumplab.robot.sagittal import box_corners
from jumplab.robot_import.write import HERE

PACKAGE = "example-robot-data"  # the optional package of published robots (extra "robots")
# the optional package that downloads one at a time (extra "descriptions")
DESCRIPTIONS = "robot_descriptions"
PACKAGE_FOLDER = "cmeel.prefix/share/example-robot-data/robots"
ROOTS = {
    "sdf": "an SDF file, not a URDF",
    "mujoco": "a MuJoCo model, not a URDF",
    "mujocoinclude": "a part of a MuJoCo model; name the file that includes it",
    "COLLADA": "a COLLADA mesh, not a URDF",
    "html": "a web page (HTML), not a URDF",
}
# what may stand before the root element
BEFORE_ROOT = r"\s|\ufeff|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^\[>]*>"
LIMITS = ("lower", "upper", "effort", "velocity")
# of a motor at its joint [kg m^2, N m, N m s/rad]; no URDF has the first
OWN = ("armature", "friction", "damping")
SIZES = {"box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": {"radius": 1, "length": 1}}
SIZES["capsule"] = SIZES["cylinder"]
SHAPES = {
    "box": coal.Box,
    "sphere": coal.Sphere,
    "cylinder": coal.Cylinder,
    "capsule": coal.Capsule,
}
JOINTS = {
    "revolute": pin.JointModelRevoluteUnaligned,
    "continuous": pin.JointModelRevoluteUnaligned,
    "prismatic": pin.JointModelPrismaticUnaligned,
}
MOVING = tuple(JOINTS)
LINK = "\n"  # before the names of links' frames: Pinocchio reduces no model where a joint has one
FRAME_KG = 5e-4  # lighter links are frames, whose tensor nobody measured; it is ignored
# relative, by which a moment may exceed the sum of the others: rounding must not refuse a robot
TRIANGLE = 1e-3
# radius of gyration of the whole robot: a link's tensor that is wrong by less is mended with a note
LEFTOVER_M = 0.01
MOST_MESH_M = 5.0  # no link is longer: a larger mesh is in millimetres
# share of the largest second moment that a repaired inertia keeps: a plate, width over thickness 30
THINNEST = 1e-3
GEAR_SHARE = 0.25  # of what a joint carries: one that carries less, and leads it, is its motor's


def locate(name: str, beside: Path) -> Path:
    """Path of a URDF: relative to the folder ``beside``, or of a package.

    ``example-robot-data:folder/file.urdf``; or ``robot_descriptions:h1_description``, where another
    file of the same repository may be named instead of the robot's own:
    ``robot_descriptions:h1_description:folder/file.urdf``.
    """
    package, colon, inside = name.partition(":")
    if colon and package == DESCRIPTIONS:
        return described(*inside.split(":", 1))
    if not (colon and package == PACKAGE):
        return beside / name
    if not have_published():
        reason = f"{name}: the package {PACKAGE} with the published robots is not installed"
        raise RobotError(f"{reason}; pip install 'jumplab[robots]'")
    return Path(str(metadata.distribution(PACKAGE).locate_file(f"{PACKAGE_FOLDER}/{inside}")))


def described(name: str, file: str | None = None) -> Path:
    """Path of the URDF or MJCF that the package ``robot_descriptions`` has under ``name``, such as
    "g1_description".

    ``file`` is another one in that robot's repository. That package downloads a robot once, and
    keeps it. Raises :class:`RobotError` if it is not installed, knows no such robot, has it as a
    xacro template only, or cannot fetch it.
    """

    def error(text: str) -> RobotError:
        return RobotError(f"robot description {name!r}: {text}")

    try:
        known = import_module("robot_descriptions._descriptions").DESCRIPTIONS
    except ModuleNotFoundError:
        reason = "is not installed; pip install 'jumplab[descriptions]'"
        raise error(f"the package robot_descriptions {reason}") from None
    if name not in known:
        near = get_close_matches(name, known, 3, 0.5)
        hint = f"; did you mean {', '.join(near)}?" if near else ""
        raise error(f"robot_descriptions has no robot of that name{hint}")
    try:
        module = import_module(f"robot_descriptions.{name}")
    except Exception as e:  # git and the net fail in many ways
        why = (str(e).strip().splitlines() or [type(e).__name__])[-1].strip()
        raise error(f"robot_descriptions cannot fetch it ({why})") from e
    if file is not None:
        return Path(module.REPOSITORY_PATH, file)
    path = getattr(module, "URDF_PATH", getattr(module, "MJCF_PATH", None))
    if path is None:
        raise error("is a xacro template only; expand it, and check the URDF")
    return Path(path)


def have_published() -> bool:
    """True if the package with the published robots is installed."""
    return any(metadata.distributions(name=PACKAGE))


def read_urdf(path: str | Path) -> str:
    """The text of a URDF file, or the description of an MJCF file as one. Raises
    :class:`RobotError` if it is neither.
    """
    text = read_text(Path(path))
    tell(f"reading {Path(path).name}")
    # URDFs may hold a <mujoco> of settings
    first = re.match(rf"(?:{BEFORE_ROOT})*<([\w:]+)", text, re.DOTALL)
    if first is None or first[1] != "mujoco":
        return text
    from jumplab.robot_import.mjcf import as_description

    reading.check_mjcf(Path(path), Path(path).parent, RobotError)
    return as_description(Path(path), _declared_first(text)[0])


def _declared_first(text: str) -> tuple[str, bool]:
    """A text without an XML declaration that is not its first word, and a DOCTYPE that declares
    nothing; whether there was such a declaration.
    """
    late = re.match(r"((?:\s|<!--.*?-->)+)<\?xml\s[^>]*\?>", text, re.DOTALL)
    text = late[1] + text[late.end() :] if late else text
    return re.sub(r"<!DOCTYPE\s+(robot|mujoco)[^\[>]*>", "", text, count=1), late is not None


def parse(text: str, where: str) -> ET.Element:
    """Root element of a URDF's text; :class:`RobotError` with the fault's place (line, column)."""
    if re.match(r"\s*<(!doctype\s+html|html)", text, re.IGNORECASE):
        raise RobotError(f"{where}: is {ROOTS['html']}; download the raw file")
    text, late = _declared_first(text)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise RobotError(
            f"{where}: declares a DOCTYPE or entities, which can expand without limit; remove them"
        )
    xacro = f"{where}: is a xacro template; expand it first: 'xacro robot.xacro > robot.urdf'"
    try:
        root = reading.xml(text, where, RobotError)
    except ET.ParseError as e:
        line, column = e.position
        reason = str(e).partition(":")[0]
        if "unbound prefix" in reason and "xacro:" in text:
            raise RobotError(xacro) from None
        kind = "ends before </robot>; it is cut short or is no URDF"
        if text.rstrip().endswith("</robot>"):
            kind = "is not well-formed XML"
        raise RobotError(f"{where}: line {line}, column {column}: {kind} ({reason})") from None
    for element in root.iter():
        if "xacro" not in element.tag:  # of a default namespace
            element.tag = element.tag.rpartition("}")[2]
    # a "${...}" in a simulator's plug-in or a call left over beside whole links does no harm
    parts = [e for kind in ("link", "joint") for part in root.findall(kind) for e in part.iter()]
    left = any("xacro" in e.tag for e in parts or root.iter())
    if left or any(_open(*x) for e in parts for x in e.attrib.items()):
        raise RobotError(xacro)
    if root.tag != "robot":
        what = ROOTS.get(root.tag, "a URDF begins with <robot>")
        raise RobotError(f"{where}: the root element is <{root.tag}>, {what}")
    _drop_lone_links(root)
    if late:
        words = "the XML declaration stands behind a comment or a space, and is ignored"
        ET.SubElement(root, "note", text=words)
    return root


def _open(key: str, value: str) -> bool:
    """Whether an attribute waits for xacro; where a mesh lies may be found all the same."""
    return "${" in value or ("$(" in value and key != "filename")


def _drop_lone_links(root: ET.Element) -> None:
    """Take out links without mass that no joint joins to anything, such as a left-over world."""
    joined = {end.get("link") for joint in root.findall("joint") for end in joint}
    for link in root.findall("link") if joined else ():
        if link.get("name") not in joined and not len(link):
            root.remove(link)
            words = f"the link {link.get('name')!r} is joined to nothing, and left out"
            ET.SubElement(root, "note", text=words)


# numbers of elements
# --------------------------------------------------------------------------------------------------
def numbers(text: str | None, count: int) -> np.ndarray | None:
    """``count`` finite numbers (count,) of an attribute, or None."""
    try:
        values = np.array((text or "").split(), float)
    except ValueError:
        return None
    return values if len(values) == count and np.all(np.isfinite(values)) else None


def finite(element: ET.Element | None, keys: Iterable[str]) -> dict[str, float]:
    """Those attributes of an element that are finite numbers."""
    values = {key: numbers(element.get(key), 1) for key in keys} if element is not None else {}
    return {key: float(value[0]) for key, value in values.items() if value is not None}


def _place(element: ET.Element) -> pin.SE3:
    origin = element.find("origin")
    if origin is None:
        return HERE
    # where it matters, the checks have refused what are no numbers
    given = (numbers(origin.get(key, "0 0 0"), 3) for key in ("xyz", "rpy"))
    xyz, rpy = (np.zeros(3) if x is None else x for x in given)
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)


def placed(place: pin.SE3, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of a frame at ``place``, where that is."""
    return points @ place.rotation.T + place.translation


def across(vector: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """A ``vector`` (3,) without its part along a unit ``axis`` (3,)."""
    return vector - (vector @ axis) * axis


def mass_of(link: ET.Element) -> float:
    """Mass of a link [kg]; 0 without an ``<inertial>``."""
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value"))


def tensor_of(link: ET.Element) -> np.ndarray:
    """(3, 3) inertia of a link that has one, in the axes of its ``<inertial>`` [kg m^2]."""
    xx, xy, xz, yy, yz, zz = (float(link.find("inertial/inertia").get(key)) for key in MOMENTS)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def unsolid(matrix: np.ndarray) -> float:
    """Largest entry by which an inertia (3, 3) differs from its nearest physical one [kg m^2]; 0 if
    it is physical.
    """
    low, middle, high = np.linalg.eigvalsh(matrix)
    solid = low > 0 and high <= (low + middle) * (1 + TRIANGLE)
    return 0.0 if solid else max(float(np.abs(repaired(matrix) - matrix).max()), 1e-15)


def slight(root: ET.Element) -> float:
    """The largest error of an inertia [kg m^2] that no jump would notice, by all links' mass."""
    return LEFTOVER_M**2 * sum(map(mass_of, root.findall("link")))


def repaired(matrix: np.ndarray) -> np.ndarray:
    """The nearest inertia (3, 3) of a solid: no second moment of mass is negative."""
    second = np.trace(matrix) / 2 * np.eye(3) - matrix  # integral of x x^T dm
    values, axes = np.linalg.eigh(second)
    floor = max(THINNEST * values.max(), 1e-12)
    second = (axes * np.maximum(values, floor)) @ axes.T
    return np.trace(second) * np.eye(3) - second


def _inertia(link: ET.Element, most: float) -> pin.Inertia:
    """A link's in its frame, repaired where at most ``most`` [kg m^2] from a solid's; or zero."""
    mass = mass_of(link)
    if not mass > 0:
        return pin.Inertia.Zero()
    matrix = tensor_of(link)
    if most == np.inf or mass < FRAME_KG or 0 < unsolid(matrix) <= most:
        matrix = repaired(matrix)
    return _place(link.find("inertial")).act(pin.Inertia(mass, np.zeros(3), matrix))


# the tree
# --------------------------------------------------------------------------------------------------
@dataclass(eq=False)
class Joint:
    """One joint: ``place`` of the child in the parent at 0, ``axis`` in its frame, raw limits."""

    name: str
    kind: str
    parent: str
    child: str
    place: pin.SE3
    axis: np.ndarray  # (3,)
    limits: dict[str, float]  # of LIMITS, those that are finite numbers
    losses: dict[str, float]  # of OWN, those that the file has and that can be
    mimic: tuple[str, float, float] | None  # leader, multiplier, offset
    driven: bool  # it turns by a motor of its own, between two stops or without
    element: ET.Element = field(repr=False)
    # with all joints at 0, in the root's frame (3,): its origin [m], and its axis
    at: np.ndarray = field(init=False)
    direction: np.ndarray = field(init=False)

    @classmethod
    def read(cls, e: ET.Element) -> Joint:
        """The joint of an element that has passed the checks."""
        axis, limit, mimic, dynamics = (e.find(x) for x in ("axis", "limit", "mimic", "dynamics"))
        direction = np.array([1.0, 0.0, 0.0]) if axis is None else numbers(axis.get("xyz"), 3)
        limits = finite(limit, LIMITS)
        kind = e.get("type")
        follows = None
        if mimic is not None:
            line = {"multiplier": 1.0, "offset": 0.0} | finite(mimic, ("multiplier", "offset"))
            follows = (mimic.get("joint"), *line.values())
        return cls(
            e.get("name"),
            kind,
            *(e.find(end).get("link") for end in ("parent", "child")),
            _place(e),
            direction / max(np.linalg.norm(direction), 1e-12),
            limits,
            {key: x for key, x in finite(dynamics, OWN).items() if x > 0},
            follows,
            kind in ("revolute", "continuous") and limits.get("effort") != 0 and mimic is None,
            e,
        )


class Tree:
    """Links and joints of a URDF whose names, connections and inertials have passed the checks.

    ``model`` is Pinocchio's with a free base, its joints those that can move, with a frame for each
    link; ``carrier`` has the joint that moves a link, ``bodies`` the links that a joint moves,
    ``pose`` where each is with all joints at 0, in the root's frame [m].

    ``where`` is the name of the file for messages, ``path`` the file itself, near which meshes are
    looked for; ``repair_inertia`` replaces inertias that no solid has by the nearest possible,
    else only those at most ``mended`` [kg m^2] from it.
    """

    def __init__(
        self, root: ET.Element, where: str, path: Path | None = None, repair_inertia: bool = False
    ):
        self.xml = root
        self.text = ""
        self.format = root.get("format", "URDF")
        self.where = where
        self.notes = []  # on files that were read on the way
        self.path = path
        self.elements = {e.get("name"): e for e in root.findall("link")}
        self.joints = {e.get("name"): Joint.read(e) for e in root.findall("joint")}
        self.above = {j.child: j for j in self.joints.values()}
        self.root = next(link for link in self.elements if link not in self.above)
        self.mended = np.inf if repair_inertia else slight(root)
        self._build()
        for follower in [j for j in self.joints.values() if j.mimic]:
            leader = self.joints.get(follower.mimic[0])
            if leader is None or leader in self.chain(follower.child):
                continue
            if self.carried(leader.child) < GEAR_SHARE * self.carried(follower.child):
                self._gear(leader, follower)
            elif follower not in self.chain(leader.child):
                leader.driven = False  # a joint on another limb follows it

    def _gear(self, motor: Joint, joint: Joint) -> None:
        """Let a joint be moved by the motor that it follows, which carries next to nothing."""
        _, factor, offset = joint.mimic
        if not (motor.driven and factor and joint.kind in ("revolute", "continuous")):
            return
        limit = joint.element.find("limit")
        for key, ratio in (("effort", 1 / factor), ("velocity", factor)):
            joint.limits.pop(key, None)
            if limit is not None:
                limit.attrib.pop(key, None)
            if key in motor.limits:
                joint.limits[key] = abs(ratio) * motor.limits[key]
        for key, ratio in zip(OWN, (factor**-2, 1 / abs(factor), factor**-2), strict=True):
            if lost := joint.losses.get(key, 0.0) + ratio * motor.losses.get(key, 0.0):
                joint.losses[key] = lost
        joint.mimic = None
        motor.mimic = (joint.name, 1 / factor, -offset / factor)
        joint.driven = True
        motor.driven = False
        self.notes.append(
            f"joint {joint.name!r} is moved by the motor of {motor.name!r}, by a gear of {factor:g}"
        )

    def _build(self) -> None:
        """Pinocchio's model, outwards; inertias repaired as :func:`_inertia` says."""
        self.model = pin.Model()
        self.carrier = {}
        self.bodies = {}
        todo = [(self.root, 0, HERE, "", "floating", None)]
        for link, carrier, place, name, kind, axis in todo:
            if kind != "fixed":
                turning = JOINTS[kind](axis) if kind in MOVING else pin.JointModelFreeFlyer()
                carrier = self.model.addJoint(carrier, turning, place, name)
                self.model.addJointFrame(carrier)
                place = HERE
            self.carrier[link] = carrier
            self.bodies.setdefault(carrier, []).append(link)
            self.model.appendBodyToJoint(carrier, _inertia(self.elements[link], self.mended), place)
            frame = pin.Frame(LINK + link, carrier, 0, place, pin.FrameType.BODY)
            self.model.addFrame(frame)
            below = [j for j in self.joints.values() if j.parent == link]
            todo += [(j.child, carrier, place * j.place, j.name, j.kind, j.axis) for j in below]
        self.mass = pin.computeTotalMass(self.model)
        data = posed(self.model)
        self._masses = [*data.mass]
        self.pose = link_poses(self.model)
        for joint in self.joints.values():
            pose = self.pose[joint.child]
            joint.at = pose.translation
            joint.direction = pose.rotation @ joint.axis

    def error(self, text: str) -> RobotError:
        """An error that begins with the file's name."""
        return RobotError(f"{self.where}: {text}")

    def body_of(self, link: str) -> pin.Inertia:
        """Inertia of a link and all fixed to it, in their joint's frame [kg, m, kg m^2]."""
        return self.model.inertias[self.carrier[link]]

    def carried(self, link: str) -> float:
        """Mass of the body of a link and of all that hangs on it [kg]."""
        return self._masses[self.carrier[link]]

    def holding(self, held: Mapping[str, float], moving: Collection[str]) -> pin.Model:
        """Pinocchio's model whose other joints do not move: they are ``held`` [rad, m], else at 0.

        Floating joints are not held.
        """
        model = self.model
        still = [j.name for j in self.joints.values() if j.kind in MOVING and j.name not in moving]
        joints = [model.getJointId(name) for name in still]
        at = np.zeros(model.nv)
        at[[model.idx_vs[j] for j in joints]] = [held.get(name, 0.0) for name in still]
        return pin.buildReducedModel(model, joints, pin.integrate(model, pin.neutral(model), at))

    def chain(self, link: str) -> list[Joint]:
        """Joints (in order) from the root to a link."""
        out = []
        while link in self.above:
            out.insert(0, self.above[link])
            link = out[0].parent
        return out

    def path_between(self, start: str, end: str) -> list[Joint]:
        """Joints on the way from one link to another (in order)."""
        up = self.chain(start)
        down = self.chain(end)
        return [j for j in up[::-1] if j not in down] + [j for j in down if j not in up]

    def shapes(self, link: str, kind: str = "collision") -> list[tuple[pin.SE3, ET.Element]]:
        """Known shapes of a link, and places in its frame [m]; kind may be "visual"."""
        return [
            (_place(e), shape)
            for e in self.elements[link].findall(kind)
            for shape in e.findall("geometry/*")
            if shape.tag == "mesh" or _sizes(shape)
        ]

    def corners(self, shape: ET.Element) -> np.ndarray:
        """(n, 3) points of a shape, in its own frame [m], none of a mesh that is not there."""
        if shape.get("vertex"):  # of an MJCF
            return np.array(shape.get("vertex").split(), float).reshape(-1, 3)
        if shape.tag != "mesh":
            return box_corners(SHAPES[shape.tag](*_sizes(shape)))
        mesh = self._mesh(shape)
        return np.array(mesh.vertices()) if mesh else np.zeros((0, 3))

    def below(self, link: str) -> list[str]:
        """The links that move with a link, and those that hang on them, with their joints at 0."""
        carrier = self.carrier[link]
        hanging = [c for c in self.bodies if c == carrier or carrier in self.model.supports[c]]
        return [part for c in hanging for part in self.bodies[c]]

    def meshes(self, link: str) -> list[tuple[np.ndarray, np.ndarray]]:
        """Points (n, 3) in a link's frame, triangles (m, 3) of the meshes that are found."""
        out = []
        for place, shape in self.shapes(link, "visual"):
            mesh = self._mesh(shape) if shape.get("filename") else None
            if mesh and mesh.num_tris:
                corners = map(mesh.tri_indices, range(mesh.num_tris))
                triangles = np.array([[corner[i] for i in range(3)] for corner in corners])
                out.append((placed(place, np.array(mesh.vertices())), triangles))
        return out

    def _mesh(self, shape: ET.Element) -> coal.BVHModelBase | None:
        """A mesh from beside the URDF or above it; None if it is not there, or cannot be read."""
        inside = unquote(shape.get("filename", "")).replace("\\", "/")
        inside = re.sub(r"^(\w+://|\$\(find\s+([^)]*)\))", r"\2", inside).lstrip("/")
        packages = filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))
        folders = [*(self.path.resolve().parents if self.path else ()), *map(Path, packages)]
        names = (inside, inside.split("/", 1)[-1])
        file = next((x for f in folders for name in names if (x := _file(f / name))), None)
        if file is None:
            return None
        scale = numbers(shape.get("scale", "1 1 1"), 3)
        loader = coal.MeshLoader(coal.BV_AABB)
        try:
            mesh = loader.load(str(file), scale)
            if np.abs(mesh.vertices()).max(initial=0.0) > MOST_MESH_M:
                self.notes.append(f"the mesh {inside!r} is taken in millimetres")
                mesh = loader.load(str(file), scale / 1000)
            return mesh
        # a pointer to a mesh that was not downloaded, or a format of its own
        except (RuntimeError, ValueError):
            return None


def _file(path: Path) -> Path | None:
    """A file, whether its name has capital letters or not; None without one."""
    if path.is_file():
        return path
    beside = path.parent.iterdir() if path.parent.is_dir() else ()
    return next((x for x in beside if x.name.lower() == path.name.lower() and x.is_file()), None)


def links_of(model: pin.Model) -> dict[str, int]:
    """Index of the frame of every link, by name."""
    frames = enumerate(model.frames)
    return {frame.name[1:]: i for i, frame in frames if frame.type == pin.FrameType.BODY}


def link_poses(model: pin.Model) -> dict[str, pin.SE3]:
    """Place of every link [m] in the world with all joints at 0, by name."""
    data = posed(model)
    return {name: data.oMf[i].copy() for name, i in links_of(model).items()}


def _sizes(shape: ET.Element) -> list[float]:
    """Sizes of a shape [m]; [] if it is not known, or they are not positive numbers."""
    sizes = [numbers(shape.get(key), count) for key, count in SIZES.get(shape.tag, {}).items()]
    good = all(x is not None and np.all(x >= 0) for x in sizes)
    return [*np.concatenate(sizes)] if sizes and good else []
