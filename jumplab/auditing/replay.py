"""Everything the audit needs, recomputed from URDF and tape with Pinocchio, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product

import numpy as np
import pinocchio as pin

from jumplab.auditing.report import METHOD
from jumplab.errors import InputError, RobotError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.description import SLIDING_RATE
from jumplab.task import GRAVITY, JumpTask

BASE = ("base x", "base y", "base z", "base roll", "base pitch", "base yaw")


@dataclass(frozen=True)
class Sole:
    """Sole rectangle in the frame of a foot link [m]."""

    heel: float
    toe: float
    right: float
    left: float
    z: float

    def points(self) -> np.ndarray:
        """(2 n, 3) points on right and left edge: index 0 is the heel, n - 1 the toe, then the left edge likewise."""
        x = np.linspace(self.heel, self.toe, METHOD.sole_points)
        return np.array([[xi, y, self.z] for y in (self.right, self.left) for xi in x])


@dataclass(frozen=True)
class Replay:
    """A tape, a robot's URDF and what follows from them, in N samples with K contact frames; vectors in world axes."""

    tape: Tape
    robot: Robot
    task: JumpTask | None
    edge_m: float | None
    model: pin.Model  # built from the URDF alone, as the geometry
    geometry: pin.GeometryModel
    soles: tuple[Sole, ...]  # one per contact frame
    com: np.ndarray  # (N, 3) [m], its velocity [m/s] and its acceleration [m/s^2]
    com_velocity: np.ndarray
    com_acceleration: np.ndarray
    momentum: np.ndarray  # (N, 3) angular momentum about the CoM [kg m^2/s]
    energy: np.ndarray  # (N,) kinetic, that of the motors' armature included, plus potential [J]
    base: np.ndarray  # (N, 3) origin of the base link [m]
    base_rotation: np.ndarray  # (N, 3, 3)
    foot: np.ndarray  # (N, K, 3) origin of each contact frame [m]
    foot_rotation: np.ndarray  # (N, K, 3, 3)
    base_residual: np.ndarray  # (N, 6) force [N] and moment about the CoM [N m] that nothing on the tape provides
    tau: np.ndarray  # (N, nv - 6) motor torques that the motion and the contact wrenches need [N m]
    lost: np.ndarray  # (N, nv - 6) of them, what the motors' friction takes [N m]
    coordinates: tuple[str, ...]  # (nv,) names of the columns of v
    gravity: float  # of the replayed model, positive [m/s^2]
    mass: float  # of the URDF [kg]
    weight: float  # m g [N]
    carrying: np.ndarray  # (N, K) whether a foot is on the ground, as the tape says; what it says is checked
    step: np.ndarray  # (N - 1,) time steps [s]; zero across take-off, and where a foot lands

    @cached_property
    def pieces(self) -> list[slice]:
        """Rows without a jump of accelerations: from one doubled instant to the next."""
        ends = [0, *(np.flatnonzero(self.step == 0) + 1).tolist(), len(self.tape.t)]
        return [slice(a, b) for a, b in pairwise(ends)]

    @cached_property
    def flights(self) -> list[slice]:
        """Rows of each flight."""
        return [p for p in self.pieces if not self.carrying[p].any()]

    @cached_property
    def ground(self) -> np.ndarray:
        """(N,) whether any foot is on the ground."""
        return self.carrying.any(axis=1)

    @cached_property
    def until_last_stand(self) -> slice:
        """Rows up to the last one with a foot on the ground."""
        return slice(0, int(np.flatnonzero(self.ground)[-1]) + 1)

    @cached_property
    def stands(self) -> list[tuple[int, slice]]:
        """(foot, rows) of each contact."""
        out = []
        for k, column in enumerate(self.carrying.T):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
            out += [(k, slice(a, b)) for a, b in edges.reshape(-1, 2).tolist()]
        return out

    @property
    def is_jump(self) -> bool:
        """Whether both feet leave once, and the tape ends as they come down; else it is another schedule."""
        return len(self.flights) == 1 and self.flights[0].stop == len(self.tape.t) and len(self.pieces) == 2

    @cached_property
    def sole_points(self) -> np.ndarray:
        """(N, K, 2 n, 3) points of the soles in the world [m], in the order of :meth:`Sole.points`."""
        local = np.array([s.points() for s in self.soles])  # (K, P, 3)
        return self.foot[:, :, None] + np.einsum("nkij,kpj->nkpi", self.foot_rotation, local)

    @property
    def toe_corners(self) -> np.ndarray:
        """(N, K, 2, 3) ends of the toe edges [m]."""
        return self.sole_points[:, :, [METHOD.sole_points - 1, -1]]

    @property
    def heel_corners(self) -> np.ndarray:
        """(N, K, 2, 3) ends of the heel edges [m]."""
        return self.sole_points[:, :, [0, METHOD.sole_points]]

    @cached_property
    def platform(self) -> float:
        """Height of the landing surface [m]: the task's, or without one that of the soles in the last sample."""
        return self.task.platform_m if self.task else float(self.sole_points[-1, :, :, 2].min())

    def along(self, points: np.ndarray) -> np.ndarray:
        """How far points (..., 3) lie along the axis on which the surfaces change [m]: x, or the way to a side."""
        if self.task is None or self.task.along_rad == 0:
            return points[..., 0]
        return np.cos(self.task.along_rad) * points[..., 0] + np.sin(self.task.along_rad) * points[..., 1]

    @cached_property
    def heading(self) -> float:
        """+1 for a jump along that axis, -1 against it."""
        if self.task is not None and self.task.along_rad:
            return 1.0
        return 1.0 if self.toe_corners[-1, ..., 0].mean() >= self.toe_corners[0, ..., 0].mean() else -1.0

    @cached_property
    def edge(self) -> float:
        """Place of the step between the two surfaces [m], as given; or else where the world is most natural.

        A higher surface begins a little behind the sole that lands on it, not under the launching one if that can be;
        the launching surface ends a little ahead of the launching sole if the landing one is lower.
        """
        if self.edge_m is not None:
            first = float(self.toe_corners[0, ..., 0].mean())
            if self.task is not None and self.task.along_rad:  # as far ahead of the soles' middle as the toes are
                foot, middle = self.robot.foot, self.sole_points[0].mean(axis=(0, 1))
                first = float(self.along(middle)) + foot.toe - float(foot.center[0])
            return first + self.edge_m
        ahead = self.heading * self.along(self.sole_points[[0, -1]])
        launched, landed = float(ahead[0].max()), float(ahead[1].min())
        up = min(max(landed - METHOD.edge_room_m, launched), landed)
        return self.heading * (up if self.platform > 0 else launched + METHOD.edge_room_m)

    def surface(self, x: np.ndarray) -> np.ndarray:
        """Height of the surface at ``x`` along the axis on which it changes [m]."""
        ahead = self.heading * (np.asarray(x) - self.edge)
        beyond = ahead > -1e-9 if self.platform > 0 else ahead > 1e-9
        return np.where(beyond, self.platform, 0.0)

    def integral(self, values: np.ndarray) -> np.ndarray:
        """Running trapezoid integral over time of (N,) or (N, M) values, zero in the first row."""
        steps = np.diff(self.tape.t).reshape(-1, *[1] * (values.ndim - 1))
        areas = steps * (values[1:] + values[:-1]) / 2  # as scipy does, whose import takes longer than the whole audit
        return np.concatenate([np.zeros_like(values[:1]), np.cumsum(areas, axis=0)])


def open_tape(tape: Tape, robot: Robot, task: JumpTask | None) -> tuple[pin.Model, list[int]]:
    """Pinocchio model from the URDF, and indices of the contact frames; raises InputError if the tape does not fit."""
    try:
        model = pin.buildModelFromXML(robot.urdf, pin.JointModelFreeFlyer())
    except ValueError as e:
        raise RobotError(f"robot {robot.name}: Pinocchio cannot read the URDF: {str(e).splitlines()[0]}") from e
    model.gravity.linear = np.array([0.0, 0.0, -(task.gravity if task else GRAVITY)])
    if tuple(map(str, tape.joint_names)) != tuple(model.names[2:]):
        raise InputError(
            f"tape: its joints are not those of the robot {robot.name!r} in the same order; plan the jump again with "
            f"this robot"
        )
    n, k = len(tape.t), len(tape.contact_frames)
    shapes = {"q": (n, model.nq), "v": (n, model.nv), "a": (n, model.nv), "tau": (n, model.nv - 6), "f": (n, k, 6)}
    for name, shape in shapes.items():
        if (found := getattr(tape, name).shape) != shape:
            raise InputError(f"tape: {name} has shape {found}, the robot {robot.name!r} needs {shape}")
    for name in tape.contact_frames:
        if not model.existFrame(str(name)):
            raise InputError(f"tape: the contact frame {str(name)!r} is not a link of the robot {robot.name!r}")
    if k == 0:
        raise InputError("tape: it names no contact frame; a jump needs at least one foot")
    return model, [model.getFrameId(str(name)) for name in tape.contact_frames]


def replay(tape: Tape, robot: Robot, task: JumpTask | None, edge_m: float | None = None) -> Replay:
    """Recompute motion and forces of a whole tape (finite numbers only; see :func:`open_tape`)."""
    model, frames = open_tape(tape, robot, task)
    try:
        geometry = pin.buildGeomFromUrdfString(model, robot.urdf, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as e:
        raise RobotError(f"robot {robot.name}: its collision shapes cannot be read: {str(e).splitlines()[0]}") from e
    soles = tuple(_sole(geometry, model, robot, frame) for frame in frames)
    motion = _motion(tape, model, frames)
    need = dict(zip(("base_residual", "tau"), _inverse_dynamics(tape, model, frames, motion), strict=True))
    armature, need["lost"] = _motors(tape, robot)
    need["tau"] = need["tau"] + armature * tape.a[:, 6:] + need["lost"]
    motion["energy"] = motion["energy"] + (armature * tape.v[:, 6:] ** 2).sum(axis=1) / 2
    gravity, mass = float(-model.gravity.linear[2]), float(pin.computeTotalMass(model))
    rows = {"carrying": carrying(tape)}
    told = {"gravity": gravity, "mass": mass, "weight": mass * gravity, "step": np.diff(tape.t)}
    names = (*BASE, *map(str, tape.joint_names))
    return Replay(
        tape, robot, task, edge_m, model, geometry, soles, coordinates=names, **motion, **need, **rows, **told
    )


def carrying(tape: Tape) -> np.ndarray:
    """(N, K) whether a foot is on the ground: the tape's ``contacts``, without them all feet until take-off."""
    told = tape.extra.get("contacts")
    if isinstance(told, np.ndarray) and told.shape == tape.f.shape[:2]:
        return told > 0
    return np.repeat((np.asarray(tape.phase) != "flight")[:, None], tape.f.shape[1], axis=1)


def _motors(tape: Tape, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Of the motors, which no URDF knows: armature (nv - 6,) [kg m^2], torques (N, nv - 6) lost to friction [N m]."""
    rows = [robot.actuators[name] for name in map(str, tape.joint_names)]
    armature, dry, viscous = (np.array([row[key] for row in rows]) for key in ("armature", "friction", "damping"))
    rate = tape.v[:, 6:]
    return armature, dry * np.tanh(rate / SLIDING_RATE) + viscous * rate


def _sole(geometry: pin.GeometryModel, model: pin.Model, robot: Robot, frame: int) -> Sole:
    """Lowest face of the boxes of a foot link; without any, what the robot's configuration says."""
    corners = []
    for shape in geometry.geometryObjects:
        half = getattr(shape.geometry, "halfSide", None)
        if half is not None and shape.parentFrame == frame:
            place = model.frames[frame].placement.actInv(shape.placement)
            corners += [place.act(half * signs) for signs in product((-1, 1), repeat=3)]
    if not corners:
        f = robot.foot
        return Sole(f.heel, f.toe, -f.half_width, f.half_width, f.sole_z)
    corners = np.array(corners)
    low = corners[corners[:, 2] < corners[:, 2].min() + METHOD.same_level_m]
    return Sole(low[:, 0].min(), low[:, 0].max(), low[:, 1].min(), low[:, 1].max(), low[:, 2].min())


def _motion(tape: Tape, model: pin.Model, frames: list[int]) -> dict[str, np.ndarray]:
    """The kinematic fields of :class:`Replay`, by name."""
    data, mass, n, k = model.createData(), pin.computeTotalMass(model), len(tape.t), len(frames)
    points = "com", "com_velocity", "com_acceleration", "momentum", "base"
    found = {name: np.empty((n, 3)) for name in points} | {"energy": np.empty(n), "base_rotation": np.empty((n, 3, 3))}
    found |= {"foot": np.empty((n, k, 3)), "foot_rotation": np.empty((n, k, 3, 3))}
    com, velocity, acceleration, momentum, base, energy, rotation, foot, foot_rotation = found.values()
    for i, (q, v, a) in enumerate(zip(tape.q, tape.v, tape.a, strict=True)):
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        energy[i] = pin.computeMechanicalEnergy(model, data, q, v)
        com[i], velocity[i], acceleration[i] = data.com[0], data.hg.linear / mass, data.dhg.linear / mass
        momentum[i], base[i], rotation[i] = data.hg.angular, data.oMi[1].translation, data.oMi[1].rotation
        for j, frame in enumerate(frames):
            foot[i, j], foot_rotation[i, j] = data.oMf[frame].translation, data.oMf[frame].rotation
    return found


def _inverse_dynamics(tape: Tape, model: pin.Model, frames: list[int], motion: dict) -> tuple[np.ndarray, np.ndarray]:
    """Base residual (force, moment about the CoM; world axes) and joint torques."""
    data = model.createData()
    # (N, K, 2, 3) force and moment at the contact frame's origin, in its axes
    local = np.einsum("nkji,nkcj->nkci", motion["foot_rotation"], tape.f.reshape(*tape.f.shape[:2], 2, 3))
    contacts = [(model.frames[i].parentJoint, model.frames[i].placement) for i in frames]
    need, external, none = np.empty_like(tape.v), pin.StdVec_Force(), pin.Force.Zero()
    external.extend([none for _ in range(model.njoints)])
    for i in range(len(tape.t)):
        for joint, _ in contacts:
            external[joint] = none
        for (joint, place), wrench in zip(contacts, local[i], strict=True):
            external[joint] = external[joint] + place.act(pin.Force(*wrench))
        need[i] = pin.rnea(model, data, tape.q[i], tape.v[i], tape.a[i], external)
    force, moment = (np.einsum("nij,nj->ni", motion["base_rotation"], need[:, k : k + 3]) for k in (0, 3))
    moment -= np.cross(motion["com"] - motion["base"], force)
    return np.concatenate([force, moment], axis=1), need[:, 6:]
