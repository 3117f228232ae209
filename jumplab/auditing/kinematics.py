"""The tape as a record of one motion: form, positions against rates against accelerations, the switch, symmetry."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.auditing import limits as lim
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check, worst
from jumplab.io.tape import Tape

GROUP = "tape"
MIN_SAMPLES = 10  # per phase: fewer are no motion
BASE_NAMES = ("base x", "base y", "base z", "base roll", "base pitch", "base yaw")


def form(tape: Tape) -> list[Check]:
    """Finite numbers, order of phases and times: without these nothing else can be computed."""
    arrays = (tape.t, tape.q, tape.v, tape.a, tape.tau, tape.f)
    broken = sum(int((~np.isfinite(x)).sum()) for x in arrays)
    phase = np.asarray(tape.phase)
    flying = phase == "flight"
    faults = int((~flying & (phase != "launch")).sum())
    faults += sum(int(np.sum(flying == x) < MIN_SAMPLES) for x in (False, True))
    faults += abs(int(np.sum(flying[1:] != flying[:-1])) - 1) + int(bool(flying[:1].any()))
    step = np.diff(tape.t)
    same = flying[1:] == flying[:-1]
    faults += int((~(step[same] > 0)).sum()) + int((step[~same] != 0).sum())
    return [
        Check(GROUP, "finite numbers", broken, 0, "entries", None, "entries of t, q, v, a, tau, f that are no number"),
        Check(GROUP, "order of phases", faults, 0, "faults", None,
              "launch, then flight, time rising inside each, the instant of take-off in both"),
    ]  # fmt: skip


def checks(r: Replay) -> list[Check]:
    """All checks of this group beyond :func:`form`."""
    tape = r.tape
    norm = np.abs(np.linalg.norm(tape.q[:, 3:7], axis=1) - 1)
    return [
        worst(GROUP, "time step", 1e3 * r.step, tape.t[1:], lim.STEP_MS, "ms", "longest step between two samples"),
        worst(GROUP, "unit quaternion", norm, tape.t, lim.QUATERNION, "1", "length of the base's quaternion against 1"),
        *_steps(r),
        *_reintegration(r),
        *_switch(r),
        *_symmetry(r),
    ]


def _labels(r: Replay) -> tuple[str, ...]:
    return (*BASE_NAMES, *(str(n) for n in r.tape.joint_names))


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
        worst(GROUP, "rates against positions", rate_error, t, lim.STEP_RATE, "m/s, rad/s",
              "difference of q over one step against the mean of v", labels=_labels(r)),
        worst(GROUP, "accelerations against rates", acceleration_error, t, lim.STEP_ACCELERATION, "m/s^2, rad/s^2",
              "difference of v over one step against the mean of a", labels=_labels(r)),
    ]  # fmt: skip


def _reintegration(r: Replay) -> list[Check]:
    tape, rates = r.tape, _mean_rates(r)
    position, rate = np.zeros_like(tape.v), np.zeros_like(tape.v)
    for phase in (r.launch, r.flight):
        q = tape.q[phase.start]
        for i in range(phase.start + 1, phase.stop):
            q = pin.integrate(r.model, q, rates[i - 1] * r.step[i - 1])
            position[i] = pin.difference(r.model, tape.q[i], q)
        gained = r.integral(tape.a)[phase]
        rate[phase] = tape.v[phase.start] + gained - gained[0] - tape.v[phase]
    return [
        worst(GROUP, "re-integrated positions", 1e3 * np.abs(position), tape.t, lim.DRIFT_POSITION, "mm, mrad",
              "q from its first sample in the phase and v alone, against q", labels=_labels(r)),
        worst(GROUP, "re-integrated rates", np.abs(rate), tape.t, lim.DRIFT_RATE, "m/s, rad/s",
              "v from its first sample in the phase and a alone, against v", labels=_labels(r)),
    ]  # fmt: skip


def _switch(r: Replay) -> list[Check]:
    tape, i = r.tape, r.tape.takeoff_index
    t, labels = tape.t[i : i + 1], _labels(r)
    jump = pin.difference(r.model, tape.q[i - 1], tape.q[i])
    rows = (
        ("position", 1e3 * jump, lim.SWITCH_POSITION, "mm, mrad"),
        ("rate", tape.v[i] - tape.v[i - 1], lim.SWITCH_RATE, "m/s, rad/s"),
        ("acceleration", tape.a[i] - tape.a[i - 1], lim.SWITCH_ACCELERATION, "m/s^2, rad/s^2"),
    )
    return [worst(GROUP, f"{name} at the switch", np.abs(x)[None], t, limit, unit,
                  f"jump of {name} between the two samples of take-off", labels=labels)
            for name, x, limit, unit in rows]  # fmt: skip


def mirror(model: pin.Model) -> list[tuple[int, int, float]] | None:
    """Joints that mirror each other in the x-z plane: (left index, right index, sign of the angle), indices into v[6:].

    Found from the geometry in the neutral pose, not from names. None if a joint has no counterpart.
    """
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model))
    flip, place, axis = np.array([1.0, -1.0, 1.0]), {}, {}
    for j in range(2, model.njoints):
        place[j] = data.oMi[j].translation
        axis[j] = jacobian[3:, model.idx_vs[j]]  # world axes, since the base is neutral
    pairs = []
    for j in place:
        for k in place:
            turned = -flip * axis[j]  # an axial vector mirrors with the opposite sign
            along = float(turned @ axis[k])
            if np.allclose(flip * place[j], place[k], atol=1e-6) and abs(along) > 1 - 1e-6:
                pairs.append((model.idx_vs[j] - 6, model.idx_vs[k] - 6, float(np.sign(along))))
                break
        else:
            return None
    return pairs


def _symmetry(r: Replay) -> list[Check]:
    tape, pairs = r.tape, mirror(r.model)
    if pairs is None:
        note = "a joint has no mirrored counterpart: a symmetric jump is not defined for this robot"
        return [Check(GROUP, "left/right posture", np.nan, lim.SYMMETRY_MRAD, "mm, mrad", None, note)]
    left, right = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    sign = np.array([p[2] for p in pairs])
    names = [str(n) for n in tape.joint_names[left]]
    joints = tape.q[:, 7:]
    out_of_plane = np.stack([tape.q[:, 1] - tape.q[0, 1], 2 * tape.q[:, 3], 2 * tape.q[:, 5]], axis=1)
    posture = np.concatenate([joints[:, right] - sign * joints[:, left], out_of_plane], axis=1)
    peak = r.model.upperEffortLimit[6:]
    torque = (tape.tau[:, right] - sign * tape.tau[:, left]) / peak[right]
    sideways = tape.f[..., 1].sum(axis=1, keepdims=True) / r.weight
    load = np.ptp(tape.f[..., 2], axis=1)[:, None] / r.weight
    effort = 100 * np.abs(np.concatenate([torque, sideways, load], axis=1))
    return [
        worst(GROUP, "left/right posture", 1e3 * np.abs(posture), tape.t, lim.SYMMETRY_MRAD, "mm, mrad",
              "right joints against mirrored left ones; lateral shift, roll and yaw of the base",
              labels=[*names, "lateral shift", "roll", "yaw"]),
        worst(GROUP, "left/right effort", effort, tape.t, lim.SYMMETRY_TORQUE_PERCENT, "% of peak, of m g",
              "right torques against mirrored left ones; lateral force; load of one foot against the other",
              labels=[*names, "lateral force", "foot load"]),
    ]  # fmt: skip
