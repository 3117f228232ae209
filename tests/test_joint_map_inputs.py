"""Stage 2 refuses what it cannot use, in one sentence that names what and when."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from paper.joint_qp_printed import Form
from paper.joint_violations import joint_violations
from test_joint_map import followable, mapped

from jumplab.errors import InputError, SolverError
from jumplab.robot import Robot
from jumplab.stages.joint_qp import CvxpySolver, DirectSolver, Limits, Options, map_to_joints
from jumplab.stages.joint_qp.diagnosis import conflict
from jumplab.stages.joint_qp.problem import Layout, StepQp
from jumplab.stages.joint_qp.reference import Track, hermite


def broken(phase, **changes):
    reference = copy.deepcopy(followable())
    for name, change in changes.items():
        setattr(getattr(reference, phase), name, change(getattr(getattr(reference, phase), name)))
    return reference


def nan_at(k):
    def change(x):
        x = np.array(x, float)
        x[k] = np.nan
        return x

    return change


@pytest.mark.parametrize(
    "phase, changes, text",
    [
        ("launch", {"L": nan_at(20)}, r"reference of the launch: L is not finite at t = 0\.\d+ s"),
        ("flight", {"foot_com": lambda x: x[:-2]}, r"reference of the flight: foot_com has shape \(\d+, 2\), must be"),
        ("launch", {"t": lambda t: np.where(t > 0.3, t + 0.05, t)}, r"gap after t = 0\.\d+ s, the step there is 0\.05"),
        ("launch", {"t": lambda t: -t}, r"gap after"),
        ("flight", {"t": lambda t: t[:2]}, r"t must be at least 3 finite times"),
    ],
)
def test_bad_references(phase, changes, text):
    with pytest.raises(InputError, match=text):
        map_to_joints(broken(phase, **changes), Robot.load(), method="direct")


def test_missing_parts():
    reference = copy.deepcopy(followable())
    del reference.launch.rho
    with pytest.raises(InputError, match="the array 'rho' is missing"):
        map_to_joints(reference, Robot.load())
    del reference.launch
    with pytest.raises(InputError, match="no phase 'launch'"):
        map_to_joints(reference, Robot.load())


@pytest.mark.parametrize("step", [0.0, -0.01, 0.1, float("nan"), "fast", None])
def test_bad_step(step):
    with pytest.raises(InputError, match=r"step_s = .* must be a number between"):
        map_to_joints(followable(), Robot.load(), step_s=step)


def test_unknown_words():
    with pytest.raises(InputError, match=r"method 'quick' is unknown; it must be one of cvxpy, direct"):
        map_to_joints(followable(), Robot.load(), method="quick")
    with pytest.raises(InputError, match=r"form: heel = 'never', must be one of"):
        Form(heel="never")
    with pytest.raises(InputError, match=r"q0 has shape \(3,\)"):
        map_to_joints(followable(), Robot.load(), q0=np.zeros(3))


@pytest.mark.parametrize("method", ["direct", "cvxpy"])
def test_hopeless_limits_name_phase_time_and_rows(method):
    weak = Options(limits=Limits(torque_share=0.05))
    said = (
        r"^stage 2: at t = 0\.\d+ s of the launch no joint motion follows stage 1; the nearest one misses '.+' by "
        r"\d.* (N|m/s\^2|N m|rad/s\^2) \(.+\), held back by .+ \(.+_.+\)"
    )
    with pytest.raises(SolverError, match=said) as error:
        map_to_joints(followable(), Robot.load(), method=method, options=weak)
    assert error.value.exit_code == 3 and error.value.violations and "\n" not in str(error.value)
    words = ("PROXQP", "QP", "infeasible", "solver", "row", "slack")  # of the solver, not of the jump
    assert error.value.status and not [w for w in words if w in str(error.value)]


def small_qp(**changes):
    layout = Layout.of(A=[("cost", "xy")], E=[("sum", ["x + y"])], G=[("cap", ["x"])], R=[("box", "xy")])
    rows = {"A": np.eye(2), "b": np.zeros(2), "E": np.ones((1, 2)), "e": np.ones(1), "G": np.array([[1.0, 0]])}
    rows |= {"h": np.array([0.2]), "R": np.eye(2), "lower": -np.ones(2), "upper": np.ones(2), "layout": layout}
    return StepQp(**{**rows, **changes})


@pytest.mark.parametrize("solver", [DirectSolver, CvxpySolver])
def test_a_small_qp_and_its_conflict(solver):
    answer = solver(small_qp()).solve(small_qp(), "test", 0.0)
    np.testing.assert_allclose(answer.x, [0.2, 0.8], atol=1e-7)
    bad = small_qp(e=np.array([3.0]))
    with pytest.raises(SolverError, match=r"at t = 1\.500 s of the test .* misses '(sum|cap|box)' by .* \("):
        solver(bad).solve(bad, "test", 1.5)


def test_the_conflict_is_told_from_the_bystanders():
    """x + y = 3 with x <= 0.2 and y <= 1: the sum gives way by 1.8; the lower sides of the box have no part in it."""
    found = conflict(small_qp(e=np.array([3.0])))
    assert [g[:2] for g in found.gives] == [("sum", "x + y")] and found.gives[0][2] == pytest.approx(1.8, abs=1e-5)
    assert set(found.limits) == {("cap", "x"), ("box", "y")}
    assert conflict(small_qp()) is None


def test_a_wrong_answer_is_refused_whatever_the_status():
    from jumplab.stages.joint_qp.solve import checked_answer

    with pytest.raises(
        SolverError, match=r"did not settle \(optimal\): one exists, but the answer misses 'sum x \+ y' by 0\.5"
    ):
        checked_answer(small_qp(), np.array([0.2, 0.3]), 3, "optimal", True, "test", 0.0)
    with pytest.raises(SolverError, match="is not a finite one"):
        checked_answer(small_qp(), None, 0, "user_limit", False, "test", 0.0)


def test_hermite_reproduces_quintics_and_cubics():
    grid, t = np.linspace(0, 1, 5), np.linspace(0, 1, 33)
    five, three = np.polynomial.Polynomial([1, -2, 3, 1, -1, 2]), np.polynomial.Polynomial([1, -2, 3, 1])
    x, dx = hermite(grid, five(grid), five.deriv()(grid), five.deriv(2)(grid), t)
    np.testing.assert_allclose(x, five(t), atol=1e-12)
    np.testing.assert_allclose(dx, five.deriv()(t), atol=1e-11)
    x, dx = hermite(grid, three(grid), three.deriv()(grid), None, t)
    np.testing.assert_allclose(x, three(t), atol=1e-12)
    np.testing.assert_allclose(dx, three.deriv()(t), atol=1e-11)


def test_track_from_state_begins_there_and_joins():
    t = np.linspace(0, 0.6, 61)
    track = Track.of(t, np.sin(t), np.cos(t)).from_state(t, 0.2, 0.5, 0.15)
    assert track.value[0] == pytest.approx(0.2) and track.rate[0] == pytest.approx(0.5)
    np.testing.assert_allclose(track.value[20:], np.sin(t[20:]), atol=1e-12)
    np.testing.assert_allclose(np.cumsum(track.feed) * t[1] + 0.5, track.rate[1:], atol=1e-12)


def test_switched_off_limits_never_bind():
    free = Limits(None, None, False, None, None, None)
    assert replace(free, friction=0.4).friction == 0.4
    plan = map_to_joints(followable(), Robot.load(), method="direct", options=Options(limits=free), q0=mapped().q[0])
    assert joint_violations(plan, Robot.load())["torque"] > 0.5 and plan.tracking["takeoff_velocity"] < 0.02
