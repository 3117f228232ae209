"""``jumplab sweep``: plans for a grid of targets, robots and weights."""

from __future__ import annotations

import argparse
import time

from jumplab.cli.common import common_options, folder_of, number
from jumplab.errors import InputError

VALUES = "FROM:TO:COUNT or A,B,..."


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab sweep``."""
    sweep = commands.add_parser("sweep", help="plans for a grid of targets, robots and weights, in one table",
                                parents=[common_options()])  # fmt: skip
    sweep.add_argument("--distance-m", default="0:1.2:13", metavar="M", help=f"{VALUES} [m] (default 0:1.2:13)")
    sweep.add_argument("--height-m", default="0.1:0.6:11", metavar="M", help=f"{VALUES} [m] (default 0.1:0.6:11)")
    sweep.add_argument("--platform-m", default="0", metavar="M", help=f"{VALUES} [m] (default 0)")
    sweep.add_argument("--robot", action="append", metavar="NAME", help="robot; may be repeated (default bhr)")
    sweep.add_argument("--weight", action="append", default=[], metavar="TERM=VALUES",
                       help="weights of a term of stage 3, as TERM=A,B,...; may be repeated")  # fmt: skip
    sweep.add_argument("--method", default="three-step", help="three-step (default) or direct")
    sweep.add_argument("--out", metavar="DIR", required=True, help="folder of the table; an unfinished sweep goes on")
    sweep.add_argument("--jobs", default="-1", metavar="N", help="processes (default: one per processor)")
    sweep.add_argument("--cluster", metavar="ADDRESS", help="Dask scheduler that does the work, tcp://HOST:PORT")
    sweep.set_defaults(work=_sweep)


def values_of(option: str, text: str) -> list[float]:
    """Numbers written as FROM:TO:COUNT, or with commas."""
    parts = text.split(":")
    if len(parts) == 1:
        return [number(option, part) for part in text.split(",")]
    if len(parts) != 3 or not parts[2].isdecimal() or not 1 <= int(parts[2]) <= 10_000:
        raise InputError(f"{option} must be {VALUES}, got {text!r}")
    first, last, count = number(option, parts[0]), number(option, parts[1]), int(parts[2])
    return [round(first + (last - first) * k / max(count - 1, 1), 9) for k in range(count)]


def weights_of(pairs: list[str]) -> list[dict[str, float]]:
    """All combinations of the weights that were given."""
    out: list[dict[str, float]] = [{}]
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not (name and equals):
            raise InputError(f"--weight must be TERM=A,B,..., got {pair!r}")
        out = [{**known, name: value} for known in out for value in values_of(f"--weight {name}", text)]
    return out


def _sweep(args: argparse.Namespace) -> None:
    began, out = time.perf_counter(), folder_of("--out", args.out)
    axes = [values_of(f"--{name}-m", getattr(args, f"{name}_m")) for name in ("distance", "height", "platform")]
    weights = weights_of(args.weight)
    if not (args.jobs == "-1" or (args.jobs.isdecimal() and 1 <= int(args.jobs) <= 4096)):
        raise InputError(f"--jobs must be a number of processes, or -1 for all processors, got {args.jobs!r}")

    from jumplab.studies import sweep

    cases = sweep.grid(*axes, robots=args.robot or ["bhr"], weights=weights, method=args.method)
    rows = sweep.run(cases, out, jobs=int(args.jobs), cluster=args.cluster)
    planned, clean = (sum(row[key] for row in rows) for key in ("planned", "clean"))
    print(f"{len(rows)} cases, {planned} planned, {clean} of them clean in the audit; table in {out}/{sweep.TABLE}")
    print(f"whole sweep: {time.perf_counter() - began:.1f} s")
