"""Pictures of a jump, from its tape or its simulation's log, and the map of the jumps that a robot can do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from jumplab.errors import InputError
from jumplab.io.columns import com_height
from jumplab.io.tape import Tape
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.show import style, turning
from jumplab.show.bodies import Silhouette, draw_ground, draw_path, film_strip, five_link_points
from jumplab.stages.whole_body import Limits
from jumplab.studies.envelope import BEYOND, OPEN, VERDICT, Envelope
from jumplab.task import GRAVITY

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.sim import SimulationResult
    from jumplab.studies.margins import MarginReport

REFUSED = {
    OPEN: ("#9A9A9A", "no plan found"),
    VERDICT: ("#D5D5D5", "beyond a straight push, and no plan found"),
    BEYOND: ("#F0F0F0", "not tried"),
}
MOST_TICKS = 14  # more would touch
AFTER_TOUCHDOWN_S = 0.25  # how much of the landing is shown
FLIGHT_SHARES = (0.25, 0.5, 0.75)  # when frames of the flight are shown
STRIP_M = 0.72  # from frame to frame, just more than a robot with its arms stretched out
LEAST_FORCE_SHARE = 0.02  # below this share of the weight, CoP and friction are 0/0 and not drawn


def heel_up_time(tape: Tape) -> float:
    """When the heel leaves the ground [s]."""
    return float(tape.extra["toe_phase_start" if turning.leaves_plane(tape) else "planar_toe_phase_start"])


# Fig. 8 ---------------------------------------------------------------------------------------------------------
@style.styled
def joint_trajectories(tape: Tape, robot: Robot, *, guess: tuple[np.ndarray, ...] | None = None) -> Figure:
    """F-8: one column per joint, angle above and velocity below, launch and flight in two colours, limits thin.

    Parameters
    ----------
    guess : time (n,), joint angles and rates (n, 4) in sagittal signs to draw dashed, such as stage 2's; of a jump in
        the plane alone. Out of it there is a column per pair of joints, the right side paler.
    """
    if turning.leaves_plane(tape):
        return turning.joint_trajectories(tape, robot, heel_up_time(tape))
    fig = style.new_figure(style.PAGE_IN, 3.1)
    axes = fig.subplots(2, 4, sharex=True)
    m, e = robot.sagittal, tape.extra
    rows = (
        (e["planar_joints"], m.lower, m.upper, "angle [rad]"),
        (e["planar_joint_rates"], -m.speed, m.speed, "velocity [rad/s]"),
    )
    for k, (y, low, high, label) in enumerate(rows):
        for i, ax in enumerate(axes[k]):
            dashed = [] if guess is None else [(guess[0], guess[1 + k][:, i])]
            style.compare(ax, (tape.t, y[:, i], tape.phase), *dashed, marks=[heel_up_time(tape)])
            style.limits(ax, low[i], high[i])
            room = 0.06 * (high[i] - low[i])
            ax.set_ylim(low[i] - room, high[i] + room)
        axes[k, 0].set_ylabel(label)
    for name, (top, bottom) in zip(SAGITTAL_JOINTS, axes.T, strict=True):
        top.set_title(name)
        bottom.set_xlabel("time [s]")
    fig.align_ylabels(axes[:, 0])
    dashed = "stage 2, the guess" if guess is not None else None
    style.legend_above(fig, style.phase_handles("launch", "flight", limit="limit", reference=dashed))
    return fig


# Fig. 9 ---------------------------------------------------------------------------------------------------------
@style.styled
def inertia_and_momentum(tape: Tape) -> Figure:
    """F-9: inertia, CoM velocity and angular momentum of the plan, and dashed what stage 1 asked for.

    Out of the plane CoM velocity and angular momentum alone, in all three directions.
    """
    if turning.leaves_plane(tape):
        return turning.speed_and_momentum(tape, heel_up_time(tape))
    fig = style.new_figure(style.PAGE_IN, 3.3)
    axes = fig.subplots(2, 2, sharex=True)
    e, takeoff, known = tape.extra, tape.takeoff_time, "srmp_launch_t" in tape.extra
    curves = (
        ("rho", ..., "$\\rho$ [kg m$^2$]"),
        ("L", ..., "$L$ [kg m$^2$/s]"),
        ("com_velocity", (..., 0), "$v_x$ of the CoM [m/s]"),
        ("com_velocity", (..., 1), "$v_z$ of the CoM [m/s]"),
    )
    for ax, (key, part, label) in zip(axes.flat, curves, strict=True):
        asked = []
        if known:
            starts = {"launch": takeoff - e["srmp_launch_t"][-1], "flight": takeoff}
            asked = [(e[f"srmp_{p}_t"] + start, e[f"srmp_{p}_{key}"][part]) for p, start in starts.items()]
        marks = (heel_up_time(tape), takeoff)
        style.compare(ax, (tape.t, e[f"planar_{key}"][part], tape.phase), *asked, label=label, marks=marks)
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    fig.align_ylabels()
    style.legend_above(
        fig, style.phase_handles("launch", "flight", reference="stage 1, the reference" if known else None)
    )
    return fig


# limits ---------------------------------------------------------------------------------------------------------
@style.styled
def margins(tape: Tape, robot: Robot, limits: Limits | Limits | None = None) -> Figure:
    """Torque against speed of each joint in its envelope; CoP in the sole and friction used through the launch.

    ``limits`` are the planner's (its defaults if None), drawn dashed inside what the motors could do.
    """
    if turning.leaves_plane(tape):
        return turning.margins(tape, robot, limits or Limits(), heel_up_time(tape))
    limits = limits or Limits()
    fig = style.new_figure(style.PAGE_IN, 3.9)
    names = [["hip", "knee", "ankle", "shoulder"], ["cop", "cop", "friction", "friction"]]
    axes = fig.subplot_mosaic(names, height_ratios=(1.15, 1.0))
    for i, name in enumerate(SAGITTAL_JOINTS):
        _torque_speed(axes[name], tape, robot, i, limits)
        axes[name].set_title(name)
    axes["hip"].set_ylabel("torque of both sides [N m]")
    r, cop, friction = ground_reaction(tape, robot), axes["cop"], axes["friction"]
    heel = 100 * robot.sagittal.heel[0]
    cop.fill_between(r["t"], heel, 0.0, color=style.BAND, linewidth=0)
    style.limits(cop, heel, 0.0)
    cop.plot(r["t"], 100 * r["cop_x"], color=style.LAUNCH)
    cop.set(ylabel="CoP from the toe [cm]", ylim=(heel - 3, 3))
    cop.annotate("heel", (0, heel), (2, 2), **style.NOTE_STYLE)
    cop.annotate("toe", (0, 0), (2, -2), va="top", **style.NOTE_STYLE)
    friction.plot(r["t"], np.abs(r["F_x"]) / r["F_z"], color=style.LAUNCH)
    friction.axhline(limits.friction, **style.REFERENCE_STYLE)
    friction.set(ylabel="friction used $|F_x|/F_z$", ylim=(0, 1.15 * limits.friction))
    for ax in (cop, friction):
        style.mark_time(ax, [heel_up_time(tape)])
        ax.set_xlabel("time [s]")
    style.legend_above(
        fig, style.phase_handles("launch", "flight", limit="limit", reference="what the planner may use")
    )
    return fig


def _torque_speed(ax: Axes, tape: Tape, robot: Robot, i: int, limits: Limits) -> None:
    m = robot.sagittal
    turning.motor(ax, m.speed[i], m.corner_speed[i], m.no_load_speed[i], m.effort[i], limits)
    rates, torques = (tape.extra[f"planar_{name}"][:, i] for name in ("joint_rates", "torques"))
    style.by_phase(ax, rates, torques, tape.phase, linewidth=1.3)


def ground_reaction(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Launch's ground reaction, both feet together: t [s], F_x, F_z [N], CoP and heel height [m] (n,).

    The CoP counts from the toe's first place; it is NaN where the ground hardly pushes.
    """
    launch = tape.phase == "launch"
    force = tape.f[launch].sum(axis=1)  # (n, 6), at the ankles
    angles, toe = tape.extra["planar_angles"][launch], tape.extra["planar_toe"][launch]
    points = [five_link_points(robot.sagittal, a, x - toe[0]) for a, x in zip(angles, toe, strict=True)]
    ankle, heel = (np.array([p[name] for p in points]) for name in ("ankle", "heel"))
    up = force[:, 2] > LEAST_FORCE_SHARE * robot.total_mass * GRAVITY
    down = np.where(up, force[:, 2], np.nan)
    cop = ankle[:, 0] - (force[:, 4] + ankle[:, 1] * force[:, 0]) / down
    return dict(t=tape.t[launch], F_x=force[:, 0], F_z=down, cop_x=cop, heel_z=heel[:, 1])


AXIS_WORDS = {"distance_m": "distance [m]", "height_m": "rise of the CoM [m]"}  # of an envelope
AXIS_WORDS |= {"side_m": "to the left [m]", "yaw_rad": "turn [rad]"}


@style.styled
def envelope_map(envelope: Envelope, *others: Envelope) -> Figure:
    """The map of an envelope; a cell's colour is the limit that it uses most, its strength how much of it.

    Maps of ``others`` over the same two numbers stand beside it, four in a row, under one legend.
    """
    maps = envelope, *others
    across, up = (AXIS_WORDS[name] for name in envelope.axes)
    cells = [c for found in maps for c in found.cells]
    palette = matplotlib.color_sequences["okabe_ito"]
    colors = {
        name: palette[(i + 1) % len(palette)] for i, name in enumerate(sorted({c.limiting for c in cells if c.solved}))
    }
    if others:
        rows = -(-len(maps) // 4)
        fig = style.new_figure(style.PAGE_IN, 0.9 + 1.75 * rows)
        axes = fig.subplots(rows, 4, squeeze=False)
        for ax in axes.flat[len(maps) :]:
            ax.set_axis_off()
        fig.supxlabel(across, fontsize=8)
        fig.supylabel(up, fontsize=8)
    else:
        fig = style.new_figure(1.6 * style.COLUMN_IN, 3.2)
        axes = np.array([fig.subplots()])
        axes[0].set(xlabel=across, ylabel=up)
    for ax, found in zip(axes.flat, maps, strict=False):
        _map_cells(ax, found, colors, "{:.2g}" if others else "{:g}")
        ax.set_title(found.robot if others else f"{found.robot}: limit used most, in %")
    seen = {c.limiting for c in cells}
    handles = [Patch(color=color, label=name) for name, color in colors.items()]
    handles += [Patch(color=color, label=text) for kind, (color, text) in REFUSED.items() if kind in seen]
    if others:
        fig.legend(handles=handles, loc="outside upper center", ncols=4, fontsize=7)
    else:
        axes[0].legend(handles=handles, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=7, frameon=False)
    return fig


def _map_cells(ax: Axes, envelope: Envelope, colors: Mapping[str, Any], tick: str) -> None:
    edges = envelope.distances, envelope.heights
    size = np.array([np.min(np.diff(values)) if len(values) > 1 else 0.1 for values in edges])
    for c in envelope.cells:
        place = np.array([getattr(c, name) for name in envelope.axes])
        if c.solved:
            face = style.tint(colors[c.limiting], 0.25 + 0.75 * float(np.clip(c.share, 0, 1)))
            ink = "black" if np.mean(face) > 0.3 else "white"
            ax.text(*place, f"{100 * c.share:.0f}", ha="center", va="center", fontsize=5.5, color=ink)
        else:
            face = REFUSED[c.limiting][0]
        ax.add_patch(Rectangle(place - size / 2, *size, facecolor=face, edgecolor="white", linewidth=0.6))
    x, y = ((min(values) - d / 2, max(values) + d / 2) for values, d in zip(edges, size, strict=True))
    ax.set(xlim=x, ylim=y)
    if max(map(len, edges)) <= MOST_TICKS:
        ax.set_xticks(envelope.distances, map(tick.format, envelope.distances))
        ax.set_yticks(envelope.heights, map(tick.format, envelope.heights))
    ax.grid(False)


RADAR_COLORS = style.LAUNCH, style.FLIGHT, style.INK, style.LANDING
RADAR_WIDTHS = 4.0, 2.6, 0.8, 1.6  # equal lines show below each other


@style.styled
def margin_radar(reports: MarginReport | Mapping[str, MarginReport]) -> Figure:
    """How much of each disturbance plans bear, as a share of the largest that is tried: plain, and re-aimed.

    Of several reports, by the names that the legend shall have, only the disturbances that two or more of them tell.
    """
    several = dict(reports) if isinstance(reports, Mapping) else {"": reports}
    told = Counter(m.names for report in several.values() for m in report.margins if m.reaim)
    names = [name for name, count in told.items() if count > 1 or len(several) == 1]
    if not names or len(several) > len(RADAR_COLORS):
        found = f"{len(several)} reports with {len(names)} disturbances that two of them tell"
        raise InputError(f"the radar shows up to {len(RADAR_COLORS)} reports and what two of them tell, got {found}")
    angles = 2 * np.pi * np.arange(len(names)) / len(names)
    fig = style.new_figure(style.PAGE_IN, 3.8)
    for ax, reaim in zip(fig.subplots(1, 2, subplot_kw={"projection": "polar"}), (False, True), strict=True):
        for (title, report), color, width in zip(several.items(), RADAR_COLORS, RADAR_WIDTHS, strict=False):
            shares = {m.names: 100 * m.share for m in report.margins if m.reaim == reaim}
            values = [shares.get(name, np.nan) for name in (*names, names[0])]
            how = dict(color=color, linewidth=width, marker="o", markersize=2 + width, label=title)
            ax.plot([*angles, angles[0]], values, **how)
        _radar_axes(ax, "re-aimed" if reaim else "plain", names, angles)
    if "" not in several:
        fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=len(several), frameon=False)
    return fig


def _radar_axes(ax: Axes, title: str, names: Sequence[str], angles: np.ndarray) -> None:
    ax.set(ylim=(0, 105), theta_offset=np.pi / 2, theta_direction=-1)
    ax.set_title(title, fontsize=8, pad=14)
    words = [name.replace("+", " +\n").replace("shove_", "shove_\n") for name in names]
    ax.set_xticks(angles, words, fontsize=6)
    for label, angle in zip(ax.get_xticklabels(), angles, strict=True):  # clear of the circle
        side = np.sin(angle)
        label.set_ha("center" if abs(side) < 0.1 else "left" if side > 0 else "right")
    ax.set_yticks([25, 50, 75, 100], ["25 %", "50 %", "75 %", "100 %"], fontsize=6)
    ax.set_rlabel_position(-180 / len(names))  # between the last and the first
    for label in ax.get_yticklabels():
        label.set(zorder=5, bbox=dict(facecolor="white", edgecolor="none", alpha=0.8, pad=0.5))


# simulations ----------------------------------------------------------------------------------------------------
@style.styled
def jump_strobe(result: SimulationResult | Tape, robot: Robot) -> Figure:
    """F-1: a simulated or planned jump in one picture, each phase in its colour, with the CoM's path.

    Heights are true; sideways the frames are evenly spaced, so that none hides another. A jump that goes more to the
    side than ahead is seen from the front.
    """
    height, travel = com_height(result), np.ptp(result.q[:, :2], axis=0)
    rows = _strip_rows(result, height)
    fig = style.new_figure(style.PAGE_IN, 2.6)
    ax = fig.subplots()
    places = STRIP_M * np.arange(len(rows))
    colors = [style.PHASE_COLORS[str(phase)] for phase in result.phase[rows]]
    view = "front" if travel[1] > travel[0] else "side"
    film_strip(ax, Silhouette(robot, view), result.q[rows], result.t[rows], colors, places, below=0.07)
    for text, color in zip(ax.texts, colors, strict=True):
        text.set_color(style.shade(color, 0.8))
    air = (result.phase == "flight") & (result.t >= result.t[rows[0]])
    draw_path(ax, np.interp(result.t[air], result.t[rows], places), height[air])  # linear in time between frames
    left, right = ax.get_xlim()
    draw_ground(ax, left, right)
    ax.set_xlim(left, right)
    style.legend_above(fig, style.phase_handles(*dict.fromkeys(map(str, result.phase))))
    style.bare(ax)
    return fig


def _strip_rows(result: SimulationResult | Tape, height: np.ndarray) -> np.ndarray:
    """Rows of the frames: start, crouch, lift-off, some of the flight, touchdown, deepest, end."""
    flight = np.flatnonzero(result.phase == "flight")
    if not len(flight):  # it never left the ground
        return np.linspace(0, len(result.t) - 1, 5).astype(int)
    off, on = int(flight[0]), int(flight[-1])
    rows = [0, int(np.argmin(height[:off])), off - 1] if off else []
    rows += [off + int(share * (on - off)) for share in FLIGHT_SHARES]
    if on + 1 < len(result.t):
        rows += [on + 1, on + 1 + int(np.argmin(height[on + 1 :])), len(result.t) - 1]
    return np.array(rows)


@style.styled
def momentum(result: SimulationResult, tape: Tape, robot: Robot) -> Figure:
    """F-12: CoM position and velocity, and L during the launch; dashed the plan, coloured the simulation.

    Out of the plane CoM position and velocity alone, in all three directions.
    """
    if turning.leaves_plane(tape):
        return turning.momentum(result, tape, AFTER_TOUCHDOWN_S)
    fig = style.new_figure(style.PAGE_IN, 3.4)
    axes = fig.subplot_mosaic([["x", "z", "L"], ["vx", "vz", "rho"]])
    e = tape.extra
    start = Silhouette(robot).com(tape.q[0])[0] - e["planar_com"][0, 0]  # the plan counts from the toe's first place
    curves = {
        "x": (result.com[:, 0], e["planar_com"][:, 0] + start, "CoM $x$ [m]"),
        "z": (result.com[:, 2], e["planar_com"][:, 1], "CoM $z$ [m]"),
        "vx": (result.com_velocity[:, 0], e["planar_com_velocity"][:, 0], "CoM $v_x$ [m/s]"),
        "vz": (result.com_velocity[:, 2], e["planar_com_velocity"][:, 1], "CoM $v_z$ [m/s]"),
        "L": (result.L, e["planar_L"], "$L$ [kg m$^2$/s], launch"),
        "rho": (result.rho, e["planar_rho"], "$\\rho$ [kg m$^2$]"),
    }
    seen = result.t <= tape.t[-1] + AFTER_TOUCHDOWN_S
    for name, (actual, planned, label) in curves.items():
        a, p, marks = seen, slice(None), [tape.takeoff_time]
        if name == "L":
            a, p, marks = seen & (result.phase == "launch"), tape.phase == "launch", []
        curve = (result.t[a], actual[a], result.phase[a])
        style.compare(axes[name], curve, (tape.t[p], planned[p]), label=label, marks=marks)
    for name in ("vx", "vz", "rho"):
        axes[name].set_xlabel("time [s]")
    style.panel_letters(axes[name] for name in curves)
    fig.align_ylabels()
    style.legend_above(fig, style.phase_handles(*style.PHASE_COLORS, reference="plan"))
    return fig
