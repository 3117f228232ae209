"""The stages in order: what a finished plan says, what is refused, and that a failed stage feeds nothing."""

import json
import re
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from fixtures_core import jump, planner, refused

from jumplab.errors import SolverError
from jumplab.ocp.nlp import GOOD_STATUSES
from jumplab.robot import Robot
from jumplab.stages import planner as pipeline
from jumplab.stages.planner import METHODS, Planner, motion_of_joints
from jumplab.stages.srmp import SrmpPlanner
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.whole_body import WholeBodyPlanner, motions
from jumplab.task import JumpTask


@pytest.mark.slow
def test_three_steps_and_one(plan):
    direct = jump(1.0, 0.5, 0.0, "direct")
    assert (plan.method, direct.method) == METHODS
    for one, first in ((plan, ["1 SRMP", "2 joint map"]), (direct, [])):
        stage = "3 whole body" if first else "direct"
        tried = [f"{stage}, {x.start}, {x.hessian}" for x in one.attempts]
        assert [row.stage for row in one.statistics] == [*first, *tried]
    assert (plan.whole_body.start, direct.whole_body.start) == ("given motion", "schedule")
    assert plan.srmp is not None and plan.joints is not None
    assert direct.srmp is None and direct.joints is None
    assert all(row.iterations > 0 and row.build_s >= 0 and row.solve_s > 0 for row in plan.statistics)


def test_planned_numbers_are_the_tapes(plan):
    assert plan.planned_distance_m == pytest.approx(1.0, abs=1e-4)
    assert plan.planned_rise_m == pytest.approx(0.5, abs=1e-4)
    v = plan.tape.extra["planar_com_velocity"][plan.tape.takeoff_index, 1]
    assert plan.planned_rise_m == pytest.approx(v * v / (2 * 9.8), abs=1e-4)


def test_tape_fits_the_robot(plan):
    tape, robot = plan.tape, plan.robot
    n = len(tape.t)
    shapes = {"q": (n, 21), "v": (n, 20), "a": (n, 20), "tau": (n, 14), "f": (n, 2, 6), "phase": (n,)}
    assert {k: getattr(tape, k).shape for k in shapes} == shapes
    assert tuple(tape.joint_names) == robot.joint_names and tuple(tape.contact_frames) == robot.foot.frames
    assert list(dict.fromkeys(tape.phase)) == ["launch", "flight"]
    assert all(np.all(np.isfinite(x)) for x in tape.arrays().values() if x.dtype.kind == "f")


def test_tape_carries_stage_one_under_its_own_name(plan):
    extra = plan.tape.extra
    for name in ("com", "com_velocity", "L", "rho", "cop_x", "F_z"):
        np.testing.assert_array_equal(extra[f"srmp_launch_{name}"], getattr(plan.srmp.launch, name))
    np.testing.assert_array_equal(extra["srmp_flight_lean"], plan.srmp.flight.lean)
    assert not any(name.startswith("srmp") for name in jump(1.0, 0.5, 0.0, "direct").tape.extra)


def test_summary_is_plain_and_true(plan):
    summary = json.loads(json.dumps(plan.summary))
    zeros = dict.fromkeys(("platform_m", "rotation_rad", "side_m", "yaw_rad"), 0.0)
    assert summary["target"] == {"distance_m": 1.0, "height_m": 0.5, "gravity": 9.8} | zeros
    assert summary["robot"]["hash"] == plan.robot.hash == Robot.load().hash
    assert summary["robot"]["mass_kg"] == pytest.approx(42.0)
    assert summary["planned_distance_m"] == plan.planned_distance_m
    assert summary["launch_s"] + summary["flight_s"] == pytest.approx(plan.tape.t[-1], abs=1.1e-3)
    for i, name in enumerate(plan.tape.joint_names):
        assert summary["peak_torque_nm"][str(name)] == np.abs(plan.tape.tau[:, i]).max()
        assert summary["peak_torque_nm"][str(name)] <= plan.robot.actuators[str(name)]["effort"]
        assert summary["peak_speed_rad_s"][str(name)] <= plan.robot.actuators[str(name)]["speed"]
    assert [row["stage"] for row in summary["stages"]] == [row.stage for row in plan.statistics]


def test_result_is_immutable(plan):
    with pytest.raises(FrozenInstanceError):
        plan.method = "other"
    with pytest.raises(ValueError, match="read-only"):
        plan.tape.q[0, 0] = 1.0


def test_trunk_bends_forward_first(plan):  # N-15
    """The trunk bows during the launch, by more than stage 1's bound at take-off asks for, before it opens again."""
    pitch = plan.tape.extra["planar_angles"][plan.tape.phase == "launch", 3]
    assert pitch.max() > max(pitch[-1] + 0.1, SrmpSettings().posture_end[0] + 0.1)


def test_inertia_is_shaped_in_flight(plan):  # N-16
    flight = plan.tape.phase == "flight"
    foot = plan.tape.extra["planar_toe"][flight][-1, 0] - plan.tape.extra["planar_com"][flight][-1, 0]
    rho = plan.tape.extra["planar_rho"][flight]
    # the arms swing up first, so rho may rise before it falls: shaped by a tenth at least, feet ahead at the end
    assert np.ptp(rho) > 0.1 * rho[0] and foot > 0.0


@pytest.mark.parametrize("method", ["", "two-step", "Direct"])
def test_unknown_method(method):
    said = refused(Planner(Robot.load()).plan, JumpTask(1.0, 0.5), method)
    assert said == f"method {method!r}: choose one of three-step, direct"


def failing(error: Exception):
    """An object that raises the error, whatever it is asked for."""

    def fail(*arguments, **options):
        raise error

    return fail


@pytest.mark.parametrize("broken", ["stage 1", "stage 2", "direct"])
def test_a_failed_stage_feeds_nothing(monkeypatch, broken):
    failure, reached = SolverError(f"{broken}: no", stage=broken), AssertionError("a later stage ran")
    if broken == "stage 1":
        monkeypatch.setattr(SrmpPlanner, "plan", failing(failure))
    monkeypatch.setattr(pipeline, "map_to_joints", failing(failure if broken == "stage 2" else reached))
    monkeypatch.setattr(WholeBodyPlanner, "plan", failing(failure if broken == "direct" else reached))
    with pytest.raises(SolverError) as e:
        planner().plan(JumpTask(1.0, 0.5), "direct" if broken == "direct" else "three-step")
    assert e.value is failure


def test_stage_three_begins_with_stage_twos_motion(plan):
    """Its charts at the nodes are stage 2's configurations at these times; what a solve begins with follows."""
    last, joints = planner().stage("whole body"), plan.joints
    motion, mesh = motion_of_joints(joints, last, plan.srmp.toe_s), last.mesh.intervals()
    assert [len(x) - 1 for x in motion.charts] == [*mesh.values()] == [12, 8, 12]
    assert motion.durations.sum() == pytest.approx(joints.t[-1], abs=1e-9)
    assert motion.durations[1] == pytest.approx(plan.srmp.toe_s, abs=1e-9)
    at = np.concatenate([[0.0], np.cumsum(motion.durations)])
    for k, charts in enumerate(motion.charts):
        t = np.linspace(at[k], at[k + 1], len(charts))
        q = last.body.model.to_pinocchio(charts, 0 * charts, 0 * charts)[0]
        for column in range(7, q.shape[1]):
            own = np.interp(t, joints.t, joints.q[:, column])
            np.testing.assert_allclose(q[:, column], own, atol=1e-9)
    np.testing.assert_allclose(q[-1], joints.q[-1], atol=1e-9)  # of the flight, its last node: base and all
    guess = motions.guess(plan.whole_body.schedule, plan.task, motion)
    assert {k: len(g.q) - 1 for k, g in guess.items()} == mesh
    heels = guess["toe"].q[:, -1]
    assert np.all(heels >= 0.0) and heels[-1] > 0.2
    velocity = [guess["flight"].constants[k] for k in ("vel_x", "vel_z")]
    np.testing.assert_allclose(velocity, plan.srmp.flight.com_velocity[0], atol=0.15)


@pytest.mark.slow
def test_refusal_of_stage_two_is_one_sentence():
    """One backward metre: phase, time, what is missed and by how much, and what holds it back."""
    with pytest.raises(SolverError) as e:
        planner().plan(JumpTask(-1.0, 0.5), "three-step")
    said = (
        r"^stage 2: at t = \d\.\d{3} s of the (launch|flight) no joint motion follows stage 1; the nearest one misses "
        r"'.+' by [\d.e+-]+ .+ \(.+\), held back by [^;]+$"
    )
    assert re.match(said, str(e.value)), str(e.value)
    assert e.value.stage == "joint_map" and e.value.violations and e.value.exit_code == 3


@pytest.mark.parametrize("method", METHODS)
def test_manifest_says_how_the_plan_came_about(method):
    """Weights and solver statistics of every stage, and that there is no seed to be told."""
    found = jump(1.0, 0.5, 0.0, method).summary["manifest"]
    stages = {"three-step": ["SRMP", "joint map", "whole body"], "direct": ["whole body"]}[method]
    assert list(found["weights"]) == list(found["solvers"]) == stages
    assert all(0 <= w < 1e5 and any(stage.values()) for stage in found["weights"].values() for w in stage.values())
    for name, told in found["solvers"].items():
        assert told["iterations"] > 0 and 0 <= told["residual"] < 1e-4
        assert name == "joint map" or (told["status"] in GOOD_STATUSES and told["variables"] > 100)
    assert found["seeds"].startswith("none")
