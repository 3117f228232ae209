"""The servo law of position mode: target, rate and acceleration of the joints in, torques out, whatever the engine.

It sums what the motion takes and what its errors ask for, both from the planned robot at the measured state and with
the feet standing as they do in the plan. What the joints' accelerations a_j take is inverse dynamics; those of the base
a_b and the wrenches f on the feet go with it,

    min over a_b, f   1/2 |J a + J' v|^2 + epsilon/2 |f - f_p|^2   so that   M a + h = J^T f   in the rows of the base,

where f_p is the plan's, none where both feet carry alike: what they push against each other no joint's motion tells.

Errors are met by damping d, which acts on the velocity v+ that the step ends with, so that it may be far stiffer than
what is computed from the velocity before the step,

    tau + d (wish - v+)   where   M (v+ - v) / step + h = S^T (tau + d (wish - v+)) + J^T f
                          and     J v+ = give step (f_t - f),

with f_t the wrenches that tau goes with: ground that gives way a little. Of rigid ground a leg would expect to hold
what it cannot where its axes nearly coincide, as H1_2's hip yaw and roll do with the thigh level, and without any roll
at the ankle, as H1's. The wished rate is the due one plus corner times the error of the angle. Where torques are known
to arrive late, the step is longer by as much: a light limb whose error is asked away within a millisecond overshoots
until that is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, solved
from jumplab.sim.playback import AIR, FLAT, TOE, Actuators, Command


@dataclass(frozen=True)
class ServoGains:
    """The paper prints none of these numbers."""

    damping: float = 45.0  # [N m s/rad] of the strongest motor; 60 swings with commands that are 4 ms old
    corner: float = 25.0  # [rad/s] stiffness over damping
    lever_m: float = 0.1  # moments on a foot count as forces at this distance
    give: float = 1e-4  # [1/kg] rate of a foot per impulse on it; 1e-5 is too little for H1_2, 1e-3 for H1 as good
    epsilon: float = 1e-8  # [(m/s^2)^2/N^2] settles what each foot takes, and nothing else


GAINS = ServoGains()
AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
PITCH = 4  # row of a foot's twist, in axes that are turned with it, that is free while it stands on its toe


class Servo:
    """Torques for commands, from the measured state.

    ``robot`` is as planned, and torques are known to arrive ``late_s`` late. They act for a whole step, which an engine
    takes in ``substeps`` semi-implicit ones: they are felt at the beginnings of these, on average (1 - 1/substeps) / 2
    of the step late, and planned ones change meanwhile. Joints whose rates are right run ahead by half a substep.
    """

    def __init__(self, robot: Robot, gains: ServoGains = GAINS, late_s: float = 0.0, substeps: int = 1):
        self._step_s, self._late, self._ahead_s = STEP_S + late_s, (1 - 1 / substeps) / 2, STEP_S / substeps / 2
        self._gauge, self._motors, self._gains, foot = Gauge(robot), Actuators(robot), gains, robot.foot
        self._damping = gains.damping * self._motors.effort / self._motors.effort.max()
        self._robot = robot
        self._pivot = {FLAT: foot.center, TOE: foot.tip}

    def torque(self, command: Command, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Torques (nv - 6,) for ``command`` at the measured (q, v) [N m]; those of the command, if it has any."""
        if command.tau is not None:
            return command.tau + self._late * command.change
        model, data = self._gauge.model, self._gauge.data
        pin.computeAllTerms(model, data, q, v)
        pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))
        feet, drift, units = self._feet(command.feet)
        push = feet.T * units
        shared = self._shared(command) / units if command.wrench is not None else 0.0
        tau, carried = self._feed_forward(command.acceleration, feet, drift, push, shared)
        error = command.q + self._ahead_s * command.rate - q[7:]
        wish = command.rate + self._step_s * command.acceleration + self._gains.corner * error
        tau = tau + self._damping * (wish - self._rates_after(tau, carried, wish, v, push))
        if self._robot.lossy:  # at the due rate: a measured one would swing with its noise
            tau = tau + self._robot.lost_torque(command.rate)
        low, high = self._motors.range(v[6:])  # a joint that was thrown beyond its no-load speed can still be braked
        return np.clip(tau, command.share * low, command.share * high)

    def _feed_forward(
        self, joints: np.ndarray, feet: np.ndarray, drift: np.ndarray, push: np.ndarray, shared: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Torques (nv - 6,) that accelerate the ``joints`` as told, while the feet stay where they are; wrenches (k,).

        The wrenches on them are as near to those ``shared`` (k,) out by the plan as that allows.
        """
        data, held = self._gauge.data, 6 + len(drift)
        offset = data.nle + data.M[:, 6:] @ joints
        kkt, right = np.zeros((held + 6, held + 6)), np.zeros(held + 6)
        kkt[:6, :6] = feet[:, :6].T @ feet[:, :6]
        kkt[range(6, held), range(6, held)] = self._gains.epsilon
        kkt[held:, :6], kkt[held:, 6:held] = data.M[:6, :6], -push[:6]
        kkt[:held, held:] = kkt[held:, :held].T
        right[6:held] = self._gains.epsilon * shared
        right[:6], right[held:] = -feet[:, :6].T @ (drift + feet[:, 6:] @ joints), -offset[:6]
        x = solved(kkt, right)
        return offset[6:] + data.M[6:, :6] @ x[:6] - push[6:] @ x[6:held], x[6:held]

    def _rates_after(
        self, tau: np.ndarray, carried: np.ndarray, wish: np.ndarray, v: np.ndarray, push: np.ndarray
    ) -> np.ndarray:
        """Joint rates (nv - 6,) at the end of the step, if ``tau`` and damping towards ``wish`` act [rad/s].

        The feet give way to what they have to carry beyond ``carried`` (k,).
        """
        data, nv, held = self._gauge.data, len(v), push.shape[1]
        kkt, right, joints = np.zeros((nv + held, nv + held)), np.zeros(nv + held), range(6, nv)
        kkt[:nv, :nv] = data.M
        step_s = self._step_s
        kkt[joints, joints] += step_s * self._damping
        kkt[:nv, nv:], kkt[nv:, :nv] = -push, -push.T
        kkt[range(nv, nv + held), range(nv, nv + held)] = -self._gains.give
        right[:nv] = data.M @ v - step_s * data.nle
        right[6:nv] += step_s * (tau + self._damping * wish)
        right[nv:] = -self._gains.give * step_s * carried
        return solved(kkt, right)[6:nv]

    def _shared(self, command: Command) -> np.ndarray:
        """The plan's wrenches (k,) on the feet, about the points on which they stand, less what a toe cannot hold."""
        found, held = [], _held(command.feet)
        for frame, wrench in zip(self._gauge.frames, command.wrench, strict=True):
            foot = self._gauge.data.oMf[frame].rotation
            arm, along = foot @ self._pivot[command.feet], headings(foot)
            found.append(np.concatenate([along @ wrench[:3], along @ (wrench[3:] - np.cross(arm, wrench[:3]))])[held])
        return np.concatenate(found)

    def _feet(self, stand: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Motions that the feet cannot make: Jacobian (k, nv), drift (k,), units (k,) of the wrench against each."""
        model, data = self._gauge.model, self._gauge.data
        rows, drifts, units = [np.zeros((0, model.nv))], [np.zeros(0)], [np.zeros(0)]
        held = _held(stand)
        for frame in self._gauge.frames if stand != AIR else ():
            foot = pin.updateFramePlacement(model, data, frame).rotation
            arm, along = foot @ self._pivot[stand], headings(foot)
            jacobian = pin.getFrameJacobian(model, data, frame, AXES)
            jacobian[:3] -= pin.skew(arm) @ jacobian[3:]
            drift = pin.getFrameClassicalAcceleration(model, data, frame, AXES)
            spin = pin.skew(pin.getFrameVelocity(model, data, frame, AXES).angular)
            linear = drift.linear + pin.skew(drift.angular) @ arm + spin @ (spin @ arm)
            rows.append(np.vstack([along @ jacobian[:3], along @ jacobian[3:]])[held])
            drifts.append(np.concatenate([along @ linear, along @ drift.angular])[held])
            units.append(np.repeat([1.0, self._gains.lever_m], 3)[held])
        return np.vstack(rows), np.concatenate(drifts), np.concatenate(units)


def headings(foot: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) from world axes to axes that are turned about the vertical as a ``foot`` (3, 3) is."""
    c, s = foot[:2, 0] / np.hypot(*foot[:2, 0])
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _held(stand: str) -> np.ndarray:
    """Rows of a foot's twist that the ground holds."""
    return np.delete(np.arange(6), [] if stand == FLAT else PITCH)
