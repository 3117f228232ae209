"""Differences between the simulated robot and the planned one; the paper's own differs "slightly"
too (Sec. VI-B).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import Field, asdict, dataclass, field, fields, replace
from itertools import pairwise, product
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import tomlkit

from jumplab.arguments import checked, real
from jumplab.control.estimator import SensorNoise
from jumplab.control.kinematics import Gauge
from jumplab.errors import InputError, quoted
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.changes import MOMENTS, limits, scale
from jumplab.robot.contact import on_feet
from jumplab.robot.legs import bring_feet
from jumplab.sim import STEP_S
from jumplab.sim.scene import Scene

FRICTION = 0.8  # rubber sole on dry floor; the ground has 1, and the engine multiplies the two
LIGHT_KG = 0.01  # links below this are the massless dummies of multi-axis joints and are left alone
PAYLOAD_SIDE_M = 0.1  # of the cube that a payload is
# how long a shove lasts, and how long after the tape's end a landing is shoved
PUSH_S = 0.05
AFTER_S = 1.0
PHASES = ("launch", "flight", "landing")
# [1] how much more readily the base moves than a joint, to close the legs over the ground
BASE_GIVES = 100.0
CLOSINGS = 20  # steps at most to put a wrong posture's feet back; two or three do
# a cube, fixed to the base link; it touches nothing
PAYLOAD = """<robot>
  <link name="payload">
    <inertial>
      <origin xyz="0 0 0" rpy="0 0 0"/>
      <mass value="{mass}"/>
      <inertia ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="payload_fixed" type="fixed">
    <parent link="{base}"/>
    <child link="payload"/>
    <origin xyz="{place}" rpy="0 0 0"/>
  </joint>
</robot>"""


Pair = tuple[float, float]  # from ... to
Vector = tuple[float, float, float]
ByName = dict[str, float]  # of links or joints
NONE = 0.0, 0.0
# of what is said, by its unit
FACTORS = {"%": 100.0, "%/kW": 100.0, "mm": 1e3, "mm per axis": 1e3, "ms late": 1e3}


def _up_to(default: Any, most: float, words: str, unit: str = "", least: float = 0.0) -> Any:
    """A disturbance: its default, what is refused beyond, and how it is said."""
    return field(default=default, metadata=dict(least=least, most=most, words=words, unit=unit))


@dataclass(frozen=True)
class Ranges:
    """Largest differences of robots and worlds: the uniform draws of :meth:`Perturbation.draw`,
    every link and joint by itself.

    A pair is drawn from ... to, a single number is the half-width around nothing. Values beyond the
    last number of a field's declaration are refused with an :class:`InputError`. From the payload
    on they are off unless they are asked for.
    """

    mass: float = _up_to(0.05, 0.2, "masses", "%")  # [1], relative
    com_m: float = _up_to(0.015, 0.05, "centres of mass", "mm per axis")  # [m], each axis
    inertia: float = _up_to(0.10, 0.5, "inertias", "%")  # [1], relative
    # [1], relative error of every torque, typical of current-controlled drives
    motor_gain: float = _up_to(0.05, 0.3, "motors", "%")
    friction: Pair = _up_to((0.5, 1.0), 1.0, "friction", least=0.3)  # [1]
    delay_s: Pair = _up_to((0.0, 0.004), 0.008, "commands", "ms late")  # [s]
    payload_kg: Pair = _up_to(NONE, 5.0, "a payload in the trunk's box of", "kg")  # [kg]
    # [1], share by which the limit curve of every motor lies lower, and by which it ends sooner
    torque_loss: Pair = _up_to(NONE, 0.2, "torque limits lower by", "%")
    speed_loss: Pair = _up_to(NONE, 0.1, "speed limits lower by", "%")
    # [1/kW], share of all speed limits that is lost per power drawn by the joints
    sag_per_kw: Pair = _up_to(NONE, 0.05, "speed limits lost to the battery", "%/kW")
    ground_m: float = _up_to(0.0, 0.04, "the ground of the landing higher by", "mm")  # [m]
    # [degrees]
    ground_tilt_deg: float = _up_to(0.0, 4.0, "tilted, in pitch and in roll, by", "degrees")
    soft_m: Pair = _up_to(NONE, 0.03, "ground that gives way by", "mm")  # [m]
    # [N s], each a force on the trunk for 50 ms, horizontal in any direction, at any moment of that
    # phase
    shove_launch_n_s: Pair = _up_to(NONE, 25.0, "a shove in launch of", "N s")
    shove_flight_n_s: Pair = _up_to(NONE, 25.0, "a shove in flight of", "N s")
    shove_landing_n_s: Pair = _up_to(NONE, 25.0, "a shove within 1 s of the landing of", "N s")
    posture_deg: float = _up_to(0.0, 3.0, "joints off at the start by", "degrees")  # [degrees]
    sensors: Pair = _up_to((1.0, 1.0), 4.0, "sensor errors times")  # [1]
    # [kg m^2] and [N m s/rad] at every joint, beside what the plan knows of
    rotor_kg_m2: Pair = _up_to(NONE, 0.05, "rotors heavier by", "kg m^2")
    damping_n_m_s: Pair = _up_to(NONE, 3.0, "joints damped more by", "N m s/rad")

    def __post_init__(self):
        for f in fields(self):
            value = getattr(self, f.name)
            pair = isinstance(f.default, tuple)
            numbers = value if pair and isinstance(value, tuple | list) else [value]
            good = all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)
            if not good or len(numbers) != 1 + pair:
                wanted = "two numbers, from and to" if pair else "one number, a half-width"
                raise InputError(f"the range {f.name} must be {wanted}, got {quoted(value)}")
            least, most = (f.metadata[key] for key in ("least", "most"))
            if not least <= numbers[0] <= numbers[-1] <= most:
                given = " ... ".join(f"{x:g}" for x in numbers)
                raise InputError(
                    f"the range {f.name} = {given} is outside {least:g} ... {most:g}; "
                    "choose a smaller one"
                )

    @classmethod
    def none(cls, **some: Any) -> Ranges:
        """Nothing differs, but for ``some``."""
        nothing = dict.fromkeys(("mass", "com_m", "inertia", "motor_gain"), 0.0)
        return cls(**(nothing | dict(friction=(FRICTION, FRICTION), delay_s=NONE) | some))

    @property
    def known_delay_s(self) -> float:
        """Delay that a laboratory measures beforehand [s]: the middle of the range. The difference
        of a robot from it is not known.
        """
        return sum(self.delay_s) / 2

    def __str__(self) -> str:
        words = [self._says(f) for f in fields(self)[:6]]
        words[-1] += f" and sent {1000 * self.known_delay_s:g} ms ahead"
        words += [self._says(f) for f in fields(self)[6:] if getattr(self, f.name) != f.default]
        return ", ".join(words)

    def _says(self, f: Field) -> str:
        factor = FACTORS.get(f.metadata["unit"], 1.0)
        value = getattr(self, f.name)
        if isinstance(f.default, tuple):
            amount = " ... ".join(f"{factor * x:g}" for x in value)
        else:
            amount = f"±{factor * value:g}"
        return f"{f.metadata['words']} {amount} {f.metadata['unit']}".rstrip()


# a "slight" difference: about a fifth of a workshop's uncertainty
SLIGHT = Ranges.none(mass=0.01, com_m=0.002, inertia=0.02, motor_gain=0.01)


@dataclass(frozen=True)
class Shove:
    """A push on the trunk, 50 ms long, horizontal."""

    phase: str  # of the planned jump, one of :data:`PHASES`
    share: float  # of that phase that has passed when it begins [1]
    impulse_n_s: float  # [N s]
    direction_rad: float  # from the x axis, seen from above


@dataclass(frozen=True)
class Push:
    """A force on the trunk, at the centre of mass that the planned one has."""

    step: int  # from the run's begin, with which it begins
    steps: int  # that it lasts
    force_n: Vector  # world axes

    def at(self, step: int) -> bool:
        """Whether it acts in this step."""
        return self.step <= step < self.step + self.steps


@checked
@dataclass(frozen=True)
class Perturbation:
    """One robot of the population: factors and shifts by link or joint name; what is not named is
    as planned.
    """

    seed: int = 0  # of the draw, also seeds the sensor noise
    mass: ByName = field(default_factory=dict)  # link -> factor [1]
    inertia: ByName = field(default_factory=dict)  # link -> factor [1]
    # link -> shift in its frame [m]
    com: dict[str, Vector] = field(default_factory=dict)
    friction: float = FRICTION  # lateral coefficient of the whole robot against ground of 1 [1]
    delay_s: float = 0.0  # age of a command when it reaches the motors, rounded to milliseconds
    # what that is believed to be, rounded likewise; the tape's commands are sent so much ahead
    known_delay_s: float = 0.0
    # joint -> torque delivered per torque commanded [1]
    motor_gain: ByName = field(default_factory=dict)
    noise: SensorNoise = SensorNoise()  # on measurements
    payload_kg: float = 0.0  # fixed to the trunk ...
    # ... at this place in the base link's frame
    payload_m: Vector = (0.0, 0.0, 0.0)
    # joint -> share by which its torque limit is lower [1]
    torque_loss: ByName = field(default_factory=dict)
    # joint -> the same of speed limit and corner speed [1]
    speed_loss: ByName = field(default_factory=dict)
    # share of the speed limits that is lost per power the joints draw [1/kW]
    sag_per_kw: float = 0.0
    ground_m: float = 0.0  # by how much the ground of the landing is higher
    # its pitch and roll, about where the soles shall land
    ground_tilt_rad: tuple[float, float] = (0.0, 0.0)
    soft_m: float = 0.0  # by how much the ground gives way under the weight on flat soles
    shoves: tuple[Shove, ...] = ()
    # joint -> wished error at the start
    posture_rad: ByName = field(default_factory=dict)
    # joint -> what its motor has beside the planned armature [kg m^2] and damping [N m s/rad]
    armature: ByName = field(default_factory=dict)
    damping: ByName = field(default_factory=dict)

    def __post_init__(self):
        if not 0 < real(self.friction, "friction") <= 2:
            raise InputError(f"friction = {self.friction:g} is outside 0 ... 2")
        for name, delay_s in (("delay", self.delay_s), ("known delay", self.known_delay_s)):
            if not 0 <= real(delay_s, name, "s") <= 0.02:
                raise InputError(f"{name} = {delay_s:g} s is outside 0 ... 0.02 s")

    @classmethod
    def draw(
        cls, robot: Robot, seed: int, ranges: Ranges = Ranges(), noise: SensorNoise = SensorNoise()
    ) -> Perturbation:
        """Draw every number uniformly and independently from ``ranges``; the same seed gives the
        same robot.

        Nothing that is drawn is known to the controllers; of the delay they know the middle of its
        range. Raises :class:`InputError` for a negative seed.
        """
        if seed < 0:
            raise InputError(f"seed = {seed} must not be negative")
        rng = np.random.default_rng(seed)
        # a stream of its own, all of it drawn whatever the ranges: a wider one changes no other
        # number
        more = np.random.default_rng([seed, 2])
        links = _heavy_links(robot)

        def factors(names: Sequence[str], half_width: float) -> ByName:
            drawn = 1 + rng.uniform(-half_width, half_width, len(names))
            return dict(zip(names, drawn.tolist(), strict=True))

        def each(low: float, high: float) -> ByName:
            drawn = more.uniform(low, high, len(robot.joint_names)).tolist()
            return dict(zip(robot.joint_names, drawn, strict=True)) if low or high else {}

        half_rad = float(np.radians(ranges.posture_deg))
        tilt_rad = np.radians(ranges.ground_tilt_deg)
        return cls(  # in the order of the draws
            seed=seed,
            mass=factors(links, ranges.mass),
            inertia=factors(links, ranges.inertia),
            com={k: tuple(rng.uniform(-ranges.com_m, ranges.com_m, 3).tolist()) for k in links},
            friction=float(rng.uniform(*ranges.friction)),
            delay_s=float(rng.uniform(*ranges.delay_s)),
            known_delay_s=ranges.known_delay_s,
            motor_gain=factors(robot.joint_names, ranges.motor_gain),
            payload_kg=float(more.uniform(*ranges.payload_kg)),
            payload_m=tuple(more.uniform(*_trunk_box(robot, ranges.payload_kg[1])).tolist()),
            torque_loss=each(*ranges.torque_loss),
            speed_loss=each(*ranges.speed_loss),
            sag_per_kw=float(more.uniform(*ranges.sag_per_kw)),
            ground_m=ranges.ground_m * more.uniform(-1, 1) + 0.0,
            ground_tilt_rad=tuple((tilt_rad * more.uniform(-1, 1, 2) + 0.0).tolist()),
            soft_m=float(more.uniform(*ranges.soft_m)),
            shoves=_shoves(more, ranges),
            posture_rad=each(-half_rad, half_rad),
            noise=noise.times(float(more.uniform(*ranges.sensors))),
            armature=each(*ranges.rotor_kg_m2),
            damping=each(*ranges.damping_n_m_s),
        )

    def robot(self, robot: Robot) -> Robot:
        """The robot as it really is: ``robot`` with masses, inertias, centres of mass, payload,
        limits and motors changed.
        """
        lost = {"effort": self.torque_loss, "speed": self.speed_loss}
        heavier = {"armature": self.armature, "damping": self.damping}
        bodies = self.mass, self.inertia, self.com, self.payload_kg
        if not any([*bodies, *lost.values(), *heavier.values()]):
            return robot
        left = {k: {name: 1 - x for name, x in losses.items()} for k, losses in lost.items()}
        root = ET.fromstring(limits(robot, left, {})[0])
        for link in root.iterfind("link[inertial]"):
            name = link.get("name")
            factor = self.mass.get(name, 1.0)
            scale(link.find("inertial/mass"), ("value",), factor)
            # a heavier link of the same shape has more inertia too; the further factor is a change
            # of shape
            moments = link.find("inertial/inertia")
            scale(moments, MOMENTS, factor * self.inertia.get(name, 1.0))
            origin = link.find("inertial/origin")
            xyz = np.array(origin.get("xyz").split(), float) + self.com.get(name, (0.0, 0.0, 0.0))
            origin.set("xyz", " ".join(f"{x:.12g}" for x in xyz))
        if self.payload_kg:
            payload = PAYLOAD.format(
                base=robot.model.frames[2].name,
                mass=f"{self.payload_kg:.12g}",
                moment=f"{self.payload_kg * PAYLOAD_SIDE_M**2 / 6:.12g}",
                place=" ".join(f"{x:.12g}" for x in self.payload_m),
            )
            root.extend(ET.fromstring(payload))
        config = tomlkit.parse(robot.config_text)
        for key, more in heavier.items():
            known = robot.motors[key]
            total = {name: known.get(name, 0.0) + x for name, x in more.items()}
            if total:
                config["actuators"][key] = total
        real = Robot(ET.tostring(root, encoding="unicode"), tomlkit.dumps(config))
        return real.under_gravity(robot.gravity)

    def ground(self, scene: Scene, robot: Robot, tape: Tape | None) -> Scene:
        """The ground as it really is; raises :class:`InputError` where the landing's cannot differ
        from the start's.
        """
        if self.ground_m or any(self.ground_tilt_rad):
            ends = _of_one_jump(tape).q[[0, -1]]
            scene = scene.landing_moved(robot, ends, self.ground_m, *self.ground_tilt_rad)
        if self.soft_m:
            blocks = [replace(x, soft_m=max(x.soft_m, self.soft_m)) for x in scene.blocks]
            scene = replace(scene, name=f"{scene.name}, soft", blocks=tuple(blocks))
        return scene

    def pushes(self, tape: Tape | None) -> tuple[Push, ...]:
        """The shoves as forces, in the steps of a planned jump."""
        if not self.shoves:
            return ()
        tape = _of_one_jump(tape)
        takeoff, end = tape.t[[tape.flights[-1].start, tape.caught - 1]].tolist()
        spans = dict(zip(PHASES, pairwise((0.0, takeoff, end, end + AFTER_S)), strict=True))
        pushes = []
        for shove in self.shoves:
            begin, until = spans[shove.phase]
            way = np.array([np.cos(shove.direction_rad), np.sin(shove.direction_rad), 0.0])
            force = tuple((shove.impulse_n_s / PUSH_S * way).tolist())
            at = round((begin + shove.share * (until - begin - PUSH_S)) / STEP_S)
            pushes.append(Push(at, round(PUSH_S / STEP_S), force))
        return tuple(pushes)

    def start(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """The configuration (nq,) in which it really starts: with its wrong posture, but both soles
        as in ``q``.

        Legs that stand are a closed chain: of the errors wished, this is the nearest posture whose
        feet do not move.
        """
        if not self.posture_rad:
            return q
        gauge = Gauge(robot)
        wrong = q.copy()
        wrong[7:] += [self.posture_rad.get(name, 0.0) for name in robot.joint_names]
        feet = dict(zip(on_feet(robot, np.zeros(3)), gauge.places(q), strict=True))
        give = np.repeat([BASE_GIVES, 1.0], [6, len(robot.joint_names)])
        return bring_feet(gauge.model, gauge.data, wrong, feet, give, steps=CLOSINGS)[0]

    def to_json(self) -> dict:
        """All numbers as plain data."""
        return asdict(self)


def _of_one_jump(tape: Tape | None) -> Tape:
    if tape is None:
        raise InputError(
            "a shove, and other ground for the landing, are for a single jump; "
            "leave them out of a chain"
        )
    return tape


def _shoves(rng: np.random.Generator, ranges: Ranges) -> tuple[Shove, ...]:
    """One in each phase, or none where the range ends at nothing."""
    shoves = []
    for phase in PHASES:
        low, high = getattr(ranges, f"shove_{phase}_n_s")
        drawn = rng.uniform((0.0, low, -np.pi), (1.0, high, np.pi)).tolist()
        if high:
            shoves.append(Shove(phase, *drawn))
    return tuple(shoves)


def _heavy_links(robot: Robot) -> list[str]:
    """Names of all links but massless dummies."""
    links = ET.fromstring(robot.urdf).iterfind("link[inertial]")
    masses = {link.get("name"): float(link.find("inertial/mass").get("value")) for link in links}
    return [name for name, mass in masses.items() if mass > LIGHT_KG]


def _trunk_box(robot: Robot, payload_kg: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), least and greatest, of the box around the base link's collision shapes, in its
    frame [m]; nothing without a payload.
    """
    if not payload_kg:
        return np.zeros(3), np.zeros(3)
    model = robot.model
    trunk = model.frames[2].name
    shapes = pin.buildGeomFromUrdfString(model, robot.urdf, pin.GeometryType.COLLISION)
    corners = []
    for shape in shapes.geometryObjects:
        if model.frames[shape.parentFrame].name == trunk:
            shape.geometry.computeLocalAABB()
            box = shape.geometry.aabb_local
            ends = product(*np.transpose([box.min_, box.max_]))
            corners += [shape.placement.act(np.array(end)) for end in ends]
    if not corners:
        raise InputError(
            f"robot {robot.name}: its trunk has no collision shape to carry payload_kg = "
            f"{payload_kg:g}; leave out payload_kg"
        )
    return np.min(corners, axis=0), np.max(corners, axis=0)


def is_pair(name: str) -> bool:
    """Whether a disturbance is drawn from ... to, and not around nothing."""
    return isinstance(getattr(Ranges, name, None), tuple)


@checked
def ranges_of(asked: Mapping[str, tuple[float, ...]], base: Ranges | None = None) -> Ranges:
    """``base`` (nothing differs if None) with what is asked: name -> from, to; a single number is a
    half-width, or goes from nothing to there. Raises :class:`InputError` for names that
    :class:`Ranges` lacks, and for what it refuses.
    """
    nothing = Ranges.none()
    changed = {}
    for name, values in asked.items():
        if not hasattr(nothing, name):
            known = ", ".join(f.name for f in fields(Ranges))
            raise InputError(f"no disturbance is called {quoted(name)}; there are {known}")
        if len(values) > 1:
            changed[name] = values
        elif is_pair(name):
            changed[name] = tuple(sorted((getattr(nothing, name)[0], *values)))
        else:
            changed[name] = values[0]
    return replace(base or nothing, **changed)
