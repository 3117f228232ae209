"""Optional correction in flight: legs are put where they can catch the robot, a flip's tuck closes and opens in time.

A shove, or a robot unlike its plan, leaves speed, momentum and attitude other than planned, about all axes. What flies
can no longer change the first two; where the soles meet the ground it still can. Legs that swing forward turn the trunk
forward, and arms that swing back hold it: where the trunk will be far off its plan, both are reckoned with.

In the air L is constant and the trunk turns at (L - h) / I, where I is the pitch inertia about the CoM and h what the
joints' own rates carry. A robot that took off with a few per cent too much L arrives a few tenths of a radian off.
Time spent tucked is what can still be chosen: 10 ms more of it turn a flip of 0.5 m by about 0.03 rad.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.stance import knees
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, pitch_of, planned_pitch, rotation, solved, turned, yaw_of
from jumplab.sim.playback import Actuators
from jumplab.sim.scene import Scene

# The paper prints none of these numbers.
START_HEIGHT_M = 0.30  # soles this far above the ground; earlier, the correction fights the swing itself
RATE = 12.0  # [rad/s] 0.8 rad within the last 0.2 m at 3 m/s, two thirds of the speed limit of the hip
FLIP_START_S, FLIP_RATE = 0.12, 4.0  # [s], [rad/s] a flip's legs open at their limits: sooner, and more gently
LARGEST_RAD = 0.8  # beyond 45 degrees the planned landing posture is lost anyway
FASTEST_FALL = 1.0  # [m/s] below it the foothold says little about the moment
SIDE_START_S, SIDE_RATE = 0.20, 8.0  # [s], [rad/s] yaw and roll joints swing nothing, and move legs that are heavy
NEWTON_STEPS = 3  # twelve equations, nearly linear
# of a sole's miss: forward, sideways, up [1/m], turned about these axes [1/rad]; a sole off the level tips, a leg can
# hardly go inwards, and no landing hangs on where a foot points
WEIGHTS = np.array([1.0, 0.3, 1.0, 2.0, 2.0, 0.1])
DAMPING = 1e-3  # [1] of the angles' squares: a leg that is nearly straight must not flap
LEAST_KNEE_RAD = 0.4  # [rad] a knee keeps this bend, to give way
FAR_RAD = 0.15  # forecast of the trunk in roll or pitch, forward; robots of the usual ranges stay below 0.08
FAR_WEIGHTS = WEIGHTS * [1.0, 1.0, 0.5, 1.0, 1.0, 1.0]  # a trunk far forward leaves the legs too short for all of it
TRUNK_WEIGHT = 1.0  # [1/rad] on the trunk's pitch at touchdown, which the arms alone shall mend
ARM_RATE = 12.0  # [rad/s] below the speed limit of the shoulders
STOP_RAD = 0.02  # a joint is not asked nearer to its stop, unless the plan goes there

FROM_SHARE = 0.4  # of the flight; before, legs and arms are still folding, which can be hastened but not undone
LATE = 1.36  # power that puts the largest shift at 60 % of the way, where a tuck opens
SOONER_S = 0.09  # the tuck opens at most
LATER_S = 0.03  # it may wait, whatever the tape's speeds
WAIT_SHARE = 0.6  # of the longest wait; the rest is kept for early forecasts, which are wrong by 0.2 rad
STEEP = 3.97  # slope of the largest shift after its top, times the length of its way
FORWARD = 0.95  # [1] of the tape's pace that a shift takes at most, once it has grown: it shall not run backwards
SHIFT_RATE = 0.5  # [1] seconds of shift per second, five 10 ms corrections per 100 ms
NOTHING = 1e-9  # [rad/s] of a joint at rest
SAMPLES = 32  # of the forecast; 64 change it by less than 1 mrad
BISECTIONS = 9  # of 0.35 s of shifts: to less than a millisecond, 5 mrad
WHOLE_TURN = np.pi  # [rad] a tape that turns by more than half a turn in flight is a flip's


def is_flip(tape: Tape) -> bool:
    """Whether the trunk turns over in the tape's flight."""
    pitch = planned_pitch(tape.q)[tape.takeoff_index :]
    return bool(abs(pitch[-1] - pitch[0]) > WHOLE_TURN)


class Reaim:
    """Turns the legs' joints so that the soles meet the ground flat, and where they can catch the robot.

    That is where the angular momentum about the middle of the soles is the planned one, about both level axes,

        (L + m r x v)_xy   with r from there to the CoM,

    since an impact under the soles does not change it, and what is left of it afterwards tips the robot over. With the
    fall v_z known it says how far the soles are ahead of the CoM and to its left. The leg on that side goes twice as
    far as the middle must, the other one stays: hips turn outwards, hardly inwards. All this is seen along the heading
    of the robot, not of the plan: the feet point where the trunk does.

    The posture at touchdown is predicted as the tape's last one, with the trunk off its planned attitude by what it is
    now and by what it drifts until then, see :meth:`turn_ahead`, and of a flip :meth:`Tuck.turn_ahead`. Without any
    error the correction is zero.

    Once it will be off by :data:`FAR_RAD`, the shoulders swing as well, so that it arrives upright, and what the trunk
    turns while legs and arms are on their way is part of the prediction: with all momentum kept, joints that move by x
    turn the body by -I^-1 A x, A being their part of the centroidal momentum matrix.

    ``tape`` and ``scene`` are seen along the heading in which the robot shall land, and so is all that is told later.
    """

    def __init__(self, robot: Robot, tape: Tape, scene: Scene):
        self._gauge, self._scene, self._mass = Gauge(robot), scene, robot.total_mass
        model, motors, self._end = robot.model, Actuators(robot), tape.q[-1].copy()
        moving = {joint for frame in self._gauge.frames for joint in model.supports[model.frames[frame].parentJoint]}
        self._legs = np.array(sorted(model.joints[joint].idx_v for joint in moving if joint > 1)) - 6
        self._pitching = np.isin(robot.joint_names, [name for name, _, _ in robot.role_signs()])
        arms = np.array([robot.joint_names.index(name) for name in robot.joints["shoulder_pitch"]])
        self._limbs, self._is_arm = np.concatenate([self._legs, arms]), np.isin(np.arange(len(motors.lower)), arms)
        self._far = False
        planned, low, high = self._end[7:], motors.lower + STOP_RAD, motors.upper - STOP_RAD
        for knee, sign, straight in knees(robot):  # flexion = sign * angle + straight
            (low if sign > 0 else high)[knee] = sign * (LEAST_KNEE_RAD - straight)
        most = np.where(self._is_arm, np.inf, LARGEST_RAD)
        self._low = np.maximum(np.minimum(low, planned), planned - most)
        self._high = np.minimum(np.maximum(high, planned), planned + most)
        self._places, self._attitudes = self._feet(self._end)
        self._middle = self._places.mean(axis=0)
        speed, self._momentum = self._motion(tape.q[-1], tape.v[-1])
        self._inertia = self._gauge.data.Ig.inertia.copy()
        self._tipping = (self._momentum / self._mass - np.cross(self._middle, speed))[:2]
        self._now = np.zeros(len(robot.joint_names))

    def _motion(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """CoM velocity (3,), and angular momentum (3,) about the CoM."""
        data = self._gauge.data
        pin.ccrba(self._gauge.model, data, q, v)
        return data.hg.linear / self._mass, data.hg.angular.copy()

    def _feet(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middles of the soles (2, 3) from the CoM [m], and their attitudes (2, 3, 3)."""
        com, feet = self._gauge.com(q), self._gauge.places(q)
        middles = [foot.act(self._gauge.robot.foot.center) - com for foot in feet]
        return np.array(middles), np.array([foot.rotation for foot in feet])

    def turn_ahead(self, q: np.ndarray, v: np.ndarray, turn: np.ndarray, left_s: float) -> np.ndarray:
        """How far (3, 3) the body will be turned off the plan in ``left_s``, if it is by ``turn`` (3, 3) now.

        With inertia I and angular momentum L_p of the plan, and the joints as planned, it turns by
        ``turn`` I^-1 (turn^T L - L_p) [rad/s]. That is taken from halfway, with the mean of I now and at touchdown.
        """
        momentum = self._motion(q, v)[1]
        now = turn.T @ self._gauge.data.Ig.inertia @ turn
        rate = turn @ solved(now, turn.T @ momentum - self._momentum)
        halfway = pin.exp3(rate * left_s / 2) @ turn
        rate = halfway @ solved((now + self._inertia) / 2, halfway.T @ momentum - self._momentum)
        return pin.exp3(rate * left_s) @ turn

    def correction(self, q: np.ndarray, v: np.ndarray, turn: np.ndarray, left_s: float, flip: bool) -> np.ndarray:
        """Angles (nv - 6,) to add to the tape [rad]; call it once per step, it moves at :data:`RATE` at most.

        ``turn`` (3, 3) is the trunk's attitude at touchdown, in ``left_s``, times that of the plan transposed.
        """
        middle = self._gauge.soles(q)
        near = middle[2] - self._scene.top_at(middle[0]) < START_HEIGHT_M
        if not flip:
            tilt = pin.log3(turn)[:2]
            self._far |= bool(tilt[1] > 0 and np.abs(tilt).max() > FAR_RAD)
        if flip:
            moving = np.full(len(self._now), near or left_s < FLIP_START_S)
        else:
            moving = np.where(self._pitching, near, near or left_s < SIDE_START_S)
        if self._far:
            moving = moving | self._is_arm
        if moving.any():
            most = np.where(self._pitching, RATE if near else FLIP_RATE, SIDE_RATE) * STEP_S
            if self._far:
                most = np.where(self._is_arm, ARM_RATE * STEP_S, most)
            self._now = self._now + np.where(moving, np.clip(self.wish(q, v, turn) - self._now, -most, most), 0.0)
        return self._now

    def wish(self, q: np.ndarray, v: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Correction (nv - 6,) with which the predicted touchdown has the soles flat and well placed."""
        return self.touchdown(q, v, turn)[0]

    def touchdown(self, q: np.ndarray, v: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The correction (nv - 6,) to wish for, and how far (3, 3) the body will be turned off the plan with it."""
        speed, momentum = self._motion(q, v)
        above = self._gauge.data.com[0][2] + self._middle[2] - self._scene.top_at(self._gauge.soles(q)[0])
        fall = np.sqrt(max(speed[2] ** 2 + 2 * self._gauge.robot.gravity * above, FASTEST_FALL**2))
        own = pin.rpy.rpyToMatrix(0.0, 0.0, -yaw_of(turn))
        goals = self._places + self.shifts(own @ speed, own @ momentum, fall)
        guess = turned(self._end, own @ turn)
        if not self._far:
            return self._reached(guess, goals), turn
        guess[7:] += self._now
        correction, level = self._balanced(guess, goals, own @ turn)
        return correction, own.T @ level

    def shifts(self, speed: np.ndarray, momentum: np.ndarray, fall: float) -> np.ndarray:
        """How far (2, 3) the soles have to be from their planned places under the CoM [m].

        ``speed`` (3,) of the CoM and ``momentum`` (3,) are seen along the robot's heading, ``fall`` is the speed
        downwards at touchdown.
        """
        roll, pitch = momentum[:2] / self._mass - self._tipping
        down = self._middle[2]
        ahead, left = (pitch - down * speed[0]) / fall, (-roll - down * speed[1]) / fall
        shifts = np.zeros((2, 3))
        shifts[:, 0], off = ahead - self._middle[0], left - self._middle[1]
        shifts[:, 1] = np.where((self._places[:, 1] - self._middle[1]) * off > 0, 2 * off, 0.0)
        return shifts

    def _reached(self, guess: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Correction (nv - 6,) that leads the soles of ``guess`` to ``goals`` (2, 3) from the CoM, flat as planned."""
        rows, planned = 7 + self._legs, self._end[7:]
        for _ in range(NEWTON_STEPS):
            slope, miss = self._slope(guess, goals, self._legs, WEIGHTS)
            low, high = self._low[self._legs], self._high[self._legs]
            guess[rows] += _within(slope, miss, low - guess[rows], high - guess[rows])
        return guess[7:] - planned  # zero but for the legs

    def _balanced(self, guess: np.ndarray, goals: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Correction (nv - 6,) as of :meth:`_reached`, of legs and arms that turn the body on their way.

        ``guess`` is the touchdown if no joint went further off the tape than it is, ``level`` (3, 3) the body's turn
        off the plan there; the one that is reached is given back.
        """
        joints, rows, planned = self._limbs, 7 + self._limbs, self._end[7:]
        low, high, arms = self._low[joints], self._high[joints], self._is_arm[joints]
        for _ in range(NEWTON_STEPS):
            pin.ccrba(self._gauge.model, self._gauge.data, guess, np.zeros(self._gauge.model.nv))
            turns = -solved(self._gauge.data.Ig.inertia.copy(), self._gauge.data.Ag[3:, 6 + joints].copy())  # (3, k)
            slope, miss = self._slope(guess, goals, joints, FAR_WEIGHTS, turns)
            slope = np.vstack([slope, TRUNK_WEIGHT * np.where(arms, turns[1], 0.0)])
            miss = np.append(miss, -TRUNK_WEIGHT * pin.log3(level)[1])
            step = _within(slope, miss, low - guess[rows], high - guess[rows])
            guess[rows] += step
            more = pin.exp3(turns @ step)
            guess, level = turned(guess, more), more @ level
        return guess[7:] - planned, level

    def _slope(self, q, goals, joints, weights, turns=None) -> tuple[np.ndarray, np.ndarray]:
        """Weighted motions (12, k) of the soles under the CoM per joint, and what is missing (12,).

        The trunk keeps its attitude, or turns by ``turns`` (3, k) per joint.
        """
        model, data, (places, attitudes) = self._gauge.model, self._gauge.data, self._feet(q)
        pin.computeJointJacobians(model, data, q)
        own, columns = pin.jacobianCenterOfMass(model, data, q)[:, 6:], 6 + joints
        slope, miss = [], []
        for side, frame in enumerate(self._gauge.frames):
            jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, columns]
            jacobian[:3] -= pin.skew(attitudes[side] @ self._gauge.robot.foot.center) @ jacobian[3:] + own[:, joints]
            if turns is not None:
                jacobian += np.vstack([-pin.skew(places[side]) @ turns, turns])
            turn = pin.log3(self._attitudes[side] @ attitudes[side].T)
            slope.append(weights[:, None] * jacobian)
            miss.append(weights * np.concatenate([goals[side] - places[side], turn]))
        return np.vstack(slope), np.concatenate(miss)


def _within(slope: np.ndarray, miss: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Least squares of ``slope`` x = ``miss`` within ``low`` <= x <= ``high``; what meets a bound stays there."""
    x, free = np.zeros(len(low)), np.ones(len(low), bool)
    while free.any():
        part = slope[:, free]
        right = part.T @ (miss - slope[:, ~free] @ x[~free])
        x[free] = np.ravel(solved(part.T @ part + DAMPING * np.eye(free.sum()), right))
        beyond = free & ((x < low) | (x > high))
        if not beyond.any():
            break
        x, free = np.clip(x, low, high), free & ~beyond
    return x


class Tuck:
    """Shifts the tape in time during the second part of a flip's flight; the joints' path stays as planned.

    A tuck that opens sooner is shifted by a sin^2 of a power of time, zero at :data:`FROM_SHARE` of the flight and at
    touchdown. One that opens later waits where it is tightest, and has less time to open: how long it may wait is a
    matter of the tape's speeds. Where more than :data:`WAIT_SHARE` of that is needed it closes sooner as well, from
    where it is widest on, as fast as its joints can; what it has closed stays closed. The turn that is left is forecast
    with the planned robot's inertia along the tape, from the measured pitch and angular momentum.
    """

    def __init__(self, robot: Robot, tape: Tape):
        self._model, self._data = robot.model, robot.model.createData()
        self._start, self._end = tape.takeoff_time, float(tape.t[-1])
        flight = slice(tape.takeoff_index, None)
        self._t, (self._inertias, self._momenta) = tape.t[flight], self._along(tape.q[flight], tape.v[flight])
        self._inertia, self._carried = self._inertias[:, 1, 1], self._momenta[:, 1]
        self._pitch, self._landed = planned_pitch(tape.q[flight]), rotation(tape.q[-1, 3:7])
        late = self._t >= self._start + FROM_SHARE * (self._end - self._start)
        self._tight = float(self._t[late][np.argmin(self._inertia[late])])
        fastest = Actuators(robot).speed / np.maximum(np.abs(tape.v[flight, 6:]), NOTHING)
        self._later = self._latest(fastest)
        self._first = WAIT_SHARE * self._later  # waited, before it closes sooner as well
        self._sooner = min(SOONER_S, FORWARD * (1 - FROM_SHARE) * (self._end - self._start) / STEEP)
        self._reached_s = self._soonest(fastest)
        self._most_gained = float(np.interp(self._tight, self._t, self._t - self._reached_s))
        self._size = self._shift = self._gained = 0.0
        self._turned: float | None = None

    def _along(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inertia (N, 3, 3) about the CoM, and angular momentum (N, 3) of the joints' rates alone, in trunk axes."""
        inertias, momenta = [], []
        for qk, vk in zip(q, v, strict=True):
            level = np.concatenate([np.zeros(6), [1.0], qk[7:]])
            pin.ccrba(self._model, self._data, level, np.concatenate([np.zeros(6), vk[6:]]))
            inertias.append(self._data.Ig.inertia.copy())
            momenta.append(self._data.hg.angular.copy())
        return np.array(inertias), np.array(momenta)

    def _latest(self, fastest: np.ndarray) -> float:
        """How long [s] the tuck may wait, and still open, joints moving ``fastest`` (N, k) times as fast."""
        opens = self._end - self._tight
        pace = float(np.min(fastest[self._t >= self._tight]))
        return max(min(LATER_S, opens / 2), opens * (1 - 1 / max(pace, 1.0)))

    def _soonest(self, fastest: np.ndarray) -> np.ndarray:
        """When [s] (N,) each place on the tape is reached, if the tuck closes ``fastest`` (N, k) times as fast."""
        widest = self._t[np.argmax(np.where(self._t < self._tight, self._inertia, 0.0))]
        closing = (self._t >= widest) & (self._t < self._tight)
        pace = np.where(closing, np.clip(fastest.min(axis=1), 1.0, 1.0 + SHIFT_RATE), 1.0)
        return self._t[0] + np.concatenate([[0.0], np.cumsum(np.diff(self._t) / pace[:-1])])

    def closing(self, step: int, q: np.ndarray, v: np.ndarray, time_left: float) -> tuple[float, float]:
        """As :meth:`shift`, before :data:`FROM_SHARE` of the flight: zero unless the tuck has to close sooner.

        How it opens is not decided here.
        """
        now, time_left = self._clock(step, time_left)
        want = self._best(now, time_left, self._turning(now, q, v))
        self._size = want if want < -self._first else 0.0
        return self._moved(now, time_left)

    def shift(self, step: int, q: np.ndarray, v: np.ndarray, time_left: float) -> tuple[float, float]:
        """Time [s] to add to the tape's at ``step``, and its rate [1]; call it once per step, measured state given."""
        now, time_left = self._clock(step, time_left)
        momentum = self._turning(now, q, v)
        if time_left > STEP_S:
            want = self._best(now, time_left, momentum)
            waits = max(want, self._size) <= 0 and now + self._shift <= self._tight  # which moves nothing yet
            most = np.inf if waits else SHIFT_RATE * STEP_S
            self._size += float(np.clip(want - self._size, -most, most))
        return self._moved(now, time_left)

    def _turning(self, now: float, q: np.ndarray, v: np.ndarray) -> float:
        """Angular momentum about +y [kg m^2/s]; whole turns of the trunk are counted on the way."""
        near = float(np.interp(now, self._t, self._pitch)) if self._turned is None else self._turned
        seen = float(pitch_of(q))
        self._turned = seen + 2 * np.pi * round((near - seen) / (2 * np.pi))
        pin.ccrba(self._model, self._data, q, v)
        return float(self._data.hg.angular[1])

    def _moved(self, now: float, time_left: float) -> tuple[float, float]:
        """The shift [s] that its size gives now, and its rate [1]; what the tuck has closed sooner is kept."""
        before, self._shift = self._shift, float(self._place(self._size, now, now, time_left)) - now
        if now <= self._tight:
            self._gained = max(self._shift - self._due(now, now, time_left)[0] + now, 0.0)
        return self._shift, (self._shift - before) / STEP_S

    def _clock(self, step: int, time_left: float) -> tuple[float, float]:
        """Time [s] at ``step`` and until touchdown; by the tape if the robot will not rise to where it should land."""
        now = step * STEP_S
        return now, time_left if np.isfinite(time_left) else max(self._end - now, STEP_S)

    def turn_ahead(self, step: int, q: np.ndarray, v: np.ndarray, time_left: float) -> np.ndarray:
        """How far (3, 3) the trunk will be turned off its planned attitude at touchdown, about all axes.

        As :meth:`shift`, which comes first, but of the whole attitude: it turns by I^-1 (L - h) in its own axes, with
        the L that is measured, and I and h of the planned robot along the shifted tape.
        """
        attitude, (now, time_left) = rotation(q[3:7]), self._clock(step, time_left)
        if time_left > STEP_S:
            pin.ccrba(self._model, self._data, q, v)
            momentum = self._data.hg.angular.copy()
            middle, pace, dt = self._pieces(self._size, now, time_left)
            at = np.interp(middle, self._t, np.arange(len(self._t)))
            low = np.minimum(at.astype(int), len(self._t) - 2)
            share = at - low
            inertias = self._inertias[low] + share[:, None, None] * (self._inertias[low + 1] - self._inertias[low])
            carried = self._momenta[low] + share[:, None] * (self._momenta[low + 1] - self._momenta[low])
            for inertia, own in zip(inertias, pace[:, None] * carried, strict=True):
                halfway = attitude @ pin.exp3(solved(inertia, attitude.T @ momentum - own) * dt / 2)
                attitude = attitude @ pin.exp3(solved(inertia, halfway.T @ momentum - own) * dt)
        return attitude @ self._landed.T

    def _best(self, now: float, time_left: float, momentum: float) -> float:
        """The shift whose turn ends as planned, or the nearest one."""
        low, high = -self._later - (self._most_gained if now + self._shift < self._tight else 0.0), self._sooner
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
        """Time on the tape at real times ``t``: the rest of it in the time that is left, shifted or held up."""
        at, u = self._due(t, now, time_left)
        lead = min(max(-size - self._first, 0.0), self._most_gained) if now + self._shift < self._tight else 0.0
        wait = min(-size - lead, self._later)
        begun = np.interp(now - STEP_S + self._gained, self._t, self._reached_s)
        furthest = np.interp(begun + t - now + STEP_S, self._reached_s, self._t)
        closed = np.minimum(np.maximum(at + self._gained, np.minimum(at + lead, furthest)), self._tight)
        if size >= 0:
            return np.minimum(np.maximum(closed, at + size * np.sin(np.pi * u**LATE) ** 2), self._end)
        opens = self._end - self._tight
        held = np.maximum(self._tight, self._end - opens / (opens - wait) * (self._end - at))
        return np.where(at > self._tight, np.minimum(held, self._end), np.maximum(closed, at))

    def _due(self, t, now: float, time_left: float) -> tuple[np.ndarray, np.ndarray]:
        """Time on the tape at real times ``t`` without any shift, and the share of the way from :data:`FROM_SHARE`."""
        due = now + time_left
        from_ = self._start + FROM_SHARE * (self._end - self._start)
        u = np.clip((t - from_) / max(due - from_, STEP_S), 0.0, 1.0)
        return t + u * (self._end - due), u

    def _left(self, size: float, now: float, time_left: float, momentum: float) -> float:
        """Turn of the trunk [rad] until touchdown, if the shift is ``size`` from now on."""
        middle, pace, dt = self._pieces(size, now, time_left)
        inertia = np.interp(middle, self._t, self._inertia)
        carried = np.interp(middle, self._t, self._carried) * pace
        return float(np.sum((momentum - carried) / inertia) * dt)

    def _pieces(self, size: float, now: float, time_left: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Places on the tape (:data:`SAMPLES`,) until touchdown [s], the pace there [1], and their distance [s]."""
        place = self._place(size, now + time_left * np.linspace(0, 1, SAMPLES + 1), now, time_left)
        dt = time_left / SAMPLES
        return (place[1:] + place[:-1]) / 2, np.diff(place) / dt, dt
