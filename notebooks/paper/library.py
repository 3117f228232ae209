"""The page of a library of clips: a picture of each, in a file that refers to those beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from jumplab.errors import InputError
from jumplab.io.files import write_file
from jumplab.io.motion import Motion
from jumplab.robot import Robot
from jumplab.show.jumps import jump_strobe
from jumplab.show.movies import write_movie
from jumplab.show.style import describe_task, file_of
from jumplab.show.viewer import Page, page_of
from jumplab.sim.scene import Scene
from jumplab.task import JumpTask

INDEX = "robot", "targets", "clips", "left_out"  # keys of an index that the page shows
STRIP = "strip.png"
FILM = "film.gif"
STRIP_DPI = 80  # 40 kB


def draw_strip(folder: Path, robot: Robot, motion: Motion, scene: Scene) -> str:
    """Draw a motion's phases as a strip into a folder, unless it has one; returns the file's name.

    The ``scene`` is not drawn.
    """
    if not (folder / STRIP).is_file():
        fig = jump_strobe(motion, robot)
        write_file(folder / STRIP, file_of(fig, "png", dpi=STRIP_DPI))
        plt.close(fig)
    return STRIP


def draw_film(folder: Path, robot: Robot, motion: Motion, scene: Scene) -> str:
    """Draw a film of a motion into a folder, unless it has one; returns the file's name."""
    if not (folder / FILM).is_file():
        write_movie(folder / FILM, robot, motion, scene)
    return FILM


def clips_page(index: Mapping[str, Any]) -> Page:
    """The page of a library (its index), by ``library.html``, to stand beside its folders.

    Raises :class:`InputError` for an index that lacks something.
    """
    if missing := [key for key in INDEX if key not in index]:
        raise InputError(f"the index of a library lacks {missing[0]!r}; give its index.json")
    done = [*index["clips"], *index["left_out"]]
    title = f"{len(index['clips'])} clips of {index['robot']['name']}"
    return page_of(
        Path(__file__).with_suffix(".html"),
        title,
        index=index,
        kinds=dict.fromkeys(row["kind"] for row in done),
        missing=index["targets"] - len(done),
        describe=_described,
    )


def _described(row: Mapping[str, Any]) -> str:
    """The target of a clip in words; of a schedule its feet."""
    target = row["target"]
    if "phases" in target:
        words = f"feet {' '.join(phase['feet'] for phase in target['phases'])}"
        ahead_m = max([place["ahead_m"] for place in target["places"]])
        words += f", {ahead_m:.2f} m ahead"
    else:
        words = describe_task(JumpTask.of(target))
    return words
