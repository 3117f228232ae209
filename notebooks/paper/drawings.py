"""One-off figures of the stages: the pendulum's jump, the mapping to joints, contacts, landing, flips."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.reach import Reach
from jumplab.show.bodies import Silhouette, draw_ground, draw_path, equal_scales, film_strip
from jumplab.show.jumps import AFTER_TOUCHDOWN_S
from jumplab.show.style import (
    BAND,
    COLUMN_IN,
    FLIGHT,
    INK,
    LANDING,
    LAUNCH,
    LIMIT_STYLE,
    NOTE_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    REFERENCE_STYLE,
    SKY,
    VERMILION,
    bare,
    by_phase,
    compare,
    legend_above,
    limits,
    mark_time,
    new_figure,
    panel_letters,
    phase_handles,
    shade,
    styled,
    tint,
)
from jumplab.stages.joint_qp import JointPlan
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.srmp.landing import LandingPlan
from jumplab.task import GRAVITY
from paper.diagrams import arrow, ellipse
from paper.experiments import trunk_pitch as trunk_angle  # of a flip: whole turns count
from paper.tracking import compared

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.sim import SimulationResult
    from paper.claims import Start

# stage1 ------------------------------------------------------------------------------------------
SPEED_SCALE_S = 0.10  # length of a drawn velocity, metres per m/s
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
    for pivot, com, color in (
        ((0.0, 0.0), launch.com[0], tint(LAUNCH, 0.45)),
        ((0.0, 0.0), takeoff, LAUNCH),
        (foot, end, shade(FLIGHT, 0.85)),
    ):
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
    place, ha = np.add(pivot, [-0.03 * side, 0.40]), "right" if side > 0 else "left"
    ax.text(*place, _degrees(lean), color=color, fontsize=7, ha=ha, va="center")


def _lengths(ax: Axes, ground, touchdown, foot, floor):
    """l_g on the ground, l_f in the air, and what the foot adds ahead of the CoM; together the jump's length."""
    z = floor - 0.13
    spans = (
        (0.0, ground, "$l_g$", LAUNCH),
        (ground, touchdown, "$l_f$", shade(FLIGHT, 0.85)),
        (touchdown, foot, "ahead", shade(LANDING, 0.8)),
    )
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
def draw_srmp(
    ax: Axes, coordinates: np.ndarray, color: str, *, pivot: tuple[float, float] | np.ndarray = (0.0, 0.0)
) -> dict[str, np.ndarray]:
    """The pendulum at one instant: rod, barbell with its two end masses, and the light-green inertia ellipse.

    Parameters
    ----------
    coordinates : theta_l [rad], phi [m], theta_pl [rad], varphi [m] (4,).

    Returns
    -------
    Places (2,) of C0 (the CoM), C1 and C2 (the barbell's ends) and the pivot.
    """
    lean, length, turn, radius = coordinates
    pivot, tilt = np.asarray(pivot, float), lean + turn
    centre = pivot + length * np.array([np.sin(lean), np.cos(lean)])
    along = np.array([np.sin(tilt), np.cos(tilt)])
    ends = np.array([centre + radius * along, centre - radius * along])
    look = dict(color=color, zorder=2.0)
    ax.add_patch(ellipse(centre, radius, tilt, 0.5))
    ax.plot(*np.array([pivot, centre]).T, linewidth=1.4, **look)
    ax.plot(*ends.T, linewidth=1.0, **look)
    ax.plot(*ends.T, marker="o", markersize=4.0, linestyle="none", **look)
    ax.plot(*centre, marker="o", markersize=3.6, markerfacecolor="white", **look)
    ax.plot(*pivot, marker="^", markersize=4.0, **look)
    equal_scales(ax)
    return dict(C0=centre, C1=ends[0], C2=ends[1], pivot=pivot)


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
    place, look = (heel_up, lower[0].get_ylim()[0]), {"fontsize": 7, "ha": "right", "color": "#555555"}
    lower[0].annotate("heel up", place, (-3, 3), textcoords="offset points", **look)
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
    limits(axes[0], low, high)
    axes[0].annotate("reach of the robot", (f.t[-1], high), (0, -2), ha="right", va="top", **NOTE_STYLE)
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
        gap = 3 if row == 0 or last == up else 11  # points; beside a slope more space is needed
        look = {"fontsize": 7, "ha": ha, "va": "bottom" if side > 0 else "top", "textcoords": "offset points"}
        ax.annotate(_degrees(angle[row]), (t[row], np.degrees(angle[row])), (0, gap * side), **look)


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
        limits(column[0], *plan.reach.inertia)
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
        look = dict(markersize=1.2, color="#C8C8C8", zorder=1, rasterized=True, label="sampled postures")
        ax.plot(np.linalg.norm(samples["com"], axis=1), samples["rho"], ".", **look)
    phi = np.linspace(*reach.length, 100)
    low, high = np.polyval(reach.inertia_low_fit, phi), np.polyval(reach.inertia_high_fit, phi)
    ax.fill_between(phi, low, high, color=tint(SKY, 0.25), zorder=0.5, label="envelope used in launch")
    for bound in (low, high):
        ax.plot(phi, bound, color=SKY, linewidth=1.0, zorder=2)
    if plan is not None:
        q = plan.launch.coordinates
        ax.plot(q[:, 1], plan.launch.rho, color=LAUNCH, zorder=3, label="launch")
        ax.plot(np.linalg.norm(plan.flight.foot_com, axis=1), plan.flight.rho, color=FLIGHT, zorder=3, label="flight")
        for x, y, text, offset in (
            (q[0, 1], plan.launch.rho[0], "stance", (4, -3)),
            (q[-1, 1], plan.launch.rho[-1], "take-off", (4, 3)),
        ):
            ax.plot(x, y, marker="o", markersize=4, color=LAUNCH, zorder=4)
            ax.annotate(text, (x, y), offset, textcoords="offset points", fontsize=7)
    for bound in reach.length:
        ax.axvline(bound, **LIMIT_STYLE)
    ax.set(xlabel="CoM from the middle of the sole, $\\phi$ [m]", ylabel="pitch inertia $\\rho$ [kg m$^2$]")
    ax.legend(loc="upper left", markerscale=4)
    return fig


# joint_map ------------------------------------------------------------------------------------------
FRAMES_LAUNCH, FRAMES_FLIGHT = 6, 5
PITCH_M = 0.66  # how far the frames are apart
GAP_M = 0.12  # between launch and flight
LEVEL_M = 1e-3  # a platform lower than this is none
TEXT_M = 0.24  # space for the frames' times below the ground
ALIKE = 0.9  # values closer than this ratio are drawn on an axis of their own instead of from zero
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
        color, rows, again = PHASE_COLORS[phase], plan.rows(phase), int(phase == "flight")
        chosen = np.linspace(rows.start, rows.stop - 1, count + again).astype(int)[again:]  # the launch shows take-off
        places, frames = place + PITCH_M * np.arange(count), plan.q[chosen]
        com = np.array([body.com(q) for q in frames])
        film_strip(ax, body, frames, plan.t[chosen], [color] * count, places)
        ax.plot(places, com[:, 1], "o", markersize=3, color=INK, markerfacecolor="white", zorder=4)
        left, right = place - PITCH_M / 2, places[-1] + PITCH_M / 2
        edge = right - PITCH_M if phase == "flight" and abs(platform_m) > LEVEL_M else None
        draw_ground(ax, left, right, edge=edge, height=platform_m if edge else 0.0)
        ax.text(left, min(platform_m, 0.0) - TEXT_M, phase, ha="left", va="top", color=shade(color, 0.8))
        place = places[-1] + PITCH_M + GAP_M
    ax.set(xlim=(-PITCH_M / 2 - 0.05, right + 0.05))
    bare(ax)
    return fig


# tracking -------------------------------------------------------------------------------------------------------
@styled
def mapped_tracking(plan: JointPlan, srmp: SrmpPlan, robot: Robot) -> Figure:
    """CoM, angular momentum, inertia and foot distance with stage 1's dashed, and below their differences."""
    fig = new_figure(PAGE_IN, 3.2)
    axes = fig.subplots(2, 4, sharex=True)
    flight = plan.phase == "flight"
    takeoff = plan.t[plan.rows("flight").start]
    for column, (title, unit, scale, every, got, want) in zip(
        axes.T, _tracked(*compared(plan, srmp, robot)), strict=True
    ):
        rows = np.ones(len(plan.t), bool) if every else flight
        t, phase = plan.t[rows], plan.phase[rows]
        for y, reference in zip(got.T, want.T, strict=True):
            by_phase(column[0], t, y, phase)
            column[0].plot(t, reference, **REFERENCE_STYLE)
        miss = np.linalg.norm(got - want, axis=1) if got.shape[1] > 1 else (got - want)[:, 0]
        limits(column[1], 0.0)
        by_phase(column[1], t, scale * miss, phase)
        column[0].set_title(title)
        column[0].set_ylabel(f"[{unit}]")
        column[1].set_ylabel("difference [mm]" if scale > 1 else f"difference [{unit}]")
        column[1].set_xlabel("time [s]")
        for ax in column:
            mark_time(ax, [takeoff])
    legend_above(fig, phase_handles("launch", "flight", reference="stage 1, the reference"))
    return fig


def _tracked(a, r):
    """(title, unit, scale of the difference, whole jump or flight only, actual (n, k), reference (n, k)) per column."""
    length = [np.linalg.norm(x["foot_com"], axis=1)[:, None] for x in (a, r)]
    return (
        ("CoM, $x$ and $z$", "m", 1000.0, True, a["com"], r["com"]),
        ("angular momentum $L$", "kg m$^2$/s", 1.0, True, a["L"][:, None], r["L"][:, None]),
        ("inertia $\\rho$", "kg m$^2$", 1.0, True, a["rho"][:, None], r["rho"][:, None]),
        ("sole to CoM", "m", 1000.0, False, *length),
    )


# starts of stage 3 ----------------------------------------------------------------------------------------------
@styled
def guess_comparison(rows: Iterable[Start], quantities: Mapping[str, str]) -> Figure:
    """One panel per quantity, one column of dots per start, a thin line per target, a bar at the median.

    Parameters
    ----------
    rows : one per target and start.
    quantities : attribute of a row -> axis label with unit.
    """
    by = {(r.task, r.start): r for r in rows}
    targets, starts = (list(dict.fromkeys(keys)) for keys in zip(*by, strict=True))
    fig = new_figure(PAGE_IN, 2.5)
    axes = fig.subplots(1, len(quantities), squeeze=False)[0]
    for ax, (key, label) in zip(axes, quantities.items(), strict=True):
        found = [[getattr(by.get((target, start)), key, None) for start in starts] for target in targets]
        table = np.array(found, float)  # None becomes nan
        _dots(ax, table)
        ax.set_ylabel(label)
        ax.set_xticks(range(len(starts)), starts)
        ax.set_xlim(-0.5, len(starts) - 0.5)
        ax.set_ylim(**_axis_limits(table))
    medians = Line2D([], [], color=INK, linewidth=2.0, label="median")
    legend_above(fig, [medians, Line2D([], [], color="#999999", linewidth=0.6, label="one target")])
    return fig


def _axis_limits(table: np.ndarray) -> dict[str, float]:
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
        look = dict(markersize=4, color=color, markerfacecolor=tint(color, 0.5), zorder=2, clip_on=False)
        ax.plot(np.full(len(values), k), values, "o", **look)
        if np.isfinite(values).any():
            middle = np.nanmedian(values)
            ax.plot([k - 0.25, k + 0.25], [middle, middle], color=INK, linewidth=2.0, zorder=3)


# landing ------------------------------------------------------------------------------------------
@styled
def landing_reference(plan: LandingPlan, reach: Reach) -> Figure:
    """CoM, angular momentum, ground force and CoP from touchdown until the robot stands, and the stance dashed."""
    fig = new_figure(PAGE_IN, 2.9)
    axes = fig.subplots(2, 2, sharex=True)
    length, weight = float(reach.start[1]), reach.mass * GRAVITY
    heel, toe = reach.cop
    axes[0, 0].plot(plan.t, plan.com[:, 1], color=LANDING)
    axes[0, 0].axhline(length, **REFERENCE_STYLE)
    axes[0, 0].set_ylabel("CoM height [m]")
    axes[0, 1].plot(plan.t, plan.F_z / weight, color=LANDING)
    axes[0, 1].axhline(1.0, **REFERENCE_STYLE)
    axes[0, 1].set_ylabel("$F_z$ [body weights]")
    axes[1, 0].plot(plan.t, plan.L, color=LANDING)
    axes[1, 0].axhline(0.0, **REFERENCE_STYLE)
    axes[1, 0].set_ylabel("$L$ [kg m$^2$/s]")
    ax = axes[1, 1]
    ax.fill_between(plan.t, 100 * heel, 100 * toe, color=BAND, linewidth=0)
    limits(ax, 100 * heel, 100 * toe)
    ax.plot(plan.t, 100 * plan.cop_x, color=LANDING, label="CoP")
    ax.plot(plan.t, 100 * plan.com[:, 0], color=LANDING, linewidth=0.9, linestyle=(0, (1, 1.2)), label="CoM")
    ax.set_ylabel("from mid-sole [cm]")
    reach_cm = 100 * max(abs(heel), abs(toe), float(np.abs(plan.com[:, 0]).max()))
    ax.set_ylim(-1.15 * reach_cm, 1.15 * reach_cm)
    ax.legend(loc="lower right", ncols=2)
    for ax in axes[1]:
        ax.set_xlabel("time since touchdown [s]")
    fig.align_ylabels()
    return fig


CUT_M = 0.5  # a CoP further than this from the sole is drawn cut off


SNAPSHOT_M = 0.62  # how far the frames of a launch are moved apart


# Fig. 10 --------------------------------------------------------------------------------------------------------
@styled
def snapshots(tape: Tape, robot: Robot) -> Figure:
    """F-10: launch and flight with their frames moved apart, heights to scale, and the CoM's path."""
    fig = new_figure(PAGE_IN, 2.55)
    ax = fig.subplots()
    body, takeoff = Silhouette(robot), tape.takeoff_index
    rows = np.linspace(0, takeoff - 1, FRAMES_LAUNCH).astype(int)
    rows = np.append(rows, np.linspace(takeoff, len(tape.t) - 1, FRAMES_FLIGHT).astype(int))
    places = SNAPSHOT_M * np.arange(len(rows))
    colors = [PHASE_COLORS[str(tape.phase[row])] for row in rows]
    film_strip(ax, body, tape.q[rows], tape.t[rows], colors, places)
    for text, color in zip(ax.texts, colors, strict=True):
        text.set_color(shade(color, 0.8))
    air = tape.phase == "flight"
    draw_path(ax, np.interp(tape.t[air], tape.t[rows], places), tape.extra["com"][air, 2], zorder=4)
    com = np.interp(tape.t[rows[FRAMES_LAUNCH:]], tape.t, tape.extra["com"][:, 2])
    marks = dict(linestyle="none", marker="o", markersize=3, color=INK, markerfacecolor="white", zorder=4)
    ax.plot(places[FRAMES_LAUNCH:], com, **marks)
    left, right = places[0] - SNAPSHOT_M / 2, places[-1] + 0.8 * SNAPSHOT_M
    height = float(tape.extra["planar_toe"][-1, 1] - tape.extra["planar_toe"][0, 1])
    edge = (places[-1] + places[-2]) / 2 if abs(height) > 1e-3 else None
    draw_ground(ax, left, right, edge=edge, height=height)
    ax.set(xlim=(left - 0.05, right + 0.05))
    legend_above(fig, phase_handles("launch", "flight"))
    bare(ax)
    return fig


# contacts -------------------------------------------------------------------------------------------------------
@styled
def contact_comparison(reactions: Mapping[str, Mapping[str, np.ndarray]], robot: Robot) -> Figure:
    """Heel height and CoP of several launches over each other, by name; see :func:`jumplab.show.jumps.ground_reaction`.

    The last is drawn in the launch's colour, those before it in vermilion: what is right, and what is wrong.
    """
    fig = new_figure(COLUMN_IN, 2.9)
    top, bottom = fig.subplots(2, 1, sharex=True)
    heel = robot.sagittal.heel[0]
    last = max(float(r["t"][-1]) for r in reactions.values())
    bottom.fill_between([0, last], 100 * heel, 0.0, color=BAND, linewidth=0)
    limits(bottom, 100 * heel, 0.0)
    beside = dict(xycoords=bottom.get_yaxis_transform(), va="center", **NOTE_STYLE)  # no curve there
    for bound, name in ((heel, "heel"), (0.0, "toe")):
        bottom.annotate(name, (1, 100 * bound), (3, 0), **beside)
    for k, (name, r) in enumerate(reactions.items(), start=1):
        color = LAUNCH if k == len(reactions) else VERMILION
        heels, places = (np.reshape(r[key], (len(r["t"]), -1)) for key in ("heel_z", "cop_x"))
        top.plot(r["t"], 100 * heels[:, 0], color=color, label=name)  # the left foot's
        bottom.plot(r["t"], 100 * places[:, 0], color=color)
    top.set_ylabel("heel height [cm]")
    top.legend(loc="upper left")
    cop = np.concatenate([np.ravel(r["cop_x"]) for r in reactions.values()])
    low = max(float(np.nanmin(cop)), heel - CUT_M) if np.isfinite(cop).any() else heel
    high = min(float(np.nanmax(cop)), CUT_M) if np.isfinite(cop).any() else 0.0
    bottom.set(xlabel="time [s]", ylabel="CoP from the toe [cm]")
    bottom.set_ylim(100 * min(low, heel) - 9, 100 * max(high, 0.0) + 9)
    fig.align_ylabels()
    return fig


# flips ------------------------------------------------------------------------------------------
@styled
def flip_shaping(srmp: SrmpPlan, tape: Tape, result: SimulationResult, robot: Robot) -> Figure:
    """Inertia, turning rate L / rho, angular momentum, and the tuck beside the trunk's angle; plan dashed.

    Stage 1's flight is thin and orange, set to begin at the plan's take-off.
    """
    fig = new_figure(PAGE_IN, 4.6)
    axes = fig.subplots(2, 2, sharex=True)
    end = result.metrics.touchdown_s or float(tape.t[-1])
    seen = result.t <= end + AFTER_TOUCHDOWN_S
    t, phase = result.t[seen], result.phase[seen]
    rho, momentum = result.rho[seen], result.L[seen]
    planned = tape.extra["planar_rho"].ravel(), tape.extra["planar_L"].ravel()
    one = srmp.flight
    start, thin = tape.takeoff_time, dict(color=FLIGHT, linewidth=0.8, linestyle=(0, (1, 1.2)))
    rows = (
        (axes[0, 0], r"$\rho$ [kg m$^2$]", rho, planned[0], one.rho),
        (axes[0, 1], r"$\omega = L / \rho$ [rad/s]", momentum / rho, planned[1] / planned[0], one.L / one.rho),
        (axes[1, 0], r"$L$ [kg m$^2$/s]", momentum, planned[1], one.L),
    )
    for ax, label, actual, plan, first in rows:
        compare(ax, (t, actual, phase), (tape.t, plan), label=label)
        ax.plot(start + one.t, first, **thin)
    ax = axes[1, 1]
    planned_turn, turn = np.degrees(trunk_angle(tape.q)), np.degrees(trunk_angle(result.q))
    compare(ax, (t, turn[seen], phase), (tape.t, planned_turn), label="trunk [deg]")
    tuck = ax.twinx()
    knee = 7 + robot.joint_names.index(robot.joints["knee"][0])
    tuck.plot(t, np.degrees(result.q[seen, knee]), color="0.45", linewidth=0.8)
    tuck.set_ylabel("knee [deg], grey")
    for ax in axes.flat:
        mark_time(ax, (start, end))
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    panel_letters(axes.flat)
    handles = phase_handles("launch", "flight", "landing", reference="plan")
    legend_above(fig, [*handles, Line2D([], [], **thin, label="stage 1")])
    fig.align_ylabels()
    return fig
