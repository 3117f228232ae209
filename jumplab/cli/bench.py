"""``jumplab bench``: how long planning takes, against one direct NLP."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from jumplab.cli.common import common_options, robot_option, target_options, task_of
from jumplab.errors import InputError


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab bench``."""
    bench = commands.add_parser("bench", help="how long planning takes, against one direct NLP",
                                parents=[common_options(), target_options(), robot_option()])  # fmt: skip
    bench.add_argument("--repeats", default="7", metavar="N", help="how often everything is timed (default 7)")
    bench.add_argument("--json", metavar="FILE", help="file for ratios and all raw times")
    bench.set_defaults(work=_bench)


def _bench(args: argparse.Namespace) -> None:
    if not (args.repeats.isdecimal() and 1 <= int(args.repeats) <= 1000):
        raise InputError(f"--repeats must be a number from 1 to 1000, got {args.repeats!r}")
    task, file = task_of(args), None if args.json is None else Path(args.json)
    if file is not None and (not args.json.strip() or file.is_dir() or not file.resolve().parent.is_dir()):
        raise InputError(f"--json must name a file in a folder that exists, got {args.json!r}")

    from jumplab.io import folder as store
    from jumplab.studies import bench as benchmark

    found = benchmark.bench(args.robot, task, int(args.repeats), say=lambda word: print(word, file=sys.stderr))
    print(benchmark.text(found))
    if file is not None:
        store.write_file(file, json.dumps(found, indent=1).encode())
        print(f"raw times in {file}")
