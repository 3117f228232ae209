"""Violations of a roll-out of stage 2, by Pinocchio's inverse dynamics and the robot's limits, not the QPs' matrices.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.models.full import FullBody, FullTerms
from jumplab.robot import Robot
from jumplab.stages.joint_qp import JointPlan
from jumplab.stages.reconstruction import to_link_angles
from jumplab.stages.whole_body import Limits

LOADED_N = 5.0  # a foot that carries less has no meaningful CoP or friction
MEANING = {  # of what is broken: words and unit
    "base_force": ("base rows of the inverse dynamics less the wrenches; in flight the drift control", "N, N m"),
    "toe_drift": ("toes slip", "m"),
    "penetration": ("sole below the ground", "m"),
    "pull": ("ground pulls", "N"),
    "friction": ("friction used", ""),
    "cop_outside": ("CoP outside the foot", "m"),
    "torque": ("torque, share of its limit", ""),
    "torque_excess": ("torque beyond the motor's line", "N m"),
    "speed": ("joint speed, share of its limit", ""),
    "range": ("beyond a joint stop", "rad"),
    "asymmetry": ("left and right differ", "rad, rad/s"),
    "flight_com": ("CoM off its parabola", "m"),
    "flight_momentum": ("angular momentum lost in flight", "kg m^2/s"),
}
ALIKE = {"deg": 0.5, "mm": 2.0, "rad/s": 0.1}  # what still counts as the same, by unit


def joint_violations(plan: JointPlan, robot: Robot, gravity: float | None = None) -> dict[str, float]:
    """Largest violations of a roll-out, by the names of :data:`MEANING`.

    ``cop_outside`` is of the sole, of the toe edge once the heel is up; ``pull`` is a negative F_z; ``friction`` the
    largest F_xy / F_z; ``torque_excess`` counts from the motor's line; ``asymmetry`` is of mirrored joints.
    """
    body = FullBody(robot if gravity is None else robot.under_gravity(gravity))
    launch, flight = plan.rows("launch"), plan.rows("flight")
    nodes = [body.terms(q, v) for q, v in zip(plan.q, plan.v, strict=True)]
    first = [k for k in range(len(plan.t)) if k + 1 not in (launch.stop, flight.stop)]  # nodes at which a step begins
    steps = [_middle(plan, body, k) for k in first]
    on_ground = len(range(*launch.indices(len(plan.t)))) - 1
    out = {"base_force": _base_force(body, steps, plan.a[first], plan.f[first])}
    out |= _ground(robot, plan.f[first][:on_ground], plan.contact[first][:on_ground])
    out |= _joints(robot, plan, plan.tau[first], np.array([x.v[6:] for x in steps]))
    left, right, sign = (np.array(x) for x in zip(*body.pairs["flight"], strict=True))
    joints, rates = plan.q[:, 1:], plan.v  # angle of tangent column i is q[i + 1]: a quaternion has four numbers
    out["asymmetry"] = float(max(np.abs(x[:, right] - sign * x[:, left]).max() for x in (joints, rates)))
    flying = nodes[flight]
    toe, rising = np.array([x.tip.place for x in nodes[launch]]), nodes[: flight.start + len(flying) // 2]
    out["toe_drift"] = float(np.abs(toe - toe[0]).max())
    lowest = min(np.r_[x.tip.place[:, 2], x.heel.place[:, 2]].min() for x in rising)
    out["penetration"] = float(max(0.0, toe[0, :, 2].mean() - lowest))
    start, t = flying[0], (plan.t[flight] - plan.t[flight.start])[:, None]
    parabola = start.com + start.com_velocity * t + np.array([0.0, 0.0, -body.gravity]) * t**2 / 2
    out["flight_com"] = float(np.linalg.norm(np.array([x.com for x in flying]) - parabola, axis=1).max())
    out["flight_momentum"] = float(max(abs(x.momentum[4] - start.momentum[4]) for x in flying))
    return out


def touchdown_rows(plan: JointPlan, robot: Robot) -> list[dict]:
    """The last posture of a roll-out beside the bounds that stage 3 sets to its own."""
    aims, deg, x = Limits(), np.degrees, FullBody(robot).terms(plan.q[-1], plan.v[-1])
    angles = to_link_angles(robot, plan.q, plan.v, plan.a)[0][-1]
    _, knee, _, _ = robot.sagittal.joint_angles(angles)  # hip, knee, ankle, shoulder
    ground = FullBody(robot).terms(plan.q[0], plan.v[0]).tip.place[0, 2]
    found = {
        ("trunk pitch", "deg"): (deg(angles[3]), *deg(aims.touchdown_pitch)),
        ("knee", "deg"): (deg(knee), *deg(aims.touchdown_knee)),
        ("foot pitch", "deg"): (deg(x.foot_pitch[0]), 0.0, 0.0),
        ("toe above the ground", "mm"): (1000 * (x.tip.place[0, 2] - ground), 0.0, 0.0),
        ("heel above the ground", "mm"): (1000 * (x.heel.place[0, 2] - ground), 0.0, 0.0),
        ("fastest joint", "rad/s"): (np.abs(plan.v[-1, 6:]).max(), 0.0, aims.touchdown_joint_rate),
    }
    rows = []
    for (what, unit), (value, low, high) in found.items():
        row = {"at touchdown": what, "stage 2": value, "stage 3, from": low, "to": high, "unit": unit}
        rows.append({**row, "outside": not low - ALIKE[unit] <= value <= high + ALIKE[unit]})
    return rows


def _middle(plan: JointPlan, body: FullBody, k: int) -> FullTerms:
    """Quantities in the middle of the step that begins at node ``k``, where its QP was written."""
    h, v, guess = plan.t[k + 1] - plan.t[k], plan.v[k], plan.predicted[k]
    return body.terms(pin.integrate(body.model, plan.q[k], v * (h / 2) + guess * (h * h / 8)), v + guess * (h / 2))


def _base_force(body, steps, accelerations, wrenches) -> float:
    """Largest base row of pin.rnea less the wrenches (N, 2, 6) at the tiptoes, about the base."""
    model, scratch = body.model, body.model.createData()
    needed = np.array([pin.rnea(model, scratch, x.q, x.v, a)[:6] for x, a in zip(steps, accelerations, strict=True)])
    turn, base = np.array([x.base_rotation for x in steps]), np.array([x.q[:3] for x in steps])
    toe, force = np.array([x.tip.place for x in steps]), wrenches[..., :3]
    moment = (wrenches[..., 3:] + np.cross(toe - base[:, None], force)).sum(1)
    given = [np.einsum("nij,ni->nj", turn, x) for x in (force.sum(1), moment)]  # in the axes of the base
    return float(np.abs(needed - np.concatenate(given, 1)).max())


def _joints(robot, plan, tau, tau_rates) -> dict[str, float]:
    """Shares of torque and speed limits, and how far the motion goes beyond the torque-speed line and the stops."""
    angles, rates = plan.q[:, 7:], plan.v[:, 6:]
    actuators = [robot.actuators[name] for name in robot.joint_names]
    limit = {k: np.array([a[k] for a in actuators]) for k in actuators[0]}
    left = (limit["speed"] - np.abs(tau_rates)) / (limit["speed"] - limit["corner_speed"])
    allowed = np.where(tau * tau_rates > 0, limit["effort"] * np.clip(left, 0.0, 1.0), limit["effort"])
    return {
        "torque": float((np.abs(tau) / limit["effort"]).max()),
        "torque_excess": float(np.maximum(np.abs(tau) - allowed, 0.0).max()),
        "speed": float((np.abs(rates) / limit["speed"]).max()),
        "range": float(np.maximum(np.maximum(angles - limit["upper"], limit["lower"] - angles), 0.0).max()),
    }


def _ground(robot, wrenches, contact) -> dict[str, float]:
    """Unilaterality, friction and CoP of each foot, from the wrenches at the tiptoes."""
    foot, force, moment = robot.foot, wrenches[..., :3], wrenches[..., 3:]
    loaded = force[..., 2] >= LOADED_N
    back = np.where(contact == "toe", 0.0, foot.heel - foot.toe)[:, None]
    lift = np.where(loaded, force[..., 2], 1.0)
    along, across = -moment[..., 1] / lift, moment[..., 0] / lift  # from the tiptoe
    beyond = np.maximum(np.maximum(along, back - along), np.abs(across) - foot.half_width)
    return {
        "pull": float(max(-force[..., 2].min(initial=0.0), 0.0)),
        "friction": float((np.hypot(force[..., 0], force[..., 1]) / lift)[loaded].max(initial=0.0)),
        "cop_outside": float(beyond[loaded].max(initial=0.0)),
    }
