"""The public tape: a planned jump of the full robot at 1 kHz, readable without the planner."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from jumplab import reading
from jumplab.errors import InputError, Shown, as_path

SCHEMA = "jumplab-plan-1"
RATE_HZ = 1000.0  # the paper's control cycle is 1 ms (Sec. VI-A)
# how a foot stands, in ``contacts``
AIR = 0
TOE = 1
FLAT = 2
# of the arrays, in the order of the fields
_DIMENSIONS = dict(t=1, q=2, v=2, a=2, tau=2, phase=1, contact_frames=1, f=3, joint_names=1)


@dataclass(frozen=True, repr=False)
class Tape(Shown):
    """A motion of the full robot at 1 kHz: launch and flight, or any contact schedule.

    Configurations are in Pinocchio's free-flyer order. Torques are what motors give: they move the
    links, turn the motors' own armature, and overcome their friction, where these are known
    (:attr:`.Robot.actuators`); otherwise they are the joints' torques of inverse dynamics. Instants
    of take-off and landing appear twice, once per phase. ``extra`` has how the feet stand
    (``contacts``), and SRMP and planar solutions, which are for study.
    """

    t: np.ndarray  # (N,) time from the start of the launch [s]
    # (N, nq) x y z qx qy qz qw of the base link in the world, then joint angles [m, rad]
    q: np.ndarray
    # (N, nv) base twist (linear, angular) in the base frame, then joint rates [m/s, rad/s]
    v: np.ndarray
    a: np.ndarray  # (N, nv) time derivative of v [m/s^2, rad/s^2]
    tau: np.ndarray  # (N, nv - 6) motor torques at the joints [N m]
    phase: np.ndarray  # (N,) "launch" (a foot carries) or "flight"
    contact_frames: np.ndarray  # (K,) names of the foot links; where wrenches act
    # (N, K, 6) force then moment on the robot, world axes, at each contact frame's origin [N, N m]
    f: np.ndarray
    joint_names: np.ndarray  # (nv - 6,) in the order of q[7:]
    extra: dict = field(default_factory=dict)  # further arrays under their own names

    def __post_init__(self):
        for name, count in _DIMENSIONS.items():
            x = np.asarray(getattr(self, name))
            if x.ndim != count:
                raise InputError(f"tape: {name} has {x.ndim} dimensions, needs {count}")
            if name not in ("contact_frames", "joint_names") and len(x) != len(self.t):
                raise InputError(f"tape: {name} has {len(x)} rows, t has {len(self.t)}")
            if name in ("t", "q", "v", "a", "tau", "f") and x.dtype.kind not in "fiu":
                raise InputError(f"tape: {name} holds no real numbers (kind {x.dtype.kind!r})")
        for x in self.arrays().values():
            if isinstance(x, np.ndarray):
                x.setflags(write=False)

    @cached_property
    def contacts(self) -> np.ndarray:
        """(N, K) how each foot stands: :data:`AIR`, :data:`TOE` or :data:`FLAT`.

        A tape that does not say stands on all feet until take-off, on the toes from
        ``toe_phase_start`` on.
        """
        stored = self.extra.get("contacts")
        if np.shape(stored) == self.f.shape[:2]:
            return stored
        toes = self.t >= self.extra.get("toe_phase_start", np.inf)
        codes = np.where(self.phase == "flight", AIR, np.where(toes, TOE, FLAT))
        return np.repeat(codes[:, None], len(self.contact_frames), axis=1)

    @property
    def flights(self) -> list[slice]:
        """Rows of each flight, in their order."""
        flying = (self.contacts == AIR).all(axis=1)
        edges = np.flatnonzero(np.diff(flying.astype(int), prepend=0, append=0))
        return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]

    @cached_property
    def caught(self) -> int:
        """Row in which the last foot comes down that stands at the end; the number of rows if the
        tape ends in the air, or no foot comes down.
        """
        down = self.contacts > AIR
        came = np.flatnonzero((np.diff(down.astype(int), axis=0) > 0).any(axis=1)) + 1
        return int(came[-1]) if len(came) and down[-1].any() else len(self.t)

    @cached_property
    def lands(self) -> tuple[int, ...]:
        """Numbers of the feet that come down as the last flight ends; all if the tape ends in the
        air, none if it has no flight.
        """
        if not self.flights:
            return ()
        end = self.flights[-1].stop
        down = np.ones(self.contacts.shape[1]) if end == len(self.t) else self.contacts[end]
        return tuple(np.flatnonzero(down).tolist())

    def until(self, row: int) -> Tape:
        """The tape up to a ``row`` (of N), which it does not have any more."""
        arrays = self.arrays().items()
        long = {k: x[:row] for k, x in arrays if np.shape(x)[:1] == self.t.shape}
        return self._of(self.arrays() | long)

    @property
    def takeoff_index(self) -> int:
        """Row of the first flight sample; zero if there is none."""
        return int(np.argmax(self.phase == "flight"))

    @property
    def takeoff_time(self) -> float:
        """Time of the first take-off [s]."""
        return float(self.t[self.takeoff_index])

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays under the names of ``plan.npz``."""
        fields = {name: getattr(self, name) for name in _DIMENSIONS}
        return {"schema": np.array(SCHEMA), **fields, **self.extra}

    def save(self, path: str | Path) -> None:
        """Write ``plan.npz`` (compressed, no pickle)."""
        np.savez_compressed(path, **self.arrays())

    @classmethod
    def load(cls, path: str | Path) -> Tape:
        """Read ``plan.npz``; raises :class:`InputError` if it is missing, damaged or foreign."""
        path = as_path(path, "a plan's file")
        try:
            raw = reading.content(path, "arrays", link=False)
        except (FileNotFoundError, IsADirectoryError):
            raise InputError(
                f"{path}: no such plan; write one with 'jumplab plan --out {path.parent}'"
            ) from None
        except (OSError, ValueError) as e:
            raise cls._unreadable(path, e) from e
        return cls.from_bytes(raw, path)

    @staticmethod
    def _unreadable(path: Path, e: Exception) -> InputError:
        return InputError(f"{path}: not a readable plan ({type(e).__name__}); it may be truncated")

    @classmethod
    def from_bytes(cls, raw: bytes, path: Path) -> Tape:
        """The tape whose file ``path`` has the content ``raw``; raises as :meth:`load`."""
        try:
            data = reading.arrays(raw)
        except reading.DAMAGE as e:
            raise cls._unreadable(path, e) from e
        schema = str(data.get("schema", "none"))
        if schema != SCHEMA:
            raise InputError(
                f"{path}: schema {schema!r}, this version reads {SCHEMA!r}; plan the jump again"
            )
        for name in _DIMENSIONS:
            if name not in data:
                raise InputError(f"{path}: the array {name!r} is missing; plan the jump again")
        return cls._of(data)

    @classmethod
    def _of(cls, arrays: dict[str, np.ndarray]) -> Tape:
        """The tape of all :meth:`arrays`."""
        fields = {name: arrays.pop(name) for name in _DIMENSIONS}
        del arrays["schema"]
        return cls(**fields, extra=arrays)
