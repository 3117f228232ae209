"""How much of the robot and of the ground a plan uses: torque against speed, CoP in the sole, friction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.io.tape import Tape
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.show.bodies import five_link_points
from jumplab.show.stages import heel_up_time
from jumplab.show.style import (
    COLUMN_IN,
    LAUNCH,
    LIMIT_STYLE,
    PAGE_IN,
    REFERENCE_STYLE,
    VERMILION,
    by_phase,
    legend_above,
    mark_time,
    new_figure,
    phase_handles,
    styled,
    tint,
)
from jumplab.stages.whole_body import Limits
from jumplab.task import GRAVITY

CUT_M = 0.5  # our choice: a CoP further than this from the sole is drawn cut off
LEAST_FORCE_SHARE = 0.02  # our choice: below this share of the weight, CoP and friction are 0/0 and not drawn


@styled
def margins(tape: Tape, robot: Robot, limits: Limits | None = None) -> Figure:
    """Torque against speed of each joint in its envelope; CoP in the sole and friction used through the launch.

    ``limits`` are the planner's (its defaults if None), drawn dashed inside what the motors could do.
    """
    limits = limits or Limits()
    fig = new_figure(PAGE_IN, 3.9)
    names = [["hip", "knee", "ankle", "shoulder"], ["cop", "cop", "friction", "friction"]]
    axes = fig.subplot_mosaic(names, height_ratios=(1.15, 1.0))
    for i, name in enumerate(SAGITTAL_JOINTS):
        _torque_speed(axes[name], tape, robot, i, limits)
        axes[name].set_title(name)
    axes["hip"].set_ylabel("torque of both sides [N m]")
    _cop(axes["cop"], tape, robot)
    _friction(axes["friction"], tape, robot, limits.friction)
    legend_above(fig, phase_handles("launch", "flight", limit="limit", reference="what the planner may use"))
    return fig


def _torque_speed(ax: Axes, tape: Tape, robot: Robot, i: int, limits: Limits) -> None:
    m = robot.sagittal
    speed, corner, effort = m.speed[i], m.corner_speed[i], m.effort[i]
    # driving: full torque to the corner, then a line to zero at the no-load speed; braking: full torque
    x = np.array([-speed, -corner, 0.0, corner, speed])
    upper = np.array([effort, effort, effort, effort, 0.0])
    ax.fill_between(x, -upper[::-1], upper, color=tint("#999999", 0.18), linewidth=0)
    ax.plot(x, upper, **LIMIT_STYLE)
    ax.plot(x, -upper[::-1], **LIMIT_STYLE)
    cut = limits.speed_share * speed
    top = limits.torque_share * effort
    end = top * (speed - cut) / (speed - corner)
    ax.plot([-cut, corner, cut, cut], [top, top, end, -top], **REFERENCE_STYLE)
    ax.plot([cut, -corner, -cut, -cut], [-top, -top, -end, top], **REFERENCE_STYLE)
    by_phase(ax, tape.extra["planar_joint_rates"][:, i], tape.extra["planar_torques"][:, i], tape.phase, linewidth=1.3)
    ax.set(xlabel="speed [rad/s]", xlim=(-1.08 * speed, 1.08 * speed), ylim=(-1.12 * effort, 1.12 * effort))


def ground_reaction(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Launch's ground reaction, both feet together: t [s], F_x, F_z [N], CoP and heel height [m] (n,).

    The CoP counts from the toe's first place; it is NaN where the ground hardly pushes.
    """
    launch = tape.phase == "launch"
    force = tape.f[launch].sum(axis=1)  # (n, 6), at the ankles
    m, angles, toe = robot.sagittal, tape.extra["planar_angles"][launch], tape.extra["planar_toe"][launch]
    points = [five_link_points(m, a, x - toe[0]) for a, x in zip(angles, toe, strict=True)]
    ankle, heel = (np.array([p[name] for p in points]) for name in ("ankle", "heel"))
    up = force[:, 2] > LEAST_FORCE_SHARE * robot.total_mass * GRAVITY
    down = np.where(up, force[:, 2], np.nan)
    cop = ankle[:, 0] - (force[:, 4] + ankle[:, 1] * force[:, 0]) / down
    return dict(t=tape.t[launch], F_x=force[:, 0], F_z=down, cop_x=cop, heel_z=heel[:, 1])


def _cop(ax: Axes, tape: Tape, robot: Robot) -> None:
    r = ground_reaction(tape, robot)
    heel = robot.sagittal.heel[0]
    ax.fill_between(r["t"], 100 * heel, 0.0, color=tint("#999999", 0.18), linewidth=0)
    for bound in (heel, 0.0):
        ax.axhline(100 * bound, **LIMIT_STYLE)
    ax.plot(r["t"], 100 * r["cop_x"], color=LAUNCH)
    mark_time(ax, [heel_up_time(tape)])
    ax.set(xlabel="time [s]", ylabel="CoP from the toe [cm]", ylim=(100 * heel - 3, 3))
    ax.annotate("heel", (0, 100 * heel), (2, 2), textcoords="offset points", fontsize=7, color="#666666")
    ax.annotate("toe", (0, 0), (2, -2), textcoords="offset points", fontsize=7, color="#666666", va="top")


def _friction(ax: Axes, tape: Tape, robot: Robot, friction: float) -> None:
    r = ground_reaction(tape, robot)
    ax.plot(r["t"], np.abs(r["F_x"]) / r["F_z"], color=LAUNCH)
    ax.axhline(friction, **REFERENCE_STYLE)
    mark_time(ax, [heel_up_time(tape)])
    ax.set(xlabel="time [s]", ylabel="friction used $|F_x|/F_z$", ylim=(0, 1.15 * friction))


@styled
def contact_comparison(reactions: Mapping[str, Mapping[str, np.ndarray]], robot: Robot) -> Figure:
    """Heel height and CoP of several launches over each other, by name; see :func:`ground_reaction` for their form.

    The last is drawn in the launch's colour, those before it in vermilion: what is right, and what is wrong.
    """
    fig = new_figure(COLUMN_IN, 2.9)
    top, bottom = fig.subplots(2, 1, sharex=True)
    heel = robot.sagittal.heel[0]
    last = max(float(r["t"][-1]) for r in reactions.values())
    bottom.fill_between([0, last], 100 * heel, 0.0, color=tint("#999999", 0.18), linewidth=0)
    for bound, name in ((heel, "heel"), (0.0, "toe")):
        bottom.axhline(100 * bound, **LIMIT_STYLE)
        bottom.annotate(
            name,
            (1, 100 * bound),
            (3, 0),
            xycoords=bottom.get_yaxis_transform(),
            fontsize=7,
            textcoords="offset points",
            color="#666666",
            va="center",
        )  # beside the axes: no curve there
    for k, (name, r) in enumerate(reactions.items(), start=1):
        color = LAUNCH if k == len(reactions) else VERMILION
        top.plot(r["t"], 100 * r["heel_z"], color=color, label=name)
        bottom.plot(r["t"], 100 * r["cop_x"], color=color)
    top.set_ylabel("heel height [cm]")
    top.legend(loc="upper left")
    cop = np.concatenate([r["cop_x"] for r in reactions.values()])
    low = max(float(np.nanmin(cop)), heel - CUT_M) if np.isfinite(cop).any() else heel
    high = min(float(np.nanmax(cop)), CUT_M) if np.isfinite(cop).any() else 0.0
    bottom.set(xlabel="time [s]", ylabel="CoP from the toe [cm]")
    bottom.set_ylim(100 * min(low, heel) - 9, 100 * max(high, 0.0) + 9)
    fig.align_ylabels()
    return fig
