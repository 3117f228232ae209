"""A plan made twice is the same plan, whatever the process, the planner or its memory did before."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fixtures_core import planner

from jumplab.robot import Robot
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask

ROOT = Path(__file__).resolve().parent.parent
TARGETS = [(1.0, 0.5), (0.6, 0.5, 0.3), (-0.2, 0.3)]
SAME = 1e-9  # on every number of the tape, in its own SI unit


def worst_difference(a, b):
    assert set(a) == set(b)
    numbers = [k for k in a if a[k].dtype.kind == "f"]
    assert all(a[k].shape == b[k].shape for k in numbers) and len(numbers) > 20
    return max(float(np.nanmax(np.abs(a[k] - b[k]), initial=0.0)) for k in numbers)


ELSEWHERE = """
import sys
sys.path[:0] = [{root!r}, {tests!r}]
import cvxpy as cp
import numpy as np
from test_repeatable import TARGETS, JumpTask, planner
litter = [np.empty(n) for n in range(1, 3000, 7)]  # another layout of the memory
for i, target in enumerate(TARGETS):
    planner().plan(JumpTask(*target)).tape.save({folder!r} + f"/{{i}}.npz")
"""


@pytest.mark.slow
def test_a_plan_made_three_times_is_the_same(tmp_path):
    """Three targets, by planners that planned others before, in two processes and two orders; and from scratch."""
    from jumplab.io.tape import Tape

    code = ELSEWHERE.format(root=str(ROOT), tests=str(ROOT / "tests"), folder=str(tmp_path))
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
    for i, target in reversed(list(enumerate(TARGETS))):
        here = planner().plan(JumpTask(*target)).tape.arrays()
        assert worst_difference(here, Tape.load(tmp_path / f"{i}.npz").arrays()) <= SAME, target
        if i < 1:
            assert worst_difference(here, Planner(Robot.load()).plan(JumpTask(*target)).tape.arrays()) <= SAME, target


def test_joint_map_is_the_same():
    """Memory is laid out anew each time."""
    from fixtures_core import pendulum

    from jumplab.stages.joint_qp import map_to_joints

    rng, litter, first = np.random.default_rng(3), [], None
    for _ in range(2):
        litter.append([np.empty(n) for n in rng.integers(1, 500, 200)])
        plan = map_to_joints(pendulum(0.3, 0.2), Robot.load())
        first = first or plan
        for name in ("q", "v", "a", "f", "tau"):
            np.testing.assert_allclose(getattr(plan, name), getattr(first, name), atol=1e-6)
