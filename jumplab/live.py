"""What a notebook does only while somebody looks at it: progress bars and sliders.

A notebook that papermill executes keeps everything that its cells print, so that bars would litter it, and a slider
that nobody can move is an empty box. There, bars stay away and sliders give way to one picture.

>>> from jumplab import live
>>> for target in live.progress(targets, "targets"):
...     plan(target)
>>> live.explore_stage1(planner, task)        # the last expression of a cell
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from jumplab import plotting
from jumplab.errors import JumplabError
from jumplab.plotting.style import Picture
from jumplab.srmp import SrmpPlanner
from jumplab.task import JumpTask

T = TypeVar("T")
SESSION = "JPY_SESSION_NAME"  # set by Jupyter's server for the kernel of a notebook that somebody has opened
DISTANCE_M, HEIGHT_M, STEP_M = (-0.4, 1.2), (0.1, 0.6), 0.05  # our choice: what the sliders offer, mostly within reach
WIDE = {"description_width": "initial"}  # names are shown in full
TURNS = {"backflip": -2 * math.pi, "none": 0.0, "front flip": 2 * math.pi}


def watched() -> bool:
    """Whether this code runs in a notebook that is open in JupyterLab, Jupyter Notebook or VS Code."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    in_editor = shell is not None and "__vsc_ipynb_file__" in getattr(shell, "user_ns", {})
    return bool(os.environ.get(SESSION)) or in_editor


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """The items one by one, under a bar while somebody looks, which disappears at the end.

    Parameters
    ----------
    label : what is being counted.
    total : how many there are, where ``len(items)`` does not tell.
    """
    if watched():
        yield from _notebook_bar(items, label, total)
    elif sys.stderr is not None and sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(items, desc=label, total=total, leave=False)
    else:
        yield from items


def _notebook_bar(items: Iterable[T], label: str, total: int | None) -> Iterator[T]:
    """A bar of the browser; at the end its place in the notebook is empty, not a bar that stands still."""
    from IPython.display import display
    from tqdm.notebook import tqdm

    bar = tqdm(items, desc=label, total=total, leave=False, display=False)
    place = display(bar.container, display_id=True)
    try:
        yield from bar
    finally:
        place.update({"text/plain": ""}, raw=True)


def _picture_or_refusal(planner: SrmpPlanner, task: JumpTask) -> Picture | None:
    """Launch of stage 1 for one target, frame by frame; prints the reason if the planner refuses it."""
    try:
        return plotting.launch_strobe(planner.plan(task))
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
