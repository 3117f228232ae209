"""Joints against their limits in the URDF: range, speed, torque, torque at speed."""

from __future__ import annotations

import numpy as np

from jumplab.auditing import limits as lim
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check, worst

GROUP = "joints"


def available_torque(r: Replay) -> np.ndarray:
    """(N, nv - 6) torque that each motor has left at its speed [N m].

    Full torque up to the corner speed, then a line to zero at the speed limit, where torque and speed have the same
    sign (motoring); full torque where the joint brakes.
    """
    peak, top = r.model.upperEffortLimit[6:], r.model.upperVelocityLimit[6:]
    corner = r.robot.corner_speed_ratio * top
    speed = r.tape.v[:, 6:]
    fall = (top - np.abs(speed)) / np.maximum(top - corner, 1e-9)
    motoring = r.tape.tau * speed > 0
    share = np.where(motoring, np.clip(fall, lim.TORQUE_FLOOR, 1.0), 1.0)
    return peak * share


def checks(r: Replay) -> list[Check]:
    """All checks of this group."""
    t, names, m = r.tape.t, r.tape.joint_names, r.model
    angle, speed, torque = r.tape.q[:, 7:], np.abs(r.tape.v[:, 6:]), np.abs(r.tape.tau)
    beyond = np.maximum(angle - m.upperPositionLimit[7:], m.lowerPositionLimit[7:] - angle)
    return [
        worst(GROUP, "joint range", 1e3 * beyond, t, lim.RANGE_MRAD, "mrad",
              "angle beyond the joint's range (negative: inside)", labels=names),
        worst(GROUP, "joint speed", 100 * speed / m.upperVelocityLimit[6:], t, lim.SHARE_PERCENT, "% of limit",
              "speed against the URDF's limit", labels=names),
        worst(GROUP, "joint torque", 100 * torque / m.upperEffortLimit[6:], t, lim.SHARE_PERCENT, "% of limit",
              "torque against the URDF's limit", labels=names),
        worst(GROUP, "torque at speed", 100 * torque / available_torque(r), t, lim.SHARE_PERCENT, "% of envelope",
              "torque against what the motor has left at that speed", labels=names),
    ]  # fmt: skip
