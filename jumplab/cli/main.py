"""The command line, ``jumplab COMMAND`` (the same as ``python -m jumplab COMMAND``).

Whatever goes wrong is said in one sentence on stderr. Exit codes: 0 done, 2 bad input, 3 infeasible
or not within the limits, 4 internal failure (or a full disk takes no output), 130 and 143
interrupted. A reader of the output that has gone changes nothing.
"""

import argparse
import contextlib
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

from jumplab.cli.common import add_common, declare
from jumplab.cli.interrupts import CODES, UNCHANGED, Interrupts, end_soon
from jumplab.cli.jumps import audit, export, plan, simulate, view
from jumplab.cli.motions import judge, mend
from jumplab.cli.notebooks import beside
from jumplab.cli.robots import check, list_, robot
from jumplab.cli.streams import patient_streams
from jumplab.cli.studies import atlas, chain, envelope, record, sweep, trials
from jumplab.errors import InputError, JumplabError
from jumplab.show.waiting import on_terminal

INTERNAL = 4


def completion(args: argparse.Namespace) -> None:
    """Print the completion of commands and options: eval "$(jumplab completion bash)"."""
    import shtab

    args.found["script"] = shtab.complete(make_parser(), args.shell)
    print(args.found["script"])


run = beside("run", "Execute the notebooks: plan, audit, simulation, figures.")
margins = beside("margins", "Find the largest size of each disturbance that a plan tolerates.")
certify = beside(
    "certify",
    "Certify a plan: audit, then both physics engines in some modes, with both contacts.",
)
clips = beside(
    "clips",
    "Make a library of clips: a hundred jumps to all sides, audited and landed in both engines.",
)
bench = beside(
    "bench", "Measure the time of planning, one kind of jump and one method after another."
)
COMMANDS = (run, plan, audit, simulate, trials, margins, certify, chain, clips, judge, mend)
COMMANDS += (view, export)
COMMANDS += (robot, record, envelope, atlas, sweep, bench, completion)


class _Parser(argparse.ArgumentParser):
    """Parser that raises instead of printing its usage, and takes -1e-1 or -inf for numbers, not
    for options.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, allow_abbrev=False, **kwargs)
        numbers = r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^-(inf|nan)"
        self._negative_number_matcher = re.compile(numbers, re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; '{self.prog} --help' shows what is possible")


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = _Parser(prog="jumplab", description="Plan a humanoid's jump, audit it, simulate it.")
    add_common(parser)
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    below = declare(parser, COMMANDS)
    declare(below["robot"], (check, list_), "action")
    return parser


def _work(argv: Sequence[str], results: dict[str, Any]) -> None:
    """Do what was typed; ``results`` is filled with what --json prints."""
    parser = make_parser()
    for text in argv:  # argparse would make an empty list of it
        if re.fullmatch(r"-[^=]*=--", text):
            parser.error(f"{text}: '--' is not a value")
    args = parser.parse_args(argv)
    if args.version:
        from jumplab.io.folder import versions

        print(f"jumplab {versions()['jumplab']}")
    elif args.command is None:
        *first, last = (work.__name__ for work in COMMANDS)
        parser.error(f"choose a command: {', '.join(first)} or {last}")
    else:
        args.found = results
        with contextlib.ExitStack() as stack:
            if "quiet" not in args:
                stack.enter_context(on_terminal(args.command))
            if "quiet" in args or "json" in args:
                nowhere = stack.enter_context(open(os.devnull, "w"))
                stack.enter_context(contextlib.redirect_stdout(nowhere))
            args.work(args)
    sys.stdout.flush()


def _explain(e: BaseException, number: int | None) -> tuple[int, str]:
    """Exit code and sentence of what has ended a command, a signal of this ``number`` perhaps."""
    if number == signal.SIGTERM:
        return CODES[number], "terminated"
    if isinstance(e, KeyboardInterrupt) or number is not None:
        return CODES[signal.SIGINT], (isinstance(e, KeyboardInterrupt) and str(e)) or UNCHANGED
    if isinstance(e, JumplabError):
        return e.exit_code, str(e)
    first = (str(e).strip().splitlines() or ["no message"])[0]
    return INTERNAL, f"internal failure, {type(e).__name__}: {first}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code. Without ``argv`` the process is its own, and ends if
    interrupted.
    """
    alone = argv is None
    argv = sys.argv[1:] if argv is None else list(argv)
    with patient_streams() as lost:
        code = _main(argv, alone)
        sys.stdout.flush()
        if lost and not code:
            print(f"jumplab: the output cannot be written ({lost[0]})", file=sys.stderr)
            code = INTERNAL
    return code


def _main(argv: list[str], alone: bool) -> int:
    """Run one command, with standard streams that never fail."""
    interrupts = Interrupts(alone)
    results = {}
    code, sentence = 0, None
    try:
        with interrupts.heeded():
            _work(argv, results)
            if interrupts.number is not None:  # and lost
                raise KeyboardInterrupt
    except (KeyboardInterrupt, Exception) as e:
        code, sentence = _explain(e, interrupts.number)
        sentence = " ".join(sentence.split())
        if "--debug" in argv:
            traceback.print_exception(e)
        elif code == INTERNAL and not isinstance(e, JumplabError):
            sentence += "; run it again with --debug for the traceback"
        print(f"jumplab: {sentence}", file=sys.stderr)
    if "--json" in argv:
        from jumplab.io.folder import to_json

        print(to_json({**results, "exit_code": code, "error": sentence}), end="", flush=True)
    if alone and interrupts.number is not None:
        logging.disable()  # papermill would print that its kernel has died
        end_soon(code)
    return code
