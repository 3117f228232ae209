"""Feet and ground: slip, penetration, clearance, centre of pressure, friction, unilaterality."""

from __future__ import annotations

import numpy as np

from jumplab.auditing import limits as lim
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check, worst

GROUP = "contact"


def checks(r: Replay) -> list[Check]:
    """All checks of this group."""
    return [*_geometry(r), *_pressure(r), *_force(r)]


def _geometry(r: Replay) -> list[Check]:
    t, s, feet = r.tape.t, r.launch, r.tape.contact_frames
    toe = r.toe_corners[s]  # (n, K, 2, 3)
    slip = np.linalg.norm((toe - toe[0])[..., :2], axis=-1).max(axis=-1)
    hover = np.abs(toe[..., 2]).max(axis=-1)
    points = r.sole_points
    above = 1e3 * (points[..., 2] - r.surface(points[..., 0])).min(axis=-1)  # (N, K)
    flying = t[r.flight]
    share = (t - flying[0]) / (flying[-1] - flying[0])
    middle = (share >= lim.MID_FLIGHT[0]) & (share <= lim.MID_FLIGHT[1])
    return [
        worst(GROUP, "toe slip", 1e3 * slip, t[s], lim.SLIP_MM, "mm",
              "horizontal travel of the toe edge since the start, over the launch", labels=feet),
        worst(GROUP, "toe on the ground", 1e3 * hover, t[s], lim.HOVER_MM, "mm",
              "height of the toe edge over the ground, or depth under it, over the launch", labels=feet),
        worst(GROUP, "penetration", -above, t, lim.PENETRATION_MM, "mm",
              "depth of the sole's points under ground or platform, whole jump", labels=feet),
        worst(GROUP, "foot clearance", above[middle], t[middle], lim.CLEARANCE_MM, "mm",
              f"lowest sole point over the surface, {lim.MID_FLIGHT[0]:.0%} to {lim.MID_FLIGHT[1]:.0%} of the flight",
              at_least=True, labels=feet),
    ]  # fmt: skip


def _pressure_points(r: Replay) -> tuple[np.ndarray, np.ndarray]:
    """CoP on the ground (N, K, 2) [m], nan without load, and torsion about it (N, K) [N m]."""
    force, moment = r.tape.f[..., :3], r.tape.f[..., 3:]
    up = np.where(force[..., 2] > lim.COP_MIN_FORCE_N, force[..., 2], np.nan)
    down = -r.foot[..., 2]  # from the frame's origin to the ground
    dx = (down * force[..., 0] - moment[..., 1]) / up
    dy = (down * force[..., 1] + moment[..., 0]) / up
    torsion = moment[..., 2] - (dx * force[..., 1] - dy * force[..., 0])
    return r.foot[..., :2] + np.stack([dx, dy], axis=-1), torsion


def _pressure(r: Replay) -> list[Check]:
    t, feet = r.tape.t, r.tape.contact_frames
    cop, torsion = _pressure_points(r)
    heading = r.foot_rotation[..., :2, 0]
    heading = heading / np.maximum(np.linalg.norm(heading, axis=-1, keepdims=True), 1e-9)  # (N, K, 2) heel to toe
    side = np.stack([-heading[..., 1], heading[..., 0]], axis=-1)
    toe, heel = (x[..., :2].mean(axis=2) for x in (r.toe_corners, r.heel_corners))
    ahead = ((cop - toe) * heading).sum(-1)  # of the toe edge
    length = ((toe - heel) * heading).sum(-1)  # of the sole, seen from above
    aside = np.abs(((cop - toe) * side).sum(-1)) - np.array([(s.left - s.right) / 2 for s in r.soles])
    outside = np.maximum.reduce([ahead, -ahead - length, aside])
    raised = 1e3 * r.heel_corners[..., 2].min(axis=-1) > lim.HEEL_UP_MM
    loaded = r.tape.f[..., 2] > lim.COP_MIN_FORCE_N
    some = loaded.any(axis=1)  # rows with something to check
    twist = np.abs(torsion) / (lim.FRICTION * lim.TORSION_ARM_M * np.where(loaded, r.tape.f[..., 2], 1.0))
    beyond = np.where(loaded, outside, -np.inf)
    load = f"wherever a foot carries over {lim.COP_MIN_FORCE_N:g} N"
    return [
        worst(GROUP, "CoP in the sole", 1e3 * beyond[some], t[some], lim.COP_OUTSIDE_MM, "mm",
              f"distance of the centre of pressure beyond the sole's edges (negative: inside), {load}", labels=feet),
        worst(GROUP, "CoP at the toe", 1e3 * np.where(loaded & raised, np.abs(ahead), 0.0), t, lim.TOE_COP_MM, "mm",
              f"distance from toe edge to centre of pressure while the heel is over {lim.HEEL_UP_MM:g} mm up, {load}",
              labels=feet),
        worst(GROUP, "torsional friction", 100 * np.where(loaded, twist, 0.0), t, lim.SHARE_PERCENT, "%",
              f"moment about the vertical through the CoP as a share of friction {lim.FRICTION:g} on "
              f"{lim.TORSION_ARM_M:g} m, {load}", labels=feet),
    ]  # fmt: skip


def _force(r: Replay) -> list[Check]:
    t, feet, force = r.tape.t, r.tape.contact_frames, r.tape.f
    along = np.linalg.norm(force[..., :2], axis=-1)
    used = along / np.maximum(force[..., 2], lim.FRICTION_MIN_FORCE_N)
    return [
        worst(GROUP, "friction used", used, t, lim.FRICTION, "1",
              f"tangential over normal force (at least {lim.FRICTION_MIN_FORCE_N:g} N) of each foot", labels=feet),
        worst(GROUP, "ground only pushes", -force[..., 2], t, lim.PULL_N, "N",
              "downward pull of the ground on a foot (negative: it pushes all the time)", labels=feet),
    ]  # fmt: skip
