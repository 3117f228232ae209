"""How the simulated robot differs from the planned one; the paper's own differs "slightly" too (Sec. VI-B)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.robot.changes import MOMENTS, scale

FRICTION = 0.8  # rubber sole on dry floor; the ground has 1, and the engine multiplies the two
LIGHT_KG = 0.01  # links below this are the massless dummies of multi-axis joints and are left alone


@dataclass(frozen=True)
class Ranges:
    """Half-widths of the uniform draws of :meth:`Perturbation.draw`; every link is drawn by itself."""

    mass: float = 0.05  # [1], relative
    com_m: float = 0.015  # [m], each axis
    inertia: float = 0.10  # [1], relative
    friction: tuple[float, float] = (0.5, 1.0)  # [1], from ... to
    delay_s: tuple[float, float] = (0.0, 0.004)  # [s], from ... to
    motor_gain: float = 0.05  # [1], relative error of every torque, typical of current-controlled drives

    @property
    def known_delay_s(self) -> float:
        """What a laboratory measures beforehand [s]: the middle of the delays. What a robot is off it, nobody knows."""
        return sum(self.delay_s) / 2

    def __str__(self) -> str:
        links = f"masses ±{100 * self.mass:g} %, centres of mass ±{1000 * self.com_m:g} mm per axis, "
        links += f"inertias ±{100 * self.inertia:g} %, motors ±{100 * self.motor_gain:g} %, "
        slow, late = (1000 * x for x in self.delay_s)
        delay = f"commands {slow:g} ... {late:g} ms late and sent {1000 * self.known_delay_s:g} ms ahead"
        return links + f"friction {self.friction[0]:g} ... {self.friction[1]:g}, " + delay


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

        return cls(
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

    def robot(self, robot: Robot) -> Robot:
        """The robot as it really is: ``robot`` with its masses, inertias and centres of mass changed."""
        if not (self.mass or self.inertia or self.com):
            return robot
        root = ET.fromstring(robot.urdf)
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
        real = Robot.from_text(ET.tostring(root, encoding="unicode"), robot.config_text)
        return real.under_gravity(robot.gravity)

    def to_json(self) -> dict:
        """All numbers as plain data."""
        return asdict(self)
