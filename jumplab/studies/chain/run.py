"""Chains in the simulation: jump, land, plan meanwhile, jump again."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from jumplab.arguments import checked
from jumplab.control import STEP_S
from jumplab.errors import InputError
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

MOST_S = 60.0  # that a plan may be charged


@checked
def run_chain(
    course: Course,
    robot: Robot,
    *,
    planner: Planner | None = None,
    rehearsal: Sequence[JumpPlan] | None = None,
    perturbation: Perturbation | None = None,
    solve_s: float | None = None,
    method: str = USUAL,
    engine: str = DEFAULT_ENGINE,
) -> ChainResult:
    """Let a simulated robot jump a course, planning every jump from what is measured on the way.

    The robot waits in a crouch, where it measures its own posture. The next jump is planned in the
    air and again after touchdown, and begins with the latest plan that is there. Planning is
    charged as simulated time: a plan is there so much later, and the robot holds its crouch if that
    is late. A chain that fails is a result too. Raises :class:`InputError` or
    :class:`InfeasibleError`, before anything moves, if the course cannot be jumped, or the robot or
    a setting makes no sense.

    Parameters
    ----------
    robot : as planned; the simulated one differs from it by ``perturbation``.
    planner : of :func:`jumplab.studies.chain.crouched` ``(robot)``, with own terms or not.
    rehearsal : the course's plans from the crouch, with which re-plans begin, see
        :func:`.foresight.rehearse`.
    perturbation : of the simulated robot. With noise, where the feet stand is odometry, which
        drifts in every impact.
    solve_s : what each plan is charged [s]; its own wall clock if None.
    engine : as in :func:`jumplab.sim.simulate_jump`.
    method : as of :meth:`jumplab.Planner.plan`.
    """
    if not robot.planar:
        raise InputError(
            f"robot {robot.name}: a chain needs a planar model of five links, in whose crouch the "
            "robot waits; choose a robot that has one"
        )
    if not 0 <= (solve_s or 0.0) <= MOST_S:
        raise InputError(f"solve_s = {solve_s:g} s is outside 0 ... {MOST_S:g} s")
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
    pilot = ChainPilot(foresight, run.scene, run.hardware)
    start = stance_configuration(waiting)
    run.play(pilot.drive, pilot.over, start, np.zeros(waiting.model.nv))
    settings = {
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
