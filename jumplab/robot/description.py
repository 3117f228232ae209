"""The Robot object: what a URDF and its role file say, checked, immutable, and shared by every stage."""

from __future__ import annotations

import hashlib
import tomllib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.sagittal import SagittalModel, reduce

GRAVITY = 9.8  # [m/s^2], stated by the paper (Sec. III); URDF tools default to 9.81
SHIPPED = {"bhr": Path(__file__).parent / "bhr" / "bhr.toml"}
ROLES = ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch")


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
        path = SHIPPED.get(str(name_or_config)) or Path(name_or_config)
        if not path.is_file():
            known = ", ".join(SHIPPED)
            raise RobotError(f"robot {str(name_or_config)!r}: neither a shipped robot ({known}) nor a readable TOML file")
        text = path.read_text()
        try:
            config = tomllib.loads(text)
            urdf = (path.parent / config["urdf"]).read_text()
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
            raise RobotError(f"{path}: not a TOML file: {e}") from e
        except KeyError as e:
            raise RobotError(f"{path}: the entry {e} is missing") from e
        except OSError as e:
            raise RobotError(f"{path}: its URDF {config['urdf']!r} cannot be read: {e.strerror}") from e
        return cls.from_text(urdf, text)

    @classmethod
    def from_text(cls, urdf: str, config_text: str) -> Robot:
        """Build a robot from the text of its URDF and of its TOML configuration."""
        config = tomllib.loads(config_text)
        try:
            feet, sole_x, sole_y = config["feet"], config["feet"]["sole_x_m"], config["feet"]["sole_y_m"]
            foot = Foot(tuple(feet["links"]), sole_x[0], sole_x[1], (sole_y[1] - sole_y[0]) / 2, feet["sole_z_m"])
            joints = {role: tuple(config["joints"][role]) for role in ROLES}
            robot = cls(config["name"], urdf, joints, foot, dict(config["stance"]),
                        float(config["actuators"]["corner_speed_ratio"]), config_text)  # fmt: skip
        except KeyError as e:
            raise RobotError(f"robot configuration: the entry {e} is missing") from e
        robot._check_names()
        return robot

    def _check_names(self) -> None:
        for role, pair in self.joints.items():
            for name in pair:
                if not self.model.existJointName(name):
                    raise RobotError(f"robot {self.name}: role {role} names the joint {name!r}, which the URDF lacks")
        for name in self.foot.frames:
            if not self.model.existFrame(name):
                raise RobotError(f"robot {self.name}: the foot link {name!r} is not in the URDF")

    @cached_property
    def model(self) -> pin.Model:
        """Pinocchio model with a free-flyer base and g = 9.8. Call ``model.createData()`` for each user."""
        try:
            model = pin.buildModelFromXML(self.urdf, pin.JointModelFreeFlyer())
        except ValueError as e:
            raise RobotError(f"robot {self.name}: Pinocchio cannot read the URDF: {str(e).splitlines()[0]}") from e
        model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
        return model

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
        return reduce(self.model, self.joints, self.foot, self.actuators)

    @cached_property
    def total_mass(self) -> float:
        """Mass of the robot [kg]."""
        return float(sum(inertia.mass for inertia in self.model.inertias))

    @cached_property
    def hash(self) -> str:
        """Twelve hexadecimal digits that change whenever URDF or configuration change."""
        return hashlib.sha256((self.urdf + "\0" + self.config_text).encode()).hexdigest()[:12]
