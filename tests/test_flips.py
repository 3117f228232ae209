"""Flips: the guess turns, the plan turns, its physics is looked at by other code, and the robot lands it."""

from functools import lru_cache

import numpy as np
import pytest

from jumplab import passport
from jumplab.errors import InputError, SolverError
from jumplab.pipeline import Planner
from jumplab.plotting.flips import trunk_angle
from jumplab.robot import load_robot
from jumplab.simulation import simulate_jump
from jumplab.task import JumpTask
from jumplab.whole_body import FlipPlanner, Limits, Mesh, Weights

TURN = 2 * np.pi


@lru_cache
def planner():
    return Planner(load_robot())


@lru_cache
def backflip():
    return planner().plan(JumpTask(0.0, 0.5, rotation_rad=-TURN), "direct")


@pytest.mark.parametrize("turns", (-2, -1, 1, 2))
def test_guess_turns_as_asked_and_goes_where_it_should(turns):
    """The foot of the guess ends flat after whole turns, and its toe ends near the target."""
    flips = planner().stage("direct flip")
    task = JumpTask(0.2, 0.5, rotation_rad=turns * TURN)
    guess = flips.naive_guess(task)
    assert abs(guess["flight"].q[-1, 0] - turns * TURN) < 0.01
    assert np.abs(np.diff(guess["flight"].q, axis=0)).max() < 1.0  # no jump on the way
    assert {n: len(g.q) - 1 for n, g in guess.items()} == flips.mesh.intervals()
    np.testing.assert_allclose(guess["flat"].q[0], flips.stance[1:])


def test_a_jump_keeps_its_own_limits():
    """What flips need is a copy: jumps without rotation have another planner and the settings of before."""
    assert Limits().capture_moment is None and Limits().jerk is None
    assert Limits().touchdown_trunk_rate == 1.0 and Limits().of_flip().touchdown_trunk_rate == 5.0
    assert Limits().of_flip().torque_share == Limits().torque_share == 0.85  # the stated margin
    assert Mesh() == Mesh(25, 20, 30) and Weights().jerk < Weights().of_flip().jerk
    assert isinstance(planner().stage("direct flip"), FlipPlanner)
    assert not isinstance(planner().stage("direct"), FlipPlanner)


def test_rotation_is_whole_turns():
    with pytest.raises(InputError, match="lands on its feet only after a multiple of 360 deg; nearest is -360 deg"):
        JumpTask(0.0, 0.5, rotation_rad=np.radians(-300.0))


@pytest.mark.slow
def test_backflip_passes_the_audit():
    plan = backflip()
    audit = passport.audit(plan.tape, plan.robot, plan.task)
    assert [c.name for c in audit.checks if not c.passed] == []
    turned = np.ptp(trunk_angle(plan.tape.q)[[0, -1]])
    assert abs(turned - TURN) < 0.35  # the trunk may lean by 0.3 rad at touchdown


@pytest.mark.slow
def test_backflip_is_captured_by_momentum():
    """Angular momentum about the middle of the soles at touchdown, from the tape: L + m (z v_x + dx v_z)."""
    plan = backflip()
    tape, sagittal = plan.tape, plan.robot.sagittal
    com, speed = tape.extra["planar_com"][-1], tape.extra["planar_com_velocity"][-1]
    sole = tape.extra["planar_toe"][-1] + sagittal.sole_center
    z, dx = com[1] - sole[1], sole[0] - com[0]
    L = float(np.ravel(tape.extra["planar_L"])[-1])
    assert L < -15  # backward
    assert abs(L + sagittal.total_mass * (z * speed[0] + dx * speed[1])) <= 4.0 + 0.1
    assert abs(plan.whole_body.solution.phases["flight"].v[-1, 3]) <= 5.0 + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("mode", ("position", "pd"))
def test_backflip_lands(mode):
    plan = backflip()
    result = simulate_jump(plan.tape, plan.robot, mode=mode)
    assert result.landed, result.reason
    down = int(np.searchsorted(result.t, result.metrics.touchdown_s))
    assert abs(trunk_angle(result.q)[down] - trunk_angle(plan.tape.q)[-1]) <= 0.15
    assert abs(result.metrics.com_rise_m - 0.5) < 0.03


@pytest.mark.slow
def test_three_steps_say_what_they_skipped():
    plan = planner().plan(JumpTask(0.0, 0.5, rotation_rad=-TURN))
    assert plan.srmp is not None
    assert (plan.joints is None) == bool(plan.skipped) == ("skipped" in plan.summary)
    if plan.skipped:
        assert plan.skipped.startswith("stage 2: ") and "stage 3 began from postures of a flip" in plan.skipped
    L = float(np.ravel(plan.tape.extra["planar_L"])[-1])
    assert abs(L / plan.srmp.launch.L[-1] - 1) <= Limits().of_flip().momentum_share + 0.01


@pytest.mark.slow
def test_a_flip_beyond_the_robot_is_refused_in_words():
    """Little effort stands for a hard target: no plan, and no minute of searching."""
    flips = FlipPlanner(load_robot(), tracking=False, options={"max_iter": 3})
    with pytest.raises(SolverError, match="two searches from a flip's postures ended so"):
        flips.plan(JumpTask(0.0, 0.5, rotation_rad=TURN))
