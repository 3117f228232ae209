"""Launch feedback: joints leave the tape a little, so that the body as a whole launches as planned.

A tape that is followed joint by joint moves a robot unlike its plan, or one that is shoved or sinks in, with another
momentum and over another place: its feet tip, and on its toes it falls on like a pendulum. Here, every 2 ms, joint
accelerations and foot wrenches are chosen that obey the base dynamics, friction, the soles' edges and the motors'
torques, and come closest to the planned CoM, its velocity, the angular momentum and the planned joints, with the feet
still. What the joints' accelerations differ by from the tape's is integrated and added to it.

Feet that stand flat tell where the CoM really is: a load that the trunk carries besides pushes them by its mass times
the acceleration of the trunk, and turns them by that push about where it is. Its mass and place are filtered from the
wrenches, and the real CoM is led along the planned one's way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, rotation
from jumplab.sim.landing import (
    NOMINAL_INERTIA,
    PERIOD_STEPS,
    WRENCH_SCALE,
    BodyQp,
    BodyTerms,
    corner_rows,
)
from jumplab.sim.playback import AIR, FLAT, TOE, Command, Playback

# The paper prints none of these numbers: it has no feedback.
FRICTION = 0.6  # more than plans use, less than most floors have
LENGTH_SHARE = 0.95  # of the sole for the CoP
LEAST_LOAD = 0.5  # [1] of the weight; with less on the feet nothing is changed any more
FELT_LOAD = 0.7  # [1] of the weight, with which feet tell where the CoM is ...
STILL_RAD = 0.01  # ... unless they are tilted by so much
ROLLING_S = 0.1  # before the heels rise: the CoP is on its way to the toes, and soles begin to tip
MOST_OFF_M = 0.025  # that the CoM is believed to be off
FADE_SHARE, FADED = 0.4, 5.0  # of the flight, in which what was changed fades; natural times of that, to 4 %
LEAST, LEAST_WRENCH = 1e-8, 1e-4  # weights of base accelerations and of wrenches / 100 N, so that the answer is one
DIGITS = 9  # of accelerations: ProxQP's last ones depend on where its memory lies


@dataclass(frozen=True)
class LaunchGains:
    """Natural frequencies [rad/s] of critically damped wishes, and weights [1 / (m/s^2)^2] or [1 / (rad/s^2)^2]."""

    com_rate: float = 8.0  # twice the pendulum's own: the launch is over within a second
    momentum_rate: float = 10.0
    posture_rate: float = 4.0  # back to the tape, where nothing else is asked
    fade_rate: float = 20.0  # back to the tape in the air, or faster in a short flight: before legs are re-aimed
    com_weight: tuple[float, float, float] = (1.0, 1.0, 3.0)
    momentum_weight: float = 1.0  # of L-rate over a nominal inertia
    foot_weight: float = 1e4
    posture_weight: float = 0.02
    most: float = 40.0  # [rad/s^2] that a joint's acceleration may differ by from the tape's
    # standard deviations. Of the load on the trunk before anything is felt, in shares of the robot's mass: its mass,
    # and that times how far it is ahead of and above the base [m]
    prior: tuple[float, float, float] = (0.1, 0.02, 0.03)
    # of one reading, in which all that moves unlike the model errs too, in shares of the push: push up, and moment [m]
    reading: tuple[float, float] = (0.07, 0.03)


def check_mode(mode: str) -> None:
    """Refuse (:class:`InputError`) a mode of playback in which the launch cannot be corrected."""
    if mode != "position":
        raise InputError(
            f"feedback changes the angles that servos follow, and mode {mode!r} sends torques; choose mode 'position'"
        )


class LaunchFeedback:
    """Changes the commands of one launch; see the module's docstring.

    ``playback`` is in mode "position": in "pd", whose torques pass on what sensors err by, feet begin to rock. ``tape``
    and what is measured are seen in the axes of the start. ``qp`` counts the QPs posed and those without a solution,
    where the joints go back to the tape. ``off_m`` is how far the CoM is believed to be
    ahead of where the robot's model has it [m]. Raises :class:`InputError` in the other mode.
    """

    def __init__(self, robot: Robot, tape: Tape, playback: Playback, gains: LaunchGains = LaunchGains()):
        check_mode(playback.mode)
        self._gains, self._robot, self._playback = gains, robot, playback
        self._terms, self._gauge = BodyTerms(robot, WRENCH_SCALE), Gauge(robot)
        self._weight_n = robot.total_mass * robot.gravity
        self._fade_rate = max(gains.fade_rate, FADED / (FADE_SHARE * float(tape.t[-1] - tape.takeoff_time)))
        self._angles, self._rates, self._changes, self._farthest = np.zeros((4, len(robot.joint_names)))
        self.off_m, self.qp = 0.0, BodyQp(robot, self._terms)
        self._load = np.zeros(3)  # mass on the trunk [kg], and that times its place ahead of and above the base [kg m]
        self._spread = np.diag(np.square(gains.prior)) * robot.total_mass**2
        self._first, self._rows = tape.q[0], self._planned(tape)
        self._spin = self._rows[0, 4]  # rate of L that the last command takes
        half = LENGTH_SHARE * (robot.foot.toe - robot.foot.heel) / 2
        self._corners = {
            stand: corner_rows(robot, FRICTION, length, robot.foot.half_width)
            for stand, length in ((FLAT, half), (TOE, 0.0))
        }

    def _planned(self, tape: Tape) -> np.ndarray:
        """CoM, its velocity and acceleration, L, its rate, and the base's acceleration (steps, 6, 3) of the launch."""
        gauge, rows, last = self._gauge, [], tape.takeoff_index  # the rows before take-off
        model, data, mass = gauge.model, gauge.data, self._robot.total_mass
        for q, v, a, f in zip(tape.q[:last], tape.v[:last], tape.a[:last], tape.f[:last], strict=True):
            base = rotation(q[3:7]) @ (a[:3] + np.cross(v[3:6], v[:3]))
            pin.ccrba(model, data, q, v)
            pin.updateFramePlacements(model, data)
            feet = [data.oMf[frame].translation for frame in gauge.frames]
            push = f[:, :3].sum(axis=0) / mass + model.gravity.linear
            moment = self._moment(feet, data.com[0], f)
            rows.append(np.concatenate([data.com[0], data.hg.linear / mass, push, data.hg.angular, moment, base]))
        grid = np.arange(round(tape.takeoff_time / STEP_S)) * STEP_S
        return np.stack([np.interp(grid, tape.t[:last], c) for c in np.array(rows).T], axis=1).reshape(-1, 6, 3)

    def to_json(self) -> dict:
        """What the settings of a result say."""
        most = float(np.abs(self._farthest).max())
        return {"solves": self.qp.solves, "failures": self.qp.failures, "farthest_rad": most, "com_ahead_m": self.off_m}

    @staticmethod
    def _moment(feet, com: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        """Moment (3,) about ``com`` of wrenches (2, 6) at the origins ``feet`` (2, 3) of the foot links."""
        return sum(w[3:] + np.cross(foot - com, w[:3]) for foot, w in zip(feet, wrench, strict=True))

    def begin(self, q: np.ndarray) -> None:
        """Start from ``q`` (nq,), whose CoM is led back to the plan as :meth:`Playback.approach` leads wrong joints."""
        model, data, (left, rate, acceleration) = self._gauge.model, self._gauge.data, self._playback.way_back()
        moved = pin.computeCentroidalMap(model, data, self._first) @ pin.difference(model, self._first, q)
        com, turned = moved[:3] / self._robot.total_mass, moved[3:]
        ways = (left, com), (rate, com), (acceleration, com), (rate, turned), (acceleration, turned)
        for rows, (share, off) in zip(np.moveaxis(self._rows[:, :5], 1, 0), ways, strict=True):
            rows[: len(share)] += share[:, None] * off

    def __call__(self, step: int, command: Command, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> Command:
        """``command`` of the tape at ``step``, changed; from the measured state, and wrenches (2, 6) on the feet."""
        g, due = self._gains, step + self._playback.lead
        stand = self._playback.stands(due)
        if stand == AIR or due >= len(self._rows):
            self._changes = -(self._fade_rate**2) * self._angles - 2 * self._fade_rate * self._rates
        elif step % PERIOD_STEPS == 0:
            if self._playback.stands(step + round(ROLLING_S / STEP_S)) == FLAT:
                self._feel(q, wrench, self._rows[step])
            if self._rows[due, 2, 2] + self._robot.gravity < LEAST_LOAD * self._robot.gravity:
                self._changes = -2 * g.posture_rate * self._rates
            else:
                self._changes = self._solved(due, stand, *(command.state or (q, v)))
        self._rates = self._rates + STEP_S * self._changes
        self._angles = self._angles + STEP_S * self._rates
        self._farthest = np.maximum(self._farthest, np.abs(self._angles))
        moves = dict(q=command.q + self._angles, rate=command.rate + self._rates)
        return replace(command, **moves, acceleration=command.acceleration + self._changes)

    def _feel(self, q: np.ndarray, wrench: np.ndarray, planned: np.ndarray) -> None:
        """Learn from the feet's wrenches (2, 6) where the CoM is, unless they carry little or are tilted.

        ``planned`` (6, 3) is the row of what is followed now. A load of mass m at p pushes by F = m (a - g), with a the
        base's acceleration, and turns by p x F: linear in m and m p, of which a Kalman filter keeps the mean.
        """
        push, feet = wrench[:, 2].sum(), self._gauge.places(q)
        if push < FELT_LOAD * self._weight_n or max(abs(foot.rotation[2, 0]) for foot in feet) > STILL_RAD:
            return
        com, axes, mass = self._gauge.com(q), rotation(q[3:7]), self._robot.total_mass
        felt = self._moment([foot.translation for foot in feet], com, wrench) - self._spin
        pull = planned[5] - self._gauge.model.gravity.linear
        arms = np.column_stack([q[:3] - com, axes[:, 0], axes[:, 2]])
        sense = np.array([[pull[2], 0.0, 0.0], np.cross(arms, pull, axisa=0)[:, 1]])
        readings = np.array([push - mass * (planned[2, 2] + self._robot.gravity), felt[1]])
        noise = np.diag(np.square(np.multiply(self._gains.reading, push)))
        gain = np.linalg.solve(sense @ self._spread @ sense.T + noise, sense @ self._spread).T
        self._load = self._load + gain @ (readings - sense @ self._load)
        self._spread = self._spread - gain @ sense @ self._spread
        ahead = float(arms[0] @ self._load) / (mass + float(self._load[0]))
        self.off_m = float(np.clip(ahead, -MOST_OFF_M, MOST_OFF_M))

    def _solved(self, due: int, stand: str, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """What the joints' accelerations (nv - 6,) shall differ by from those of the tape's step ``due``."""
        g, body, foot, nv = self._gains, self._terms, self._robot.foot, self._terms.nv
        point = foot.center if stand == FLAT else foot.tip
        body.update(q, v, point)
        body.set_contact(np.ones(2, bool))
        com, speed, push, momentum, spin, _ = self._rows[due]
        off = np.array([self.off_m, 0.0, 0.0])
        beyond = np.cross(off, body.mass * (push - body.gravity))  # moment that the real CoM takes besides
        shift = g.com_rate**2 * (com - off - body.com) + 2 * g.com_rate * (speed - body.com_velocity)
        turn = spin + beyond + g.momentum_rate * (momentum - body.momentum)
        tilting = np.array([1.0, 1.0, 1.0, 1.0, float(stand == FLAT), 1.0])
        rows = np.vstack([body.force_rows, body.momentum_rows / NOMINAL_INERTIA, *body.sole_rows])
        targets = np.concatenate([push + shift - body.gravity, turn / NOMINAL_INERTIA, *-body.sole_drift])
        weights = [g.com_weight, np.full(3, g.momentum_weight), *(g.foot_weight * tilting,) * 2]
        tape = self._playback.acceleration(due)
        back = -(g.posture_rate**2) * self._angles - 2 * g.posture_rate * self._rates
        x = self._solve((rows, targets, np.concatenate(weights)), tape + back, beyond, stand, v)
        self._spin = spin if x is None else body.momentum_rows @ x - beyond
        return back if x is None else np.clip(np.round(x[6:nv], DIGITS) - tape, -g.most, g.most)

    def _solve(self, wishes, joint_wish, beyond, stand, v):
        """Unknowns x (nx,) of the QP, or None if the solver does not report success."""
        body, nv, weight = self._terms, self._terms.nv, self._gains.posture_weight
        linear = np.zeros(body.nx)
        linear[6:nv] -= weight * joint_wish
        diagonal = np.concatenate([np.full(6, LEAST), np.full(nv - 6, weight), np.full(12, LEAST_WRENCH)])
        offset = body.base_offset.copy()
        offset[3:] += body.trunk.T @ beyond
        return self.qp.solve(wishes, diagonal, linear, self._corners[stand], v, offset=offset)
