"""A robot of MuJoCo's own format as a URDF: the same links, joints, masses and ranges; shapes become boxes."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError

KINDS = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}


def as_urdf(path: Path) -> str:
    """The text of a URDF of what stands in an MJCF file; raises :class:`RobotError` if MuJoCo cannot read it.

    Meshes that are not there are left out. MJCF has no speed limits: the URDF has none either.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        folder, lost = path.parent / spec.meshdir, {m.name for m in spec.meshes}
        lost -= {m.name for m in spec.meshes if (folder / m.file).is_file()}
        for part in [g for g in spec.geoms if g.meshname in lost] + [m for m in spec.meshes if m.name in lost]:
            spec.delete(part)
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as e:
        raise RobotError(f"{path.name}: MuJoCo cannot read this MJCF file: {str(e).strip().splitlines()[0]}") from e
    robot = ET.Element("robot", name=path.stem)
    for i in range(1, model.nbody):
        _body(robot, model, i)
    return ET.tostring(robot, encoding="unicode")


def _add(parent: ET.Element, tag: str, **values: str | float | np.ndarray) -> ET.Element:
    texts = {k: v if isinstance(v, str) else " ".join(f"{x:.12g}" for x in np.atleast_1d(v)) for k, v in values.items()}
    return ET.SubElement(parent, tag, texts)


def _place(position: np.ndarray, quaternion: np.ndarray) -> pin.SE3:
    w, x, y, z = quaternion
    return pin.SE3(pin.Quaternion(w, x, y, z).normalized().matrix(), np.array(position))


def _origin(parent: ET.Element, place: pin.SE3) -> None:
    _add(parent, "origin", xyz=place.translation, rpy=pin.rpy.matrixToRpy(place.rotation))


def _body(robot: ET.Element, model: mujoco.MjModel, i: int) -> None:
    """A body's link and the joints above it; where there are several, with links without mass between them."""
    body, name = model.body(i), model.body(i).name or f"body_{i}"
    above, place = model.body(body.parentid[0]).name or f"body_{body.parentid[0]}", _place(body.pos, body.quat)
    first = int(body.jntadr[0])
    for k in range(first, first + int(body.jntnum[0])):
        if (kind := KINDS.get(int(model.jnt_type[k]))) is None:  # a free base; a ball has no motor of its own
            continue
        anchor = pin.SE3(np.eye(3), np.array(model.jnt_pos[k]))
        child = f"{name}_{model.joint(k).name or k}"
        _add(robot, "link", name=child)
        joint = _joint(robot, model.joint(k).name or f"joint_{k}", kind, above, child, place * anchor)
        _add(joint, "axis", xyz=model.jnt_axis[k])
        _add(joint, "limit", **_limits(model, k))
        above, place = child, anchor.inverse()
    if body.parentid[0] or above != "world":
        _joint(robot, f"{name}_fixed", "fixed", above, name, place)
    link, (xx, yy, zz) = _add(robot, "link", name=name), model.body_inertia[i]
    inertial = _add(link, "inertial")
    _origin(inertial, _place(model.body_ipos[i], model.body_iquat[i]))
    _add(inertial, "mass", value=model.body_mass[i])
    _add(inertial, "inertia", ixx=xx, ixy=0.0, ixz=0.0, iyy=yy, iyz=0.0, izz=zz)
    for g in range(int(body.geomadr[0]), int(body.geomadr[0] + body.geomnum[0])):
        if model.geom_contype[g] | model.geom_conaffinity[g] and model.geom_type[g] != int(mujoco.mjtGeom.mjGEOM_PLANE):
            middle, half = model.geom_aabb[g].reshape(2, 3)
            shape = _add(link, "collision")
            _origin(shape, _place(model.geom_pos[g], model.geom_quat[g]) * pin.SE3(np.eye(3), np.array(middle)))
            _add(_add(shape, "geometry"), "box", size=np.maximum(2 * half, 1e-6))


def _joint(robot: ET.Element, name: str, kind: str, parent: str, child: str, place: pin.SE3) -> ET.Element:
    joint = _add(robot, "joint", name=name, type=kind)
    _add(joint, "parent", link=parent)
    _add(joint, "child", link=child)
    _origin(joint, place)
    return joint


def _limits(model: mujoco.MjModel, k: int) -> dict[str, float]:
    """What a joint is limited to: its range, and the torque of the joint or of the motor that drives it."""
    told = dict(zip(("lower", "upper"), model.jnt_range[k], strict=True)) if model.jnt_limited[k] else {}
    if model.jnt_actfrclimited[k]:
        return told | {"effort": model.jnt_actfrcrange[k, 1]}
    for a in np.flatnonzero(model.actuator_trnid[:, 0] == k):
        gear = abs(model.actuator_gear[a, 0])
        if model.actuator_forcelimited[a]:
            told["effort"] = gear * model.actuator_forcerange[a, 1]
        elif model.actuator_ctrllimited[a] and not model.actuator_biastype[a]:  # a motor
            told["effort"] = gear * model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a, 1]
    return told
