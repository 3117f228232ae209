"""The 3-D page of a jump: a meshcat scene and its player in one file that refers to nothing outside itself.

meshcat is normally fed through a server. Here its commands are collected instead, so that no process is started and no
port is opened; the page replays them when it is opened.
"""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import meshcat
import meshcat.geometry as shapes
import numpy as np
import pinocchio as pin
import umsgpack

from jumplab.errors import InputError
from jumplab.io.folder import write_file
from jumplab.io.motion import Motion, Record
from jumplab.robot import Robot
from jumplab.robot_import.config import LEG
from jumplab.show.bodies import ABOVE_M, LIMB_SHARE
from jumplab.show.shapes import Part, parts_of
from jumplab.show.style import INK, PHASE_COLORS, VERMILION, describe_task, tint
from jumplab.sim.result import CONTACT_FORCE_N
from jumplab.sim.scene import Scene
from jumplab.task import GRAVITY, JumpTask

FPS = 50.0  # frames a second: every twentieth sample of a log; the page turns smoothly between them
AHEAD_M = 0.75  # ground that is seen behind the start and beyond the end of the jump
RULER_M = 0.5  # spacing of the numbers along the ground
NOTEBOOK_HEIGHT_PX = 640  # height of the frame in a notebook
GHOST_ALPHA = 0.35  # strength of the plan where simulation and plan are shown together
TRACK_HALF_WIDTH_M, TRACK_DEPTH_M, TOP_M = 0.8, 0.06, 0.004  # the ground as drawn, and the thickness of its surface
LINE_LIFT_M = 0.0015  # lines lie this much above the ground, so that they are not hidden by it
MARK_M = 0.012  # width of a line across the ground
BEAD_M, BEAD_RADIUS_M = 0.03, 0.007  # spacing and size of the beads along the path of the CoM
TRAIL_AFTER_TOUCHDOWN_S = 0.6  # later the CoM hardly moves
TRACK_COLOR, TRACK_SIDE = "#F4F5F7", "#C9CED6"
GRIDS = {"fine": (0.1, 1.0, "#DDE1E7"), "coarse": (0.5, 1.3, "#AEB6C2")}  # spacing [m], lift [LINE_LIFT_M], colour
REST_COLOR = "#42474F"  # feet and joints, whose colour stays
ROLE_COLORS = {"hip": INK, "knee": VERMILION, "ankle": "#9C5480"}  # not those of the phases, which lie behind
FORCE_COLOR = "#B3125F"
CURVES = (  # title, unit, limit or None, names and colours of lines, in the order of _values() after its first two
    ("CoM height", "m", None, {"": INK}),
    ("left angle", "°", None, ROLE_COLORS),
    ("torque / limit", "", 1.0, ROLE_COLORS),
    ("ground force / weight", "", None, {"": INK}),
)
ROOT = "jump"
FILES = {"PAGE": "page.html", "STYLE": "page.css", "PLAYER": "player.js"}
_UUID = re.compile(rb"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


@dataclass(frozen=True)
class Page:
    """A finished page, which refers to nothing outside itself; a notebook shows it, :meth:`save` writes it."""

    html: str = field(repr=False)
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

    It shows ``plan``, ``simulation``, or each alone and both together; the title is that of the ``task``, whose toes'
    goal is marked, unless ``title`` says otherwise. ``marks_m`` are further places where the toes should land, from
    where they start [m]; the ``scene`` is flat if None. Raises :class:`InputError` if there is nothing to show, or
    ``fps``, frames a second, cannot be meant.
    """
    given = {name: record for name, record in (("simulation", simulation), ("plan", plan)) if record is not None}
    if not given:
        raise InputError("a page needs a plan or a simulation to show")
    wholes = {k: r if isinstance(r, Motion) else Motion.of(r) for k, r in given.items()}
    motions = {name: whole.every(fps) for name, whole in wholes.items()}
    scene, commands = scene or Scene.flat(), _Commands()
    vis = meshcat.Visualizer(window=commands)
    _light(vis)
    clips, places, (parts, said) = [], [], parts_of(robot)
    for name, motion in motions.items():
        painted, trace = _add_robot(vis, parts, name), _Trace.of(motion, robot)
        _add_trail(vis[f"{ROOT}/{name}/trail"], motion, trace.com)
        forces = _forces(wholes[name], motion.t, trace.feet, scene)
        values = _values(wholes[name], motion, robot, trace, forces)
        clips.append({"name": name, **painted, **_clip(motion, trace.poses), "values": _packed(values)})
        clips[-1]["forces"] = None if forces is None else _packed(forces)
        places += list(map(float, trace.com[:, 0]))
    toe = robot.foot.toe - float(robot.foot.center[0])
    marks = [toe + goal for goal in (0.0, *([task.distance_m] if task else []), *marks_m)]
    span = min(places + marks) - AHEAD_M, max(places + marks) + AHEAD_M
    _lay_ground(vis, scene, span, marks)
    rest = tint(REST_COLOR, 1.0)
    facts = {  # what player.js reads
        "title": title or (describe_task(task) if task else "A jump"),
        "note": " · ".join([f"robot {robot.name}, {robot.total_mass:.0f} kg", f"{fps:g} frames per second", *said]),
        "fps": fps,
        "weight": robot.total_mass * GRAVITY,
        "arrow": FORCE_COLOR,
        "curves": [dict(title=title, unit=unit, limit=limit, lines=lines) for title, unit, limit, lines in CURVES],
        "clips": clips,
        "ruler": _ruler(scene, span, toe),
        "view": {"x": span, "z": _heights(scene, span, motions), "width": 2 * TRACK_HALF_WIDTH_M},
        "colors": {p: dict(trunk=tint(c, 1.0), limb=tint(c, LIMB_SHARE), rest=rest) for p, c in PHASE_COLORS.items()},
        "css": PHASE_COLORS,
        "ghost": GHOST_ALPHA,
    }
    name = f"{facts['title']}: {' and '.join(motions)}"
    return Page(_assemble(name, facts, commands.sent), name)


def _clip(motion: Motion, poses: np.ndarray) -> dict[str, Any]:
    """Poses of all joints at the frames, and when the phases begin."""
    cuts = [0, *(np.flatnonzero(motion.phase[1:] != motion.phase[:-1]) + 1)]
    return {
        "bodies": poses.shape[1],
        "frames": len(poses),
        "poses": _packed(poses),
        "phases": [[float(motion.t[k] - motion.t[0]), str(motion.phase[k])] for k in cuts],
    }


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")


def _ruler(scene: Scene, span: tuple[float, float], zero: float) -> list[dict[str, Any]]:
    """Numbers along the front edge of the ground, counted from where the toes start."""
    first, last = int(np.ceil((span[0] - zero) / RULER_M)), int(np.floor((span[1] - zero) / RULER_M))
    places = [(zero + RULER_M * k, f"{RULER_M * k:g} m") for k in range(first, last + 1)]
    return [{"at": [x, -TRACK_HALF_WIDTH_M, scene.top_at(x)], "text": text} for x, text in places]


def _heights(scene: Scene, span: tuple[float, float], motions: Mapping[str, Motion]) -> list[float]:
    """What the view must show: from below the lowest ground to above the highest base [m]."""
    low = min((b.top for b in scene.blocks if b.x_from < span[1] and b.x_to > span[0]), default=0.0)
    high = max(float(m.q[:, 2].max()) for m in motions.values())
    return [min(0.0, low) - TRACK_DEPTH_M, high + ABOVE_M]


def _assemble(title: str, facts: Mapping[str, Any], commands: list[str]) -> str:
    """Fill the template; data stands in JSON, where ``<`` is escaped so that no text can end the script."""
    files = resources.files("jumplab.show")
    engine = (resources.files("meshcat") / "viewer" / "dist" / "main.min.js").read_text(encoding="utf-8")
    if "</script" in engine:
        raise InputError("this version of meshcat cannot be put into a page; install another one")
    form = dict(ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    data = {"FACTS": facts, "COMMANDS": commands}
    data = {name: json.dumps(x, **form).replace("<", "\\u003c") for name, x in data.items()}
    texts = {name: (files / file).read_text(encoding="utf-8") for name, file in FILES.items()}
    return Template(texts.pop("PAGE")).substitute(TITLE=html.escape(title), ENGINE=engine, **data, **texts)


# the scene ------------------------------------------------------------------------------------------------------
class _Commands:
    """Stands in for meshcat's window: keeps every command instead of sending it to a server."""

    def __init__(self):
        self.sent: list[str] = []  # base64 text of the bytes that a server would pass on
        self._names: dict[bytes, bytes] = {}

    def send(self, command: Any) -> None:
        """Keep one command. Its identifiers tell the machine and the time; counted ones make equal files."""
        packed = _UUID.sub(self._counted, umsgpack.packb(command.lower()))
        self.sent.append(base64.b64encode(packed).decode("ascii"))

    def _counted(self, found: re.Match[bytes]) -> bytes:
        return self._names.setdefault(found[0], b"%08x-0000-4000-8000-000000000000" % len(self._names))


def _light(vis: meshcat.Visualizer) -> None:
    """Lights and a bright background."""
    hidden = ("/Axes", "/Grid", "/Lights/PointLightNegativeX", "/Lights/PointLightPositiveX")
    lamp = "/Lights/SpotLight/<object>"
    for path, key, value in (
        ("/Background", "top_color", [1.0, 1.0, 1.0]),
        ("/Background", "bottom_color", [0.90, 0.92, 0.95]),
        *((name, "visible", False) for name in hidden),
        ("/Lights/AmbientLight/<object>", "intensity", 0.7),
        ("/Lights/FillLight/<object>", "intensity", 0.25),
        ("/Lights/SpotLight", "visible", True),
        (lamp, "intensity", 0.38),
        (lamp, "angle", 0.55),
        (lamp, "penumbra", 0.6),
        (lamp, "position", [0.4, -1.6, 6.0]),
    ):
        vis[path].set_property(key, value)


def _put(node: meshcat.Visualizer, shape: Any, place: pin.SE3 | Sequence[float] | None, color: str) -> None:
    """A shape at a pose or at a point [m], without much shine, so that its colour itself is seen."""
    node.set_object(shape, shapes.MeshPhongMaterial(color=int(color[1:], 16), shininess=12, specular=0x222222))
    if place is not None:
        pose = place if isinstance(place, pin.SE3) else pin.SE3(np.eye(3), np.asarray(place, float))
        node.set_transform(pose.homogeneous)


# the ground -----------------------------------------------------------------------------------------------------
def _lay_ground(vis: meshcat.Visualizer, scene: Scene, span: tuple[float, float], marks: Sequence[float]) -> None:
    """Blocks of the scene between ``span`` [m] with a grid on top, and lines across at ``marks`` [m]."""
    seen, across = scene.within(*span, TRACK_HALF_WIDTH_M).blocks, 2 * TRACK_HALF_WIDTH_M
    for number, block in enumerate(seen):
        node, wide = vis[f"{ROOT}/ground/{number}"], float(block.y_to - block.y_from)
        size, (x, y) = [float(block.x_to - block.x_from), wide], (block.x_from + block.x_to, block.y_from + block.y_to)
        depth = float(block.top - min(b.top for b in seen) + TRACK_DEPTH_M - TOP_M)
        _put(node["side"], shapes.Box([*size, depth]), (x / 2, y / 2, block.top - TOP_M - depth / 2), TRACK_SIDE)
        _put(node["top"], shapes.Box([*size, TOP_M]), (x / 2, y / 2, block.top - TOP_M / 2), TRACK_COLOR)
        if not block.even:
            pivot = np.array([block.pivot_m, 0.0, block.top])
            node.set_transform(pin.SE3(block.turn, pivot - block.turn @ pivot).homogeneous)
        for name, (step, lift, color) in GRIDS.items() if wide == across else ():
            _grid(node[name], block.x_from, block.x_to, block.top + LINE_LIFT_M * lift, step, color)
    for number, x in enumerate(marks):
        line = shapes.Box([MARK_M, across, 0.003])
        _put(vis[f"{ROOT}/marks/{number}"], line, (x, 0.0, scene.top_at(x) + 0.0025), VERMILION)


def _grid(node: meshcat.Visualizer, start: float, end: float, top: float, step: float, color: str) -> None:
    half = TRACK_HALF_WIDTH_M
    across = step * np.arange(np.ceil(start / step), np.floor(end / step) + 1)
    along = step * np.arange(-np.floor(half / step), np.floor(half / step) + 1)
    points = [(x, y, top) for x in across for y in (-half, half)] + [(x, y, top) for y in along for x in (start, end)]
    line = shapes.LineBasicMaterial(color=int(color[1:], 16))
    node.set_object(shapes.LineSegments(shapes.PointsGeometry(np.array(points, np.float32).T), line))


# the robot ------------------------------------------------------------------------------------------------------
def _add_robot(vis: meshcat.Visualizer, parts: Sequence[Part], name: str) -> dict[str, list[str]]:
    """The parts of a robot, below one node per joint.

    Returns the paths to paint: "trunk" and "limb", whose colour tells the phase, and the "rest".
    """
    painted = {"trunk": [], "limb": [], "rest": []}
    for number, part in enumerate(parts):
        place = f"{ROOT}/{name}/{part.joint}/{part.kind}"
        look = dict(shininess=12, specular=0x222222, flatShading=part.faceted)
        surface = shapes.TriangularMeshGeometry(part.points, part.triangles)
        vis[f"{place}/{number}"].set_object(surface, shapes.MeshPhongMaterial(color=int(REST_COLOR[1:], 16), **look))
        painted[part.kind].append(f"/meshcat/{place}")
    return {kind: list(dict.fromkeys(paths)) for kind, paths in painted.items()}


@dataclass(frozen=True)
class _Trace:
    """Where the robot is at the frames of a motion."""

    poses: np.ndarray  # (N, njoints - 1, 7) of the joints, base first: x y z [m], quaternion x y z w
    com: np.ndarray  # (N, 3) [m]
    feet: np.ndarray  # (N, 2, 3) origins of the foot links [m]
    toes: np.ndarray  # (N,) mean x of the two toes [m]

    @classmethod
    def of(cls, motion: Motion, robot: Robot) -> _Trace:
        model, data = robot.model, robot.model.createData()
        frames, toe = [model.getFrameId(f) for f in robot.foot.frames], robot.foot.corners[2:].mean(axis=0)
        poses, com, feet, toes = [], [], [], []
        for q in motion.q:
            com.append(pin.centerOfMass(model, data, q).copy())
            places = [pin.updateFramePlacement(model, data, frame).copy() for frame in frames]
            poses.append([pin.SE3ToXYZQUAT(data.oMi[j]) for j in range(1, model.njoints)])
            feet.append([place.translation for place in places])
            toes.append(np.mean([place.act(toe)[0] for place in places]))
        return cls(*map(np.array, (poses, com, feet, toes)))


def _forces(motion: Motion, times: np.ndarray, feet: np.ndarray, scene: Scene) -> np.ndarray | None:
    """Centre of pressure and force (N, 2, 6) [m, N] of each foot (N, 2, 3) at ``times`` (N,), world axes; or None.

    A force is the mean over the time from frame to frame, as that of an impact depends on the engine's step; where
    nothing presses on a foot, there is nan.
    """
    if motion.wrench is None:
        return None
    half = (times[1] - times[0]) / 2 if len(times) > 1 else 1.0
    first, last = np.searchsorted(motion.t, times - half), np.searchsorted(motion.t, times + half, side="right")
    first = np.minimum(first, last - 1)  # frames may be closer than samples
    sums = np.concatenate([np.zeros((1, 2, 6)), np.cumsum(motion.wrench, axis=0)])
    fx, fy, fz, mx, my, _ = np.moveaxis((sums[last] - sums[first]) / (last - first)[:, None, None], -1, 0)
    fz = np.where(fz > CONTACT_FORCE_N, fz, np.nan)
    top = np.vectorize(scene.top_at, otypes=[float])(feet[:, :, 0])
    down = top - feet[:, :, 2]  # the moment about this point of the ground has no horizontal part
    x, y = feet[:, :, 0] + (down * fx - my) / fz, feet[:, :, 1] + (down * fy + mx) / fz
    forces = np.stack([x, y, top, fx, fy, fz], -1)
    forces[np.isnan(fz)] = np.nan
    return forces


def _values(whole: Motion, motion: Motion, robot: Robot, trace: _Trace, forces: np.ndarray | None) -> np.ndarray:
    """What the page's table and curves show (N, 10): travel of the toes, rise of the CoM since take-off [m], then the
    columns of :data:`CURVES`.
    """
    air = np.flatnonzero(whole.phase == "flight")
    start = pin.centerOfMass(robot.model, robot.model.createData(), whole.q[air[0] if len(air) else 0])[2]
    names = robot.joint_names
    pairs = [[names.index(name) for name in robot.joints[role]] for role in LEG]
    angles = [np.degrees(motion.q[:, 7 + pair[0]]) for pair in pairs]
    shares = np.abs(motion.tau) / [robot.actuators[name]["effort"] for name in names]
    pressed = np.full(len(motion.t), np.nan) if forces is None else np.nansum(forces[:, :, 5], axis=1)
    height = trace.com[:, 2]
    columns = [
        trace.toes - trace.toes[0],
        height - start,
        height,
        *angles,
        *(shares[:, pair].max(axis=1) for pair in pairs),
    ]
    return np.stack([*columns, pressed / (robot.total_mass * GRAVITY)], -1)


def _add_trail(node: meshcat.Visualizer, motion: Motion, path: np.ndarray) -> None:
    """Beads along the path (N, 3) of the CoM in the colours of the phases."""
    landing = np.flatnonzero(motion.phase == "landing")
    until = motion.t[landing[0]] + TRAIL_AFTER_TOUCHDOWN_S if len(landing) else motion.t[-1]
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    beads = np.searchsorted(run, np.arange(0.0, run[np.searchsorted(motion.t, until) - 1], BEAD_M))
    for number, row in enumerate(beads[beads < len(path)]):
        color = PHASE_COLORS[str(motion.phase[row])]
        _put(node[str(number)], shapes.Sphere(BEAD_RADIUS_M), path[row], color)
