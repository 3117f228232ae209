"""Motion clips in other people's files: read by content, run by nobody, refused in a sentence."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from joblib.numpy_pickle import NumpyArrayWrapper, NumpyUnpickler
from scipy.spatial.transform import Rotation

from jumplab import reading
from jumplab.errors import InputError, Shown, as_path, quoted
from jumplab.io.columns import BASE
from jumplab.io.motion import Motion, steady
from jumplab.io.tensors import read_tensors
from jumplab.io.whole import ORDERS, Whole, ordered
from jumplab.robot import Robot
from jumplab.robot.contact import on_feet
from jumplab.robot.files import SHIPPED, read_toml

ENDINGS = (".pkl", ".npz", ".csv", ".motion")
USUAL_FPS = 30.0  # of files that do not say
RECORD_FPS = 100.0  # at which plans and simulations are looked at
LEAST_FRAMES = 10
FPS = 5.0, 10_000.0  # least and most
TURN_RAD = 7.0  # no joint turns further
BEYOND_RAD = 0.5  # of its range, by which a joint of the right robot is not most of the time
# joints are in the other order if with it the lower sole's usual tilt is less than this share of
# it, which is more than that: public clips have shares of 0.2 to 0.6, and 0.07 to 0.5 rad of tilt
FLATTER = 0.7
TILTED_RAD = 0.3
LEVEL_RAD = 0.45  # what it has to be less than in that order
LYING_RAD = 0.8  # from which on a note says so: the order may be a third one
LOOKED_AT = 100  # frames at most
STILL_RAD = 0.02  # by which a joint that the robot holds may move
# what a pickle may name: arrays and nothing that could run
ARRAYS = {
    ("joblib.numpy_pickle", "NumpyArrayWrapper"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
}


@dataclass(frozen=True, repr=False)
class Clip(Shown):
    """Configurations of a robot at a frame rate, and nothing else.

    Attributes
    ----------
    q : (n, nq) x y z qx qy qz qw of the base in the world, then joint angles [m, rad].
    fps : frames a second [1/s].
    origin : format of the file, in words; ``notes`` say what was taken for granted.
    platform_m : height of a platform beside the ground [m].
    """

    name: str
    robot: Robot
    q: np.ndarray
    fps: float
    origin: str
    notes: tuple[str, ...] = ()
    platform_m: float = 0.0

    def line(self) -> str:
        """Name, robot, frames, rate, format, and what was taken for granted."""
        size = f"{len(self.q)} frames at {self.fps:g} per second"
        return "; ".join([f"{self.name}, {self.robot.name}, {size}, {self.origin}", *self.notes])

    @property
    def t(self) -> np.ndarray:
        """Times (n,) of the frames [s]."""
        return np.arange(len(self.q)) / self.fps

    @classmethod
    def of(cls, record: Any, robot: Robot | None = None, fps: float | None = None) -> Clip:
        """That of a plan, a tape or a simulation; ``robot`` if it does not carry its own."""
        robot = getattr(record, "robot", None) or robot
        if robot is None:
            raise InputError("the robot of this motion is unknown; pass it as robot=")
        rate = fps or RECORD_FPS
        motion = Motion.of(getattr(record, "tape", record)).every(rate)
        platform_m = getattr(getattr(record, "task", None), "platform_m", 0.0)
        origin = "a motion of this package"
        return cls(motion.source, robot, motion.q, rate, origin, platform_m=platform_m)


@dataclass
class _Raw:
    """Content of a clip's file: base (n, 3) [m], its quaternions (n, 4) x y z w, joints (n, k)
    [rad]; raises ValueError if these are no arrays of numbers.
    """

    base: np.ndarray
    turn: np.ndarray
    joints: np.ndarray
    origin: str
    fps: float | None = None
    names: tuple[str, ...] | None = None
    usual_fps: float = USUAL_FPS  # where nobody says

    def __post_init__(self) -> None:
        for name in ("base", "turn", "joints"):
            array = np.asarray(getattr(self, name))
            if array.dtype.kind not in "fiu":
                raise ValueError(f"{name}: no real numbers")
            setattr(self, name, array)


# files
# ----------------------------------------------------------------------------------------------
class _Arrays(NumpyUnpickler):
    """Reads pickles of arrays, joblib's too, and refuses to name or call anything else."""

    dispatch = NumpyUnpickler.dispatch.copy()

    def find_class(self, module: str, name: str) -> Any:
        """An allowed class; raises for others."""
        if (module, name) not in ARRAYS:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which could run code")
        return super().find_class(module, name)

    def load_build(self) -> None:
        """As joblib's, but arrays of objects, whose content it would unpickle freely."""
        built, state = self.stack[-2:]
        values = state if isinstance(state, Mapping) else {}
        if isinstance(built, NumpyArrayWrapper) and getattr(values.get("dtype"), "hasobject", True):
            raise pickle.UnpicklingError("it holds an array of objects, which could run code")
        super().load_build()

    dispatch[pickle.BUILD[0]] = load_build


def _content(path: Path) -> Mapping[str, Any]:
    """Arrays and numbers of a file by name; of a CSV file by column."""
    try:
        raw = reading.content(path, "clip")
        if not raw.strip():
            raise InputError(f"{path}: is empty; give a pickle, npz or csv file")
        if raw[:2] == b"PK":
            tensors = read_tensors(raw)
            return reading.arrays(raw) if tensors is None else tensors
        if raw[:1] == b"\x80":
            return _Arrays(str(path), io.BytesIO(raw), ensure_native_byte_order=True).load()
        return _columns(raw.decode())
    except pickle.UnpicklingError as e:
        raise InputError(f"{path}: refused, {e}; ask for the clip as npz") from e
    except InputError:
        raise
    except Exception as e:  # damaged pickles raise whatever they like
        reason = getattr(e, "strerror", None) or type(e).__name__
        raise InputError(
            f"{path}: not a readable clip ({reason}); give a pickle, npz or csv file"
        ) from e


def _columns(text: str) -> Mapping[str, Any]:
    """A table with commas: of names in its first line, else of x y z, quaternion and joints."""
    head, _, rows = text.lstrip().partition("\n")
    names = head.rstrip().split(",")
    try:
        float(names[0])
        return {"rows": np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2)}
    except ValueError:
        if not rows.strip():
            raise ValueError("no rows") from None
        table = np.loadtxt(io.StringIO(rows), delimiter=",", ndmin=2)
        return dict(zip(names, table.T, strict=True))


def _rate(x: Mapping[str, Any]) -> float | None:
    """Frames a second that a file states, or that its times have [1/s]."""
    for name in ("fps", "hz", "framerate"):
        if name in x:
            return float(np.ravel(x[name])[0])
    for name in ("time_s", "time", "t"):
        if name in x and len(x[name]) > 1:
            return float(1 / np.median(np.diff(x[name])))
    return None


def _first_wxyz(x: np.ndarray) -> np.ndarray:
    return np.roll(x, -1, axis=-1)


def _of_tracker(x: Mapping[str, Any]) -> _Raw:
    joints = x["joint_pos"]
    root = int(not x["body_pos_w"][:, 0].any())  # the world may be the first body
    before = joints.shape[1] - len(x["joint_names"]) if "joint_names" in x else 0
    return _Raw(
        x["body_pos_w"][:, root],
        _first_wxyz(x["body_quat_w"][:, root]),
        joints[:, before:],
        "arrays of a motion tracker, quaternion w x y z",
    )


def _of_states(x: Mapping[str, Any]) -> _Raw:
    return _Raw(
        x["rigid_body_pos"][:, 0],
        x["rigid_body_rot"][:, 0],
        x["dof_pos"],
        "states of all bodies, quaternion x y z w",
    )


def _of_table(x: Mapping[str, Any]) -> _Raw:
    ending = "_position_rad"
    names = tuple(name.removesuffix(ending) for name in x if name.endswith(ending))
    q = np.column_stack([x[name] for name in (*BASE, *(name + ending for name in names))])
    return _Raw(q[:, :3], q[:, 3:7], q[:, 7:], "a table of joints by name", names=names)


def _of_animation(x: Mapping[str, Any]) -> _Raw:
    place, turn = (
        np.column_stack([x[f"root_{word}{axis}"] for axis in "XYZ"])
        for word in ("translate", "rotate")
    )
    joints = {name.removesuffix("_dof"): x[name] for name in x if name.endswith("_dof")}
    return _Raw(
        place / 100,
        Rotation.from_euler("xyz", turn, degrees=True).as_quat(),
        np.radians(np.column_stack([*joints.values()])),
        "an animator's table, cm and degrees",
        names=tuple(joints),
        usual_fps=120.0,
    )


def _of_arrays(words: str, x: Mapping[str, Any], names: tuple[str, ...]) -> _Raw:
    """Base, quaternions and joints of three ``names``, or from the columns of the first one."""
    parts = [x[name] for name in names[:3]]
    base, turn, joints = parts if len(names) == 3 else np.split(parts[0], [3, 7], axis=1)
    return _Raw(base, _first_wxyz(turn) if "w x y z" in words else turn, joints, words)


# names that a file has to have -> how it is read, or in words what its arrays are; the first that
# fits counts
FORMS: Mapping[tuple[str, ...], Callable[[Mapping[str, Any]], _Raw] | str] = {
    ("root_trans_offset", "root_rot", "dof"): "pickle of a motion library, quaternion x y z w",
    ("root_pos", "root_rot", "dof_pos"): "pickle of a retargeter, quaternion x y z w",
    (
        "base_position_m",
        "base_quaternion_xyzw",
        "joint_position_rad",
    ): "arrays with units, quaternion x y z w",
    ("body_pos_w", "body_quat_w", "joint_pos"): _of_tracker,
    ("rigid_body_pos", "rigid_body_rot", "dof_pos"): _of_states,
    ("base_pos_w", "base_quat_w", "joint_pos"): "base and joints, quaternion w x y z",
    ("root_translateX", "root_rotateX"): _of_animation,
    ("qpos",): "MuJoCo's qpos, quaternion w x y z",
    ("q", "joint_names"): "a plan or simulation, quaternion x y z w",
    ("rows",): "rows of numbers, quaternion x y z w",
    ("base_x_m", "base_qw"): _of_table,
}


def _entries(content: Any, name: str) -> Iterator[tuple[str, Mapping[str, Any], tuple]]:
    """Clips of a file: name, content, and its form; files may hold many by name."""
    if isinstance(content, Mapping):
        for names in FORMS:
            if set(names) <= content.keys():
                yield name, content, names
                return
        for key, part in content.items():
            yield from _entries(part, str(key))


def read_clips(
    path: str | Path, robot: Robot, *, fps: float | None = None, order: str = ORDERS[0]
) -> list[Clip]:
    """The clips of a file, found by its content: pickles of motion libraries and retargeters, npz,
    csv.

    Pickles are read without running anything that is in them.

    Parameters
    ----------
    robot : whose clips they are; where a clip has other joints than it, the shipped robot of the
        same URDF that has those.
    fps : frames a second [1/s], if the file does not say (then :data:`USUAL_FPS`,
        120 of tables in cm and degrees).
    order : "depth-first" or "breadth-first", of joints without names.

    Raises
    ------
    InputError
        For files that hold no clip, or one of another robot, in other units, axes or orders.
    """
    path = as_path(path, "a clip's file")
    if order not in ORDERS:
        raise InputError(f"order = {quoted(order)}: choose one of {', '.join(ORDERS)}")
    if fps is not None and not FPS[0] <= fps <= FPS[1]:
        raise InputError(f"fps = {fps:g} must lie between {FPS[0]:g} and {FPS[1]:g}")
    content = _content(path)
    clips = []
    for name, x, form in _entries(content, path.stem):
        where = f"{path}" if name == path.stem else f"{path}, clip {name!r}"
        try:
            reader = FORMS[form]
            raw = _of_arrays(reader, x, form) if isinstance(reader, str) else reader(x)
            raw.names = raw.names or tuple(map(str, x.get("joint_names", ()))) or None
            raw.fps = _rate(x)
        except (KeyError, IndexError, TypeError, ValueError) as e:
            raise InputError(f"{where}: its arrays do not fit each other ({e})") from e
        clips.append(_clip(where, name, raw, robot, fps, order))
    if not clips:
        keys = list(content)[:6] if isinstance(content, Mapping) else quoted(content)
        known = "; ".join(map(", ".join, FORMS))
        raise InputError(f"{path}: holds no clip, but {keys}; a clip has one of: {known}")
    return clips if len(clips) > 1 else [replace(clips[0], name=path.stem)]


# checks
# ----------------------------------------------------------------------------------------------
def _clip(where: str, name: str, raw: _Raw, robot: Robot, fps: float | None, order: str) -> Clip:
    """A clip of what a file holds, or a sentence."""
    notes = []
    rate = raw.fps if raw.fps is not None else fps or raw.usual_fps
    if not FPS[0] <= rate <= FPS[1]:
        raise InputError(
            f"{where}: says {rate:g} frames per second; a motion has {FPS[0]:g} to {FPS[1]:g}: "
            f"correct it in the file"
        )
    if raw.fps is None:
        notes.append(f"{rate:g} frames per second {'as given' if fps else 'assumed'}")
    elif fps is not None and abs(fps - raw.fps) > 0.01 * raw.fps:
        raise InputError(
            f"{where}: states {raw.fps:g} frames per second, but fps = {fps:g} is given; "
            f"leave out fps"
        )
    for fault in _faults(raw):
        raise InputError(f"{where}: {fault}")
    robot, q = _fitted(where, raw, robot, order)
    if raw.names is None:
        notes.append(f"joints taken for {order}")
        tilt = _check_order(where, raw, robot, q, order)
        if tilt > LYING_RAD:
            notes.append(f"with them the lower sole is {tilt:.1f} rad off level half of the time")
    q[:, 3:7] = steady(q[:, 3:7])
    _check_joints(where, robot, q)
    return Clip(name, robot, q, rate, raw.origin, tuple(notes))


def _faults(raw: _Raw) -> Iterator[str]:
    """Sentences on what makes arrays no motion in metres and radians, z up."""
    n = len(raw.base)
    shapes = raw.base.shape, raw.turn.shape, raw.joints.shape
    if shapes != ((n, 3), (n, 4), (n, *raw.joints.shape[-1:])):
        sizes = ", ".join(map(str, shapes))
        yield (
            f"base, quaternions and joints have shapes {sizes}; they must be (n, 3), (n, 4), "
            f"(n, joints)"
        )
    if n < LEAST_FRAMES:
        yield f"has {n} frames; a motion has {LEAST_FRAMES} or more"
    whole = np.hstack([raw.base, raw.turn, raw.joints]).astype(float)
    for frame, column in np.argwhere(~np.isfinite(whole)):
        yield f"frame {frame}, column {column} is not a finite number; repair it"
    length = np.linalg.norm(raw.turn, axis=1)
    frame = int(np.abs(length - 1).argmax())
    if abs(length[frame] - 1) > 0.01:
        yield (
            f"the quaternion of frame {frame} has length {length[frame]:.3g}, must be 1; "
            f"normalise it"
        )
    most = np.abs(raw.joints).max()
    if most > TURN_RAD:
        yield f"joint angles up to {most:.0f}; they look like degrees: pass radians"
    away = np.abs(raw.base)
    if np.median(away.max(axis=1)) > 50:
        yield f"the base is {away.max():.0f} m away; it looks like cm or mm: pass metres"
    _, y, z = _upwards(raw.turn)
    if z > 0.5:
        return
    if y > 0.9 and np.median(raw.base[:, 1]) > np.median(raw.base[:, 2]):
        yield "the robot's up is the world's y; turn the clip so that z points up"
    if _upwards(_first_wxyz(raw.turn))[2] > 0.9:
        yield (
            "its quaternions, read as x y z w, lay the robot down or stand it on its head; read as "
            "w x y z they keep it upright: reorder them to x y z w"
        )


def _upwards(turn: np.ndarray) -> np.ndarray:
    """The base's z axis in the world (3,), the median of attitudes (n, 4)."""
    return np.median(Rotation.from_quat(turn).as_matrix()[..., 2], axis=0)


def _fitted(where: str, raw: _Raw, robot: Robot, order: str) -> tuple[Robot, np.ndarray]:
    """The robot whose joints are the clip's, and configurations (n, nq)."""
    count = raw.joints.shape[1]
    turn = raw.turn / np.linalg.norm(raw.turn, axis=1, keepdims=True)
    counts = set()
    refusal = ""
    for one in _siblings(robot):
        whole = Whole(one)
        for joints, urdf in ((one.joint_names, one.urdf), (whole.joints, whole.urdf)):
            counts.add(len(joints))
            names = raw.names or ordered(urdf, order)[0]
            if count != len(joints) or set(names) != set(joints):
                continue
            columns = [names.index(name) for name in joints]
            q = np.hstack([raw.base, turn, raw.joints[:, columns]])
            if joints == one.joint_names:
                return one, q
            q, moved = whole.own(q)
            name = max(moved, key=moved.get)
            if moved[name] < STILL_RAD:
                return one, q
            refusal = refusal or (
                f"{where}: joint {name!r} moves by {moved[name]:.2f} rad, and robot {one.name} "
                f"holds it; pass a robot that moves it"
            )
    if refusal:
        raise InputError(refusal)
    what = f"{count} joints"
    strange = sorted(set(raw.names or ()) - set(Whole(robot).joints))
    if strange:
        what += f", of which {strange[0]!r} is none of the robot's"
    listed = ", ".join(map(str, sorted(counts)))
    raise InputError(
        f"{where}: has {what}; clips of robot {robot.name} have {listed}: pass the robot that the "
        f"clip was made for"
    )


def _siblings(robot: Robot) -> Iterator[Robot]:
    """The robot, and the shipped ones that are made of the same URDF."""
    yield robot
    if robot.name not in SHIPPED:
        return
    urdfs = {name: read_toml(path.read_text(), name)["urdf"] for name, path in SHIPPED.items()}
    for name, urdf in urdfs.items():
        if name != robot.name and urdf == urdfs[robot.name]:
            yield Robot.load(name)


def _check_order(where: str, raw: _Raw, robot: Robot, q: np.ndarray, order: str) -> float:
    """Tilt of the lower sole (see :func:`_tilt`); refuses joints in an ``order`` with which soles
    are tilted, if they are level in the other one.
    """
    tilt = _tilt(robot, q)
    other = ORDERS[order == ORDERS[0]]
    try:
        again = _tilt(*_fitted(where, raw, robot, other))
    except InputError:
        return tilt
    if again < min(LEVEL_RAD, FLATTER * tilt) and tilt > TILTED_RAD:
        raise InputError(
            f"{where}: in {order} order its lower sole is {tilt:.1f} rad off level half of the "
            f"time, in {other} order {again:.1f} rad; pass order = {other!r}"
        )
    return tilt


def _tilt(robot: Robot, q: np.ndarray) -> float:
    """Median angle of the lower sole to the ground [rad], in configurations (n, nq)."""
    data = robot.model.createData()
    soles = on_feet(robot, robot.foot.center)
    upright = []
    for row in q[:: max(1, len(q) // LOOKED_AT)]:
        pin.forwardKinematics(robot.model, data, row)
        lower = min((sole.place(data) for sole in soles), key=lambda place: place.translation[2])
        upright.append(lower.rotation[2, 2])
    return float(np.arccos(min(1.0, np.median(upright))))


def _check_joints(where: str, robot: Robot, q: np.ndarray) -> None:
    """Refuse joints that are out of their ranges most of the time: another order, or robot."""
    limits = robot.limits
    excess = np.median(np.maximum(limits.lower - q[:, 7:], q[:, 7:] - limits.upper), axis=0)
    worst = int(excess.argmax())
    if excess[worst] > BEYOND_RAD:
        raise InputError(
            f"{where}: joint {robot.joint_names[worst]!r} is {excess[worst]:.1f} rad beyond its "
            f"range most of the time: its joints are in another order, or the clip is of another "
            f"robot; correct the order, or pass that robot"
        )
