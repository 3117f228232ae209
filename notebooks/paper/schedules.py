"""Hops, run-ups and the like: which are planned, pass the audit, and stand in which engine and contact."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import trapezoid

import jumplab as jl
from jumplab import sim
from jumplab.control import STEP_S
from jumplab.errors import JumplabError, SolverError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show.style import PAGE_IN, by_phase, new_figure
from jumplab.sim import SLIGHT
from jumplab.stages.plan import JumpPlan, planned
from jumplab.studies import chain, trials
from paper import logs

LOG = Path(__file__).with_name("schedules.jsonl")
PERTURBED = Path(__file__).with_name("schedules_perturbed.jsonl")
BOUNDS = Path(__file__).with_name("schedules_bounds.jsonl")
CLIMBS = Path(__file__).with_name("run_up_climbs.jsonl")
ROBOTS = "bhr", "g1_arms"
RISE_M = 0.1  # of jumps at a target, and of those that climb
PATIENCE_S = 40.0  # processor time for one plan
FIRST_M = 0.5  # of a climb
STEP_M = 0.25
# name -> words of Contacts.named, or a target
CASES = {
    "hop 0.1 m": "hop=0.1",
    "hop 0.2 m": "hop=0.2",
    "hop 0.3 m": "hop=0.3",
    "run-up of two steps": "run_up=2",
    "leap": "leap",
    "step off 0.3 m": "step_off=0.3",
    "drop jump 0.2 m": "drop_jump=0.2",
    "hurdle": "hurdle",
    "hurdle over 0.2 m": "hurdle=0.2",
    "five bounds": "bound=5",
    "target 0.5 m after a run-up": jl.JumpTask(0.5, RISE_M, takeoff="left", run_up=2),
}
WORLDS = {
    "PyBullet": dict(engine="bullet"),
    "MuJoCo, hard": dict(engine="mujoco"),
    "MuJoCo, usual": dict(engine="mujoco", contact="usual"),
}


def study(folder: str | Path, path: Path = LOG, robots: Iterable[str] = ROBOTS) -> None:
    """Plan each case, and play it in each world; one row each, written at once, plans kept in ``folder``.

    Rows of the log are not made again. ``python -m paper.schedules DIR`` calls it.
    """
    with logs.keep(path, itemgetter("robot", "case")) as log:
        for robot, case in product(robots, CASES):
            if (robot, case) not in log.done:
                log.add({"robot": robot, "case": case} | _row(Path(folder) / f"{robot} {case}", robot, case))


def _row(folder: Path, robot: str, case: str) -> dict[str, Any]:
    try:
        plan = _planned(folder, robot, CASES[case])
    except SolverError as e:
        return {"planned": False, "refusal": str(e)}
    report = jl.audit(plan)
    where = planned(plan.tape)
    row = {
        "planned": True,
        "phases": len(plan.schedule),
        "cpu_s": round(sum(x.cpu_s for x in plan.attempts), 2),
        "failed_checks": [check.name for check in report.failed],
        "travel_m": where["planned_distance_m"],
        "rise_m": where["planned_rise_m"],
        "runs": {},
    }
    for world, options in WORLDS.items():
        run = jl.simulate(plan, **options)
        m = run.metrics
        row["runs"][world] = {
            "stands": run.landed and run.checks_passed,
            "reason": run.reason,
            "travel_m": m.foot_distance_m,
            "rise_m": m.com_rise_m,
            "slip_m": m.slip_m,
        }
    return row


def perturbed(folder: str | Path, n: int = 30, path: Path = PERTURBED, robots: Iterable[str] = ROBOTS) -> None:
    """Let ``n`` perturbed robots play each plan that :func:`study` kept in ``folder``, an equal part of them in each
    engine; one row each.

    Trials of a plan are kept beside it: an interrupted run, or one of more robots, goes on where the other ended.
    ``python -m paper.schedules DIR N`` calls it.
    """
    engines = sim.INSTALLED
    with logs.keep(path, itemgetter("robot", "case", "engine", "n")) as log:
        for robot, case, (seed, engine) in product(robots, CASES, enumerate(engines)):
            place = Path(folder) / f"{robot} {case}"
            part = n // len(engines)
            if (robot, case, engine, part) in log.done or not (place / "plan.npz").is_file():
                continue
            settings = trials.TrialSettings(engine=engine)
            # other robots in each engine, which by its seed are the same in every case
            report = trials.run_trials(place, part, seed, settings, jobs=1, progress=False)
            row = {"robot": robot, "case": case, "engine": engine, "n": part, "landed": report.landed}
            log.add(row | {"causes": report.causes})


def climbs(path: Path = CLIMBS, robots: Iterable[str] = ROBOTS) -> None:
    """Jumps with a rise of :data:`RISE_M`, each :data:`STEP_M` longer than the one before, from whose plan it begins,
    until there is no plan: from a stand, and off one foot after a run-up of two steps; one row each, with the worlds in
    which it stands.

    ``python -m paper.schedules DIR climbs`` calls it.
    """
    stand = jl.JumpTask(FIRST_M, RISE_M)
    asked = {"stand": stand, "run-up": replace(stand, takeoff="left", run_up=2)}
    with logs.keep(path, itemgetter("robot", "from", "distance_m")) as log:
        for robot, name in product(robots, asked):
            if any(key[:2] == (robot, name) for key in log.done):
                continue
            planner = jl.Planner(Robot.load(robot))
            plan = None
            task = asked[name]
            while True:
                try:
                    plan = planner.plan(task, "direct", near=plan)
                except JumplabError:
                    break
                runs = {world: jl.simulate(plan, **options) for world, options in WORLDS.items()}
                row = {"robot": robot, "from": name, "distance_m": task.distance_m, "audit": plan.audit.passed}
                row["speed_m_s"] = float(plan.com_velocity[plan.tape.flights[-1].start, 0])
                log.add(row | {"stands": [x for x, run in runs.items() if run.landed and run.checks_passed]})
                task = replace(task, distance_m=task.distance_m + STEP_M)


def climbs_table(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per robot and way to begin: the longest flight that is planned, and those that stand [m]."""
    lines: dict[tuple, dict[str, Any]] = {}
    for row in sorted(rows, key=itemgetter("distance_m")):
        key = row["robot"], row["from"]
        line = lines.setdefault(key, dict(zip(("robot", "from"), key, strict=True)))
        for world in ["plan", *WORLDS]:
            if row["audit"] if world == "plan" else world in row["stands"]:
                line[f"{world} [m]"] = row["distance_m"]
    return list(lines.values())


def bounds(folder: str | Path, n: int = 10, path: Path = BOUNDS) -> None:
    """Five bounds of ``bhr`` as one program, which :func:`study` kept in ``folder``, against five jumps of the same
    travel and rise, each planned again on the way; one row each, with ``n`` slightly perturbed robots.

    ``python -m paper.schedules DIR bounds`` calls it.
    """
    place = Path(folder) / "bhr five bounds"
    plan = jl.load(place).plan
    rises = [plan.com_velocity[flight.start, 2] ** 2 / (2 * plan.robot.gravity) for flight in plan.tape.flights]
    course = chain.Course.of([plan.planned_distance_m / len(rises)] * len(rises), rises)
    with logs.keep(path, itemgetter("how")) as log:
        if "one program" not in log.done:
            settings = trials.TrialSettings(ranges=SLIGHT, noise=sim.SensorNoise())
            report = trials.run_trials(place, n, settings=settings, jobs=1, progress=False)
            row = {"how": "one program", "cpu_s": [x.cpu_s for x in plan.attempts]}
            log.add(row | _worked([jl.simulate(plan)]) | {"stand": report.landed, "of": n})
        if "planned again" not in log.done:
            result = jl.run_chain(course, plan.robot)
            series = chain.run_chains(course, plan.robot, n, jobs=1)
            row = {"how": "planned again", "cpu_s": [x.cpu_s for x in result.replans]}
            worked = _worked([jump.simulation for jump in result.jumps])
            log.add(row | worked | {"stand": series["stood"], "of": n})


def bounds_table(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per way of planning five bounds."""
    return [
        {
            "five bounds": row["how"],
            "CPU [s]": sum(row["cpu_s"]),
            "until the last touchdown [s]": row["time_s"],
            "work of the motors [J]": row["work_j"],
            "perturbed": f"{row['stand']} of {row['of']}",
        }
        for row in rows
    ]


def _worked(runs: list[sim.SimulationResult]) -> dict[str, float]:
    """Time [s] and work of the motors [J], braking not counted, from the start to the last touchdown."""
    *before, last = runs
    until = [len(run.t) for run in before] + [int(np.searchsorted(last.t, last.metrics.touchdown_s))]
    power = (np.maximum(run.tau * run.v[:, 6:], 0)[:end] for run, end in zip(runs, until, strict=True))
    work = sum(trapezoid(x.sum(axis=1), dx=STEP_S) for x in power)
    return {"time_s": STEP_S * sum(until), "work_j": float(work)}


def _planned(folder: Path, robot: str, asked: str | jl.JumpTask) -> JumpPlan:
    if (folder / "plan.npz").is_file():
        return jl.load(folder).plan
    given = {"contacts": asked} if isinstance(asked, str) else {"task": asked}
    plan = jl.plan(**given, robot=robot, patience_s=PATIENCE_S)
    jl.save(folder, plan)
    return plan


def stored(path: Path = LOG) -> list[dict[str, Any]]:
    """The kept rows."""
    return logs.rows(path)


def table(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per case: what was planned, how it ended in each world, and how many perturbed robots stand."""
    most = {(x["robot"], x["case"], x["engine"]): x for x in sorted(stored(PERTURBED), key=itemgetter("n"))}
    lines = []
    for row in rows:
        line = {"robot": row["robot"], "case": row["case"], "planned": "yes" if row["planned"] else "no"}
        if row["planned"]:
            line |= {"CPU [s]": row["cpu_s"], "audit": ", ".join(row["failed_checks"]) or "passed"}
            line |= {"travel [m]": row["travel_m"], "rise [m]": row["rise_m"]}
        ends = row.get("runs", {}).items()
        line |= {world: "stands" if run["stands"] else "falls" for world, run in ends}
        drawn = [x for (*key, _), x in most.items() if key == [row["robot"], row["case"]]]
        if drawn:
            line["perturbed"] = f"{sum(x['landed'] for x in drawn)} of {sum(x['n'] for x in drawn)}"
        lines.append(line)
    return lines


def pushes(tape: Tape, robot: Robot) -> list[dict[str, Any]]:
    """A line per contact that begins before the last take-off: what its force along x adds to the CoM's speed."""
    end = tape.flights[-1].start
    lines = []
    for side, name in enumerate(("left", "right")):
        down = tape.contacts[:end, side] > 0
        edges = np.flatnonzero(np.diff(down.astype(int), prepend=0, append=0)).reshape(-1, 2)
        for a, b in edges:
            gained = trapezoid(tape.f[a:b, side, 0], tape.t[a:b]) / robot.total_mass
            lines.append({"from [s]": tape.t[a], "to [s]": tape.t[b - 1], "foot": name, "speed ahead [m/s]": gained})
    return sorted(lines, key=lambda line: (line["from [s]"], line["foot"]))


def speeds(plans: dict[str, JumpPlan]) -> Figure:
    """Speed of the CoM ahead and up over the time until the last take-off, one column for each plan."""
    fig = new_figure(PAGE_IN, 3.0)
    axes = fig.subplots(2, len(plans), sharex="col", sharey="row")
    for column, (name, plan) in zip(axes.T, plans.items(), strict=True):
        tape = plan.tape
        t = tape.t - tape.t[tape.flights[-1].start]
        for ax, axis in zip(column, (0, 2), strict=True):
            by_phase(ax, t, plan.com_velocity[:, axis], tape.phase)
        column[0].set(title=name)
        column[1].set(xlabel="time from the last take-off [s]")
    axes[0, 0].set_ylabel("CoM ahead [m/s]")
    axes[1, 0].set_ylabel("CoM up [m/s]")
    return fig


if __name__ == "__main__":
    if sys.argv[2:] == ["climbs"]:
        climbs()
    elif sys.argv[2:] == ["bounds"]:
        bounds(sys.argv[1])
    elif sys.argv[2:]:
        perturbed(sys.argv[1], int(sys.argv[2]))
    else:
        study(*sys.argv[1:2])
