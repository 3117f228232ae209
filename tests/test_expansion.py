"""From the planar solution to the tape: the very motion that was optimised, once more in 20 degrees of freedom."""

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS, full_state, inverse_dynamics, jump, replay

from jumplab.models.planar import evaluator
from jumplab.ocp import PhaseSolution
from jumplab.robot.stance import stance_angles
from jumplab.stages.planner import to_link_angles
from jumplab.stages.reconstruction import expand, planar_motion, planar_quantities

TARGET = (1.0, 0.5, 0.0, "direct")


@pytest.fixture(scope="module")
def plan():
    return jump(*TARGET)


@pytest.fixture(scope="module")
def motion(plan, bhr):
    return planar_motion(plan.whole_body.solution.phases, 9.8, bhr)


def random_motion(n=5, seed=0):
    rng = np.random.default_rng(seed)
    return dict(
        t=np.arange(n) / 1e3, angles=rng.uniform(-1, 1, (n, 5)), rates=rng.normal(scale=3, size=(n, 5)),
        accels=rng.normal(scale=20, size=(n, 5)), toe=rng.normal(size=(n, 2)), toe_velocity=rng.normal(size=(n, 2)),
        toe_acceleration=rng.normal(scale=5, size=(n, 2)), flying=np.arange(n) >= 2, toe_phase_start=np.array(0.0),
    )  # fmt: skip


# sampling -------------------------------------------------------------------------------------------------------
def test_sampling_at_one_kilohertz(motion, plan):
    t, i = motion["t"], int(np.argmax(motion["flying"]))
    assert t[0] == 0.0 and t[i] == t[i - 1]
    step = np.diff(t)
    np.testing.assert_allclose(np.delete(step, [i - 1, len(step) - 1]), 1e-3, atol=1e-12)
    assert 0.0 < step[-1] <= 1.25e-3 + 1e-12  # the last one ends at the touchdown itself
    body = plan.whole_body
    assert t[-1] - t[i] == pytest.approx(body.flight_s, abs=1e-12)
    assert body.launch_s <= t[i] < body.launch_s + 1e-3 + 1e-12


def test_samples_are_the_planners_own_interpolant(motion, plan):
    """At the nodes of the solution the tape passes through the nodes."""
    phases = plan.whole_body.solution.phases
    i = int(np.argmax(motion["flying"]))
    flight, t = phases["flight"], motion["t"][i:] - motion["t"][i]
    for k, node in enumerate(flight.t):
        near = int(np.argmin(np.abs(t - node)))
        h = t[near] - node
        want = flight.q[k] + h * flight.v[k] + h * h / 2 * flight.a[k]
        np.testing.assert_allclose(motion["angles"][i + near], want, atol=1e-5)
    np.testing.assert_allclose(motion["angles"][0, 1:], phases["flat"].q[0], atol=1e-12)
    np.testing.assert_allclose(motion["angles"][-1], flight.q[-1], atol=1e-9)


def test_flat_foot_is_flat_and_the_toe_stands(motion):
    launch = ~motion["flying"]
    flat = motion["t"] < float(motion["toe_phase_start"])
    assert np.abs(motion["angles"][flat, 0]).max() == 0.0 and flat.sum() > 100
    for name in ("toe", "toe_velocity", "toe_acceleration"):
        assert np.abs(motion[name][launch]).max() == 0.0


def test_toe_follows_from_the_parabola(motion, plan, bhr):
    flying = motion["flying"]
    c, t = plan.whole_body.solution.phases["flight"].constants, motion["t"][flying] - motion["t"][flying][0]
    rel = planar_quantities(bhr, *(motion[k][flying] for k in ("angles", "rates", "accels", "toe_acceleration")), 9.8)
    com = motion["toe"][flying] + rel["com"]
    np.testing.assert_allclose(com[:, 0], c["com_x"] + c["vel_x"] * t, atol=1e-12)
    np.testing.assert_allclose(com[:, 1], c["com_z"] + c["vel_z"] * t - 4.9 * t**2, atol=1e-12)
    np.testing.assert_allclose(
        motion["toe_acceleration"][flying] + rel["com_acceleration"], [[0, -9.8]] * len(t), atol=1e-9
    )


@pytest.mark.parametrize("flat_s, toe_s", [(0.5, 0.1), (0.5004, 0.1), (0.49999, 0.10001), (0.2501, 0.0609)])
def test_takeoff_falls_on_a_sample_for_any_duration(bhr, flat_s, toe_s):
    """Durations that are no multiple of a millisecond: still 1 kHz, at rest before the start, exact at the end."""
    q = stance_angles(bhr)

    def phase(duration, coordinates):
        n = len(coordinates)
        still = np.tile(coordinates, (4, 1)), np.zeros((4, n)), np.zeros((4, n)), np.zeros((3, n)), np.zeros((4, 0))
        return PhaseSolution(np.linspace(0, duration, 4), *still, duration, {})

    flight = phase(0.3337, q)
    com = planar_quantities(bhr, q[None], *(np.zeros((1, k)) for k in (5, 5, 2)), 9.8)["com"]
    constants = dict(com_x=com[0], com_z=com[1], vel_x=0.5, vel_z=1.0)
    flight = PhaseSolution(*(getattr(flight, k) for k in ("t", "q", "v", "a", "j", "z", "duration")), constants)
    m = planar_motion({"flat": phase(flat_s, q[1:]), "toe": phase(toe_s, q), "flight": flight}, 9.8, bhr)
    i = int(np.argmax(m["flying"]))
    assert m["t"][0] == 0.0 and m["t"][i] == m["t"][i - 1]
    np.testing.assert_allclose(np.diff(m["t"][:i]), 1e-3, atol=1e-12)
    assert flat_s + toe_s - 1e-12 <= m["t"][i] < flat_s + toe_s + 1e-3
    assert np.all(np.diff(m["t"][i:]) > 0.2e-3) and m["t"][-1] - m["t"][i] == pytest.approx(0.3337, abs=1e-12)
    np.testing.assert_allclose(m["angles"][:i], np.tile(q, (i, 1)), atol=1e-15)


# expansion ------------------------------------------------------------------------------------------------------
def test_states_are_those_worked_out_by_hand(bhr):
    m = random_motion()
    tape = expand(m, bhr, 9.8)
    origin = -bhr.sagittal.sole_center
    for k in range(len(m["t"])):
        want = full_state(bhr, *(m[x][k] for x in ("angles", "rates", "accels")), m["toe"][k] + origin,
                          m["toe_velocity"][k], m["toe_acceleration"][k])  # fmt: skip
        for got, x in zip((tape.q[k], tape.v[k], tape.a[k]), want, strict=True):
            np.testing.assert_allclose(got, x, atol=1e-11)


def test_launch_forces_are_the_planar_wrench(bhr):
    """Half on each foot, carried to the origins of the foot frames; torques then leave nothing over."""
    m = random_motion()
    m |= {"toe": np.zeros((5, 2)), "toe_velocity": np.zeros((5, 2)), "toe_acceleration": np.zeros((5, 2))}
    m["flying"] = np.arange(5) >= 4
    tape = expand(m, bhr, 9.8)
    planar = evaluator(bhr.sagittal)
    for k in range(4):
        wrench = planar(angles=m["angles"][k], rates=m["rates"][k], accels=m["accels"][k], toe=np.zeros(2))[
            "ground_wrench"
        ]
        left = inverse_dynamics(bhr, tape.q[k], tape.v[k], tape.a[k], wrench.full().ravel(), -bhr.sagittal.sole_center)
        np.testing.assert_allclose(left[6:], tape.tau[k], atol=1e-8)
        np.testing.assert_allclose(left[:6], 0, atol=1e-8)
        np.testing.assert_allclose(tape.f[k].sum(0)[[0, 2]], wrench.full().ravel()[:2], atol=1e-9)
    assert np.abs(tape.f[4]).max() == 0.0


def test_full_torques_are_half_of_the_planar_ones(plan):
    names, planar = list(plan.tape.joint_names), plan.tape.extra["planar_torques"]
    launch = plan.tape.phase == "launch"
    for i, role in enumerate(LIMBS):
        for name in plan.robot.joints[role]:
            own = plan.tape.tau[:, names.index(name)]
            np.testing.assert_allclose(own[launch], planar[launch, i] / 2, atol=1e-8)
            np.testing.assert_allclose(
                own, planar[:, i] / 2, atol=0.1
            )  # in flight L' between the nodes is small, not zero


def test_gravity_of_the_task_reaches_the_torques(bhr):
    """Standing still under another gravity: half the weight on each foot, nothing left over, torques in proportion."""
    q = np.tile(stance_angles(bhr), (2, 1))
    still = dict(t=np.array([0.0, 1e-3]), angles=q, rates=0 * q, accels=0 * q, toe=np.zeros((2, 2)),
                 toe_velocity=np.zeros((2, 2)), toe_acceleration=np.zeros((2, 2)), flying=np.array([False, False]),
                 toe_phase_start=np.array(1.0))  # fmt: skip
    earth, moon = expand(still, bhr, 9.8), expand(still, bhr, 1.62)
    assert moon.f[0, :, 2].sum() == pytest.approx(42.0 * 1.62)
    np.testing.assert_allclose(moon.tau[0] / 1.62, earth.tau[0] / 9.8, atol=1e-9)


def test_link_angles_come_back(plan):
    """to_link_angles undoes the expansion, trunk turns included."""
    tape = plan.tape
    for got, name in zip(
        to_link_angles(plan.robot, tape.q, tape.v, tape.a), ("angles", "rates", "accels"), strict=True
    ):
        np.testing.assert_allclose(got, tape.extra[f"planar_{name}"], atol=1e-9)


def test_link_angles_come_back_after_a_somersault(bhr):
    m = random_motion(400)
    m["angles"] = np.linspace(0, -2 * np.pi, 400)[:, None] + 0.2 * np.sin(np.arange(5))
    tape = expand(m, bhr, 9.8)
    back = to_link_angles(bhr, tape.q, tape.v, tape.a)[0]
    np.testing.assert_allclose(back - back[0], m["angles"] - m["angles"][0], atol=1e-9)


def test_planar_arrays_are_pinocchios(plan):
    run, extra = replay(*TARGET), plan.tape.extra
    shift = plan.robot.sagittal.sole_center  # the planar origin is the toe, the tape's the middle of the sole
    np.testing.assert_allclose(extra["planar_com"] - shift, run.com[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(extra["planar_com_velocity"], run.com_velocity[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(extra["planar_L"], run.L, atol=1e-9)
    np.testing.assert_allclose(extra["planar_rho"], run.rho, atol=1e-9)
    toe = run.corners[:, 0, 2][:, [0, 2]]
    np.testing.assert_allclose(extra["planar_toe"] - shift, toe, atol=1e-9)


def test_base_is_the_top_of_the_trunk(plan):  # M-5
    model, data = plan.robot.model, plan.robot.model.createData()
    pin.forwardKinematics(model, data, plan.tape.q[500])
    left, right = (data.oMi[model.getJointId(n)].translation for n in plan.robot.joints["shoulder_pitch"])
    np.testing.assert_allclose((left + right) / 2, plan.tape.q[500, :3], atol=1e-12)


def test_quaternions_are_unit(plan):
    np.testing.assert_allclose(np.linalg.norm(plan.tape.q[:, 3:7], axis=1), 1.0, atol=1e-12)
