"""Recovery steps: the pendulum's truths, and falls that it prevents."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from jumplab.control.landing import SOLE_SHARE
from jumplab.control.step import BESIDE_M, BEYOND_S, SETTLED_S, SWING_S, RecoveryStep, beyond_hull
from jumplab.robot.legs import Size
from jumplab.sim import INSTALLED, Perturbation, Shove, simulate_jump
from jumplab.studies.trials import TrialKey, TrialSettings, run_trials

AHEAD = Perturbation(shoves=(Shove("landing", 0.46, 25.0, 0.3),))


def body(com=(0.0, 0.0, 0.8), velocity=(0.0, 0.0, 0.0), turned_rad=0.0):
    """A pendulum over two soles 0.2 m apart, all seen along a heading."""
    c, s = np.cos(turned_rad), np.sin(turned_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    soles = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]) @ turn.T
    still = dict(twists=np.zeros((2, 6)), gravity=np.array([0.0, 0.0, -9.8]), size=Size(1.0, 1.0))
    attitudes = np.array([turn, turn])
    return SimpleNamespace(com=turn @ com, com_velocity=turn @ velocity, soles=soles, attitudes=attitudes, **still)


def test_distance_from_a_hull():
    square = np.array([[0, 0], [2, 0], [2, 1], [0, 1], [1.0, 0.5]])
    assert beyond_hull(np.array([1.0, 0.25]), square) == pytest.approx(-0.25)
    assert beyond_hull(np.array([2.5, 0.5]), square) == pytest.approx(0.5)
    assert beyond_hull(np.array([1.0, -3.0]), square) == pytest.approx(3.0)


@pytest.mark.parametrize("turned_rad", [0.0, 2.0])
@pytest.mark.parametrize("velocity", [(0.7, 0.0, 0.0), (-0.6, 0.1, 0.0), (0.55, 0.3, 0.0), (0.6, -0.3, 0.0)])
def test_the_foot_goes_where_a_pendulum_comes_to_rest(bhr, velocity, turned_rad):
    """Integrated in small steps over the standing foot, the capture point ends within the sole that is put down."""
    here, step = body((0.03, 0.0, 0.8), velocity, turned_rad), RecoveryStep(bhr, SOLE_SHARE)
    began = [step.look(t, here, np.full(2, 200.0)) or step.starts_s[:1] for t in (0.10, 0.16, 0.17, 0.19)]
    assert began[:3] == [[]] * 3 and began[3] == [0.19]  # settled, and beyond for long enough
    goal, dt, rate = step.goal, 1e-4, np.sqrt(9.8 / 0.8)
    for _ in range(round(SWING_S / dt)):
        here.com[:2] = here.com[:2] + here.com_velocity[:2] * dt
        here.com_velocity[:2] = here.com_velocity[:2] + step.com_acceleration(here) * dt
    c, s = np.cos(turned_rad), np.sin(turned_rad)
    off = np.array([[c, s], [-s, c]]) @ (here.com + here.com_velocity / rate - goal)[:2]
    beside = -BESIDE_M if step.side == 0 else BESIDE_M
    assert off == pytest.approx([0.0, beside], abs=0.004)
    if abs(velocity[1]) > 0.2:
        assert step.side == (0 if velocity[1] > 0 else 1)


def test_a_robot_that_comes_to_rest_on_its_soles_does_not_step(bhr):
    for velocity in ((0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.0, -0.3, 0.0)):
        step = RecoveryStep(bhr, SOLE_SHARE)
        for t in np.arange(0.0, 1.0, 0.002):
            step.look(t, body(velocity=velocity), np.full(2, 200.0))
        assert step.starts_s == [] and step.side is None


def test_a_step_ends_when_the_foot_stands_or_its_time_is_over_and_the_next_waits(bhr):
    for force, ends in ((0.0, SWING_S), (60.0, SWING_S / 2)):
        step, here = RecoveryStep(bhr, SOLE_SHARE), body(velocity=(0.8, 0.0, 0.0))
        seen = []
        for t in np.arange(0.2, 1.0, 0.002):
            load = np.full(2, 200.0)
            if step.side is not None:
                load[step.side] = force
            step.look(t, here, load)
            seen.append(step.side is not None)
        first = np.flatnonzero(seen)[0]
        assert np.argmin(seen[first:]) * 0.002 == pytest.approx(ends, abs=0.005)
        # the robot still falls: the next foot leaves once the soles have stood, and a fall has been seen
        waits_s = np.diff(step.starts_s) - ends
        assert len(waits_s) and np.all(waits_s > SETTLED_S + BEYOND_S - 0.003) and waits_s.max() < 0.2


def test_a_jump_that_needs_no_step_is_the_same_with_it(bhr, good):
    plain, allowed = (simulate_jump(good, bhr, step=on, stand_s=0.5) for on in (False, True))
    assert allowed.metrics.recovery_step_s is None and allowed.metrics.recovery_steps == 0
    assert np.array_equal(plain.q, allowed.q)


@pytest.mark.slow
@pytest.mark.parametrize("engine", INSTALLED[-1:])
def test_a_shove_after_the_landing_is_caught_by_a_step(bhr, engine, good):
    held, caught = (simulate_jump(good, bhr, perturbation=AHEAD, step=on, engine=engine) for on in (False, True))
    assert not held.landed and held.metrics.recovery_step_s is None
    assert caught.landed and caught.checks_passed, caught.reason
    assert caught.metrics.recovery_step_s > 0.15
    assert f"after {caught.metrics.recovery_steps} recovery step" in caught.line()
    after = round((caught.metrics.touchdown_s + caught.metrics.recovery_step_s + 0.02) * 1000)
    aloft = caught.foot_wrench[after : after + 180, :, 2] < 1.0
    assert sorted(aloft.mean(axis=0) > 0.9) == [False, True]  # one foot flew, the other one carried


@pytest.mark.slow
def test_trials_count_the_steps(plan, tmp_path):
    from jumplab import save
    from jumplab.sim import Ranges

    save(tmp_path, plan)
    ranges = Ranges.none(shove_landing_n_s=(25.0, 25.0))
    report = run_trials(tmp_path, 2, 0, TrialSettings(ranges=ranges, step=True), jobs=1)
    assert 0 < report.stepped <= report.landed
    assert f"({report.stepped} with recovery steps)" in report.line()
    assert report.to_json()["counts"]["landed_with_a_step"] == report.stepped
    assert report.conditions["recovery step"] == "whenever the robot would come to rest beyond its soles"
    plain = TrialSettings(ranges=ranges)
    assert plain.hash != replace(plain, step=True).hash
    assert TrialKey(0, 0, plain.hash, "").robot_seed == TrialKey(0, 0, "", "").robot_seed
