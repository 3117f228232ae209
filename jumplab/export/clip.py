"""Motion clips: states of joints and bodies at a frame rate, as trackers for reinforcement learning read them.

The layout is that of the public motion-tracking environments for Isaac Lab and MuJoCo: one ``.npz`` with ``fps``,
``joint_pos``, ``joint_vel``, ``body_pos_w``, ``body_quat_w`` (w x y z), ``body_lin_vel_w`` and ``body_ang_vel_w``. They
find joints and bodies by number, not by name, and each simulator counts in its own order: MuJoCo goes down each limb in
turn, Isaac Lab level by level. Our clips carry the names as well, and either order.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError
from jumplab.motion import Motion
from jumplab.robot import Robot

ORDERS = ("depth-first", "breadth-first")


@dataclass(frozen=True)
class Clip:
    """One clip of F frames, J joints and B bodies; everything in world axes.

    Attributes
    ----------
    fps : (1,) frames a second.
    joint_pos, joint_vel : (F, J) [rad, rad/s].
    body_pos_w : (F, B, 3) origins of the link frames [m].
    body_quat_w : (F, B, 4) their attitudes, w x y z, free of jumps in sign.
    body_lin_vel_w : (F, B, 3) velocities of those origins [m/s];  body_ang_vel_w : (F, B, 3) [rad/s].
    joint_names, body_names : (J,), (B,) the base link is the first body.
    """

    fps: np.ndarray
    joint_pos: np.ndarray
    joint_vel: np.ndarray
    body_pos_w: np.ndarray
    body_quat_w: np.ndarray
    body_lin_vel_w: np.ndarray
    body_ang_vel_w: np.ndarray
    joint_names: np.ndarray
    body_names: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays under the names that trackers read; numbers as 32-bit floats."""
        out = {f.name: getattr(self, f.name) for f in fields(self)}
        return {k: x.astype(np.float32) if x.dtype == float else x for k, x in out.items()}


def motion_clip(motion: Motion, robot: Robot, *, fps: float = 50.0, order: str = "depth-first") -> Clip:
    """Resample a motion and work out the bodies' states with Pinocchio.

    Base and joints are interpolated (the attitude along the arc), bodies follow from them, so that every frame is a
    state that the robot can have.

    Parameters
    ----------
    fps : whole frames a second; trackers mostly run at 50.
    order : of joints and bodies, "depth-first" (MuJoCo) or "breadth-first" (Isaac Lab).

    Raises
    ------
    InputError
        If ``fps`` or ``order`` cannot be meant.
    """
    if fps != round(fps):
        raise InputError(f"fps = {fps:g}: clips carry whole frames per second")
    frames = motion.every(fps)
    model, data = robot.model, robot.model.createData()
    names, joints = body_names(robot, order), joint_order(robot, order)
    ids = [model.getFrameId(n, pin.FrameType.BODY) for n in names]
    n = len(frames.t)
    place, turn, speed, spin = (np.empty((n, len(ids), k)) for k in (3, 4, 3, 3))
    for k, (q, v) in enumerate(zip(frames.q, frames.v, strict=True)):
        pin.forwardKinematics(model, data, q, v)
        pin.updateFramePlacements(model, data)
        for i, frame in enumerate(ids):
            place[k, i] = data.oMf[frame].translation
            turn[k, i] = pin.Quaternion(data.oMf[frame].rotation).coeffs()[[3, 0, 1, 2]]
            twist = pin.getFrameVelocity(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            speed[k, i], spin[k, i] = twist.linear, twist.angular
    columns = [robot.joint_names.index(name) for name in joints]
    return Clip(
        fps=np.array([round(fps)], np.int64),
        joint_pos=frames.q[:, 7:][:, columns],
        joint_vel=frames.v[:, 6:][:, columns],
        body_pos_w=place,
        body_quat_w=_steady(turn),
        body_lin_vel_w=speed,
        body_ang_vel_w=spin,
        joint_names=np.array(joints),
        body_names=np.array(names),
    )


def body_names(robot: Robot, order: str = "depth-first") -> tuple[str, ...]:
    """Names of all links in one of :data:`ORDERS`; the base link first."""
    return tuple(link for link, _ in _walk(robot, order))


def joint_order(robot: Robot, order: str = "depth-first") -> tuple[str, ...]:
    """Names of the actuated joints in one of :data:`ORDERS`."""
    return tuple(joint for _, joint in _walk(robot, order) if joint in robot.joint_names)


def _walk(robot: Robot, order: str) -> list[tuple[str, str | None]]:
    """Every link with the joint above it. Siblings come as the URDF lists them; Pinocchio sorts them by name."""
    if order not in ORDERS:
        raise InputError(f"order {order!r}: must be {' or '.join(ORDERS)}")
    tree = ElementTree.fromstring(robot.urdf)
    below: dict[str, list[tuple[str, str | None]]] = {}
    for joint in tree.iterfind("joint"):
        parent, child = joint.find("parent").get("link"), joint.find("child").get("link")
        below.setdefault(parent, []).append((child, joint.get("name")))
    children = {link for pairs in below.values() for link, _ in pairs}
    waiting = deque((link.get("name"), None) for link in tree.iterfind("link") if link.get("name") not in children)
    out = []
    while waiting:
        out.append(waiting.popleft())
        found = below.get(out[-1][0], [])
        if order == "depth-first":
            waiting.extendleft(reversed(found))
        else:
            waiting.extend(found)
    return out


def _steady(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (F, B, 4) with the sign of each the nearest to the one before."""
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=2) < 0
    flip = np.concatenate([np.zeros((1, quaternions.shape[1]), bool), np.cumsum(turned, axis=0) % 2 == 1])
    return np.where(flip[:, :, None], -quaternions, quaternions)
