"""Chains in the simulation: jump, land, plan meanwhile, jump again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from jumplab.arguments import checked
from jumplab.control import STEP_S
from jumplab.control.controller import LANDINGS
from jumplab.errors import InputError, quoted
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim import DEFAULT_ENGINE, Perturbation
from jumplab.sim.loop import Run
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import USUAL, Planner
from jumplab.studies.chain.course import Course, crouched
from jumplab.studies.chain.foresight import Foresight, rehearse
from jumplab.studies.chain.pilot import MODE, ChainPilot
from jumplab.studies.chain.result import ChainedJump, ChainResult

LOOK_S = -0.3  # just before the apex of a rise of 0.3 m; foretells the toes' place to 2 mm
REVISE_S = 0.1  # the impact is over, the feet lie flat and still
# from, to; the earliest look is longer before touchdown than any flight
TIMES_S = {"solve_s": (0.0, 60.0), "look_s": (-1.0, 2.0), "revise_s": (0.0, 2.0)}


@checked
def run_chain(
    course: Course,
    robot: Robot,
    *,
    planner: Planner | None = None,
    rehearsal: Sequence[JumpPlan] | None = None,
    perturbation: Perturbation | None = None,
    solve_s: float | None = None,
    look_s: float = LOOK_S,
    revise_s: float | None = REVISE_S,
    landing: str = "spring",
    method: str = USUAL,
    engine: str = DEFAULT_ENGINE,
) -> ChainResult:
    """Let a simulated robot jump a course, planning every jump from what is measured on the way.

    The robot waits in a crouch, where it measures its own posture. Planning is charged as simulated
    time: a plan is there so much later, and the robot holds its crouch if that is late. A chain
    that fails is a result too. Raises :class:`InputError` or :class:`InfeasibleError`, before
    anything moves, if the course cannot be jumped, or the robot or a setting makes no sense.

    Parameters
    ----------
    robot : as planned; the simulated one differs from it by ``perturbation``.
    planner : of :func:`jumplab.studies.chain.crouched` ``(robot)``, with own terms or not.
    rehearsal : the course's plans from the crouch, with which re-plans begin, see
        :func:`.foresight.rehearse`.
    perturbation : of the simulated robot. With noise, where the feet stand is odometry, which
        drifts in every impact.
    solve_s : what each plan is charged [s]; its own wall clock if None.
    look_s : when the next jump is planned, after touchdown [s]; negative: so long before the
        touchdown that is due.
    revise_s : when a plan made in the air is made again, after touchdown [s]; never if None. The
        robot waits for neither: it begins with the latest plan that is there.
    landing, engine : as in :func:`jumplab.sim.simulate_jump`.
    method : as of :meth:`jumplab.Planner.plan`.
    """
    times_s = dict(solve_s=solve_s or 0.0, look_s=look_s, revise_s=revise_s or 0.0)
    _check(robot, landing, times_s)
    waiting = crouched(robot)
    planner = planner or Planner(waiting, keep=True)
    if planner.robot.hash != waiting.hash:
        raise InputError(
            f"the planner is for {planner.robot.name} in another posture; "
            f"make it for crouched(robot)"
        )
    method = planner.chosen(method)
    course.check(waiting)
    rehearsal = rehearsal or rehearse(course, planner, method)
    run = Run(waiting, perturbation, course.scene(waiting), engine)
    foresight = Foresight(course, waiting, planner, rehearsal, solve_s)
    pilot = ChainPilot(foresight, run.scene, landing, look_s, revise_s, run.hardware)
    start = stance_configuration(waiting)
    run.play(pilot.drive, pilot.over, start, np.zeros(waiting.model.nv))
    settings = {
        "look_s": look_s,
        "revise_s": revise_s,
        "landing": landing,
        "solve_s": solve_s,
        "method": method,
        "perception": run.perception,
        "perturbation": run.perturbation.to_json(),
    }
    return ChainResult(
        course, waiting, run.scene, _jumps(run, pilot, course), pilot.reason, settings
    )


def _jumps(run: Run, chain: ChainPilot, course: Course) -> tuple[ChainedJump, ...]:
    """The jumps of a chain that has been run; the last may not have begun."""
    # the stand before the first jump belongs to it
    edges = [0, *(round(jump.began_s / STEP_S) for jump in chain.jumps[1:]), len(run.log.q)]
    jumps = []
    for k, (first, after) in enumerate(pairwise(edges)):
        plans = tuple(plan for plan in chain.plans if plan.number == k)
        ahead = chain.jumps[k] if k < len(chain.jumps) else None
        goal = stance_configuration(run.robot)
        goal[2] += course.platforms_m[k]
        log = run.result(
            goal,
            ahead.controller.solves if ahead else (0, 0),
            slice(first, after),
            landing=ahead and ahead.controller.ahead.to_json(),
            mode=MODE,
            reaim=True,
            disturbance=None,
        )
        jumps.append(ChainedJump(k, first * STEP_S, ahead, plans, log))
    return tuple(jumps)


def _check(robot: Robot, landing: str, times_s: Mapping[str, float]) -> None:
    if not robot.planar:
        raise InputError(
            f"robot {robot.name}: a chain needs a planar model of five links, in whose crouch the "
            "robot waits; choose a robot that has one"
        )
    if landing not in LANDINGS:
        raise InputError(f"landing {quoted(landing)}: choose one of {', '.join(LANDINGS)}")
    for name, value in times_s.items():
        low, high = TIMES_S[name]
        if not low <= value <= high:
            raise InputError(f"{name} = {value:g} s is outside {low:g} ... {high:g} s")
