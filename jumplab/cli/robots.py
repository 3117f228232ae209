"""The command ``jumplab robot``: which robots there are, and whether a URDF is one."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

import jumplab as jl
from jumplab import io
from jumplab.errors import InputError, JumplabError, RobotError

if TYPE_CHECKING:  # help of a command is there before NumPy is
    from jumplab.robot_import.roles import Draft


def list_(args: Namespace) -> None:
    """List the robots that have a name."""
    from jumplab.robot.files import SHIPPED
    from jumplab.robot_import.urdf import DESCRIPTIONS

    rows = []
    for name, file in SHIPPED.items():
        row = {"name": name, "kg": None, "joints": None, "arms": "", "note": ""}
        try:
            if DESCRIPTIONS in file.read_text(encoding="utf-8"):  # a list downloads nothing
                raise RobotError(
                    f"{name}: is downloaded when it is first loaded, with jumplab[descriptions]"
                )
            robot = jl.Robot.load(name)
            row |= {"kg": robot.total_mass, "joints": len(robot.joint_names)}
            row["arms"] = "swing" if robot.joints["shoulder_pitch"] else "held"
        except JumplabError as e:
            row["note"] = str(e).rpartition(": ")[2]
        rows.append(row)
    args.found["robots"] = rows
    print(jl.plots.table(rows, digits=3))


def check(args: Namespace) -> None:
    """Find hips, knees, ankles, shoulders and soles of a URDF, and judge it."""
    from jumplab.robot.files import SHIPPED, toml_text
    from jumplab.robot_import import checkup
    from jumplab.robot_import.jumper import REPAIRS
    from jumplab.robot_import.urdf import described

    urdf, draft = args.urdf, None
    if (urdf is None) == (args.robot_description is None):
        raise InputError("jumplab robot check: give either a URDF or --robot-description")
    if urdf is None:
        urdf = str(described(args.robot_description))
        print(f"robot description: {urdf}")
    for word in args.repair:
        if word not in REPAIRS:
            raise InputError(f"--repair accepts {', '.join(REPAIRS)}, got {word!r}")
    shipped = SHIPPED.get(urdf)
    if args.repair and (args.config is not None or shipped):
        raise InputError(
            "--repair is for a bare URDF; a configuration has its own [source] repair, so leave it "
            "out"
        )
    if args.config is not None:
        try:
            text = toml_text(Path(args.config).read_bytes(), f"--config {args.config}")
        except (OSError, ValueError) as e:
            raise InputError(
                f"--config {args.config}: cannot be read as text ({type(e).__name__})"
            ) from e
        result = checkup.check(urdf, text)
    elif not shipped:
        draft = _draft(urdf, tuple(args.repair), args.out, args.force)
        try:
            result = checkup.check(urdf, draft.text, draft.tree)
        except RobotError:  # the configuration is where it is mended
            _write(args.out, draft.text, args.force)
            raise
    elif "[source]" in shipped.read_text(encoding="utf-8"):
        result = checkup.examine(urdf)
    else:
        raise InputError(
            f"{urdf!r} is the default robot, and its description needs no check; give another robot"
        )
    robot = result.robot
    picture = jl.plots.robot_sheet(robot) if args.out else None
    if args.out:
        io.folder.settle()
    if draft:
        _write(args.out, draft.text, args.force)
    args.found |= {"robot": robot.name, "notes": result.lines(), "roles": result.rows()}
    print(*result.lines(), sep="\n")
    print(jl.plots.table(result.rows()))
    if args.out is not None:
        views = "Side view, moving joints from the front, and the five links of the sagittal plane"
        jl.plots.save_figure(picture, robot.name, args.out, f"{views}, standing.", robot=robot)
        print(f"picture: {Path(args.out) / robot.name}.png")


def robot(args: Namespace) -> None:
    """List the robots that have a name, or check whether a URDF can jump."""
    raise InputError(
        "jumplab robot: choose an action: check or list; 'jumplab robot --help' shows what is "
        "possible"
    )


def _draft(urdf: str, repair: tuple[str, ...], out: str | None, force: bool) -> Draft:
    """A URDF (path) without faults and its starter configuration.

    If there are faults, and of limits alone, the configuration is written as OUT/NAME.toml: they
    are mended there.
    """
    from jumplab.robot_import import checkup

    try:
        draft, faults = checkup.first_look(urdf, repair)
    except RobotError as e:
        for note in getattr(e, "__notes__", ()):
            print(f"note: {note}")
        raise
    path = None
    if draft:
        for note in draft.roles.notes:
            print(f"note: {note}")
        for role, pair in draft.roles.joints.items() if faults else ():
            print(f"{role.replace('_', ' ')}: {', '.join(pair) or 'held'}")
        print(f"sole: {draft.sole.source}")
        if faults and draft.faults == tuple(faults):
            path = _write(out, draft.text, force)
    if faults:
        first, *others = faults
        print("".join(f"{sentence}\n" for sentence in others), end="")
        if path:
            print(f"comments in {path} list the missing data; check again with --config {path}")
        more = "1 further fault is" if len(others) == 1 else f"{len(others)} further faults are"
        above = f" ({more} printed above)" if others else ""
        raise RobotError(first + above)
    return draft


def _write(folder: str | None, text: str, force: bool) -> Path | None:
    """Write a starter configuration, but not over another one, which a user may have edited;
    returns its path, or None without a folder.
    """
    from jumplab.robot import files

    if folder is None:
        return None
    path = Path(folder) / f"{files.read_toml(text, 'starter')['name']}.toml"
    content = text.encode()
    if path.exists() and not force and path.read_bytes() != content:
        raise InputError(
            f"{path}: has been edited, or another version wrote it; choose another --out, or "
            f"overwrite it with --force"
        )
    try:
        io.folder.write_file(path, content)
    except InputError as e:
        reason = getattr(e.__cause__, "strerror", e)
        raise InputError(f"{path}: cannot be written ({reason})") from e
    print(f"starter configuration: {path}")
    return path
