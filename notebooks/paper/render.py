"""Rendered pictures of logged states: the frame strip of a jump (Fig. 11), and what others are made with.

PyBullet's software renderer draws the shapes that the simulation collides with; neither a display nor a graphics driver
is needed. Nothing here is simulated: a state is taken from a log, the robot is put there, the camera looks.

>>> with Renderer(robot) as studio:
...     picture = studio.picture(result.q[0], Camera(x=0.5))
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import matplotlib.colors as mcolors
import numpy as np
import pinocchio as pin
from matplotlib.figure import Figure

from jumplab.robot import Robot
from jumplab.show.bodies import ABOVE_M, JOINT_RADIUS_M, LIMB_SHARE, ROD_RADIUS_M, skeleton
from jumplab.show.jumps import AFTER_TOUCHDOWN_S
from jumplab.show.style import PAGE_IN, PHASE_COLORS, VERMILION, bare, new_figure, shade, styled, tint
from jumplab.sim.bullet import base_to_bullet, bullet, load_urdf
from jumplab.sim.scene import Scene

if TYPE_CHECKING:
    from jumplab.sim import SimulationResult

OVERSAMPLING = 2  # the renderer does not smooth edges, so pictures are drawn larger and averaged
STRIPE_M = 0.25  # the ground is striped, so that distances can be counted
SEEN_M, HALF_WIDTH_M = (-4.5, 4.5), 0.45  # what is built of the ground; the longest jump allowed is 3 m
GREYS, JOINT_GREY = (0.87, 0.76), 0.35
COLUMNS = 6  # frames per line of a page-wide strip, each then 1.2 in wide
TITLE_IN = 0.17  # room for a frame's title
MARK_M = 0.015  # width of a line on the ground
LIGHT = {"lightDirection": (0.4, -1.6, 2.4), "lightColor": (1, 1, 1), "lightDistance": 4.0, "shadow": 0}
SHINE = {"lightAmbientCoeff": 0.65, "lightDiffuseCoeff": 0.4, "lightSpecularCoeff": 0.0}
DISTANCE_M = 10.0  # far away, so that near and far legs look equally large
BELOW_M = 0.14  # seen below the ground


@dataclass(frozen=True)
class Camera:
    """What the picture shows, in the plane through ``x`` that faces the camera."""

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

    def matrices(self) -> tuple[list[float], list[float]]:
        """View and projection as PyBullet wants them."""
        target = (self.x, 0.0, (self.top + self.bottom) / 2)
        opening = 2 * np.degrees(np.arctan((self.top - self.bottom) / 2 / DISTANCE_M))
        width, height = self.size
        view = bullet.computeViewMatrixFromYawPitchRoll(target, DISTANCE_M, self.yaw_deg, self.pitch_deg, 0.0, 2)
        return view, bullet.computeProjectionMatrixFOV(opening, width / height, 1.0, 2 * DISTANCE_M)


class Renderer(AbstractContextManager):
    """A robot on the ground of a scene (flat if None), with lines across at ``marks`` [m].

    Use as a context manager, or call :meth:`close`.
    """

    def __init__(self, robot: Robot, *, scene: Scene | None = None, marks: Sequence[float] = ()):
        self.robot, self._data = robot, robot.model.createData()
        self._client = bullet.connect(bullet.DIRECT)
        self._here = {"physicsClientId": self._client}
        self._marks: list[tuple[int, int, pin.SE3]] = []  # shape, the joint that carries it, its place there
        try:
            self._body = load_urdf(robot.urdf, robot.name, self._client)
            self._lever = np.array(bullet.getDynamicsInfo(self._body, -1, **self._here)[3])
            count = bullet.getNumJoints(self._body, **self._here)
            info = [bullet.getJointInfo(self._body, i, **self._here) for i in range(count)]
            self._joints = {row[1].decode(): i for i, row in enumerate(info)}
            self._paint = {row[1]: row[7] for row in bullet.getVisualShapeData(self._body, **self._here)}
            feet = {i for i, row in enumerate(info) if row[12].decode() in robot.foot.frames}
            self._limbs = set(self._paint) - feet - {-1}
            self._lay_ground(scene or Scene.flat(), marks)
            self._add_skeleton()
        except BaseException:
            self.close()
            raise

    def __exit__(self, *exc) -> None:
        self.close()

    def close(self) -> None:
        """Free the engine."""
        if self._client is not None:
            bullet.disconnect(**self._here)
            self._client = None

    def picture(self, q: np.ndarray, camera: Camera, color: str | None = None) -> np.ndarray:
        """The robot at configuration ``q`` (nq,), in its own colours or in ``color``: (height, width, 3), 0 ... 1."""
        self._pose(np.asarray(q, float))
        for link, own in self._paint.items():
            painted = color is not None and (link == -1 or link in self._limbs)
            paint = (*tint(color, 1.0 if link == -1 else LIMB_SHARE), 1.0) if painted else own
            bullet.changeVisualShape(self._body, link, rgbaColor=paint, **self._here)
        width, height = (OVERSAMPLING * n for n in camera.size)
        look = {"renderer": bullet.ER_TINY_RENDERER, **LIGHT, **SHINE}
        shot = bullet.getCameraImage(width, height, *camera.matrices(), **look, **self._here)
        image = np.reshape(shot[2], (height, width, 4))[:, :, :3] / 255.0
        image[np.reshape(shot[4], (height, width)) < 0] = 1.0  # where no body is: white
        return image.reshape(camera.size[1], OVERSAMPLING, camera.size[0], OVERSAMPLING, 3).mean(axis=(1, 3))

    def _add(self, kind: int, place: Sequence[float], color: Sequence[float], **shape) -> int:
        visual = bullet.createVisualShape(kind, rgbaColor=(*color, 1.0), **shape, **self._here)
        return bullet.createMultiBody(0, -1, visual, basePosition=place, **self._here)

    def _slab(self, start: float, end: float, top: float, thickness: float, color: Sequence[float]) -> None:
        half = [(end - start) / 2, HALF_WIDTH_M, thickness / 2]
        self._add(bullet.GEOM_BOX, [(start + end) / 2, 0.0, top - thickness / 2], color, halfExtents=half)

    def _lay_ground(self, scene: Scene, marks: Sequence[float]) -> None:
        lowest = min((block.top for block in scene.blocks), default=0.0)
        for block in scene.blocks:
            start, end = max(block.x_from, SEEN_M[0]), min(block.x_to, SEEN_M[1])
            cuts = [start, *np.arange(np.floor(start / STRIPE_M) + 1, np.ceil(end / STRIPE_M)) * STRIPE_M, end]
            depth = block.top - lowest or 0.05  # walls of ditches and platforms reach down to the lowest ground
            for a, b in itertools.pairwise(cuts):
                if b - a > 1e-9:
                    grey = GREYS[int(np.floor((a + b) / 2 / STRIPE_M)) % 2]
                    self._slab(a, b, block.top, depth, (grey,) * 3)
        for x in marks:
            top = scene.top_at(x) + 0.002
            self._slab(x - MARK_M / 2, x + MARK_M / 2, top, 0.004, mcolors.to_rgb(VERMILION))

    def _add_skeleton(self) -> None:
        place, grey = (0, 0, 0), (JOINT_GREY,) * 3
        for joint, rod in skeleton(self.robot, (0, 0, 1)):
            ball = self._add(bullet.GEOM_SPHERE, place, grey, radius=JOINT_RADIUS_M)
            self._marks.append((ball, joint, pin.SE3.Identity()))
            if rod:
                above, length, at = rod
                shape = self._add(bullet.GEOM_CYLINDER, place, grey, radius=ROD_RADIUS_M, length=length)
                self._marks.append((shape, above, at))

    def _pose(self, q: np.ndarray) -> None:
        place, attitude, *_ = base_to_bullet(q, np.zeros(6), self._lever)
        bullet.resetBasePositionAndOrientation(self._body, place, attitude, **self._here)
        for name, angle in zip(self.robot.joint_names, q[7:], strict=True):
            bullet.resetJointState(self._body, self._joints[name], float(angle), **self._here)
        pin.forwardKinematics(self.robot.model, self._data, q)
        for shape, joint, at in self._marks:
            pose = pin.SE3ToXYZQUAT(self._data.oMi[joint] * at)
            bullet.resetBasePositionAndOrientation(shape, pose[:3], pose[3:], **self._here)


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
    with Renderer(robot, scene=scene, marks=marks) as studio:
        draw_frames(axes.flat, studio, result, rows, camera)
    return fig
