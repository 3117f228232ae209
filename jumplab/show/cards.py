"""Cards: a line, a small table and a picture of a result that stands alone in a notebook's cell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from jumplab.arguments import checked
from jumplab.errors import InputError, Shown
from jumplab.forms import filled
from jumplab.show.bodies import robot_sheet
from jumplab.show.jumps import (
    active,
    inertia_and_momentum,
    joint_trajectories,
    jump_strobe,
    margins,
)
from jumplab.show.maps import envelope_map
from jumplab.show.style import (
    COLUMN_IN,
    FLIGHT,
    LANDING,
    LAUNCH,
    LIMIT_STYLE,
    PAGE_IN,
    VERMILION,
    Picture,
    describe_task,
    new_figure,
    themed,
)
from jumplab.show.tables import Table, table
from jumplab.stages.plan import JumpPlan

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.auditing import AuditReport, ClipReport
    from jumplab.io.columns import Rows
    from jumplab.robot import Robot
    from jumplab.sim import Metrics, SimulationResult
    from jumplab.stages import Planner
    from jumplab.studies.envelope import Envelope
    from jumplab.studies.improve import Improved
    from jumplab.studies.mend import Mended
    from jumplab.studies.prices import Prices
    from jumplab.studies.record import Record
    from jumplab.studies.trials import TrialReport
    from jumplab.task import JumpTask

MOST_BINDING = 12  # limits of a record that are shown, those of the highest worth
MOST_PRICES = 14  # and prices
Card = tuple[Table, Picture | None]


def card(x: Shown) -> str | None:
    """HTML of a result's card; None for what has none."""
    make = next((CARDS[kind.__name__] for kind in type(x).__mro__ if kind.__name__ in CARDS), None)
    if make is None:
        return None
    rows, picture = make(x)
    title = f"{type(x).__name__}: {x.line()}"
    return filled("show/card.html", title=title, rows=rows, picture=picture)


def _listed(values: Mapping[str, Any], heading: str = "value") -> Table:
    """Values by name, one below the other."""
    return table([{"": name, heading: value} for name, value in values.items()])


def _of_plan(plan: JumpPlan) -> Card:
    peaks = plan.summary["peak_torque_nm"]
    joint = max(peaks, key=peaks.get)
    asked = {"travel [m]": plan.task.distance_m, "rise of the CoM [m]": plan.task.height_m}
    planned = {
        "travel [m]": plan.planned_distance_m,
        "rise of the CoM [m]": plan.planned_rise_m,
        "its apex above the stance [m]": plan.planned_apex_m,
        "time in the air [s]": float(sum(np.ptp(plan.tape.t[x]) for x in plan.tape.flights)),
        f"largest torque [N m], {joint}": peaks[joint],
        "solving [s]": sum(row.solve_s for row in plan.statistics),
    }
    rows = [{"": name, "asked": asked.get(name), "planned": x} for name, x in planned.items()]
    rows.append({"": "audit", "planned": plan.verdict})
    return table(rows), jump_strobe(plan.tape, plan.robot)


def _of_run(run: SimulationResult) -> Card:
    m = run.metrics
    simulated = {
        "travel [m]": m.foot_distance_m,
        "rise of the CoM [m]": m.com_rise_m,
        "its apex above the stance [m]": m.com_apex_m,
        "on its feet [s]": m.standing_s,
        "largest share of a torque limit": m.max_torque_ratio,
        "verdict": run.reason,
    }
    figure = None if run.robot is None else jump_strobe(run, run.robot)
    return _listed(simulated, "simulated"), figure


def _of_robot(robot: Robot) -> Card:
    rows = []
    for role, pair in robot.joints.items():
        row = {"role": role.replace("_", " "), "joints": ", ".join(pair) or "held"}
        rows.append(row | (dict(robot.actuators[pair[0]]) if pair else {}))
    columns = {
        "role": "role",
        "joints": "joints",
        "lower": "from [rad]",
        "upper": "to [rad]",
        "effort": "N m",
        "speed": "rad/s",
    }
    return table(rows, columns), robot_sheet(robot)


def _of_audit(report: AuditReport) -> Card:
    rows = []
    for group, count in Counter(check.group for check in report.checks).items():
        failed = [check.name for check in report.failed if check.group == group]
        passed = f"{count - len(failed)} of {count}"
        rows.append({"group": group, "passed": passed, "failed": ", ".join(failed)})
    return table(rows), _shares(report)


@themed
def _shares(report: AuditReport) -> Figure | None:
    """Bars: the share of its limit that each check uses, the largest above."""
    used = sorted(
        (100 * check.value / check.limit, check.name)
        for check in report.checks
        if not check.at_least and check.limit > 0 and np.isfinite(check.value)
    )
    if not used:
        return None
    shares, names = zip(*used[-12:], strict=True)
    fig = new_figure(PAGE_IN, 2.4)
    ax = fig.subplots()
    ax.barh(names, shares, color=[LAUNCH if share <= 100 else VERMILION for share in shares])
    ax.axvline(100, **LIMIT_STYLE)
    ax.set_xlabel("share of the limit used [%]")
    return fig


def _of_clip(report: ClipReport) -> Card:
    rows = [vars(check) | {"passed": check.passed} for check in report.checks]
    columns = {
        "name": "",
        "value": "found",
        "limit": "limit",
        "unit": "unit",
        "time": "at [s]",
        "passed": "passed",
    }
    return table(rows, columns), clip_sheet(report)


@themed
def clip_sheet(report: ClipReport) -> Figure:
    """A judged clip over time; shaded where no foot carries."""
    fig = new_figure(PAGE_IN, 4.2)
    axes = fig.subplots(len(report.series), 1, sharex=True)
    for ax, (label, values) in zip(axes, report.series.items(), strict=True):
        for column, opacity in zip(np.atleast_2d(values.T), (1.0, 0.45), strict=False):
            ax.plot(report.clip.t, column, color=LAUNCH, alpha=opacity)
        for begin, end in report.flights:
            ax.axvspan(begin, end, color=FLIGHT, alpha=0.2, linewidth=0)
        ax.set_ylabel(label.replace(" [", "\n["))
    axes[-1].set_xlabel("time [s]")
    return fig


def _of_mended(mended: Mended) -> Card:
    rows = table(mended.changes, ("what", "clip", "mended", "change"))
    return rows, jump_strobe(mended.plan.tape, mended.plan.robot)


def _of_record(record: Record) -> Card:
    rows = [vars(limit) | {"worth": limit.worth} for limit in record.limits[:MOST_BINDING]]
    columns = {
        "limit": "binds",
        "joint": "joint",
        "phase": "phase",
        "from_s": "from [s]",
        "to_s": "to [s]",
        "worth": "worth of all of it",
    }
    return table(rows, columns, digits=3), jump_strobe(record.plan.tape, record.plan.robot)


def _of_improved(improved: Improved) -> Card:
    columns = {
        "number": "number",
        "unit": "unit",
        "before": "was",
        "after": "becomes",
        "low": "from",
        "high": "to",
        "buys": f"gain [{improved.after.unit}]",
    }
    rows = table([vars(x) for x in improved.changes], columns, digits=3)
    return rows, jump_strobe(improved.after.plan.tape, improved.robot)


def _of_prices(prices: Prices) -> Card:
    rows = [vars(row) | {"gap": f"{row.gap:.1%}"} for row in prices.rows]
    columns = {
        "limit": "limit",
        "unit": "for one",
        "price": f"gain [{prices.unit}]",
        "checked": "with the limit moved",
        "gap": "differs",
        "stays": "same limits bind",
    }
    return table(rows, columns, digits=3), price_bars(prices)


@themed
def price_bars(prices: Prices) -> Figure:
    """Gain from one per cent more of each limit (a degree, 0.01 of friction), with the records that
    check it; hollow where other limits take over.
    """
    rows = prices.rows[:MOST_PRICES][::-1]
    fig = new_figure(PAGE_IN, 0.7 + 0.22 * len(rows))
    ax = fig.subplots()
    size = 1e3 if prices.unit == "m" else 180 / np.pi
    names = [f"{row.limit}, {row.step_words}" for row in rows]
    ax.barh(names, [size * row.price * row.step for row in rows], color=LAUNCH)
    look = dict(linestyle="none", marker="o", markersize=4, color=FLIGHT, zorder=3)
    for kept, face, label in (
        (True, FLIGHT, "with the limit moved"),
        (False, "white", "the same, other limits bind"),
    ):
        at = [(size * row.checked * row.step, k) for k, row in enumerate(rows) if row.stays == kept]
        ax.plot(*np.array(at).reshape(-1, 2).T, markerfacecolor=face, label=label, **look)
    ax.axvline(0, **LIMIT_STYLE)
    ax.legend(loc="best")
    unit = "mm" if prices.unit == "m" else "deg"
    ax.set(xlabel=f"gain [{unit}]", title=f"{prices.robot}: gain from more of each limit")
    return fig


def _of_trials(report: TrialReport) -> Card:
    return table(report.rows()), _scatter(report)


@themed
def _scatter(report: TrialReport) -> Figure | None:
    """Travel and rise of the robots that landed."""
    values = [report.values(name) for name in ("foot_distance_m", "com_rise_m")]
    if not len(values[0]):
        return None
    fig = new_figure(COLUMN_IN, 2.2)
    ax = fig.subplots()
    ax.plot(*values, linestyle="none", marker="o", markersize=3, color=LANDING)
    ax.set(xlabel="travel of the feet [m]", ylabel="rise of the CoM [m]")
    return fig


def _of_envelope(envelope: Envelope) -> Card:
    rows = []
    for word in ("highest", "farthest"):
        cell = getattr(envelope, word)
        row = {name: getattr(cell, name) for name in envelope.axes} if cell else {}
        rows.append({"": word, **row, "uses most": cell.limiting if cell else "no jump"})
    return table(rows), envelope_map(envelope)


def _of_metrics(m: Metrics) -> Card:
    plain = {name: x for name, x in vars(m).items() if not isinstance(x, Mapping)}
    return _listed({name: x for name, x in plain.items() if x not in (None, ())}), None


def _of_task(task: JumpTask) -> Card:
    rows = {
        "target": describe_task(task),
        "speed at take-off [m/s], upwards": task.takeoff_speed,
        "time in the air [s], at equal heights": task.flight_time(),
        "gravity [m/s^2]": task.gravity,
    }
    return _listed(rows), None


def _of_planner(planner: Planner) -> Card:
    built = ", ".join(planner.built) or "none yet"
    rows = {"robot": planner.robot.line(), "stages built": built, "limits": str(planner.limits)}
    return _listed(rows), None


def _of_rows(rows: Rows) -> Card:
    return table([x if isinstance(x, Mapping) else vars(x) for x in rows]), None


CARDS: dict[str, Callable[[Any], Card]] = {
    "Envelope": _of_envelope,
    "Metrics": _of_metrics,
    "JumpTask": _of_task,
    "Planner": _of_planner,
    "Rows": _of_rows,
    "JumpPlan": _of_plan,
    "SimulationResult": _of_run,
    "Robot": _of_robot,
    "AuditReport": _of_audit,
    "ClipReport": _of_clip,
    "Mended": _of_mended,
    "Record": _of_record,
    "Prices": _of_prices,
    "Improved": _of_improved,
    "TrialReport": _of_trials,
}


@checked
class Plots:
    """Pictures of a plan or of a simulation: ``plan.plots.torques()``; each returns a matplotlib
    figure. Joints, torques and momentum are of plans.
    """

    def __init__(self, of: JumpPlan | SimulationResult):
        self._of = of

    def __repr__(self) -> str:
        return "<Plots: strobe(), joints(), torques(), active(), momentum()>"

    def strobe(self) -> Figure:
        """The jump in one picture."""
        return jump_strobe(getattr(self._of, "tape", self._of), self._of.robot)

    def joints(self) -> Figure:
        """Angles, velocities and torques of the joints over time, within their limits."""
        return joint_trajectories(self._planned().tape, self._of.robot, torques=True)

    def active(self) -> Figure:
        """Which limit binds when."""
        return active(self._planned())

    def torques(self) -> Figure:
        """Torque against speed of each joint; CoP and friction."""
        return margins(self._planned().tape, self._of.robot)

    def momentum(self) -> Figure:
        """Inertia, CoM velocity and angular momentum, and dashed what stage 1 asked for."""
        return inertia_and_momentum(self._planned().tape)

    def _planned(self) -> JumpPlan:
        if not isinstance(self._of, JumpPlan):
            raise InputError("this figure needs a plan; use .strobe(), which shows any jump")
        return self._of
