"""Launch feedback: joints leave the tape a little, so that the body as a whole launches as planned.

A tape that is followed joint by joint moves a robot unlike its plan, or one that is shoved or sinks
in, with another momentum and over another place: its feet tip, and on its toes it falls on like a
pendulum. Here, every 2 ms, joint accelerations and foot wrenches are chosen that obey the base
dynamics, friction, the soles' edges and the motors' torques, and come closest to the planned CoM,
its velocity, the angular momentum and the planned joints, with the feet moving on as they do. While
a foot is in the air, it and the trunk are led along the plan as well: errors of the attitude would
put it down turned, and elsewhere. The difference of the joints' accelerations from the tape's is
integrated and added to it, and so are the torques that go with them.

Feet that creep, as on contacts that give way, take the planned place of the CoM along, or the
forces on them would turn the body. Its planned velocity is that in the world, and what the feet
have lost of their way until take-off is made good by speed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from jumplab.control import STEP_S
from jumplab.control.body import PERIOD_STEPS, PITCH, Footing, WholeBody, solver
from jumplab.control.kinematics import Gauge, State, about_vertical
from jumplab.control.playback import AIR, Command, Playback, Stand, resampled
from jumplab.errors import InputError
from jumplab.io import tape as tapes
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.contact import Anchor, moving, point_motion

FRICTION = 0.6  # more than plans use, less than most floors have
LENGTH_SHARE = 0.95  # of the sole for the CoP
LEAST_LOAD = 0.5  # [1] of the weight; with less on the feet nothing is changed any more
# of the flight, in which what was changed fades; natural times of that, to 4 %
FADE_SHARE = 0.4
FADED = 5.0
# weights of base accelerations and of wrenches / 100 N, so that the answer is one
LEAST = 1e-8
LEAST_WRENCH = 1e-4
TORQUE_DIGITS = 4  # [0.1 mN m]
DIGITS = 9  # of accelerations: ProxQP's last ones depend on where its memory lies


# natural frequencies [rad/s] of critically damped wishes
COM_RATE = 8.0  # twice the pendulum's own: the launch is over within a second
MOMENTUM_RATE = 10.0
# of that about the pitch axis over time, once heels rise: its lack turns the body in flight;
# sooner, loads and shoves would tip the robot
PITCH_RATE = 20.0
CREEP_S = 0.01  # [s] in which the rate of the feet's speed is taken; 20 ms are too late
POSTURE_RATE = 4.0  # back to the tape, where nothing else is asked
# back to the tape in the air, or faster in a short flight: before legs are re-aimed
FADE_RATE = 20.0
# weights [1 / (m/s^2)^2] or [1 / (rad/s^2)^2]
COM_WEIGHT = 1.0, 1.0, 3.0
MOMENTUM_WEIGHT = 1.0  # of L-rate over a nominal inertia
FOOT_WEIGHT = 1e4
POSTURE_WEIGHT = 0.02
# rates [rad/s] and weights of a foot in the air, and of the trunk meanwhile; heavier ones cost the
# balance that the other foot keeps. Of 30 perturbed robots after a run-up (bhr) and over a hurdle
# (g1_arms), 26 and 25 stand where that leg follows the tape's joints, 28 and 28 with these
SWING_RATE = 12.0
SWING_WEIGHT = 0.02
SWING_TURNING_WEIGHT = 0.002
TRUNK_RATE = 7.0
TRUNK_WEIGHT = 0.1
MOST = 40.0  # [rad/s^2] that a joint's acceleration may differ by from the tape's


def check_mode(mode: str) -> None:
    """Refuse (:class:`InputError`) a mode of playback in which the launch cannot be corrected."""
    if mode == "pd":
        raise InputError(
            "feedback cannot run in mode 'pd', where the servos already correct the same measured "
            "errors; choose mode 'position' or 'whole-body'"
        )


def balance_rows(robot: Robot, tape: Tape, steps: int) -> np.ndarray:
    """CoM, its velocity and acceleration, L, its rate, and the places of the left and the right toe
    (steps + 1, 7, 3) of a tape, on the grid of control.
    """
    gauge = Gauge(robot)
    gravity = robot.model.gravity.linear
    rows = []
    for q, v, f in zip(tape.q, tape.v, tape.f, strict=True):
        now = gauge.motion(q, v)
        push = f[:, :3].sum(axis=0) / robot.total_mass + gravity
        arms = np.array([foot.translation for foot in gauge.places(q)]) - now.com
        moment = (f[:, 3:] + np.cross(arms, f[:, :3])).sum(axis=0)
        toes = gauge.points(q, robot.foot.tip)
        rows.append([now.com, now.velocity, push, now.momentum, moment, *toes])
    return resampled(np.arange(steps + 1) * STEP_S, tape.t, np.array(rows))


class LaunchFeedback:
    """Changes the commands of one launch; see the module's docstring.

    Not for servos of mode "pd": feet begin to rock by what sensors err by. ``solver`` counts the
    QPs posed and those without a solution, where the joints go back to the tape.
    """

    def __init__(self, robot: Robot, tape: Tape, playback: Playback):
        self._robot = robot
        self.playback = playback
        self._body = body = WholeBody(robot)
        self._gauge = Gauge(robot)
        self.solver = solver()
        self._stand: Stand | None = None
        # pitch momentum that was missing since the heels rose, summed over time [kg m^2]
        self._unturned = 0.0
        self._speed = np.zeros(3)  # of the feet that carry, filtered [m/s]
        air_s = [np.ptp(tape.t[rows]) for rows in tape.flights]
        rates = COM_RATE, MOMENTUM_RATE, PITCH_RATE, POSTURE_RATE, SWING_RATE, TRUNK_RATE, FADE_RATE
        *self._lead_rates, self._posture_rate, self._swing_rate, self._trunk_rate, fade_rate = (
            body.size.of(x, "rad/s") for x in rates
        )
        self._turning = body.size.of(1.0, "s") ** 4  # on weights of angular accelerations
        self._foot_weights = {
            tapes.AIR: np.repeat([SWING_WEIGHT, self._turning * SWING_TURNING_WEIGHT], 3),
            tapes.TOE: FOOT_WEIGHT * (np.arange(6) != PITCH),
            tapes.FLAT: FOOT_WEIGHT,
        }
        self._fade_rate = max([fade_rate, *(FADED / (FADE_SHARE * x) for x in air_s)])
        self._air_s = next(iter(air_s), np.inf)  # of the first flight
        # of the joints, off the tape
        self.angles, self._rates, self.changes = np.zeros((3, len(robot.joint_names)))
        self._torque: np.ndarray | float = 0.0  # besides the tape's
        self._farthest = 0.0  # [rad]
        self._left = about_vertical(self._gauge.heading(tape.q[0]))[:, 1]
        self._first = tape.q[0]
        self.rows = balance_rows(robot, tape, playback.steps)
        self._footing = Footing(robot, FRICTION, LENGTH_SHARE, 1.0)

    def to_json(self) -> dict:
        """Counts and deviations of the launch, for the settings of a result."""
        return {
            "solves": self.solver.solves,
            "failures": self.solver.failures,
            "farthest_rad": self._farthest,
        }

    def begin(self, q: np.ndarray) -> None:
        """Start from ``q`` (nq,), whose CoM is led back to the plan as :meth:`Playback.approach`
        leads wrong joints.
        """
        model = self._gauge.model
        way = pin.difference(model, self._first, q)
        moved = pin.computeCentroidalMap(model, self._gauge.data, self._first) @ way
        com = moved[:3] / self._robot.total_mass
        left, *rates = self.playback.way_back()
        # of the CoM and its rates, then of L and its rate
        offs = np.array([com, com, com, moved[3:], moved[3:]])
        shares = np.stack([left, *rates, *rates], axis=1)
        self.rows[: len(left), :5] += shares[:, :, None] * offs

    def __call__(self, step: int, command: Command, state: State) -> Command:
        """``command`` of the tape at ``step``, changed; from the measured state, in the tape's
        axes.
        """
        due = step + self.playback.lead
        stand = command.feet
        if stand == AIR or due >= len(self.rows):
            self.changes = self._back(self._fade_rate)
            self._torque = 0.0
        elif step % PERIOD_STEPS == 0:
            if self.rows[due, 2, 2] + self._robot.gravity < LEAST_LOAD * self._robot.gravity:
                self.changes = -2 * self._posture_rate * self._rates
            else:
                self.changes, tau = self._solve(due, stand, *(command.state or state[:2]))
                self._torque = 0.0 if tau is None else tau - command.tau
        self._rates = self._rates + STEP_S * self.changes
        self.angles = self.angles + STEP_S * self._rates
        self._farthest = max(self._farthest, float(np.abs(self.angles).max()))
        return replace(
            command,
            q=command.q + self.angles,
            rate=command.rate + self._rates,
            acceleration=command.acceleration + self.changes,
            tau=command.tau + self._torque,
        )

    def _solve(
        self, due: int, stand: Stand, q: np.ndarray, v: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Differences (nv - 6,) from the tape's joint accelerations at step ``due``, and the
        motors' torques (nv - 6,) with them [N m], None without a solution.
        """
        body = self._body
        carries = np.array(stand) > tapes.AIR
        anchors, corners = self._footing.of(stand)
        body.update(q, v, anchors)
        body.set_contact(carries)
        com, speed, push, momentum, spin, *toes = self.rows[due]
        # the plan goes on where the feet are, and ends where it would have
        now = self._gauge.points(q, self._robot.foot.tip)
        moved = [1.0, 1.0, 0.0] * (now - toes)[carries].mean(axis=0)
        com = com + moved
        if due < self.playback.lands:
            speed = speed - moved / self._air_s
        com_rate, momentum_rate, pitch_rate = self._lead_rates
        push = body.com_wish(com, speed, push, com_rate)
        missing = momentum - body.momentum
        turn = spin + momentum_rate * missing
        creep = np.zeros(6)
        if tapes.TOE in stand:
            creep = self._creep(stand, carries)
            pitching = float(self._left @ missing)
            self._unturned += PERIOD_STEPS * STEP_S * pitching
            faster = (2 * pitch_rate - momentum_rate) * pitching
            turn = turn + (faster + pitch_rate**2 * self._unturned) * self._left
        tape = self.playback.acceleration(due)
        back = self._back(self._posture_rate)
        qp = body.program(v, corners)
        body.balance(qp, push, turn, (COM_WEIGHT, self._turning * MOMENTUM_WEIGHT))
        for side, x in enumerate(stand):
            wish = self._swing(due, side, anchors[side], moved) if x == tapes.AIR else creep
            target = wish - body.sole_drift[side]
            qp.cost(f"foot {side}", body.sole_rows[side], target, self._foot_weights[x])
        if tapes.AIR in stand:
            wish = body.trunk_wish(v, *self.playback.planned(due), self._trunk_rate)
            qp.cost("trunk", body.unknowns[3:6], wish, self._turning * TRUNK_WEIGHT)
        posture = self._turning * POSTURE_WEIGHT
        qp.cost("posture", body.unknowns[6 : body.nv], tape + back, posture)
        qp.cost("base", body.unknowns[:6], 0.0, LEAST)
        qp.cost("wrenches", body.unknowns[body.nv :], 0.0, LEAST_WRENCH)
        answer = self.solver.solve(qp)
        if not answer.solved:
            return back, None
        change = np.round(answer.x[6 : body.nv], DIGITS) - tape
        tau = np.round(body.torque(answer.x), TORQUE_DIGITS) + body.motors.lost(v[6:])
        most = body.size.of(MOST, "rad/s^2")
        return np.clip(change, -most, most), tau

    def _swing(self, due: int, side: int, anchor: Anchor, moved: np.ndarray) -> np.ndarray:
        """Acceleration (6,) of the sole of a foot in the air, towards its motion by the plan, which
        goes on where the feet that carry are, ``moved`` (3,) [m].
        """
        body = self._body
        gauge = self._gauge
        rate = self._swing_rate
        q, v, gained = self.playback.planned(due)
        moving(gauge.model, gauge.data, q, v)
        foot = point_motion(gauge.model, gauge.data, anchor)
        turned = pin.log3(foot.turn @ body.attitudes[side].T)
        off = np.concatenate([foot.place + moved - body.soles[side], turned])
        gained = foot.jacobian @ gained + foot.drift
        return gained + rate**2 * off + 2 * rate * (foot.velocity - body.twists[side])

    def _creep(self, stand: Stand, carries: np.ndarray) -> np.ndarray:
        """Rate (6,) of the twist with which feet that carry move along the jump and up; none is
        felt yet where the ``stand`` is new.

        Their other motions are left out: answered to, they would swing.
        """
        speed = self._body.twists[carries, :3].mean(axis=0)
        if stand != self._stand:
            self._stand = stand
            self._speed = speed
        gained = (speed - self._speed) / CREEP_S
        self._speed = self._speed + PERIOD_STEPS * STEP_S * gained
        return np.append(gained - self._left @ gained * self._left, np.zeros(3))

    def _back(self, rate: float) -> np.ndarray:
        """Accelerations (nv - 6,) that lead the joints back to the tape, critically damped."""
        return -(rate**2) * self.angles - 2 * rate * self._rates
