"""What the simulation wants of a physics engine, and which ones there are.

Servo law, delay, motors, sensors, perturbations, log and checks are written once and know no engine. A further engine
is a class with :class:`Engine`'s methods, a line in :data:`jumplab.sim.ENGINES`, and passes ``test_sim_world.py``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib import import_module
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, JumplabError, quoted
from jumplab.robot import Robot
from jumplab.sim import DEFAULT_ENGINE, ENGINES, INSTALLED
from jumplab.sim.perturbation import FRICTION
from jumplab.sim.scene import Contacts, Scene

MASS_KG, ROUNDING = 1e-6, 1e-9  # by how much an engine's mass, and its friction, may differ from what was asked for
SOLE_POINTS = 8  # contact points of two flat rectangular soles
TANGLES = 20  # postures tried until links are in each other; for a humanoid the first one does


class Engine(ABC):
    """A robot in a scene, advanced in steps of :data:`jumplab.sim.STEP_S`. Use as a context manager.

    Outside of an engine everything is Pinocchio's: ``q`` and ``v`` of the base *link* frame, joints in its order.

    Parameters
    ----------
    robot : the robot as it really is (perturbed, if at all).
    q, v : initial configuration (nq,) and velocity (nv,), rest if ``v`` is None. Set once; nothing is ever reset.
    friction : effective coefficient between robot and ground [1].

    Attributes
    ----------
    name : as in :data:`jumplab.sim.ENGINES`.  title : as in sentences.
    links : names of the robot's links, the base first.
    late_armature : whether the engine has no armature, and that of motors comes by :class:`.armature.Armature`.
    substeps : semi-implicit steps that the engine takes within one of the simulation.

    Raises
    ------
    RobotError
        If the engine cannot read the robot.
    JumplabError
        If its mass or friction, read back, are not what was asked for.
    """

    name: str
    title: str
    substeps: int = 1
    late_armature: bool = False
    links: tuple[str, ...]

    def __init__(self, robot: Robot, q: np.ndarray, v=None, *, scene: Scene | None = None, friction: float = FRICTION):
        self.robot, self.scene, self.beyond_sole_m = robot, scene or Scene.flat(), 0.0
        try:
            self._build(friction)
            self._compare(friction)
            self._solid = self._feels_itself()
            self._place(np.asarray(q, float), np.zeros(robot.model.nv) if v is None else np.asarray(v, float))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    @abstractmethod
    def _build(self, friction: float) -> None:
        """Make scene and robot, with damping, armature and friction of its motors, and none of the engine's own."""

    @abstractmethod
    def _tangled(self, angles: np.ndarray) -> bool:
        """Whether the engine finds links in each other, high above the ground, with joints at ``angles`` (nv - 6,)."""

    def _feels_itself(self) -> bool:
        rng, joints = np.random.default_rng(0), len(self.robot.joint_names)
        return any(self._tangled(rng.uniform(-np.pi, np.pi, joints)) for _ in range(TANGLES))

    @abstractmethod
    def _place(self, q: np.ndarray, v: np.ndarray) -> None:
        """Put the robot where the run begins."""

    @abstractmethod
    def close(self) -> None:
        """Free the engine."""

    @property
    @abstractmethod
    def inertials(self) -> dict[str, pin.Inertia]:
        """Mass, centre of mass and inertia of every link, in its frame, as the engine has them."""

    @property
    @abstractmethod
    def gravity(self) -> list[float]:
        """Gravity (3,) as the engine has it [m/s^2]."""

    @property
    @abstractmethod
    def friction(self) -> dict[str, float]:
        """Friction coefficient between every link that can touch, and the ground of 1, as the engine has it."""

    @property
    @abstractmethod
    def ground_friction(self) -> list[float]:
        """Friction coefficient of every block of the scene as the engine has it."""

    @property
    @abstractmethod
    def damping(self) -> float:
        """Largest damping, armature or dry friction of a joint as the engine has it, less what the robot's motors have
        and the engine was told, in SI units; zero is wanted."""

    @abstractmethod
    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """True configuration (nq,) and velocity (nv,)."""

    @abstractmethod
    def set_torque(self, tau: np.ndarray) -> None:
        """Torque of every motor (nv - 6,) for the next step [N m]; the caller clips."""

    @abstractmethod
    def applied(self) -> np.ndarray:
        """Torque (nv - 6,) that the motors gave in the last step, before their own friction [N m]."""

    @abstractmethod
    def push(self, force: np.ndarray, place: np.ndarray) -> None:
        """External force (3,) for the next step, world axes, at ``place`` (3,) in the base link's frame [N, m]."""

    @abstractmethod
    def step(self) -> None:
        """Advance by :data:`jumplab.sim.STEP_S`."""

    @abstractmethod
    def contacts(self) -> Contacts:
        """What touched, and how hard, in the last step."""

    def spring(self, soft_m: float) -> tuple[float, float]:
        """Stiffness [N/m] and damping [N s/m] of one contact point of ground into which flat soles, four points each,
        sink by ``soft_m`` under the weight; the whole robot on it is critically damped."""
        mass, gravity = self.robot.total_mass / SOLE_POINTS, self.robot.gravity
        return mass * gravity / soft_m, 2 * mass * np.sqrt(gravity / soft_m)

    @property
    def mass_kg(self) -> float:
        """Mass of the robot as the engine has it."""
        return float(sum(link.mass for link in self.inertials.values()))

    def inertia_error(self) -> float:
        """Largest error of the engine's bodies, each with what is fixed to it: mass [kg], times place of its centre
        [kg m], inertia [kg m^2] about the joint."""
        model = self.robot.model
        bodies = [pin.Inertia.Zero() for _ in model.inertias]
        for name, inertia in self.inertials.items():
            frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
            bodies[frame.parentJoint] += frame.placement.act(inertia)
        pairs = zip(bodies[1:], list(model.inertias)[1:], strict=True)
        return float(max(np.abs(a.toDynamicParameters() - b.toDynamicParameters()).max() for a, b in pairs))

    def read_back(self) -> dict[str, Any]:
        """What the engine has, not what it was told: effective friction of each foot on each block, the mass [kg], how
        wrong inertias are, damping in the joints, gravity [m/s^2], whether links collide, how far beyond the stated
        sole a foot ever touched [m], and where it is so, that armature comes late."""
        feet = [self.friction[foot] for foot in self.robot.foot.frames]
        friction = sorted({foot * block for foot in feet for block in self.ground_friction})
        read = dict(friction=friction, mass_kg=self.mass_kg, inertia_error=self.inertia_error(), damping=self.damping)
        read |= dict(gravity=self.gravity, self_collision=self._solid)
        if self.late_armature:
            read["late_armature"] = True
        return dict(name=self.name, substeps=self.substeps, **read, beyond_sole_m=self.beyond_sole_m)

    def _compare(self, friction: float) -> None:
        for name, found in self.friction.items():
            if abs(found - friction) > ROUNDING:
                raise JumplabError(f"{self.title} kept friction {found:g} on {name} where {friction:g} was set")
        if abs(self.mass_kg - self.robot.total_mass) > MASS_KG:
            weight = f"{self.title}'s robot weighs {self.mass_kg:.4f} kg"
            raise JumplabError(f"{weight}, Pinocchio's {self.robot.total_mass:.4f} kg")

    def _note_sole(self, points: np.ndarray) -> None:
        """Remember how far contact points (k, 3) in the foot's frame lay beyond the stated sole."""
        foot = self.robot.foot
        side = np.abs(points[:, 1] - foot.center[1]) - foot.half_width
        beyond = max((foot.heel - points[:, 0]).max(), (points[:, 0] - foot.toe).max(), side.max())
        self.beyond_sole_m = max(self.beyond_sole_m, float(beyond))


def engine_class(name: str = DEFAULT_ENGINE) -> type[Engine]:
    """The class of an engine, imported now; raises :class:`InputError` if it is unknown or not installed."""
    if not isinstance(name, str) or name not in ENGINES:
        raise InputError(f"engine {quoted(name)}: must be one of {', '.join(INSTALLED)}")
    module, kind, package, cure = ENGINES[name]
    try:
        return getattr(import_module(f"jumplab.sim.{module}"), kind)
    except ModuleNotFoundError as e:
        if e.name != package:
            raise
        others = "".join(f"take {other!r}, or " for other in INSTALLED if other != name)
        raise InputError(f"engine {name!r}: the package {package} is not installed; {others}{cure}") from e
