"""Optional in-flight correction of flips: the tuck opens earlier or later, so that the turn ends where it should.

In the air L is constant and the trunk turns at (L - h) / I, where I is the pitch inertia about the CoM and h what the
joints' own rates carry. A robot that took off with a few per cent too much L, or is a little heavier here or there,
arrives a few tenths of a radian off, in both directions. Time spent tucked is what can still be chosen: every
10 ms more of it turn a flip by about 0.06 rad.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.simulation.reaim import pitch_of
from jumplab.simulation.world import STEP_S
from jumplab.trajectory import Tape

FROM_SHARE = 0.4  # our choice: of the flight; before, legs and arms are still folding at their speed limits
# our choice: how much sooner and how much later the tuck opens at most. Opened later the hips have to hurry: with 45 ms
# they passed their speed limit, where a servo has no torque left to stop them, and the soles came down tilted. Opened
# sooner they have time
SOONER_S, LATER_S = 0.09, 0.03
SHIFT_RATE = 0.5  # [1] our choice: seconds of shift per second, five 10 ms corrections per 100 ms
SAMPLES = 32  # of the forecast; 64 change it by less than 1 mrad
BISECTIONS = 8  # of the range of shifts: to half a millisecond, 3 mrad
WHOLE_TURN = np.pi  # [rad] our choice: a tape that turns by more than half a turn in flight is a flip's


def is_flip(tape: Tape) -> bool:
    """Whether the trunk turns over in the tape's flight."""
    pitch = np.unwrap(2 * np.arctan2(tape.q[:, 4], tape.q[:, 6]))[tape.takeoff_index :]
    return bool(abs(pitch[-1] - pitch[0]) > WHOLE_TURN)


class Tuck:
    """Shifts the tape in time during the second part of a flip's flight; the joints' path stays as planned.

    The shift has the shape of sin^2, zero at :data:`FROM_SHARE` of the flight and at touchdown. The turn that is left
    is forecast with the planned robot's inertia along the tape, from the measured pitch and angular momentum.

    Attributes
    ----------
    miss : forecast trunk pitch at touchdown, less the planned one [rad]; whole turns counted.
    """

    def __init__(self, robot: Robot, tape: Tape):
        self._model, self._data = robot.model, robot.model.createData()
        self._start, self._end = tape.takeoff_time, float(tape.t[-1])
        flight = slice(tape.takeoff_index, None)
        self._t = tape.t[flight]
        self._inertia, self._carried = self._along(tape.q[flight], tape.v[flight])
        self._pitch = np.unwrap(2 * np.arctan2(tape.q[flight, 4], tape.q[flight, 6]))
        self._size = self._shift = self._speed = 0.0
        self._turned: float | None = None
        self.miss = 0.0

    def _along(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pitch inertia (N,) about the CoM, and angular momentum (N,) of the joints' rates alone."""
        rows = []
        for qk, vk in zip(q, v, strict=True):
            pin.ccrba(self._model, self._data, qk, np.concatenate([np.zeros(6), vk[6:]]))
            rows.append((self._data.Ig.inertia[1, 1], self._data.hg.angular[1]))
        return tuple(np.array(rows).T)

    def shift(self, step: int, q: np.ndarray, v: np.ndarray, time_left: float) -> tuple[float, float]:
        """Time [s] to add to the tape's at ``step``, and its rate [1]; call it once per step, measured state given."""
        now = step * STEP_S
        self._look(now, q)
        pin.ccrba(self._model, self._data, q, v)
        momentum = float(self._data.hg.angular[1])
        if time_left > STEP_S:
            want = self._best(now, time_left, momentum)
            most = SHIFT_RATE * STEP_S
            self._size += float(np.clip(want - self._size, -most, most))
            self.miss = self._turned + self._left(self._size, now, time_left, momentum) - self._pitch[-1]
        before = self._shift
        self._shift = float(self._place(self._size, now, now, time_left)) - now
        self._speed = (self._shift - before) / STEP_S
        return self._shift, self._speed

    def _look(self, now: float, q: np.ndarray) -> None:
        """Count the turns of the measured pitch."""
        near = float(np.interp(now, self._t, self._pitch)) if self._turned is None else self._turned
        seen = pitch_of(q)
        self._turned = seen + 2 * np.pi * round((near - seen) / (2 * np.pi))

    def _best(self, now: float, time_left: float, momentum: float) -> float:
        """The shift whose turn ends as planned, or the nearest one."""
        low, high = -LATER_S, SOONER_S
        need = self._pitch[-1] - self._turned
        way = np.sign(self._left(low, now, time_left, momentum) - self._left(high, now, time_left, momentum))
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            if way * (self._left(middle, now, time_left, momentum) - need) > 0:
                low = middle
            else:
                high = middle
        return (low + high) / 2

    def _place(self, size: float, t, now: float, time_left: float):
        """Time on the tape at real times ``t``: the rest of it in the time that is left, shifted by a bump."""
        due = now + time_left
        from_ = self._start + FROM_SHARE * (self._end - self._start)
        u = np.clip((t - from_) / max(due - from_, STEP_S), 0.0, 1.0)
        return np.minimum(t + u * (self._end - due) + size * np.sin(np.pi * u) ** 2, self._end)

    def _left(self, size: float, now: float, time_left: float, momentum: float) -> float:
        """Turn of the trunk [rad] until touchdown, if the shift is ``size`` from now on."""
        edges = now + time_left * np.linspace(0, 1, SAMPLES + 1)
        place = self._place(size, edges, now, time_left)
        middle, dt = (place[1:] + place[:-1]) / 2, time_left / SAMPLES
        pace = np.diff(place) / dt
        inertia = np.interp(middle, self._t, self._inertia)
        carried = np.interp(middle, self._t, self._carried) * pace
        return float(np.sum((momentum - carried) / inertia) * dt)
