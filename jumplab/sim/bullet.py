"""PyBullet as an engine: ground with edges, the robot from its own URDF, contact as stated."""

from __future__ import annotations

import contextlib
import os
import tempfile
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.sim import STEP_S
from jumplab.sim.armature import Armature, Friction
from jumplab.sim.engine import Engine
from jumplab.sim.kinematics import inertial, rotation
from jumplab.sim.scene import REACH_M, Contacts


@dataclass(frozen=True)
class EngineSettings:
    """What the engine is told; the paper prints none of these numbers."""

    solver_iterations: int = 1000  # with 200, what is left unsolved tips the robot sideways by 2.5 mrad
    contact_erp: float = 0.1  # [1] a deep penetration fades in 10 ms; with the default 0.2, feet bounce off an impact
    contact_slop_m: float = 1e-4  # boxes rest this deep; at zero, rounding breaks the contact of a light toe
    ground_friction: float = 1.0  # friction combines as a product: the robot's coefficient is the effective one
    fastest: float = 1e3  # [rad/s] lifts Bullet's silent cap of 100 rad/s


SETTINGS = EngineSettings()


def _import_quietly() -> ModuleType:
    """Import pybullet with file descriptor 2, to which its C code greets, muted for the moment."""
    with contextlib.ExitStack() as undo:
        with contextlib.suppress(OSError):  # no standard error to protect
            keep, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
            undo.callback(os.close, keep)
            undo.callback(os.close, nowhere)
            os.dup2(nowhere, 2)
            undo.callback(os.dup2, keep, 2)
        return import_module("pybullet")


bullet = _import_quietly()


class _Client:
    """The functions and constants of PyBullet, each function for one of its worlds."""

    def __init__(self, number: int):
        self._number = number

    def __getattr__(self, name: str) -> Any:
        value = getattr(bullet, name)
        return partial(value, physicsClientId=self._number) if callable(value) else value


def load_urdf(urdf: str, name: str, client: int, flags: int = 0) -> int:
    """Load the URDF text of robot ``name``, inertias as written there; returns the body's number.

    Raises :class:`RobotError` if PyBullet cannot read it.
    """
    handle, path = tempfile.mkstemp(suffix=".urdf")  # Bullet reads files only
    try:
        with os.fdopen(handle, "w") as file:
            file.write(urdf)
        return bullet.loadURDF(path, flags=flags | bullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client)
    except bullet.error as e:
        raise RobotError(f"robot {name}: PyBullet cannot read the URDF: {e}") from e
    finally:
        with contextlib.suppress(OSError):
            os.remove(path)


def base_to_bullet(
    q: np.ndarray, v: np.ndarray, lever: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pinocchio base state to Bullet's: position [m], orientation x y z w, velocity [m/s] and rate [rad/s] of its CoM.

    ``q`` (7,), ``v`` (6,) : pose of the link frame and twist in its own axes, further entries unread; ``lever`` (3,) :
    CoM of the base link in its link frame [m]. What is returned is in world axes.
    """
    attitude = rotation(q[3:7])
    velocity = attitude @ (v[:3] + pin.skew(v[3:6]) @ lever)
    return q[:3] + attitude @ lever, q[3:7].copy(), velocity, attitude @ v[3:6]


def base_from_bullet(
    position: np.ndarray, quaternion: np.ndarray, velocity: np.ndarray, rate: np.ndarray, lever: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of :func:`base_to_bullet`: base part of Pinocchio's ``q`` (7,) and ``v`` (6,)."""
    attitude = rotation(quaternion)
    local_rate = attitude.T @ rate
    local_velocity = attitude.T @ velocity - pin.skew(local_rate) @ lever
    return np.concatenate([position - attitude @ lever, quaternion]), np.concatenate([local_velocity, local_rate])


class BulletEngine(Engine):
    """PyBullet behind the interface of :class:`.engine.Engine`."""

    name, title = "bullet", "PyBullet"
    _client: int | None = None
    _friction: Friction | None = None  # of the motors, if any is known

    def _build(self, friction: float) -> None:
        self._client = bullet.connect(bullet.DIRECT)
        self._bullet = _Client(self._client)
        self._set_engine()
        pairs = zip(self.scene.boxes(), self.scene.blocks, strict=True)
        self._ground = [self._add_block(*box, block.soft_m) for box, block in pairs]
        self._body = load_urdf(self.robot.urdf, self.robot.name, self._client, bullet.URDF_USE_SELF_COLLISION)
        self._index_links()
        self._set_dynamics(friction)
        for joint in self._joints:  # Bullet's own motors hold every joint until they are told not to
            self._bullet.setJointMotorControl2(self._body, joint, bullet.VELOCITY_CONTROL, force=0.0)

    def close(self) -> None:
        """Free the engine."""
        if self._client is not None:
            self._bullet.disconnect()
            self._client = None

    def _set_engine(self) -> None:
        s = SETTINGS
        contact = dict(contactERP=s.contact_erp, contactSlop=s.contact_slop_m, deterministicOverlappingPairs=1)
        steps = dict(fixedTimeStep=STEP_S, numSubSteps=0, numSolverIterations=s.solver_iterations)
        self._bullet.setGravity(0, 0, -self.robot.gravity)
        self._bullet.setPhysicsEngineParameter(**steps, **contact)

    def _add_block(self, half: np.ndarray, centre: np.ndarray, turn: np.ndarray, soft_m: float) -> int:
        box = self._bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half)
        body = self._bullet.createMultiBody(0, box, basePosition=centre, baseOrientation=turn)
        self._bullet.changeDynamics(body, -1, lateralFriction=SETTINGS.ground_friction)
        self._bullet.changeDynamics(body, -1, restitution=0.0)
        if soft_m:
            stiffness, damping = self.spring(soft_m)
            self._bullet.changeDynamics(body, -1, contactStiffness=stiffness, contactDamping=damping)
        return body

    def _index_links(self) -> None:
        info = [self._bullet.getJointInfo(self._body, i) for i in range(self._bullet.getNumJoints(self._body))]
        by_joint = {row[1].decode(): i for i, row in enumerate(info)}
        base = self._bullet.getBodyInfo(self._body)[0].decode()
        self.links = (base, *(row[12].decode() for row in info))  # Bullet's link i is links[i + 1]
        self._joints = [by_joint[name] for name in self.robot.joint_names]
        self._feet = {self.links.index(name) - 1: side for side, name in enumerate(self.robot.foot.frames)}
        lever, tilt = self._bullet.getDynamicsInfo(self._body, -1)[3:5]
        self._lever = np.array(lever)
        if abs(abs(tilt[3]) - 1) > 1e-9:
            raise RobotError(f"robot {self.robot.name}: the inertial frame of {base} is turned; align it with its link")

    def _dynamics(self) -> list[tuple]:
        return [self._bullet.getDynamicsInfo(self._body, i - 1) for i in range(len(self.links))]

    def _set_dynamics(self, friction: float) -> None:
        change = partial(self._bullet.changeDynamics, self._body)
        for link in range(-1, len(self.links) - 1):
            still = dict(linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, restitution=0.0)
            change(link, maxJointVelocity=SETTINGS.fastest, **still)
            change(link, lateralFriction=friction)  # ignored if in the call above
        self._armature = Armature(self.robot)
        self._lent = [(self.links.index(name) - 1, name) for name in self._armature.lent]
        self.late_armature = bool(self._lent)
        for link, name in self._lent:
            own = self._bullet.getDynamicsInfo(self._body, link)[2]
            change(link, localInertiaDiagonal=[x + self._armature.lent[name] for x in own])

    def _place(self, q: np.ndarray, v: np.ndarray) -> None:
        if self.robot.lossy:
            self._friction = Friction(self.robot, q)
        position, quaternion, velocity, rate = base_to_bullet(q, v, self._lever)
        self._bullet.resetBasePositionAndOrientation(self._body, position, quaternion)
        self._bullet.resetBaseVelocity(self._body, velocity, rate)
        for joint, angle, speed in zip(self._joints, q[7:], v[6:], strict=True):
            self._bullet.resetJointState(self._body, joint, float(angle), float(speed))

    def _tangled(self, angles: np.ndarray) -> bool:
        self._bullet.resetBasePositionAndOrientation(self._body, [0.0, 0.0, REACH_M], [0.0, 0.0, 0.0, 1.0])
        for joint, angle in zip(self._joints, angles, strict=True):
            self._bullet.resetJointState(self._body, joint, angle)
        self._bullet.performCollisionDetection()
        return bool(self._bullet.getContactPoints(bodyA=self._body, bodyB=self._body))

    @property
    def inertials(self) -> dict[str, pin.Inertia]:
        """Mass, centre of mass and inertia of every link, in its frame, as the engine has them."""
        found = {k: inertial(r[0], r[3], r[4], r[2]) for k, r in zip(self.links, self._dynamics(), strict=True)}
        for link, more in self._armature.lent.items():  # what was lent is given back in every step
            found[link] = pin.Inertia(found[link].mass, found[link].lever, found[link].inertia - more * np.eye(3))
        return found

    @property
    def gravity(self) -> list[float]:
        """Gravity (3,) as the engine has it [m/s^2]."""
        return [self._bullet.getPhysicsEngineParameters()[f"gravityAcceleration{axis}"] for axis in "XYZ"]

    @property
    def friction(self) -> dict[str, float]:
        """Friction coefficient of every link as the engine has it."""
        return {name: row[1] for name, row in zip(self.links, self._dynamics(), strict=True)}

    @property
    def ground_friction(self) -> list[float]:
        """Friction coefficient of every block of the scene as the engine has it."""
        return [self._bullet.getDynamicsInfo(block, -1)[1] for block in self._ground]

    @property
    def damping(self) -> float:
        """Largest damping or dry friction of a joint as the engine has it, in SI units: those of motors come in
        :meth:`step`."""
        rows = (self._bullet.getJointInfo(self._body, joint) for joint in self._joints)
        return max(max(row[6:8]) for row in rows)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """True configuration (nq,) and velocity (nv,) in Pinocchio's conventions."""
        pose = self._bullet.getBasePositionAndOrientation(self._body)
        twist = self._bullet.getBaseVelocity(self._body)
        base_q, base_v = base_from_bullet(*(np.array(x) for x in (*pose, *twist)), self._lever)
        joints = np.array([row[:2] for row in self._bullet.getJointStates(self._body, self._joints)])
        return np.concatenate([base_q, joints[:, 0]]), np.concatenate([base_v, joints[:, 1]])

    def set_torque(self, tau: np.ndarray) -> None:
        """Torque of every joint for the next step [N m]."""
        self._torque = np.array(tau, float)
        if self._friction is None:
            self._drive(self._torque)

    def _drive(self, tau: np.ndarray) -> None:
        self._bullet.setJointMotorControlArray(self._body, self._joints, bullet.TORQUE_CONTROL, forces=tau)

    def push(self, force: np.ndarray, place: np.ndarray) -> None:
        """External force (3,) for the next step, world axes, at ``place`` (3,) in the base link's frame [N, m]."""
        origin, turn = self._bullet.getBasePositionAndOrientation(self._body)
        point = np.array(origin) + rotation(turn) @ (place - self._lever)
        self._bullet.applyExternalForce(self._body, -1, force, point, bullet.WORLD_FRAME)

    def step(self) -> None:
        """Advance by :data:`jumplab.sim.STEP_S`."""
        if self._friction is not None or self._lent:
            self._add_motors()
        self._bullet.stepSimulation()

    def _add_motors(self) -> None:
        """What armature and friction of the motors do in this step."""
        q, v = self.state()
        if self._friction is not None:
            self._drive(self._torque - self._friction.torque(v[6:]))
        if self._lent:
            returned = self._armature.returned(q, v)
            for link, name in self._lent:
                self._bullet.applyExternalTorque(self._body, link, returned[name], bullet.WORLD_FRAME)

    def applied(self) -> np.ndarray:
        """Torque that the motors gave in the last step (nv - 6,) [N m], as they were told: PyBullet reports those of
        its own only."""
        return self._torque

    def contacts(self) -> Contacts:
        """Ground forces on the feet and all touching links, from the last step."""
        wrench, touching, colliding, points = np.zeros((2, 6)), set(), set(), ([], [])
        for row in self._bullet.getContactPoints(bodyA=self._body):
            body_b, link_a, link_b, normal_force = row[2], row[3], row[4], row[9]
            if normal_force <= 0:
                continue
            if body_b == self._body:
                colliding.add((self.links[link_a + 1], self.links[link_b + 1]))
                continue
            touching.add(self.links[link_a + 1])
            side = self._feet.get(link_a)
            if side is not None:
                force = np.array((row[7], row[11], row[13])).T @ (normal_force, row[10], row[12])
                wrench[side, :3] += force
                wrench[side, 3:] += pin.skew(np.array(row[5])) @ force
                points[side].append(row[5])
        for link, side in self._feet.items():
            if points[side]:
                state = self._bullet.getLinkState(self._body, link)
                origin = np.array(state[4])
                wrench[side, 3:] -= pin.skew(origin) @ wrench[side, :3]
                self._note_sole((np.array(points[side]) - origin) @ rotation(state[5]))
        return Contacts(wrench, frozenset(touching), frozenset(colliding))
