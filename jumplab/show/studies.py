"""Pictures of many jumps: perturbed robots, the map of what a robot can do, and chains of jumps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from jumplab.show import style
from jumplab.show.bodies import Silhouette, draw_path, strobe
from jumplab.show.style import COLUMN_IN, INK, PAGE_IN, PHASE_COLORS, legend_above, new_figure, phase_handles, tint
from jumplab.studies.envelope import BEYOND, OPEN, VERDICT, Envelope

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.sim import Metrics, Scene
    from jumplab.studies.chain import ChainResult
    from jumplab.task import JumpTask

REFUSED = {
    OPEN: ("#9A9A9A", "no plan found"),
    VERDICT: ("#D5D5D5", "refused before solving"),
    BEYOND: ("#F0F0F0", "not tried"),
}
TOLERANCE_M = (0.05, 0.03)  # of distance and rise
MOST_TICKS = 14  # more would touch
AROUND_M, BELOW_M = 0.45, 0.05  # what is shown of the ground beyond the soles of a chain, and below it
WAITING = 0.55  # strength of a robot between jumps
LEGEND_IN, TALLEST_IN = 0.3, 4.2


@style.styled
def trials(rows: Sequence[Metrics], task: JumpTask, *, nominal: Metrics | None = None) -> Figure:
    """Travel of the feet against rise of the CoM for many robots: landed, fallen, as planned (``nominal``), the target.

    Robots that never left the ground or never came down are not drawn; the box is :data:`TOLERANCE_M` around it.
    """
    fig = new_figure(COLUMN_IN, 2.5)
    ax = fig.subplots()
    corner, size = np.array([task.distance_m, task.height_m]) - TOLERANCE_M, 2 * np.array(TOLERANCE_M)
    box = dict(facecolor=tint(INK, 0.06), edgecolor=INK, linestyle=(0, (4, 2)), linewidth=0.8)
    ax.add_patch(Rectangle(corner, *size, **box))
    ax.plot(task.distance_m, task.height_m, "+", color=INK, markersize=7, label="target")
    kinds = (
        ([m for m in rows if m.landed], "o", style.LANDING, "landed"),
        ([m for m in rows if not m.landed], "x", style.VERMILION, "fell"),
        ([nominal] if nominal else [], "D", style.LAUNCH, "as planned"),
    )
    for found, marker, color, label in kinds:
        places = np.array([(m.foot_distance_m, m.com_rise_m) for m in found if m.foot_distance_m is not None])
        if len(places):
            ax.plot(*places.T, linestyle="none", marker=marker, color=color, markersize=4.5, label=label)
    ax.set(xlabel="travel of the feet [m]", ylabel="rise of the CoM [m]")
    ax.margins(0.12)
    legend_above(fig, ax.get_legend_handles_labels()[0])
    return fig


@style.styled
def envelope_map(envelope: Envelope) -> Figure:
    """Distance against height; a cell's colour is the limit that it uses most, its strength how much of it."""
    fig = new_figure(1.6 * COLUMN_IN, 3.2)
    ax = fig.subplots()
    names = sorted({c.limiting for c in envelope.cells if c.solved})
    palette = matplotlib.color_sequences["okabe_ito"]
    colors = {name: palette[(i + 1) % len(palette)] for i, name in enumerate(names)}
    edges = envelope.distances, envelope.heights
    size = np.array([np.min(np.diff(values)) if len(values) > 1 else 0.1 for values in edges])
    for c in envelope.cells:
        place = np.array([c.distance_m, c.height_m])
        if c.solved:
            face = tint(colors[c.limiting], 0.25 + 0.75 * float(np.clip(c.share, 0, 1)))
            ax.text(*place, f"{100 * c.share:.0f}", ha="center", va="center", fontsize=5.5)
        else:
            face = REFUSED[c.limiting][0]
        ax.add_patch(Rectangle(place - size / 2, *size, facecolor=face, edgecolor="white", linewidth=0.6))
    x, y = ((min(values) - d / 2, max(values) + d / 2) for values, d in zip(edges, size, strict=True))
    title = f"{envelope.robot}: limit used most, in %"
    ax.set(xlim=x, ylim=y, xlabel="distance [m]", ylabel="rise of the CoM [m]", title=title)
    if max(map(len, edges)) <= MOST_TICKS:
        ax.set(xticks=envelope.distances, yticks=envelope.heights)
    ax.grid(False)
    seen = {c.limiting for c in envelope.cells}
    handles = [Patch(color=color, label=name) for name, color in colors.items()]
    handles += [Patch(color=color, label=text) for kind, (color, text) in REFUSED.items() if kind in seen]
    ax.legend(handles=handles, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=7, frameon=False)
    return fig


# chains ---------------------------------------------------------------------------------------------------------
@style.styled
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
    top = max(map(body.top, postures)) + BELOW_M
    fig = new_figure(PAGE_IN, min(LEGEND_IN + PAGE_IN * (top + BELOW_M) / (right - left), TALLEST_IN))
    ax = fig.subplots()
    strobe(ax, body, postures, [PHASE_COLORS[p] for p in phases], strengths=strengths)
    draw_path(ax, result.com[:, 0], result.com[:, 2])
    draw_scene(ax, result.scene, left, right, -BELOW_M)
    draw_goals(ax, result)
    ax.set(xlim=(left, right), ylim=(-BELOW_M, top))
    legend_above(fig, phase_handles(*PHASE_COLORS))
    style.bare(ax)
    return fig


def span(result: ChainResult) -> tuple[float, float]:
    """What to show of the ground of a chain: from, to [m]."""
    x = result.q[:, 0]
    return float(x.min()) - AROUND_M, float(x.max()) + AROUND_M


def draw_goals(ax: Axes, result: ChainResult) -> None:
    """Where the toes should stand after each jump."""
    foot = result.robot.foot
    zero = foot.toe - float(foot.center[0])
    for goal, top in zip(result.course.goals_m, result.course.platforms_m, strict=True):
        ax.plot([zero + goal] * 2, [top - 0.035, top], color=style.VERMILION, linewidth=1.4, zorder=6)


def draw_scene(ax: Axes, scene: Scene, left: float, right: float, bottom: float) -> None:
    """Cross-section of the ground from ``left`` to ``right``, cut off at ``bottom`` [m]."""
    line = dict(color=style.GROUND, linewidth=0.8, zorder=1.5)
    fill = dict(facecolor=tint(style.GROUND, 0.35), edgecolor="none", zorder=1)
    for block in sorted(scene.blocks, key=lambda b: b.top):
        start, end = max(left, block.x_from), min(right, block.x_to)
        if start >= end or block.top <= bottom:
            continue
        ax.add_patch(Rectangle((start, bottom), end - start, block.top - bottom, **fill))
        ax.plot([start, end], [block.top] * 2, **line)
        for x in (block.x_from, block.x_to):
            if left < x < right:
                below = max((b.top for b in scene.blocks if b is not block and b.x_from <= x <= b.x_to), default=bottom)
                ax.plot([x, x], [max(below, bottom), block.top], **line)
