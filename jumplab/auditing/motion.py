"""The tape as a record of one motion: form, rates, switch, symmetry; and against the target."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pinocchio as pin

from jumplab.auditing.replay import Replay, norm, runs
from jumplab.auditing.report import METHOD, Measure
from jumplab.io.tape import AIR, Tape
from jumplab.task import JumpTask

DEGREES = np.degrees(1.0)  # a radian


def form(tape: Tape) -> Iterator[Measure]:
    """Finite numbers, order of phases and times: without these nothing else can be computed."""
    arrays = (tape.t, tape.q, tape.v, tape.a, tape.tau, tape.f)
    yield "finite numbers", sum((~np.isfinite(x)).sum() for x in arrays)
    flying = tape.phase == "flight"
    carrying = tape.contacts > AIR
    step = np.diff(tape.t)
    doubled = np.diff(flying)
    faults = [~flying & (tape.phase != "launch"), flying[:1], carrying.any(axis=1) == flying]
    if "contacts" in tape.extra:  # where a foot lands an instant is there twice as well
        doubled |= (carrying[1:] > carrying[:-1]).any(axis=1)
    else:
        faults.append(abs(doubled.sum() - 1))
    pieces = runs(np.cumsum([False, *doubled]))
    short = [piece.stop - piece.start < METHOD.min_samples for piece in pieces]
    faults += [step[doubled] != 0, ~(step[~doubled] > 0), short]
    yield "order of phases", sum(np.sum(x) for x in faults)


def rates(r: Replay) -> Iterator[Measure]:
    """Positions, rates and accelerations against each other, over a step and over a phase."""
    tape = r.tape
    yield "time step", r.step, tape.t[1:]
    yield "unit quaternion", np.abs(norm(tape.q[:, 3:7]) - 1)
    v = tape.v
    a = tape.a
    inside = r.step > 0
    t = tape.t[1:][inside]
    h = r.step[:, None]
    # means over each step: the trapezoid, corrected by the accelerations (fourth order)
    mean = (v[1:] + v[:-1]) / 2 + (a[:-1] - a[1:]) * h / 12
    mean_acceleration = (a[1:] + a[:-1]) / 2
    moved = np.array([pin.difference(r.model, *pair) for pair in pairwise(tape.q)])
    rate_error = np.abs(moved[inside] / h[inside] - mean[inside])
    acceleration_error = np.abs(np.diff(v, axis=0) / np.where(h > 0, h, 1.0) - mean_acceleration)
    position, rate = np.zeros((2, *v.shape))
    gained = r.integral(a)
    for phase in r.pieces:
        q = tape.q[phase.start]
        for i in range(phase.start + 1, phase.stop):
            q = pin.integrate(r.model, q, mean[i - 1] * r.step[i - 1])
            position[i] = pin.difference(r.model, tape.q[i], q)
        rate[phase] = v[phase.start] + gained[phase] - gained[phase.start] - v[phase]
    yield "rates against positions", rate_error, t
    yield "accelerations against rates", acceleration_error[inside], t
    yield "re-integrated positions", np.abs(position)
    yield "re-integrated rates", np.abs(rate)


def switch(r: Replay) -> Iterator[Measure]:
    """Jumps at take-off and where a foot lands."""
    tape = r.tape
    rows = np.array([p.start for p in r.pieces[1:]], int)
    # forces and accelerations may jump where a foot lands
    leaves = rows[~(r.carrying[rows] & ~r.carrying[rows - 1]).any(axis=1)]
    moved = [pin.difference(r.model, tape.q[i - 1], tape.q[i]) for i in rows]
    for kind, jumps, at in (
        ("position", moved, rows),
        ("rate", tape.v[rows] - tape.v[rows - 1], rows),
        ("acceleration", tape.a[leaves] - tape.a[leaves - 1], leaves),
    ):
        if len(at):
            yield f"{kind} at the switch", np.abs(jumps), tape.t[at]


def mirror(model: pin.Model) -> tuple[np.ndarray, np.ndarray] | None:
    """For each joint (nv - 6,), the index of the one that mirrors it in the x-z plane, and the sign
    of its angle.

    Found from the geometry in the neutral pose, not from names. None if a joint has no counterpart.
    """
    data = model.createData()
    # world axes, since the base is neutral
    axes = pin.computeJointJacobians(model, data, pin.neutral(model))[3:, 6:].T
    places = np.array([place.translation for place in data.oMi[2:]])
    flip = np.array([1.0, -1.0, 1.0])
    near = norm(flip * places[:, None] - places) < 2e-6
    along = (-flip * axes) @ axes.T  # an axial vector mirrors with the opposite sign
    alike = near & (np.abs(along) > 1 - 1e-6)
    if not alike.any(axis=1).all():
        return None
    other = alike.argmax(axis=1)
    return other, np.sign(along[np.arange(len(other)), other])


def symmetry(r: Replay) -> Iterator[Measure]:
    """Left against right, of a jump in the plane."""
    if not (r.robot.planar and r.is_jump and (r.task is None or r.task.in_plane)):
        return
    tape = r.tape
    other, sign = mirror(r.model)
    angles = tape.q[:, 7:]
    peak = r.model.upperEffortLimit[6:]
    shift = tape.q[:, 1] - tape.q[0, 1]
    out_of_plane = np.column_stack([shift, 2 * tape.q[:, 3], 2 * tape.q[:, 5]])
    posture = np.hstack([angles[:, other] - sign * angles, out_of_plane])
    torque = (tape.tau[:, other] - sign * tape.tau) / peak[other]
    forces = [tape.f[..., 1].sum(axis=1), np.ptp(tape.f[..., 2], axis=1)]
    effort = np.column_stack([torque, *np.divide(forces, r.weight)])
    base = ("lateral shift", "roll", "yaw")
    yield "left/right posture", np.abs(posture), None, None, (*r.joints, *base)
    yield "left/right effort", np.abs(effort), None, None, (*r.joints, "lateral force", "foot load")


def target(r: Replay) -> Iterator[Measure]:
    """Measures of the group "target": touchdown; with a task start, distance, rise, turns."""
    tape = r.tape
    end = tape.t[-1:]
    apart = np.abs(r.sole_points[-1:, ..., 2] - r.platform).max(axis=-1)  # (1, K)
    yield "sole on the surface", apart, end, {"height": r.platform}
    tilt = np.arccos(np.clip(r.foot_rotation[-1:, :, 2, 2], -1, 1))
    yield "sole flat at touchdown", tilt, end
    names = (*("base",) * 6, *r.joints)
    if r.task or not r.is_jump:
        yield "start at rest", np.abs(tape.v[:1]), tape.t[:1], None, names
    if not r.is_jump:
        yield "end at rest", np.abs(tape.v[-1:]), end, None, names
        if r.task and not r.task.standing:
            yield from _flown(r, r.task)
    elif r.task:
        yield from _asked(r, r.task)


def capture(r: Replay) -> Iterator[Measure]:
    """Distance of a jump's capture point from the soles at touchdown, as a share of the CoM's
    height over them; 0 within them.

    The impact keeps the angular momentum about the soles' middle: the CoM goes on as an inverted
    pendulum that has it, and would come to rest over the capture point.
    """
    if not r.is_jump:
        return
    points = r.sole_points[-1].reshape(-1, 3)
    arm = r.com[-1] - points.mean(axis=0)
    spin = r.momentum[-1] + r.mass * np.cross(arm, r.com_velocity[-1])
    velocity = np.array([spin[1], -spin[0]]) / (r.mass * arm[2])
    rests = r.com[-1, :2] + velocity * np.sqrt(arm[2] / r.gravity)
    beyond = np.maximum(points.min(axis=0)[:2] - rests, rests - points.max(axis=0)[:2])
    yield "capture point", norm(np.maximum(beyond, 0.0)) / arm[2], r.tape.t[-1:]


def _turned(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(K,) turn of directions (N, K) from first to last sample [rad], whole turns counted."""
    angles = np.unwrap(np.arctan2(y, x), axis=0)
    return angles[-1] - angles[0]


def foot_turn(r: Replay) -> np.ndarray:
    """(K,) turn of each foot about +y in its heading [rad], whole turns counted."""
    down = r.foot_rotation[..., 2, :]  # (N, K, 3) the vertical in the feet's axes
    return _turned(-down[..., 0], down[..., 2])


def _place(r: Replay, task: JumpTask) -> Iterator[Measure]:
    """Place and turn of the feet at the end of a jump out of the plane, against the target."""
    end = r.tape.t[-1:]
    first, last = r.sole_points[[0, -1]].mean(axis=2)  # (K, 3) middles of the soles
    turn = pin.rpy.rpyToMatrix(0.0, 0.0, task.yaw_rad)
    centre = first.mean(axis=0)
    goal = centre + [task.distance_m, task.side_m, 0] + (first - centre) @ turn.T
    ahead, left, _ = (last - first).mean(axis=0)
    numbers = {"ahead": ahead, "left": left, "asked": task.distance_m, "aside": task.side_m}
    yield "place", norm((last - goal)[None, :, :2]), end, numbers
    side = r.foot_rotation[..., :, 1]  # level in a flip too
    yaw = _turned(-side[..., 0], side[..., 1])
    yield _off("heading", yaw, task.yaw_rad, end, DEGREES)


def _asked(r: Replay, task: JumpTask) -> Iterator[Measure]:
    if task.in_plane:
        travel = (r.toe_corners[-1] - r.toe_corners[0]).mean(axis=1)[:, :2]  # (K, 2)
        numbers = {"found": travel[:, 0].mean(), "asked": task.distance_m}
        yield "distance", norm(travel - [task.distance_m, 0.0])[None], r.tape.t[-1:], numbers
    else:
        yield from _place(r, task)
    yield from _risen(r, task, slice(r.flights[0].start, None))
    yield _off("rotation", foot_turn(r), task.rotation_rad, r.tape.t[-1:], DEGREES)


def _risen(r: Replay, task: JumpTask, flight: slice) -> Iterator[Measure]:
    """Rise of the CoM in a flight."""
    height = r.com[flight, 2]
    highest = int(np.argmax(height))
    rise = height[highest] - height[0]
    yield _off("rise", rise, task.height_m, r.tape.t[flight][highest])


def _flown(r: Replay, task: JumpTask) -> Iterator[Measure]:
    """Distance and rise of the last flight, after steps or off one foot: ahead of where the feet
    stood first, against those that leave.
    """
    row = r.flights[-1].start
    ahead = r.toe_corners[[row, -1], ..., 0].mean(axis=-1) - r.toe_corners[0, ..., 0].mean(axis=-1)
    flown = ahead[1] - ahead[0, r.carrying[row - 1]].mean()
    yield _off("distance", flown, task.distance_m, r.tape.t[-1:])
    yield from _risen(r, task, r.flights[-1])


def _off(name: str, found: np.ndarray, asked: float, t: np.ndarray, unit: float = 1.0) -> Measure:
    """Measure of a number ``found`` at ``t`` [s], () or (K,) of each foot, against the one that was
    asked for; the note has both, times ``unit``.
    """
    numbers = {"found": unit * found.mean(), "asked": unit * asked}
    return name, np.abs(found - asked)[None], t, numbers
