"""PyBullet as an engine: ground with edges, the robot from its own URDF, contact as stated."""

from __future__ import annotations

import locale
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin

from jumplab.control.kinematics import rotation, rotations
from jumplab.errors import RobotError
from jumplab.sim import STEP_S
from jumplab.sim.armature import Armature, Friction
from jumplab.sim.engine import Engine, Kept, inertial, moments
from jumplab.sim.scene import REACH_M


@dataclass(frozen=True)
class Contact:
    """Contact model: options of PyBullet's engine, which has defaults of its own."""

    options: dict[str, float] = field(default_factory=dict)
    substeps: int = 1  # in one step of the simulation


# With 200 iterations, what is left unsolved tips the robot sideways by 2.5 mrad. With the default
# fading, feet bounce off an impact; this one takes 10 ms. Boxes at a depth of zero lose the contact
# of a light toe by rounding
HARD = Contact({"numSolverIterations": 1000, "contactERP": 0.1, "contactSlop": 1e-4})
# friction combines as a product: the robot's coefficient is the effective one
GROUND_FRICTION = 1.0
NOTHING = np.zeros((0, 16))  # what is noted of points on which ground presses, where it does not
# places and attitudes of the feet, where nothing presses
NOWHERE = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]] * 2)
FASTEST = 1e3  # [rad/s] lifts Bullet's silent cap of 100 rad/s


def _import_quietly() -> ModuleType:
    """Import pybullet with file descriptor 2, to which its C code greets, muted for the moment."""
    try:
        keep = os.dup(2)
    except OSError:  # no standard error to protect
        return import_module("pybullet")
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        return import_module("pybullet")
    finally:
        os.dup2(keep, 2)
        os.close(keep)


bullet = _import_quietly()


class _Client:
    """The functions and constants of PyBullet, each function for one of its worlds."""

    def __init__(self, number: int):
        self._number = number

    def __getattr__(self, name: str) -> Any:
        value = getattr(bullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self._number)
        self.__dict__[name] = value  # found at once from here on
        return value


def load_urdf(urdf: str, name: str, client: int, flags: int = 0) -> int:
    """Load the URDF text of robot ``name``, inertias as written there; returns the body's number.

    Raises :class:`RobotError` if PyBullet cannot read it.
    """
    flags |= bullet.URDF_USE_INERTIA_FROM_FILE
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        path = Path(folder, "robot.urdf")  # Bullet reads files only
        path.write_text(urdf, encoding="utf-8")
        try:
            with _decimal_points():
                return bullet.loadURDF(str(path), flags=flags, physicsClientId=client)
        except bullet.error as e:
            raise RobotError(f"robot {name}: PyBullet cannot read the URDF: {e}") from e


@contextmanager
def _decimal_points() -> Iterator[None]:
    """Numbers with points, as Bullet must read them: those of a host program may have commas."""
    before = locale.setlocale(locale.LC_NUMERIC)
    locale.setlocale(locale.LC_NUMERIC, "C")
    try:
        yield
    finally:
        locale.setlocale(locale.LC_NUMERIC, before)


def base_to_bullet(
    q: np.ndarray, v: np.ndarray, lever: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pinocchio base state to Bullet's: position [m], orientation x y z w, velocity [m/s] and rate
    [rad/s] of its CoM.

    ``q`` (7,), ``v`` (6,) : pose of the link frame and twist in its own axes, further entries
    unread; ``lever`` (3,) : CoM of the base link in its link frame [m]. Results are in world axes.
    """
    attitude = rotation(q[3:7])
    velocity = attitude @ (v[:3] + pin.skew(v[3:6]) @ lever)
    return q[:3] + attitude @ lever, q[3:7].copy(), velocity, attitude @ v[3:6]


class BulletEngine(Engine):
    """PyBullet behind the interface of :class:`.engine.Engine`."""

    name = "bullet"
    title = "PyBullet"
    known: ClassVar = {"hard": HARD, "usual": Contact()}
    contact: Contact
    _client: int | None = None

    def _build(self, friction: float) -> None:
        self._client = bullet.connect(bullet.DIRECT)
        self._bullet = _Client(self._client)
        self._bullet.setGravity(0, 0, -self.robot.gravity)
        self._bullet.setPhysicsEngineParameter(
            fixedTimeStep=STEP_S,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
            **self.contact.options,
        )
        pairs = zip(self.scene.boxes(), self.scene.blocks, strict=True)
        self._ground = [self._add_block(*box, block.soft_m) for box, block in pairs]
        self._body = load_urdf(
            self.robot.urdf, self.robot.name, self._client, bullet.URDF_USE_SELF_COLLISION
        )
        self._index_links()
        self._set_dynamics(friction)
        # Bullet's own motors hold every joint until they are told not to
        for joint in self._joints:
            self._bullet.setJointMotorControl2(
                self._body, joint, bullet.VELOCITY_CONTROL, force=0.0
            )

    def close(self) -> None:
        """Free the engine."""
        if self._client is not None:
            self._bullet.disconnect()
            self._client = None

    def _add_block(
        self, half: np.ndarray, centre: np.ndarray, turn: np.ndarray, soft_m: float
    ) -> int:
        box = self._bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half)
        body = self._bullet.createMultiBody(0, box, basePosition=centre, baseOrientation=turn)
        change = partial(self._bullet.changeDynamics, body, -1)
        change(lateralFriction=GROUND_FRICTION)
        change(restitution=0.0)
        if soft_m:
            stiffness, damping = self.spring(soft_m)
            change(contactStiffness=stiffness, contactDamping=damping)
        return body

    def _index_links(self) -> None:
        count = self._bullet.getNumJoints(self._body)
        info = [self._bullet.getJointInfo(self._body, i) for i in range(count)]
        by_joint = {row[1].decode(): i for i, row in enumerate(info)}
        base = self._bullet.getBodyInfo(self._body)[0].decode()
        self.links = (base, *(row[12].decode() for row in info))  # Bullet's link i is links[i + 1]
        self._joints = [by_joint[name] for name in self.robot.joint_names]
        self._feet = [self.links.index(name) - 1 for name in self.robot.foot.frames]
        lever, tilt = self._bullet.getDynamicsInfo(self._body, -1)[3:5]
        self._lever = np.array(lever)
        self._arm = pin.skew(self._lever)
        self.keeps_m = lever
        if abs(abs(tilt[3]) - 1) > 1e-9:
            raise RobotError(
                f"robot {self.robot.name}: the inertial frame of {base} is turned; "
                "align it with its link"
            )

    def _set_dynamics(self, friction: float) -> None:
        change = partial(self._bullet.changeDynamics, self._body)
        for link in range(-1, len(self.links) - 1):
            still = dict(linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
            change(link, maxJointVelocity=FASTEST, **still)
            change(link, lateralFriction=friction)  # ignored if in the call above
        self._armature = Armature(self.robot)
        self._lent = [(self.links.index(name) - 1, name) for name in self._armature.lent]
        self.late_armature = bool(self._lent)
        for link, name in self._lent:
            inertia = self._bullet.getDynamicsInfo(self._body, link)[2]
            change(link, localInertiaDiagonal=[x + self._armature.lent[name] for x in inertia])

    def _place(self, q: np.ndarray, v: np.ndarray) -> None:
        self._friction = Friction(self.robot, q)
        self._torque = np.zeros(len(self._joints))
        position, quaternion, velocity, rate = base_to_bullet(q, v, self._lever)
        self._bullet.resetBasePositionAndOrientation(self._body, position, quaternion)
        self._bullet.resetBaseVelocity(self._body, velocity, rate)
        for joint, angle, speed in zip(self._joints, q[7:], v[6:], strict=True):
            self._bullet.resetJointState(self._body, joint, float(angle), float(speed))

    def _tangled(self, angles: np.ndarray) -> bool:
        self._bullet.resetBasePositionAndOrientation(
            self._body, [0.0, 0.0, REACH_M], [0.0, 0.0, 0.0, 1.0]
        )
        for joint, angle in zip(self._joints, angles, strict=True):
            self._bullet.resetJointState(self._body, joint, angle)
        self._bullet.performCollisionDetection()
        return bool(self._bullet.getContactPoints(bodyA=self._body, bodyB=self._body))

    def kept(self) -> Kept:
        """Quantities that the engine really has; damping, armature and friction of the motors come
        in :meth:`step`, and the inertia that links are lent is given back there.
        """
        rows = {
            link: self._bullet.getDynamicsInfo(self._body, i)
            for i, link in enumerate(self.links, -1)
        }
        inertials = {link: inertial(r[0], r[3], r[4], r[2]) for link, r in rows.items()}
        for link, more in self._armature.lent.items():
            inertials[link] -= pin.Inertia(0.0, np.zeros(3), more * np.eye(3))
        world = self._bullet.getPhysicsEngineParameters()
        joints = [self._bullet.getJointInfo(self._body, joint) for joint in self._joints]
        return Kept(
            inertials,
            friction={link: row[1] for link, row in rows.items()},
            ground_friction=[self._bullet.getDynamicsInfo(x, -1)[1] for x in self._ground],
            damping=max(max(row[6:8]) for row in joints),
            gravity=[world[f"gravityAcceleration{axis}"] for axis in "XYZ"],
        )

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        place, turn = self._bullet.getBasePositionAndOrientation(self._body)
        twist = self._bullet.getBaseVelocity(self._body)
        angles, rates, *_ = zip(*self._bullet.getJointStates(self._body, self._joints), strict=True)
        attitude = rotation(turn)
        q = np.array([*place, *turn, *angles])
        v = np.array([*twist[0], *twist[1], *rates])
        # the inverse of :func:`base_to_bullet`
        q[:3] -= attitude @ self._lever
        v[:6] = (v[:6].reshape(2, 3) @ attitude).ravel()
        v[:3] += self._arm @ v[3:6]
        return q, v

    def set_torque(self, tau: np.ndarray) -> None:
        """Torque of every joint for the next step [N m]."""
        self._torque = np.array(tau, float)

    def push(self, force: np.ndarray, place: np.ndarray) -> None:
        """External force (3,) for the next step, world axes, at ``place`` (3,) in the base link's
        frame [N, m].
        """
        origin, turn = self._bullet.getBasePositionAndOrientation(self._body)
        point = np.array(origin) + rotation(turn) @ (place - self._lever)
        self._bullet.applyExternalForce(self._body, -1, force, point, bullet.WORLD_FRAME)

    def _advance(self) -> None:
        tau = self._torque
        if self.robot.limits.lossy or self._lent:
            q, v = self.state()
            tau = tau - self._friction.torque(v[6:])
            returned = self._armature.returned(q, v)
            tau += returned[6:]
            moment = rotation(q[3:7]) @ returned[3:6]
            self._bullet.applyExternalTorque(self._body, -1, moment, bullet.WORLD_FRAME)
        self._bullet.setJointMotorControlArray(
            self._body, self._joints, bullet.TORQUE_CONTROL, forces=tau.tolist()
        )
        self._bullet.stepSimulation()
        self._note()

    def applied(self) -> np.ndarray:
        """Torque that the motors gave in the last step (nv - 6,) [N m], as they were told: PyBullet
        reports those of its own only."""
        return self._torque

    def _note(self) -> None:
        """Note all points on which ground presses, and where the feet are."""
        # of a row: body and link that it touches, place, normal, pressure, friction along two axes
        rows = [row for row in self._bullet.getContactPoints(bodyA=self._body) if row[9] > 0]
        points = [
            (row[3], row[9], row[10], row[12], *row[5], *row[7], *row[11], *row[13])
            for row in rows
            if row[2] != self._body
        ]
        self.fallen = any(point[0] not in self._feet for point in points)
        if not points:
            self._notes.append((NOTHING, bool(rows), NOWHERE))
            return
        states = [self._bullet.getLinkState(self._body, foot) for foot in self._feet]
        feet = np.array([state[4] + state[5] for state in states])
        self._notes.append((np.array(points), len(points) < len(rows), feet))

    def _pressed(self, notes: list[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        step, link, arm, force, _ = self._presses(notes)
        wrench = np.zeros((len(notes), 2, 6))
        pushes = np.hstack([force, moments(arm, force)])
        on_foot, side = np.nonzero(link[:, None] == self._feet)
        np.add.at(wrench, (step[on_foot], side), pushes[on_foot])
        touching = np.zeros((len(notes), len(self.links)), bool)
        touching[step, link + 1] = True
        return wrench, touching, np.array([note[1] for note in notes])

    def _presses(self, notes: list[tuple[Any, ...]]) -> tuple[np.ndarray, ...]:
        """Of all k points that were noted: step, link, place (k, 3) from the foot, force (k, 3) and
        the foot's attitude (k, 4); the right foot's where the link is none.
        """
        points, _, feet = zip(*notes, strict=True)
        step = np.repeat(np.arange(len(notes)), [len(x) for x in points])
        points = np.concatenate(points)
        link = points[:, 0].astype(int)
        foot = np.array(feet)[step, (link != self._feet[0]).astype(int)]
        axes = points[:, 7:].reshape(-1, 3, 3)
        force = (points[:, None, 1:4] @ axes)[:, 0]
        return step, link, points[:, 4:7] - foot[:, :3], force, foot[:, 3:]

    def _sole_points(self) -> np.ndarray:
        if not self._notes:
            return np.zeros((0, 3))
        _, link, arm, _, attitude = self._presses(self._notes)
        there = (arm[:, None] @ rotations(attitude))[:, 0]
        return there[np.isin(link, self._feet)]
