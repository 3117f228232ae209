"""Rendered pictures of logged states: the frame strip of a jump (Fig. 11), and what others are made with.

Drawn here, ray by ray: no physics engine, display or graphics library is needed. Nothing is simulated: a state
is taken from a log, the robot is put there, the camera looks.

>>> picture = Renderer(robot).picture(result.q[0], Camera(x=0.5))
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import matplotlib.colors as mcolors
import numpy as np
import pinocchio as pin
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

from jumplab.robot import Robot
from jumplab.show.bodies import ABOVE_M
from jumplab.show.jumps import AFTER_TOUCHDOWN_S
from jumplab.show.shapes import LIMB_SHARE, REST_COLOR, rounded_body
from jumplab.show.style import PAGE_IN, PHASE_COLORS, VERMILION, bare, new_figure, shade, styled, tint
from jumplab.sim.scene import Scene

if TYPE_CHECKING:
    from jumplab.sim import SimulationResult

OVERSAMPLING = 2  # pictures are drawn larger and averaged, which smooths edges
COARSE_M = 0.01  # grid of the corners of a body: finer looks the same, and takes longer
STRIPE_M = 0.25  # the ground is striped, so that distances can be counted
SEEN_M, HALF_WIDTH_M = (-4.5, 4.5), 0.45  # what is built of the ground; the longest jump allowed is 3 m
GREYS = 0.87, 0.76
BODY = {"trunk": "#4C5A70", "limb": "#BFC7D1", "rest": REST_COLOR}  # a robot outside of any phase
COLUMNS = 6  # frames per line of a page-wide strip, each then 1.2 in wide
TITLE_IN = 0.17  # space for a frame's title
MARK_M = 0.015  # width of a line on the ground
LIGHT = np.array([0.4, -1.6, 2.4]) / np.linalg.norm([0.4, -1.6, 2.4])  # towards the lamp
AMBIENT, DIFFUSE = 0.65, 0.4  # share of its colour that a face has anyway, and that the lamp adds
DISTANCE_M = 10.0  # far away, so that near and far legs look equally large
EDGE_ON_M = 1e-9  # the plane of a face goes through the camera
BELOW_M = 0.14  # seen below the ground


@dataclass(frozen=True)
class Camera:
    """Camera of a picture, of the plane through ``x`` that faces it."""

    width: float = 1.3  # [m], enough for stretched arms
    bottom: float = -BELOW_M  # [m]
    top: float = 1.65  # [m]
    x: float = 0.0  # middle of the picture along the jump [m]
    yaw_deg: float = 0.0  # 0 looks along +y, with x to the right
    pitch_deg: float = -7.0  # negative looks down
    pixels_per_m: float = 240  # 280 pixels per inch of a page-wide strip

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return round(self.width * self.pixels_per_m), round((self.top - self.bottom) * self.pixels_per_m)

    @property
    def axes(self) -> np.ndarray:
        """Directions right, up and away of the camera (3, 3), world axes, one per row."""
        (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in np.radians([self.yaw_deg, self.pitch_deg]))
        right, away = np.array([cy, sy, 0.0]), np.array([-sy * cp, cy * cp, sp])
        return np.array([right, np.cross(right, away), away])

    @property
    def eye(self) -> np.ndarray:
        """Place of the camera (3,) [m]."""
        return np.array([self.x, 0.0, (self.top + self.bottom) / 2]) - DISTANCE_M * self.axes[2]


class Shape:
    """The convex hull of ``corners`` (n, 3) [m], which moves with a joint (0: the ground).

    ``part`` is "trunk" or "limb" where the colour of a phase replaces its own ``color`` (3,).
    """

    def __init__(self, joint: int, corners: np.ndarray, color: Sequence[float], part: str = ""):
        self.joint, self.corners, self.color, self.part = joint, corners, np.array(color[:3]), part
        faces = np.unique(ConvexHull(corners).equations.round(9), axis=0)  # triangles of one plane are one face
        self.normals, self.offsets = faces[:, :3], faces[:, 3]


class Renderer:
    """A robot on the ground of a scene (flat if None), with lines across at ``marks`` [m].

    Its body is that of :func:`jumplab.show.shapes.rounded_body`.
    """

    def __init__(self, robot: Robot, *, scene: Scene | None = None, marks: Sequence[float] = ()):
        self.robot, self._data = robot, robot.model.createData()
        self._shapes = [*_ground(scene or Scene.flat(), marks), *_links(robot)]

    def picture(self, q: np.ndarray, camera: Camera, color: str | None = None) -> np.ndarray:
        """The robot at configuration ``q`` (nq,), in its own colours or in ``color``: (height, width, 3), 0 ... 1."""
        pin.forwardKinematics(self.robot.model, self._data, np.asarray(q, float))
        canvas = _Canvas(camera)
        for shape in self._shapes:
            paint = shape.color
            if color is not None and shape.part:
                paint = np.array(mcolors.to_rgb(tint(color, 1.0 if shape.part == "trunk" else LIMB_SHARE)))
            canvas.draw(shape, self._data.oMi[shape.joint], paint)
        width, height = camera.size
        return canvas.image.reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3).mean(axis=(1, 3))


class _Canvas:
    """A picture in the making: for every pixel the colour, and how near it is (one over the depth; 0: nothing)."""

    def __init__(self, camera: Camera):
        self._camera, self._size = camera, OVERSAMPLING * np.array(camera.size)
        self._per_depth = OVERSAMPLING * camera.pixels_per_m * DISTANCE_M  # [1] pixels per ratio of width to depth
        self.image, self._near = np.ones((*self._size[::-1], 3)), np.zeros(self._size[::-1])

    def draw(self, shape: Shape, at: pin.SE3, color: np.ndarray) -> None:
        """``shape``, where nothing nearer is drawn.

        Along a ray, one over the depth of a face's plane is linear in the pixel. A ray is inside of a convex body from
        the last plane that it enters, on the camera's side, to the first that it leaves.
        """
        right, up, away = self._camera.axes
        sight = shape.corners @ at.rotation.T + at.translation - self._camera.eye
        shown = np.column_stack([sight @ right, sight @ -up]) / (sight @ away)[:, None] * self._per_depth
        low, high = np.floor(shown.min(axis=0) + self._size / 2), np.ceil(shown.max(axis=0) + self._size / 2)
        (left, top), (end, bottom) = (np.clip(x, 0, self._size).astype(int) for x in (low, high))
        x, y = (np.arange(*of) + 0.5 - n / 2 for of, n in zip(((left, end), (top, bottom)), self._size, strict=True))
        if not (len(x) and len(y)):
            return
        normals = shape.normals @ at.rotation.T
        outside = shape.offsets + normals @ (self._camera.eye - at.translation)  # [m] of the camera, before each face
        outside = np.where(np.abs(outside) < EDGE_ON_M, EDGE_ON_M, outside)
        faces, window = outside > 0, np.s_[top:bottom, left:end]
        rays = away + (x[None, :, None] * right - y[:, None, None] * up) / self._per_depth
        near = -rays @ (normals / outside[:, None]).T
        enters = near[..., faces].min(axis=-1)
        seen = (enters >= near[..., ~faces].max(axis=-1)) & (enters > self._near[window])
        light = AMBIENT + DIFFUSE * np.maximum(normals[faces] @ LIGHT, 0.0)
        face = near[..., faces].argmin(axis=-1)[seen]
        self._near[window][seen] = enters[seen]
        self.image[window][seen] = np.minimum(light[:, None] * color, 1.0)[face]


def _box(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Corners (8, 3) of a box."""
    return np.array(list(itertools.product(*zip(low, high, strict=True))), float)


def _ground(scene: Scene, marks: Sequence[float]) -> list[Shape]:
    lowest, out = min((block.top for block in scene.blocks), default=0.0), []
    for block in scene.blocks:
        start, end = max(block.x_from, SEEN_M[0]), min(block.x_to, SEEN_M[1])
        cuts = [start, *np.arange(np.floor(start / STRIPE_M) + 1, np.ceil(end / STRIPE_M)) * STRIPE_M, end]
        depth = block.top - lowest or 0.05  # walls of ditches and platforms reach down to the lowest ground
        for a, b in itertools.pairwise(cuts):
            if b - a > 1e-9:
                grey = GREYS[int(np.floor((a + b) / 2 / STRIPE_M)) % 2]
                sides = np.clip((block.y_from, block.y_to), -HALF_WIDTH_M, HALF_WIDTH_M)
                slab = _box((a, sides[0], block.top - depth), (b, sides[1], block.top))
                if not block.even:
                    pivot = np.array([block.pivot_m, 0.0, block.top])
                    slab = pivot + (slab - pivot) @ block.turn.T
                out.append(Shape(0, slab, (grey,) * 3))
    for x in marks:
        low = (x - MARK_M / 2, -HALF_WIDTH_M, scene.top_at(x) - 0.002)
        line = _box(low, (x + MARK_M / 2, HALF_WIDTH_M, scene.top_at(x) + 0.002))
        out.append(Shape(0, line, mcolors.to_rgb(VERMILION)))
    return out


def _links(robot: Robot) -> list[Shape]:
    """The robot's body, made coarser; feet and joints keep their colour."""
    shapes = []
    for part in rounded_body(robot):
        corners = COARSE_M * np.unique(np.round(part.points / COARSE_M), axis=0)
        shapes.append(Shape(part.joint, corners, mcolors.to_rgb(BODY[part.kind]), part.kind.replace("rest", "")))
    return shapes


def frame_rows(result: SimulationResult) -> np.ndarray:
    """Twelve rows of a log worth a picture, four per phase; of a jump without flight or landing, twelve evenly spaced.

    Launch: start, crouch, half-way up, lift-off; flight: evenly; landing: touchdown, deepest, half-way up, the end.
    """
    count, flight = len(result.t), np.flatnonzero(result.phase == "flight")
    if not len(flight) or flight[0] == 0 or flight[-1] + 1 == count:
        return np.linspace(0, count - 1, 12).astype(int)
    z, off, on = result.com[:, 2], int(flight[0]), int(flight[-1]) + 1
    crouch = int(np.argmin(z[:off]))
    deepest = on + int(np.argmin(z[on : on + round(AFTER_TOUCHDOWN_S / (result.t[1] - result.t[0]))]))
    launch = [0, crouch, _halfway(z, crouch, off - 1), off - 1]
    air = [off + (on - off) * share for share in (0.125, 0.375, 0.625, 0.875)]
    return np.array([*launch, *air, on, deepest, _halfway(z, deepest, count - 1), count - 1]).astype(int)


def _halfway(z: np.ndarray, start: int, end: int) -> int:
    """First row after ``start`` that is half of the way up to the height at ``end``; in a fall, half of the time."""
    if z[end] <= z[start]:
        return (start + end) // 2
    return start + int(np.argmax(z[start : end + 1] >= (z[start] + z[end]) / 2))


def draw_frames(
    axes: np.ndarray, studio: Renderer, result: SimulationResult, rows: np.ndarray, camera: Camera, fontsize: float = 8
) -> None:
    """Rendered frames ``rows`` of a log, one per axes, in the colours of the phases; the camera follows the CoM."""
    for ax, row in zip(axes, rows, strict=True):
        phase = str(result.phase[row])
        color = PHASE_COLORS[phase]
        ax.imshow(studio.picture(result.q[row], replace(camera, x=float(result.com[row, 0])), color))
        bare(ax)
        title = f"{phase}, {result.t[row]:.2f} s"
        ax.set_title(title, loc="center", fontsize=fontsize, color=shade(color, 0.8))


@styled
def frame_strip(
    result: SimulationResult, robot: Robot, *, scene: Scene | None = None, marks: Sequence[float] = ()
) -> Figure:
    """F-11: rendered frames of a simulated jump; the stripes on the ground are 0.25 m wide.

    ``marks`` are places of lines across the ground [m], such as where the toes started and where they should land.
    """
    rows = frame_rows(result)
    floor = min(0.0, scene.top_at(float(result.com[-1, 0]))) if scene else 0.0
    camera = Camera(bottom=floor - BELOW_M, top=float(result.q[rows, 2].max()) + ABOVE_M)
    width, lines = PAGE_IN / COLUMNS, len(rows) // COLUMNS
    fig = new_figure(PAGE_IN, lines * (width * camera.size[1] / camera.size[0] + TITLE_IN))
    axes = fig.subplots(lines, COLUMNS)
    draw_frames(axes.flat, Renderer(robot, scene=scene, marks=marks), result, rows, camera)
    return fig
