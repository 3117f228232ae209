"""From the solution to the tape, planar quantities back from it; and planar motions of five links on full robots."""

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS, full_state, inverse_dynamics, jump, replay
from paper.expansion import expand
from paper.planar import evaluator, planar_quantities

from jumplab.ocp import PhaseSolution
from jumplab.robot.stance import stance_angles
from jumplab.stages.reconstruction import to_link_angles
from jumplab.stages.whole_body import ContactPhase, Contacts, Limits, Weights, motions
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.tape import make_tape

TARGET = (1.0, 0.5, 0.0, "direct")
FEET = ("LR", "lr", "-")  # that carry in a jump, phase by phase


@pytest.fixture(scope="module")
def plan():
    return jump(*TARGET)


@pytest.fixture(scope="module")
def chart(plan):
    """The tape's motion as charts, rates and accelerations, each (n, 6 + joints)."""
    tape = plan.tape
    return plan.whole_body.schedule.body.model.charts(tape.q, tape.v, tape.a)


def random_motion(n=5, seed=0):
    rng = np.random.default_rng(seed)
    return dict(
        t=np.arange(n) / 1e3, angles=rng.uniform(-1, 1, (n, 5)), rates=rng.normal(scale=3, size=(n, 5)),
        accels=rng.normal(scale=20, size=(n, 5)), toe=rng.normal(size=(n, 2)), toe_velocity=rng.normal(size=(n, 2)),
        toe_acceleration=rng.normal(scale=5, size=(n, 2)), flying=np.arange(n) >= 2, toe_phase_start=np.array(0.0),
    )  # fmt: skip


# sampling -------------------------------------------------------------------------------------------------------
def test_sampling_at_one_kilohertz(plan):
    t = plan.tape.t
    i = plan.tape.takeoff_index
    body = plan.whole_body
    assert t[0] == 0.0 and t[i] == t[i - 1]
    step = np.diff(t)
    np.testing.assert_allclose(np.delete(step, [i - 1, len(step) - 1]), 1e-3, atol=1e-12)
    assert 0.0 < step[-1] <= 1.05e-3 + 1e-12  # the last one ends at the touchdown itself
    assert t[-1] - t[i] == pytest.approx(body.flight_s, abs=1e-12)
    assert body.launch_s <= t[i] < body.launch_s + 1e-3 + 1e-12


def within(plan, name):
    """Rows of the tape within a phase, its solution, and times since it began."""
    phases = plan.whole_body.phases
    tape = plan.tape
    start = tape.takeoff_time - plan.whole_body.launch_s
    for other, phase in phases.items():
        if other == name:
            break
        start += phase.duration
    at = tape.t - start
    flying = tape.phase == "flight"
    rows = np.flatnonzero((at >= 0) & (at <= phase.duration) & (flying == (name == "flight")))
    return rows, phase, at[rows]


@pytest.mark.parametrize("name", ["flat", "toe"])
def test_samples_on_the_ground_are_the_planners_own_interpolant(chart, plan, name):
    """Base, arms and the pitch of the foot on all three levels; legs follow. On the toes the base moves a little."""
    rows, phase, at = within(plan, name)
    arms = [BASE + plan.robot.joint_names.index(n) for n in plan.robot.joints["shoulder_pitch"]]
    planned = phase.sample(at)
    n = chart[0].shape[1]
    for mine, theirs, foot in zip(chart, planned, ("angles", "rates", "accels"), strict=True):
        columns = [0, *arms] if name == "flat" else arms
        columns = [1, 2, 3, 4, 5, *columns]
        np.testing.assert_allclose(mine[rows][:, columns], theirs[:, columns], atol=1e-9)
        pitch = theirs[:, n] if name == "toe" else np.zeros(len(rows))
        np.testing.assert_allclose(plan.tape.extra[f"planar_{foot}"][rows, 0], pitch, atol=1e-9)
    np.testing.assert_allclose(chart[0][rows, :n], planned[0][:, :n], atol=1e-3)


def test_samples_in_flight_are_the_planners_own_interpolant(chart, plan):
    """But for what the motion between the nodes misses of momentum: some millimetres and milliradians."""
    rows, phase, at = within(plan, "flight")
    n = chart[0].shape[1]
    np.testing.assert_allclose(chart[0][rows, :n], phase.sample(at)[0][:, :n], atol=2e-3)
    nodes = np.array([np.argmin(np.abs(at - t)) for t in phase.t])
    h = (at[nodes] - phase.t)[:, None]
    through = phase.q + h * phase.v + h * h / 2 * phase.a
    np.testing.assert_allclose(chart[0][rows[nodes], :n], through[:, :n], atol=2e-3)


def test_flat_foot_is_flat_and_the_toe_stands(plan):
    extra = plan.tape.extra
    launch = plan.tape.phase == "launch"
    flat = plan.tape.t < float(extra["planar_toe_phase_start"])
    assert np.abs(extra["planar_angles"][flat, 0]).max() < 1e-9 and flat.sum() > 100
    assert np.abs(extra["planar_toe"][launch]).max() < 1e-9


def test_toe_follows_from_the_parabola(plan, bhr):
    """That of the plan but for what it misses between the nodes."""
    extra = plan.tape.extra
    flying = plan.tape.phase == "flight"
    c = plan.whole_body.phases["flight"].constants
    t = plan.tape.t[flying] - plan.tape.takeoff_time
    links = [extra[f"planar_{k}"][flying] for k in ("angles", "rates", "accels")]
    rel = planar_quantities(bhr, *links, 0 * extra["planar_toe"][flying], 9.8)
    com = extra["planar_toe"][flying] + rel["com"] - bhr.sagittal.sole_center  # from the middle of the soles
    np.testing.assert_allclose(com[:, 0], c["com_x"] + c["vel_x"] * t, atol=1e-3)
    np.testing.assert_allclose(com[:, 1], c["com_z"] + c["vel_z"] * t - 4.9 * t**2, atol=1e-3)


@pytest.mark.parametrize("flat_s, toe_s", [(0.5, 0.1), (0.5004, 0.1), (0.49999, 0.10001), (0.2501, 0.0609)])
def test_takeoff_falls_on_a_sample_for_any_duration(plan, bhr, flat_s, toe_s):
    """Durations that are no multiple of a millisecond: still 1 kHz, at rest before the start, exact at the end."""
    body = Body(bhr)
    durations = {"flat": flat_s, "toe": toe_s, "flight": 0.3337}
    named = [ContactPhase(f, (0.05, 1.5), s, 3, n) for f, (n, s) in zip(FEET, durations.items(), strict=True)]
    schedule = Schedule(body, Contacts(tuple(named), ends="touchdown"), Limits(), Weights())
    still = [np.tile(body.stance, (4, 1)) for _ in named]
    guess = motions.guess(schedule, plan.task, motions.Motion(np.array(list(durations.values())), still))
    phases = {}
    for name, g in guess.items():
        t = np.linspace(0, g.duration, 4)
        q = g.q.copy()
        v = 0 * g.q
        a = 0 * g.q
        if name == "flight":  # let go, it falls
            q[:, 2] = q[:, 2] - 4.9 * t**2
            v[:, 2] = -9.8 * t
            a[:, 2] = -9.8
        phases[name] = PhaseSolution(t, q, v, a, 0 * q[1:], g.z, g.duration, g.constants)
    tape = make_tape(schedule, phases, 9.8)
    i = tape.takeoff_index
    t = tape.t
    assert t[0] == 0.0 and t[i] == t[i - 1]
    np.testing.assert_allclose(np.diff(t[:i]), 1e-3, atol=1e-12)
    assert flat_s + toe_s - 1e-12 <= t[i] < flat_s + toe_s + 1e-3
    assert np.all(np.diff(t[i:]) > 0.05e-3 - 1e-12) and t[-1] - t[i] == pytest.approx(0.3337, abs=1e-12)
    flat = t[:i] < flat_s  # on its toes it tips over
    np.testing.assert_allclose(tape.q[:i][flat], tape.q[:1].repeat(flat.sum(), axis=0), atol=1e-12)
    since = (t[i:] - t[i])[:, None]
    com = tape.extra["com"][i:]
    fallen = com[0] + since * tape.extra["com_velocity"][i] - [0.0, 0.0, 4.9] * since**2
    np.testing.assert_allclose(com, fallen, atol=1e-9)


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
    for i, role in enumerate(LIMBS):
        for name in plan.robot.joints[role]:
            np.testing.assert_allclose(plan.tape.tau[:, names.index(name)], planar[:, i] / 2, atol=1e-8)


def test_gravity_of_the_task_reaches_the_torques(bhr):
    """Standing still under another gravity: half the weight on each foot, nothing left over, torques in proportion."""
    q = np.tile(stance_angles(bhr), (2, 1))
    still = dict(t=np.array([0.0, 1e-3]), angles=q, rates=0 * q, accels=0 * q, toe=np.zeros((2, 2)),
                 toe_velocity=np.zeros((2, 2)), toe_acceleration=np.zeros((2, 2)), flying=np.array([False, False]),
                 toe_phase_start=np.array(1.0))  # fmt: skip
    earth, moon = expand(still, bhr, 9.8), expand(still, bhr, 1.62)
    assert moon.f[0, :, 2].sum() == pytest.approx(42.0 * 1.62)
    np.testing.assert_allclose(moon.tau[0] / 1.62, earth.tau[0] / 9.8, atol=1e-9)


def test_link_angles_come_back(bhr):
    m = random_motion()
    tape = expand(m, bhr, 9.8)
    for got, name in zip(to_link_angles(bhr, tape.q, tape.v, tape.a), ("angles", "rates", "accels"), strict=True):
        np.testing.assert_allclose(got, m[name], atol=1e-9)


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
