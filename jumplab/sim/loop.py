"""The one loop of the simulation: a controller commands, the engine steps, everything is logged,
nothing is reset.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jumplab.arguments import checked
from jumplab.control import STAND_S
from jumplab.control.controller import Controller, Hardware
from jumplab.control.kinematics import Gauge, State
from jumplab.control.servo import Drive
from jumplab.errors import InputError
from jumplab.io.progress import tell
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import CONTACTS, DEFAULT_ENGINE, STEP_S
from jumplab.sim.checks import check
from jumplab.sim.engine import engine_class
from jumplab.sim.motors import Motors
from jumplab.sim.perturbation import Perturbation
from jumplab.sim.result import BOTH, SimulationResult, record
from jumplab.sim.scene import Scene
from jumplab.sim.sensors import Perception

# simulated beyond the time to stand, so that the last step is not decided by rounding
EXTRA_S = 0.05
AFTER_FALL_S = 0.5  # a fall is shown for this long
TOLD = 100  # after so many steps it is told how far the run is


class Run:
    """One run: ``robot`` as planned, perturbed as it really is (``real``), on a ground, in one of
    the engines.

    A controller may know its ``hardware``; the ``log`` is there once it was played.
    """

    def __init__(
        self,
        robot: Robot,
        perturbation: Perturbation | None = None,
        scene: Scene | None = None,
        engine: str = DEFAULT_ENGINE,
        tape: Tape | None = None,
        contact: str = CONTACTS[0],
    ):
        kind = engine_class(engine)
        self._open = partial(kind, contact=contact)
        self.robot = robot
        self.perturbation = perturbation or Perturbation()
        self.scene = scene or Scene.flat()
        self.real = self.perturbation.robot(robot)
        self.ground = self.perturbation.ground(self.scene, robot, tape)
        self.pushes = self.perturbation.pushes(tape)
        self.hardware = Hardware(
            delay_s=self.perturbation.known_delay_s,
            force_noise_n=self.perturbation.noise.force,
            substeps=kind.contact_of(contact, self.ground).substeps,
        )

    def play(
        self,
        drive: Callable[[float, State], Drive],
        over: Callable[[int, float], bool],
        q: np.ndarray,
        v: np.ndarray,
        step: int = 0,
    ) -> None:
        """Simulate from ``q`` (nq,) and ``v`` (nv,) at ``step``, until ``over`` says so of a step,
        and of the time for which the robot has lain on the ground [s].

        ``drive`` is what a controller sends at a time [s], from what is measured; until the next
        arrives, the joints' drives follow it by their own encoders.
        """
        differs = self.perturbation
        perceive = Perception(self.robot, q, v, differs.noise, differs.seed)
        motors = Motors(self.real, differs.motor_gain, differs.sag_per_kw)
        delay = round(differs.delay_s / STEP_S)
        sent: deque[Drive] = deque(maxlen=delay + 1)
        self.push_place = self.robot.model.inertias[1].lever.copy()
        self._begun = step
        fallen = 0
        with self._open(self.real, q, v, scene=self.ground, friction=differs.friction) as engine:
            while not over(step, fallen * STEP_S):
                if step % TOLD == 0:
                    tell(f"simulated {step * STEP_S:.1f} s")
                q, v = engine.state()
                state = perceive(State(q, v, engine.wrench))
                sent.append(drive(step * STEP_S, state))
                arriving = sent[0].torque(state.q[7:], state.v[6:])
                engine.set_torque(motors.deliver(arriving, v[6:]))
                for push in self.pushes:
                    if push.at(step):
                        engine.push(np.array(push.force_n), self.push_place)
                engine.step()
                fallen += bool(fallen or engine.fallen)
                step += 1
            self.log = engine.log()
            self.links = engine.links
            self.engine = engine.read_back()
            self.perception = perceive.to_json()

    def result(
        self,
        goal: np.ndarray,
        solves: tuple[int, int],
        rows: slice = slice(None),
        steps_s: Sequence[float] = (),
        flights: int = 1,
        lands: Sequence[int] = BOTH,
        **settings: Any,
    ) -> SimulationResult:
        """The checked record of the run, or of some ``rows`` of it.

        ``goal`` (nq,) is where the robot shall land, ``solves`` are the QPs posed and failed,
        ``steps_s`` the times of recovery steps, and it is to fly so many ``flights`` and to end the
        last one on the feet ``lands``.
        """
        settings |= dict(
            scene=self.scene.name,
            robot=self.robot.name,
            robot_hash=self.robot.hash,
            step_s=STEP_S,
            perturbation=self.perturbation.to_json(),
            perception=self.perception,
            engine=self.engine,
            friction_read_back=min(self.engine["friction"]),
        )
        if self.ground is not self.scene or not self.ground.plain:
            settings["ground"] = asdict(self.ground)
        if self.pushes:  # what the checks know of them
            settings["pushes"] = [
                asdict(replace(push, step=push.step - self._begun)) for push in self.pushes
            ]
            settings["push_place_m"] = self.push_place.tolist()
        higher_m = self.ground.height_of(goal, self.robot, self.scene)
        result = record(
            self.real,
            self.log.some(rows),
            self.links,
            goal,
            higher_m=higher_m,
            flights=flights,
            lands=lands,
            solves=solves,
            steps_s=steps_s,
            settings=settings,
        )
        return replace(result, checks=check(result))


@runtime_checkable
class Disturbance(Protocol):
    """A dataclass that makes a wrong state at the apex of the last flight."""

    def apex(self, tape: Tape, robot: Robot) -> tuple[int, np.ndarray, np.ndarray]:
        """Step of the apex of ``tape``, and q (nq,), v (nv,) of ``robot`` there."""


@checked
def simulate_jump(
    tape: Tape,
    robot: Robot,
    *,
    perturbation: Perturbation | None = None,
    scene: Scene | None = None,
    stand_s: float = STAND_S,
    disturbance: Disturbance | None = None,
    engine: str = DEFAULT_ENGINE,
    contact: Any = CONTACTS[0],
    **control: Any,
) -> SimulationResult:
    """Play ``tape`` on a simulated robot, catch it, and watch it stand.

    Returns a result of a jump that fails, too: see its ``landed`` and ``reason``. Raises
    :class:`InputError` if the tape is not this robot's, an option makes no sense, the engine is not
    there, or the robot cannot stand on the ground at the start.

    Parameters
    ----------
    tape : of a standing jump, or along any other contact schedule that begins on both feet.
    robot : the robot as planned; the simulated one differs from it by ``perturbation``.
    perturbation : None simulates the robot as planned.
    scene : ground; flat if None.
    stand_s : how long to watch after the last touchdown [s]; less than the default is no landing.
    disturbance : begin at the apex of the last flight, in a state that differs so, see
        :class:`Disturbance`; time, distance and rise count from there.
    engine : "bullet" or "mujoco"; the default is the first that is installed.
    contact : "hard", as plans assume, or "usual", the engine's own defaults.
    control : ``mode``, ``reaim``, ``step``, ``feedback`` and ``landing`` of
        :class:`jumplab.control.Controller`.
    """
    _check(tape, stand_s)
    if control.get("feedback") and disturbance is not None:
        raise InputError(
            "feedback corrects the launch, but a run with a disturbance begins after it, at the "
            "apex; leave out feedback or disturbance"
        )
    run = Run(robot, perturbation, scene, engine, tape, contact)
    ground = run.scene.seen_along(Gauge(robot).heading(tape.q[-1]), robot, tape.q[-1]).top_at
    controller = Controller(tape, robot, **control, ground=ground, hardware=run.hardware)
    if disturbance is None:
        first = 0
        q = run.ground.seated(robot, run.perturbation.start(robot, tape.q[0]))
        v = tape.v[0]
    else:
        first, q, v = disturbance.apex(tape, robot)

    def over(step: int, fallen_s: float) -> bool:
        if controller.touchdown is None:
            return step >= controller.last_step
        watched = controller.touchdown + round((stand_s + EXTRA_S) / STEP_S)
        return step >= watched or fallen_s > AFTER_FALL_S

    run.play(controller.drive, over, q, v, first)
    return run.result(
        controller.goal,
        controller.solves,
        steps_s=controller.steps_s,
        flights=len(tape.flights) if disturbance is None else 1,
        lands=tape.lands,
        reaim=control.get("reaim", False),
        step=control.get("step", False),
        mode=controller.mode,
        stand_s=stand_s,
        disturbance=disturbance and asdict(disturbance),
        **controller.to_json(),
    )


def _check(tape: Tape, stand_s: float) -> None:
    if not 0 < stand_s <= 60:
        raise InputError(f"stand_s = {stand_s:g} s is outside 0 ... 60 s")
    for name in ("t", "q", "v", "tau"):
        if not np.all(np.isfinite(getattr(tape, name))):
            raise InputError(
                f"the tape's {name} has entries that are no number; plan the jump again"
            )
    if not tape.contacts[0].all() or not tape.flights:
        raise InputError("the tape must begin on both feet, and have a flight; plan the jump again")
