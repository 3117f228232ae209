"""Violations of physics, by the same checks for stage 3 as printed and for ours, at every millisecond."""

from __future__ import annotations

from typing import Any

import numpy as np

from jumplab.errors import InputError
from jumplab.io.tape import Tape
from jumplab.robot import SAGITTAL_JOINTS, Robot, SagittalModel
from jumplab.robot.contact import moving, on_feet, point_motion
from jumplab.task import JumpTask
from paper.whole_body_printed import MOTION, PaperCoordinates, PrintedPlan, planar_numbers

# what a violation is
HEEL_UP_M, MOMENT_NM = 0.005, 5.0  # a heel is up, and a moment about the toe is one, beyond these
LOADED_N = 100.0  # CoP and friction are quotients by F_z: looked at beyond a quarter of the weight
FRICTION = 0.5  # the lowest that the simulations use
CONTACT_M, PLACE_M = 0.001, 0.01  # of slip and of height over the ground; of CoP and of jump length
FREE_FALL, RESIDUAL_PERCENT, DRIFT, PITCH_RAD = 0.1, 0.5, 0.01, 0.01  # [m/s^2], of m g, of L [kg m^2/s], of the foot


def violations(plan: Any, robot: Robot) -> tuple[dict, ...]:
    """Violations of physics in a motion, found by evaluating it again at every millisecond.

    Parameters
    ----------
    plan : a :class:`PrintedPlan`, or anything with ``task`` and ``tape`` as a finished jump has.

    Returns
    -------
    Rows name, amount (worst of all samples), unit, limit, kept, note; of a missing flight amounts are nan, not kept.

    Raises
    ------
    InputError
        If the printed launch was not solved.
    """
    task, note = plan.task, ""
    if isinstance(plan, PrintedPlan):
        if plan.launch is None:
            raise InputError(f"the printed launch was not solved ({plan.launch_status}): there is no motion to judge")
        motion, planned = plan.motion, np.stack([plan.F_x, plan.F_z], -1)
        phase = plan.launch.phases["launch"]
        nodes = PaperCoordinates(robot.sagittal).links(phase.q, phase.v, phase.a)
        up, turned = _heel_up(nodes, planar_numbers(robot, nodes, task.gravity))
        note = f"; at nodes {turned.sum()} of {len(up)}"
    else:
        motion = planar_motion(plan.tape, robot) | dict(flying=plan.tape.phase == "flight")
        planned = plan.tape.f.sum(axis=1)[:, [0, 2]]
    x = planar_numbers(robot, motion, task.gravity)
    down = {k: v[~motion["flying"]] for k, v in {**x, **{k: motion[k] for k in MOTION}}.items()}
    rows = (
        *_contact_rows(down, note),
        *_joint_rows(robot.sagittal, x),
        *_motion_rows(robot.sagittal, motion, x, planned, task),
    )
    keys = ("name", "amount", "unit", "limit", "note")
    return tuple(dict(zip(keys, r, strict=True), kept=bool(r[1] <= r[3])) for r in rows)


def planar_motion(tape: Tape, robot: Robot) -> dict[str, np.ndarray]:
    """Columns of a tape by the names of ``MOTION``; rates of the left toes' middle (n, 2) from the joints' motion."""
    known = {k: np.array(tape.extra[f"planar_{k}"]) for k in MOTION if f"planar_{k}" in tape.extra}
    model, data, toes, rows = robot.model, robot.model.createData(), on_feet(robot, robot.foot.tip)[0], []
    for q, v, a in zip(tape.q, tape.v, tape.a, strict=True):
        moving(model, data, q, v)
        at = point_motion(model, data, toes)
        rows.append([at.velocity[:3], (at.jacobian @ a + at.drift)[:3]])
    velocity, acceleration = np.array(rows)[..., [0, 2]].transpose(1, 0, 2)
    return {"toe_velocity": velocity, "toe_acceleration": acceleration} | known


def _heel_up(motion, x) -> tuple[np.ndarray, np.ndarray]:
    """Whether the heel is up, and whether there is a moment about the toe as well, sample by sample."""
    up = motion["toe"][:, 1] + x["heel"][:, 1] > HEEL_UP_M
    return up, up & (np.abs(x["moment"]) > MOMENT_NM)


def _contact_rows(x, note):
    """Rows of the launch; ``x`` holds its samples only."""
    (f_x, f_z), toe, heel, moment = x["force"].T, x["toe"], x["heel"], x["moment"]
    up, turned = _heel_up(x, x)
    loaded = f_z > LOADED_N
    cop = -moment[loaded] / f_z[loaded]  # from the toe
    outside = np.maximum(np.maximum(cop, heel[loaded, 0] - cop), 0.0)
    lowest = min(toe[:, 1].min(), (toe + heel)[:, 1].min())
    yield "heel up and a moment about the toe", int(turned.sum()), "ms", 0, f"of {up.sum()} ms with heel up{note}"
    yield "moment about the toe, heel up", float(np.max(np.abs(moment[up]), initial=0.0)), "N m", MOMENT_NM, ""
    yield "CoP outside the sole", _worst(outside), "m", PLACE_M, f"where F_z > {LOADED_N:g} N"
    yield "pull on the ground", max(0.0, -float(f_z.min())), "N", 1.0, ""
    yield "friction used", _worst(np.abs(f_x[loaded]) / f_z[loaded]), "1", FRICTION, f"where F_z > {LOADED_N:g} N"
    yield "toe slips", _worst(np.linalg.norm(toe - toe[0], axis=1)), "m", CONTACT_M, ""
    yield "sole below the ground", max(0.0, -float(lowest)), "m", CONTACT_M, ""


def _joint_rows(m: SagittalModel, x):
    rate, torque = np.abs(x["joint_rates"]), np.abs(x["torques"])
    line = m.effort * np.clip((m.speed - rate) / (m.speed - m.corner_speed), 0.0, 1.0)  # of the motors
    beyond = torque - line
    joint, over = SAGITTAL_JOINTS[int(np.argmax(beyond.max(axis=0)))], int((beyond.max(axis=1) > 0).sum())
    note = f"{over} ms, worst at the {joint}" if over else ""
    yield "torque beyond the motors", max(0.0, float(beyond.max())), "N m", 0.0, note
    yield "joint speed of its limit", _worst(rate / m.speed), "1", 1.0, ""


def _motion_rows(m: SagittalModel, motion, x, planned, task: JumpTask):
    """Rows of dynamics between nodes, of take-off and of touchdown."""
    fly = motion["flying"]
    off = 100 * np.linalg.norm(x["force"] - planned, axis=1) / (m.total_mass * task.gravity)
    push = float(x["force"][~fly][-1, 1]) / m.total_mass
    spin, toe, heel = x["L"][fly, 0], motion["toe"], motion["toe"] + x["heel"]
    height = np.abs([p[fly, 1][-1:] - task.platform_m for p in (toe, heel)])
    length = np.abs(toe[fly, 0][-1:] - toe[0, 0] - task.distance_m)
    pitch = np.abs(motion["angles"][fly, 0][-1:] - task.rotation_rad)
    yield "c_z'' at take-off, off -g", abs(push), "m/s^2", FREE_FALL, f"it is {push - task.gravity:+.1f}"
    yield "force residual, launch", _worst(off[~fly]), "% m g", RESIDUAL_PERCENT, "between nodes"
    yield "force residual, flight", _worst(off[fly]), "% m g", RESIDUAL_PERCENT, "at and between nodes"
    yield "drift of L in flight", _worst(np.abs(spin - spin[:1])), "kg m^2/s", DRIFT, ""
    yield "jump length error", _worst(length), "m", PLACE_M, ""
    yield "sole off the surface at touchdown", _worst(height), "m", CONTACT_M, "toe or heel"
    yield "foot pitch at touchdown", _worst(pitch), "rad", PITCH_RAD, ""


def _worst(values) -> float:
    return float(np.max(values)) if np.size(values) else float("nan")
