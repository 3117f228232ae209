"""The tape as a record of one motion: form, rates, switch of phases, symmetry; and that motion against the target."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin

from jumplab.auditing.replay import Replay, carrying
from jumplab.auditing.report import LIMITS, METHOD, Check
from jumplab.io.tape import Tape
from jumplab.task import JumpTask


def form(tape: Tape) -> list[Check]:
    """Finite numbers, order of phases and times: without these nothing else can be computed."""
    arrays = (tape.t, tape.q, tape.v, tape.a, tape.tau, tape.f)
    broken = sum(int((~np.isfinite(x)).sum()) for x in arrays)
    phase = np.asarray(tape.phase)
    flying, step = phase == "flight", np.diff(tape.t)
    faults = int((~flying & (phase != "launch")).sum()) + int(bool(flying[:1].any()))
    faults += int((carrying(tape).any(axis=1) == flying).sum())
    switched = flying[1:] != flying[:-1]
    if "contacts" in tape.extra:  # where a foot lands an instant is there twice as well
        landed = (np.diff(carrying(tape).astype(int), axis=0) > 0).any(axis=1)
        doubled = switched | landed
    else:
        faults += abs(int(np.sum(switched)) - 1)
        doubled = switched
    faults += int((step[doubled] != 0).sum()) + int((~(step[~doubled] > 0)).sum())
    ends = [0, *(np.flatnonzero(doubled) + 1).tolist(), len(tape.t)]
    faults += sum(b - a < METHOD.min_samples for a, b in pairwise(ends))
    return [LIMITS["finite numbers"].check(broken), LIMITS["order of phases"].check(faults)]


def checks(r: Replay) -> list[Check]:
    """All checks of the group "tape" beyond :func:`form`."""
    norm = np.abs(np.linalg.norm(r.tape.q[:, 3:7], axis=1) - 1)
    return [
        LIMITS["time step"].worst(1e3 * r.step, r.tape.t[1:]),
        LIMITS["unit quaternion"].worst(norm, r.tape.t),
        *_steps(r),
        *_reintegration(r),
        *_switch(r),
        *(_symmetry(r) if r.robot.planar and r.is_jump and (r.task is None or r.task.in_plane) else ()),
    ]


def _mean_rates(r: Replay) -> np.ndarray:
    """(N - 1, nv) mean of v over each step: the trapezoid, corrected by the accelerations (fourth order)."""
    v, a = r.tape.v, r.tape.a
    return (v[1:] + v[:-1]) / 2 + (a[:-1] - a[1:]) * r.step[:, None] / 12


def _steps(r: Replay) -> list[Check]:
    tape, inside = r.tape, r.step > 0
    t, h = tape.t[1:][inside], r.step[inside][:, None]
    moved = np.array([pin.difference(r.model, a, b) for a, b in zip(tape.q[:-1], tape.q[1:], strict=True)])[inside]
    rate_error = np.abs(moved / h - _mean_rates(r)[inside])
    mean_acceleration = ((tape.a[1:] + tape.a[:-1]) / 2)[inside]
    acceleration_error = np.abs(np.diff(tape.v, axis=0)[inside] / h - mean_acceleration)
    return [
        LIMITS["rates against positions"].worst(rate_error, t, r.coordinates),
        LIMITS["accelerations against rates"].worst(acceleration_error, t, r.coordinates),
    ]


def _reintegration(r: Replay) -> list[Check]:
    tape, rates = r.tape, _mean_rates(r)
    position, rate = np.zeros_like(tape.v), np.zeros_like(tape.v)
    for phase in r.pieces:
        q = tape.q[phase.start]
        for i in range(phase.start + 1, phase.stop):
            q = pin.integrate(r.model, q, rates[i - 1] * r.step[i - 1])
            position[i] = pin.difference(r.model, tape.q[i], q)
        gained = r.integral(tape.a)[phase]
        rate[phase] = tape.v[phase.start] + gained - gained[0] - tape.v[phase]
    return [
        LIMITS["re-integrated positions"].worst(1e3 * np.abs(position), tape.t, r.coordinates),
        LIMITS["re-integrated rates"].worst(np.abs(rate), tape.t, r.coordinates),
    ]


def _switch(r: Replay) -> list[Check]:
    tape, rows = r.tape, np.array([p.start for p in r.pieces[1:]], int)
    lands = (r.carrying[rows] & ~r.carrying[rows - 1]).any(axis=1)  # forces and accelerations may jump there
    moved = [1e3 * pin.difference(r.model, tape.q[i - 1], tape.q[i]) for i in rows]
    out, names = [], r.coordinates
    for kind, jumps, at in (
        ("position", np.reshape(moved, (-1, r.model.nv)), rows),
        ("rate", tape.v[rows] - tape.v[rows - 1], rows),
        ("acceleration", (tape.a[rows] - tape.a[rows - 1])[~lands], rows[~lands]),
    ):
        if len(at):
            out.append(LIMITS[f"{kind} at the switch"].worst(np.abs(jumps), tape.t[at], names))
    return out


def mirror(model: pin.Model) -> list[tuple[int, int, float]] | None:
    """Joints that mirror each other in the x-z plane: (left index, right index, sign of the angle), indices into v[6:].

    Found from the geometry in the neutral pose, not from names. None if a joint has no counterpart.
    """
    data = model.createData()
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model))
    flip, joints, pairs = np.array([1.0, -1.0, 1.0]), range(2, model.njoints), []
    place = {j: data.oMi[j].translation for j in joints}
    axis = {j: jacobian[3:, model.idx_vs[j]] for j in joints}  # world axes, since the base is neutral
    for j in joints:
        turned = -flip * axis[j]  # an axial vector mirrors with the opposite sign
        for k in joints:
            along = float(turned @ axis[k])
            if np.allclose(flip * place[j], place[k], atol=1e-6) and abs(along) > 1 - 1e-6:
                pairs.append((model.idx_vs[j] - 6, model.idx_vs[k] - 6, float(np.sign(along))))
                break
        else:
            return None
    return pairs


def _symmetry(r: Replay) -> list[Check]:
    tape, pairs = r.tape, mirror(r.model)
    left, right, sign = (np.array(x) for x in zip(*pairs, strict=True))
    names = [str(n) for n in tape.joint_names[left]]
    joints, peak = tape.q[:, 7:], r.model.upperEffortLimit[6:]
    out_of_plane = np.stack([tape.q[:, 1] - tape.q[0, 1], 2 * tape.q[:, 3], 2 * tape.q[:, 5]], axis=1)
    posture = np.concatenate([joints[:, right] - sign * joints[:, left], out_of_plane], axis=1)
    torque = (tape.tau[:, right] - sign * tape.tau[:, left]) / peak[right]
    sideways = tape.f[..., 1].sum(axis=1, keepdims=True) / r.weight
    load = np.ptp(tape.f[..., 2], axis=1)[:, None] / r.weight
    effort = 100 * np.abs(np.concatenate([torque, sideways, load], axis=1))
    base = ["lateral shift", "roll", "yaw"]
    return [
        LIMITS["left/right posture"].worst(1e3 * np.abs(posture), tape.t, [*names, *base]),
        LIMITS["left/right effort"].worst(effort, tape.t, [*names, "lateral force", "foot load"]),
    ]


def target(r: Replay) -> list[Check]:
    """All checks of the group "target": touchdown always; start, distance, rise and turns if there is a task."""
    t, feet = r.tape.t[-1:], r.tape.contact_frames
    off = np.abs(r.sole_points[-1:, ..., 2] - r.platform).max(axis=-1)  # (1, K)
    tilt = np.arccos(np.clip(r.foot_rotation[-1:, :, 2, 2], -1, 1))
    touchdown = [
        LIMITS["sole on the surface"].worst(1e3 * off, t, feet, height=r.platform),
        LIMITS["sole flat at touchdown"].worst(1e3 * tilt, t, feet),
    ]
    if not r.is_jump:
        names = [*("base",) * 6, *map(str, r.tape.joint_names)]
        ends = (("start at rest", slice(0, 1)), ("end at rest", slice(-1, None)))
        return touchdown + [LIMITS[name].worst(np.abs(r.tape.v[row]), r.tape.t[row], names) for name, row in ends]
    return touchdown + (_asked(r, r.task) if r.task else [])


def foot_turn(r: Replay) -> np.ndarray:
    """(K,) turn of each foot about +y in its heading, from the first to the last sample, whole turns counted [rad]."""
    down = r.foot_rotation[..., 2, :]  # (N, K, 3) the vertical in the feet's axes
    return np.diff(np.unwrap(np.arctan2(-down[..., 0], down[..., 2]), axis=0)[[0, -1]], axis=0)[0]


def foot_yaw(r: Replay) -> np.ndarray:
    """(K,) turn of each foot about the vertical, whole turns counted [rad]; by its left side, level in a flip too."""
    left = r.foot_rotation[..., :, 1]
    return np.diff(np.unwrap(np.arctan2(-left[..., 0], left[..., 1]), axis=0)[[0, -1]], axis=0)[0]


def _place(r: Replay, task: JumpTask) -> list[Check]:
    """Where the feet of a jump out of the plane stand in the end."""
    t, feet = r.tape.t[-1:], r.tape.contact_frames
    middles = r.sole_points[[0, -1]].mean(axis=2)  # (2, K, 3)
    c, s, centre = np.cos(task.yaw_rad), np.sin(task.yaw_rad), middles[0].mean(axis=0)
    goal = (
        centre
        + [task.distance_m, task.side_m, 0]
        + (middles[0] - centre) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    )
    miss, found = 1e3 * np.linalg.norm((middles[1] - goal)[:, :2], axis=1), (middles[1] - middles[0]).mean(axis=0)
    turn = foot_yaw(r)
    asked = dict(ahead=found[0], left=found[1], asked=task.distance_m, aside=task.side_m)
    wrong, degrees = 1e3 * np.abs(turn - task.yaw_rad), np.degrees([turn.mean(), task.yaw_rad])
    return [
        LIMITS["place"].worst(miss[None], t, feet, **asked),
        LIMITS["heading"].worst(wrong[None], t, feet, found=degrees[0], asked=degrees[1]),
    ]


def _asked(r: Replay, task: JumpTask) -> list[Check]:
    tape, i = r.tape, r.flights[0].start
    t, feet = tape.t, tape.contact_frames
    travel = (r.toe_corners[-1] - r.toe_corners[0]).mean(axis=1)[:, :2]  # (K, 2)
    miss = 1e3 * np.linalg.norm(travel - np.array([task.distance_m, 0.0]), axis=-1)
    found = dict(found=travel[:, 0].mean(), asked=task.distance_m)
    place = [LIMITS["distance"].worst(miss[None], t[-1:], feet, **found)] if task.in_plane else _place(r, task)
    highest = int(np.argmax(r.com[i:, 2])) + i
    rise, turn = float(r.com[highest, 2] - r.com[i, 2]), foot_turn(r)
    wrong, degrees = 1e3 * np.abs(turn - task.rotation_rad), np.degrees([turn.mean(), task.rotation_rad])
    names = [*("base",) * 6, *map(str, tape.joint_names)]
    return [
        LIMITS["start at rest"].worst(np.abs(tape.v[:1]), t[:1], names),
        *place,
        LIMITS["rise"].check(1e3 * abs(rise - task.height_m), float(t[highest]), found=rise, asked=task.height_m),
        LIMITS["rotation"].worst(wrong[None], t[-1:], feet, found=degrees[0], asked=degrees[1]),
    ]
