"""One simulated jump: the tape in the air, the landing controller on the ground, everything logged, nothing reset."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, quoted, require_type
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import checks as honesty
from jumplab.sim.actuation import Delay
from jumplab.sim.estimator import Perception
from jumplab.sim.perturbation import Perturbation
from jumplab.sim.pilot import Pilot
from jumplab.sim.playback import Motors
from jumplab.sim.recorder import STAND_S, Recorder
from jumplab.sim.reference import LandingSource
from jumplab.sim.result import SimulationResult
from jumplab.sim.scene import Scene
from jumplab.sim.world import STEP_S, World

EXTRA_S = 0.05  # our choice: simulated beyond it, so that the last step is not decided by rounding
AFTER_FALL_S = 0.5  # our choice: a fall is shown for this long


@dataclass(frozen=True)
class Disturbance:
    """A wrong state at the apex of the flight.

    Attributes
    ----------
    speed_factor : on the horizontal velocity of the whole robot [1].
    pitch_rad : turn of the whole robot about its CoM [rad].
    height_m : shift of the whole robot upward [m].
    """

    speed_factor: float = 1.0
    pitch_rad: float = 0.0
    height_m: float = 0.0

    def apex(self, tape: Tape, robot: Robot) -> tuple[int, np.ndarray, np.ndarray]:
        """Step of the tape's apex, and the disturbed configuration (nq,) and velocity (nv,) there."""
        model, data = robot.model, robot.model.createData()
        for row in range(tape.takeoff_index, len(tape.t)):
            pin.centerOfMass(model, data, tape.q[row], tape.v[row])
            if data.vcom[0][2] <= 0:
                break
        q, v, com, speed = tape.q[row].copy(), tape.v[row].copy(), data.com[0].copy(), data.vcom[0].copy()
        turn = pin.rpy.rpyToMatrix(0.0, self.pitch_rad, 0.0)
        attitude = turn @ pin.Quaternion(q[6], q[3], q[4], q[5]).toRotationMatrix()
        q[:3] = com + turn @ (q[:3] - com) + np.array([0.0, 0.0, self.height_m])
        q[3:7] = pin.Quaternion(attitude).coeffs()
        # the base twist is written in base axes and so has turned with the robot; the flight of its CoM must not
        v[:3] += attitude.T @ (speed * [self.speed_factor, 1.0, 1.0] - turn @ speed)
        return round(float(tape.t[row]) / STEP_S), q, v


def simulate_jump(
    tape: Tape,
    robot: Robot,
    *,
    mode: str = "position",
    perturbation: Perturbation | None = None,
    scene: Scene | None = None,
    reaim: bool = False,
    landing: str = "planned",
    reference: LandingSource | None = None,
    stand_s: float = STAND_S,
) -> SimulationResult:
    """Play ``tape`` on a simulated robot, catch it, and watch it stand.

    Parameters
    ----------
    tape : planned launch and flight.
    robot : the robot as planned; the simulated one differs from it by ``perturbation``.
    mode : "position" or "pd", how the tape is played until touchdown.
    perturbation : None simulates the robot as planned.
    scene : ground; flat if None.
    reaim : turn the legs in the air against the trunk's measured pitch error.
    landing : "planned" follows stage 1's landing, planned in flight from the measured state; "spring" leads to the
        stance by spring-dampers alone, and so does "planned" where stage 1 finds no landing. The result's
        ``settings["landing"]`` says what was followed, and what the plan's solve cost.
    reference : overrides ``landing``: a landing to follow, or a function that plans one from the measured state (q, v)
        at touchdown (None: it found none).
    stand_s : how long to watch after touchdown [s]; less than the default is never called a landing.

    Returns
    -------
    SimulationResult
        Also of a jump that fails: see its ``landed`` and ``reason``.

    Raises
    ------
    InputError
        If the tape is not this robot's, or ``mode`` or ``stand_s`` make no sense.
    """
    return _run(tape, robot, mode, perturbation, scene, reaim, landing, reference, stand_s)


def simulate_landing(
    tape: Tape,
    robot: Robot,
    disturbance: Disturbance,
    *,
    mode: str = "position",
    perturbation: Perturbation | None = None,
    scene: Scene | None = None,
    reaim: bool = False,
    landing: str = "planned",
    reference: LandingSource | None = None,
    stand_s: float = STAND_S,
) -> SimulationResult:
    """Like :func:`simulate_jump`, but from a disturbed state at the apex of the flight: one point of the landing basin.

    Time, distance and rise of the result count from the apex.
    """
    return _run(tape, robot, mode, perturbation, scene, reaim, landing, reference, stand_s, disturbance)


def _check(tape, robot, perturbation, scene, reference, stand_s) -> None:
    require_type(tape, Tape, "the tape to play")
    require_type(robot, Robot, "the robot to simulate")
    for value, kind, what in ((perturbation, Perturbation, "the perturbation"), (scene, Scene, "the scene")):
        if value is not None:
            require_type(value, kind, what)
    if not (reference is None or callable(reference) or callable(getattr(reference, "at", None))):
        raise InputError(f"the landing's reference must be one, or a function that plans one, got {quoted(reference)}")
    if not (isinstance(stand_s, int | float) and not isinstance(stand_s, bool) and 0 < stand_s <= 60):
        raise InputError(f"stand_s = {quoted(stand_s)} s is outside 0 ... 60 s")
    for name in ("t", "q", "v", "tau"):
        if not np.all(np.isfinite(getattr(tape, name))):
            raise InputError(f"the tape's {name} has entries that are no number; plan the jump again")
    if not np.any(tape.phase == "flight") or not np.any(tape.phase == "launch"):
        raise InputError("the tape must have a launch and a flight; plan the jump again")


def _run(
    tape, robot, mode, perturbation, scene, reaim, landing, reference, stand_s, disturbance=None
) -> SimulationResult:
    _check(tape, robot, perturbation, scene, reference, stand_s)
    perturbation, scene = perturbation or Perturbation(), scene or Scene.flat()
    real = perturbation.robot(robot)
    pilot = Pilot(tape, robot, mode, scene, landing, reference, reaim)
    motors, delay = Motors(robot, perturbation.motor_gain), Delay(round(perturbation.delay_s / STEP_S))
    step, q, v = (0, tape.q[0], tape.v[0]) if disturbance is None else disturbance.apex(tape, robot)
    perceive = Perception(robot, q, v, perturbation.noise, perturbation.seed)
    with World(real, q, v, scene=scene, friction=perturbation.friction) as world:
        recorder = Recorder(real, tape.q[-1], world.links)
        contacts, end = world.contacts(), pilot.last_step
        while step < end:
            q, v = world.state()
            was_flying = pilot.touchdown is None
            told = delay(pilot.command(step, *perceive(q, v, contacts.wrench)))
            if was_flying and pilot.touchdown is not None:
                end = step + round((stand_s + EXTRA_S) / STEP_S)
            tau = motors.apply(world, told, v[6:])
            world.step()
            contacts = world.contacts()
            recorder.add(q, v, world.servo_torque() if tau is None else tau, contacts)
            if pilot.touchdown is not None and recorder.fallen_steps * STEP_S > AFTER_FALL_S:
                break
            step += 1
        engine = world.read_back()
    settings = {
        "mode": mode, "scene": scene.name, "reaim": reaim,
        "landing": pilot.ahead.to_json() | {"again": pilot.replanned},
        "perception": perceive.to_json(), "stand_s": stand_s, "step_s": STEP_S,
        "robot": robot.name, "robot_hash": robot.hash,
        "friction_read_back": min(engine["friction"]), "engine": engine,
        "perturbation": perturbation.to_json(),
        "disturbance": None if disturbance is None else asdict(disturbance),
    }  # fmt: skip
    result = recorder.result(pilot.solves, settings)
    return replace(result, honesty=honesty.check(result, real))
