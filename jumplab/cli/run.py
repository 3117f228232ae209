"""``jumplab run``: all notebooks, or some, in order."""

from __future__ import annotations

import argparse
import ast
from typing import Any

from jumplab.cli.common import (
    common_options,
    folder_of,
    print_simulation,
    print_summary,
    robot_option,
    target_options,
    task_of,
)
from jumplab.errors import InputError


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab run``."""
    run = commands.add_parser("run", help="execute the notebooks: plan, audit, simulation, figures",
                              parents=[common_options(), target_options(), robot_option()])  # fmt: skip
    run.add_argument("notebook", nargs="*", metavar="NOTEBOOK", help="which ones, as 00 or 02_srmp (default: all)")
    run.add_argument("--out", metavar="DIR", help="results and executed notebooks (default: executed/ in the checkout)")
    run.add_argument(
        "--figures", metavar="DIR", help="figures (default: DIR/figures with --out, else figures/ in the checkout)"
    )
    run.add_argument("-p", "--parameter", action="append", default=[], metavar="NAME=VALUE",
                     help="any further parameter that a notebook declares; may be repeated")  # fmt: skip
    run.set_defaults(work=_run)


def _run(args: argparse.Namespace) -> None:
    task = task_of(args)
    values: dict[str, Any] = {"distance_m": task.distance_m, "height_m": task.height_m, "robot": args.robot}
    for pair in args.parameter:
        name, equals, text = pair.partition("=")
        if not (equals and name.isidentifier()):
            raise InputError(f"--parameter must be NAME=VALUE, got {pair!r}")
        if name in values:
            raise InputError(f"--parameter {name} is given twice, or has an option of its own")
        try:
            values[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            values[name] = text
    out, figures = folder_of("--out", args.out), folder_of("--figures", args.figures)

    from jumplab.cli import notebooks
    from jumplab.io import folder as store

    report = notebooks.run_notebooks(
        values, out=out, figures=figures, notebooks=notebooks.find_notebooks(args.notebook)
    )
    if (report.out / "plan.npz").is_file():
        print_summary(store.read_plan(report.out)[2])
    if (report.out / "simulation.json").is_file():
        print_simulation(store.read_json(report.out / "simulation.json"))
    print(f"figures in {report.figures}, results and executed notebooks in {report.out}")
    if (report.out / "jump.html").is_file():
        print(f"the jump in 3-D, for any browser: {report.out / 'jump.html'}")
    print(f"whole run: {report.wall_s:.1f} s")
