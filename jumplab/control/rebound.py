"""Flights before the last one of a tape: the robot comes down on both feet, and goes on.

A tape that is played through them has errors that grow like a pendulum's, from one contact to the
next. Here, as after the last flight, a whole-body QP in torque mode takes over as the feet touch
the ground; but it leads CoM, angular momentum, trunk and posture along the tape, until the feet
leave again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from jumplab.control import STEP_S
from jumplab.control.body import PERIOD_STEPS, PITCH, Footing, solver
from jumplab.control.flight import Flight
from jumplab.control.kinematics import Gauge, State
from jumplab.control.landing import GAINS, PLANNED_FRICTION, SOLE_SHARE, LandingController
from jumplab.control.launch import FADE_SHARE, balance_rows
from jumplab.control.playback import AIR, FLAT, Command, Playback
from jumplab.control.reaim import Reaim
from jumplab.io import tape as tapes
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.legs import size

# the next flight hangs on height, place and angular momentum at its start. Two bounds of four
# perturbed robots in each engine: the second begins with 1 cm/s of speed aside and 0.3 kg m^2/s of
# roll too much (rms); with the landing's own rates and weights ahead and aside 10 cm/s and 0.8
TRACKING = replace(
    GAINS,
    com_rate_xy=6.0,
    com_rate_z=10.0,
    com_weight=(30.0, 30.0, 30.0),
    momentum_rate=16.0,
    momentum_weight=3.0,
)
# [s] so long before a touchdown is due, its forecast is made no more: it knows no ground
NEAR_S = 0.03
# of soles to the axes of the last landing, in which the CoP's and the legs' rows are written
ALONG_RAD = 0.3


class Tracker(LandingController):
    """Torques that lead the robot along the tape while its feet stand."""

    def __init__(self, robot: Robot, tape: Tape, playback: Playback, force_noise_n: float):
        super().__init__(robot, force_noise_n=force_noise_n, gains=TRACKING)
        self._gauge = Gauge(robot)
        self._playback = playback
        self._rows = balance_rows(robot, tape, playback.steps)
        self._due = 0
        self._footing = Footing(robot, PLANNED_FRICTION, *SOLE_SHARE)
        self._pitch_weights = self._foot_weights[..., PITCH].copy()

    def begin(self) -> None:
        """Feet come down once more, perhaps on other ground."""
        self._last_contact[:] = -np.inf
        self._ground = np.inf
        self._leaning[:] = False

    def lead(self, step: int, state: State) -> np.ndarray:
        """Torques (nv - 6,) [N m] with which the robot, in a measured ``state``, goes on as the
        tape does from ``step``.
        """
        due = min(step + self._playback.lead, len(self._rows) - 2)
        if self._playback.stands(due) != AIR:  # of a take-off that is due, the last contact
            self._due = due
        self._stand = self._playback.stands(self._due)
        self._planned = q, v, gained = self._playback.planned(self._due)
        self._rest = q[7:]
        self._rest_rates = v[6:]
        self._rest_push = gained[6:]
        self._anchors, self._corners = self._footing.of(self._stand)
        on_toe = np.equal(self._stand, tapes.TOE)  # such a foot may pitch
        self._foot_weights[..., PITCH] = np.where(on_toe[:, None], 0.0, self._pitch_weights)
        com, *goal, left, right = self._rows[self._due]
        # the plan goes on where the feet are
        moved = self._gauge.toe(state.q) - (left + right) / 2
        self._led_to = com + moved, *goal
        return self.torque(step * STEP_S, *state[:2], state.wrench[:, 2])

    def standing(self, time: float, foot_force: np.ndarray) -> np.ndarray:
        """Which feet (2,) may carry weight: those that feel the ground, if any does; on their toes
        both.
        """
        felt = super().standing(time, foot_force)
        flat = self._stand == FLAT and felt.any()
        return felt if flat else np.ones(2, bool)

    def _goal(self, time: float, foot_middle: np.ndarray) -> Sequence[np.ndarray]:
        """As of every landing controller, (3,) each; those of the tape."""
        return self._led_to

    def _trunk_wish(self, v: np.ndarray) -> np.ndarray:
        """Angular acceleration (3,) of the trunk in its own axes, towards the tape's attitude."""
        return self.body.trunk_wish(v, *self._planned, self.gains.trunk_rate)


@dataclass
class Passage:
    """A flight before the last one, between its first and its last step on the tape."""

    begin: int
    end: int
    flight: Flight
    reaim: Reaim | None
    near_s: float  # so long before a touchdown is due, its forecast is made no more

    shift_s: float = 0.0  # by which the tape is read ahead

    def __post_init__(self):
        self._due_s = self.flight.end_s  # when its touchdown is due, on the tape's clock

    def command(self, step: int, state: State, gauge: Gauge, playback: Playback) -> Command:
        """Command at a ``step`` of the tape: the rest of it in the time that is left [s], the legs
        to where they catch the robot.
        """
        t = step * STEP_S
        now = gauge.motion(*state[:2])
        left = self.flight.time_left(now)
        if self._due_s - t > self.near_s and np.isfinite(left):
            self._due_s = t + left
        left = max(self._due_s - t, 0.0)
        aimed = 0.0, 0.0, 0.0
        if self.reaim is not None:
            aimed = self.reaim.correction(now, self.flight.turn_ahead(step, now, left), left)
        before = self.shift_s
        at = float(self.flight.place(0.0, t, t, left))
        self.shift_s = min(at, (self.end - 1) * STEP_S) - t
        pace = (self.shift_s - before) / STEP_S
        command = playback.command(step, *state[:2], aimed, self.shift_s, pace)
        return replace(command, feet=AIR)  # also of a robot that comes down later than planned

    def may_end(self, step: int) -> bool:
        """Whether feet that feel the ground at a ``step`` have come down; sooner, they graze it."""
        return step * STEP_S >= self.flight.from_s


def passages(
    robot: Robot, tape: Tape, flights: Sequence[slice], ground: Callable[[float], float], aim: bool
) -> list[Passage]:
    """Those of ``flights`` of a tape after which both feet come down flat, along the heading of the
    last landing, and carry until they leave together, over a ``ground`` whose height [m] is known
    at a place [m]; legs are put to where they can catch the robot if ``aim``.
    """
    near_s = size(robot).of(NEAR_S, "s")
    gauge = Gauge(robot)
    starts = np.array([rows.start for rows in tape.flights] + [len(tape.t)])
    found = []
    for rows in flights:
        stands = tape.contacts[rows.stop : starts[starts >= rows.stop][0]]
        both = (stands > tapes.AIR).all()
        flat = (tape.contacts[rows.stop] == FLAT).all()
        if both and flat and abs(gauge.heading(tape.q[rows.stop])) < ALONG_RAD:
            part = tape.until(rows.stop)
            begin, end = (round(float(tape.t[row]) / STEP_S) for row in (rows.start, rows.stop))
            reaim = Reaim(robot, part) if aim else None
            found.append(Passage(begin, end, Flight(robot, part, ground), reaim, near_s))
    return found


class Rebounds:
    """Commands from the first of some ``passages`` of a tape to the take-off of its last flight.

    Attributes
    ----------
    late : steps by which the robot is behind the tape, which is read so much later.
    solver : of the torques between the flights.
    """

    def __init__(
        self,
        robot: Robot,
        tape: Tape,
        playback: Playback,
        passages: list[Passage],
        touches_n: float,
        force_noise_n: float,
    ):
        self.late = 0
        self.solver = solver()
        if passages:
            self._tracker = Tracker(robot, tape, playback, force_noise_n)
            self.solver = self._tracker.solver
        self._playback = playback
        self._gauge = Gauge(robot)
        self._passages = passages
        times = np.append(tape.t, tape.t[-1])
        self._ends = [round(float(times[rows.stop]) / STEP_S) for rows in tape.flights]
        self._touches_n = touches_n
        self._since: int | None = None  # the step in which the feet came down
        self._begun = False

    def command(self, step: int, state: State) -> Command | None:
        """Command at a ``step``, from the measured ``state``; None where the tape is played as it
        is.
        """
        at = step - self.late
        if not self._begun:  # a run may begin later on the tape
            self._passages = [x for x in self._passages if x.end > at]
            self._begun = True
        if self._since is not None:
            if self._playback.stands(at) != AIR:
                return self._lead(step, state)
            self._leave(at, state)
        if not self._passages or at < self._passages[0].begin:
            return None
        passage = self._passages[0]
        command = passage.command(at, state, self._gauge, self._playback)
        if not (passage.may_end(at) and state.wrench[:, 2].sum() > self._touches_n):
            return command
        self._passages.pop(0)
        self.late += at - passage.end
        self._since = step
        self._tracker.begin()
        return self._lead(step, state)

    def _lead(self, step: int, state: State) -> Command:
        """Torques (nv - 6,) [N m] of the tracker, held for some steps."""
        if (step - self._since) % PERIOD_STEPS == 0:
            self._tau = self._tracker.lead(step - self.late, state)
        return Command(tau=self._tau)

    def _leave(self, step: int, state: State) -> None:
        """The feet leave: angles (nv - 6,) of joints off the tape [rad] fade in the air."""
        self._since = None
        lasts = FADE_SHARE * (next(end for end in self._ends if end > step) - step)
        off = state.q[7:] - self._playback.q[step, 7:]
        rates = state.v[6:] - self._playback.v[step, 6:]
        t = np.array([step, step + lasts]) * STEP_S
        still = np.zeros_like(off)
        self._playback.add(CubicHermiteSpline(t, np.array([off, still]), np.array([rates, still])))
