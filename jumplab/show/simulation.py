"""The simulated jump in pictures: in one (Fig. 1), against the plan (Fig. 12), its landing, and many robots' jumps.

Rendered pictures (Figs. 3b and 11) are in :mod:`jumplab.plotting.render`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show.bodies import Silhouette, draw_ground, draw_robot, equal_scales
from jumplab.show.style import (
    COLUMN_IN,
    INK,
    LANDING,
    LAUNCH,
    LIMIT_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    REFERENCE_STYLE,
    VERMILION,
    bare,
    by_phase,
    legend_above,
    mark_time,
    new_figure,
    panel_letters,
    phase_handles,
    shade,
    styled,
    tint,
)
from jumplab.task import GRAVITY, JumpTask

if TYPE_CHECKING:  # pictures of a plan need no simulator
    from jumplab.sim import Metrics, SimulationResult

AFTER_TOUCHDOWN_S = 0.25  # our choice: how much of the landing is shown
STANDING_UP_S = 1.0  # our choice: how much is shown where the landing itself is the subject
SMOOTHING_S = 0.02  # our choice: longer than an impact's ringing, shorter than the landing's push of 0.2 s
FLIGHT_SHARES = (0.25, 0.5, 0.75)  # our choice: when frames of the flight are shown
STRIP_M = 0.72  # our choice: from frame to frame, just more than a robot with its arms stretched out


@styled
def jump_strobe(result: SimulationResult, robot: Robot) -> Figure:
    """F-1: the simulated jump in one picture, launch, flight and landing in their colours, with the CoM's path.

    Heights are true; sideways the frames are evenly spaced, so that none hides another. A jump where it happened is
    :func:`jumplab.show.experiments.scene_strobe`.
    """
    rows = _strip_rows(result)
    fig = new_figure(PAGE_IN, 2.6)
    ax = fig.subplots()
    body = Silhouette(robot)
    places = STRIP_M * np.arange(len(rows))
    for row, place in zip(rows, places, strict=True):
        color, com = PHASE_COLORS[str(result.phase[row])], body.com(result.q[row])
        draw_robot(ax, body, result.q[row], color, shift=place - com[0])
        ax.text(place, -0.07, f"{result.t[row]:.2f} s", ha="center", va="top", fontsize=7, color=shade(color, 0.8))
    equal_scales(ax)
    air = (result.phase == "flight") & (result.t >= result.t[rows[0]])
    path = np.interp(result.t[air], result.t[rows], places)  # linear in time between take-off and touchdown
    ax.plot(path, result.com[air, 2], color=INK, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=5)
    left, right = ax.get_xlim()
    draw_ground(ax, left, right)
    ax.set_xlim(left, right)
    legend_above(fig, phase_handles("launch", "flight", "landing"))
    bare(ax)
    return fig


def _strip_rows(result: SimulationResult) -> np.ndarray:
    """Rows of the frames: start, crouch, lift-off, some of the flight, touchdown, deepest, end."""
    flight = np.flatnonzero(result.phase == "flight")
    if not len(flight):  # it never left the ground
        return np.linspace(0, len(result.t) - 1, 5).astype(int)
    off, on = int(flight[0]), int(flight[-1])
    rows = [0, int(np.argmin(result.com[:off, 2])), off - 1] if off else []
    rows += [off + int(share * (on - off)) for share in FLIGHT_SHARES]
    if on + 1 < len(result.t):
        rows += [on + 1, on + 1 + int(np.argmin(result.com[on + 1 :, 2])), len(result.t) - 1]
    return np.array(rows)


def frame_rows(result: SimulationResult) -> np.ndarray:
    """Twelve rows of a log worth a picture, four per phase; of a jump without flight or landing, twelve evenly spaced.

    Launch: start, crouch, half-way up, lift-off; flight: evenly; landing: touchdown, deepest, half-way up, the end.
    """
    count, flight = len(result.t), np.flatnonzero(result.phase == "flight")
    if not len(flight) or flight[0] == 0 or flight[-1] + 1 == count:
        return np.linspace(0, count - 1, 12).astype(int)
    z, off, on = result.com[:, 2], int(flight[0]), int(flight[-1]) + 1
    crouch = int(np.argmin(z[:off]))
    deepest = on + int(np.argmin(z[on : on + round(AFTER_TOUCHDOWN_S / (result.t[1] - result.t[0]))]))
    launch = [0, crouch, _halfway(z, crouch, off - 1), off - 1]
    air = [off + (on - off) * share for share in (0.125, 0.375, 0.625, 0.875)]
    return np.array([*launch, *air, on, deepest, _halfway(z, deepest, count - 1), count - 1]).astype(int)


def _halfway(z: np.ndarray, start: int, end: int) -> int:
    """First row after ``start`` that is half of the way up to the height at ``end``; in a fall, half of the time."""
    if z[end] <= z[start]:
        return (start + end) // 2
    return start + int(np.argmax(z[start : end + 1] >= (z[start] + z[end]) / 2))


@styled
def momentum(result: SimulationResult, tape: Tape, robot: Robot) -> Figure:
    """F-12: CoM position and velocity, and L during the launch; dashed the plan, coloured the simulation."""
    fig = new_figure(PAGE_IN, 3.4)
    axes = fig.subplot_mosaic([["x", "z", "L"], ["vx", "vz", "rho"]])
    body = Silhouette(robot)
    seen = result.t <= tape.t[-1] + AFTER_TOUCHDOWN_S
    t, phase = result.t[seen], result.phase[seen]
    place = tape.extra["planar_com"] + [body.com(tape.q[0])[0] - tape.extra["planar_com"][0, 0], 0.0]
    curves = {
        "x": (result.com[:, 0], place[:, 0], "CoM $x$ [m]"),
        "z": (result.com[:, 2], place[:, 1], "CoM $z$ [m]"),
        "vx": (result.com_velocity[:, 0], tape.extra["planar_com_velocity"][:, 0], "CoM $v_x$ [m/s]"),
        "vz": (result.com_velocity[:, 2], tape.extra["planar_com_velocity"][:, 1], "CoM $v_z$ [m/s]"),
        "L": (result.L, tape.extra["planar_L"], "$L$ [kg m$^2$/s], launch"),
        "rho": (result.rho, tape.extra["planar_rho"], "$\\rho$ [kg m$^2$]"),
    }
    for name, (actual, planned, label) in curves.items():
        ax = axes[name]
        a, p = (phase == "launch", tape.phase == "launch") if name == "L" else (np.full(len(t), True), slice(None))
        by_phase(ax, t[a], actual[seen][a], phase[a])
        ax.plot(tape.t[p], planned[p], **REFERENCE_STYLE)
        ax.set_ylabel(label)
        mark_time(ax, [] if name == "L" else [tape.takeoff_time])
    for name in ("vx", "vz", "rho"):
        axes[name].set_xlabel("time [s]")
    panel_letters(axes[k] for k in ("x", "z", "vx", "vz", "L", "rho"))
    fig.align_ylabels()
    legend_above(fig, phase_handles("launch", "flight", "landing", reference="plan"))
    return fig


# Landing --------------------------------------------------------------------------------------------------------
@styled
def landing_loads(result: SimulationResult, tape: Tape, robot: Robot) -> Figure:
    """Trunk pitch, vertical ground force and share of the torque limits used, through the whole jump.

    Forces are means over the last :data:`SMOOTHING_S`, which keeps their impulse: the bare peak of an impact says more
    about the simulation's step than about the robot. Bars are such means too, the largest per phase, left or right; the
    tick beside a bar is the largest single step.
    """
    fig = new_figure(PAGE_IN, 2.5)
    pitch, force, bars = fig.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    seen = result.t <= tape.t[-1] + STANDING_UP_S
    t, phase = result.t[seen], result.phase[seen]
    by_phase(pitch, t, np.degrees(trunk_pitch(result.q))[seen], phase)
    pitch.plot(tape.t, np.degrees(trunk_pitch(tape.q)), **REFERENCE_STYLE)
    pitch.set(xlabel="time [s]", ylabel="trunk pitch [deg]")
    step = float(result.t[1] - result.t[0])
    by_phase(force, t, smooth(result.foot_wrench[:, :, 2].sum(axis=1), step)[seen] / 1000, phase)
    weight = robot.total_mass * GRAVITY / 1000
    force.plot(tape.t, smooth(tape.f[:, :, 2].sum(axis=1), step) / 1000, **REFERENCE_STYLE)
    force.axhline(weight, **LIMIT_STYLE)
    place = dict(xytext=(0, 2), textcoords="offset points", ha="right")
    force.annotate("weight", (t[-1], weight), fontsize=7, color="#666666", **place)
    force.set(xlabel="time [s]", ylabel="mean vertical force [kN]")
    _torque_shares(bars, result, robot)
    panel_letters((pitch, force, bars))
    legend_above(fig, phase_handles("launch", "flight", "landing", reference="plan", limit="weight, torque limit"))
    return fig


def _torque_shares(ax: Axes, result: SimulationResult, robot: Robot) -> None:
    """Bars: largest mean of |torque| / limit within a phase, the worse of left and right; ticks: largest step."""
    step = float(result.t[1] - result.t[0])
    window = round(SMOOTHING_S / step)
    names = [name.removeprefix("left_").removeprefix("right_") for name in result.joint_names]
    groups = list(dict.fromkeys(names))
    step_peak, mean_peak = np.zeros((2, len(PHASE_COLORS), len(groups)))
    for name, group, tau in zip(result.joint_names, names, result.tau.T, strict=True):
        share = np.abs(tau) / robot.actuators[name]["effort"]  # (N,)
        g = groups.index(group)
        for k, p in enumerate(PHASE_COLORS):
            part = share[result.phase == p]
            step_peak[k, g] = max(step_peak[k, g], part.max(initial=0.0))
            mean = smooth(part, step)[window - 1 :]  # from the first whole window of the phase on
            mean_peak[k, g] = max(mean_peak[k, g], mean.max(initial=0.0))
    for k, color in enumerate(PHASE_COLORS.values()):
        at = np.arange(len(groups)) + 0.26 * (k - 1)
        ax.barh(at, mean_peak[k], 0.24, color=color)
        ax.plot(step_peak[k], at, linestyle="none", marker="|", markersize=5, markeredgewidth=1.2, color=color)
    ax.axvline(1.0, **LIMIT_STYLE)
    ax.set_yticks(range(len(groups)), [g.replace("_", " ") for g in groups])
    ax.invert_yaxis()
    ax.set(xlabel="largest torque / limit", xlim=(0, 1.05))
    ax.grid(False, axis="y")


def smooth(values: np.ndarray, step_s: float) -> np.ndarray:
    """Mean (N,) over the last :data:`SMOOTHING_S` of samples ``step_s`` apart; at first over those that there are."""
    width = max(1, round(SMOOTHING_S / step_s))
    total = np.concatenate([np.zeros(width), np.cumsum(values)])
    return (total[width:] - total[:-width]) / np.minimum(np.arange(len(values)) + 1, width)


def trunk_pitch(q: np.ndarray) -> np.ndarray:
    """Pitch (N,) of the trunk [rad] from configurations (N, nq), continuous through full turns."""
    x, y, z, w = q[:, 3:7].T
    return np.unwrap(np.arctan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y)))


@styled
def trials(rows: Sequence[Metrics], task: JumpTask, *, nominal: Metrics | None = None,
           tolerance: tuple[float, float] = (0.05, 0.03)) -> Figure:  # fmt: skip
    """Travel of the feet against rise of the CoM for many robots: landed, fallen, the robot as planned, the target.

    Parameters
    ----------
    rows : one per robot; those that never left the ground or never came down are not drawn.
    nominal : of the robot as planned.
    tolerance : half-widths of the box around the target: distance, rise [m].
    """
    fig = new_figure(COLUMN_IN, 2.5)
    ax = fig.subplots()
    corner = task.distance_m - tolerance[0], task.height_m - tolerance[1]
    ax.add_patch(Rectangle(corner, 2 * tolerance[0], 2 * tolerance[1], facecolor=tint(INK, 0.06), edgecolor=INK,
                           linestyle=(0, (4, 2)), linewidth=0.8))  # fmt: skip
    ax.plot(task.distance_m, task.height_m, "+", color=INK, markersize=7, label="target")
    kinds = (
        ([m for m in rows if m.landed], "o", LANDING, "landed"),
        ([m for m in rows if not m.landed], "x", VERMILION, "fell"),
        ([nominal] if nominal else [], "D", LAUNCH, "as planned"),
    )
    for found, marker, color, label in kinds:
        places = np.array([(m.foot_distance_m, m.com_rise_m) for m in found if m.foot_distance_m is not None])
        if len(places):
            ax.plot(*places.T, linestyle="none", marker=marker, color=color, markersize=4.5, label=label)
    ax.set(xlabel="travel of the feet [m]", ylabel="rise of the CoM [m]")
    ax.margins(0.12)
    legend_above(fig, ax.get_legend_handles_labels()[0])
    return fig
