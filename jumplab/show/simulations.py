"""Pictures of one simulated jump: in one frame (Fig. 1), and against its plan (Fig. 12)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show import style
from jumplab.show.bodies import Silhouette, draw_ground, draw_path, film_strip
from jumplab.show.style import PAGE_IN, PHASE_COLORS, compare, legend_above, new_figure, phase_handles, styled

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.sim import SimulationResult

AFTER_TOUCHDOWN_S = 0.25  # how much of the landing is shown
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
