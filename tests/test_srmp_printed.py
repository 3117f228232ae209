"""Stage 1 in sequence as printed: its launches exist, its flights do not, and what is missing."""

from functools import cache

import numpy as np
import pytest
from paper.srmp_printed import (
    WINDOW_MARGIN,
    PrintedSequence,
    build_printed_flight,
    build_printed_launch,
    count_successes,
)

from jumplab.errors import InputError
from jumplab.models.srmp import SrmpState
from jumplab.robot import Robot
from jumplab.stages.srmp import SrmpSettings
from jumplab.task import JumpTask

TARGETS = [JumpTask(x, h) for x in (0.0, 1.2) for h in (0.1, 0.6)]


@cache
def sequence(window: bool) -> PrintedSequence:
    return PrintedSequence(Robot.load(), window=window)


@cache
def result(distance, height, window, rotation=0.0):
    return sequence(window).plan(JumpTask(distance, height, rotation_rad=rotation))


def state_at_end(printed) -> SrmpState:
    end = printed.launch.phases["launch"]
    return SrmpState(sequence(False).reach.mass, end.q[-1], end.v[-1], end.a[-1])


def test_printed_launches_are_solved_and_their_flights_are_not():
    count = count_successes(sequence(False), TARGETS)
    assert (count.targets, count.launches, count.flights) == (4, 4, 0)


def test_the_window_alone_makes_every_flight_possible():
    count = count_successes(sequence(True), TARGETS)
    assert (count.targets, count.launches, count.flights) == (4, 4, 4)


def test_printed_momentum_lies_outside_what_any_inertia_could_turn_into_the_rotation():
    printed = result(1.2, 0.35, False)
    lean, t_f = printed.launch.phases["launch"].q[-1, 0], printed.task.flight_time()
    low, high = (-2 * lean * rho / t_f for rho in sequence(False).reach.inertia)
    momentum = float(state_at_end(printed).L)
    assert high < low < momentum  # both bounds negative: the jump needs backward rotation, the launch gives forward
    assert printed.flight_status == "Infeasible_Problem_Detected"
    assert not printed.solved


def test_printed_launch_meets_its_own_end_constraints():
    printed = result(0.6, 0.35, False)
    end, task, mass = state_at_end(printed), printed.task, sequence(False).reach.mass
    com, velocity = end.com.full().ravel(), end.com_velocity.full().ravel()
    assert 2 * com[0] + velocity[0] * 2 * task.takeoff_speed / task.gravity == pytest.approx(0.6, abs=1e-5)
    assert velocity[1] == pytest.approx(task.takeoff_speed, abs=1e-5)
    for zero in (end.rod_force, end.pivot_torque, end.L_rate):
        assert float(zero) == pytest.approx(0.0, abs=1e-3 * mass)


def test_printed_cop_quotient_stays_in_the_sole_at_all_nodes_but_the_last():
    phase, reach = result(1.2, 0.6, False).launch.phases["launch"], sequence(False).reach
    for q, v, a in zip(phase.q[:-1], phase.v[:-1], phase.a[:-1], strict=True):
        s = SrmpState(reach.mass, q, v, a)
        cop = -float(s.pivot_torque) / float(s.ground_force[1])
        assert reach.cop[0] - 1e-5 < cop < reach.cop[1] + 1e-5


def test_window_flight_begins_where_the_launch_ended_and_lands_symmetrically():
    printed = result(0.6, 0.35, True)
    end, flight = state_at_end(printed), printed.flight.phases["flight"]
    launch_lean = printed.launch.phases["launch"].q[-1, 0]
    assert flight.z[0, 0] == pytest.approx(launch_lean, abs=1e-6)
    assert flight.q[0, 0] == pytest.approx(float(end.inertia), abs=1e-6)
    assert flight.v[0, 0] == pytest.approx(float(end.inertia_rate), abs=1e-5)
    assert flight.a[0, 0] == pytest.approx(float(end.inertia_accel), abs=1e-3)
    assert flight.z[-1, 0] + launch_lean == pytest.approx(0.0, abs=1e-5)
    assert flight.duration == pytest.approx(2 * printed.task.takeoff_speed / 9.8, abs=1e-9)
    t = np.linspace(0, flight.duration, 4001)
    rho = flight.sample(t)[0][:, 0]
    turned = np.trapezoid(float(end.L) / rho, t)
    assert flight.z[-1, 0] - flight.z[0, 0] == pytest.approx(turned, abs=1e-4)


def test_window_momentum_belongs_to_an_inertia_inside_the_range():
    printed = result(1.2, 0.1, True)
    low, high = sequence(True).reach.inertia
    lean = printed.launch.phases["launch"].q[-1, 0]
    mean = float(state_at_end(printed).L) * printed.task.flight_time() / (-2 * lean)
    margin = WINDOW_MARGIN * (high - low)
    assert low + margin - 1e-4 < mean < high - margin + 1e-4


def test_what_the_printed_problem_does_not_ask_shows():
    for window in (False, True):
        assert result(0.6, 0.35, window).envelope_excess > 0.5  # kg m^2 beyond what a leg that long can have
    assert 0 <= result(0.6, 0.35, False).friction_used < 0.45
    assert result(0.6, 0.35, False).lowest_force_n > 0


def test_backflip_by_the_window():
    flip = result(0.0, 0.5, True, -2 * np.pi)
    assert flip.solved
    flight = flip.flight.phases["flight"]
    assert flight.z[-1, 0] + flight.z[0, 0] == pytest.approx(-2 * np.pi, abs=1e-5)


def test_problems_hold_the_printed_terms_and_no_others():
    robot, reach = Robot.load(), sequence(False).reach
    launch = build_printed_launch(robot, SrmpSettings(), reach)
    names = {t.name for _, t in launch.terms()}
    assert not names & {"friction", "unilateral", "leg force", "leg speed", "inertia envelope", "take-off length"}
    equations = " ".join(row["equation"] for row in launch.table())
    for mark in ("SL-J1", "SL-J2", "SL-J3", "SL-J4", "SL-J5", "SL-E1", "SL-E2", "SL-E3", "SL-E4", "SL-E5", "SL-E6",
                 "SL-P1", "SL-P2", "SL-P3", "SL-P4", "SL-P5", "SL-B1"):  # fmt: skip
        assert mark in equations, mark
    equations = " ".join(row["equation"] for row in build_printed_flight(SrmpSettings(), reach).table())
    for mark in ("SF-B1", "SF-J1", "SF-D1", "SF-E1", "SF-L1", "SF-L2", "SF-L3", "SF-L4"):
        assert mark in equations, mark


def test_platform_is_refused_in_words():
    with pytest.raises(InputError, match=r"platform = 0\.3 m.*ask for 0 m"):
        sequence(False).plan(JumpTask(0.5, 0.4, 0.3))
