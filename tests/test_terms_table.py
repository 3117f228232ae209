"""All terms and bounds of the stages as numbers and words, against the file beside this one.

A weight, a bound, a scale or an equation that changes is a decision: after it, ``python tests/test_terms_table.py``
writes the file anew, and the change is read in the diff.
"""

import re
from collections.abc import Iterator
from dataclasses import asdict
from difflib import unified_diff
from pathlib import Path

import numpy as np

from jumplab.models.spatial import SpatialModel
from jumplab.ocp import Bound, Problem
from jumplab.robot import Robot
from jumplab.robot.reach import reach
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.stages import srmp, whole_body
from jumplab.stages.joint_qp.settings import GENTLE, Options
from jumplab.stages.whole_body import Contacts, Limits, Weights
from jumplab.stages.whole_body.planner import jump_contacts
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.settings import SPATIAL_MESH
from jumplab.stages.whole_body.terms import Body
from jumplab.stages.srmp import SrmpSettings
from jumplab.stages.whole_body import Limits, Weights
from jumplab.task import JumpTask

TABLE = Path(__file__).with_name("terms.txt")
TARGET = JumpTask(0.6, 0.4, 0.3)  # for which the bounds that depend on the target are told
ROUNDING = 1e-12  # below, a number is zero


def number(x) -> str:
    values = np.atleast_1d(np.asarray(x, float))
    values = np.where(np.abs(values) < ROUNDING, 0.0, values)
    return " ".join(f"{v:.5g}" for v in (values[:1] if np.all(values == values[0]) else values))


def lines(problem: Problem, parameters: dict) -> Iterator[str]:
    """One line per term, bound, duration and constant."""

    def told(low, high):
        low, high = (x(parameters) if callable(x) else x for x in (low, high))
        return f"{number(low)} ... {number(high)}"

    for phase in problem.phases:
        yield f"{problem.name}/{phase.name} | duration | {told(*phase.duration)} s | {phase.intervals} intervals"
        if phase.shared:
            yield f"{problem.name}/{phase.name} | shares {phase.shared} with the phase before"
        for name, (low, high, scale, *key) in phase.constants.items():
            how = f"scale {number(scale)}" + "".join(f" | {x}" for x in key)
            yield f"{problem.name}/{phase.name} | constant {name} | {told(low, high)} | {how}"
    for owner, x in (*problem.terms(), *problem.bounds()):
        head = f"{problem.place(owner)} | {x.name} | {x.equation}"
        if isinstance(x, Bound):
            yield f"{head} | {x.on} {x.where} | {told(x.lower, x.upper)} {x.unit}"
        elif x.is_cost:
            yield f"{head} | {x.at} | weight {number(x.weight)} | {x.unit}"
        else:
            how = f" | scale {number(x.scale)}" + f" | skip {x.skip}" * (x.skip != (0, 0)) + " | link" * x.identity
            yield f"{head} | {x.at} | {told(x.lower, x.upper)} {x.unit}{how}"


def table() -> str:
    """The file's text."""
    robot = Robot.load()
    values = dict(stance=stance_angles(robot), distance=TARGET.distance_m, platform=TARGET.platform_m, edge=0.4)
    values |= dict(takeoff_speed=TARGET.takeoff_speed, rotation=0.0, gravity=TARGET.gravity, momentum=1.0, launch_s=1.0)
    rod = srmp.parameters(TARGET, reach(robot))
    found = [*lines(srmp.build_problem(robot), rod), *lines(whole_body.build_problem(robot), values)]
    flips = [*lines(srmp.build_problem(robot, SrmpSettings().of_flip()), rod)]
    flips += lines(whole_body.build_problem(robot, limits=Limits().of_flip(), weights=Weights().of_flip()), values)
    found += [f"of a flip: {line}" for line in flips if line not in found]
    stance = SpatialModel(robot.model).of_pinocchio(stance_configuration(robot)[None])[0]
    body, limits, weights = Body(robot), Limits(), Weights()
    given = {"stance": stance, "yaw": 2 * np.pi, "takeoff_speed": TARGET.takeoff_speed}
    for contacts in (jump_contacts(limits, SPATIAL_MESH), Contacts.hop(robot)):
        found += lines(Schedule(body, contacts, limits, weights).problem(), given)
    for name, options in (("joint qp", Options()), ("joint qp, gentle", GENTLE)):
        for part, fields in asdict(options).items():
            rows = fields.items() if isinstance(fields, dict) else [("", fields)]
            found += [f"{name}/{part} | {key} | {value}" for key, value in rows]
    return "\n".join(found) + "\n"


def test_every_term_is_as_the_table_says():
    text = table()
    changes = unified_diff(TABLE.read_text().splitlines(), text.splitlines(), lineterm="", n=0)
    assert not "\n".join(changes)


def test_the_table_is_whole():
    stages = [line.partition("/")[0] for line in TABLE.read_text().splitlines()]
    assert (
        stages.count("SRMP") > 60
        and stages.count("whole body") > 60
        and stages.count("joint qp") > 30
        and stages.count("spatial") > 60
    )


# the paper's equations that stages 1 and 3 keep, relax or weigh; SL-D1 and WL-K1 are how their models are built
EQUATIONS = {"SRMP": "SL-J1..J5, SL-E1..E6, SL-P1..P5, SL-B1, SF-J1, SF-D1, SF-E1, SF-L1..L4, SF-B1",
             "whole body": "WL-J1..J3, WL-D1, WL-K2, WL-E1, WF-J1..J2, WF-D1, WF-L1..L3, WF-E1..E2, SL-E1..E4, SL-E6, "
             "SL-P2"}  # fmt: skip


def equations(text: str) -> set[str]:
    """Numbers of equations in a text: "SL-E3, E4; SF-L1..L3" names five."""
    found, group = set(), ""
    for word in re.split(r"[ ,;:]+", text):
        if parts := re.fullmatch(r"(?:([SW][LF])-)?([A-Z])(\d)(?:\.\.[A-Z](\d))?", word):
            group = parts[1] or group
            found |= {f"{group}-{parts[2]}{i}" for i in range(int(parts[3]), int(parts[4] or parts[3]) + 1)}
    return found


def test_equations_of_the_paper_and_terms_in_force_belong_together():
    """No equation without a term that weighs or binds something, and no term of an equation that is not known."""
    for problem in (srmp.build_problem(Robot.load()), whole_body.build_problem(Robot.load())):
        named, in_force = set(), set()
        for _, x in (*problem.terms(), *problem.bounds()):
            named |= equations(x.equation)
            bounds = (x.lower, x.upper) if isinstance(x, Bound) or not x.is_cost else ()
            limited = any(callable(b) or np.isfinite(b).any() for b in bounds)
            in_force |= equations(x.equation) if limited or getattr(x, "weight", None) else set()
        assert named == in_force == equations(EQUATIONS[problem.name])


if __name__ == "__main__":
    TABLE.write_text(table())
