"""Motion clips: states of joints and bodies at a frame rate, as trackers for reinforcement learning read them.

The layout is that of the public motion-tracking environments for Isaac Lab and MuJoCo: one ``.npz`` with ``fps``,
``joint_pos``, ``joint_vel``, ``body_pos_w``, ``body_quat_w`` (w x y z), ``body_lin_vel_w`` and ``body_ang_vel_w``. They
find joints and bodies by number, not by name, and each simulator counts in its own order: MuJoCo goes down each limb in
turn, Isaac Lab level by level. Our clips carry the names as well, and either order.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

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
    model = robot.model
    bodies = [i for i, frame in enumerate(model.frames) if frame.type == pin.FrameType.BODY]
    return tuple(model.frames[i].name for i in _sorted(bodies, [_depth(robot, i) for i in bodies], order))


def joint_order(robot: Robot, order: str = "depth-first") -> tuple[str, ...]:
    """Names of the actuated joints in one of :data:`ORDERS`."""
    model = robot.model
    frames = [model.getFrameId(name, pin.FrameType.JOINT) for name in robot.joint_names]
    return tuple(model.frames[i].name for i in _sorted(frames, [_depth(robot, i) for i in frames], order))


def _sorted(frames: list[int], depth: list[int], order: str) -> list[int]:
    """Pinocchio numbers frames depth first; level by level is the same list, sorted by depth alone."""
    if order not in ORDERS:
        raise InputError(f"order {order!r}: must be {' or '.join(ORDERS)}")
    if order == "depth-first":
        return frames
    return [frames[i] for i in np.argsort(depth, kind="stable")]


def _depth(robot: Robot, frame: int) -> int:
    """How many links lie between a frame and the world."""
    model, depth = robot.model, 0
    while frame:
        depth += model.frames[frame].type == pin.FrameType.BODY
        frame = model.frames[frame].parentFrame
    return depth


def _steady(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (F, B, 4) with the sign of each the nearest to the one before."""
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=2) < 0
    flip = np.concatenate([np.zeros((1, quaternions.shape[1]), bool), np.cumsum(turned, axis=0) % 2 == 1])
    return np.where(flip[:, :, None], -quaternions, quaternions)
