"""The formats of ``jumplab export``: what each file holds, then written whole or not at all."""

from __future__ import annotations

import io
import logging
import pickle
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jumplab.arguments import checked
from jumplab.errors import InputError
from jumplab.forms import filled
from jumplab.io import gains
from jumplab.io.columns import table_of
from jumplab.io.folder import FORMATS, MESH, WITH_OBJECT, transaction, write_file
from jumplab.io.motion import Motion, checked_rate
from jumplab.io.tensors import tensor_file
from jumplab.io.whole import ORDERS, Whole, axes_of, ordered
from jumplab.robot import Robot

HELD_RAD = 0.02  # by which joints that a format leaves out may move
LIBRARIES = ("asap-pkl", "sonic-pkl")  # files that may hold many motions by name
PHASES = ("launch", "flight", "landing")


def default_name(format_name: str, source: str) -> str:
    """Name of an export in a result folder; what comes from a simulation says so."""
    name = FORMATS[format_name][0]
    return name if source == "plan" else f"simulated_{name}"


@checked
def rate_of(format_name: str, fps: float | None = None) -> float:
    """Rate of a format, or ``fps`` [1/s]; raises :class:`InputError` if it cannot be meant."""
    if format_name not in FORMATS:
        raise InputError(f"format {format_name!r}: must be one of {', '.join(FORMATS)}")
    return checked_rate(FORMATS[format_name][1] if fps is None else fps)


@checked
def write(
    format_name: str, motion: Motion, robot: Robot, path: str | Path, *, fps: float | None = None
) -> Path:
    """Write a motion of the whole robot in one of :data:`FORMATS` to a file, or to a folder.

    ``fps`` are frames a second [1/s], by default those of the format; the motion's end follows,
    where it is none of them. Beside a file that has an object, the object's mesh is written
    (``..._platform.obj``). Raises :class:`InputError`, and leaves nothing behind, if the format is
    unknown, the rate cannot be meant, or the path cannot be written.
    """
    path = Path(path)
    rate = rate_of(format_name, fps)
    ending = Path(FORMATS[format_name][0]).suffix
    if ending and path.suffix.lower() != ending:
        raise InputError(f"--out must name a file that ends in {ending}, got {str(path)!r}")
    whole = Whole(robot)
    frames = whole.frames(motion, rate)
    content = CONTENTS[format_name](whole, frames, rate)
    if format_name in LIBRARIES:
        content = {path.stem: content}  # readers of folders look there
    if ending:
        if format_name in WITH_OBJECT:
            _write_mesh(path.with_name(path.stem + MESH), whole.block(frames))
        return write_file(path, _encoded(ending, content))
    # the last two are left by a writer that was killed
    strangers = {p.name for p in path.glob("*")} - {*content, ".staging", ".commit"}
    if strangers:
        raise InputError(
            f"the folder {str(path)!r} already holds {min(strangers)!r}; choose a new or an empty "
            "one"
        )
    with transaction(path) as staging:
        for name, part in content.items():
            (staging / name).write_bytes(_encoded(Path(name).suffix, part))
    return path


def _write_mesh(path: Path, block: tuple[np.ndarray, np.ndarray, float] | None) -> None:
    """Write a block (see :meth:`.Whole.block`) as a mesh [m] about its centre, along its own axes;
    where there is none, that of an earlier motion goes.
    """
    if block is None:
        path.unlink(missing_ok=True)
        return
    text = filled("io/platform.obj.in", ends=np.outer(block[0], [-1.0, 1.0]))
    write_file(path, text.encode())


def _encoded(ending: str, content: Any) -> bytes:
    """Content of a file whose name ends so: arrays by name, a plain object, or a text."""
    if ending == ".npz":
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **content)
        return buffer.getvalue()
    if ending == ".motion":
        return tensor_file(content)
    return pickle.dumps(content, protocol=4) if ending == ".pkl" else content.encode()


# What the formats hold: of the published robot, its motion of F frames with J joints, depth-first,
# and their rate [1/s].
# -----------------------------------------------------------------------------------
def joint_table(whole: Whole, x: Motion, fps: float) -> str:
    """Time, phase, contacts, position, velocity and torque of every joint (F), the base's place and
    quaternion, the CoM, and the forces on the feet where they are known, with commas between.

    One header line with units, one line per frame; take-off, which a tape holds twice, stands once.
    """
    left, right = x.contact.T
    table = {
        "time_s": x.t,
        "phase_0_launch_1_flight_2_landing": [PHASES.index(phase) for phase in x.phase],
        "contact_left": left,
        "contact_right": right,
        **table_of(x, whole.joints, whole.com(x.q)),
    }
    digits = ["%.6f", *["%d"] * 3, *["%.9g"] * (len(table) - 4)]
    return _rows(np.column_stack([*table.values()]), ",".join(table), digits)


def bare_states(whole: Whole, x: Motion, fps: float) -> str:
    """x y z, quaternion x y z w and joints of every frame with commas between, no line of names."""
    return _rows(x.q)


def _rows(table: np.ndarray, head: str = "", digits: str | list[str] = "%.9g") -> str:
    buffer = io.StringIO()
    np.savetxt(buffer, table, fmt=digits, delimiter=",", header=head, comments="")
    return buffer.getvalue()


def plain_arrays(whole: Whole, x: Motion, fps: float) -> dict[str, np.ndarray]:
    """The motion under names that need no manual, each (F, ...): units in them, world axes."""
    turn = Rotation.from_quat(x.q[:, 3:7])
    return {
        "time_s": x.t,
        "phase": x.phase,
        "contact": x.contact,
        "joint_names": np.array(whole.joints),
        "base_position_m": x.q[:, :3],
        "base_quaternion_xyzw": x.q[:, 3:7],
        "base_velocity_world_m_s": turn.apply(x.v[:, :3]),
        "base_angular_velocity_world_rad_s": turn.apply(x.v[:, 3:6]),
        "joint_position_rad": x.q[:, 7:],
        "joint_velocity_rad_s": x.v[:, 6:],
        "joint_torque_N_m": x.tau,
    }


def tracked(
    whole: Whole, x: Motion, fps: float, *, order: str = ORDERS[0], at_com: bool = False
) -> dict[str, np.ndarray]:
    """The motion under the names that motion trackers read: J joints and B links in ``order``,
    32-bit floats.

    Returns
    -------
    ``fps`` (1,); ``joint_pos``, ``joint_vel``, ``joint_torque`` (F, J) [rad, rad/s, N m];
    ``body_pos_w`` (F, B, 3) origins of the links [m]; ``body_quat_w`` (F, B, 4) w x y z, free of
    jumps in sign; ``body_lin_vel_w`` (F, B, 3) of those origins, or of the centres of mass,
    ``at_com`` [m/s]; ``body_ang_vel_w`` (F, B, 3) [rad/s], all in world axes; ``contact`` (F, 2);
    ``phase`` (F,); ``joint_names`` (J,); ``body_names`` (B,), the root link first.
    """
    joints, links = ordered(whole.urdf, order)
    columns = [whole.joints.index(name) for name in joints]
    arrays = {
        "joint_pos": x.q[:, 7:][:, columns],
        "joint_vel": x.v[:, 6:][:, columns],
        "joint_torque": x.tau[:, columns],
        **whole.bodies(x, links, at_com=at_com),
    }
    # whole numbers as their readers divide by them
    rate = np.array([int(fps) if fps == int(fps) else fps])
    return {
        "fps": rate,
        **{name: array.astype(np.float32) for name, array in arrays.items()},
        "contact": x.contact,
        "phase": x.phase,
        "joint_names": np.array(joints),
        "body_names": np.array(links),
    }


def with_world(
    whole: Whole, x: Motion, fps: float, *, at_com: bool = False
) -> dict[str, np.ndarray]:
    """The arrays of :func:`tracked` with the world as first body; where the motion ends higher or
    lower than it begins also ``object_pos_w`` (F, 3), ``object_quat_w`` (F, 4) w x y z, and both
    velocities (F, 3), of the box between (see :meth:`.Whole.block`).
    """
    arrays = tracked(whole, x, fps, at_com=at_com)
    for name in ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w"):
        still = np.zeros_like(arrays[name][:, :1])
        still[..., 0] = name == "body_quat_w"
        arrays[name] = np.concatenate([still, arrays[name]], axis=1)
    if block := whole.block(x):
        turn = np.roll(Rotation.from_euler("z", block[2]).as_quat(), 1)
        states = {"pos": block[1], "quat": turn, "lin_vel": np.zeros(3), "ang_vel": np.zeros(3)}
        for name, state in states.items():
            arrays[f"object_{name}_w"] = np.tile(state, (len(x.t), 1)).astype(np.float32)
    return arrays | {"body_names": np.array(["world", *whole.links])}


def with_root(whole: Whole, x: Motion, fps: float) -> dict[str, np.ndarray]:
    """The arrays of :func:`with_world`, velocities at centres of mass, with the root's state before
    the joints', as MuJoCo's (see :func:`_qpos_qvel`).
    """
    arrays = with_world(whole, x, fps, at_com=True)
    for name, state in zip(("joint_pos", "joint_vel"), _qpos_qvel(x), strict=True):
        arrays[name] = state.astype(np.float32)
    return arrays


def retargeted(whole: Whole, x: Motion, fps: float) -> dict[str, object]:
    """Fields of retargeters' files: rotations x y z w, ``local_body_pos`` (F, B, 3) in root axes
    [m].
    """
    places = whole.bodies(x, whole.links, at_com=False)["body_pos_w"] - x.q[:, None, :3]
    back = Rotation.from_quat(x.q[:, 3:7]).as_matrix()
    return {
        "fps": fps,
        "root_pos": x.q[:, :3],
        "root_rot": x.q[:, 3:7],
        "dof_pos": x.q[:, 7:],
        "local_body_pos": places @ back,
        "link_body_list": list(whole.links),
        "dof_torque": x.tau,
        "contact": x.contact,
        "phase": [str(name) for name in x.phase],
        "joint_names": list(whole.joints),
    }


def states(whole: Whole, x: Motion, fps: float) -> dict[str, Any]:
    """States as ProtoMotions reads them: joints depth-first; of all links places, rotations
    x y z w, velocities of their origins and whether they touch the ground, as the feet do; 32-bit
    floats.
    """
    arrays = tracked(whole, x, fps)
    touching = np.zeros(arrays["body_pos_w"].shape[:2], bool)
    feet = [whole.model.names[foot.joint] for foot in whole.feet(np.zeros(3))]
    touching[:, [1 + whole.joints.index(joint) for joint in feet]] = x.contact
    return {
        "fps": arrays["fps"].item(),
        "dof_pos": arrays["joint_pos"],
        "dof_vel": arrays["joint_vel"],
        "rigid_body_pos": arrays["body_pos_w"],
        "rigid_body_rot": np.roll(arrays["body_quat_w"], -1, axis=-1),
        "rigid_body_vel": arrays["body_lin_vel_w"],
        "rigid_body_ang_vel": arrays["body_ang_vel_w"],
        "rigid_body_contacts": touching,
    }


def with_base(whole: Whole, x: Motion, fps: float) -> dict[str, np.ndarray]:
    """Fields of the motions of trainers in Isaac Lab: joints breadth-first, by name, and the base,
    (F, 3) and quaternion (F, 4) w x y z, velocities in world axes at its origin; 32-bit floats.
    """
    arrays = tracked(whole, x, fps, order=ORDERS[1])
    arrays.pop("body_names")
    out = {"framerate": np.array(float(fps))}
    for name, array in arrays.items():
        body = name.startswith("body_")
        out[name.replace("body_", "base_")] = array[:, 0] if body else array
    return out


def library_entry(
    whole: Whole, x: Motion, fps: float, *, without: str = "", more: int = 0
) -> dict[str, object]:
    """A motion library's entry: the root (quaternion x y z w), angles ``dof`` of the joints whose
    names are free of ``without``, depth-first, and ``pose_aa`` (F, 1 + J + ``more``, 3), the same
    as rotation vectors of the root and about the joints' axes; of bodies fixed to others zero.

    ``smpl_joints`` (F, 24, 3) are zeros, for a robot has none. Raises :class:`InputError` if a
    joint that is left out moves.
    """
    kept = [k for k, name in enumerate(whole.joints) if not without or without not in name]
    moved = np.ptp(x.q[:, 7:], axis=0)
    moved[kept] = 0.0
    if moved.max(initial=0.0) > HELD_RAD:
        raise InputError(
            f"the format has no joints called {without!r}, and {whole.joints[moved.argmax()]!r} "
            f"moves by {moved.max():.2f} rad; choose sonic-pkl"
        )
    dof = x.q[:, 7:][:, kept]
    root = Rotation.from_quat(x.q[:, 3:7]).as_rotvec()
    turned = dof[..., None] * axes_of(whole.urdf, [whole.joints[k] for k in kept])
    poses = np.concatenate([root[:, None], turned, np.zeros((len(dof), more, 3))], axis=1)
    return {
        "root_trans_offset": x.q[:, :3].astype(np.float32),
        "pose_aa": poses.astype(np.float32),
        "dof": dof.astype(np.float32),
        "root_rot": x.q[:, 3:7],
        "smpl_joints": np.zeros((len(dof), 24, 3), np.float32),
        "contact": x.contact,
        "joint_names": [whole.joints[k] for k in kept],
        "fps": int(fps) if fps == int(fps) else fps,
    }


def animated(whole: Whole, x: Motion, fps: float) -> str:
    """A table as animators keep it: number of the frame, the root in cm and degrees (about the
    world's x, then y, then z), then joints in degrees.
    """
    angles = Rotation.from_quat(x.q[:, 3:7]).as_euler("xyz", degrees=True)
    angles = np.unwrap(angles, axis=0, period=360.0)
    root = [f"root_{word}{axis}" for word in ("translate", "rotate") for axis in "XYZ"]
    head = ["Frame", *root, *(f"{name}_dof" for name in whole.joints)]
    frames = np.arange(len(x.t))
    table = np.column_stack([frames, 100 * x.q[:, :3], angles, np.degrees(x.q[:, 7:])])
    return _rows(table, ",".join(head), ["%d"] + ["%.9g"] * (len(head) - 1))


def pybullet_folder(whole: Whole, x: Motion, fps: float) -> dict[str, Any]:
    """The URDF, the trajectory, and a script of ten lines that shows it."""
    script = filled("io/replay.py.txt")
    about = filled("io/replay.md", script=script.strip(), source=x.source, robot=whole.robot.name)
    return {
        "robot.urdf": whole.urdf,
        "trajectory.npz": {"hz": np.array(fps), **plain_arrays(whole, x, fps)},
        "replay.py": script,
        "README.md": about,
    }


def _qpos_qvel(x: Motion) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo's states: (F, 7 + J) x y z, quaternion w x y z, joints; (F, 6 + J) velocity in world
    axes, angular velocity in the root's own, joints.
    """
    place, turn, joints = np.split(x.q, [3, 7], axis=1)
    speed = Rotation.from_quat(turn).apply(x.v[:, :3])
    return np.hstack([place, np.roll(turn, 1, axis=1), joints]), np.hstack([speed, x.v[:, 3:]])


def mujoco_folder(whole: Whole, x: Motion, fps: float) -> dict[str, Any]:
    """The robot on its ground as MuJoCo's XML, with the motors that it is planned with;
    ``qpos``, ``qvel``, ``ctrl`` (torques) and the arrays of :func:`.gains.gains`; and a script that
    plays them.

    Limits of torque are the plan's, as are armature, friction and damping of the joints. Step and
    contacts are MuJoCo's own.
    """
    import mujoco

    # MuJoCo would write its warnings into a file of the working folder
    mujoco.set_mju_user_warning(logging.getLogger(__name__).info)
    spec = mujoco.MjSpec.from_string(whole.urdf)
    spec.compiler.discardvisual = False
    spec.compiler.fusestatic = True
    spec.worldbody.first_body().add_freejoint()
    spec.option.gravity = [0.0, 0.0, -whole.robot.gravity]
    ground = spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE)
    ground.size = [0.0, 0.0, 1.0]
    if block := whole.block(x):
        half, centre, heading = block
        ground.pos = [0.0, 0.0, centre[2] - half[2]]
        turn = np.roll(Rotation.from_euler("z", heading).as_quat(), 1)
        box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": half, "pos": centre, "quat": turn}
        spec.worldbody.add_geom(name="platform", **box)
    for name in whole.joints:
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        joint = spec.joint(name)
        if actuator := whole.robot.actuators.get(name):
            joint.actfrcrange = [-actuator["effort"], actuator["effort"]]
            joint.armature = actuator["armature"]
            joint.frictionloss = actuator["friction"]
            joint.damping = [actuator["damping"], 0.0, 0.0]  # of a polynomial in the rate
        motor.ctrlrange = joint.actfrcrange
    spec.compile()
    qpos, qvel = _qpos_qvel(x)
    gain_time, gain = gains.gains(whole, x)
    arrays = {
        "time": x.t,
        "qpos": qpos,
        "qvel": qvel,
        "ctrl": x.tau,
        "gain_time": gain_time,
        "gain": gain,
        "joint_names": np.array(whole.joints),
        "contact": x.contact,
        "phase": x.phase,
        "fps": np.array(fps),
    }
    return {
        "robot.xml": spec.to_xml(),
        "motion.npz": arrays,
        "play.py": filled("io/play.py.txt"),
    }


CONTENTS: Mapping[str, Callable[[Whole, Motion, float], Any]] = {
    "csv": joint_table,
    "npz": plain_arrays,
    "urdf-replay": pybullet_folder,
    "unitree-csv": bare_states,
    "gmr-pkl": retargeted,
    "mjlab-npz": tracked,
    "beyondmimic-npz": partial(tracked, order=ORDERS[1], at_com=True),
    "holosoma-npz": with_root,
    "unilab-npz": with_world,
    "protomotions": states,
    "isaaclab-npz": with_base,
    "asap-pkl": partial(library_entry, without="wrist", more=3),  # head and hands
    "sonic-pkl": library_entry,
    "bones-csv": animated,
    "mujoco": mujoco_folder,
}
