"""Chained jumps that several tests look at, made once."""

from functools import cache

from jumplab.robot import Robot
from jumplab.sim import SLIGHT, Perturbation
from jumplab.stages.planner import Planner
from jumplab.studies.chain import ChainResult, Course, Rehearsal, crouched, run_chain


@cache
def waiting() -> Robot:
    """The default robot in its crouch."""
    return crouched(Robot.load())


@cache
def planner() -> Planner:
    return Planner(waiting())


@cache
def rehearsal() -> Rehearsal:
    return Rehearsal.of(Course.of([0.6, 0.6], 0.3), planner())


@cache
def chain(solve_s: float = 0.2, seed: int | None = None) -> ChainResult:
    """Two jumps of 0.6 m, planning charged with a given time."""
    drawn = None if seed is None else Perturbation.draw(Robot.load(), seed, SLIGHT)
    return run_chain(Course.of([0.6, 0.6], 0.3), Robot.load(), planner=planner(), rehearsal=rehearsal(),
                     solve_s=solve_s, perturbation=drawn)  # fmt: skip
