"""The controller of one tape: played until the last feet come down, a landing planned on the way
down, the landing controller after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jumplab.arguments import checked, real, shaped
from jumplab.control import STEP_S
from jumplab.control.estimator import SURE
from jumplab.control.flight import FROM_SHARE, Flight, is_flip
from jumplab.control.kinematics import (
    Gauge,
    Motion,
    State,
    headed,
    rotation,
    turned_wrench,
    yaw_of,
)
from jumplab.control.landing import LandingController
from jumplab.control.launch import LaunchFeedback, check_mode
from jumplab.control.playback import Command, Playback, check_tape
from jumplab.control.reaim import Reaim
from jumplab.control.rebound import Rebounds, passages
from jumplab.control.reference import LEAD_S, LandingAhead
from jumplab.control.servo import Drive, servo_of
from jumplab.errors import InputError, quoted
from jumplab.io.tape import AIR, Tape
from jumplab.robot import Robot

LANDINGS = ("planned", "spring")
# how long the robot may hang in the air after the tape's end before the run is given up
WAIT_S = 0.5
TOUCHDOWN_FORCE_N = 30.0  # sum of both feet; 7 % of the weight, ten times the sensor noise
HEADING_DIGITS = 9  # of headings [nrad]
# so long after touchdown a landing QP is posed each 4 ms, then each 20 ms: of 54 perturbed jumps,
# hops and flips, as many stand as with one each 2 and 10 ms (51 and 52), and most end within
# millimetres; those shoved as they land within 8 cm
SETTLING_S = 0.5
SETTLING_STEPS = 4
CALM_STEPS = 20
OFTENER = 2  # times as often in flips: of 20 backflips in MuJoCo 19 stand, and 18 without
# about the vertical, in the last flight: stage 1's landing lies in the sagittal plane, and leads a
# robot that comes down turning so deep and so slowly that it falls
TURNS_RAD = np.pi / 4
# so long before the ground is due (a flip's legs still have to be stopped then) ...
YIELD_S = 0.03
FLIP_YIELD_S = 0.008
# ... servos of mode "whole-body" get this share of the torque: enough for the posture, too little
# to fight the impact
YIELD_SHARE = 0.2


@dataclass(frozen=True)
class Hardware:
    """Drives, sensors and time steps that a controller works with, as far as it knows them."""

    # torques are known to arrive so late; until touchdown, they are sent ahead
    delay_s: float = 0.0
    force_noise_n: float = 0.0  # standard deviation of the feet's forces
    substeps: int = 1  # in which a simulator takes one step, see :class:`.servo.WholeBodyServo`


def level(x: float) -> float:
    """Height of flat ground [m], wherever."""
    return 0.0


class Controller:
    """Joint torques of one jump, from measured states; it knows no simulator.

    Raises :class:`InputError` if mode or landing make no sense, the tape is another robot's, or
    ``feedback`` is asked in mode "pd".

    Parameters
    ----------
    mode : "position", "pd" or "whole-body", the servo that plays the tape until touchdown, see
        :mod:`.servo`; after it, a landing in torque mode.
    reaim : put the legs in the air to where they can catch the robot, see :class:`.reaim.Reaim`.
    step : allow recovery steps after touchdown, see :class:`.step.RecoveryStep`.
    feedback : let the joints leave the tape on the ground, so that the body as a whole moves as
        planned, see :class:`.launch.LaunchFeedback`. Not in mode "pd". If None, where the tape
        stands on one foot: what is wrong there tips the robot.
    landing : "planned" follows stage 1's landing, planned in flight from the measured state;
        "spring" leads to the stance by spring-dampers alone, and so does "planned" where stage 1
        finds no landing, and after a flight that turns the robot by :data:`TURNS_RAD` or more.
    ground : its height [m] at a place [m] along the heading of the landing.
    hardware : what is known of drives and sensors.
    start_rad : heading in which the robot stands at the start, where the tape begins with zero.
    at_rest : the robot stands still at the start, and a wrong posture is led back to the plan.

    Attributes
    ----------
    looks_rad : heading in which the robot shall land, or has landed; all that looks ahead sees it
        along that one.
    touchdown : step in which the feet come down that end the schedule, and the landing begins;
        None until then.
    ahead : what the landing controller follows, and why.
    rebounds : flights before the last one, see :class:`.rebound.Rebounds`.
    """

    @checked
    def __init__(
        self,
        tape: Tape,
        robot: Robot,
        *,
        mode: str = "position",
        reaim: bool = False,
        step: bool = False,
        feedback: bool | None = None,
        landing: str = "planned",
        ground: Callable[[float], float] = level,
        hardware: Hardware = Hardware(),
        start_rad: float = 0.0,
        at_rest: bool = True,
    ):
        if landing not in LANDINGS:
            raise InputError(f"landing {quoted(landing)}: must be one of {', '.join(LANDINGS)}")
        check_tape(tape, robot)
        self.goal = tape.q[-1]
        tape = tape.until(tape.caught)
        self._gauge = Gauge(robot)
        # without the rounding of a plan that goes straight on: states need not be turned then
        heading = round(self._gauge.heading(self.goal), HEADING_DIGITS)
        self.looks_rad = start_rad + heading
        tape = replace(tape, q=headed(tape.q, heading), f=turned_wrench(tape.f, heading))
        self._last = tape.q[-1]
        self._tau = np.zeros(len(robot.joint_names))
        self._at_rest = at_rest
        self.touchdown: int | None = None
        self.mode = mode
        self.playback = Playback(tape, robot, hardware.delay_s)
        self._servo = servo_of(mode)(robot, hardware.delay_s, hardware.substeps)
        if feedback:
            check_mode(mode)
        if feedback is None:
            alone = (tape.contacts > AIR).sum(axis=1) == 1
            feedback = bool(at_rest and mode != "pd" and alone.any())
        self.feedback = LaunchFeedback(robot, tape, self.playback) if feedback else None
        self._awaited = tape.contacts[-1] == AIR  # feet, which end the tape as they come down
        flies = bool(self._awaited.all())
        self.forecast = Flight(robot, tape, ground) if flies else None
        self.landing = LandingController(robot, may_step=step, force_noise_n=hardware.force_noise_n)
        flip = is_flip(tape)
        self.ahead = LandingAhead(robot, landing, _hindrance(tape, self._gauge, flies))
        self._reaim = Reaim(robot, tape, legs_alone=flip) if reaim and flies else None
        self._shifts = reaim and flip
        self._often = OFTENER if flip else 1
        size = self.landing.body.size
        self._yield_s = size.of(FLIP_YIELD_S if flip else YIELD_S, "s") + hardware.delay_s
        self._settling = size.of(SETTLING_S, "s") / STEP_S
        touches_n = size.of(TOUCHDOWN_FORCE_N, "N")
        self._touches_n = max(touches_n, SURE * np.sqrt(2) * hardware.force_noise_n)
        earlier = passages(robot, tape, tape.flights[: -1 if flies else None], ground, reaim)
        limits = self._touches_n, hardware.force_noise_n
        self.rebounds = Rebounds(robot, tape, self.playback, earlier, *limits)
        self._looks_from = round(_looks_from_s(tape, self._awaited) / STEP_S)

    @property
    def last_step(self) -> int:
        """Step at which a robot that is still in the air is given up."""
        return self.playback.steps + self.rebounds.late + round(WAIT_S / STEP_S)

    @property
    def solves(self) -> tuple[int, int]:
        """QPs posed in torque mode, and how many of them failed."""
        used = self.landing.solver, self.rebounds.solver
        return sum(x.solves for x in used), sum(x.failures for x in used)

    @property
    def steps_s(self) -> tuple[float, ...]:
        """When recovery steps began, since the touchdown [s]."""
        return tuple(self.landing.step.starts_s)

    def to_json(self) -> dict:
        """Settings of this controller, for the settings of a result."""
        feedback = self.feedback and self.feedback.to_json()
        return dict(feedback=feedback, landing=self.ahead.to_json())

    def torque(self, t: float, state: State) -> np.ndarray:
        """Joint torques (nv - 6,) [N m] at ``t`` since the tape began [s], from the measured
        ``state``: what drives make of :meth:`drive` that have the same encoders and get it at once.

        Without any simulator: call it once in each :data:`~jumplab.control.STEP_S` with a
        :class:`.kinematics.State` of what the robot measures, and send the torques to the motors.
        Raises :class:`InputError` where the state is no number, or not this robot's.
        """
        model = self._gauge.model
        sizes = {"q": (model.nq,), "v": (model.nv,), "wrench": (2, 6)}
        t = real(t, "t", "s")
        state = State(*(shaped(getattr(state, k), n, f"the state's {k}") for k, n in sizes.items()))
        for name, x in zip(sizes, state, strict=True):
            if not np.isfinite(x).all():
                raise InputError(
                    f"the state's {name} has entries that are no number at t = {t:g} s; "
                    "stop the motors and check the sensors"
                )
        return self.drive(t, state).torque(state.q[7:], state.v[6:])

    def drive(self, t: float, state: State) -> Drive:
        """Values to send to the joints' drives at ``t`` since the tape began [s], from the measured
        ``state``; to be called once in each :data:`~jumplab.control.STEP_S`.
        """
        step = round(t / STEP_S)
        if self.touchdown is not None and not self._decides(step - self.touchdown):
            return Drive(self._tau)
        command = self.command(step, state.along(self.looks_rad))
        if command.q is None:
            return Drive(command.tau)
        return self._servo.drive(command, *(command.state or state[:2]))

    def command(self, step: int, state: State) -> Command:
        """Command to the joints at ``step``, from the state as it is seen along the heading of the
        landing; after touchdown, the landing controller's torque.
        """
        if step == 0 and self._at_rest:
            self.playback.approach(state.q)
            if self.feedback is not None:
                self.feedback.begin(state.q)
        if self.touchdown is None:
            at = step - self.rebounds.late
            if at < self._looks_from or not self._touches(at, state):
                flies = self.forecast is not None and at >= self._looks_from
                return self._fly(at, state) if flies else self._play(step, state)
            state = self._touch(step, state)
        since = (step - self.touchdown) * STEP_S
        self._tau = self.landing.torque(since, *state[:2], state.wrench[:, 2])
        return Command(tau=self._tau)

    def _play(self, step: int, state: State) -> Command:
        """Before the last flight is under way."""
        command = self.rebounds.command(step, state)
        at = step - self.rebounds.late
        if command is None:
            command = self.playback.command(at, *state[:2])
        if self.feedback is None or command.q is None:
            return command
        return self.feedback(at, command, state)

    def _touches(self, step: int, state: State) -> bool:
        """Whether the feet that are awaited come down; beside one that stands, in time at least."""
        late = self.forecast is None and step >= self.playback.steps
        return late or state.wrench[self._awaited, 2].sum() > self._touches_n

    def _fly(self, step: int, state: State) -> Command:
        q, v, _ = state
        now = self._gauge.motion(q, v)
        left = self.forecast.time_left(now)
        shift = self.forecast.shift(step, now, left) if self._shifts else ()
        if left <= LEAD_S and self.ahead.followed is None:
            self._look_ahead(step, now, left)
        aimed = 0.0, 0.0, 0.0
        if self._reaim is not None:
            turn = self.forecast.turn_ahead(step, now, left)
            aimed = self._reaim.correction(now, turn, left)
        command = self.playback.command(step, q, v, aimed, *shift)
        if self._shifts:
            command = replace(command, tau=self.forecast.torque(command, q, v))
        return replace(command, share=YIELD_SHARE) if left <= self._yield_s else command

    def _decides(self, since: int) -> bool:
        """Whether the landing controller poses a QP ``since`` touchdown in steps."""
        steps = SETTLING_STEPS if since < self._settling else CALM_STEPS
        return since % (steps // self._often) == 0

    def _look_ahead(self, step: int, now: Motion, left: float) -> None:
        """Plan the landing for the touchdown in ``left`` seconds."""
        turn = self.forecast.turn_ahead(step, now, left)
        correction = 0.0
        if self._reaim is not None:
            correction, turn = self._reaim.touchdown(now, turn, left)
        there = self.forecast.state(now, turn, left, correction)
        self.landing.reference = self.ahead.plan(*there, step * STEP_S, left)

    def _touch(self, step: int, state: State) -> State:
        """Begin the landing; the state comes back as it is seen from now on.

        Soles point where the trunk does, and along that heading the robot has to be caught.
        """
        self.touchdown = step
        turn = rotation(state.q[3:7]) @ rotation(self._last[3:7]).T
        yaw = round(yaw_of(turn), HEADING_DIGITS)
        self.looks_rad += yaw
        state = state.along(yaw)
        if self.ahead.followed is None:  # ground came early
            self.landing.reference = self.ahead.plan(*state[:2], step * STEP_S, 0.0)
        return state


def _hindrance(tape: Tape, gauge: Gauge, flies: bool) -> str | None:
    """Reason for which stage 1's landing cannot be followed; None if it can be."""
    if not flies:
        return "a robot that stands on one foot does not fall onto the other"
    headings = [gauge.heading(q) for q in tape.q[tape.flights[-1]]]
    if not is_flip(tape):  # upside down, feet point backwards
        headings = np.unwrap(headings)
    turned = abs(headings[-1] - headings[0])
    if turned < TURNS_RAD:
        return None
    return f"stage 1 knows no landing after a turn by {np.degrees(turned):.0f} degrees"


def _looks_from_s(tape: Tape, awaited: np.ndarray) -> float:
    """Time [s] from which on feet that are ``awaited`` (2,), in the air at the tape's end, may come
    down: sooner, a graze of the ground is no landing.
    """
    end = float(tape.t[-1])
    left = np.flatnonzero((tape.contacts[:, awaited] > AIR).any(axis=1))
    begin = float(tape.t[left[-1] + 1]) if len(left) else end
    return begin + FROM_SHARE * (end - begin)
