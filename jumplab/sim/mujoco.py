"""MuJoCo as an engine: the same boxes and the same robot, over contacts that give way by a hair."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.sim import STEP_S
from jumplab.sim.engine import Engine
from jumplab.sim.kinematics import inertial, rotation
from jumplab.sim.scene import REACH_M, Contacts


@dataclass(frozen=True)
class Softness:
    """How a contact gives way; MuJoCo's names are those of its solref and solimp."""

    time_s: float = 0.001  # [s] a penetration fades; of the engine's steps it takes four, with two feet would bounce
    damping_ratio: float = 1.0  # [1] nothing bounces
    # [1] share of a contact's acceleration that is held off, at the surface and ``depth_m`` below. MuJoCo's contacts do
    # not see what turning legs add to it (J' v): a share of 0.95 at the surface lets loaded toes lift off and fall back
    impedance: tuple[float, float] = (0.5, 0.95)
    depth_m: float = 1e-4  # [m] as deep as feet stand in Bullet's ground


SOFTNESS = Softness()  # as hard as Bullet's ground: in launch, toes sink by 0.1 mm and slip by less than 1 mm
SUBSTEPS = 4  # of 0.25 ms: one of 1 ms would make feet creep, and jumps 1 to 4 cm shorter
SOFT_CONE_RATIO = 1000.0  # the same on soft ground, whose pressure gives way by far more
CONE_RATIO = 10.0  # [1] impedance of friction over that of pressure; at 1, feet creep under load
ITERATIONS, TOLERANCE = 100, 1e-12  # of the constraint solver; it takes five, and the check of forces sees the rest
THREE = np.arange(3)  # a contact's forces: pressure, then friction along two axes
MOTOR = "damping", "armature", "friction"  # of a motor, as the engine has them
FIRST = 1  # geoms of the robot have it, the ground's have 0: the robot's friction coefficient is the effective one
SOFT_FIRST, SOFT_SHARE = 2, 0.1  # geoms of soft ground have it; small shares of acceleration make a plain spring


class MujocoEngine(Engine):
    """MuJoCo behind the interface of :class:`.engine.Engine`; ``softness`` may be set on the class for a study."""

    name, title, substeps = "mujoco", "MuJoCo", SUBSTEPS
    softness = SOFTNESS

    def _build(self, friction: float) -> None:
        spec = self._read()
        option = spec.option
        option.timestep, option.gravity = STEP_S / SUBSTEPS, [0.0, 0.0, -self.robot.gravity]
        option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio, option.iterations, option.tolerance = CONE_RATIO, ITERATIONS, TOLERANCE
        for geom in spec.geoms:
            geom.friction, geom.priority = [friction, 0.0, 0.0], FIRST
        for half, centre, turn in self.scene.boxes():
            how = dict(size=half, pos=centre, quat=np.roll(turn, 1), friction=[1.0, 0.0, 0.0])
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **how)
        for geom in spec.geoms:
            geom.condim, geom.margin = 3, 0.0
            geom.solref = [self.softness.time_s, self.softness.damping_ratio]
            geom.solimp = [*self.softness.impedance, self.softness.depth_m, 0.5, 2.0]
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._model.jnt_solref[:] = [self.softness.time_s, self.softness.damping_ratio]
        self._index_links()
        self._soften(friction)

    def _motors(self) -> tuple[np.ndarray, ...]:
        """Damping, armature and dry friction (nv,) of the engine's joints, to be written to: as :data:`MOTOR`."""
        return self._model.dof_damping, self._model.dof_armature, self._model.dof_frictionloss

    def _soften(self, friction: float) -> None:
        """Make springs of soft blocks, which then decide their contacts, friction included.

        A contact's force is share / (1 - share) / inverse mass times its reference acceleration, -b v - k r. The
        inverse mass is the engine's own of a foot: under other links the ground is as much harder as they are heavier.
        """
        model = self._model
        inverse = float(np.mean([model.body_invweight0[body, 0] for body in self._feet]))
        for geom, block in zip(np.flatnonzero(model.geom_bodyid == 0), self.scene.blocks, strict=True):
            if block.soft_m:
                k, b = np.array(self.spring(block.soft_m)) * inverse * (1 - SOFT_SHARE) / SOFT_SHARE
                model.geom_solref[geom] = [-k * SOFT_SHARE, -b * SOFT_SHARE]  # by which the engine divides
                model.geom_solimp[geom, :2] = SOFT_SHARE
                model.geom_priority[geom], model.geom_friction[geom, 0] = SOFT_FIRST, friction
                model.opt.impratio = SOFT_CONE_RATIO

    def _read(self) -> mujoco.MjSpec:
        """The robot's URDF, its base free, every link kept, none of its pictures."""
        try:
            spec = mujoco.MjSpec.from_string(self.robot.urdf)
            spec.compiler.fusestatic, spec.compiler.discardvisual = False, True
            base = spec.worldbody.first_body()
            if base is None:
                raise ValueError("it has no body of its own")
            base.add_freejoint()
            spec.copy().compile()
        except ValueError as e:
            said = " ".join(str(e).split())
            raise RobotError(f"robot {self.robot.name}: MuJoCo cannot read the URDF: {said}") from e
        return spec

    def _index_links(self) -> None:
        model = self._model
        self.links = tuple(model.body(i).name for i in range(1, model.nbody))  # body i is links[i - 1]
        joints = [model.joint(name) for name in self.robot.joint_names]
        self._angles = np.array([joint.qposadr[0] for joint in joints])
        self._rates = np.array([joint.dofadr[0] for joint in joints])
        rows = [self.robot.actuators[name] for name in self.robot.joint_names]
        self._stated = [np.zeros(model.nv) for _ in MOTOR]
        for own, stated, key in zip(self._motors(), self._stated, MOTOR, strict=True):
            stated[self._rates] = [row[key] for row in rows]
            own[:] = stated
        self._feet = {model.body(name).id: side for side, name in enumerate(self.robot.foot.frames)}
        self._torque = np.zeros(len(joints))
        self._wrench, self._touching, self._colliding = np.zeros((2, 6)), set(), set()

    def close(self) -> None:
        """Free the engine."""
        self._data = self._model = None

    def _tangled(self, angles: np.ndarray) -> bool:
        data = mujoco.MjData(self._model)
        data.qpos[2], data.qpos[self._angles] = REACH_M, angles
        mujoco.mj_forward(self._model, data)
        return bool(data.ncon)

    def _place(self, q: np.ndarray, v: np.ndarray) -> None:
        data = self._data
        data.qpos[:3], data.qpos[3:7], data.qpos[self._angles] = q[:3], q[[6, 3, 4, 5]], q[7:]
        data.qvel[:3], data.qvel[3:6], data.qvel[self._rates] = rotation(q[3:7]) @ v[:3], v[3:6], v[6:]

    @property
    def inertials(self) -> dict[str, pin.Inertia]:
        """Mass, centre of mass and inertia of every link, in its frame, as the engine has them."""
        has = self._model
        rows = zip(has.body_mass, has.body_ipos, has.body_iquat[:, [1, 2, 3, 0]], has.body_inertia, strict=True)
        return dict(zip(self.links, (inertial(*row) for row in list(rows)[1:]), strict=True))

    @property
    def gravity(self) -> list[float]:
        """Gravity (3,) as the engine has it [m/s^2]."""
        return self._model.opt.gravity.tolist()

    @property
    def friction(self) -> dict[str, float]:
        """Friction coefficient between every link that can touch, and the ground, as the engine has it."""
        robot = np.flatnonzero(self._model.geom_bodyid)
        links = (self.links[self._model.geom_bodyid[geom] - 1] for geom in robot)
        return {link: float(max(self._between(geom))) for link, geom in zip(links, robot, strict=True)}

    def _between(self, geom: int) -> np.ndarray:
        """Friction coefficients between a geom of the robot and every block of the scene: the higher rank decides."""
        rank, own = self._model.geom_priority, self._model.geom_friction[:, 0]
        ground = np.flatnonzero(self._model.geom_bodyid == 0)
        ours = np.where(rank[ground] > rank[geom], own[ground], own[geom])
        return np.where(rank[ground] == rank[geom], np.maximum(own[ground], own[geom]), ours)

    @property
    def ground_friction(self) -> list[float]:
        """What every block of the scene makes of a foot's friction coefficient, as the engine has it [1]."""
        foot = int(np.flatnonzero(np.isin(self._model.geom_bodyid, list(self._feet)))[0])
        return (self._between(foot) / self._model.geom_friction[foot, 0]).tolist()

    @property
    def damping(self) -> float:
        """Largest difference of a joint's damping, armature or dry friction from the stated, in SI units."""
        pairs = zip(self._motors(), self._stated, strict=True)
        return float(max(np.abs(x - stated).max() for x, stated in pairs))

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """True configuration (nq,) and velocity (nv,) in Pinocchio's conventions."""
        position, quaternion = self._data.qpos[:3], self._data.qpos[[4, 5, 6, 3]]
        velocity, rate = rotation(quaternion).T @ self._data.qvel[:3], self._data.qvel[3:6]
        return (
            np.concatenate([position, quaternion, self._data.qpos[self._angles]]),
            np.concatenate([velocity, rate, self._data.qvel[self._rates]]),
        )

    def set_torque(self, tau: np.ndarray) -> None:
        """Torque of every joint for the next step [N m]."""
        self._data.qfrc_applied[self._rates] = tau

    def push(self, force: np.ndarray, place: np.ndarray) -> None:
        """External force (3,) for the next step, world axes, at ``place`` (3,) in the base link's frame [N, m]."""
        mujoco.mj_kinematics(self._model, self._data)
        arm = self._data.xpos[1] + self._data.xmat[1].reshape(3, 3) @ place - self._data.xipos[1]
        self._data.xfrc_applied[1] = [*force, *np.cross(arm, force)]

    def applied(self) -> np.ndarray:
        """Torque (nv - 6,) that acted in the last step [N m]."""
        return self._torque

    def step(self) -> None:
        """Advance by :data:`jumplab.sim.STEP_S`."""
        self._wrench, self._touching, self._colliding = np.zeros((2, 6)), set(), set()
        mujoco.mj_kinematics(self._model, self._data)
        origins = self._data.xpos.copy()
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self._model, self._data)
            self._feel(origins)
        self._torque = self._data.qfrc_applied[self._rates].copy()
        self._data.xfrc_applied[1] = 0.0

    def contacts(self) -> Contacts:
        """Mean forces of the ground on the feet, and all that touched, in the last step."""
        return Contacts(self._wrench / SUBSTEPS, frozenset(self._touching), frozenset(self._colliding))

    def _feel(self, origins: np.ndarray) -> None:
        """Add the contacts of one substep; moments are about the links' ``origins`` (k, 3) before the step."""
        data, contact = self._data, self._data.contact
        acting = np.flatnonzero(contact.efc_address >= 0)
        if not len(acting):
            return
        force = data.efc_force[contact.efc_address[acting, None] + THREE]  # along the axes of the contact's frame
        pairs, places = self._model.geom_bodyid[contact.geom[acting]], contact.pos[acting]
        pushes = np.einsum("ki,kij->kj", force, contact.frame[acting].reshape(-1, 3, 3))
        points, depths = ([], []), contact.dist[acting, None] / 2 * contact.frame[acting].reshape(-1, 3, 3)[:, 0]
        for k, (one, other) in enumerate(pairs.tolist()):
            if force[k, 0] <= 0:
                continue
            if one and other:
                self._colliding.add((self.links[one - 1], self.links[other - 1]))
                continue
            body = other or one
            self._touching.add(self.links[body - 1])
            side = self._feet.get(body)
            if side is not None:
                push, place = (pushes[k] if other else -pushes[k]), places[k]
                self._wrench[side, :3] += push
                self._wrench[side, 3:] += pin.skew(place - origins[body]) @ push
                points[side].append(place + depths[k] if other else place - depths[k])  # on the robot's own surface
        for body, side in self._feet.items():
            if points[side]:
                self._note_sole((np.array(points[side]) - data.xpos[body]) @ data.xmat[body].reshape(3, 3))
