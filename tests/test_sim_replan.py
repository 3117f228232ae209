"""A landing planned anew: when, from what, and what is followed meanwhile."""

from dataclasses import dataclass

import numpy as np
import pytest

from jumplab.control import reference as replan
from jumplab.control.reference import (
    FIRST_S,
    LATENCY_S,
    UNTIL_S,
    LandingAhead,
    landing_planner,
)
from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.stages.srmp.landing import touchdown_of_state


@pytest.fixture
def robot():
    return Robot.load()


@dataclass(frozen=True)
class Landing:
    t: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    L: np.ndarray

    def at(self, time):
        com, velocity = (
            np.array([np.interp(time, self.t, x) for x in rows.T]) for rows in (self.com, self.com_velocity)
        )
        return com, velocity, float(np.interp(time, self.t, self.L))


def standing(ahead_m=0.0, speed=0.0):
    """A landing that is over: the CoM stays, or moves on with constant speed."""
    t = np.array([0.0, 1.0])
    com = np.array([[ahead_m, 0.7], [ahead_m + speed, 0.7]])
    return Landing(t, com, np.array([[speed, 0.0]] * 2), np.zeros(2))


class Planner:
    """Stands in for stage 1's landing; remembers from where it was asked."""

    def __init__(self, failing=False):
        self.asked, self.failing = [], failing

    def plan(self, touchdown):
        self.asked.append(touchdown)
        if self.failing:
            raise SolverError("no landing", stage="landing")
        return standing(touchdown.com[0])


def run(robot, monkeypatch, planner, reference, until=UNTIL_S + 0.2):
    """Times and references followed by a robot that stands still in its stance."""
    monkeypatch.setattr(replan, "landing_planner", lambda _: planner)
    q, v = stance_configuration(robot), np.zeros(robot.model.nv)
    again, followed = LandingAhead(robot, "spring", again=True), []
    for step in range(round(until * 1000)):
        reference = again.follow(step * 1e-3, q, v, reference)
        followed.append(reference)
    return again, followed


def test_a_robot_that_is_where_its_landing_is_plans_nothing(robot, monkeypatch):
    planner = Planner()
    here = touchdown_of_state(robot, stance_configuration(robot), np.zeros(robot.model.nv), impact=False).com[0]
    again, followed = run(robot, monkeypatch, planner, standing(here))
    assert planner.asked == [] and again.again == {"made": 0, "refused": 0, "slowest_s": 0.0}
    assert len(set(map(id, followed))) == 1


def test_a_robot_elsewhere_follows_the_old_landing_until_the_new_one_is_there(robot, monkeypatch):
    planner = Planner()
    here = touchdown_of_state(robot, stance_configuration(robot), np.zeros(robot.model.nv), impact=False).com[0]
    again, followed = run(robot, monkeypatch, planner, standing(here + 0.1))
    there = round((FIRST_S + LATENCY_S) * 1000)
    assert followed[there - 1] is followed[0] and followed[there] is not followed[0]
    assert followed[there].t[0] == pytest.approx(FIRST_S)  # since touchdown
    assert followed[-1] is followed[there]  # the new one begins where the robot is, and needs no other
    assert again.again["made"] == len(planner.asked) == 1 and planner.asked[0].com[0] == pytest.approx(here)


def test_a_capture_point_counts_not_the_place_alone(robot, monkeypatch):
    """A landing that is here but moves at 0.2 m/s will be 5 cm away: xi = x + v / sqrt(g / z)."""
    planner = Planner()
    here = touchdown_of_state(robot, stance_configuration(robot), np.zeros(robot.model.nv), impact=False).com[0]
    moving = standing(here - 0.2 * FIRST_S, 0.2)
    run(robot, monkeypatch, planner, moving, until=FIRST_S + 0.01)
    assert len(planner.asked) == 1


def test_without_a_new_landing_the_old_one_is_kept_to_the_end(robot, monkeypatch):
    planner = Planner(failing=True)
    again, followed = run(robot, monkeypatch, planner, standing(0.2))
    assert len(set(map(id, followed))) == 1
    assert again.again["made"] == 0 and again.again["refused"] == len(planner.asked) == 1


def test_stage_1_plans_the_rest_from_a_state_of_the_robot(robot):
    """From the stance, at rest: it ends at rest, CoP inside the sole."""
    touchdown = touchdown_of_state(robot, stance_configuration(robot), np.zeros(robot.model.nv), impact=False)
    plan = landing_planner(robot).plan(touchdown)
    assert plan.com[0] == pytest.approx(touchdown.com, abs=1e-6)
    assert np.abs(plan.com_velocity[-1]).max() < 1e-6
    assert np.abs(plan.cop_x).max() <= (robot.foot.toe - robot.foot.heel) / 2
