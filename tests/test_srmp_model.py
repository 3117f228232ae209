"""Stage 1's pendulum: identities of the paper's equations, and two derivations that agree."""

import casadi as ca
import numpy as np
import pytest
from paper.lagrange import pendulum

from jumplab.models.srmp import COORDINATES, SrmpState

MASS, G = 42.0, 9.8
NAMES = ("com", "com_velocity", "com_acceleration", "inertia", "inertia_rate", "inertia_accel", "L", "L_rate",
         "ground_force", "pivot_torque", "rod_force", "barbell_force")  # fmt: skip
STEP = 1e-5


def _function():
    q, v, a = (ca.SX.sym(n, 4) for n in "qva")
    s = SrmpState(MASS, q, v, a, G)
    return ca.Function("srmp", [q, v, a], [getattr(s, n) for n in NAMES])


FUNCTION = _function()


def at(q, v, a):
    return {n: x.full().squeeze() for n, x in zip(NAMES, FUNCTION(q, v, a), strict=True)}


def random_states(count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        q = np.array([rng.uniform(-0.6, 0.6), rng.uniform(0.3, 0.9), rng.uniform(-1, 1), rng.uniform(0.2, 0.45)])
        yield q, rng.normal(scale=3, size=4), rng.normal(scale=20, size=4)


def test_coordinates():
    assert COORDINATES == ("lean", "length", "turn", "radius")


def test_lagrange_agrees():  # M-1
    second = pendulum(MASS, G)
    for q, v, a in random_states(20):
        x = at(q, v, a)
        want = [x["pivot_torque"], x["rod_force"], x["L_rate"], x["barbell_force"]]
        np.testing.assert_allclose(second(q, v, a).full().ravel(), want, rtol=1e-10, atol=1e-10)


def test_printed_forces():  # M-1, written out
    for (lean, phi, turn, r), (w, phi1, wp, r1), (w1, phi2, wp1, r2) in random_states(10, seed=1):
        x = at([lean, phi, turn, r], [w, phi1, wp, r1], [w1, phi2, wp1, r2])
        L_rate = MASS * r**2 * (w1 + wp1) + 2 * MASS * r * r1 * (w + wp)
        assert x["rod_force"] == pytest.approx(MASS * (phi2 - phi * w**2 + G * np.cos(lean)), rel=1e-12)
        assert x["barbell_force"] == pytest.approx(MASS * (r2 - r * (w + wp) ** 2), rel=1e-12)
        assert x["L_rate"] == pytest.approx(L_rate, rel=1e-12)
        swing = MASS * phi**2 * w1 + 2 * MASS * phi * phi1 * w - MASS * G * phi * np.sin(lean) + L_rate
        assert x["pivot_torque"] == pytest.approx(swing, rel=1e-10)


def test_two_masses_make_the_same(bhr):
    """The barbell's two ends as point masses: inertia and momentum about the CoM from first principles."""
    for q, v, _ in random_states(5, seed=3):

        def ends(t, q=q, v=v):
            lean, _, turn, r = q + t * v
            offset = r * np.array([np.sin(lean + turn), np.cos(lean + turn)])
            return offset, -offset

        spin = 0.0
        for end in range(2):
            r, rate = ends(0.0)[end], (ends(STEP)[end] - ends(-STEP)[end]) / (2 * STEP)
            spin += MASS / 2 * (r[1] * rate[0] - r[0] * rate[1])
        assert at(q, v, np.zeros(4))["L"] == pytest.approx(spin, rel=1e-7)


PAIRS = [("com", "com_velocity"), ("com_velocity", "com_acceleration"), ("inertia", "inertia_rate"),
         ("inertia_rate", "inertia_accel"), ("L", "L_rate")]  # fmt: skip


@pytest.mark.parametrize("quantity, rate", PAIRS)
def test_rates_are_derivatives(quantity, rate):
    for q, v, a in random_states(5, seed=4):
        before, after = (at(q + t * v + t * t / 2 * a, v + t * a, a)[quantity] for t in (-STEP, STEP))
        np.testing.assert_allclose(at(q, v, a)[rate], (after - before) / (2 * STEP), rtol=1e-6, atol=1e-6)


def test_cop_is_the_papers():  # M-4 and the equation of SL-P2
    for q, v, a in random_states(20, seed=5):
        x = at(q, v, a)
        (px, pz), (ax, az) = x["com"], x["com_acceleration"]
        force = MASS * (az + G)
        printed = px - (MASS * pz * ax + x["L_rate"]) / force
        assert -x["pivot_torque"] / force == pytest.approx(printed, rel=1e-9, abs=1e-9)
        np.testing.assert_allclose(x["ground_force"], [MASS * ax, force], rtol=1e-12)


def free_accelerations(q, v):
    """Accelerations that make F_phi, tau_l and dL/dt zero; the barbell keeps its length."""
    zero = np.zeros(4)
    names = ("rod_force", "pivot_torque", "L_rate")
    base = np.array([at(q, v, zero)[n] for n in names])
    columns = np.array([[at(q, v, np.eye(4)[k])[n] for n in names] for k in range(3)]).T - base[:, None]
    return np.array([*np.linalg.solve(columns, -base), 0.0])


def test_three_zeros_are_a_zero_wrench():
    """F_phi = tau_l = dL/dt = 0 together leave nothing but gravity: c'' = -g."""
    for q, v, _ in random_states(10, seed=6):
        x = at(q, v, free_accelerations(q, v))
        np.testing.assert_allclose(x["com_acceleration"], [0.0, -G], atol=1e-9)
        np.testing.assert_allclose(x["ground_force"], 0, atol=1e-8)
