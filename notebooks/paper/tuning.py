"""The numbers that decide a plan: a dozen to touch first, measured, then every other one by table.

``python -m paper.tuning`` in the folder of the notebooks measures what :data:`LOG` lacks, one line per number and
value, and writes the tables of ``tuning.md`` anew between its markers.
"""

from __future__ import annotations

import ast
import io
import json
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

import jumplab
from jumplab.auditing.audit import audit
from jumplab.errors import JumplabError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body.settings import Limits, Mesh, Weights
from jumplab.task import JumpTask
from paper import logs

LOG = Path(__file__).with_name("tuning.jsonl")
PAGE = Path(__file__).parent.parent / "tuning.md"
ROOMS = "stages", "ocp", "control", "sim"  # whose numbers are listed
TARGETS = {  # robot -> targets it is asked, in metres: far, high, to the left
    "bhr": ((0.3, 0.3, 0.0), (0.6, 0.4, 0.0), (1.0, 0.5, 0.0), (0.2, 0.4, 0.2)),
    "g1_arms": ((0.3, 0.2, 0.0), (0.4, 0.2, 0.0), (0.2, 0.2, 0.15)),
}
TORQUE_WEIGHT, ACCELERATION_WEIGHT = 2e-4, 2e-3  # one measure for all plans: the weights as they ship


@dataclass(frozen=True)
class Number:
    """One that a user may want to touch, and the values that are tried."""

    option: str  # of jl.plan and jl.Planner
    name: str
    unit: str
    values: tuple[Any, Any]
    means: str


FIRST = (
    Number("limits", "torque_share", "1", (0.7, 1.0), "share of the peak torque that a plan may use"),
    Number("limits", "speed_share", "1", (0.75, 1.0), "share of the speed limit"),
    Number("limits", "friction", "1", (0.3, 0.5), "friction that the plan counts on"),
    Number("limits", "cop_reserve_share", "1", (0.0, 0.2), "CoP kept from both ends of the sole until the heel rises"),
    Number("limits", "toe_s", "s", ((0.06, 0.08), (0.06, 0.2)), "duration of the phase on the toes"),
    Number("limits", "flat_s", "s", ((0.25, 0.5), (0.25, 1.3)), "duration of the phase on flat feet"),
    Number("limits", "clearance_m", "m", (0.02, 0.08), "soles over the ground in mid-flight"),
    Number("limits", "touchdown_joint_rate", "rad/s", (1.0, 6.0), "rate of each joint at touchdown"),
    Number("limits", "touchdown_pitch", "rad", ((0.0, 0.1), (0.0, 0.5)), "lean of the trunk at touchdown"),
    Number("weights", "torque", "1/(N m)^2/s", (2e-5, 2e-3), "cost of torques"),
    Number("weights", "acceleration", "1/(rad/s^2)^2/s", (2e-4, 2e-2), "cost of joint accelerations"),
    Number("mesh", "flat", "intervals", (8, 24), "mesh of the flat phase; toe and flight in proportion"),
)


def changes(number: Number, value: Any) -> dict[str, Any]:
    """Arguments of :class:`jumplab.Planner`."""
    if number.option == "mesh":
        return {"mesh": {"flat": value, "toe": value * 2 // 3, "flight": value}}
    return {number.option: {number.name: value}}


def measured(robot: str, options: dict[str, Any]) -> list[dict[str, float] | None]:
    """For each target: effort of the plan, its iterations, and whether the audit passes; None without a plan."""
    planner = Planner(Robot.load(robot), keep=True, **options)
    rows = []
    for distance_m, height_m, side_m in TARGETS[robot]:
        try:
            plan = planner.plan(JumpTask(distance_m, height_m, side_m=side_m))
        except JumplabError:
            rows.append(None)
            continue
        clean = audit(plan.tape, plan.robot, plan.task, edge_m=plan.summary["platform_edge_m"]).passed
        iterations = sum(attempt.iterations for attempt in plan.attempts)
        rows.append({"effort": effort(plan.tape), "iterations": iterations, "clean": bool(clean)})
    return rows


def effort(tape: Tape) -> float:
    """Torques and joint accelerations of a tape squared, with the weights as they ship, integrated over time [1]."""
    squares = TORQUE_WEIGHT * np.sum(tape.tau**2, axis=1) + ACCELERATION_WEIGHT * np.sum(tape.a[:, 6:] ** 2, axis=1)
    return float(np.trapezoid(squares, tape.t))


def cases() -> Iterator[tuple[str, str, Any, dict[str, Any]]]:
    """(robot, name, value, options) of every run; the first of a robot is as shipped."""
    for robot in TARGETS:
        yield robot, "as shipped", None, {}
        for number in FIRST:
            for value in number.values:
                yield robot, number.name, value, changes(number, value)


def case_of(robot: str, name: str, value: Any) -> str:
    """Key of a run."""
    return f"{robot} {name} {json.dumps(value)}"


def measure() -> None:
    """Solve what the log lacks."""
    with logs.keep(LOG, itemgetter("case")) as log:
        for robot, name, value, options in cases():
            case = case_of(robot, name, value)
            if case not in log.done:
                print(case, file=sys.stderr)
                log.add({"case": case, "plans": measured(robot, options)})


# ------------------------------------------------------------------------------------------ tables
def shown(value: Any) -> str:
    """A number, or a range."""
    return " to ".join(f"{x:g}" for x in value) if isinstance(value, tuple | list) else f"{value:g}"


def compared(plans: list[dict[str, float] | None], shipped: list[dict[str, float] | None]) -> str:
    """Effort and iterations of plans with a changed number, times those as shipped (medians); and what fails."""
    pairs = [(a, b) for a, b in zip(plans, shipped, strict=True) if a and b]
    words = []
    for name in ("effort", "iterations"):
        if pairs:
            words.append(f"{np.median([a[name] / b[name] for a, b in pairs]):.2f}")
    if missing := plans.count(None):
        words.append(f"{missing} of {len(plans)} without a plan")
    if unclean := sum(not row["clean"] for row in plans if row):
        words.append(f"{unclean} of {len(plans)} fail the audit")
    return ", ".join(words)


def first_table() -> str:
    """The dozen, as Markdown: each with both values that were tried, on each robot."""
    done = {row["case"]: row["plans"] for row, _ in logs.lines(LOG)}
    defaults = {"limits": Limits(), "weights": Weights(), "mesh": Mesh()}
    rows = []
    for number in FIRST:
        ships = shown(getattr(defaults[number.option], number.name))
        tried = "; ".join(map(shown, number.values))
        outcomes = []
        for robot in TARGETS:
            shipped = done[case_of(robot, "as shipped", None)]
            found = [compared(done[case_of(robot, number.name, value)], shipped) for value in number.values]
            outcomes.append("; ".join(found))
        rows.append([f"`{number.option}={{'{number.name}': ...}}`", ships, number.unit, tried, *outcomes, number.means])
    return table(["option", "as shipped", "unit", "tried", *TARGETS, "meaning"], rows)


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table of Markdown."""
    cells = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def numbers_in(path: Path) -> Iterator[list[str]]:
    """Names, values and comments of the numbers that a module or its settings classes set by hand."""
    text = path.read_text(encoding="utf-8")
    comments = {
        token.start[0]: (token.string.lstrip("# "), token.line.lstrip().startswith("#"))
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT
    }
    module = ast.parse(text)
    blocks = [("", module.body)]
    blocks += [(f"{node.name}.", node.body) for node in module.body if isinstance(node, ast.ClassDef)]
    for owner, body in blocks:
        for node in body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and is_number(node.value):
                name = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
                yield [f"`{owner}{name}`", ast.unparse(node.value), comment_of(node, comments)]


def is_number(node: ast.expr) -> bool:
    """Whether an expression is a number, or a tuple of some."""
    try:
        value = ast.literal_eval(node)
    except ValueError:
        return False
    values = value if isinstance(value, tuple) else (value,)
    return bool(values) and all(type(x) in (int, float) for x in values)


def comment_of(node: ast.stmt, comments: dict[int, tuple[str, bool]]) -> str:
    """The comment behind a statement with the lines that go on below it, else the lines before it."""
    lines = range(node.lineno, node.end_lineno + 1)
    words = [comments[line][0] for line in lines if line in comments]
    step, line = (1, node.end_lineno + 1) if words else (-1, node.lineno - 1)
    further = []
    while comments.get(line, ("", False))[1]:
        further.append(comments[line][0])
        line += step
    # lines below belong to a comment that they continue; before another number's own, they are that one's
    if words and further and line not in comments:
        further = []
    return " ".join(words + further[::step]).replace("|", "or")


def all_tables() -> str:
    """Every number of the stages, the solver, the controller and the simulation, as Markdown."""
    package = Path(jumplab.__file__).parent
    parts = []
    for room in ROOMS:
        rows = [
            [f"`{path.relative_to(package).as_posix()}`", *row]
            for path in sorted((package / room).rglob("*.py"))
            for row in numbers_in(path)
        ]
        parts.append(f"### `jumplab/{room}`\n\n" + table(["file", "name", "value", "reason"], rows))
    return "\n\n".join(parts)


def page() -> str:
    """``tuning.md`` with its tables made anew."""
    text = PAGE.read_text(encoding="utf-8")
    for name, content in (("first", first_table()), ("all", all_tables())):
        before, rest = text.split(f"<!-- {name} -->\n")
        after = rest.split(f"<!-- end of {name} -->\n")[1]
        text = f"{before}<!-- {name} -->\n{content}\n<!-- end of {name} -->\n{after}"
    return text


if __name__ == "__main__":
    measure()
    PAGE.write_text(page(), encoding="utf-8")
