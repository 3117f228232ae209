"""Stage 1's landing: the state after the impact, and the way from there to standing."""

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import pendulum, refused, turned
from paper.srmp_touchdown import touchdown_of_plan

from jumplab.control import LandingController
from jumplab.errors import InfeasibleError, SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import configuration, stance_angles
from jumplab.stages.srmp.landing import (
    LandingPlanner,
    LandingSettings,
    Touchdown,
    touchdown_of_state,
)

FALL = Touchdown(np.array([-0.16, 0.65]), np.array([0.9, -2.4]), -6.0, 4.0)


@cache
def planner() -> LandingPlanner:
    return LandingPlanner(Robot.load())


@cache
def fall():
    return planner().plan(FALL)


def bent_state():
    """Full-robot state (q, v) and its planar counterpart: link angles and rates, toe velocity."""
    robot = Robot.load()
    angles = np.array([0.0, 0.5, -0.6, 0.2, -0.1])
    rates = np.array([-1.5, 0.8, -2.0, 0.3, 1.1])
    toe_velocity = np.array([1.2, -3.1])
    step = 1e-6
    ends = [configuration(robot, angles + s * step * rates, toe=s * step * toe_velocity) for s in (-1, 1)]
    v = pin.difference(robot.model, *ends) / (2 * step)
    return configuration(robot, angles), v, angles, rates, toe_velocity


def planar_maps(angles):
    """Planar mass matrix over (toe x, toe z, five angles), and the maps to CoM velocity and L."""
    m = Robot.load().sagittal
    arms = m.com_arms()
    places = np.array([sum(turned(angles[j], arms[i, j]) for j in range(5)) for i in range(5)])
    columns = np.array([[turned(angles[j] + np.pi / 2, arms[i, j]) for j in range(5)] for i in range(5)])
    jac = np.concatenate([np.tile(np.eye(2), (5, 1, 1)), columns.transpose(0, 2, 1)], axis=2)  # (5, 2, 7)
    mass = np.einsum("i,iab,iac->bc", m.mass, jac, jac)
    mass[2:, 2:] += np.diag(m.inertia)
    to_com = np.einsum("i,iab->ab", m.mass, jac) / m.total_mass
    r = places - m.mass @ places / m.total_mass
    spin = np.einsum("i,ib->b", m.mass, r[:, 1:] * jac[:, 0] - r[:, :1] * jac[:, 1])
    spin[2:] += m.inertia
    return mass, to_com, spin


def test_touchdown_of_a_state_without_impact_is_the_state():
    q, v, angles, rates, toe_velocity = bent_state()
    _, to_com, spin = planar_maps(angles)
    u = np.concatenate([toe_velocity, rates])
    got = touchdown_of_state(Robot.load(), q, v, impact=False)
    np.testing.assert_allclose(got.com_velocity, to_com @ u, atol=1e-6)
    assert got.L == pytest.approx(spin @ u, abs=1e-6)
    assert got.trunk_pitch == pytest.approx(0.2, abs=1e-9)


def test_impact_agrees_with_the_planar_projection():
    q, v, angles, rates, toe_velocity = bent_state()
    mass, to_com, spin = planar_maps(angles)
    u = np.concatenate([toe_velocity, rates])
    after = np.zeros(7)  # toe and foot stand; the impulse acts on them alone, so the other rows of M du are zero
    after[3:] = np.linalg.solve(mass[3:, 3:], mass[3:] @ u)
    got = touchdown_of_state(Robot.load(), q, v)
    np.testing.assert_allclose(got.com_velocity, to_com @ after, atol=1e-5)
    assert got.L == pytest.approx(spin @ after, abs=1e-5)
    assert abs(got.com_velocity[1]) < abs((to_com @ u)[1])


def test_impact_of_a_standing_robot_changes_nothing():
    robot = Robot.load()
    q = configuration(robot, stance_angles(robot))
    got = touchdown_of_state(robot, q, np.zeros(robot.model.nv))
    np.testing.assert_allclose([*got.com_velocity, got.L], 0.0, atol=1e-12)
    np.testing.assert_allclose(got.com[0], 0.0, atol=1e-6)
    assert got.rho == pytest.approx(planner().reach.mass * planner().reach.start[3] ** 2, rel=1e-6)


def test_touchdown_of_a_plan_starts_from_its_last_instant():
    plan, robot = pendulum(1.0, 0.5), Robot.load()
    before, after = (touchdown_of_plan(plan, robot, impact=x) for x in (False, True))
    np.testing.assert_allclose(before.com_velocity, plan.flight.com_velocity[-1])
    np.testing.assert_allclose(before.com, -plan.flight.foot_com[-1])
    assert before.L == plan.flight.L[-1]
    lost = 1 - after.com_velocity[1] / before.com_velocity[1]
    assert 0.15 < lost < 0.40  # feet and shanks stop at once
    np.testing.assert_allclose(after.com, before.com)


def test_touchdown_out_of_reach_is_refused_in_words():
    plan = pendulum(1.0, 0.5)
    flight = replace(plan.flight, foot_com=plan.flight.foot_com * 2)
    with pytest.raises(InfeasibleError, match=r"CoM -0\.\d+ m ahead of and 1\.\d+ m above the soles"):
        touchdown_of_plan(replace(plan, flight=flight), Robot.load())


def test_landing_begins_at_touchdown_and_ends_standing():
    plan, stance = fall(), planner().reach.start
    np.testing.assert_allclose(plan.com[0], FALL.com, atol=1e-6)
    np.testing.assert_allclose(plan.com_velocity[0], FALL.com_velocity, atol=1e-5)
    assert plan.L[0] == pytest.approx(FALL.L, abs=1e-4)
    np.testing.assert_allclose(plan.com[-1], [0.0, stance[1]], atol=1e-6)
    np.testing.assert_allclose([*plan.com_velocity[-1], *plan.com_acceleration[-1], plan.L[-1]], 0.0, atol=1e-4)
    assert plan.F_z[-1] == pytest.approx(planner().reach.mass * 9.8, rel=1e-4)
    low, high = LandingSettings().duration_s
    assert low <= plan.duration_s <= high


def test_landing_keeps_to_the_ground_and_the_legs():
    plan, reach, s = fall(), planner().reach, LandingSettings()
    edge = reach.cop[1] - s.cop_margin_m
    assert np.abs(plan.cop_x).max() < edge + 0.003
    assert (np.abs(plan.F_x) / plan.F_z).max() < 0.46
    assert plan.F_z.min() > 0.95 * s.press_share * reach.mass * 9.8
    phi = np.hypot(*plan.com.T)
    assert np.all(plan.F_z < 1.02 * s.force_gain * np.polyval(reach.force_fit, phi))
    assert phi.min() > reach.length[0] - 0.005
    inside = plan.rho[5:] - np.polyval(reach.inertia_low_fit, phi[5:])
    assert inside.min() > 0
    assert (np.polyval(reach.inertia_high_fit, phi[5:]) - plan.rho[5:]).min() > 0


def test_landing_obeys_newton_and_euler():
    plan, mass = fall(), planner().reach.mass
    np.testing.assert_allclose(plan.F_x, mass * plan.com_acceleration[:, 0], atol=1e-8)
    np.testing.assert_allclose(plan.F_z, mass * (plan.com_acceleration[:, 1] + 9.8), atol=1e-8)
    x, z = plan.com.T
    np.testing.assert_allclose(plan.L_rate, -z * plan.F_x - (plan.cop_x - x) * plan.F_z, atol=1e-7)
    np.testing.assert_allclose(np.gradient(plan.L, plan.t)[2:-2], plan.L_rate[2:-2], atol=2.0)
    moved = np.trapezoid(plan.com_velocity, plan.t, axis=0)
    np.testing.assert_allclose(plan.com[-1] - plan.com[0], moved, atol=1e-3)
    gained = np.trapezoid(np.stack([plan.F_x, plan.F_z - mass * 9.8], -1), plan.t, axis=0)
    np.testing.assert_allclose(gained, -mass * FALL.com_velocity, atol=0.5)


@pytest.mark.parametrize("target", [(0.0, 0.1), (1.2, 0.6), (0.7, 0.55, 0.5)])
def test_every_jump_has_a_landing(target):
    plan = planner().plan(touchdown_of_plan(pendulum(*target), Robot.load()))
    assert plan.statistics.iterations < 40
    assert plan.statistics.residual < 1e-5


def test_finer_mesh_changes_little():
    fine = LandingPlanner(Robot.load(), LandingSettings(intervals=64)).plan(FALL)
    for t in np.linspace(0, 1.2, 49):
        np.testing.assert_allclose(fall().at(t)[0], fine.at(t)[0], atol=0.008)


def test_reference_holds_its_end_and_feeds_forward():
    plan = fall()
    com, velocity, momentum = plan.at(plan.duration_s + 1.0)
    np.testing.assert_allclose(com, plan.com[-1], atol=1e-15)  # rounding of an interpolation
    np.testing.assert_allclose([*velocity, momentum], 0.0, atol=1e-4)
    push, twist = plan.feed_forward(0.05)
    assert push[1] > 5.0
    assert np.isfinite(twist)
    push, twist = plan.feed_forward(plan.duration_s)
    assert not push.any()
    assert twist == 0.0


def test_too_fast_a_fall_forward_names_what_gives():
    with pytest.raises(SolverError, match="landing") as caught:
        planner().plan(replace(FALL, com_velocity=np.array([3.5, -2.4])))
    assert any(word in str(caught.value) for word in ("CoP", "friction", "touchdown", "stance"))


def test_a_landing_is_planned_from_a_full_state_or_refused():
    robot = Robot.load()
    q = configuration(robot, np.array([0.0, 0.45, -0.55, 0.15, 0.0]), toe=(0.3, 0.0))
    falling, away = np.zeros(robot.model.nv), np.zeros(robot.model.nv)
    falling[2], away[0], away[2] = -2.5, 8.0, -2.5
    caught = planner().plan(touchdown_of_state(robot, q, falling))
    assert caught.touchdown.com_velocity[1] > -2.5
    np.testing.assert_allclose(caught.com[0], caught.touchdown.com, atol=1e-6)
    assert "landing" in refused(planner().plan, touchdown_of_state(robot, q, away), by=SolverError)


def test_the_landing_controller_takes_the_plan_as_its_reference():
    robot = Robot.load()
    controller = LandingController(robot, reference=fall())
    q = configuration(robot, stance_angles(robot), toe=-robot.sagittal.sole_center)
    torque = controller.torque(2.0, q, np.zeros(robot.model.nv), np.full(2, 206.0))
    assert controller.solver.failures == 0
    rest = LandingController(robot).torque(2.0, q, np.zeros(robot.model.nv), np.full(2, 206.0))
    np.testing.assert_allclose(torque, rest, atol=0.5)
