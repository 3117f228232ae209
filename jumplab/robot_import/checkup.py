"""Result of ``jumplab robot check`` on a URDF; above all, whether five links describe it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jumplab.errors import InfeasibleError, RobotError, quoted
from jumplab.robot.contact import posed
from jumplab.robot.description import Robot
from jumplab.robot.files import files_of, read_toml, roles_table
from jumplab.robot.stance import check_held, check_stance, stance_configuration
from jumplab.robot_import import checks as urdf_checks
from jumplab.robot_import.jumper import REPAIRS, make_jumper, source_of
from jumplab.robot_import.lump import Lumped
from jumplab.robot_import.roles import Draft, draft
from jumplab.robot_import.urdf import MOVING, Tree, locate, parse, read_urdf

COLUMNS = ("role", "left", "right", "axes", "range", "N m", "rad/s")


@dataclass(frozen=True)
class Checkup:
    """A robot that can be planned with, and how it came about."""

    robot: Robot
    lumped: Lumped  # its bodies
    tree: Tree  # the URDF as it was

    def rows(self) -> list[dict]:
        """One row per role: joints, direction of their axes, range, torque and speed."""
        s = self.robot.sagittal
        out = []
        for i, (role, pair) in enumerate(self.robot.joints.items()):
            values = ("held", "held", "", "", "", "")
            if pair:
                values = (
                    *pair,
                    " ".join("+y" if x > 0 else "-y" for x in s.signs[i]),
                    f"{s.lower[i]:+.2f} ... {s.upper[i]:+.2f}",
                    f"{s.effort[i] / 2:.4g}",
                    f"{s.speed[i]:.4g}",
                )
            out.append(dict(zip(COLUMNS, (role.replace("_", " "), *values), strict=True)))
        return out

    def lines(self) -> list[str]:
        """Further facts about the robot, a line each."""
        r = self.robot
        moving = len(r.joint_names)
        foot = r.foot
        data = posed(r.model, stance_configuration(r))
        movable = sum(joint.kind in MOVING for joint in self.tree.joints.values())
        return [
            f"robot {r.name}: {r.total_mass:.3f} kg ({self.tree.mass:.3f} kg in the XML), "
            f"{moving} of {movable} joints move, {len(self.lumped.held)} are held off zero",
            f"sole: {1e3 * foot.heel:.0f} ... {1e3 * foot.toe:.0f} mm from the last leg joint, "
            f"{2e3 * foot.half_width:.0f} mm wide, {-1e3 * foot.sole_z:.0f} mm below it",
            f"standing: CoM {data.com[0][2]:.3f} m up, knee {r.stance['knee_rad']:.2f} rad, "
            f"trunk {r.stance['trunk_pitch_rad']:.2f} rad",
            "five links describe it"
            if r.planar
            else "no five links describe it: jumps are planned directly, not in three steps",
            *(f"changed: {k}: {x:.3g} {unit}" for k, (x, unit) in self.lumped.changed.items()),
        ]


def first_look(path: str | Path, repair: tuple[str, ...] = ()) -> tuple[Draft | None, list[str]]:
    """A first description of a URDF, and every fault of the file, else of the limits of the joints
    with a role.

    With faults of the file the roles are those that it has once all repairs are allowed; None if
    not even then. Raises :class:`RobotError` if it is no URDF at all, or has no two legs.
    """
    path = Path(path)
    try:
        first = draft(path, repair)
        return first, list(first.faults)
    except RobotError:
        faults = urdf_checks.faults(parse(read_urdf(path), path.name), path.name, repair)
        if not faults:
            raise
    try:
        return draft(path, REPAIRS), faults
    except RobotError:
        return None, faults


def check(path: str | Path, config_text: str, tree: Tree | None = None) -> Checkup:
    """The robot of a URDF and a configuration with [source]; raises :class:`RobotError`.

    ``tree`` is that of its :class:`.roles.Draft`, if there is one.
    """
    path = Path(path)
    config = read_toml(config_text, "robot configuration")
    if "source" not in config:
        missing = "the table [source] is missing; add it, with trunk, forward, up and repair"
        raise RobotError(f"robot configuration: {missing}")
    repair = source_of(config)["repair"]
    tree = tree or urdf_checks.read_tree(read_urdf(path), path.name, path, repair)
    result = Checkup(*make_jumper(tree, config), tree)
    check_stance(result.robot)
    try:
        check_held(result.robot, stance_configuration(result.robot))
    except InfeasibleError as e:
        raise RobotError(str(e)) from None
    return result


def check_texts(urdf: str, config_text: str, where: str = "") -> None:
    """Refuse (:class:`RobotError`) the texts of a robot by the rules of a bare URDF: its file, and
    the limits of the joints that the configuration names.

    ``where`` names the URDF's file; texts without one may have been changed for a study, whose
    motors may be stronger and faster than any.
    Engines and viewers read these texts, and would open the meshes that they name.
    """
    tree = urdf_checks.read_tree(urdf, where or "robot.urdf")
    for name, link in tree.elements.items():
        for mesh in link.iterfind("*/geometry/mesh"):
            raise tree.error(
                f"link {name!r}: the mesh {quoted(mesh.get('filename'))} is not opened without "
                f"[source]; make it a box, or describe the robot by a TOML file with [source]"
            )
    for pair in roles_table(read_toml(config_text, "robot configuration")).values():
        for name in pair if where else ():
            # one that is missing is refused by the robot itself
            for sentence in urdf_checks.limit_faults(tree, name) if name in tree.joints else ():
                raise RobotError(sentence)


def examine(robot: str | Path, repair: tuple[str, ...] = ()) -> Checkup:
    """The checkup of a name or of a path, of a bare URDF or MJCF or of a TOML file; roles are found
    where no table [source] names them.
    """
    urdf, folder, config = files_of(robot)
    path = locate(urdf, folder)
    if config is not None and "source" in read_toml(config, "robot configuration"):
        return check(path, config)
    first = draft(path, repair)
    return check(path, first.text, first.tree)
