"""The formats of ``jumplab export``, each as the bytes of its files, then written whole or not at all."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError
from jumplab.io.folder import transaction, write_file
from jumplab.io.motion import Motion
from jumplab.robot import Robot

# clip ------------------------------------------------------------------------------------------
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


# formats ------------------------------------------------------------------------------------------
RATE_HZ = 1000.0  # the paper's control cycle is 1 ms (Sec. VI-A)
CLIP_FPS = 50.0  # our choice: what motion trackers run at
REPLAY_HZ = 100.0  # our choice: smoother than any screen, and a small file
PHASE_CODES = {"launch": 0, "flight": 1, "landing": 2}
FORMATS = {"csv": "joints.csv", "npz": "motion.npz", "motion-clip": "motion_clip.npz", "urdf-replay": "replay"}
REPLAY_FILES = ("README.md", "replay.py", "robot.urdf", "trajectory.npz")


def default_name(format_name: str, source: str) -> str:
    """Name of an export in a result folder; what comes from a simulation says so."""
    return FORMATS[format_name] if source == "plan" else f"simulated_{FORMATS[format_name]}"


def write(format_name: str, motion: Motion, robot: Robot, path: str | Path, *, fps: float = CLIP_FPS,
          order: str = "depth-first") -> Path:  # fmt: skip
    """Write a motion in one of :data:`FORMATS`.

    Parameters
    ----------
    path : file to write, or folder with "urdf-replay".
    fps, order : of a motion clip, see :func:`jumplab.io.export.motion_clip`.

    Raises
    ------
    InputError
        If the format is unknown, an option cannot be meant, or the path cannot be written. Nothing is left behind.
    """
    path = Path(path)
    if format_name == "urdf-replay":
        return _write_replay(motion, robot, path)
    makers: Mapping[str, Callable[[], bytes]] = {
        "csv": lambda: joint_table(motion, robot).encode(),
        "npz": lambda: _npz(plain_arrays(motion, robot)),
        "motion-clip": lambda: _npz(motion_clip(motion, robot, fps=fps, order=order).arrays()),
    }
    if format_name not in makers:
        raise InputError(f"format {format_name!r}: must be one of {', '.join(FORMATS)}")
    ending = Path(FORMATS[format_name]).suffix
    if path.suffix.lower() != ending:
        raise InputError(f"--out must name a file that ends in {ending}, got {str(path)!r}")
    return write_file(path, makers[format_name]())


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def joint_table(motion: Motion, robot: Robot, rate_hz: float = RATE_HZ) -> str:
    """Time, phase, position, velocity and torque of every joint as comma-separated text, one header line with units.

    One line per millisecond; take-off, which a tape holds twice, stands once. The last line is the last whole
    millisecond within the motion.
    """
    x = motion.every(rate_hz)
    kinds = {"position_rad": x.q[:, 7:], "velocity_rad_s": x.v[:, 6:], "torque_N_m": x.tau}
    head = ["time_s", "phase_0_launch_1_flight_2_landing"]
    head += [f"{name}_{kind}" for kind in kinds for name in robot.joint_names]
    code = [PHASE_CODES[str(p)] for p in x.phase]
    table = np.column_stack([x.t - x.t[0], code, *kinds.values()])
    buffer = io.StringIO()
    np.savetxt(buffer, table, fmt=["%.6f", "%d", *["%.9g"] * (table.shape[1] - 2)], delimiter=",",
               header=",".join(head), comments="")  # fmt: skip
    return buffer.getvalue()


def plain_arrays(motion: Motion, robot: Robot, rate_hz: float = RATE_HZ) -> dict[str, np.ndarray]:
    """The motion on an even grid under names that need no manual: units in them, velocities in world axes."""
    x = motion.every(rate_hz)
    turn = [pin.Quaternion(q[3:7]).toRotationMatrix() for q in x.q]
    return {
        "time_s": x.t - x.t[0],
        "phase": x.phase,
        "joint_names": np.array(robot.joint_names),
        "base_position_m": x.q[:, :3],
        "base_quaternion_xyzw": x.q[:, 3:7],
        "base_velocity_world_m_s": np.einsum("nij,nj->ni", turn, x.v[:, :3]),
        "base_angular_velocity_world_rad_s": np.einsum("nij,nj->ni", turn, x.v[:, 3:6]),
        "joint_position_rad": x.q[:, 7:],
        "joint_velocity_rad_s": x.v[:, 6:],
        "joint_torque_N_m": x.tau,
    }


def _write_replay(motion: Motion, robot: Robot, path: Path) -> Path:
    """A folder with the URDF, the trajectory, and a script of ten lines that shows it."""
    known = (*REPLAY_FILES, ".staging", ".commit")  # the last two are left by a writer that was killed
    strangers = sorted(p.name for p in path.iterdir() if p.name not in known) if path.is_dir() else []
    if strangers:
        raise InputError(f"the folder {str(path)!r} already holds {strangers[0]!r}; choose a new or an empty one")
    script = (resources.files("jumplab.io") / "replay.py.txt").read_text(encoding="utf-8")
    text = (resources.files("jumplab.io") / "replay.md").read_text(encoding="utf-8")
    arrays = {"hz": np.array(REPLAY_HZ), **plain_arrays(motion, robot, REPLAY_HZ)}
    with transaction(path) as staging:
        (staging / "robot.urdf").write_bytes(robot.urdf.encode())
        (staging / "trajectory.npz").write_bytes(_npz(arrays))
        (staging / "replay.py").write_text(script, encoding="utf-8")
        readme = text.replace("@@SCRIPT@@", script.strip()).replace("@@SOURCE@@", motion.source)
        (staging / "README.md").write_text(readme.replace("@@ROBOT@@", robot.name), encoding="utf-8")
    return path
