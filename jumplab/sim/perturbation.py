"""How the simulated robot differs from the planned one; the paper's own differs "slightly" too (Sec. VI-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, quoted
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.changes import MOMENTS, limits, scale
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, solved
from jumplab.sim.scene import Scene

FRICTION = 0.8  # rubber sole on dry floor; the ground has 1, and the engine multiplies the two
LIGHT_KG = 0.01  # links below this are the massless dummies of multi-axis joints and are left alone
PAYLOAD_SIDE_M = 0.1  # of the cube that a payload is
PUSH_S, AFTER_S = 0.05, 1.0  # how long a shove lasts, and how long after the tape's end a landing is shoved
PHASES = ("launch", "flight", "landing")
BASE_GIVES = 1e4  # [1] how much more readily the base moves than a joint, to close the legs over the ground
CLOSE_RAD, CLOSINGS = 1e-10, 20  # a wrong posture's feet are put back to so much; two or three steps do


def _up_to(default: Any, most: float, words: str, unit: str = "", least: float = 0.0, factor: float = 1.0) -> Any:
    """A disturbance: its default, what is refused beyond, and how it is said (``factor`` times the number)."""
    return field(default=default, metadata=dict(least=least, most=most, words=words, unit=unit, factor=factor))


@dataclass(frozen=True)
class Ranges:
    """How far robots and worlds differ: the uniform draws of :meth:`Perturbation.draw`, every link and joint by itself.

    A pair is drawn from ... to, a single number is the half-width around nothing. What is beyond the last number of a
    field's declaration is refused with an :class:`InputError`. The last thirteen are off unless they are asked for.
    """

    mass: float = _up_to(0.05, 0.2, "masses", "%", factor=100)  # [1], relative
    com_m: float = _up_to(0.015, 0.05, "centres of mass", "mm per axis", factor=1e3)  # [m], each axis
    inertia: float = _up_to(0.10, 0.5, "inertias", "%", factor=100)  # [1], relative
    friction: tuple[float, float] = _up_to((0.5, 1.0), 1.0, "friction", least=0.3)  # [1]
    delay_s: tuple[float, float] = _up_to((0.0, 0.004), 0.008, "commands", "ms late", factor=1e3)  # [s]
    # [1], relative error of every torque, typical of current-controlled drives
    motor_gain: float = _up_to(0.05, 0.3, "motors", "%", factor=100)
    payload_kg: tuple[float, float] = _up_to((0.0, 0.0), 5.0, "a payload in the trunk's box of", "kg")  # [kg]
    # [1], share by which the limit curve of every motor lies lower, and by which it ends sooner
    torque_loss: tuple[float, float] = _up_to((0.0, 0.0), 0.2, "torque limits lower by", "%", factor=100)
    speed_loss: tuple[float, float] = _up_to((0.0, 0.0), 0.1, "speed limits lower by", "%", factor=100)
    # [1/kW], share of all speed limits that is lost per power drawn by the joints
    sag_per_kw: tuple[float, float] = _up_to((0.0, 0.0), 0.05, "speed limits lost to the battery", "%/kW", factor=100)
    ground_m: float = _up_to(0.0, 0.04, "the ground of the landing higher by", "mm", factor=1e3)  # [m]
    ground_tilt_deg: float = _up_to(0.0, 4.0, "tilted, in pitch and in roll, by", "degrees")  # [degrees]
    soft_m: tuple[float, float] = _up_to((0.0, 0.0), 0.03, "ground that gives way by", "mm", factor=1e3)  # [m]
    # [N s], each a force on the trunk for 50 ms, horizontal in any direction, at any moment of that phase
    shove_launch_n_s: tuple[float, float] = _up_to((0.0, 0.0), 25.0, "a shove in launch of", "N s")
    shove_flight_n_s: tuple[float, float] = _up_to((0.0, 0.0), 25.0, "a shove in flight of", "N s")
    shove_landing_n_s: tuple[float, float] = _up_to((0.0, 0.0), 25.0, "a shove within 1 s of the landing of", "N s")
    posture_deg: float = _up_to(0.0, 3.0, "joints off at the start by", "degrees")  # [degrees]
    sensors: tuple[float, float] = _up_to((1.0, 1.0), 4.0, "sensor errors times")  # [1]

    def __post_init__(self):
        for f in fields(self):
            value, least, most = getattr(self, f.name), f.metadata["least"], f.metadata["most"]
            pair = isinstance(f.default, tuple)
            numbers = value if isinstance(value, tuple | list) else (value,)
            good = len(numbers) == (2 if pair else 1) and isinstance(value, tuple | list) == pair
            if not good or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers):
                wanted = "two numbers, from and to" if pair else "one number, a half-width"
                raise InputError(f"the range {f.name} must be {wanted}, got {quoted(value)}")
            if not (least <= numbers[0] <= numbers[-1] <= most):
                said = " ... ".join(f"{x:g}" for x in numbers)
                raise InputError(f"the range {f.name} = {said} is outside {least:g} ... {most:g}; choose a smaller one")

    @classmethod
    def none(cls, **some: Any) -> Ranges:
        """Nothing differs, but for ``some``."""
        off = dict(mass=0.0, com_m=0.0, inertia=0.0, friction=(FRICTION, FRICTION), delay_s=(0.0, 0.0), motor_gain=0.0)
        return cls(**(off | some))

    @property
    def known_delay_s(self) -> float:
        """What a laboratory measures beforehand [s]: the middle of the delays. What a robot is off it, nobody knows."""
        return sum(self.delay_s) / 2

    def __str__(self) -> str:
        links = f"masses ±{100 * self.mass:g} %, centres of mass ±{1000 * self.com_m:g} mm per axis, "
        links += f"inertias ±{100 * self.inertia:g} %, motors ±{100 * self.motor_gain:g} %, "
        slow, late = (1000 * x for x in self.delay_s)
        delay = f"commands {slow:g} ... {late:g} ms late and sent {1000 * self.known_delay_s:g} ms ahead"
        said = links + f"friction {self.friction[0]:g} ... {self.friction[1]:g}, " + delay
        return ", ".join([said, *(self._says(f) for f in fields(self)[6:] if getattr(self, f.name) != f.default)])

    def _says(self, f: Any) -> str:
        value, how = getattr(self, f.name), f.metadata
        low, high = (how["factor"] * x for x in (value if isinstance(value, tuple | list) else (-value, value)))
        amount = f"±{high:g}" if low == -high != 0 else f"{low:g} ... {high:g}"
        return f"{how['words']} {amount} {how['unit']}".rstrip()


# a "slight" difference: about a fifth of a workshop's uncertainty
SLIGHT = Ranges(0.01, 0.002, 0.02, friction=(FRICTION, FRICTION), delay_s=(0.0, 0.0), motor_gain=0.01)


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of what is wrong with the sensors; zero means exact.

    White noise is that of one sample at 1 kHz; biases and the error of the first attitude are drawn once per run.
    """

    joint_rad: float = 0.0  # [rad] white
    joint_rate: float = 0.0  # [rad/s] white
    encoder_step_rad: float = 0.0  # [rad] quantisation of the joint angles
    tilt_rad: float = 0.0  # [rad] roll and pitch as they are believed to be before the jump
    gyro: float = 0.0  # [rad/s] white
    gyro_bias: float = 0.0  # [rad/s]
    accel: float = 0.0  # [m/s^2] white
    accel_bias: float = 0.0  # [m/s^2]
    force: float = 0.0  # [N] white, each foot

    @classmethod
    def typical(cls) -> SensorNoise:
        """16-bit encoders on gears with some play; a mid-range inertial unit, zeroed at rest."""
        return cls(5e-4, 0.05, 1e-4, tilt_rad=5e-3, gyro=0.02, gyro_bias=1e-3, accel=0.2, accel_bias=0.05, force=3.0)

    def times(self, factor: float) -> SensorNoise:
        """Sensors that are so much worse."""
        return SensorNoise(**{name: factor * value for name, value in vars(self).items()})

    def __str__(self) -> str:
        if self == SensorNoise():
            return "the true state and foot forces"
        joints = (
            f"joint angles (±{1000 * self.joint_rad:g} mrad in steps of {1000 * self.encoder_step_rad:g}) and rates "
        )
        inertial = f"gyro (±{self.gyro:g}, bias ±{self.gyro_bias:g} rad/s), accelerometer (±{self.accel:g}, bias "
        rest = f"±{self.accel_bias:g} m/s^2), foot forces (±{self.force:g} N), tilt before the jump "
        return joints + f"(±{self.joint_rate:g} rad/s), " + inertial + rest + f"(±{1000 * self.tilt_rad:g} mrad)"


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
    force_n: tuple[float, float, float]  # world axes

    def at(self, step: int) -> bool:
        """Whether it acts in this step."""
        return self.step <= step < self.step + self.steps


@dataclass(frozen=True)
class Perturbation:
    """One robot of the population: factors and shifts by link or joint name; what is not named is as planned."""

    seed: int = 0  # of the draw, also seeds the sensor noise
    mass: dict[str, float] = field(default_factory=dict)  # link -> factor [1]
    inertia: dict[str, float] = field(default_factory=dict)  # link -> factor [1]
    com: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # link -> shift in its frame [m]
    friction: float = FRICTION  # lateral coefficient of the whole robot against ground of 1 [1]
    delay_s: float = 0.0  # age of a command when it reaches the motors, rounded to milliseconds
    known_delay_s: float = (
        0.0  # what it is believed to be, rounded likewise; the tape's commands are sent so much ahead
    )
    motor_gain: dict[str, float] = field(default_factory=dict)  # joint -> torque delivered per torque commanded [1]
    noise: SensorNoise = SensorNoise()  # on measurements
    payload_kg: float = 0.0  # fixed to the trunk ...
    payload_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # ... at this place in the base link's frame
    torque_loss: dict[str, float] = field(default_factory=dict)  # joint -> share by which its torque limit is lower [1]
    speed_loss: dict[str, float] = field(default_factory=dict)  # joint -> the same of speed limit and corner speed [1]
    sag_per_kw: float = 0.0  # share of the speed limits that is lost per power the joints draw [1/kW]
    ground_m: float = 0.0  # by how much the ground of the landing is higher
    ground_tilt_rad: tuple[float, float] = (0.0, 0.0)  # its pitch and roll, about where the soles shall land
    soft_m: float = 0.0  # by how much the ground gives way under the weight on flat soles
    shoves: tuple[Shove, ...] = ()
    posture_rad: dict[str, float] = field(default_factory=dict)  # joint -> wished error at the start

    def __post_init__(self):
        if not 0 < self.friction <= 2:
            raise InputError(f"friction = {self.friction:g} is outside 0 ... 2")
        for name, delay_s in (("delay", self.delay_s), ("known delay", self.known_delay_s)):
            if not 0 <= delay_s <= 0.02:
                raise InputError(f"{name} = {delay_s:g} s is outside 0 ... 0.02 s")

    @classmethod
    def draw(
        cls, robot: Robot, seed: int, ranges: Ranges = Ranges(), noise: SensorNoise = SensorNoise()
    ) -> Perturbation:
        """Draw every number uniformly and independently from ``ranges``; the same seed gives the same robot.

        Nothing that is drawn is known to the controllers; of the delay they know the middle of its range.
        """
        rng = np.random.default_rng(seed)
        masses = ((link.get("name"), link.find("inertial/mass")) for link in ET.fromstring(robot.urdf).iter("link"))
        names = [name for name, mass in masses if mass is not None and float(mass.get("value")) > LIGHT_KG]

        def around(half_width, size=None):
            return rng.uniform(-half_width, half_width, size)

        drawn = cls(
            seed,
            {name: 1 + float(around(ranges.mass)) for name in names},
            {name: 1 + float(around(ranges.inertia)) for name in names},
            {name: tuple(around(ranges.com_m, 3).tolist()) for name in names},
            float(rng.uniform(*ranges.friction)),
            float(rng.uniform(*ranges.delay_s)),
            ranges.known_delay_s,
            {name: 1 + float(around(ranges.motor_gain)) for name in robot.joint_names},
            noise,
        )
        return replace(drawn, **_further(robot, np.random.default_rng([seed, 2]), ranges, noise))

    def robot(self, robot: Robot) -> Robot:
        """The robot as it really is: ``robot`` with masses, inertias, centres of mass, payload and limits changed."""
        if not (self.mass or self.inertia or self.com or self.payload_kg or self.torque_loss or self.speed_loss):
            return robot
        lost = {"effort": self.torque_loss, "speed": self.speed_loss}
        factors = {what: {name: 1 - x for name, x in told.items()} for what, told in lost.items()}
        root = ET.fromstring(limits(robot, factors, {})[0] if any(lost.values()) else robot.urdf)
        for link in root.iter("link"):
            name, inertial = link.get("name"), link.find("inertial")
            if inertial is None:
                continue
            factor = self.mass.get(name, 1.0)
            scale(inertial.find("mass"), ("value",), factor)
            # a heavier link of the same shape has more inertia too; the further factor is a change of shape
            scale(inertial.find("inertia"), MOMENTS, factor * self.inertia.get(name, 1.0))
            origin = inertial.find("origin")
            xyz = np.array(origin.get("xyz").split(), float) + self.com.get(name, (0.0, 0.0, 0.0))
            origin.set("xyz", " ".join(f"{x:.12g}" for x in xyz))
        if self.payload_kg:
            _load(root, self.payload_kg, self.payload_m)
        real = Robot.from_text(ET.tostring(root, encoding="unicode"), robot.config_text)
        return real.under_gravity(robot.gravity)

    def ground(self, scene: Scene, robot: Robot, tape: Tape | None) -> Scene:
        """The ground as it really is; raises :class:`InputError` where the landing's cannot differ from the start's."""
        if self.ground_m or any(self.ground_tilt_rad):
            ends = _of_one_jump(tape).q[[0, -1]]
            scene = scene.landing_moved(robot, ends, self.ground_m, *self.ground_tilt_rad)
        if not self.soft_m:
            return scene
        blocks = tuple(replace(block, soft_m=max(block.soft_m, self.soft_m)) for block in scene.blocks)
        return replace(scene, name=f"{scene.name}, soft", blocks=blocks)

    def pushes(self, tape: Tape | None) -> tuple[Push, ...]:
        """The shoves as forces, in the steps of a planned jump."""
        if not self.shoves:
            return ()
        takeoff, end = _of_one_jump(tape).takeoff_time, float(tape.t[-1])
        spans = dict(zip(PHASES, ((0.0, takeoff), (takeoff, end), (end, end + AFTER_S)), strict=True))
        found = []
        for shove in self.shoves:
            begin, until = spans[shove.phase]
            size, steps = shove.impulse_n_s / PUSH_S, round(PUSH_S / STEP_S)
            force = size * np.cos(shove.direction_rad), size * np.sin(shove.direction_rad), 0.0
            at = round((begin + shove.share * (until - begin - PUSH_S)) / STEP_S)
            found.append(Push(at, steps, tuple(map(float, force))))
        return tuple(found)

    def start(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """The configuration (nq,) in which it really starts: with its wrong posture, but both soles as in ``q``.

        Legs that stand are a closed chain: of the errors wished, this is the nearest posture whose feet do not move.
        """
        if not self.posture_rad:
            return q
        gauge, wrong = Gauge(robot), q.copy()
        wrong[7:] += [self.posture_rad.get(name, 0.0) for name in robot.joint_names]
        pin.framesForwardKinematics(gauge.model, gauge.data, q)
        there = [gauge.data.oMf[frame].copy() for frame in gauge.frames]
        local = pin.ReferenceFrame.LOCAL
        for _ in range(CLOSINGS):
            pin.computeJointJacobians(gauge.model, gauge.data, wrong)
            pin.updateFramePlacements(gauge.model, gauge.data)
            rows = np.vstack([pin.getFrameJacobian(gauge.model, gauge.data, f, local) for f in gauge.frames])
            pairs = zip(gauge.frames, there, strict=True)
            miss = np.concatenate([pin.log6(gauge.data.oMf[f].actInv(place)).vector for f, place in pairs])
            if np.abs(miss).max() < CLOSE_RAD:
                break
            light = BASE_GIVES * rows.T
            light[6:] = rows.T[6:]
            wrong = pin.integrate(gauge.model, wrong, light @ solved(rows @ light + 1e-12 * np.eye(12), miss))
        return wrong

    def to_json(self) -> dict:
        """All numbers as plain data."""
        return asdict(self)


def _of_one_jump(tape: Tape | None) -> Tape:
    if tape is None:
        raise InputError("a shove, and other ground for the landing, belong to one jump; leave them away in a chain")
    return tape


def _further(robot: Robot, rng: np.random.Generator, ranges: Ranges, noise: SensorNoise) -> dict[str, Any]:
    """What a stream of its own draws, all of it whatever the ranges: a wider one changes no other number."""

    def each(low: float, high: float) -> dict[str, float]:
        drawn = rng.uniform(low, high, len(robot.joint_names))
        return dict(zip(robot.joint_names, drawn.tolist(), strict=True)) if (low, high) != (0, 0) else {}

    low, high = _trunk_box(robot) if ranges.payload_kg[1] else (np.zeros(3), np.zeros(3))
    found = dict(payload_kg=float(rng.uniform(*ranges.payload_kg)), payload_m=tuple(rng.uniform(low, high).tolist()))
    found |= dict(torque_loss=each(*ranges.torque_loss), speed_loss=each(*ranges.speed_loss))
    found |= dict(
        sag_per_kw=float(rng.uniform(*ranges.sag_per_kw)), ground_m=ranges.ground_m * rng.uniform(-1, 1) + 0.0
    )
    found |= dict(ground_tilt_rad=tuple(np.radians(ranges.ground_tilt_deg * rng.uniform(-1, 1, 2) + 0.0).tolist()))
    found |= dict(soft_m=float(rng.uniform(*ranges.soft_m)))
    pushes = []
    for phase in PHASES:
        range_n_s = getattr(ranges, f"shove_{phase}_n_s")
        share, impulse, direction = rng.uniform(), rng.uniform(*range_n_s), rng.uniform(-np.pi, np.pi)
        pushes += [Shove(phase, float(share), float(impulse), float(direction))] if range_n_s[1] else []
    half = float(np.radians(ranges.posture_deg))
    found |= dict(shoves=tuple(pushes), posture_rad=each(-half, half))
    return found | dict(
        noise=noise if ranges.sensors == (1.0, 1.0) else noise.times(float(rng.uniform(*ranges.sensors)))
    )


def _trunk_box(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), least and greatest, of the box around the base link's collision shapes, in its frame [m]."""
    base, corners = robot.model.frames[2].name, []
    shapes = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.COLLISION).geometryObjects
    for shape in (g for g in shapes if robot.model.frames[g.parentFrame].name == base):
        shape.geometry.computeLocalAABB()
        low, high = shape.geometry.aabb_local.min_, shape.geometry.aabb_local.max_
        ends = [np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)]
        corners += [shape.placement.act(end) for end in ends]
    if not corners:
        raise InputError(f"robot {robot.name}: its trunk has no shape to carry a payload_kg; leave that away")
    return np.min(corners, axis=0), np.max(corners, axis=0)


def _load(root: ET.Element, mass_kg: float, place_m: Sequence[float]) -> None:
    """Fix a cube to the base link of a URDF, in place; it touches nothing."""
    below = {joint.find("child").get("link") for joint in root.findall("joint")}
    base = next(link.get("name") for link in root.findall("link") if link.get("name") not in below)
    moment = f"{mass_kg * PAYLOAD_SIDE_M**2 / 6:.12g}"
    inertial = ET.SubElement(ET.SubElement(root, "link", name="payload"), "inertial")
    ET.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=f"{mass_kg:.12g}")
    ET.SubElement(inertial, "inertia", {k: moment if k[1] == k[2] else "0" for k in MOMENTS})
    joint = ET.SubElement(root, "joint", name="payload_fixed", type="fixed")
    ET.SubElement(joint, "parent", link=base)
    ET.SubElement(joint, "child", link="payload")
    ET.SubElement(joint, "origin", xyz=" ".join(f"{x:.12g}" for x in place_m), rpy="0 0 0")


def is_pair(name: str) -> bool:
    """Whether a disturbance is drawn from ... to, and not around nothing."""
    return isinstance(getattr(Ranges, name, None), tuple)


def ranges_of(told: Mapping[str, tuple[float, ...]], base: Ranges | None = None) -> Ranges:
    """``base`` (nothing differs if None) with what was told: name -> from, to; a single number is a half-width, or goes
    from nothing to there. Raises :class:`InputError` for names that :class:`Ranges` lacks, and for what it refuses.
    """
    base, known = base or Ranges.none(), {f.name: f for f in fields(Ranges)}
    found = {}
    for name, values in told.items():
        if name not in known:
            raise InputError(f"no disturbance is called {quoted(name)}; there are {', '.join(known)}")
        if not isinstance(known[name].default, tuple):
            if len(values) != 1:
                raise InputError(f"the range {name} is a half-width: give it one number, got {len(values)}")
            found[name] = values[0]
        elif len(values) == 1:
            nothing = getattr(Ranges.none(), name)[0]
            found[name] = tuple(sorted((nothing, values[0])))
        else:
            found[name] = tuple(values)
    return replace(base, **found)
