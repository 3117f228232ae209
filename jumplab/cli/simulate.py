"""``jumplab simulate``: a plan in a physics engine."""

from __future__ import annotations

import argparse

from jumplab.cli.common import common_options, engine_option, print_simulation


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab simulate``."""
    simulate = commands.add_parser("simulate", help="simulate a plan in PyBullet or MuJoCo",
                                   parents=[common_options(), engine_option()])  # fmt: skip
    simulate.add_argument("dir", metavar="DIR", help="folder of a plan")
    simulate.add_argument("--mode", choices=("position", "pd"), default="position",
                          help="how the joints follow the plan up to touchdown")  # fmt: skip
    simulate.set_defaults(work=_simulate)


def _simulate(args: argparse.Namespace) -> None:
    from jumplab.io import folder as store

    tape, robot, summary = store.read_plan(args.dir)
    store.ensure_writable(args.dir)

    from jumplab import sim as simulation

    scene = simulation.Scene.of_plan(summary, robot)
    result = simulation.simulate_jump(tape, robot, mode=args.mode, scene=scene, engine=args.engine)
    store.write_simulation(args.dir, result, summary)
    print_simulation(result.to_json())
