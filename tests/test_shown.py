"""Results show themselves: one line where they are printed, a card in a notebook, columns by the names of joints."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures_core import jump

import jumplab as jl
from jumplab.errors import InputError
from jumplab.sim import SimulationResult


@pytest.fixture(scope="module")
def plan():
    return jump(1.0, 0.5)


def test_a_plan_and_its_stages_are_a_line_each(plan):
    lasts = f"{plan.tape.t[-1]:.2f} s"
    assert repr(plan) == f"<JumpPlan: bhr, 1.00 m far, rise 0.50 m, three-step, {lasts}>"
    assert re.fullmatch(r"<Robot: bhr, 42\.0 kg, 14 joints, hash [0-9a-f]+>", repr(plan.robot))
    for x in (plan.tape, plan.srmp, plan.joints, plan.whole_body, plan.whole_body.solution, jl.audit(plan)):
        assert len(repr(x)) < 200 and "\n" not in repr(x) and repr(x).startswith(f"<{type(x).__name__}: ")


@pytest.mark.parametrize("of", [lambda p: p, lambda p: p.robot, jl.audit], ids=["plan", "robot", "audit"])
def test_a_notebook_shows_a_small_table_and_a_picture(plan, of):
    page = of(plan)._repr_html_()
    assert page.count("<table>") == 1 and page.count('src="data:image/png;base64,') == 1 and len(page) < 150_000


def test_a_plans_card_says_whether_its_audit_passed(plan):
    assert ">audit</td>" in plan._repr_html_() and "all 51 checks passed" in plan._repr_html_()
    other = replace(plan, task=replace(plan.task, distance_m=0.9))
    assert "of 51 checks failed: distance" in other._repr_html_()


def test_a_plan_keeps_its_audit_and_how_it_landed(plan, monkeypatch, tmp_path):
    """Made once, the same for the card, the summary and ``jl.audit``; a plan with faults is returned with a warning."""
    assert plan.audit is plan.audit is jl.audit(plan) and plan.audit.sound
    jl.save(tmp_path, plan)
    assert jl.load(tmp_path).plan.summary["audit"] == plan.audit.line() == plan.verdict == "all 51 checks passed"
    other = replace(plan, task=replace(plan.task, distance_m=0.9))
    assert repr(other) == repr(plan)  # not audited yet
    monkeypatch.setattr("jumplab.studies.advice.plan_or_advise", lambda *_: other)
    with pytest.warns(UserWarning, match=r"^the plan is returned with its faults: 1 of 51 checks failed: distance$"):
        assert jl.plan(plan.task, plan.robot) is other
    assert repr(other).endswith("three-step, " + f"{plan.tape.t[-1]:.2f} s; {other.verdict}>")
    clean = replace(plan)
    monkeypatch.setattr("jumplab.sim.simulate_jump", lambda *_, **o: SimpleNamespace(landed=o["engine"] == "mujoco"))
    for engine in ("mujoco", "bullet"):
        assert (repr(clean) == repr(plan)) == (not clean.landings or all(clean.landings))
        jl.simulate(clean, engine=engine)
    assert clean.audit.passed and clean.verdict == "all 51 checks passed; not landed in 1 of 2 tries"
    assert clean.verdict in repr(clean) and clean.verdict in clean._repr_html_()
    assert plan.landings == [] == replace(clean).landings  # each plan has its own


def test_the_rise_counts_from_take_off_and_the_apex_from_the_stance(plan):
    height = plan.tape.extra["com"][:, 2]
    assert plan.planned_apex_m == pytest.approx(height.max() - height[0], abs=1e-12)
    assert plan.planned_rise_m - plan.planned_apex_m == pytest.approx(
        height[0] - height[plan.tape.takeoff_index], abs=1e-12
    )
    assert 0.3 < plan.planned_apex_m < 0.45 < plan.planned_rise_m


def test_what_has_no_card_shows_its_line(plan):
    assert plan.tape._repr_html_() is None


def test_columns_have_names(plan):
    names = list(plan.tape.joint_names)
    np.testing.assert_array_equal(plan.torque["left_knee"], plan.tape.tau[:, names.index("left_knee")])
    both = np.column_stack([plan.speed["left_hip_pitch"], plan.speed["right_hip_pitch"]])
    np.testing.assert_array_equal(plan.speed["hip"], both)
    assert plan.angle["knee"].shape == (len(plan.t), 2) and "nose" not in plan.angle and "knee" in plan.angle
    with pytest.raises(InputError, match=r"^there is no joint 'nose'; there are hip_pitch, knee, ankle_pitch, "):
        plan.torque["nose"]


def test_logs_without_a_robot_say_how_to_get_one(plan):
    logs = SimulationResult(**dict.fromkeys([f for f in SimulationResult.__dataclass_fields__ if f != "robot"]))
    with pytest.raises(InputError, match=r"^these logs do not know their robot; read them with jl\.load$"):
        _ = logs.torque


def test_a_frame_needs_pandas(plan):
    try:
        import pandas  # noqa: F401
    except ImportError:
        with pytest.raises(InputError, match=r"^a frame needs pandas: pip install pandas$"):
            plan.to_frame()
    else:
        frame = plan.to_frame()
        assert len(frame) == len(plan.t) and "left_knee_torque_N_m" in frame


def test_pictures_by_name(plan):
    for draw in (plan.plots.strobe, plan.plots.joints, plan.plots.torques, plan.plots.momentum):
        assert draw().axes
