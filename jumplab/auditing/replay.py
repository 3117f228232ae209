"""Everything the audit needs, recomputed from URDF and tape with Pinocchio, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from jumplab.auditing.report import METHOD, Measure, of_size
from jumplab.errors import InputError, RobotError
from jumplab.io.tape import AIR, Tape
from jumplab.robot import Robot
from jumplab.robot.locked import LockedJoint
from jumplab.robot.motors import SLIDING_RATE
from jumplab.task import GRAVITY, JumpTask

BASE = ("base x", "base y", "base z", "base roll", "base pitch", "base yaw")


def norm(x: np.ndarray) -> np.ndarray:
    """Lengths (...) of vectors (..., n)."""
    return np.linalg.norm(x, axis=-1)


def runs(values: np.ndarray) -> list[slice]:
    """Rows of each run of equal rows in values (N,) or (N, M)."""
    differ = (values[1:] != values[:-1]).reshape(len(values) - 1, -1).any(axis=1)
    edges = [0, *(np.flatnonzero(differ) + 1).tolist(), len(values)]
    return [slice(a, b) for a, b in pairwise(edges)]


def spans(flags: np.ndarray) -> list[slice]:
    """Rows of each run of true flags (N,)."""
    return [rows for rows in runs(flags) if flags[rows.start]]


class Sole(NamedTuple):
    """Sole rectangle in the frame of a foot link [m]."""

    heel: float
    toe: float
    right: float
    left: float
    z: float


@dataclass(frozen=True)
class Replay:
    """A tape of N samples with K contact frames, a robot's URDF, and what follows; world axes."""

    tape: Tape
    robot: Robot
    task: JumpTask | None
    edge_m: float | None
    over: Sequence[float] | None
    model: pin.Model  # built from the URDF alone, as the geometry
    geometry: pin.GeometryModel
    frames: list[int]  # (K,) of the model, that the feet are
    soles: tuple[Sole, ...]  # one per contact frame
    com: np.ndarray  # (N, 3) [m], its velocity [m/s] and its acceleration [m/s^2]
    com_velocity: np.ndarray
    com_acceleration: np.ndarray
    momentum: np.ndarray  # (N, 3) angular momentum about the CoM [kg m^2/s]
    energy: np.ndarray  # (N,) kinetic, that of the motors' armature included, plus potential [J]
    foot: np.ndarray  # (N, K, 3) origin of each contact frame [m]
    foot_rotation: np.ndarray  # (N, K, 3, 3)
    # (N, 6) force [N] and moment about the CoM [N m] that nothing on the tape provides
    base_residual: np.ndarray
    tau: np.ndarray  # (N, nv - 6) motor torques that the motion and the contact wrenches need [N m]
    lost: np.ndarray  # (N, nv - 6) of them, what the motors' friction takes [N m]
    holding: np.ndarray  # (N, H) torques that hold the robot's locked joints [N m]

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """(nv - 6,) names of the joints."""
        return tuple(map(str, self.tape.joint_names))

    @property
    def coordinates(self) -> tuple[str, ...]:
        """(nv,) names of the columns of v."""
        return (*BASE, *self.joints)

    @cached_property
    def method(self) -> SimpleNamespace:
        """Numbers of the audit that are no limits, for a robot of this size."""
        return of_size(self.robot)[0]

    @cached_property
    def gravity(self) -> float:
        """Of the replayed model, positive [m/s^2]."""
        return float(-self.model.gravity.linear[2])

    @cached_property
    def mass(self) -> float:
        """Of the URDF [kg]."""
        return float(pin.computeTotalMass(self.model))

    @property
    def weight(self) -> float:
        """m g [N]."""
        return self.mass * self.gravity

    @cached_property
    def step(self) -> np.ndarray:
        """(N - 1,) time steps [s]; zero across take-off, and where a foot lands."""
        return np.diff(self.tape.t)

    @cached_property
    def carrying(self) -> np.ndarray:
        """(N, K) whether a foot is on the ground, as the tape says; what it says is checked."""
        return self.tape.contacts > AIR

    @cached_property
    def ground(self) -> np.ndarray:
        """(N,) whether any foot is on the ground."""
        return self.carrying.any(axis=1)

    @cached_property
    def pieces(self) -> list[slice]:
        """Rows without a jump of accelerations: from one doubled instant to the next."""
        return runs(np.cumsum(np.diff(self.tape.t, prepend=-1) == 0))

    @cached_property
    def flights(self) -> list[slice]:
        """Rows of each flight."""
        return [p for p in self.pieces if not self.carrying[p].any()]

    @cached_property
    def stands(self) -> list[tuple[int, slice]]:
        """(foot, rows) of each contact."""
        return [(k, rows) for k, down in enumerate(self.carrying.T) for rows in spans(down)]

    @property
    def is_jump(self) -> bool:
        """Whether both feet leave once, and the tape ends as they come down."""
        return len(self.pieces) == 2 and self.flights == self.pieces[1:]

    @cached_property
    def sole_points(self) -> np.ndarray:
        """(N, K, 2 n, 3) points of the soles in the world [m]: from heel to toe on the right edge,
        then on the left one.
        """
        heel, toe, right, left, z = np.transpose(self.soles)[..., None]  # (K, 1)
        ahead = np.linspace(heel, toe, METHOD.sole_points, axis=-1)[:, 0]  # (K, n)
        edges = [np.stack(np.broadcast_arrays(ahead, y, z), axis=-1) for y in (right, left)]
        local = np.concatenate(edges, axis=1)
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
        """Height of the landing surface [m]: the task's, else that of the soles at the end."""
        return self.task.platform_m if self.task else float(self.sole_points[-1, :, :, 2].min())

    @property
    def course_rad(self) -> float:
        """Direction in which the surfaces change, from +x to the left [rad]."""
        return self.task.along_rad if self.task else 0.0

    def along(self, points: np.ndarray) -> np.ndarray:
        """Coordinate of points (..., 3) [m] along the axis on which the surfaces change [m]."""
        return points[..., :2] @ [np.cos(self.course_rad), np.sin(self.course_rad)]

    @cached_property
    def heading(self) -> float:
        """+1 for a jump along that axis, -1 against it."""
        first, last = self.toe_corners[[0, -1], ..., 0].mean(axis=(1, 2))
        return 1.0 if self.course_rad or last >= first else -1.0

    @property
    def toes(self) -> float:
        """First place of the toes along the axis on which the surfaces change [m]."""
        foot = self.robot.foot
        middle = float(self.along(self.sole_points[0]).mean())
        return middle + foot.toe - float(foot.center[0])

    @cached_property
    def edge(self) -> float:
        """Place of the step between the two surfaces [m], as given; or else where the world is most
        natural.

        A higher surface begins a little behind the sole that lands on it, not under the launching
        one if that can be; the launching surface ends a little ahead of the launching sole if the
        landing one is lower.
        """
        ahead = self.along(self.sole_points[[0, -1]])
        if self.edge_m is not None:
            return self.toes + self.edge_m
        launched = float((self.heading * ahead[0]).max())
        landed = float((self.heading * ahead[1]).min())
        up = min(max(landed - METHOD.edge_room_m, launched), landed)
        return self.heading * (up if self.platform > 0 else launched + METHOD.edge_room_m)

    def surface(self, x: np.ndarray) -> np.ndarray:
        """Heights (...) of the surface at ``x`` (...) along the axis on which it changes [m]."""
        ahead = self.heading * (np.asarray(x) - self.edge)
        beyond = ahead > -1e-9 if self.platform > 0 else ahead > 1e-9
        return np.where(beyond, self.platform, 0.0)

    def named(
        self,
        name: str,
        values: ArrayLike,
        t: ArrayLike | None = None,
        numbers: Mapping[str, float | str] | None = None,
        labels: Sequence[str] | None = None,
    ) -> Measure:
        """A measure as :meth:`.Limit.check` takes it: values with N rows are of all samples; (M, K)
        are of the feet, (M, nv - 6) of the joints and (M, nv) of the coordinates.
        """
        x = np.asarray(values, float)
        if t is None and x.shape[:1] == self.tape.t.shape:
            t = self.tape.t
        if labels is None and x.ndim == 2:
            columns = self.tape.contact_frames, self.joints, self.coordinates
            labels = {len(names): names for names in columns}.get(x.shape[1])
        return name, x, t, labels, vars(self.method) | (numbers or {})

    def integral(self, values: np.ndarray) -> np.ndarray:
        """Running trapezoid integral over time of (N,) or (N, M) values, zero in the first row."""
        # as scipy does, whose import takes longer than the whole audit
        areas = ((values[1:] + values[:-1]).T * self.step / 2).T
        return np.concatenate([np.zeros_like(values[:1]), np.cumsum(areas, axis=0)])


def open_tape(tape: Tape, robot: Robot, task: JumpTask | None) -> tuple[pin.Model, list[int]]:
    """Pinocchio model, and contact frames; raises InputError if the tape does not fit."""
    try:
        model = pin.buildModelFromXML(robot.urdf, pin.JointModelFreeFlyer())
    except ValueError as e:
        raise RobotError(
            f"robot {robot.name}: Pinocchio cannot read the URDF: {str(e).splitlines()[0]}"
        ) from e
    model.gravity.linear = np.array([0.0, 0.0, -(task.gravity if task else GRAVITY)])
    if tuple(map(str, tape.joint_names)) != tuple(model.names[2:]):
        raise InputError(
            f"tape: its joints are not those of the robot {robot.name!r} in the same order; plan "
            "the jump again with this robot"
        )
    frames = list(map(str, tape.contact_frames))
    widths = {"q": [model.nq], "v": [model.nv], "a": [model.nv], "tau": [model.nv - 6]}
    for name, width in {**widths, "f": [len(frames), 6]}.items():
        shape = (len(tape.t), *width)
        given = getattr(tape, name).shape
        if given != shape:
            raise InputError(
                f"tape: {name} has shape {given}, the robot {robot.name!r} needs {shape}"
            )
    for name in frames:
        if not model.existFrame(name, pin.FrameType.BODY):
            raise InputError(
                f"tape: the contact frame {name!r} is not a link of the robot {robot.name!r}"
            )
    if not frames:
        raise InputError(
            "tape: it names no contact frame, but a jump needs a foot; plan the jump again"
        )
    return model, [model.getFrameId(name, pin.FrameType.BODY) for name in frames]


def replay(
    tape: Tape,
    robot: Robot,
    task: JumpTask | None,
    edge_m: float | None = None,
    over: Sequence[float] | None = None,
) -> Replay:
    """Recompute motion and forces of a whole tape (finite numbers only; see :func:`open_tape`)."""
    model, frames = open_tape(tape, robot, task)
    try:
        geometry = pin.buildGeomFromUrdfString(model, robot.urdf, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as e:
        raise RobotError(
            f"robot {robot.name}: its collision shapes cannot be read: {str(e).splitlines()[0]}"
        ) from e
    motion = _motion(tape, model, frames, robot.locked)
    rates = tape.v[:, 6:]
    motors = robot.limits  # of the tape's joints, in their order
    lost = motors.friction * np.tanh(rates / SLIDING_RATE) + motors.damping * rates
    motion["tau"] += motors.armature * tape.a[:, 6:] + lost
    motion["energy"] += (motors.armature * rates**2).sum(axis=1) / 2
    soles = tuple(_sole(geometry, model, robot, frame) for frame in frames)
    places = tape, robot, task, edge_m, over, model, geometry, frames, soles
    return Replay(*places, lost=lost, **motion)


def configured_sole(robot: Robot) -> Sole:
    """A sole as the robot's configuration has it."""
    f = robot.foot
    return Sole(f.heel, f.toe, -f.half_width, f.half_width, f.sole_z)


def _sole(geometry: pin.GeometryModel, model: pin.Model, robot: Robot, frame: int) -> Sole:
    """Lowest face of the boxes of a foot link; without any, what the robot's configuration says."""
    corners = []
    for shape in geometry.geometryObjects:
        half = getattr(shape.geometry, "halfSide", None)
        if half is not None and shape.parentFrame == frame:
            place = model.frames[frame].placement.actInv(shape.placement)
            corners += [place.act(half * signs) for signs in product((-1, 1), repeat=3)]
    if not corners:
        return configured_sole(robot)
    corners = np.array(corners)
    low = corners[corners[:, 2] < corners[:, 2].min() + METHOD.same_level_m]
    (heel, right, z), (toe, left, _) = low.min(axis=0), low.max(axis=0)
    return Sole(heel, toe, right, left, z)


def _held(
    model: pin.Model, inverse: pin.Data, locked: Sequence[LockedJoint], limbs: list[list[int]]
) -> list[float]:
    """Torques (H,) of locked joints: what their parts need, and the ``limbs`` on them, by inverse
    dynamics that has just been done."""
    torques = []
    for joint, beyond in zip(locked, limbs, strict=True):
        need = joint.part * inverse.a_gf[1] + joint.part.vxiv(inverse.v[1])
        for k in beyond:
            need += inverse.liMi[k].act(inverse.f[k])
        torques.append(float(joint.axis @ (need.angular - np.cross(joint.place, need.linear))))
    return torques


def _motion(
    tape: Tape, model: pin.Model, frames: list[int], locked: Sequence[LockedJoint]
) -> dict[str, np.ndarray]:
    """The mechanical fields of :class:`Replay`, by name; torques without what motors add."""
    data = model.createData()
    inverse = model.createData()
    mass = pin.computeTotalMass(model)
    limbs = [[model.getJointId(name) for name in joint.joints] for joint in locked]
    rows = []
    for q, v, a, wrenches in zip(tape.q, tape.v, tape.a, tape.f, strict=True):
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        external = [pin.Force.Zero() for _ in range(model.njoints)]
        for frame, wrench in zip(frames, wrenches, strict=True):
            # from the frame's origin in world axes to the joint that carries it
            contact = pin.SE3(np.eye(3), data.oMf[frame].translation).act(pin.Force(wrench))
            joint = model.frames[frame].parentJoint
            external[joint] += data.oMi[joint].actInv(contact)
        need = pin.rnea(model, inverse, q, v, a, external)
        about_com = pin.SE3(np.eye(3), data.com[0])
        row = {
            "com": data.com[0].copy(),
            "com_velocity": data.hg.linear / mass,
            "com_acceleration": data.dhg.linear / mass,
            "momentum": data.hg.angular.copy(),
            "energy": pin.computeMechanicalEnergy(model, data, q, v),
            "foot": [data.oMf[frame].translation.copy() for frame in frames],
            "foot_rotation": [data.oMf[frame].rotation.copy() for frame in frames],
            "base_residual": about_com.actInv(data.oMi[1].act(pin.Force(need[:6]))).vector,
            "tau": need[6:].copy(),
            "holding": _held(model, inverse, locked, limbs),
        }
        rows.append(row)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}
