"""What ``jumplab robot check`` finds out about a URDF, as one result; above all, whether five links describe it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.description import Robot, files_of
from jumplab.robot.sagittal import SagittalModel
from jumplab.robot.stance import check_stance, com_from_toe, configuration
from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.config import read_toml
from jumplab.robot_import.jumper import Jumper, make_jumper
from jumplab.robot_import.roles import Roles
from jumplab.robot_import.soles import Sole
from jumplab.robot_import.starter import safe_name, starter
from jumplab.robot_import.tree import Tree, moving_count
from jumplab.robot_import.urdf import parse, read_urdf

SAMPLES = 24  # fixed random postures over the whole joint range
RATE_RAD_S = 3.0  # of every link, for the momentum
COM_LIMIT_M = 2e-3  # twice what the audit allows the CoM in flight; canted axes beyond it are refused
SHARE_LIMIT = 0.01  # [1] of pitch inertia, and of momentum


# five links against the full robot ------------------------------------------------------------------
@dataclass(frozen=True)
class ReductionError:
    """Largest difference between the sagittal and the full model; the shares are of the largest value seen."""

    mass_kg: float
    com_m: float
    inertia_kgm2: float
    momentum_kgm2_s: float
    inertia_share: float
    momentum_share: float


def reduction_error(robot: Robot) -> ReductionError:
    """Compare mass, CoM, pitch inertia and angular momentum of both models on random symmetric motions."""
    s, model, rng = robot.sagittal, robot.model, np.random.default_rng(8)
    data = model.createData()
    com, full, flat = [], [], []
    for _ in range(SAMPLES):
        joints = s.lower + rng.uniform(0.05, 0.95, 4) * (s.upper - s.lower)
        angles = s.link_angles(joints, rng.uniform(-0.3, 0.8))
        rates = rng.uniform(-RATE_RAD_S, RATE_RAD_S, 5)
        pin.ccrba(model, data, configuration(robot, angles), _velocity(robot, angles, rates))
        com.append(data.com[0][[0, 2]] - com_from_toe(robot, angles))
        full.append((data.Ig.inertia[1, 1], data.hg.angular[1]))
        flat.append(_planar(s, angles, rates))
    off, top = np.abs(np.subtract(full, flat)).max(axis=0), np.abs(full).max(axis=0)
    mass = abs(robot.total_mass - s.total_mass)
    return ReductionError(mass, float(np.abs(com).max()), *off.tolist(), *(off / top).tolist())


def _planar(s: SagittalModel, angles: np.ndarray, rates: np.ndarray) -> tuple[float, float]:
    """Pitch inertia and angular momentum about the CoM of the five links; vectors as x + iz, turned by exp(-ia)."""
    arms, turn = s.com_arms() @ [1, 1j], np.exp(-1j * angles)
    r, v = (x - s.mass @ x / s.total_mass for x in (arms @ turn, arms @ (-1j * rates * turn)))
    return s.inertia.sum() + s.mass @ np.abs(r) ** 2, s.inertia @ rates - s.mass @ (r.conj() * v).imag


def _velocity(robot: Robot, angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Rates (nv,) of the full robot: toe at rest, links turning at ``rates``."""
    s, model, turn = robot.sagittal, robot.model, np.exp(-1j * angles[:4])
    v = np.zeros(model.nv)
    base = np.array([*s.span[:3], s.base]) @ [1, 1j] @ (-1j * rates[:4] * turn) / turn[3]
    v[0], v[2], v[4] = base.real, base.imag, rates[3]
    joints = s.joint_angles(rates)
    for name, row, sign in robot.role_signs():
        v[model.idx_vs[model.getJointId(name)]] = sign * joints[row]
    return v


def check_reduction(robot: Robot) -> ReductionError:
    """The error, or :class:`RobotError` where the sagittal plane is no model of this robot."""
    error = reduction_error(robot)
    worst = max(error.inertia_share, error.momentum_share)
    if error.com_m > COM_LIMIT_M or worst > SHARE_LIMIT:
        raise RobotError(
            f"robot {robot.name}: its legs do not move in the sagittal plane: against the full robot the CoM is off by "
            f"{1e3 * error.com_m:.2f} mm, inertia or momentum by {100 * worst:.2f} %, at most {1e3 * COM_LIMIT_M:g} mm "
            f"and {100 * SHARE_LIMIT:g} % can be planned with; hold canted joints with [locked], or straighten "
            f"their axes"
        )
    return error


# checkup ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Draft:
    """A URDF with a first description: ``text`` is the TOML, ``roles`` and ``sole`` what was found."""

    text: str
    roles: Roles
    sole: Sole


@dataclass(frozen=True)
class Checkup:
    """A robot that can be planned with, and how it came about."""

    robot: Robot
    jumper: Jumper  # its lumped bodies and the URDF as it was
    error: ReductionError  # sagittal model against full robot
    stance: np.ndarray  # (5,) absolute link angles of the standing posture [rad]

    def rows(self) -> list[dict]:
        """One row per role: joints, direction of their axes, range, torque and speed."""
        s, out = self.robot.sagittal, []
        for i, (role, pair) in enumerate(self.robot.joints.items()):
            row = dict.fromkeys(("role", "left", "right", "axes", "range", "N m", "rad/s"), "")
            row |= {"role": role.replace("_", " "), "left": "held", "right": "held"}
            if pair:
                row["left"], row["right"] = pair
                row["axes"] = " ".join("+y" if x > 0 else "-y" for x in s.signs[i])
                row["range"] = f"{s.lower[i]:+.2f} ... {s.upper[i]:+.2f}"
                row["N m"], row["rad/s"] = f"{s.effort[i] / 2:.4g}", f"{s.speed[i]:.4g}"
            out.append(row)
        return out

    def lines(self) -> list[str]:
        """What else is worth knowing, a line each."""
        r, tree, e = self.robot, self.jumper.tree, self.error
        moving, foot, com = len(r.joint_names), r.foot, com_from_toe(r, self.stance)
        out = [
            f"robot {r.name}: {r.total_mass:.3f} kg ({tree.mass:.3f} kg in the XML), {moving} of "
            f"{moving_count(tree)} joints move, {len(self.jumper.lumped.held)} are held off zero",
            f"sole: {1e3 * foot.heel:.0f} ... {1e3 * foot.toe:.0f} mm from the last leg joint, "
            f"{2e3 * foot.half_width:.0f} mm wide, {-1e3 * foot.sole_z:.0f} mm below it",
            f"standing: CoM {com[1]:.3f} m up, knee {r.stance['knee_rad']:.2f} rad, "
            f"trunk {r.stance['trunk_pitch_rad']:.2f} rad",
            f"sagittal against full model: mass {e.mass_kg:.1e} kg, CoM {e.com_m:.1e} m, inertia {e.inertia_kgm2:.1e} "
            f"kg m^2, L {e.momentum_kgm2_s:.1e} kg m^2/s",
        ]
        return out + [f"changed: {what}: {x:.3g} {unit}" for what, (x, unit) in self.jumper.lumped.changed.items()]


def all_faults(path: str | Path, repair: tuple[str, ...] = ()) -> list[str]:
    """Every fault of a URDF file, one sentence each; raises :class:`RobotError` if it is no URDF at all."""
    path = Path(path)
    return list(urdf_checks.faults(parse(read_urdf(path), path.name), path.name, repair))


def draft(path: str | Path, repair: tuple[str, ...] = ()) -> Draft:
    """Find the roles in a URDF and write the first TOML file for it; raises :class:`RobotError`."""
    path = Path(path)
    root = parse(read_urdf(path), path.name)
    urdf_checks.check(root, path.name, repair)
    tree = Tree(root, path.name, path, "inertia" in repair)
    return Draft(*starter(tree, str(path.resolve()), safe_name(root.get("name") or path.stem), repair))


def check(path: str | Path, config_text: str) -> Checkup:
    """Build the robot that a URDF and a configuration describe, and measure it; raises :class:`RobotError`."""
    path = Path(path)
    config = read_toml(config_text, "robot configuration")
    if "source" not in config:
        raise RobotError("robot configuration: the table [source] is missing: it names trunk, forward, up and repair")
    jumper = make_jumper(read_urdf(path), config, path.name, path)
    robot = Robot.from_text(jumper.urdf, jumper.config_text)
    return Checkup(robot, jumper, check_reduction(robot), check_stance(robot))


def examine(robot: str | Path, repair: tuple[str, ...] = ()) -> Checkup:
    """The checkup of what :meth:`Robot.load` takes; roles are found where no table [source] tells them."""
    path, config = files_of(robot)
    told = config is not None and "source" in read_toml(config, "robot configuration")
    return check(path, config if told else draft(path, repair).text)
