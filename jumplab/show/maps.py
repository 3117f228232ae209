"""Picture of many jumps: the map of those that a robot can do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from jumplab.show.style import (
    COLUMN_IN,
    PAGE_IN,
    new_figure,
    themed,
    tint,
)
from jumplab.studies.envelope import BEYOND, OPEN, Envelope

REFUSED = {
    OPEN: ("#9A9A9A", "no plan found"),
    BEYOND: ("#F0F0F0", "not tried"),
}
MOST_TICKS = 14  # more would touch
COLUMNS = 4  # of maps side by side
AXIS_WORDS = {
    "distance_m": "distance [m]",
    "height_m": "rise of the CoM [m]",
    "side_m": "to the left [m]",
    "yaw_rad": "turn [rad]",
}

MORE_COLORS = "#8C564B", "#5E3C99"  # brown and purple, of which that sequence has none


@themed
def envelope_map(envelope: Envelope, *others: Envelope) -> Figure:
    """The map of an envelope; a cell's colour is the limit that it uses most, its strength how much
    of it.

    Maps of ``others`` over the same two numbers stand beside it, four in a row, under one legend.
    """
    maps = envelope, *others
    across, up = (AXIS_WORDS[name] for name in envelope.axes)
    cells = [cell for each in maps for cell in each.cells]
    limiting = {cell.limiting for cell in cells}
    names = sorted({cell.limiting for cell in cells if cell.solved})
    palette = [*matplotlib.color_sequences["okabe_ito"], *MORE_COLORS]
    colors = {name: palette[(i + 1) % len(palette)] for i, name in enumerate(names)}
    entries = colors | {words: x for kind, (x, words) in REFUSED.items() if kind in limiting}
    handles = [Patch(color=color, label=label) for label, color in entries.items()]
    if others:
        rows = -(-len(maps) // COLUMNS)
        fig = new_figure(PAGE_IN, 0.9 + 1.75 * rows)
        axes = fig.subplots(rows, COLUMNS, squeeze=False).ravel()
        for ax in axes[len(maps) :]:
            ax.set_axis_off()
        fig.supxlabel(across, fontsize=8)
        fig.supylabel(up, fontsize=8)
        fig.legend(handles=handles, loc="outside upper center", ncols=4)
    else:
        fig = new_figure(1.6 * COLUMN_IN, 3.2)
        axes = [fig.subplots()]
        axes[0].set(xlabel=across, ylabel=up)
        axes[0].legend(handles=handles, loc="center left", bbox_to_anchor=(1.01, 0.5))
    for ax, each in zip(axes, maps, strict=False):
        _draw_cells(ax, each, colors, "{:.2g}" if others else "{:g}")
        ax.set_title(each.robot if others else f"{each.robot}: limit used most, in %")
    return fig


def _draw_cells(ax: Axes, envelope: Envelope, colors: Mapping[str, Any], tick: str) -> None:
    centres = envelope.distances, envelope.heights
    size = np.array([np.min(np.diff(values)) if len(values) > 1 else 0.1 for values in centres])
    for cell in envelope.cells:
        place = np.array([getattr(cell, name) for name in envelope.axes])
        face = REFUSED.get(cell.limiting, ("", ""))[0]
        if cell.solved:
            face = tint(colors[cell.limiting], 0.25 + 0.75 * float(np.clip(cell.share, 0, 1)))
            luminance = np.dot((0.2126, 0.7152, 0.0722), np.array(face) ** 2.2)
            ink = "black" if luminance > 0.2 else "white"
            share = f"{100 * cell.share:.0f}"
            ax.text(*place, share, ha="center", va="center", fontsize=5.5, color=ink)
        ax.add_patch(
            Rectangle(place - size / 2, *size, facecolor=face, edgecolor="white", linewidth=0.6)
        )
    ax.autoscale_view()
    ax.margins(0)
    if max(map(len, centres)) <= MOST_TICKS:
        ax.set_xticks(envelope.distances, map(tick.format, envelope.distances))
        ax.set_yticks(envelope.heights, map(tick.format, envelope.heights))
    ax.grid(False)
