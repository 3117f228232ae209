"""One-off figures of simulations: the experiments (Figs. 13, 14), landing, robots that fall, wrong states, chains."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show.bodies import ABOVE_M, Silhouette, draw_path, strobe
from jumplab.show.style import (
    COLUMN_IN,
    FLIGHT,
    GROUND,
    INK,
    LANDING,
    LAUNCH,
    LIMIT_STYLE,
    NOTE_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    PURPLE,
    REFERENCE_STYLE,
    VERMILION,
    bare,
    by_phase,
    compare,
    legend_above,
    limits,
    new_figure,
    panel_letters,
    phase_handles,
    shade,
    styled,
    tint,
)
from jumplab.studies.trials import wilson
from jumplab.task import GRAVITY
from paper.render import BELOW_M, TITLE_IN, Camera, Renderer, draw_frames, frame_rows

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.sim import Metrics, Scene, SimulationResult
    from jumplab.studies.chain import ChainResult
    from jumplab.studies.trials import Trial
    from jumplab.task import JumpTask
    from paper.measurement import Measurement

WITHIN_M = (0.05, 0.03)  # of distance and rise
AROUND_M, GROUND_M = 0.45, 0.05  # what is shown of the ground beyond the soles of a chain, and below it
WAITING = 0.55  # strength of a robot between jumps
LEGEND_IN, CHAIN_TALLEST_IN = 0.3, 4.2
APART_M = 1.2  # how far start and end are moved away from the jump
DITCH_SHOWN_M = 0.25  # a ditch that nobody falls into is cut off at this depth
GROUND_SHOWN_M = 0.04
LABEL_ROOM_M = 0.14  # for a frame's time above a head
LABEL_SIDES = {"launch": "right", "flight": "center", "landing": "left"}  # away from the neighbour's head
TALLEST_IN = 3.2  # of a jump in its scene
WIDE_FRAME_M = 1.5  # wide enough for a ditch of 0.8 m and its edges
WIDE_PIXELS_PER_M = 180  # 235 pixels per inch of a page-wide line, where a PNG has 200
FRAMES = (0, 1, 3, 5, 8, 11)  # of the twelve of frame_rows: start, crouch, lift-off, flight, touchdown, end
ROW_LABEL_IN = 0.25
BASIN_SINGLE_IN, BASIN_ROW_IN = 2.4, 1.55  # height of a single map, of each of several rows
PER_BIN = 10  # robots per bin of the map; fewer would make its intervals meaningless
MAX_BINS = 5
TOLERANCE_M = 0.03  # what a jump of a chain may miss by
STANDING_UP_S = 1.0  # how much of a landing is shown
SMOOTHING_S = 0.02  # longer than an impact's ringing, shorter than the landing's push of 0.2 s
CORRECTION = 0.5  # strength of what is planned on the ground
PALE = 0.4  # strength of a frame that lies behind others
BAR = 0.62  # height of a bar of the timeline
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
    """A simulated jump where it happened: lift-off, mid-flight (pale), touchdown and the path of the CoM.

    The start is moved back and the end forward by :data:`APART_M`; a fall is shown in its
    place.
    """
    rows, shifts = zip(*_strobe_rows(result), strict=True)
    body, halo, frames = Silhouette(robot), withStroke(linewidth=2, foreground="white"), result.q[list(rows)]
    outlines = [
        [(part, o + np.array([dx, 0.0])) for part, o in body.outlines(q)] for q, dx in zip(frames, shifts, strict=True)
    ]
    corners = np.vstack([o for frame in outlines for _, o in frame])
    (left, low), (right, high) = corners.min(axis=0) - 0.1, corners.max(axis=0)
    right += 0.1
    walls = any(b.top < 0 for b in scene.blocks)
    bottom = low - GROUND_SHOWN_M if low < -DITCH_SHOWN_M else -DITCH_SHOWN_M if walls else -GROUND_SHOWN_M
    top = high + LABEL_ROOM_M
    fig = new_figure(PAGE_IN, min(LEGEND_IN + PAGE_IN * (top - bottom) / (right - left), TALLEST_IN))
    ax = fig.subplots()
    phases = [str(result.phase[row]) for row in rows]
    order = np.argsort([phase != "flight" for phase in phases], kind="stable")  # the flight behind the others, pale
    strobe(
        ax, body, frames[order], [PHASE_COLORS[phases[k]] for k in order], shifts=np.array(shifts)[order],
        strengths=[PALE if phases[k] == "flight" else 1.0 for k in order],
    )  # fmt: skip
    trunks = [np.vstack([o for part, o in frame if part == "trunk"])[:, 0] for frame in outlines]
    for row, shift, phase, frame in zip(rows, shifts, phases, outlines, strict=True):
        trunk = np.vstack([o for part, o in frame if part == "trunk"])
        x, z = trunk[np.argmax(trunk[:, 1])]
        behind = any(trunks[k].min() < trunk[:, 0].max() for k, name in enumerate(phases) if name == "landing")
        if phase == "launch" and shift == 0 and behind:  # its outline shows through the robot that lands before it
            edge = dict(facecolor="none", edgecolor=shade(LAUNCH, 0.55), linewidth=0.7, zorder=5)
            for _, outline in frame:
                ax.add_patch(Polygon(outline, closed=True, **edge))
        look = dict(fontsize=7, color=shade(PHASE_COLORS[phase], 0.8), zorder=6, path_effects=[halo])
        side = LABEL_SIDES[phase] if shift == 0 else "center"
        ax.text(x, z + 0.02, f"{result.t[row]:.2f} s", ha=side, va="bottom", **look)
    flight = result.phase == "flight"
    draw_path(ax, result.com[flight, 0], result.com[flight, 2])
    draw_scene(ax, scene, left, right, bottom)
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
        rows = frame_rows(result)[list(FRAMES)]
        draw_frames(line, Renderer(robot, scene=scene), result, rows, camera, fontsize=7)
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
        curve, plan = (measured.t[seen], actual[seen], measured.phase[seen]), (tape.t[part], planned[part])
        compare(ax, curve, plan, label=label, marks=[tape.takeoff_time] if both else [], linewidth=1.0)
        ax.set_xlabel("time [s]")
    panel_letters(axes)
    legend_above(fig, phase_handles("launch", "flight", reference="plan"))
    return fig


# Landing -------------------------------------------------------------------------------------------------------
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
    limits(force, weight)
    force.annotate("weight", (result.t[seen][-1], weight), xytext=(0, 2), ha="right", **NOTE_STYLE)
    _torque_shares(bars, result, robot)
    panel_letters((pitch, force, bars))
    legend_above(fig, phase_handles(*PHASE_COLORS, reference="plan", limit="weight, torque limit"))
    return fig


# Two engines ---------------------------------------------------------------------------------------------------
@styled
def engines_compared(runs: Mapping[str, SimulationResult], tape: Tape, robot: Robot) -> Figure:
    """The same jump by several engines, and the plan: height of the CoM, trunk pitch, force of the ground; below, the
    deviation of each engine from the plan, before the impact.
    """
    fig = new_figure(PAGE_IN, 3.6)
    axes = fig.subplots(2, 3, sharex="col", height_ratios=(1.4, 1))
    labels = ("height of the CoM [m]", "trunk pitch [deg]", "mean vertical force [kN]")
    away = ("less the plan [mm]", "less the plan [deg]", "less the plan [kN]")
    force = smooth(tape.f[:, :, 2].sum(axis=1), float(tape.t[1] - tape.t[0])) / 1000
    planned = tape.extra["com"][:, 2], np.degrees(trunk_pitch(tape.q)), force
    for (name, run), color, style in zip(runs.items(), (LAUNCH, VERMILION, PURPLE), ("-", "--", "-."), strict=False):
        seen, step = run.t <= tape.t[-1] + STANDING_UP_S, float(run.t[1] - run.t[0])
        force = smooth(run.foot_wrench[:, :, 2].sum(axis=1), step) / 1000
        curves = run.com[:, 2], np.degrees(trunk_pitch(run.q)), force
        # before the impact, and from where the first mean is whole: an engine has no force in its first step
        with_plan = (run.t > 2 * SMOOTHING_S) & (run.t < tape.t[-1] - SMOOTHING_S)
        for column, y, plan, size in zip(axes.T, curves, planned, (1e3, 1.0, 1.0), strict=True):
            column[0].plot(run.t[seen], y[seen], style, color=color, label=name)
            gap = y[with_plan] - np.interp(run.t[with_plan], tape.t, plan)
            column[1].plot(run.t[with_plan], size * gap, style, color=color)
    for ax, y in zip(axes[0], planned, strict=True):
        ax.plot(tape.t, y, ":", color=INK, linewidth=1.0, label="plan")
    limits(axes[0, 2], robot.total_mass * GRAVITY / 1000)
    for column, label, below in zip(axes.T, labels, away, strict=True):
        column[0].set_ylabel(label)
        column[1].set(xlabel="time [s]", ylabel=below)
        limits(column[1], 0.0)
    panel_letters(axes[0])
    fig.align_ylabels()
    legend_above(fig, axes[0, 0].get_legend_handles_labels()[0])
    return fig


@styled
def soft_ground(runs: Mapping[float, SimulationResult], tape: Tape, task: JumpTask) -> Figure:
    """Travel of the feet and pitch of the trunk over how long a penetration takes to fade; open marks fell."""
    fig = new_figure(PAGE_IN, 2.2)
    travel, pitch = fig.subplots(1, 2)
    planned = task.distance_m, np.degrees(trunk_pitch(tape.q)[-1])
    for time_s, run in runs.items():
        k, look = run.metrics, dict(marker="o", color=LAUNCH, fillstyle="full" if run.landed else "none")
        for ax, y in ((travel, k.foot_distance_m), (pitch, k.touchdown_trunk_pitch_rad)):
            if y is not None:
                ax.plot(1000 * time_s, y if ax is travel else np.degrees(y), **look)
    for ax, y, label in zip((travel, pitch), planned, ("travel of the feet [m]", "trunk pitch [deg]"), strict=True):
        ax.axhline(y, **REFERENCE_STYLE)
        ax.set(xscale="log", xlabel="a penetration fades in [ms]", ylabel=label)
        ax.xaxis.set_major_formatter("{x:g}")
    panel_letters((travel, pitch))
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
    """Pitch (N,) of the trunk in its own heading [rad] from configurations (N, nq), continuous through full turns."""
    x, y, z, w = q[:, 3:7].T
    return np.unwrap(np.arctan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y)))


# Many robots -----------------------------------------------------------------------------------------------------
@styled
def trial_map(trials: Sequence[Trial]) -> Figure:
    """Robots over six numbers of their draw: landed (above) or fallen (below), with success rates of equally many
    robots each and Wilson's 95 % interval; where all of them landed, how far they went.
    """
    fig = new_figure(PAGE_IN, 3.3)
    axes = fig.subplots(2, 3, sharey=True)
    landed = np.array([t.landed for t in trials], bool)
    ends = [getattr(t, "metrics", t) for t in trials] if landed.all() else []  # stored ones are their own metrics
    travel = [end.foot_distance_m for end in ends if end]
    for ax, (name, label, factor) in zip(axes.flat, FEATURES, strict=True):
        values = factor * np.array([t.features[name] for t in trials])
        if len(travel) == len(trials) > 2:
            _travels(ax, values, np.array(travel))
        else:
            _landings(ax, values, landed)
        ax.margins(x=0.04)
        ax.set_xlabel(label)
    if len(travel):
        for ax in axes[:, 0]:
            ax.set_ylabel("travel [m]")
    panel_letters(axes.flat)
    return fig


def _travels(ax: Axes, values: np.ndarray, travel: np.ndarray) -> None:
    """Travel [m] over a number, with the line of least squares and the correlation."""
    ax.plot(values, travel, "o", color=LANDING, markersize=2.5, alpha=0.6, markeredgewidth=0)
    ends = np.array([values.min(), values.max()])
    ax.plot(ends, np.polyval(np.polyfit(values, travel, 1), ends), color=INK, linewidth=1.2)
    ax.set_title(f"r = {np.corrcoef(values, travel)[0, 1]:.2f}")


def _landings(ax: Axes, values: np.ndarray, landed: np.ndarray) -> None:
    _rates(ax, values, landed)
    for mask, height, marker, color in ((landed, 1.2, "o", LANDING), (~landed, -0.2, "x", VERMILION)):
        look = dict(color=color, markersize=3.0, markeredgewidth=0.8, alpha=0.7)
        ax.plot(values[mask], np.full(mask.sum(), height), marker, **look)
    ax.set_ylim(-0.3, 1.3)
    ax.set_yticks([-0.2, 0, 0.5, 1, 1.2], ["fell", "0 %", "50 %", "100 %", "landed"])


def _rates(ax: Axes, values: np.ndarray, landed: np.ndarray) -> None:
    """Success rate with its interval over equally filled bins."""
    bins = int(np.clip(len(values) // PER_BIN, 1, MAX_BINS))
    for part in np.array_split(np.argsort(values, kind="stable"), bins):
        if len(part):
            low, high = wilson(int(landed[part].sum()), len(part))
            start, end = values[part].min(), values[part].max()
            ax.fill_between([start, end], low, high, color=tint(INK, 0.15), linewidth=0, zorder=1)
            ax.plot([start, end], [landed[part].mean()] * 2, color=INK, linewidth=1.2, zorder=2)


# Wrong states in flight ------------------------------------------------------------------------------------------
@styled
def basin_map(states: Sequence[Trial]) -> Figure:
    """The landing basin: which wrong states at the apex land (dots) or fall (crosses).

    Across: error of the horizontal speed, up: error of the pitch. One panel for each height (columns) and friction
    (rows) that was tried; its title counts.
    """
    tried = {name: sorted({t.features[name] for t in states}) for name in states[0].features}
    heights, frictions = tried["height_m"], tried["friction"]
    shape = len(frictions), len(heights)
    width, height = (COLUMN_IN, BASIN_SINGLE_IN) if shape == (1, 1) else (PAGE_IN, BASIN_ROW_IN * shape[0])
    fig = new_figure(width, height)
    axes = fig.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    for line, friction in zip(axes, frictions, strict=True):
        for ax, rise in zip(line, heights, strict=True):
            here = [t for t in states if (t.features["height_m"], t.features["friction"]) == (rise, friction)]
            _basin_panel(ax, here)
            ax.set_title(f"{_height_text(rise)}, friction {friction:g}: {sum(t.landed for t in here)}/{len(here)}")
    for ax in axes[-1]:
        ax.set(xlabel="horizontal speed [%]", xticks=[100 * (x - 1) for x in tried["speed_factor"]])
    for ax in axes[:, 0]:
        ax.set(ylabel="pitch [deg]", yticks=tried["pitch_deg"])
    marks = ((LANDING, "o", "lands"), (VERMILION, "x", "falls"))
    legend_above(fig, [Line2D([], [], color=c, marker=m, linestyle="none", label=text) for c, m, text in marks])
    return fig


def _height_text(rise_m: float) -> str:
    """Deviation of the CoM from its planned height, in words."""
    return f"{abs(rise_m):g} m {'higher' if rise_m > 0 else 'lower'}" if rise_m else "planned height"


def _basin_panel(ax: Axes, states: Sequence[Trial]) -> None:
    """States of one height and friction; a ring around the planned one."""
    for landed, marker, color in ((True, "o", LANDING), (False, "x", VERMILION)):
        found = [t.features for t in states if t.landed == landed]
        x, y = [100 * (f["speed_factor"] - 1) for f in found], [f["pitch_deg"] for f in found]
        ax.plot(x, y, linestyle="none", marker=marker, color=color, markersize=5, markeredgewidth=1.2)
    ax.plot(0, 0, marker="o", markersize=9, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=0.7)
    ax.margins(0.15)


# Chains ----------------------------------------------------------------------------------------------------------
@styled
def chain_path(result: ChainResult) -> Figure:
    """Path of the CoM through the chain, by phase; dashed each jump's plan, from where the toes stood."""
    fig = new_figure(PAGE_IN, 2.4)
    ax = fig.subplots()
    foot = result.robot.foot
    zero = foot.toe - float(foot.center[0])
    by_phase(ax, result.com[:, 0], result.com[:, 2], result.phase)
    for jump, place in zip(result.jumps, result.places_m, strict=False):
        if jump.ahead is not None and jump.ahead.plan is not None:
            com = jump.ahead.plan.tape.extra["planar_com"] + [zero + place[0], place[2]]
            com[:, 0] -= jump.ahead.plan.tape.extra["planar_toe"][0, 0]
            ax.plot(*com.T, **REFERENCE_STYLE)
    left, right = span(result)
    low = float(result.com[:, 2].min()) - 0.1
    draw_scene(ax, result.scene, left, right, min(0.0, low) - 0.05)
    draw_goals(ax, result)
    ax.set(xlabel="$x$ [m]", ylabel="CoM $z$ [m]", xlim=(left, right))
    legend_above(fig, phase_handles("launch", "flight", "landing", reference="plan"))
    return fig


@styled
def chain_errors(result: ChainResult, trials: Sequence[dict] = ()) -> Figure:
    """Distance error of each jump, and planning time against air time; grey the perturbed robots."""
    fig = new_figure(PAGE_IN, 2.3)
    error, clock = fig.subplots(1, 2)
    number = 1 + np.arange(len(result.jumps))
    for trial in trials:
        grey = dict(color=tint(INK, 0.45), linewidth=0.7, marker=".", markersize=3)
        error.plot(1 + np.arange(len(trial["errors_m"])), 1000 * np.array(trial["errors_m"]), **grey)
        clock.plot(
            [1 + p["jump"] for p in trial["plans"]], [p["solve_s"] for p in trial["plans"]], **grey | {"linestyle": ""}
        )
    error.plot(number, 1000 * result.errors_m, color=shade(PHASE_COLORS["landing"], 0.9), marker="o", markersize=4)
    limits(error, -1000 * TOLERANCE_M, 1000 * TOLERANCE_M)
    error.set(xlabel="jump", ylabel="distance error [mm]")
    air = np.array([np.nan if j.air_s is None else j.air_s for j in result.jumps])
    clock.plot(number, air, color=FLIGHT, marker="o", markersize=4, label="in the air")
    for in_air, face, label in ((True, PURPLE, "planned in the air"), (False, "white", "planned standing")):
        known = [(1 + p.number, p.solve_s) for j in result.jumps for p in j.plans if p.air == in_air]
        clock.plot(*np.reshape(known, (-1, 2)).T, "o", color=PURPLE, markersize=4, markerfacecolor=face, label=label)
    clock.set(xlabel="jump", ylabel="time [s]", ylim=(0.0, None))
    for ax in (error, clock):
        ax.set_xticks(number)
    panel_letters((error, clock))
    handles, _ = clock.get_legend_handles_labels()
    legend_above(fig, [*handles, Line2D([], [], **LIMIT_STYLE, label=f"{100 * TOLERANCE_M:g} cm")])
    return fig


@styled
def chain_timeline(result: ChainResult) -> Figure:
    """Motion of the robot above, making of its plans below; a tick where it was ready for the plan."""
    fig = new_figure(PAGE_IN, 1.7)
    ax = fig.subplots()
    starts = [0, *(np.flatnonzero(result.phase[1:] != result.phase[:-1]) + 1), len(result.phase)]
    for first, after in itertools.pairwise(starts):
        width = result.t[after - 1] - result.t[first]
        ax.barh(1, width, BAR, left=result.t[first], color=PHASE_COLORS[str(result.phase[first])])
    colors = {"planned in the air": PURPLE, "standing": tint(PURPLE, CORRECTION), "late": VERMILION}
    for jump in result.jumps:
        for plan in jump.plans:
            late = jump.number and not plan.in_time
            kind = "late" if late else "planned in the air" if plan.air else "standing"
            ax.barh(0, plan.solve_s, BAR, left=plan.looked_s, color=colors[kind])
            below = -0.36 if plan.air else -0.7  # two numbers in a line would run together
            ax.text(plan.looked_s, below, f"{1000 * plan.solve_s:.0f}", va="top", fontsize=6.5)
            if plan.needed_s is not None and jump.number:
                ax.plot([plan.needed_s] * 2, [-BAR / 2, 1.5], color=INK, linewidth=0.7)
            if plan.began_s is not None:
                ax.text(plan.began_s + 0.03, 1.38, str(jump.number + 1), ha="left", va="bottom", fontsize=6.5)
    ax.set_yticks([0, 1], ["planning [ms]", "robot"])
    ax.set(xlabel="time [s]", ylim=(-1.1, 1.75), xlim=(0.0, float(result.t[-1])))
    ax.grid(False, axis="y")
    bars = [Patch(color=color, label=kind) for kind, color in colors.items()]
    if result.in_time == len(result.replans):
        bars.pop()
    bars.insert(2, Line2D([], [], color=INK, linewidth=0.7, label="still enough"))
    legend_above(fig, [*phase_handles(*PHASE_COLORS), *bars])
    return fig


@styled
def trials(rows: Sequence[Metrics], task: JumpTask, *, nominal: Metrics | None = None) -> Figure:
    """Travel of the feet against rise of the CoM for many robots: landed, fallen, as planned (``nominal``), the target.

    Robots that never left the ground or never came down are not drawn; the box is :data:`WITHIN_M` around it.
    """
    fig = new_figure(COLUMN_IN, 2.5)
    ax = fig.subplots()
    corner, size = np.array([task.distance_m, task.height_m]) - WITHIN_M, 2 * np.array(WITHIN_M)
    box = dict(facecolor=tint(INK, 0.06), edgecolor=INK, linestyle=(0, (4, 2)), linewidth=0.8)
    ax.add_patch(Rectangle(corner, *size, **box))
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


@styled
def chain_strobe(result: ChainResult) -> Figure:
    """The whole chain where it happened: the crouch before each jump, the apex of each flight, and the end."""
    body, frames = Silhouette(result.robot), []
    for jump in result.jumps:
        s = jump.simulation
        flight = np.flatnonzero(s.phase == "flight")
        frames.append((WAITING, s.q[0], "landing" if jump.number else "launch"))
        if len(flight):
            frames.append((1.0, s.q[flight[np.argmax(s.com[flight, 2])]], "flight"))
    frames.append((1.0, result.jumps[-1].simulation.q[-1], "landing"))
    strengths, postures, phases = zip(*sorted(frames, key=lambda f: f[0]), strict=True)  # robots in the air in front
    left, right = span(result)
    top = max(points[:, 1].max() for q in postures for _, points in body.outlines(q)) + GROUND_M
    fig = new_figure(PAGE_IN, min(LEGEND_IN + PAGE_IN * (top + GROUND_M) / (right - left), CHAIN_TALLEST_IN))
    ax = fig.subplots()
    strobe(ax, body, postures, [PHASE_COLORS[p] for p in phases], strengths=strengths)
    draw_path(ax, result.com[:, 0], result.com[:, 2])
    draw_scene(ax, result.scene, left, right, -GROUND_M)
    draw_goals(ax, result)
    ax.set(xlim=(left, right), ylim=(-GROUND_M, top))
    legend_above(fig, phase_handles(*PHASE_COLORS))
    bare(ax)
    return fig


def span(result: ChainResult) -> tuple[float, float]:
    """Part of the ground of a chain to show: from, to [m]."""
    x = result.q[:, 0]
    return float(x.min()) - AROUND_M, float(x.max()) + AROUND_M


def draw_goals(ax: Axes, result: ChainResult) -> None:
    """Draw the places where the toes should stand after each jump."""
    foot = result.robot.foot
    zero = foot.toe - float(foot.center[0])
    for goal, top in zip(result.course.goals_m, result.course.platforms_m, strict=True):
        ax.plot([zero + goal] * 2, [top - 0.035, top], color=VERMILION, linewidth=1.4, zorder=6)


def draw_scene(ax: Axes, scene: Scene, left: float, right: float, bottom: float) -> None:
    """Cross-section of the ground from ``left`` to ``right``, cut off at ``bottom`` [m]."""
    line = dict(color=GROUND, linewidth=0.8, zorder=1.5)
    fill = dict(facecolor=tint(GROUND, 0.35), edgecolor="none", zorder=1)
    for block in sorted(scene.blocks, key=lambda b: b.top):
        start, end = max(left, block.x_from), min(right, block.x_to)
        if start >= end or block.top <= bottom or not block.y_from <= 0 <= block.y_to:
            continue
        tops = [block.height_at(x) for x in (start, end)]
        ax.fill([start, start, end, end], [bottom, *tops, bottom], **fill)
        ax.plot([start, end], tops, **line)
        for x, top in zip((start, end), tops, strict=True):
            if left < x < right:
                others = (b.height_at(x) for b in scene.blocks if b is not block and b.x_from <= x <= b.x_to)
                ax.plot([x, x], [max(max(others, default=bottom), bottom), top], **line)
