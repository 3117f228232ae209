"""Three steps against one program where it is hard: far, high, flips, tight limits, other robots, bad guesses.

``python -m paper.hard_cases`` in the folder of the notebooks solves what :data:`LOG` lacks, one line per solve, and can
be stopped and started again. Notebook 10 draws the file.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy.stats import qmc

from jumplab.auditing.audit import audit
from jumplab.errors import JumplabError, SolverError
from jumplab.robot import Robot
from jumplab.show.style import INK, PAGE_IN, PURPLE, REFERENCE_STYLE, VERMILION, legend_above, new_figure
from jumplab.stages.joint_qp import map_to_joints
from jumplab.stages.plan import make_tape
from jumplab.stages.planner import METHODS, STEPS_S, Planner, motion_of_joints
from jumplab.stages.whole_body import Weights, WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.coordinates import Coordinates, even
from jumplab.stages.whole_body.motions import Motion, along
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.starts import GIVEN
from jumplab.task import JumpTask
from paper import logs

LOG = Path(__file__).with_name("hard_cases.jsonl")
KINDS = ("targets", "platforms", "flips", "tight limits", "other robots", "bad guesses")
PER_KIND = 40
LIMITS = ({"torque_share": 0.6}, {"torque_share": 0.5}, {"speed_share": 0.65})
ROBOTS = ("heavy trunk", "weak joints", "slow joints")
NOISE_RAD = (0.1, 0.2, 0.4, 0.8)  # standard deviation of what is added to every angle in mid-phase
NOISE_TARGETS = ((0.3, 0.3), (0.6, 0.4), (0.9, 0.3), (1.0, 0.5), (0.5, 0.5))
EFFORT = {"acceleration": Weights().acceleration, "jerk": Weights().jerk, "torque": Weights().torque}
WITHIN = 1.01  # of the least effort known for a target: the same local solution


@dataclass(frozen=True)
class Case:
    """One jump that both methods are asked for; ``variant`` picks limits, robot, or noise, -1 for none."""

    number: int
    kind: str
    task: JumpTask
    variant: int = -1


def cases() -> list[Case]:
    """All cases, the kinds in turn, so that any beginning of the list is a fair sample."""
    points, found = qmc.Halton(2, scramble=False).random(PER_KIND + 1)[1:], []
    for k, (a, b) in enumerate(points):
        far = JumpTask(round(1.4 * a, 3), round(0.1 + 0.55 * b, 3))
        near = JumpTask(round(0.2 + 0.8 * a, 3), round(0.2 + 0.3 * b, 3))
        step = round(0.05 + 0.45 * b, 3)
        high = JumpTask(round(0.5 + 0.4 * a, 3), round(step + 0.05 + 0.1 * a, 3), step)
        target = JumpTask(*NOISE_TARGETS[k % len(NOISE_TARGETS)])
        turn = JumpTask(round(0.2 * a, 3), round(0.4 + 0.3 * b, 3), rotation_rad=2 * np.pi * (-1) ** k)
        chosen = (far, -1), (high, -1), (turn, -1), (near, k % len(LIMITS)), (near, k % len(ROBOTS)), (target, k)
        found += [Case(len(found) + i, kind, *chosen[i]) for i, kind in enumerate(KINDS)]
    return found


@cache
def _planner(kind: str, variant: int) -> Planner:
    """Planner of a kind of cases, its stages built."""
    robot, limits = Robot.load(), LIMITS[variant] if kind == "tight limits" else None
    if kind == "other robots":
        changed = (
            lambda: robot.with_mass("trunk", factor=1.5),
            lambda: robot.with_limits(effort=0.75),
            lambda: robot.with_limits(speed=0.75),
        )
        robot = changed[variant]()
    planner = Planner(robot, limits=limits)
    for method in METHODS:
        with suppress(JumplabError):  # the first call of anything is not timed
            planner.plan(JumpTask(0.0, 0.5, rotation_rad=2 * np.pi) if kind == "flips" else JumpTask(0.5, 0.3), method)
    return planner


@cache
def _begun(method: str) -> WholeBodyPlanner:
    """The last program of a method, which begins with the motion that it is given and with nothing else."""
    body = Body(Robot.load())
    planner = WholeBodyPlanner(body.robot, body=body, free=even(body), tracking=method == METHODS[0])
    _ = planner.nlp.solver  # made now, not when it is timed
    return planner


def _noisy(motion: Motion, free: Coordinates, case: Case) -> Motion:
    """The motion with half a sine added to every angle in every phase, left and right alike."""
    random, charts = np.random.default_rng(case.variant), []
    size = NOISE_RAD[case.variant // len(NOISE_TARGETS) % len(NOISE_RAD)]
    angle = [name not in "xyz" for name in free.free_names]
    for rows in motion.charts:
        much = free.spread @ (size * random.standard_normal(free.size) * angle)
        charts.append(rows + np.sin(np.linspace(0, np.pi, len(rows)))[:, None] * much)
    return replace(motion, charts=charts)


def _solved(planner: Planner, method: str, case: Case) -> tuple[WholeBodyPlan, Any]:
    """Whole body and tape, as :meth:`Planner.plan` makes them; with noise on the start where that is asked for."""
    task, robot = case.task, planner.robot
    if case.kind != "bad guesses":
        plan = planner.plan(task, method)
        return plan.whole_body, plan.tape
    last, srmp = _begun(method), None
    if method == "direct":
        motion = along(Schedule(last.body, last.contacts, last.limits, last.weights, free=last.free), task)
    else:
        srmp = planner.stage("srmp").plan(task)
        try:
            joints = map_to_joints(srmp, robot, STEPS_S)
        except SolverError:
            joints = map_to_joints(srmp, robot)
        motion = motion_of_joints(joints, last, srmp.toe_s)
    body = last.plan(task, srmp, begin=_noisy(motion, last.free, case), starts=GIVEN)
    return body, make_tape(body, srmp)


def effort(plan: WholeBodyPlan) -> float:
    """Cost of a plan besides following stage 1 [1], all methods weighed alike."""
    costs = [r for r in plan.solution.cost_shares if r["name"] in EFFORT]
    return sum(r["cost"] * EFFORT[r["name"]] / r["weight"] for r in costs)


def solve(case: Case, method: str) -> dict[str, Any]:
    """One solve as a row of plain types: what was asked, whether it is planned and clean, time [s], effort, reason."""
    planner = _planner(case.kind, case.variant if case.kind in KINDS[3:5] else -1)
    if case.kind == "bad guesses":
        _begun(method)  # what is built once is not timed
    t, began = case.task, time.process_time()
    row = {"number": case.number, "method": method, "kind": case.kind, "variant": case.variant, "planned": False}
    row |= {"distance_m": t.distance_m, "height_m": t.height_m, "platform_m": t.platform_m, "clean": False}
    try:
        body, tape = _solved(planner, method, case)
    except JumplabError as e:
        return row | {"cpu_s": time.process_time() - began, "effort": None, "reason": str(e)[:160]}
    row |= {"planned": True, "cpu_s": time.process_time() - began, "reason": ""}
    row["effort"] = effort(body)
    found = audit(tape, planner.robot, t, edge_m=body.edge_m)
    return row | {"clean": found.passed}


def run(path: str | Path = LOG, asked: Sequence[Case] | None = None) -> list[dict[str, Any]]:
    """Rows of both methods for the cases asked for, in their order; what the file has is not solved again."""
    asked = cases() if asked is None else asked
    with logs.keep(Path(path), itemgetter("number", "method")) as log:
        for case in asked:
            for method in METHODS:
                if (case.number, method) not in log.done:
                    log.add(solve(case, method))
        return [log.done[case.number, method] for case in asked for method in METHODS]


def read(path: str | Path = LOG) -> list[dict[str, Any]]:
    """Rows of a file that :func:`run` has written, in the order of their cases; nothing is solved."""
    return sorted(logs.rows(Path(path)), key=lambda row: (row["number"], METHODS.index(row["method"])))


def _pairs(rows: Sequence[Mapping[str, Any]], kind: str) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """(three steps, direct) of each case of a kind, or of all."""
    by = {(r["number"], r["method"]): r for r in rows if kind in (r["kind"], "all")}
    return [(by[n, METHODS[0]], by[n, METHODS[1]]) for n in dict.fromkeys(n for n, _ in by)]


def _ratios(pairs: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]], key: str) -> np.ndarray:
    """Three steps over direct, where both are clean."""
    return np.array([a[key] / b[key] for a, b in pairs if a["clean"] and b["clean"]])


def compared(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per kind of cases, and one for all: how often each method ends in a clean plan, and medians of ratios.

    ``same`` of a method is the share of its clean plans from bad guesses whose effort is the least that it found for
    that target, within :data:`WITHIN`; None for other kinds. Ratios are three steps over direct, where both are clean.
    """
    out = []
    for kind in (*KINDS, "all"):
        pairs = _pairs(rows, kind)
        row: dict[str, Any] = {"cases": kind, "number": len(pairs)}
        for k, method in enumerate(METHODS):
            good = [pair[k] for pair in pairs if pair[k]["clean"]]
            row[f"{method}, clean"] = len(good)
            least: dict[tuple[float, float], float] = {}
            for r in good:
                target = r["distance_m"], r["height_m"]
                least[target] = min(least.get(target, np.inf), r["effort"])
            near = [r["effort"] <= WITHIN * least[r["distance_m"], r["height_m"]] for r in good]
            row[f"{method}, same"] = float(np.mean(near)) if kind == KINDS[-1] and near else None
        for key in ("cpu_s", "effort"):
            found = _ratios(pairs, key)
            row[f"{key}, ratio"] = float(np.median(found)) if found.size else None
        out.append(row)
    return out


def picture(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Failures of both methods by kind of cases, and the ratios of time and effort of every case that both solve."""
    fig = new_figure(PAGE_IN, 2.4)
    axes, table = fig.subplots(1, 3, sharey=True), compared(rows)[:-1]
    for y, row in enumerate(table):
        pairs = _pairs(rows, row["cases"])
        for k, (method, color) in enumerate(zip(METHODS, (PURPLE, VERMILION), strict=True)):
            place, failed = y + 0.36 * (k - 0.5), row["number"] - row[f"{method}, clean"]
            axes[0].barh(place, failed, height=0.32, color=color)
            axes[0].text(failed + 0.2, place, f"{failed} of {row['number']}", va="center", fontsize=6.5)
        for ax, key in zip(axes[1:], ("cpu_s", "effort"), strict=True):
            found = _ratios(pairs, key)
            ax.plot(found, y + np.linspace(-0.3, 0.3, len(found)), ".", color=PURPLE, markersize=2)
            ax.plot(np.median(found), y, "|", color=INK, markersize=16, zorder=3)
    axes[0].set(yticks=range(len(table)), yticklabels=[row["cases"] for row in table])
    axes[0].set(xlabel="cases without a plan that passes")
    axes[0].margins(x=0.3)
    axes[0].grid(False)
    axes[0].invert_yaxis()
    legend_above(fig, [Patch(color=c, label=m) for m, c in zip(METHODS, (PURPLE, VERMILION), strict=True)])
    for ax, what in zip(axes[1:], ("CPU time", "effort"), strict=True):
        ax.axvline(1.0, **REFERENCE_STYLE)
        ticks = (0.5, 1, 2, 5)
        ax.set(
            xscale="log", xlabel=f"{what}, three steps / direct", xticks=ticks, xticklabels=[f"{x:g}" for x in ticks]
        )
        ax.minorticks_off()
        ax.margins(x=0.05)
    return fig


if __name__ == "__main__":
    run()
