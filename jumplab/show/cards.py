"""What a notebook shows of a result that stands alone in a cell: a line, a small table, a picture."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from jumplab.errors import InputError, Shown
from jumplab.show import jumps, style
from jumplab.show.bodies import robot_sheet
from jumplab.show.tables import Table, table
from jumplab.stages.plan import JumpPlan

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.auditing import AuditReport
    from jumplab.robot import Robot
    from jumplab.sim import SimulationResult
    from jumplab.studies.margins import MarginReport
    from jumplab.studies.trials import TrialReport

Card = tuple[Table, style.Picture | None]


def card(x: Shown) -> str | None:
    """HTML of a result's card; None for what has none."""
    make = next((CARDS[kind.__name__] for kind in type(x).__mro__ if kind.__name__ in CARDS), None)
    if make is None:
        return None
    rows, figure = make(x)
    picture = "" if figure is None else _image(figure)
    return f"<div><b>{html.escape(f'{type(x).__name__}: {x.line()}')}</b>{rows._repr_html_()}{picture}</div>"


def _image(figure: style.Picture) -> str:
    png = base64.b64encode(figure._repr_png_()).decode()
    return f'<img src="data:image/png;base64,{png}" style="max-width: 100%">'


def _of_plan(plan: JumpPlan) -> Card:
    task, peaks = plan.task, plan.summary["peak_torque_nm"]
    name, most = max(peaks.items(), key=lambda x: x[1])
    rows = [
        {"": "travel [m]", "asked": task.distance_m, "planned": plan.planned_distance_m},
        {"": "rise of the CoM [m]", "asked": task.height_m, "planned": plan.planned_rise_m},
        {"": "time in the air [s]", "planned": float(plan.tape.t[-1] - plan.tape.takeoff_time)},
        {"": f"largest torque [N m], {name}", "planned": most},
        {"": "solving [s]", "planned": sum(row.solve_s for row in plan.statistics)},
    ]
    return table(rows, ["", "asked", "planned"]), jumps.jump_strobe(plan.tape, plan.robot)


def _of_run(run: SimulationResult) -> Card:
    m = run.metrics
    rows = [
        {"": "travel [m]", "simulated": m.foot_distance_m},
        {"": "rise of the CoM [m]", "simulated": m.com_rise_m},
        {"": "on its feet [s]", "simulated": m.standing_s},
        {"": "largest share of a torque limit", "simulated": m.max_torque_ratio},
        {"": "verdict", "simulated": run.reason},
    ]
    return table(rows), None if run.robot is None else jumps.jump_strobe(run, run.robot)


def _of_robot(robot: Robot) -> Card:
    s, rows = robot.sagittal, []
    for k, (role, pair) in enumerate(robot.joints.items()):
        row = {"role": role.replace("_", " "), "joints": ", ".join(pair) or "held"}
        if pair:
            numbers = {"from [rad]": s.lower[k], "to [rad]": s.upper[k], "N m": s.effort[k] / 2, "rad/s": s.speed[k]}
            row |= {name: float(x) for name, x in numbers.items()}
        rows.append(row)
    return table(rows, ["role", "joints", "from [rad]", "to [rad]", "N m", "rad/s"]), robot_sheet(robot)


def _of_audit(report: AuditReport) -> Card:
    groups: dict[str, list[Any]] = {}
    for check in report.checks:
        groups.setdefault(check.group, []).append(check)
    rows = [
        {"group": group, "passed": f"{sum(c.passed for c in checks)} of {len(checks)}",
         "failed": ", ".join(c.name for c in checks if not c.passed)}
        for group, checks in groups.items()
    ]  # fmt: skip
    return table(rows), _shares(report)


@style.styled
def _shares(report: AuditReport) -> Figure | None:
    """How much of its limit each check uses, the fullest above."""
    used = {c.name: c.value / c.limit for c in report.checks if not c.at_least and c.limit > 0 and np.isfinite(c.value)}
    if not used:
        return None
    most = sorted(used.items(), key=lambda x: x[1])[-12:]
    fig = style.new_figure(style.PAGE_IN, 2.4)
    ax = fig.subplots()
    colors = [style.LAUNCH if share <= 1 else style.VERMILION for _, share in most]
    ax.barh([name for name, _ in most], [100 * share for _, share in most], color=colors)
    ax.axvline(100, **style.LIMIT_STYLE)
    ax.set_xlabel("share of the limit used [%]")
    return fig


def _of_trials(report: TrialReport) -> Card:
    low, high = report.interval
    rows = [{"": "landed", "robots": report.landed, "share": f"{report.success_rate:.1%} ({low:.1%} ... {high:.1%})"}]
    rows += [{"": reason, "robots": count} for reason, count in report.reasons.items()]
    rows += [{"": f"of the failures, began with: {cause}", "robots": count} for cause, count in report.causes.items()]
    return table(rows, ["", "robots", "share"]), _scatter(report)


def _of_margins(report: MarginReport) -> Card:
    return table([margin.row() for margin in report.margins], digits=3), jumps.margin_radar(report)


@style.styled
def _scatter(report: TrialReport) -> Figure | None:
    """Travel and rise of the robots that landed."""
    values = [report.values(name) for name in ("foot_distance_m", "com_rise_m")]
    if not len(values[0]):
        return None
    fig = style.new_figure(style.COLUMN_IN, 2.2)
    ax = fig.subplots()
    ax.plot(*values, linestyle="none", marker="o", markersize=3, color=style.LANDING)
    ax.set(xlabel="travel of the feet [m]", ylabel="rise of the CoM [m]")
    return fig


CARDS: Mapping[str, Callable[[Any], Card]] = {
    "JumpPlan": _of_plan,
    "SimulationResult": _of_run,
    "Robot": _of_robot,
    "AuditReport": _of_audit,
    "TrialReport": _of_trials,
    "MarginReport": _of_margins,
}


class Plots:
    """Pictures of a plan or of a simulation: ``plan.plots.torques()``; each returns a matplotlib figure."""

    def __init__(self, of: JumpPlan | SimulationResult):
        self._of = of

    def __repr__(self) -> str:
        return (
            "<Plots: strobe(), joints(), torques(), momentum(); joints, torques and momentum are of plans in the plane>"
        )

    def strobe(self) -> Figure:
        """The jump in one picture."""
        return jumps.jump_strobe(getattr(self._of, "tape", self._of), self._of.robot)

    def joints(self) -> Figure:
        """Angles and velocities of the joints, within their limits."""
        return jumps.joint_trajectories(self._planar().tape, self._of.robot)

    def torques(self) -> Figure:
        """Torque against speed of each joint; CoP and friction."""
        return jumps.margins(self._planar().tape, self._of.robot)

    def momentum(self) -> Figure:
        """Inertia, CoM velocity and angular momentum, and dashed what stage 1 asked for."""
        return jumps.inertia_and_momentum(self._planar().tape)

    def _planar(self) -> JumpPlan:
        if not (isinstance(self._of, JumpPlan) and self._of.task.in_plane):
            raise InputError("this picture is of a plan in the plane; .strobe() shows any jump")
        return self._of
