"""Pictures of a jump, from its tape or its simulation's log.

Of every joint both sides are drawn, the right one paler. A jump in the plane has the joints that
bend in it, and the planar quantities of its tape; any other one has all of both.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jumplab.auditing.replay import runs
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.legs import size
from jumplab.robot.motors import MotorLimits
from jumplab.show.bodies import Silhouette, draw_ground, draw_path, film_strip
from jumplab.show.shapes import pressure_points, trace
from jumplab.show.style import (
    BAND,
    LAUNCH,
    LIMIT_STYLE,
    NOTE_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    REFERENCE_STYLE,
    bare,
    by_phase,
    compare,
    legend_above,
    mark_time,
    new_figure,
    panel_letters,
    phase_handles,
    shade,
    themed,
)
from jumplab.show.style import (
    limits as draw_limits,
)
from jumplab.stages.plan import JumpPlan
from jumplab.stages.whole_body import Limits

if TYPE_CHECKING:  # pictures need no simulator
    from jumplab.sim import SimulationResult

OPACITIES = (1.0, 0.45)  # of the left side and of the right one
COLUMNS = 3  # of the panels of limits
AFTER_TOUCHDOWN_S = 0.25  # how much of the landing is shown
FLIGHT_SHARES = (0.25, 0.5, 0.75)  # when frames of the flight are shown
STRIP_M = 0.72  # from frame to frame, just more than a robot with its arms stretched out
# a limit is used up from this share on, this near to a stop or to the end of a sole
FULL = 0.985
NEAR_STOP_RAD = 0.01
NEAR_EDGE_M = 0.004
LEAST_SHARE = 0.02  # of the weight on a foot: below, CoP and friction are 0/0 and not drawn
MOMENTUM, INERTIA = "$L$ [kg m$^2$/s]", "$\\rho$ [kg m$^2$]"
# name on the tape and component of each curve in the plane, and out of it: of the plan alone ...
PLANAR_CURVES = {
    INERTIA: ("rho", ...),
    MOMENTUM: ("L", ...),
    "$v_x$ of the CoM [m/s]": ("com_velocity", 0),
    "$v_z$ of the CoM [m/s]": ("com_velocity", 1),
}
# ... and of what is simulated too
PLANAR_MOTION = {
    "CoM $x$ [m]": ("com", 0),
    "CoM $z$ [m]": ("com", 2),
    f"{MOMENTUM}, launch": ("planar_L", ...),
    "CoM $v_x$ [m/s]": ("com_velocity", 0),
    "CoM $v_z$ [m/s]": ("com_velocity", 2),
    INERTIA: ("planar_rho", ...),
}


def _components(label: str, name: str) -> dict[str, tuple]:
    """Curves of all three components of an array, which ``label`` calls "?"."""
    return {label.replace("?", x): (name, k) for k, x in enumerate("xyz")}


SPATIAL_CURVES = {
    **_components("$v_?$ of the CoM [m/s]", "com_velocity"),
    **_components("$L_?$ [kg m$^2$/s]", "angular_momentum"),
}
SPATIAL_MOTION = _components("CoM $?$ [m]", "com") | _components("CoM $v_?$ [m/s]", "com_velocity")


def _in_plane(tape: Tape) -> bool:
    return "planar_joints" in tape.extra


def _heel_up_time(tape: Tape) -> float:
    """When the heel leaves the ground [s]."""
    name = "planar_toe_phase_start" if _in_plane(tape) else "toe_phase_start"
    return float(tape.extra[name])


def _joints(tape: Tape, robot: Robot) -> dict[str, list[int]]:
    """The joints to show: their columns by title, of one joint or of a pair."""
    columns = defaultdict(list)
    in_plane = {name for pair in robot.joints.values() for name in pair}
    for i, name in enumerate(robot.joint_names):
        if name in in_plane or not _in_plane(tape):
            title = name.removeprefix("left_").removeprefix("right_").removesuffix("_joint")
            columns[title.replace("_", " ")].append(i)
    return columns


# Fig. 8 and 9
# ----------------------------------------------------------------------------------------------
def _panels(curves: dict[str, tuple], handles: list, height: float) -> tuple[Figure, np.ndarray]:
    """Two rows of panels by label: a curve, those to compare it with, when phases change [s]."""
    fig = new_figure(PAGE_IN, height)
    axes = fig.subplots(2, len(curves) // 2, sharex="col")
    for ax, (label, (curve, references, marks)) in zip(axes.flat, curves.items(), strict=True):
        compare(ax, curve, *references, label=label, marks=marks)
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    fig.align_ylabels()
    legend_above(fig, handles)
    return fig, axes


@themed
def joint_trajectories(
    tape: Tape,
    robot: Robot,
    *,
    guess: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    torques: bool = False,
) -> Figure:
    """F-8: one column per pair of joints, angle above and velocity below, limits thin.

    Parameters
    ----------
    torques : a third row, of torques and of the most that each motor gives at its speed then.
    guess : time (n,) [s], joint angles (n, 4) [rad] and rates (n, 4) [rad/s] in sagittal signs to
        draw dashed, such as stage 2's; of a jump in the plane alone.
    """
    joints = _joints(tape, robot)
    signs = {name: (row, sign) for name, row, sign in robot.role_signs()}
    fig = new_figure(PAGE_IN, 4.5 if torques else 3.1)
    axes = fig.subplots(3 if torques else 2, len(joints), sharex=True)
    for column, (title, sides) in zip(axes.T, joints.items(), strict=True):
        motor = robot.limits[sides[0]]
        panels = (
            (tape.q[:, 7:], (motor.lower, motor.upper)),
            (tape.v[:, 6:], (-motor.speed, motor.speed)),
            (tape.tau, motor.range(tape.v[:, 6 + sides[0]])),
        )
        for ax, (values, edges) in zip(column, panels, strict=False):
            for i, opacity in zip(sides, OPACITIES, strict=False):
                by_phase(ax, tape.t, values[:, i], tape.phase, alpha=opacity)
            mark_time(ax, [_heel_up_time(tape)])
            for edge in edges:
                ax.plot(tape.t, np.broadcast_to(edge, tape.t.shape), **LIMIT_STYLE)
        if guess is not None:
            row, sign = signs[robot.joint_names[sides[0]]]
            for ax, rows in zip(column, guess[1:], strict=False):
                ax.plot(guess[0], sign * rows[:, row], **REFERENCE_STYLE)
        column[0].set_title(title.removesuffix(" pitch"), fontsize=8 if len(joints) < 5 else 7)
        column[-1].set_xlabel("time [s]")
    labels = ("angle [rad]", "velocity [rad/s]", "torque [N m]")
    for ax, label in zip(axes[:, 0], labels, strict=False):
        ax.set_ylabel(label)
    fig.align_ylabels(axes[:, 0])
    dashed = None if guess is None else "stage 2, the guess"
    legend_above(fig, phase_handles("launch", "flight", limit="limit", reference=dashed))
    return fig


@themed
def inertia_and_momentum(tape: Tape) -> Figure:
    """F-9: inertia, CoM velocity and angular momentum of the plan; dashed what stage 1 asked for.

    Out of the plane CoM velocity and angular momentum alone, in all three directions.
    """
    e = tape.extra
    names, prefix = (PLANAR_CURVES, "planar_") if _in_plane(tape) else (SPATIAL_CURVES, "")
    takeoff = tape.takeoff_time
    starts = {}
    if "srmp_launch_t" in e:
        starts = {"launch": takeoff - e["srmp_launch_t"][-1], "flight": takeoff}
    marks = (_heel_up_time(tape), takeoff)
    curves = {}
    for label, (name, part) in names.items():
        asked = [(e[f"srmp_{p}_t"] + t, e[f"srmp_{p}_{name}"].T[part]) for p, t in starts.items()]
        curves[label] = (tape.t, e[prefix + name].T[part], tape.phase), asked, marks
    dashed = "stage 1, the reference" if starts else None
    return _panels(curves, phase_handles("launch", "flight", reference=dashed), 3.3)[0]


# limits
# ----------------------------------------------------------------------------------------------
@themed
def margins(tape: Tape, robot: Robot, limits: Limits | None = None) -> Figure:
    """Torque against speed of each joint in its envelope; CoP in the sole and friction used through
    the launch.

    ``limits`` are the planner's (its defaults for the robot if None), drawn dashed inside what the
    motors could do.
    """
    limits = limits or Limits().of_size(size(robot))
    joints = _joints(tape, robot)
    panels = [*joints, "cop", "friction"]
    panels += ["."] * (-len(panels) % COLUMNS)
    mosaic = np.reshape(panels, (-1, COLUMNS)).tolist()
    fig = new_figure(PAGE_IN, 1.75 * len(mosaic))
    axes = fig.subplot_mosaic(mosaic)
    for title, sides in joints.items():
        ax = axes[title]
        _draw_motor(ax, robot.limits[sides[0]], limits)
        for i, opacity in zip(sides, OPACITIES, strict=False):
            by_phase(ax, tape.v[:, 6 + i], tape.tau[:, i], tape.phase, linewidth=1.1, alpha=opacity)
        ax.set(title=title, ylabel="torque [N m]")
    _draw_contact(axes["cop"], axes["friction"], tape, robot, limits)
    reference = "limit of the planner"
    legend_above(fig, phase_handles("launch", "flight", limit="limit", reference=reference))
    return fig


def _draw_motor(ax: Axes, motor: MotorLimits, limits: Limits) -> None:
    """A motor's torque against speed, as far as it goes; dashed as far as the planner goes."""
    free = motor.no_load_speed
    x = np.array([-free, -motor.corner_speed, motor.corner_speed, free])
    edges = motor.range(x)
    ax.fill_between(x, *edges, color=BAND, linewidth=0)
    for edge in edges:
        ax.plot(x, edge, **LIMIT_STYLE)
    cut = limits.speed_share * motor.speed
    rates = np.clip(x, -cut, cut)
    least, most = motor.range(rates)
    around = limits.torque_share * np.append(least, most[::-1])
    ax.fill(np.append(rates, rates[::-1]), around, fill=False, **REFERENCE_STYLE)
    ax.set(xlabel="speed [rad/s]", xlim=(-1.08 * free, 1.08 * free))
    ax.set_ylim(-1.12 * motor.effort, 1.12 * motor.effort)


def _draw_contact(cop: Axes, friction: Axes, tape: Tape, robot: Robot, limits: Limits) -> None:
    """CoP in each sole, and friction used by each foot, through the launch."""
    r = ground_reaction(tape, robot)
    heel = 100 * (robot.foot.heel - robot.foot.toe)
    cop.fill_between(r["t"], heel, 0.0, color=BAND, linewidth=0)
    draw_limits(cop, heel, 0.0)
    cop.annotate("heel", (0, heel), (2, 2), **NOTE_STYLE)
    cop.annotate("toe", (0, 0), (2, -2), va="top", **NOTE_STYLE)
    for foot, opacity in enumerate(OPACITIES):
        cop.plot(r["t"], 100 * r["cop_x"][:, foot], color=LAUNCH, alpha=opacity)
        friction.plot(r["t"], r["friction"][:, foot], color=LAUNCH, alpha=opacity)
    friction.axhline(limits.friction, **REFERENCE_STYLE)
    friction.set_ylim(0, 1.15 * limits.friction)
    cop.set_ylim(heel - 3, 3)
    for ax, label in ((cop, "CoP from the toe [cm]"), (friction, "friction used")):
        mark_time(ax, [_heel_up_time(tape)])
        ax.set(xlabel="time [s]", ylabel=label)


@themed
def active(plan: JumpPlan, limits: Limits | None = None) -> Figure:
    """Which limit of a plan binds when: a bar while a joint, a foot or the friction uses all that
    the planner may use, in the colour of the phase.

    ``limits`` are the planner's, its defaults for the robot if None. Bars of left and right are
    one.
    """
    tape = plan.tape
    rows = _used_up(tape, plan.robot, limits or Limits().of_size(size(plan.robot)))
    rows = {name: used for name, used in rows.items() if used.any()}
    names = sorted(rows, key=lambda name: -int(np.argmax(rows[name])))
    fig = new_figure(PAGE_IN, 0.9 + 0.2 * len(names))
    ax = fig.subplots()
    for k, name in enumerate(names):
        for phase, color in PHASE_COLORS.items():
            used = rows[name] & (tape.phase == phase)
            parts = [part for part in runs(used) if used[part.start]]
            spans = [tape.t[part.start : part.stop + 1] for part in parts]
            bars = [(span[0], np.ptp(span)) for span in spans]
            ax.broken_barh(bars, (k - 0.35, 0.7), facecolor=color, edgecolor=color, linewidth=0.8)
    mark_time(ax, (_heel_up_time(tape), tape.takeoff_time))
    ax.set_yticks(range(len(names)), names)
    ax.set(xlabel="time [s]", xlim=(tape.t[0], tape.t[-1]), ylim=(-0.6, len(names) - 0.4))
    ax.grid(False, axis="y")
    legend_above(fig, phase_handles(*dict.fromkeys(map(str, tape.phase))))
    return fig


def _used_up(tape: Tape, robot: Robot, limits: Limits) -> dict[str, np.ndarray]:
    """Limit in words -> whether it is used up (N,), of the joints, the soles and the friction."""
    motors = robot.limits
    angles, speeds = tape.q[:, 7:], tape.v[:, 6:]
    least, most = (FULL * limits.torque_share * edge for edge in motors.range(speeds))
    room = limits.range_margin_rad + NEAR_STOP_RAD
    by_limit = {
        "torque": (tape.tau >= most) | (tape.tau <= least),
        "speed": np.abs(speeds) >= FULL * limits.speed_share * motors.speed,
        "lower stop": angles <= motors.lower + room,
        "upper stop": angles >= motors.upper - room,
    }
    rows = {}
    for title, sides in _joints(tape, robot).items():
        rows |= {f"{title}, {what}": used[:, sides].any(axis=1) for what, used in by_limit.items()}
    ground = ground_reaction(tape, robot)
    launch = tape.phase == "launch"
    heel = robot.foot.heel - robot.foot.toe + limits.cop_margin_m
    for what, used in {
        "CoP at the heel": ground["cop_x"] <= heel + NEAR_EDGE_M,
        "CoP at the toe": ground["cop_x"] >= -NEAR_EDGE_M,
        "friction": ground["friction"] >= FULL * limits.friction,
    }.items():
        rows[what] = np.zeros(len(tape.t), bool)
        rows[what][launch] = used.any(axis=1)
    return rows


def ground_reaction(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Launch's ground reaction over ``t`` (n,) [s], left foot first.

    ``force`` (n, 2, 3) [N]; ``friction`` (n, 2) used, and the CoP's ``cop_x`` (n, 2) from the toe's
    first place [m], NaN where the ground hardly pushes; heights of the heels ``heel_z`` (n, 2) [m].
    """
    launch = tape.phase == "launch"
    poses = trace(robot, tape.q[launch]).feet
    foot = robot.foot
    tip, heel = ((poses @ [*x, 1.0])[..., :3] for x in (foot.tip, 2 * foot.center - foot.tip))
    wrench = tape.f[launch]
    least = LEAST_SHARE * robot.total_mass * robot.gravity
    cop = pressure_points(wrench, poses[..., :3, 3], tip[0, :, 2], least) - tip[0]
    used = np.linalg.norm(wrench[..., :2], axis=-1) / np.maximum(wrench[..., 2], least)
    return {
        "t": tape.t[launch],
        "force": wrench[..., :3],
        "friction": np.where(np.isnan(cop[..., 0]), np.nan, used),
        "cop_x": cop[..., 0],
        "heel_z": heel[..., 2],
    }


# simulations
# ----------------------------------------------------------------------------------------------
@themed
def jump_strobe(record: SimulationResult | Tape, robot: Robot) -> Figure:
    """F-1: a simulated or planned jump in one picture, each phase in its colour, with the CoM's
    path.

    Heights [m] are true; sideways the frames are evenly spaced, so that none hides another. A jump
    that goes more to the side than ahead is seen from the front.
    """
    height = trace(robot, record.q).com[:, 2]
    travel = np.ptp(record.q[:, :2], axis=0)
    rows = _strip_rows(record, height)
    fig = new_figure(PAGE_IN, 2.6)
    ax = fig.subplots()
    places = STRIP_M * np.arange(len(rows))
    colors = [PHASE_COLORS[str(phase)] for phase in record.phase[rows]]
    body = Silhouette(robot, "front" if travel[1] > travel[0] else "side")
    film_strip(ax, body, record.q[rows], record.t[rows], colors, places)
    for text, color in zip(ax.texts, colors, strict=True):
        text.set_color(shade(color, 0.8))
    air = (record.phase == "flight") & (record.t <= record.t[rows[-1]])
    # linear in time between frames
    draw_path(ax, np.interp(record.t[air], record.t[rows], places), height[air])
    left, right = ax.get_xlim()
    draw_ground(ax, left, right)
    ax.set_xlim(left, right)
    legend_above(fig, phase_handles(*dict.fromkeys(map(str, record.phase))))
    bare(ax)
    return fig


def _strip_rows(record: SimulationResult | Tape, height: np.ndarray) -> np.ndarray:
    """Rows of the frames: beginning, deepest and end of each time on the ground, some of each
    flight.
    """
    pieces = runs(record.phase)
    if len(pieces) == 1:  # it never left the ground
        return np.linspace(0, len(record.t) - 1, 5).astype(int)
    shares = FLIGHT_SHARES if len(pieces) < 4 else FLIGHT_SHARES[1:2]
    rows = []
    for piece in pieces:
        first, last = piece.start, piece.stop - 1
        if record.phase[first] == "flight":
            rows += [first + int(share * (last - first)) for share in shares]
        else:
            rows += [first, first + np.argmin(height[piece]), last]
    return np.array(rows)


@themed
def momentum(result: SimulationResult, tape: Tape, robot: Robot) -> Figure:
    """F-12: CoM position [m] and velocity [m/s], inertia, and L during the launch; dashed the plan,
    coloured the simulation.

    Out of the plane CoM position and velocity alone, in all three directions.
    """
    curves = {}
    for label, (name, part) in (PLANAR_MOTION if _in_plane(tape) else SPATIAL_MOTION).items():
        actual = getattr(result, name.removeprefix("planar_")).T[part]
        planned = tape.extra[name].T[part]
        launch = label.endswith("launch")
        seen = result.phase == "launch" if launch else result.t <= tape.t[-1] + AFTER_TOUCHDOWN_S
        kept = tape.phase == "launch" if launch else slice(None)
        marks = [] if launch else [tape.takeoff_time]
        curve = (result.t[seen], actual[seen], result.phase[seen])
        curves[label] = curve, [(tape.t[kept], planned[kept])], marks
    fig, axes = _panels(curves, phase_handles(*PHASE_COLORS, reference="plan"), 3.4)
    panel_letters(axes.flat)
    return fig
