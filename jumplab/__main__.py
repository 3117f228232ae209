"""The command line: ``jumplab run | plan | simulate | audit`` (the same as ``python -m jumplab``).

Whatever goes wrong is said in one sentence on stderr. Exit codes: 0 done, 2 bad input, 3 infeasible or not within the
limits, 4 internal failure, 130 and 143 interrupted.
"""

from __future__ import annotations

import argparse
import ast
import math
import os
import re
import signal
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from jumplab.errors import InfeasibleError, InputError, JumplabError
from jumplab.task import JumpTask

INTERNAL, INTERRUPTED, TERMINATED = 4, 130, 143


class _Parser(argparse.ArgumentParser):
    """Parser that raises instead of printing its usage, and takes -1e-1 or -inf for numbers, not for options."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^-(inf|nan)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; '{self.prog} --help' shows what is possible")


def _parser() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help="show tracebacks")
    target = argparse.ArgumentParser(add_help=False)
    target.add_argument("--distance-m", default="1.0", metavar="M", help="travel of the feet [m] (default 1.0)")
    target.add_argument("--height-m", default="0.5", metavar="M", help="rise of the CoM in flight [m] (default 0.5)")
    target.add_argument("--robot", default="bhr", help="shipped robot (bhr) or path of a robot's TOML file")

    parser = _Parser(prog="jumplab", description="Plan a humanoid's jump, audit it, simulate it.", parents=[common])
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)

    run = commands.add_parser("run", help="execute all notebooks: plan, audit, simulation, figures",
                              parents=[common, target])  # fmt: skip
    run.add_argument("--out", metavar="DIR", help="results and executed notebooks (default: executed/ in the checkout)")
    run.add_argument(
        "--figures", metavar="DIR", help="figures (default: DIR/figures with --out, else figures/ in the checkout)"
    )
    run.add_argument("-p", "--parameter", action="append", default=[], metavar="NAME=VALUE",
                     help="any further parameter that a notebook declares; may be repeated")  # fmt: skip
    run.set_defaults(work=_run)

    plan = commands.add_parser("plan", help="the optimisations and the audit alone", parents=[common, target])
    plan.add_argument("--out", metavar="DIR", required=True, help="folder for the plan")
    plan.add_argument("--platform-m", default="0", metavar="M", help="height of the landing surface [m] (default 0)")
    plan.add_argument("--rotation-deg", default="0", metavar="DEG", help="0 or a multiple of 360; -360 is a backflip")
    plan.add_argument("--method", choices=("three-step", "direct"), default="three-step",
                      help="the paper's three steps, or the whole-body problem without them")  # fmt: skip
    plan.set_defaults(work=_plan)

    simulate = commands.add_parser("simulate", help="simulate a plan in PyBullet", parents=[common])
    simulate.add_argument("dir", metavar="DIR", help="folder of a plan")
    simulate.add_argument("--mode", choices=("position", "pd"), default="position",
                          help="how the joints follow the plan up to touchdown")  # fmt: skip
    simulate.set_defaults(work=_simulate)

    audit = commands.add_parser("audit", help="check a plan by a second code path", parents=[common])
    audit.add_argument("dir", metavar="DIR", help="folder of a plan")
    audit.set_defaults(work=_audit)
    return parser


# ---------------------------------------------------------------------------------------------- commands


def _number(option: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option} must be a number, got {text!r}") from None


def _task(args: argparse.Namespace) -> JumpTask:
    return JumpTask(
        distance_m=_number("--distance-m", args.distance_m),
        height_m=_number("--height-m", args.height_m),
        platform_m=_number("--platform-m", getattr(args, "platform_m", "0")),
        rotation_rad=math.radians(_number("--rotation-deg", getattr(args, "rotation_deg", "0"))),
    )


def _folder(option: str, text: str | None) -> str | None:
    if text is not None and not text.strip():
        raise InputError(f"{option} must name a folder, got {text!r}")
    return text


def _run(args: argparse.Namespace) -> None:
    task = _task(args)
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
    out, figures = _folder("--out", args.out), _folder("--figures", args.figures)

    from jumplab import notebooks, store

    report = notebooks.run_notebooks(values, out=out, figures=figures)
    _print_summary(store.read_plan(report.out)[2])
    _print_simulation(store.read_json(report.out / "simulation.json"))
    print(f"figures in {report.figures}, results and executed notebooks in {report.out}")
    print(f"whole run: {report.wall_s:.1f} s")


def _plan(args: argparse.Namespace) -> None:
    start = time.perf_counter()
    task, out = _task(args), _folder("--out", args.out)

    from jumplab import store
    from jumplab.robot import load_robot

    robot = load_robot(args.robot)
    store.ensure_writable(out)

    from jumplab import passport, pipeline

    plan = pipeline.plan_jump(task, robot, method=args.method)
    audit = store.write_plan(out, plan.tape, plan.robot, plan.summary, complete=passport.write_passport)
    _print_summary(plan.summary)
    print(f"plan in {out}, whole run: {time.perf_counter() - start:.1f} s")
    _judge(audit, out)


def _simulate(args: argparse.Namespace) -> None:
    from jumplab import store

    tape, robot, summary = store.read_plan(args.dir)
    store.ensure_writable(args.dir)

    from jumplab import simulation

    result = simulation.simulate_jump(tape, robot, mode=args.mode, scene=_scene(summary, robot))
    store.write_simulation(args.dir, result, summary)
    _print_simulation(result.to_json())


def _scene(summary: Mapping[str, Any], robot: Any) -> Any:
    """The ground that the plan was made for: flat, or two levels that meet at the planned edge."""
    from jumplab.simulation import Block, Scene
    from jumplab.simulation.scene import REACH_M

    top = summary["target"]["platform_m"]
    if top == 0:
        return Scene.flat()
    edge = (
        summary["platform_edge_m"] + robot.foot.toe - float(robot.foot.center[0])
    )  # the soles' middle starts at x = 0
    return Scene("platform", (Block(-REACH_M, edge, 0.0), Block(edge, REACH_M, top)))


def _audit(args: argparse.Namespace) -> None:
    from jumplab import store

    store.read_plan(args.dir)  # refuses a damaged folder
    folder = store.ensure_writable(args.dir)

    from jumplab import passport

    with store.locked(folder):
        audit = passport.write_passport(folder)
    print(audit.table())
    _judge(audit, args.dir)


def _judge(audit: Any, folder: str) -> None:
    failed = [check.name for check in audit.checks if not check.passed]
    if failed:
        raise InfeasibleError(
            f"the plan fails {len(failed)} of {len(audit.checks)} checks of its audit ({', '.join(failed)}); "
            f"see passport.json in {folder!r}"
        )
    print(f"audit: all {len(audit.checks)} checks passed")


# ---------------------------------------------------------------------------------------------- what is printed


def _print_summary(summary: Mapping[str, Any]) -> None:
    print(f"{'stage':<22}{'iterations':>11}{'build':>10}{'solve':>10}")
    for row in summary["stages"]:
        print(f"{row['stage']:<22}{row['iterations']:>11}{row['build_s']:>8.2f} s{row['solve_s']:>8.2f} s")
    print(f"planned: distance {summary['planned_distance_m']:.3f} m, rise {summary['planned_rise_m']:.3f} m")


def _print_simulation(metrics: Mapping[str, Any]) -> None:
    distance, rise = (
        "none" if metrics[name] is None else f"{metrics[name]:.3f} m" for name in ("foot_distance_m", "com_rise_m")
    )
    print(f"simulated: distance {distance}, rise {rise}")
    verdict = "stands" if metrics["landed"] else "FAILED"
    print(f"landing: {verdict}, {metrics['standing_s']:.2f} s on its feet after touchdown ({metrics['reason']})")


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("jumplab")
    except metadata.PackageNotFoundError:
        return "(not installed)"


# ---------------------------------------------------------------------------------------------- entry


def _terminate(signum: int, frame: Any) -> NoReturn:
    raise SystemExit(TERMINATED)


def _complain(text: str, debug: bool) -> None:
    if debug:
        traceback.print_exc()
    print(f"jumplab: {' '.join(text.split())}", file=sys.stderr)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    debug = "--debug" in argv
    before = signal.signal(signal.SIGTERM, _terminate)
    sys.stdout.reconfigure(errors="backslashreplace")  # a path need not be printable
    try:
        parser = _parser()
        for text in argv:  # argparse would make an empty list of it
            if re.fullmatch(r"-[^=]*=--", text):
                parser.error(f"{text}: '--' is not a value")
        args = parser.parse_args(argv)
        if args.version:
            print(f"jumplab {_version()}")
        elif args.command is None:
            parser.error("choose a command: run, plan, simulate or audit")
        else:
            args.work(args)
        sys.stdout.flush()
    except JumplabError as e:
        _complain(str(e), debug)
        return e.exit_code
    except KeyboardInterrupt:
        _complain("interrupted; what was there before is unchanged", debug)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as in `jumplab plan ... | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return INTERNAL
    except Exception as e:
        first = (str(e).strip().splitlines() or ["no message"])[0]
        hint = "" if debug else "; run it again with --debug for the traceback"
        _complain(f"internal failure, {type(e).__name__}: {first}{hint}", debug)
        return INTERNAL
    finally:
        signal.signal(signal.SIGTERM, before)
    return 0


if __name__ == "__main__":
    sys.exit(main())
