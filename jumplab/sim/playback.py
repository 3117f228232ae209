"""Launch and flight as the paper plays them: the tape goes to the joints, and nothing else does (Sec. VI-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, quoted
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim.actuation import Actuators
from jumplab.sim.world import STEP_S, World

MODES = ("position", "pd")

# position mode: Bullet's servo asks for the rate  v + POSITION_GAIN * error / step  at the end of each step
POSITION_GAIN = 0.1  # our choice: an error decays in 10 ms, ten control cycles; the torque limit decides the rest
VELOCITY_GAIN = 1.0  # our choice: the wished rate is met within a cycle, as the inner loop of a drive does

# pd mode: tau = planned + KP * error + KD * rate error; explicit at 1 kHz, so the damping is bounded by the joint's
# reflected inertia over the age of a command. On the ground the body's weight makes that inertia large:
PITCH_KP, PITCH_KD = 800.0, 10.0  # [N m/rad], [N m s/rad] our choice
ANKLE_KP, ANKLE_KD = 300.0, 3.0  # our choice
SIDE_KP, SIDE_KD = 300.0, 2.0  # our choice: yaw and roll joints, which only hold
ARM_KP, ARM_KD = 200.0, 3.0  # our choice: the arm is light
# In the air the foot alone hangs on the ankle (0.005 kg m^2, 0.002 in roll), and with these gains a delay of 1 to 4 ms
# makes it swing at 30 rad/s until touchdown. There the errors ask for accelerations, and the inertia of the whole free
# body turns them into torques: coupled joints then share one bandwidth
FLIGHT_BANDWIDTH = 100.0  # [rad/s] our choice: 0.55 rad of phase are lost to 4 ms of delay and 1.5 ms of sampling
FLIGHT_CORNER = 25.0  # [rad/s] stiffness over damping, our choice: a quarter of the bandwidth; 0.78 rad are left


@dataclass(frozen=True)
class Command:
    """What the motors are told for one step: a position servo's target, or a torque."""

    q: np.ndarray | None = None  # (nv - 6,) [rad]
    rate: np.ndarray | None = None  # (nv - 6,) [rad/s]
    tau: np.ndarray | None = None  # (nv - 6,) [N m]
    share: float = 1.0  # of the torque limit, for the servo


class Playback:
    """The tape on the 1 ms grid of the simulation, as commands. After its end the last posture is held.

    Parameters
    ----------
    mode : "position" (servo with the planned rate fed forward) or "pd" (planned torque plus PD in torque mode).

    Raises
    ------
    InputError
        If the mode is unknown or the tape belongs to another robot.
    """

    def __init__(self, tape: Tape, robot: Robot, mode: str = "position"):
        if not isinstance(mode, str) or mode not in MODES:
            raise InputError(f"mode {quoted(mode)}: must be one of {', '.join(MODES)}")
        names = tuple(str(n) for n in tape.joint_names)
        if names != robot.joint_names:
            raise InputError(f"the tape's joints {', '.join(names[:3])} ... are not those of robot {robot.name}")
        self.mode = mode
        self.steps = round(float(tape.t[-1]) / STEP_S)
        grid = np.arange(self.steps + 1) * STEP_S
        # Bullet's steps are semi-implicit: a joint whose rate is right at every step runs half a step ahead
        self._ahead = _resample(grid + STEP_S / 2, tape.t, tape.q[:, 7:])
        self._q, self._rate, self._tau = (_resample(grid, tape.t, x) for x in (tape.q[:, 7:], tape.v[:, 6:], tape.tau))
        self._pitch = _resample(grid, tape.t, np.unwrap(_pitch(tape.q))[:, None])[:, 0]
        self._rest = np.zeros(len(names))
        self._kp, self._kd = _gains(robot)
        self._model, self._data = robot.model, robot.model.createData()
        self._takeoff = round(tape.takeoff_time / STEP_S)
        self._corrected = self._rest

    def shifted(
        self, step: int, shift_s: float, pace: float, q: np.ndarray, v: np.ndarray, correction: np.ndarray
    ) -> Command:
        """As :meth:`command` in flight, the tape read ``shift_s`` beyond ``step``, and ``1 + pace`` times as fast."""
        at = min(max(step + shift_s / STEP_S, 0.0), float(self.steps))
        if at >= self.steps:
            return self.command(self.steps, q, v, correction)
        ahead, angles, rate, tau = (_between(x, at) for x in (self._ahead, self._q, self._rate, self._tau))
        rate = (1 + pace) * rate
        if self.mode == "position":
            return Command(q=ahead + correction, rate=rate)
        change, self._corrected = (correction - self._corrected) / STEP_S, correction
        wish = FLIGHT_BANDWIDTH * (FLIGHT_CORNER * (angles + correction - q[7:]) + rate + change - v[6:])
        return Command(tau=tau + self._inertia(q) @ wish)

    def command(self, step: int, q: np.ndarray, v: np.ndarray, correction: np.ndarray) -> Command:
        """Command for one step; the measured state is read in "pd" mode only, ``correction`` is added to the angles."""
        now = min(step, self.steps)
        holding = step >= self.steps
        if self.mode == "position":
            # the servo steers to the rate that is due at the end of the step
            rate = self._rest if holding else self._rate[min(step + 1, self.steps)]
            return Command(q=self._ahead[now] + correction, rate=rate)
        rate = self._rest if holding else self._rate[now]
        rate = rate + (correction - self._corrected) / STEP_S
        self._corrected = correction
        error, rate_error = self._q[now] + correction - q[7:], rate - v[6:]
        if step < self._takeoff:
            return Command(tau=self._tau[now] + self._kp * error + self._kd * rate_error)
        wish = FLIGHT_BANDWIDTH * (FLIGHT_CORNER * error + rate_error)
        return Command(tau=self._tau[now] + self._inertia(q) @ wish)

    def _inertia(self, q: np.ndarray) -> np.ndarray:
        """Torques per joint acceleration (nv - 6, nv - 6) of the free body [kg m^2]."""
        upper = pin.crba(self._model, self._data, q)
        whole = np.triu(upper) + np.triu(upper, 1).T
        lever = whole[:6, 6:]
        return whole[6:, 6:] - lever.T @ np.linalg.solve(whole[:6, :6], lever)

    def trunk_pitch(self, step: int) -> float:
        """Planned trunk pitch [rad], continuous through full turns."""
        return float(self._pitch[min(step, self.steps)])


class Motors:
    """Turns commands into torques within the limits, and remembers what was really applied."""

    def __init__(self, robot: Robot, gain: dict[str, float]):
        self.actuators = Actuators(robot)
        self._gain = np.array([gain.get(name, 1.0) for name in robot.joint_names])
        self._servo = False

    def apply(self, world: World, command: Command, rate: np.ndarray) -> np.ndarray | None:
        """Give ``command`` to the engine at true joint rates ``rate``; returns the torque, None for a servo."""
        if command.tau is None:
            self._servo = True
            limit = command.share * self.actuators.either_way(rate) * np.minimum(self._gain, 1.0)
            world.command_position(command.q, command.rate, limit, POSITION_GAIN, VELOCITY_GAIN)
            return None
        if self._servo:
            world.release()
            self._servo = False
        tau = np.clip(self._gain * command.tau, *self.actuators.range(rate))
        world.command_torque(tau)
        return tau


def _resample(grid: np.ndarray, t: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(grid, t, c) for c in columns.T], axis=1)


def _between(rows: np.ndarray, at: float) -> np.ndarray:
    """The row (k,) at a place between two."""
    low = min(int(at), len(rows) - 2)
    return rows[low] + (at - low) * (rows[low + 1] - rows[low])


def _pitch(q: np.ndarray) -> np.ndarray:
    """Pitch (N,) of a base that turns about y only [rad]."""
    return 2 * np.arctan2(q[:, 4], q[:, 6])


def _gains(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    role = {name: role for role, pair in robot.joints.items() for name in pair}
    special = {"ankle_pitch": (ANKLE_KP, ANKLE_KD), "shoulder_pitch": (ARM_KP, ARM_KD), None: (SIDE_KP, SIDE_KD)}
    kp, kd = zip(*(special.get(role.get(n), (PITCH_KP, PITCH_KD)) for n in robot.joint_names), strict=True)
    return np.array(kp), np.array(kd)
