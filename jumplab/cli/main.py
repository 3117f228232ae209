"""The command line, ``jumplab COMMAND`` (the same as ``python -m jumplab COMMAND``).

Whatever goes wrong is said in one sentence on stderr. Exit codes: 0 done, 2 bad input, 3 infeasible or not within the
limits, 4 internal failure, 130 and 143 interrupted.
"""

import argparse
import contextlib
import os
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

from jumplab.cli.common import DEBUG, JSON, QUIET, command, declare, opt
from jumplab.cli.interrupts import CODES, UNCHANGED, Interrupts, end_soon
from jumplab.cli.jumps import audit, export, plan, run, simulate, view
from jumplab.cli.robots import robot
from jumplab.cli.status import Status
from jumplab.cli.studies import atlas, bench, certify, chain, clips, envelope, margins, sweep, trials
from jumplab.errors import InputError, JumplabError

INTERNAL = 4


@command(opt("SHELL", "bash, zsh or fish", None, ("bash", "zsh", "fish")))
def completion(args: argparse.Namespace) -> None:
    """Completion of commands and options: eval "$(jumplab completion bash)"."""
    import shtab

    args.found["script"] = shtab.complete(_parser(), args.shell)
    print(args.found["script"])


COMMANDS = (run, plan, audit, simulate, trials, margins, certify, chain, clips, view, export)
COMMANDS += (robot, envelope, atlas, sweep, bench, completion)


class _Parser(argparse.ArgumentParser):
    """Parser that raises instead of printing its usage, and takes -1e-1 or -inf for numbers, not for options."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^-(inf|nan)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; '{self.prog} --help' shows what is possible")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jumplab", description="Plan a humanoid's jump, audit it, simulate it.")
    for names, how in (JSON, QUIET, DEBUG):
        parser.add_argument(*names, **how)
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    declare(parser, COMMANDS)
    return parser


def _work(argv: Sequence[str], found: dict[str, Any]) -> None:
    """Do what was typed; ``found`` is filled with what --json prints."""
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
        args.found, quiet = found, "quiet" in args
        with contextlib.ExitStack() as stack:
            if not quiet:
                stack.enter_context(Status(args.command))
            if quiet or "json" in args:
                stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
            args.work(args)
    sys.stdout.flush()


def _print_json(data: dict[str, Any]) -> None:
    from jumplab.io.folder import to_json

    print(to_json(data), end="", flush=True)


def _tell(e: BaseException, heard: Interrupts, debug: bool) -> tuple[int, str]:
    """Say in one sentence what has ended a command; returns the exit code and the sentence."""
    if heard.number == signal.SIGTERM:
        return heard.code, "terminated"
    if isinstance(e, KeyboardInterrupt) or heard.number is not None:
        code, said = CODES[signal.SIGINT], (isinstance(e, KeyboardInterrupt) and str(e)) or UNCHANGED
    elif isinstance(e, JumplabError):
        code, said = e.exit_code, str(e)
    else:
        first = (str(e).strip().splitlines() or ["no message"])[0]
        hint = "" if debug else "; run it again with --debug for the traceback"
        code, said = INTERNAL, f"internal failure, {type(e).__name__}: {first}{hint}"
    if debug:
        traceback.print_exception(e)
    said = " ".join(said.split())
    print(f"jumplab: {said}", file=sys.stderr)
    return code, said


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code. Without ``argv`` the process is its own, and ends if interrupted."""
    alone, argv = argv is None, sys.argv[1:] if argv is None else list(argv)
    sys.stdout.reconfigure(errors="backslashreplace")  # a path need not be printable
    heard, found = Interrupts(alone), {}
    try:
        with heard.heeded():
            _work(argv, found)
            if heard.number is not None:  # and lost
                raise KeyboardInterrupt
    except BrokenPipeError:  # the reader of our output has gone, as in `jumplab plan ... | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return INTERNAL
    except (KeyboardInterrupt, Exception) as e:
        code, said = _tell(e, heard, "--debug" in argv)
        if "--json" in argv:
            _print_json({**found, "exit_code": code, "error": said})
        if alone and heard.number is not None:
            end_soon(code)
        return code
    if "--json" in argv:
        _print_json({**found, "exit_code": 0, "error": None})
    return 0
