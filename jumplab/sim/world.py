"""The PyBullet world: ground with edges, the robot from its own URDF, honest contact, honest actuators.

The step is 1 ms, the paper's control cycle, without substeps. Everything outside this file speaks Pinocchio: ``q`` and
``v`` of the base *link* frame and the joints in Pinocchio's order.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import pinocchio as pin

from jumplab.errors import JumplabError, RobotError
from jumplab.robot import Robot
from jumplab.sim.perturbation import FRICTION
from jumplab.sim.scene import REACH_M, Scene
from jumplab.task import GRAVITY


# engine ------------------------------------------------------------------------------------------
def _import_quietly() -> ModuleType:
    """Import pybullet with file descriptor 2, to which its C code greets, muted for the moment."""
    try:
        keep, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # no standard error to protect
        import pybullet

        return pybullet
    try:
        os.dup2(nowhere, 2)
        import pybullet
    finally:
        os.dup2(keep, 2)
        os.close(keep)
        os.close(nowhere)
    return pybullet


bullet = _import_quietly()


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


# world ------------------------------------------------------------------------------------------
STEP_S = 0.001  # paper, Sec. VI-A: control cycle 1 ms
SOLVER_ITERATIONS = 1000  # our choice: with 200, what is left unsolved tips the robot sideways by 2.5 mrad
CONTACT_ERP = 0.1  # our choice: a deep penetration fades in 10 ms; the default 0.2 makes feet bounce off an impact
CONTACT_SLOP_M = 1e-4  # our choice: boxes rest this deep; at zero, rounding would break the contact of a light toe
GROUND_FRICTION = 1.0  # friction combines as a product, so the robot's own coefficient is the effective one
TANGLES = 20  # our choice: postures tried until links are in each other; for a humanoid the first one does
UNLIMITED_RATE = 1e3  # [rad/s] lifts Bullet's silent cap of 100 rad/s


@dataclass(frozen=True)
class Contacts:
    """What touched in the last step.

    Attributes
    ----------
    wrench : (2, 6) force and moment on each foot from the ground, world axes, at the origin of the foot link [N, N m].
    touching : names of the robot's links that press on the ground.
    colliding : pairs of the robot's links that press on each other.
    """

    wrench: np.ndarray
    touching: frozenset[str]
    colliding: frozenset[tuple[str, str]]


def base_to_bullet(
    q: np.ndarray, v: np.ndarray, lever: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pinocchio base state to Bullet's: position and orientation of the base's CoM, world velocity of it, world rate.

    Parameters
    ----------
    q, v : configuration and velocity, of which the first 7 and 6 entries are read (link frame, twist in its own axes).
    lever : (3,) CoM of the base link in its link frame [m].

    Returns
    -------
    (3,) position [m], (4,) quaternion x y z w, (3,) velocity [m/s], (3,) angular velocity [rad/s], all in the world.
    """
    rotation = pin.Quaternion(q[6], q[3], q[4], q[5]).toRotationMatrix()
    velocity = rotation @ (v[:3] + pin.skew(v[3:6]) @ lever)
    return q[:3] + rotation @ lever, q[3:7].copy(), velocity, rotation @ v[3:6]


def base_from_bullet(
    position: np.ndarray, quaternion: np.ndarray, velocity: np.ndarray, rate: np.ndarray, lever: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of :func:`base_to_bullet`: base part of Pinocchio's ``q`` (7,) and ``v`` (6,)."""
    x, y, z, w = quaternion
    rotation = pin.Quaternion(w, x, y, z).toRotationMatrix()
    local_rate = rotation.T @ rate
    local_velocity = rotation.T @ velocity - pin.skew(local_rate) @ lever
    return np.concatenate([position - rotation @ lever, quaternion]), np.concatenate([local_velocity, local_rate])


class World:
    """A robot in a scene. Use as a context manager, or call :meth:`close`.

    Parameters
    ----------
    robot : the robot as it really is (perturbed, if at all).
    q, v : initial configuration (nq,) and velocity (nv,), rest if ``v`` is None. Set once; nothing is ever reset.
    friction : effective coefficient between robot and ground.

    Raises
    ------
    JumplabError
        If the engine's masses, damping or friction, read back, are not what was asked for.
    """

    def __init__(self, robot: Robot, q: np.ndarray, v=None, *, scene: Scene | None = None, friction: float = FRICTION):
        self.robot, self.scene, self._beyond_sole = robot, scene or Scene.flat(), 0.0
        self._client = bullet.connect(bullet.DIRECT)
        try:
            self._engine_settings()
            self._ground = [self._add_block(b) for b in self.scene.blocks]
            self._body = self._load(robot.urdf)
            self._index_links()
            self._set_dynamics(friction)
            self._motors_off()
            self._solid = self._feels_itself()
            self._place(np.asarray(q, float), np.zeros(robot.model.nv) if v is None else np.asarray(v, float))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> World:
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def close(self) -> None:
        """Free the engine."""
        if self._client is not None:
            bullet.disconnect(physicsClientId=self._client)
            self._client = None

    # building --------------------------------------------------------------------------------------------------

    def _engine_settings(self) -> None:
        bullet.setGravity(0, 0, -GRAVITY, physicsClientId=self._client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=STEP_S, numSubSteps=0, numSolverIterations=SOLVER_ITERATIONS, contactERP=CONTACT_ERP,
            contactSlop=CONTACT_SLOP_M, deterministicOverlappingPairs=1, physicsClientId=self._client)  # fmt: skip

    def _add_block(self, block) -> int:
        half = [(block.x_to - block.x_from) / 2, REACH_M, block.thickness / 2]
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client)
        centre = [(block.x_from + block.x_to) / 2, 0, block.top - block.thickness / 2]
        body = bullet.createMultiBody(0, shape, basePosition=centre, physicsClientId=self._client)
        bullet.changeDynamics(body, -1, lateralFriction=GROUND_FRICTION, physicsClientId=self._client)
        bullet.changeDynamics(body, -1, restitution=0.0, physicsClientId=self._client)
        return body

    def _load(self, urdf: str) -> int:
        return load_urdf(urdf, self.robot.name, self._client, bullet.URDF_USE_SELF_COLLISION)

    def _index_links(self) -> None:
        count = bullet.getNumJoints(self._body, physicsClientId=self._client)
        info = [bullet.getJointInfo(self._body, i, physicsClientId=self._client) for i in range(count)]
        by_joint = {row[1].decode(): i for i, row in enumerate(info)}
        base = bullet.getBodyInfo(self._body, physicsClientId=self._client)[0].decode()
        self.links = (base, *(row[12].decode() for row in info))  # Bullet's link i is links[i + 1]
        self._joints = [by_joint[name] for name in self.robot.joint_names]
        self._feet = {self.links.index(name) - 1: side for side, name in enumerate(self.robot.foot.frames)}
        dynamics = bullet.getDynamicsInfo(self._body, -1, physicsClientId=self._client)
        self._lever, tilt = np.array(dynamics[3]), dynamics[4]
        if abs(abs(tilt[3]) - 1) > 1e-9:
            raise RobotError(f"robot {self.robot.name}: the inertial frame of {base} is turned; align it with its link")

    def _set_dynamics(self, friction: float) -> None:
        client, links = {"physicsClientId": self._client}, range(-1, len(self.links) - 1)
        for link in links:
            bullet.changeDynamics(
                self._body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0,
                maxJointVelocity=UNLIMITED_RATE, restitution=0.0, **client)  # fmt: skip
            bullet.changeDynamics(self._body, link, lateralFriction=friction, **client)  # ignored if in the call above
        total = 0.0
        for link in links:
            dynamics = bullet.getDynamicsInfo(self._body, link, **client)
            total += dynamics[0]
            if abs(dynamics[1] - friction) > 1e-9:
                name = self.links[link + 1]
                raise JumplabError(f"PyBullet kept friction {dynamics[1]:g} on {name} where {friction:g} was set")
        if abs(total - self.robot.total_mass) > 1e-6:
            raise JumplabError(f"PyBullet's robot weighs {total:.4f} kg, Pinocchio's {self.robot.total_mass:.4f} kg")

    def _motors_off(self) -> None:
        zero = [0.0] * len(self._joints)
        bullet.setJointMotorControlArray(
            self._body, self._joints, bullet.VELOCITY_CONTROL, targetVelocities=zero, forces=zero,
            physicsClientId=self._client)  # fmt: skip

    def _place(self, q: np.ndarray, v: np.ndarray) -> None:
        client = {"physicsClientId": self._client}
        position, quaternion, velocity, rate = base_to_bullet(q, v, self._lever)
        bullet.resetBasePositionAndOrientation(self._body, position, quaternion, **client)
        bullet.resetBaseVelocity(self._body, velocity, rate, **client)
        for joint, angle, speed in zip(self._joints, q[7:], v[6:], strict=True):
            bullet.resetJointState(self._body, joint, float(angle), float(speed), **client)

    def _feels_itself(self) -> bool:
        """Whether the engine notices links in each other: tangles the robot, before it is placed for the run."""
        client, rng = {"physicsClientId": self._client}, np.random.default_rng(0)
        bullet.resetBasePositionAndOrientation(self._body, [0.0, 0.0, REACH_M], [0.0, 0.0, 0.0, 1.0], **client)
        for _ in range(TANGLES):
            for joint, angle in zip(self._joints, rng.uniform(-np.pi, np.pi, len(self._joints)), strict=True):
                bullet.resetJointState(self._body, joint, angle, **client)
            bullet.performCollisionDetection(**client)
            if bullet.getContactPoints(bodyA=self._body, bodyB=self._body, **client):
                return True
        return False

    # running ---------------------------------------------------------------------------------------------------

    @property
    def friction(self) -> dict[str, float]:
        """Friction coefficient of every link as the engine has it."""
        rows = (bullet.getDynamicsInfo(self._body, i - 1, physicsClientId=self._client) for i in range(len(self.links)))
        return {name: row[1] for name, row in zip(self.links, rows, strict=True)}

    def read_back(self) -> dict:
        """What the engine has, not what it was told: effective friction of each foot on each block, the mass [kg],
        whether links collide with each other, and how far beyond the stated sole a foot ever touched [m]."""
        client = {"physicsClientId": self._client}
        ground = [bullet.getDynamicsInfo(block, -1, **client)[1] for block in self._ground]
        feet = [bullet.getDynamicsInfo(self._body, link, **client)[1] for link in self._feet]
        masses = (bullet.getDynamicsInfo(self._body, i - 1, **client)[0] for i in range(len(self.links)))
        friction = sorted({foot * block for foot in feet for block in ground})
        return {"friction": friction, "mass_kg": sum(masses), "self_collision": self._solid,
                "beyond_sole_m": self._beyond_sole}  # fmt: skip

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """True configuration (nq,) and velocity (nv,) in Pinocchio's conventions."""
        client = {"physicsClientId": self._client}
        pose = bullet.getBasePositionAndOrientation(self._body, **client)
        twist = bullet.getBaseVelocity(self._body, **client)
        base_q, base_v = base_from_bullet(*(np.array(x) for x in (*pose, *twist)), self._lever)
        joints = np.array([row[:2] for row in bullet.getJointStates(self._body, self._joints, **client)])
        return np.concatenate([base_q, joints[:, 0]]), np.concatenate([base_v, joints[:, 1]])

    def command_torque(self, tau: np.ndarray) -> None:
        """Torque of every joint for the next step [N m]; the caller clips."""
        bullet.setJointMotorControlArray(self._body, self._joints, bullet.TORQUE_CONTROL, forces=tau.tolist(),
                                         physicsClientId=self._client)  # fmt: skip

    def command_position(
        self, q: np.ndarray, rate: np.ndarray, limit: np.ndarray, position_gain: float, velocity_gain: float
    ) -> None:
        """Position servo of every joint for the next steps: target angle, its rate, largest torque (each (nv - 6,))."""
        n = len(self._joints)
        bullet.setJointMotorControlArray(
            self._body, self._joints, bullet.POSITION_CONTROL, targetPositions=q.tolist(),
            targetVelocities=rate.tolist(), forces=limit.tolist(), positionGains=[position_gain] * n,
            velocityGains=[velocity_gain] * n, physicsClientId=self._client)  # fmt: skip

    def release(self) -> None:
        """Switch the position servos off, before torques are commanded."""
        self._motors_off()

    def step(self) -> None:
        """Advance by :data:`STEP_S`."""
        bullet.stepSimulation(physicsClientId=self._client)

    def servo_torque(self) -> np.ndarray:
        """Torque (nv - 6,) that the position servos gave in the last step [N m]."""
        rows = bullet.getJointStates(self._body, self._joints, physicsClientId=self._client)
        return np.array([row[3] for row in rows])

    def contacts(self) -> Contacts:
        """Ground forces on the feet and all touching links, from the last step."""
        client = {"physicsClientId": self._client}
        wrench, touching, colliding, points = np.zeros((2, 6)), set(), set(), ([], [])
        for row in bullet.getContactPoints(bodyA=self._body, **client):
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
                state = bullet.getLinkState(self._body, link, **client)
                origin = np.array(state[4])
                wrench[side, 3:] -= pin.skew(origin) @ wrench[side, :3]
                self._note_sole(np.array(points[side]) - origin, state[5])
        return Contacts(wrench, frozenset(touching), frozenset(colliding))

    def _note_sole(self, points: np.ndarray, quaternion) -> None:
        """Remember how far contact points (k, 3), from the foot's origin in world axes, lay beyond the stated sole."""
        x, y, z, w = quaternion
        foot, local = self.robot.foot, points @ pin.Quaternion(w, x, y, z).toRotationMatrix()
        side = np.abs(local[:, 1] - foot.center[1]) - foot.half_width
        beyond = max((foot.heel - local[:, 0]).max(), (local[:, 0] - foot.toe).max(), side.max())
        self._beyond_sole = max(self._beyond_sole, float(beyond))
