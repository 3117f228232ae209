"""Drawing robots: the full robot from its URDF, the five-link model as sticks, the pendulum with its ellipse.

A picture of one instant is a "frame". The full robot is drawn by a :class:`Silhouette`, made once per robot:

>>> body = Silhouette(robot)                         # side view; view="front" looks along -x
>>> draw_robot(ax, body, tape.q[0], color=LAUNCH)    # one frame at its true place
>>> strobe(ax, body, tape.q[rows], colors)           # several, faint to strong
>>> film_strip(ax, body, tape.q[rows], times, LAUNCH)  # side by side, when the robot hardly moves

Angles are positive about +y, x forward, z up; all lengths in metres. Axes that pass through here get equal scales.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Ellipse, Polygon
from scipy.spatial import ConvexHull

from jumplab.robot import Robot, SagittalModel
from jumplab.show.style import ELLIPSE, GROUND, INK, shade, tint

ROUNDING_M = 0.018  # our choice: radius by which drawn boxes are rounded
CIRCLE = np.stack([np.cos(a := np.linspace(0, 2 * np.pi, 12, endpoint=False)), np.sin(a)], -1)  # (12, 2)
VIEWS = {"side": (0, 2), "front": (1, 2)}
ELLIPSE_EDGE = shade(ELLIPSE, 0.7)
ELLIPSE_RATIO = 0.55  # our choice, for the eye: the barbell fixes only the ellipse's long axis
SHADES = {"trunk": 1.0, "limb": 0.78, "far": 0.45}  # strength of the colour per part


class Silhouette:
    """Outlines of a robot's visual shapes, projected on a vertical plane.

    Parameters
    ----------
    robot : its URDF gives the shapes; boxes are drawn exactly, other primitives as their bounding boxes.
    view : "side" (x to the right) or "front" (y to the right).
    """

    def __init__(self, robot: Robot, view: str = "side"):
        self.robot, self.view = robot, view
        self._model, self._data = robot.model, robot.model.createData()
        self._axes = VIEWS[view]
        geometry = pin.buildGeomFromUrdfString(self._model, robot.urdf, pin.GeometryType.VISUAL)
        self._shapes = []
        neutral = pin.neutral(self._model)
        pin.forwardKinematics(self._model, self._data, neutral)
        for g in geometry.geometryObjects:
            g.geometry.computeLocalAABB()
            low, high = g.geometry.aabb_local.min_, g.geometry.aabb_local.max_
            rounding = min(ROUNDING_M, 0.45 * float(np.min(high - low)))
            low, high = low + rounding, high - rounding
            corners = np.array(list(itertools.product(*zip(low, high, strict=True))))  # (8, 3), shape's own frame
            corners = corners @ g.placement.rotation.T + g.placement.translation  # (8, 3), joint frame
            side = self._data.oMi[g.parentJoint].act(corners.mean(axis=0))[1]
            part = "trunk" if g.parentJoint == 1 else "far" if side < -1e-3 and view == "side" else "limb"
            self._shapes.append((side if view == "side" else 0.0, g.parentJoint, corners, rounding, part))
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

    def joints(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Places (2,) [m] of the joint axes in the view, by joint name."""
        pin.forwardKinematics(self._model, self._data, q)
        axes, ids = list(self._axes), {n: self._model.getJointId(n) for n in self.robot.joint_names}
        return {name: self._data.oMi[i].translation[axes] for name, i in ids.items()}

    def com(self, q: np.ndarray) -> np.ndarray:
        """CoM (2,) [m] in the view."""
        return pin.centerOfMass(self._model, self._data, q)[list(self._axes)].copy()


def draw_robot(ax: Axes, body: Silhouette, q: np.ndarray, color: str, *, strength: float = 1.0, shift: float = 0.0,
               zorder: float = 2.0, joints: bool = True) -> None:  # fmt: skip
    """One frame of the full robot.

    Parameters
    ----------
    q : configuration (nq,).
    strength : 0 ... 1, how much of the colour; less is nearer to white.
    shift : added to the horizontal coordinate [m].
    joints : draw the pitch joints as discs.
    """
    edge = tint(shade(color, 0.55), 0.25 + 0.75 * strength)
    for part, outline in body.outlines(q):
        face = tint(color, strength * SHADES[part])
        ax.add_patch(Polygon(np.add(outline, [shift, 0.0]), closed=True, facecolor=face, edgecolor=edge, linewidth=0.5,
                             zorder=zorder))  # fmt: skip
    if joints:
        places = body.joints(q)
        for role, pair in body.robot.joints.items():
            radius = 0.042 if role in ("hip_pitch", "knee") else 0.032
            for name in pair[:1] if body.view == "side" else pair:
                ax.add_patch(Circle(np.add(places[name], [shift, 0.0]), radius, facecolor=tint(color, 0.9 * strength),
                                    edgecolor=edge, linewidth=0.5, zorder=zorder))  # fmt: skip


def strobe(
    ax: Axes,
    body: Silhouette,
    frames: Sequence[np.ndarray],
    colors: Sequence[str],
    *,
    strengths: Sequence[float] | None = None,
    shift: float = 0.0,
) -> None:
    """Several frames at their true places, later ones in front; strengths and shift as in :func:`draw_robot`."""
    strengths = np.linspace(0.55, 1.0, len(frames)) if strengths is None else strengths
    for k, (q, color, strength) in enumerate(zip(frames, colors, strengths, strict=True)):
        draw_robot(ax, body, q, color, strength=float(strength), shift=shift, zorder=2 + k / max(len(frames), 1))
    equal_scales(ax)


def film_strip(
    ax: Axes,
    body: Silhouette,
    frames: Sequence[np.ndarray],
    times: Sequence[float],
    color: str | Sequence[str],
    *,
    pitch_m: float = 0.62,
    start_m: float = 0.0,
) -> None:
    """Frames side by side, ``pitch_m`` apart, each with its time below; the first one's origin at ``start_m``.

    ``color`` is one colour, or one per frame.
    """
    colors = [color] * len(frames) if isinstance(color, str) else color
    for k, (q, t, c) in enumerate(zip(frames, times, colors, strict=True)):
        at = start_m + k * pitch_m
        draw_robot(ax, body, q, c, shift=at)
        ax.text(at, -0.05, f"{t:.2f} s", ha="center", va="top", fontsize=7)
    equal_scales(ax)


def draw_five_link(
    ax: Axes,
    model: SagittalModel,
    angles: np.ndarray,
    toe: tuple[float, float] | np.ndarray = (0.0, 0.0),
    color: str = INK,
    *,
    linewidth: float = 1.6,
    shift: float = 0.0,
    zorder: float = 2.0,
    alpha: float = 1.0,
) -> dict[str, np.ndarray]:
    """One frame of the five-link model as sticks; returns the places (2,) of its points by name.

    Parameters
    ----------
    angles : absolute link angles (5,): foot, shank, thigh, trunk, arm [rad].
    toe : (2,) place of the toe [m].
    """
    p = five_link_points(model, angles, toe)
    p = {name: np.add(x, [shift, 0.0]) for name, x in p.items()}
    style = dict(color=color, solid_capstyle="round", solid_joinstyle="round", zorder=zorder, alpha=alpha)
    sole = np.array([p["heel"], p["toe"], p["ankle"], p["heel"]])
    ax.fill(*sole.T, facecolor=color, edgecolor=color, linewidth=linewidth / 2, zorder=zorder, alpha=alpha)
    body = np.array([p[n] for n in ("ankle", "knee", "hip", "shoulder")])
    ax.plot(*body.T, linewidth=linewidth, **style)
    ax.plot(*np.array([p["shoulder"], p["hand"]]).T, linewidth=0.7 * linewidth, **style)
    ax.plot(*body.T, linestyle="none", marker="o", markersize=1.6 * linewidth, markerfacecolor="white",
            markeredgewidth=0.6 * linewidth, **{k: style[k] for k in ("color", "zorder", "alpha")})  # fmt: skip
    equal_scales(ax)
    return p


def five_link_points(
    model: SagittalModel, angles: np.ndarray, toe: tuple[float, float] | np.ndarray = (0.0, 0.0)
) -> dict[str, np.ndarray]:
    """Places (2,) [m] of toe, heel, ankle, knee, hip, shoulder, hand and com for link angles (5,)."""
    c, s = np.cos(angles), np.sin(angles)
    turns = np.array([[c, s], [-s, c]]).transpose(2, 0, 1)  # (5, 2, 2)
    steps = [turns[j] @ model.span[j] for j in range(5)]
    start = np.asarray(toe, float)
    ankle = start + steps[0]
    knee, hip = ankle + steps[1], ankle + steps[1] + steps[2]
    shoulder = hip + steps[3]
    arms = np.einsum("i,ijk->jk", model.mass, model.com_arms()) / model.total_mass
    com = start + np.einsum("jkl,jl->k", turns, arms)
    return dict(toe=start, heel=start + turns[0] @ model.heel, ankle=ankle, knee=knee, hip=hip, shoulder=shoulder,
                hand=shoulder + steps[4], com=com)  # fmt: skip


def draw_srmp(
    ax: Axes,
    coordinates: np.ndarray,
    color: str,
    *,
    pivot: tuple[float, float] = (0.0, 0.0),
    ellipse: bool = True,
    strength: float = 1.0,
    zorder: float = 2.0,
) -> dict[str, np.ndarray]:
    """The pendulum at one instant: rod, barbell with its two end masses, and the light-green inertia ellipse.

    Parameters
    ----------
    coordinates : theta_l [rad], phi [m], theta_pl [rad], varphi [m] (4,).

    Returns
    -------
    Places (2,) of C0 (the CoM), C1 and C2 (the barbell's ends) and the pivot.
    """
    lean, length, turn, radius = coordinates
    pivot = np.asarray(pivot, float)
    centre = pivot + length * np.array([np.sin(lean), np.cos(lean)])
    along = np.array([np.sin(lean + turn), np.cos(lean + turn)])
    ends = centre + radius * along, centre - radius * along
    line = tint(color, strength)
    if ellipse:
        ax.add_patch(Ellipse(centre, 2 * radius, 2 * ELLIPSE_RATIO * radius, angle=90 - np.degrees(lean + turn),
                             facecolor=ELLIPSE, edgecolor=ELLIPSE_EDGE, linewidth=0.5, zorder=zorder))  # fmt: skip
    ax.plot(*np.array([pivot, centre]).T, color=line, linewidth=1.4, zorder=zorder)
    ax.plot(*np.array(ends).T, color=line, linewidth=1.0, zorder=zorder)
    ax.plot(*np.array(ends).T, color=line, marker="o", markersize=4.0, linestyle="none", zorder=zorder)
    ax.plot(*centre, color=line, marker="o", markersize=3.6, markerfacecolor="white", zorder=zorder)
    ax.plot(*pivot, color=line, marker="^", markersize=4.0, zorder=zorder)
    equal_scales(ax)
    return dict(C0=centre, C1=ends[0], C2=ends[1], pivot=pivot)


def draw_ground(ax: Axes, left: float, right: float, *, edge: float | None = None, height: float = 0.0,
                level: float = 0.0) -> None:  # fmt: skip
    """The ground from ``left`` to ``right`` [m] at ``level``; with ``edge``, a step there to ``height``."""
    x, z = [left, right], [level, level]
    if edge is not None and height:
        x, z = [left, edge, edge, right], [level, level, height, height]
    ax.fill_between(x, z, min(*z, 0.0) - 0.04, facecolor=tint(GROUND, 0.35), edgecolor="none", zorder=1)
    ax.plot(x, z, color=GROUND, linewidth=0.8, zorder=1.5)


def equal_scales(ax: Axes) -> None:
    """Equal scales on both axes, everything in view."""
    ax.set_aspect("equal", adjustable="box")
    ax.autoscale_view()
