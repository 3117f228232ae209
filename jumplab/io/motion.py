"""A finished motion, planned or simulated, as pictures and exports want it: at any instants, without double samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from jumplab.errors import InputError
from jumplab.io.tape import DAMAGE
from jumplab.robot import Robot

SIMULATION_NAME, SIMULATION_SCHEMA = "simulation.npz", "jumplab-simulation-1"
MAX_RATE_HZ = 10_000.0  # ten times the rate of the logs; more is a typing error
CONTACT_FORCE_N = 5.0  # "a few newtons"; a height threshold would see the lift-off 20 ms late
END_TOLERANCE = 1e-9  # [s], so that a grid of k / rate reaches the last sample in spite of rounding


class Record(Protocol):
    """What a motion is made from: a ``Tape`` or a ``SimulationResult``."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    phase: np.ndarray


@dataclass(frozen=True)
class Motion:
    """States and torques of a robot over time."""

    t: np.ndarray  # (N,) [s], never falling; an instant may stand twice, where one phase ends and the next begins
    q: np.ndarray  # (N, nq) x y z qx qy qz qw of the base link in the world, then joint angles [m, rad]
    v: np.ndarray  # (N, nv) base twist (linear, angular) in the base frame, then joint rates [m/s, rad/s]
    tau: np.ndarray  # (N, nv - 6) joint torques [N m]
    phase: np.ndarray  # (N,) "launch", "flight" or "landing"
    source: str  # "plan" or "simulation"
    wrench: np.ndarray | None = None  # (N, 2, 6) on the feet: force, moment, world axes, at the foot links' origins
    contact: np.ndarray | None = None  # (N, 2) whether left and right foot press on the ground; None: but in flight

    def __post_init__(self) -> None:
        if self.contact is None:
            both = np.repeat(np.asarray(self.phase)[:, None] != "flight", 2, axis=1)
            object.__setattr__(self, "contact", both)

    @classmethod
    def of(cls, record: Record) -> Motion:
        """The motion of a ``Tape`` (it alone carries accelerations) or of a ``SimulationResult``."""
        source = "plan" if hasattr(record, "a") else "simulation"
        wrench = getattr(record, "f" if source == "plan" else "foot_wrench", None)
        contact = None if source == "plan" else _pressing(wrench)
        return cls(record.t, record.q, record.v, record.tau, record.phase, source, wrench, contact)

    @classmethod
    def of_simulation_file(cls, folder: str | Path, robot: Robot) -> Motion:
        """Read ``simulation.npz`` from a result folder; raises :class:`InputError` if it is missing or damaged."""
        if not (Path(folder) / SIMULATION_NAME).is_file():
            raise InputError(f"{str(folder)!r} holds no simulation; run 'jumplab simulate {folder}' first")
        data = read_simulation(folder, robot, ("t", "q", "v", "tau", "phase"), ("foot_wrench",))
        wrench = data.pop("foot_wrench", None)
        return cls(wrench=wrench, contact=_pressing(wrench), **data, source="simulation")

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    def at(self, times: np.ndarray) -> Motion:
        """The motion at ``times`` (M,) [s]: everything linear between samples, the base's attitude along the arc.

        An instant that stands twice gives its later sample, so that take-off belongs to the flight. Raises
        :class:`InputError` if a time lies outside the motion.
        """
        times = np.asarray(times, float)
        if len(times) and not (self.t[0] <= times.min() and times.max() <= self.t[-1] + END_TOLERANCE):
            asked = f"{times.min():g} ... {times.max():g} s"
            raise InputError(f"times {asked} leave the motion, {self.t[0]:g} ... {self.t[-1]:g} s")
        row = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        gap = self.t[row + 1] - self.t[row]
        share = np.clip((times - self.t[row]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
        share[gap <= 0] = 1.0  # the last instant stands twice

        def between(x: np.ndarray) -> np.ndarray:
            return x[row] + share.reshape(-1, *[1] * (x.ndim - 1)) * (x[row + 1] - x[row])

        q = between(self.q)
        q[:, 3:7] = _between_attitudes(self.q[row, 3:7], self.q[row + 1, 3:7], share)
        wrench, late = None if self.wrench is None else between(self.wrench), np.where(share < 1.0, row, row + 1)
        states = (q, between(self.v), between(self.tau), self.phase[late])
        return Motion(times, *states, self.source, wrench, self.contact[late])

    def every(self, rate_hz: float, *, end: bool = False) -> Motion:
        """The motion on a grid of ``rate_hz`` samples a second, from its start to the last grid point within it.

        With ``end`` its last instant follows, where it is none of the grid: touchdown, in a plan.
        """
        checked_rate(rate_hz)
        count = int(np.floor((self.duration + END_TOLERANCE) * rate_hz)) + 1
        times = np.minimum(self.t[0] + np.arange(count) / rate_hz, self.t[-1])
        return self.at(np.append(times, self.t[-1]) if end and self.t[-1] - times[-1] > END_TOLERANCE else times)


def checked_rate(rate_hz: float) -> float:
    """A rate [1/s] that a motion can be sampled with; raises :class:`InputError` if it is none."""
    if not 0 < rate_hz <= MAX_RATE_HZ:
        raise InputError(f"rate = {rate_hz:g} per second must lie above 0 and not above {MAX_RATE_HZ:g}")
    return rate_hz


def read_simulation(
    folder: str | Path, robot: Robot, names: Sequence[str], more: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Arrays ``names`` (t, q, v, tau, phase among them) of the ``simulation.npz`` in ``folder``, and ``more`` if there.

    Raises :class:`InputError` if the file is damaged or not one of ``robot``.
    """
    path = Path(folder) / SIMULATION_NAME
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {k: file[k] for k in (*names, *(k for k in more if k in file.files))}
            schema, joints = str(file["schema"]), tuple(str(n) for n in file["joint_names"])
    except DAMAGE as e:
        raise InputError(f"{path}: not a readable simulation ({type(e).__name__}); simulate the plan again") from e
    n, nq, nv = data["t"].size, robot.model.nq, robot.model.nv
    shapes = dict(t=(n,), q=(n, nq), v=(n, nv), tau=(n, nv - 6), phase=(n,), foot_wrench=(n, 2, 6))
    fits = all(data[k].shape == shape for k, shape in shapes.items() if k in data)
    if schema != SIMULATION_SCHEMA or joints != robot.joint_names or not fits:
        raise InputError(f"{path}: not a simulation of this folder's robot; simulate the plan again")
    return data


def _between_attitudes(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Quaternions xyzw (M, 4) at ``share`` (M,) of the arcs from ``first`` to ``second``, free of jumps in sign."""
    start = Rotation.from_quat(first)
    arc = (start.inv() * Rotation.from_quat(second)).as_rotvec()
    return steady((start * Rotation.from_rotvec(share[:, None] * arc)).as_quat())


def _pressing(wrench: np.ndarray | None) -> np.ndarray | None:
    """Which feet (N, 2) press on the ground, from the wrenches (N, 2, 6) on them."""
    return None if wrench is None else wrench[:, :, 2] > CONTACT_FORCE_N


def steady(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (M, ..., 4) with the sign of each the nearest to the one before."""
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True) < 0
    flips = np.concatenate([np.zeros((1, *turned.shape[1:]), bool), np.cumsum(turned, axis=0) % 2 == 1])
    return np.where(flips, -quaternions, quaternions)
