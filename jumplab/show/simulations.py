"""Pictures of one simulated jump: in one frame (Fig. 1), against its plan (Fig. 12), and how it lands."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show import style
from jumplab.show.bodies import Silhouette, draw_ground, draw_path, film_strip
from jumplab.show.style import PAGE_IN, PHASE_COLORS, compare, legend_above, new_figure, phase_handles, styled
from jumplab.task import GRAVITY

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.sim import SimulationResult

AFTER_TOUCHDOWN_S = 0.25  # how much of the landing is shown
STANDING_UP_S = 1.0  # how much is shown where the landing itself is the subject
SMOOTHING_S = 0.02  # longer than an impact's ringing, shorter than the landing's push of 0.2 s
FLIGHT_SHARES = (0.25, 0.5, 0.75)  # when frames of the flight are shown
STRIP_M = 0.72  # from frame to frame, just more than a robot with its arms stretched out


@styled
def jump_strobe(result: SimulationResult, robot: Robot) -> Figure:
    """F-1: the simulated jump in one picture, launch, flight and landing in their colours, with the CoM's path.

    Heights are true; sideways the frames are evenly spaced, so that none hides another.
    """
    rows = _strip_rows(result)
    fig = new_figure(PAGE_IN, 2.6)
    ax = fig.subplots()
    places = STRIP_M * np.arange(len(rows))
    colors = [PHASE_COLORS[str(phase)] for phase in result.phase[rows]]
    film_strip(ax, Silhouette(robot), result.q[rows], result.t[rows], colors, places, below=0.07)
    for text, color in zip(ax.texts, colors, strict=True):
        text.set_color(style.shade(color, 0.8))
    air = (result.phase == "flight") & (result.t >= result.t[rows[0]])
    draw_path(ax, np.interp(result.t[air], result.t[rows], places), result.com[air, 2])  # linear in time between frames
    left, right = ax.get_xlim()
    draw_ground(ax, left, right)
    ax.set_xlim(left, right)
    legend_above(fig, phase_handles(*PHASE_COLORS))
    style.bare(ax)
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


@styled
def momentum(result: SimulationResult, tape: Tape, robot: Robot) -> Figure:
    """F-12: CoM position and velocity, and L during the launch; dashed the plan, coloured the simulation."""
    fig = new_figure(PAGE_IN, 3.4)
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
        compare(axes[name], curve, (tape.t[p], planned[p]), label=label, marks=marks)
    for name in ("vx", "vz", "rho"):
        axes[name].set_xlabel("time [s]")
    style.panel_letters(axes[name] for name in curves)
    fig.align_ylabels()
    legend_above(fig, phase_handles(*PHASE_COLORS, reference="plan"))
    return fig


# landing --------------------------------------------------------------------------------------------------------
@styled
def landing_loads(result: SimulationResult, tape: Tape, robot: Robot) -> Figure:
    """Trunk pitch, vertical ground force and share of the torque limits used, through the whole jump.

    Forces are means over the last :data:`SMOOTHING_S`, which keeps their impulse: the bare peak of an impact says more
    about the simulation's step than about the robot. Bars are such means too, the largest per phase, left or right; the
    tick beside a bar is the largest single step.
    """
    fig = new_figure(PAGE_IN, 2.5)
    pitch, force, bars = fig.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    step, weight = float(result.t[1] - result.t[0]), robot.total_mass * GRAVITY / 1000
    seen = result.t <= tape.t[-1] + STANDING_UP_S
    angles = [np.degrees(trunk_pitch(q)) for q in (result.q, tape.q)]
    pushes = [smooth(f[:, :, 2].sum(axis=1), step) / 1000 for f in (result.foot_wrench, tape.f)]
    panels = ((pitch, angles, "trunk pitch [deg]"), (force, pushes, "mean vertical force [kN]"))
    for ax, (actual, planned), label in panels:
        compare(ax, (result.t[seen], actual[seen], result.phase[seen]), (tape.t, planned), label=label)
        ax.set_xlabel("time [s]")
    style.limits(force, weight)
    force.annotate("weight", (result.t[seen][-1], weight), xytext=(0, 2), ha="right", **style.NOTE_STYLE)
    _torque_shares(bars, result, robot)
    style.panel_letters((pitch, force, bars))
    legend_above(fig, phase_handles(*PHASE_COLORS, reference="plan", limit="weight, torque limit"))
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
    ax.axvline(1.0, **style.LIMIT_STYLE)
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
