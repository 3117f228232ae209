"""The formats of ``jumplab export``, each as the bytes of its files, then written whole or not at all."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError
from jumplab.export.clip import motion_clip
from jumplab.motion import Motion
from jumplab.robot import Robot
from jumplab.store import transaction, write_file

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
    fps, order : of a motion clip, see :func:`jumplab.export.motion_clip`.

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
    script = (resources.files("jumplab.export") / "replay.py.txt").read_text(encoding="utf-8")
    text = (resources.files("jumplab.export") / "replay.md").read_text(encoding="utf-8")
    arrays = {"hz": np.array(REPLAY_HZ), **plain_arrays(motion, robot, REPLAY_HZ)}
    with transaction(path) as staging:
        (staging / "robot.urdf").write_bytes(robot.urdf.encode())
        (staging / "trajectory.npz").write_bytes(_npz(arrays))
        (staging / "replay.py").write_text(script, encoding="utf-8")
        readme = text.replace("@@SCRIPT@@", script.strip()).replace("@@SOURCE@@", motion.source)
        (staging / "README.md").write_text(readme.replace("@@ROBOT@@", robot.name), encoding="utf-8")
    return path
