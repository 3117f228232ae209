"""The 3-D page of a jump: what it shows as data, its player and meshcat's viewer in one file that
refers to nothing outside itself.

This module computes the data; ``player.js`` draws them.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from jumplab.arguments import checked
from jumplab.auditing.replay import runs
from jumplab.errors import InputError
from jumplab.forms import filled
from jumplab.io.folder import plain, write_file
from jumplab.io.motion import Motion, Record
from jumplab.robot import Robot
from jumplab.robot.files import LEG
from jumplab.show.bodies import ABOVE_M
from jumplab.show.shapes import PAINTS, Part, Trace, ground_forces, parts_of, trace
from jumplab.show.style import PHASE_COLORS, describe_task, made_with
from jumplab.sim.scene import Scene
from jumplab.task import JumpTask

FPS = 50.0  # frames a second: every twentieth sample of a log; the page turns smoothly between them
AHEAD_M = 0.75  # ground that is seen behind the start and beyond the end of the jump
RULER_M = 0.5  # spacing of the numbers along the ground
NOTEBOOK_HEIGHT_PX = 640  # height of the frame in a notebook
# the ground as drawn
TRACK_HALF_WIDTH_M = 0.8
TRACK_DEPTH_M = 0.06


@checked
@dataclass(frozen=True)
class Page:
    """A finished page that needs nothing else; a notebook shows it, :meth:`save` writes it."""

    html: str = field(repr=False)
    title: str

    def save(self, path: str | Path) -> Path:
        """Write the page (whole or not at all); raises :class:`InputError` if that cannot be."""
        return write_file(path, self.html.encode())

    def _repr_html_(self) -> str:
        height = NOTEBOOK_HEIGHT_PX
        return filled("show/frame.html", page=self.html, title=self.title, height=height)


def page_of(form: Path, title: str, **facts: Any) -> Page:
    """The page that a template of Jinja (the file ``form``) makes of ``facts``."""
    return Page(filled(form, title=title, made_with=made_with(), **facts), title)


def page(
    robot: Robot,
    *,
    plan: Record | Motion | None = None,
    simulation: Record | Motion | None = None,
    task: JumpTask | None = None,
    scene: Scene | None = None,
    marks_m: Sequence[float] = (),
    title: str | None = None,
) -> Page:
    """The page of one jump: to play, to scrub, to look at from all sides.

    It shows ``plan``, ``simulation``, or each alone and both together; the title is that of the
    ``task``, whose toes' goal is marked, unless ``title`` says otherwise. ``marks_m`` are further
    places where the toes should land, from where they start [m]; the ``scene`` is flat if None.
    Raises :class:`InputError` if there is nothing to show.
    """
    motions = {
        name: Motion.of(record)
        for name, record in (("simulation", simulation), ("plan", plan))
        if record is not None
    }
    if not motions:
        raise InputError("a page needs a plan or a simulation to show")
    scene = scene or Scene.flat()
    parts, notes = parts_of(robot)
    toe = robot.foot.toe - robot.foot.center[0]
    marks = [toe + goal for goal in (0.0, *([task.distance_m] if task else []), *marks_m)]
    ways = {name: trace(robot, motion.every(FPS).q) for name, motion in motions.items()}
    places = np.concatenate([marks, *(way.com[:, 0] for way in ways.values())])
    span = places.min() - AHEAD_M, places.max() + AHEAD_M
    top = max(motion.q[:, 2].max() for motion in motions.values()) + ABOVE_M
    ground, low = _ground(scene, span)
    first, last = (np.array(span) - toe) / RULER_M
    ruler = RULER_M * np.arange(np.ceil(first), np.floor(last) + 1)
    size = f"robot {robot.name}, {robot.total_mass:.0f} kg"
    facts = {  # what player.js reads
        "title": title or (describe_task(task) if task else "A jump"),
        "note": " · ".join([size, f"{FPS:g} frames per second", *notes]),
        "fps": FPS,
        "weight": robot.total_mass * robot.gravity,
        "parts": list(map(_part, parts)),
        "joints": robot.joint_names,
        "clips": [
            {"name": name, **_clip(motion, robot, scene, ways[name])}
            for name, motion in motions.items()
        ],
        "ground": ground,
        "marks": [[x, 0.0, scene.top_at(x)] for x in marks],
        "ruler": [
            {"at": [toe + x, -TRACK_HALF_WIDTH_M, scene.top_at(toe + x)], "text": f"{x:g} m"}
            for x in ruler
        ],
        "view": {"x": span, "z": [low, top], "width": 2 * TRACK_HALF_WIDTH_M},
        "colors": PAINTS,
        "css": PHASE_COLORS,
    }
    name = f"{facts['title']}: {' and '.join(motions)}"
    return Page(_assemble(name, facts), name)


def _assemble(title: str, facts: Mapping[str, Any]) -> str:
    """Fill the template; in JSON ``<`` is escaped, so that no text can end the script."""
    engine = (resources.files("meshcat") / "viewer" / "dist" / "main.min.js").read_text("utf-8")
    if "</script" in engine:
        raise InputError("this version of meshcat cannot be put into a page; install another one")
    data = json.dumps(plain(facts), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    data = data.replace("<", "\\u003c")
    return filled("show/page.html", title=title, engine=engine, facts=data)


def _ground(scene: Scene, span: tuple[float, float]) -> tuple[list[dict[str, Any]], float]:
    """Boxes of the scene between ``span`` [m], as thick as they are drawn; their lowest z [m]."""
    seen = scene.within(*span, TRACK_HALF_WIDTH_M)
    low = min(block.top for block in seen.blocks) - TRACK_DEPTH_M
    blocks = tuple(replace(block, thickness=block.top - low) for block in seen.blocks)
    boxes = [
        {"size": 2 * half, "middle": middle, "turn": turn}
        for half, middle, turn in replace(seen, blocks=blocks).boxes()
    ]
    return boxes, min(0.0, low)


# the motion
# ----------------------------------------------------------------------------------------------
def _clip(whole: Motion, robot: Robot, scene: Scene, way: Trace) -> dict[str, Any]:
    """Data with which the page plays a motion that goes this way."""
    motion = whole.every(FPS)
    forces = ground_forces(whole, FPS, way, scene)
    words = np.array(list(map(_words, motion.phase, motion.contact)))
    cuts = [part.start for part in runs(words)]
    return {
        "bodies": way.joints.shape[1],
        "frames": len(motion.t),
        "phases": [[motion.t[k] - motion.t[0], motion.phase[k], words[k]] for k in cuts],
        "poses": _packed(way.joints),
        "path": _packed(way.com),
        "forces": None if forces is None else _packed(forces),
        "values": _packed(_values(whole, motion, robot, way, forces)),
    }


def _words(phase: str, contact: np.ndarray) -> str:
    """The name of a phase, with the foot that carries if it is one alone before the last flight."""
    if phase != "launch" or contact.all() or not contact.any():
        return phase
    return f"{phase}, {('left', 'right')[int(contact[1])]} foot"


def _part(part: Part) -> dict[str, Any]:
    """A surface, its joint counted from the base on."""
    packed = {name: _packed(getattr(part, name)) for name in ("points", "triangles")}
    return vars(part) | packed | {"joint": part.joint - 1}


def _packed(values: np.ndarray) -> str:
    """Base64 of numbers as 32-bit floats."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def _values(
    whole: Motion, motion: Motion, robot: Robot, way: Trace, forces: np.ndarray | None
) -> np.ndarray:
    """The values of table and curves (N, 10 + 2 joints): travel of the toes, rise of the CoM since
    take-off [m], the lines of the curves in ``player.js``, then of each joint its angle [deg] and
    its torque as a share of the limit.
    """
    height = way.com[:, 2]
    toes = way.toes(robot)
    takeoff = int(np.argmax(whole.phase == "flight"))
    start = trace(robot, whole.q[[takeoff]]).com[0, 2]
    names = robot.joint_names
    pairs = np.array([[names.index(name) for name in robot.joints[role]] for role in LEG])
    shares = np.abs(motion.tau) / [robot.actuators[name]["effort"] for name in names]
    joints = np.stack([np.degrees(motion.q[:, 7:]), shares], axis=2).reshape(len(height), -1)
    push = np.full(len(height), np.nan) if forces is None else np.nansum(forces[..., 5], axis=1)
    return np.column_stack(
        [
            toes - toes[0],
            height - start,
            height,
            np.degrees(motion.q[:, 7 + pairs[:, 0]]),
            shares[:, pairs].max(axis=2),
            push / (robot.total_mass * robot.gravity),
            joints,
        ]
    )
