"""What ``jumplab robot check`` finds out about a URDF, as one result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jumplab.errors import RobotError
from jumplab.robot.accuracy import ReductionError, check_reduction
from jumplab.robot.description import SHIPPED, Robot
from jumplab.robot.stance import check_stance, com_from_toe
from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.config import entry, read_toml
from jumplab.robot_import.jumper import Jumper, make_jumper
from jumplab.robot_import.roles import Roles
from jumplab.robot_import.starter import Sole, safe_name, starter
from jumplab.robot_import.tree import Tree, moving_count
from jumplab.robot_import.urdf import locate, parse, read_urdf

ROLE_WORDS = {
    "hip_pitch": "hip pitch",
    "knee": "knee",
    "ankle_pitch": "ankle pitch",
    "shoulder_pitch": "shoulder pitch",
}


@dataclass(frozen=True)
class Draft:
    """A URDF with a first description: ``text`` is the TOML, ``roles`` and ``sole`` what was found."""

    text: str
    roles: Roles
    sole: Sole


@dataclass(frozen=True)
class Checkup:
    """A robot that can be planned with, and how it came about.

    Attributes
    ----------
    robot : the robot.
    jumper : its lumped bodies and the URDF as it was.
    error : sagittal model against full robot.
    stance : absolute link angles (5,) of the standing posture.
    """

    robot: Robot
    jumper: Jumper
    error: ReductionError
    stance: np.ndarray

    def rows(self) -> list[dict]:
        """One row per role: joints, direction of their axes, range, torque and speed."""
        s, out = self.robot.sagittal, []
        for i, (role, word) in enumerate(ROLE_WORDS.items()):
            pair = self.robot.joints[role]
            if not pair:
                out.append(
                    {"role": word, "left": "held", "right": "held", "axes": "", "range": "", "N m": "", "rad/s": ""}
                )
                continue
            axes = " ".join("+y" if x > 0 else "-y" for x in s.signs[i])
            out.append({"role": word, "left": pair[0], "right": pair[1], "axes": axes,
                        "range": f"{s.lower[i]:+.2f} ... {s.upper[i]:+.2f}", "N m": f"{s.effort[i] / 2:.4g}",
                        "rad/s": f"{s.speed[i]:.4g}"})  # fmt: skip
        return out

    def lines(self) -> list[str]:
        """What else is worth knowing, a line each."""
        r, tree = self.robot, self.jumper.tree
        moving, foot = len(r.joint_names), r.foot
        com = com_from_toe(r, self.stance)
        e = self.error
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
    """The checkup of a shipped robot, of a TOML file, or of a URDF whose roles are found; raises :class:`RobotError`.

    Parameters
    ----------
    robot : name of a shipped robot, or path of a TOML or URDF file.
    repair : what may be repaired where roles are found, see :meth:`jumplab.robot.Robot.from_urdf`.
    """
    path = SHIPPED.get(str(robot)) or Path(robot)
    if path.suffix != ".toml":
        return check(path, draft(path, repair).text)
    try:
        text = path.read_text()
    except (OSError, ValueError) as e:
        raise RobotError(f"{path}: cannot be read as text ({type(e).__name__})") from e
    config = read_toml(text, str(path))
    urdf = locate(entry(config, "urdf", kind=str), path.parent)
    return check(urdf, text if "source" in config else draft(urdf, repair).text)
