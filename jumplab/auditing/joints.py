"""Joints against their limits in the URDF, and the files of the robot against each other."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np

from jumplab.auditing.limits import LIMITS, METHOD
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check


def available_torque(r: Replay) -> np.ndarray:
    """(N, nv - 6) torque that each motor has left at its speed [N m].

    Full torque up to the corner speed, then a line to zero at the speed limit, where torque and speed have the same
    sign (motoring); full torque where the joint brakes.
    """
    peak, top, speed = r.model.upperEffortLimit[6:], r.model.upperVelocityLimit[6:], r.tape.v[:, 6:]
    fall = (top - np.abs(speed)) / np.maximum(top - r.robot.corner_speed_ratio * top, 1e-9)
    motoring = r.tape.tau * speed > 0
    return peak * np.where(motoring, np.clip(fall, METHOD.torque_floor, 1.0), 1.0)


def checks(r: Replay) -> list[Check]:
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
            bare.append(link.get("name", "unnamed"))
    return [
        LIMITS["sole as in the URDF"].check(float(max(off))),
        LIMITS["links have mass"].check(len(bare), bare=", ".join(bare) or "none"),
    ]
