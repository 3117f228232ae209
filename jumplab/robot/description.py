"""The Robot object: what a URDF and its role file say, checked, immutable, and shared by every stage."""

from __future__ import annotations

import hashlib
import os
import tomllib
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError, said
from jumplab.robot.sagittal import SagittalModel, reduce

GRAVITY = 9.8  # [m/s^2], stated by the paper (Sec. III); URDF tools default to 9.81
SHIPPED = {"bhr": Path(__file__).parent / "bhr" / "bhr.toml"}
ROLES = ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch")


def _toml(text: str, where: str) -> dict:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise RobotError(f"{where}: not a TOML file: {e}") from e


def _entry(config: dict, *path: str, kind: type = float, count: int | None = None):
    """One checked entry of the configuration: a finite number or a text, or ``count`` of them."""
    where, value = ".".join(path), config
    for key in path:
        if not isinstance(value, dict) or key not in value:
            raise RobotError(f"robot configuration: the entry {where!r} is missing")
        value = value[key]
    items = value if count else [value]
    numbers = kind is float
    good = isinstance(items, list) and len(items) == (count or 1)
    good = good and all(isinstance(x, (int, float) if numbers else str) and not isinstance(x, bool) for x in items)
    if not good or (numbers and not np.all(np.isfinite(items))):
        wanted = "a finite number" if numbers else "a text"
        raise RobotError(
            f"robot configuration: {where!r} = {value!r}, must be {f'{count} of ' if count else ''}{wanted}"
        )
    clean = [float(x) if numbers else x for x in items]
    return clean if count else clean[0]


@dataclass(frozen=True)
class Foot:
    """Sole rectangle in the frames of the two foot links [m]."""

    frames: tuple[str, str]
    heel: float
    toe: float
    half_width: float
    sole_z: float

    @property
    def corners(self) -> np.ndarray:
        """(4, 3) corners of the sole in the foot frame [m]: heel right, heel left, toe right, toe left."""
        w = self.half_width
        return np.array([[x, y, self.sole_z] for x in (self.heel, self.toe) for y in (-w, w)])

    @property
    def center(self) -> np.ndarray:
        """(3,) middle of the sole in the foot frame [m]."""
        return np.array([(self.heel + self.toe) / 2, 0.0, self.sole_z])


@dataclass(frozen=True)
class Robot:
    """A humanoid: URDF text, roles of its joints, soles, stance and actuators.

    Attributes
    ----------
    name : short name, used in file names and messages.
    urdf : the XML text itself, so that a result folder can carry its robot.
    joints : role -> (left, right) joint names.
    foot : sole rectangle.
    stance : knee_rad, trunk_pitch_rad, shoulder_rad of the standing posture.
    corner_speed_ratio : share of the speed limit up to which full torque is available.
    """

    name: str
    urdf: str
    joints: dict
    foot: Foot
    stance: dict
    corner_speed_ratio: float
    config_text: str = field(repr=False, default="")

    @classmethod
    def load(cls, name_or_config: str | Path = "bhr") -> Robot:
        """Load a shipped robot by name, or any robot by the path of its TOML file."""
        if not isinstance(name_or_config, str | os.PathLike):
            raise RobotError(f"a robot must be a name or the path of a TOML file, got {said(name_or_config)}")
        path = SHIPPED.get(str(name_or_config)) or Path(name_or_config)
        known = ", ".join(SHIPPED)
        try:
            text = path.read_text()
        except UnicodeDecodeError as e:
            raise RobotError(f"{path}: not a text file, byte {e.start} cannot be read as UTF-8") from e
        except (OSError, ValueError) as e:
            name = str(name_or_config)
            short = name if len(name) < 80 else name[:77] + "..."
            raise RobotError(f"robot {short!r}: neither a shipped robot ({known}) nor a readable TOML file") from e
        config = _toml(text, str(path))
        urdf = config.get("urdf")
        if not isinstance(urdf, str):
            raise RobotError(f"{path}: the entry 'urdf' must name the URDF file beside it, got {urdf!r}")
        try:
            return cls.from_text((path.parent / urdf).read_text(), text)
        except (OSError, UnicodeDecodeError) as e:
            raise RobotError(f"{path}: its URDF {urdf!r} cannot be read as text ({type(e).__name__})") from e

    @classmethod
    def from_text(cls, urdf: str, config_text: str) -> Robot:
        """Build a robot from the text of its URDF and of its TOML configuration; raises :class:`RobotError`."""
        config = _toml(config_text, "robot configuration")
        get = partial(_entry, config)
        x, y = get("feet", "sole_x_m", count=2), get("feet", "sole_y_m", count=2)
        links = get("feet", "links", kind=str, count=2)
        foot = Foot(tuple(links), x[0], x[1], (y[1] - y[0]) / 2, get("feet", "sole_z_m"))
        if not (x[0] < x[1] and y[0] < y[1]):
            raise RobotError(
                f"robot configuration: the sole {x} x {y} m has no area; give [heel, toe] and [right, left]"
            )
        joints = {role: tuple(get("joints", role, kind=str, count=2)) for role in ROLES}
        stance = {key: get("stance", key) for key in ("knee_rad", "trunk_pitch_rad", "shoulder_rad")}
        corner = get("actuators", "corner_speed_ratio")
        if not 0 < corner < 1:
            raise RobotError(f"robot configuration: corner_speed_ratio = {corner:g} must lie between 0 and 1")
        robot = cls(get("name", kind=str), urdf, joints, foot, stance, corner, config_text)
        robot._check_names()
        robot._check_numbers()
        return robot

    def _check_names(self) -> None:
        for role, pair in self.joints.items():
            for name in pair:
                if not self.model.existJointName(name):
                    raise RobotError(f"robot {self.name}: role {role} names the joint {name!r}, which the URDF lacks")
        for name in self.foot.frames:
            if not self.model.existFrame(name):
                raise RobotError(f"robot {self.name}: the foot link {name!r} is not in the URDF")

    def _check_numbers(self) -> None:
        for joint, inertia in enumerate(self.model.inertias):
            name = self.model.names[joint]
            if joint and not (np.isfinite(inertia.mass) and inertia.mass >= 0 and np.all(np.isfinite(inertia.inertia))):
                raise RobotError(f"robot {self.name}: the body moved by {name!r} has mass {inertia.mass:g} kg")
        for name, a in self.actuators.items():
            if not (
                a["lower"] < a["upper"] and a["effort"] > 0 and a["speed"] > 0 and np.all(np.isfinite([*a.values()]))
            ):
                raise RobotError(
                    f"robot {self.name}: joint {name!r} has range {a['lower']:g} ... {a['upper']:g} rad, effort "
                    f"{a['effort']:g} N m, speed {a['speed']:g} rad/s; all must be finite, positive and in order"
                )

    def _check_xml(self) -> None:
        """Refuse what the URDF parser would complain of on stderr, in lines of its own."""
        try:
            root = ET.fromstring(self.urdf)
        except (ET.ParseError, ValueError) as e:
            raise RobotError(f"robot {self.name}: the URDF is no well-formed XML: {e}") from e
        for joint in root.iter("joint"):
            limit = joint.find("limit")
            for key, text in limit.items() if limit is not None else ():
                try:
                    float(text)
                except ValueError:
                    where = f"robot {self.name}: joint {joint.get('name')!r}"
                    raise RobotError(f"{where}: the limit {key!r} must be a number, got {said(text)}") from None

    @cached_property
    def model(self) -> pin.Model:
        """Pinocchio model with a free-flyer base and g = 9.8. Call ``model.createData()`` for each user."""
        self._check_xml()
        try:
            model = pin.buildModelFromXML(self.urdf, pin.JointModelFreeFlyer())
        except ValueError as e:
            raise RobotError(f"robot {self.name}: Pinocchio cannot read the URDF: {str(e).splitlines()[0]}") from e
        model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
        return model

    def under_gravity(self, gravity: float) -> Robot:
        """The same robot whose :attr:`model` feels another gravity [m/s^2]; itself at 9.8."""
        if gravity == GRAVITY:
            return self
        other = replace(self)
        model = self.model.copy()
        model.gravity.linear = np.array([0.0, 0.0, -gravity])
        other.__dict__["model"] = model  # fills the cached property
        return other

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints in Pinocchio's order (nv - 6 of them)."""
        return tuple(self.model.names[2:])

    @cached_property
    def actuators(self) -> dict[str, dict[str, float]]:
        """joint -> lower, upper [rad], speed [rad/s], effort [N m], corner_speed [rad/s]; from the URDF."""
        m, out = self.model, {}
        for name in self.joint_names:
            j = m.getJointId(name)
            iq, iv = m.idx_qs[j], m.idx_vs[j]
            speed = float(m.upperVelocityLimit[iv])
            out[name] = {
                "lower": float(m.lowerPositionLimit[iq]),
                "upper": float(m.upperPositionLimit[iq]),
                "speed": speed,
                "effort": float(m.upperEffortLimit[iv]),
                "corner_speed": self.corner_speed_ratio * speed,
            }
        return out

    @cached_property
    def sagittal(self) -> SagittalModel:
        """The symmetric five-link model of this robot."""
        return reduce(self.model, self.joints, self.foot, self.actuators, self.urdf)

    @cached_property
    def total_mass(self) -> float:
        """Mass of the robot [kg]."""
        return float(sum(inertia.mass for inertia in self.model.inertias))

    @cached_property
    def hash(self) -> str:
        """Twelve hexadecimal digits that change whenever URDF or configuration change."""
        return hashlib.sha256((self.urdf + "\0" + self.config_text).encode()).hexdigest()[:12]
