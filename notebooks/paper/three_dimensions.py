"""Jumps in three dimensions, by the dozen: which targets are planned, and how they land.

``python -m paper.three_dimensions`` in the folder of the notebooks does what :data:`LOG` lacks, one line per target,
and can be stopped and started again; playbacks and perturbed robots take an hour. Notebook 13 draws the file. Rows with
``attempts`` were made by the whole-body program, the others by the program before it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.integrate import cumulative_trapezoid

from jumplab import sim
from jumplab.auditing import audit
from jumplab.control.servo import SERVOS
from jumplab.errors import JumplabError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show.style import (
    FLIGHT,
    LANDING,
    LAUNCH,
    LIMIT,
    PAGE_IN,
    REFERENCE_STYLE,
    VERMILION,
    by_phase,
    new_figure,
    tint,
)
from jumplab.stages.planner import JumpPlan, Planner
from jumplab.studies.grid import most_used
from jumplab.studies.trials import TrialKey, TrialSettings, run_trial, wilson
from jumplab.task import JumpTask
from paper import logs

LOG = Path(__file__).with_name("three_dimensions.jsonl")
AHEAD, SIDE, YAW_DEG, RISE = (0.0, 0.3, 0.6, 0.9), (0.15, 0.3, 0.45, 0.6), (45, 90, 135, 180), (0.2, 0.3, 0.4, 0.5)
LANDED = {  # ahead [m], to the left [m], rise [m], turn [deg]
    "side": (
        *((0.0, y, 0.4, 0) for y in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, -0.3)),
        *((0.0, -0.6, 0.5, 0), (0.0, 0.2, 0.3, 0), (0.0, 0.4, 0.5, 0), (0.0, 0.3, 0.3, 0), (0.0, 0.6, 0.5, 0)),
    ),
    "turn": (
        *((0.0, 0.0, 0.4, yaw) for yaw in (30, 45, 60, 90, 120, -45, -90)),
        *((0.0, 0.0, 0.5, yaw) for yaw in (150, 180, -135, -180, 90)),
        *((0.0, 0.0, 0.3, 90), (0.0, 0.0, 0.3, 45)),
    ),
    "both, diagonal": (
        *((0.3, 0.3, 0.4, 0), (0.5, 0.3, 0.4, 0), (0.5, -0.3, 0.4, 0), (0.8, 0.3, 0.5, 0), (0.2, 0.5, 0.5, 0)),
        *((0.5, 0.3, 0.4, 45), (0.8, 0.5, 0.5, 45), (0.4, -0.2, 0.4, -30), (0.3, 0.3, 0.4, 90), (0.5, 0.0, 0.4, 90)),
        *((0.6, 0.0, 0.4, 45), (0.0, 0.3, 0.4, 90), (0.0, 0.3, 0.4, -90), (0.3, 0.0, 0.5, 180)),
    ),
    "three quarters, whole turn": ((0.0, 0.0, 0.5, 270), (0.0, 0.0, 0.5, 360)),
}
PERTURBED = ((0.0, 0.3, 0.4, 0), (0.0, 0.0, 0.4, 90), (0.0, 0.0, 0.5, 180), (0.5, 0.3, 0.4, 0))
HEADING_DEG = 3.0  # that a playback may miss
ROBOTS = 100  # that differ from their model, for each of those targets
KINDS = {  # name -> targets
    "side": [(x, y, 0.4, 0) for y in SIDE for x in AHEAD],
    "turn": [(0.0, 0.0, h, yaw) for h in RISE for yaw in YAW_DEG],
    "landed": [target for group in LANDED.values() for target in group],
    "perturbed": PERTURBED,
}


def solve(planner: Planner, kind: str, target: Sequence[float]) -> dict[str, Any]:
    """One plan as a row of plain types: planned, clean, CPU time [s], attempts and their iterations in all, cost of the
    last, what is used most.

    ``runs`` of the landed are its playbacks, see :func:`played`; ``robots`` of the perturbed whether each one landed.
    """
    ahead, side, rise, turn = target
    task, began = JumpTask(ahead, rise, side_m=side, yaw_rad=np.radians(turn)), time.process_time()
    row = {"kind": kind, "target": list(target), "planned": False, "clean": False}
    try:
        plan = planner.plan(task)
    except JumplabError as e:
        return row | {"cpu_s": time.process_time() - began, "reason": str(e)[:160]}
    row |= {"planned": True, "cpu_s": time.process_time() - began}
    report = audit(plan.tape, plan.robot, task)
    most, share = most_used(report, plan.robot)
    row |= {"attempts": len(plan.attempts), "iterations": sum(x.iterations for x in plan.attempts)}
    row |= {"cost": plan.whole_body.solution.statistics.objective, "limiting": most, "share": share}
    row |= {"clean": report.passed}
    if kind == "landed":
        row["runs"] = {f"{e}, {mode}": played(plan, e, mode) for e, mode in product(sim.INSTALLED, SERVOS)}
    if kind == "perturbed":
        settings = TrialSettings()
        keys = [TrialKey(0, k, settings.hash, "") for k in range(ROBOTS)]
        there = SimpleNamespace(tape=plan.tape, robot=plan.robot, scene=sim.Scene.flat())
        drawn = (run_trial(there, settings, key) for key in keys)
        row["robots"] = [trial.landed for trial in drawn]
    return row


def played(plan: JumpPlan, engine: str, mode: str) -> dict[str, Any]:
    """One playback: whether it stands and passes every check; how far place [mm], heading [deg], rise [mm] are off."""
    result = sim.simulate_jump(plan.tape, plan.robot, engine=engine, mode=mode)
    m, task = result.metrics, plan.task
    row: dict[str, Any] = {"stands": result.landed and result.checks_passed, "reason": result.reason}
    if not result.landed:
        return row
    row["place_mm"] = 1e3 * float(np.hypot(m.foot_distance_m - task.distance_m, m.side_m - task.side_m))
    row["heading_deg"] = float(np.degrees(m.yaw_rad - task.yaw_rad))
    return row | {"rise_mm": 1e3 * (m.com_rise_m - task.height_m)}


def run(path: str | Path = LOG, kinds: Iterable[str] = tuple(KINDS)) -> None:
    """Solve what the file lacks."""

    planner = Planner(Robot.load(), keep=True)
    planner.plan(JumpTask(0.0, 0.3, side_m=0.1))  # the first call of anything is not timed
    with logs.keep(Path(path), lambda row: (row["kind"], *row["target"]), robot=planner.robot) as log:
        for kind in kinds:
            for target in KINDS[kind]:
                if (kind, *target) not in log.done:
                    log.add(solve(planner, kind, target))


def read(path: str | Path = LOG) -> dict[str, list[dict[str, Any]]]:
    """Rows of a file that :func:`run` has written, by kind; nothing is solved."""
    out: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    for row in logs.rows(Path(path)):
        out[row["kind"]].append(row)
    return out


def landed(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per group of :data:`LANDED`: plans, playbacks that stand, and the largest errors."""
    by, out = {tuple(r["target"]): r for r in rows}, []
    for name, targets in LANDED.items():
        ours = [by[target] for target in targets]
        runs = [x for r in ours for x in r.get("runs", {}).values()]
        row = {"targets": name, "number": len(ours), "clean plans": sum(r["clean"] for r in ours)}
        row |= {"median CPU of a plan [s]": float(np.median([r["cpu_s"] for r in ours]))}
        row |= {"most CPU of a plan [s]": max(r["cpu_s"] for r in ours)}
        row |= {"playbacks": len(runs), "stand": sum(x["stands"] for x in runs)}
        row["heading within 3 deg"] = sum(abs(x.get("heading_deg", np.inf)) <= HEADING_DEG for x in runs)
        for key, words in (("place_mm", "place [mm]"), ("heading_deg", "heading [deg]"), ("rise_mm", "rise [mm]")):
            row[f"{words}, at most"] = max((abs(x[key]) for x in runs if key in x), default=np.nan)
        out.append(row)
    return out


def perturbed(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per target: how many of the robots that differ from their model land."""
    out = []
    for r in rows:
        row = dict(zip(("ahead [m]", "side [m]", "rise [m]", "turn [deg]"), r["target"], strict=True))
        low, high = wilson(sum(r["robots"]), len(r["robots"]))
        row |= {"robots": len(r["robots"]), "land": sum(r["robots"])}
        out.append(row | {"95 % interval": f"{low:.1%} ... {high:.1%}"})
    return out


def maps(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Targets to the side and with a turn: cost as a multiple of the least there, and the limit used most."""
    fig = new_figure(PAGE_IN, 3.1)
    axes = fig.subplots(1, 2)
    for ax, kind, (i, j), ticks in zip(
        axes, ("side", "turn"), ((0, 1), (3, 2)), ((AHEAD, SIDE), (YAW_DEG, RISE)), strict=True
    ):
        size = [t[1] - t[0] for t in ticks]
        least = min(r["cost"] for r in found[kind] if r["clean"])
        for r in found[kind]:
            place = np.array([r["target"][i], r["target"][j]])
            dear = r["cost"] / least if r["clean"] else None
            color = tint(LANDING, min(0.1 + 0.25 * (dear - 1), 0.8)) if r["clean"] else (0.82, 0.82, 0.82)
            ax.add_patch(Rectangle(place - np.array(size) / 2, *size, facecolor=color, edgecolor="white"))
            words = r.get("limiting", "").replace(" pitch", "").replace(" ", "\n", 1)
            said = f"{dear:.1f}\n{words}\n{100 * r['share']:.0f} %" if r["clean"] else "no plan"
            ax.text(*place, said, ha="center", va="center", fontsize=6.5)
        x, y = ((min(t) - d / 2, max(t) + d / 2) for t, d in zip(ticks, size, strict=True))
        ax.set(xlim=x, ylim=y, xticks=ticks[0], yticks=ticks[1])
        ax.grid(False)
    axes[0].set(xlabel="ahead [m]", ylabel="to the left [m]", title="(a) rise 0.4 m, no turn")
    axes[1].set(xlabel="turn [deg]", ylabel="rise of the CoM [m]", title="(b) on the spot")
    return fig


# one turn --------------------------------------------------------------------------------------------------------
def yaw_sources(tape: Tape, robot: Robot) -> dict[str, dict[str, np.ndarray]]:
    """Angular momentum about the vertical, by the limbs that carry it and by its sources.

    Returns
    -------
    "limbs" : of legs, arms and trunk about the CoM, moving with it (n,) [kg m^2/s]; their sum is L_z.
    "ground" : impulse since the start (n,) [kg m^2/s] of the couple of the feet's horizontal forces, of the spin in the
        soles, and of the common push that passes the CoM; their sum is L_z again.
    """
    model, data = robot.model, robot.model.createData()
    legs = {j for n in robot.foot.frames for j in model.supports[model.frames[model.getFrameId(n)].parentJoint]}
    limbs = {j: "trunk" if j == 1 else "legs" if j in legs else "arms" for j in range(1, model.njoints)}
    carried = {name: np.zeros(len(tape.t)) for name in ("legs", "arms", "trunk")}
    moments = np.zeros((len(tape.t), 3))
    for k, (q, v) in enumerate(zip(tape.q, tape.v, strict=True)):
        pin.centerOfMass(model, data, q, v)
        com, speed = data.com[0], data.vcom[0]
        for j, name in limbs.items():
            h = data.oMi[j].act(model.inertias[j] * data.v[j])
            arm = data.oMi[j].act(model.inertias[j].lever) - com
            about = h.angular - np.cross(com, h.linear) - np.cross(arm, model.inertias[j].mass * speed)
            carried[name][k] += about[2]
        if tape.phase[k] == "launch":
            pin.updateFramePlacements(model, data)
            places = [data.oMf[model.getFrameId(n)].translation for n in robot.foot.frames]
            moments[k] = _about_vertical(np.array(places), tape.f[k], com)
    impulse = cumulative_trapezoid(moments, tape.t, axis=0, initial=0.0)
    names = "opposite forces of the feet", "spin in the soles", "push past the CoM"
    return {"limbs": carried, "ground": dict(zip(names, impulse.T, strict=True))}


def _about_vertical(places: np.ndarray, f: np.ndarray, com: np.ndarray) -> np.ndarray:
    """Moment about the vertical through the CoM (3,) [N m] by its sources, of wrenches (2, 6) at ``places`` (2, 3)."""
    force, total = f[:, :3], f[:, :3].sum(axis=0)
    down = np.maximum(f[:, 2], 1e-9)
    cop = places[:, :2] + (np.stack([-f[:, 4], f[:, 3]], -1) - places[:, 2:] * force[:, :2]) / down[:, None]
    loaded = f[:, 2:3] > 1.0
    cop = np.where(loaded, cop, places[:, :2])
    spin = f[:, 5] - _turn(cop - places[:, :2], force)
    middle = cop.mean(axis=0)
    return np.array([_turn(cop - middle, force).sum(), spin.sum(), float(_turn(middle - com[:2], total))])


def _turn(arm: np.ndarray, force: np.ndarray) -> np.ndarray:
    return arm[..., 0] * force[..., 1] - arm[..., 1] * force[..., 0]


def yaw_momentum(tape: Tape, sources: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """L_z by the limbs that carry it, and by what the ground did for it."""
    fig = new_figure(PAGE_IN, 2.6)
    axes = fig.subplots(1, 2, sharey=True)
    for ax, (kind, parts) in zip(axes, sources.items(), strict=True):
        shown = tape.t <= (tape.takeoff_time if kind == "ground" else np.inf)
        for color, (name, values) in zip((LAUNCH, VERMILION, FLIGHT), parts.items(), strict=True):
            ax.plot(tape.t[shown], values[shown], color=color, label=name)
        ax.plot(tape.t[shown], sum(parts.values())[shown], **REFERENCE_STYLE, label="sum")
        ax.axvline(tape.takeoff_time, color=LIMIT, linewidth=0.6)
        ax.set_xlabel("time [s]")
        ax.legend(fontsize=6.5, frameon=False)
    axes[0].set(title="(a) limbs that carry it", ylabel="$L_z$ [kg m$^2$/s]")
    axes[1].set_title("(b) impulses of the ground")
    return fig


def turned(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Turn of a robot about the vertical, as a whole and of its base.

    Returns
    -------
    "inertia" : about the vertical through the CoM (n,) [kg m^2].
    "turned_deg" : by its mean angular velocity, inertia^-1 L, about the vertical (n,) [deg].
    "base_deg" : heading of the base (n,) [deg].
    """
    model = robot.model
    data = model.createData()
    still = np.zeros(model.nv)
    inertia, rate, heading = (np.empty(len(tape.t)) for _ in range(3))
    for k, (q, L) in enumerate(zip(tape.q, tape.extra["angular_momentum"], strict=True)):
        pin.ccrba(model, data, q, still)
        inertia[k] = data.Ig.inertia[2, 2]
        rate[k] = np.linalg.solve(data.Ig.inertia, L)[2]
        ahead = data.oMi[1].rotation[:, 0]
        heading[k] = np.arctan2(ahead[1], ahead[0])
    total = cumulative_trapezoid(rate, tape.t, initial=0.0)
    found = {"turned_deg": np.degrees(total), "base_deg": np.degrees(np.unwrap(heading))}
    return {"inertia": inertia} | found


def yaw_turn(tape: Tape, whole: Mapping[str, np.ndarray]) -> Figure:
    """The inertia about the vertical, and the turn of the whole robot beside its base's."""
    fig = new_figure(PAGE_IN, 2.3)
    axes = fig.subplots(1, 2)
    for ax, name in zip(axes, ("inertia", "turned_deg"), strict=True):
        by_phase(ax, tape.t, whole[name], tape.phase)
        ax.axvline(tape.takeoff_time, color=LIMIT, linewidth=0.6)
        ax.set_xlabel("time [s]")
    axes[1].plot(tape.t, whole["base_deg"], **REFERENCE_STYLE)
    axes[0].set(title="(a) inertia about the vertical", ylabel="[kg m$^2$]")
    axes[1].set(title="(b) turn", ylabel="[deg]")
    return fig


def contacts(tape: Tape) -> Figure:
    """Which foot is flat on the ground, on its toes or in the air, and the vertical force on each."""
    fig = new_figure(PAGE_IN, 2.6)
    feet, loads = fig.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    codes = tape.extra["contacts"]  # (N, 2): 0 in the air, 1 on its toes, 2 flat
    for k, (name, color) in enumerate((("left", LAUNCH), ("right", VERMILION))):
        for code, shade in ((1, tint(color, 0.35)), (2, color)):
            feet.fill_between(tape.t, 0.6 - k, 1.4 - k, where=codes[:, k] == code, color=shade, linewidth=0)
        loads.plot(tape.t, tape.f[:, k, 2], color=color, label=name)
    feet.set(yticks=(1, 0), yticklabels=("left", "right"), title="(a) foot on the ground")
    feet.grid(False)
    loads.set(xlabel="time [s]", ylabel="force [N]", title="(b) vertical force of the ground")
    loads.legend(frameon=False)
    return fig


if __name__ == "__main__":
    run()
