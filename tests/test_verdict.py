"""Closed-form verdict before any solve: passes what is possible, refuses the absurd with a number that would pass."""

import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fixtures_core import srmp_planner
from scipy.integrate import solve_ivp

from jumplab.auditing import audit
from jumplab.errors import InfeasibleError, SolverError
from jumplab.ocp.nlp import Nlp
from jumplab.robot import Robot
from jumplab.stages.planner import Planner
from jumplab.stages.srmp import SYMMETRY_OFF, SrmpSettings, build_problem, naive_guess, parameters
from jumplab.stages.srmp.reachable import (
    SWING_GAIN,
    capability,
    check_reachable,
    farthest,
    highest,
    highest_platform,
    least_momentum,
    needed_force,
)
from jumplab.task import JumpTask


def check(task, envelope=None):
    check_reachable(task, envelope or srmp_planner().reach, Robot.load())


def message(task, **options) -> str:
    with pytest.raises(InfeasibleError) as caught:
        check(task, **options)
    return str(caught.value)


@cache
def can():
    return capability(srmp_planner().reach, 9.8)


@cache
def small_effort() -> Nlp:
    """Stage 1 with few iterations: enough for every target of the grid."""
    return Nlp(build_problem(Robot.load(), SrmpSettings(), srmp_planner().reach), {"max_iter": 120})


def test_the_whole_grid_passes():
    for distance in np.linspace(0, 1.2, 13):
        for height in np.linspace(0.1, 0.6, 11):
            check(JumpTask(distance, height))


@pytest.mark.parametrize("task", [JumpTask(0.7, 0.55, 0.5), JumpTask(0.3, 0.55, 0.5), JumpTask(0.5, 0.3, -0.5),
                                  JumpTask(0.0, 0.5, rotation_rad=-2 * math.pi), JumpTask(-0.6, 0.4),
                                  JumpTask(0.0, 0.6, rotation_rad=4 * math.pi), JumpTask(0.3, 0.02)])  # fmt: skip
def test_platforms_drops_flips_and_backward_jumps_pass(task):
    check(task)


@pytest.mark.parametrize("task, words", [
    (JumpTask(1.0, 1.2), r"height = 1\.2 m: take-off at 4\.85 m/s, on average \d+ N over 0\.\d\d m of leg stroke"),
    (JumpTask(2.8, 0.5), r"distance = 2\.8 m: .* enough for \d\.\d\d m forward .*; at a height of \d\.\d\d m it is"),
    (JumpTask(-2.9, 0.2), r"distance = -2\.9 m: .* enough for \d\.\d\d m backward"),
    (JumpTask(0.5, 0.2, 0.9), r"platform = 0\.9 m: .* a platform of 0\.\d\d m, and for this one at a height of"),
    (JumpTask(0.0, 0.2, rotation_rad=-4 * math.pi), r"rotation = -720 deg: .* heights of less than 0\.\d\d m"),
])  # fmt: skip
def test_the_absurd_is_refused_in_words(task, words):
    assert re.search(words, message(task)), message(task)


@pytest.mark.parametrize("height", [0.02, 0.1, 0.25, 0.4, 0.55, 0.7])
def test_no_height_reaches_2_8_m(height):
    message(JumpTask(2.8, height))


def number_after(words: str, text: str) -> float:
    return float(re.search(words + r" (-?\d+\.\d+)", text).group(1))


def test_bounds_are_where_the_verdict_turns():
    check(JumpTask(0.0, number_after("enough for", message(JumpTask(0.0, 1.2)))))
    check(JumpTask(number_after("is enough for", message(JumpTask(2.8, 0.5))), 0.5))
    check(JumpTask(-number_after("is enough for", message(JumpTask(-2.9, 0.2))), 0.2))
    text = message(JumpTask(2.6, 0.6))
    check(JumpTask(number_after("it is enough for", text), number_after("at a height of", text.rpartition("; ")[2])))
    text = message(JumpTask(0.5, 0.2, 0.9))
    check(JumpTask(0.5, 0.2, number_after("a platform of", text)))
    check(JumpTask(0.5, number_after("for this one at a height of", text), 0.9))
    text = message(JumpTask(0.0, 0.2, rotation_rad=4 * math.pi))
    check(JumpTask(0.0, number_after("heights of less than", text), rotation_rad=4 * math.pi))


@pytest.mark.parametrize("task", [JumpTask(0.0, 0.75), JumpTask(2.0, 0.1), JumpTask(2.4, 0.5), JumpTask(0.3, 0.3, 0.5)])
def test_what_is_refused_stage_1_cannot_solve_either(task):
    message(task)
    reach, s = srmp_planner().reach, SrmpSettings()
    with pytest.raises(SolverError) as e:
        small_effort().solve(parameters(task, reach), naive_guess(task, reach, s), off=SYMMETRY_OFF)
    term, amount = re.match(r"(\w+/[\w -]+) by ([\d.]+) m", e.value.violations[0]).groups()
    assert term in ("toe/take-off speed", "toe/take-off length", "flight/touchdown height", "SRMP/jump length")
    assert float(amount) > 0.02  # [m, m/s] far beyond what a few more iterations would mend


def test_the_limits_are_near_what_stage_1_can_do():
    """Solved by stage 1, and within a fifth of the verdict's limit."""
    reach, s = srmp_planner().reach, SrmpSettings()
    for task, share in ((JumpTask(1.6, 0.1), 1.6 / farthest(can(), JumpTask(1.6, 0.1))),
                        (JumpTask(2.2, 0.3), 2.2 / farthest(can(), JumpTask(2.2, 0.3))),
                        (JumpTask(0.0, 0.62), 0.62 / highest(can())),
                        (JumpTask(0.3, 0.4, 0.54), 0.54 / highest_platform(can(), 0.4, 0.3))):  # fmt: skip
        small_effort().solve(parameters(task, reach), naive_guess(task, reach, s), off=SYMMETRY_OFF)
        assert 0.79 < share < 1.0, (task, share)


def test_push_speed_agrees_with_an_integrator():
    reach, s = srmp_planner().reach, SrmpSettings()

    def slope(phi, square):
        force, speed = np.polyval(reach.force_fit, phi), np.polyval(reach.speed_fit, phi)
        fade = np.clip((speed - np.sqrt(max(square[0], 0.0))) / ((1 - s.corner_speed) * speed), 0, 1)
        return [2 * (force * fade / reach.mass - 9.8)]

    span = (reach.length[0], s.takeoff_length * reach.start[1])
    run = solve_ivp(slope, span, [0.0], rtol=1e-8, atol=1e-10, dense_output=True)
    phi = np.linspace(*span, 2000)
    limit = np.minimum(np.sqrt(run.sol(phi)[0]), s.speed_share * np.polyval(reach.speed_fit, phi))
    assert can().speed == pytest.approx(SWING_GAIN * limit.max(), abs=0.01)


def test_average_force_is_work_over_stroke():
    c = can()
    gained = c.mass * 9.8 * 0.5 + c.mass * 9.8 * c.stroke  # kinetic energy at take-off and the lift over the stroke
    assert needed_force(c, 0.5) * c.stroke == pytest.approx(gained)


def test_limits_move_the_right_way():
    reach = srmp_planner().reach
    task = JumpTask(1.0, 0.3)
    icy = capability(reach, 9.8, replace(SrmpSettings(), friction=0.1))
    weak = capability(replace(reach, force_fit=0.6 * reach.force_fit), 9.8)
    light = capability(reach, 3.7)
    assert farthest(icy, task) < 0.6 * farthest(can(), task)
    assert highest(weak) < highest(can()) < highest(light)
    assert highest_platform(can(), 0.3, 0.5) < highest_platform(can(), 0.5, 0.5)
    assert least_momentum(can(), JumpTask(0, 0.3, rotation_rad=2 * math.pi)) > least_momentum(
        can(), JumpTask(0, 0.6, rotation_rad=2 * math.pi)
    )
    assert least_momentum(can(), task) == 0.0


def test_a_robot_too_weak_to_leave_the_ground_is_told_so():
    reach = srmp_planner().reach
    text = message(JumpTask(0.0, 0.1), envelope=replace(reach, force_fit=0.15 * reach.force_fit))
    assert re.search(r"does not lift bhr off the ground, its legs give \d+ N on average for a weight of 412 N", text)


def test_light_gravity_looks_no_further_than_a_task_may_ask():
    with pytest.raises(InfeasibleError, match=r"^(platform|distance) = "):
        check(JumpTask(3.0, 0.05, 0.9, gravity=1.62))


def test_the_whole_body_is_tried_where_a_straight_push_is_not_enough(bhr):
    """Arms and trunk add to the push: what the forms doubt is planned, and what has no plan is refused after a try."""
    planner, doubted = Planner(bhr), JumpTask(0.0, 0.8)
    message(doubted)
    assert audit(planner.plan(doubted).tape, bhr, doubted).passed
    with pytest.raises(InfeasibleError, match=r"enough for 0\.\d\d m; the whole body.* was tried: no plan found$") as e:
        planner.plan(JumpTask(0.0, 1.2))
    assert e.value.number == "height_m" and e.value.bound == pytest.approx(highest(can()))
    with pytest.raises(InfeasibleError, match=r"by a straight push enough for 0\.\d\d m$"):  # stage 1 is that push
        planner.plan(doubted, "three-step")
