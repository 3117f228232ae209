"""Stage 1's result as stage 2 follows it: checked, sampled at the roll-out's steps, with feed-forward."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from jumplab.errors import InputError
from jumplab.stages.joint_qp.settings import Gain

STEP_TOLERANCE = 1e-3  # relative unevenness above which the time axis counts as having a gap
COP_AT_TOE_M = 0.015  # reference CoP this close to the toe edge counts as standing on the toes
FOOT_BLEND_S = 0.15  # a quarter of a flight; longer, and the rates of take-off carry the legs far off
INERTIA_BLEND_S = 0.08  # arms and trunk are quicker than legs; shorter, they are at their limits
COM = {"com": 2, "com_velocity": 2, "com_acceleration": 2}
INERTIA = {"rho": 1, "rho_rate": 1, "rho_accel": 1}
NEEDED = {  # array -> columns
    "launch": {**COM, "L": 1, "L_rate": 1, **INERTIA, "cop_x": 1},
    "flight": {**COM, "L": 1, **INERTIA, "foot_com": 2, "foot_com_rate": 2, "foot_com_accel": 2},
}


def checked(srmp: Any, phase: str) -> dict[str, np.ndarray]:
    """Arrays of one phase of stage 1's result; raises :class:`InputError` naming array and time if one is unusable."""
    source = getattr(srmp, phase, None)
    if source is None or not hasattr(source, "t"):
        raise InputError(f"stage 2: the reference has no phase {phase!r} with a time axis 't'")
    t = np.asarray(source.t, float)
    where = f"stage 2, reference of the {phase}"
    if t.ndim != 1 or len(t) < 3 or not np.all(np.isfinite(t)):
        raise InputError(f"{where}: t must be at least 3 finite times, got shape {t.shape}")
    steps = np.diff(t)
    usual = np.median(steps)
    odd = np.flatnonzero(np.abs(steps - usual) > STEP_TOLERANCE * abs(usual))
    if usual <= 0 or len(odd):
        k = int(odd[0]) if len(odd) else 0
        raise InputError(f"{where}: gap after t = {t[k]:.4f} s, the step there is {steps[k]:.4g} s, not {usual:.4g} s")
    out = {"t": t - t[0]}
    for name, columns in NEEDED[phase].items():
        if not hasattr(source, name):
            raise InputError(f"{where}: the array {name!r} is missing")
        x = np.asarray(getattr(source, name), float)
        shape = (len(t),) if columns == 1 else (len(t), columns)
        if x.shape != shape:
            raise InputError(f"{where}: {name} has shape {x.shape}, must be {shape}")
        bad = np.flatnonzero(~np.isfinite(x.reshape(len(t), -1)).all(1))
        if len(bad):
            raise InputError(f"{where}: {name} is not finite at t = {t[bad[0]]:.4f} s")
        out[name] = x
    return out


def hermite(
    grid: np.ndarray, value: np.ndarray, rate: np.ndarray, accel: np.ndarray | None, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Value and rate at times ``t`` of the quintic pieces through value, rate and acceleration on an even ``grid``.

    Without ``accel`` the pieces are cubic.
    """
    h = grid[1] - grid[0]
    k = np.clip(((t - grid[0]) / h).astype(int), 0, len(grid) - 2)
    s = ((t - grid[k]) / h).reshape((-1,) + (1,) * (np.ndim(value) - 1))
    p0, p1, v0, v1 = value[k], value[k + 1], h * rate[k], h * rate[k + 1]
    if accel is None:
        c = [p0, v0, 3 * (p1 - p0) - 2 * v0 - v1, -2 * (p1 - p0) + v0 + v1]
    else:
        a0, a1 = h * h * accel[k], h * h * accel[k + 1]
        d, e, f = p1 - p0 - v0 - a0 / 2, v1 - v0 - a0, a1 - a0
        c = [p0, v0, a0 / 2, 10 * d - 4 * e + f / 2, -15 * d + 7 * e - f, 6 * d - 3 * e + f / 2]
    x = sum(ci * s**i for i, ci in enumerate(c))
    dx = sum(i * ci * s ** (i - 1) for i, ci in enumerate(c) if i) / h
    return x, dx


@dataclass(frozen=True)
class Track:
    """A reference at the nodes of n steps."""

    value: np.ndarray  # at the nodes (n + 1, d)
    rate: np.ndarray  # at the nodes (n + 1, d)
    feed: np.ndarray  # mean acceleration over each step (n, d): alone it reproduces the rates at the nodes

    @classmethod
    def of(cls, t: np.ndarray, value: np.ndarray, rate: np.ndarray) -> Track:
        """From value and rate at node times ``t`` (n + 1,)."""
        step = np.diff(t).reshape((-1,) + (1,) * (rate.ndim - 1))
        return cls(value, rate, np.diff(rate, axis=0) / step)

    @classmethod
    def sample(cls, grid: np.ndarray, value: np.ndarray, rate: np.ndarray, accel: np.ndarray, t: np.ndarray) -> Track:
        """Through the samples of stage 1."""
        return cls.of(t, *hermite(grid, value, rate, accel, t))

    def command(self, k: int, value: np.ndarray, rate: np.ndarray, gain: Gain) -> np.ndarray:
        """Acceleration to ask for over step k, from value and rate at its start: feed-forward + PD."""
        return self.feed[k] + gain.damping * (self.rate[k] - rate) + gain.stiffness * (self.value[k] - value)

    def from_state(self, t: np.ndarray, value: np.ndarray, rate: np.ndarray, blend_s: float) -> Track:
        """The same reference, but beginning at a given value and rate and joining it smoothly after ``blend_s``.

        The quintic that carries the initial offset down to zero is added. SRMP's pivot stays on the ground while the
        robot's heel may be up at take-off, so the two can meet only in the air.
        """
        start = np.asarray(value) - self.value[0], np.asarray(rate) - self.rate[0]
        zero, ends = np.zeros_like(start[0]), np.array([0.0, min(blend_s, t[-1])])
        offset = [np.array([x, zero]) for x in (*start, zero)]
        fade = Track.of(t, *hermite(ends, *offset, np.minimum(t, ends[1])))
        return Track(*(getattr(self, f.name) + getattr(fade, f.name) for f in fields(self)))


def nodes(duration: float, step_s: float) -> np.ndarray:
    """Even node times from 0 to ``duration``, no further apart than ``step_s``."""
    return np.linspace(0.0, duration, max(int(np.ceil(duration / step_s - 1e-9)), 1) + 1)


def planar(x: np.ndarray) -> np.ndarray:
    """(N, 2) x, z as (N, 3) with y = 0."""
    return np.stack([x[:, 0], np.zeros(len(x)), x[:, 1]], 1)


def followed(r: dict[str, np.ndarray], t: np.ndarray) -> tuple[Track, Track]:
    """CoM (3,) and inertia at times ``t``, from the arrays of a phase."""
    com = Track.sample(r["t"], *(planar(r[k]) for k in COM), t)
    return com, Track.sample(r["t"], *(r[k] for k in INERTIA), t)


@dataclass(frozen=True)
class LaunchReference:
    """Launch reference at the nodes; CoM relative to the pivot (3,), ``momentum`` with L as its rate, inertia."""

    t: np.ndarray
    com: Track
    momentum: Track
    inertia: Track
    cop_x: np.ndarray

    @classmethod
    def sample(cls, srmp: Any, step_s: float, toe: tuple[float, float] | None = None) -> LaunchReference:
        """From stage 1's launch; ``toe`` is the length [s] of a last part that has another step, and that step [s]."""
        r = checked(srmp, "launch")
        grid = r["t"]
        t = nodes(grid[-1], step_s)
        if toe is not None and 0 < toe[0] < grid[-1]:
            split = grid[-1] - toe[0]
            t = np.concatenate([nodes(split, step_s), split + nodes(*toe)[1:]])
        com, inertia = followed(r, t)
        # L is a rate of nothing that is followed: its "value" has no gain
        momentum = Track.of(t, np.zeros_like(t), hermite(grid, r["L"], r["L_rate"], None, t)[0])
        return cls(t, com, momentum, inertia, np.interp(t, grid, r["cop_x"]))

    def toe_steps(self, toe_x: float, toe_s: float | None) -> np.ndarray:
        """(n,) True for steps on the toes: the last ``toe_s`` seconds, or from where the CoP stays at the toe."""
        start = self.t[:-1]
        if toe_s is not None:
            return start >= self.t[-1] - toe_s - 1e-9
        inside = np.flatnonzero(self.cop_x[:-1] < toe_x - COP_AT_TOE_M)  # the last node has no CoP: zero force
        first = inside[-1] + 1 if len(inside) else 0
        return np.arange(len(start)) >= first


@dataclass(frozen=True)
class FlightReference:
    """Flight reference at the nodes."""

    t: np.ndarray
    com: Track  # the parabola (3,)
    inertia: Track
    foot: Track  # sole relative to the CoM (3,)
    L: float
    turn: np.ndarray  # how far trunk and feet shall have rotated about +y [rad]: zero, or a share of the flip's 2 pi

    @classmethod
    def sample(cls, srmp: Any, step_s: float) -> FlightReference:
        """From stage 1's flight."""
        r = checked(srmp, "flight")
        t, grid = nodes(r["t"][-1], step_s), r["t"]
        com, inertia = followed(r, t)
        foot = Track.sample(grid, planar(r["foot_com"]), planar(r["foot_com_rate"]), planar(r["foot_com_accel"]), t)
        lean = np.asarray(getattr(srmp.flight, "lean", np.zeros_like(grid)), float)
        whole = np.round((lean[-1] - lean[0]) / (2 * np.pi)) * 2 * np.pi  # full turns only; leaning is no flip
        turn = whole * (lean - lean[0]) / (lean[-1] - lean[0]) if whole else np.zeros_like(grid)
        return cls(t, com, inertia, foot, float(r["L"][0]), np.interp(t, grid, turn))
