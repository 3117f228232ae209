"""Rendered pictures of logged states: the simulation model (Fig. 3b) and the frame strip of a jump (Fig. 11).

PyBullet's software renderer draws the shapes that the simulation collides with; neither a display nor a graphics driver
is needed. Nothing here is simulated: a state is taken from a log, the robot is put there, the camera looks.

>>> from jumplab.plotting import render
>>> fig = render.frame_strip(result, robot, marks=(0.14, 1.14))
>>> with render.Renderer(robot) as studio:
...     picture = studio.picture(result.q[0], render.Camera(x=0.5))
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

from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.show.simulation import frame_rows
from jumplab.show.style import COLUMN_IN, PAGE_IN, PHASE_COLORS, VERMILION, bare, new_figure, shade, styled, tint
from jumplab.sim.scene import Scene
from jumplab.sim.world import base_to_bullet, bullet, load_urdf

if TYPE_CHECKING:
    from jumplab.sim import SimulationResult

OVERSAMPLING = 2  # our choice: the renderer does not smooth edges, so pictures are drawn larger and averaged
STRIPE_M = 0.25  # our choice: the ground is striped, so that distances can be counted
SEEN_M = (-4.5, 4.5)  # our choice: how much of the ground is built; the longest jump allowed is 3 m
HALF_WIDTH_M = 0.45  # our choice: of the ground that is shown
GREYS = (0.87, 0.76)
COLUMNS = 6  # our choice: frames per line of a page-wide strip, each then 1.2 in wide
TITLE_IN = 0.17  # room for a frame's title
MARK_M = 0.015  # width of a line on the ground
JOINT_RADIUS_M = 0.038  # our choice: balls that mark the pitch joints, in pictures only ...
ROD_RADIUS_M = 0.018  # ... and rods between them, as the boxes are shorter than the links, which lets them bend
JOINT_GREY = 0.35
LIMB_SHARE = 0.5  # our choice: strength of a colour on limbs, whose trunk has all of it
LIGHT = dict(
    lightDirection=(0.4, -1.6, 2.4), lightColor=(1, 1, 1), lightDistance=4.0, lightAmbientCoeff=0.65,
    lightDiffuseCoeff=0.4, lightSpecularCoeff=0.0, shadow=0)  # fmt: skip
DISTANCE_M = 10.0  # our choice: far away, so that near and far legs look equally large
PIXELS_PER_M = 240  # our choice: 280 pixels per inch of a page-wide strip
FRAME_M = 1.3  # our choice: width of a frame, enough for stretched arms
ABOVE_M, BELOW_M = 0.36, 0.14  # our choice: seen above the highest shoulder (a head is 0.3 m), and below the ground


@dataclass(frozen=True)
class Camera:
    """Where the camera is and what it sees.

    Attributes
    ----------
    width, bottom, top : what the picture shows, in the plane through ``x`` that faces the camera [m].
    x : middle of the picture along the jump [m].
    yaw_deg : 0 looks along +y, with x to the right;  pitch_deg : negative looks down.
    pixels_per_m : resolution.
    """

    width: float = FRAME_M
    bottom: float = -BELOW_M
    top: float = 1.65
    x: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = -7.0
    pixels_per_m: float = PIXELS_PER_M

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


class Renderer:
    """A robot, the ground, and a camera. Use as a context manager, or call :meth:`close`.

    Parameters
    ----------
    robot : its URDF gives the shapes.
    scene : ground; flat if None.
    marks : places of lines across the ground [m].
    """

    def __init__(self, robot: Robot, *, scene: Scene | None = None, marks: Sequence[float] = ()):
        self.robot = robot
        self._data = robot.model.createData()
        self._client = bullet.connect(bullet.DIRECT)
        self._marks: list[tuple[int, int, pin.SE3]] = []  # shape, the joint that carries it, its place there
        try:
            self._body = load_urdf(robot.urdf, robot.name, self._client)
            self._lever = np.array(bullet.getDynamicsInfo(self._body, -1, physicsClientId=self._client)[3])
            count = bullet.getNumJoints(self._body, physicsClientId=self._client)
            info = [bullet.getJointInfo(self._body, i, physicsClientId=self._client) for i in range(count)]
            self._joints = {row[1].decode(): i for i, row in enumerate(info)}
            shapes = bullet.getVisualShapeData(self._body, physicsClientId=self._client)
            self._paint = {row[1]: row[7] for row in shapes}
            feet = {i for i, row in enumerate(info) if row[12].decode() in robot.foot.frames}
            self._limbs = set(self._paint) - feet - {-1}
            self._lay_ground(scene or Scene.flat(), marks)
            self._add_joints()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def close(self) -> None:
        """Free the engine."""
        if self._client is not None:
            bullet.disconnect(physicsClientId=self._client)
            self._client = None

    def picture(self, q: np.ndarray, camera: Camera, color: str | None = None) -> np.ndarray:
        """The robot at configuration ``q`` (nq,), in its own colours or in ``color``: (height, width, 3), 0 ... 1."""
        self._pose(np.asarray(q, float))
        for link, own in self._paint.items():
            paint = own
            if color is not None and (link == -1 or link in self._limbs):
                paint = (*tint(color, 1.0 if link == -1 else LIMB_SHARE), 1.0)
            bullet.changeVisualShape(self._body, link, rgbaColor=paint, physicsClientId=self._client)
        width, height = (OVERSAMPLING * n for n in camera.size)
        view, lens = camera.matrices()
        options = {"renderer": bullet.ER_TINY_RENDERER, "physicsClientId": self._client, **LIGHT}
        shot = bullet.getCameraImage(width, height, view, lens, **options)
        image = np.reshape(shot[2], (height, width, 4))[:, :, :3] / 255.0
        image[np.reshape(shot[4], (height, width)) < 0] = 1.0  # where no body is: white
        return image.reshape(camera.size[1], OVERSAMPLING, camera.size[0], OVERSAMPLING, 3).mean(axis=(1, 3))

    # building and posing ---------------------------------------------------------------------------------------

    def _add(self, kind: int, place, **shape) -> int:
        client = {"physicsClientId": self._client}
        visual = bullet.createVisualShape(kind, **shape, **client)
        return bullet.createMultiBody(0, -1, visual, basePosition=place, **client)

    def _slab(self, start: float, end: float, top: float, thickness: float, color) -> None:
        half = [(end - start) / 2, HALF_WIDTH_M, thickness / 2]
        place = [(start + end) / 2, 0.0, top - thickness / 2]
        self._add(bullet.GEOM_BOX, place, halfExtents=half, rgbaColor=(*color, 1.0))

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

    def _add_joints(self) -> None:
        """A ball for every pitch joint, and a rod from it to the next one above it in the same limb."""
        model, grey = self.robot.model, (*[JOINT_GREY] * 3, 1.0)
        joints = [model.getJointId(n) for pair in self.robot.joints.values() for n in pair]
        for joint in joints:
            ball = self._add(bullet.GEOM_SPHERE, (0, 0, 0), radius=JOINT_RADIUS_M, rgbaColor=grey)
            self._marks.append((ball, joint, pin.SE3.Identity()))
            above, span = model.parents[joint], model.jointPlacements[joint].translation
            if above in joints:
                turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), span).toRotationMatrix()
                length = float(np.linalg.norm(span))
                rod = self._add(bullet.GEOM_CYLINDER, (0, 0, 0), radius=ROD_RADIUS_M, length=length, rgbaColor=grey)
                self._marks.append((rod, above, pin.SE3(turn, span / 2)))

    def _pose(self, q: np.ndarray) -> None:
        client = {"physicsClientId": self._client}
        place, attitude, *_ = base_to_bullet(q, np.zeros(6), self._lever)
        bullet.resetBasePositionAndOrientation(self._body, place, attitude, **client)
        for name, angle in zip(self.robot.joint_names, q[7:], strict=True):
            bullet.resetJointState(self._body, self._joints[name], float(angle), **client)
        pin.forwardKinematics(self.robot.model, self._data, q)
        for shape, joint, at in self._marks:
            place = self._data.oMi[joint] * at
            turn = pin.Quaternion(place.rotation).coeffs()
            bullet.resetBasePositionAndOrientation(shape, place.translation, turn, **client)


# Fig. 3b --------------------------------------------------------------------------------------------------------
@styled
def simulation_model(robot: Robot) -> Figure:
    """F-3b: the robot as the simulation has it, in its stance, seen from a corner and from the side."""
    fig = new_figure(COLUMN_IN, 2.9)
    axes = fig.subplots(1, 2)
    q = stance_configuration(robot)
    side = Camera(width=1.0, bottom=-0.22, x=float(q[0]), pixels_per_m=2 * PIXELS_PER_M)
    with Renderer(robot) as studio:
        for ax, camera in zip(axes, (replace(side, yaw_deg=40.0, pitch_deg=-14.0), side), strict=True):
            ax.imshow(studio.picture(q, camera))
            bare(ax)
    return fig


# Fig. 11 --------------------------------------------------------------------------------------------------------
@styled
def frame_strip(result: SimulationResult, robot: Robot, *, scene: Scene | None = None,
                marks: Sequence[float] = ()) -> Figure:  # fmt: skip
    """F-11: rendered frames of a simulated jump, in the colours of launch, flight and landing.

    The camera follows the CoM; the stripes on the ground are 0.25 m wide.

    Parameters
    ----------
    scene : ground; flat if None.
    marks : places of lines across the ground [m], such as where the toes started and where they should land.
    """
    rows = frame_rows(result)
    floor = min(0.0, scene.top_at(float(result.com[-1, 0]))) if scene else 0.0
    camera = Camera(bottom=floor - BELOW_M, top=float(result.q[rows, 2].max()) + ABOVE_M)
    width = PAGE_IN / COLUMNS
    lines = -(-len(rows) // COLUMNS)
    fig = new_figure(PAGE_IN, lines * (width * camera.size[1] / camera.size[0] + TITLE_IN))
    axes = fig.subplots(lines, COLUMNS)
    with Renderer(robot, scene=scene, marks=marks) as studio:
        for ax, row in zip(axes.flat, rows, strict=True):
            phase = str(result.phase[row])
            shot = replace(camera, x=float(result.com[row, 0]))
            ax.imshow(studio.picture(result.q[row], shot, PHASE_COLORS[phase]))
            bare(ax)
            ax.set_title(f"{phase}, {result.t[row]:.2f} s", loc="center", color=shade(PHASE_COLORS[phase], 0.8))
    return fig
