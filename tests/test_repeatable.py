"""A plan made twice is the same plan, whatever the process, the planner or its memory did before."""

import hashlib
import subprocess
import sys
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest
from fixtures_core import planner

from jumplab.robot import Robot
from jumplab.stages.joint_qp import DirectSolver
from jumplab.stages.joint_qp.solve import Program
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask

ROOT = Path(__file__).resolve().parent.parent
TARGETS = [(1.0, 0.5), (0.3, 0.2), (0.6, 0.5, 0.3), (-0.2, 0.3), (1.1, 0.5)]
SAME = 1e-9  # on every number of the tape, in its own SI unit


def digest(arrays):
    return hashlib.sha256(b"".join(np.ascontiguousarray(arrays[k]).tobytes() for k in sorted(arrays))).hexdigest()


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
    """Five targets, by planners that planned others before, in two processes and two orders; and from scratch."""
    from jumplab.io.tape import Tape

    code = ELSEWHERE.format(root=str(ROOT), tests=str(ROOT / "tests"), folder=str(tmp_path))
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
    for i, target in reversed(list(enumerate(TARGETS))):
        here = planner().plan(JumpTask(*target)).tape.arrays()
        assert worst_difference(here, Tape.load(tmp_path / f"{i}.npz").arrays()) <= SAME, target
        if i < 2:
            assert worst_difference(here, Planner(Robot.load()).plan(JumpTask(*target)).tape.arrays()) <= SAME, target


def test_joint_map_is_the_same_to_the_last_bit():
    """Stage 3 multiplies what differs here by a thousand; memory is laid out anew each time."""
    from fixtures_core import pendulum

    from jumplab.stages.joint_qp import map_to_joints

    rng, seen, litter = np.random.default_rng(3), set(), []
    for _ in range(6):
        litter.append([np.empty(n) for n in rng.integers(1, 500, 200)])
        plan = map_to_joints(pendulum(0.3, 0.2), Robot.load(), method="direct")
        seen.add(digest({k: getattr(plan, k) for k in ("q", "v", "a", "f", "tau")}))
    assert len(seen) == 1


# ------------------------------------------------------------------------------------------ rows known to bind


def small_program(twice: bool):
    """min |x - (2, 2, 2)|^2 / 2 with x_0 + x_1 = 1 and x_2 <= 1 (said twice if asked): x = (1/2, 1/2, 1)."""
    rows = np.array([[0.0, 0.0, 1.0]] * (2 if twice else 1) + [[1.0, 0.0, 0.0]])
    low, high = np.full(len(rows), -np.inf), np.r_[np.ones(len(rows) - 1), 7.0]
    return Program(np.eye(3), -2 * np.ones(3), np.array([[1.0, 1.0, 0.0]]), np.ones(1), rows, low, high)


@pytest.mark.parametrize("twice", [False, True])
def test_from_a_rough_answer_to_the_closed_form(twice):
    """From 1e-8 off to round-off, dependent rows or not."""
    program, n = small_program(twice), 2 if twice else 1
    binding = program.binding(np.array([0.5 + 1e-8, 0.5 - 1e-8, 1.0 + 2e-8]), np.r_[np.full(n, 1.0 / n), 0.0])
    assert list(binding[0]) == [True] * n + [False] and not binding[1].any()
    np.testing.assert_allclose(program.settled(*binding)[0], [0.5, 0.5, 1.0], rtol=0, atol=1e-15)


def test_without_settled_rows_the_solvers_answer_stays(monkeypatch):
    from test_joint_map_inputs import small_qp

    monkeypatch.setattr(Program, "settled", lambda self, top, bottom: None)
    solver = DirectSolver(small_qp())
    for _ in range(2):
        np.testing.assert_allclose(solver.solve(small_qp(), "test", 0.0).x, [0.2, 0.8], atol=1e-7)


@pytest.mark.parametrize("top, tries", [([True, False], 1), ([False, False], 2), ([True, True], 2)])
def test_binding_rows_join_and_leave(top, tries):
    """Known, missing, or one too many: the rows that bind are found, and with them the closed form."""
    x, at_top, at_bottom, count = small_program(False).settled(np.array(top), np.zeros(2, bool))
    np.testing.assert_allclose(x, [0.5, 0.5, 1.0], rtol=0, atol=1e-14)
    assert list(at_top) == [True, False] and not at_bottom.any() and count == tries


def test_binding_rows_end_at_the_optimum_or_say_nothing():
    """Programs that drift, warm from the last one's rows: where the method ends, Clarabel agrees; else it is None."""
    rng, ended = np.random.default_rng(8), 0
    rows, root, high = rng.normal(size=(6, 4)), rng.normal(size=(4, 4)), rng.uniform(0.05, 0.5, 6)
    hessian, no_rows = root @ root.T + 0.1 * np.eye(4), (np.zeros((0, 4)), np.zeros(0))
    linear, drift = rng.normal(size=4), 0.05 * rng.normal(size=4)
    top = bottom = np.zeros(6, bool)
    for k in range(40):
        push = linear + k * drift
        found = Program(hessian, push, *no_rows, rows, -high, high).settled(top, bottom)
        if found is None:
            continue
        x, top, bottom, _ = found
        y = cp.Variable(4)
        cost = cp.quad_form(y, hessian) / 2 + push @ y
        cp.Problem(cp.Minimize(cost), [cp.abs(rows @ y) <= high]).solve(cp.CLARABEL)
        np.testing.assert_allclose(x, y.value, atol=1e-5)
        ended += 1
    assert ended > 20
