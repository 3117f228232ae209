"""A chain in the simulation: jump, land, plan meanwhile, jump again; nothing is reset, and time does not wait."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jumplab.errors import InputError, quoted, require_type
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim import checks as honesty
from jumplab.sim.actuation import Delay
from jumplab.sim.estimator import Perception
from jumplab.sim.loop import AFTER_FALL_S, EXTRA_S
from jumplab.sim.perturbation import Perturbation
from jumplab.sim.pilot import LANDINGS
from jumplab.sim.playback import Motors
from jumplab.sim.recorder import Recorder
from jumplab.sim.world import STEP_S, World
from jumplab.stages.planner import METHODS, Planner
from jumplab.studies.chain.course import Course, crouched
from jumplab.studies.chain.foresight import Foresight, Rehearsal
from jumplab.studies.chain.pilot import ChainPilot
from jumplab.studies.chain.result import ChainedJump, ChainResult

LOOK_S = -0.3  # our choice: just before the apex of a rise of 0.3 m; foretells the toes' place to 2 mm
REVISE_S = 0.1  # our choice: the impact is over, the feet lie flat and still
EARLIEST_LOOK_S = -1.0  # our choice: longer than any flight


def run_chain(
    course: Course,
    robot: Robot,
    *,
    planner: Planner | None = None,
    rehearsal: Rehearsal | None = None,
    rehearse: bool = True,
    perturbation: Perturbation | None = None,
    solve_s: float | None = None,
    look_s: float = LOOK_S,
    revise_s: float | None = REVISE_S,
    landing: str = "spring",
    method: str = "three-step",
) -> ChainResult:
    """Let a simulated robot jump a course, planning every jump from what is measured on the way.

    The robot waits in a crouch. Once it has measured its own posture there, the first jump is planned; each further
    one is planned while the robot flies (or lands, see ``look_s``). What planning takes is charged as simulated time:
    the plan is there so much later, and the robot holds its crouch if that is late.

    Parameters
    ----------
    robot : as planned; the simulated one differs from it by ``perturbation``.
    planner : of :func:`jumplab.studies.chain.crouched` ``(robot)``; a new one if None.
    perturbation : of the simulated robot. With its sensors' noise, where the feet stand is odometry through impacts,
        which drifts by centimetres in every jump; without, it is the truth.
    rehearsal : the course's plans from the crouch, with which re-plans begin; made now if None and ``rehearse``, which
        also refuses jumps that have no plan before anything moves. Without, every plan begins from nothing.
    solve_s : what each plan is charged [s]; its own wall clock if None.
    look_s : when the next jump is planned, after touchdown [s]; negative: so long before the touchdown that is due.
    revise_s : when a plan made in the air is made again, from where the feet have really come down, after touchdown
        [s]. The robot waits for neither: it begins with the latest plan that is there. Never if None.
    landing : "planned" or "spring", see :func:`jumplab.sim.simulate_jump`.
    method : "three-step" or "direct".

    Returns
    -------
    ChainResult
        Also of a chain that fails: see its ``stood`` and ``reason``.

    Raises
    ------
    InputError, InfeasibleError
        If the course cannot be jumped, or the robot or a setting makes no sense; nothing has moved then.
    """
    _check(course, robot, perturbation, landing, method)
    _check_times(solve_s, look_s, revise_s)
    waiting = crouched(robot)
    planner = planner or Planner(waiting, keep=True)
    if planner.robot.hash != waiting.hash:
        raise InputError(f"the planner is for {planner.robot.name} in another posture; make it for crouched(robot)")
    course.check(waiting, planner.stage("reach"))
    if rehearsal is None and rehearse:
        rehearsal = Rehearsal.of(course, planner, method)
    foresight = Foresight(course, waiting, planner, rehearsal, solve_s, method)
    settings = {"look_s": look_s, "revise_s": revise_s, "landing": landing, "solve_s": solve_s, "method": method,
                "rehearsed": rehearsal is not None}  # fmt: skip
    return _Chain(course, waiting, foresight, perturbation or Perturbation(), settings).run()


def _check(course, robot, perturbation, landing, method) -> None:
    require_type(course, Course, "the course")
    require_type(robot, Robot, "the robot")
    if perturbation is not None:
        require_type(perturbation, Perturbation, "the perturbation")
    for name, value, known in (("landing", landing, LANDINGS), ("method", method, METHODS)):
        if not isinstance(value, str) or value not in known:
            raise InputError(f"{name} {quoted(value)}: choose one of {', '.join(known)}")


def _check_times(solve_s, look_s, revise_s) -> None:
    for name, value, low, high in (("solve_s", 0.0 if solve_s is None else solve_s, 0.0, 60.0),
                                   ("look_s", look_s, EARLIEST_LOOK_S, 2.0),
                                   ("revise_s", 0.0 if revise_s is None else revise_s, 0.0, 2.0)):  # fmt: skip
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise InputError(f"{name} = {quoted(value)} s is outside {low:g} ... {high:g} s")


class _Chain:
    """One run: the loop, and one recorder per jump."""

    def __init__(self, course: Course, robot: Robot, foresight: Foresight, perturbation: Perturbation, settings: dict):
        self.course, self.robot, self.perturbation, self.settings = course, robot, perturbation, settings
        self.real, self.scene = perturbation.robot(robot), course.scene(robot)
        self.pilot = ChainPilot(foresight, robot, self.scene, settings["landing"], settings["look_s"],
                                settings["revise_s"])  # fmt: skip
        self.recorders: list[Recorder] = []

    def run(self) -> ChainResult:
        """Simulate until the last jump has been watched, or something ends the chain."""
        q = stance_configuration(self.robot)
        perceive = Perception(self.robot, q, np.zeros(self.robot.model.nv), self.perturbation.noise,
                              self.perturbation.seed)  # fmt: skip
        motors = Motors(self.robot, self.perturbation.motor_gain)
        delay = Delay(round(self.perturbation.delay_s / STEP_S))
        with World(self.real, q, scene=self.scene, friction=self.perturbation.friction) as world:
            self._record(world)
            contacts, step, fell = world.contacts(), 0, ""
            while not (fell or self._over(step)):
                q, v = world.state()
                told = delay(self.pilot.command(step, *perceive(q, v, contacts.wrench)))
                if len(self.pilot.began) > len(self.recorders):
                    self._record(world)
                tau = motors.apply(world, told, v[6:])
                world.step()
                contacts = world.contacts()
                recorder = self.recorders[-1]
                recorder.add(q, v, world.servo_torque() if tau is None else tau, contacts)
                if recorder.fallen_steps * STEP_S > AFTER_FALL_S:
                    fell = f"the robot fell in jump {max(self.pilot.current, 0) + 1}"
                step += 1
            engine = world.read_back()
        return self._result(engine, perceive.to_json(), fell or self.pilot.over)

    def _record(self, world: World) -> None:
        """A recorder per jump; the stand before the first one belongs to it."""
        end = stance_configuration(self.robot)
        end[2] += self.course.platforms_m[len(self.recorders)]
        self.recorders.append(Recorder(self.real, end, world.links))

    def _over(self, step: int) -> bool:
        if self.pilot.over:
            return True
        return self.pilot.finished and self.pilot.since_touchdown(step) >= honesty.STAND_S + EXTRA_S

    def _result(self, engine: dict, perception: dict, reason: str) -> ChainResult:
        jumps, starts = [], [0, *self.pilot.began[1:]]
        for k, (recorder, start) in enumerate(zip(self.recorders, starts, strict=True)):
            pilot = self.pilot.pilots[k] if k < len(self.pilot.pilots) else None
            settings = {
                "mode": "position", "scene": self.scene.name, "reaim": True, "robot": self.robot.name,
                "landing": None if pilot is None else pilot.ahead.to_json(), "perception": perception,
                "step_s": STEP_S, "robot_hash": self.robot.hash, "friction_read_back": min(engine["friction"]),
                "engine": engine, "perturbation": self.perturbation.to_json(), "disturbance": None,
            }  # fmt: skip
            result = recorder.result((0, 0) if pilot is None else pilot.solves, settings)
            result = replace(result, honesty=honesty.check(result, self.real))
            plans = tuple(self.pilot.plans[k]) if k < len(self.pilot.plans) else ()
            used = self.pilot.used[k] if k < len(self.pilot.used) else None
            jumps.append(ChainedJump(k, start * STEP_S, used, plans, result))
        settings = {**self.settings, "perturbation": self.perturbation.to_json(), "perception": perception}
        return ChainResult(self.course, self.robot, self.scene, tuple(jumps), reason, settings)
