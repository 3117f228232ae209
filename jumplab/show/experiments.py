"""The three experiments (Figs. 13 and 14), a jump in its scene, and what makes robots fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show.bodies import Silhouette, draw_robot, equal_scales
from jumplab.show.render import ABOVE_M, BELOW_M, TITLE_IN, Camera, Renderer
from jumplab.show.simulation import frame_rows
from jumplab.show.style import (
    COLUMN_IN,
    GROUND,
    INK,
    LANDING,
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

if TYPE_CHECKING:  # pictures need no simulator
    from paper.measurement import Measurement

    from jumplab.sim import Scene, SimulationResult
    from jumplab.studies.basin import BasinReport
    from jumplab.studies.trials import Trial

APART_M = 1.2  # our choice: how far start and end are moved away from the jump
DITCH_SHOWN_M = 0.25  # our choice: a ditch that nobody falls into is cut off at this depth
GROUND_SHOWN_M = 0.04
LABEL_ROOM_M = 0.14  # our choice: for a frame's time above a head
LABEL_SIDES = {"launch": "right", "flight": "center", "landing": "left"}  # away from the neighbour's head
LEGEND_IN, TALLEST_IN = 0.3, 3.2
WIDE_FRAME_M = 1.5  # our choice: wide enough for a ditch of 0.8 m and its edges
WIDE_PIXELS_PER_M = 180  # our choice: 235 pixels per inch of a page-wide line, where a PNG has 200
FRAMES = (0, 1, 3, 5, 8, 11)  # of the twelve of frame_rows: start, crouch, lift-off, flight, touchdown, end
ROW_LABEL_IN = 0.25
BASIN_SINGLE_IN, BASIN_ROW_IN = 2.4, 1.55  # our choice: height of a single map, of each of several rows
PER_BIN = 10  # our choice: robots per bin of the map; fewer would make its intervals meaningless
MAX_BINS = 5
# feature, label, factor to the label's unit
FEATURES = (
    ("friction", "friction of the soles", 1.0),
    ("delay_s", "delay [ms]", 1e3),
    ("leg_motors", "leg motors, mean error [%]", 1e2),
    ("mass", "mass [%]", 1e2),
    ("com_x_m", "CoM shift forward [mm]", 1e3),
    ("com_y_m", "CoM shift to the left [mm]", 1e3),
)


# A jump in its scene ---------------------------------------------------------------------------------------------
@styled
def scene_strobe(result: SimulationResult, robot: Robot, scene: Scene) -> Figure:
    """A simulated jump where it happened: lift-off, mid-flight, touchdown and the path of the CoM.

    The start is moved back and the end forward by :data:`APART_M`; a fall is shown in its
    place.
    """
    frames = _strobe_rows(result)
    body, halo = Silhouette(robot), withStroke(linewidth=2, foreground="white")
    outlines = [[(part, np.add(o, [shift, 0.0])) for part, o in body.outlines(result.q[row])] for row, shift in frames]
    corners = np.vstack([o for frame in outlines for _, o in frame])
    (left, low), (right, high) = corners.min(axis=0) - 0.1, corners.max(axis=0)
    right += 0.1
    walls = any(b.top < 0 for b in scene.blocks)
    bottom = low - GROUND_SHOWN_M if low < -DITCH_SHOWN_M else -DITCH_SHOWN_M if walls else -GROUND_SHOWN_M
    top = high + LABEL_ROOM_M
    fig = new_figure(PAGE_IN, min(LEGEND_IN + PAGE_IN * (top - bottom) / (right - left), TALLEST_IN))
    ax = fig.subplots()
    for k, ((row, shift), frame) in enumerate(zip(frames, outlines, strict=True)):
        phase = str(result.phase[row])
        color = PHASE_COLORS[phase]
        draw_robot(ax, body, result.q[row], color, shift=shift, zorder=2 + k / len(frames))
        trunk = np.vstack([o for part, o in frame if part == "trunk"])
        x, z = trunk[np.argmax(trunk[:, 1])]
        ax.text(x, z + 0.02, f"{result.t[row]:.2f} s", ha=LABEL_SIDES[phase] if shift == 0 else "center", va="bottom",
                fontsize=7, color=shade(color, 0.8), zorder=6, path_effects=[halo])  # fmt: skip
    flight = result.phase == "flight"
    ax.plot(result.com[flight, 0], result.com[flight, 2], color=INK, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=5)
    draw_scene(ax, scene, left, right, bottom)
    equal_scales(ax)
    ax.set(xlim=(left, right), ylim=(bottom, top))
    legend_above(fig, phase_handles("launch", "flight", "landing"))
    bare(ax)
    return fig


def _strobe_rows(result: SimulationResult) -> list[tuple[int, float]]:
    """(row, shift) of the frames: start, lift-off, middle of the flight, touchdown, end."""
    flight = np.flatnonzero(result.phase == "flight")
    last = len(result.t) - 1
    if not len(flight):  # it never left the ground
        return [(0, -APART_M), (last, 0.0)]
    off, on = int(flight[0]), int(flight[-1])
    rows = [(0, -APART_M), (max(off - 1, 0), 0.0), ((off + on) // 2, 0.0)]
    if on < last:
        rows += [(on + 1, 0.0), (last, APART_M if result.landed else 0.0)]
    return rows


def draw_scene(ax: Axes, scene: Scene, left: float, right: float, bottom: float) -> None:
    """Cross-section of the ground from ``left`` to ``right``, cut off at ``bottom`` [m]."""
    for block in sorted(scene.blocks, key=lambda b: b.top):
        start, end = max(left, block.x_from), min(right, block.x_to)
        if start >= end or block.top <= bottom:
            continue
        ax.add_patch(Rectangle((start, bottom), end - start, block.top - bottom, facecolor=tint(GROUND, 0.35),
                               edgecolor="none", zorder=1))  # fmt: skip
        ax.plot([start, end], [block.top] * 2, color=GROUND, linewidth=0.8, zorder=1.5)
        for x in (block.x_from, block.x_to):
            if left < x < right:
                below = max((b.top for b in scene.blocks if b is not block and b.x_from <= x <= b.x_to), default=bottom)
                ax.plot([x, x], [max(below, bottom), block.top], color=GROUND, linewidth=0.8, zorder=1.5)


# Fig. 13 ---------------------------------------------------------------------------------------------------------
@styled
def experiment_frames(runs: Sequence[tuple[str, SimulationResult, Scene]], robot: Robot) -> Figure:
    """F-13: one line of rendered frames per experiment, (name, jump, scene) each.

    Frames: start, crouch, lift-off, flight, touchdown, end. The camera follows the CoM; the stripes on the ground are
    0.25 m wide.
    """
    width = (PAGE_IN - ROW_LABEL_IN) / len(FRAMES)
    cameras = [_camera(result, scene) for _, result, scene in runs]
    heights = [width * c.size[1] / c.size[0] + TITLE_IN for c in cameras]
    fig = new_figure(PAGE_IN, sum(heights))
    axes = fig.subplots(len(runs), len(FRAMES), squeeze=False, height_ratios=heights)
    for (name, result, scene), line, camera in zip(runs, axes, cameras, strict=True):
        with Renderer(robot, scene=scene) as studio:
            for ax, row in zip(line, frame_rows(result)[list(FRAMES)], strict=True):
                phase = str(result.phase[row])
                shot = replace(camera, x=float(result.com[row, 0]))
                ax.imshow(studio.picture(result.q[row], shot, PHASE_COLORS[phase]))
                bare(ax)
                ax.set_title(f"{phase}, {result.t[row]:.2f} s", loc="center", fontsize=7,
                             color=shade(PHASE_COLORS[phase], 0.8))  # fmt: skip
        line[0].text(-0.04, 0.5, name, transform=line[0].transAxes, rotation=90, ha="right", va="center", fontsize=8)
    return fig


def _camera(result: SimulationResult, scene: Scene) -> Camera:
    rows = frame_rows(result)[list(FRAMES)]
    floor = 0.0 if result.landed else min(0.0, scene.top_at(float(result.com[-1, 0])))
    below = DITCH_SHOWN_M if floor == 0 and any(b.top < 0 for b in scene.blocks) else BELOW_M
    top = float(result.q[rows, 2].max()) + ABOVE_M
    return Camera(width=WIDE_FRAME_M, bottom=floor - below, top=top, pixels_per_m=WIDE_PIXELS_PER_M)


# Fig. 14 ---------------------------------------------------------------------------------------------------------
@styled
def measured_jump(measured: Measurement, tape: Tape, robot: Robot) -> Figure:
    """F-14: CoM and L in the launch, pitch inertia in launch and flight; coloured the sensors, dashed the plan."""
    fig = new_figure(PAGE_IN, 1.9)
    axes = fig.subplots(1, 4)
    place = tape.extra["planar_com"] + [Silhouette(robot).com(tape.q[0])[0] - tape.extra["planar_com"][0, 0], 0.0]
    curves = (
        (measured.com[:, 0], place[:, 0], "CoM $x$ [m], launch"),
        (measured.com[:, 1], place[:, 1], "CoM $z$ [m], launch"),
        (measured.L, tape.extra["planar_L"], "$L$ [kg m$^2$/s], launch"),
        (measured.rho, tape.extra["planar_rho"], "$\\rho$ [kg m$^2$]"),
    )
    for ax, (actual, planned, label) in zip(axes, curves, strict=True):
        both = label.startswith("$\\rho")
        seen = np.full(len(measured.t), True) if both else measured.phase == "launch"
        part = np.full(len(tape.t), True) if both else tape.phase == "launch"
        by_phase(ax, measured.t[seen], actual[seen], measured.phase[seen], linewidth=1.0)
        ax.plot(tape.t[part], planned[part], **REFERENCE_STYLE)
        mark_time(ax, [tape.takeoff_time] if both else [])
        ax.set(xlabel="time [s]", ylabel=label)
    panel_letters(axes)
    legend_above(fig, phase_handles("launch", "flight", reference="plan"))
    return fig


# Many robots -----------------------------------------------------------------------------------------------------
@styled
def trial_map(trials: Sequence[Trial]) -> Figure:
    """What makes robots fall: each one landed (above) or fallen (below), over six numbers of its draw.

    Bars are success rates of equally many robots each, with Wilson's 95 % interval; one bar if there are few robots.
    """
    fig = new_figure(PAGE_IN, 3.3)
    axes = fig.subplots(2, 3, sharey=True)
    landed = np.array([t.landed for t in trials], bool)
    for ax, (name, label, factor) in zip(axes.flat, FEATURES, strict=True):
        values = factor * np.array([t.features[name] for t in trials])
        _rates(ax, values, landed)
        for mask, height, marker, color in ((landed, 1.2, "o", LANDING), (~landed, -0.2, "x", VERMILION)):
            ax.plot(values[mask], np.full(mask.sum(), height), linestyle="none", marker=marker, color=color,
                    markersize=3.0, markeredgewidth=0.8, alpha=0.7)  # fmt: skip
        ax.margins(x=0.04)
        ax.set(xlabel=label, ylim=(-0.3, 1.3), yticks=[-0.2, 0, 0.5, 1, 1.2],
               yticklabels=["fell", "0 %", "50 %", "100 %", "landed"])  # fmt: skip
    panel_letters(axes.flat)
    return fig


def _rates(ax: Axes, values: np.ndarray, landed: np.ndarray) -> None:
    """Success rate with its interval over equally filled bins."""
    from jumplab.studies.trials import wilson

    bins = int(np.clip(len(values) // PER_BIN, 1, MAX_BINS))
    for part in np.array_split(np.argsort(values, kind="stable"), bins):
        if len(part):
            low, high = wilson(int(landed[part].sum()), len(part))
            start, end = values[part].min(), values[part].max()
            ax.fill_between([start, end], low, high, color=tint(INK, 0.15), linewidth=0, zorder=1)
            ax.plot([start, end], [landed[part].mean()] * 2, color=INK, linewidth=1.2, zorder=2)


# Wrong states in flight ------------------------------------------------------------------------------------------
@styled
def basin_map(basin: BasinReport) -> Figure:
    """The landing basin: which wrong states at the apex land (dots) or fall (crosses).

    Across: error of the horizontal speed, up: error of the pitch. One panel for each height (columns) and friction
    (rows) of the grid; its title counts.
    """
    heights, frictions = sorted(set(basin.grid.height_m)), sorted(set(basin.grid.friction))
    shape = len(frictions), len(heights)
    width, height = (COLUMN_IN, BASIN_SINGLE_IN) if shape == (1, 1) else (PAGE_IN, BASIN_ROW_IN * shape[0])
    fig = new_figure(width, height)
    axes = fig.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    for line, friction in zip(axes, frictions, strict=True):
        for ax, rise in zip(line, heights, strict=True):
            states = [t for t in basin.trials if (t.features["height_m"], t.features["friction"]) == (rise, friction)]
            _basin_panel(ax, states)
            ax.set_title(f"{_height_text(rise)}, friction {friction:g}: {sum(t.landed for t in states)}/{len(states)}")
    for ax in axes[-1]:
        ax.set(xlabel="horizontal speed [%]", xticks=[100 * (x - 1) for x in sorted(set(basin.grid.speed_factor))])
    for ax in axes[:, 0]:
        ax.set(ylabel="pitch [deg]", yticks=sorted(set(basin.grid.pitch_deg)))
    marks = ((LANDING, "o", "lands"), (VERMILION, "x", "falls"))
    legend_above(fig, [Line2D([], [], color=c, marker=m, linestyle="none", label=text) for c, m, text in marks])
    return fig


def _height_text(rise_m: float) -> str:
    """How far the CoM is off its planned height, in words."""
    return f"{abs(rise_m):g} m {'higher' if rise_m > 0 else 'lower'}" if rise_m else "planned height"


def _basin_panel(ax: Axes, states: Sequence[Trial]) -> None:
    """States of one height and friction; a ring around the planned one."""
    for landed, marker, color in ((True, "o", LANDING), (False, "x", VERMILION)):
        found = [t.features for t in states if t.landed == landed]
        x, y = [100 * (f["speed_factor"] - 1) for f in found], [f["pitch_deg"] for f in found]
        ax.plot(x, y, linestyle="none", marker=marker, color=color, markersize=5, markeredgewidth=1.2)
    ax.plot(0, 0, marker="o", markersize=9, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=0.7)
    ax.margins(0.15)
