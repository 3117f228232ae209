"""The command line, ``jumplab COMMAND`` (the same as ``python -m jumplab COMMAND``).

Whatever goes wrong is said in one sentence on stderr. Exit codes: 0 done, 2 bad input, 3 infeasible or not within the
limits, 4 internal failure, 130 and 143 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

from jumplab.cli.common import DEBUG, declare
from jumplab.cli.jumps import audit, export, plan, run, simulate, view
from jumplab.cli.robots import robot
from jumplab.cli.studies import bench, chain, envelope, sweep, trials
from jumplab.errors import InputError, JumplabError

INTERNAL, INTERRUPTED, TERMINATED = 4, 130, 143
COMMANDS = (run, plan, audit, simulate, trials, chain, view, export, robot, envelope, sweep, bench)


class _Parser(argparse.ArgumentParser):
    """Parser that raises instead of printing its usage, and takes -1e-1 or -inf for numbers, not for options."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^-(inf|nan)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; '{self.prog} --help' shows what is possible")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jumplab", description="Plan a humanoid's jump, audit it, simulate it.")
    names, how = DEBUG
    parser.add_argument(*names, **how)
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    declare(parser, COMMANDS)
    return parser


def _work(argv: Sequence[str]) -> None:
    parser = _parser()
    for text in argv:  # argparse would make an empty list of it
        if re.fullmatch(r"-[^=]*=--", text):
            parser.error(f"{text}: '--' is not a value")
    args = parser.parse_args(argv)
    if args.version:
        from importlib import metadata

        found = next(metadata.Distribution.discover(name="jumplab"), None)
        print(f"jumplab {found.version if found else '(not installed)'}")
    elif args.command is None:
        *first, last = (work.__name__ for work in COMMANDS)
        parser.error(f"choose a command: {', '.join(first)} or {last}")
    else:
        args.work(args)
    sys.stdout.flush()


@contextlib.contextmanager
def _heeded() -> Iterator[list[int]]:
    """Let signals end what is run; yields those that came. An ignored Ctrl-C stays ignored.

    They are noted, since CasADi can lose what is raised within its calls: only a failure is left.
    """
    seen: list[int] = []

    def stop(signum: int, frame: Any) -> NoReturn:
        seen.append(signum)
        raise KeyboardInterrupt if signum == signal.SIGINT else SystemExit(TERMINATED)

    ours = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        ours.append(signal.SIGINT)
    before = {number: signal.signal(number, stop) for number in ours}
    try:
        yield seen
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _verdict(e: BaseException, seen: list[int], debug: bool) -> tuple[int, str]:
    """Exit code and sentence of what has ended a command."""
    if isinstance(e, KeyboardInterrupt) or seen[-1:] == [signal.SIGINT]:
        said = str(e) if isinstance(e, KeyboardInterrupt) else ""
        return INTERRUPTED, said or "interrupted; what was there before is unchanged"
    if seen:
        return TERMINATED, ""
    if isinstance(e, JumplabError):
        return e.exit_code, str(e)
    first = (str(e).strip().splitlines() or ["no message"])[0]
    hint = "" if debug else "; run it again with --debug for the traceback"
    return INTERNAL, f"internal failure, {type(e).__name__}: {first}{hint}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    sys.stdout.reconfigure(errors="backslashreplace")  # a path need not be printable
    with _heeded() as seen:
        try:
            _work(argv)
        except BrokenPipeError:  # the reader of our output has gone, as in `jumplab plan ... | head -1`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return INTERNAL
        except (KeyboardInterrupt, Exception) as e:
            code, said = _verdict(e, seen, debug="--debug" in argv)
            if said and "--debug" in argv:
                traceback.print_exc()
            if said:
                print(f"jumplab: {' '.join(said.split())}", file=sys.stderr)
            return code
    return 0
