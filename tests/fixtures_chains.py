"""Chained jumps that several tests look at, made once."""

from functools import cache

from jumplab.robot import Robot
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import Planner
from jumplab.studies.chain import ChainResult, Course, crouched, rehearse, run_chain


@cache
def waiting() -> Robot:
    """The default robot in its crouch."""
    return crouched(Robot.load())


@cache
def planner() -> Planner:
    return Planner(waiting())


@cache
def rehearsal() -> tuple[JumpPlan, ...]:
    return rehearse(Course.of([0.6, 0.6], 0.3), planner())


@cache
def chain(solve_s: float = 0.2) -> ChainResult:
    """Two jumps of 0.6 m, planning charged with a given time."""
    return run_chain(Course.of([0.6, 0.6], 0.3), Robot.load(), planner=planner(), rehearsal=rehearsal(),
                     solve_s=solve_s)  # fmt: skip
