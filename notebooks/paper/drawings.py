"""A flip in pictures: what stage 1 shapes, and what the simulated body makes of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Arc, Circle, Ellipse, FancyArrowPatch, FancyBboxPatch

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.reach import Reach
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.show.bodies import (
    ELLIPSE_RATIO,
    Silhouette,
    draw_five_link,
    draw_ground,
    draw_robot,
    draw_srmp,
    equal_scales,
)
from jumplab.show.simulation import AFTER_TOUCHDOWN_S
from jumplab.show.simulation import trunk_pitch as trunk_angle  # of a flip: whole turns count
from jumplab.show.style import (
    COLUMN_IN,
    ELLIPSE,
    FLIGHT,
    INK,
    LANDING,
    LAUNCH,
    LIMIT,
    LIMIT_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    REFERENCE_STYLE,
    SKY,
    VERMILION,
    bare,
    by_phase,
    legend_above,
    mark_time,
    new_figure,
    panel_letters,
    phase_handles,
    shade,
    styled,
    tint,
)
from jumplab.stages.joint_qp import JointPlan
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.srmp.landing import LandingPlan
from jumplab.task import GRAVITY

# diagrams ------------------------------------------------------------------------------------------
ARROW = dict(arrowstyle="-|>", mutation_scale=7, linewidth=0.9, shrinkA=0, shrinkB=0)


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], color: str = INK, **kwargs) -> None:
    """A straight arrow in data coordinates."""
    ax.add_patch(FancyArrowPatch(start, end, **(ARROW | {"color": color, "zorder": 5} | kwargs)))


# Fig. 2 ---------------------------------------------------------------------------------------------------------
def _box(ax, x, y, width, height, text, color, *, strength=0.18, fontsize=7.0, weight="normal"):
    ax.add_patch(FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=0.08", linewidth=0.8,
                                facecolor=tint(color, strength), edgecolor=shade(color, 0.8), zorder=2))  # fmt: skip
    ax.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=fontsize, fontweight=weight,
            linespacing=1.25, zorder=3)  # fmt: skip


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
        ("3  whole body", "Sec. V", "launch: 5 links,\nflat foot, then toe", "flight: ballistic\nCoM, foot at target"),
    )
    first, width, gap = 2.35, 2.45, 0.85
    for k, (name, section, launch, flight) in enumerate(stages):
        x = first + k * (width + gap)
        ax.add_patch(FancyBboxPatch((x, 0.75), width, 3.4, boxstyle="round,pad=0,rounding_size=0.12", linewidth=0.8,
                                    facecolor="#F7F7F7", edgecolor=LIMIT))  # fmt: skip
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
    _box(ax, x, 2.6, 14.27 - x, 1.55, "audit\nsecond\ncode path", INK, strength=0.06)
    _box(ax, x, 0.75, 14.27 - x, 1.55, "simulation\nplayback,\nlanding", LANDING)
    arrow(ax, (first + width / 2, 0.75), (first + 2 * (width + gap) + width / 2, 0.75),
          connectionstyle="arc3,rad=0.16", color="#555555")  # fmt: skip
    ax.text(first + 1.5 * width + gap, 0.50, "references $\\rho,\\, \\dot{\\rho},\\, \\mathbf{v},\\, L$", ha="center",
            va="center", fontsize=7, color="#333333")  # fmt: skip
    for k, (color, text) in enumerate(((LAUNCH, "launch"), (FLIGHT, "flight"), (LANDING, "landing"))):
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
    draw_robot(axes[0], side, q, "#5B6B7F", shift=-0.42)
    draw_robot(axes[0], front, q, "#5B6B7F", shift=0.42)
    height = 1.56
    for ax in axes:
        draw_ground(ax, -1.0, 1.0)
        bare(ax)
        ax.set(xlim=(-0.9, 0.9), ylim=(-0.15, height), aspect="equal")
    _dimension(axes[0], -0.8, 0.0, _top(front, q))
    axes[0].text(-0.42, -0.08, "side", ha="center", va="top")
    axes[0].text(0.42, -0.08, "front", ha="center", va="top")
    _nine_links(axes[1], front, q)
    _five_links(axes[2], robot)
    titles = ("(a) shapes of the URDF", "(b) nine links, 20 DOF", "(c) five links, sagittal plane")
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title)
    return fig


def _top(body, q):
    return max(outline[:, 1].max() for _, outline in body.outlines(q))


def _dimension(ax, x, low, high):
    arrow(ax, (x, low), (x, high), color="#555555", arrowstyle="<|-|>", linewidth=0.6)
    ax.text(x + 0.03, (low + high) / 2, f"{high - low:.2f} m", rotation=90, ha="left", va="center", fontsize=7)


def _nine_links(ax, body, q):
    robot, p = body.robot, body.joints(q)
    style = dict(color="#5B6B7F", linewidth=3.0, solid_capstyle="round", zorder=2)
    hips, knees, ankles, shoulders = (np.array([p[n] for n in robot.joints[r]])
                                      for r in ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch"))  # fmt: skip
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
    angles, m = stance_angles(robot, 1.0), robot.sagittal
    angles = angles + np.array([0.0, 0.0, 0.0, 0.25, -0.6])
    p = draw_five_link(ax, m, angles, -m.sole_center, "#5B6B7F", linewidth=3.0)
    points = ("hip", "knee", "ankle", "shoulder")
    offsets = ((-0.09, 0.02), (0.09, 0.0), (-0.10, 0.03), (-0.09, 0.02))
    for point, offset in zip(points, offsets, strict=True):
        align = "left" if offset[0] > 0 else "right"
        ax.text(*np.add(p[point], offset), f"$q_\\mathrm{{{point}}}$", ha=align, va="center")
    middles = (("foot", "heel", "toe"), ("shank", "ankle", "knee"), ("thigh", "knee", "hip"),
               ("trunk", "hip", "shoulder"), ("arm", "shoulder", "hand"))  # fmt: skip
    for k, (name, a, b) in enumerate(middles):
        middle = (p[a] + p[b]) / 2
        side, align = (-1, "right") if name == "trunk" else (1, "left")
        x, z = (p["toe"][0] + 0.05, 0.03) if name == "foot" else (middle[0] + 0.07 * side, middle[1])
        ax.text(x, z, f"{name} {m.mass[k]:.1f} kg", ha=align, va="center", fontsize=7, color="#444444")
    ax.plot(*p["com"], marker="o", markersize=6, markerfacecolor="white", markeredgecolor=VERMILION, zorder=6)
    ax.plot(*p["com"], marker="+", markersize=6, color=VERMILION, zorder=7)
    ax.text(p["com"][0] + 0.06, p["com"][1] + 0.02, "CoM", color=VERMILION, va="center", fontsize=7)
    arrow(ax, p["shoulder"], p["shoulder"] + [0.0, 0.24], color=VERMILION)
    arrow(ax, p["shoulder"], p["shoulder"] + [0.24, 0.0], color=VERMILION)
    ax.text(p["shoulder"][0] - 0.03, p["shoulder"][1] + 0.21, "$z$", ha="right", color=VERMILION)
    ax.text(p["shoulder"][0] + 0.27, p["shoulder"][1], "$x$", va="center", color=VERMILION)


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
    ax.add_patch(Ellipse(centre, 2 * radius, 2 * ELLIPSE_RATIO * radius, angle=90 - np.degrees(tilt), facecolor=ELLIPSE,
                         edgecolor=shade(ELLIPSE, 0.7), linewidth=0.6, zorder=2))  # fmt: skip
    ax.plot(*np.array([[0, 0], centre]).T, color=INK, linewidth=2.0, zorder=3)
    ax.plot(*ends.T, color=INK, linewidth=1.2, zorder=3)
    for end in ends:
        ax.add_patch(Circle(end, 0.055, facecolor="#8FA3B5", edgecolor=INK, zorder=4))
    ax.add_patch(Circle(centre, 0.035, facecolor="white", edgecolor=INK, zorder=4))
    ax.plot(0, 0, marker="^", markersize=7, color=INK, zorder=4)


def _turning(ax, at, radius, start, end, color, label, where):
    """Arc from angle ``start`` to ``end`` (from vertical, positive about +y, i.e. clockwise here) with a head."""
    ax.add_patch(Arc(at, 2 * radius, 2 * radius, theta1=90 - np.degrees(max(start, end)),
                     theta2=90 - np.degrees(min(start, end)), color=color, linewidth=1.0, zorder=5))  # fmt: skip
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
    ax.text(*(centre + (radius + 0.17) * along + [-0.11, 0.09]), r"$F_\varphi$", color=VERMILION, ha="center",
            va="center", fontsize=9)  # fmt: skip
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


# stage1 ------------------------------------------------------------------------------------------
SPEED_SCALE_S = 0.10  # our choice: length of a drawn velocity, metres per m/s
FRAMES = 8


# Fig. 5 ---------------------------------------------------------------------------------------------------------
@styled
def inverted_pendulum(plan: SrmpPlan) -> Figure:
    """F-5: CoM path, rods and velocities at take-off and touchdown, and how the length of the jump adds up."""
    fig = new_figure(PAGE_IN * 0.62, 3.3)
    ax = fig.subplots()
    bare(ax)
    launch, flight = plan.launch, plan.flight
    platform, end = plan.task.platform_m, flight.com[-1]
    foot = end + flight.foot_com[-1]
    takeoff, v0, v1 = flight.com[0], flight.com_velocity[0], flight.com_velocity[-1]
    left, right = min(0.0, foot[0]) - 0.45, max(0.0, foot[0]) + 0.45
    edge = (0.2 * takeoff + 0.8 * foot)[0] if platform else None
    draw_ground(ax, left, right, edge=edge, height=platform)
    ax.plot(*launch.com.T, color=LAUNCH, label="CoM, launch")
    ax.plot(*flight.com.T, color=FLIGHT, label="CoM, flight")
    for pivot, com, color in (((0.0, 0.0), launch.com[0], tint(LAUNCH, 0.45)), ((0.0, 0.0), takeoff, LAUNCH),
                              (foot, end, shade(FLIGHT, 0.85))):  # fmt: skip
        ax.plot(*np.array([pivot, com]).T, color=color, linewidth=2.0)
        ax.plot(*com, marker="o", markersize=8, color=color, markerfacecolor="white", markeredgewidth=1.3, zorder=4)
        ax.plot(*pivot, marker="^", markersize=5, color=color)
    _velocity(ax, takeoff, v0, "right")
    _velocity(ax, end, v1, "left")
    apex = int(np.argmax(flight.com[:, 1]))
    ax.plot(*flight.com[apex], marker="o", markersize=3, color=FLIGHT)
    _height(ax, flight.com[apex], takeoff[1], plan.task.height_m)
    _lean(ax, (0.0, 0.0), plan.launch.lean[-1], LAUNCH)
    _lean(ax, foot, flight.lean[-1] - plan.task.rotation_rad, shade(FLIGHT, 0.85))
    _lengths(ax, takeoff[0], end[0], foot[0], min(0.0, platform))
    ax.set_aspect("equal")
    ax.legend(loc="upper left")
    return fig


def _degrees(angle) -> str:
    return f"${round(np.degrees(angle)):d}$°"


def _velocity(ax: Axes, com, v, align):
    tip = com + SPEED_SCALE_S * v
    arrow(ax, com, tip, color=LANDING, linewidth=1.3)
    text = f"$v_x = {v[0]:.2f}$ m/s\n$v_z = {v[1]:.2f}$ m/s"
    place = np.add(com, [0.12, -0.02]) if align == "left" else np.add(tip, [-0.05, 0.0])
    ax.text(*place, text, color=shade(LANDING, 0.8), fontsize=7, ha=align, va="center", linespacing=1.3)


def _height(ax: Axes, apex, base, height):
    ax.plot([apex[0] - 0.06, apex[0] + 0.06], [base, base], **LIMIT_STYLE)
    arrow(ax, (apex[0], base), apex, color="#555555", arrowstyle="<|-|>", linewidth=0.6)
    ax.text(apex[0], apex[1] + 0.03, f"$h = {height:.2f}$ m", fontsize=7, ha="center", va="bottom")


def _lean(ax: Axes, pivot, lean, color):
    """The rod's angle against the vertical, with its value."""
    pivot = np.asarray(pivot, float)
    ax.plot(*np.array([pivot, np.add(pivot, [0, 0.5])]).T, color="#777777", linewidth=0.7, linestyle=(0, (3, 2)))
    a = np.linspace(0, lean, 20)
    ax.plot(*(pivot[:, None] + 0.36 * np.array([np.sin(a), np.cos(a)])), color=color, linewidth=1.0)
    side = np.sign(lean) or 1.0
    ax.text(*np.add(pivot, [-0.03 * side, 0.40]), _degrees(lean), color=color, fontsize=7,
            ha="right" if side > 0 else "left", va="center")  # fmt: skip


def _lengths(ax: Axes, ground, touchdown, foot, floor):
    """l_g on the ground, l_f in the air, and what the foot adds ahead of the CoM; together the jump's length."""
    z = floor - 0.13
    spans = ((0.0, ground, "$l_g$", LAUNCH), (ground, touchdown, "$l_f$", shade(FLIGHT, 0.85)),
             (touchdown, foot, "ahead", shade(LANDING, 0.8)))  # fmt: skip
    for x in (0.0, ground, touchdown, foot):
        ax.plot([x, x], [z - 0.03, floor - 0.05], color="#999999", linewidth=0.6)
    for k, (a, b, name, color) in enumerate(spans):
        arrow(ax, (a, z), (b, z), color=color, arrowstyle="<|-|>", mutation_scale=5)
        place, where = ((a + b) / 2, z - 0.04), dict(ha="center", va="top")
        if k == 2:  # too short for a text below it
            place, where = (max(a, b) + 0.03, z), dict(ha="left", va="center")
        ax.text(*place, f"{name} {b - a:.2f} m", color=color, fontsize=7, **where)
    arrow(ax, (0.0, z - 0.19), (foot, z - 0.19), color=INK, arrowstyle="<|-|>", mutation_scale=5)
    ax.text(foot / 2, z - 0.22, f"$l = {foot:.2f}$ m, foot to foot", fontsize=7, ha="center", va="top")


# Fig. 6 ---------------------------------------------------------------------------------------------------------
@styled
def launch_strobe(plan: SrmpPlan) -> Figure:
    """F-6: rod, barbell and inertia ellipse through the launch, frames moved apart; below, posture, speed and L."""
    fig = new_figure(PAGE_IN, 3.2)
    names = [["strip"] * 3, ["posture", "speed", "momentum"]]
    top, *lower = fig.subplot_mosaic(names, height_ratios=(1.25, 1.0)).values()
    launch = plan.launch
    rows = np.linspace(0, len(launch.t) - 1, FRAMES).astype(int)
    pitch = 2.6 * launch.coordinates[:, 3].max()
    bare(top)
    for k, row in enumerate(rows):
        at = np.array([k * pitch, 0.0])
        draw_srmp(top, launch.coordinates[row], LAUNCH, pivot=at)
        top.text(at[0], -0.10, f"{launch.t[row]:.2f} s", ha="center", va="top", fontsize=7)
    draw_ground(top, -0.6 * pitch, (len(rows) - 0.4) * pitch)
    top.set_xlim(-0.6 * pitch, (len(rows) - 0.4) * pitch)
    heel_up = plan.launch_s - plan.toe_s
    curves = (
        (np.degrees(launch.posture), "posture $\\theta_l + \\theta_{pl}$ [deg]"),
        (launch.com_velocity[:, 1], "$v_z$ of the CoM [m/s]"),
        (launch.L, "$L$ [kg m$^2$/s]"),
    )
    for ax, (y, label) in zip(lower, curves, strict=True):
        ax.plot(launch.t, y, color=LAUNCH)
        ax.plot(launch.t[rows], y[rows], linestyle="none", marker="o", markersize=2.5, color=LAUNCH)
        ax.set(xlabel="time [s]", ylabel=label)
        mark_time(ax, [heel_up])
    lower[0].annotate("heel up", (heel_up, lower[0].get_ylim()[0]), (-3, 3), textcoords="offset points", fontsize=7,
                      ha="right", color="#555555")  # fmt: skip
    return fig


# flight ---------------------------------------------------------------------------------------------------------
@styled
def flight_shaping(plan: SrmpPlan) -> Figure:
    """Inertia shaping: rho, the turning rate omega = L / rho, and theta; dashed, had rho kept its take-off value."""
    fig = new_figure(COLUMN_IN, 3.5)
    axes = fig.subplots(3, 1, sharex=True)
    f = plan.flight
    rigid = f.L / f.rho[0]
    low, high = plan.reach.inertia
    axes[0].plot(f.t, f.rho, color=FLIGHT)
    axes[0].axhline(f.rho[0], **REFERENCE_STYLE)
    for bound in (low, high):
        axes[0].axhline(bound, **LIMIT_STYLE)
    axes[0].annotate("reach of the robot", (f.t[-1], high), (0, -2), textcoords="offset points", ha="right",
                     va="top", fontsize=7, color="#666666")  # fmt: skip
    axes[1].plot(f.t, f.L / f.rho, color=FLIGHT)
    axes[1].plot(f.t, rigid, **REFERENCE_STYLE)
    axes[2].plot(f.t, np.degrees(f.lean), color=FLIGHT, label="inertia shaped")
    axes[2].plot(f.t, np.degrees(f.lean[0] + rigid * f.t), **REFERENCE_STYLE, label="$\\rho$ as at take-off")
    _end_angles(axes[2], f.t, f.lean, away_from=f.lean[0] + rigid[-1] * f.t[-1])
    axes[2].legend(loc="best")
    for ax, label in zip(axes, ("$\\rho$ [kg m$^2$]", "$\\omega = L/\\rho$ [rad/s]", "$\\theta$ [deg]"), strict=True):
        ax.set_ylabel(label)
        ax.margins(y=0.22)
    axes[0].set_title(f"$L = {f.L[0]:.2f}$ kg m$^2$/s throughout the flight", fontsize=8)
    axes[2].set_xlabel("time since take-off [s]")
    fig.align_ylabels()
    return fig


def _end_angles(ax: Axes, t: np.ndarray, angle: np.ndarray, away_from: float | None = None) -> None:
    """The first and last value of a curve of angles [rad], where neither it nor one that ends at ``away_from`` is."""
    up = 1 if angle[-1] > angle[0] else -1
    last = up if away_from is None else int(np.sign(angle[-1] - away_from)) or up
    for row, side, ha in ((0, -up, "left"), (-1, last, "right")):
        gap = 3 if row == 0 or last == up else 11  # points; beside a slope more room is needed
        ax.annotate(_degrees(angle[row]), (t[row], np.degrees(angle[row])), (0, gap * side), fontsize=7, ha=ha,
                    textcoords="offset points", va="bottom" if side > 0 else "top")  # fmt: skip


@styled
def flight_comparison(plans: Mapping[str, SrmpPlan]) -> Figure:
    """Inertia and angle of several flights beside each other, one column per plan under its name."""
    fig = new_figure(PAGE_IN, 2.7)
    axes = fig.subplots(2, len(plans), squeeze=False)
    inertia = [bound for plan in plans.values() for bound in plan.reach.inertia]
    for column, (name, plan) in zip(axes.T, plans.items(), strict=True):
        f = plan.flight
        column[0].set_title(f"{name}: $L = {f.L[0]:.1f}$ kg m$^2$/s")
        column[0].plot(f.t, f.rho, color=FLIGHT)
        for bound in plan.reach.inertia:
            column[0].axhline(bound, **LIMIT_STYLE)
        column[1].plot(f.t, np.degrees(f.lean), color=FLIGHT)
        _end_angles(column[1], f.t, f.lean)
        column[0].set_ylim(0.85 * min(inertia), 1.05 * max(inertia))
        column[1].margins(y=0.22)
        column[1].set_xlabel("time since take-off [s]")
    axes[0, 0].set_ylabel("$\\rho$ [kg m$^2$]")
    axes[1, 0].set_ylabel("$\\theta$ [deg]")
    fig.align_ylabels()
    return fig


# reach ----------------------------------------------------------------------------------------------------------
@styled
def reach_envelope(reach: Reach, plan: SrmpPlan | None = None, *, samples: dict | None = None) -> Figure:
    """Inertia within reach over the CoM's distance phi from the sole, with a plan's launch in it.

    Parameters
    ----------
    samples : postures as :func:`jumplab.robot.reach.postures` returns them, drawn as dots.
    """
    fig = new_figure(COLUMN_IN, 2.7)
    ax = fig.subplots()
    if samples is not None:
        ax.plot(np.linalg.norm(samples["com"], axis=1), samples["rho"], linestyle="none", marker=".", markersize=1.2,
                color="#C8C8C8", zorder=1, rasterized=True, label="sampled postures")  # fmt: skip
    phi = np.linspace(*reach.length, 100)
    low, high = np.polyval(reach.inertia_low_fit, phi), np.polyval(reach.inertia_high_fit, phi)
    ax.fill_between(phi, low, high, color=tint(SKY, 0.25), zorder=0.5, label="envelope used in launch")
    for bound in (low, high):
        ax.plot(phi, bound, color=SKY, linewidth=1.0, zorder=2)
    if plan is not None:
        q = plan.launch.coordinates
        ax.plot(q[:, 1], plan.launch.rho, color=LAUNCH, zorder=3, label="launch")
        ax.plot(np.linalg.norm(plan.flight.foot_com, axis=1), plan.flight.rho, color=FLIGHT, zorder=3, label="flight")
        for x, y, text, offset in ((q[0, 1], plan.launch.rho[0], "stance", (4, -3)),
                                   (q[-1, 1], plan.launch.rho[-1], "take-off", (4, 3))):  # fmt: skip
            ax.plot(x, y, marker="o", markersize=4, color=LAUNCH, zorder=4)
            ax.annotate(text, (x, y), offset, textcoords="offset points", fontsize=7)
    for bound in reach.length:
        ax.axvline(bound, **LIMIT_STYLE)
    ax.set(xlabel="CoM from the middle of the sole, $\\phi$ [m]", ylabel="pitch inertia $\\rho$ [kg m$^2$]")
    ax.legend(loc="upper left", markerscale=4)
    return fig


# joint_map ------------------------------------------------------------------------------------------
FRAMES_LAUNCH, FRAMES_FLIGHT = 6, 5
PITCH_M = 0.66  # our choice: how far the frames are apart
GAP_M = 0.12  # our choice: between launch and flight
LEVEL_M = 1e-3  # a platform lower than this is none
TEXT_M = 0.24  # room for the frames' times below the ground
ALIKE = 0.9  # our choice: values closer than this ratio are drawn on an axis of their own instead of from zero
START_COLORS = (LAUNCH, FLIGHT)  # in turn


# Fig. 7 ---------------------------------------------------------------------------------------------------------
@styled
def mapped_snapshots(plan: JointPlan, robot: Robot, platform_m: float = 0.0) -> Figure:
    """F-7: launch and flight in frames, moved apart so that every posture shows; heights are as they are.

    Parameters
    ----------
    platform_m : height of the landing surface [m].
    """
    fig = new_figure(PAGE_IN, 2.6)
    ax = fig.subplots()
    body, place = Silhouette(robot), 0.0
    for phase, count in (("launch", FRAMES_LAUNCH), ("flight", FRAMES_FLIGHT)):
        color, rows = PHASE_COLORS[phase], plan.rows(phase)
        left, again = place - PITCH_M / 2, int(phase == "flight")  # the launch has shown take-off already
        for k in np.linspace(rows.start, rows.stop - 1, count + again).astype(int)[again:]:
            _frame(ax, body, plan.q[k], place, color, text=f"{plan.t[k]:.2f} s")
            place += PITCH_M
        right = place - PITCH_M / 2
        edge = right - PITCH_M if phase == "flight" and abs(platform_m) > LEVEL_M else None
        draw_ground(ax, left, right, edge=edge, height=platform_m if edge else 0.0)
        ax.text(left, min(platform_m, 0.0) - TEXT_M, phase, ha="left", va="top", color=shade(color, 0.8))
        place += GAP_M
    ax.set(xlim=(-PITCH_M / 2 - 0.05, right + 0.05))
    bare(ax)
    return fig


def _frame(ax: Axes, body: Silhouette, q: np.ndarray, place: float, color: str, *, text: str) -> None:
    """One frame with its CoM at the horizontal ``place`` [m], and a text below the ground."""
    com = body.com(q)
    draw_robot(ax, body, q, color, shift=place - com[0])
    ax.plot(place, com[1], marker="o", markersize=3, color=INK, markerfacecolor="white", zorder=4)
    ax.text(place, -0.06, text, ha="center", va="top", fontsize=7)
    equal_scales(ax)


# tracking -------------------------------------------------------------------------------------------------------
@styled
def mapped_tracking(plan: JointPlan) -> Figure:
    """CoM, angular momentum, inertia and foot distance with stage 1's dashed, and below their differences."""
    fig = new_figure(PAGE_IN, 3.2)
    axes = fig.subplots(2, 4, sharex=True)
    flight = plan.phase == "flight"
    takeoff = plan.t[plan.rows("flight").start]
    for column, (title, unit, scale, every, got, want) in zip(axes.T, _tracked(plan), strict=True):
        rows = np.ones(len(plan.t), bool) if every else flight
        t, phase = plan.t[rows], plan.phase[rows]
        for y, reference in zip(got.T, want.T, strict=True):
            by_phase(column[0], t, y, phase)
            column[0].plot(t, reference, **REFERENCE_STYLE)
        miss = np.linalg.norm(got - want, axis=1) if got.shape[1] > 1 else (got - want)[:, 0]
        column[1].axhline(0.0, **LIMIT_STYLE)
        by_phase(column[1], t, scale * miss, phase)
        column[0].set_title(title)
        column[0].set_ylabel(f"[{unit}]")
        column[1].set_ylabel("difference [mm]" if scale > 1 else f"difference [{unit}]")
        column[1].set_xlabel("time [s]")
        for ax in column:
            mark_time(ax, [takeoff])
    legend_above(fig, phase_handles("launch", "flight", reference="stage 1, the reference"))
    return fig


def _tracked(plan: JointPlan):
    """(title, unit, scale of the difference, whole jump or flight only, actual (n, k), reference (n, k)) per column."""
    a, r, planar = plan.actual, plan.reference, [0, 2]
    length = [np.linalg.norm(x["foot_com"][:, planar], axis=1)[:, None] for x in (a, r)]
    return (
        ("CoM, $x$ and $z$", "m", 1000.0, True, a["com"][:, planar], r["com"][:, planar]),
        ("angular momentum $L$", "kg m$^2$/s", 1.0, True, a["L"][:, None], r["L"][:, None]),
        ("inertia $\\rho$", "kg m$^2$", 1.0, True, a["rho"][:, None], r["rho"][:, None]),
        ("sole to CoM", "m", 1000.0, False, *length),
    )


# starts of stage 3 ----------------------------------------------------------------------------------------------
@styled
def guess_comparison(rows: Iterable[Mapping], quantities: Mapping[str, str]) -> Figure:
    """One panel per quantity, one column of dots per start, a thin line per target, a bar at the median.

    Parameters
    ----------
    rows : one mapping per target and start: "target", "start", the quantities (NaN or None without a solution).
    quantities : key -> axis label with unit.
    """
    rows = list(rows)
    starts, targets = (list(dict.fromkeys(r[k] for r in rows)) for k in ("start", "target"))
    fig = new_figure(PAGE_IN, 2.5)
    axes = fig.subplots(1, len(quantities), squeeze=False)[0]
    for ax, (key, label) in zip(axes, quantities.items(), strict=True):
        found = {(r["target"], r["start"]): np.nan if r[key] is None else float(r[key]) for r in rows}
        table = np.array([[found.get((target, start), np.nan) for start in starts] for target in targets])
        _dots(ax, table)
        ax.set_ylabel(label)
        ax.set_xticks(range(len(starts)), starts)
        ax.set_xlim(-0.5, len(starts) - 0.5)
        ax.set_ylim(**_limits(table))
    medians = Line2D([], [], color=INK, linewidth=2.0, label="median")
    legend_above(fig, [medians, Line2D([], [], color="#999999", linewidth=0.6, label="one target")])
    return fig


def _limits(table: np.ndarray) -> dict[str, float]:
    """Limits of an axis: from zero, or around values that hardly differ."""
    values = table[np.isfinite(table)]
    if len(values) and not values.any():
        return {"bottom": 0.0, "top": 1.0}
    if len(values) and values.min() > ALIKE * values.max():
        return {"bottom": ALIKE * values.min(), "top": (2 - ALIKE) * values.max()}
    return {"bottom": 0.0}


def _dots(ax: Axes, table: np.ndarray) -> None:
    """Values (targets, starts): lines of targets, dots of starts, medians."""
    for line in table:
        ax.plot(line, color="#BBBBBB", linewidth=0.6, zorder=1)
    for k, values in enumerate(table.T):
        color = START_COLORS[k % len(START_COLORS)]
        ax.plot(np.full(len(values), k), values, linestyle="none", marker="o", markersize=4, color=color,
                markerfacecolor=tint(color, 0.5), zorder=2, clip_on=False)  # fmt: skip
        if np.isfinite(values).any():
            middle = np.nanmedian(values)
            ax.plot([k - 0.25, k + 0.25], [middle, middle], color=INK, linewidth=2.0, zorder=3)


# landing ------------------------------------------------------------------------------------------
@styled
def landing_reference(plan: LandingPlan, reach: Reach) -> Figure:
    """CoM, angular momentum, ground force and CoP from touchdown until the robot stands, and the stance dashed."""
    fig = new_figure(PAGE_IN, 2.9)
    axes = fig.subplots(2, 2, sharex=True)
    length, weight = float(reach.start[1]), reach.mass * GRAVITY
    heel, toe = reach.cop
    axes[0, 0].plot(plan.t, plan.com[:, 1], color=LANDING)
    axes[0, 0].axhline(length, **REFERENCE_STYLE)
    axes[0, 0].set_ylabel("CoM height [m]")
    axes[0, 1].plot(plan.t, plan.F_z / weight, color=LANDING)
    axes[0, 1].axhline(1.0, **REFERENCE_STYLE)
    axes[0, 1].set_ylabel("$F_z$ [body weights]")
    axes[1, 0].plot(plan.t, plan.L, color=LANDING)
    axes[1, 0].axhline(0.0, **REFERENCE_STYLE)
    axes[1, 0].set_ylabel("$L$ [kg m$^2$/s]")
    ax = axes[1, 1]
    ax.fill_between(plan.t, 100 * heel, 100 * toe, color=tint("#999999", 0.18), linewidth=0)
    for bound in (heel, toe):
        ax.axhline(100 * bound, **LIMIT_STYLE)
    ax.plot(plan.t, 100 * plan.cop_x, color=LANDING, label="CoP")
    ax.plot(plan.t, 100 * plan.com[:, 0], color=LANDING, linewidth=0.9, linestyle=(0, (1, 1.2)), label="CoM")
    ax.set_ylabel("from mid-sole [cm]")
    reach_cm = 100 * max(abs(heel), abs(toe), float(np.abs(plan.com[:, 0]).max()))
    ax.set_ylim(-1.15 * reach_cm, 1.15 * reach_cm)
    ax.legend(loc="lower right", ncols=2)
    for ax in axes[1]:
        ax.set_xlabel("time since touchdown [s]")
    fig.align_ylabels()
    return fig


# flips ------------------------------------------------------------------------------------------
if TYPE_CHECKING:  # pictures of a plan need no simulator
    from jumplab.sim import SimulationResult


@styled
def flip_shaping(srmp: SrmpPlan, tape: Tape, result: SimulationResult, robot: Robot) -> Figure:
    """Inertia, turning rate L / rho, angular momentum, and the tuck beside the trunk's angle; plan dashed.

    Stage 1's flight is thin and orange, set to begin at the plan's take-off.
    """
    fig = new_figure(PAGE_IN, 4.6)
    axes = fig.subplots(2, 2, sharex=True)
    end = result.metrics.touchdown_s or float(tape.t[-1])
    seen = result.t <= end + AFTER_TOUCHDOWN_S
    t, phase = result.t[seen], result.phase[seen]
    rho, momentum = result.rho[seen], result.L[seen]
    planned = tape.extra["planar_rho"].ravel(), tape.extra["planar_L"].ravel()
    one = srmp.flight
    start, thin = tape.takeoff_time, dict(color=FLIGHT, linewidth=0.8, linestyle=(0, (1, 1.2)))
    rows = ((axes[0, 0], r"$\rho$ [kg m$^2$]", rho, planned[0], one.rho),
            (axes[0, 1], r"$\omega = L / \rho$ [rad/s]", momentum / rho, planned[1] / planned[0], one.L / one.rho),
            (axes[1, 0], r"$L$ [kg m$^2$/s]", momentum, planned[1], one.L))  # fmt: skip
    for ax, label, actual, plan, first in rows:
        by_phase(ax, t, actual, phase)
        ax.plot(tape.t, plan, **REFERENCE_STYLE)
        ax.plot(start + one.t, first, **thin)
        ax.set_ylabel(label)
    ax = axes[1, 1]
    by_phase(ax, t, np.degrees(trunk_angle(result.q))[seen], phase)
    ax.plot(tape.t, np.degrees(trunk_angle(tape.q)), **REFERENCE_STYLE)
    ax.set_ylabel("trunk [deg]")
    tuck = ax.twinx()
    knee = 7 + robot.joint_names.index(robot.joints["knee"][0])
    tuck.plot(t, np.degrees(result.q[seen, knee]), color="0.45", linewidth=0.8)
    tuck.set_ylabel("knee [deg], grey")
    for ax in axes.flat:
        mark_time(ax, (start, end))
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    panel_letters(axes.flat)
    handles = phase_handles("launch", "flight", "landing", reference="plan")
    legend_above(fig, [*handles, Line2D([], [], **thin, label="stage 1")])
    fig.align_ylabels()
    return fig
