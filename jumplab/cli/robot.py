"""``jumplab robot check`` and ``jumplab robot list``: which robots there are, and whether a URDF is one."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from jumplab.cli.common import common_options, folder_of
from jumplab.errors import InputError, JumplabError, RobotError


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab robot``."""
    robot = commands.add_parser("robot", help="the robots that are there, and whether a URDF can jump",
                                parents=[common_options()])  # fmt: skip
    robot.set_defaults(work=_neither)
    actions = robot.add_subparsers(dest="action", metavar="ACTION", parser_class=type(robot))
    check = actions.add_parser("check", help="find hips, knees, ankles, shoulders and soles of a URDF, and judge it",
                               parents=[common_options()])  # fmt: skip
    check.add_argument("urdf", metavar="URDF", help="the robot's URDF, or the name of a shipped robot")
    check.add_argument("--config", metavar="TOML", help="take the roles from this file instead of finding them")
    check.add_argument("--out", metavar="DIR", help="write a starter configuration and a picture into DIR")
    check.add_argument("--repair", action="append", default=[], metavar="WHAT",
                       help="allow a repair: symmetry, inertia or massless; may be repeated")  # fmt: skip
    check.set_defaults(work=_check)
    shipped = actions.add_parser("list", help="the shipped robots", parents=[common_options()])
    shipped.set_defaults(work=_list)


def _neither(args: argparse.Namespace) -> None:
    raise InputError("jumplab robot: choose an action: check or list; 'jumplab robot --help' shows what is possible")


def _list(args: argparse.Namespace) -> None:
    from jumplab.robot import Robot
    from jumplab.robot.description import SHIPPED
    from jumplab.show.tables import table

    rows = []
    for name in SHIPPED:
        try:
            robot = Robot.load(name)
            arms = "swing" if robot.joints["shoulder_pitch"] else "held"
            rows.append(
                {"name": name, "kg": robot.total_mass, "joints": len(robot.joint_names), "arms": arms, "note": ""}
            )
        except JumplabError as e:
            rows.append({"name": name, "kg": None, "joints": None, "arms": "", "note": str(e).rpartition(": ")[2]})
    print(table(rows, digits=3))


def _check(args: argparse.Namespace) -> None:
    from jumplab.robot.checkup import all_faults, check, draft
    from jumplab.robot_import.jumper import REPAIRS
    from jumplab.show.tables import table

    for word in args.repair:
        if word not in REPAIRS:
            raise InputError(f"--repair knows {', '.join(REPAIRS)}, got {word!r}")
    out, repair = folder_of("--out", args.out), tuple(args.repair)
    urdf, config = _files(args.urdf, folder_of("--config", args.config))
    if config is None:
        faults = all_faults(urdf, repair)
        for sentence in faults[1:]:
            print(sentence)
        if faults:
            more = f" ({len(faults) - 1} further faults are printed above)" if faults[1:] else ""
            raise RobotError(faults[0] + more)
        found = draft(urdf, repair)
        text = found.text
        for note in found.roles.notes:
            print(f"note: {note}")
        print(f"sole: {found.sole.source}")
        if out is not None:
            print(f"starter configuration: {_write(out, text)}")
    else:
        text = config
    result = check(urdf, text)
    print(*result.lines(), sep="\n")
    print(table(result.rows()))
    if out is not None:
        _draw(result.robot, out)


def _files(urdf: str, config: str | None) -> tuple[Path, str | None]:
    """Path of the URDF and text of the configuration; the name of a shipped robot stands for both."""
    from jumplab.robot.description import SHIPPED
    from jumplab.robot_import.config import read_toml
    from jumplab.robot_import.urdf import locate

    if config is None and urdf in SHIPPED:
        text = SHIPPED[urdf].read_text()
        if "[source]" not in text:
            raise InputError(f"{urdf!r} is the default robot, described as jumplab wants it; there is nothing to check")
        return locate(read_toml(text, urdf)["urdf"], SHIPPED[urdf].parent), text
    if config is None:
        return Path(urdf), None
    try:
        return Path(urdf), Path(config).read_text()
    except (OSError, ValueError) as e:
        raise InputError(f"--config {config}: cannot be read as text ({type(e).__name__})") from e


def _write(out: str, text: str) -> Path:
    """The starter configuration as OUT/NAME.toml, written whole or not at all."""
    from jumplab.robot_import.config import read_toml

    path = Path(out) / f"{read_toml(text, 'starter')['name']}.toml"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            raise InputError(f"{path}: is there already, perhaps with corrections; choose another --out or remove it")
        part = path.with_suffix(".part")
        part.write_text(text)
        os.replace(part, path)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror})") from e
    return path


def _draw(robot, out: str) -> None:
    from jumplab.show.bodies import robot_sheet
    from jumplab.show.style import save_figure

    caption = "Side view, moving joints from the front, and the five links of the sagittal plane, standing."
    save_figure(robot_sheet(robot), robot.name, out, caption, robot=robot)
    print(f"picture: {Path(out) / robot.name}.png")
