"""Judging a motion clip: contacts as found, and what of it no robot could do; by the audit's own
code where that applies.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import compress, pairwise, starmap
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.arguments import checked
from jumplab.auditing.audit import _checks
from jumplab.auditing.contact import collisions
from jumplab.auditing.dynamics import joints
from jumplab.auditing.replay import Replay, norm, replay, runs
from jumplab.auditing.report import LIMITS, METHOD, AuditReport, Measure
from jumplab.errors import InputError, as_path
from jumplab.io.clip import ENDINGS, Clip, read_clips
from jumplab.io.folder import versions
from jumplab.io.tape import Tape
from jumplab.robot import Robot

SIDES = "LR"
Fall = tuple[np.ndarray, np.ndarray, float]  # see _free_falls
# limits that a clip passes if it is beyond them for some time, see _lasting
LASTING = {
    name: dataclasses.replace(
        LIMITS[name],
        limit=LIMITS[name].limit + METHOD.torque_room,
        note=LIMITS[name].note + ", for {lasting_s:g} s",
    )
    for name in ("joint torque", "torque at speed")
}
# of clips: stops of engines and robots give way
ALLOWED = LIMITS | LASTING
ALLOWED["joint range"] = dataclasses.replace(LIMITS["joint range"], limit=METHOD.give_mrad)


@dataclass(frozen=True, repr=False)
class ClipReport(AuditReport):
    """Outcome of judging a clip: an audit, and what was found on the way.

    Attributes
    ----------
    clip : that was judged.
    tape : the same with rates by differences, the ground's best forces, and torques.
    ground : (n, 2) whether left and right foot carry, as found.  still : whether they are slow.
    series : by name with unit, what the table has worst values of, over time (n,) or (n, 2).
    """

    clip: Clip | None = None
    tape: Tape | None = None
    ground: np.ndarray | None = None
    still: np.ndarray | None = None
    series: Mapping[str, np.ndarray] = field(default_factory=dict)

    def line(self) -> str:
        """The clip, and the verdict."""
        verdict = "physical" if self.passed else f"not physical: {super().line()}"
        return f"{self.clip.name}: {verdict}"

    @property
    def phases(self) -> list[tuple[str, float, float]]:
        """Feet that carry ("LR", "L", "R", "-"), from and to [s]."""
        return phases_of(self.ground, self.clip.fps)

    @property
    def flights(self) -> list[tuple[float, float]]:
        """From and to [s] of each flight."""
        return [(a, b) for feet, a, b in self.phases if feet == "-"]

    def row(self) -> dict[str, Any]:
        """Row of this clip in a table of many."""
        flown = ", ".join(f"{a:.2f} to {b:.2f}" for a, b in self.flights)
        row = {"clip": self.clip.name, "physical": self.passed, "flights [s]": flown or "none"}
        return row | {f"{c.name} [{c.unit}]": c.value for c in self.checks}


def phases_of(ground: np.ndarray, fps: float) -> list[tuple[str, float, float]]:
    """Feet that carry ("LR", "L", "R", "-"), from and to [s], of contacts (n, 2)."""
    phases = []
    for rows in runs(ground):
        feet = "".join(compress(SIDES, ground[rows.start])) or "-"
        phases.append((feet, rows.start / fps, min(rows.stop, len(ground) - 1) / fps))
    return phases


@checked
def judge(
    motion: Any,
    robot: Robot | str | Path = "bhr",
    *,
    fps: float | None = None,
    order: str = "depth-first",
    platform_m: float | None = None,
) -> ClipReport | list[ClipReport]:
    """Judge a motion, however it was made: feet that float, sink or slide, flights that are no free
    fall, unphysical forces, motors, joints, collisions.

    Returns a report, of a folder and of a file with several clips a list of them. Raises
    :class:`InputError` for what holds no clip of the robot.

    Parameters
    ----------
    motion : a plan, tape or simulation; a :class:`.Clip`; or the path of a clip (pickles of motion
        libraries and retargeters, npz, csv, recognised by their content; pickles are read without
        running them), or of a folder of clips.
    robot : whose motion it is, if it does not carry its own: what :meth:`Robot.load` takes. For a
        clip with more joints than this robot moves, the shipped robot of the same URDF with these
        joints is taken.
    fps : frame rate of files that do not say [1/s].
    order : of joints without names, "depth-first" or "breadth-first".
    platform_m : height of a platform on which feet may stand as well [m]; that of a plan is known.
    """
    if isinstance(motion, Clip):
        return _judged(motion, platform_m)
    robot = robot if isinstance(robot, Robot) else Robot.load(robot)
    if not isinstance(motion, str | Path):
        return _judged(Clip.of(motion, robot, fps), platform_m)
    path = as_path(motion, "a clip")
    paths = [path]
    if path.is_dir():
        paths = sorted(x for x in path.iterdir() if x.suffix in ENDINGS)
        if not paths:
            raise InputError(
                f"{path}: holds no file that ends in {', '.join(ENDINGS)}; give a folder of clips"
            )
    clips = [clip for one in paths for clip in read_clips(one, robot, fps=fps, order=order)]
    reports = [_judged(clip, platform_m) for clip in clips]
    return reports if path.is_dir() or len(reports) > 1 else reports[0]


def _judged(clip: Clip, platform_m: float | None) -> ClipReport:
    if platform_m is not None:
        clip = dataclasses.replace(clip, platform_m=platform_m)
    bare = tape_of(clip)
    r = replay(bare, clip.robot, None)
    z = r.sole_points[..., 2].min(axis=2)
    low, high = sorted((0.0, clip.platform_m))
    height = z - np.where(z > high - METHOD.step_m, high, low)
    ground, still, level = contacts(r, clip.fps, height)
    depth = np.where(ground, -height, low - z)  # in the air beside a platform none is in it
    tape = dataclasses.replace(
        bare,
        f=_pushed(r, ground),
        phase=np.where(ground.any(axis=1), "launch", "flight"),
        extra={"contacts": ground.astype(np.int8)},
    )
    r = replay(tape, clip.robot, None)
    tape = dataclasses.replace(tape, tau=_of_motors(r))
    r = dataclasses.replace(r, tape=tape)
    falls = _free_falls(r, ground)
    self_collision, _ = collisions(r)  # how near the body comes to the ground is no fault of it
    measures = [
        *_measures(r, ground, (height, depth, level), falls),
        *(_lasting(measure, clip.fps) for measure in joints(r)),
        self_collision,
    ]
    checks = tuple(_checks(starmap(r.named, measures), ALLOWED))
    manifest = {
        "clip": clip.name,
        "format": clip.origin,
        "notes": list(clip.notes),
        "fps": clip.fps,
        "frames": len(clip.q),
        "robot": clip.robot.name,
        "robot_hash": clip.robot.hash,
        "standing_m": level.tolist(),
        "flights": [
            {"from_s": t[0], "to_s": t[-1], "acceleration_m_s2": a.tolist(), "rise_m": float(up)}
            for t, a, up in falls
        ],
        "versions": versions(),
        "phases": [list(phase) for phase in phases_of(ground, clip.fps)],
    }
    return ClipReport(
        checks, manifest, clip=clip, tape=tape, ground=ground, still=still, series=_series(r)
    )


def _width(fps: float) -> float:
    """Frames [1] over which rates are averaged."""
    return min(METHOD.smoothing_s * fps, max(1.0, METHOD.rates_s * fps))


def tape_of(clip: Clip) -> Tape:
    """A clip as a tape, rates (n, nv) by differences over METHOD.rates_s, without forces."""
    from scipy.ndimage import gaussian_filter1d  # slow to import

    model = clip.robot.model
    steps = [pin.difference(model, a, b) for a, b in pairwise(clip.q)]
    steps = np.array(steps) * clip.fps
    width = _width(clip.fps)
    v = np.gradient(np.vstack([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)]), axis=0)
    v = gaussian_filter1d(v, width, axis=0, mode="nearest")
    a = np.gradient(v, 1 / clip.fps, axis=0)
    n = len(clip.q)
    names = np.array(clip.robot.joint_names)
    frames = np.array(clip.robot.foot.frames)
    tau = np.zeros((n, len(names)))
    none = np.zeros((n, len(frames), 6))
    return Tape(clip.t, clip.q, v, a, tau, np.full(n, "launch"), frames, none, names)


# contacts
# ----------------------------------------------------------------------------------------------
def contacts(
    r: Replay, fps: float, height: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether each foot carries (n, 2), whether it is still (n, 2), and how high it would stand
    (n, 2) [m]; ``height`` (n, 2) is how high it is.

    A foot stands where its sole is slow, and not far above the lowest one around, nor lifted in
    free fall: so far its height is that of the ground, and linear between. In the air it is while
    it is ``METHOD.lifted_m`` higher than that, or fast while the other one stands, or faster than
    any foot slides. Phases shorter than ``METHOD.short_s`` are ignored.
    """
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d  # slow to import

    least = max(1, round(METHOD.short_s * fps))
    middle = gaussian_filter1d(r.sole_points.mean(axis=2), METHOD.smoothing_s * fps, axis=0)
    speed = norm(np.gradient(middle, 1 / fps, axis=0))
    around = minimum_filter1d(height.min(axis=1), round(METHOD.around_s * fps) | 1, mode="nearest")
    over = height - around[:, None]
    # at the apex of a jump on the spot feet are slow as well
    falls = np.abs(r.com_acceleration[:, 2] / r.gravity + 1) < METHOD.fall_share
    still = (speed < METHOD.still_m_s) & (over < METHOD.high_m)
    still &= ~(falls[:, None] & (over > METHOD.near_m))
    for column in still.T:
        _drop(column, False, least + 1)
        _drop(column, True, least + 1)
    still |= ~still.any(axis=0)  # a foot that never rests does not show where the ground is
    rows = np.arange(len(height))
    level = np.column_stack(
        [np.interp(rows, rows[s], h[s]) for s, h in zip(still.T, height.T, strict=True)]
    )
    gliding = (speed > METHOD.flies_m_s).all(axis=1, keepdims=True)
    low = (height - level < METHOD.lifted_m) & ~gliding
    carrying = still | (low & ~still.any(axis=1, keepdims=True))
    carrying[falls & (over > METHOD.near_m).all(axis=1)] = False
    flying = ~carrying.any(axis=1)
    kept = flying.copy()
    _drop(kept, True, least)
    carrying[flying & ~kept] = True
    return carrying, still, level


def _drop(flags: np.ndarray, value: bool, least: int) -> None:
    """Turn runs of a ``value`` over that are shorter than ``least``, but at both ends."""
    for rows in runs(flags)[1:-1]:
        if flags[rows.start] == value and rows.stop - rows.start < least:
            flags[rows] = not value


def _pushed(r: Replay, ground: np.ndarray) -> np.ndarray:
    """Wrenches (n, 2, 6) at the feet: what friction at the soles' corners can do for the base, with
    torques within their limits if that can be, else least beyond them.

    Rates are averages over some frames, so forces are: a foot may push that long before it lands
    and after it leaves.
    """
    from scipy.ndimage import maximum_filter1d  # slow to import
    from scipy.optimize import nnls  # slow to import

    width = _width(1 / np.median(np.diff(r.tape.t)))
    ground = maximum_filter1d(ground, 2 * round(width) + 1, axis=0)
    effort = r.model.upperEffortLimit[6:]
    f = np.zeros((*ground.shape, 6))
    for k in np.flatnonzero(ground.any(axis=1)):
        sides = np.flatnonzero(ground[k])
        wrenches, base, torques = _pushes(r, k, sides)
        torques /= effort[:, None]
        asked = r.base_residual[k] / r.weight
        needed = r.tau[k] / effort
        weights = np.full(len(needed), METHOD.torque_weight)
        goals = needed.copy()
        for _ in range(METHOD.torque_rounds):
            rows = np.vstack([base, weights[:, None] * torques])
            shares, _ = nnls(rows, np.concatenate([asked, weights * goals]))
            left = needed - torques @ shares
            over = np.abs(left) > METHOD.torque_share
            if not (over & (weights < METHOD.over_weight)).any():
                break
            weights[over] = METHOD.over_weight
            goals[over] = (needed - METHOD.torque_share * np.sign(left))[over]
        for side, columns in zip(sides, np.split(np.arange(len(shares)), len(sides)), strict=True):
            f[k, side] = wrenches[:, columns] @ shares[columns]
    return f


def _of_motors(r: Replay) -> np.ndarray:
    """Torques (n, joints) of the motors [N m]: a joint at its stop leans on it, and the stop takes
    what pushes the joint further.
    """
    angles = r.tape.q[:, 7:]
    above = angles > r.model.upperPositionLimit[7:] - METHOD.stop_mrad / 1e3
    below = angles < r.model.lowerPositionLimit[7:] + METHOD.stop_mrad / 1e3
    return np.where(above, np.maximum(r.tau, 0.0), np.where(below, np.minimum(r.tau, 0.0), r.tau))


def _pushes(r: Replay, k: int, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pushes along the edges of the friction cones at the corners of the soles ``sides`` in sample
    ``k``: wrenches (6, m) at the feet, the same about the CoM as shares of the weight (6, m), and
    torques (nv - 6, m) that they spare [N m].
    """
    mu = METHOD.clip_friction
    edges = np.array([[mu, 0, 1], [-mu, 0, 1], [0, mu, 1], [0, -mu, 1]])
    data = r.model.createData()
    pin.computeJointJacobians(r.model, data, r.tape.q[k])
    parts = []
    for side in sides:
        corners = np.concatenate([r.toe_corners[k, side], r.heel_corners[k, side]])
        force = np.tile(edges, (len(corners), 1))
        arms = np.repeat(corners, len(edges), axis=0)
        wrench = np.hstack([force, np.cross(arms - r.foot[k, side], force)]).T
        slope = pin.getFrameJacobian(r.model, data, r.frames[side], pin.LOCAL_WORLD_ALIGNED)
        base = np.vstack([force.T, np.cross(arms - r.com[k], force).T]) / r.weight
        parts.append((wrench, base, (slope.T @ wrench)[6:]))
    wrenches, base, torques = (np.hstack(x) for x in zip(*parts, strict=True))
    return wrenches, base, torques


# measures
# ----------------------------------------------------------------------------------------------
def _measures(
    r: Replay, ground: np.ndarray, places: tuple[np.ndarray, ...], falls: list[Fall]
) -> Iterator[Measure]:
    """Measures of the group "clip"; ``places`` (n, 2) say how high each foot is over its ground,
    how deep in it, and how high it would stand [m].
    """
    height, depth, level = places
    standing = _inner(ground, r.tape.t)
    floating = np.where(standing, height, -np.inf)
    yield "standing feet float", _most(floating, METHOD.float_percent)
    yield "feet in the ground", depth
    near = standing & (height - level < METHOD.near_m)
    yield "feet on the ground slide", _most(_sliding(r, near), METHOD.slide_percent)
    deviations = [norm(a - r.model.gravity.linear) / r.gravity for _, a, _ in falls]
    yield "flights fall freely", deviations, [times[0] for times, _, _ in falls]
    missing = norm(r.base_residual[:, :3]) / r.weight
    yield "unphysical force", _most(missing, METHOD.force_percent)
    moment = norm(r.base_residual[:, 3:]) / r.weight
    yield "unphysical moment", _most(moment, METHOD.force_percent)


def _lasting(measure: Measure, fps: float) -> Measure:
    """A measure with torque shares (n, joints) that are the least over METHOD.lasting_s around;
    others as they are.
    """
    from scipy.ndimage import minimum_filter1d  # slow to import

    name, values, *more = measure
    if name not in LASTING:
        return measure
    size = max(METHOD.lasting_frames, round(METHOD.lasting_s * fps))
    return name, minimum_filter1d(values, size, axis=0), *more


def _inner(ground: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Contacts (n, 2) without what is close to their ends."""
    from scipy.ndimage import binary_erosion  # slow to import

    rim = max(1, round(METHOD.rim_s / np.median(np.diff(t))))
    return binary_erosion(ground, np.ones((2 * rim + 1, 1)))


def _series(r: Replay) -> dict[str, np.ndarray]:
    torque = np.abs(r.tape.tau) / r.model.upperEffortLimit[6:]
    return {
        "lowest point of each sole [m]": r.sole_points[..., 2].min(axis=2),
        "unphysical force [m g]": norm(r.base_residual[:, :3]) / r.weight,
        "largest torque [of the limit]": torque.max(axis=1),
    }


def _most(values: np.ndarray, percent: float) -> np.ndarray:
    """Values (n, ...) without their largest, beyond a percentile; none if none are finite."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return finite
    return np.where(values <= np.percentile(finite, percent), values, -np.inf)


def _sliding(r: Replay, ground: np.ndarray) -> np.ndarray:
    """Speed (n, 2) [m/s] over the ground of the lower edge of each sole that carries; else -inf."""
    edges = np.stack([r.toe_corners.mean(axis=2), r.heel_corners.mean(axis=2)], axis=2)
    speed = norm(np.gradient(edges[..., :2], r.tape.t, axis=0))
    low = edges[..., 2] - edges[..., 2].min(axis=2, keepdims=True) < METHOD.same_edge_m
    return np.where(ground, np.where(low, speed, np.inf).min(axis=2), -np.inf)


def _free_falls(r: Replay, ground: np.ndarray) -> list[Fall]:
    """Of each flight its times [s], the CoM's mean acceleration (3,) [m/s^2], and its rise [m]."""
    falls = []
    for rows in runs(ground.any(axis=1)):
        if ground[rows.start].any() or rows.stop - rows.start <= METHOD.least_flight:
            continue
        t = r.tape.t[rows]
        com = r.com[rows]
        bent = 2 * np.polyfit(t - t[0], com, 2)[0]
        falls.append((t, bent, com[:, 2].max() - com[0, 2]))
    return falls
