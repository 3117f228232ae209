"""Nine-link quantities: every Jacobian and drift against finite differences, and against other libraries' paths."""

import numpy as np
import pinocchio as pin
import pytest

from jumplab.errors import RobotError
from jumplab.models.full import FullBody, force_target
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration

STEP = 1e-5  # central differences: truncation and round-off meet near 1e-9 for quantities of size 1 to 100
TOLERANCE = 2e-7


@pytest.fixture(scope="module")
def body():
    return FullBody(Robot.load())


def random_states(body, n=4, seed=3):
    rng = np.random.default_rng(seed)
    for _ in range(n):
        q = pin.integrate(body.model, stance_configuration(body.robot), 0.5 * rng.normal(size=body.nv))
        yield q, rng.normal(size=body.nv), rng.normal(size=body.nv)


def check_differences(body, quantity, jacobian, drift, q, v, a):
    """The one finite-difference check: x' = J v and x'' = J a + drift along the motion q(t) with q' = v, v' = a.

    ``quantity(terms)`` may be None for angular velocities, which are no derivative of anything; then the rate J v is
    differentiated instead.
    """

    def at(t):
        return body.terms(pin.integrate(body.model, q, v * t + a * t * t / 2), v + a * t)

    now, before, after = at(0.0), at(-STEP), at(STEP)
    if quantity is not None:
        slope = (quantity(after) - quantity(before)) / (2 * STEP)
        np.testing.assert_allclose(jacobian(now) @ v, slope, atol=TOLERANCE * (1 + np.abs(slope).max()))
    rate = (jacobian(after) @ after.v - jacobian(before) @ before.v) / (2 * STEP)
    np.testing.assert_allclose(jacobian(now) @ a + drift(now), rate, atol=TOLERANCE * (1 + np.abs(rate).max()))


CASES = {
    "A_c, B_c": (lambda x: x.com, lambda x: x.A_c, lambda x: x.B_c),
    "A_h, B_h": (None, lambda x: x.A_h, lambda x: x.B_h),
    "J_rho": (lambda x: np.array([x.rho]), lambda x: x.J_rho[None], lambda x: np.array([x.drift_rho])),
    "tiptoes": (lambda x: x.tip.place, lambda x: x.tip.jacobian[:, :3], lambda x: x.tip.drift[:, :3]),
    "feet, angular": (None, lambda x: x.tip.jacobian[:, 3:], lambda x: x.tip.drift[:, 3:]),
    "heels": (lambda x: x.heel.place, lambda x: x.heel.jacobian[:, :3], lambda x: x.heel.drift[:, :3]),
    "J_rd": (lambda x: x.foot_com, lambda x: x.J_rd, lambda x: x.drift_rd),
}


@pytest.mark.parametrize("name", CASES)
def test_jacobian_and_drift(body, name):
    for state in random_states(body):
        check_differences(body, *CASES[name], *state)


def test_velocities_match_jacobians(body):
    for q, v, _ in random_states(body, 2):
        x = body.terms(q, v)
        pairs = (
            (x.A_c, x.com_velocity),
            (x.A_h, x.momentum),
            (x.J_rho, x.rho_rate),
            (x.tip.jacobian, x.tip.velocity),
            (x.heel.jacobian, x.heel.velocity),
        )
        for jacobian, value in pairs:
            rate = jacobian @ v
            np.testing.assert_allclose(rate, value, atol=1e-12)


def test_dynamics_and_places_against_pinocchio(body):
    model, data = body.model, body.model.createData()
    for q, v, a in random_states(body):
        x = body.terms(q, v)
        np.testing.assert_allclose(x.M @ a + x.H, pin.rnea(model, data, q, v, a), atol=1e-9)
        pin.framesForwardKinematics(model, data, q)
        pin.ccrba(model, data, q, v)
        assert x.rho == pytest.approx(data.Ig.inertia[1, 1], abs=1e-10)
        for k, name in enumerate(body.robot.foot.frames):
            frame = data.oMf[model.getFrameId(name)]
            for i, place in ((0, x.heel.place), (2, x.tip.place)):
                corners = body.robot.foot.corners[i : i + 2]
                np.testing.assert_allclose(frame.act(corners.mean(0)), place[k], atol=1e-12)
            np.testing.assert_allclose(frame.act(body.robot.foot.center), x.sole.place[k], atol=1e-12)
            np.testing.assert_allclose(frame.rotation, x.tip.turn[k], atol=1e-12)


def test_wrench_map(body):
    """A_f F + gravity is the momentum rate of whatever acceleration the six base rows allow."""
    rng = np.random.default_rng(7)
    for q, v, _ in random_states(body, 2):
        x = body.terms(q, v)
        force, torque = 100 * rng.normal(size=12), 50 * rng.normal(size=body.nv - 6)
        a = np.linalg.solve(x.M, x.J.T @ force + np.r_[np.zeros(6), torque] - x.H)
        rate = x.A_h @ a + x.B_h
        target = force_target(body.mass, body.gravity, rate[:3] / body.mass, rate[3:])
        np.testing.assert_allclose(x.A_f @ force, target, atol=1e-8)
        np.testing.assert_allclose(x.A_c @ a + x.B_c, rate[:3] / body.mass, atol=1e-9)


def test_gravity_can_be_another():
    robot = Robot.load()
    moon, rest = FullBody(robot.under_gravity(1.62)), np.zeros(robot.model.nv)
    weight = moon.terms(stance_configuration(robot), rest).H[[0, 2]]
    assert np.hypot(*weight) == pytest.approx(42 * 1.62) and moon.gravity == pytest.approx(1.62)
    assert FullBody(robot).gravity == pytest.approx(9.8)


def test_symmetry_signs_follow_from_motion(body):
    signs = {body.model.names[2 + left - 6]: sign for left, _, sign in body.pairs["flight"]}
    pitch = {f"left_{n}": 1 for n in ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch")}
    assert signs == {"left_hip_yaw": -1, "left_hip_roll": -1, "left_ankle_roll": -1, **pitch}
    assert body.symmetry_rows("launch").shape == (4, 20) and body.symmetry_rows("flight").shape == (7, 20)


def with_axis(robot, joint, old, new):
    """The robot with one joint's axis replaced."""
    head, tail = robot.urdf.split(f'<joint name="{joint}"', 1)
    assert f'<axis xyz="{old}" />' in tail.split("</joint>", 1)[0]
    return Robot.from_text(f'{head}<joint name="{joint}"{tail.replace(old, new, 1)}', robot.config_text)


def test_mirrored_axes_turn_sums_into_differences():
    rolled = with_axis(Robot.load(), "right_hip_roll", "1 0 0", "-1 0 0")
    row = FullBody(rolled).symmetry_rows("launch")[1]
    assert sorted(row[row != 0]) == [-1, 1]  # a difference now


def test_a_crooked_foot_is_named():
    straight = '<origin xyz="0 0 -0.35" rpy="0 0 0" />'  # of knees and ankles
    turned = Robot.load().urdf.replace(straight, straight.replace("0 0 0", "0 0 0.1"))
    with pytest.raises(RobotError, match=r"axes of 'left_foot' are not parallel"):
        FullBody(Robot.from_text(turned, Robot.load().config_text))
