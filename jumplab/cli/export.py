"""``jumplab export``: a jump for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from jumplab.cli.common import common_options, folder_of, number

FORMATS = ("csv", "npz", "motion-clip", "urdf-replay")  # of jumplab.io.export, which is imported late
ORDERS = ("depth-first", "breadth-first")


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab export``."""
    export = commands.add_parser("export", help="a jump for other programs", parents=[common_options()])
    export.add_argument("dir", metavar="DIR", help="folder of a plan")
    export.add_argument("--format", choices=FORMATS, required=True,
                        help="joint table at 1 kHz, arrays, clip for motion trackers, folder to replay")  # fmt: skip
    export.add_argument("--out", metavar="PATH", help="file, or folder of a urdf-replay (default: in DIR)")
    export.add_argument("--simulated", action="store_true", help="the simulated jump instead of the planned one")
    export.add_argument("--fps", default="50", metavar="N", help="frames per second of a motion-clip (default 50)")
    export.add_argument("--order", choices=ORDERS, default="depth-first",
                        help="of joints and bodies in a clip: MuJoCo's, or Isaac Lab's (breadth-first)")  # fmt: skip
    export.set_defaults(work=_export)


def _export(args: argparse.Namespace) -> None:
    fps, out = number("--fps", args.fps), folder_of("--out", args.out)

    from jumplab.io import folder as store

    tape, robot, _ = store.read_plan(args.dir)

    from jumplab.io import export
    from jumplab.io.motion import Motion

    motion = Motion.of_simulation_file(args.dir, robot) if args.simulated else Motion.of(tape)
    path = Path(out or Path(args.dir) / export.default_name(args.format, motion.source))
    export.write(args.format, motion, robot, path, fps=fps, order=args.order)
    print(f"{motion.source}, {motion.duration:.3f} s, as {args.format}: {path}")
