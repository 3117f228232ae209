"""Newton, Euler and energy on the tape; joints against their limits; the files of the robot against each other."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np

from jumplab.auditing.replay import Replay
from jumplab.auditing.report import LIMITS, METHOD, Check


def _norm(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x, axis=-1)


def checks(r: Replay) -> list[Check]:
    """All checks of the group "dynamics"."""
    return [*_inverse(r), *_impulses(r), *_flight(r), *_takeoff(r), *_balances(r)]


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
    s = r.until_last_stand
    t, last = r.tape.t[s], r.flights[0].start - 1 if r.flights else s.stop - 1
    force = r.tape.f[..., :3].sum(axis=1) - [0.0, 0.0, r.weight]
    gained = r.mass * (r.com_velocity - r.com_velocity[0])
    off = 100 * _norm(gained - r.integral(force)) / max(r.mass * _norm(r.com_velocity[last]), 1e-9)
    turned = _norm(r.momentum - r.momentum[0] - r.integral(_contact_moment(r, slice(None))))
    return [LIMITS["linear impulse"].worst(off[s], t), LIMITS["angular impulse"].worst(turned[s], t)]


def _flight(r: Replay) -> list[Check]:
    fall, off, spun, bent = np.array([0.0, 0.0, -r.gravity / 2]), np.zeros(len(r.tape.t)), np.zeros(len(r.tape.t)), []
    for rows in r.flights:
        com, since = r.com[rows], r.tape.t[rows] - r.tape.t[rows][0]
        parabola = com[0] + r.com_velocity[rows][0] * since[:, None] + fall * since[:, None] ** 2
        off[rows], spun[rows] = _norm(com - parabola), _norm(r.momentum[rows] - r.momentum[rows][0])
        # x = t / T keeps the fit well conditioned
        bent.append(-2 * np.polyfit(since / since[-1], com[:, 2], 2)[0] / since[-1] ** 2)
    air = ~r.carrying
    claimed = np.where(air, _norm(r.tape.f[..., :3]) + _norm(r.tape.f[..., 3:]), 0.0)  # both must vanish
    flown = ~r.ground
    t = r.tape.t[flown]
    checks = [
        LIMITS["ballistic CoM"].worst(1e3 * off[flown], t, g=r.gravity),
        LIMITS["gravity in flight"].check(100 * max(abs(x / r.gravity - 1) for x in bent)),
        LIMITS["angular momentum in flight"].worst(spun[flown], t),
    ]
    return [
        *(checks if r.flights else []),
        LIMITS["no force in flight"].worst(claimed, r.tape.t, r.tape.contact_frames),
    ]


def _takeoff(r: Replay) -> list[Check]:
    if not r.flights:
        return []
    percent, last = 100 / r.weight, np.array([rows.start - 1 for rows in r.flights])
    t, both = r.tape.t[last], np.sort(np.concatenate([last, last + 1]))
    force = r.tape.f[last, :, :3].sum(axis=1)
    moment = np.array([_contact_moment(r, int(i)) for i in last])
    off = _norm(r.com_acceleration[both] - np.array([0, 0, -r.gravity]))
    return [
        LIMITS["zero force at take-off"].worst(percent * _norm(force), t),
        LIMITS["zero moment at take-off"].worst(percent * _norm(moment), t),
        LIMITS["free fall at take-off"].worst(100 / r.gravity * off, r.tape.t[both]),
    ]


def _balances(r: Replay) -> list[Check]:
    power = ((r.tape.tau - r.lost) * r.tape.v[:, 6:]).sum(axis=1)
    missing = r.energy - r.energy[0] - r.integral(power)
    span, s = max(float(np.ptp(r.energy)), 1e-9), r.ground
    push, accelerated = r.tape.f[s][..., 2].sum(axis=1), r.com_acceleration[s][:, 2] + r.gravity
    moved = float(push @ accelerated / max(accelerated @ accelerated, 1e-9))
    return [
        LIMITS["energy balance"].worst(100 * np.abs(missing) / span, r.tape.t, span=span),
        LIMITS["mass"].check(100 * abs(moved / r.mass - 1), moved=moved, mass=r.mass),
    ]


def available_torque(r: Replay) -> np.ndarray:
    """(N, nv - 6) torque that each motor has left at its speed [N m].

    Full torque up to the corner speed, then a line to zero at the no-load speed, where torque and speed have the same
    sign (motoring); full torque where the joint brakes.
    """
    peak, speed = r.model.upperEffortLimit[6:], r.tape.v[:, 6:]
    rows = [r.robot.actuators[name] for name in map(str, r.tape.joint_names)]
    corner, free = (np.array([row[key] for row in rows]) for key in ("corner_speed", "no_load_speed"))
    fall = (free - np.abs(speed)) / np.maximum(free - corner, 1e-9)
    motoring = r.tape.tau * speed > 0
    return peak * np.where(motoring, np.clip(fall, METHOD.torque_floor, 1.0), 1.0)


def joints(r: Replay) -> list[Check]:
    """All checks of the group "joints": range, speed, torque, torque at speed."""
    t, names, m = r.tape.t, r.tape.joint_names, r.model
    angle, speed, torque = r.tape.q[:, 7:], np.abs(r.tape.v[:, 6:]), np.abs(r.tape.tau)
    beyond = np.maximum(angle - m.upperPositionLimit[7:], m.lowerPositionLimit[7:] - angle)
    return [
        LIMITS["joint range"].worst(1e3 * beyond, t, names),
        LIMITS["joint speed"].worst(100 * speed / m.upperVelocityLimit[6:], t, names),
        LIMITS["joint torque"].worst(100 * torque / m.upperEffortLimit[6:], t, names),
        LIMITS["torque at speed"].worst(100 * torque / available_torque(r), t, names),
    ]


def description(r: Replay) -> list[Check]:
    """All checks of the group "robot": disagreements that make every engine simulate another robot."""
    f = r.robot.foot
    said = np.array([f.heel, f.toe, -f.half_width, f.half_width, f.sole_z])
    off = [1e3 * np.abs(np.array([s.heel, s.toe, s.right, s.left, s.z]) - said).max() for s in r.soles]
    bare = []
    for link in ET.fromstring(r.robot.urdf).iter("link"):
        mass = link.find("inertial/mass")
        if mass is None or not float(mass.get("value", "0")) > 0:
            bare.append(link.attrib["name"])
    return [
        LIMITS["sole as in the URDF"].check(float(max(off))),
        LIMITS["links have mass"].check(len(bare), bare=", ".join(bare) or "none"),
    ]
