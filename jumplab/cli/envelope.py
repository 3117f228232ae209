"""``jumplab envelope``: the map of jumps that a robot can do."""

from __future__ import annotations

import argparse
import json
import math
import os
from dataclasses import asdict
from pathlib import Path

from jumplab.cli.common import common_options, folder_of, number, robot_option
from jumplab.errors import InfeasibleError, InputError


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab envelope``."""
    envelope = commands.add_parser("envelope", help="map of the jumps that a robot can do",
                                   parents=[common_options(), robot_option()])  # fmt: skip
    envelope.add_argument("--out", metavar="DIR", required=True, help="folder for the map; an interrupted one goes on")
    envelope.add_argument("--distances-m", default="0:1.2:0.1", metavar="A:B:STEP", help="of the cells [m]")
    envelope.add_argument("--heights-m", default="0.1:0.6:0.1", metavar="A:B:STEP", help="of the cells [m]")
    envelope.add_argument("--workers", default=str(os.cpu_count() or 1), metavar="N", help="processes side by side")
    envelope.set_defaults(work=_envelope)


def _grid(option: str, text: str) -> list[float]:
    parts = [number(option, part) for part in text.split(":")]
    if len(parts) != 3 or not all(map(math.isfinite, parts)) or parts[2] <= 0 or parts[1] < parts[0]:
        raise InputError(f"{option} must be A:B:STEP with A <= B and a positive STEP, got {text!r}")
    count = min(math.floor((parts[1] - parts[0]) / parts[2] + 1e-9), 10_000)
    return [round(parts[0] + i * parts[2], 9) for i in range(count + 1)]


def _envelope(args: argparse.Namespace) -> None:
    out = folder_of("--out", args.out)
    distances, heights = _grid("--distances-m", args.distances_m), _grid("--heights-m", args.heights_m)
    workers = number("--workers", args.workers)
    if workers not in range(1, 257):
        raise InputError(f"--workers must be a whole number from 1 to 256, got {args.workers!r}")

    from jumplab.io import folder as store
    from jumplab.robot import Robot

    robot = Robot.load(args.robot)
    store.ensure_writable(out)

    from jumplab.show.studies import envelope_map
    from jumplab.show.style import save_figure
    from jumplab.studies.envelope import envelope

    found = envelope(robot, distances, heights, folder=out, workers=int(workers), tell=print)
    text = json.dumps(asdict(found) | {"hash": robot.hash}, indent=1).replace("NaN", "null")
    Path(out, "envelope.json").write_text(text + "\n")
    caption = "Cells with a plan of the direct planner, coloured by the limit of which they use most."
    save_figure(envelope_map(found), "envelope", out, caption, robot=robot)
    print(f"map in {out}: {sum(c.solved for c in found.cells)} of {len(found.cells)} cells have a plan")
    if found.highest is None:
        reason = next((c.reason for c in found.cells if c.reason), "no cell has a plan")
        raise InfeasibleError(f"{robot.name} can do none of these jumps: {reason}")
    for word, cell in (("highest", found.highest), ("farthest", found.farthest)):
        print(f"{word}: {cell.distance_m:.2f} m far with a rise of {cell.height_m:.2f} m, limited by {cell.limiting} "
              f"({100 * cell.share:.0f} % used)")  # fmt: skip
