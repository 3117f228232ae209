"""MuJoCo as an engine: the same boxes and the same robot, over contacts that give way by a hair."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import mujoco
import numpy as np

from jumplab.control.kinematics import rotation
from jumplab.errors import RobotError
from jumplab.sim import STEP_S
from jumplab.sim.engine import Engine, Kept, inertial, moments
from jumplab.sim.scene import REACH_M, Scene

# MuJoCo would write its warnings into a file of the working folder
mujoco.set_mju_user_warning(logging.getLogger(__name__).info)


@dataclass(frozen=True)
class Contact:
    """Contact model: how far contacts give way, and how they stick; defaults are MuJoCo's own, with
    its names in brackets.
    """

    # [s] a penetration fades (solref); of the engine's steps it takes two, with feet four
    time_s: float = 0.02
    damping_ratio: float = 1.0  # [1] nothing bounces (solref)
    # [1] share of a contact's acceleration that is held off, at the surface and ``depth_m`` below
    # (solimp)
    impedance: tuple[float, float] = (0.9, 0.95)
    depth_m: float = 1e-3  # [m] (solimp)
    cone_ratio: float = 1.0  # [1] impedance of friction over that of pressure (impratio)
    elliptic: bool = False  # friction cone; a pyramid within it otherwise (cone)
    substeps: int = 1  # in one step of the simulation (timestep)


# As hard as Bullet's ground: in launch, toes sink by 0.1 mm and slip by less than 1 mm. MuJoCo's
# contacts do not see what turning legs add to their acceleration (J' v): a share of 0.95 at the
# surface lets loaded toes lift off and fall back. At a cone ratio of 1 feet creep under load, with
# one step of 1 ms too, and jumps are 1 to 4 cm shorter
HARD = Contact(
    time_s=0.001,
    impedance=(0.5, 0.95),
    depth_m=1e-4,
    cone_ratio=10.0,
    elliptic=True,
    substeps=4,
)
SOFT_CONE_RATIO = 1000.0  # on soft ground, whose pressure gives way by far more
# of the constraint solver; it takes five, and the check of forces sees the rest
ITERATIONS = 100
TOLERANCE = 1e-12
# of a contact sensor (mjtConDataField, reduction): net force and moment, and where they act; the
# strongest contact's force
NET = (1 << 1 | 1 << 2 | 1 << 4, 3, 1)
STRONGEST = (1 << 1, 2, 1)
# of a motor, as the engine has them
MOTOR = {"damping": "dof_damping", "armature": "dof_armature", "friction": "dof_frictionloss"}
# geoms of the robot have it, the ground's have 0: the robot's friction coefficient is the effective
# one
FIRST = 1
# geoms of soft ground have it; small shares of acceleration make a plain spring
SOFT_FIRST = 2
SOFT_SHARE = 0.1


class MujocoEngine(Engine):
    """MuJoCo behind the interface of :class:`.engine.Engine`."""

    name = "mujoco"
    title = "MuJoCo"
    known: ClassVar = {"hard": HARD, "usual": Contact()}
    contact: Contact

    @classmethod
    def contact_of(cls, contact: Any, scene: Scene | None = None) -> Contact:
        """As of every engine; springs of soft ground need steps as short as those of hard contacts,
        and an elliptic cone at their ratio of friction.
        """
        resolved = super().contact_of(contact)
        if scene and any(block.soft_m for block in scene.blocks):
            return replace(resolved, substeps=max(resolved.substeps, HARD.substeps), elliptic=True)
        return resolved

    def _build(self, friction: float) -> None:
        spec = self._spec()
        contact = self.contact
        option = spec.option
        option.timestep = STEP_S / contact.substeps
        option.gravity = [0.0, 0.0, -self.robot.gravity]
        option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        cone = mujoco.mjtCone
        option.cone = cone.mjCONE_ELLIPTIC if contact.elliptic else cone.mjCONE_PYRAMIDAL
        option.impratio = contact.cone_ratio
        option.iterations = ITERATIONS
        option.tolerance = TOLERANCE
        for geom in spec.geoms:
            geom.friction = [friction, 0.0, 0.0]
            geom.priority = FIRST
        for half, centre, turn in self.scene.boxes():
            box = dict(size=half, pos=centre, quat=np.roll(turn, 1), friction=[1.0, 0.0, 0.0])
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **box)
        for geom in spec.geoms:
            geom.condim = 3
            geom.margin = 0.0
            geom.solref = [contact.time_s, contact.damping_ratio]
            geom.solimp = [*contact.impedance, contact.depth_m, 0.5, 2.0]
        base, *links = [body.name for body in spec.bodies[1:]]
        body, tree = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
        self._sense(spec, tree, base, tree, base, STRONGEST)
        for link in (base, *links):
            self._sense(spec, body, link, body, "world", NET)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        data = self._data
        # views: to ask the engine for one takes as long as to read it
        self._sensed, self._applied = data.sensordata, data.qfrc_applied
        self._places, self._attitudes = data.xpos, data.xmat
        self._model.jnt_solref[:] = [contact.time_s, contact.damping_ratio]
        self._index_links()
        self._soften(friction)

    def _sense(self, spec: mujoco.MjSpec, kind, link: str, other, what: str, says) -> None:
        """A sensor of what links and others do to each other, read in every one of the engine's
        steps.
        """
        sensor = spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = kind, link
        sensor.reftype, sensor.refname = other, what
        sensor.intprm[:3] = says

    def _soften(self, friction: float) -> None:
        """Make springs of soft blocks, which then decide their contacts, friction included.

        A contact's force is share / (1 - share) / inverse mass times its reference acceleration, -b
        v - k r. The inverse mass is the engine's own of a foot: under other links the ground is as
        much harder as they are heavier. Where four points damp a foot by more than all of its speed
        within a step, it would be thrown up: ground is at least as soft as that (0.3 mm).
        """
        model = self._model
        inverse = float(np.mean([model.body_invweight0[body, 0] for body in self._feet]))
        stiffest = self.robot.total_mass * inverse * model.opt.timestep  # [s]
        least_m = self.robot.gravity * stiffest**2
        for geom, block in zip(
            np.flatnonzero(model.geom_bodyid == 0), self.scene.blocks, strict=True
        ):
            if block.soft_m:
                spring = np.array(self.spring(max(block.soft_m, least_m)))
                k, b = spring * inverse * (1 - SOFT_SHARE) / SOFT_SHARE
                # by which the engine divides
                model.geom_solref[geom] = [-k * SOFT_SHARE, -b * SOFT_SHARE]
                model.geom_solimp[geom, :2] = SOFT_SHARE
                model.geom_priority[geom] = SOFT_FIRST
                model.geom_friction[geom, 0] = friction
                model.opt.impratio = SOFT_CONE_RATIO

    def _spec(self) -> mujoco.MjSpec:
        """The robot's URDF, its base free, every link kept, none of its pictures."""
        try:
            spec = mujoco.MjSpec.from_string(self.robot.urdf)
            spec.compiler.fusestatic = False
            spec.compiler.discardvisual = True
            base = spec.worldbody.first_body()
            if base is None:
                raise ValueError("it has no body of its own")
            base.add_freejoint()
            spec.copy().compile()
        except ValueError as e:
            reason = " ".join(str(e).split())
            raise RobotError(
                f"robot {self.robot.name}: MuJoCo cannot read the URDF: {reason}"
            ) from e
        return spec

    def _index_links(self) -> None:
        model = self._model
        # body i is links[i - 1]
        self.links = tuple(model.body(i).name for i in range(1, model.nbody))
        joints = [model.joint(name) for name in self.robot.joint_names]
        # where the engine has what Pinocchio's q and v begin with, and go on with
        self._q = np.array([0, 1, 2, 4, 5, 6, 3, *(joint.qposadr[0] for joint in joints)])
        self._v = np.array([*range(6), *(joint.dofadr[0] for joint in joints)])
        self._motors = self.robot.limits
        for key, there in MOTOR.items():
            getattr(model, there)[self._v[6:]] = getattr(self._motors, key)
        self._feet = np.array([model.body(name).id for name in self.robot.foot.frames])
        self._torque = np.zeros(len(joints))
        self._back = np.zeros(4)  # from the world into the base's axes
        # of the contact sensors in a step: all of them, and forces on links that are no feet
        self._felt = np.zeros((self.contact.substeps, model.nsensordata))
        columns = 3 + np.arange(9 * len(self.links)).reshape(-1, 9)
        self._stray = np.delete(columns, self._feet - 1, axis=0)[:, :3].ravel()

    def close(self) -> None:
        """Free the engine."""
        self._data = self._model = None

    def _tangled(self, angles: np.ndarray) -> bool:
        data = mujoco.MjData(self._model)
        data.qpos[2] = REACH_M
        data.qpos[self._q[7:]] = angles
        mujoco.mj_forward(self._model, data)
        return bool(data.ncon)

    def _place(self, q: np.ndarray, v: np.ndarray) -> None:
        self._data.qpos[self._q] = q
        self._data.qvel[self._v] = v
        self._data.qvel[:3] = rotation(q[3:7]) @ v[:3]

    def kept(self) -> Kept:
        """Quantities that the engine really has; ``ground_friction`` is the factor by which a block
        changes that of a foot.
        """
        has = self._model
        quaternions = has.body_iquat[:, [1, 2, 3, 0]]
        rows = zip(has.body_mass, has.body_ipos, quaternions, has.body_inertia, strict=True)
        bodies = has.geom_bodyid
        robot = np.flatnonzero(bodies)
        foot = int(np.flatnonzero(np.isin(bodies, self._feet))[0])
        motors = [(getattr(has, there), getattr(self._motors, k)) for k, there in MOTOR.items()]
        return Kept(
            dict(zip(self.links, [inertial(*row) for row in rows][1:], strict=True)),
            friction={self.links[bodies[k] - 1]: float(max(self._between(k))) for k in robot},
            ground_friction=(self._between(foot) / has.geom_friction[foot, 0]).tolist(),
            damping=float(max(np.abs(x[self._v[6:]] - due).max() for x, due in motors)),
            gravity=has.opt.gravity.tolist(),
        )

    def _between(self, geom: int) -> np.ndarray:
        """Friction coefficients between a geom of the robot and every block of the scene: the
        higher rank decides.
        """
        rank = self._model.geom_priority
        friction = self._model.geom_friction[:, 0]
        ground = np.flatnonzero(self._model.geom_bodyid == 0)
        ranked = np.where(rank[ground] > rank[geom], friction[ground], friction[geom])
        larger = np.maximum(friction[ground], friction[geom])
        return np.where(rank[ground] == rank[geom], larger, ranked)

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        data = self._data
        v = data.qvel[self._v]
        mujoco.mju_negQuat(self._back, data.qpos[3:7])
        mujoco.mju_rotVecQuat(v[:3], data.qvel[:3], self._back)
        return data.qpos[self._q], v

    def set_torque(self, tau: np.ndarray) -> None:
        """Torque of every joint for the next step [N m]."""
        self._applied[self._v[6:]] = tau

    def push(self, force: np.ndarray, place: np.ndarray) -> None:
        """External force (3,) for the next step, world axes, at ``place`` (3,) in the base link's
        frame [N, m].
        """
        mujoco.mj_kinematics(self._model, self._data)
        arm = self._data.xpos[1] + self._data.xmat[1].reshape(3, 3) @ place - self._data.xipos[1]
        self._data.xfrc_applied[1] = [*force, *np.cross(arm, force)]

    def applied(self) -> np.ndarray:
        """Torque (nv - 6,) that acted in the last step [N m]."""
        return self._torque

    def _advance(self) -> None:
        data = self._data
        for substep in range(self.contact.substeps):
            mujoco.mj_step(self._model, data)
            if substep == 0:
                origins = self._places[self._feet]
            self._felt[substep] = self._sensed
        self._torque = self._applied[self._v[6:]]
        data.xfrc_applied[1] = 0.0
        felt = self._felt.copy()
        met = None
        if data.ncon:
            has = data.contact
            feet = self._places[self._feet], self._attitudes[self._feet]
            met = has.geom.copy(), has.pos.copy(), has.frame.copy(), has.dist.copy(), *feet
        # a link that lies on the ground is still there at the end of the step
        self.fallen = met is not None and np.count_nonzero(felt[:, self._stray]) > 0
        self._notes.append((felt, origins, met))

    def _pressed(self, notes: list[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Forces are means over a step; moments are about where the feet were before it."""
        felt, origins = (np.array([note[k] for note in notes]) for k in range(2))
        # by step, the engine's own one and link: force and moment on the ground, where they act
        links = felt[:, :, 3:].reshape(*felt.shape[:2], -1, 3, 3)
        on_feet = links[:, :, self._feet - 1]
        total = on_feet[..., :2, :].sum(axis=1)
        arms = on_feet[..., 2, :] - origins[:, None]
        total[..., 1, :] += moments(arms, on_feet[..., 0, :]).sum(axis=1)
        wrench = (total / -felt.shape[1]).reshape(-1, 2, 6)
        return wrench, links[..., 0, :].any(axis=(1, 3)), felt[:, :, :3].any(axis=(1, 2))

    def _sole_points(self) -> np.ndarray:
        met = [note[2] for note in self._notes if note[2] is not None]
        if not met:
            return np.zeros((0, 3))
        *contacts, origins, turns = zip(*met, strict=True)
        geoms, place, frame, depth = map(np.concatenate, contacts)
        step = np.repeat(np.arange(len(met)), [len(x) for x in contacts[0]])
        pairs = self._model.geom_bodyid[geoms]
        body = pairs.max(axis=1)
        side = (body == self._feet[1]).astype(int)
        # a contact's place is in the middle of its depth, its axis leads to the second body
        half = np.where(pairs[:, 1] == body, 0.5, -0.5) * depth
        arm = place + half[:, None] * frame[:, :3] - np.array(origins)[step, side]
        turn = np.array(turns)[step, side].reshape(-1, 3, 3)
        on_foot = np.isin(body, self._feet) & (pairs.min(axis=1) == 0)
        return (arm[:, None, :] @ turn)[on_foot, 0]
