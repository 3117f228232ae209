"""``jumplab view``: a jump in 3-D, as one HTML file."""

from __future__ import annotations

import argparse
from pathlib import Path

from jumplab.cli.common import common_options


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab view``."""
    view = commands.add_parser("view", help="a jump in 3-D, as one HTML file", parents=[common_options()])
    view.add_argument("dir", metavar="DIR", help="folder of a plan, simulated or not")
    view.add_argument("--out", metavar="FILE.html", help="file to write (default: DIR/jump.html)")
    view.set_defaults(work=_view)


def _view(args: argparse.Namespace) -> None:
    from jumplab.errors import InputError
    from jumplab.io import folder as store

    if args.out is not None and not args.out.lower().endswith(".html"):
        raise InputError(f"--out must name a file that ends in .html, got {args.out!r}")
    tape, robot, summary = store.read_plan(args.dir)
    out = Path(args.out or Path(args.dir) / "jump.html")
    store.ensure_writable(out.parent)

    from jumplab.io.motion import SIMULATION_NAME, Motion
    from jumplab.show import page as viewer
    from jumplab.sim import Scene
    from jumplab.task import JumpTask

    simulated = (Path(args.dir) / SIMULATION_NAME).is_file()
    simulation = Motion.of_simulation_file(args.dir, robot) if simulated else None
    page = viewer.page(robot, plan=tape, simulation=simulation, task=JumpTask(**summary["target"]),
                       scene=Scene.of_plan(summary, robot))  # fmt: skip
    page.save(out)
    print(f"{page.title}: {out}, {out.stat().st_size / 1e6:.1f} MB; open it in any browser")
