"""A flip's tuck opens in time.

In the air L is constant and the trunk turns at (L - h) / I, where I is the pitch inertia about the
CoM and h what the joints' own rates carry. A robot that took off with a few per cent too much L
arrives a few tenths of a radian off. Time spent tucked is what can still be chosen: 10 ms more of
it turn a flip of 0.5 m by about 0.03 rad.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.control import STEP_S
from jumplab.control.kinematics import LEVEL, Gauge, Motion, pitch_of, rotation
from jumplab.control.playback import between
from jumplab.io.tape import Tape
from jumplab.robot import Robot

# of the flight; before, legs and arms are still folding
FROM_SHARE = 0.4
LATE = 1.36  # power that puts the largest shift at 60 % of the way, where a tuck opens
SOONER_S = 0.09  # the tuck opens at most
LATER_S = 0.03  # it may wait, whatever the tape's speeds
STEEP = 3.97  # slope of the largest shift after its top, times the length of its way
# [1] of the tape's pace that a shift takes at most, once it has grown: it shall not run backwards
FORWARD = 0.95
SHIFT_RATE = 0.5  # [1] seconds of shift per second, five 10 ms corrections per 100 ms
NOTHING = 1e-9  # [rad/s] of a joint at rest
SAMPLES = 32  # of the forecast; 64 change it by less than 1 mrad
BISECTIONS = 9  # of 0.35 s of shifts: to less than a millisecond, 5 mrad
WHOLE_TURN = np.pi  # [rad] a tape that turns by more than half a turn in flight is a flip's


def is_flip(tape: Tape) -> bool:
    """Whether the trunk turns over in the tape's flight."""
    pitch = np.unwrap(pitch_of(tape.q))[tape.takeoff_index :]
    return bool(abs(pitch[-1] - pitch[0]) > WHOLE_TURN)


class Tuck:
    """Shifts the tape in time during the second part of a flip's flight; the joints' path stays as
    planned.

    A tuck that opens sooner is shifted by a sin^2 of a power of time, zero at :data:`FROM_SHARE` of
    the flight and at touchdown. One that opens later waits where it is tightest, and has less time
    to open: how long it may wait is a matter of the tape's speeds. The turn that is left is
    forecast with the planned robot's inertia along the tape, from the measured pitch and angular
    momentum.
    """

    def __init__(self, robot: Robot, tape: Tape):
        gauge = Gauge(robot)
        flight = slice(tape.takeoff_index, None)
        q = tape.q[flight]
        self._t = tape.t[flight]
        self._end = float(tape.t[-1])
        self._from = tape.takeoff_time + FROM_SHARE * (self._end - tape.takeoff_time)
        self._pitch = np.unwrap(pitch_of(q))
        self._landed = rotation(tape.q[-1, 3:7])
        # about the CoM in trunk axes: inertia, and momentum of the joints' rates alone
        level = np.hstack([np.tile(LEVEL, (len(q), 1)), q[:, 7:]])
        rates = tape.v[flight] * (np.arange(robot.model.nv) >= 6)
        rows = [gauge.motion(*row) for row in zip(level, rates, strict=True)]
        self._inertias = np.array([row.inertia for row in rows])
        self._momenta = np.array([row.momentum for row in rows])
        late = self._t >= self._from
        self._tight = float(self._t[late][np.argmin(self._inertias[late, 1, 1])])
        self._later = self._longest_wait(robot, rates[self._t >= self._tight, 6:])
        self._sooner = min(SOONER_S, FORWARD * (self._end - self._from) / STEEP)
        self._size = 0.0
        self._shift = 0.0

    def _longest_wait(self, robot: Robot, rates: np.ndarray) -> float:
        """How long [s] the tuck may wait, and still open within the speed limits of the joints,
        whose ``rates`` (N, nv - 6) are those of the tape.
        """
        faster = robot.limits.speed / np.maximum(np.abs(rates), NOTHING)
        opens = self._end - self._tight
        return max(min(LATER_S, opens / 2), opens * (1 - 1 / max(float(faster.min()), 1.0)))

    def shift(self, step: int, now: Motion, left_s: float) -> tuple[float, float]:
        """Time [s] to add to the tape's at ``step``, and its rate [1]; call it once per step,
        ``left_s`` before the touchdown.
        """
        t, left_s = self._clock(step, left_s)
        if left_s > STEP_S:
            seen = pitch_of(now.q)
            turns = round((np.interp(t, self._t, self._pitch) - seen) / (2 * np.pi))
            need = self._pitch[-1] - seen - 2 * np.pi * turns
            want = self._best(t, left_s, now.momentum[1], need)
            # which moves nothing yet
            waits = max(want, self._size) <= 0 and t + self._shift <= self._tight
            most = np.inf if waits else SHIFT_RATE * STEP_S
            self._size += float(np.clip(want - self._size, -most, most))
        before = self._shift
        self._shift = float(self._place(self._size, t, t, left_s)) - t
        return self._shift, (self._shift - before) / STEP_S

    def _clock(self, step: int, left_s: float) -> tuple[float, float]:
        """Time [s] at ``step`` and until touchdown; by the tape if the robot will not rise to where
        it should land.
        """
        t = step * STEP_S
        return t, left_s if np.isfinite(left_s) else max(self._end - t, STEP_S)

    def turn_ahead(self, step: int, now: Motion, left_s: float) -> np.ndarray:
        """How far (3, 3) the trunk will be turned off its planned attitude at touchdown, about all
        axes, in ``left_s``.

        As :meth:`shift`, which comes first, but of the whole attitude: it turns by I^-1 (L - h) in
        its own axes, with the L that is measured, and I and h of the planned robot along the
        shifted tape.
        """
        attitude = rotation(now.q[3:7])
        t, left_s = self._clock(step, left_s)
        if left_s > STEP_S:
            middle, pace, dt = self._pieces(self._size, t, left_s)
            rows = np.interp(middle, self._t, np.arange(len(self._t)))
            for row, faster in zip(rows, pace, strict=True):
                inertia = between(self._inertias, row)
                carried = faster * between(self._momenta, row)
                halfway = attitude
                for part in (dt / 2, dt):
                    spin = np.linalg.solve(inertia, halfway.T @ now.momentum - carried)
                    halfway = attitude @ pin.exp3(spin * part)
                attitude = halfway
        return attitude @ self._landed.T

    def _best(self, t: float, left_s: float, momentum: float, need: float) -> float:
        """The shift with which the trunk turns by ``need`` [rad], or the nearest one."""
        low = -self._later
        high = self._sooner
        way = np.sign(self._left(low, t, left_s, momentum) - self._left(high, t, left_s, momentum))
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            if way * (self._left(middle, t, left_s, momentum) - need) > 0:
                low = middle
            else:
                high = middle
        return (low + high) / 2

    def _place(self, size: float, t, now: float, left_s: float):
        """Time on the tape at real times ``t``: the rest of it in the time that is left, shifted or
        held up.
        """
        due = now + left_s
        share = np.clip((t - self._from) / max(due - self._from, STEP_S), 0.0, 1.0)
        at = t + share * (self._end - due)
        if size >= 0:
            return np.minimum(at + size * np.sin(np.pi * share**LATE) ** 2, self._end)
        opens = self._end - self._tight
        held = self._end - opens / (opens + size) * (self._end - at)
        return np.where(at > self._tight, np.clip(held, self._tight, self._end), at)

    def _left(self, size: float, t: float, left_s: float, momentum: float) -> float:
        """Turn of the trunk [rad] until touchdown, if the shift is ``size`` from now on."""
        middle, pace, dt = self._pieces(size, t, left_s)
        inertia = np.interp(middle, self._t, self._inertias[:, 1, 1])
        carried = np.interp(middle, self._t, self._momenta[:, 1]) * pace
        return float(np.sum((momentum - carried) / inertia) * dt)

    def _pieces(self, size: float, t: float, left_s: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Places on the tape (:data:`SAMPLES`,) until touchdown [s], the pace there [1], and their
        distance [s].
        """
        place = self._place(size, t + left_s * np.linspace(0, 1, SAMPLES + 1), t, left_s)
        dt = left_s / SAMPLES
        return (place[1:] + place[:-1]) / 2, np.diff(place) / dt, dt
