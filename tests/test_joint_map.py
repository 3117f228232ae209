"""Stage 2: tracking, limits, drift, agreement of both solution paths, and what the paper's literal forms do."""

from functools import cache
from itertools import product

import numpy as np
import pytest
from fixtures_core import pendulum
from paper.joint_qp_printed import PRINTED, Form, cop_behind_toe_mm, map_as_read
from paper.joint_qp_studies import CvxpySolver, wide
from paper.joint_violations import joint_violations
from paper.tracking import tracking

from jumplab.errors import SolverError
from jumplab.models.full import FullBody
from jumplab.ocp.qp import QpSolver
from jumplab.robot import Robot
from jumplab.stages.changes import StageChanges
from jumplab.stages.joint_qp import JointMapper, Options, map_to_joints

AGREE = {"force": 0.02, "acceleration": 2e-3}  # N or N m, rad/s^2: a hundred thousandth of what occurs


@cache
def mapped(**form):
    """The roll-out of one jump, in a form of the paper's QPs."""
    if form:
        return map_as_read(pendulum(1.0, 0.5), Robot.load(), Form(**form))
    return map_to_joints(pendulum(1.0, 0.5), Robot.load(), options=Options())


def errors(plan, target=(1.0, 0.5)):
    """Of a roll-out, against what it follows."""
    return tracking(plan, pendulum(*target), Robot.load())


def check_physics(plan):
    """Check laws that hold whatever the reference: contacts, limits, symmetry, dynamics."""
    r = joint_violations(plan, Robot.load())
    assert r["toe_drift"] < 1e-3 and r["penetration"] < 1e-3
    assert r["asymmetry"] < 1e-9
    assert r["cop_outside"] < 1e-6 and r["pull"] < 1e-6 and r["friction"] < 0.45 + 1e-6
    assert r["torque"] < 1 + 1e-6 and r["torque_excess"] < 1e-5 and r["speed"] < 1 + 1e-6 and r["range"] == 0
    assert r["flight_com"] < 2e-3 and r["flight_momentum"] < 0.1
    assert plan.statistics.worst_residual < 1e-6


def test_heel_rises_only_with_the_pressure_at_the_toe():
    plan = mapped()
    toe = np.flatnonzero(plan.contact == "toe")
    assert 0.04 < plan.t[toe[-1]] - plan.t[toe[0]] < 0.2
    body = FullBody(Robot.load())
    pitch = np.array([body.terms(q, v).foot_pitch for q, v in zip(plan.q, plan.v, strict=True)])
    assert np.abs(pitch[plan.contact == "flat"]).max() < 1e-3
    assert pitch[toe[-1]].min() > 0.1


@pytest.mark.parametrize("target", [(1.0, 0.5), (0.5, 0.3)])
def test_follows_stage_one(target):
    plan = mapped() if target == (1.0, 0.5) else map_to_joints(pendulum(*target), Robot.load())
    e = errors(plan, target)
    check_physics(plan)
    assert e["takeoff_velocity"] < 0.02 and e["launch_momentum"] < 0.05
    assert e["launch_inertia_rms"] < 0.03 and e["flight_inertia_rms"] < 0.03


@pytest.mark.slow
def test_targets_within_reach_are_followed():
    """All of six targets run through within every limit; what stage 1 asks is now and then beyond the robot."""
    seen = []
    for target in product((0.0, 0.4, 0.8), (0.2, 0.5)):
        plan = map_to_joints(pendulum(*target), Robot.load())
        check_physics(plan)
        e = errors(plan, target)
        seen.append([e[k] for k in ("takeoff_velocity", "launch_momentum", "launch_inertia_rms",
                                         "flight_inertia_rms")])  # fmt: skip
    assert (np.median(seen, axis=0) < [0.02, 0.05, 0.03, 0.03]).all()
    assert (np.max(seen, axis=0) < [0.05, 0.10, 0.06, 0.06]).all()


@pytest.fixture(scope="module")
def steps():
    """(phase QP, published accelerations, quantities, target, program) at some steps of the roll-out."""
    plan, reference = mapped(), pendulum(1.0, 0.5)
    mapper = JointMapper(reference, Robot.load())
    launch, flight = plan.rows("launch"), plan.rows("flight")
    flying = mapper.flight_from(plan.state(flight.start))
    out = []
    for qp, rows in ((mapper.launch, launch), (flying, flight)):
        for k in np.linspace(0, rows.stop - rows.start - 2, 6).astype(int):
            at = rows.start + k
            start = plan.state(at)._replace(a=plan.predicted[at])  # as the plan's own QP was made
            out.append((qp, plan.a[at], *mapper.step(qp, int(k), start)))
    return out


def test_both_paths_find_the_same_optimum(steps):
    """Tolerance: both solve to 1e-9, and the flattest direction of the Hessian weighs 1e-6."""
    for *_, program in steps:
        x, y = (solver.solve(program).x for solver in (QpSolver(), CvxpySolver()))
        n = len(x) - 20
        np.testing.assert_allclose(x[:n], y[:n], atol=AGREE["force"])
        np.testing.assert_allclose(x[n:], y[n:], atol=AGREE["acceleration"])
        H, g = program.matrices[:2]
        assert x @ H @ x / 2 + g @ x == pytest.approx(y @ H @ y / 2 + g @ y, rel=1e-6, abs=1e-6)


def test_published_accelerations_are_the_optimum(steps):
    """To what the solver's tolerance of 1e-11 leaves open."""
    for _, published, *_, program in steps:
        x = QpSolver().solve(program).x
        np.testing.assert_allclose(x[len(x) - 20 :], published, atol=1e-6)


def test_every_row_has_a_name_and_no_equality_is_said_twice(steps):
    for *_, program in steps:
        for block in (*program.costs.values(), *program.constraints()):
            assert len(block.labels) == len(block.matrix) == len(block.low) == len(block.high)
        E = wide(program)[2]
        assert np.linalg.matrix_rank(E) == len(E)


def test_missing_half_halves_the_targets():
    """X^T W X + f X with f = -b^T A has its optimum at half of b; feedback mends the velocity, not L or the place."""
    printed, ours = errors(mapped(half=False)), errors(mapped())
    assert printed["launch_momentum"] > 0.2 > 10 * ours["launch_momentum"]
    assert printed["launch_com"] > 3 * ours["launch_com"]


def test_three_base_rows_do_not_conserve_angular_momentum():
    plan = map_as_read(pendulum(1.0, 0.5), Robot.load(), Form(base_rows=3),
                       changes=StageChanges(off=("torque",)))  # fmt: skip
    broken = joint_violations(plan, Robot.load())
    assert broken["base_force"] > 100 and broken["flight_momentum"] > 1


def test_free_heel_leaves_the_pressure_behind():
    """The printed tiptoe contact lets the heel rise while the CoP is elsewhere [mm]."""
    assert cop_behind_toe_mm(mapped(contact="free"), Robot.load()) > 20
    assert cop_behind_toe_mm(mapped(), Robot.load()) < 1


def test_printed_form_is_not_enough():
    with pytest.raises(SolverError, match=r"stage 2: at t = \d\.\d+ s of the (launch|flight) no joint motion") as error:
        map_as_read(pendulum(1.0, 0.5), Robot.load(), PRINTED)
    assert error.value.stage == "joint_map" and error.value.violations


def test_results_are_immutable_and_repeatable():
    plan = mapped()
    with pytest.raises(ValueError, match="read-only"):
        plan.q[0, 0] = 1
    again = map_to_joints(pendulum(1.0, 0.5), Robot.load())
    np.testing.assert_allclose(plan.q, again.q, atol=1e-7)  # the order of sums may depend on where arrays lie
    assert plan.f.shape == (len(plan.t), 2, 6) and plan.tau.shape == (len(plan.t), 14)
