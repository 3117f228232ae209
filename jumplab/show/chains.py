"""Chained jumps in pictures: all in one frame, the path of the CoM, when plans were made, how far off they landed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jumplab.show.bodies import Silhouette, draw_robot, equal_scales
from jumplab.show.experiments import draw_scene
from jumplab.show.style import (
    FLIGHT,
    INK,
    LIMIT_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    PURPLE,
    REFERENCE_STYLE,
    VERMILION,
    bare,
    by_phase,
    legend_above,
    new_figure,
    panel_letters,
    phase_handles,
    shade,
    styled,
    tint,
)

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.studies.chain import ChainResult, ChainTrial

AROUND_M = 0.45  # our choice: ground that is shown before the first heel and beyond the last toe
BELOW_M = 0.05
WAITING, FLYING = 0.55, 1.0  # strength of the frames: the robot between jumps, and in the air
TOLERANCE_M = 0.03  # what a jump of a chain may miss by
LEGEND_IN, TALLEST_IN = 0.3, 4.2
CORRECTION = 0.5  # strength of what is planned on the ground
BAR = 0.62  # height of a bar of the timeline


@styled
def chain_strobe(result: ChainResult) -> Figure:
    """The whole chain where it happened: the crouch before each jump, the apex of each flight, and the end."""
    body, frames = Silhouette(result.robot), []
    for jump in result.jumps:
        s = jump.simulation
        flight = np.flatnonzero(s.phase == "flight")
        frames.append((s.q[0], "launch" if not jump.number else "landing", WAITING))
        if len(flight):
            frames.append((s.q[flight[np.argmax(s.com[flight, 2])]], "flight", FLYING))
    frames.append((result.jumps[-1].simulation.q[-1], "landing", FLYING))
    left, right = _span(result)
    top = max(float(outline[:, 1].max()) for q, _, _ in frames for _, outline in body.outlines(q)) + BELOW_M
    fig = new_figure(PAGE_IN, min(LEGEND_IN + PAGE_IN * (top + BELOW_M) / (right - left), TALLEST_IN))
    ax = fig.subplots()
    for k, (q, phase, strength) in enumerate(sorted(frames, key=lambda f: f[2])):
        draw_robot(ax, body, q, PHASE_COLORS[phase], strength=strength, zorder=2 + k / len(frames))
    ax.plot(result.com[:, 0], result.com[:, 2], color=INK, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=5)
    draw_scene(ax, result.scene, left, right, -BELOW_M)
    _goals(ax, result)
    equal_scales(ax)
    ax.set(xlim=(left, right), ylim=(-BELOW_M, top))
    legend_above(fig, phase_handles("launch", "flight", "landing"))
    bare(ax)
    return fig


def _span(result: ChainResult) -> tuple[float, float]:
    x = result.q[:, 0]
    return float(x.min()) - AROUND_M, float(x.max()) + AROUND_M


def _goals(ax: Axes, result: ChainResult) -> None:
    """Where the toes should stand after each jump."""
    foot = result.robot.foot
    zero = foot.toe - float(foot.center[0])
    for goal, top in zip(result.course.goals_m, result.course.platforms_m, strict=True):
        ax.plot([zero + goal] * 2, [top - 0.035, top], color=VERMILION, linewidth=1.4, zorder=6)


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
    left, right = _span(result)
    low = float(result.com[:, 2].min()) - 0.1
    draw_scene(ax, result.scene, left, right, min(0.0, low) - BELOW_M)
    _goals(ax, result)
    ax.set(xlabel="$x$ [m]", ylabel="CoM $z$ [m]", xlim=(left, right))
    legend_above(fig, phase_handles("launch", "flight", "landing", reference="plan"))
    return fig


@styled
def chain_timeline(result: ChainResult) -> Figure:
    """What the robot does above, when its plans are made below; a tick where it was ready for the plan."""
    fig = new_figure(PAGE_IN, 1.5)
    ax = fig.subplots()
    cuts = np.flatnonzero(result.phase[1:] != result.phase[:-1]) + 1
    for part in np.split(np.arange(len(result.phase)), cuts):
        start, end = result.t[part[0]], result.t[part[-1]]
        ax.barh(1, end - start, BAR, left=start, color=PHASE_COLORS[str(result.phase[part[0]])])
    for jump in result.jumps:
        for plan in jump.plans:
            late = jump.number and not plan.in_time
            ax.barh(0, plan.solve_s, BAR, left=plan.looked_s, color=VERMILION if late else tint(PURPLE, 1.0 if plan.air
                    else CORRECTION))  # fmt: skip
            ax.text(plan.looked_s, -0.36, f"{1000 * plan.solve_s:.0f}", va="top", fontsize=6.5)
            if plan.needed_s is not None and jump.number:
                ax.plot([plan.needed_s] * 2, [-BAR / 2, 1.5], color=INK, linewidth=0.7)
            if plan.began_s is not None:
                ax.text(plan.began_s + 0.03, 1.38, str(jump.number + 1), ha="left", va="bottom", fontsize=6.5)
    ax.set_yticks([0, 1], ["planning [ms]", "robot"])
    ax.set(xlabel="time [s]", ylim=(-0.75, 1.75), xlim=(0.0, float(result.t[-1])))
    ax.grid(False, axis="y")
    handles = [Patch(color=PURPLE, label="planned in the air"), Patch(color=tint(PURPLE, CORRECTION), label="standing"),
               Line2D([], [], color=INK, linewidth=0.7, label="still enough")]  # fmt: skip
    if result.in_time < len(result.replans):
        handles.append(Patch(color=VERMILION, label="late"))
    legend_above(fig, [*phase_handles("launch", "flight", "landing"), *handles])
    return fig


@styled
def chain_errors(result: ChainResult, trials: Sequence[ChainTrial] = ()) -> Figure:
    """Distance error of each jump, and planning time against air time; grey the perturbed robots."""
    fig = new_figure(PAGE_IN, 2.3)
    error, clock = fig.subplots(1, 2)
    number = 1 + np.arange(len(result.jumps))
    for trial in trials:
        grey = dict(color=tint(INK, 0.45), linewidth=0.7, marker=".", markersize=3)
        error.plot(1 + np.arange(len(trial.errors_m)), 1000 * np.array(trial.errors_m), **grey)
        clock.plot(
            [1 + p["jump"] for p in trial.plans], [p["solve_s"] for p in trial.plans], **grey | {"linestyle": ""}
        )
    error.plot(number, 1000 * result.errors_m, color=shade(PHASE_COLORS["landing"], 0.9), marker="o", markersize=4)
    for sign in (-1, 1):
        error.axhline(sign * 1000 * TOLERANCE_M, **LIMIT_STYLE)
    error.set(xlabel="jump", ylabel="distance error [mm]")
    air = np.array([np.nan if j.air_s is None else j.air_s for j in result.jumps])
    clock.plot(number, air, color=FLIGHT, marker="o", markersize=4, label="in the air")
    for in_air, face, label in ((True, PURPLE, "planned in the air"), (False, "white", "planned standing")):
        known = [(1 + p.number, p.solve_s) for j in result.jumps for p in j.plans if p.air == in_air]
        clock.plot(*np.reshape(known, (-1, 2)).T, color=PURPLE, linestyle="", marker="o", markersize=4,
                   markerfacecolor=face, label=label)  # fmt: skip
    clock.set(xlabel="jump", ylabel="time [s]", ylim=(0.0, None))
    for ax in (error, clock):
        ax.set_xticks(number)
    panel_letters((error, clock))
    handles, _ = clock.get_legend_handles_labels()
    legend_above(fig, [*handles, Line2D([], [], **LIMIT_STYLE, label=f"{100 * TOLERANCE_M:g} cm")])
    return fig
