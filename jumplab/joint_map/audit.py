"""Second look at a roll-out: errors against stage 1, and physics re-evaluated by Pinocchio's own algorithms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

LOADED_N = 5.0  # our choice: a foot that carries less has no meaningful CoP or friction


def tracking(actual: dict, reference: dict, n: int) -> dict[str, float]:
    """Errors against stage 1. The first ``n`` rows are the launch.

    Keys: ``takeoff_velocity`` (share of the take-off speed), ``takeoff_momentum`` and ``launch_momentum`` (share of the
    peak of L in the launch; at take-off, and the largest), ``launch_inertia_rms``, ``flight_inertia_rms`` (share of the
    mean of rho), ``launch_com`` (largest distance [m]), ``flight_foot_rms`` and ``touchdown_foot`` [m].
    """
    end = n - 1
    speed = reference["com_velocity"][end]
    L_error = np.abs(actual["L"][:n] - reference["L"][:n])
    peak = max(np.abs(reference["L"][:n]).max(), 1e-9)
    rho_error = actual["rho"] - reference["rho"]
    foot = np.linalg.norm(actual["foot_com"] - reference["foot_com"], axis=1)
    place = np.linalg.norm(actual["com"][:n] - reference["com"][:n], axis=1)

    def rms(x, size):
        return float(np.sqrt(np.mean(x**2)) / size)

    return {
        "takeoff_velocity": float(np.linalg.norm(actual["com_velocity"][end] - speed) / np.linalg.norm(speed)),
        "takeoff_momentum": float(L_error[end] / peak),
        "launch_momentum": float(L_error.max() / peak),
        "launch_inertia_rms": rms(rho_error[:n], reference["rho"][:n].mean()),
        "flight_inertia_rms": rms(rho_error[n:], reference["rho"][n:].mean()),
        "launch_com": float(place.max()),
        "flight_foot_rms": rms(foot, 1.0),
        "touchdown_foot": float(foot[-1]),
    }


def audit(mapper: Any, data: dict, held: np.ndarray, nodes: list, steps: list) -> dict[str, float]:
    """Largest violations, from Pinocchio's inverse dynamics and the robot's own limits, not from the QPs' matrices.

    Keys: ``base_force`` (base rows of the inverse dynamics less the wrenches [N, N m]; in flight it shows the drift
    control), ``toe_drift``, ``penetration``, ``cop_outside`` [m] (of the sole; of the toe edge once the heel is up),
    ``pull`` [N] (negative F_z), ``friction`` (largest F_xy / F_z), ``torque``, ``speed`` (largest share of the limit),
    ``torque_excess`` [N m] (beyond the actuator's torque-speed line), ``range`` [rad] (beyond a joint stop),
    ``asymmetry`` [rad, rad/s] (of mirrored joints), ``flight_com`` [m] and ``flight_momentum`` [kg m^2/s] (off the
    parabola, and lost).
    """
    body = mapper.body
    n = len(mapper.launch.t)  # nodes of the launch
    first = np.unique(held, return_index=True)[1]  # the node at which each step begins
    a, f, tau, contact = (data[k][first] for k in ("a", "f", "tau", "contact"))
    out = {"base_force": _base_force(body, steps, a, f)}
    out |= _ground(mapper.robot, f[: n - 1], steps[: n - 1], contact[: n - 1])
    out |= _joints(body.robot, data["q"][:, 7:], data["v"][:, 6:], tau, np.array([x.v[6:] for x in steps]))
    left, right, sign = (np.array(x) for x in zip(*body.pairs, strict=True))
    joints, rates = data["q"][:, 1:], data["v"]  # angle of tangent column i is q[i + 1]: a quaternion has four numbers
    out["asymmetry"] = float(max(np.abs(x[:, right] - sign * x[:, left]).max() for x in (joints, rates)))
    toe = np.array([x.toe for x in nodes[:n]])
    rising = nodes[: n + (len(nodes) - n) // 2]
    lowest = min(np.r_[x.toe[:, 2], x.heel[:, 2]].min() for x in rising)
    out["toe_drift"] = float(np.abs(toe - toe[0]).max())
    out["penetration"] = float(max(0.0, toe[0, :, 2].mean() - lowest))
    start, t = nodes[n], (data["t"][n:] - data["t"][n])[:, None]
    parabola = start.com + start.com_velocity * t + np.array([0.0, 0.0, -body.gravity]) * t**2 / 2
    out["flight_com"] = float(np.linalg.norm(np.array([x.com for x in nodes[n:]]) - parabola, axis=1).max())
    out["flight_momentum"] = float(max(abs(x.momentum[4] - start.momentum[4]) for x in nodes[n:]))
    return out


def _base_force(body, steps, accelerations, wrenches) -> float:
    """Largest base row of pin.rnea less the wrenches (N, 2, 6) at the origins of the foot frames, about the base."""
    model, scratch, foot = body.model, body.model.createData(), body.robot.foot
    needed = np.array([pin.rnea(model, scratch, x.q, x.v, a)[:6] for x, a in zip(steps, accelerations, strict=True)])
    turn, base = np.array([x.base_rotation for x in steps]), np.array([x.q[:3] for x in steps])
    toe, force = np.array([x.toe for x in steps]), wrenches[..., :3]
    origin = toe - _arms(steps, foot)
    moment = (wrenches[..., 3:] + np.cross(origin - base[:, None], force)).sum(1)
    given = np.concatenate([_into(turn, force.sum(1)), _into(turn, moment)], 1)
    return float(np.abs(needed - given).max())


def _into(turn, x) -> np.ndarray:
    """World vectors (N, 3) in frames turned by (N, 3, 3)."""
    return np.einsum("nij,ni->nj", turn, x)


def _arms(terms, foot) -> np.ndarray:
    """From the origins of the foot frames to the tiptoes (N, 2, 3), world axes."""
    return np.array([x.foot_rotation for x in terms]) @ np.array([foot.toe, 0.0, foot.sole_z])


def _joints(robot, angles, rates, tau, tau_rates) -> dict[str, float]:
    """Shares of torque and speed limits, and how far the motion goes beyond the torque-speed line and the stops."""
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


def _ground(robot, wrenches, terms, contact) -> dict[str, float]:
    """Unilaterality, friction and CoP of each foot, from the wrenches at the foot frames."""
    foot, force = robot.foot, wrenches[..., :3]
    moment = wrenches[..., 3:] - np.cross(_arms(terms, foot), force)  # about the tiptoes
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
