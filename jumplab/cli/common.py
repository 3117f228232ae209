"""What the commands share: how one is declared, its options and what they take, and what is printed of a result."""

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any

from jumplab.errors import InfeasibleError, InputError
from jumplab.sim import DEFAULT_ENGINE, ENGINES

Option = tuple[tuple[str, ...], dict[str, Any]]  # what add_argument takes
Kind = Callable[[str, str], Any]  # the value of an option, from its name and its text; raises InputError
Work = Callable[[argparse.Namespace], None]


class Late:
    """A module that is imported when it is first used: help and refusals need not wait for the heavy libraries."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self._name), attribute)


def command(*options: Option, actions: Sequence[Work] = ()) -> Callable[[Work], Work]:
    """Make a command of a function: its name and docstring are the command's; ``actions`` are commands below it."""

    def mark(work: Work) -> Work:
        work.options, work.actions = (*options, JSON, QUIET, DEBUG), actions
        return work

    return mark


def declare(parser: argparse.ArgumentParser, commands: Sequence[Work], dest: str = "command") -> None:
    """Add a parser for each of these commands, and for those below them."""
    below = parser.add_subparsers(dest=dest, metavar=dest.upper(), parser_class=type(parser))
    for work in commands:
        text = work.__doc__ or ""
        parser = below.add_parser(work.__name__.rstrip("_"), help=text[:1].lower() + text[1:].rstrip("."))
        parser.set_defaults(work=work)
        for names, how in work.options:
            parser.add_argument(*names, **how)
        if work.actions:
            declare(parser, work.actions, "action")


def opt(usage: str, text: str, default: Any = None, kind: Kind | tuple | None = None, **how: Any) -> Option:
    """Declare an option, ``opt("--out DIR", "where to")``, or an argument, ``opt("DIR", "where from")``.

    Parameters
    ----------
    usage : names, then the placeholder of the value. "DIR+" and "DIR*" take several values, "DIR..." may be repeated.
        Without placeholder and choices it is a flag; one that has a default can also be undone with --no-.
    default : a text is read as if it had been typed.
    kind : what makes the value of the text, or a tuple of choices.
    """
    names = tuple(word for word in usage.split() if word.startswith("-"))
    placeholder = usage.split()[-1]
    for sign, meaning in (("+", {"nargs": "+"}), ("*", {"nargs": "*"}), ("...", {"action": "append"})):
        if placeholder.endswith(sign):
            how |= meaning
            placeholder = placeholder.removesuffix(sign)
    if isinstance(kind, tuple):
        how["choices"] = kind
    elif placeholder in names:
        how["action"] = argparse.BooleanOptionalAction if isinstance(default, bool) else "store_true"
    else:
        how |= {"metavar": placeholder, "type": partial(kind, names[-1]) if kind else str}
    return names or (placeholder.lower(),), {"help": text, "default": default, **how}


def number(option: str, text: str) -> float:
    """The number that an option was given."""
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option} must be a number, got {text!r}") from None


def needing(what: str, fits: Callable[[Any], Any], make: Kind = lambda option, text: text) -> Kind:
    """Kind of an option that must ``what``: refuses a value that does not fit."""

    def kind(option: str, text: str) -> Any:
        value = make(option, text)
        if not fits(value):
            raise InputError(f"{option} must {what}, got {text!r}")
        return value

    return kind


def whole(least: int, most: int) -> Kind:
    """Kind of an option that takes a whole number from ``least`` to ``most``."""
    check = needing(
        f"be a whole number from {least} to {most}", lambda x: least <= x <= most and x.is_integer(), number
    )
    return lambda option, text: int(check(option, text))


def values_of(option: str, text: str) -> list[float]:
    """Kind of an option that takes numbers, as FROM:TO:COUNT or with commas."""
    parts = text.split(":")
    if len(parts) == 1:
        return [number(option, part) for part in text.split(",")]
    if len(parts) != 3 or not parts[2].isdecimal() or not 1 <= int(parts[2]) <= MOST_VALUES:
        raise InputError(f"{option} must be {VALUES} with COUNT from 1 to {MOST_VALUES}, got {text!r}")
    first, last, count = number(option, parts[0]), number(option, parts[1]), int(parts[2])
    return [round(first + (last - first) * k / max(count - 1, 1), 9) for k in range(count)]


def disturbances(option: str, pairs: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """What was given as NAME=SIZE or NAME=FROM:TO, several times."""
    found: dict[str, tuple[float, ...]] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        numbers = text.split(":")
        if not (name and equals) or len(numbers) > 2:
            raise InputError(f"{option} must be NAME=SIZE or NAME=FROM:TO, got {pair!r}")
        found[name] = tuple(number(f"{option} {name}", part) for part in numbers)
    return found


DISTURB = opt(
    "--disturb NAME=SIZE...", "payload_kg=5, friction=0.3:1.0 ...; a wrong name shows all; may be repeated", []
)
VALUES, MOST_VALUES = "FROM:TO:COUNT or A,B,...", 10_000
folder = needing("name a folder", str.strip)
# without defaults, which would undo them where they stand before COMMAND
DEBUG = opt("--debug", "show tracebacks", argparse.SUPPRESS)
JSON = opt("--json", "one JSON object on stdout, refusals included, instead of text", argparse.SUPPRESS)
QUIET = opt("--quiet", "say nothing but what goes wrong (and --json)", argparse.SUPPRESS)
JOBS = opt("--jobs N", "processes side by side (default: one per core)", None, whole(1, 4096))
SEED = opt("--seed S", "seed of the first robot (default 0)", None, whole(0, 2**31 - 1))
PLAN = opt("DIR", "folder of a plan")
MODE = opt("--mode", "how the joints follow the plan up to touchdown", "position", ("position", "pd"))
ENGINE = opt("--engine", "physics engine of the simulation", DEFAULT_ENGINE, tuple(ENGINES))
TRACKERS = ("unitree-csv", "gmr-pkl", "mjlab-npz", "beyondmimic-npz", "holosoma-npz", "mujoco")
EXPORTED = ("csv", "npz", "urdf-replay", *TRACKERS)  # of jumplab.io.export
FPS = opt("--fps N", "frames per second (default: 1000, 100 or, for trackers, 50 or 30)", None, number)
METHODS = ("three-step", "direct")
ROBOT = opt("--robot ROBOT", "shipped robot (see 'jumplab robot list') or path of a robot's TOML file", "bhr")
JUMP = (
    opt("--distance-m M", "travel of the feet [m] (default 1.0)", "1.0", number),
    opt("--height-m M", "rise of the CoM in flight [m] (default 0.5)", "0.5", number),
    ROBOT,
)


def without(args: argparse.Namespace, why: str, **options: Any) -> None:
    """Refuse options that would be ignored: by name, and the value that each has if it was not given."""
    for name, default in options.items():
        if getattr(args, name) != default:
            raise InputError(f"--{name.replace('_', '-')} {why}; leave it away")


def judge(audit: Any, folder: str) -> None:
    """Say that the audit is clean, or refuse the plan."""
    failed = [check.name for check in audit.checks if not check.passed]
    if failed:
        said = f"the plan fails {len(failed)} of {len(audit.checks)} checks of its audit ({', '.join(failed)})"
        raise InfeasibleError(f"{said}; see passport.json in {folder!r}")
    print(f"audit: all {len(audit.checks)} checks passed")


def print_summary(summary: Mapping[str, Any]) -> None:
    """Cost of the stages and what was planned."""
    print(f"{'stage':<22}{'iterations':>11}{'build':>10}{'solve':>10}")
    for row in summary["stages"]:
        print(f"{row['stage']:<22}{row['iterations']:>11}{row['build_s']:>8.2f} s{row['solve_s']:>8.2f} s")
    side, yaw = summary.get("planned_side_m"), summary.get("planned_yaw_rad")
    away = "" if side is None else f", side {side:.3f} m, turn {math.degrees(yaw):.1f} deg"
    print(f"planned: distance {summary['planned_distance_m']:.3f} m, rise {summary['planned_rise_m']:.3f} m{away}")
    if followed := summary.get("tracking"):
        off = (f"{100 * followed[phase]['rho']['relative_rms']:.1f} % in {phase}" for phase in ("launch", "flight"))
        print(f"inertia off stage 1's by {', '.join(off)} (rms)")


def misses(target: Mapping[str, float], values: Callable[[str], Sequence[float]]) -> str:
    """How far feet stand and point beyond a ``target``, least and most; ``values`` gives a metric of many jumps."""
    rows = ("forward", "foot_distance_m", "distance_m", 1e3, "mm"), ("side", "side_m", "side_m", 1e3, "mm")
    told = []
    for word, name, asked, factor, unit in (*rows, ("heading", "yaw_rad", "yaw_rad", math.degrees(1), "deg")):
        off = [factor * (x - target[asked]) for x in values(name)]
        told.append(f"{word} {min(off):+.1f} ... {max(off):+.1f} {unit}")
    return ", ".join(told)


def print_simulation(metrics: Mapping[str, Any]) -> None:
    """What the simulation made of it."""
    lengths = (metrics["foot_distance_m"], metrics["com_rise_m"])
    distance, rise = ("none" if x is None else f"{x:.3f} m" for x in lengths)
    print(f"simulated: distance {distance}, rise {rise}")
    verdict = "stands" if metrics["landed"] else "FAILED"
    print(f"landing: {verdict}, {metrics['standing_s']:.2f} s on its feet after touchdown ({metrics['reason']})")
    failed = [finding for finding in metrics["honesty"] if not finding["passed"]]
    if not failed:
        print(f"honesty: all {len(metrics['honesty'])} checks of the run passed")
    for finding in failed:
        value = f"{finding['value']:.4g} {finding['unit']}".rstrip()
        print(f"NOT HONEST: {finding['name']} {value}, at most {finding['limit']:.4g}: {finding['catches']}")
