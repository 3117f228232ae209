"""Targets: ballistics in closed form, and what cannot be meant."""

import math
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from fixtures_core import refused

from jumplab.errors import InputError
from jumplab.task import GRAVITY, JumpTask


@pytest.mark.parametrize("height, speed, time", [(0.5, 3.130, 0.639), (0.25, 2.214, 0.452), (0.2, 1.980, 0.404)])
def test_speed_and_time_of_the_paper(height, speed, time):  # N-9
    task = JumpTask(1.0, height)
    assert task.takeoff_speed == pytest.approx(speed, abs=5e-4)
    assert task.flight_time() == pytest.approx(time, abs=5e-4)
    assert task.flight_time() == pytest.approx(2 * task.takeoff_speed / GRAVITY, rel=1e-15)


@pytest.mark.parametrize("rise", [-0.2, -0.05, 0.0, 0.1, 0.3, 0.4999])
@pytest.mark.parametrize("gravity", [1.62, 9.8, 20.0])
def test_flight_time_is_the_later_root(rise, gravity):
    task = JumpTask(0.7, 0.5, gravity=gravity)
    t, v = task.flight_time(rise), task.takeoff_speed
    assert v * t - gravity * t * t / 2 == pytest.approx(rise, abs=1e-12)
    assert v - gravity * t <= 1e-6  # on the way down


def test_apex_is_the_limit():
    task = JumpTask(0.7, 0.5)
    assert task.flight_time(0.5 - 1e-12) == pytest.approx(task.takeoff_speed / GRAVITY, abs=1e-5)


def test_gravity_is_the_papers():  # N-8
    assert GRAVITY == 9.8 == JumpTask(1.0, 0.5).gravity


def test_numbers_become_floats_and_stay():
    task = JumpTask(np.float32(0.5), 1, platform_m=-0.2)
    assert (task.distance_m, task.height_m, type(task.height_m)) == (0.5, 1.0, float)
    with pytest.raises(FrozenInstanceError):
        task.distance_m = 2.0


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 2])
def test_whole_turns(turns):
    assert JumpTask(0.0, 0.5, rotation_rad=2 * math.pi * turns).rotation_rad == pytest.approx(2 * math.pi * turns)


REFUSED = [
    ((math.nan, 0.5), "distance must be finite, got nan"),
    ((1.0, math.inf), "height must be finite, got inf"),
    (("0.5", 0.5), "distance must be a number in m, got '0.5'"),
    ((np.True_, 0.5), "distance must be a number in m, got np.True_"),
    ((1j, 0.5), "distance must be a number in m, got 1j"),
    ((None, 0.5), "distance must be a number in m, got None"),
    (([1.0, 2.0], 0.5), "distance must be a number in m, got [1.0, 2.0]"),
    ((3.5, 0.5), "distance = 3.5 m is outside -3 ... 3 m"),
    ((-3.5, 0.5), "distance = -3.5 m is outside -3 ... 3 m"),
    ((1.0, 0.0), "height = 0 m is outside 0.02 ... 1.5 m"),
    ((1.0, -0.5), "height = -0.5 m is outside 0.02 ... 1.5 m"),
    ((1.0, 2.0), "height = 2 m is outside 0.02 ... 1.5 m"),
    ((1.0, 0.5, 1.2), "platform = 1.2 m is outside -1 ... 1 m"),
    ((1.0, 0.5, math.nan), "platform must be finite, got nan"),
    ((1.0, 0.5, 0.0, 20.0), "rotation = 20 rad is outside -12.5664 ... 12.5664 rad"),
    ((1.0, 0.5, 0.0, -math.pi / 2), "rotation = -90 deg: the robot lands on its feet only after a multiple of 360 deg; "
     "nearest is 0 deg"),
    ((1.0, 0.5, 0.0, 3 * math.pi / 2), "rotation = 270 deg: the robot lands on its feet only after a multiple of 360 "
     "deg; nearest is 360 deg"),
    ((1.0, 0.5, 0.0, 0.0, 0.0), "gravity = 0 m/s^2 is outside 0.5 ... 30 m/s^2"),
    ((1.0, 0.5, 0.0, 0.0, -9.8), "gravity = -9.8 m/s^2 is outside 0.5 ... 30 m/s^2"),
]  # fmt: skip


@pytest.mark.parametrize("values, sentence", REFUSED)
def test_refusals(values, sentence):
    with pytest.raises(InputError) as e:
        JumpTask(*values)
    assert str(e.value) == sentence
    assert e.value.exit_code == 2


def test_a_number_too_large_for_a_float():
    assert refused(JumpTask, 10**400, 0.5).startswith("distance must be finite, got 10")


def test_touchdown_above_the_apex():
    assert refused(JumpTask(1.0, 0.5).flight_time, 0.52) == (
        "a CoM rise of 0.5 m cannot reach a touchdown 0.520 m above take-off; the rise must be at least that"
    )
    with pytest.raises(InputError):
        JumpTask(1.0, 0.5).flight_time(math.nan)
