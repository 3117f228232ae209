"""``jumplab plan``: the optimisations and the audit alone."""

from __future__ import annotations

import argparse
import time

from jumplab.cli.common import (
    common_options,
    folder_of,
    judge,
    print_summary,
    robot_option,
    target_options,
    task_of,
)


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab plan``."""
    plan = commands.add_parser("plan", help="the optimisations and the audit alone",
                               parents=[common_options(), target_options(), robot_option()])  # fmt: skip
    plan.add_argument("--out", metavar="DIR", required=True, help="folder for the plan")
    plan.add_argument("--platform-m", default="0", metavar="M", help="height of the landing surface [m] (default 0)")
    plan.add_argument("--rotation-deg", default="0", metavar="DEG", help="0 or a multiple of 360; -360 is a backflip")
    plan.add_argument("--method", choices=("three-step", "direct"), default="three-step",
                      help="the paper's three steps, or the whole-body problem without them")  # fmt: skip
    plan.set_defaults(work=_plan)


def _plan(args: argparse.Namespace) -> None:
    start = time.perf_counter()
    task, out = task_of(args), folder_of("--out", args.out)

    from jumplab.io import folder as store
    from jumplab.robot import Robot

    robot = Robot.load(args.robot)
    store.ensure_writable(out)

    from jumplab import auditing as passport
    from jumplab.stages import planner as pipeline

    plan = pipeline.plan_jump(task, robot, method=args.method)
    audit = store.write_plan(out, plan.tape, plan.robot, plan.summary, complete=passport.write_audit)
    print_summary(plan.summary)
    print(f"plan in {out}, whole run: {time.perf_counter() - start:.1f} s")
    judge(audit, out)
