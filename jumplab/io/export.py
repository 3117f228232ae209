"""The formats of ``jumplab export``, each as the bytes of its files, then written whole or not at all."""

from __future__ import annotations

import io
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError
from jumplab.io.folder import EXPORTS, transaction, write_file
from jumplab.io.motion import Motion, steady
from jumplab.io.tape import RATE_HZ
from jumplab.robot import Robot

CLIP_FPS = 50.0  # what motion trackers run at
REPLAY_HZ = 100.0  # smoother than any screen, and a small file
PHASE_CODES = {"launch": 0, "flight": 1, "landing": 2}
ORDERS = ("depth-first", "breadth-first")  # of links and joints: MuJoCo's and Isaac Lab's
FORMATS = dict(zip(("csv", "npz", "motion-clip", "urdf-replay"), EXPORTS, strict=True))


def default_name(format_name: str, source: str) -> str:
    """Name of an export in a result folder; what comes from a simulation says so."""
    return FORMATS[format_name] if source == "plan" else f"simulated_{FORMATS[format_name]}"


def write(
    format_name: str, motion: Motion, robot: Robot, path: str | Path, *, fps: float = CLIP_FPS, order: str = ORDERS[0]
) -> Path:
    """Write a motion in one of :data:`FORMATS` to a file, or to a folder with "urdf-replay".

    ``fps`` and ``order`` are those of a :func:`motion_clip`. Raises :class:`InputError`, and leaves nothing behind, if
    the format is unknown, an option cannot be meant, or the path cannot be written.
    """
    path = Path(path)
    if format_name not in FORMATS:
        raise InputError(f"format {format_name!r}: must be one of {', '.join(FORMATS)}")
    if format_name == "urdf-replay":
        return _write_replay(motion, robot, path)
    ending = Path(FORMATS[format_name]).suffix
    if path.suffix.lower() != ending:
        raise InputError(f"--out must name a file that ends in {ending}, got {str(path)!r}")
    if format_name == "csv":
        return write_file(path, joint_table(motion, robot).encode())
    clip = format_name == "motion-clip"
    arrays = motion_clip(motion, robot, fps=fps, order=order) if clip else plain_arrays(motion, robot)
    return write_file(path, _npz(arrays))


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def joint_table(motion: Motion, robot: Robot) -> str:
    """Time, phase, position, velocity and torque of every joint as comma-separated text, one header line with units.

    One line per millisecond; take-off, which a tape holds twice, stands once. The last line is the last whole
    millisecond within the motion.
    """
    x = motion.every(RATE_HZ)
    kinds = {"position_rad": x.q[:, 7:], "velocity_rad_s": x.v[:, 6:], "torque_N_m": x.tau}
    head = ["time_s", "phase_0_launch_1_flight_2_landing"]
    head += [f"{name}_{kind}" for kind in kinds for name in robot.joint_names]
    code = [PHASE_CODES[str(p)] for p in x.phase]
    table, buffer = np.column_stack([x.t - x.t[0], code, *kinds.values()]), io.StringIO()
    digits = ["%.6f", "%d", *["%.9g"] * (table.shape[1] - 2)]
    np.savetxt(buffer, table, fmt=digits, delimiter=",", header=",".join(head), comments="")
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


def motion_clip(
    motion: Motion, robot: Robot, *, fps: float = CLIP_FPS, order: str = ORDERS[0]
) -> dict[str, np.ndarray]:
    """F frames under the names that motion trackers read: J joints and B links, 32-bit floats, all in world axes.

    Base and joints are interpolated, links follow from them by Pinocchio, so that every frame is a state that the robot
    can have. ``fps`` are whole frames a second, ``order`` of joints and links is one of :data:`ORDERS`; raises
    :class:`InputError` if they cannot be meant.

    Returns
    -------
    ``fps`` (1,); ``joint_pos``, ``joint_vel`` (F, J) [rad, rad/s]; ``body_pos_w`` (F, B, 3) origins of the links [m];
    ``body_quat_w`` (F, B, 4) w x y z, free of jumps in sign; ``body_lin_vel_w`` (F, B, 3) of those origins [m/s];
    ``body_ang_vel_w`` (F, B, 3) [rad/s]; ``joint_names`` (J,); ``body_names`` (B,), the base link first.
    """
    if fps != round(fps):
        raise InputError(f"fps = {fps:g}: clips carry whole frames per second")
    frames, walk = motion.every(fps), _walk(robot, order)
    joints = [joint for _, joint in walk if joint in robot.joint_names]
    columns = [robot.joint_names.index(name) for name in joints]
    place, turn, speed, spin = _links(frames, robot, [link for link, _ in walk])
    arrays = {
        "joint_pos": frames.q[:, 7:][:, columns],
        "joint_vel": frames.v[:, 6:][:, columns],
        "body_pos_w": place,
        "body_quat_w": steady(turn),
        "body_lin_vel_w": speed,
        "body_ang_vel_w": spin,
    }
    names = {"joint_names": np.array(joints), "body_names": np.array([link for link, _ in walk])}
    numbers = {name: x.astype(np.float32) for name, x in arrays.items()}
    return {"fps": np.array([round(fps)], np.int64), **numbers, **names}


def _links(frames: Motion, robot: Robot, links: list[str]) -> tuple[np.ndarray, ...]:
    """Origins, attitudes (w x y z), velocities and angular velocities of the links, (F, B, 3 or 4) in world axes."""
    model, data = robot.model, robot.model.createData()
    ids = [model.getFrameId(name, pin.FrameType.BODY) for name in links]
    place, turn, speed, spin = (np.empty((len(frames.t), len(ids), k)) for k in (3, 4, 3, 3))
    for k, (q, v) in enumerate(zip(frames.q, frames.v, strict=True)):
        pin.forwardKinematics(model, data, q, v)
        pin.updateFramePlacements(model, data)
        for i, frame in enumerate(ids):
            place[k, i] = data.oMf[frame].translation
            turn[k, i] = pin.Quaternion(data.oMf[frame].rotation).coeffs()[[3, 0, 1, 2]]
            twist = pin.getFrameVelocity(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            speed[k, i], spin[k, i] = twist.linear, twist.angular
    return place, turn, speed, spin


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
    out, waiting = [], [(link.get("name"), None) for link in tree.iterfind("link") if link.get("name") not in children]
    while waiting:
        out.append(waiting.pop(0))
        found = below.get(out[-1][0], [])
        waiting = found + waiting if order == "depth-first" else waiting + found
    return out


def _write_replay(motion: Motion, robot: Robot, path: Path) -> Path:
    """A folder with the URDF, the trajectory, and a script of ten lines that shows it."""
    # the last two are left by a writer that was killed
    known = ("README.md", "replay.py", "robot.urdf", "trajectory.npz", ".staging", ".commit")
    strangers = sorted(p.name for p in path.iterdir() if p.name not in known) if path.is_dir() else []
    if strangers:
        raise InputError(f"the folder {str(path)!r} already holds {strangers[0]!r}; choose a new or an empty one")
    files = resources.files("jumplab.io")
    script, readme = ((files / name).read_text(encoding="utf-8") for name in ("replay.py.txt", "replay.md"))
    for mark, said in (("@@SCRIPT@@", script.strip()), ("@@SOURCE@@", motion.source), ("@@ROBOT@@", robot.name)):
        readme = readme.replace(mark, said)
    arrays = {"hz": np.array(REPLAY_HZ), **plain_arrays(motion, robot, REPLAY_HZ)}
    with transaction(path) as staging:
        (staging / "robot.urdf").write_bytes(robot.urdf.encode())
        (staging / "trajectory.npz").write_bytes(_npz(arrays))
        (staging / "replay.py").write_text(script, encoding="utf-8")
        (staging / "README.md").write_text(readme, encoding="utf-8")
    return path
