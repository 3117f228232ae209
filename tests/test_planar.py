"""Five links rooted at the toe: derivatives, energy, momentum, and a second derivation."""

import casadi as ca
import numpy as np
import pytest
from fixtures_core import chain_motion
from paper.lagrange import five_links
from paper.planar import PlanarState, evaluator, symbols

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


PAIRS = [("com", "com_velocity"), ("com_velocity", "com_acceleration"), ("L", "L_rate"), ("rho", "rho_rate"),
         ("joints", "joint_rates")]  # fmt: skip


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
