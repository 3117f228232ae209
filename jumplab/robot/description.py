"""The Robot object: what a URDF and its role file say, checked, immutable, and shared by every
stage.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.arguments import checked, real
from jumplab.errors import RobotError, Shown, quoted, require_type
from jumplab.robot import changes, foreign
from jumplab.robot.files import (
    MOTORS,
    ROLES,
    SHIPPED,
    STANCE,
    TABLES,
    check_entries,
    entry,
    files_of,
    numbers,
    read_text,
    read_toml,
    roles_table,
)
from jumplab.robot.locked import LockedJoint, locked_joints
from jumplab.robot.motors import Bus, MotorLimits, read_only
from jumplab.robot.reduction import in_plane
from jumplab.robot.sagittal import SagittalModel, reduce
from jumplab.robot.stance import check_stance, standing
from jumplab.task import GRAVITY


@dataclass(frozen=True)
class Foot:
    """Sole rectangle in the frames of the two foot links [m]."""

    frames: tuple[str, str]
    heel: float
    toe: float
    half_width: float
    sole_z: float

    @cached_property
    def corners(self) -> np.ndarray:
        """(4, 3) corners in the foot frame [m]: heel right and left, toe right and left."""
        w = self.half_width
        return read_only([[x, y, self.sole_z] for x in (self.heel, self.toe) for y in (-w, w)])

    @cached_property
    def center(self) -> np.ndarray:
        """(3,) middle of the sole in the foot frame [m]."""
        return read_only([(self.heel + self.toe) / 2, 0.0, self.sole_z])

    @cached_property
    def tip(self) -> np.ndarray:
        """(3,) middle of the toes' edge in the foot frame [m], about which the foot tips."""
        return read_only([self.toe, 0.0, self.sole_z])


@dataclass(frozen=True, repr=False)
class Robot(Shown):
    """A humanoid: the texts of its URDF and of its TOML file, and all that follows from them; made
    by :meth:`load`.

    Everything is read-only, so that :attr:`hash` names what is planned with; :meth:`with_limits`,
    :meth:`with_mass` and :meth:`with_stance` give another robot. Only :attr:`model`, Pinocchio's,
    can be written to: each user's own copy.
    """

    # the XML text itself, so that a result folder can carry its robot
    urdf: str = field(repr=False)
    config_text: str = field(repr=False)
    gravity: float = GRAVITY  # [m/s^2] that :attr:`model` feels; no part of the description
    name: str = field(init=False)  # short, for file names and messages
    # role -> (left, right) names; shoulder () if arms held
    joints: Mapping[str, tuple[str, ...]] = field(init=False)
    foot: Foot = field(init=False)
    # knee_rad, trunk_pitch_rad, shoulder_rad of the standing posture
    stance: Mapping[str, float] = field(init=False)
    # joint -> angle [rad] of the standing posture, beside those
    rest: Mapping[str, float] = field(init=False)
    # [1] share of the speed limit up to which full torque is available
    corner_speed_ratio: float = field(init=False)
    motors: Mapping[str, Mapping[str, float]] = field(
        init=False
    )  # key of MOTORS -> joint -> number, where one is known

    def line(self) -> str:
        """Name, mass, joints, hash."""
        arms = "" if self.joints["shoulder_pitch"] else ", arms held"
        return (
            f"{self.name}, {self.total_mass:.1f} kg, {len(self.joint_names)} joints{arms}, hash "
            f"{self.hash}"
        )

    @classmethod
    def load(cls, name_or_path: str | Path = "bhr", *, repair: tuple[str, ...] = ()) -> Robot:
        """Load a robot; raises :class:`RobotError` if there is none, or if it is not fit for
        jumping.

        Parameters
        ----------
        name_or_path : name of a shipped robot (:data:`SHIPPED`), or path of a TOML file or of a
            URDF. Of a bare URDF, roles, soles and standing posture are found.
        repair : of a bare URDF, what may be repaired: "inertia" (the nearest that a solid can
            have), "massless" (a gram for bodies without any).
        """
        urdf, folder, config = files_of(name_or_path)
        if config is None or "source" in read_toml(config, urdf):
            return foreign.importer().examine(name_or_path, repair).robot
        text = read_text(folder / urdf)
        if name_or_path not in SHIPPED:
            foreign.importer().check_texts(text, config, urdf)
        return cls(text, config)

    @classmethod
    @checked
    def from_text(cls, urdf: str, config_text: str) -> Robot:
        """The robot of two texts (URDF, TOML), checked as files are; raises :class:`RobotError`."""
        foreign.importer().check_texts(urdf, config_text)
        return cls(urdf, config_text)

    def __post_init__(self) -> None:
        require_type(self.urdf, str, "the URDF's text")
        require_type(self.config_text, str, "the configuration's text")
        real(self.gravity, "gravity", "m/s^2")
        config = read_toml(self.config_text, "robot configuration")
        check_entries(config, TABLES)
        get = partial(entry, config)
        x = get("feet", "sole_x_m", count=2)
        y = get("feet", "sole_y_m", count=2)
        links = get("feet", "links", kind=str, count=2)
        foot = Foot(tuple(links), x[0], x[1], (y[1] - y[0]) / 2, get("feet", "sole_z_m"))
        if not (x[0] < x[1] and y[0] < y[1]):
            raise RobotError(
                f"robot configuration: the sole {x} x {y} m has no area; give [heel, toe] and "
                f"[right, left]"
            )
        corner = get("actuators", "corner_speed_ratio")
        if not 0 < corner < 1:
            raise RobotError(
                f"robot configuration: corner_speed_ratio = {corner:g} must lie between 0 and 1"
            )
        stance = {key: get("stance", key) for key in STANCE}
        motors = {key: MappingProxyType(numbers(config, "actuators", key)) for key in MOTORS}
        values = {
            "name": get("name", kind=str),
            "joints": MappingProxyType(roles_table(config)),
            "foot": foot,
            "stance": MappingProxyType(stance),
            "rest": MappingProxyType(numbers(config, "rest")),
            "corner_speed_ratio": corner,
            "motors": MappingProxyType(motors),
        }
        for key, value in values.items():
            object.__setattr__(self, key, value)  # once: from here on the dataclass is frozen
        self._check_names()
        self._check_numbers()

    def error(self, text: str) -> RobotError:
        """An error that begins with the robot's name."""
        return RobotError(f"robot {self.name}: {text}")

    def __reduce__(self) -> tuple:
        # so what another process gets is read-only as well
        return Robot, (self.urdf, self.config_text, self.gravity)

    def _check_names(self) -> None:
        for role, pair in self.joints.items():
            for name in pair:
                if not self._model.existJointName(name):
                    raise self.error(
                        f"role {role} names the joint {name!r}, which the URDF lacks; correct "
                        f"the name"
                    )
        for name, ratio in self.motors["corner_speed_ratios"].items():
            most = max(1.0, self.motors["no_load_ratios"].get(name, 1.0))
            if not (self._model.existJointName(name) and 0 < ratio < most):
                raise self.error(
                    f"corner_speed_ratios: {name} = {ratio:g} must name a joint, and lie "
                    f"between 0 and {most:g}"
                )
        for key, least in MOTORS.items():  # no motor gives less than nothing at the speed limit
            for name, value in self.motors[key].items() if least is not None else ():
                if name not in self.joint_names or value < least:
                    raise self.error(
                        f"{key}: {name} = {value:g} must name a joint that moves, and be at "
                        f"least {least:g}"
                    )
        for name in self.foot.frames:
            if not self._model.existFrame(name, pin.FrameType.BODY):
                raise self.error(f"the foot link {name!r} is not in the URDF; correct the name")

    def _check_numbers(self) -> None:
        _ = self.bus
        for name, a in self.actuators.items():
            in_order = a["lower"] < a["upper"] and a["effort"] > 0 and a["speed"] > 0
            if not (in_order and np.all(np.isfinite([*a.values()]))):
                raise self.error(
                    f"joint {name!r} has range {a['lower']:g} ... "
                    f"{a['upper']:g} rad, effort {a['effort']:g} N m, speed {a['speed']:g} rad/s; "
                    f"all must be finite, positive and in order"
                )

    def _check_limits(self) -> None:
        """Refuse what the URDF parser would complain of on stderr, in lines of its own."""
        try:
            urdf = ET.fromstring(self.urdf)
        except ET.ParseError as e:
            raise self.error(f"the URDF is not XML: {e}") from None
        for joint in urdf.iterfind("joint/limit/.."):
            for key, text in joint.find("limit").items():
                try:
                    float(text)
                except ValueError:
                    raise self.error(
                        f"joint {joint.get('name')!r}: the limit {key!r} must be a number, got "
                        f"{quoted(text)}"
                    ) from None

    @cached_property
    def _model(self) -> pin.Model:
        """The model that is never handed out."""
        self._check_limits()
        try:
            model = pin.buildModelFromXML(self.urdf, pin.JointModelFreeFlyer())
        except ValueError as e:
            raise self.error(f"Pinocchio cannot read the URDF: {str(e).splitlines()[0]}") from e
        model.gravity.linear = np.array([0.0, 0.0, -self.gravity])
        for name, armature in self.motors["armature"].items():
            if model.existJointName(name):  # if not, it is refused in a moment
                model.armature[model.idx_vs[model.getJointId(name)]] = armature
        return model

    @property
    def model(self) -> pin.Model:
        """Pinocchio model with a free-flyer base, a new copy each time (10 us): what is written to
        it stays in it.

        Its inverse dynamics and inertia matrix know the armature of the motors, not what they
        lose (:meth:`.MotorLimits.lost`). Keep it in a variable, with a ``model.createData()`` for
        each user.
        """
        return self._model.copy()

    @checked
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
        """Another robot, with other torques, speeds or ranges; corner and no-load speeds follow the
        speeds.

        Armature, friction and damping of the motors stay as they are.

        Roles are those of :attr:`joints`, or hip, knee, ankle, shoulder; where a joint and its role
        are both named, the joint's own counts; joints that are held (:attr:`locked`) have only an
        effort. The URDF gets the new numbers, the TOML a remark on each, so the :attr:`hash` is
        new. Raises :class:`RobotError` for names that the robot lacks, for numbers that are no
        limits, and if the robot cannot stand within them.

        Parameters
        ----------
        effort, speed : factors [1] on the limits as they are: one for all joints, or a mapping from
            joints or roles.
        joints : joint or role -> new values of ``lower``, ``upper`` [rad], ``effort`` [N m] or
            ``speed`` [rad/s], some or all; the range of a role in the signs of :attr:`sagittal`.
        """
        factors = {"effort": effort, "speed": speed}
        return self._changed(*changes.limits(self, factors, joints))

    def with_mass(
        self,
        link: str | Sequence[str] | None = None,
        *,
        mass_kg: float | None = None,
        factor: float | None = None,
    ) -> Robot:
        """Another robot, some links of which weigh otherwise: each ``mass_kg`` [kg], or ``factor``
        times as much; all of them if None is named.

        The inertia scales with the mass, the CoM of the link stays. Name both of a pair,
        ``("left_thigh", "right_thigh")``: with one of them the robot is no longer :attr:`planar`.
        The URDF gets the new numbers, the TOML a remark on each, so the :attr:`hash` is new. Raises
        :class:`RobotError` for links that the robot lacks or that have no mass, for numbers that
        are none, and if the robot cannot stand so.
        """
        return self._changed(*changes.masses(self, link, mass_kg, factor))

    def with_gears(self, ratios: Mapping[str, float]) -> Robot:
        """Another robot, whose motors turn more often for a turn of their joints: by factors
        ``ratios`` [1] of joints or roles ("knee"). Torques grow by the factor and speeds fall by
        it, armature and damping grow with its square, dry friction with the factor.

        Raises :class:`RobotError` for names that the robot lacks and for numbers that are no
        factor.
        """
        geared = replace(self, config_text=changes.gears(self, ratios))
        slower = {key: 1 / ratio for key, ratio in ratios.items()}
        return geared.with_limits(effort=ratios, speed=slower)

    def with_rotors(self, factor: float = 1.0) -> Robot:
        """Another robot, whose motors have rotors where its files give none: an estimate from their
        peak torque (2.2e-5 kg m^2 of armature per (N m)^1.5, which is the G1's within a third),
        ``factor`` [1] times as large.

        Raises :class:`RobotError` for a number that is no factor, and if all motors have rotors.
        """
        return replace(self, config_text=changes.rotors(self, factor))

    def with_legs(self, factor: float = 1.0, *, thigh: float = 1.0, shank: float = 1.0) -> Robot:
        """Another robot, whose thighs and shanks are ``factor`` [1] times as long, or each by a
        factor of its own besides, and weigh the same. The URDF gets the new numbers, the TOML a
        remark on each, so the :attr:`hash` is new. Raises :class:`RobotError` for links that do not
        run along their own z from joint to joint, as those of imported robots may not, for numbers
        that are no factor, and if the robot cannot stand so.
        """
        return self._changed(*changes.legs(self, factor, thigh, shank))

    def _changed(self, urdf: str, remarks: list[str], config_text: str = "") -> Robot:
        """The robot of another URDF, with remarks in its TOML (or another one); itself without."""
        if not remarks:
            return self
        lines = "".join(f"# changed: {remark}\n" for remark in remarks)
        text = (config_text or self.config_text).rstrip()
        robot = replace(self, urdf=urdf, config_text=f"{text}\n{lines}")
        foreign.importer().check_texts(robot.urdf, robot.config_text)
        check_stance(robot)
        return robot

    def with_stance(self, **stance: float) -> Robot:
        """The same robot, standing otherwise: ``knee_rad``, ``trunk_pitch_rad``, ``shoulder_rad``
        [rad]; a new hash.

        Raises :class:`RobotError` for other names. Whether it can stand so,
        :func:`.stance.check_stance` says.
        """
        unknown = sorted(stance.keys() - self.stance.keys())
        if unknown:
            raise RobotError(f"a stance has {', '.join(self.stance)}, not {', '.join(unknown)}")
        import tomlkit

        config = tomlkit.parse(self.config_text)
        config["stance"].update({key: real(angle, key, "rad") for key, angle in stance.items()})
        return replace(self, config_text=tomlkit.dumps(config))

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints in Pinocchio's order (nv - 6 of them)."""
        return tuple(self._model.names[2:])

    @cached_property
    def limits(self) -> MotorLimits:
        """Ranges and motors of the joints (nv - 6 rows), in Pinocchio's order; from the URDF, and
        from the TOML for what a URDF cannot hold.

        Without numbers of its own a motor's no-load speed is its speed limit, and armature,
        friction and damping are zero.
        """
        m = self._model
        q = m.idx_qs[2:]
        v = m.idx_vs[2:]
        speed = m.upperVelocityLimit[v]
        defaults = MOTORS | {"corner_speed_ratios": self.corner_speed_ratio}
        corner, no_load, *losses = (
            np.array([self.motors[key].get(name, default) for name in self.joint_names])
            for key, default in defaults.items()
        )
        ends = m.lowerPositionLimit[q], m.upperPositionLimit[q]
        effort = m.upperEffortLimit[v]
        return MotorLimits(*ends, speed, effort, corner * speed, no_load * speed, *losses)

    @cached_property
    def bus(self) -> Bus:
        """Limits of all motors together, and of the warmth of each; nothing is limited that the
        TOML does not name.
        """
        config = read_toml(self.config_text, "robot configuration")
        power = entry(config, "bus", "power_w", default=np.inf)
        share = entry(config, "bus", "regeneration", default=1.0)
        if not (power > 0 and 0 <= share <= 1):
            raise self.error(
                f"[bus]: power_w = {power:g} W must be positive, and regeneration = {share:g} "
                "between 0 and 1"
            )
        columns = []
        for key, default in (("losses", 0.0), ("rms", np.inf)):
            given = numbers(config, "bus", key)
            efforts = self.limits.effort + (np.inf if key == "losses" else 0.0)
            most = dict(zip(self.joint_names, efforts, strict=True))
            for name, value in given.items():
                if not 0 < value <= most.get(name, -1):
                    raise self.error(
                        f"[bus.{key}]: {name} = {value:g} must name a joint that moves, and be "
                        f"positive, at most {most.get(name, np.inf):g}"
                    )
            columns.append(read_only([given.get(name, default) for name in self.joint_names]))
        return Bus(power, share, *columns)

    @cached_property
    def locked(self) -> tuple[LockedJoint, ...]:
        """Joints of the published robot that hold heavy parts on the base and never move."""
        return locked_joints(self)

    @cached_property
    def actuators(self) -> Mapping[str, Mapping[str, float]]:
        """joint -> its row of :attr:`limits`, by the names of :class:`.MotorLimits`."""
        columns = vars(self.limits)
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        named = [MappingProxyType(dict(zip(columns, row, strict=True))) for row in rows]
        return MappingProxyType(dict(zip(self.joint_names, named, strict=True)))

    @cached_property
    def sagittal(self) -> SagittalModel:
        """The symmetric five-link model of this robot."""
        return reduce(self)

    @cached_property
    def planar(self) -> bool:
        """Whether five links in the plane describe this robot exactly; if not, three steps cannot
        plan it.
        """
        return bool(in_plane(self))

    @cached_property
    def standing(self) -> np.ndarray:
        """Configuration (nq,) of the standing posture, if not :attr:`planar`."""
        return read_only(standing(self))

    def role_signs(self) -> tuple[tuple[str, int, float], ...]:
        """(joint, row of its role, sign): joint angle = sign * sagittal angle."""
        rows = enumerate(zip(ROLES, self.sagittal.signs, strict=True))
        return tuple(
            (n, row, float(s))
            for row, (role, signs) in rows
            for n, s in zip(self.joints[role], signs, strict=False)
        )

    @cached_property
    def total_mass(self) -> float:
        """Mass of the robot [kg]."""
        masses = [inertia.mass for inertia in self._model.inertias]
        # from 3.12 on, sum() rounds otherwise, and the last digit moves plans
        return float(np.cumsum(masses)[-1])

    @cached_property
    def hash(self) -> str:
        """Twelve hexadecimal digits that change whenever URDF or configuration change."""
        return hashlib.sha256((self.urdf + "\0" + self.config_text).encode()).hexdigest()[:12]
