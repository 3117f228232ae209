"""The servos by their names: what joints are sent for a command of the tape, whatever the engine.

"position" are drives that hold angles, "pd" adds their errors to the planned torque, "whole-body"
measures base and joints and sees no planned torque. That one sums what the motion takes and what
its errors ask for, both from the planned robot at the measured state and with the feet standing as
they do in the plan. The torques for the joints' accelerations a_j are inverse dynamics; those of
the base a_b and the wrenches f on the feet go with it,

    min over a_b, f   1/2 |J a + J' v|^2 + epsilon/2 |f - f_p|^2   so that   M a + h = J^T f   in
    the rows of the base,

where f_p is the plan's: no joint's motion shows how feet push against each other.

Errors are met by damping d, which acts on the velocity v+ that the step ends with, so that it may
be far stiffer than what is computed from the velocity before the step,

    tau + d (wish - v+)   where   M (v+ - v) / step + h = S^T (tau + d (wish - v+)) + J^T f
                          and     J v+ = give step (f_t - f),

with f_t the wrenches that tau goes with: ground that gives way a little. Of rigid ground a leg
would expect to hold what it cannot where its axes nearly coincide, as H1_2's hip yaw and roll do
with the thigh level, and without any roll at the ankle, as H1's. The wished rate is the due one
plus corner times the error of the angle. Where torques are known to arrive late, the step is longer
by as much: a light limb whose error is asked away within a millisecond overshoots until that is
seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.control import STEP_S
from jumplab.control.kinematics import about_vertical
from jumplab.control.playback import Command
from jumplab.errors import InputError, quoted
from jumplab.io.tape import AIR, FLAT, TOE
from jumplab.robot import Robot
from jumplab.robot.contact import on_feet, point_motion
from jumplab.robot.legs import leg_columns, size
from jumplab.robot.stance import stance_configuration

# of "pd": kp, kd [N m/rad, N m s/rad] of pitch joints, ...
PITCH_GAINS = 800.0, 10.0
# ... of those that have others, and of yaw and roll joints (None), which only hold
GAINS = {"ankle_pitch": (300.0, 3.0), "shoulder_pitch": (200.0, 3.0), None: (300.0, 2.0)}
FLIGHT_BANDWIDTH = 100.0  # [rad/s] 4 ms of delay and 1.5 ms of sampling cost 0.55 rad of phase
FLIGHT_CORNER = 25.0  # [rad/s] stiffness over damping; 0.78 rad of phase are left
# of "whole-body": [N m s/rad] of the strongest motor; 60 swings with commands that are 4 ms old
DAMPING = 45.0
CORNER = 25.0  # [rad/s] stiffness over damping
STIFFNESS = 4.0  # [1/rad] stiffness of a drive over its motor's effort: all of it at 14 degrees
STIFFNESS_TIME_S = 0.0125  # [s] damping over stiffness
# of inertia / step^2 and inertia / step: an eighth of the stiffness that is stable, half of the
# damping
MOST_KP = 0.5
MOST_KD = 1.0
LEVER_M = 0.1  # moments on a foot count as forces at this distance
# [1/kg] rate of a foot per impulse on it; 1e-5 is too little for H1_2, 1e-3 for H1 as good
GIVE = 1e-4
EPSILON = 1e-8  # [(m/s^2)^2/N^2] settles what each foot takes, and nothing else
# row of a foot's twist, in axes that are turned with it, that is free while it stands on its toe
PITCH = 4
HELD = {TOE: np.delete(np.arange(6), PITCH), FLAT: np.arange(6)}
UNITS = np.repeat([1.0, LEVER_M], 3)


@dataclass(frozen=True)
class Drive:
    """Values that are sent to the joints' drives: a torque, and angles and rates to hold.

    A drive gives tau + kp (q - its angle) + kd (rate - its rate) from its own encoder, until
    something newer arrives.
    """

    tau: np.ndarray | float  # (n,) [N m]
    q: np.ndarray | float = 0.0  # (n,) [rad]
    rate: np.ndarray | float = 0.0  # (n,) [rad/s]
    kp: np.ndarray | float = 0.0  # (n,) [N m/rad]
    kd: np.ndarray | float = 0.0  # (n,) [N m s/rad]

    def torque(self, angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Torque (n,) [N m] at encoder readings ``angles`` (n,) [rad] and ``rates`` (n,)
        [rad/s].
        """
        return self.tau + self.kp * (self.q - angles) + self.kd * (self.rate - rates)


class PositionServo:
    """Position drives: each joint is sent an angle and a rate, and measures its own; no drive knows
    the base, the feet or another joint.

    Where a drive has no error it gives no torque, so the angle that is sent lies ahead of the
    planned one by the planned torque over the stiffness, also beyond the joint's range: cut off
    there, a joint near its stop would get too little torque. Stiffness is scaled by a motor's
    effort, damping by the stiffness, both within what a cycle of 1 ms can hold on the joint's own
    inertia, that of the robot in its stance with all other joints free. ``late_s`` makes no
    difference here: the loop is closed in the drive. A torque that is held for a step, which a
    simulator takes in ``substeps`` semi-implicit ones, is felt (1 - 1/substeps) / 2 of it late on
    average, and planned torques change meanwhile.
    """

    told = "target angles and rates; a drive measures its own joint"

    def __init__(self, robot: Robot, late_s: float = 0.0, substeps: int = 1):
        motors = robot.limits
        self._late = (1 - 1 / substeps) / 2
        mass = pin.crba(robot.model, robot.model.createData(), stance_configuration(robot))
        inertia = 1 / np.diag(np.linalg.inv(mass))[6:]
        self.kp = np.minimum(STIFFNESS * motors.effort, MOST_KP * inertia / STEP_S**2)
        self.kd = np.minimum(STIFFNESS_TIME_S * self.kp, MOST_KD * inertia / STEP_S)

    def drive(self, command: Command, q: np.ndarray, v: np.ndarray) -> Drive:
        """Values to send for ``command``; the measured (q, v) are not used."""
        ahead = command.q + (command.tau + self._late * command.change) / self.kp
        return Drive(0.0, ahead, command.rate, self.kp, self.kd)


class TorqueServo:
    """The planned torque, and a correction from each joint's own error; the torque is computed
    where commands come from, so that a late one is late twice.

    On the ground tau = planned + kp * error + kd * rate error, explicit at 1 kHz: the damping is
    bounded by the joint's reflected inertia over the age of a command. On the ankle of a leg in the
    air the foot alone hangs, and such gains would make it swing; there, and everywhere in flight,
    the errors ask for accelerations, which the inertia of the free body turns into torques.
    """

    told = "planned torques, angles and rates; it measures all joints"

    def __init__(self, robot: Robot, late_s: float = 0.0, substeps: int = 1):
        self._late = (1 - 1 / substeps) / 2
        self._model = robot.model
        self._data = robot.model.createData()
        role = {name: role for role, pair in robot.joints.items() for name in pair}
        gains = [GAINS.get(role.get(name), PITCH_GAINS) for name in robot.joint_names]
        units = zip(np.transpose(gains), ("N m", "N m s"), strict=True)
        self._kp, self._kd = (size(robot).of(gain, unit) for gain, unit in units)
        self._legs = [leg - 6 for leg in leg_columns(robot)]

    def drive(self, command: Command, q: np.ndarray, v: np.ndarray) -> Drive:
        """Values to send for ``command`` at the measured (q, v)."""
        tau = command.tau + self._late * command.change
        error = command.q - q[7:]
        rate_error = command.rate - v[6:]
        held = self._kp * error + self._kd * rate_error
        swings = [leg for leg, x in zip(self._legs, command.feet, strict=True) if x == AIR]
        if len(swings) == len(self._legs):
            swings = [np.arange(len(tau))]
        if swings:
            # torques per joint acceleration of the free body
            whole = pin.crba(self._model, self._data, q)
            free = whole[6:, 6:] - whole[6:, :6] @ np.linalg.solve(whole[:6, :6], whole[:6, 6:])
            wish = FLIGHT_BANDWIDTH * (FLIGHT_CORNER * error + rate_error)
        for leg in swings:
            held[leg] = free[np.ix_(leg, leg)] @ wish[leg]
        return Drive(tau + held)


class WholeBodyServo:
    """Torques for commands, from the measured state; see the module's docstring.

    ``robot`` is as planned, and torques are known to arrive ``late_s`` late. A simulator may take a
    step in ``substeps`` semi-implicit ones: joints whose rates are right run ahead by half of one.
    """

    told = "angles, rates, accelerations and contacts; it measures base and joints"

    def __init__(self, robot: Robot, late_s: float = 0.0, substeps: int = 1):
        self._step_s = STEP_S + late_s
        self._ahead_s = STEP_S / substeps / 2
        self._model = robot.model
        self._data = self._model.createData()
        self._motors = robot.limits
        large = size(robot)
        self._give = GIVE / large.of(1.0, "N")
        self._epsilon = EPSILON / large.of(1.0, "N") ** 2
        self._damping = large.of(DAMPING, "N m s") * self._motors.effort / self._motors.effort.max()
        self._pivots = {FLAT: robot.foot.center, TOE: robot.foot.tip}
        self._anchors = {stand: on_feet(robot, at) for stand, at in self._pivots.items()}

    def drive(self, command: Command, q: np.ndarray, v: np.ndarray) -> Drive:
        """Values to send for ``command`` at the measured (q, v)."""
        return Drive(self.torque(command, q, v))

    def torque(self, command: Command, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Torques (nv - 6,) for ``command`` at the measured (q, v) [N m]."""
        pin.computeAllTerms(self._model, self._data, q, v)
        pin.forwardKinematics(self._model, self._data, q, v, np.zeros(len(v)))
        feet, drift, units, shared = self._feet(command)
        push = feet.T * units
        tau, carried = self._feed_forward(command.acceleration, feet, drift, push, shared / units)
        error = command.q + self._ahead_s * command.rate - q[7:]
        wish = command.rate + self._step_s * command.acceleration + CORNER * error
        tau = tau + self._damping * (wish - self._rates_after(tau, carried, wish, v, push))
        # at the due rate: a measured one would swing with its noise
        tau = tau + self._motors.lost(command.rate)
        # a joint that was thrown beyond its no-load speed can still be braked
        low, high = self._motors.range(v[6:])
        return np.clip(tau, command.share * low, command.share * high)

    def _feed_forward(
        self,
        joints: np.ndarray,
        feet: np.ndarray,
        drift: np.ndarray,
        push: np.ndarray,
        shared: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Torques (nv - 6,) that accelerate the ``joints`` as told, while the feet stay where they
        are; wrenches (k,).

        The wrenches on them are as near to those ``shared`` (k,) out by the plan as that allows.
        """
        held = len(drift)
        base = feet[:, :6]
        mass = self._data.M
        offset = self._data.nle + mass[:, 6:] @ joints
        # unknowns: accelerations of the base, wrenches, multipliers of the base's dynamics
        kkt = np.zeros((12 + held, 12 + held))
        kkt[:6, :6] = base.T @ base
        kkt[:6, -6:] = kkt[-6:, :6] = mass[:6, :6]
        kkt[6:-6, 6:-6] = self._epsilon * np.eye(held)
        kkt[-6:, 6:-6] = -push[:6]
        kkt[6:-6, -6:] = -push[:6].T
        still = -base.T @ (drift + feet[:, 6:] @ joints)
        x = np.linalg.solve(kkt, np.concatenate([still, self._epsilon * shared, -offset[:6]]))
        wrench = x[6:-6]
        return offset[6:] + mass[6:, :6] @ x[:6] - push[6:] @ wrench, wrench

    def _rates_after(
        self,
        tau: np.ndarray,
        carried: np.ndarray,
        wish: np.ndarray,
        v: np.ndarray,
        push: np.ndarray,
    ) -> np.ndarray:
        """Joint rates (nv - 6,) at the end of the step, if ``tau`` and damping towards ``wish`` act
        [rad/s].

        The feet give way to what they have to carry beyond ``carried`` (k,).
        """
        step_s = self._step_s
        nv, held = push.shape
        kkt = np.zeros((nv + held, nv + held))
        kkt[:nv, :nv] = self._data.M
        kkt[range(6, nv), range(6, nv)] += step_s * self._damping
        kkt[:nv, nv:] = -push
        kkt[nv:, :nv] = -push.T
        kkt[nv:, nv:] = -self._give * np.eye(held)
        moved = self._data.M @ v - step_s * self._data.nle
        moved[6:] += step_s * (tau + self._damping * wish)
        right = np.concatenate([moved, -self._give * step_s * carried])
        return np.linalg.solve(kkt, right)[6:nv]

    def _feet(self, command: Command) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Motions that the feet cannot make: Jacobian (k, nv), drift (k,), units (k,) of the wrench
        against each, and the plan's wrench (k,), about the points on which they stand.
        """
        rows = [np.zeros((0, self._model.nv + 3))]
        for side, stand in enumerate(command.feet):
            if stand == AIR:
                continue
            foot = point_motion(self._model, self._data, self._anchors[stand][side])
            load = np.zeros(6) if command.wrench is None else command.wrench[side].copy()
            load[3:] -= pin.skew(foot.turn @ self._pivots[stand]) @ load[:3]
            # in axes that are turned about the vertical as the foot is
            yaw = np.arctan2(foot.turn[1, 0], foot.turn[0, 0])
            along = np.kron(np.eye(2), about_vertical(-yaw))
            columns = along @ np.concatenate([foot.jacobian.T, [foot.drift, load]]).T
            rows.append(np.column_stack([columns, UNITS])[HELD[stand]])
        rows = np.concatenate(rows)
        return rows[:, :-3], rows[:, -3], rows[:, -1], rows[:, -2]


# how the tape is played until touchdown, by name
SERVOS = {"position": PositionServo, "pd": TorqueServo, "whole-body": WholeBodyServo}


def servo_of(mode: str) -> type[PositionServo | TorqueServo | WholeBodyServo]:
    """The servo of a ``mode``; raises :class:`InputError` if there is none."""
    if mode not in SERVOS:
        raise InputError(f"mode {quoted(mode)}: must be one of {', '.join(SERVOS)}")
    return SERVOS[mode]
