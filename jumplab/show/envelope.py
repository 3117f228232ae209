"""The map of jumps that a robot can do."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from jumplab.show.style import COLUMN_IN, new_figure, styled, tint
from jumplab.studies.envelope import BEYOND, OPEN, VERDICT, Envelope

REFUSED = {OPEN: "#9A9A9A", VERDICT: "#D5D5D5", BEYOND: "#F0F0F0"}
MOST_TICKS = 14  # our choice: more would touch
SHORT = {OPEN: "no plan found", VERDICT: "refused before solving", BEYOND: "not tried"}


@styled
def envelope_map(envelope: Envelope) -> Figure:
    """Distance against height; a cell's colour is the limit that it uses most, its strength how much of it."""
    fig = new_figure(1.6 * COLUMN_IN, 3.2)
    ax = fig.subplots()
    names = sorted({c.limiting for c in envelope.cells if c.solved})
    palette = colormaps["okabe_ito"].colors if "okabe_ito" in colormaps else colormaps["tab10"].colors
    colors = {name: palette[(i + 1) % len(palette)] for i, name in enumerate(names)}
    dx, dy = _step(envelope.distances), _step(envelope.heights)
    for c in envelope.cells:
        share = float(np.clip(c.share, 0, 1)) if c.solved else 1.0
        face = tint(colors[c.limiting], 0.25 + 0.75 * share) if c.solved else REFUSED[c.limiting]
        ax.add_patch(Rectangle((c.distance_m - dx / 2, c.height_m - dy / 2), dx, dy, facecolor=face, edgecolor="white",
                               linewidth=0.6))  # fmt: skip
        if c.solved:
            ax.text(c.distance_m, c.height_m, f"{100 * c.share:.0f}", ha="center", va="center", fontsize=5.5)
    ax.set(xlim=(min(envelope.distances) - dx / 2, max(envelope.distances) + dx / 2),
           ylim=(min(envelope.heights) - dy / 2, max(envelope.heights) + dy / 2),
           xlabel="distance [m]", ylabel="rise of the CoM [m]",
           title=f"{envelope.robot}: limit used most, in %")  # fmt: skip
    if len(envelope.distances) <= MOST_TICKS >= len(envelope.heights):
        ax.set(xticks=envelope.distances, yticks=envelope.heights)
    ax.grid(False)
    handles = [Patch(color=colors[n], label=n) for n in names]
    seen = {c.limiting for c in envelope.cells}
    handles += [Patch(color=REFUSED[k], label=SHORT[k]) for k in REFUSED if k in seen]
    ax.legend(handles=handles, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=7, frameon=False)
    return fig


def _step(values) -> float:
    return float(np.min(np.diff(values))) if len(values) > 1 else 0.1
