"""Launch and flight as the paper plays them: the tape goes to the joints, and nothing else does (Sec. VI-B).

What the motors are told, how late, and what they can give stands here too. Commands become torques, torques grow old
(:class:`Delay`), and what arrives is delivered as well as each motor can (:class:`Motors`), in both modes alike.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, quoted
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import rotation, solved

MODES = ("position", "pd")
FLAT, TOE, AIR = "flat", "toe", "air"  # how both feet stand
HEEL_RAD = 1e-6  # a foot that is tilted by more stands on its toe
LEAST_VOLTAGE = 0.5  # share that a battery holds, whatever is drawn
ALIKE_N = 0.1  # feet whose loads differ by no more carry alike
WRONG_RAD = 0.02  # a start farther off than sensors err is led back until the heels rise; sooner, the robot tips


class Actuators:
    """Torque limits of all joints at a given speed.

    Full torque up to the corner speed, then a line to zero at the no-load speed; against the motion the full torque
    remains, as in any electric drive.
    """

    def __init__(self, robot: Robot):
        rows = [robot.actuators[name] for name in robot.joint_names]
        keys = "effort", "speed", "corner_speed", "no_load_speed", "lower", "upper"
        self.effort, self.speed, corner, self._free, self.lower, self.upper = (
            np.array([row[key] for row in rows]) for key in keys
        )
        self._slope = 1 / (self._free - corner)

    def range(self, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest torque (nv - 6,) [N m] at the joint rates ``rate`` [rad/s]."""
        lower = -self.effort * np.clip((self._free + rate) * self._slope, 0.0, 1.0)
        upper = self.effort * np.clip((self._free - rate) * self._slope, 0.0, 1.0)
        return lower, upper


@dataclass(frozen=True)
class Command:
    """What the joints shall do in one step: move, as the servo law sees to, or give a torque."""

    q: np.ndarray | None = None  # (nv - 6,) [rad]
    rate: np.ndarray | None = None  # (nv - 6,) [rad/s]
    acceleration: np.ndarray | None = None  # (nv - 6,) [rad/s^2]
    tau: np.ndarray | None = None  # (nv - 6,) [N m]
    change: np.ndarray | float = 0.0  # of ``tau`` within the step, as planned [N m]
    feet: str = AIR  # how they stand by the plan
    wrench: np.ndarray | None = None  # (2, 6) of the plan on them, as on a tape; None: both carry alike
    share: float = 1.0  # of the torque limit, for the servo
    state: tuple[np.ndarray, np.ndarray] | None = None  # (q, v) that it is expected to arrive in; as measured if None


class Delay:
    """A line of ``steps`` torques between the controller and the motors; the first one fills it."""

    def __init__(self, steps: int):
        self._line: deque = deque(maxlen=steps + 1)

    def __call__(self, tau: np.ndarray) -> np.ndarray:
        self._line.extend([tau] * (1 if self._line else self._line.maxlen))
        return self._line[0]


class Motors:
    """Turns commanded into delivered torques; ``gain`` is joint -> torque delivered per torque commanded.

    A battery sags by ``sag_per_kw``: speed limits and corner speeds fall by that share per power [kW] that all joints
    drew in the step before; what brakes gives nothing back.
    """

    def __init__(self, robot: Robot, gain: dict[str, float], sag_per_kw: float = 0.0):
        self.actuators, self._sag_per_w, self._drawn_w = Actuators(robot), sag_per_kw / 1e3, 0.0
        self._gain = np.array([gain.get(name, 1.0) for name in robot.joint_names])

    def deliver(self, tau: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """What becomes of ``tau`` (nv - 6,) [N m] at true joint rates ``rate``."""
        left = max(1 - self._sag_per_w * self._drawn_w, LEAST_VOLTAGE)
        found = np.clip(self._gain * tau, *self.actuators.range(rate / left))
        self._drawn_w = float(np.maximum(found * rate, 0.0).sum())
        return found


@dataclass(frozen=True)
class PdGains:
    """Gains of the "pd" mode; the paper prints none.

    On the ground tau = planned + kp * error + kd * rate error, explicit at 1 kHz: the damping is bounded by the joint's
    reflected inertia over the age of a command. In the air the foot alone hangs on the ankle, and such gains would make
    it swing; there the errors ask for accelerations, which the inertia of the free body turns into torques.
    """

    pitch: tuple[float, float] = (800.0, 10.0)  # kp, kd [N m/rad, N m s/rad]
    ankle: tuple[float, float] = (300.0, 3.0)
    side: tuple[float, float] = (300.0, 2.0)  # yaw and roll joints, which only hold
    arm: tuple[float, float] = (200.0, 3.0)  # the arm is light
    flight_bandwidth: float = 100.0  # [rad/s] 4 ms of delay and 1.5 ms of sampling cost 0.55 rad of phase
    flight_corner: float = 25.0  # [rad/s] stiffness over damping; 0.78 rad of phase are left

    def of(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """kp and kd of every joint (nv - 6,)."""
        role = {name: role for role, pair in robot.joints.items() for name in pair}
        special = {"ankle_pitch": self.ankle, "shoulder_pitch": self.arm, None: self.side}
        return tuple(np.array([special.get(role.get(n), self.pitch) for n in robot.joint_names]).T)


GAINS = PdGains()


class Playback:
    """The tape on the 1 ms grid of the simulation, as commands. After its end the last posture is held.

    In ``mode`` "position" the servo law of :mod:`.servo` follows its angles, rates and accelerations and sees no
    planned torque; of a jump whose feet carry unlike loads it knows what each of them carries. In "pd" the planned
    torque is commanded, plus PD. Raises :class:`InputError` if the mode is unknown or the tape is another robot's.

    Commands that are known to arrive ``lead_s`` late are those of the tape so much later. The robot is expected to be
    as far off the tape then as it is measured to be now: the plan is sent ahead, errors are met late.
    """

    def __init__(self, tape: Tape, robot: Robot, mode: str = "position", lead_s: float = 0.0):
        if not isinstance(mode, str) or mode not in MODES:
            raise InputError(f"mode {quoted(mode)}: must be one of {', '.join(MODES)}")
        names = tuple(str(n) for n in tape.joint_names)
        if names != robot.joint_names:
            raise InputError(f"the tape's joints {', '.join(names[:3])} ... are not those of robot {robot.name}")
        self.mode = mode
        self.steps, self.lead = round(float(tape.t[-1]) / STEP_S), round(lead_s / STEP_S)
        grid = np.arange(self.steps + 1) * STEP_S
        self._q, self._v, self._tau = (_resample(grid, tape.t, x) for x in (tape.q[:, 7:], tape.v, tape.tau))
        self._rate = self._v[:, 6:]
        self._attitude = _resample(grid, tape.t, tape.q[:, 3:7])
        self._rest = self._corrected = np.zeros(len(names))
        self._kp, self._kd = GAINS.of(robot)
        self._model, self._data = robot.model, robot.model.createData()
        self._takeoff = round(tape.takeoff_time / STEP_S)
        self._change = np.vstack([np.diff(self._tau, axis=0), self._rest])
        self._change[self._takeoff - 1] = 0.0  # what the ground held ends there at once
        self._heel_off = self._first_tilt(robot, tape)
        loads = tape.f[: tape.takeoff_index]
        unlike = loads.shape[1] == 2 and np.abs(loads[:, 0, 2] - loads[:, 1, 2]).max() > ALIKE_N
        self._wrench = _resample(grid, tape.t, tape.f.reshape(len(tape.t), -1)) if unlike else None

    def _first_tilt(self, robot: Robot, tape: Tape) -> int:
        """Step at which the heels leave the ground."""
        data, frame = self._data, robot.model.getFrameId(robot.foot.frames[0])
        for t, q in zip(tape.t, tape.q, strict=True):
            pin.framesForwardKinematics(self._model, data, q)
            if abs(data.oMf[frame].rotation[2, 0]) > HEEL_RAD:
                return round(float(t) / STEP_S)
        return self.steps

    def stands(self, step: int) -> str:
        """How the feet stand by the plan."""
        return AIR if step >= self._takeoff else TOE if step >= self._heel_off else FLAT

    def shifted(
        self, step: int, shift_s: float, pace: float, q: np.ndarray, v: np.ndarray, correction: np.ndarray
    ) -> Command:
        """As :meth:`command` in flight, the tape read ``shift_s`` beyond ``step``, and ``1 + pace`` times as fast."""
        at = min(max(step + self.lead + shift_s / STEP_S, 0.0), float(self.steps))
        if at >= self.steps:
            return self.command(self.steps, q, v, correction)
        q, v = self._arriving(at, q, v)
        angles, rate, tau, change = (_between(x, at) for x in (self._q, self._rate, self._tau, self._change))
        due = (_between(self._rate, at + 1.0) - rate) / STEP_S
        rate = (1 + pace) * rate
        if self.mode == "position":
            return Command(q=angles + correction, rate=rate, acceleration=(1 + pace) ** 2 * due, state=(q, v))
        wish = GAINS.flight_corner * (angles + correction - q[7:]) + rate + self._correction_rate(correction) - v[6:]
        return Command(tau=tau + self._inertia(q) @ (GAINS.flight_bandwidth * wish), change=change)

    def command(self, step: int, q: np.ndarray, v: np.ndarray, correction: np.ndarray) -> Command:
        """Command to send at one step, from the measured state; ``correction`` is added to the angles."""
        step += self.lead
        now, holding = min(step, self.steps), step >= self.steps
        q, v = self._arriving(step, q, v)
        if self.mode == "position":
            rate = self._rest if holding else self._rate[now]
            due = (self._rate[min(now + 1, self.steps)] - self._rate[now]) / STEP_S
            moves = dict(q=self._q[now] + correction, rate=rate, acceleration=due)
            wrench = None if self._wrench is None or step >= self._takeoff else self._wrench[now].reshape(2, 6)
            return Command(**moves, feet=self.stands(step), wrench=wrench, state=(q, v))
        rate = self._rest if holding else self._rate[now]
        error, rate_error = self._q[now] + correction - q[7:], rate + self._correction_rate(correction) - v[6:]
        if step < self._takeoff:
            return Command(tau=self._tau[now] + self._kp * error + self._kd * rate_error, change=self._change[now])
        wish = GAINS.flight_bandwidth * (GAINS.flight_corner * error + rate_error)
        return Command(tau=self._tau[now] + self._inertia(q) @ wish, change=self._change[now])

    def approach(self, q: np.ndarray) -> None:
        """Begin in the posture of ``q`` (nq,), if it is another one than planned, and come to the plan smoothly."""
        off = q[7:] - self._q[0]
        if np.abs(off).max() > WRONG_RAD:
            for rows, share in zip((self._q, self._rate), self.way_back(), strict=False):
                rows[: len(share)] += share[:, None] * off

    def way_back(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Share (k,) of an error at the start that is left while the feet stand flat, and its first two derivatives."""
        steps = min(self._heel_off, self._takeoff)
        share, lasts_s = np.arange(steps) / max(steps, 1), max(steps, 1) * STEP_S
        left = 1 - share**3 * (10 - 15 * share + 6 * share**2)
        rate = -30 * share**2 * (1 - share) ** 2 / lasts_s
        return left, rate, -60 * share * (1 - share) * (1 - 2 * share) / lasts_s**2

    def acceleration(self, step: int) -> np.ndarray:
        """Joint accelerations (nv - 6,) of the tape [rad/s^2]."""
        now = min(step, self.steps - 1)
        return (self._rate[now + 1] - self._rate[now]) / STEP_S

    def _arriving(self, at: float, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """State (q, v) in which a command of the tape's step ``at`` arrives, as far off the tape as now."""
        if self.lead == 0:
            return q, v
        due, now = (min(max(x, 0.0), self.steps) for x in (at, at - self.lead))
        moved, gained = (_between(x, due) - _between(x, now) for x in (self._q, self._v))
        base = self.lead * STEP_S * (v[:6] + gained[:6] / 2)
        return pin.integrate(self._model, q, np.concatenate([base, moved])), v + gained

    def _correction_rate(self, correction: np.ndarray) -> np.ndarray:
        change, self._corrected = (correction - self._corrected) / STEP_S, correction
        return change

    def _inertia(self, q: np.ndarray) -> np.ndarray:
        """Torques per joint acceleration (nv - 6, nv - 6) of the free body [kg m^2]."""
        upper = pin.crba(self._model, self._data, q)
        whole = np.triu(upper) + np.triu(upper, 1).T
        lever = whole[:6, 6:]
        return whole[6:, 6:] - lever.T @ solved(whole[:6, :6], lever)

    def attitude_error(self, step: int, q: np.ndarray) -> np.ndarray:
        """How far the trunk is turned away from the plan: rotation vector (3,) in the axes of ``q`` and tape [rad]."""
        planned = self._attitude[min(step, self.steps)]
        return pin.log3(rotation(q[3:7]) @ rotation(planned / np.linalg.norm(planned)).T)


def _resample(grid: np.ndarray, t: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(grid, t, c) for c in columns.T], axis=1)


def _between(rows: np.ndarray, at: float) -> np.ndarray:
    """The row (k,) at a place between two."""
    low = min(int(at), len(rows) - 2)
    return rows[low] + min(at - low, 1.0) * (rows[low + 1] - rows[low])
