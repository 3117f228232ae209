"""Optional correction in flight: legs are put where they can catch the robot.

A shove, or a robot unlike its plan, leaves speed, momentum and attitude other than planned, about
all axes. A flying robot can no longer change the first two; where the soles meet the ground it
still can. Legs that swing forward turn the trunk forward, and arms that swing back hold it: where
the trunk will be far off its plan, both are reckoned with.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.control import STEP_S
from jumplab.control.kinematics import Gauge, Motion, about_vertical, turned, yaw_of
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.contact import on_feet
from jumplab.robot.legs import leg_columns, size
from jumplab.robot.stance import knees

START_S = 0.12  # before touchdown; earlier, the correction fights the swing itself
# [rad/s] 0.8 rad within the last 0.2 m at 3 m/s, two thirds of the speed limit of the hip
RATE = 12.0
LARGEST_RAD = 0.8  # beyond 45 degrees the planned landing posture is lost anyway
FASTEST_FALL = 1.0  # [m/s] below it the foothold says little about the moment
# [s], [rad/s] yaw and roll joints swing nothing, and move legs that are heavy
SIDE_START_S = 0.20
SIDE_RATE = 8.0
# [s] in flips, a correction aims at a touchdown that is at least so far ahead, or noise would
# shake the legs
LEAST_S = 0.04
NEWTON_STEPS = 3  # twelve equations, nearly linear
# of a sole's miss: forward, sideways, up [1/m], turned about these axes [1/rad]; a sole off the
# level tips, a leg can hardly go inwards, and no landing hangs on where a foot points
WEIGHTS = np.array([1.0, 0.3, 1.0, 2.0, 2.0, 0.1])
DAMPING = 1e-3  # [1] of the angles' squares: a leg that is nearly straight must not flap
LEAST_KNEE_RAD = 0.4  # [rad] a knee keeps this bend, to give way
# forecast of the trunk in roll or pitch, forward; robots of the usual ranges stay below 0.08
FAR_RAD = 0.15
# a trunk far forward leaves the legs too short for all of it
FAR_WEIGHTS = WEIGHTS * [1.0, 1.0, 0.5, 1.0, 1.0, 1.0]
TRUNK_WEIGHT = 1.0  # [1/rad] on the trunk's pitch at touchdown, which the arms alone shall mend
STOP_RAD = 0.02  # a joint is not asked nearer to its stop, unless the plan goes there


class Reaim:
    """Turns the legs' joints so that the soles meet the ground flat, and where they can catch the
    robot.

    That is where the angular momentum about the middle of the soles is the planned one, about both
    level axes,

        (L + m r x v)_xy   with r from there to the CoM,

    since an impact under the soles does not change it, and what is left of it afterwards tips the
    robot over. With the fall v_z known it says how far the soles are ahead of the CoM and to its
    left. The leg on that side goes twice as far as the middle must, the other one stays: hips turn
    outwards, hardly inwards. All this is seen along the heading of the robot, not of the plan: the
    feet point where the trunk does.

    The posture at touchdown is predicted as the tape's last one, with the trunk off its planned
    attitude as :meth:`.Flight.turn_ahead` says. Without any error the correction is zero.

    Once it will be off by :data:`FAR_RAD`, the shoulders swing as well unless ``legs_alone``, so
    that it arrives upright, and what the trunk turns while legs and arms are on their way is part
    of the prediction: with all momentum kept, joints that move by x turn the body by -I^-1 A x, A
    being their part of the centroidal momentum matrix.

    ``tape`` is seen along the heading in which the robot shall land, and so is all that is told
    later.
    """

    def __init__(self, robot: Robot, tape: Tape, legs_alone: bool = False):
        self._gauge = Gauge(robot)
        large = size(robot)
        self._slowest = large.of(FASTEST_FALL, "m/s")
        self._legs_alone = legs_alone
        self._anchors = on_feet(robot, robot.foot.center)
        names = robot.joint_names
        self._end = tape.q[-1].copy()
        self._legs = np.sort(np.concatenate(leg_columns(robot))) - 6
        self._pitching = np.isin(names, [name for name, _, _ in robot.role_signs()])
        self._is_arm = np.isin(names, robot.joints["shoulder_pitch"])
        self._start_s = large.of(np.where(self._pitching, START_S, SIDE_START_S), "s")
        self._most = STEP_S * large.of(np.where(self._pitching, RATE, SIDE_RATE), "rad/s")
        self._least_s = large.of(LEAST_S, "s")
        self._limbs = np.concatenate([self._legs, np.flatnonzero(self._is_arm)])
        self._low, self._high = self._range(robot)
        self._far = False
        end = self._gauge.motion(tape.q[-1], tape.v[-1])
        self._attitudes = [foot.rotation for foot in self._gauge.places(self._end)]
        # of the soles' middles, from the CoM
        self._places = self._gauge.points(self._end, robot.foot.center) - end.com
        self._middle = self._places.mean(axis=0)
        tipping = end.momentum / robot.total_mass - np.cross(self._middle, end.velocity)
        self._tipping = tipping[:2]
        self._now, self._rate = np.zeros((2, len(names)))

    def _range(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest angles (nv - 6,) of the joints at touchdown; as planned is allowed."""
        motors = robot.limits
        low = motors.lower + STOP_RAD
        high = motors.upper - STOP_RAD
        for knee, sign, straight in knees(robot):  # flexion = sign * angle + straight
            (low if sign > 0 else high)[knee] = sign * (LEAST_KNEE_RAD - straight)
        planned = self._end[7:]
        most = np.where(self._is_arm, np.inf, LARGEST_RAD)
        return (
            np.maximum(np.minimum(low, planned), planned - most),
            np.minimum(np.maximum(high, planned), planned + most),
        )

    def correction(self, now: Motion, turn: np.ndarray, left_s: float) -> np.ndarray:
        """Angles, rates and accelerations (3, nv - 6) to add to the tape's; call it once per step.

        ``turn`` (3, 3) is the trunk's attitude at touchdown, in ``left_s``, times that of the plan
        transposed. In a flip, whose legs are still opening, the correction comes to rest at what
        :meth:`touchdown` asks for by the cubic way that is left: drives that are sent angles alone
        lag behind by some centimetres of sole. Otherwise angles alone move, by :data:`RATE` at
        most: shoved robots whose arms arrive by such a way swing them too far, and fall.
        """
        tilt = pin.log3(turn)[:2]
        ahead = tilt[1] > 0 and np.abs(tilt).max() > FAR_RAD
        self._far |= bool(ahead and not self._legs_alone)
        moving = (left_s < self._start_s) | (self._is_arm & self._far)
        gained = np.zeros(len(moving))
        if np.any(moving):
            way = np.where(moving, self.touchdown(now, turn, left_s)[0] - self._now, 0.0)
            step = np.clip(way, -self._most, self._most)
            if self._legs_alone:
                lasts_s = max(left_s, self._least_s)
                gained = 6 * way / lasts_s**2 - 4 * self._rate / lasts_s
                self._rate = self._rate + STEP_S * gained
                step = STEP_S * self._rate
            self._now = self._now + step
        return np.stack([self._now, self._rate, gained])

    def touchdown(
        self, now: Motion, turn: np.ndarray, left_s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The correction (nv - 6,) with which the soles come down flat and well placed, and how far
        (3, 3) the body will be turned off the plan with it, where it would be by ``turn`` (3, 3).
        """
        fall = self._gauge.robot.gravity * left_s - now.velocity[2] if left_s < np.inf else 0.0
        back = about_vertical(-yaw_of(turn))  # seen along the robot's heading
        shifts = self._shifts(back @ now.velocity, back @ now.momentum, max(fall, self._slowest))
        correction, level = self._reached(self._places + shifts, back @ turn)
        return correction, back.T @ level

    def _shifts(self, speed: np.ndarray, momentum: np.ndarray, fall: float) -> np.ndarray:
        """Shifts (2, 3) of the soles from their planned places under the CoM [m] that are needed at
        the speed downwards ``fall`` [m/s] at touchdown.
        """
        roll, pitch = momentum[:2] / self._gauge.robot.total_mass - self._tipping
        down = self._middle[2]
        ahead = (pitch - down * speed[0]) / fall - self._middle[0]
        left = (-roll - down * speed[1]) / fall - self._middle[1]
        outer = (self._places[:, 1] - self._middle[1]) * left > 0
        return np.stack([np.full(2, ahead), np.where(outer, 2 * left, 0.0), np.zeros(2)], axis=1)

    def _reached(self, goals: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Correction (nv - 6,) that leads the soles to ``goals`` (2, 3) from the CoM, flat as
        planned, and the body's turn (3, 3) off the plan that is left with it.

        ``level`` (3, 3) is that turn if no joint goes further off the tape than it is. Arms that
        swing, and then legs too, turn the body on their way.
        """
        guess = turned(self._end, level)
        if self._far:
            guess[7:] += self._now
        joints = self._limbs if self._far else self._legs
        weights = np.tile(FAR_WEIGHTS if self._far else WEIGHTS, 2)
        for _ in range(NEWTON_STEPS):
            turns = self._turns(guess, joints)
            slope, miss = self._slope(guess, goals, joints, turns)
            upright = TRUNK_WEIGHT * np.where(self._is_arm[joints], turns[1], 0.0)
            slope = np.vstack([weights[:, None] * slope, upright])
            miss = np.append(weights * miss, -TRUNK_WEIGHT * pin.log3(level)[1])
            now = guess[7 + joints]
            step = least_within(slope, miss, self._low[joints] - now, self._high[joints] - now)
            guess[7 + joints] += step
            more = pin.exp3(turns @ step)
            guess = turned(guess, more)
            level = more @ level
        return guess[7:] - self._end[7:], level  # zero but for the limbs

    def _turns(self, q: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Turn (3, k) of the body per angle of the ``joints`` (k,); zero unless its arms swing."""
        if not self._far:
            return np.zeros((3, len(joints)))
        data = self._gauge.data
        self._gauge.motion(q, np.zeros(self._gauge.model.nv))
        return -np.linalg.solve(data.Ig.inertia, data.Ag[3:, 6 + joints])

    def _slope(
        self, q: np.ndarray, goals: np.ndarray, joints: np.ndarray, turns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Motions (12, k) of the soles under the CoM per joint, and what is missing (12,)."""
        model = self._gauge.model
        data = self._gauge.data
        pin.computeJointJacobians(model, data, q)
        com = pin.jacobianCenterOfMass(model, data, q)[:, 6 + joints]
        slopes = []
        misses = []
        for anchor, planned, goal in zip(self._anchors, self._attitudes, goals, strict=True):
            sole = anchor.place(data)
            arm = sole.translation - data.com[0]
            foot = anchor.slope(model, data)
            turning = np.vstack([-pin.skew(arm) @ turns - com, turns])
            slopes.append(foot[:, 6 + joints] + turning)
            misses += [goal - arm, pin.log3(planned @ sole.rotation.T)]
        return np.vstack(slopes), np.concatenate(misses)


def least_within(
    slope: np.ndarray, miss: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Least squares of ``slope`` (m, n) x = ``miss`` (m,) within ``low`` <= x <= ``high`` (n,);
    what meets a bound stays there.
    """
    x = np.zeros(len(low))
    free = np.ones(len(low), bool)
    while free.any():
        part = slope[:, free]
        right = part.T @ (miss - slope[:, ~free] @ x[~free])
        x[free] = np.linalg.solve(part.T @ part + DAMPING * np.eye(free.sum()), right)
        beyond = free & ((x < low) | (x > high))
        if not beyond.any():
            break
        x = np.clip(x, low, high)
        free = free & ~beyond
    return x
