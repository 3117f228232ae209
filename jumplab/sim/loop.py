"""The one loop of the simulation: a pilot commands, the engine steps, everything is logged, nothing is reset."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, quoted, require_type
from jumplab.io.progress import tell
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import DEFAULT_ENGINE, STEP_S
from jumplab.sim.checks import check
from jumplab.sim.engine import engine_class
from jumplab.sim.estimator import Perception
from jumplab.sim.kinematics import Gauge, rotation
from jumplab.sim.perturbation import Perturbation
from jumplab.sim.pilot import Pilot
from jumplab.sim.playback import Command, Delay, Motors
from jumplab.sim.reference import LandingSource
from jumplab.sim.result import STAND_S, Recorder, SimulationResult
from jumplab.sim.scene import Scene
from jumplab.sim.servo import Servo

TOLD = 100  # after so many steps it is told how far the run is


class Commander(Protocol):
    """Who commands a run. Its log has parts, each of which shall end on the height of a goal."""

    part: int  # that the last command belongs to, from 0
    goal: np.ndarray  # (nq,) of this part

    def command(self, step: int, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> Command:
        """Command at ``step`` from measured state and foot wrenches (2, 6)."""

    def over(self, step: int, fallen_s: float) -> bool:
        """Whether ``step`` is beyond the end; the robot has lain on the ground for ``fallen_s`` [s]."""


class Run:
    """One run: ``robot`` as planned, perturbed as it really is (``real``), on a ground, in one of the engines."""

    def __init__(
        self,
        robot: Robot,
        perturbation: Perturbation | None = None,
        scene: Scene | None = None,
        engine: str = DEFAULT_ENGINE,
        tape: Tape | None = None,
    ):
        self._open = engine_class(engine)
        self.robot, self.perturbation = robot, perturbation or Perturbation()
        self.scene, self.real = scene or Scene.flat(), self.perturbation.robot(robot)
        self.ground, self.pushes = self.perturbation.ground(self.scene, robot, tape), self.perturbation.pushes(tape)

    def stance(self, tape: Tape) -> tuple[int, np.ndarray, np.ndarray]:
        """First step of ``tape``, and the configuration (nq,) and velocity (nv,) in which the robot stands then."""
        start = self.perturbation.start(self.robot, tape.q[0])
        return 0, self.ground.seated(self.robot, start), tape.v[0]

    def play(self, pilot: Commander, q: np.ndarray, v: np.ndarray, step: int = 0) -> None:
        """Simulate from (q, v) at ``step`` until the pilot says that it is over."""
        how = self.perturbation
        perceive = Perception(self.robot, q, v, how.noise, how.seed)
        motors, delay = Motors(self.real, how.motor_gain, how.sag_per_kw), Delay(round(how.delay_s / STEP_S))
        self.recorders: list[Recorder] = []
        self.push_place, self._begun = self.robot.model.inertias[1].lever.copy(), step
        with self._open(self.real, q, v, scene=self.ground, friction=how.friction) as engine:
            servo = Servo(self.robot, late_s=how.known_delay_s, substeps=engine.substeps)
            contacts, fallen_s = engine.contacts(), 0.0
            while not pilot.over(step, fallen_s):
                if step % TOLD == 0:
                    tell(f"simulated {step * STEP_S:.1f} s")
                q, v = engine.state()
                seen = perceive(q, v, contacts.wrench)
                command = pilot.command(step, *seen)
                if pilot.part == len(self.recorders):
                    higher_m = self.ground.height_of(pilot.goal, self.robot, self.scene)
                    self.recorders.append(Recorder(self.real, pilot.goal, engine.links, higher_m))
                engine.set_torque(motors.deliver(delay(servo.torque(command, *(command.state or seen[:2]))), v[6:]))
                for push in self.pushes:
                    if push.at(step):
                        engine.push(np.array(push.force_n), self.push_place)
                engine.step()
                contacts = engine.contacts()
                self.recorders[-1].add(q, v, engine.applied(), contacts)
                fallen_s = self.recorders[-1].fallen_steps * STEP_S
                step += 1
            self.engine, self.perception = engine.read_back(), perceive.to_json()

    def result(self, part: int, solves: tuple[int, int], **settings: Any) -> SimulationResult:
        """The checked record of one part of the run; ``solves`` are the QPs posed and failed in it."""
        settings |= dict(scene=self.scene.name, robot=self.robot.name, robot_hash=self.robot.hash, step_s=STEP_S)
        settings |= dict(perturbation=self.perturbation.to_json(), perception=self.perception)
        if self.ground is not self.scene or not self.ground.plain:
            settings["ground"] = asdict(self.ground)
        if self.pushes:  # what the checks know of them
            told = [asdict(replace(push, step=push.step - self._begun)) for push in self.pushes]
            settings |= dict(pushes=told, push_place_m=self.push_place.tolist())
        settings |= dict(engine=self.engine, friction_read_back=min(self.engine["friction"]))
        result = self.recorders[part].result(solves, settings)
        return replace(result, checks=check(result, self.real))


@dataclass(frozen=True)
class Disturbance:
    """A wrong state at the apex of the flight."""

    speed_factor: float = 1.0  # on the horizontal velocity of the whole robot [1]
    pitch_rad: float = 0.0  # turn of the whole robot about its CoM, forward along ``direction_rad``
    height_m: float = 0.0  # shift of the whole robot upward
    direction_rad: float = 0.0  # from the heading in which the jump shall land; a quarter turn tips it to its left

    def apex(self, tape: Tape, robot: Robot) -> tuple[int, np.ndarray, np.ndarray]:
        """Step of the tape's apex, and the disturbed configuration (nq,) and velocity (nv,) there."""
        model, data = robot.model, robot.model.createData()
        for row in range(tape.takeoff_index, len(tape.t)):
            pin.centerOfMass(model, data, tape.q[row], tape.v[row])
            if data.vcom[0][2] <= 0:
                break
        q, v, com, speed = tape.q[row].copy(), tape.v[row].copy(), data.com[0].copy(), data.vcom[0].copy()
        along = Gauge(robot).heading(tape.q[-1]) + self.direction_rad
        turn = pin.rpy.rpyToMatrix(0.0, self.pitch_rad, 0.0)
        if along:
            seen = pin.rpy.rpyToMatrix(0.0, 0.0, along)
            turn = seen @ turn @ seen.T
        attitude = turn @ rotation(q[3:7])
        q[:3] = com + turn @ (q[:3] - com) + np.array([0.0, 0.0, self.height_m])
        q[3:7] = pin.Quaternion(attitude).coeffs()
        # the base twist is written in base axes and so has turned with the robot; the flight of its CoM must not
        v[:3] += attitude.T @ (speed * [self.speed_factor, self.speed_factor, 1.0] - turn @ speed)
        return round(float(tape.t[row]) / STEP_S), q, v


def simulate_jump(
    tape: Tape,
    robot: Robot,
    *,
    mode: str = "position",
    perturbation: Perturbation | None = None,
    scene: Scene | None = None,
    reaim: bool = False,
    step: bool = False,
    feedback: bool = False,
    landing: str = "planned",
    reference: LandingSource | None = None,
    stand_s: float = STAND_S,
    disturbance: Disturbance | None = None,
    engine: str = DEFAULT_ENGINE,
) -> SimulationResult:
    """Play ``tape`` on a simulated robot, catch it, and watch it stand.

    Parameters
    ----------
    tape : planned launch and flight.
    robot : the robot as planned; the simulated one differs from it by ``perturbation``.
    mode : "position" or "pd", how the tape is played until touchdown.
    perturbation : None simulates the robot as planned.
    scene : ground; flat if None.
    reaim : put the legs in the air to where they can catch the robot, see :class:`jumplab.sim.reaim.Reaim`.
    feedback : let the joints leave the tape in launch, so that the body as a whole launches as planned, see
        :class:`jumplab.sim.launch.LaunchFeedback`; open loop otherwise. In mode "position" alone.
    step : allow one recovery step after touchdown, see :class:`jumplab.sim.step.RecoveryStep`; the metrics tell it.
    landing : "planned" follows stage 1's landing, planned in flight from the measured state; "spring" leads to the
        stance by spring-dampers alone, and so does "planned" where stage 1 finds no landing. The result's
        ``settings["landing"]`` says what was followed, and what the plan's solve cost.
    reference : overrides ``landing``: a landing to follow, or a function that plans one from the measured state (q, v)
        at touchdown (None: it found none).
    stand_s : how long to watch after touchdown [s]; less than the default is never called a landing.
    disturbance : begin at the apex of the flight, in a state that differs so; time, distance and rise count from there.
    engine : "bullet" or "mujoco", whose physics it is; where PyBullet is not installed, "mujoco" is the default.

    Returns
    -------
    SimulationResult
        Also of a jump that fails: see its ``landed`` and ``reason``.

    Raises
    ------
    InputError
        If the tape is not this robot's, ``mode`` or ``stand_s`` make no sense, the engine is unknown or not there, the
        robot cannot stand on the ground at the start, or ``feedback`` is asked in mode "pd" or without a launch.
    """
    _check(tape, robot, perturbation, scene, reference, stand_s, from_apex=feedback and disturbance is not None)
    run = Run(robot, perturbation, scene, engine, tape)
    known_delay_s = run.perturbation.known_delay_s
    options = dict(may_step=step, feedback=feedback, force_noise_n=run.perturbation.noise.force)
    pilot = Pilot(tape, robot, run.scene, mode, landing, reference, reaim, stand_s, known_delay_s, **options)
    first, q, v = run.stance(tape) if disturbance is None else disturbance.apex(tape, robot)
    run.play(pilot, q, v, first)
    said = dict(mode=mode, reaim=reaim, step=step, stand_s=stand_s, disturbance=disturbance and asdict(disturbance))
    said |= dict(feedback=pilot.feedback and pilot.feedback.to_json(), landing=pilot.landing_said())
    result = run.result(0, pilot.solves, **said)
    return replace(result, metrics=replace(result.metrics, recovery_step_s=pilot.stepped_s))


def simulate_landing(tape: Tape, robot: Robot, disturbance: Disturbance, **options: Any) -> SimulationResult:
    """One point of the landing basin: :func:`simulate_jump` from a disturbed apex, with the other options of that."""
    return simulate_jump(tape, robot, disturbance=disturbance, **options)


def _check(tape, robot, perturbation, scene, reference, stand_s, from_apex) -> None:
    require_type(tape, Tape, "the tape to play")
    require_type(robot, Robot, "the robot to simulate")
    tape.require_jump()
    for value, kind, what in ((perturbation, Perturbation, "the perturbation"), (scene, Scene, "the scene")):
        if value is not None:
            require_type(value, kind, what)
    if not (reference is None or callable(reference) or callable(getattr(reference, "at", None))):
        raise InputError(f"the landing's reference must be one, or a function that plans one, got {quoted(reference)}")
    if not (isinstance(stand_s, int | float) and not isinstance(stand_s, bool) and 0 < stand_s <= 60):
        raise InputError(f"stand_s = {quoted(stand_s)} s is outside 0 ... 60 s")
    if from_apex:
        raise InputError("feedback acts in launch, and a run from the apex has none; leave one of them away")
    for name in ("t", "q", "v", "tau"):
        if not np.all(np.isfinite(getattr(tape, name))):
            raise InputError(f"the tape's {name} has entries that are no number; plan the jump again")
    if not np.any(tape.phase == "flight") or not np.any(tape.phase == "launch"):
        raise InputError("the tape must have a launch and a flight; plan the jump again")
