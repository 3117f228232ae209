"""``jumplab trials``: many perturbed robots, or many wrong states of one in flight, and the share that lands."""

from __future__ import annotations

import argparse
import time

from jumplab.cli.common import common_options, engine_option
from jumplab.errors import InputError

DEFAULT_N = "200"  # the interval of a success rate near 95 % is then 3 % wide on either side
LARGEST = 100_000  # our choice: two days of one core; more is surely a typo
INTERRUPTED = "interrupted; finished trials are kept, and the same command goes on from there"


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab trials``."""
    trials = commands.add_parser("trials", help="let many perturbed robots jump a plan",
                                 parents=[common_options(), engine_option()])  # fmt: skip
    trials.add_argument("dir", metavar="DIR", help="folder of a plan; trials.jsonl and trials.json are written there")
    trials.add_argument(
        "--n", metavar="N", help="number of robots (default 200), or of the basin's states (default: all)"
    )
    trials.add_argument("--seed", metavar="S", help="seed of the robots (default 0)")
    trials.add_argument("--basin", action="store_true",
                        help="the robot as planned, from 225 wrong states at the apex; writes basin.json")  # fmt: skip
    trials.add_argument("--mode", choices=("position", "pd"), default="position",
                        help="how the joints follow the plan up to touchdown")  # fmt: skip
    trials.add_argument("--reaim", action=argparse.BooleanOptionalAction, default=True,
                        help="turn the legs in the air against the trunk's pitch error")  # fmt: skip
    trials.add_argument("--noise", action=argparse.BooleanOptionalAction, default=False,
                        help="tell the controllers noisy measurements instead of the truth")  # fmt: skip
    trials.add_argument("--jobs", metavar="J", help="processes (default: one per core)")
    trials.set_defaults(work=_trials)


def _trials(args: argparse.Namespace) -> None:
    start = time.perf_counter()
    if args.basin and args.seed is not None:
        raise InputError("--seed says which robots are drawn, and --basin draws none; leave one of them away")
    n = None if args.n is None and args.basin else _whole("--n", DEFAULT_N if args.n is None else args.n, 1, LARGEST)
    seed = _whole("--seed", "0" if args.seed is None else args.seed, 0)
    jobs = None if args.jobs is None else _whole("--jobs", args.jobs, 1)

    from jumplab.io import folder as store

    store.read_plan(args.dir)  # refuses a damaged folder before the heavy libraries are there
    store.ensure_writable(args.dir)

    from jumplab.sim import SensorNoise
    from jumplab.studies.basin import landing_basin
    from jumplab.studies.trials import TrialSettings, run_trials

    noise = SensorNoise.typical() if args.noise else SensorNoise()
    settings = TrialSettings(args.mode, args.reaim, noise, engine=args.engine)
    try:
        if args.basin:
            report = landing_basin(args.dir, n, settings, jobs=jobs)
        else:
            report = run_trials(args.dir, n, seed, settings, jobs=jobs)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(INTERRUPTED) from None
    low, high = report.interval
    print(f"{report.landed} of {report.count} land: {report.success_rate:.1%}, 95 % interval {low:.1%} ... {high:.1%}")
    for reason, count in report.reasons.items():
        print(f"{count:>5} failed: {reason}")
    for name, unit in (("distance", "foot_distance_m"), ("rise", "com_rise_m")):
        values = report.values(unit)
        if len(values) and not args.basin:  # they would count from the apex
            print(f"{name} of those that landed: {values.min():.3f} ... {values.max():.3f} m")
    print(f"{'basin' if args.basin else 'trials'}.json in {args.dir}, {report.resumed} trials from an earlier run, "
          f"whole run: {time.perf_counter() - start:.1f} s")  # fmt: skip


def _whole(option: str, text: str, least: int, most: int | None = None) -> int:
    """The whole number that an option was given."""
    try:
        value = int(text)
    except ValueError:
        raise InputError(f"{option} must be a whole number, got {text!r}") from None
    if value < least:
        raise InputError(f"{option} must be at least {least}, got {value}")
    if most is not None and value > most:
        raise InputError(f"{option} must be at most {most}, got {value}")
    return value
