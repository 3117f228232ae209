"""Stage 3 in pictures, from the tape: joints (Fig. 8), inertia and momentum (Fig. 9), snapshots (Fig. 10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.io.tape import Tape
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.show.bodies import Silhouette, draw_ground, film_strip, strobe
from jumplab.show.style import (
    FLIGHT,
    INK,
    LAUNCH,
    LIMIT_STYLE,
    PAGE_IN,
    REFERENCE_STYLE,
    bare,
    by_phase,
    legend_above,
    mark_time,
    new_figure,
    phase_handles,
    shade,
    styled,
)

FRAMES_LAUNCH, FRAMES_FLIGHT = 6, 5
PITCH_M = 0.62  # our choice: how far the frames of a launch are moved apart
EDGE_M = 0.05  # a platform begins this far behind the landing heel, as in the planner's limits


def heel_up_time(tape: Tape) -> float:
    """When the heel leaves the ground [s]."""
    return float(tape.extra["planar_toe_phase_start"])


# Fig. 8 ---------------------------------------------------------------------------------------------------------
@styled
def joint_trajectories(tape: Tape, robot: Robot, *, guess: tuple[np.ndarray, ...] | None = None) -> Figure:
    """F-8: one column per joint, angle above and velocity below, launch and flight in two colours, limits thin.

    Parameters
    ----------
    guess : time (n,), joint angles and rates (n, 4) in sagittal signs to draw dashed, such as stage 2's.
    """
    fig = new_figure(PAGE_IN, 3.1)
    axes = fig.subplots(2, 4, sharex=True)
    m, e = robot.sagittal, tape.extra
    for i, name in enumerate(SAGITTAL_JOINTS):
        for ax, key in zip(axes[:, i], ("planar_joints", "planar_joint_rates"), strict=True):
            by_phase(ax, tape.t, e[key][:, i], tape.phase)
            if guess is not None:
                ax.plot(guess[0], guess[1 if key == "planar_joints" else 2][:, i], **REFERENCE_STYLE)
            mark_time(ax, [heel_up_time(tape)])
        _limits(axes[0, i], m.lower[i], m.upper[i])
        _limits(axes[1, i], -m.speed[i], m.speed[i])
        axes[0, i].set_title(name)
        axes[1, i].set_xlabel("time [s]")
    axes[0, 0].set_ylabel("angle [rad]")
    axes[1, 0].set_ylabel("velocity [rad/s]")
    fig.align_ylabels(axes[:, 0])
    dashed = "stage 2, the guess" if guess is not None else None
    legend_above(fig, phase_handles("launch", "flight", limit="limit", reference=dashed))
    return fig


def _limits(ax, low, high):
    """Thin lines at the limits, and axes that show both."""
    room = 0.06 * (high - low)
    for bound in (low, high):
        ax.axhline(bound, **LIMIT_STYLE)
    ax.set_ylim(low - room, high + room)


# Fig. 9 ---------------------------------------------------------------------------------------------------------
@styled
def inertia_and_momentum(tape: Tape) -> Figure:
    """F-9: inertia, CoM velocity and angular momentum of the plan, and dashed what stage 1 asked for."""
    fig = new_figure(PAGE_IN, 3.3)
    axes = fig.subplots(2, 2, sharex=True)
    e = tape.extra
    curves = (
        (e["planar_rho"], "rho", "$\\rho$ [kg m$^2$]"),
        (e["planar_L"], "L", "$L$ [kg m$^2$/s]"),
        (e["planar_com_velocity"][:, 0], "com_velocity", "$v_x$ of the CoM [m/s]"),
        (e["planar_com_velocity"][:, 1], "com_velocity", "$v_z$ of the CoM [m/s]"),
    )
    takeoff = tape.takeoff_time
    known = "srmp_launch_t" in e
    for k, (ax, (y, key, label)) in enumerate(zip(axes.flat, curves, strict=True)):
        by_phase(ax, tape.t, y, tape.phase)
        if known:
            shift = takeoff - e["srmp_launch_t"][-1]
            for part, start in (("launch", shift), ("flight", takeoff)):
                r = e[f"srmp_{part}_{key}"]
                ax.plot(e[f"srmp_{part}_t"] + start, r if r.ndim == 1 else r[:, k - 2], **REFERENCE_STYLE)
        mark_time(ax, [heel_up_time(tape), takeoff])
        ax.set_ylabel(label)
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    fig.align_ylabels()
    legend_above(fig, phase_handles("launch", "flight", reference="stage 1, the reference" if known else None))
    return fig


# Fig. 10 --------------------------------------------------------------------------------------------------------
@styled
def snapshots(tape: Tape, robot: Robot) -> Figure:
    """F-10: the launch with its frames moved apart, then the flight as it is, with the CoM's path; one scale."""
    fig = new_figure(PAGE_IN, 2.55)
    ax = fig.subplots()
    body, takeoff = Silhouette(robot), tape.takeoff_index
    rows = np.linspace(0, takeoff - 1, FRAMES_LAUNCH).astype(int)
    film_strip(ax, body, tape.q[rows], tape.t[rows], LAUNCH, pitch_m=PITCH_M)
    first, width = -0.3, PITCH_M * FRAMES_LAUNCH
    draw_ground(ax, first, width - 0.25)
    rows = np.linspace(takeoff, len(tape.t) - 1, FRAMES_FLIGHT).astype(int)
    right = draw_flight(ax, tape, body, rows, shift=width + 0.45)
    ax.text(first, -0.22, "launch, frames moved apart", ha="left", va="top", color=LAUNCH)
    ax.text(right, -0.22, "flight, as it is", ha="right", va="top", color=shade(FLIGHT, 0.8))
    ax.set(xlim=(first - 0.05, right + 0.05))
    bare(ax)
    return fig


def draw_flight(ax: Axes, tape: Tape, body: Silhouette, rows: Sequence[int], *, shift: float = 0.0) -> float:
    """Frames ``rows`` of the flight in their true places, moved by ``shift`` [m], with the CoM's path and the ground.

    Returns
    -------
    The right end of the ground [m].
    """
    strobe(ax, body, tape.q[rows], [FLIGHT] * len(rows), shift=shift)
    # planar quantities count from the toe's first place, the tape from the middle of the soles
    origin = np.array([body.com(tape.q[0])[0] - tape.extra["planar_com"][0, 0] + shift, 0.0])
    com, toe = tape.extra["planar_com"] + origin, tape.extra["planar_toe"] + origin
    ax.plot(*com[tape.phase == "flight"].T, color=INK, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=4)
    ax.plot(*com[rows].T, linestyle="none", marker="o", markersize=3, color=INK, markerfacecolor="white", zorder=4)
    height = float(toe[-1, 1])
    heel = body.robot.sagittal.heel[0]
    low, high = sorted((toe[0, 0] + heel, toe[-1, 0] + heel))
    edge = toe[-1, 0] + heel - EDGE_M if abs(height) > 1e-3 else None
    draw_ground(ax, low - 0.2, high + 0.45, edge=edge, height=height)
    return high + 0.45
