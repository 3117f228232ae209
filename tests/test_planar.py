"""Five links rooted at the toe: derivatives, energy, momentum, and a second derivation."""

import casadi as ca
import numpy as np
import pytest
from fixtures_core import chain_motion
from paper.lagrange import five_links

from jumplab.models.planar import PlanarState, evaluator, symbols
from jumplab.robot.stance import stance_angles

STEP = 1e-5


@pytest.fixture(scope="module")
def planar(bhr):
    return evaluator(bhr.sagittal)


def at(planar, angles, rates, accels, toe=(0.0, 0.0)):
    out = planar(angles=angles, rates=rates, accels=accels, toe=np.asarray(toe))
    return {k: x.full().ravel() for k, x in out.items()}


def random_states(count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform(-1.5, 1.5, 5), rng.normal(scale=4, size=5), rng.normal(scale=30, size=5)


PAIRS = [
    ("com", "com_velocity"),
    ("com_velocity", "com_acceleration"),
    ("L", "L_rate"),
    ("rho", "rho_rate"),
    ("joints", "joint_rates"),
]


@pytest.mark.parametrize("quantity, rate", PAIRS)
def test_rates_are_derivatives(planar, quantity, rate):
    for q, v, a in random_states(3):
        before, after = (at(planar, q + t * v + t * t / 2 * a, v + t * a, a)[quantity] for t in (-STEP, STEP))
        now = at(planar, q, v, a)[rate]
        np.testing.assert_allclose(now, (after - before) / (2 * STEP), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["toe", "heel", "knee", "hip", "shoulder", "hand", "mid-arm"])
def test_points_and_their_derivatives(bhr, name):
    a, w, b = symbols()
    state = PlanarState(bhr.sagittal, a, w, b)
    function = ca.Function("point", [a, w, b], [state.point(name, k) for k in range(3)])
    for q, v, c in random_states(3, seed=1):
        arms = bhr.sagittal.point_arms(*bhr.sagittal.points[name])
        for got, want in zip(function(q, v, c), chain_motion(arms, q, v, c), strict=True):
            np.testing.assert_allclose(got.full().ravel(), want, atol=1e-11)


def test_com_and_inertia_by_hand(bhr, planar):
    """All arms straight up from an upright leg: heights add, and only heights."""
    s, zero = bhr.sagittal, np.zeros(5)
    out = at(planar, zero, zero, zero)
    place = np.cumsum([[0.0, 0.0], *s.span[:4]], axis=0)  # toe, ankle, knee, hip, shoulder
    links = np.array([*(place[:4] + s.com[:4]), place[4] + s.com[4]])
    com = s.mass @ links / s.mass.sum()
    np.testing.assert_allclose(out["com"], com, atol=1e-12)
    rho = s.inertia.sum() + s.mass @ ((links - com) ** 2).sum(1)
    assert out["rho"][0] == pytest.approx(rho, abs=1e-12)


def test_rigid_turn_has_momentum_rho_w(planar):
    """All links turning together: L = rho w, and rho does not change."""
    for q, _, _ in random_states(3, seed=2):
        out = at(planar, q, np.full(5, 2.0), np.zeros(5))
        assert out["L"][0] == pytest.approx(2.0 * out["rho"][0], rel=1e-12)
        assert out["rho_rate"][0] == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(out["joint_rates"], 0, atol=1e-12)


def test_turning_the_whole_robot_turns_its_forces(planar):
    """Nothing in the model prefers a direction but gravity: without it, a turned motion has turned forces."""
    free = evaluator_without_gravity()
    for q, v, a in random_states(2, seed=3):
        one, two = at(free, q, v, a), at(free, q + 0.7, v, a)
        c, s = np.cos(0.7), np.sin(0.7)
        turn = np.array([[c, s], [-s, c]])
        np.testing.assert_allclose(two["ground_wrench"][:2], turn @ one["ground_wrench"][:2], atol=1e-9)
        np.testing.assert_allclose(two["torques"], one["torques"], atol=1e-9)
        assert two["ground_wrench"][2] == pytest.approx(one["ground_wrench"][2], abs=1e-9)


def evaluator_without_gravity():
    from jumplab.robot import Robot

    return evaluator(Robot.load().sagittal, 0.0)


def energy(model, q, v, gravity=9.8):
    """Kinetic and potential energy over the toe, from the links themselves."""
    total = 0.0
    for i, arms in enumerate(model.com_arms()):
        place, speed, _ = chain_motion(arms, q, v, np.zeros(5))
        total += model.mass[i] * (speed @ speed / 2 + gravity * place[1]) + model.inertia[i] * v[i] ** 2 / 2
    return total


def test_power_balance(bhr, planar):
    """Toe on the ground: the energy changes by what the joints do, and by what the ground's moment does to the foot."""
    for q, v, a in random_states(4, seed=5):
        out = at(planar, q, v, a)
        before, after = (energy(bhr.sagittal, q + t * v + t * t / 2 * a, v + t * a) for t in (-STEP, STEP))
        power = out["torques"] @ out["joint_rates"] + out["ground_wrench"][2] * v[0]
        assert power == pytest.approx((after - before) / (2 * STEP), rel=1e-6)


def test_newton_and_euler_of_the_whole(bhr, planar):
    """Ground wrench = momentum rate - weight, about any point."""
    for q, v, a in random_states(3, seed=6):
        out = at(planar, q, v, a)
        fx, fz, moment = out["ground_wrench"]
        np.testing.assert_allclose([fx, fz], 42.0 * (out["com_acceleration"] + [0, 9.8]), atol=1e-9)
        assert moment - out["com"][1] * fx + out["com"][0] * fz == pytest.approx(out["L_rate"][0], abs=1e-8)


def test_against_lagrange(bhr, planar):
    """M theta'' + H = S tau + J' F of the paper's coordinates, from the toe-rooted recursion."""
    s, second = bhr.sagittal, five_links(bhr.sagittal)
    for i, (q, v, a) in enumerate(random_states(6, seed=7)):
        jolt = np.zeros(2) if i % 2 else np.array([3.0, -5.0])
        out = at(planar, q, v, a, jolt)
        hip, hip_v, hip_a = chain_motion(s.span[:3], q[:3], v[:3], a[:3])
        theta, rate, accel = (
            np.array([*h, x[3], *s.joint_angles(x)]) for h, x in ((hip, q), (hip_v, v), (hip_a + jolt, a))
        )
        left = second(theta, rate, accel).full().ravel()
        force = 42.0 * (out["com_acceleration"] + jolt + [0, 9.8])
        moment = out["L_rate"][0] + out["com"][1] * force[0] - out["com"][0] * force[1]  # about the toe
        joints = [s.point_arms(k, np.zeros(2)) for k in (3, 2, 1)]  # hip, knee, ankle
        about = [moment - p[1] * force[0] + p[0] * force[1] for p in (chain_motion(x, q, v, a)[0] for x in joints)]
        hip_t, knee_t, ankle_t, shoulder_t = out["torques"]
        want = [*force, about[0], hip_t + about[0], knee_t + about[1], ankle_t + about[2], shoulder_t]
        np.testing.assert_allclose(left, want, atol=1e-8)


def test_flight_without_torque_on_the_whole(bhr, planar):
    """With the toe falling so that the CoM falls freely, the torques are those of a robot that nothing touches."""
    s, second = bhr.sagittal, five_links(bhr.sagittal)
    q, v, a = next(random_states(1, seed=8))
    inertia = at(planar, q, v, np.eye(5)[4])["L_rate"] - at(planar, q, v, np.zeros(5))["L_rate"]
    a[4] -= at(planar, q, v, a)["L_rate"][0] / inertia[0]  # the arm swings so that L is constant
    out = at(planar, q, v, a)
    assert out["L_rate"][0] == pytest.approx(0, abs=1e-9)
    jolt = -out["com_acceleration"] - [0, 9.8]
    torques = at(planar, q, v, a, jolt)["torques"]
    hip, hip_v, hip_a = chain_motion(s.span[:3], q[:3], v[:3], a[:3])
    theta, rate, accel = (
        np.array([*h, x[3], *s.joint_angles(x)]) for h, x in ((hip, q), (hip_v, v), (hip_a + jolt, a))
    )
    left = second(theta, rate, accel).full().ravel()
    np.testing.assert_allclose(left[:3], 0, atol=1e-8)
    np.testing.assert_allclose(left[3:], torques, atol=1e-8)


def test_standing_still(bhr, planar):
    """Statics by levers: each leg joint carries the moment of the weights above it, the arms hang."""
    s, q, zero = bhr.sagittal, stance_angles(bhr), np.zeros(5)
    out = at(planar, q, zero, zero)
    place = [chain_motion(s.point_arms(k, np.zeros(2)), q, zero, zero)[0][0] for k in range(5)]
    links = [chain_motion(arms, q, zero, zero)[0][0] for arms in s.com_arms()]

    def weights_about(joint, above):
        return sum(s.mass[i] * 9.8 * (links[i] - place[joint]) for i in above)

    want = [
        weights_about(3, (3, 4)),
        weights_about(2, (2, 3, 4)),
        weights_about(1, (1, 2, 3, 4)),
        -weights_about(4, (4,)),
    ]
    np.testing.assert_allclose(out["torques"], want, atol=1e-9)
    assert np.all(np.abs(out["torques"]) < 0.5 * s.effort)


def test_gravity_is_an_argument(bhr):
    q, zero = stance_angles(bhr), np.zeros(5)
    moon = at(evaluator(bhr.sagittal, 1.62), q, zero, zero)
    assert moon["ground_wrench"][1] == pytest.approx(42.0 * 1.62)
    np.testing.assert_allclose(moon["torques"] / 1.62, at(evaluator(bhr.sagittal), q, zero, zero)["torques"] / 9.8)
