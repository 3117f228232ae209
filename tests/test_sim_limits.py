"""No joint of a nominal jump leaves its limits, from stand to stand, whatever planned, played and simulated it.

Where soles come down 5 mrad off the level (of the three-step plan; of drives on PyBullet's ground) one sample at
touchdown is left out for ankles: the ground turns them flat within a millisecond at 19 to 21 rad/s, and no motor has a
part in it.
"""

import numpy as np
import pytest
from fixtures_core import jump

from jumplab.sim import INSTALLED, simulate_jump


def within_limits(robot, run, slaps=0):
    """From the log alone: the worst torque and the worst speed over their limits, through the impact too.

    An ankle may be too fast in as many samples as ``slaps``.
    """
    motors = robot.limits
    torque = np.abs(run.tau).max(axis=0) / motors.effort
    speed = np.abs(run.v[:, 6:]) / motors.speed
    assert run.metrics.max_speed_ratio == pytest.approx(speed.max())
    ankles = ["ankle" in name for name in robot.joint_names]
    speed[:, ankles] = np.sort(speed[:, ankles], axis=0)[len(speed) - 1 - slaps]
    assert sum(run.metrics.overspeed_s.values()) <= 1e-3 * slaps * sum(ankles)
    return run.landed and torque.max() <= 1 and speed.max() <= 1


# each mode and method, and each engine, with samples in which an ankle is turned flat
PLAYED = [
    ("position", "direct", INSTALLED[-1], 0),
    ("pd", "direct", INSTALLED[0], 0),
    ("whole-body", "three-step", INSTALLED[-1], 1),
]


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "method", "engine", "slaps"), PLAYED)
def test_the_default_jump_stays_within_all_limits(bhr, method, mode, engine, slaps):
    run = simulate_jump(jump(1.0, 0.5, method=method).tape, bhr, mode=mode, engine=engine)
    assert within_limits(bhr, run, slaps), run.metrics


@pytest.mark.slow
def test_soles_that_are_aimed_flat_slap_no_ankle(bhr):
    """A sole that meets the ground 5 mrad off the level is turned flat within a millisecond, at 19 rad/s in MuJoCo."""
    run = simulate_jump(jump(0.5, 0.3).tape, bhr, engine=INSTALLED[-1], reaim=True)
    assert within_limits(bhr, run), run.metrics
