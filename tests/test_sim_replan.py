"""A landing planned from a state of the robot."""

import numpy as np
import pytest

from jumplab.control.reference import landing_planner
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.stages.srmp.landing import touchdown_of_state


def test_stage_1_plans_the_rest_from_a_state_of_the_robot():
    """From the stance, at rest: it ends at rest, CoP inside the sole."""
    robot = Robot.load()
    touchdown = touchdown_of_state(robot, stance_configuration(robot), np.zeros(robot.model.nv), impact=False)
    plan = landing_planner(robot).plan(touchdown)
    assert plan.com[0] == pytest.approx(touchdown.com, abs=1e-6)
    assert np.abs(plan.com_velocity[-1]).max() < 1e-6
    assert np.abs(plan.cop_x).max() <= (robot.foot.toe - robot.foot.heel) / 2
