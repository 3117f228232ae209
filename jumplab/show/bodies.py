"""Drawing robots: the full robot from its URDF, the five-link model as sticks, and the sheet of a
robot.

A picture of one instant is a "frame"; a :class:`Silhouette`, made once per robot, has the outlines
that are drawn. Angles are positive about +y, x forward, z up; all lengths in metres. Axes that pass
through here get equal scales.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from jumplab.arguments import checked, shaped
from jumplab.errors import InputError, quoted
from jumplab.robot import SAGITTAL_LINKS, Robot, SagittalModel
from jumplab.robot.sagittal import rotated
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.robot_import.urdf import placed
from jumplab.show.shapes import Part, rounded_body
from jumplab.show.style import (
    FLIGHT,
    GROUND,
    INK,
    LANDING,
    LAUNCH,
    NOTE_STYLE,
    PAGE_IN,
    PURPLE,
    VERMILION,
    Color,
    bare,
    new_figure,
    shade,
    themed,
    tint,
)

VIEWS = {"side": [0, 2], "front": [1, 2]}
BELOW_M = 0.07  # of the ground: where times are written
ABOVE_M = 0.52  # seen above the highest base: raised hands are 0.45 m above the shoulders
SHADES = {"trunk": 1.0, "limb": 0.78, "rest": 0.78, "far": 0.45}  # strengths of the colour
BODY = "#5B6B7F"  # a robot outside of any phase
ROLE_COLORS = {
    "hip_pitch": LAUNCH,
    "knee": FLIGHT,
    "ankle_pitch": LANDING,
    "shoulder_pitch": PURPLE,
}


@checked
class Silhouette:
    """Outlines of the boxes around the shapes in a robot's URDF.

    ``view`` is "side" (x to the right) or "front" (y to the right).
    """

    def __init__(self, robot: Robot, view: str = "side"):
        if view not in VIEWS:
            raise InputError(f"view {quoted(view)}: must be one of {', '.join(VIEWS)}")
        self.robot = robot
        self.view = view
        self._model = robot.model
        self._axes = VIEWS[view]
        self._data = robot.model.createData()
        pin.forwardKinematics(self._model, self._data, pin.neutral(self._model))
        self._parts = rounded_body(robot)
        if view == "side":  # far ones first
            self._parts = [
                replace(part, kind="far")
                if self._left(part) < -1e-3 and part.kind != "trunk"
                else part
                for part in sorted(self._parts, key=self._left)
            ]

    def _left(self, part: Part) -> float:
        """Place of a part along y [m]."""
        return self._data.oMi[part.joint].act(part.points.mean(axis=0))[1]

    def outlines(self, q: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """(kind, outline (n, 2) [m]) of every box at a configuration (nq,), far ones first."""
        pin.forwardKinematics(self._model, self._data, q)
        outlines = []
        for part in self._parts:
            flat = placed(self._data.oMi[part.joint], part.points)[:, self._axes]
            outlines.append((part.kind, flat[ConvexHull(flat).vertices]))
        return outlines

    def joints(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Places (2,) [m] of the joint axes in the view, by joint name."""
        pin.forwardKinematics(self._model, self._data, q)
        places = zip(self._model.names, self._data.oMi, strict=True)
        return {name: place.translation[self._axes] for name, place in list(places)[2:]}

    def com(self, q: np.ndarray) -> np.ndarray:
        """CoM (2,) [m] in the view."""
        return pin.centerOfMass(self._model, self._data, q)[self._axes].copy()


def draw_robot(
    ax: Axes,
    body: Silhouette,
    q: np.ndarray,
    color: Color,
    *,
    strength: float = 1,
    shift: float = 0,
    zorder: float = 2,
) -> None:
    """One frame of the full robot at configuration ``q`` (nq,), its pitch joints as discs.

    ``strength`` 0 ... 1 is how much of the colour is used, less is nearer to white; ``shift`` moves
    it forward [m].
    """
    q = shaped(q, (body.robot.model.nq,), "q")
    edge = tint(shade(color, 0.55), 0.25 + 0.75 * strength)
    look = dict(edgecolor=edge, linewidth=0.5, zorder=zorder)
    for kind, outline in body.outlines(q):
        face = tint(color, strength * SHADES[kind])
        ax.add_patch(Polygon(np.add(outline, (shift, 0.0)), facecolor=face, **look))
    places = body.joints(q)
    face = tint(color, 0.9 * strength)
    for role, pair in body.robot.joints.items():
        radius = 0.042 if role in ("hip_pitch", "knee") else 0.032
        for name in pair[:1] if body.view == "side" else pair:
            ax.add_patch(Circle(np.add(places[name], (shift, 0.0)), radius, facecolor=face, **look))


def strobe(
    ax: Axes,
    body: Silhouette,
    frames: ArrayLike,
    colors: list[Color],
    *,
    strengths: ArrayLike = 1,
    shifts: ArrayLike = 0,
) -> None:
    """Frames (n, nq), later ones in front; strengths and shifts [m] as in :func:`draw_robot`."""
    frames = shaped(frames, (None, body.robot.model.nq), "frames")
    n = len(frames)
    if len(colors) != n:
        raise InputError(f"{len(colors)} colors given for {n} frames")
    looks = (
        np.full(n, x) if np.ndim(x) == 0 else shaped(x, (n,), name)
        for x, name in ((strengths, "strengths"), (shifts, "shifts"))
    )
    for k, (q, color, strength, shift) in enumerate(zip(frames, colors, *looks, strict=True)):
        draw_robot(ax, body, q, color, strength=strength, shift=shift, zorder=2 + k / n)
    equal_scales(ax)


def film_strip(
    ax: Axes,
    body: Silhouette,
    frames: np.ndarray,
    times: np.ndarray,
    colors: list[Color],
    places: np.ndarray,
) -> None:
    """Frames (n, nq), CoM at ``places`` (n,) [m], times (n,) [s] below the ground."""
    frames = shaped(frames, (None, body.robot.model.nq), "frames")
    times = shaped(times, (len(frames),), "times")
    places = shaped(places, (len(frames),), "places")
    strobe(ax, body, frames, colors, shifts=places - [body.com(q)[0] for q in frames])
    for place, t in zip(places, times, strict=True):
        ax.text(place, -BELOW_M, f"{t:.2f} s", ha="center", va="top", fontsize=7)


def draw_five_link(
    ax: Axes,
    model: SagittalModel,
    angles: np.ndarray,
    toe: ArrayLike = (0.0, 0.0),
) -> dict[str, np.ndarray]:
    """Sticks: link angles (5,) [rad], toe at (2,) [m]; returns their :func:`five_link_points`."""
    points = five_link_points(model, angles, toe)
    look = dict(color=BODY, zorder=2.0)
    ends = dict(solid_capstyle="round", solid_joinstyle="round")
    dots = dict(marker="o", markersize=4.8, markerfacecolor="white", markeredgewidth=1.8)
    parts = ("heel toe ankle", "ankle knee hip shoulder", "shoulder hand")
    sole, body, arm = (np.array([points[n] for n in part.split()]).T for part in parts)
    ax.fill(*sole, linewidth=1.5, **look)
    ax.plot(*arm, linewidth=2.1, **look, **ends)
    ax.plot(*body, linewidth=3.0, **dots, **look, **ends)
    equal_scales(ax)
    return points


def five_link_points(
    model: SagittalModel, angles: np.ndarray, toe: ArrayLike = (0.0, 0.0)
) -> dict[str, np.ndarray]:
    """Places (2,) [m] of toe, heel, joints, hand and com for link angles (5,) [rad]."""
    toe = shaped(toe, (2,), "toe")
    angles = shaped(angles, (len(model.span),), "angles")
    tips = toe + np.cumsum(list(map(rotated, angles, model.span)), axis=0)
    return {
        **dict(zip(("ankle", "knee", "hip", "shoulder", "hand"), tips, strict=True)),
        "toe": toe,
        "heel": toe + rotated(angles[0], model.heel),
        "com": toe + model.mass @ model.link_coms(angles) / model.total_mass,
    }


def draw_ground(
    ax: Axes, left: float, right: float, *, edge: float | None = None, height: float = 0.0
) -> None:
    """The ground from ``left`` to ``right`` [m]; at an ``edge`` [m], a step to ``height`` [m]."""
    step = left if edge is None else edge
    x = [left, step, step, right]
    z = [0.0, 0.0, height, height]
    low = min(height, 0.0) - 0.04
    ax.fill_between(x, z, low, facecolor=tint(GROUND, 0.35), edgecolor="none", zorder=1)
    ax.plot(x, z, color=GROUND, linewidth=0.8, zorder=1.5)


def draw_path(ax: Axes, x: np.ndarray, z: np.ndarray, zorder: float = 5.0) -> None:
    """The dotted path (n,) [m] of the CoM."""
    z = shaped(z, (len(x),), "z")
    ax.plot(x, z, color=INK, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=zorder)


def draw_com(ax: Axes, place: np.ndarray) -> None:
    """The mark of the CoM at ``place`` (2,) [m]."""
    look = dict(markersize=6, color=VERMILION)
    ax.plot(*place, marker="o", markerfacecolor="white", zorder=6, **look)
    ax.plot(*place, marker="+", zorder=7, **look)


def equal_scales(ax: Axes) -> None:
    """Equal scales on both axes, everything in view."""
    ax.set_aspect("equal", adjustable="box")
    ax.autoscale_view()


# the sheet of a robot
# ----------------------------------------------------------------------------------------------
@themed
def robot_sheet(robot: Robot) -> Figure:
    """A robot standing, its moving joints with their roles from the front, and its five links."""
    fig = new_figure(PAGE_IN, 3.0)
    axes = fig.subplots(1, 3)
    q = stance_configuration(robot)
    side = Silhouette(robot)
    com = side.com(q)
    draw_robot(axes[0], side, q, BODY)
    top = axes[0].dataLim.y1  # of the robot
    draw_com(axes[0], com)
    axes[0].annotate("CoM", com, (8, 0), va="center", **(NOTE_STYLE | {"color": VERMILION}))
    _draw_joints(axes[1], robot, q, top)
    _draw_links(axes[2], robot, top)
    titles = ("(a) side view", "(b) joints that move, front", "(c) sagittal reduction")
    for ax, title in zip(axes, titles, strict=True):
        draw_ground(ax, -0.6 * top, 0.6 * top)
        bare(ax)
        ax.set(xlim=(-0.55 * top, 0.55 * top), ylim=(-0.08 * top, 1.06 * top), aspect="equal")
        ax.set_title(title)
    return fig


def _draw_joints(ax: Axes, robot: Robot, q: np.ndarray, top: float) -> None:
    """The joints from the front, by roles, joined as the robot's tree is; ``top`` is its height."""
    model = robot.model
    places = Silhouette(robot, "front").joints(q)
    roles = {name: role for role, pair in robot.joints.items() for name in pair}
    for joint, (name, place) in enumerate(places.items(), 2):
        start = places.get(model.names[model.parents[joint]], (0.0, q[2]))
        ax.plot(*zip(start, place, strict=True), color=BODY, linewidth=2.0, zorder=2)
        face = ROLE_COLORS.get(roles.get(name), "white")
        size = 6 if name in roles else 3.5
        ax.plot(
            *place,
            marker="o",
            markersize=size,
            markerfacecolor=face,
            markeredgecolor=INK,
            markeredgewidth=0.6,
            zorder=10 - size,
        )
    for role, pair in robot.joints.items():
        look = dict(va="center", fontsize=7, color=ROLE_COLORS[role])
        if pair:
            ax.text(0.20 * top, places[pair[0]][1], role.replace("_", " "), **look)
        else:
            ax.text(0.0, 0.97 * top, "arms held", ha="center", **look)


def _draw_links(ax: Axes, robot: Robot, top: float) -> None:
    """The five links with their masses; ``top`` is the robot's height."""
    model = robot.sagittal
    angles = stance_angles(robot, within_limits=robot.planar)
    points = draw_five_link(ax, model, angles, -model.sole_center)
    pairs = itertools.pairwise(("ankle", "knee", "hip", "shoulder"))
    middles = [(points[a] + points[b]) / 2 for a, b in pairs]
    places = (points["toe"] + [0.0, 0.03 * top], *middles, points["hand"])
    for name, (x, z), mass in zip(SAGITTAL_LINKS, places, model.mass, strict=True):
        if mass > 0:
            words = f"{name} {mass:.1f} kg"
            ax.text(x + 0.06 * top, z, words, va="center", fontsize=7, color="#444444")
    draw_com(ax, points["com"])
