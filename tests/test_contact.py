"""Physics that everybody shares: friction and CoP rows, motions of foot points, motors, legs."""

import numpy as np
import pinocchio as pin
import pytest

from jumplab.robot.contact import moving, on_feet, point_motion, pyramid, wrench_rows
from jumplab.robot.legs import bring_feet, give_of, leg_columns
from jumplab.robot.stance import stance_configuration


def test_forces_of_the_pyramid_satisfy_all_rows_and_touch_its_faces():
    rows = wrench_rows(0.5, 0.1, 0.2, 0.04, 0.05)
    assert len(rows) == 11
    for edge in pyramid(0.5):
        left = {name: float(row[:3] @ edge) for name, row in rows.items()}
        assert min(left.values()) == pytest.approx(0.0, abs=1e-12)
    assert list(wrench_rows()) == ["F_z >= 0"]


@pytest.mark.parametrize(
    ("moment", "broken"),
    [
        ([0, -11, 0], "CoP behind toe"),
        ([0, 21, 0], "CoP ahead of heel"),
        ([4.1, 0, 0], "CoP right of left edge"),
        ([-4.1, 0, 0], "CoP left of right edge"),
        ([0, 0, 5.1], "torsion +"),
        ([0, 0, -5.1], "torsion -"),
    ],
)
def test_a_cop_outside_breaks_the_row_of_that_edge_alone(moment, broken):
    """The CoP of a wrench about a point of the sole is at (-m_y, m_x) / f_z."""
    rows = wrench_rows(0.5, 0.1, 0.2, 0.04, 0.05)
    wrench = np.concatenate([[0.0, 0.0, 100.0], moment])
    assert [name for name, row in rows.items() if row @ wrench < 0] == [broken]


def test_points_move_by_their_jacobian_and_drift(bhr):
    """Places and velocities by differences along q(t) with constant acceleration."""
    model = bhr.model
    data = model.createData()
    rng = np.random.default_rng(1)
    q = pin.integrate(model, stance_configuration(bhr), 0.3 * rng.standard_normal(model.nv))
    v = rng.standard_normal(model.nv)
    a = rng.standard_normal(model.nv)
    anchor = on_feet(bhr, [0.1, -0.02, 0.03])[1]

    def at(t):
        moving(model, data, pin.integrate(model, q, t * v + t * t / 2 * a), v + t * a)
        return point_motion(model, data, anchor)

    h = 1e-5
    before, now, after = at(-h), at(0.0), at(h)
    np.testing.assert_allclose((after.place - before.place) / (2 * h), now.velocity[:3], atol=1e-7)
    np.testing.assert_allclose(now.jacobian @ v, now.velocity, atol=1e-12)
    gained = (after.velocity - before.velocity) / (2 * h)
    np.testing.assert_allclose(gained, now.jacobian @ a + now.drift, atol=1e-6)


def test_a_motor_is_strong_when_slow_and_when_it_brakes(bhr):
    motors = bhr.limits
    least, most = motors.range(np.zeros(len(motors.effort)))
    np.testing.assert_allclose([-least, most], [motors.effort] * 2)
    halfway = (motors.corner_speed + motors.no_load_speed) / 2
    least, most = motors.range(halfway)
    np.testing.assert_allclose([-least, most], [motors.effort, motors.effort / 2])
    np.testing.assert_allclose(motors.range(2 * motors.no_load_speed)[1], 0.0)


def test_legs_bring_the_feet_to_their_places_and_move_nothing_else(bhr):
    model = bhr.model
    data = model.createData()
    q = stance_configuration(bhr)
    feet = on_feet(bhr, bhr.foot.tip)
    pin.forwardKinematics(model, data, q)
    goals = {
        foot: pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.2, 0.1), np.array([0.03, 0.0, 0.04]))
        * (data.oMi[foot.joint] * foot.placement)
        for foot in feet
    }
    moved, missed = bring_feet(model, data, q, goals, give_of(bhr))
    assert np.abs(missed).max() < 1e-10
    pin.forwardKinematics(model, data, moved)
    for foot, goal in goals.items():
        assert (data.oMi[foot.joint] * foot.placement).isApprox(goal, 1e-8)
    still = np.setdiff1d(np.arange(model.nv), np.concatenate(leg_columns(bhr)))
    np.testing.assert_allclose(pin.difference(model, q, moved)[still], 0.0, atol=1e-12)
