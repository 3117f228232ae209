"""``jumplab chain``: several jumps in a row, each planned from what the one before has come to."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from typing import Any

from jumplab.cli.common import common_options, engine_option, folder_of, number, robot_option
from jumplab.errors import InfeasibleError, InputError

MOST_RUNS = 10_000  # our choice: a day of two cores; more is surely a typo


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab chain``."""
    chain = commands.add_parser("chain", help="several jumps in a row, each planned while the one before lands",
                                parents=[common_options(), robot_option(), engine_option()])  # fmt: skip
    chain.add_argument("--distances-m", nargs="+", required=True, metavar="M", help="travel of the feet, per jump [m]")
    chain.add_argument("--height-m", nargs="+", default=["0.3"], metavar="M",
                       help="rise of the CoM in flight [m], for all jumps or per jump (default 0.3)")  # fmt: skip
    chain.add_argument("--platforms-m", nargs="+", metavar="M",
                       help="height of each landing surface above the first ground [m] (default: level)")  # fmt: skip
    chain.add_argument("--seed", metavar="S", help="seed of a perturbed robot (default: the robot as planned)")
    chain.add_argument("--runs", default="1", metavar="N",
                       help="so many perturbed robots, from the seed on; the first is kept in full")  # fmt: skip
    chain.add_argument("--ranges", choices=("slight", "wide"), default="slight", help="how much they differ")
    chain.add_argument("--look-s", default="-0.3", metavar="S",
                       help="when the next jump is planned, from touchdown on [s]; negative: in the air")  # fmt: skip
    chain.add_argument("--revise-s", default="0.1", metavar="S",
                       help="when it is planned again, from touchdown on [s], or 'never'")  # fmt: skip
    chain.add_argument("--solve-s", metavar="S", help="charge each plan this [s] instead of its wall clock")
    chain.add_argument("--landing", choices=("planned", "spring"), default="spring", help="how it lands")
    chain.add_argument("--method", choices=("three-step", "direct"), default="three-step", help="of planning")
    chain.add_argument("--jobs", metavar="J", help="processes for several runs (default: one per core)")
    chain.add_argument("--out", metavar="DIR", required=True, help="folder for plans, log, report and 3-D page")
    chain.set_defaults(work=_chain)


def _whole(option: str, text: str, least: int, most: int) -> int:
    value = number(option, text)
    if value != value // 1 or not least <= value <= most:
        raise InputError(f"{option} must be a whole number from {least} to {most}, got {text!r}")
    return int(value)


def _chain(args: argparse.Namespace) -> None:
    start, out = time.perf_counter(), folder_of("--out", args.out)
    distances, heights, platforms = (
        values and [number(option, x) for x in values] for option, values in (
            ("--distances-m", args.distances_m), ("--height-m", args.height_m), ("--platforms-m", args.platforms_m))
    )  # fmt: skip
    revise = None if args.revise_s == "never" else number("--revise-s", args.revise_s)
    how = {"look_s": number("--look-s", args.look_s), "revise_s": revise, "landing": args.landing,
           "solve_s": None if args.solve_s is None else number("--solve-s", args.solve_s),
           "method": args.method, "engine": args.engine}  # fmt: skip
    runs = _whole("--runs", args.runs, 1, MOST_RUNS)
    jobs = None if args.jobs is None else _whole("--jobs", args.jobs, 1, 4096)
    seed = None if args.seed is None and runs == 1 else _whole("--seed", args.seed or "0", 0, 2**31 - 1)

    from jumplab.io import folder as store
    from jumplab.robot import Robot
    from jumplab.sim import Perturbation
    from jumplab.studies.chain import RANGES, Course, run_chain, run_chains, write_chain

    course, robot = Course.of(distances, heights, platforms), Robot.load(args.robot)
    store.ensure_writable(out)
    ranges = RANGES[args.ranges]
    drawn = None if seed is None else Perturbation.draw(robot, seed, ranges)
    result = run_chain(course, robot, perturbation=drawn, **how)
    report = run_chains(course, robot, runs, seed, ranges=ranges, jobs=jobs, **how) if runs > 1 else None

    from jumplab.show import page as viewer

    page = viewer.page(result.robot, simulation=result, scene=result.scene, marks_m=course.goals_m,
                       title="A chain of jumps")  # fmt: skip
    audits = write_chain(out, result, {"chain.html": page.html}, series=None if report is None else report.to_json())
    _print(result, report)
    print(f"chain in {out}, whole run: {time.perf_counter() - start:.1f} s")
    _judge(result, audits, out)


def _print(result: Any, report: Any) -> None:
    """Jump by jump, then the verdicts."""
    heads = ("asked", "planned", "travel", "error", "in air", "solve", "ready", "needed")
    print(f"{'jump':<5}" + "".join(f"{head:>9}" for head in heads))
    for row in result.rows():
        print(_line(row))
    print(
        f"plans made on the way: {result.in_time} of {len(result.replans)} were there when the robot was ready for them"
    )
    print("chain: stands after every jump" if result.stood else f"chain: FAILED, {result.reason}")
    if report is not None:
        low, high = report.interval
        errors = report.errors_m
        worst = f"{abs(errors).max():.3f} m" if len(errors) else "none"
        print(f"{report.stood} of {len(report.trials)} robots stand to the end, 95 % interval {low:.1%} ... {high:.1%}")
        print(f"largest distance error {worst}; {report.in_time} of {report.replans} plans in time")
        print(f"{(report.waits_s <= 0).sum()} of {len(report.waits_s)} next jumps began without waiting for a plan")
        for trial in report.trials:
            if not trial.stood:
                print(f"  seed {trial.seed}: {trial.reason}")


def _line(row: Mapping[str, Any]) -> str:
    names = ("asked_m", "planned_m", "travel_m", "error_m", "air_s", "solve_s", "ready_s", "needed_s")
    cells = ("-" if row[n] is None else f"{row[n]:.3f} {n[-1]}" for n in names)
    return f"{row['jump']:<5}" + "".join(f"{cell:>9}" for cell in cells)


def _judge(result: Any, audits: Sequence[Any], out: str) -> None:
    """Refuse a chain whose plans fail their audit, or that fell."""
    failed = [f"jump {k}: {c.name}" for k, a in enumerate(audits, 1) for c in a.checks if not c.passed]
    if failed:
        raise InfeasibleError(f"{len(failed)} checks of the plans' audits failed ({', '.join(failed[:6])}); "
                              f"see the passport.json files in {out!r}")  # fmt: skip
    print(f"audit: all {sum(len(a.checks) for a in audits)} checks of {len(audits)} plans passed")
    if not result.stood:
        raise InfeasibleError(f"the chain failed: {result.reason}; see chain.json in {out!r}")
