"""Stage 1 in pictures: the jump as a pendulum (Fig. 5 of the paper), launch (Fig. 6), flight, and the robot's reach."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.plotting.bodies import draw_ground, draw_srmp
from jumplab.plotting.diagrams import arrow
from jumplab.plotting.style import (
    COLUMN_IN,
    FLIGHT,
    INK,
    LANDING,
    LAUNCH,
    LIMIT_STYLE,
    PAGE_IN,
    REFERENCE_STYLE,
    SKY,
    bare,
    mark_time,
    new_figure,
    shade,
    styled,
    tint,
)
from jumplab.robot.reach import Reach
from jumplab.srmp import SrmpPlan

SPEED_SCALE_S = 0.10  # our choice: length of a drawn velocity, metres per m/s
FRAMES = 8


# Fig. 5 ---------------------------------------------------------------------------------------------------------
@styled
def inverted_pendulum(plan: SrmpPlan) -> Figure:
    """F-5: CoM path, rods and velocities at take-off and touchdown, and how the length of the jump adds up."""
    fig = new_figure(PAGE_IN * 0.62, 3.3)
    ax = fig.subplots()
    bare(ax)
    launch, flight = plan.launch, plan.flight
    platform, end = plan.task.platform_m, flight.com[-1]
    foot = end + flight.foot_com[-1]
    takeoff, v0, v1 = flight.com[0], flight.com_velocity[0], flight.com_velocity[-1]
    left, right = min(0.0, foot[0]) - 0.45, max(0.0, foot[0]) + 0.45
    edge = (0.2 * takeoff + 0.8 * foot)[0] if platform else None
    draw_ground(ax, left, right, edge=edge, height=platform)
    ax.plot(*launch.com.T, color=LAUNCH, label="CoM, launch")
    ax.plot(*flight.com.T, color=FLIGHT, label="CoM, flight")
    for pivot, com, color in (((0.0, 0.0), launch.com[0], tint(LAUNCH, 0.45)), ((0.0, 0.0), takeoff, LAUNCH),
                              (foot, end, shade(FLIGHT, 0.85))):  # fmt: skip
        ax.plot(*np.array([pivot, com]).T, color=color, linewidth=2.0)
        ax.plot(*com, marker="o", markersize=8, color=color, markerfacecolor="white", markeredgewidth=1.3, zorder=4)
        ax.plot(*pivot, marker="^", markersize=5, color=color)
    _velocity(ax, takeoff, v0, "right")
    _velocity(ax, end, v1, "left")
    apex = int(np.argmax(flight.com[:, 1]))
    ax.plot(*flight.com[apex], marker="o", markersize=3, color=FLIGHT)
    _height(ax, flight.com[apex], takeoff[1], plan.task.height_m)
    _lean(ax, (0.0, 0.0), plan.launch.lean[-1], LAUNCH)
    _lean(ax, foot, flight.lean[-1] - plan.task.rotation_rad, shade(FLIGHT, 0.85))
    _lengths(ax, takeoff[0], end[0], foot[0], min(0.0, platform))
    ax.set_aspect("equal")
    ax.legend(loc="upper left")
    return fig


def _degrees(angle) -> str:
    return f"${round(np.degrees(angle)):d}$°"


def _velocity(ax: Axes, com, v, align):
    tip = com + SPEED_SCALE_S * v
    arrow(ax, com, tip, color=LANDING, linewidth=1.3)
    text = f"$v_x = {v[0]:.2f}$ m/s\n$v_z = {v[1]:.2f}$ m/s"
    place = np.add(com, [0.12, -0.02]) if align == "left" else np.add(tip, [-0.05, 0.0])
    ax.text(*place, text, color=shade(LANDING, 0.8), fontsize=7, ha=align, va="center", linespacing=1.3)


def _height(ax: Axes, apex, base, height):
    ax.plot([apex[0] - 0.06, apex[0] + 0.06], [base, base], **LIMIT_STYLE)
    arrow(ax, (apex[0], base), apex, color="#555555", arrowstyle="<|-|>", linewidth=0.6)
    ax.text(apex[0], apex[1] + 0.03, f"$h = {height:.2f}$ m", fontsize=7, ha="center", va="bottom")


def _lean(ax: Axes, pivot, lean, color):
    """The rod's angle against the vertical, with its value."""
    pivot = np.asarray(pivot, float)
    ax.plot(*np.array([pivot, np.add(pivot, [0, 0.5])]).T, color="#777777", linewidth=0.7, linestyle=(0, (3, 2)))
    a = np.linspace(0, lean, 20)
    ax.plot(*(pivot[:, None] + 0.36 * np.array([np.sin(a), np.cos(a)])), color=color, linewidth=1.0)
    side = np.sign(lean) or 1.0
    ax.text(*np.add(pivot, [-0.03 * side, 0.40]), _degrees(lean), color=color, fontsize=7,
            ha="right" if side > 0 else "left", va="center")  # fmt: skip


def _lengths(ax: Axes, ground, touchdown, foot, floor):
    """l_g on the ground, l_f in the air, and what the foot adds ahead of the CoM; together the jump's length."""
    z = floor - 0.13
    spans = ((0.0, ground, "$l_g$", LAUNCH), (ground, touchdown, "$l_f$", shade(FLIGHT, 0.85)),
             (touchdown, foot, "ahead", shade(LANDING, 0.8)))  # fmt: skip
    for x in (0.0, ground, touchdown, foot):
        ax.plot([x, x], [z - 0.03, floor - 0.05], color="#999999", linewidth=0.6)
    for k, (a, b, name, color) in enumerate(spans):
        arrow(ax, (a, z), (b, z), color=color, arrowstyle="<|-|>", mutation_scale=5)
        place, where = ((a + b) / 2, z - 0.04), dict(ha="center", va="top")
        if k == 2:  # too short for a text below it
            place, where = (max(a, b) + 0.03, z), dict(ha="left", va="center")
        ax.text(*place, f"{name} {b - a:.2f} m", color=color, fontsize=7, **where)
    arrow(ax, (0.0, z - 0.19), (foot, z - 0.19), color=INK, arrowstyle="<|-|>", mutation_scale=5)
    ax.text(foot / 2, z - 0.22, f"$l = {foot:.2f}$ m, foot to foot", fontsize=7, ha="center", va="top")


# Fig. 6 ---------------------------------------------------------------------------------------------------------
@styled
def launch_strobe(plan: SrmpPlan) -> Figure:
    """F-6: rod, barbell and inertia ellipse through the launch, frames moved apart; below, posture, speed and L."""
    fig = new_figure(PAGE_IN, 3.2)
    names = [["strip"] * 3, ["posture", "speed", "momentum"]]
    top, *lower = fig.subplot_mosaic(names, height_ratios=(1.25, 1.0)).values()
    launch = plan.launch
    rows = np.linspace(0, len(launch.t) - 1, FRAMES).astype(int)
    pitch = 2.6 * launch.coordinates[:, 3].max()
    bare(top)
    for k, row in enumerate(rows):
        at = np.array([k * pitch, 0.0])
        draw_srmp(top, launch.coordinates[row], LAUNCH, pivot=at)
        top.text(at[0], -0.10, f"{launch.t[row]:.2f} s", ha="center", va="top", fontsize=7)
    draw_ground(top, -0.6 * pitch, (len(rows) - 0.4) * pitch)
    top.set_xlim(-0.6 * pitch, (len(rows) - 0.4) * pitch)
    heel_up = plan.launch_s - plan.toe_s
    curves = (
        (np.degrees(launch.posture), "posture $\\theta_l + \\theta_{pl}$ [deg]"),
        (launch.com_velocity[:, 1], "$v_z$ of the CoM [m/s]"),
        (launch.L, "$L$ [kg m$^2$/s]"),
    )
    for ax, (y, label) in zip(lower, curves, strict=True):
        ax.plot(launch.t, y, color=LAUNCH)
        ax.plot(launch.t[rows], y[rows], linestyle="none", marker="o", markersize=2.5, color=LAUNCH)
        ax.set(xlabel="time [s]", ylabel=label)
        mark_time(ax, [heel_up])
    lower[0].annotate("heel up", (heel_up, lower[0].get_ylim()[0]), (-3, 3), textcoords="offset points", fontsize=7,
                      ha="right", color="#555555")  # fmt: skip
    return fig


# flight ---------------------------------------------------------------------------------------------------------
@styled
def flight_shaping(plan: SrmpPlan) -> Figure:
    """Inertia shaping: rho, the turning rate omega = L / rho, and theta; dashed, had rho kept its take-off value."""
    fig = new_figure(COLUMN_IN, 3.5)
    axes = fig.subplots(3, 1, sharex=True)
    f = plan.flight
    rigid = f.L / f.rho[0]
    low, high = plan.reach.inertia
    axes[0].plot(f.t, f.rho, color=FLIGHT)
    axes[0].axhline(f.rho[0], **REFERENCE_STYLE)
    for bound in (low, high):
        axes[0].axhline(bound, **LIMIT_STYLE)
    axes[0].annotate("reach of the robot", (f.t[-1], high), (0, -2), textcoords="offset points", ha="right",
                     va="top", fontsize=7, color="#666666")  # fmt: skip
    axes[1].plot(f.t, f.L / f.rho, color=FLIGHT)
    axes[1].plot(f.t, rigid, **REFERENCE_STYLE)
    axes[2].plot(f.t, np.degrees(f.lean), color=FLIGHT, label="inertia shaped")
    axes[2].plot(f.t, np.degrees(f.lean[0] + rigid * f.t), **REFERENCE_STYLE, label="$\\rho$ as at take-off")
    _end_angles(axes[2], f.t, f.lean, away_from=f.lean[0] + rigid[-1] * f.t[-1])
    axes[2].legend(loc="best")
    for ax, label in zip(axes, ("$\\rho$ [kg m$^2$]", "$\\omega = L/\\rho$ [rad/s]", "$\\theta$ [deg]"), strict=True):
        ax.set_ylabel(label)
        ax.margins(y=0.22)
    axes[0].set_title(f"$L = {f.L[0]:.2f}$ kg m$^2$/s throughout the flight", fontsize=8)
    axes[2].set_xlabel("time since take-off [s]")
    fig.align_ylabels()
    return fig


def _end_angles(ax: Axes, t: np.ndarray, angle: np.ndarray, away_from: float | None = None) -> None:
    """The first and last value of a curve of angles [rad], where neither it nor one that ends at ``away_from`` is."""
    up = 1 if angle[-1] > angle[0] else -1
    last = up if away_from is None else int(np.sign(angle[-1] - away_from)) or up
    for row, side, ha in ((0, -up, "left"), (-1, last, "right")):
        gap = 3 if row == 0 or last == up else 11  # points; beside a slope more room is needed
        ax.annotate(_degrees(angle[row]), (t[row], np.degrees(angle[row])), (0, gap * side), fontsize=7, ha=ha,
                    textcoords="offset points", va="bottom" if side > 0 else "top")  # fmt: skip


@styled
def flight_comparison(plans: Mapping[str, SrmpPlan]) -> Figure:
    """Inertia and angle of several flights beside each other, one column per plan under its name."""
    fig = new_figure(PAGE_IN, 2.7)
    axes = fig.subplots(2, len(plans), squeeze=False)
    inertia = [bound for plan in plans.values() for bound in plan.reach.inertia]
    for column, (name, plan) in zip(axes.T, plans.items(), strict=True):
        f = plan.flight
        column[0].set_title(f"{name}: $L = {f.L[0]:.1f}$ kg m$^2$/s")
        column[0].plot(f.t, f.rho, color=FLIGHT)
        for bound in plan.reach.inertia:
            column[0].axhline(bound, **LIMIT_STYLE)
        column[1].plot(f.t, np.degrees(f.lean), color=FLIGHT)
        _end_angles(column[1], f.t, f.lean)
        column[0].set_ylim(0.85 * min(inertia), 1.05 * max(inertia))
        column[1].margins(y=0.22)
        column[1].set_xlabel("time since take-off [s]")
    axes[0, 0].set_ylabel("$\\rho$ [kg m$^2$]")
    axes[1, 0].set_ylabel("$\\theta$ [deg]")
    fig.align_ylabels()
    return fig


# reach ----------------------------------------------------------------------------------------------------------
@styled
def reach_envelope(reach: Reach, plan: SrmpPlan | None = None, *, samples: dict | None = None) -> Figure:
    """Inertia within reach over the CoM's distance phi from the sole, with a plan's launch in it.

    Parameters
    ----------
    samples : postures as :func:`jumplab.robot.reach.postures` returns them, drawn as dots.
    """
    fig = new_figure(COLUMN_IN, 2.7)
    ax = fig.subplots()
    if samples is not None:
        ax.plot(np.linalg.norm(samples["com"], axis=1), samples["rho"], linestyle="none", marker=".", markersize=1.2,
                color="#C8C8C8", zorder=1, rasterized=True, label="sampled postures")  # fmt: skip
    phi = np.linspace(*reach.length, 100)
    low, high = np.polyval(reach.inertia_low_fit, phi), np.polyval(reach.inertia_high_fit, phi)
    ax.fill_between(phi, low, high, color=tint(SKY, 0.25), zorder=0.5, label="envelope used in launch")
    for bound in (low, high):
        ax.plot(phi, bound, color=SKY, linewidth=1.0, zorder=2)
    if plan is not None:
        q = plan.launch.coordinates
        ax.plot(q[:, 1], plan.launch.rho, color=LAUNCH, zorder=3, label="launch")
        ax.plot(np.linalg.norm(plan.flight.foot_com, axis=1), plan.flight.rho, color=FLIGHT, zorder=3, label="flight")
        for x, y, text, offset in ((q[0, 1], plan.launch.rho[0], "stance", (4, -3)),
                                   (q[-1, 1], plan.launch.rho[-1], "take-off", (4, 3))):  # fmt: skip
            ax.plot(x, y, marker="o", markersize=4, color=LAUNCH, zorder=4)
            ax.annotate(text, (x, y), offset, textcoords="offset points", fontsize=7)
    for bound in reach.length:
        ax.axvline(bound, **LIMIT_STYLE)
    ax.set(xlabel="CoM from the middle of the sole, $\\phi$ [m]", ylabel="pitch inertia $\\rho$ [kg m$^2$]")
    ax.legend(loc="upper left", markerscale=4)
    return fig
