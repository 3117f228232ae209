"""The formats of ``jumplab export``, each as the bytes of its files, then written whole or not at all."""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import numpy as np

from jumplab.errors import InputError
from jumplab.io.folder import EXPORTS, transaction, write_file
from jumplab.io.motion import Motion, checked_rate
from jumplab.io.whole import ORDERS, Frames, Whole
from jumplab.robot import Robot

PHASE_CODES = {"launch": 0, "flight": 1, "landing": 2}
_RATES = (1000.0, 1000.0, 100.0, 30.0, 30.0, 50.0, 50.0, 50.0, 50.0)  # what the formats' usual readers expect
_NAMES = ("csv", "npz", "urdf-replay", "unitree-csv", "gmr-pkl", "mjlab-npz", "beyondmimic-npz", "holosoma-npz")
FORMATS = dict(zip((*_NAMES, "mujoco"), zip(EXPORTS, _RATES, strict=True), strict=True))  # -> file, frames a second
WXYZ = [3, 0, 1, 2]  # of x y z w


def default_name(format_name: str, source: str) -> str:
    """Name of an export in a result folder; what comes from a simulation says so."""
    name = FORMATS[format_name][0]
    return name if source == "plan" else f"simulated_{name}"


def rate_of(format_name: str, fps: float | None = None) -> float:
    """Frames a second of a format, ``fps`` where given; raises :class:`InputError` if either cannot be meant."""
    if format_name not in FORMATS:
        raise InputError(f"format {format_name!r}: must be one of {', '.join(FORMATS)}")
    return checked_rate(FORMATS[format_name][1] if fps is None else fps)


def write(format_name: str, motion: Motion, robot: Robot, path: str | Path, *, fps: float | None = None) -> Path:
    """Write a motion of the whole robot in one of :data:`FORMATS` to a file, or to a folder.

    ``fps`` are frames a second, by default those of the format; the motion's end follows, where it is none of them.
    Raises :class:`InputError`, and leaves nothing behind, if the format is unknown, the rate cannot be meant, or the
    path cannot be written.
    """
    path, rate = Path(path), rate_of(format_name, fps)
    ending = Path(FORMATS[format_name][0]).suffix
    if ending and path.suffix.lower() != ending:
        raise InputError(f"--out must name a file that ends in {ending}, got {str(path)!r}")
    whole = Whole(robot)
    frames = whole.frames(motion, rate)
    if not ending:
        return _write_folder(_replay if format_name == "urdf-replay" else _mujoco, whole, frames, rate, path)
    makers = {
        "csv": lambda: joint_table(whole, frames).encode(),
        "npz": lambda: _npz(plain_arrays(whole, frames)),
        "unitree-csv": lambda: _rows(_state(frames)),
        "gmr-pkl": lambda: pickle.dumps(retargeted(whole, frames, rate), protocol=4),
        "mjlab-npz": lambda: _npz(tracked(whole, frames, rate)),
        "beyondmimic-npz": lambda: _npz(tracked(whole, frames, rate, order=ORDERS[1], at_com=True)),
        "holosoma-npz": lambda: _npz(with_world(tracked(whole, frames, rate, at_com=True), frames)),
    }
    return write_file(path, makers[format_name]())


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _rows(table: np.ndarray, head: str = "", digits: str | list[str] = "%.9g") -> bytes:
    buffer = io.StringIO()
    np.savetxt(buffer, table, fmt=digits, delimiter=",", header=head, comments="")
    return buffer.getvalue().encode()


def _state(x: Frames) -> np.ndarray:
    """(F, 7 + J): x y z, quaternion x y z w, joints in the maker's order."""
    return np.column_stack([x.place, x.turn, x.angles])


# tables and arrays ----------------------------------------------------------------------------------------------
def joint_table(whole: Whole, x: Frames) -> str:
    """Time, phase, contacts, position, velocity and torque of every joint as comma-separated text.

    One header line with units, one line per frame; take-off, which a tape holds twice, stands once.
    """
    kinds = {"position_rad": x.angles, "velocity_rad_s": x.rates, "torque_N_m": x.torques}
    head = ["time_s", "phase_0_launch_1_flight_2_landing", "contact_left", "contact_right"]
    head += [f"{name}_{kind}" for kind in kinds for name in whole.joints]
    table = np.column_stack([x.t, [PHASE_CODES[str(p)] for p in x.phase], x.contact, *kinds.values()])
    return _rows(table, ",".join(head), ["%.6f", *["%d"] * 3, *["%.9g"] * (table.shape[1] - 4)]).decode()


def plain_arrays(whole: Whole, x: Frames) -> dict[str, np.ndarray]:
    """The motion under names that need no manual: units in them, velocities in world axes."""
    return {
        "time_s": x.t,
        "phase": x.phase,
        "contact": x.contact,
        "joint_names": np.array(whole.joints),
        "base_position_m": x.place,
        "base_quaternion_xyzw": x.turn,
        "base_velocity_world_m_s": x.velocity,
        "base_angular_velocity_world_rad_s": x.spin_world,
        "joint_position_rad": x.angles,
        "joint_velocity_rad_s": x.rates,
        "joint_torque_N_m": x.torques,
    }


# what trackers and retargeters read -----------------------------------------------------------------------------
def tracked(
    whole: Whole, x: Frames, fps: float, *, order: str = ORDERS[0], at_com: bool = False
) -> dict[str, np.ndarray]:
    """F frames under the names that motion trackers read: J joints and B links in ``order``, 32-bit floats.

    Returns
    -------
    ``fps`` (1,); ``joint_pos``, ``joint_vel``, ``joint_torque`` (F, J) [rad, rad/s, N m]; ``body_pos_w`` (F, B, 3)
    origins of the links [m]; ``body_quat_w`` (F, B, 4) w x y z, free of jumps in sign; ``body_lin_vel_w`` (F, B, 3) of
    those origins, or of the centres of mass, ``at_com`` [m/s]; ``body_ang_vel_w`` (F, B, 3) [rad/s], all in world
    axes; ``contact`` (F, 2); ``phase`` (F,); ``joint_names`` (J,); ``body_names`` (B,), the root link first.
    """
    joints, links = whole.ordered(order)
    columns = [whole.joints.index(name) for name in joints]
    joined = {"joint_pos": x.angles, "joint_vel": x.rates, "joint_torque": x.torques}
    arrays = {name: values[:, columns] for name, values in joined.items()} | whole.bodies(x, links, at_com=at_com)
    numbers = {name: values.astype(np.float32) for name, values in arrays.items()}
    names = {"joint_names": np.array(joints), "body_names": np.array(links)}
    rate = np.array([fps]) if fps % 1 else np.array([fps], np.int64)
    return {"fps": rate, **numbers, "contact": x.contact, "phase": x.phase, **names}


def with_world(arrays: Mapping[str, np.ndarray], x: Frames) -> dict[str, np.ndarray]:
    """The arrays of :func:`tracked` with the world as first body and the root's state before the joints', as MuJoCo's.

    ``joint_pos`` (F, 7 + J) begins with x y z, quaternion w x y z, ``joint_vel`` (F, 6 + J) with the velocity in world
    axes and the angular velocity in the root's own.
    """
    out = dict(arrays)
    for name in ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w"):
        still = np.zeros_like(arrays[name][:, :1])
        still[..., 0] = name == "body_quat_w"
        out[name] = np.concatenate([still, arrays[name]], axis=1)
    for name, state in (("joint_pos", _qpos(x)[:, :7]), ("joint_vel", _qvel(x)[:, :6])):
        out[name] = np.hstack([state.astype(np.float32), arrays[name]])
    return out | {"body_names": np.array(["world", *arrays["body_names"]])}


def retargeted(whole: Whole, x: Frames, fps: float) -> dict[str, object]:
    """What motion retargeters keep in a pickle: rotations x y z w, ``local_body_pos`` (F, B, 3) in the root's axes."""
    here = whole.bodies(x, whole.links, at_com=False)["body_pos_w"] - x.place[:, None]
    return {
        "fps": fps,
        "root_pos": x.place,
        "root_rot": x.turn,
        "dof_pos": x.angles,
        "local_body_pos": np.einsum("fji,fbj->fbi", x.rotation, here),
        "link_body_list": list(whole.links),
        "dof_torque": x.torques,
        "contact": x.contact,
        "phase": [str(name) for name in x.phase],
        "joint_names": list(whole.joints),
    }


# folders --------------------------------------------------------------------------------------------------------
def _write_folder(fill, whole: Whole, x: Frames, fps: float, path: Path) -> Path:
    """A folder with what ``fill`` makes, bytes by file name."""
    files = fill(whole, x, fps)
    known = (*files, ".staging", ".commit")  # the last two are left by a writer that was killed
    strangers = sorted(p.name for p in path.iterdir() if p.name not in known) if path.is_dir() else []
    if strangers:
        raise InputError(f"the folder {str(path)!r} already holds {strangers[0]!r}; choose a new or an empty one")
    with transaction(path) as staging:
        for name, content in files.items():
            (staging / name).write_bytes(content)
    return path


def _replay(whole: Whole, x: Frames, fps: float) -> dict[str, bytes]:
    """The URDF, the trajectory, and a script of ten lines that shows it."""
    files = resources.files("jumplab.io")
    script, readme = ((files / name).read_text(encoding="utf-8") for name in ("replay.py.txt", "replay.md"))
    for mark, said in (("@@SCRIPT@@", script.strip()), ("@@SOURCE@@", x.source), ("@@ROBOT@@", whole.robot.name)):
        readme = readme.replace(mark, said)
    return {
        "robot.urdf": whole.urdf.encode(),
        "trajectory.npz": _npz({"hz": np.array(fps), **plain_arrays(whole, x)}),
        "replay.py": script.encode(),
        "README.md": readme.encode(),
    }


def _qpos(x: Frames) -> np.ndarray:
    """(F, 7 + J): x y z, quaternion w x y z, joints."""
    return np.column_stack([x.place, x.turn[:, WXYZ], x.angles])


def _qvel(x: Frames) -> np.ndarray:
    """(F, 6 + J): velocity in world axes, angular velocity in the root's own, joints."""
    return np.column_stack([x.velocity, x.spin, x.rates])


def _mujoco(whole: Whole, x: Frames, fps: float) -> dict[str, bytes]:
    """The robot on level ground as MuJoCo's XML, a motor on every joint, and ``qpos``, ``qvel``, ``ctrl`` (torques).

    Armature, friction and damping of the motors are the joints'.
    """
    import mujoco

    spec = mujoco.MjSpec.from_string(whole.urdf)
    spec.compiler.discardvisual, spec.compiler.fusestatic = False, True
    spec.worldbody.first_body().add_freejoint()
    spec.option.gravity = [0.0, 0.0, -whole.robot.gravity]
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    for name in whole.joints:
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motors = whole.robot.motors
    for name in set(motors["armature"]) | set(motors["friction"]) | set(motors["damping"]):
        joint = spec.joint(name)
        joint.armature = motors["armature"].get(name, joint.armature)
        joint.frictionloss = motors["friction"].get(name, joint.frictionloss)
        if name in motors["damping"]:  # of a polynomial in the rate, in newer versions, the first coefficient
            more = np.size(joint.damping) - 1
            joint.damping = [motors["damping"][name], *[0.0] * more] if more else motors["damping"][name]
    spec.compile()
    names = {"joint_names": np.array(whole.joints), "contact": x.contact, "phase": x.phase, "fps": np.array(fps)}
    states = {"time": x.t, "qpos": _qpos(x), "qvel": _qvel(x), "ctrl": x.torques}
    return {"robot.xml": spec.to_xml().encode(), "motion.npz": _npz(states | names)}
