"""A robot of MuJoCo's own format as a URDF: the same links, joints, masses and ranges; shapes
become boxes.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot_import.write import add, add_boxes, add_joint, add_link

KINDS = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
}
PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


def as_urdf(path: Path) -> str:
    """The text of a URDF of what stands in an MJCF file; raises :class:`RobotError` if MuJoCo
    cannot read it.

    Meshes that are not there are left out. MJCF has no speed limits: the URDF has none either.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        folder = path.parent / spec.meshdir
        lost = [m for m in spec.meshes if not (folder / m.file).is_file()]
        names = {m.name for m in lost}
        for part in [g for g in spec.geoms if g.meshname in names] + lost:
            spec.delete(part)
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as e:
        raise RobotError(
            f"{path.name}: MuJoCo cannot read this MJCF file: {str(e).strip().splitlines()[0]}"
        ) from e
    robot = ET.Element("robot", name=path.stem)
    for i in range(1, model.nbody):
        _body(robot, model, i)
    return ET.tostring(robot, encoding="unicode")


def _place(position: np.ndarray, quaternion: np.ndarray) -> pin.SE3:
    return pin.XYZQUATToSE3(np.concatenate([position, np.roll(quaternion, -1)]))


def _body(robot: ET.Element, model: mujoco.MjModel, i: int) -> None:
    """A body's link and the joints above it, with links without mass between several."""
    name, above = (model.body(k).name or f"body_{k}" for k in (i, model.body_parentid[i]))
    place = _place(model.body_pos[i], model.body_quat[i])
    for k in np.flatnonzero(model.jnt_bodyid == i):
        # a free base; a ball has no motor of its own
        if (kind := KINDS.get(int(model.jnt_type[k]))) is None:
            continue
        anchor = pin.SE3(np.eye(3), np.array(model.jnt_pos[k]))
        child = f"{name}_{model.joint(k).name or k}"
        add(robot, "link", name=child)
        joint = model.joint(k).name or f"joint_{k}"
        limits = _limits(model, k)
        add_joint(robot, joint, kind, (above, child), place * anchor, model.jnt_axis[k], limits)
        above = child
        place = anchor.inverse()
    if above != "world":
        add_joint(robot, f"{name}_fixed", "fixed", (above, name), place)
    middle = _place(model.body_ipos[i], model.body_iquat[i])
    inertia = pin.Inertia(model.body_mass[i], np.zeros(3), np.diag(model.body_inertia[i]))
    link = add_link(robot, name, middle.act(inertia))
    for g in np.flatnonzero(model.geom_bodyid == i):
        if model.geom_contype[g] | model.geom_conaffinity[g] and model.geom_type[g] != PLANE:
            middle, half = model.geom_aabb[g].reshape(2, 3)
            place = _place(model.geom_pos[g], model.geom_quat[g])
            add_boxes(link, "collision", [(middle, np.maximum(2 * half, 1e-6))], place)


def _limits(model: mujoco.MjModel, k: int) -> dict[str, float]:
    """A joint's range, and the torque of the joint or of the motor that drives it."""
    limits = {}
    if model.jnt_limited[k]:
        limits |= zip(("lower", "upper"), model.jnt_range[k], strict=True)
    if model.jnt_actfrclimited[k]:
        return limits | {"effort": model.jnt_actfrcrange[k, 1]}
    for a in np.flatnonzero(model.actuator_trnid[:, 0] == k):
        gear = abs(model.actuator_gear[a, 0])
        if model.actuator_forcelimited[a]:
            limits["effort"] = gear * model.actuator_forcerange[a, 1]
        elif model.actuator_ctrllimited[a] and not model.actuator_biastype[a]:  # a motor
            limits["effort"] = gear * model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a, 1]
    return limits
