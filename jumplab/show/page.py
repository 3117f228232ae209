"""The page around the 3-D scene: what it is told, and the one file that it becomes."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from jumplab.errors import InputError
from jumplab.io.folder import write_file
from jumplab.io.motion import Motion, Record
from jumplab.robot import Robot
from jumplab.show import scene as stage
from jumplab.show.bodies import ABOVE_M, LIMB_SHARE
from jumplab.show.style import PHASE_COLORS, describe_task, tint
from jumplab.sim.scene import Scene
from jumplab.task import JumpTask

FPS = 50.0  # frames a second: every twentieth sample of a log; the page turns smoothly between them
AHEAD_M = 0.75  # ground that is seen behind the start and beyond the end of the jump
RULER_M = 0.5  # spacing of the numbers along the ground
NOTEBOOK_HEIGHT_PX = 520  # height of the frame in a notebook
GHOST_ALPHA = 0.35  # strength of the plan where simulation and plan are shown together


@dataclass(frozen=True)
class Page:
    """A finished page; a notebook shows it, :meth:`save` writes it.

    Attributes
    ----------
    html : the whole page; it refers to nothing outside itself.
    title : what it shows.
    """

    html: str
    title: str

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all; raises :class:`InputError` if that cannot be."""
        return write_file(path, self.html.encode())

    def _repr_html_(self) -> str:
        source = html.escape(self.html, quote=True)
        return (
            f'<iframe srcdoc="{source}" sandbox="allow-scripts" title="{html.escape(self.title, quote=True)}" '
            f'style="width: 100%; height: {NOTEBOOK_HEIGHT_PX}px; border: 1px solid #d5d9e0; border-radius: 6px">'
            "</iframe><p><small>No picture? Notebooks that one has not run oneself must be trusted before they may "
            "move; or open the HTML file in the result folder.</small></p>"
        )

    def __repr__(self) -> str:
        return f"Page({self.title!r}, {len(self.html) / 1e6:.1f} MB)"


def page(
    robot: Robot,
    *,
    plan: Record | Motion | None = None,
    simulation: Record | Motion | None = None,
    task: JumpTask | None = None,
    scene: Scene | None = None,
    marks_m: Sequence[float] = (),
    title: str | None = None,
    fps: float = FPS,
) -> Page:
    """The page of one jump: to play, to scrub, to look at from all sides.

    Parameters
    ----------
    plan, simulation : a ``Tape``, a ``SimulationResult`` or a ``Motion``; at least one of them. With both, the page
        offers each alone and both together.
    task : what was asked, for the title and the line where the toes should land.
    scene : ground; flat if None.
    marks_m : further places where the toes should land, from where they start [m].
    title : instead of the task's.
    fps : frames a second.

    Raises
    ------
    InputError
        If there is nothing to show, or ``fps`` cannot be meant.
    """
    records = {"simulation": simulation, "plan": plan}
    motions = {
        name: (record if isinstance(record, Motion) else Motion.of(record)).every(fps)
        for name, record in records.items()
        if record is not None
    }
    if not motions:
        raise InputError("a page needs a plan or a simulation to show")
    scene = scene or Scene.flat()
    vis, commands = stage.new_stage()
    clips, paths = [], []
    for name, motion in motions.items():
        painted = stage.add_robot(vis, robot, name)
        paths.append(stage.add_trail(vis, motion, robot, name))
        clips.append({"name": name, **painted, **_clip(motion, robot)})
    x = np.concatenate(paths)[:, 0]
    toe = robot.foot.toe - float(robot.foot.center[0])
    marks = [toe, *(toe + goal for goal in ([task.distance_m] if task else []) + list(marks_m))]
    span = min(float(x.min()), *marks) - AHEAD_M, max(float(x.max()), *marks) + AHEAD_M
    stage.lay_ground(vis, scene, span, marks)
    facts: dict[str, Any] = {  # what player.js reads
        "title": title or (describe_task(task) if task else "A jump"),
        "note": f"robot {robot.name}, {robot.total_mass:.0f} kg · {fps:g} frames per second",
        "fps": fps,
        "clips": clips,
        "ruler": _ruler(scene, span, toe),
        "view": {"x": span, "z": _heights(scene, span, motions), "width": 2 * stage.TRACK_HALF_WIDTH_M},
        "colors": {
            p: {"trunk": tint(c, 1.0), "limb": tint(c, LIMB_SHARE), "rest": tint(stage.REST_COLOR, 1.0)}
            for p, c in PHASE_COLORS.items()
        },
        "css": PHASE_COLORS,
        "ghost": GHOST_ALPHA,
    }
    title = f"{facts['title']}: {' and '.join(motions)}"
    return Page(_assemble(title, facts, commands.sent), title)


def _clip(motion: Motion, robot: Robot) -> dict[str, Any]:
    """Poses of all joints at the frames, and when the phases begin."""
    poses = stage.joint_poses(motion, robot).astype("<f4")
    cuts = [0, *(np.flatnonzero(motion.phase[1:] != motion.phase[:-1]) + 1)]
    return {
        "bodies": poses.shape[1],
        "frames": len(poses),
        "poses": base64.b64encode(poses.tobytes()).decode("ascii"),
        "phases": [[float(motion.t[k] - motion.t[0]), str(motion.phase[k])] for k in cuts],
    }


def _ruler(scene: Scene, span: tuple[float, float], zero: float) -> list[dict[str, Any]]:
    """Numbers along the front edge of the ground, counted from where the toes start."""
    first, last = int(np.ceil((span[0] - zero) / RULER_M)), int(np.floor((span[1] - zero) / RULER_M))
    places = [(zero + RULER_M * k, f"{RULER_M * k:g} m") for k in range(first, last + 1)]
    front = -stage.TRACK_HALF_WIDTH_M
    return [{"at": [x, front, scene.top_at(x)], "text": text} for x, text in places]


def _heights(scene: Scene, span: tuple[float, float], motions: Mapping[str, Motion]) -> list[float]:
    """What the view must show: from below the lowest ground to above the highest base [m]."""
    low = min((b.top for b in scene.blocks if b.x_from < span[1] and b.x_to > span[0]), default=0.0)
    high = max(float(m.q[:, 2].max()) for m in motions.values())
    return [min(0.0, low) - stage.TRACK_DEPTH_M, high + ABOVE_M]


def _assemble(title: str, facts: Mapping[str, Any], commands: list[str]) -> str:
    """Fill the template; data stands in JSON, where ``<`` is escaped so that no text can end the script."""
    files = resources.files("jumplab.show")
    engine = (resources.files("meshcat") / "viewer" / "dist" / "main.min.js").read_text(encoding="utf-8")
    if "</script" in engine:
        raise InputError("this version of meshcat cannot be put into a page; install another one")

    def data(value: Any) -> str:
        return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")

    parts = {
        "TITLE": html.escape(title),
        "STYLE": (files / "page.css").read_text(encoding="utf-8"),
        "ENGINE": engine,
        "FACTS": data(facts),
        "COMMANDS": data(commands),
        "PLAYER": (files / "player.js").read_text(encoding="utf-8"),
    }
    pieces = (files / "page.html").read_text(encoding="utf-8").split("@@")  # text, NAME, text, NAME, text ...
    return "".join(parts[p] if i % 2 else p for i, p in enumerate(pieces))
