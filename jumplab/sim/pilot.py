"""Who commands when: the tape until touchdown, a landing planned on the way down, the landing controller after it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, JumplabError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.estimator import SURE
from jumplab.sim.kinematics import Gauge, headed, yaw_of
from jumplab.sim.landing import PERIOD_STEPS, LandingController
from jumplab.sim.launch import LaunchFeedback
from jumplab.sim.playback import Command, Playback
from jumplab.sim.reaim import FROM_SHARE, Reaim, Tuck, is_flip
from jumplab.sim.reference import LEAD_S, Forecast, LandingAhead, LandingSource, Replan, landing_planner
from jumplab.sim.result import STAND_S
from jumplab.sim.scene import Scene

LANDINGS = ("planned", "spring")
# The paper prints none of these numbers.
WAIT_S = 0.5  # how long the robot may hang in the air after the tape's end before the run is given up
TOUCHDOWN_FORCE_N = 30.0  # sum of both feet; 7 % of the weight, ten times the sensor noise
EARLIEST_TOUCHDOWN = 0.5  # share of the planned flight before which a graze of the ground is no landing
YIELD_S, FLIP_YIELD_S = (
    0.03,
    0.008,
)  # so long before the ground is due (a flip's legs still have to be stopped then) ...
YIELD_SHARE = 0.2  # ... servos get this share of the torque: enough for the posture, too little to fight the impact
EXTRA_S = 0.05  # simulated beyond the time to stand, so that the last step is not decided by rounding
AFTER_FALL_S = 0.5  # a fall is shown for this long


class Pilot:
    """Decides the command of each step: playback until touchdown, landing controller afterwards.

    Tape, robot and scene are as planned; ``mode`` is that of :class:`Playback`, the rest that of
    :func:`jumplab.sim.simulate_jump`. Until touchdown, commands are sent ``lead_s`` ahead. ``start_rad`` is the heading
    in which the robot stands at the start, where the tape begins with zero. ``leads_back`` is for a start at rest: a
    wrong posture is led back to the plan, see :meth:`Playback.approach`. With ``may_step`` the landing may take a
    recovery step; with ``feedback`` the launch is corrected. Foot forces err by ``force_noise_n`` [N] each.

    Attributes
    ----------
    looks_rad : heading in which the robot shall land, or has landed if its legs are re-aimed; all that looks ahead sees
        it along that one.
    touchdown : step of the first contact after the flight, None until then.
    ahead : what the landing controller follows, and why.
    last_step : at which a robot that is still in the air is given up.
    """

    part = 0

    def __init__(
        self,
        tape: Tape,
        robot: Robot,
        scene: Scene,
        mode: str,
        landing: str,
        reference: LandingSource | None = None,
        reaim: bool = True,
        stand_s: float = STAND_S,
        lead_s: float = 0.0,
        start_rad: float = 0.0,
        leads_back: bool = True,
        may_step: bool = False,
        feedback: bool = False,
        force_noise_n: float = 0.0,
    ):
        if landing not in LANDINGS:
            raise InputError(f"landing {landing!r}: must be one of {', '.join(LANDINGS)}")
        self.goal, self._heading, self._start = tape.q[-1], Gauge(robot).heading(tape.q[-1]), start_rad
        self.looks_rad = start_rad + self._heading
        self._robot, self.playback = robot, Playback(tape, robot, mode, lead_s)
        self.feedback = LaunchFeedback(robot, tape, self.playback) if feedback else None
        self._touches_n = max(TOUCHDOWN_FORCE_N, SURE * np.sqrt(2) * force_noise_n)
        tape = replace(tape, q=headed(tape.q, self._heading))
        scene = scene.seen_along(self.looks_rad, robot, self.goal)
        self.forecast = Forecast(robot, tape, scene)
        self._plan_landing = reference if callable(reference) else None
        given = None if callable(reference) else reference
        self._landing = LandingController(robot, reference=given, may_step=may_step, force_noise_n=force_noise_n)
        self.ahead = LandingAhead(landing if reference is None else "given")
        if self.ahead.source == "planned":
            self._prepare()
        flip, flight = is_flip(tape), tape.t[-1] - tape.takeoff_time
        self._reaim = Reaim(robot, tape, scene) if reaim else None
        self._tuck = Tuck(robot, tape) if reaim and flip else None
        # other jumps land flat, within a centimetre or two of what was planned for them
        self._replan = Replan(robot) if flip else None
        self._yield_s = (FLIP_YIELD_S if flip else YIELD_S) + lead_s
        self._earliest = round((tape.takeoff_time + EARLIEST_TOUCHDOWN * flight) / STEP_S)
        self._tape_until, self._takeoff = self._earliest, tape.takeoff_index
        if self._tuck is not None:
            self._tape_until = min(self._earliest, round((tape.takeoff_time + FROM_SHARE * flight) / STEP_S))
        self._none = self._tau = np.zeros(len(robot.joint_names))
        self._stand_s, self._leads_back = stand_s, leads_back
        self.last_step = self.playback.steps + round(WAIT_S / STEP_S)
        self.touchdown: int | None = None

    def _prepare(self) -> None:
        """Build the planner now, so that the solve in flight is all that is left to do."""
        try:
            landing_planner(self._robot)
        except JumplabError as e:  # a robot for which stage 1 has no landing
            self.ahead.followed, self.ahead.reason = "spring", str(e)

    @property
    def solves(self) -> tuple[int, int]:
        """QPs posed by the landing controller, and how many of them failed."""
        return self._landing.qp.solves, self._landing.qp.failures

    def landing_said(self) -> dict:
        """What the settings of a result say about the landing, and how often that of a flip was planned anew."""
        return self.ahead.to_json() | {"again": self._replan and self._replan.to_json()}

    @property
    def stepped_s(self) -> float | None:
        """When a recovery step began, since the touchdown; None if none did."""
        return self._landing.step.began_s if self._landing.stepped else None

    def over(self, step: int, fallen_s: float) -> bool:
        """Whether the robot has stood or lain for long enough, or will never come down."""
        if self.touchdown is None:
            return step >= self.last_step
        return step >= self.touchdown + round((self._stand_s + EXTRA_S) / STEP_S) or fallen_s > AFTER_FALL_S

    def command(self, step: int, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> Command:
        """Command at ``step`` from measured state and foot wrenches (2, 6).

        The tape is played in the axes of the start; all that looks ahead sees the robot along the heading in which it
        shall land.
        """
        played = headed(q, self._start)
        if step == 0 and self._leads_back:
            self.playback.approach(played)
            if self.feedback is not None:
                self.feedback.begin(played)
        if self.touchdown is None and step < self._tape_until:
            command = self.playback.command(step, played, v, self._none)
            if self.feedback is None:
                return self._close(step, command, played, self.seen(q), v)
            own = wrench.reshape(2, 2, 3) @ pin.rpy.rpyToMatrix(0.0, 0.0, self._start)
            return self.feedback(step, command, played, v, own.reshape(2, 6))
        q, force = self.seen(q), wrench[:, 2]
        if self.touchdown is None:
            if step < self._earliest or force.sum() <= self._touches_n:
                return self._fly(step, played, q, v)
            q = self._touch(step, played, q, v)
        since = step - self.touchdown
        if self._replan is not None and self.ahead.followed == "planned" and not self._landing.stepped:
            self._landing.reference = self._replan.follow(since * STEP_S, q, v, self._landing.reference)
        if since % PERIOD_STEPS == 0:
            self._tau = self._landing.torque(since * STEP_S, q, v, force)
        return Command(tau=self._tau)

    def seen(self, q: np.ndarray) -> np.ndarray:
        """A configuration (nq,) of the world, seen along the heading of the landing."""
        return headed(q, self.looks_rad)

    def heading_error(self, step: int, seen: np.ndarray) -> float:
        """How far the trunk is turned about the vertical beyond the plan [rad]."""
        return float(self.playback.attitude_error(step, headed(seen, -self._heading))[2])

    def _close(self, step: int, command: Command, played: np.ndarray, q: np.ndarray, v: np.ndarray) -> Command:
        """Early in flight: the tape's ``command``, or another one if the tuck of a flip has to close sooner.

        ``played`` and ``q`` as of :meth:`_fly`.
        """
        if self._tuck is None or step < self._takeoff:
            return command
        shift = self._tuck.closing(step, q, v, self.forecast.time_left(q, v))
        return command if shift == (0.0, 0.0) else self.playback.shifted(step, *shift, played, v, self._none)

    def _fly(self, step: int, played: np.ndarray, q: np.ndarray, v: np.ndarray) -> Command:
        """In flight: ``played`` is the configuration in the tape's axes, ``q`` in those of the landing."""
        left, aimed = self.forecast.time_left(q, v), self._none
        shift = None if self._tuck is None else self._tuck.shift(step, q, v, left)
        if left <= LEAD_S:
            self._look_ahead(step, played, q, v, left)
        if self._reaim is not None:
            turn = self._turn(step, played, q, v, left)
            aimed = self._reaim.correction(q, v, turn, left, self._tuck is not None)
        if shift is None:
            command = self.playback.command(step, played, v, aimed)
        else:
            command = self.playback.shifted(step, *shift, played, v, aimed)
        return replace(command, share=YIELD_SHARE) if left <= self._yield_s else command

    def _look_ahead(self, step: int, played: np.ndarray, q: np.ndarray, v: np.ndarray, left: float) -> None:
        """Plan the landing for the touchdown in ``left`` seconds, unless that is done."""
        if self.ahead.source != "planned" or self.ahead.followed is not None:
            return
        there = q, v
        if left > 0:
            turn = self._turn(step, played, q, v, left)
            correction, turn = (None, turn) if self._reaim is None else self._reaim.touchdown(q, v, turn)
            there = self.forecast.state(q, v, turn, correction)
        self._landing.reference = self.ahead.plan(self._robot, *there, step * STEP_S, left)

    def _turn(self, step: int, played: np.ndarray, q: np.ndarray, v: np.ndarray, left: float) -> np.ndarray:
        """How far (3, 3) the trunk will be off its planned attitude at touchdown, in ``left`` seconds.

        Without re-aim only the pitch is told, as it is now.
        """
        if self._tuck is not None:
            return self._tuck.turn_ahead(step, q, v, left)
        x, y, z = self.playback.attitude_error(step, played)
        if self._heading != 0:
            c, s = np.cos(self._heading), np.sin(self._heading)
            x, y = c * x + s * y, c * y - s * x
        if self._reaim is None:
            return pin.rpy.rpyToMatrix(0.0, _within_half_a_turn(y), 0.0)
        turn = pin.exp3(np.array([x, y, z]))
        return self._reaim.turn_ahead(q, v, turn, left) if 0 < left < np.inf else turn

    def _touch(self, step: int, played: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Begin the landing; the configuration (nq,) comes back as it is seen from now on.

        Re-aimed soles point where the trunk does, and along that heading the robot has to be caught.
        """
        self.touchdown = step
        if self._reaim is not None:
            yaw = yaw_of(self._turn(step, played, q, v, 0.0))
            self.looks_rad, q = self.looks_rad + yaw, headed(q, yaw)
        if self._plan_landing is not None:
            self._landing.reference = self._plan_landing(q, v)
            self.ahead.followed = "spring" if self._landing.reference is None else "given"
        self._look_ahead(step, played, q, v, 0.0)  # the ground came early
        return q


def _within_half_a_turn(angle: float) -> float:
    return float(np.arctan2(np.sin(angle), np.cos(angle)))
