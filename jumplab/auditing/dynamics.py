"""Newton, Euler and energy on the tape; joints against limits; the robot's files."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.auditing.replay import Replay, configured_sole, norm
from jumplab.auditing.report import METHOD, Measure


def _contact_moment(r: Replay) -> np.ndarray:
    """(N, 3) moment of all contact wrenches about the CoM [N m]."""
    arm = r.foot - r.com[:, None]
    return (np.cross(arm, r.tape.f[..., :3]) + r.tape.f[..., 3:]).sum(axis=1)


def forces(r: Replay) -> Iterator[Measure]:
    """Newton and Euler in every sample, and integrated until the last foot leaves."""
    # a moment is taken as a share of m g * 1 m
    yield "base force residual", norm(r.base_residual[:, :3]) / r.weight
    yield "base moment residual", norm(r.base_residual[:, 3:]) / r.weight
    missing = np.abs(r.tau - r.tape.tau) / r.model.upperEffortLimit[6:]
    yield "joint torque consistency", missing
    s = slice(0, int(np.flatnonzero(r.ground)[-1]) + 1)  # until the last foot leaves
    # a motion without a flight ends at rest, so its largest momentum is the scale
    last = r.flights[0].start - 1 if r.flights else int(norm(r.com_velocity).argmax())
    push = r.tape.f[..., :3].sum(axis=1) - [0.0, 0.0, r.weight]
    gained = r.mass * (r.com_velocity - r.com_velocity[0])
    turned = r.momentum - r.momentum[0] - r.integral(_contact_moment(r))
    scale = max(r.mass * norm(r.com_velocity[last]), 1e-9)
    yield "linear impulse", norm(gained - r.integral(push))[s] / scale, r.tape.t[s]
    yield "angular impulse", norm(turned)[s], r.tape.t[s]


def flight(r: Replay) -> Iterator[Measure]:
    """The parabola of the CoM, and momentum and forces of feet in the air."""
    fall = np.array([0.0, 0.0, -r.gravity / 2])
    apart, spun = np.zeros((2, len(r.tape.t)))
    curvatures = []
    for rows in r.flights:
        com = r.com[rows]
        since = r.tape.t[rows] - r.tape.t[rows][0]
        parabola = com[0] + r.com_velocity[rows][0] * since[:, None] + fall * since[:, None] ** 2
        apart[rows] = norm(com - parabola)
        spun[rows] = norm(r.momentum[rows] - r.momentum[rows][0])
        # x = t / T keeps the fit well conditioned
        curvatures.append(-2 * np.polyfit(since / since[-1], com[:, 2], 2)[0] / since[-1] ** 2)
    if r.flights:
        flown = ~r.ground
        t = r.tape.t[flown]
        yield "ballistic CoM", apart[flown], t, {"g": r.gravity}
        yield "gravity in flight", np.abs(np.array(curvatures) / r.gravity - 1)
        yield "angular momentum in flight", spun[flown], t
    # both must vanish
    wrench = norm(r.tape.f[..., :3]) + norm(r.tape.f[..., 3:])
    lifted = np.where(r.carrying, 0.0, wrench)
    yield "no force in flight", lifted


def takeoff(r: Replay) -> Iterator[Measure]:
    """Both samples of each take-off."""
    if not r.flights:
        return
    last = np.array([rows.start - 1 for rows in r.flights])
    t = r.tape.t
    both = np.sort(np.concatenate([last, last + 1]))
    force = r.tape.f[last, :, :3].sum(axis=1)
    falling = norm(r.com_acceleration[both] + [0.0, 0.0, r.gravity])
    yield "zero force at take-off", norm(force) / r.weight, t[last]
    yield "zero moment at take-off", norm(_contact_moment(r)[last]) / r.weight, t[last]
    yield "free fall at take-off", falling / r.gravity, t[both]


def energy(r: Replay) -> Iterator[Measure]:
    """Energy against the work of the joints; mass by the ground's force."""
    power = ((r.tape.tau - r.lost) * r.tape.v[:, 6:]).sum(axis=1)
    missing = r.energy - r.energy[0] - r.integral(power)
    span = max(float(np.ptp(r.energy)), 1e-9)
    push = r.tape.f[r.ground][..., 2].sum(axis=1)
    accelerated = r.com_acceleration[r.ground, 2] + r.gravity
    moved = float(push @ accelerated / max(accelerated @ accelerated, 1e-9))
    yield "energy balance", np.abs(missing) / span, None, {"span": span}
    masses = {"moved": moved, "mass": r.mass}
    yield "mass", abs(moved / r.mass - 1), None, masses


def available_torque(r: Replay) -> np.ndarray:
    """(N, nv - 6) torque that each motor has left at its speed [N m].

    Full torque up to the corner speed, then a line to zero at the no-load speed, where torque and
    speed have the same sign (motoring); full torque where the joint brakes.
    """
    speed = r.tape.v[:, 6:]
    motors = r.robot.limits
    free = motors.no_load_speed
    fall = (free - np.abs(speed)) / np.maximum(free - motors.corner_speed, 1e-9)
    left = np.where(r.tape.tau * speed > 0, np.clip(fall, METHOD.torque_floor, 1.0), 1.0)
    return r.model.upperEffortLimit[6:] * left


def joints(r: Replay) -> Iterator[Measure]:
    """Measures of the group "joints": range, speed, torque, torque at speed, torques that hold."""
    m = r.model
    angle = r.tape.q[:, 7:]
    torque = np.abs(r.tape.tau)
    beyond = np.maximum(angle - m.upperPositionLimit[7:], m.lowerPositionLimit[7:] - angle)
    yield "joint range", beyond
    yield "joint speed", np.abs(r.tape.v[:, 6:]) / m.upperVelocityLimit[6:]
    yield "joint torque", torque / m.upperEffortLimit[6:]
    yield "torque at speed", torque / available_torque(r)
    bus = r.robot.bus
    if np.isfinite(bus.power_w):
        shaft = r.tape.tau * r.tape.v[:, 6:]
        used = np.where(shaft < 0, bus.regeneration * shaft, shaft) + bus.losses * r.tape.tau**2
        yield "bus power", used.sum(axis=1) / bus.power_w
    if np.isfinite(bus.rms).any():
        mean = r.integral(r.tape.tau**2)[-1] / np.ptp(r.tape.t)
        yield "torque over the motion", np.sqrt(mean[None]) / bus.rms
    if locked := r.robot.locked:
        holding = np.abs(r.holding) / [x.effort for x in locked]
        yield "torque of locked joints", holding, None, None, tuple(x.name for x in locked)


def description(r: Replay) -> Iterator[Measure]:
    """Measures of the group "robot": disagreements by which engines simulate another robot."""
    masses = {
        link.attrib["name"]: link.find("inertial/mass")
        for link in ET.fromstring(r.robot.urdf).iter("link")
    }
    bare = [
        name
        for name, mass in masses.items()
        if mass is None or not float(mass.get("value", "0")) > 0
    ]
    yield "sole as in the URDF", np.abs(np.subtract(r.soles, configured_sole(r.robot)))
    yield "links have mass", len(bare), None, {"bare": ", ".join(bare) or "none"}
