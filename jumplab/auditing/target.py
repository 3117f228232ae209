"""The jump against what was asked: start, rise, distance, turns, touchdown."""

from __future__ import annotations

import numpy as np

from jumplab.auditing import limits as lim
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check, worst

GROUP = "target"


def checks(r: Replay) -> list[Check]:
    """Touchdown geometry always; start, distance, rise and turns if there is a task."""
    return _touchdown(r) + (_asked(r) if r.task else [])


def _touchdown(r: Replay) -> list[Check]:
    t, feet = r.tape.t[-1:], r.tape.contact_frames
    off = np.abs(r.sole_points[-1:, ..., 2] - r.platform).max(axis=-1)  # (1, K)
    upright = np.clip(r.foot_rotation[-1:, :, 2, 2], -1, 1)
    return [
        worst(GROUP, "sole on the surface", 1e3 * off, t, lim.TOUCHDOWN_MM, "mm",
              f"farthest sole corner from the surface at {r.platform:g} m in the last sample", labels=feet),
        worst(GROUP, "sole flat at touchdown", 1e3 * np.arccos(upright), t, lim.FLAT_MRAD, "mrad",
              "tilt of the sole in the last sample", labels=feet),
    ]  # fmt: skip


def foot_turn(r: Replay) -> np.ndarray:
    """(K,) rotation of each foot about +y from the first to the last sample [rad], whole turns counted."""
    x_axis = r.foot_rotation[..., :, 0]  # (N, K, 3)
    return np.diff(np.unwrap(np.arctan2(-x_axis[..., 2], x_axis[..., 0]), axis=0)[[0, -1]], axis=0)[0]


def _asked(r: Replay) -> list[Check]:
    task, tape = r.task, r.tape
    t, i = tape.t, tape.takeoff_index
    travel = (r.toe_corners[-1] - r.toe_corners[0]).mean(axis=1)[:, :2]  # (K, 2)
    miss = np.linalg.norm(travel - np.array([task.distance_m, 0.0]), axis=-1)
    highest = int(np.argmax(r.com[i:, 2])) + i
    rise = float(r.com[highest, 2] - r.com[i, 2])
    turn = np.abs(foot_turn(r) - task.rotation_rad)
    names = [*("base",) * 6, *(str(n) for n in tape.joint_names)]
    return [
        worst(GROUP, "start at rest", np.abs(tape.v[:1]), t[:1], lim.START_RATE, "m/s, rad/s",
              "fastest coordinate in the first sample", labels=names),
        worst(GROUP, "distance", 1e3 * miss[None], t[-1:], lim.DISTANCE_MM, "mm",
              f"feet travel {travel[:, 0].mean():.4f} m from toe to toe, asked {task.distance_m:g} m",
              labels=tape.contact_frames),
        Check(GROUP, "rise", 1e3 * abs(rise - task.height_m), lim.RISE_MM, "mm", float(t[highest]),
              f"CoM rises {rise:.4f} m from take-off to apex, asked {task.height_m:g} m"),
        worst(GROUP, "rotation", 1e3 * turn[None], t[-1:], lim.ROTATION_MRAD, "mrad",
              f"feet turn {np.degrees(foot_turn(r).mean()):.1f} deg about +y over the jump, asked "
              f"{np.degrees(task.rotation_rad):g} deg", labels=tape.contact_frames),
    ]  # fmt: skip
