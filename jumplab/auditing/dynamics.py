"""Newton, Euler and energy on the tape: inverse dynamics, impulses, flight, mass."""

from __future__ import annotations

import numpy as np

from jumplab.auditing import limits as lim
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check, worst

GROUP = "dynamics"


def _norm(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x, axis=-1)


def checks(r: Replay) -> list[Check]:
    """All checks of this group."""
    return [*_inverse(r), *_impulses(r), *_flight(r), *_takeoff(r), _energy(r), _mass(r)]


def _inverse(r: Replay) -> list[Check]:
    t, percent = r.tape.t, 100 / r.weight  # the moment is taken as a share of m g * 1 m
    peak = r.model.upperEffortLimit[6:]
    return [
        worst(GROUP, "base force residual", percent * _norm(r.base_residual[:, :3]), t, lim.RESIDUAL_PERCENT, "% m g",
              "force on the floating base that no contact provides, by inverse dynamics"),
        worst(GROUP, "base moment residual", percent * _norm(r.base_residual[:, 3:]), t, lim.RESIDUAL_PERCENT,
              "% m g 1m", "moment about the CoM that no contact provides, by inverse dynamics"),
        worst(GROUP, "joint torque consistency", 100 * np.abs(r.tau - r.tape.tau) / peak, t, lim.TORQUE_PERCENT,
              "% of peak torque", "torques on the tape against inverse dynamics", labels=r.tape.joint_names),
    ]  # fmt: skip


def _impulses(r: Replay) -> list[Check]:
    s, t = r.launch, r.tape.t
    force = r.tape.f[..., :3].sum(axis=1)
    force[:, 2] -= r.weight
    arm = r.foot - r.com[:, None]
    moment = (np.cross(arm, r.tape.f[..., :3]) + r.tape.f[..., 3:]).sum(axis=1)
    gained = r.mass * (r.com_velocity - r.com_velocity[0])
    end = r.launch.stop - 1
    off = 100 * _norm(gained - r.integral(force)) / max(r.mass * _norm(r.com_velocity[end]), 1e-9)
    turned = _norm(r.momentum - r.momentum[0] - r.integral(moment))
    return [
        worst(GROUP, "linear impulse", off[s], t[s], lim.IMPULSE_PERCENT, "% of take-off",
              "momentum gained since the start against the integral of contact force and weight"),
        worst(GROUP, "angular impulse", turned[s], t[s], lim.ANGULAR_IMPULSE, "kg m^2/s",
              "angular momentum gained since the start against the integral of the contact moment about the CoM"),
    ]  # fmt: skip


def _flight(r: Replay) -> list[Check]:
    s, t = r.flight, r.tape.t[r.flight]
    since = (t - t[0])[:, None]
    parabola = r.com[s][0] + r.com_velocity[s][0] * since + np.array([0, 0, -r.gravity / 2]) * since**2
    # x = t / T keeps the fit well conditioned
    fitted = -2 * np.polyfit(since[:, 0] / since[-1, 0], r.com[s][:, 2], 2)[0] / since[-1, 0] ** 2
    claimed = _norm(r.tape.f[s][..., :3]) + _norm(r.tape.f[s][..., 3:])  # N and N m: both must vanish
    return [
        worst(GROUP, "ballistic CoM", 1e3 * _norm(r.com[s] - parabola), t, lim.FLIGHT_COM_MM, "mm",
              f"CoM in flight against the parabola from take-off with g = {r.gravity:g}"),
        Check(GROUP, "gravity in flight", 100 * abs(fitted / r.gravity - 1), lim.FLIGHT_GRAVITY_PERCENT, "% of g", None,
              "curvature of the CoM's height over the flight, least squares, against g"),
        worst(GROUP, "angular momentum in flight", _norm(r.momentum[s] - r.momentum[s][0]), t, lim.FLIGHT_L, "kg m^2/s",
              "L about the CoM against its value at take-off"),
        worst(GROUP, "no force in flight", claimed, t, lim.FLIGHT_FORCE_N, "N, N m", "contact wrenches in the air",
              labels=r.tape.contact_frames),
    ]  # fmt: skip


def _takeoff(r: Replay) -> list[Check]:
    last, t = r.launch.stop - 1, r.tape.t
    instant = float(t[last])
    force = r.tape.f[last, :, :3].sum(axis=0)
    moment = (np.cross(r.foot[last] - r.com[last], r.tape.f[last, :, :3]) + r.tape.f[last, :, 3:]).sum(axis=0)
    rows = slice(last, last + 2)
    off = _norm(r.com_acceleration[rows] - np.array([0, 0, -r.gravity]))
    percent = 100 / r.weight
    return [
        Check(GROUP, "zero force at take-off", percent * _norm(force), lim.TAKEOFF_PERCENT, "% m g", instant,
              "contact force in the last launch sample"),
        Check(GROUP, "zero moment at take-off", percent * _norm(moment), lim.TAKEOFF_PERCENT, "% m g 1m", instant,
              "contact moment about the CoM in the last launch sample"),
        worst(GROUP, "free fall at take-off", 100 / r.gravity * off, t[rows],
              lim.TAKEOFF_ACCELERATION_PERCENT, "% of g", "CoM acceleration against free fall, both sides of take-off"),
    ]  # fmt: skip


def _energy(r: Replay) -> Check:
    power = (r.tape.tau * r.tape.v[:, 6:]).sum(axis=1)
    missing = r.energy - r.energy[0] - r.integral(power)
    span = max(float(np.ptp(r.energy)), 1e-9)
    return worst(GROUP, "energy balance", 100 * np.abs(missing) / span, r.tape.t, lim.ENERGY_PERCENT, "% of range",
                 f"mechanical energy against the joints' work; the energy ranges over {span:.0f} J and a foot at rest "
                 f"does no work")  # fmt: skip


def _mass(r: Replay) -> Check:
    s = r.launch
    push, accelerated = r.tape.f[s][..., 2].sum(axis=1), r.com_acceleration[s][:, 2] + r.gravity
    moved = float(push @ accelerated / max(accelerated @ accelerated, 1e-9))
    note = f"the ground force moves {moved:.3f} kg (least squares over the launch), the URDF has {r.mass:.3f} kg"
    return Check(GROUP, "mass", 100 * abs(moved / r.mass - 1), lim.MASS_PERCENT, "% of mass", None, note)
