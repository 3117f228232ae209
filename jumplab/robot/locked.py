"""Joints of a published robot that its jumps do not move, and what they have to hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from jumplab.robot.contact import posed
from jumplab.robot.files import entry, numbers, read_toml

if TYPE_CHECKING:  # a robot is asked for these
    from jumplab.robot.description import Robot

BASE = 1  # Pinocchio's index of the free-flyer
# of the robot's mass: in jumps of the G1 and of Talos, lighter parts take half of their motors'
# torque at most
HEAVY = 0.05


@dataclass(frozen=True, eq=False)
class LockedJoint:
    """A motor that holds a part of the robot on the base.

    Attributes
    ----------
    effort : its torque [N m].  place, axis : (3,) of the joint, in the base link's frame [m, 1].
    part : inertia of what is rigid with the base beyond the joint, in the same frame.
    joints : moving joints whose links hang on that part.
    """

    name: str
    effort: float
    place: np.ndarray
    axis: np.ndarray
    part: pin.Inertia
    joints: tuple[str, ...]


def locked_joints(robot: Robot) -> tuple[LockedJoint, ...]:
    """Joints between the base and parts of more than 5 % of the robot's mass, from the table
    [published]; none where there is no such table.

    Parts scale with the mass of the base, which may have been changed since. Raises
    :class:`RobotError` if the table makes no robot.
    """
    config = read_toml(robot.config_text, "robot configuration")
    if "published" not in config:
        return ()
    try:
        model = pin.buildModelFromXML(
            entry(config, "published", "urdf", kind=str), pin.JointModelFreeFlyer()
        )
    except ValueError as e:
        raise robot.error(f"[published] holds no URDF: {str(e).splitlines()[0]}") from e
    trunk = entry(config, "published", "trunk", kind=str)
    xyz, rpy = (entry(config, "published", key, count=3) for key in ("xyz_m", "rpy_rad"))
    q = pin.neutral(model)
    for name, angle in numbers(config, "published", "held").items():
        q[model.idx_qs[_index(robot, model, name)]] = angle
    data = posed(model, q)
    at = model.getFrameId(trunk, pin.FrameType.BODY)
    if at == model.nframes:
        raise robot.error(f"[published] lacks the link {trunk!r}")
    carrier = model.frames[at].parentJoint
    placement = pin.SE3(pin.rpy.rpyToMatrix(np.array(rpy)), np.array(xyz))
    to_base = placement * data.oMf[at].inverse()
    return tuple(_locked(robot, model, data, carrier, to_base))


def _index(robot: Robot, model: pin.Model, name: str) -> int:
    if not model.existJointName(name):
        raise robot.error(f"[published] lacks the joint {name!r}")
    return model.getJointId(name)


def _locked(
    robot: Robot, model: pin.Model, data: pin.Data, carrier: int, to_base: pin.SE3
) -> list[LockedJoint]:
    """Those of a model whose body ``carrier`` is the base's; ``to_base`` takes the world there."""
    reduced = robot.model
    below = posed(reduced)
    moving = {_index(robot, model, name) for name in robot.joint_names}
    edges = {j: {j, model.parents[j]} for j in range(BASE + 1, model.njoints)}
    stiff = {j: ends for j, ends in edges.items() if j not in moving}
    rigid = _reached(carrier, stiff)
    parts = {j: (to_base * data.oMi[j]).act(model.inertias[j]) for j in rigid}
    scale = reduced.inertias[BASE].mass / sum(part.mass for part in parts.values())
    out = []
    for j in stiff:
        column = model.idx_vs[j]
        effort = float(model.upperEffortLimit[column])
        beyond = rigid - _reached(carrier, {k: ends for k, ends in stiff.items() if k != j})
        limbs = tuple(model.names[k] for k in sorted(moving) if edges[k] & beyond)
        part = sum((parts[k] for k in beyond), pin.Inertia.Zero())
        part = pin.Inertia(scale * part.mass, part.lever, scale * part.inertia)
        mass = part.mass + sum(below.mass[reduced.getJointId(name)] for name in limbs)
        if effort > 0 and mass > HEAVY * robot.total_mass:
            place = (to_base * data.oMi[j]).translation
            # seen from a part that floats, with the base beyond, its joint turns the other way
            way = 1.0 if j in beyond else -1.0
            axis = way * to_base.rotation @ data.J[3:, column]
            out.append(LockedJoint(model.names[j], effort, place, axis, part, limbs))
    return out


def _reached(start: int, edges: dict[int, set[int]]) -> set[int]:
    """Bodies that joints (joint -> its two bodies) connect with one."""
    reached = {start}
    while more := {k for ends in edges.values() if ends & reached for k in ends} - reached:
        reached |= more
    return reached
