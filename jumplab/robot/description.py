"""The Robot object: what a URDF and its role file say, checked, immutable, and shared by every stage."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError, Shown, quoted
from jumplab.robot import changes
from jumplab.robot.reduction import in_plane
from jumplab.robot.sagittal import SagittalModel, read_only, reduce
from jumplab.robot.stance import check_stance, standing
from jumplab.robot_import.config import ROLES, entry, read_toml, roles_table, table
from jumplab.robot_import.urdf import locate, read_urdf
from jumplab.task import GRAVITY

if TYPE_CHECKING:
    from jumplab.robot_import.jumper import Jumper

HERE = Path(__file__).parent
MOTORS = {
    "no_load_ratios": 1.0,
    "armature": 0.0,
    "friction": 0.0,
    "damping": 0.0,
}  # tables of [actuators], and defaults
SLIDING_RATE = 0.1  # [rad/s] from about here on dry friction is there in full: a step would have no slope to plan with
SHIPPED = {path.stem: path for path in (HERE / "bhr" / "bhr.toml", *sorted((HERE / "published").glob("*.toml")))}


def files_of(name_or_path: str | Path) -> tuple[Path, str | None]:
    """Path of a robot's URDF and text of its TOML file, None for a bare URDF; raises :class:`RobotError`."""
    if not isinstance(name_or_path, str | os.PathLike):
        raise RobotError(f"a robot must be a name or the path of a TOML file, got {quoted(name_or_path)}")
    name = str(name_or_path)
    path = SHIPPED.get(name) or Path(name)
    if path.suffix.lower() in (".urdf", ".xml", ".mjcf"):
        return path, None
    try:
        text = path.read_text()
    except UnicodeDecodeError as e:
        raise RobotError(f"{path}: not a text file, byte {e.start} cannot be read as UTF-8") from e
    except (OSError, ValueError) as e:
        known, short = ", ".join(SHIPPED), name if len(name) < 80 else name[:77] + "..."
        raise RobotError(f"robot {short!r}: neither a shipped robot ({known}) nor a readable TOML file") from e
    urdf = read_toml(text, str(path)).get("urdf")
    if not isinstance(urdf, str):
        raise RobotError(f"{path}: the entry 'urdf' must name the URDF file beside it, got {urdf!r}")
    return locate(urdf, path.parent), text


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
        return read_only([[x, y, self.sole_z] for x in (self.heel, self.toe) for y in (-w, w)])

    @property
    def center(self) -> np.ndarray:
        """(3,) middle of the sole in the foot frame [m]."""
        return read_only([(self.heel + self.toe) / 2, 0.0, self.sole_z])

    @property
    def tip(self) -> np.ndarray:
        """(3,) middle of the toes' edge in the foot frame [m], about which the foot tips."""
        return read_only([self.toe, 0.0, self.sole_z])


@dataclass(frozen=True, repr=False)
class Robot(Shown):
    """A humanoid: the texts of its URDF and of its TOML file, and all that follows from them; made by :meth:`load`.

    Everything is read-only, so that :attr:`hash` names what is planned with; :meth:`with_limits`, :meth:`with_mass` and
    :meth:`with_stance` give another robot. Only :attr:`model`, Pinocchio's, can be written to: each user's own copy.
    """

    urdf: str = field(repr=False)  # the XML text itself, so that a result folder can carry its robot
    config_text: str = field(repr=False)
    gravity: float = GRAVITY  # [m/s^2] that :attr:`model` feels; no part of the description
    name: str = field(init=False)  # short, for file names and messages
    joints: Mapping[str, tuple[str, ...]] = field(init=False)  # role -> (left, right) names; shoulder () if arms held
    foot: Foot = field(init=False)
    stance: Mapping[str, float] = field(init=False)  # knee_rad, trunk_pitch_rad, shoulder_rad of the standing posture
    rest: Mapping[str, float] = field(init=False)  # joint -> angle [rad] of the standing posture, beside those
    corner_speed_ratio: float = field(init=False)  # [1] share of the speed limit up to which full torque is available
    corner_speed_ratios: Mapping[str, float] = field(init=False)  # joint -> its own share, where one is known
    motors: Mapping[str, Mapping[str, float]] = field(
        init=False
    )  # key of MOTORS -> joint -> number, where one is known

    def line(self) -> str:
        """Name, mass, joints, hash."""
        arms = "" if self.joints["shoulder_pitch"] else ", arms held"
        return f"{self.name}, {self.total_mass:.1f} kg, {len(self.joint_names)} joints{arms}, hash {self.hash}"

    @classmethod
    def load(cls, name_or_path: str | Path = "bhr", *, repair: tuple[str, ...] = ()) -> Robot:
        """Load a robot; raises :class:`RobotError` if there is none, or if it is not fit for jumping.

        Parameters
        ----------
        name_or_path : name of a shipped robot (:data:`SHIPPED`), or path of a TOML file or of a URDF. Of a bare URDF,
            roles, soles and standing posture are found.
        repair : of a bare URDF, what may be repaired: "inertia" (the nearest that a solid can have), "massless" (a gram
            for bodies without any).
        """
        path, config = files_of(name_or_path)
        if config is not None and "source" not in read_toml(config, str(path)):
            return cls.from_text(read_urdf(path), config)
        from jumplab.robot_import.roles import draft  # the importer takes time that most robots need not wait for

        robot = cls.imported(path, draft(path, repair).text if config is None else config)[1]
        check_stance(robot)
        return robot

    @classmethod
    def imported(cls, path: Path, config_text: str) -> tuple[Jumper, Robot]:
        """A published URDF as a jumper and as a robot, by a configuration that has a table [source]; not yet measured.

        Raises :class:`RobotError` if they do not make one.
        """
        config = read_toml(config_text, "robot configuration")
        if "source" not in config:
            missing = "the table [source] is missing: it names trunk, forward, up and repair"
            raise RobotError(f"robot configuration: {missing}")
        from jumplab.robot_import.jumper import make_jumper

        jumper = make_jumper(read_urdf(path), config, path.name, path)
        return jumper, cls.from_text(jumper.urdf, jumper.config_text)

    @classmethod
    def from_text(cls, urdf: str, config_text: str) -> Robot:
        """Build a robot from the text of its URDF and of its TOML configuration; raises :class:`RobotError`."""
        return cls(urdf, config_text)

    def __post_init__(self) -> None:
        config = read_toml(self.config_text, "robot configuration")
        get = partial(entry, config)
        x, y = get("feet", "sole_x_m", count=2), get("feet", "sole_y_m", count=2)
        links = get("feet", "links", kind=str, count=2)
        foot = Foot(tuple(links), x[0], x[1], (y[1] - y[0]) / 2, get("feet", "sole_z_m"))
        if not (x[0] < x[1] and y[0] < y[1]):
            wrong = f"the sole {x} x {y} m has no area; give [heel, toe] and [right, left]"
            raise RobotError(f"robot configuration: {wrong}")
        joints = roles_table(config)
        stance = {key: get("stance", key) for key in ("knee_rad", "trunk_pitch_rad", "shoulder_rad")}
        corner = get("actuators", "corner_speed_ratio")
        if not 0 < corner < 1:
            raise RobotError(f"robot configuration: corner_speed_ratio = {corner:g} must lie between 0 and 1")
        rest = {key: get("rest", key) for key in table(config, "rest")}
        where = "actuators", "corner_speed_ratios"
        own = {key: get(*where, key) for key in table(table(config, where[0]), where[1])}
        motors = {key: table(table(config, where[0]), key) for key in MOTORS}
        motors = {key: {name: get(where[0], key, name) for name in told} for key, told in motors.items()}
        motors = {key: MappingProxyType(told) for key, told in motors.items()}
        joints, stance, rest, own, motors = (MappingProxyType(x) for x in (joints, stance, rest, own, motors))
        told = dict(name=get("name", kind=str), joints=joints, foot=foot, stance=stance, rest=rest)
        told |= dict(corner_speed_ratio=corner, corner_speed_ratios=own, motors=motors)
        for key, value in told.items():
            object.__setattr__(self, key, value)  # once: from here on the dataclass is frozen
        self._check_names()
        self._check_numbers()

    def __reduce__(self) -> tuple:
        return Robot, (self.urdf, self.config_text, self.gravity)  # so what another process gets is read-only as well

    def _check_names(self) -> None:
        for role, pair in self.joints.items():
            for name in pair:
                if not self._model.existJointName(name):
                    raise RobotError(f"robot {self.name}: role {role} names the joint {name!r}, which the URDF lacks")
        for name, ratio in self.corner_speed_ratios.items():
            most = max(1.0, self.motors["no_load_ratios"].get(name, 1.0))
            if not (self._model.existJointName(name) and 0 < ratio < most):
                told = f"corner_speed_ratios: {name} = {ratio:g}"
                raise RobotError(f"robot {self.name}: {told} must be of a joint, and between 0 and {most:g}")
        for key, told in self.motors.items():
            least = MOTORS[key]  # no motor gives less than nothing at the speed limit
            for name, value in told.items():
                if name not in self.joint_names or value < least:
                    said = f"{key}: {name} = {value:g} must be of a joint that moves, and at least {least:g}"
                    raise RobotError(f"robot {self.name}: {said}")
        for name in self.foot.frames:
            if not self._model.existFrame(name):
                raise RobotError(f"robot {self.name}: the foot link {name!r} is not in the URDF")

    def _check_numbers(self) -> None:
        for joint, inertia in enumerate(self._model.inertias):
            name = self._model.names[joint]
            if joint and not (np.isfinite(inertia.mass) and inertia.mass >= 0 and np.all(np.isfinite(inertia.inertia))):
                raise RobotError(f"robot {self.name}: the body moved by {name!r} has mass {inertia.mass:g} kg")
        for name, a in self.actuators.items():
            in_order = a["lower"] < a["upper"] and a["effort"] > 0 and a["speed"] > 0
            if not (in_order and np.all(np.isfinite([*a.values()]))):
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
                    raise RobotError(f"{where}: the limit {key!r} must be a number, got {quoted(text)}") from None

    @cached_property
    def _model(self) -> pin.Model:
        """The model that is never handed out."""
        self._check_xml()
        try:
            model = pin.buildModelFromXML(self.urdf, pin.JointModelFreeFlyer())
        except ValueError as e:
            raise RobotError(f"robot {self.name}: Pinocchio cannot read the URDF: {str(e).splitlines()[0]}") from e
        model.gravity.linear = np.array([0.0, 0.0, -self.gravity])
        for name, armature in self.motors["armature"].items():
            if model.existJointName(name):  # if not, it is refused in a moment
                model.armature[model.idx_vs[model.getJointId(name)]] = armature
        return model

    @property
    def model(self) -> pin.Model:
        """Pinocchio model with a free-flyer base, a new copy each time (10 us): what is written to it stays in it.

        Its inverse dynamics and inertia matrix know the armature of the motors, not their :meth:`lost_torque`. Keep it
        in a variable, and call ``model.createData()`` for each user.
        """
        return self._model.copy()

    def under_gravity(self, gravity: float) -> Robot:
        """The same robot whose :attr:`model` feels another gravity [m/s^2]; itself at its own."""
        return self if gravity == self.gravity else replace(self, gravity=gravity)

    def with_limits(
        self,
        *,
        effort: float | Mapping[str, float] = 1.0,
        speed: float | Mapping[str, float] = 1.0,
        joints: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    ) -> Robot:
        """Another robot, with other torques, speeds or ranges; corner and no-load speeds follow the speeds.

        Armature, friction and damping of the motors stay as they are.

        Parameters
        ----------
        effort, speed : factors [1] on the limits as they are: one for all joints, or a mapping from joints or roles.
        joints : joint or role -> ``lower``, ``upper`` [rad], one or both; a role's in the signs of :attr:`sagittal`.

        Roles are those of :attr:`joints`, or hip, knee, ankle, shoulder; where a joint and its role are both named,
        the joint's own counts. The URDF gets the new numbers, the TOML a remark on each, so the :attr:`hash` is new.
        Raises :class:`RobotError` for names that the robot lacks, for numbers that are no limits, and if the robot
        cannot stand within them.
        """
        factors = {"effort": effort, "speed": speed}
        return self._changed(*changes.limits(self, factors, joints))

    def with_mass(
        self, link: str | Sequence[str] | None = None, *, mass_kg: float | None = None, factor: float | None = None
    ) -> Robot:
        """Another robot, some links of which weigh otherwise: each ``mass_kg`` [kg], or ``factor`` times as much; all
        of them if None is named.

        The inertia scales with the mass, the CoM of the link stays. Name both of a pair, ``("left_thigh",
        "right_thigh")``: with one of them the robot is no longer :attr:`planar`. The URDF gets the new numbers, the
        TOML a remark on each, so the :attr:`hash` is new. Raises :class:`RobotError` for links that the robot lacks or
        that have no mass, for numbers that are none, and if the robot cannot stand so.
        """
        return self._changed(*changes.masses(self, link, mass_kg, factor))

    def with_legs(self, factor: float) -> Robot:
        """Another robot, whose thighs and shanks are ``factor`` times as long, and weigh the same.

        The URDF gets the new numbers, the TOML a remark on each, so the :attr:`hash` is new. Raises
        :class:`RobotError` for links that do not run along their own z from joint to joint, as those of imported
        robots may not, for numbers that are no factor, and if the robot cannot stand so.
        """
        return self._changed(*changes.legs(self, factor))

    def _changed(self, urdf: str, remarks: list[str]) -> Robot:
        """The robot of another URDF, checked to the end, with remarks in its TOML; itself without any."""
        if not remarks:
            return self
        from jumplab.robot.stance import check_stance  # it builds on this class

        said = "".join(f"# changed: {remark}\n" for remark in remarks)
        robot = replace(self, urdf=urdf, config_text=f"{self.config_text.rstrip()}\n{said}")
        check_stance(robot)
        return robot

    def with_stance(self, **stance: float) -> Robot:
        """The same robot, standing otherwise: ``knee_rad``, ``trunk_pitch_rad``, ``shoulder_rad`` [rad]; a new hash.

        Raises :class:`RobotError` for other names. Whether it can stand so, :func:`.stance.check_stance` says.
        """
        unknown = sorted(stance.keys() - self.stance.keys())
        if unknown:
            raise RobotError(f"a stance has {', '.join(self.stance)}, not {', '.join(unknown)}")
        import tomlkit

        config = tomlkit.parse(self.config_text)
        config["stance"].update({key: float(angle) for key, angle in stance.items()})
        return replace(self, config_text=tomlkit.dumps(config))

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints in Pinocchio's order (nv - 6 of them)."""
        return tuple(self._model.names[2:])

    @cached_property
    def actuators(self) -> Mapping[str, Mapping[str, float]]:
        """joint -> lower, upper [rad], speed [rad/s], effort [N m], corner_speed, no_load_speed [rad/s], armature
        [kg m^2], friction [N m], damping [N m s/rad]; from the URDF, and from the TOML what no URDF tells.

        A motor gives its effort up to the corner speed, then less along a line that ends at the no-load speed. Without
        numbers of its own that is the speed limit, and armature, friction and damping are zero.
        """
        m, out = self._model, {}
        for name in self.joint_names:
            j = m.getJointId(name)
            iq, iv = m.idx_qs[j], m.idx_vs[j]
            told = m.lowerPositionLimit[iq], m.upperPositionLimit[iq], m.upperVelocityLimit[iv], m.upperEffortLimit[iv]
            row = dict(zip(("lower", "upper", "speed", "effort"), map(float, told), strict=True))
            ratio = self.corner_speed_ratios.get(name, self.corner_speed_ratio)
            free, *own = (self.motors[key].get(name, default) for key, default in MOTORS.items())
            row |= {"corner_speed": ratio * row["speed"], "no_load_speed": free * row["speed"]}
            out[name] = MappingProxyType(row | dict(zip(tuple(MOTORS)[1:], own, strict=True)))
        return MappingProxyType(out)

    @cached_property
    def armature(self) -> np.ndarray:
        """Inertia of the motors (nv - 6,) as felt at the joints [kg m^2]."""
        return read_only([self.actuators[name]["armature"] for name in self.joint_names])

    @cached_property
    def lossy(self) -> bool:
        """Whether the friction of any motor is known."""
        return any(row["friction"] or row["damping"] for row in self.actuators.values())

    @cached_property
    def _losses(self) -> tuple[np.ndarray, np.ndarray]:
        rows = [self.actuators[name] for name in self.joint_names]
        return tuple(read_only([row[key] for row in rows]) for key in ("friction", "damping"))

    def lost_torque(self, rates: np.ndarray) -> np.ndarray:
        """Torque (..., nv - 6) that the motors lose to their own friction at joint rates (..., nv - 6) [N m].

        friction tanh(rate / :data:`SLIDING_RATE`) + damping rate, in the sense of the rate: what a motor gives is that
        of inverse dynamics and this.
        """
        friction, damping = self._losses
        return friction * np.tanh(np.asarray(rates) / SLIDING_RATE) + damping * rates

    @cached_property
    def sagittal(self) -> SagittalModel:
        """The symmetric five-link model of this robot."""
        return reduce(self._model, self.joints, self.foot, self.actuators, self.urdf)

    @cached_property
    def planar(self) -> bool:
        """Whether five links in the plane stand for it exactly; if not, it has no three steps."""
        return bool(in_plane(self))

    @cached_property
    def standing(self) -> np.ndarray:
        """Pinocchio configuration (nq,) of the standing posture of a robot that is not :attr:`planar`."""
        return read_only(standing(self))

    def role_signs(self) -> tuple[tuple[str, int, float], ...]:
        """(joint, row of its role, sign) for every joint with a role: joint angle = sign * sagittal angle."""
        rows = enumerate(zip(ROLES, self.sagittal.signs, strict=True))
        return tuple(
            (n, row, float(s)) for row, (role, signs) in rows for n, s in zip(self.joints[role], signs, strict=False)
        )

    @cached_property
    def total_mass(self) -> float:
        """Mass of the robot [kg]."""
        masses = [inertia.mass for inertia in self._model.inertias]
        return float(np.cumsum(masses)[-1])  # from 3.12 on, sum() rounds otherwise, and the last digit moves plans

    @cached_property
    def hash(self) -> str:
        """Twelve hexadecimal digits that change whenever URDF or configuration change."""
        return hashlib.sha256((self.urdf + "\0" + self.config_text).encode()).hexdigest()[:12]
