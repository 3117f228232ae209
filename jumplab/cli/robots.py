"""The command ``jumplab robot``: which robots there are, and whether a URDF is one."""

import hashlib
import os
from argparse import Namespace
from pathlib import Path

from jumplab.cli.common import Late, command, folder, opt
from jumplab.errors import InputError, JumplabError, RobotError

robots, checkup, describe = Late("jumplab.robot"), Late("jumplab.robot.checkup"), Late("jumplab.robot.description")
store, jumper = Late("jumplab.io.folder"), Late("jumplab.robot_import.jumper")
configs, urdfs = Late("jumplab.robot_import.config"), Late("jumplab.robot_import.urdf")
MARK = b"# unless edited, the sum of what is above: "
tables, sheets, style = Late("jumplab.show.tables"), Late("jumplab.show.bodies"), Late("jumplab.show.style")


@command()
def list_(args: Namespace) -> None:
    """The shipped robots."""
    rows = []
    for name, file in describe.SHIPPED.items():
        try:
            if urdfs.DESCRIPTIONS in file.read_text(encoding="utf-8"):  # a list downloads nothing
                raise RobotError(f"{name}: is downloaded when it is first loaded, with jumplab[descriptions]")
            robot = robots.Robot.load(name)
            kg, joints, note = robot.total_mass, len(robot.joint_names), ""
            arms = "swing" if robot.joints["shoulder_pitch"] else "held"
        except JumplabError as e:
            kg, joints, arms, note = None, None, "", str(e).rpartition(": ")[2]
        rows.append({"name": name, "kg": kg, "joints": joints, "arms": arms, "note": note})
    args.found["robots"] = rows
    print(tables.table(rows, digits=3))


@command(
    opt("URDF", "the robot's URDF or MJCF, or the name of a shipped robot", nargs="?"),
    opt("--robot-description NAME", "instead of a file, one that robot_descriptions downloads, as g1_description"),
    opt("--config TOML", "take the roles from this file instead of finding them", None, folder),
    opt("--out DIR", "write a starter configuration and a picture into DIR", None, folder),
    opt("--force", "overwrite a configuration in DIR that somebody has edited"),
    opt("--repair WHAT...", "allow a repair: inertia or massless; may be repeated", []),
)
def check(args: Namespace) -> None:
    """Find hips, knees, ankles, shoulders and soles of a URDF, and judge it."""
    if (args.urdf is None) == (args.robot_description is None):
        raise InputError("jumplab robot check: name a URDF, or a robot by --robot-description; one of the two")
    if args.urdf is None:
        args.urdf = str(urdfs.described(args.robot_description))
        print(f"robot description: {args.urdf}")
    for word in args.repair:
        if word not in jumper.REPAIRS:
            raise InputError(f"--repair knows {', '.join(jumper.REPAIRS)}, got {word!r}")
    if args.repair and (args.config is not None or args.urdf in describe.SHIPPED):
        raise InputError("--repair is for a bare URDF; a configuration says itself what is repaired, so leave it away")
    if args.config is not None:
        try:
            text = Path(args.config).read_text()
        except (OSError, ValueError) as e:
            raise InputError(f"--config {args.config}: cannot be read as text ({type(e).__name__})") from e
        result = checkup.check(args.urdf, text)
    elif args.urdf not in describe.SHIPPED:
        result = checkup.check(args.urdf, _draft(args.urdf, tuple(args.repair), args.out, args.force))
    elif "[source]" in describe.SHIPPED[args.urdf].read_text():
        result = checkup.examine(args.urdf)
    else:
        said = "is the default robot, described as jumplab wants it; there is nothing to check"
        raise InputError(f"{args.urdf!r} {said}")
    args.found |= {"robot": result.robot.name, "notes": result.lines(), "roles": result.rows()}
    print(*result.lines(), sep="\n")
    print(tables.table(result.rows()))
    if args.out is not None:
        caption = "Side view, moving joints from the front, and the five links of the sagittal plane, standing."
        robot = result.robot
        style.save_figure(sheets.robot_sheet(robot), robot.name, args.out, caption, robot=robot)
        print(f"picture: {Path(args.out) / robot.name}.png")


@command(actions=(check, list_))
def robot(args: Namespace) -> None:
    """The robots that are there, and whether a URDF can jump."""
    raise InputError("jumplab robot: choose an action: check or list; 'jumplab robot --help' shows what is possible")


def _draft(urdf: str, repair: tuple[str, ...], out: str | None, force: bool) -> str:
    """The starter configuration of a URDF without faults; written as OUT/NAME.toml if there is an ``out``.

    Faults of limits alone do not hinder the writing: they are mended there.
    """
    found, faults = checkup.first_look(urdf, repair)
    for note in found.roles.notes if found else ():
        print(f"note: {note}")
    for role, pair in found.roles.joints.items() if found and faults else ():
        print(f"{role.replace('_', ' ')}: {', '.join(pair) or 'held'}")
    if found:
        print(f"sole: {found.sole.source}")
    if out is not None and found and (not faults or found.faults == tuple(faults)):
        path = Path(out) / f"{configs.read_toml(found.text, 'starter')['name']}.toml"
        if os.path.exists(path) and not force and path.read_bytes() != _marked(path.read_bytes()):
            raise InputError(f"{path}: has been edited; choose another --out, or overwrite it with --force")
        try:
            store.write_file(path, _marked(found.text.encode()))
        except InputError as e:
            raise InputError(f"{path}: cannot be written ({getattr(e.__cause__, 'strerror', e)})") from e
        print(f"starter configuration: {path}")
    if faults:
        print("".join(f"{sentence}\n" for sentence in faults[1:]), end="")
        raise RobotError(faults[0] + (f" ({len(faults) - 1} further faults are printed above)" if faults[1:] else ""))
    return found.text


def _marked(text: bytes) -> bytes:
    """A configuration with a last line that tells whether it is still as it was written."""
    own = text.rpartition(MARK)[0] or text
    return own + MARK + hashlib.sha256(own).hexdigest()[:12].encode() + b"\n"
