"""A flip in pictures: what stage 1 shapes, and what the simulated body makes of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jumplab.plotting.simulation import AFTER_TOUCHDOWN_S
from jumplab.plotting.simulation import trunk_pitch as trunk_angle  # of a flip: whole turns count
from jumplab.plotting.style import (
    FLIGHT,
    PAGE_IN,
    REFERENCE_STYLE,
    by_phase,
    legend_above,
    mark_time,
    new_figure,
    panel_letters,
    phase_handles,
    styled,
)
from jumplab.robot import Robot
from jumplab.srmp import SrmpPlan
from jumplab.trajectory import Tape

if TYPE_CHECKING:  # pictures of a plan need no simulator
    from jumplab.simulation import SimulationResult


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
    rows = ((axes[0, 0], r"$\rho$ [kg m$^2$]", rho, planned[0], one.rho),
            (axes[0, 1], r"$\omega = L / \rho$ [rad/s]", momentum / rho, planned[1] / planned[0], one.L / one.rho),
            (axes[1, 0], r"$L$ [kg m$^2$/s]", momentum, planned[1], one.L))  # fmt: skip
    for ax, label, actual, plan, first in rows:
        by_phase(ax, t, actual, phase)
        ax.plot(tape.t, plan, **REFERENCE_STYLE)
        ax.plot(start + one.t, first, **thin)
        ax.set_ylabel(label)
    ax = axes[1, 1]
    by_phase(ax, t, np.degrees(trunk_angle(result.q))[seen], phase)
    ax.plot(tape.t, np.degrees(trunk_angle(tape.q)), **REFERENCE_STYLE)
    ax.set_ylabel("trunk [deg]")
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
