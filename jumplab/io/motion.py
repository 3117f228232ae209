"""A finished motion, planned or simulated, at any instants, without double samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from jumplab import reading
from jumplab.arguments import checked
from jumplab.errors import InputError
from jumplab.robot import Robot

SIMULATION_NAME = "simulation.npz"
SIMULATION_SCHEMA = "jumplab-simulation-1"
MAX_RATE_HZ = 10_000.0  # ten times the rate of the logs; more is a typing error
CONTACT_FORCE_N = 5.0  # "a few newtons"; a height threshold would see the lift-off 20 ms late
END_TOLERANCE = 1e-9  # [s], so that a grid of k / rate reaches the last sample in spite of rounding


@runtime_checkable
class Record(Protocol):
    """Record of a jump from which a motion is made: a ``Tape`` or a ``SimulationResult``."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    phase: np.ndarray


@dataclass(frozen=True)
class Motion:
    """States and torques of a robot over time."""

    # (N,) [s], never falling; an instant may stand twice, where one phase ends and the next begins
    t: np.ndarray
    # (N, nq) x y z qx qy qz qw of the base link in the world, then joint angles [m, rad]
    q: np.ndarray
    # (N, nv) base twist (linear, angular) in the base frame, then joint rates [m/s, rad/s]
    v: np.ndarray
    tau: np.ndarray  # (N, nv - 6) joint torques [N m]
    phase: np.ndarray  # (N,) "launch", "flight" or "landing"
    source: str  # "plan" or "simulation"
    # (N, 2, 6) on the feet: force, moment, world axes, at the foot links' origins
    wrench: np.ndarray | None = None
    # (N, 2) whether left and right foot press on the ground; None: but in flight
    contact: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.contact is None:
            both = np.repeat(np.asarray(self.phase)[:, None] != "flight", 2, axis=1)
            object.__setattr__(self, "contact", both)

    @classmethod
    @checked
    def of(cls, record: Record | Motion) -> Motion:
        """The motion of a ``Tape`` (which has accelerations) or of a ``SimulationResult``."""
        if isinstance(record, Motion):
            return record
        states = record.t, record.q, record.v, record.tau, record.phase
        if hasattr(record, "a"):
            stands = getattr(record, "contacts", None)
            down = None if stands is None else stands > 0
            return cls(*states, "plan", getattr(record, "f", None), down)
        wrench = getattr(record, "foot_wrench", None)
        pressing = None if wrench is None else wrench[:, :, 2] > CONTACT_FORCE_N
        return cls(*states, "simulation", wrench, pressing)

    @classmethod
    def of_simulation_file(cls, folder: str | Path, robot: Robot) -> Motion:
        """Read a folder's ``simulation.npz``; raises :class:`InputError` if missing or damaged."""
        if not (Path(folder) / SIMULATION_NAME).is_file():
            raise InputError(
                f"{str(folder)!r} holds no simulation; run 'jumplab simulate {folder}' first"
            )
        names = ("t", "q", "v", "tau", "phase", "foot_wrench")
        return cls.of(SimpleNamespace(**read_simulation(folder, robot, names)))

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    @checked
    def at(self, times: np.ndarray) -> Motion:
        """The motion at ``times`` (M,) [s]: everything linear between samples, the base's attitude
        along the arc.

        An instant that stands twice gives its later sample, so that take-off belongs to the flight.
        Raises :class:`InputError` if a time lies outside the motion, or a quaternion is zero.
        """
        if not self.q[:, 3:7].any(axis=1).all():
            raise InputError(
                "a quaternion of the base is zero, which is no attitude; make the motion again"
            )
        times = np.asarray(times, float)
        if not ((times >= self.t[0]) & (times <= self.t[-1] + END_TOLERANCE)).all():
            asked = f"{times.min():g} ... {times.max():g} s"
            raise InputError(
                f"times {asked} are outside the motion, {self.t[0]:g} ... {self.t[-1]:g} s"
            )
        row = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        # no gap is where the last instant stands twice, of which the later sample counts
        gap = np.maximum(self.t[row + 1] - self.t[row], END_TOLERANCE)
        share = 1.0 - np.clip((self.t[row + 1] - times) / gap, 0.0, 1.0)

        def between(x: np.ndarray) -> np.ndarray:
            return x[row] + share.reshape(-1, *[1] * (x.ndim - 1)) * (x[row + 1] - x[row])

        q = between(self.q)
        start = Rotation.from_quat(self.q[row, 3:7])
        arc = (start.inv() * Rotation.from_quat(self.q[row + 1, 3:7])).as_rotvec()
        q[:, 3:7] = steady((start * Rotation.from_rotvec(share[:, None] * arc)).as_quat())
        late = np.where(share < 1.0, row, row + 1)
        wrench = None if self.wrench is None else between(self.wrench)
        states = (times, q, between(self.v), between(self.tau), self.phase[late])
        return Motion(*states, self.source, wrench, self.contact[late])

    @checked
    def every(self, rate_hz: float, *, end: bool = False) -> Motion:
        """The motion on a grid of ``rate_hz`` [1/s], from its start to the last grid
        point within it.

        With ``end`` its last instant follows, where it is none of the grid: touchdown, in a plan.
        """
        checked_rate(rate_hz)
        count = int((self.duration + END_TOLERANCE) * rate_hz) + 1
        times = np.minimum(self.t[0] + np.arange(count) / rate_hz, self.t[-1])
        more = end and self.t[-1] - times[-1] > END_TOLERANCE
        return self.at(np.append(times, self.t[-1:] if more else []))


@checked
def checked_rate(rate_hz: float) -> float:
    """A rate [1/s] that a motion can be sampled with; raises :class:`InputError` if it is none."""
    if not 0 < rate_hz <= MAX_RATE_HZ:
        raise InputError(
            f"rate = {rate_hz:g} per second must lie above 0 and not above {MAX_RATE_HZ:g}"
        )
    return rate_hz


def read_simulation(
    folder: str | Path, robot: Robot, names: Sequence[str]
) -> dict[str, np.ndarray]:
    """Arrays ``names`` (t, q, v, tau, phase among them) of the ``simulation.npz`` in ``folder``.

    Raises :class:`InputError` if the file is damaged or not one of ``robot``.
    """
    path = Path(folder) / SIMULATION_NAME
    try:
        file = reading.arrays(reading.content(path, "arrays", link=False))
        data = {k: file[k] for k in names}
        schema = str(file["schema"])
        joints = tuple(str(n) for n in file["joint_names"])
    except reading.DAMAGE as e:
        raise InputError(
            f"{path}: not a readable simulation ({type(e).__name__}); simulate the plan again"
        ) from e
    nv = robot.model.nv
    widths = dict(t=(), q=(robot.model.nq,), v=(nv,), tau=(nv - 6,), phase=(), foot_wrench=(2, 6))
    fits = all(
        data[k].shape == (data["t"].size, *widths[k])
        and (k == "phase" or data[k].dtype.kind == "f")
        for k in widths.keys() & data
    )
    if schema != SIMULATION_SCHEMA or joints != robot.joint_names or not fits:
        raise InputError(
            f"{path}: not a simulation of this folder's robot; simulate the plan again"
        )
    return data


def steady(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (M, ..., 4) with the sign of each the nearest to the one before."""
    beside = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True)
    signs = np.cumprod(np.where(beside < 0, -1.0, 1.0), axis=0)
    return np.concatenate([quaternions[:1], signs * quaternions[1:]])
