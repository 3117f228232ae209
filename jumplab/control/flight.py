"""A flight to its end: when, where and how turned the robot will touch down. And the tuck of a
flip, which opens in time.

In the air L is constant and the trunk turns at (L - h) / I, where I is the pitch inertia about the
CoM and h what the joints' own rates carry. A robot that took off with a few per cent too much L
arrives a few tenths of a radian off. Time spent tucked is what can still be chosen: 10 ms more of
it turn a flip of 0.5 m by about 0.03 rad.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from jumplab.control import STEP_S
from jumplab.control.kinematics import (
    LEVEL,
    Gauge,
    Motion,
    about_vertical,
    pitch_of,
    rotation,
    turned,
    yaw_of,
)
from jumplab.control.playback import Command, between
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.legs import size

# of the flight; before, legs and arms are still folding, and a graze of the ground is no landing
FROM_SHARE = 0.4
LATE = 1.36  # power that puts the largest shift at 60 % of the way, where a tuck opens
SOONER_S = 0.09  # the tuck opens at most
LATER_S = 0.03  # it may wait, whatever the tape's speeds
STEEP = 3.97  # slope of the largest shift after its top, times the length of its way
# [1] of the tape's pace that a shift takes at most, once it has grown: it shall not run backwards
FORWARD = 0.95
# [s] before the ground a shift stays as it is: it turns nothing any more, and shakes the legs. Of
# 40 perturbed backflips of a G1 33 stand, 30 without
LAST_S = 0.06
SHIFT_RATE = 0.5  # [1] seconds of shift per second, five 10 ms corrections per 100 ms
PROBE_S = 0.005  # over which the pace of a shifted tape is measured
NOTHING = 1e-9  # [1] of a joint's speed or torque, at rest
# [1] of the torque in a tuck that opens as late as it may; robots unlike their model need more
REACH = 0.85
SAMPLES = 32  # of the forecast; 64 change it by less than 1 mrad
TURNS = 12  # of that about all axes
BISECTIONS = 9  # of 0.35 s of shifts: to less than a millisecond, 5 mrad
WHOLE_TURN = np.pi  # [rad] a tape that turns by more than half a turn in flight is a flip's


def is_flip(tape: Tape) -> bool:
    """Whether the trunk turns over in the tape's last flight."""
    if not tape.flights:
        return False
    pitch = np.unwrap(pitch_of(tape.q[tape.flights[-1]]))
    return bool(abs(pitch[-1] - pitch[0]) > WHOLE_TURN)


class Flight:
    """The rest of a measured flight, by the planned robot's inertia along the rest of the tape,
    which ends with that flight.

    The tape's last row is the posture to land in; ``ground`` is the height [m] at a place [m] along
    the heading in which all this is seen. ``from_s`` is the time from which on anything is
    foreseen.

    A flip's tape can be shifted in time during the second part of the flight; the joints' path
    stays as planned. A tuck that opens sooner is shifted by a sin^2 of a power of time, zero at
    :data:`FROM_SHARE` of the flight and at touchdown. One that opens later waits where it is
    tightest, and has less time to open: how long it may wait is a matter of the tape's speeds.

    Attributes
    ----------
    end_s, tight_s : time on the tape at touchdown, and where the tuck is tightest [s].
    sooner_s, later_s : how much sooner the tuck may open, and how long it may wait [s].
    """

    def __init__(self, robot: Robot, tape: Tape, ground: Callable[[float], float]):
        self._gauge = gauge = Gauge(robot)
        self._gravity = robot.gravity
        self._motors = robot.limits
        self._ground = ground
        self._q = tape.q[-1].copy()
        self._v = tape.v[-1].copy()
        self._ahead, _, self._below = (gauge.soles(self._q) - gauge.com(self._q)).tolist()
        flight = tape.flights[-1]
        q = tape.q[flight]
        self._t = tape.t[flight]
        self.end_s = float(tape.t[-1])
        self.from_s = float(self._t[0] + FROM_SHARE * (self.end_s - self._t[0]))
        self._pitch = np.unwrap(pitch_of(q))
        # about the CoM in trunk axes: inertia, and momentum of the joints' rates alone
        level = np.hstack([np.tile(LEVEL, (len(q), 1)), q[:, 7:]])
        rates = tape.v[flight] * (np.arange(robot.model.nv) >= 6)
        _, _, _, self._momenta, self._inertias = gauge.motions(level, rates)
        late = self._t >= self.from_s
        self.tight_s = float(self._t[late][np.argmin(self._inertias[late, 1, 1])])
        # a tuck that waits shall still open within the speeds and torques of the joints
        after = self._t >= self.tight_s
        motors = robot.limits
        used = np.abs([rates[after, 6:] / motors.speed, tape.tau[flight][after] / motors.effort])
        speed, torque = used.max(axis=(1, 2), initial=NOTHING)
        # torques grow with the square of the pace
        faster = float(min(1 / speed, np.sqrt(REACH / torque)))
        opens = self.end_s - self.tight_s
        self.later_s = max(min(LATER_S, opens / 2), opens * (1 - 1 / max(faster, 1.0)))
        self.sooner_s = min(SOONER_S, FORWARD * (self.end_s - self.from_s) / STEEP)
        self._last_s = size(robot).of(LAST_S, "s")
        self._size = 0.0
        self._shift = 0.0

    def time_left(self, now: Motion) -> float:
        """Time until the soles meet the ground [s] in a flight that is measured ``now``; inf if
        they never do.
        """
        x, _, z = now.com.tolist()
        vx, _, vz = now.velocity.tolist()
        left = 0.0
        for _ in range(2):  # the ground's height depends on where, and so on when
            drop = z + self._below - self._ground(x + vx * left + self._ahead)
            root = vz**2 + 2 * self._gravity * drop
            if root < 0:
                return np.inf
            left = (vz + root**0.5) / self._gravity
        return left

    def state(
        self, now: Motion, turn: np.ndarray, left_s: float, correction: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Configuration (nq,) and velocity (nv,) at touchdown, in ``left_s``.

        The trunk will be off its planned attitude by ``turn`` (3, 3), and ``correction`` (nv - 6,)
        will have been added to the tape by then. All is seen along the heading that the robot will
        have.
        """
        back = about_vertical(-yaw_of(turn))
        end = turned(self._q, back @ turn)
        end[7:] += correction
        rates = self._v.copy()
        # the body turns as fast as its momentum says at the joint rates of the tape, and its CoM
        # flies on
        attitude = rotation(end[3:7])
        tape = self._gauge.motion(end, rates)
        missing = (back @ now.momentum - tape.momentum)[1] / tape.inertia[1, 1]
        rates[3:6] += missing * attitude[1]
        speed = back @ now.velocity - [0.0, 0.0, self._gravity * left_s]
        rates[:3] += attitude.T @ (speed - self._gauge.motion(end, rates).velocity)
        return end, rates

    def shift(self, step: int, now: Motion, left_s: float) -> tuple[float, float, float]:
        """Time [s] to add to the tape's at ``step``, its rate [1] and how fast that grows [1/s];
        call it once per step, ``left_s`` before the touchdown.

        Rates are those of the shift as it is: differences from step to step would have the noise
        of ``left_s``. Where a tuck waits, its pace jumps while the joints are nearly at rest.
        """
        t, left_s = self._clock(step, left_s)
        if left_s > self._last_s:
            seen = pitch_of(now.q)
            turns = round((np.interp(t, self._t, self._pitch) - seen) / (2 * np.pi))
            need = self._pitch[-1] - seen - 2 * np.pi * turns
            want = self._best(t, left_s, now.momentum[1], need)
            # which moves nothing yet
            waits = max(want, self._size) <= 0 and t + self._shift <= self.tight_s
            most = np.inf if waits else SHIFT_RATE * STEP_S
            self._size += float(np.clip(want - self._size, -most, most))
        self._shift = float(self.place(self._size, t, t, left_s)) - t
        if left_s <= 0:
            return self._shift, -1.0, 0.0
        times = t + min(0.0, left_s - PROBE_S) + PROBE_S * np.arange(-1, 2)
        before, here, after = self.place(self._size, times, t, left_s)
        gain = (after - 2 * here + before) / PROBE_S**2 if self._size > 0 else 0.0
        return self._shift, (after - before) / (2 * PROBE_S) - 1, gain

    def torque(self, command: Command, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Torques (nv - 6,) with which a free body, whose base is at ``q`` (nq,) and ``v`` (nv,),
        makes the commanded motion [N m]; a shifted tape's own are those of another one.
        """
        model = self._gauge.model
        data = self._gauge.data
        q = np.concatenate([q[:7], command.q])
        v = np.concatenate([v[:6], command.rate])
        mass = pin.crba(model, data, q)
        due = pin.nonLinearEffects(model, data, q, v) + mass[:, 6:] @ command.acceleration
        base = np.linalg.solve(mass[:6, :6], -due[:6])
        return due[6:] + mass[6:, :6] @ base + self._motors.lost(command.rate)

    def _clock(self, step: int, left_s: float) -> tuple[float, float]:
        """Time [s] at ``step`` and until touchdown; by the tape if the robot will not rise to where
        it should land.
        """
        t = step * STEP_S
        return t, left_s if np.isfinite(left_s) else max(self.end_s - t, STEP_S)

    def turn_ahead(self, step: int, now: Motion, left_s: float) -> np.ndarray:
        """Rotation (3, 3) from the trunk's planned attitude at touchdown to the one expected after
        ``left_s``, about all axes; of a shifted tape, :meth:`shift` comes first.

        It turns by I^-1 (L - h) in its own axes, with the L that is measured, and I and h along the
        tape.
        """
        attitude = rotation(now.q[3:7])
        t, left_s = self._clock(step, left_s)
        if left_s > STEP_S:
            middle, pace, dt = self.pieces(self._size, t, left_s, TURNS)
            rows = np.interp(middle, self._t, np.arange(len(self._t)))
            ways = np.linalg.inv([between(self._inertias, row) for row in rows])
            for row, faster, way in zip(rows, pace, ways, strict=True):
                carried = faster * between(self._momenta, row)
                halfway = attitude
                for part in (dt / 2, dt):
                    spin = way @ (now.momentum @ halfway - carried)
                    halfway = attitude @ pin.exp3(spin * part)
                attitude = halfway
        return attitude @ rotation(self._q[3:7]).T

    def _best(self, t: float, left_s: float, momentum: float, need: float) -> float:
        """The shift with which the trunk turns by ``need`` [rad], or the nearest one."""
        ends = [-self.later_s, self.sooner_s]
        first, last = (self.trunk_turn(size, t, left_s, momentum) for size in ends)
        way = np.sign(first - last)
        for _ in range(BISECTIONS):
            middle = sum(ends) / 2
            more = way * (self.trunk_turn(middle, t, left_s, momentum) - need) > 0
            ends[0 if more else 1] = middle
        return sum(ends) / 2

    def place(
        self, size: float, t: float | np.ndarray, now: float, left_s: float
    ) -> float | np.ndarray:
        """Time (...) on the tape at real times ``t`` (...) [s]: the rest of it in the time that is
        left, shifted or held up by ``size`` [s].
        """
        due = now + left_s
        share = np.clip((t - self.from_s) / max(due - self.from_s, STEP_S), 0.0, 1.0)
        at = t + share * (self.end_s - due)
        if size >= 0:
            return np.minimum(at + size * np.sin(np.pi * share**LATE) ** 2, self.end_s)
        opens = self.end_s - self.tight_s
        held = self.end_s - opens / (opens + size) * (self.end_s - at)
        return np.where(at > self.tight_s, np.clip(held, self.tight_s, self.end_s), at)

    def trunk_turn(self, size: float, t: float, left_s: float, momentum: float) -> float:
        """Turn of the trunk [rad] until touchdown, if the shift is ``size`` from now on."""
        middle, pace, dt = self.pieces(size, t, left_s, SAMPLES)
        inertia = np.interp(middle, self._t, self._inertias[:, 1, 1])
        carried = np.interp(middle, self._t, self._momenta[:, 1]) * pace
        return float(np.sum((momentum - carried) / inertia) * dt)

    def pieces(
        self, size: float, t: float, left_s: float, count: int
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Places on the tape (``count``,) until touchdown [s], the pace there [1], and their
        distance [s].
        """
        place = self.place(size, t + left_s * np.linspace(0, 1, count + 1), t, left_s)
        dt = left_s / count
        return (place[1:] + place[:-1]) / 2, np.diff(place) / dt, dt
