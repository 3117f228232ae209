"""Pictures of a plan, from its tape: joints, inertia and momentum, and how much of the limits it uses."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.io.tape import Tape
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.show import style
from jumplab.show.bodies import five_link_points
from jumplab.show.style import LAUNCH, PAGE_IN, compare, legend_above, new_figure, phase_handles, styled
from jumplab.stages.whole_body import Limits
from jumplab.task import GRAVITY

LEAST_FORCE_SHARE = 0.02  # below this share of the weight, CoP and friction are 0/0 and not drawn


def heel_up_time(tape: Tape) -> float:
    """When the heel leaves the ground [s]."""
    return float(tape.extra["planar_toe_phase_start"])


# Fig. 8 ---------------------------------------------------------------------------------------------------------
@styled
def joint_trajectories(tape: Tape, robot: Robot, *, guess: tuple[np.ndarray, ...] | None = None) -> Figure:
    """F-8: one column per joint, angle above and velocity below, launch and flight in two colours, limits thin.

    Parameters
    ----------
    guess : time (n,), joint angles and rates (n, 4) in sagittal signs to draw dashed, such as stage 2's.
    """
    fig = new_figure(PAGE_IN, 3.1)
    axes = fig.subplots(2, 4, sharex=True)
    m, e = robot.sagittal, tape.extra
    rows = (
        (e["planar_joints"], m.lower, m.upper, "angle [rad]"),
        (e["planar_joint_rates"], -m.speed, m.speed, "velocity [rad/s]"),
    )
    for k, (y, low, high, label) in enumerate(rows):
        for i, ax in enumerate(axes[k]):
            dashed = [] if guess is None else [(guess[0], guess[1 + k][:, i])]
            compare(ax, (tape.t, y[:, i], tape.phase), *dashed, marks=[heel_up_time(tape)])
            style.limits(ax, low[i], high[i])
            room = 0.06 * (high[i] - low[i])
            ax.set_ylim(low[i] - room, high[i] + room)
        axes[k, 0].set_ylabel(label)
    for name, (top, bottom) in zip(SAGITTAL_JOINTS, axes.T, strict=True):
        top.set_title(name)
        bottom.set_xlabel("time [s]")
    fig.align_ylabels(axes[:, 0])
    dashed = "stage 2, the guess" if guess is not None else None
    legend_above(fig, phase_handles("launch", "flight", limit="limit", reference=dashed))
    return fig


# Fig. 9 ---------------------------------------------------------------------------------------------------------
@styled
def inertia_and_momentum(tape: Tape) -> Figure:
    """F-9: inertia, CoM velocity and angular momentum of the plan, and dashed what stage 1 asked for."""
    fig = new_figure(PAGE_IN, 3.3)
    axes = fig.subplots(2, 2, sharex=True)
    e, takeoff, known = tape.extra, tape.takeoff_time, "srmp_launch_t" in tape.extra
    curves = (
        ("rho", ..., "$\\rho$ [kg m$^2$]"),
        ("L", ..., "$L$ [kg m$^2$/s]"),
        ("com_velocity", (..., 0), "$v_x$ of the CoM [m/s]"),
        ("com_velocity", (..., 1), "$v_z$ of the CoM [m/s]"),
    )
    for ax, (key, part, label) in zip(axes.flat, curves, strict=True):
        asked = []
        if known:
            starts = {"launch": takeoff - e["srmp_launch_t"][-1], "flight": takeoff}
            asked = [(e[f"srmp_{p}_t"] + start, e[f"srmp_{p}_{key}"][part]) for p, start in starts.items()]
        marks = (heel_up_time(tape), takeoff)
        compare(ax, (tape.t, e[f"planar_{key}"][part], tape.phase), *asked, label=label, marks=marks)
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    fig.align_ylabels()
    legend_above(fig, phase_handles("launch", "flight", reference="stage 1, the reference" if known else None))
    return fig


# limits ---------------------------------------------------------------------------------------------------------
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
    r, cop, friction = ground_reaction(tape, robot), axes["cop"], axes["friction"]
    heel = 100 * robot.sagittal.heel[0]
    cop.fill_between(r["t"], heel, 0.0, color=style.BAND, linewidth=0)
    style.limits(cop, heel, 0.0)
    cop.plot(r["t"], 100 * r["cop_x"], color=LAUNCH)
    cop.set(ylabel="CoP from the toe [cm]", ylim=(heel - 3, 3))
    cop.annotate("heel", (0, heel), (2, 2), **style.NOTE_STYLE)
    cop.annotate("toe", (0, 0), (2, -2), va="top", **style.NOTE_STYLE)
    friction.plot(r["t"], np.abs(r["F_x"]) / r["F_z"], color=LAUNCH)
    friction.axhline(limits.friction, **style.REFERENCE_STYLE)
    friction.set(ylabel="friction used $|F_x|/F_z$", ylim=(0, 1.15 * limits.friction))
    for ax in (cop, friction):
        style.mark_time(ax, [heel_up_time(tape)])
        ax.set_xlabel("time [s]")
    legend_above(fig, phase_handles("launch", "flight", limit="limit", reference="what the planner may use"))
    return fig


def _torque_speed(ax: Axes, tape: Tape, robot: Robot, i: int, limits: Limits) -> None:
    m = robot.sagittal
    speed, corner, effort = m.speed[i], m.corner_speed[i], m.effort[i]
    # driving: full torque to the corner, then a line to zero at the no-load speed; braking: full torque
    x = np.array([-speed, -corner, 0.0, corner, speed])
    upper = np.array([effort, effort, effort, effort, 0.0])
    ax.fill_between(x, -upper[::-1], upper, color=style.BAND, linewidth=0)
    for bound in (upper, -upper[::-1]):
        ax.plot(x, bound, **style.LIMIT_STYLE)
    cut, top = limits.speed_share * speed, limits.torque_share * effort
    allowed = np.array([[-cut, corner, cut, cut], [top, top, top * (speed - cut) / (speed - corner), -top]])
    for sign in (1, -1):
        ax.plot(*(sign * allowed), **style.REFERENCE_STYLE)
    rates, torques = (tape.extra[f"planar_{name}"][:, i] for name in ("joint_rates", "torques"))
    style.by_phase(ax, rates, torques, tape.phase, linewidth=1.3)
    ax.set(xlabel="speed [rad/s]", xlim=(-1.08 * speed, 1.08 * speed), ylim=(-1.12 * effort, 1.12 * effort))


def ground_reaction(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Launch's ground reaction, both feet together: t [s], F_x, F_z [N], CoP and heel height [m] (n,).

    The CoP counts from the toe's first place; it is NaN where the ground hardly pushes.
    """
    launch = tape.phase == "launch"
    force = tape.f[launch].sum(axis=1)  # (n, 6), at the ankles
    angles, toe = tape.extra["planar_angles"][launch], tape.extra["planar_toe"][launch]
    points = [five_link_points(robot.sagittal, a, x - toe[0]) for a, x in zip(angles, toe, strict=True)]
    ankle, heel = (np.array([p[name] for p in points]) for name in ("ankle", "heel"))
    up = force[:, 2] > LEAST_FORCE_SHARE * robot.total_mass * GRAVITY
    down = np.where(up, force[:, 2], np.nan)
    cop = ankle[:, 0] - (force[:, 4] + ankle[:, 1] * force[:, 0]) / down
    return dict(t=tape.t[launch], F_x=force[:, 0], F_z=down, cop_x=cop, heel_z=heel[:, 1])
