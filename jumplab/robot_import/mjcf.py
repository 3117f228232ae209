"""A robot of MuJoCo's own format (MJCF), by MuJoCo's compiled model, in the description that URDFs
end in too: links, joints with range, torque, armature and losses, shapes.

Parts of an MJCF that such a description lacks (loops, tendons, springs, other things in a scene)
are named in its ``<note>`` elements.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
from mujoco import mjtBias as BIAS
from mujoco import mjtDyn as DYNAMICS
from mujoco import mjtEq as EQUALITY
from mujoco import mjtGain as GAIN
from mujoco import mjtGeom as GEOM
from mujoco import mjtJoint as JOINT
from mujoco import mjtTrn as TRANSMISSION
from mujoco import mjtWrap as WRAP

from jumplab.errors import RobotError
from jumplab.robot.contact import shifted
from jumplab.robot_import.write import HERE, add, add_joint, add_link, add_origin, listed

ON_JOINT = [*map(int, (TRANSMISSION.mjTRN_JOINT, TRANSMISSION.mjTRN_JOINTINPARENT))]
TURNING = [*map(int, (JOINT.mjJNT_HINGE, JOINT.mjJNT_BALL))]
TIES = [*map(int, (EQUALITY.mjEQ_CONNECT, EQUALITY.mjEQ_WELD))]  # of bodies: closed chains
# an activation of these is no larger than the control
PLAIN = [*map(int, (DYNAMICS.mjDYN_NONE, DYNAMICS.mjDYN_FILTER, DYNAMICS.mjDYN_FILTEREXACT))]
# points of a sphere of radius 1, (n, 3), 6 deg apart
TURN, TILT = np.radians(np.meshgrid(np.arange(0, 360, 6), np.arange(-90, 91, 6))).reshape(2, -1)
ROUND = np.stack([np.cos(TILT) * np.cos(TURN), np.cos(TILT) * np.sin(TURN), np.sin(TILT)], axis=-1)
LONG = {GEOM.mjGEOM_CAPSULE: "capsule", GEOM.mjGEOM_CYLINDER: "cylinder"}
UNREADABLE = (ValueError, mujoco.FatalError, OSError)
MASSLESS = "; give the body an <inertial> with a mass above 0"
UNNAMED = "MuJoCo Model"
MOST_MESHES = 5  # of which hulls are made in half a second; MuJoCo lets nothing else run then
MOST_TOES = 2  # joints that hang on a foot
FOOT_HEIGHT = 0.35  # of a robot's, over its lowest body, up to which a foot may be
# elements of settings, in which an attribute that another MuJoCo knows is no part of the robot
SETTINGS = ("option", "flag", "size", "global", "quality", "map", "headlight", "statistic", "key")
UNKNOWN = re.compile(r"unrecognized attribute: '(\w+)'; Element '(\w+)'")
# names of files that say nothing of the robot in them
GENERIC = re.compile(r"(?i)[ _-]*\b(scene|robot|model|main|mjcf|mjx)\b[ _-]*|^scene[ _-]")


def as_description(path: Path, text: str) -> str:
    """The description, as XML, of the robot in an MJCF file; raises :class:`RobotError` if MuJoCo
    cannot read it, if its mass depends on files that are not there, or if it has no robot, or two.

    ``text`` is what the file holds. Links between several joints of one body have no mass.
    """
    notes = []
    spec = _spec(path, text, notes)
    model = _compiled(spec, path, notes)
    xml = ET.Element("robot", name=_name(spec, path, text), format="MJCF")
    _Writer(model, _robot_of(model, path.name, notes), xml, notes).write()
    for note in notes:
        add(xml, "note", text=note)
    return ET.tostring(xml, encoding="unicode")


# reading
# --------------------------------------------------------------------------------------------------
def _spec(path: Path, text: str, notes: list[str]) -> mujoco.MjSpec:
    """MuJoCo's own reading of a file, whatever it is called; settings that this MuJoCo does not
    know are left out.
    """
    # MuJoCo would write its warnings into a file of the working folder
    mujoco.set_mju_user_warning(logging.getLogger(__name__).info)
    texts = dict(_included(path, text))
    # MuJoCo reads only files that are called so; what they include may lie in other folders
    plain = path.suffix in (".xml", ".urdf") and path.read_bytes() == text.encode()
    while True:
        try:
            if plain:
                return mujoco.MjSpec.from_file(str(path))
            included = {name: inner.encode() for name, inner in texts.items()}
            spec = mujoco.MjSpec.from_string(text, include=included)
            spec.modelfiledir = f"{path.parent}/"
            return spec
        except UNREADABLE as e:
            match = UNKNOWN.search(_sentence(e))
            key, tag = match.groups() if match else ("", "")
            given = re.compile(rf"(<{tag}\b[^>]*?)\s{key}\s*=\s*([\"']).*?\2", re.DOTALL)
            if tag not in SETTINGS or not any(map(given.search, (text, *texts.values()))):
                raise _unreadable(path, e) from e
            plain = False
            text = given.sub(r"\1", text)
            texts = {name: given.sub(r"\1", inner) for name, inner in texts.items()}
            notes.append(f"<{tag}> has {key!r}, which this MuJoCo does not know: left out")


def _included(path: Path, text: str) -> Iterator[tuple[str, str]]:
    """Names and contents of the files that a text includes or attaches, and of those in them."""
    todo = [(path.parent, text)]
    seen = {path.resolve()}
    for folder, outer in todo:
        for name in re.findall(r"<(?:include|model)\s[^>]*file\s*=\s*[\"']([^\"']+)", outer):
            # beside the first file, or beside the one that includes it
            files = (path.parent / name, folder / name)
            file = next((x.resolve() for x in files if x.is_file()), None)
            if file is not None and file not in seen:
                inner = file.read_text("utf-8", "replace")
                seen.add(file)
                todo.append((file.parent, inner))
                yield name, inner


def _sentence(e: Exception) -> str:
    """MuJoCo's complaint in a line, with the element that it names."""
    sentence = "; ".join(line.strip() for line in str(e).splitlines() if line.strip())
    return sentence + (MASSLESS if "mjMINVAL" in sentence else "")


def _unreadable(path: Path, e: Exception) -> RobotError:
    return RobotError(f"{path.name}: MuJoCo cannot read this MJCF file: {_sentence(e)}")


def _name(spec: mujoco.MjSpec, path: Path, text: str) -> str:
    """The robot's name: of the model, of a file that it includes, else of file or folder."""
    inner = [spec.modelname if spec.modelname != UNNAMED else ""]
    for _, part in _included(path, text):
        inner += re.findall(r"<mujoco\s[^>]*model\s*=\s*\"([^\"]+)", part)
    names = (GENERIC.sub("", name) for name in (*inner, path.stem, path.resolve().parent.name))
    return next((name for name in names if name.strip(" _-")), path.stem)


def _compiled(spec: mujoco.MjSpec, path: Path, notes: list[str]) -> mujoco.MjModel:
    """The model, without pictures, terrain and the meshes that are not there, if none of them
    weighs anything.
    """
    folders = {"", spec.compiler.meshdir, spec.compiler.texturedir}
    files = sorted({x.file for x in (*spec.textures, *spec.hfields) if x.file})
    absent = [f for f in files if not any((path.parent / x / f).is_file() for x in folders)]
    if absent:
        notes.append(f"the pictures {listed(absent)} are not there: left out")
    pictures = [*spec.textures, *spec.materials, *spec.skins, *spec.sensors, *spec.keys]
    terrain = [g for g in spec.geoms if int(g.type) == GEOM.mjGEOM_HFIELD]
    for part in (*spec.geoms, *spec.sites, *spec.tendons, *spec.flexes):
        part.material = ""
    for part in [*pictures, *terrain, *spec.hfields]:
        spec.delete(part)
    for pair in _pairs_with_others(spec, notes):
        spec.delete(pair)
    spec.compiler.fusestatic = spec.compiler.discardvisual = False
    if len(spec.meshes) > MOST_MESHES and not _always_from_geoms(spec):
        _spare_meshes(spec, notes)
    while True:
        unread = spec.copy()  # what has read its meshes takes seconds to delete some
        try:
            return spec.compile()
        except (ValueError, mujoco.FatalError) as e:
            lost = _lost(spec.meshes, _sentence(e))
            if not lost:
                raise _unreadable(path, e) from e
            files = [mesh.file for mesh in lost]
            spec = unread
            _leave_out(spec, [m for m in spec.meshes if m.file in files], path, notes)


def _always_from_geoms(spec: mujoco.MjSpec) -> bool:
    """Whether geoms weigh although their body has an <inertial>."""
    return spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE


def _spare_meshes(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Replace massless meshes that belong to no foot by points: MuJoCo takes a minute for
    the hulls of a thousand.
    """
    below = {b.name: len(b.find_all("joint")) - len(list(b.joints)) for b in spec.bodies}
    ends = {name for name, joints in below.items() if joints <= MOST_TOES}
    bare = spec.copy()
    _as_points(bare, set())
    with suppress(ValueError, mujoco.FatalError):  # said where the whole is compiled
        ends -= _high(bare.compile())
    spared = _as_points(spec, ends)
    notes.append(f"{len(spared)} of {len(spec.meshes)} meshes, none of a foot, are not read")


def _high(model: mujoco.MjModel) -> set[str]:
    """Names of the bodies that are no feet, by their height with all joints at 0: of hands, each
    finger ends a chain, with many meshes.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    up = -model.opt.gravity if np.any(model.opt.gravity) else np.array([0.0, 0.0, 1.0])
    height = data.xpos[1:] @ up
    high = np.flatnonzero(height > height.min() + FOOT_HEIGHT * np.ptp(height))
    return {model.body(int(i) + 1).name for i in high} - {""}


def _as_points(spec: mujoco.MjSpec, but: Collection[str]) -> list[mujoco.MjsMesh]:
    """Points instead of massless meshes of all bodies ``but`` some; the meshes that are not read
    then.
    """
    for geom in spec.geoms:
        if geom.meshname and geom.parent.explicitinertial and geom.parent.name not in but:
            geom.type = GEOM.mjGEOM_SPHERE
            geom.meshname = ""
            geom.size = [1e-3, 0.0, 0.0]
    used = {geom.meshname for geom in spec.geoms}
    spared = [mesh for mesh in spec.meshes if mesh.name not in used]
    for mesh in spared:
        mesh.file = ""
        mesh.uservert = np.vstack([np.zeros(3), np.eye(3)]).ravel()
        mesh.userface = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
    return spared


def _pairs_with_others(spec: mujoco.MjSpec, notes: list[str]) -> list[mujoco.MjsPair]:
    """Contact pairs with a geom that is in another file, such as the scene's floor; the geoms that
    are here are marked as such that touch.
    """
    here = {geom.name: geom for geom in spec.geoms}
    pairs = []
    others = {}  # in order, each once
    for pair in spec.pairs:
        ends = (pair.geomname1, pair.geomname2)
        if lost := [name for name in ends if name not in here]:
            pairs.append(pair)
            others[lost[0]] = pair
            for name in {*ends} - {*lost}:
                here[name].contype = 1
    if pairs:
        notes.append(
            f"the pairs with {listed(others)}, which is terrain or in another file, are left out"
        )
    return pairs


def _lost(meshes: Iterable[mujoco.MjsMesh], sentence: str) -> list[mujoco.MjsMesh]:
    """Meshes of whose files MuJoCo complains: one that is no mesh, such as a pointer that Git LFS
    has not replaced, or all of a folder that are not there.
    """
    reading = re.search(r"decoder|MSH file|vertices required", sentence)
    opening = re.search(r"Error opening file '(.*?)'", sentence)
    for mesh in meshes:
        if mesh.file and reading and f"name '{mesh.name}'" in sentence:
            return [mesh]
        if mesh.file and opening and opening[1].endswith(mesh.file):
            folder = Path(opening[1]).parent
            beside = [m for m in meshes if Path(m.file).parent == Path(mesh.file).parent]
            return [m for m in beside if m.file and not (folder / Path(m.file).name).is_file()]
    return []


def _leave_out(
    spec: mujoco.MjSpec, meshes: list[mujoco.MjsMesh], path: Path, notes: list[str]
) -> None:
    """Delete meshes that are not there, and the geoms that show them; refused if they weigh."""
    files = {mesh.name: mesh.file for mesh in meshes}
    geoms = [g for g in spec.geoms if g.meshname in files]
    low, high = spec.compiler.inertiagrouprange
    always = _always_from_geoms(spec)
    for geom in geoms:
        body = geom.parent
        weighs = geom.mass > 0 if np.isfinite(geom.mass) else geom.density > 0
        counts = always or not body.explicitinertial
        if weighs and counts and low <= geom.group <= high and body.name != "world":
            raise RobotError(
                f"{path.name}: body {body.name!r}: its mass and inertia are those of the "
                f"mesh {files[geom.meshname]!r}, which is not there or cannot be read; put it into "
                f"{str(path.parent / spec.compiler.meshdir)!r}, or give the body an <inertial>"
            )
    names = {g.name for g in geoms if g.name}
    pairs = [pair for pair in spec.pairs if {pair.geomname1, pair.geomname2} & names]
    bodies = sorted({g.parent.name for g in geoms})
    for part in [*pairs, *geoms, *meshes]:
        spec.delete(part)
    where = f" of {listed(bodies)}" if bodies else ""
    what = f"the mesh {listed(files.values())}{where} is"
    if len(files) > 1:
        what = f"the meshes {listed(files.values())}{where} are"
    notes.append(f"{what} not there or cannot be read: left out")


def _robot_of(model: mujoco.MjModel, where: str, notes: list[str]) -> int:
    """The body at the world that carries the robot: the one with the most hinges."""
    tops = np.flatnonzero(model.body_parentid[1:] == 0) + 1
    turns = np.isin(model.jnt_type, TURNING)
    below = model.jnt_bodyid[turns & (model.body_parentid[model.jnt_bodyid] > 0)]
    hinges = np.bincount(model.body_rootid[below], minlength=model.nbody)
    most = hinges.max()
    robots = [int(top) for top in tops if hinges[top] == most]
    if not most:
        raise RobotError(f"{where}: no body hangs on another by a hinge; a robot needs legs")
    if len(robots) > 1:
        names = listed(model.body(top).name for top in robots)
        raise RobotError(
            f"{where}: the bodies {names} of the world have {most} hinges each below them, "
            f"{len(robots)} robots; take out all but one"
        )
    if others := [model.body(top).name or f"body_{top}" for top in tops if top not in robots]:
        notes.append(f"other bodies of the scene are left out: {listed(others)}")
    return robots[0]


# torques
# --------------------------------------------------------------------------------------------------
def _force(model: mujoco.MjModel, a: int) -> np.ndarray:
    """Least and greatest force (2,) of an actuator, before its gear; infinite if nothing says."""
    switched_off = model.opt.disableactuator >> model.actuator_group[a] & 1
    unbiased = model.actuator_biastype[a] == BIAS.mjBIAS_NONE
    damper = unbiased and not np.any(model.actuator_gainprm[a, :2])
    if switched_off or damper:
        return np.zeros(2)
    ends = np.array([-np.inf, np.inf])
    if model.actuator_forcelimited[a]:
        ends = model.actuator_forcerange[a].copy()
    plain = model.actuator_ctrllimited[a] and model.actuator_dyntype[a] in PLAIN
    if unbiased and model.actuator_gaintype[a] == GAIN.mjGAIN_FIXED:
        if plain or model.actuator_actlimited[a]:
            given = model.actuator_ctrlrange[a] if plain else model.actuator_actrange[a]
            ends = np.clip(np.sort(model.actuator_gainprm[a, 0] * given), *ends)
    return ends


@dataclass(frozen=True)
class _Loop:
    """A closed chain: its equality, the bodies that it ties, hinges that no spring holds, on the
    way to the one and to the other, and all joints there.
    """

    name: str
    ends: list[int]
    ways: list[list[int]]
    joints_there: list[list[int]]


def _loops(model: mujoco.MjModel) -> Iterator[_Loop]:
    hinges = (model.jnt_type == JOINT.mjJNT_HINGE) & (model.jnt_stiffness == 0)
    for e in np.flatnonzero(model.eq_active0 & np.isin(model.eq_type, TIES)):
        ends = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            ends = model.site_bodyid[ends].tolist()
        one, two = ({*_up(model, body)} for body in ends)
        there = [np.isin(model.jnt_bodyid, [*way]) for way in (one - two, two - one)]
        ways = [np.flatnonzero(way & hinges).tolist() for way in there]
        joints = [np.flatnonzero(way).tolist() for way in there]
        yield _Loop(model.equality(e).name or str(e), ends, ways, joints)


def _bent(model: mujoco.MjModel, e: int) -> bool:
    """Whether a joint follows another, by an equality of joints, along no line."""
    _, factor, *further = model.eq_data[e, :5]
    return model.eq_obj2id[e] >= 0 and (any(further) or not factor)


def _up(model: mujoco.MjModel, body: int) -> Iterator[int]:
    """A body and all that carry it."""
    while body:
        yield body
        body = int(model.body_parentid[body])


class _Motors:
    """Effects of a model's actuators on its degrees of freedom (nv)."""

    def __init__(self, model: mujoco.MjModel):
        self.torque = np.zeros((model.nv, 2))  # least, greatest [N m]
        self.driven = np.zeros(model.nv, bool)
        # by a tendon or a site, whose lever changes: its torque is not known
        self.pulled = np.zeros(model.nv, bool)
        self.armature = model.dof_armature.copy()
        self.damping = model.dof_damping.copy()
        self.others = []  # actuators that are not counted
        for a in range(model.nu):
            self._add(model, a)
        driven = model.jnt_bodyid[self.driven[model.jnt_dofadr]]
        carried = {above for body in driven for above in _up(model, model.body_parentid[body])}
        for loop in _loops(model):
            # a chain that only holds another one, which goes on, gets no motor by that
            on = [end in carried for end in loop.ends]
            for way, leads in zip(loop.ways, on, strict=True):
                self.pulled[model.jnt_dofadr[way]] |= leads or not any(on)
        for e in np.flatnonzero(model.eq_active0 & (model.eq_type == EQUALITY.mjEQ_JOINT)):
            if _bent(model, e):  # by a lever that changes
                self.pulled[model.jnt_dofadr[[model.eq_obj1id[e], model.eq_obj2id[e]]]] = True
        for k in np.flatnonzero(model.jnt_actfrclimited):
            dof = model.jnt_dofadr[k]
            given = self.torque[dof] if self.driven[dof] else [-np.inf, np.inf]
            self.torque[dof] = np.clip(given, *model.jnt_actfrcrange[k])
            self.driven[dof] = True

    def _add(self, model: mujoco.MjModel, a: int) -> None:
        kind = model.actuator_trntype[a]
        k = model.actuator_trnid[a, 0]
        if kind not in ON_JOINT:
            self.others.append(model.actuator(a).name or f"actuator_{a}")
            tendon = kind == TRANSMISSION.mjTRN_TENDON
            if tendon and model.wrap_type[model.tendon_adr[k]] == WRAP.mjWRAP_JOINT:
                parts = model.tendon_adr[k] + np.arange(model.tendon_num[k])
                self.pulled[model.jnt_dofadr[model.wrap_objid[parts]]] = True
            elif kind != TRANSMISSION.mjTRN_BODY:
                self.pulled[:] = True
            return
        count = 3 if model.jnt_type[k] == JOINT.mjJNT_BALL else 1
        used = np.flatnonzero(model.actuator_gear[a, :count])
        gear = model.actuator_gear[a, used]
        dofs = model.jnt_dofadr[k] + used
        self.torque[dofs] += np.sort(np.outer(gear, _force(model, a)))
        self.driven[dofs] = True
        self.armature[dofs] += gear**2 * model.actuator_armature[a]
        self.damping[dofs] += gear**2 * model.actuator_damping[a]

    def effort(self, dof: int) -> float | None:
        """The torque that a joint has both ways [N m], the weaker way; None if nothing says."""
        if not self.driven[dof]:
            return None if self.pulled[dof] or not (self.driven.any() or self.others) else 0.0
        weaker = min(-self.torque[dof, 0], self.torque[dof, 1])
        return float(max(weaker, 0.0)) if np.isfinite(weaker) else None


# writing
# --------------------------------------------------------------------------------------------------
def _place(position: np.ndarray, quaternion: np.ndarray) -> pin.SE3:
    return pin.XYZQUATToSE3(np.concatenate([position, np.roll(quaternion, -1)]))


class _Writer:
    """The bodies of one robot of a model, as elements of a description."""

    def __init__(self, model: mujoco.MjModel, root: int, xml: ET.Element, notes: list[str]):
        self.model = model
        self.root = root
        self.xml = xml
        self.notes = notes
        self.motors = _Motors(model)
        self.bodies = [i for i in range(1, model.nbody) if model.body_rootid[i] == root]
        self.names = {i: model.body(i).name or f"body_{i}" for i in self.bodies}
        self.joints = {}  # number of a joint -> names that it has got
        # where joints count from [rad, m]: there bodies are as the file places them
        self.ref = model.qpos0[model.jnt_qposadr] * (model.jnt_type != JOINT.mjJNT_BALL)
        paired = {*model.pair_geom1, *model.pair_geom2}
        self.touching = [
            bool(model.geom_contype[g] | model.geom_conaffinity[g]) or g in paired
            for g in range(model.ngeom)
        ]

    def write(self) -> None:
        """Links with the joints above them, then what is between joints, and what is left out."""
        for i in self.bodies:
            joints = [int(k) for k in np.flatnonzero(self.model.jnt_bodyid == i)]
            base = [k for k in joints if self.model.jnt_type[k] != JOINT.mjJNT_FREE]
            if i != self.root:
                self._add_joints(i, joints)
            elif base:
                self.notes.append(
                    f"the joints {self._joints(base)} join the body {self.names[i]!r} to the "
                    f"world: left out, it moves freely"
                )
            self._add_link(i)
        self._add_equalities()
        self._note_what_is_left_out()

    def _add_joints(self, i: int, joints: list[int]) -> None:
        """The joints above a body, with links without mass between several."""
        model = self.model
        name = self.names[i]
        above = self.names[model.body_parentid[i]]
        place = _place(model.body_pos[i], model.body_quat[i])
        for k in joints:
            above, place = self._add_joint(k, above, place, name, k == joints[-1])
        if above != name:
            add_joint(self.xml, f"{name}_fixed", "fixed", (above, name), place)

    def _add_link(self, i: int) -> None:
        model = self.model
        middle = _place(model.body_ipos[i], model.body_iquat[i])
        inertia = pin.Inertia(model.body_mass[i], np.zeros(3), np.diag(model.body_inertia[i]))
        link = add_link(self.xml, self.names[i], middle.act(inertia))
        for g in np.flatnonzero(model.geom_bodyid == i):
            if model.geom_type[g] != GEOM.mjGEOM_PLANE:
                self._add_shape(link, g)

    def _add_joint(
        self, k: int, above: str, place: pin.SE3, body: str, last: bool
    ) -> tuple[str, pin.SE3]:
        """A joint, or the three of a ball; the link that it moves, and the place of the body or
        of the next joint in it.
        """
        model = self.model
        name = model.joint(k).name or f"{body}_joint_{k}"
        kind = model.jnt_type[k]
        anchor = shifted(model.jnt_pos[k])
        ball = kind == JOINT.mjJNT_BALL
        if ball:
            self.notes.append(f"the ball joint {name!r} is taken as hinges about x, y and z")
        self.joints[k] = [f"{name}_{axis}" for axis in "xyz"] if ball else [name]
        axes = np.eye(3) if ball else model.jnt_axis[k][None]
        place = place * anchor
        for n, joint in enumerate(self.joints[k]):
            end = last and n == len(axes) - 1 and not np.any(model.jnt_pos[k])
            child = body if end else self._between(f"{body}_{joint}")
            moving = "prismatic" if kind == JOINT.mjJNT_SLIDE else "revolute"
            limits, losses = self._limits(k, n)
            element = add_joint(self.xml, joint, moving, (above, child), place, axes[n], limits)
            add(element, "dynamics", **losses)
            above = child
            place = HERE
        return above, anchor.inverse()

    def _between(self, name: str) -> str:
        """A link without mass, of a name that no body has; its name."""
        while name in self.names.values():
            name += "_"
        add(self.xml, "link", name=name, between="joints")
        return name

    def _limits(self, k: int, n: int) -> tuple[dict[str, float], dict[str, float]]:
        """Range and torque of the ``n``-th degree of freedom of a joint; armature and losses."""
        model = self.model
        dof = model.jnt_dofadr[k] + n
        limits = {}
        if model.jnt_limited[k]:
            low, high = model.jnt_range[k] - self.ref[k]
            ball = model.jnt_type[k] == JOINT.mjJNT_BALL
            limits = {"lower": -high if ball else low, "upper": high}
        if (effort := self.motors.effort(dof)) is not None:
            limits["effort"] = effort
        losses = {
            "armature": self.motors.armature[dof],
            "friction": model.dof_frictionloss[dof],
            "damping": self.motors.damping[dof],
        }
        return limits, losses

    def _add_shape(self, link: ET.Element, g: int) -> None:
        """A geom as a shape of a URDF; a mesh by the corners of its hull, others by a box."""
        model = self.model
        shape = add(link, "collision" if self.touching[g] else "visual")
        place = _place(model.geom_pos[g], model.geom_quat[g])
        radius, half, _ = model.geom_size[g]
        kind = int(model.geom_type[g])
        hull = model.mesh_graphadr[model.geom_dataid[g]] if kind == GEOM.mjGEOM_MESH else -1
        if kind == GEOM.mjGEOM_SPHERE:
            tag, sizes = "sphere", {"radius": radius}
        elif kind == GEOM.mjGEOM_ELLIPSOID:
            tag, sizes = "mesh", {"vertex": (ROUND * model.geom_size[g]).ravel()}
        elif tag := LONG.get(kind):
            sizes = {"radius": radius, "length": 2 * half}
        elif hull >= 0:
            count = model.mesh_graph[hull]
            rows = model.mesh_graph[hull + 2 + count : hull + 2 + 2 * count]
            first = model.mesh_vertadr[model.geom_dataid[g]]
            tag, sizes = "mesh", {"vertex": model.mesh_vert[first + rows].astype(float).ravel()}
        else:
            middle, half_sizes = model.geom_aabb[g].reshape(2, 3)
            place = place * shifted(middle)
            tag, sizes = "box", {"size": np.maximum(2 * half_sizes, 1e-6)}
        add_origin(shape, place)
        add(add(shape, "geometry"), tag, **sizes)

    # what is between joints, and what is left out
    # ----------------------------------------------------------------------------------------------
    def _joints(self, numbers: Iterable[int]) -> str:
        return listed(self.model.joint(int(k)).name or f"joint_{k}" for k in numbers)

    def _add_equalities(self) -> None:
        """Joints that follow others, as mimics; what ties bodies is named."""
        model = self.model
        for e in np.flatnonzero(model.eq_active0):
            ends = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            kind = model.eq_type[e]
            name = f"the equality {model.equality(e).name or int(e)!r}"
            if kind == EQUALITY.mjEQ_JOINT and _bent(model, e):
                if ends[0] in self.joints:
                    self.notes.append(
                        f"{name} couples the joints {self._joints(ends)} along a curve: left out, "
                        f"they move as if it were cut; those of a leg without a motor need in "
                        f"[limits] the effort that it gives them"
                    )
                self._tie(name, [[k] for k in ends])
            elif kind == EQUALITY.mjEQ_JOINT:
                if ends[0] in self.joints:
                    self._follow(name, *ends, *model.eq_data[e, :2])
            elif kind == EQUALITY.mjEQ_TENDON:
                joints = [k for tendon in ends for k in self._joints_of(tendon)]
                pulls = f" of the joints {self._joints(joints)}" if joints else ""
                self.notes.append(f"{name} of tendons{pulls} is left out")
                self._tie(name, [[k] for k in joints])
            elif kind not in TIES:
                self.notes.append(f"{name} of flexes is left out")
        for loop in _loops(model):
            name = f"the equality {loop.name!r}"
            if set(loop.ends) <= set(self.bodies):
                self._tie(name, loop.joints_there)
            if set(loop.ends) & set(self.bodies):
                tied = " to ".join(repr(model.body(x).name) for x in loop.ends)
                joints = sorted(chain(*loop.ways))
                cut = (
                    f", the joints {self._joints(joints)} of this closed chain move as if it "
                    f"were cut; those of a leg without a motor need in [limits] the effort that "
                    f"the chain gives them"
                )
                self.notes.append(f"{name} ties {tied}: left out{cut if joints else ''}")

    def _joints_of(self, tendon: int) -> list[int]:
        """The joints of this robot that a tendon takes as they are; none of one that winds."""
        model = self.model
        if tendon < 0:
            return []
        parts = model.tendon_adr[tendon] + np.arange(model.tendon_num[tendon])
        fixed = parts[model.wrap_type[parts] == WRAP.mjWRAP_JOINT]
        return [int(k) for k in model.wrap_objid[fixed] if k in self.joints]

    def _tie(self, by: str, ways: list[list[int]]) -> None:
        """Say which joints may not move each by itself, for :mod:`jumplab.robot_import.lump`."""
        tie = add(self.xml, "tie", by=by)
        for way in ways:
            part = add(tie, "way")
            for k in way:
                for name in self.joints.get(k, ()):
                    add(part, "of", joint=name)

    def _follow(self, name: str, one: int, other: int, offset: float, factor: float) -> None:
        """The mimic of a joint that follows another, the one with a motor, along a line, from where
        both joints count.
        """
        driven = self.motors.driven[self.model.jnt_dofadr]
        if other >= 0 and driven[one] and not driven[other]:
            one, other = other, one
            factor, offset = 1 / factor, -offset / factor
        follower = next(j for j in self.xml.iter("joint") if j.get("name") == self.joints[one][0])
        if other < 0:
            held = {"effort": "0", "lower": f"{offset:.12g}", "upper": f"{offset:.12g}"}
            follower.find("limit").attrib.update(held)
            self.notes.append(f"{name} holds the joint {self._joints([one])} at {offset:.3g}")
        elif other in self.joints:
            leader = self.joints[other][0]
            add(follower, "mimic", joint=leader, multiplier=factor, offset=offset)

    def _note_what_is_left_out(self) -> None:
        """Springs, tendons, compensation of gravity, and actuators that act on no joint."""
        model = self.model
        counted = self._joints(k for k in self.joints if self.ref[k])
        springs = self._joints(k for k in self.joints if model.jnt_stiffness[k])
        eased = listed(self.names[i] for i in self.bodies if model.body_gravcomp[i])
        tendons = listed(model.tendon(t).name or t for t in range(model.ntendon))
        pulled = [k for t in range(model.ntendon) for k in self._joints_of(t)]
        tendons += f" of the joints {self._joints(dict.fromkeys(pulled))}" if pulled else ""
        others = listed(self.motors.others)
        for names, sentence in (
            (counted, "the joints {} have their zero at their ref"),
            (eased, "the gravity compensation of the bodies {} is left out"),
            (springs, "the springs of the joints {} are left out"),
            (tendons, "the tendons {} are left out"),
            (others, "the actuators {} act on no joint: their torque is not counted"),
        ):
            if names:
                self.notes.append(sentence.format(names))
