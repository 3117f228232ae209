"""Code that commands share: it reads their options, and prints results.

Help and refusals do not wait for the heavy libraries: ``jl`` and the sub-packages load them late.
"""

import argparse
import inspect
import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jumplab as jl
from jumplab.errors import InfeasibleError, InputError
from jumplab.io.files import ensure_writable
from jumplab.sim import DEFAULT_ENGINE, ENGINES

# the value of an option, from its name and its text; raises InputError
Kind = Callable[[str, str], Any]
Work = Callable[[argparse.Namespace], None]
MOST_VALUES = 10_000


# what options take ------------------------------------------------------------------------------
def number(option: str, text: str) -> float:
    """The number that an option was given; refuses (:class:`InputError`) any other text."""
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option} must be a number, got {text!r}") from None


def needing(what: str, fits: Callable[[str], Any]) -> Kind:
    """Kind of an option that must ``what``: a text that does not fit is refused
    (:class:`InputError`).
    """

    def kind(option: str, text: str) -> str:
        if not fits(text):
            raise InputError(f"{option} must {what}, got {text!r}")
        return text

    return kind


def whole(option: str, text: str, least: int, most: int) -> int:
    """The whole number from ``least`` to ``most`` (included) that an option was given; refuses
    (:class:`InputError`) any other text.
    """
    value = number(option, text)
    if not (least <= value <= most and value.is_integer()):
        raise InputError(f"{option} must be a whole number from {least} to {most}, got {text!r}")
    return int(value)


def values_of(option: str, text: str) -> list[float]:
    """The numbers (n,) that an option was given, as FROM:TO:COUNT or with commas."""
    parts = text.split(":")
    if len(parts) == 1:
        return [number(option, part) for part in text.split(",")]
    if len(parts) != 3 or not parts[2].isdecimal() or not 1 <= int(parts[2]) <= MOST_VALUES:
        raise InputError(
            f"{option} must be {VALUES} with COUNT from 1 to {MOST_VALUES}, got {text!r}"
        )
    first, last = (number(option, part) for part in parts[:2])
    count = int(parts[2])
    return [round(first + (last - first) * k / max(count - 1, 1), 9) for k in range(count)]


VALUES = "FROM:TO:COUNT or A,B,..."
folder = needing("name a folder", str.strip)
KINDS = {
    "number": number,
    "degrees": lambda option, text: math.radians(number(option, text)),
    "whole": whole,
    "values": values_of,
    "values in degrees": lambda option, text: [math.radians(x) for x in values_of(option, text)],
    "robot": lambda option, text: jl.Robot.load(text),
    "folder": folder,
    "writable": lambda option, text: ensure_writable(folder(option, text)) and text,
    "file": needing(
        "name a file in a folder that exists",
        lambda text: (
            text.strip() and not Path(text).is_dir() and Path(text).resolve().parent.is_dir()
        ),
    ),
    "page": needing("name a file that ends in .html", lambda text: text.lower().endswith(".html")),
    "movie": needing(
        "name a file that ends in .gif or .mp4",
        lambda text: text.lower().endswith((".gif", ".mp4")),
    ),
}
OPTIONS = tomllib.loads(Path(__file__).with_name("options.toml").read_text(encoding="utf-8"))
CHOICES = OPTIONS["choices"] | {"engines": list(ENGINES)}
SEVERAL = {"": {}, "+": {"nargs": "+"}, "*": {"nargs": "*"}, "...": {"action": "append"}}


def declare(
    parser: argparse.ArgumentParser, commands: Sequence[Work], dest: str = "command"
) -> dict[str, argparse.ArgumentParser]:
    """Add a parser for each of these commands, with its options; returns the parsers by name."""
    below = parser.add_subparsers(dest=dest, metavar=dest.upper(), parser_class=type(parser))
    for work in commands:
        text = work.__doc__
        name = work.__name__.rstrip("_")
        options = dict(OPTIONS[name])
        example = options.pop("example", None)
        help_ = text[:1].lower() + text[1:].rstrip(".")
        example = example and f"example: jumplab {example}"
        one = below.add_parser(name, help=help_, description=text, epilog=example)
        one.set_defaults(work=work)
        shared = {usage: OPTIONS["shared"][usage] for usage in options.pop("shared", ())}
        for usage, settings in (shared | options).items():
            add_option(one, usage, **settings)
        add_common(one)
    return below.choices


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options of every command; without defaults, which would undo them where they stand
    before COMMAND.
    """
    for usage, settings in OPTIONS["every"].items():
        add_option(parser, usage, default=argparse.SUPPRESS, **settings)


def add_option(
    parser: argparse.ArgumentParser,
    usage: str,
    *,
    kind: str | None = None,
    choices: str | list[str] | None = None,
    default: Any = None,
    **settings: Any,
) -> None:
    """Add one option, as ``options.toml`` describes it."""
    *names, last = usage.split()
    placeholder = last.rstrip("+*.")
    settings |= SEVERAL[last.removeprefix(placeholder)]
    if last.startswith("-"):
        names.append(last)
    if choices:
        settings["choices"] = CHOICES[choices] if isinstance(choices, str) else choices
        default = DEFAULT_ENGINE if default == "installed" else default
    elif last in names:
        undone = isinstance(default, bool)
        settings["action"] = argparse.BooleanOptionalAction if undone else "store_true"
        default = False if default is None else default
    else:
        settings["metavar"] = placeholder
    if kind:
        ends = (
            {"least": settings.pop("from"), "most": settings.pop("to")} if kind == "whole" else {}
        )
        settings["type"] = partial(KINDS[kind], (names or [placeholder])[-1], **ends)
    if kind and kind.startswith("values"):
        settings["help"] += f": {VALUES}" + (f" (default {default})" if default else "")
    parser.add_argument(*(names or [placeholder.lower()]), default=default, **settings)


# what commands do -------------------------------------------------------------------------------
def named(must: str, pair: str) -> tuple[str, str]:
    """Name and value of what was given as NAME=VALUE; ``must`` begins the sentence that refuses
    (:class:`InputError`) anything else.
    """
    name, equals, text = pair.partition("=")
    if not (name and equals):
        raise InputError(f"{must}, got {pair!r}")
    return name, text


def disturbances(option: str, pairs: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Read options of the form NAME=SIZE or NAME=FROM:TO, given several times: name -> (size,) or
    (from, to).
    """
    sizes = {}
    must = f"{option} must be NAME=SIZE or NAME=FROM:TO"
    for pair in pairs:
        name, text = named(must, pair)
        numbers = text.split(":")
        if len(numbers) > 2:
            raise InputError(f"{must}, got {pair!r}")
        sizes[name] = tuple(number(f"{option} {name}", part) for part in numbers)
    return sizes


def without(args: argparse.Namespace, why: str, **options: Any) -> None:
    """Refuse (:class:`InputError`) options that would be ignored: by name, and the value that each
    has if it was not given.
    """
    for name, default in options.items():
        if getattr(args, name) != default:
            raise InputError(f"--{name.replace('_', '-')} {why}; leave it out")


def given(function: Callable, args: argparse.Namespace, **more: Any) -> dict[str, Any]:
    """Arguments of a ``function``: ``more``, and the options that are called as its parameters.

    Its bars are shown on a terminal, and not with --quiet.
    """
    options = vars(args) | {"progress": False if "quiet" in args else None}
    names = inspect.signature(function).parameters
    return {name: options[name] for name in names if name in options} | more


def resumed(function: Callable, args: argparse.Namespace, kept: str = "trials", **more: Any) -> Any:
    """The result of a ``function`` with the arguments that are :func:`given`; if it is interrupted,
    the command says that what is ``kept`` need not be done again.
    """
    try:
        return function(**given(function, args, **more))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; finished {kept} are kept, and the same command resumes from there"
        ) from None


def judge(audit: Any, folder: str) -> None:
    """Say that the plan in ``folder`` passes its audit, or refuse it
    (:class:`InfeasibleError`).
    """
    count = len(audit.checks)
    failed = [check.name for check in audit.checks if not check.passed]
    if failed:
        raise InfeasibleError(
            f"the plan fails {len(failed)} of {count} checks of its audit ({', '.join(failed)}); "
            f"see passport.json in {folder!r}"
        )
    print(f"audit: {audit.line()}")


def print_summary(summary: Mapping[str, Any]) -> None:
    """Cost of the stages and what was planned."""
    columns = ("stage", "iterations", "build_s", "solve_s")
    print(jl.plots.table(summary["stages"], columns, decimals=2))
    if summary.get("method") == "three-step" and all(
        x["stage"][0] != "2" for x in summary["stages"]
    ):
        print("without stage 2, which cannot follow a flip")
    line = "planned: distance {planned_distance_m:.3f} m, rise {planned_rise_m:.3f} m"
    if summary.get("planned_side_m") is not None:
        line += ", side {planned_side_m:.3f} m, turn {turn_deg:.1f} deg"
    turn = math.degrees(summary.get("planned_yaw_rad") or 0.0)
    print(line.format_map({**summary, "turn_deg": turn}))


def print_simulation(metrics: Mapping[str, Any]) -> None:
    """Print distance, rise, landing and failed checks of a simulation."""
    lengths = (metrics["foot_distance_m"], metrics["com_rise_m"])
    distance, rise = ("none" if x is None else f"{x:.3f} m" for x in lengths)
    print(f"simulated: distance {distance}, rise {rise}")
    verdict = "stands" if metrics["landed"] else "FAILED"
    line = f"landing: {verdict}, {{standing_s:.2f}} s on its feet after touchdown ({{reason}})"
    print(line.format_map(metrics))
    checks = metrics["checks"]
    failed = [check for check in checks if not check["passed"]]
    if not failed:
        print(f"checks: all {len(checks)} of the run passed")
    for check in failed:
        value = "{value:.4g} {unit}".format_map(check).rstrip()
        line = f"CHECK FAILED: {{name}} {value}, at most {{limit:.4g}}: {{catches}}"
        print(line.format_map(check))
