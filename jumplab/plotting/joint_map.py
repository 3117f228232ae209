"""Stage 2 in pictures: snapshots (Fig. 7), tracking of stage 1, and what stage 3 gains from different starts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jumplab.joint_map import JointPlan
from jumplab.plotting.bodies import Silhouette, draw_ground, draw_robot, equal_scales
from jumplab.plotting.style import (
    FLIGHT,
    INK,
    LAUNCH,
    LIMIT_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    REFERENCE_STYLE,
    bare,
    by_phase,
    legend_above,
    mark_time,
    new_figure,
    phase_handles,
    shade,
    styled,
    tint,
)
from jumplab.robot import Robot

FRAMES_LAUNCH, FRAMES_FLIGHT = 6, 5
PITCH_M = 0.66  # our choice: how far the frames are apart
GAP_M = 0.12  # our choice: between launch and flight
LEVEL_M = 1e-3  # a platform lower than this is none
TEXT_M = 0.24  # room for the frames' times below the ground
ALIKE = 0.9  # our choice: values closer than this ratio are drawn on an axis of their own instead of from zero
START_COLORS = (LAUNCH, FLIGHT)  # in turn


# Fig. 7 ---------------------------------------------------------------------------------------------------------
@styled
def mapped_snapshots(plan: JointPlan, robot: Robot, platform_m: float = 0.0) -> Figure:
    """F-7: launch and flight in frames, moved apart so that every posture shows; heights are as they are.

    Parameters
    ----------
    platform_m : height of the landing surface [m].
    """
    fig = new_figure(PAGE_IN, 2.6)
    ax = fig.subplots()
    body, place = Silhouette(robot), 0.0
    for phase, count in (("launch", FRAMES_LAUNCH), ("flight", FRAMES_FLIGHT)):
        color, rows = PHASE_COLORS[phase], plan.rows(phase)
        left, again = place - PITCH_M / 2, int(phase == "flight")  # the launch has shown take-off already
        for k in np.linspace(rows.start, rows.stop - 1, count + again).astype(int)[again:]:
            _frame(ax, body, plan.q[k], place, color, text=f"{plan.t[k]:.2f} s")
            place += PITCH_M
        right = place - PITCH_M / 2
        edge = right - PITCH_M if phase == "flight" and abs(platform_m) > LEVEL_M else None
        draw_ground(ax, left, right, edge=edge, height=platform_m if edge else 0.0)
        ax.text(left, min(platform_m, 0.0) - TEXT_M, phase, ha="left", va="top", color=shade(color, 0.8))
        place += GAP_M
    ax.set(xlim=(-PITCH_M / 2 - 0.05, right + 0.05))
    bare(ax)
    return fig


def _frame(ax: Axes, body: Silhouette, q: np.ndarray, place: float, color: str, *, text: str) -> None:
    """One frame with its CoM at the horizontal ``place`` [m], and a text below the ground."""
    com = body.com(q)
    draw_robot(ax, body, q, color, shift=place - com[0])
    ax.plot(place, com[1], marker="o", markersize=3, color=INK, markerfacecolor="white", zorder=4)
    ax.text(place, -0.06, text, ha="center", va="top", fontsize=7)
    equal_scales(ax)


# tracking -------------------------------------------------------------------------------------------------------
@styled
def mapped_tracking(plan: JointPlan) -> Figure:
    """CoM, angular momentum, inertia and foot distance with stage 1's dashed, and below their differences."""
    fig = new_figure(PAGE_IN, 3.2)
    axes = fig.subplots(2, 4, sharex=True)
    flight = plan.phase == "flight"
    takeoff = plan.t[plan.rows("flight").start]
    for column, (title, unit, scale, every, got, want) in zip(axes.T, _tracked(plan), strict=True):
        rows = np.ones(len(plan.t), bool) if every else flight
        t, phase = plan.t[rows], plan.phase[rows]
        for y, reference in zip(got.T, want.T, strict=True):
            by_phase(column[0], t, y, phase)
            column[0].plot(t, reference, **REFERENCE_STYLE)
        miss = np.linalg.norm(got - want, axis=1) if got.shape[1] > 1 else (got - want)[:, 0]
        column[1].axhline(0.0, **LIMIT_STYLE)
        by_phase(column[1], t, scale * miss, phase)
        column[0].set_title(title)
        column[0].set_ylabel(f"[{unit}]")
        column[1].set_ylabel("difference [mm]" if scale > 1 else f"difference [{unit}]")
        column[1].set_xlabel("time [s]")
        for ax in column:
            mark_time(ax, [takeoff])
    legend_above(fig, phase_handles("launch", "flight", reference="stage 1, the reference"))
    return fig


def _tracked(plan: JointPlan):
    """(title, unit, scale of the difference, whole jump or flight only, actual (n, k), reference (n, k)) per column."""
    a, r, planar = plan.actual, plan.reference, [0, 2]
    length = [np.linalg.norm(x["foot_com"][:, planar], axis=1)[:, None] for x in (a, r)]
    return (
        ("CoM, $x$ and $z$", "m", 1000.0, True, a["com"][:, planar], r["com"][:, planar]),
        ("angular momentum $L$", "kg m$^2$/s", 1.0, True, a["L"][:, None], r["L"][:, None]),
        ("inertia $\\rho$", "kg m$^2$", 1.0, True, a["rho"][:, None], r["rho"][:, None]),
        ("sole to CoM", "m", 1000.0, False, *length),
    )


# starts of stage 3 ----------------------------------------------------------------------------------------------
@styled
def guess_comparison(rows: Iterable[Mapping], quantities: Mapping[str, str]) -> Figure:
    """One panel per quantity, one column of dots per start, a thin line per target, a bar at the median.

    Parameters
    ----------
    rows : one mapping per target and start: "target", "start", the quantities (NaN or None without a solution).
    quantities : key -> axis label with unit.
    """
    rows = list(rows)
    starts, targets = (list(dict.fromkeys(r[k] for r in rows)) for k in ("start", "target"))
    fig = new_figure(PAGE_IN, 2.5)
    axes = fig.subplots(1, len(quantities), squeeze=False)[0]
    for ax, (key, label) in zip(axes, quantities.items(), strict=True):
        found = {(r["target"], r["start"]): np.nan if r[key] is None else float(r[key]) for r in rows}
        table = np.array([[found.get((target, start), np.nan) for start in starts] for target in targets])
        _dots(ax, table)
        ax.set_ylabel(label)
        ax.set_xticks(range(len(starts)), starts)
        ax.set_xlim(-0.5, len(starts) - 0.5)
        ax.set_ylim(**_limits(table))
    medians = Line2D([], [], color=INK, linewidth=2.0, label="median")
    legend_above(fig, [medians, Line2D([], [], color="#999999", linewidth=0.6, label="one target")])
    return fig


def _limits(table: np.ndarray) -> dict[str, float]:
    """Limits of an axis: from zero, or around values that hardly differ."""
    values = table[np.isfinite(table)]
    if len(values) and not values.any():
        return {"bottom": 0.0, "top": 1.0}
    if len(values) and values.min() > ALIKE * values.max():
        return {"bottom": ALIKE * values.min(), "top": (2 - ALIKE) * values.max()}
    return {"bottom": 0.0}


def _dots(ax: Axes, table: np.ndarray) -> None:
    """Values (targets, starts): lines of targets, dots of starts, medians."""
    for line in table:
        ax.plot(line, color="#BBBBBB", linewidth=0.6, zorder=1)
    for k, values in enumerate(table.T):
        color = START_COLORS[k % len(START_COLORS)]
        ax.plot(np.full(len(values), k), values, linestyle="none", marker="o", markersize=4, color=color,
                markerfacecolor=tint(color, 0.5), zorder=2, clip_on=False)  # fmt: skip
        if np.isfinite(values).any():
            middle = np.nanmedian(values)
            ax.plot([k - 0.25, k + 0.25], [middle, middle], color=INK, linewidth=2.0, zorder=3)
