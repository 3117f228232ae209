"""Mutants of all terms: each weight ten times as large, each constraint and bound left out, in turn, in memory.

``python tests/mutants_terms.py`` runs the fast tests concerned on every mutant and prints the share that one of them
notices, twice: with the table of all terms, and without it. No part of the collected tests.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import fields, replace

import pytest
from test_terms_table import program

from jumplab.ocp import Problem
from jumplab.robot import Robot
from jumplab.stages import srmp
from jumplab.stages.joint_qp.settings import FlightWeights, LaunchWeights, Options
from jumplab.stages.whole_body.body import Body

TESTS = ("tests/test_terms_table.py", "tests/test_terms_values.py")
FACTOR, LEAST = 10.0, 0.95


@contextmanager
def changed(stage: str, owner: str, name: str) -> Iterator[None]:
    """Every problem of a stage is built with one cost dearer, or without one constraint or bound."""
    usual = Problem.__init__

    def mutated(items, place):
        for x in items:
            if (place, x.name) != (owner, name):
                yield x
            elif getattr(x, "weight", None) is not None:
                yield replace(x, weight=FACTOR * x.weight)

    def build(self, *arguments, **how):
        usual(self, *arguments, **how)
        if self.name == stage:
            phases = (
                replace(p, terms=tuple(mutated(p.terms, p.name)), bounds=tuple(mutated(p.bounds, p.name)))
                for p in self.phases
            )
            object.__setattr__(self, "phases", tuple(phases))
            object.__setattr__(self, "joints", tuple(mutated(self.joints, stage)))

    Problem.__init__ = build
    try:
        yield
    finally:
        Problem.__init__ = usual


@contextmanager
def dearer(weights: LaunchWeights | FlightWeights, name: str) -> Iterator[None]:
    """One weight of stage 2 is ten times as large in its usual options."""
    usual = getattr(weights, name)
    object.__setattr__(weights, name, FACTOR * usual)
    try:
        yield
    finally:
        object.__setattr__(weights, name, usual)


def mutants() -> Iterator[tuple[str, Callable]]:
    """(name, what makes it) of each mutant of the three stages, of the last one in the plane and in space.

    The direct planner's terms are those of "whole body": a test compares them one by one.
    """
    body = Body(Robot.load())
    programs = (program(body, name) for name in ("whole body", "spatial"))
    for problem in (srmp.build_problem(body.robot), *programs):
        for owner, x in (*problem.terms(), *problem.bounds()):
            yield f"{problem.place(owner)}/{x.name}", lambda a=(problem.name, owner, x.name): changed(*a)
    for part in ("launch", "flight"):
        weights = getattr(Options(), part)
        for f in fields(weights):
            yield f"joint qp/{part}/{f.name}", lambda a=(weights, f.name): dearer(*a)


def noticed(make: Callable, tests: tuple[str, ...]) -> bool:
    """Whether one of the tests fails on a mutant."""
    said = io.StringIO()
    with make(), redirect_stdout(said), redirect_stderr(said):
        return pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests]) == pytest.ExitCode.TESTS_FAILED


def main() -> int:
    """Print what is noticed; 1 if it is less than it must be."""
    found, shares = list(mutants()), {}
    for tests in (TESTS[:1], TESTS[1:]):
        missed = [name for name, make in found if not noticed(make, tests)]
        shares[tests] = 1 - len(missed) / len(found)
        print(f"{', '.join(tests)}: {len(found) - len(missed)} of {len(found)} mutants, {100 * shares[tests]:.0f} %")
        print("".join(f"  not: {name}\n" for name in missed[:200]), end="", flush=True)
    return int(max(shares.values()) < LEAST)


if __name__ == "__main__":
    sys.exit(main())
