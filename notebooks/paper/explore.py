"""Sliders over stage 1, for whoever looks at its notebook."""

from __future__ import annotations

import math
from typing import Any

from jumplab.errors import JumplabError
from jumplab.show.style import Picture
from jumplab.stages.srmp import SrmpPlanner
from jumplab.task import JumpTask
from paper import drawings
from paper.widgets import watched

DISTANCE_M, HEIGHT_M, STEP_M = (-0.4, 1.2), (0.1, 0.6), 0.05  # what the sliders offer, mostly within reach
WIDE = {"description_width": "initial"}  # names are shown in full
TURNS = {"backflip": -2 * math.pi, "none": 0.0, "front flip": 2 * math.pi}


def _picture_or_refusal(planner: SrmpPlanner, task: JumpTask) -> Picture | None:
    """Launch of stage 1 for one target, frame by frame; prints the reason if the planner refuses it."""
    try:
        return drawings.launch_strobe(planner.plan(task))
    except JumplabError as refusal:
        print(refusal)
        return None


def explore_stage1(planner: SrmpPlanner, task: JumpTask) -> Any:
    """Sliders for distance, rise and rotation over the launch of stage 1; the picture of ``task`` if nobody looks.

    A target that the planner refuses shows its reason instead of a picture.
    """
    if not watched():
        return _picture_or_refusal(planner, task)
    import ipywidgets as widgets
    from IPython.display import display

    def slider(text: str, value: float, limits: tuple[float, float]) -> widgets.FloatSlider:
        low, high = min(limits[0], value), max(limits[1], value)
        return widgets.FloatSlider(
            value=value, min=low, max=high, step=STEP_M, description=text, style=WIDE, continuous_update=False
        )

    distance, height = slider("distance [m]", task.distance_m, DISTANCE_M), slider("rise [m]", task.height_m, HEIGHT_M)
    turn = widgets.SelectionSlider(
        options=list(TURNS), value="none", description="rotation", style=WIDE, continuous_update=False
    )

    def show(distance_m: float, height_m: float, rotation: str) -> None:
        picture = _picture_or_refusal(planner, JumpTask(distance_m, height_m, rotation_rad=TURNS[rotation]))
        if picture is not None:
            display(picture)

    picture = widgets.interactive_output(show, {"distance_m": distance, "height_m": height, "rotation": turn})
    return widgets.VBox([widgets.HBox([distance, height, turn]), picture])
