"""One sheet per robot: its shapes, its joints with their roles, and the five links that are planned with."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.robot import Robot
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.show.bodies import Silhouette, draw_five_link, draw_ground, draw_robot
from jumplab.show.style import FLIGHT, INK, LANDING, LAUNCH, PAGE_IN, PURPLE, VERMILION, bare, new_figure, styled

BODY = "#5B6B7F"
ROLE_COLORS = {"hip_pitch": LAUNCH, "knee": FLIGHT, "ankle_pitch": LANDING, "shoulder_pitch": PURPLE}


@styled
def robot_sheet(robot: Robot) -> Figure:
    """Standing robot from the side, its moving joints from the front, and its sagittal reduction."""
    fig = new_figure(PAGE_IN, 3.0)
    axes = fig.subplots(1, 3)
    q = stance_configuration(robot)
    side, front = Silhouette(robot), Silhouette(robot, "front")
    top = max(outline[:, 1].max() for _, outline in side.outlines(q))
    draw_robot(axes[0], side, q, BODY)
    com = side.com(q)
    axes[0].plot(*com, marker="o", markersize=6, markerfacecolor="white", markeredgecolor=VERMILION, zorder=6)
    axes[0].plot(*com, marker="+", markersize=6, color=VERMILION, zorder=7)
    axes[0].annotate("CoM", com, (8, 0), textcoords="offset points", va="center", fontsize=7, color=VERMILION)
    _joints(axes[1], robot, front, q, top)
    _reduction(axes[2], robot, top)
    for ax, title in zip(axes, ("(a) side view", "(b) joints that move, front", "(c) sagittal reduction"), strict=True):
        draw_ground(ax, -0.6 * top, 0.6 * top)
        bare(ax)
        ax.set(xlim=(-0.55 * top, 0.55 * top), ylim=(-0.08 * top, 1.06 * top), aspect="equal")
        ax.set_title(title)
    return fig


def _joints(ax: Axes, robot: Robot, front: Silhouette, q: np.ndarray, top: float) -> None:
    model, place = robot.model, front.joints(q)
    roles = {name: role for role, pair in robot.joints.items() for name in pair}
    trunk = np.array([0.0, robot_height(robot, q, 1)])
    for joint in range(2, model.njoints):
        above = model.parents[joint]
        start = trunk if above == 1 else place[model.names[above]]
        ax.plot(*np.array([start, place[model.names[joint]]]).T, color=BODY, linewidth=2.0, zorder=2)
    for name, at in place.items():
        color = ROLE_COLORS.get(roles.get(name), "white")
        ax.plot(*at, marker="o", markersize=6 if name in roles else 3.5, markerfacecolor=color, markeredgecolor=INK,
                markeredgewidth=0.6, zorder=4 if name in roles else 5)  # fmt: skip
    for role, pair in robot.joints.items():
        if pair:
            ax.text(
                0.20 * top, place[pair[0]][1], role.replace("_", " "), va="center", fontsize=7, color=ROLE_COLORS[role]
            )
        else:
            ax.text(0.0, 0.97 * top, "arms held", ha="center", va="center", fontsize=7, color=ROLE_COLORS[role])


def robot_height(robot: Robot, q: np.ndarray, joint: int) -> float:
    """Height of a joint's frame above the ground [m]; 1 is the trunk."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    return float(data.oMi[joint].translation[2])


def _reduction(ax: Axes, robot: Robot, top: float) -> None:
    m = robot.sagittal
    p = draw_five_link(ax, m, stance_angles(robot), -m.sole_center, BODY, linewidth=3.0)
    middles = {"foot": p["toe"] + [0.0, 0.03 * top], "shank": (p["ankle"] + p["knee"]) / 2,
               "thigh": (p["knee"] + p["hip"]) / 2,
               "trunk": (p["hip"] + p["shoulder"]) / 2, "arm": p["hand"]}  # fmt: skip
    for (name, at), mass in zip(middles.items(), m.mass, strict=True):
        if mass > 0:
            ax.text(at[0] + 0.06 * top, at[1], f"{name} {mass:.1f} kg", va="center", fontsize=7, color="#444444")
    ax.plot(*p["com"], marker="o", markersize=6, markerfacecolor="white", markeredgecolor=VERMILION, zorder=6)
    ax.plot(*p["com"], marker="+", markersize=6, color=VERMILION, zorder=7)
