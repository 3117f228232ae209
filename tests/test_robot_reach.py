"""Reach of the default robot: sampled postures and the envelope made of them."""

import numpy as np
import pinocchio as pin
import pytest
from fixtures_robots import child, write

from jumplab.robot import Robot
from jumplab.robot.reach import postures, reach
from jumplab.robot.stance import configuration, stance_configuration


# reach ----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def envelope(bhr):
    return reach(bhr)


def test_sampled_postures_are_real(bhr):
    """CoM and inertia of sampled postures are Pinocchio's, and their joints lie within the ranges."""
    found, s = postures(bhr, 2**10), bhr.sagittal
    joints = s.joint_angles(found["angles"])
    assert np.all(joints >= s.lower - 1e-12) and np.all(joints <= s.upper + 1e-12) and len(joints) > 50
    model, data = bhr.model, bhr.model.createData()
    for i in range(0, len(joints), 50):
        q = configuration(bhr, found["angles"][i], toe=-s.sole_center)
        pin.ccrba(model, data, q, np.zeros(20))
        np.testing.assert_allclose(found["com"][i], data.com[0][[0, 2]], atol=1e-9)
        assert found["rho"][i] == pytest.approx(data.Ig.inertia[1, 1], abs=1e-9)


def test_envelope_is_an_envelope(bhr, envelope):
    found = postures(bhr, 2**12)
    phi = np.linalg.norm(found["com"], axis=1)
    inside = (phi > envelope.length[0]) & (phi < envelope.length[1])
    low, high = (np.polyval(fit, phi[inside]) for fit in (envelope.inertia_low_fit, envelope.inertia_high_fit))
    rho = found["rho"][inside]
    assert np.all(low < high) and np.all(bhr.sagittal.inertia.sum() < low)
    assert np.mean((rho > low) & (rho < high)) > 0.9  # 2 % are cut off on either side, and a parabola is not exact
    assert np.all(
        np.polyval(envelope.force_fit, np.linspace(*envelope.length, 20)) > 42 * 9.8
    )  # it can stand at any length
    assert np.all(np.polyval(envelope.speed_fit, np.linspace(*envelope.length, 20)) > 0)
    assert envelope.mass == pytest.approx(42.0) and envelope.cop == pytest.approx((-0.12, 0.12))


def test_reach_starts_from_the_stance(bhr, envelope):
    q, model, data = stance_configuration(bhr), bhr.model, bhr.model.createData()
    pin.ccrba(model, data, q, np.zeros(20))
    lean, length, turn, radius = envelope.start
    np.testing.assert_allclose(length * np.array([np.sin(lean), np.cos(lean)]), data.com[0][[0, 2]], atol=1e-9)
    assert 42.0 * radius**2 == pytest.approx(data.Ig.inertia[1, 1], abs=1e-9)
    assert lean + turn == pytest.approx(bhr.stance["trunk_pitch_rad"], abs=1e-9)  # theta_l + theta_pl is the trunk


def test_heavier_limbs_widen_the_envelope(bhr, envelope):
    """The envelope is the robot's own: arms of four times the mass reach out to more inertia."""
    head, tail = bhr.urdf.split('<link name="left_arm">')
    heavy = head + '<link name="left_arm">' + tail.replace('<mass value="2" />', '<mass value="8" />')
    other = reach(Robot.from_text(heavy, bhr.config_text), 2**12)
    assert other.inertia[1] > envelope.inertia[1] + 1.0


def test_a_small_robot_reaches_as_the_large_one_does(bhr, envelope, tmp_path):
    """Lengths by which postures are chosen grow with the legs: a quarter of the size has a quarter of the reach."""
    small = reach(Robot.load(write(tmp_path, child, 0.25)))
    np.testing.assert_allclose(np.array(small.length) / 0.25, envelope.length, rtol=0.02)
    low, easy = (np.polyval(x, 0.0) / 0.25 for x in (small.low_com_fit, small.easy_com_fit))
    assert low == pytest.approx(np.polyval(envelope.low_com_fit, 0.0), abs=0.02)
    assert easy == pytest.approx(np.polyval(envelope.easy_com_fit, 0.0), abs=0.02)
