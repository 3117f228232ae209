"""Drawing robots: the full robot from its URDF, the five-link model as sticks, and the sheet of a robot.

A picture of one instant is a "frame"; a :class:`Silhouette`, made once per robot, has the outlines that are drawn.
Angles are positive about +y, x forward, z up; all lengths in metres. Axes that pass through here get equal scales.
"""

from __future__ import annotations

import itertools

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from jumplab.robot import SAGITTAL_LINKS, Robot, SagittalModel
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.show import style
from jumplab.show.style import FLIGHT, GROUND, INK, LANDING, LAUNCH, PURPLE, VERMILION, shade, tint

ROUNDING_M = 0.018  # radius by which drawn boxes are rounded
CIRCLE = np.stack([np.cos(a := np.linspace(0, 2 * np.pi, 12, endpoint=False)), np.sin(a)], -1)  # (12, 2)
VIEWS = {"side": [0, 2], "front": [1, 2]}
LIMB_SHARE = 0.5  # strength of a colour on limbs, whose trunk has all of it, in rendered pictures and on the page
ABOVE_M = 0.36  # seen there above the highest base: a head is 0.3 m above the shoulders
SHADES = {"trunk": 1.0, "limb": 0.78, "far": 0.45}  # strength of the colour per part
BODY = "#5B6B7F"  # a robot outside of any phase
ROLE_COLORS = {"hip_pitch": LAUNCH, "knee": FLIGHT, "ankle_pitch": LANDING, "shoulder_pitch": PURPLE}


class Silhouette:
    """Outlines of the shapes in a robot's URDF: boxes exactly, others as their bounding boxes.

    ``view`` is "side" (x to the right) or "front" (y to the right).
    """

    def __init__(self, robot: Robot, view: str = "side"):
        self.robot, self.view = robot, view
        self._model, self._data, self._axes = robot.model, robot.model.createData(), VIEWS[view]
        geometry = pin.buildGeomFromUrdfString(self._model, robot.urdf, pin.GeometryType.VISUAL)
        self._shapes = []
        pin.forwardKinematics(self._model, self._data, pin.neutral(self._model))
        for g in geometry.geometryObjects:
            g.geometry.computeLocalAABB()
            low, high = g.geometry.aabb_local.min_, g.geometry.aabb_local.max_
            rounding = min(ROUNDING_M, 0.45 * float(np.min(high - low)))
            corners = np.array(list(itertools.product(*zip(low + rounding, high - rounding, strict=True))))
            corners = corners @ g.placement.rotation.T + g.placement.translation  # (8, 3), joint frame
            left = self._data.oMi[g.parentJoint].act(corners.mean(axis=0))[1] if view == "side" else 0.0
            part = "trunk" if g.parentJoint == 1 else "far" if left < -1e-3 else "limb"
            self._shapes.append((left, g.parentJoint, corners, rounding, part))
        self._shapes.sort(key=lambda s: s[0])  # far ones first

    def outlines(self, q: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """(part, outline (n, 2) [m]) of every shape at configuration ``q`` (nq,), far ones first."""
        pin.forwardKinematics(self._model, self._data, q)
        out = []
        for _, joint, corners, rounding, part in self._shapes:
            place = self._data.oMi[joint]
            flat = (corners @ place.rotation.T + place.translation)[:, self._axes]
            points = (flat[:, None] + rounding * CIRCLE).reshape(-1, 2)
            out.append((part, points[ConvexHull(points).vertices]))
        return out

    def top(self, q: np.ndarray) -> float:
        """Height of the highest point [m]."""
        return float(max(outline[:, 1].max() for _, outline in self.outlines(q)))

    def joints(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Places (2,) [m] of the joint axes in the view, by joint name."""
        pin.forwardKinematics(self._model, self._data, q)
        place = {n: self._data.oMi[self._model.getJointId(n)] for n in self.robot.joint_names}
        return {name: at.translation[self._axes] for name, at in place.items()}

    def com(self, q: np.ndarray) -> np.ndarray:
        """CoM (2,) [m] in the view."""
        return pin.centerOfMass(self._model, self._data, q)[self._axes].copy()


def draw_robot(
    ax: Axes, body: Silhouette, q: np.ndarray, color: str, *, strength: float = 1, shift: float = 0, zorder: float = 2
) -> None:
    """One frame of the full robot at configuration ``q`` (nq,), its pitch joints as discs.

    ``strength`` 0 ... 1 is how much of the colour is used, less is nearer to white; ``shift`` moves it forward [m].
    """
    look = dict(edgecolor=tint(shade(color, 0.55), 0.25 + 0.75 * strength), linewidth=0.5, zorder=zorder)
    for part, outline in body.outlines(q):
        face = tint(color, strength * SHADES[part])
        ax.add_patch(Polygon(np.add(outline, [shift, 0.0]), closed=True, facecolor=face, **look))
    places = body.joints(q)
    for role, pair in body.robot.joints.items():
        radius = 0.042 if role in ("hip_pitch", "knee") else 0.032
        for name in pair[:1] if body.view == "side" else pair:
            place = np.add(places[name], [shift, 0.0])
            ax.add_patch(Circle(place, radius, facecolor=tint(color, 0.9 * strength), **look))


def strobe(
    ax: Axes, body: Silhouette, frames: ArrayLike, colors: list[str], *, strengths: ArrayLike = 1, shifts: ArrayLike = 0
) -> None:
    """Frames (n, nq), later ones in front; one strength and one shift as in :func:`draw_robot`, or one per frame."""
    n = len(frames)
    looks = zip(frames, colors, np.broadcast_to(strengths, n), np.broadcast_to(shifts, n), strict=True)
    for k, (q, color, strength, shift) in enumerate(looks):
        draw_robot(ax, body, q, color, strength=float(strength), shift=float(shift), zorder=2 + k / n)
    equal_scales(ax)


def film_strip(
    ax: Axes,
    body: Silhouette,
    frames: np.ndarray,
    times: np.ndarray,
    colors: list[str],
    places: np.ndarray,
    below: float,
) -> None:
    """Frames (n, nq) with their CoM at ``places`` (n,) [m], each with its time ``below`` [m] the ground."""
    strobe(ax, body, frames, colors, shifts=places - np.array([body.com(q)[0] for q in frames]))
    for place, t in zip(places, times, strict=True):
        ax.text(place, -below, f"{t:.2f} s", ha="center", va="top", fontsize=7)


def draw_five_link(
    ax: Axes, model: SagittalModel, angles: np.ndarray, toe: ArrayLike = (0.0, 0.0), color: str = BODY
) -> dict[str, np.ndarray]:
    """The five-link model as sticks: link angles (5,) [rad], toe at (2,) [m]; returns its :func:`five_link_points`."""
    p = five_link_points(model, angles, toe)
    look, ends = dict(color=color, zorder=2.0), dict(solid_capstyle="round", solid_joinstyle="round")
    parts = ("heel toe ankle heel", "ankle knee hip shoulder", "shoulder hand")
    sole, body, arm = (np.array([p[name] for name in part.split()]).T for part in parts)
    ax.fill(*sole, linewidth=1.5, **look)
    ax.plot(*body, linewidth=3.0, **look, **ends)
    ax.plot(*arm, linewidth=2.1, **look, **ends)
    dots = dict(markersize=4.8, markerfacecolor="white", markeredgewidth=1.8)
    ax.plot(*body, linestyle="none", marker="o", **dots, **look)
    equal_scales(ax)
    return p


def five_link_points(model: SagittalModel, angles: np.ndarray, toe: ArrayLike = (0.0, 0.0)) -> dict[str, np.ndarray]:
    """Places (2,) [m] of toe, heel, ankle, knee, hip, shoulder, hand and com for link angles (5,)."""
    c, s = np.cos(angles), np.sin(angles)
    turns = np.array([[c, s], [-s, c]]).transpose(2, 0, 1)  # (5, 2, 2)
    start = np.asarray(toe, float)
    tips = start + np.cumsum(np.einsum("jkl,jl->jk", turns, model.span), axis=0)
    arms = np.einsum("i,ijk->jk", model.mass, model.com_arms()) / model.total_mass
    com = start + np.einsum("jkl,jl->k", turns, arms)
    names = ("ankle", "knee", "hip", "shoulder", "hand")
    return dict(zip(names, tips, strict=True)) | dict(toe=start, heel=start + turns[0] @ model.heel, com=com)


def draw_ground(ax: Axes, left: float, right: float, *, edge: float | None = None, height: float = 0.0) -> None:
    """The ground from ``left`` to ``right`` [m]; with ``edge``, a step there to ``height``."""
    x, z = [left, right], [0.0, 0.0]
    if edge is not None and height:
        x, z = [left, edge, edge, right], [0.0, 0.0, height, height]
    ax.fill_between(x, z, min(*z, 0.0) - 0.04, facecolor=tint(GROUND, 0.35), edgecolor="none", zorder=1)
    ax.plot(x, z, color=GROUND, linewidth=0.8, zorder=1.5)


def draw_path(ax: Axes, x: np.ndarray, z: np.ndarray, zorder: float = 5.0) -> None:
    """The dotted path of the CoM."""
    ax.plot(x, z, color=INK, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=zorder)


def draw_com(ax: Axes, place: np.ndarray) -> None:
    """The mark of the CoM at ``place`` (2,) [m]."""
    ax.plot(*place, marker="o", markersize=6, markerfacecolor="white", markeredgecolor=VERMILION, zorder=6)
    ax.plot(*place, marker="+", markersize=6, color=VERMILION, zorder=7)


def equal_scales(ax: Axes) -> None:
    """Equal scales on both axes, everything in view."""
    ax.set_aspect("equal", adjustable="box")
    ax.autoscale_view()


# the sheet of a robot -------------------------------------------------------------------------------------------
@style.styled
def robot_sheet(robot: Robot) -> Figure:
    """Standing robot from the side, its moving joints with their roles from the front, and its five planned links."""
    fig = style.new_figure(style.PAGE_IN, 3.0)
    axes = fig.subplots(1, 3)
    q, side = stance_configuration(robot), Silhouette(robot)
    top, com = side.top(q), side.com(q)
    draw_robot(axes[0], side, q, BODY)
    draw_com(axes[0], com)
    axes[0].annotate("CoM", com, (8, 0), va="center", **(style.NOTE_STYLE | {"color": VERMILION}))
    _sheet_joints(axes[1], robot, q, top)
    _sheet_links(axes[2], robot, top)
    for ax, title in zip(axes, ("(a) side view", "(b) joints that move, front", "(c) sagittal reduction"), strict=True):
        draw_ground(ax, -0.6 * top, 0.6 * top)
        style.bare(ax)
        ax.set(xlim=(-0.55 * top, 0.55 * top), ylim=(-0.08 * top, 1.06 * top), aspect="equal")
        ax.set_title(title)
    return fig


def _sheet_joints(ax: Axes, robot: Robot, q: np.ndarray, top: float) -> None:
    model, place = robot.model, Silhouette(robot, "front").joints(q)
    roles = {name: role for role, pair in robot.joints.items() for name in pair}
    for joint in range(2, model.njoints):
        above = model.parents[joint]
        start = np.array([0.0, q[2]]) if above == 1 else place[model.names[above]]
        ax.plot(*np.array([start, place[model.names[joint]]]).T, color=BODY, linewidth=2.0, zorder=2)
    for name, at in place.items():
        look = dict(markersize=6, zorder=4) if name in roles else dict(markersize=3.5, zorder=5)
        look |= dict(markerfacecolor=ROLE_COLORS.get(roles.get(name), "white"), markeredgecolor=INK)
        ax.plot(*at, marker="o", markeredgewidth=0.6, **look)
    for role, pair in robot.joints.items():
        look = dict(va="center", fontsize=7, color=ROLE_COLORS[role])
        if pair:
            ax.text(0.20 * top, place[pair[0]][1], role.replace("_", " "), **look)
        else:
            ax.text(0.0, 0.97 * top, "arms held", ha="center", **look)


def _sheet_links(ax: Axes, robot: Robot, top: float) -> None:
    m = robot.sagittal
    p = draw_five_link(ax, m, stance_angles(robot, within_limits=robot.planar), -m.sole_center)
    links = ("ankle", "knee", "hip", "shoulder")
    middles = [(p[a] + p[b]) / 2 for a, b in itertools.pairwise(links)]
    places = (p["toe"] + [0.0, 0.03 * top], *middles, p["hand"])
    for name, at, mass in zip(SAGITTAL_LINKS, places, m.mass, strict=True):
        if mass > 0:
            ax.text(at[0] + 0.06 * top, at[1], f"{name} {mass:.1f} kg", va="center", fontsize=7, color="#444444")
    draw_com(ax, p["com"])
