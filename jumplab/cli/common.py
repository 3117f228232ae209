"""What several commands share: targets and folders as they are typed, and what is printed of results."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from typing import Any

from jumplab.errors import InfeasibleError, InputError
from jumplab.task import JumpTask


def common_options() -> argparse.ArgumentParser:
    """Options of every command."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help="show tracebacks")
    return common


def robot_option() -> argparse.ArgumentParser:
    """The option ``--robot``."""
    robot = argparse.ArgumentParser(add_help=False)
    robot.add_argument(
        "--robot", default="bhr", help="shipped robot (see 'jumplab robot list') or path of a robot's TOML file"
    )
    return robot


def target_options() -> argparse.ArgumentParser:
    """``--distance-m`` and ``--height-m``."""
    target = argparse.ArgumentParser(add_help=False)
    target.add_argument("--distance-m", default="1.0", metavar="M", help="travel of the feet [m] (default 1.0)")
    target.add_argument("--height-m", default="0.5", metavar="M", help="rise of the CoM in flight [m] (default 0.5)")
    return target


def engine_option() -> argparse.ArgumentParser:
    """The option ``--engine``."""
    from jumplab.sim import DEFAULT_ENGINE, ENGINES

    engine = argparse.ArgumentParser(add_help=False)
    engine.add_argument("--engine", choices=tuple(ENGINES), default=DEFAULT_ENGINE,
                        help=f"whose physics it is (default {DEFAULT_ENGINE})")  # fmt: skip
    return engine


def number(option: str, text: str) -> float:
    """The number that an option was given."""
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option} must be a number, got {text!r}") from None


def task_of(args: argparse.Namespace) -> JumpTask:
    """The target that the options describe."""
    return JumpTask(
        distance_m=number("--distance-m", args.distance_m),
        height_m=number("--height-m", args.height_m),
        platform_m=number("--platform-m", getattr(args, "platform_m", "0")),
        rotation_rad=math.radians(number("--rotation-deg", getattr(args, "rotation_deg", "0"))),
    )


def folder_of(option: str, text: str | None) -> str | None:
    """A folder's name, refused if it is blank."""
    if text is not None and not text.strip():
        raise InputError(f"{option} must name a folder, got {text!r}")
    return text


def judge(audit: Any, folder: str) -> None:
    """Say that the audit is clean, or refuse the plan."""
    failed = [check.name for check in audit.checks if not check.passed]
    if failed:
        raise InfeasibleError(
            f"the plan fails {len(failed)} of {len(audit.checks)} checks of its audit ({', '.join(failed)}); "
            f"see passport.json in {folder!r}"
        )
    print(f"audit: all {len(audit.checks)} checks passed")


def print_summary(summary: Mapping[str, Any]) -> None:
    """Cost of the stages and what was planned."""
    print(f"{'stage':<22}{'iterations':>11}{'build':>10}{'solve':>10}")
    for row in summary["stages"]:
        print(f"{row['stage']:<22}{row['iterations']:>11}{row['build_s']:>8.2f} s{row['solve_s']:>8.2f} s")
    print(f"planned: distance {summary['planned_distance_m']:.3f} m, rise {summary['planned_rise_m']:.3f} m")


def print_simulation(metrics: Mapping[str, Any]) -> None:
    """What the simulation made of it."""
    distance, rise = (
        "none" if metrics[name] is None else f"{metrics[name]:.3f} m" for name in ("foot_distance_m", "com_rise_m")
    )
    print(f"simulated: distance {distance}, rise {rise}")
    verdict = "stands" if metrics["landed"] else "FAILED"
    print(f"landing: {verdict}, {metrics['standing_s']:.2f} s on its feet after touchdown ({metrics['reason']})")
    failed = [finding for finding in metrics["honesty"] if not finding["passed"]]
    if not failed:
        print(f"honesty: all {len(metrics['honesty'])} checks of the run passed")
    for finding in failed:
        value = f"{finding['value']:.4g} {finding['unit']}".rstrip()
        print(f"NOT HONEST: {finding['name']} {value}, at most {finding['limit']:.4g}: {finding['catches']}")
