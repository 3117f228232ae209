"""Diagrams: the stages (Fig. 2), the links (Fig. 3), the rendered model (Fig. 3b), the pendulum (Fig. 4)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Ellipse, FancyArrowPatch, FancyBboxPatch

from jumplab.robot import Robot
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.show.bodies import BODY, Silhouette, draw_com, draw_five_link, draw_ground, draw_robot
from jumplab.show.style import (
    COLUMN_IN,
    FLIGHT,
    INK,
    LANDING,
    LAUNCH,
    LIMIT,
    PAGE_IN,
    PHASE_COLORS,
    VERMILION,
    bare,
    new_figure,
    shade,
    styled,
    tint,
)
from paper.render import Camera, Renderer

ARROW = dict(arrowstyle="-|>", mutation_scale=7, linewidth=0.9, shrinkA=0, shrinkB=0)


CENTRED = {"ha": "center", "va": "center"}


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], color: str = INK, **kwargs) -> None:
    """A straight arrow in data coordinates."""
    ax.add_patch(FancyArrowPatch(start, end, **(ARROW | {"color": color, "zorder": 5} | kwargs)))


# Fig. 2 ---------------------------------------------------------------------------------------------------------
def _box(ax, x, y, width, height, text, color, *, strength=0.18, fontsize=7.0, weight="normal"):
    look = dict(linewidth=0.8, facecolor=tint(color, strength), edgecolor=shade(color, 0.8), zorder=2)
    ax.add_patch(FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=0.08", **look))
    look = dict(**CENTRED, fontsize=fontsize, fontweight=weight, linespacing=1.25, zorder=3)
    ax.text(x + width / 2, y + height / 2, text, **look)


@styled
def framework() -> Figure:
    """F-2: from the target to a robot that lands, and what passes from stage to stage."""
    fig = new_figure(PAGE_IN, 2.35)
    ax = fig.subplots()
    bare(ax)
    ax.set(xlim=(0, 14.32), ylim=(0.1, 4.7), aspect="equal")
    _box(ax, 0.05, 1.55, 1.65, 1.8, "target\ndistance $l$\nCoM rise $h$\nplatform,\nrotation", INK, strength=0.06)
    stages = (
        ("1  SRMP", "Sec. III", "launch: rod, barbell,\nCoP in the sole", "flight: inertia $\\rho$\nturns the body"),
        ("2  joint space", "Sec. IV", "launch QP: 9 links,\nmomentum, tiptoes", "flight QP: inertia,\nfoot placement"),
        ("3  whole body", "Sec. V", "launch: flat foot,\nthen toe", "flight: ballistic\nCoM, foot at target"),
    )
    first, width, gap = 2.35, 2.45, 0.85
    for k, (name, section, launch, flight) in enumerate(stages):
        x = first + k * (width + gap)
        look = dict(boxstyle="round,pad=0,rounding_size=0.12", linewidth=0.8, facecolor="#F7F7F7", edgecolor=LIMIT)
        ax.add_patch(FancyBboxPatch((x, 0.75), width, 3.4, **look))
        ax.text(x + 0.14, 3.88, name, ha="left", va="center", fontweight="bold", fontsize=8)
        ax.text(x + width / 2, 4.25, section, ha="center", va="bottom", fontsize=7, color="#555555")
        _box(ax, x + 0.12, 2.3, width - 0.24, 1.3, launch, LAUNCH)
        _box(ax, x + 0.12, 0.9, width - 0.24, 1.3, flight, FLIGHT, strength=0.25)
    motion = "$\\mathbf{q},\\, \\dot{\\mathbf{q}},\\, \\ddot{\\mathbf{q}}$"
    passed = ("$\\mathbf{c},\\, L,\\, \\rho$\nCoP", f"{motion}\nguess", "1 kHz\ntape")
    arrow(ax, (1.72, 2.45), (first - 0.04, 2.45))
    for k, text in enumerate(passed):
        x = first + (k + 1) * (width + gap) - gap
        arrow(ax, (x + 0.04, 2.45), (x + gap - 0.04, 2.45))
        ax.text(x + gap / 2, 2.62, text, ha="center", va="bottom", fontsize=7, linespacing=1.2)
    x = first + 3 * (width + gap)
    _box(ax, x, 2.6, 14.27 - x, 1.55, "audit,\nindependent", INK, strength=0.06)
    _box(ax, x, 0.75, 14.27 - x, 1.55, "simulation\nplayback,\nlanding", LANDING)
    start, end = (first + width / 2, 0.75), (first + 2 * (width + gap) + width / 2, 0.75)
    arrow(ax, start, end, connectionstyle="arc3,rad=0.16", color="#555555")
    text = "references $\\rho,\\, \\dot{\\rho},\\, \\mathbf{v},\\, L$"
    ax.text(first + 1.5 * width + gap, 0.50, text, **CENTRED, fontsize=7, color="#333333")
    for k, (text, color) in enumerate(PHASE_COLORS.items()):
        ax.add_patch(Circle((0.2, 1.15 - 0.36 * k), 0.09, color=color))
        ax.text(0.38, 1.15 - 0.36 * k, text, va="center", fontsize=7)
    return fig


# Fig. 3 ---------------------------------------------------------------------------------------------------------
@styled
def link_models(robot: Robot) -> Figure:
    """F-3: the robot's shapes, its nine links with their joints, and the five links of the sagittal plane."""
    fig = new_figure(PAGE_IN, 2.75)
    axes = fig.subplots(1, 3)
    q = stance_configuration(robot)
    front, side = Silhouette(robot, "front"), Silhouette(robot)
    draw_robot(axes[0], side, q, BODY, shift=-0.42)
    draw_robot(axes[0], front, q, BODY, shift=0.42)
    height = 1.56
    for ax in axes:
        draw_ground(ax, -1.0, 1.0)
        bare(ax)
        ax.set(xlim=(-0.9, 0.9), ylim=(-0.15, height), aspect="equal")
    _dimension(axes[0], -0.8, 0.0, max(outline[:, 1].max() for _, outline in front.outlines(q)))
    axes[0].text(-0.42, -0.08, "side", ha="center", va="top")
    axes[0].text(0.42, -0.08, "front", ha="center", va="top")
    _nine_links(axes[1], front, q)
    _five_links(axes[2], robot)
    titles = ("(a) shapes of the URDF", "(b) nine links, 20 DOF", "(c) five links, sagittal plane")
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title)
    return fig


def _dimension(ax, x, low, high):
    arrow(ax, (x, low), (x, high), color="#555555", arrowstyle="<|-|>", linewidth=0.6)
    ax.text(x + 0.03, (low + high) / 2, f"{high - low:.2f} m", rotation=90, ha="left", va="center", fontsize=7)


def _nine_links(ax, body, q):
    robot, p = body.robot, body.joints(q)
    style = dict(color=BODY, linewidth=3.0, solid_capstyle="round", zorder=2)
    hips, knees, ankles, shoulders = (
        np.array([p[n] for n in robot.joints[r]]) for r in ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch")
    )
    if not len(shoulders):  # arms that are held: shoulders are drawn above the hips
        shoulders = hips + np.array([0.0, robot.sagittal.span[3, 1]])
    ax.plot(*shoulders.T, **style)
    ax.plot(*hips.T, **style)
    ax.plot(*np.array([shoulders.mean(axis=0), hips.mean(axis=0)]).T, **(style | {"linewidth": 7.0}))
    arm = 2 * robot.sagittal.com[4]
    for shoulder, hip, knee, ankle in zip(shoulders, hips, knees, ankles, strict=True):
        ax.plot(*np.array([shoulder, np.add(shoulder, [0, arm[1]])]).T, **style)
        ax.plot(*np.array([hip, knee, ankle, [ankle[0], ankle[1] + robot.foot.sole_z]]).T, **style)
        ax.plot([ankle[0] - 0.05, ankle[0] + 0.05], [0.012, 0.012], **style)
    for places, count, name in ((shoulders, 1, "shoulder"), (hips, 3, "hip"), (knees, 1, "knee"), (ankles, 2, "ankle")):
        for x, z in places:
            ax.add_patch(Circle((x, z), 0.055, facecolor="white", edgecolor=INK, linewidth=0.9, zorder=4))
            ax.text(x, z - 0.004, str(count), ha="center", va="center", fontsize=7, zorder=5)
        ax.text(0.38, places[0][1], name, va="center", fontsize=7)
    top = shoulders.mean(axis=0)
    for vector, name, beside in (((0.0, 0.26), "$z$", (0.05, -0.02)), ((0.16, 0.0), "$y$", (-0.03, -0.06))):
        arrow(ax, top, top + vector, color=VERMILION)
        ax.text(*(top + vector + beside), name, ha="center", va="center", color=VERMILION)
    ax.text(-0.10, top[1] + 0.20, "floating base: 6", ha="right", va="center", fontsize=7, color=VERMILION)


def _five_links(ax, robot):
    angles, m = stance_angles(robot.with_stance(knee_rad=1.0)), robot.sagittal
    angles = angles + np.array([0.0, 0.0, 0.0, 0.25, -0.6])
    p = draw_five_link(ax, m, angles, -m.sole_center)
    points = ("hip", "knee", "ankle", "shoulder")
    offsets = ((-0.09, 0.02), (0.09, 0.0), (-0.10, 0.03), (-0.09, 0.02))
    for point, offset in zip(points, offsets, strict=True):
        align = "left" if offset[0] > 0 else "right"
        ax.text(*np.add(p[point], offset), f"$q_\\mathrm{{{point}}}$", ha=align, va="center")
    middles = [("foot", "heel", "toe"), ("shank", "ankle", "knee"), ("thigh", "knee", "hip")]
    middles += [("trunk", "hip", "shoulder"), ("arm", "shoulder", "hand")]
    for k, (name, a, b) in enumerate(middles):
        middle = (p[a] + p[b]) / 2
        side, align = (-1, "right") if name == "trunk" else (1, "left")
        x, z = (p["toe"][0] + 0.05, 0.03) if name == "foot" else (middle[0] + 0.07 * side, middle[1])
        ax.text(x, z, f"{name} {m.mass[k]:.1f} kg", ha=align, va="center", fontsize=7, color="#444444")
    draw_com(ax, p["com"])
    ax.text(p["com"][0] + 0.06, p["com"][1] + 0.02, "CoM", color=VERMILION, va="center", fontsize=7)
    arrow(ax, p["shoulder"], p["shoulder"] + [0.0, 0.24], color=VERMILION)
    arrow(ax, p["shoulder"], p["shoulder"] + [0.24, 0.0], color=VERMILION)
    ax.text(p["shoulder"][0] - 0.03, p["shoulder"][1] + 0.21, "$z$", ha="right", color=VERMILION)
    ax.text(p["shoulder"][0] + 0.27, p["shoulder"][1], "$x$", va="center", color=VERMILION)


# Fig. 3b --------------------------------------------------------------------------------------------------------
@styled
def simulation_model(robot: Robot) -> Figure:
    """F-3b: the robot as the simulation has it, in its stance, seen from a corner and from the side."""
    fig = new_figure(COLUMN_IN, 2.9)
    axes = fig.subplots(1, 2)
    q = stance_configuration(robot)
    side = Camera(width=1.0, bottom=-0.22, x=float(q[0]), pixels_per_m=480)
    for ax, camera in zip(axes, (replace(side, yaw_deg=40.0, pitch_deg=-14.0), side), strict=True):
        ax.imshow(Renderer(robot).picture(q, camera))
        bare(ax)
    return fig


ELLIPSE = "#B8E6B0"  # light green
ELLIPSE_RATIO = 0.55  # for the eye: the barbell fixes only the ellipse's long axis


def ellipse(centre: np.ndarray, radius: float, tilt: float, linewidth: float, zorder: float = 2.0) -> Ellipse:
    """The inertia ellipse of a barbell of half-length ``radius`` [m] that leans by ``tilt`` [rad]."""
    look = dict(facecolor=ELLIPSE, edgecolor=shade(ELLIPSE, 0.7), linewidth=linewidth, zorder=zorder)
    return Ellipse(centre, 2 * radius, 2 * ELLIPSE_RATIO * radius, angle=90 - np.degrees(tilt), **look)


# Fig. 4 ---------------------------------------------------------------------------------------------------------
@styled
def pendulum_diagram(lean: float = 0.30, turn: float = 0.62, length: float = 1.0, radius: float = 0.42) -> Figure:
    """F-4: the reaction mass pendulum; (a) its coordinates, (b) the forces and torques that belong to them."""
    fig = new_figure(PAGE_IN * 0.62, 2.4)
    axes = fig.subplots(1, 2)
    for ax, title in zip(axes, ("(a) geometry", "(b) dynamics"), strict=True):
        bare(ax)
        ax.set_title(title)
        draw_ground(ax, -0.62, 1.02)
        ax.set(xlim=(-0.62, 1.02), ylim=(-0.16, 1.5), aspect="equal")
    centre = length * np.array([np.sin(lean), np.cos(lean)])
    along = np.array([np.sin(lean + turn), np.cos(lean + turn)])
    for ax in axes:
        _pendulum(ax, centre, along, radius, lean + turn)
    _geometry(axes[0], centre, along, radius, lean, turn, length)
    _dynamics(axes[1], centre, along, radius, lean)
    return fig


def _pendulum(ax, centre, along, radius, tilt):
    ends = np.array([centre + radius * along, centre - radius * along])
    ax.add_patch(ellipse(centre, radius, tilt, 0.6))
    ax.plot(*np.array([[0, 0], centre]).T, color=INK, linewidth=2.0, zorder=3)
    ax.plot(*ends.T, color=INK, linewidth=1.2, zorder=3)
    for end in ends:
        ax.add_patch(Circle(end, 0.055, facecolor="#8FA3B5", edgecolor=INK, zorder=4))
    ax.add_patch(Circle(centre, 0.035, facecolor="white", edgecolor=INK, zorder=4))
    ax.plot(0, 0, marker="^", markersize=7, color=INK, zorder=4)


def _turning(ax, at, radius, start, end, color, label, where):
    """Arc from angle ``start`` to ``end`` (from vertical, positive about +y, i.e. clockwise here) with a head."""
    angles = {"theta1": 90 - np.degrees(max(start, end)), "theta2": 90 - np.degrees(min(start, end))}
    ax.add_patch(Arc(at, 2 * radius, 2 * radius, **angles, color=color, linewidth=1.0, zorder=5))
    tip = np.asarray(at) + radius * np.array([np.sin(end), np.cos(end)])
    tangent = np.sign(end - start) * np.array([np.cos(end), -np.sin(end)])
    arrow(ax, tip - 0.02 * tangent, tip + 0.035 * tangent, color=color)
    ax.text(*where, label, color=color, ha="center", va="center", fontsize=9)


def _geometry(ax, centre, along, radius, lean, turn, length):
    rod = centre / length
    dashed = dict(color="#777777", linewidth=0.7, linestyle=(0, (3, 2)), zorder=2.5)
    ax.plot([0, 0], [0, 0.56], **dashed)
    ax.plot(*np.array([centre, centre + 0.52 * rod]).T, **dashed)
    _turning(ax, (0, 0), 0.44, 0.0, lean, LAUNCH, r"$\theta_l$", (0.075, 0.53))
    _turning(ax, centre, 0.36, lean, lean + turn, VERMILION, r"$\theta_{pl}$", centre + 0.46 * np.array([0.62, 0.84]))
    across = np.array([rod[1], -rod[0]])
    ax.text(*(0.5 * centre + 0.09 * across), r"$\phi$", ha="center", va="center", fontsize=9)
    normal = np.array([along[1], -along[0]])
    ax.text(*(centre - 0.55 * radius * along + 0.10 * normal), r"$\varphi$", ha="center", va="center", fontsize=9)
    ax.text(*np.add(centre, [-0.11, 0.03]), "$C_0$", ha="center", va="center", fontsize=8)
    ax.text(*(centre + radius * along + [0.02, -0.13]), "$C_1,\\ m_p$", ha="left", va="center", fontsize=8)
    ax.text(*(centre - radius * along + [-0.08, 0.02]), "$C_2,\\ m_p$", ha="right", va="center", fontsize=8)
    arrow(ax, (-0.5, 0.0), (-0.28, 0.0), color="#777777")
    arrow(ax, (-0.5, 0.0), (-0.5, 0.22), color="#777777")
    ax.text(-0.22, 0.045, "$x$", color="#555555", ha="center")
    ax.text(-0.5, 0.25, "$z$", color="#555555", ha="center")


def _dynamics(ax, centre, along, radius, lean):
    rod = centre / np.linalg.norm(centre)
    arrow(ax, centre - 0.52 * rod - [0.055, 0], centre - 0.22 * rod - [0.055, 0], color=LAUNCH, linewidth=1.3)
    ax.text(*(centre - 0.42 * rod - [0.17, 0.0]), r"$F_\phi$", color=LAUNCH, ha="center", va="center", fontsize=9)
    for sign in (1, -1):
        end = centre + sign * radius * along
        arrow(ax, end + sign * 0.07 * along, end + sign * 0.25 * along, color=VERMILION, linewidth=1.3)
    place = centre + (radius + 0.17) * along + [-0.11, 0.09]
    ax.text(*place, r"$F_\varphi$", color=VERMILION, **CENTRED, fontsize=9)
    _turning(ax, centre, 0.19, lean + 2.0, lean + 5.0, VERMILION, r"$\tau_{pl}$", np.add(centre, [-0.28, 0.14]))
    _turning(ax, (0, 0), 0.17, -1.3, 1.1, LAUNCH, r"$\tau_l$", (-0.21, 0.14))
    arrow(ax, centre, centre - [0, 0.36], color="#555555", linewidth=1.3)
    ax.text(*np.add(centre, [0.06, -0.40]), "$mg$", color="#555555", ha="center", va="center", fontsize=9)
    arrow(ax, (0.13, 0.0), (0.13, 0.34), color=LANDING, linewidth=1.3)
    arrow(ax, (0.13, 0.0), (0.31, 0.0), color=LANDING, linewidth=1.3)
    ax.text(0.20, 0.29, "$F_z$", color=LANDING, ha="left", va="center", fontsize=8)
    ax.text(0.34, 0.05, "$F_x$", color=LANDING, ha="left", va="center", fontsize=8)
    arrow(ax, (0.0, -0.10), (0.13, -0.10), color=LANDING, arrowstyle="<|-|>", mutation_scale=4)
    ax.text(0.17, -0.10, "$X_{CoP}$", color=LANDING, ha="left", va="center", fontsize=8)
