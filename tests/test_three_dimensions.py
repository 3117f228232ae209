"""Jumps out of the plane: the method that plans them, the one that is refused, their pictures."""

import numpy as np
import pytest
from fixtures_core import jump, planner, refused

import jumplab as jl
from jumplab.cli.main import main
from jumplab.ocp import Nlp
from jumplab.stages.planner import Planner
from jumplab.studies.chain import Course, crouched, run_chain
from jumplab.task import JumpTask

SIDE = JumpTask(0.1, 0.3, side_m=0.2)
TURN = JumpTask(0.0, 0.3, yaw_rad=np.pi / 4)
FLIP = JumpTask(0.0, 0.6, yaw_rad=0.1, rotation_rad=2 * np.pi)
REFUSED = "method 'three-step': stages 1 and 2 are planar, and this target goes to the side or turns; choose 'direct'"


@pytest.fixture
def no_solve(monkeypatch):
    monkeypatch.setattr(Nlp, "solve", lambda *a, **k: pytest.fail("a stage was solved"))


# refused ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("task", [SIDE, TURN, FLIP], ids=["side", "turn", "flip"])
def test_three_steps_have_no_third_dimension(task, no_solve):
    assert refused(planner().plan, task, "three-step") == REFUSED
    assert refused(jl.plan, task, planner().robot, method="three-step") == REFUSED


@pytest.mark.parametrize(
    "changes",
    [
        {"settings": {"w_time": 3.0}},
        {"weights": {"srmp/turn": 3.0}},
        {"off": ["joint qp/friction"]},
        {"weights": {"track inertia": 1.0}},
    ],
)
def test_what_only_three_steps_have_changes_no_jump_to_the_side(bhr, changes, no_solve):
    assert refused(Planner(bhr, **changes).plan, SIDE) == REFUSED


def test_weights_of_one_plan_that_name_another_stage_are_refused(no_solve):
    said = "it takes limits, mesh and the terms of 'whole body'; choose 'three-step', or leave out these changes"
    found = refused(planner().plan, SIDE, "direct", weights={"srmp/turn": 1.0})
    assert found == f"method 'direct' cannot use changes of 'srmp': {said}"


def test_a_plan_of_three_steps_is_not_planned_again_to_the_side():
    assert refused(planner().replan, jump(0.5, 0.3), SIDE) == REFUSED


def test_a_chain_with_turns_is_not_planned_in_three_steps(bhr, no_solve):
    course = Course.of([0.0], 0.3, turns_rad=[0.5])
    assert refused(run_chain, course, bhr, planner=Planner(crouched(bhr)), method="three-step") == REFUSED


@pytest.mark.parametrize("way", [("--side-m", "0.2"), ("--yaw-deg", "45")])
def test_the_command_line_refuses_alike(tmp_path, capsys, way, no_solve):
    asked = "--distance-m", "0.1", "--height-m", "0.3", "--method", "three-step"
    code = main(["plan", *asked, *way, "--out", str(tmp_path / "plan")])
    assert (code, capsys.readouterr().err) == (2, f"jumplab: {REFUSED}\n")


# planned ----------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_turn_is_planned_by_the_spatial_program_alone():
    plan = planner().plan(TURN)
    assert plan.method == "direct"
    assert [row.stage for row in plan.statistics[:2]] == [
        "direct, straight ahead, held Gauss-Newton",
        "direct, ramp, held Gauss-Newton",
    ]
    assert len(plan.statistics) == len(plan.whole_body.attempts)
    assert plan.srmp is None and plan.joints is None
    assert set(plan.weights) == {"whole body"} and len(plan.terms()) > 30
    assert jl.audit(plan).passed


@pytest.mark.slow
def test_pictures_show_both_sides_and_three_directions():
    plan = planner().plan(TURN)
    figures = (
        jl.plots.inertia_and_momentum(plan.tape),
        jl.plots.margins(plan.tape, plan.robot),
        jl.plots.joint_trajectories(plan.tape, plan.robot),
    )
    assert [len(fig.axes) for fig in figures] == [6, 9, 14]
    labels = [ax.get_ylabel() for ax in figures[0].axes]
    assert labels == [*(f"$v_{x}$ of the CoM [m/s]" for x in "xyz"), *(f"$L_{x}$ [kg m$^2$/s]" for x in "xyz")]
