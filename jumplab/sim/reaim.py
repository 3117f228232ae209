"""Optional correction in flight: legs are turned against the trunk's pitch error, and a flip's tuck opens in time.

In the air L is constant and the trunk turns at (L - h) / I, where I is the pitch inertia about the CoM and h what the
joints' own rates carry. A robot that took off with a few per cent too much L arrives a few tenths of a radian off.
Time spent tucked is what can still be chosen: 10 ms more of it turn a flip by about 0.06 rad.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, pitch_of, pitched, planned_pitch, solved
from jumplab.sim.scene import Scene

# The paper prints none of these numbers.
START_HEIGHT_M = 0.30  # soles this far above the ground; earlier, the correction fights the swing itself
RATE = 12.0  # [rad/s] 0.8 rad within the last 0.2 m at 3 m/s, two thirds of the speed limit of the hip
FLIP_START_S, FLIP_RATE = 0.12, 4.0  # [s], [rad/s] a flip's legs open at their limits: sooner, and more gently
LARGEST_RAD = 0.8  # beyond 45 degrees the planned landing posture is lost anyway
FASTEST_FALL = 1.0  # [m/s] below it the foothold says little about the moment
NEWTON_STEPS = 2  # two equations, nearly linear
HIP_ANKLE = (0, 2)  # rows of jumplab.robot.SAGITTAL_JOINTS
PROBE_RAD = 1e-4  # of the finite differences

FROM_SHARE = 0.4  # of the flight; before, legs and arms are still folding at their speed limits
SOONER_S, LATER_S = 0.09, 0.03  # the tuck opens at most; opened later, hips have to pass their speed limits
SHIFT_RATE = 0.5  # [1] seconds of shift per second, five 10 ms corrections per 100 ms
SAMPLES = 32  # of the forecast; 64 change it by less than 1 mrad
BISECTIONS = 8  # of the range of shifts: to half a millisecond, 3 mrad
WHOLE_TURN = np.pi  # [rad] a tape that turns by more than half a turn in flight is a flip's


def is_flip(tape: Tape) -> bool:
    """Whether the trunk turns over in the tape's flight."""
    pitch = planned_pitch(tape.q)[tape.takeoff_index :]
    return bool(abs(pitch[-1] - pitch[0]) > WHOLE_TURN)


class Reaim:
    """Turns hips and ankles so that the soles meet the ground flat, and where they can catch the robot.

    That is where the angular momentum about the soles' middle, L + m (z v_x + ahead v_z), is the planned one: an impact
    under the soles does not change it, and what is left of it afterwards tips the robot over.

    The posture at touchdown is predicted as the tape's last one, with the trunk as far off its planned pitch as it is
    now. Without any error the correction is zero.
    """

    def __init__(self, robot: Robot, tape: Tape, scene: Scene):
        self._gauge, self._scene, self._mass = Gauge(robot), scene, robot.total_mass
        sides = [[(robot.joint_names.index(n), s) for n, row, s in robot.role_signs() if row == i] for i in HIP_ANKLE]
        self._rows = [[7 + row for row, _ in side] for side in sides]
        self._signs = [np.array([sign for _, sign in side]) for side in sides]  # left and right may turn opposite ways
        self._end = tape.q[-1].copy()
        ahead, self._tilt, height = self._aim(self._end)
        speed, momentum = self._motion(tape.q[-1], tape.v[-1])
        self._moment = momentum / self._mass + height * speed[0] + ahead * speed[2]
        self._now = np.zeros(len(robot.joint_names))

    def _motion(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, float]:
        """CoM velocity (3,), and angular momentum about the pitch axis."""
        data = self._gauge.data
        pin.ccrba(self._gauge.model, data, q, v)
        return data.hg.linear / self._mass, float(data.hg.angular[1])

    def _aim(self, q: np.ndarray) -> np.ndarray:
        """Middle of the soles ahead of the CoM [m], the soles' pitch [rad], CoM above the soles [m]."""
        com, middle = self._gauge.com(q), self._gauge.soles(q)
        feet = [self._gauge.data.oMf[frame].rotation for frame in self._gauge.frames]
        tilt = np.mean([np.arctan2(-foot[2, 0], foot[2, 2]) for foot in feet])
        return np.array([middle[0] - com[0], tilt, com[2] - middle[2]])

    def correction(self, q: np.ndarray, v: np.ndarray, error: float, opening: float | None = None) -> np.ndarray:
        """Angles (nv - 6,) to add to the tape [rad]; call it once per step, it moves at :data:`RATE` at most.

        ``error`` of the trunk's pitch at touchdown, as now or as forecast [rad], is within half a turn; ``opening`` is,
        in a flip, the time until touchdown [s].
        """
        middle = self._gauge.soles(q)
        near = middle[2] - self._scene.top_at(middle[0]) < START_HEIGHT_M
        if near or (opening is not None and opening < FLIP_START_S):
            most = (RATE if near else FLIP_RATE) * STEP_S
            self._now = self._now + np.clip(self.wish(q, v, error) - self._now, -most, most)
        return self._now

    def wish(self, q: np.ndarray, v: np.ndarray, pitch_error: float) -> np.ndarray:
        """Correction (nv - 6,) with which the predicted touchdown has the soles flat and well placed."""
        speed, momentum = self._motion(q, v)
        com = self._gauge.data.com[0].copy()
        top = self._scene.top_at(self._gauge.soles(q)[0])
        guess = pitched(self._end, pitch_error)
        for _ in range(NEWTON_STEPS):
            here = self._aim(guess)
            fall = np.sqrt(
                max(speed[2] ** 2 + 2 * self._gauge.robot.gravity * (com[2] - here[2] - top), FASTEST_FALL**2)
            )
            goal = np.array([(momentum / self._mass + here[2] * speed[0] - self._moment) / fall, self._tilt])
            slope = np.empty((2, 2))
            for column, (rows, signs) in enumerate(zip(self._rows, self._signs, strict=True)):
                probe = guess.copy()
                probe[rows] += PROBE_RAD * signs
                slope[:, column] = (self._aim(probe) - here)[:2] / PROBE_RAD
            turns = solved(slope, goal - here[:2])
            for rows, signs, angle in zip(self._rows, self._signs, turns, strict=True):
                guess[rows] += angle * signs
        return np.clip(guess[7:] - self._end[7:], -LARGEST_RAD, LARGEST_RAD)  # zero but for hips and ankles


class Tuck:
    """Shifts the tape in time during the second part of a flip's flight; the joints' path stays as planned.

    The shift has the shape of sin^2, zero at :data:`FROM_SHARE` of the flight and at touchdown. The turn that is left
    is forecast with the planned robot's inertia along the tape, from the measured pitch and angular momentum; ``miss``
    is the forecast trunk pitch at touchdown, less the planned one [rad], whole turns counted.
    """

    def __init__(self, robot: Robot, tape: Tape):
        self._model, self._data = robot.model, robot.model.createData()
        self._start, self._end = tape.takeoff_time, float(tape.t[-1])
        flight = slice(tape.takeoff_index, None)
        self._t, (self._inertia, self._carried) = tape.t[flight], self._along(tape.q[flight], tape.v[flight])
        self._pitch = planned_pitch(tape.q[flight])
        self._size = self._shift = 0.0
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
        if not np.isfinite(time_left):  # it will not rise to where it should land: by the clock
            time_left = max(self._end - now, STEP_S)
        near = float(np.interp(now, self._t, self._pitch)) if self._turned is None else self._turned
        seen = float(pitch_of(q))
        self._turned = seen + 2 * np.pi * round((near - seen) / (2 * np.pi))  # whole turns counted
        pin.ccrba(self._model, self._data, q, v)
        momentum = float(self._data.hg.angular[1])
        if time_left > STEP_S:
            want = self._best(now, time_left, momentum)
            most = SHIFT_RATE * STEP_S
            self._size += float(np.clip(want - self._size, -most, most))
            self.miss = self._turned + self._left(self._size, now, time_left, momentum) - self._pitch[-1]
        before, self._shift = self._shift, float(self._place(self._size, now, now, time_left)) - now
        return self._shift, (self._shift - before) / STEP_S

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
