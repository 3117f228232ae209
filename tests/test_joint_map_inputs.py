"""Stage 2 refuses what it cannot use, in one sentence that names what and when."""

from types import SimpleNamespace

import numpy as np
import pytest
from fixtures_core import pendulum, refused
from paper.joint_qp_printed import Form
from paper.joint_qp_studies import CvxpySolver
from paper.joint_violations import joint_violations
from test_joint_map import errors

from jumplab.errors import InputError, SolverError
from jumplab.ocp.qp import Qp, QpAnswer, QpSolver, conflict
from jumplab.robot import Robot
from jumplab.stages.changes import StageChanges
from jumplab.stages.joint_qp import Limits, Options, build_problem, map_to_joints
from jumplab.stages.joint_qp.programs import Track
from jumplab.stages.joint_qp.words import checked


def test_another_thing_than_a_plan_of_stage_one():
    assert "stage 1's plan must be a SrmpPlan, got namespace" in refused(map_to_joints, SimpleNamespace(), Robot.load())


@pytest.mark.parametrize("step", [0.0, -0.01, 0.1, float("nan"), "fast", None])
def test_bad_step(step):
    with pytest.raises(InputError, match=r"step_s = .* must be a number between"):
        map_to_joints(pendulum(1.0, 0.5), Robot.load(), step_s=step)


def test_unknown_words():
    assert "form: heel = 'never', must be one of" in refused(Form, heel="never")
    assert "q0 has shape (3,)" in refused(map_to_joints, pendulum(1.0, 0.5), Robot.load(), q0=np.zeros(3))


def test_hopeless_limits_name_phase_time_and_rows():
    weak = Options(limits=Limits(torque_share=0.05))
    said = (
        r"^stage 2: at t = 0\.\d+ s of the launch no joint motion follows stage 1; the nearest one misses '.+' by "
        r"\d.* (N|m/s\^2|N m|rad/s\^2) \(.+\), held back by .+ \(.+_.+\)"
    )
    with pytest.raises(SolverError, match=said) as error:
        map_to_joints(pendulum(1.0, 0.5), Robot.load(), options=weak)
    assert error.value.exit_code == 3 and error.value.violations and "\n" not in str(error.value)
    words = ("PROXQP", "QP", "infeasible", "solver", "row", "slack")  # of the solver, not of the jump
    assert error.value.status and not [w for w in words if w in str(error.value)]


def small_qp(total=1.0):
    """The least x^2 + y^2 with x + y = total, x <= 0.2 and both within 1."""
    qp = Qp(2)
    qp.cost("small", np.eye(2), 0.0)
    qp.equality("sum", [[1.0, 1.0]], total, ["x + y"])
    qp.limit("cap", [[1.0, 0.0]], high=0.2, labels="x")
    qp.limit("box", np.eye(2), -1.0, 1.0, "xy")
    return qp


@pytest.mark.parametrize("solver", [QpSolver(), CvxpySolver()])
def test_a_small_qp_and_its_conflict(solver):
    launch = build_problem(Options()).phases[0]
    for _ in range(2):
        answer = solver.solve(small_qp())
        np.testing.assert_allclose(answer.x, [0.2, 0.8], atol=1e-7)
        assert checked(launch, small_qp(), answer, 0.0) < 1e-6
    with pytest.raises(SolverError, match=r"at t = 1\.500 s of the launch .* misses 'sum' by 1\.8 \(x \+ y\)"):
        checked(launch, small_qp(3.0), solver.solve(small_qp(3.0)), 1.5)


def test_the_conflict_is_told_from_the_bystanders():
    """x + y = 3 with x <= 0.2 and y <= 1: the sum gives way by 1.8; the lower sides of the box have no part in it."""
    found = conflict(small_qp(3.0))
    assert [g[:2] for g in found.gives] == [("sum", "x + y")] and found.gives[0][2] == pytest.approx(1.8, abs=1e-5)
    assert set(found.limits) == {("cap", "x"), ("box", "y")}
    assert conflict(small_qp()) is None


def test_a_wrong_answer_is_refused_whatever_the_status():
    launch = build_problem(Options()).phases[0]
    with pytest.raises(
        SolverError, match=r"did not settle \(optimal\): one exists, but the answer misses 'sum x \+ y' by 0\.5"
    ):
        checked(launch, small_qp(), QpAnswer(np.array([0.2, 0.3]), 3, "optimal", True), 0.0)
    with pytest.raises(SolverError, match="is not a finite one"):
        checked(launch, small_qp(), QpAnswer(np.array([np.nan, 0.0]), 0, "user_limit", False), 0.0)


def test_track_from_state_begins_there_and_joins():
    t = np.linspace(0, 0.6, 61)
    track = Track(t, np.sin(t), np.cos(t)).from_state(0.2, 0.5, 0.15)
    assert track.value[0] == pytest.approx(0.2) and track.rate[0] == pytest.approx(0.5)
    np.testing.assert_allclose(track.value[20:], np.sin(t[20:]), atol=1e-12)
    np.testing.assert_allclose(np.cumsum(track.feed) * t[1] + 0.5, track.rate[1:], atol=1e-12)


def test_limits_that_are_left_out_never_bind():
    free = StageChanges(off=("ground", "torque", "speed and range"))
    plan = map_to_joints(pendulum(1.0, 0.5), Robot.load(), options=Options(), changes=free)
    assert joint_violations(plan, Robot.load())["torque"] > 0.5 and errors(plan)["takeoff_velocity"] < 0.02
