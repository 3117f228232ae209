"""The tape, step by step, as commands that the servos of :mod:`.servo` turn into
what joints are sent. The paper plays it in position mode (Sec. VI-B).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.polynomial import Polynomial
from scipy.interpolate import PPoly

from jumplab.control import STEP_S
from jumplab.control.kinematics import Gauge
from jumplab.errors import InputError
from jumplab.io import tape as tapes
from jumplab.io.tape import Tape
from jumplab.robot import Robot

# how the left and the right foot stand
Stand = tuple[int, int]
FLAT: Stand = (tapes.FLAT, tapes.FLAT)
TOE: Stand = (tapes.TOE, tapes.TOE)
AIR: Stand = (tapes.AIR, tapes.AIR)
# a start farther off than sensors err is led back until the heels rise; sooner, the robot tips
WRONG_RAD = 0.02
WAY_BACK = Polynomial([1.0, 0.0, 0.0, -10.0, 15.0, -6.0])  # of time, smooth at 0 and at 1


@dataclass(frozen=True)
class Command:
    """Command to the joints for one step: a motion, which the servo follows, or only a torque."""

    q: np.ndarray | None = None  # (nv - 6,) [rad]
    rate: np.ndarray | None = None  # (nv - 6,) [rad/s]
    acceleration: np.ndarray | None = None  # (nv - 6,) [rad/s^2]
    tau: np.ndarray | None = None  # (nv - 6,) of the plan, or that is to be given [N m]
    change: np.ndarray | float = 0.0  # of ``tau`` within the step, as planned [N m]
    feet: Stand = AIR  # how they stand by the plan
    # (2, 6) of the plan on them, as on a tape; None: none
    wrench: np.ndarray | None = None
    share: float = 1.0  # of the torque limit, for the servo
    # (q, v) that it is expected to arrive in; as measured if None
    state: tuple[np.ndarray, np.ndarray] | None = None


class Playback:
    """The tape on the 1 ms grid of control, as commands. After its end the last posture is held.

    Raises :class:`InputError` if the tape is another robot's.

    Commands that are known to arrive ``lead_s`` late are those of the tape so much later. The robot
    is expected to be as far off the tape then as it is measured to be now: the plan is sent ahead,
    errors are met late.

    Attributes
    ----------
    q, v : (steps + 1, nq) and (steps + 1, nv), the tape on that grid, as it was planned.
    """

    def __init__(self, tape: Tape, robot: Robot, lead_s: float = 0.0):
        check_tape(tape, robot)
        self.steps = round(float(tape.t[-1]) / STEP_S)
        self.lead = round(lead_s / STEP_S)
        self._gauge = Gauge(robot)
        self._grid = np.arange(self.steps + 1) * STEP_S
        self._n = n = len(robot.joint_names)
        self.q, self.v, tau, wrench = (
            resampled(self._grid, tape.t, rows) for rows in (tape.q, tape.v, tape.tau, tape.f)
        )
        change = np.diff(tau, axis=0, append=tau[-1:])
        # angles, rates, torques, their changes and wrenches side by side: one row is read at a time
        self._rows = np.hstack([self.q[:, 7:], self.v[:, 6:], tau, change, wrench.reshape(-1, 12)])
        self._q, self._rate, _, change = self._rows[:, : 4 * n].reshape(-1, 4, n).swapaxes(0, 1)
        last = np.searchsorted(tape.t, self._grid + STEP_S / 2, side="right") - 1
        self._stands = tape.contacts[last]
        changes = np.diff((self._stands > tapes.AIR).astype(int), axis=0)
        # the first step in which a foot comes down
        self.lands = int(np.argmax([*(changes > 0).any(axis=1), True])) + 1
        change[:-1][changes.any(axis=1)] = 0.0  # what the ground gives changes there at once
        moved = (self._stands != self._stands[0]).any(axis=1)
        # the first step in which a foot stands otherwise
        self._moves = int(np.argmax([*moved[:-1], True]))

    def stands(self, step: float) -> Stand:
        """Contact of the left and of the right foot by the plan."""
        return tuple(self._stands[min(max(int(step), 0), self.steps)].tolist())

    def command(
        self,
        step: int,
        q: np.ndarray,
        v: np.ndarray,
        correction: Sequence[np.ndarray | float] = (0.0, 0.0, 0.0),
        shift_s: float = 0.0,
        pace: float = 0.0,
        gain: float = 0.0,
    ) -> Command:
        """Command to send at one step, from the measured ``q`` (nq,) and ``v`` (nv,).

        ``correction`` (3, nv - 6) is added to angles, rates and accelerations [rad, rad/s,
        rad/s^2]. The tape is read ``shift_s`` beyond the step, and ``1 + pace`` times as fast,
        which grows by ``gain`` [1/s].
        """
        due = step + self.lead + shift_s / STEP_S
        at = min(max(due, 0.0), float(self.steps))
        row = between(self._rows, at)
        angles, rate, tau, change = row[: 4 * self._n].reshape(4, -1)
        acceleration = (1 + pace) ** 2 * (between(self._rate, at + 1.0) - rate) / STEP_S
        acceleration += gain * rate
        return Command(
            q=angles + correction[0],
            rate=((1 + pace) * rate if at < self.steps else np.zeros(self._n)) + correction[1],
            acceleration=acceleration + correction[2],
            tau=tau,
            change=change,
            feet=self.stands(at),
            wrench=row[4 * self._n :].reshape(2, 6),
            state=self._arriving(due, q, v),
        )

    def approach(self, q: np.ndarray) -> None:
        """Begin in the posture of ``q`` (nq,), if it is another one than planned, and come to the
        plan smoothly.
        """
        error = q[7:] - self._q[0]
        if np.abs(error).max() > WRONG_RAD:
            for rows, share in zip((self._q, self._rate), self.way_back(), strict=False):
                rows[: len(share)] += share[:, None] * error

    def add(self, way: PPoly) -> None:
        """Add joint angles (nv - 6,) over time [s], with their rates, to the tape's while the
        ``way`` lasts.
        """
        rows = (self._grid >= way.x[0]) & (self._grid < way.x[-1])
        self._q[rows] += way(self._grid[rows])
        self._rate[rows] += way(self._grid[rows], 1)

    def way_back(self) -> list[np.ndarray]:
        """Share (k,) of an error at the start that is left while the feet stand as there, and its
        first two derivatives [1, 1/s, 1/s^2].
        """
        steps = self._moves
        share = np.arange(steps) / max(steps, 1)
        lasts_s = max(steps, 1) * STEP_S
        return [WAY_BACK.deriv(k)(share) / lasts_s**k for k in range(3)]

    def acceleration(self, step: int) -> np.ndarray:
        """Joint accelerations (nv - 6,) of the tape [rad/s^2]."""
        now = min(step, self.steps - 1)
        return (self._rate[now + 1] - self._rate[now]) / STEP_S

    def planned(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """State (nq,), (nv,) and acceleration (nv,) of the tape as it was planned."""
        now = min(step, self.steps - 1)
        return self.q[step], self.v[step], (self.v[now + 1] - self.v[now]) / STEP_S

    def _arriving(self, at: float, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """State (q, v) in which a command of the tape's step ``at`` arrives, as far off the tape as
        now.
        """
        if self.lead == 0:
            return q, v
        due, now = (min(max(x, 0.0), self.steps) for x in (at, at - self.lead))
        moved = between(self._q, due) - between(self._q, now)
        gained = between(self.v, due) - between(self.v, now)
        base = self.lead * STEP_S * (v[:6] + gained[:6] / 2)
        return pin.integrate(self._gauge.model, q, np.concatenate([base, moved])), v + gained


def check_tape(tape: Tape, robot: Robot) -> None:
    """Refuse (:class:`InputError`) a tape of another robot's joints."""
    names = tuple(map(str, tape.joint_names))
    if names != robot.joint_names:
        raise InputError(
            f"the tape's joints {', '.join(names[:3])} ... are not those of robot "
            f"{robot.name}; plan the jump again with this robot"
        )


def resampled(grid: np.ndarray, t: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows (n, ...) at times ``grid`` (n,) [s] of ``rows`` (N, ...) at times ``t`` (N,) [s]."""
    columns = [np.interp(grid, t, column) for column in rows.reshape(len(t), -1).T]
    return np.transpose(columns).reshape(len(grid), *rows.shape[1:])


def between(rows: np.ndarray, at: float) -> np.ndarray:
    """The row (...) of ``rows`` (N, ...) at a place between two."""
    low = min(int(at), len(rows) - 2)
    share = min(at - low, 1.0)
    return rows[low] + share * (rows[low + 1] - rows[low]) if share else rows[low]
