"""Stage 3 and the direct planner: every named limit on the 1 kHz tape, judged through Pinocchio alone."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS, jump, pendulum, planner, replay

from jumplab.errors import InputError, SolverError
from jumplab.ocp.nlp import GOOD_STATUSES
from jumplab.robot import Robot
from jumplab.stages.whole_body import Limits, Mesh, WholeBodyPlanner, build_problem
from jumplab.stages.whole_body.planner import platform_edge_m
from jumplab.task import JumpTask

LIMITS, MG = Limits(), 42.0 * 9.8
JUMPS = [
    (1.0, 0.5, 0.0, "three-step"),
    (0.6, 0.5, 0.3, "three-step"),
    (0.8, 0.3, -0.2, "three-step"),
    (1.0, 0.5, 0.0, "direct"),
    (0.6, 0.5, 0.3, "direct"),
]


@pytest.fixture(params=JUMPS, ids=str, scope="module")
def run(request):
    """A plan whose tape was looked at again; planned once per session."""
    return replay(*request.param)


def sagittal_columns(run, values):
    """(N, 4) left joints hip, knee, ankle, shoulder of an (N, 14) array."""
    names = list(run.tape.joint_names)
    return values[:, [names.index(run.robot.joints[role][0]) for role in LIMBS]]


# solving --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_it_solves(run):
    s = run.plan.whole_body.solution.statistics
    assert s.status in GOOD_STATUSES and s.residual < 1e-4 and s.iterations <= 40


def test_the_mesh_is_refined(run):
    """A few steps on a third of the mesh first; the fine one, begun from there, needs few iterations."""
    body = run.plan.whole_body
    assert body.coarse.status == "Approached" and body.coarse.variables < 0.6 * body.solution.statistics.variables
    assert body.solution.statistics.iterations <= 40


# dynamics on the tape -------------------------------------------------------------------------------------------
def test_base_residual(run):
    """Six rows that no motor can help: under half a percent of the weight (and of the weight on a lever of 1 m)."""
    assert np.abs(run.residual[:, :6]).max() < 0.005 * MG


def test_joint_rows(run):
    assert np.abs(run.residual[:, 6:]).max() < 1e-6


def test_momentum_theorem(run):
    """Over the launch the contact forces on the tape make the momentum at take-off."""
    launch, t, f = ~run.flying, run.tape.t, run.tape.f
    force = f[launch, :, :3].sum(1) - np.array([0.0, 0.0, MG])
    impulse = np.trapezoid(force, t[launch], axis=0)
    np.testing.assert_allclose(impulse, 42.0 * run.com_velocity[launch][-1], atol=0.5)
    arm = run.feet - run.com[:, None]
    moment = (f[..., 3:] + np.cross(arm, f[..., :3])).sum(1)[launch]
    assert np.trapezoid(moment[:, 1], t[launch]) == pytest.approx(run.L[launch][-1], abs=0.02)


def test_flight_is_ballistic(run):
    t = run.tape.t[run.flying][:, None] - run.tape.takeoff_time
    com, velocity = run.com[run.flying], run.com_velocity[run.flying]
    parabola = com[0] + t * velocity[0] - np.array([0.0, 0.0, 4.9]) * t**2
    assert np.abs(com - parabola).max() < 1e-3
    assert np.ptp(run.L[run.flying]) < 0.01
    assert np.abs(run.tape.f[run.flying]).max() == 0.0


def test_takeoff_has_no_wrench(run):
    last = run.tape.takeoff_index - 1
    assert np.abs(run.tape.f[last]).max() < 1.0
    np.testing.assert_allclose(run.com_acceleration[last], [0.0, 0.0, -9.8], atol=0.02)


def test_continuity_at_takeoff(run):
    i, tape = run.tape.takeoff_index, run.tape
    assert tape.t[i] == tape.t[i - 1]
    np.testing.assert_allclose(tape.q[i], tape.q[i - 1], atol=1e-5)
    np.testing.assert_allclose(tape.v[i], tape.v[i - 1], atol=1e-3)
    np.testing.assert_allclose(tape.a[i], tape.a[i - 1], atol=0.1)
    np.testing.assert_allclose(tape.tau[i], tape.tau[i - 1], atol=0.5)


def test_positions_rates_and_accelerations_agree(run):
    """Step by step; the jerk jumps at the planner's nodes, by up to some 1e4 rad/s^3."""
    tape, model = run.tape, run.robot.model
    for k in range(0, len(tape.t) - 1, 7):
        h = tape.t[k + 1] - tape.t[k]
        if h == 0:
            continue
        slope = pin.difference(model, tape.q[k], tape.q[k + 1]) / h
        np.testing.assert_allclose(slope, (tape.v[k] + tape.v[k + 1]) / 2, atol=2e-3)
        np.testing.assert_allclose((tape.v[k + 1] - tape.v[k]) / h, (tape.a[k] + tape.a[k + 1]) / 2, atol=3.0)


# contact --------------------------------------------------------------------------------------------------------
def test_toe_stays_and_nothing_sinks(run):
    launch = ~run.flying
    toe = run.corners[launch][:, :, 2:]
    assert np.abs(toe - toe[0]).max() < 1e-3
    np.testing.assert_allclose(toe[0, ..., 2], 0.0, atol=1e-9)
    assert run.corners[launch][..., 2].min() > -1e-3


def test_pressure_and_friction(run):
    """CoP within the sole; heel up means CoP at the toe; inside the friction cone; the ground only pushes."""
    fz, fx = run.tape.f[..., 2].sum(1), run.tape.f[..., 0].sum(1)
    loaded = fz > 100.0
    heel, toe = run.corners[:, 0, 0], run.corners[:, 0, 2]
    raised = heel[:, 2] > 0.005
    flat = loaded & ~raised & ~run.flying
    assert np.all(run.cop_x[flat] > heel[flat, 0] - 1e-3) and np.all(run.cop_x[flat] < toe[flat, 0] + 1e-3)
    assert np.abs(run.cop_x - toe[:, 0])[loaded & raised].max() < 0.01
    assert fz.min() > -1.0
    assert np.abs(fx[loaded] / fz[loaded]).max() < LIMITS.friction + 0.01


def test_flight_clears_the_ground(run):
    """No corner of a sole below the surface under it; in mid-flight well above."""
    task, corners = run.plan.task, run.corners[run.flying]
    edge = run.corners[0, 0, 2, 0] + platform_edge_m(task, run.robot)
    surface = np.where(corners[..., 0] > edge, task.platform_m, 0.0)
    height = (corners[..., 2] - surface).min(axis=(1, 2))
    assert height.min() > -1e-3
    assert height[len(height) // 3 : 2 * len(height) // 3].min() > 0.02


# joints ---------------------------------------------------------------------------------------------------------
def test_ranges(run):
    q = run.tape.q[:, 7:]
    for i, name in enumerate(run.tape.joint_names):
        a = run.robot.actuators[str(name)]
        assert q[:, i].min() >= a["lower"] - 1e-6 and q[:, i].max() <= a["upper"] + 1e-6, name


def test_torques_and_speeds(run):
    """Below the share of the peak torque, below the share of the speed limit, and under the motor's line."""
    tau, rate = sagittal_columns(run, run.tape.tau), sagittal_columns(run, run.tape.v[:, 6:])
    a = [run.robot.actuators[run.robot.joints[role][0]] for role in LIMBS]
    peak, speed, corner = (np.array([x[k] for x in a]) for k in ("effort", "speed", "corner_speed"))
    assert np.all(np.abs(tau) <= (LIMITS.torque_share + 0.01) * peak)
    assert np.all(np.abs(rate) <= (LIMITS.speed_share + 0.01) * speed)
    left = np.clip((speed - np.abs(rate)) / (speed - corner), 0.0, 1.0) * peak  # what the motor still has
    driving = tau * rate > 0
    assert np.all((np.abs(tau) <= (LIMITS.torque_share + 0.01) * left)[driving])


def test_symmetry(run):
    """Left is right, nothing rolls or yaws, nothing leaves the plane."""
    names = [str(n) for n in run.tape.joint_names]
    for i, name in enumerate(names):
        if name.startswith("left"):
            k = names.index(name.replace("left", "right"))
            sign = -1 if name.endswith(("roll", "yaw")) else 1
            for x in (run.tape.q[:, 7:], run.tape.v[:, 6:], run.tape.a[:, 6:], run.tape.tau):
                np.testing.assert_allclose(x[:, i], sign * x[:, k], atol=1e-9)
        if name.endswith(("roll", "yaw")):
            assert np.abs(run.tape.q[:, 7 + i]).max() == 0.0
    assert np.abs(run.tape.q[:, [1, 3, 5]]).max() == 0.0 and np.abs(run.tape.v[:, [1, 3, 5]]).max() == 0.0
    np.testing.assert_allclose(run.tape.f[:, 0, [0, 2, 4]], run.tape.f[:, 1, [0, 2, 4]], atol=1e-9)
    np.testing.assert_allclose(run.momentum[:, [1, 3, 5]], 0.0, atol=1e-9)


# the target -----------------------------------------------------------------------------------------------------
def test_start_at_rest(run):
    assert np.abs(run.tape.v[0]).max() < 1e-9 and np.abs(run.tape.a[0]).max() < 1e-6
    assert abs(run.com[0, 0]) < 1e-6  # above the middle of the soles, where the world's x is zero


def test_touchdown(run):
    task, corners = run.plan.task, run.corners
    travelled = corners[-1, :, 2:, 0] - corners[0, :, 2:, 0]
    np.testing.assert_allclose(travelled, task.distance_m, atol=1e-4)
    np.testing.assert_allclose(corners[-1, ..., 2], task.platform_m, atol=1e-3)  # flat, and on the surface
    com = run.com[run.flying][:, 2]
    assert com.max() - com[0] == pytest.approx(task.height_m, abs=1e-3)
    rate = run.tape.v[-1, 6:]
    assert np.abs(rate).max() <= LIMITS.touchdown_joint_rate + 1e-3
    assert abs(run.tape.v[-1, 4]) <= LIMITS.touchdown_trunk_rate + 1e-3
    knee = sagittal_columns(run, run.tape.q[:, 7:])[-1, 1]
    assert LIMITS.touchdown_knee[0] - 1e-3 <= knee <= LIMITS.touchdown_knee[1] + 1e-3
    sole = corners[-1, ..., 0].mean()
    ahead = sole - run.com[-1, 0] - LIMITS.capture_offset_m - LIMITS.capture_slope_s * run.com_velocity[-1, 0]
    assert LIMITS.capture_window_m[0] - 1e-3 <= ahead <= LIMITS.capture_window_m[1] + 1e-3


def test_momentum_follows_stage_one(run):
    """L at take-off within one percent of stage 1's, or within the stated slack where there is little of it."""
    if run.plan.srmp is None:  # the direct planner has no reference: its L at take-off is what the flight keeps
        assert np.ptp(run.L[run.flying]) < 0.01
        return
    want = run.plan.srmp.launch.L[-1]
    allowed = max(LIMITS.momentum_share * abs(want), LIMITS.momentum_slack) + 1e-4
    assert abs(run.L[run.tape.takeoff_index] - want) <= allowed
    assert LIMITS.momentum_share <= 0.01


# the problem ----------------------------------------------------------------------------------------------------
def test_the_direct_problem_tracks_nothing_and_keeps_every_limit(bhr):
    direct = {row["name"] for row in build_problem(bhr, tracking=False).table()}
    assert not any(name.startswith("track") for name in direct)
    assert {"joint torque", "torque-speed", "friction", "unilateral", "CoP in the sole", "capture window"} <= direct


def test_names_are_unique_within_a_phase(bhr):
    for tracking in (True, False):
        table = [(row["phase"], row["name"]) for row in build_problem(bhr, tracking=tracking).table()]
        assert len(table) == len(set(table))


def test_unknown_names_are_refused():
    with pytest.raises(InputError) as e:
        planner().stage("direct").plan(JumpTask(0.5, 0.3), off=("gravity",))
    assert str(e.value).startswith("weight or switch 'gravity': the problem 'whole body' has no such term; it has ")


def test_a_switched_off_limit_is_gone():
    """Without the knee's window at touchdown the cost can only fall; with it, the window holds."""
    body = planner().stage("direct")
    usual = jump(1.0, 0.5, 0.0, "direct").whole_body
    free = body.plan(JumpTask(1.0, 0.5), guess=usual.solution.guess(), off=("knee at touchdown",))
    assert free.solution.statistics.objective <= usual.solution.statistics.objective * (1 + 1e-5)


def test_edge_of_the_platform(bhr):
    up, down = (platform_edge_m(JumpTask(0.8, 0.5, h), bhr) for h in (0.3, -0.2))
    assert up == pytest.approx(0.8 - 0.24 - LIMITS.edge_before_heel_m)  # a little before the landing heel
    assert down == pytest.approx(LIMITS.edge_before_heel_m)  # a little ahead of the launching toe


def test_references_are_stage_ones(bhr):
    srmp, body = pendulum(1.0, 0.5), planner().stage("whole body")
    refs = body.references(srmp, body.mesh)
    for name, size in (("flat", body.mesh.flat), ("toe", body.mesh.toe), ("flight", body.mesh.flight)):
        assert refs[name]["rho"].shape == (1, size + 1)
    assert refs["flat"]["rho"][0, 0] == pytest.approx(srmp.launch.rho[0])
    assert refs["toe"]["rho"][0, -1] == pytest.approx(srmp.launch.rho[-1])
    assert refs["flat"]["velocity"][:, -1] == pytest.approx(refs["toe"]["velocity"][:, 0])
    np.testing.assert_allclose(refs["toe"]["velocity"][:, -1], srmp.launch.com_velocity[-1])
    np.testing.assert_allclose(refs["flight"]["rho"][0, [0, -1]], srmp.flight.rho[[0, -1]])
    data = body.parameters(JumpTask(1.0, 0.5), srmp)
    assert data["momentum"] == srmp.launch.L[-1] and sum(data["launch_s"]) == pytest.approx(srmp.launch_s)


def test_naive_guess_keeps_its_place(bhr):
    guess = planner().stage("direct").naive_guess(JumpTask(1.0, 0.5))
    assert all(np.all(np.isfinite(g.q)) for g in guess.values())
    np.testing.assert_allclose(guess["flat"].q[-1], guess["toe"].q[0, 1:])
    np.testing.assert_allclose(guess["toe"].q[-1], guess["flight"].q[0])


@pytest.mark.slow
def test_a_robot_too_weak_is_told_so(bhr):
    """A fifth of the torque cannot jump: the refusal names terms, amounts and instants, in one sentence."""
    config = bhr.config_text
    urdf = bhr.urdf
    for effort in ("200", "210", "150"):
        urdf = urdf.replace(f'effort="{effort}"', f'effort="{float(effort) * 0.2:g}"')
    weak = WholeBodyPlanner(Robot.from_text(urdf, config), Mesh(8, 6, 8), tracking=False, options={"max_iter": 60})
    with pytest.raises(SolverError) as e:
        weak.plan(JumpTask(0.3, 0.3))
    assert e.value.stage == "whole body" and e.value.violations
    sentence = str(e.value)
    assert "torque" in sentence or "take-off" in sentence
    assert "\n" not in sentence
    # what only says that the motion is one motion is no limit that anybody could relax
    assert not any(name in sentence for name in ("jerk chain", "flat to toe", "toe to flight", "ballistic"))


def test_limits_are_read(bhr):
    rows = {
        (r["phase"], r["name"]): r for r in build_problem(bhr, limits=replace(LIMITS, hand_clearance_m=0.2)).table()
    }
    assert rows["flat", "body clearance"]["value"] == "0.2 ... inf"
