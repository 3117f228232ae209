"""The 3-D scene as meshcat commands: ground, robot, path of the CoM, lights.

meshcat is normally fed through a server. Here its commands are collected instead, so that no process is started and no
port is opened; the page replays them when it is opened.
"""

from __future__ import annotations

import base64
import itertools
import re
from collections.abc import Sequence
from typing import Any

import matplotlib.colors as mcolors
import meshcat
import meshcat.geometry as shapes
import numpy as np
import pinocchio as pin
import umsgpack
from pinocchio.visualize import MeshcatVisualizer

from jumplab.errors import RobotError
from jumplab.io.motion import Motion
from jumplab.robot import Robot
from jumplab.show.render import JOINT_RADIUS_M, ROD_RADIUS_M
from jumplab.show.style import PHASE_COLORS, VERMILION
from jumplab.sim.scene import Scene

TRACK_HALF_WIDTH_M = 0.6  # our choice: of the ground that is drawn
TRACK_DEPTH_M = 0.06  # our choice: thickness of the ground as drawn
FINE_M, COARSE_M = 0.1, 0.5  # our choice: spacing of the grid's lines
LINE_LIFT_M = 0.0015  # lines lie this much above the ground, so that they are not hidden by it
MARK_M = 0.012  # width of a line across the ground
BEAD_M, BEAD_RADIUS_M = 0.03, 0.007  # our choice: spacing and size of the beads along the path of the CoM
TRAIL_AFTER_TOUCHDOWN_S = 0.6  # our choice: later the CoM hardly moves
GHOST_ALPHA = 0.35  # our choice: strength of the plan where simulation and plan are shown together
TRACK_COLOR, TRACK_SIDE, FINE_COLOR, COARSE_COLOR = "#F4F5F7", "#C9CED6", "#DDE1E7", "#AEB6C2"
REST_COLOR = "#42474F"  # our choice: feet and skeleton, whose colour stays
ROOT = "jump"
_UUID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


class Commands:
    """Stands in for meshcat's window: keeps every command instead of sending it to a server."""

    def __init__(self):
        self.sent: list[str] = []
        self._names: dict[str, str] = {}

    def send(self, command: Any) -> None:
        """Keep one command, as base64 text of the bytes that a server would pass on."""
        self.sent.append(base64.b64encode(umsgpack.packb(self._numbered(command.lower()))).decode("ascii"))

    def _numbered(self, data: Any) -> Any:
        """meshcat's identifiers tell the machine and the time; counted ones make equal scenes equal files."""
        if isinstance(data, dict):
            return {key: self._numbered(value) for key, value in data.items()}
        if isinstance(data, list):
            return [self._numbered(value) for value in data]
        if isinstance(data, str) and _UUID.fullmatch(data):
            return self._names.setdefault(data, f"{len(self._names):08x}-0000-4000-8000-000000000000")
        return data


class _Loader(MeshcatVisualizer):
    """Pinocchio's visualizer, whose node names put each shape below the joint that moves it."""

    def getViewerNodeName(self, geometry_object: Any, geometry_type: Any) -> str:
        return f"{self.viewerRootNodeName}/{geometry_object.parentJoint}/{self.kinds[geometry_object.name]}"

    def _check_meshcat_has_get_image(self) -> None:
        """Nobody takes pictures of a page that is only written."""


def paint(color: str) -> shapes.MeshPhongMaterial:
    """Material of one colour; weak highlights, so that the colour itself is seen."""
    return shapes.MeshPhongMaterial(color=int(color[1:], 16), shininess=12, specular=0x222222)


def new_stage() -> tuple[meshcat.Visualizer, Commands]:
    """An empty scene with lights and a bright background, and the commands that make it."""
    commands = Commands()
    vis = meshcat.Visualizer(window=commands)
    vis["/Background"].set_property("top_color", [1.0, 1.0, 1.0])
    vis["/Background"].set_property("bottom_color", [0.90, 0.92, 0.95])
    for name in ("/Axes", "/Grid", "/Lights/PointLightNegativeX", "/Lights/PointLightPositiveX"):
        vis[name].set_property("visible", False)
    vis["/Lights/AmbientLight/<object>"].set_property("intensity", 0.7)
    vis["/Lights/FillLight/<object>"].set_property("intensity", 0.25)
    vis["/Lights/SpotLight"].set_property("visible", True)
    lamp = vis["/Lights/SpotLight/<object>"]
    for key, value in {"intensity": 0.38, "angle": 0.55, "penumbra": 0.6}.items():
        lamp.set_property(key, value)
    lamp.set_property("position", [0.4, -1.6, 6.0])
    return vis, commands


# the ground -----------------------------------------------------------------------------------------------------
def lay_ground(vis: meshcat.Visualizer, scene: Scene, span: tuple[float, float], marks: Sequence[float]) -> None:
    """Blocks of the scene between ``span`` [m] with a grid on top, and lines across at ``marks`` [m]."""
    seen = [b for b in scene.blocks if max(b.x_from, span[0]) < min(b.x_to, span[1])]
    for number, block in enumerate(seen):
        start, end = max(block.x_from, span[0]), min(block.x_to, span[1])
        node = vis[f"{ROOT}/ground/{number}"]
        depth = block.top - min(b.top for b in seen) + TRACK_DEPTH_M
        _box(node["side"], (end - start, 2 * TRACK_HALF_WIDTH_M, depth - 0.004),
             ((start + end) / 2, 0.0, block.top - 0.004 - (depth - 0.004) / 2), TRACK_SIDE)  # fmt: skip
        _box(node["top"], (end - start, 2 * TRACK_HALF_WIDTH_M, 0.004),
             ((start + end) / 2, 0.0, block.top - 0.002), TRACK_COLOR)  # fmt: skip
        for name, step, color in (("fine", FINE_M, FINE_COLOR), ("coarse", COARSE_M, COARSE_COLOR)):
            _grid(node[name], start, end, block.top + LINE_LIFT_M * (1 if name == "fine" else 1.3), step, color)
    for number, x in enumerate(marks):
        _box(vis[f"{ROOT}/marks/{number}"], (MARK_M, 2 * TRACK_HALF_WIDTH_M, 0.003),
             (x, 0.0, scene.top_at(x) + 0.0025), VERMILION)  # fmt: skip


def _box(node: meshcat.Visualizer, size: Sequence[float], place: Sequence[float], color: str) -> None:
    node.set_object(shapes.Box([float(x) for x in size]), paint(color))
    node.set_transform(pin.SE3(np.eye(3), np.asarray(place, float)).homogeneous)


def _grid(node: meshcat.Visualizer, start: float, end: float, top: float, step: float, color: str) -> None:
    across = step * np.arange(np.ceil(start / step), np.floor(end / step) + 1)
    along = step * np.arange(-np.floor(TRACK_HALF_WIDTH_M / step), np.floor(TRACK_HALF_WIDTH_M / step) + 1)
    ends = [((x, -TRACK_HALF_WIDTH_M), (x, TRACK_HALF_WIDTH_M)) for x in across]
    ends += [((start, y), (end, y)) for y in along]
    points = np.array([(x, y, top) for pair in ends for x, y in pair], np.float32)
    line = shapes.LineBasicMaterial(color=int(color[1:], 16))
    node.set_object(shapes.LineSegments(shapes.PointsGeometry(points.T), line))


# the robot ------------------------------------------------------------------------------------------------------
def add_robot(vis: meshcat.Visualizer, robot: Robot, name: str) -> dict[str, list[str]]:
    """Shapes of the URDF and the skeleton between the pitch joints, below one node per joint.

    Returns
    -------
    Paths to paint: "trunk" and "limb", whose colour tells the phase, and the "rest".
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
    painted["rest"] += [f"/meshcat/{root}/{joint}/rest" for joint in _add_skeleton(vis[root], robot)]
    return {kind: list(dict.fromkeys(paths)) for kind, paths in painted.items()}


def _visuals(robot: Robot) -> pin.GeometryModel:
    """Visual shapes of the URDF; none if they lie in mesh files, which the robot's text does not carry."""
    try:
        return pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.VISUAL)
    except ValueError as e:
        if "mesh" not in str(e).lower():
            raise RobotError(f"robot {robot.name}: Pinocchio cannot read its shapes: {str(e).splitlines()[0]}") from e
        return pin.GeometryModel()


def _add_skeleton(node: meshcat.Visualizer, robot: Robot) -> list[int]:
    """A ball for every pitch joint, and a rod from it to the next one above it in the same limb; the joints."""
    model, material = robot.model, paint(REST_COLOR)
    joints = [model.getJointId(name) for pair in robot.joints.values() for name in pair]
    for joint in joints:
        node[f"{joint}/rest/ball"].set_object(shapes.Sphere(JOINT_RADIUS_M), material)
        above, span = model.parents[joint], np.array(model.jointPlacements[joint].translation)
        if above in joints:
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 1.0, 0.0]), span).toRotationMatrix()
            rod = node[f"{above}/rest/rod{joint}"]
            rod.set_object(shapes.Cylinder(float(np.linalg.norm(span)), ROD_RADIUS_M), material)
            rod.set_transform(pin.SE3(turn, span / 2).homogeneous)
    return joints


def joint_poses(motion: Motion, robot: Robot) -> np.ndarray:
    """(N, njoints - 1, 7) places of the joints, base first: x y z, then quaternion x y z w of the world's."""
    model, data = robot.model, robot.model.createData()
    out = np.empty((len(motion.t), model.njoints - 1, 7))
    for k, q in enumerate(motion.q):
        pin.forwardKinematics(model, data, q)
        out[k] = [pin.SE3ToXYZQUAT(data.oMi[j]) for j in range(1, model.njoints)]
    return out


# the path of the CoM --------------------------------------------------------------------------------------------
def add_trail(vis: meshcat.Visualizer, motion: Motion, robot: Robot, name: str) -> np.ndarray:
    """Beads along the path of the CoM in the colours of the phases; returns the path (N, 3) [m]."""
    model, data = robot.model, robot.model.createData()
    path = np.array([pin.centerOfMass(model, data, q).copy() for q in motion.q])
    landing = np.flatnonzero(motion.phase == "landing")
    until = motion.t[landing[0]] + TRAIL_AFTER_TOUCHDOWN_S if len(landing) else motion.t[-1]
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    beads = np.searchsorted(run, np.arange(0.0, run[np.searchsorted(motion.t, until) - 1], BEAD_M))
    for number, row in enumerate(itertools.takewhile(lambda k: k < len(path), beads)):
        bead = vis[f"{ROOT}/{name}/trail/{number}"]
        bead.set_object(shapes.Sphere(BEAD_RADIUS_M), paint(PHASE_COLORS[str(motion.phase[row])]))
        bead.set_transform(pin.SE3(np.eye(3), path[row]).homogeneous)
    return path
