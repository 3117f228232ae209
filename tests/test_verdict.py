"""Verdicts where there is no plan: the programs say so, in words; arms and trunk add to the rise of the legs' push."""

import math

import pytest
from fixtures_core import planner

from jumplab.auditing import audit
from jumplab.errors import SolverError
from jumplab.task import JumpTask


@pytest.mark.slow
def test_the_whole_body_jumps_higher_than_the_pendulum(bhr):
    high = JumpTask(0.0, 0.8)
    assert audit(planner().plan(high).tape, bhr, high).passed
    with pytest.raises(SolverError, match=r"take-off speed by \d") as e:
        planner().plan(high, "three-step")
    assert e.value.stage == "SRMP"


@pytest.mark.slow
@pytest.mark.parametrize(
    "task", [JumpTask(0.0, 1.2), JumpTask(0.5, 0.2, 0.9), JumpTask(0.0, 0.2, rotation_rad=4 * math.pi)]
)
def test_the_absurd_is_refused_in_words(task):
    with pytest.raises(SolverError) as e:
        planner().plan(task)
    assert "\n" not in str(e.value) and " by " in str(e.value) and e.value.exit_code == 3
