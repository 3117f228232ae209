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

import matplotlib.colors as mcolors
import meshcat
import meshcat.geometry as shapes
import numpy as np
import pinocchio as pin
import umsgpack
from pinocchio.visualize import MeshcatVisualizer

from jumplab.errors import InputError, RobotError
from jumplab.io.folder import write_file
from jumplab.io.motion import Motion, Record
from jumplab.robot import Robot
from jumplab.show.bodies import ABOVE_M, JOINT_RADIUS_M, LIMB_SHARE, ROD_RADIUS_M, skeleton
from jumplab.show.style import PHASE_COLORS, VERMILION, describe_task, tint
from jumplab.sim.scene import Scene
from jumplab.task import JumpTask

FPS = 50.0  # frames a second: every twentieth sample of a log; the page turns smoothly between them
AHEAD_M = 0.75  # ground that is seen behind the start and beyond the end of the jump
RULER_M = 0.5  # spacing of the numbers along the ground
NOTEBOOK_HEIGHT_PX = 520  # height of the frame in a notebook
GHOST_ALPHA = 0.35  # strength of the plan where simulation and plan are shown together
TRACK_HALF_WIDTH_M, TRACK_DEPTH_M, TOP_M = 0.6, 0.06, 0.004  # the ground as drawn, and the thickness of its surface
LINE_LIFT_M = 0.0015  # lines lie this much above the ground, so that they are not hidden by it
MARK_M = 0.012  # width of a line across the ground
BEAD_M, BEAD_RADIUS_M = 0.03, 0.007  # spacing and size of the beads along the path of the CoM
TRAIL_AFTER_TOUCHDOWN_S = 0.6  # later the CoM hardly moves
TRACK_COLOR, TRACK_SIDE = "#F4F5F7", "#C9CED6"
GRIDS = {"fine": (0.1, 1.0, "#DDE1E7"), "coarse": (0.5, 1.3, "#AEB6C2")}  # spacing [m], lift [LINE_LIFT_M], colour
REST_COLOR = "#42474F"  # feet and skeleton, whose colour stays
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
    motions = {k: (r if isinstance(r, Motion) else Motion.of(r)).every(fps) for k, r in given.items()}
    scene, commands = scene or Scene.flat(), _Commands()
    vis = meshcat.Visualizer(window=commands)
    _light(vis)
    clips, places = [], []
    for name, motion in motions.items():
        painted, (poses, path) = _add_robot(vis, robot, name), _trace(motion, robot)
        _add_trail(vis[f"{ROOT}/{name}/trail"], motion, path)
        clips.append({"name": name, **painted, **_clip(motion, poses)})
        places += list(map(float, path[:, 0]))
    toe = robot.foot.toe - float(robot.foot.center[0])
    marks = [toe + goal for goal in (0.0, *([task.distance_m] if task else []), *marks_m)]
    span = min(places + marks) - AHEAD_M, max(places + marks) + AHEAD_M
    _lay_ground(vis, scene, span, marks)
    rest = tint(REST_COLOR, 1.0)
    facts = {  # what player.js reads
        "title": title or (describe_task(task) if task else "A jump"),
        "note": f"robot {robot.name}, {robot.total_mass:.0f} kg · {fps:g} frames per second",
        "fps": fps,
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
        "poses": base64.b64encode(poses.astype("<f4").tobytes()).decode("ascii"),
        "phases": [[float(motion.t[k] - motion.t[0]), str(motion.phase[k])] for k in cuts],
    }


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


class _Loader(MeshcatVisualizer):
    """Pinocchio's visualizer, whose node names put each shape below the joint that moves it."""

    def getViewerNodeName(self, geometry_object: Any, geometry_type: Any) -> str:
        return f"{self.viewerRootNodeName}/{geometry_object.parentJoint}/{self.kinds[geometry_object.name]}"

    def _check_meshcat_has_get_image(self) -> None:
        """Nobody takes pictures of a page that is only written."""


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
def _add_robot(vis: meshcat.Visualizer, robot: Robot, name: str) -> dict[str, list[str]]:
    """Shapes of the URDF and the skeleton between the pitch joints, below one node per joint.

    Returns the paths to paint: "trunk" and "limb", whose colour tells the phase, and the "rest".
    """
    geometry, root = _visuals(robot), f"{ROOT}/{name}"
    feet = {robot.model.getFrameId(frame) for frame in robot.foot.frames}
    kinds, painted = {}, {"trunk": [], "limb": [], "rest": []}
    for number, shape in enumerate(geometry.geometryObjects):
        kind = "rest" if shape.parentFrame in feet else "trunk" if shape.parentJoint == 1 else "limb"
        kinds[shape.name] = f"{kind}/{number}"
        painted[kind].append(f"/meshcat/{root}/{shape.parentJoint}/{kind}")
    loader = _Loader(robot.model, None, geometry)
    loader.kinds, loader.viewerRootNodeName = kinds, root
    loader.initViewer(viewer=vis)
    for shape in geometry.geometryObjects:
        loader.loadViewerGeometryObject(shape, pin.GeometryType.VISUAL, [*mcolors.to_rgb(REST_COLOR), 1.0])
        node = vis[loader.getViewerNodeName(shape, pin.GeometryType.VISUAL)]
        node.set_transform(shape.placement.homogeneous @ np.diag([*shape.meshScale, 1.0]))
    for joint, rod in skeleton(robot, (0, 1, 0)):
        _put(vis[f"{root}/{joint}/rest/ball"], shapes.Sphere(JOINT_RADIUS_M), None, REST_COLOR)
        painted["rest"].append(f"/meshcat/{root}/{joint}/rest")
        if rod:
            above, length, place = rod
            _put(vis[f"{root}/{above}/rest/rod{joint}"], shapes.Cylinder(length, ROD_RADIUS_M), place, REST_COLOR)
    return {kind: list(dict.fromkeys(paths)) for kind, paths in painted.items()}


def _visuals(robot: Robot) -> pin.GeometryModel:
    """Visual shapes of the URDF; none if they lie in mesh files, which the robot's text does not carry."""
    try:
        return pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.VISUAL)
    except ValueError as e:
        if "mesh" not in str(e).lower():
            raise RobotError(f"robot {robot.name}: Pinocchio cannot read its shapes: {str(e).splitlines()[0]}") from e
        return pin.GeometryModel()


def _trace(motion: Motion, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, njoints - 1, 7) of the joints, base first: x y z [m] and quaternion x y z w; path (N, 3) of the CoM."""
    model, data = robot.model, robot.model.createData()
    poses, path = [], []
    for q in motion.q:
        path.append(pin.centerOfMass(model, data, q).copy())
        poses.append([pin.SE3ToXYZQUAT(data.oMi[j]) for j in range(1, model.njoints)])
    return np.array(poses), np.array(path)


def _add_trail(node: meshcat.Visualizer, motion: Motion, path: np.ndarray) -> None:
    """Beads along the path (N, 3) of the CoM in the colours of the phases."""
    landing = np.flatnonzero(motion.phase == "landing")
    until = motion.t[landing[0]] + TRAIL_AFTER_TOUCHDOWN_S if len(landing) else motion.t[-1]
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    beads = np.searchsorted(run, np.arange(0.0, run[np.searchsorted(motion.t, until) - 1], BEAD_M))
    for number, row in enumerate(beads[beads < len(path)]):
        color = PHASE_COLORS[str(motion.phase[row])]
        _put(node[str(number)], shapes.Sphere(BEAD_RADIUS_M), path[row], color)
