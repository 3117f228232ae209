"""Newton, Euler and energy on the tape: inverse dynamics, impulses, flight, take-off, mass."""

from __future__ import annotations

import numpy as np

from jumplab.auditing.limits import LIMITS
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check


def _norm(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x, axis=-1)


def checks(r: Replay) -> list[Check]:
    """All checks of the group "dynamics"."""
    return [*_inverse(r), *_impulses(r), *_flight(r), *_takeoff(r), _energy(r), _mass(r)]


def _inverse(r: Replay) -> list[Check]:
    t, percent = r.tape.t, 100 / r.weight  # the moment is taken as a share of m g * 1 m
    off = 100 * np.abs(r.tau - r.tape.tau) / r.model.upperEffortLimit[6:]
    return [
        LIMITS["base force residual"].worst(percent * _norm(r.base_residual[:, :3]), t),
        LIMITS["base moment residual"].worst(percent * _norm(r.base_residual[:, 3:]), t),
        LIMITS["joint torque consistency"].worst(off, t, r.tape.joint_names),
    ]


def _contact_moment(r: Replay, rows: slice | int) -> np.ndarray:
    """(..., 3) moment of all contact wrenches about the CoM [N m]."""
    f, arm = r.tape.f[rows], r.foot[rows] - r.com[rows][..., None, :]
    return (np.cross(arm, f[..., :3]) + f[..., 3:]).sum(axis=-2)


def _impulses(r: Replay) -> list[Check]:
    s, t = r.launch, r.tape.t[r.launch]
    force = r.tape.f[..., :3].sum(axis=1) - [0.0, 0.0, r.weight]
    gained = r.mass * (r.com_velocity - r.com_velocity[0])
    off = 100 * _norm(gained - r.integral(force)) / max(r.mass * _norm(r.com_velocity[s.stop - 1]), 1e-9)
    turned = _norm(r.momentum - r.momentum[0] - r.integral(_contact_moment(r, slice(None))))
    return [LIMITS["linear impulse"].worst(off[s], t), LIMITS["angular impulse"].worst(turned[s], t)]


def _flight(r: Replay) -> list[Check]:
    t, com, f, momentum = (x[r.flight] for x in (r.tape.t, r.com, r.tape.f, r.momentum))
    since = t - t[0]
    fall = np.array([0.0, 0.0, -r.gravity / 2])
    parabola = com[0] + r.com_velocity[r.flight][0] * since[:, None] + fall * since[:, None] ** 2
    # x = t / T keeps the fit well conditioned
    fitted = -2 * np.polyfit(since / since[-1], com[:, 2], 2)[0] / since[-1] ** 2
    claimed = _norm(f[..., :3]) + _norm(f[..., 3:])  # N and N m: both must vanish
    return [
        LIMITS["ballistic CoM"].worst(1e3 * _norm(com - parabola), t, g=r.gravity),
        LIMITS["gravity in flight"].check(100 * abs(fitted / r.gravity - 1)),
        LIMITS["angular momentum in flight"].worst(_norm(momentum - momentum[0]), t),
        LIMITS["no force in flight"].worst(claimed, t, r.tape.contact_frames),
    ]


def _takeoff(r: Replay) -> list[Check]:
    last, percent = r.launch.stop - 1, 100 / r.weight
    both = slice(last, last + 2)
    instant = float(r.tape.t[last])
    force = r.tape.f[last, :, :3].sum(axis=0)
    off = _norm(r.com_acceleration[both] - np.array([0, 0, -r.gravity]))
    return [
        LIMITS["zero force at take-off"].check(percent * _norm(force), instant),
        LIMITS["zero moment at take-off"].check(percent * _norm(_contact_moment(r, last)), instant),
        LIMITS["free fall at take-off"].worst(100 / r.gravity * off, r.tape.t[both]),
    ]


def _energy(r: Replay) -> Check:
    power = (r.tape.tau * r.tape.v[:, 6:]).sum(axis=1)
    missing = r.energy - r.energy[0] - r.integral(power)
    span = max(float(np.ptp(r.energy)), 1e-9)
    return LIMITS["energy balance"].worst(100 * np.abs(missing) / span, r.tape.t, span=span)


def _mass(r: Replay) -> Check:
    s = r.launch
    push, accelerated = r.tape.f[s][..., 2].sum(axis=1), r.com_acceleration[s][:, 2] + r.gravity
    moved = float(push @ accelerated / max(accelerated @ accelerated, 1e-9))
    return LIMITS["mass"].check(100 * abs(moved / r.mass - 1), moved=moved, mass=r.mass)
