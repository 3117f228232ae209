"""All terms and bounds of the stages as numbers and words, against the file beside this one.

A weight, a bound, a scale or an equation that changes is a decision: after it, ``python tests/test_terms_table.py``
writes the file anew, and the change is read in the diff.
"""

import re
from collections.abc import Iterator
from dataclasses import asdict, replace
from difflib import unified_diff
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from jumplab.ocp import Bound, Problem
from jumplab.robot import Robot
from jumplab.robot.reach import reach
from jumplab.stages import srmp
from jumplab.stages.joint_qp import build_problem
from jumplab.stages.joint_qp.settings import Options
from jumplab.stages.srmp import SrmpSettings
from jumplab.stages.whole_body import Contacts, Limits, Mesh, Weights, coordinates
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import jump_contacts
from jumplab.stages.whole_body.problem import Schedule
from jumplab.task import JumpTask

TABLE = Path(__file__).with_name("terms.txt")
TARGET = JumpTask(0.6, 0.4, 0.3)  # for which the bounds that depend on the target are told
ROUNDING = 1e-12  # below, a number is zero
PROGRAMS = "direct", "whole body", "spatial"  # the whole-body program in the plane, there with stage 1, and in space


def program(body: Body, name: str, contacts: Contacts | None = None, *, flip: bool = False) -> Problem:
    """The whole-body program under the name of a stage; of a standing jump without ``contacts``."""
    limits = Limits()
    weights = Weights()
    mesh = Mesh()
    if flip:
        limits = limits.of_flip()
        weights = weights.of_flip()
        mesh = mesh.of_flip()
    free = coordinates.whole(body) if name == "spatial" else coordinates.even(body)
    contacts = contacts or jump_contacts(limits, mesh)
    schedule = Schedule(body, contacts, limits, weights, free=free, tracking=name == "whole body")
    return replace(schedule.problem(), name=name)


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
        head = f"{problem.name}/{phase.name}"
        yield f"{head} | duration | {told(*phase.duration)} s | {phase.intervals} intervals"
        if phase.integrated is not None:
            given = [x for x in phase.coordinates if x not in phase.integrated]
            yield f"{head} | integrated | {', '.join(phase.integrated)} | not {', '.join(given) or 'any'}"
        if phase.shared:
            yield f"{head} | shares {phase.shared} with the phase before"
        for name, (low, high, scale, *key) in phase.constants.items():
            how = f"scale {number(scale)}" + "".join(f" | {x}" for x in key)
            yield f"{head} | constant {name} | {told(low, high)} | {how}"
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
    body = Body(robot)
    rod = srmp.parameters(TARGET, reach(robot))
    found = [*lines(srmp.build_problem(robot), rod)]
    flips = [*lines(srmp.build_problem(robot, SrmpSettings().of_flip()), rod)]
    for name in PROGRAMS:
        free = coordinates.whole(body) if name == "spatial" else coordinates.even(body)
        given = {"stance": free.taken(body.stance), "yaw": 2 * np.pi, "rotation": -2 * np.pi}
        given["takeoff_speed"] = TARGET.takeoff_speed
        found += lines(program(body, name), given)
        flips += lines(program(body, name, flip=True), given)
        if name == "spatial":
            found += lines(program(body, name, Contacts.hop(robot)), given)
    found += [f"of a flip: {line}" for line in flips if line not in found]
    for part, fields in asdict(Options()).items():
        rows = fields.items() if isinstance(fields, dict) else [("", fields)]
        found += [f"joint qp/{part} | {key} | {value}" for key, value in rows]
    for row in build_problem(Options()).table():
        head = " | ".join(row[key] for key in ("name", "equation", "kind", "value", "unit"))
        found.append(f"joint qp/{row['phase']} | {head}")
    return "\n".join(found) + "\n"


def test_every_term_is_as_the_table_says():
    text = table()
    changes = unified_diff(TABLE.read_text().splitlines(), text.splitlines(), lineterm="", n=0)
    assert not "\n".join(changes)


def test_the_table_is_whole():
    stages = [re.split("[/|]", line)[0].strip() for line in TABLE.read_text().splitlines()]
    least = {"SRMP": 60, "joint qp": 30, "direct": 60, "whole body": 75, "spatial": 150}
    assert {name: stages.count(name) > count for name, count in least.items()} == dict.fromkeys(least, True)
    assert {f"of a flip: {name}" for name in ("SRMP", *PROGRAMS)} <= set(stages)


# the paper's equations that stages keep, relax or weigh; SL-D1 and WL-K1 are how their models are built. Of stage 3's,
# WF-L1..L3 are how phases share their nodes, SL-E2 is a constant of the flight, SL-P2 is where forces act on the sole.
OF_BODY = "WL-J2, WL-K2, WL-E1, WF-J2, WF-D1, WF-E1..E2, SL-E1..E4, SL-E6"
EQUATIONS = {
    "SRMP": "SL-J1..J5, SL-E1..E6, SL-P1..P5, SL-B1, SF-J1, SF-D1, SF-E1, SF-L1..L4, SF-B1",
    "direct": OF_BODY,
    "whole body": f"{OF_BODY}, WL-J1, WL-J3, WL-D1, WF-J1",
    "spatial": OF_BODY,
}


def equations(text: str) -> set[str]:
    """Numbers of equations in a text: "SL-E3, E4; SF-L1..L3" names five."""
    found, group = set(), ""
    for word in re.split(r"[ ,;:]+", text):
        if parts := re.fullmatch(r"(?:([SW][LF])-)?([A-Z])(\d)(?:\.\.[A-Z](\d))?", word):
            group = parts[1] or group
            found |= {f"{group}-{parts[2]}{i}" for i in range(int(parts[3]), int(parts[4] or parts[3]) + 1)}
    return found


def test_phases_share_their_nodes_and_the_flight_has_the_speed_of_the_target():
    """WF-L1..L3, for which there are no terms, and SL-E2, WL-E1."""
    body = Body(Robot.load())
    for name in PROGRAMS:
        flat, toe, flight = program(body, name).phases
        assert (flat.shared, toe.shared, flight.shared) == ("", "qvaz", "qvaz")
        (speed,) = (t for t in flight.terms if t.name == "vertical take-off speed")
        at = SimpleNamespace(c=SimpleNamespace(vel_z=3.0), p=SimpleNamespace(takeoff_speed=2.5))
        assert (speed.at, speed.lower, speed.upper, speed.expression(at)) == ("start", 0.0, 0.0, 0.5)


def test_equations_of_the_paper_and_terms_in_force_belong_together():
    """No equation without a term that weighs or binds something, and no term of an equation that is not known."""
    body = Body(Robot.load())
    for problem in (srmp.build_problem(body.robot), *(program(body, name) for name in PROGRAMS)):
        named, in_force = set(), set()
        for _, x in (*problem.terms(), *problem.bounds()):
            named |= equations(x.equation)
            bounds = (x.lower, x.upper) if isinstance(x, Bound) or not x.is_cost else ()
            limited = any(callable(b) or np.isfinite(b).any() for b in bounds)
            in_force |= equations(x.equation) if limited or getattr(x, "weight", None) else set()
        assert named == in_force == equations(EQUATIONS[problem.name])


if __name__ == "__main__":
    TABLE.write_text(table())
