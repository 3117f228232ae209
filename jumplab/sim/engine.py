"""Interface of physics engines, as the simulation needs it.

A further engine is a class with :class:`Engine`'s methods, a line in :data:`jumplab.sim.ENGINES`,
and passes ``test_sim_world.py``; all else knows no engine.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from jumplab.control.kinematics import rotation
from jumplab.errors import InputError, JumplabError, quoted
from jumplab.robot import Robot
from jumplab.sim import CONTACTS, DEFAULT_ENGINE, ENGINES, INSTALLED
from jumplab.sim.perturbation import FRICTION
from jumplab.sim.scene import Scene

# by how much an engine's mass, and its friction, may differ from what was asked for
MASS_KG = 1e-6
ROUNDING = 1e-9
SOLE_POINTS = 8  # contact points of two flat rectangular soles
NEXT, LAST = np.array([[1, 2, 0], [2, 0, 1]])  # axes
TANGLES = 20  # postures tried until links are in each other; for a humanoid the first one does


class Log(NamedTuple):
    """Steps of a run, a row each: the state before it, and what acted in it."""

    q: np.ndarray  # (n, nq)
    v: np.ndarray  # (n, nv)
    tau: np.ndarray  # (n, nv - 6) of the motors [N m]
    # (n, 2, 6) force and moment on each foot, world axes, at the origin of the foot link [N, N m]
    foot_wrench: np.ndarray
    touching: np.ndarray  # (n, links) which links press on the ground
    colliding: np.ndarray  # (n,) whether links of the robot press on each other

    def some(self, rows: slice) -> Log:
        """Some of its rows (steps)."""
        return Log(*(column[rows] for column in self))


class Kept(NamedTuple):
    """Quantities that an engine really has, which may differ from those that it was given."""

    inertials: dict[str, pin.Inertia]  # of every link, in its frame
    # between every link that can touch, and ground of 1 [1]
    friction: dict[str, float]
    ground_friction: list[float]  # of every block of the scene [1]
    # largest damping, armature or dry friction of a joint, less what the robot's motors have and
    # the engine was told, in SI units; zero is wanted
    damping: float
    gravity: list[float]  # (3,) [m/s^2]

    @property
    def mass_kg(self) -> float:
        """Mass of the robot."""
        return float(sum(link.mass for link in self.inertials.values()))


class Engine(AbstractContextManager):
    """A robot in a scene, advanced in steps of :data:`jumplab.sim.STEP_S`; a context manager.

    Outside of an engine everything is Pinocchio's: ``q`` and ``v`` of the base *link* frame, joints
    in its order.

    Parameters
    ----------
    robot : as it really is, perturbed or not.
    q, v : where it begins, (nq,) and (nv,), at rest if ``v`` is None. Nothing is ever reset.
    friction : effective coefficient between robot and ground [1].
    contact : how contacts give way, one of :data:`jumplab.sim.CONTACTS`, or the engine's own words.

    Raises :class:`RobotError` if the engine cannot read the robot, :class:`JumplabError` if its
    mass or friction, read back, are not what was asked for.
    """

    name: str  # as in :data:`jumplab.sim.ENGINES`
    title: str  # as in sentences
    known: Mapping[str, Any]  # contacts by name, those of :data:`jumplab.sim.CONTACTS`
    contact: Any  # the one of them that this engine has
    # point of the base link whose velocity is kept, from the link's origin and in its axes [m]
    keeps_m: Sequence[float] = (0.0, 0.0, 0.0)
    # whether it has no armature, and that of motors comes by :class:`.armature.Armature`
    late_armature: bool = False
    links: tuple[str, ...]  # names of the robot's links, the base first
    fallen: bool  # whether a link that is no foot touched the ground in the last step

    def __init__(
        self,
        robot: Robot,
        q: np.ndarray,
        v=None,
        *,
        scene: Scene | None = None,
        friction: float = FRICTION,
        contact: str | Any = CONTACTS[0],
    ):
        self.robot = robot
        self._contact_name = contact if isinstance(contact, str) else str(contact)
        self.scene = scene or Scene.flat()
        self.contact = self.contact_of(contact, self.scene)
        self._now: tuple[np.ndarray, np.ndarray] | None = None
        # of each step: state before it and torque in it; and what the engine notes of its contacts
        self._steps: list[tuple[np.ndarray, ...]] = []
        self._notes: list[tuple[Any, ...]] = []
        self.fallen = False
        try:
            self._build(friction)
            self._compare(friction)
            self._solid = self._feels_itself()
            self._place(np.asarray(q, float), np.zeros(robot.model.nv) if v is None else v)
        except BaseException:
            self.close()
            raise

    def __exit__(self, *exc) -> None:
        self.close()

    @classmethod
    def contact_of(cls, contact: Any, scene: Scene | None = None) -> Any:
        """A contact by its name, or as it is, for the ground of a ``scene``; raises
        :class:`InputError` if it is none.
        """
        if isinstance(contact, str) and contact in cls.known:
            return cls.known[contact]
        if not isinstance(contact, type(cls.known[CONTACTS[0]])):
            raise InputError(f"contact {quoted(contact)}: must be one of {', '.join(CONTACTS)}")
        return contact

    @abstractmethod
    def _build(self, friction: float) -> None:
        """Make scene and robot, with damping, armature and friction of its motors, and none of the
        engine's own.
        """

    @abstractmethod
    def _tangled(self, angles: np.ndarray) -> bool:
        """Whether the engine finds links in each other, high above the ground, with joints at
        ``angles`` (nv - 6,).
        """

    def _feels_itself(self) -> bool:
        rng = np.random.default_rng(0)
        joints = len(self.robot.joint_names)
        return any(self._tangled(rng.uniform(-np.pi, np.pi, joints)) for _ in range(TANGLES))

    @abstractmethod
    def _place(self, q: np.ndarray, v: np.ndarray) -> None:
        """Put the robot where the run begins."""

    @abstractmethod
    def close(self) -> None:
        """Free the engine."""

    @abstractmethod
    def kept(self) -> Kept:
        """Quantities that the engine really has."""

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """True configuration (nq,) and velocity (nv,), in Pinocchio's conventions."""
        if self._now is None:
            self._now = self._read()
        q, v = self._now
        return q.copy(), v.copy()

    @abstractmethod
    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        """The state, as the engine has it now."""

    @abstractmethod
    def set_torque(self, tau: np.ndarray) -> None:
        """Torque of every motor (nv - 6,) for the next step [N m]; the caller clips."""

    @abstractmethod
    def applied(self) -> np.ndarray:
        """Torque (nv - 6,) that motors gave in the last step, before their own friction [N m]."""

    @abstractmethod
    def push(self, force: np.ndarray, place: np.ndarray) -> None:
        """External force (3,) for the next step, world axes, at ``place`` (3,) in the base link's
        frame [N, m].
        """

    def step(self) -> None:
        """Advance by :data:`jumplab.sim.STEP_S`, with armature and friction of the motors."""
        state = self._now or self._read()
        self._advance()
        self._now = None
        self._steps.append((*state, self.applied()))

    @abstractmethod
    def _advance(self) -> None:
        """Take a step, append to ``_notes`` what the next ones need of it, and set ``fallen``:
        whether a link that is no foot touched the ground.
        """

    @abstractmethod
    def _pressed(self, notes: list[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """In n steps that were noted, the wrenches on the feet (n, 2, 6), which links touched the
        ground (n, links), and whether links touched each other (n,).
        """

    @abstractmethod
    def _sole_points(self) -> np.ndarray:
        """Places (k, 3) in the feet's frames where ground has pressed on them so far."""

    def wrench(self) -> np.ndarray:
        """Force and moment of the ground on each foot in the last step (2, 6), world axes, at the
        origin of the foot link [N, N m].
        """
        return self._pressed(self._notes[-1:])[0][0] if self._notes else np.zeros((2, 6))

    def log(self) -> Log:
        """All steps so far."""
        columns = map(np.array, zip(*self._steps, strict=True))
        return Log(*columns, *self._pressed(self._notes))

    def spring(self, soft_m: float) -> tuple[float, float]:
        """Stiffness [N/m] and damping [N s/m] of one contact point of ground into which flat soles,
        four points each, sink by ``soft_m`` under the weight; the whole robot on it is critically
        damped."""
        mass = self.robot.total_mass / SOLE_POINTS
        gravity = self.robot.gravity
        return mass * gravity / soft_m, 2 * mass * np.sqrt(gravity / soft_m)

    def read_back(self) -> dict[str, Any]:
        """Quantities that the engine really has, as plain data: effective friction of each foot on
        each block, the largest error of its bodies, each with the links that are fixed to it (mass
        [kg], times place of its centre [kg m], inertia about the joint [kg m^2]), whether links
        collide, the largest distance beyond the stated sole at which a foot touched [m] ...
        """
        kept = self.kept()
        model = self.robot.model
        bodies = [pin.Inertia.Zero() for _ in model.inertias]
        for name, inertia in kept.inertials.items():
            frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
            bodies[frame.parentJoint] += frame.placement.act(inertia)
        real, due = (
            np.array([body.toDynamicParameters() for body in x])[1:]
            for x in (bodies, model.inertias)
        )
        feet = [kept.friction[foot] for foot in self.robot.foot.frames]
        return dict(
            name=self.name,
            contact=self._contact_name,
            substeps=self.contact.substeps,
            keeps_m=list(self.keeps_m),
            friction=sorted({foot * block for foot in feet for block in kept.ground_friction}),
            mass_kg=kept.mass_kg,
            inertia_error=float(np.abs(real - due).max()),
            damping=kept.damping,
            gravity=kept.gravity,
            self_collision=self._solid,
            beyond_sole_m=self._beyond_sole(),
            late_armature=self.late_armature,
        )

    def _compare(self, friction: float) -> None:
        kept = self.kept()
        for name, there in kept.friction.items():
            if abs(there - friction) > ROUNDING:
                raise JumplabError(
                    f"{self.title} has friction {there:g} on {name}, but {friction:g} was set"
                )
        if abs(kept.mass_kg - self.robot.total_mass) > MASS_KG:
            weight = f"{self.title}'s robot weighs {kept.mass_kg:.4f} kg"
            raise JumplabError(f"{weight}, Pinocchio's {self.robot.total_mass:.4f} kg")

    def _beyond_sole(self) -> float:
        """Largest distance beyond the stated sole at which a contact of a foot ever lay [m]."""
        foot = self.robot.foot
        x, y, _ = self._sole_points().T
        side = np.abs(y - foot.center[1]) - foot.half_width
        return float(np.max([foot.heel - x, x - foot.toe, side], initial=0.0))


def moments(arms: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Moments (..., 3) of ``forces`` (..., 3) at ``arms`` (..., 3); np.cross takes three times as
    long.
    """
    return arms[..., NEXT] * forces[..., LAST] - arms[..., LAST] * forces[..., NEXT]


def inertial(
    mass: float, com: np.ndarray, quaternion: np.ndarray, moments: np.ndarray
) -> pin.Inertia:
    """Inertia of a link in its frame, from its CoM (3,) there [m], and moments (3,) [kg m^2] about
    axes that are turned by ``quaternion`` (4,).
    """
    turn = rotation(np.asarray(quaternion))
    return pin.Inertia(float(mass), np.asarray(com), turn @ np.diag(moments) @ turn.T)


def engine_class(name: str = DEFAULT_ENGINE) -> type[Engine]:
    """The class of an engine, imported now; raises :class:`InputError` if it is unknown or not
    installed.
    """
    if not isinstance(name, str) or name not in ENGINES:
        raise InputError(f"engine {quoted(name)}: must be one of {', '.join(INSTALLED)}")
    module, kind, package, cure = ENGINES[name]
    try:
        return getattr(import_module(f"jumplab.sim.{module}"), kind)
    except ModuleNotFoundError as e:
        if e.name != package:
            raise
        others = "".join(f"take {other!r}, or " for other in INSTALLED if other != name)
        raise InputError(
            f"engine {name!r}: the package {package} is not installed; {others}{cure}"
        ) from e
