"""The pictures of a jump's tape where it leaves the plane: both sides of the robot, three components of each vector."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.show import style
from jumplab.stages.whole_body import Limits

if TYPE_CHECKING:
    from jumplab.sim import SimulationResult

PALE = 0.45  # opacity of the right side
COLUMNS = 3  # of the panels of limits
LEAST_FORCE_SHARE = 0.05  # of the weight, on one foot, below which CoP and friction are 0/0 and not drawn


def leaves_plane(tape: Tape) -> bool:
    """Whether a tape has no quantities of the five links in the plane."""
    return "planar_joints" not in tape.extra


def pairs(robot: Robot) -> dict[str, list[int]]:
    """Joints by their names without the side: name -> left and right, or one alone."""
    out: dict[str, list[int]] = {}
    for i, name in enumerate(robot.joint_names):
        out.setdefault(name.removeprefix("left_").removeprefix("right_").replace("_", " "), []).append(i)
    return out


def motor(ax: Axes, speed: float, corner: float, free: float, effort: float, limits: Limits | Limits) -> None:
    """What a motor can do, torque against speed up to its no-load speed ``free``; dashed what the planner may use."""
    # driving: full torque to the corner, then a line to zero at the no-load speed; braking: full torque
    x = np.array([-free, -corner, 0.0, corner, free])
    upper = np.array([effort, effort, effort, effort, 0.0])
    ax.fill_between(x, -upper[::-1], upper, color=style.BAND, linewidth=0)
    for bound in (upper, -upper[::-1]):
        ax.plot(x, bound, **style.LIMIT_STYLE)
    cut, top = limits.speed_share * speed, limits.torque_share * effort
    left = min(1.0, (free - cut) / (free - corner))
    allowed = np.array([[-cut, min(corner, cut), cut, cut], [top, top, top * left, -top]])
    for sign in (1, -1):
        ax.plot(*(sign * allowed), **style.REFERENCE_STYLE)
    ax.set(xlabel="speed [rad/s]", xlim=(-1.08 * free, 1.08 * free), ylim=(-1.12 * effort, 1.12 * effort))


def joint_trajectories(tape: Tape, robot: Robot, heel_up: float) -> Figure:
    """Angles above, rates below, a column per pair of joints, the right side paler."""
    joints = pairs(robot)
    fig = style.new_figure(style.PAGE_IN, 3.1)
    axes = fig.subplots(2, len(joints), sharex=True)
    for column, (name, sides) in zip(axes.T, joints.items(), strict=True):
        for k, (ax, values) in enumerate(zip(column, (tape.q[:, 7:], tape.v[:, 6:]), strict=True)):
            for i, alpha in zip(sides, (1.0, PALE), strict=False):
                style.compare(ax, (tape.t, values[:, i], tape.phase), marks=[heel_up], alpha=alpha)
            a = robot.actuators[robot.joint_names[sides[0]]]
            style.limits(ax, *((a["lower"], a["upper"]) if k == 0 else (-a["speed"], a["speed"])))
        column[0].set_title(name.removesuffix(" pitch"), fontsize=7)
        column[1].set_xlabel("time [s]")
    for ax, label in zip(axes[:, 0], ("angle [rad]", "velocity [rad/s]"), strict=True):
        ax.set_ylabel(label)
    style.legend_above(fig, style.phase_handles("launch", "flight", limit="limit"))
    return fig


def speed_and_momentum(tape: Tape, heel_up: float) -> Figure:
    """Velocity of the CoM and L about it, in three directions."""
    fig = style.new_figure(style.PAGE_IN, 3.3)
    axes = fig.subplots(2, 3, sharex=True)
    speed = tape.extra["com_velocity"], "$v_{}$ of the CoM [m/s]"
    spin = tape.extra["angular_momentum"], "$L_{}$ [kg m$^2$/s]"
    for row, (values, label) in zip(axes, (speed, spin), strict=True):
        for ax, curve, axis in zip(row, values.T, "xyz", strict=True):
            marks = heel_up, tape.takeoff_time
            style.compare(ax, (tape.t, curve, tape.phase), label=label.format(axis), marks=marks)
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    style.legend_above(fig, style.phase_handles("launch", "flight"))
    return fig


def feet_reaction(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Launch's t (n,) [s], force on each foot (n, 2, 3) [N], CoP (n, 2, 2) from the middle of each sole [m].

    The CoP is NaN where the ground hardly pushes.
    """
    launch, model = np.flatnonzero(tape.phase == "launch"), robot.model
    data, f, place = model.createData(), tape.f[launch], []
    for k in launch:
        pin.framesForwardKinematics(model, data, tape.q[k])
        place.append([data.oMf[model.getFrameId(name)].translation.copy() for name in robot.foot.frames])
    pin.framesForwardKinematics(model, data, tape.q[0])
    soles = np.array([data.oMf[model.getFrameId(name)].act(robot.foot.center) for name in robot.foot.frames])
    moment = f[..., 3:] + np.cross(np.array(place) - soles, f[..., :3])
    least = LEAST_FORCE_SHARE * robot.total_mass * robot.gravity
    down = np.where(f[..., 2] > least, f[..., 2], np.nan)
    return {
        "t": tape.t[launch],
        "force": f[..., :3],
        "cop": np.stack([-moment[..., 1], moment[..., 0]], -1) / down[..., None],
    }


def margins(tape: Tape, robot: Robot, limits: Limits | Limits, heel_up: float) -> Figure:
    """Torque against speed of every pair of joints; CoP in both soles, and friction used by both feet."""
    joints, r = pairs(robot), feet_reaction(tape, robot)
    lines = -(-(len(joints) + 2) // COLUMNS)
    fig = style.new_figure(style.PAGE_IN, 1.75 * lines)
    axes = fig.subplots(lines, COLUMNS).ravel()
    for ax, (name, sides) in zip(axes, joints.items(), strict=False):
        a = robot.actuators[robot.joint_names[sides[0]]]
        motor(ax, a["speed"], a["corner_speed"], a["no_load_speed"], a["effort"], limits)
        for i, alpha in zip(sides, (1.0, PALE), strict=False):
            style.by_phase(ax, tape.v[:, 6 + i], tape.tau[:, i], tape.phase, linewidth=1.1, alpha=alpha)
        ax.set(title=name, ylabel="torque [N m]")
    cop, friction = axes[len(joints) : len(joints) + 2]
    half, force = 50 * (robot.foot.toe - robot.foot.heel), r["force"]
    used = np.linalg.norm(force[..., :2], axis=-1) / np.where(np.isnan(r["cop"][..., 0]), np.nan, force[..., 2])
    cop.fill_between(r["t"], -half, half, color=style.BAND, linewidth=0)
    style.limits(cop, -half, half)
    for side, alpha in enumerate((1.0, PALE)):
        cop.plot(r["t"], 100 * r["cop"][:, side, 0], color=style.LAUNCH, alpha=alpha)
        friction.plot(r["t"], used[:, side], color=style.LAUNCH, alpha=alpha)
    friction.axhline(limits.friction, **style.REFERENCE_STYLE)
    cop.set(ylabel="CoP ahead of mid-sole [cm]", xlabel="time [s]")
    friction.set(ylabel="friction used", ylim=(0, 1.15 * limits.friction), xlabel="time [s]")
    for ax in (cop, friction):
        style.mark_time(ax, [heel_up])
    for ax in axes[len(joints) + 2 :]:
        style.bare(ax)
    reference = "what the planner may use"
    style.legend_above(fig, style.phase_handles("launch", "flight", limit="limit", reference=reference))
    return fig


def momentum(result: SimulationResult, tape: Tape, after_s: float) -> Figure:
    """CoM position and velocity in three directions; dashed the plan, coloured the simulation."""
    fig, e = style.new_figure(style.PAGE_IN, 3.4), tape.extra
    axes, seen = fig.subplots(2, 3, sharex=True), result.t <= tape.t[-1] + after_s
    for k, x in enumerate("xyz"):
        for ax, actual, planned, label in (
            (axes[0, k], result.com, e["com"], f"CoM ${x}$ [m]"),
            (axes[1, k], result.com_velocity, e["com_velocity"], f"CoM $v_{x}$ [m/s]"),
        ):
            curve = result.t[seen], actual[seen, k], result.phase[seen]
            style.compare(ax, curve, (tape.t, planned[:, k]), label=label, marks=[tape.takeoff_time])
        axes[1, k].set_xlabel("time [s]")
    style.panel_letters(axes.flat)
    style.legend_above(fig, style.phase_handles(*style.PHASE_COLORS, reference="plan"))
    return fig
