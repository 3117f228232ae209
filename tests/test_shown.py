"""Results have rich displays: one line where they are printed, a card in a notebook, columns by the names of joints."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from fixtures_core import refused
from matplotlib.colors import to_rgb

import jumplab as jl
from jumplab.errors import InputError
from jumplab.show import jumps
from jumplab.sim import SimulationResult


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
    with pytest.warns(UserWarning, match=r"^the plan is returned although it has faults: 1 of 51 checks failed: dis"):
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
    np.testing.assert_array_equal(plan.torque["left_ankle"], plan.torque["left_ankle_pitch"])  # one side of a role
    np.testing.assert_array_equal(plan.torque["right_knee"], plan.torque["knee"][:, 1])
    assert plan.angle["knee"].shape == (len(plan.t), 2) and "nose" not in plan.angle and "knee" in plan.angle
    with pytest.raises(InputError, match=r"^there is no joint 'nose'; there are hip_pitch, knee, ankle_pitch, "):
        plan.torque["nose"]


def test_logs_without_a_robot_say_how_to_get_one(plan):
    logs = SimulationResult(**dict.fromkeys([f for f in SimulationResult.__dataclass_fields__ if f != "robot"]))
    with pytest.raises(InputError, match=r"^the robot of these logs is unknown; read them with jl\.load$"):
        _ = logs.torque


def test_a_frame_needs_pandas(plan):
    try:
        import pandas  # noqa: F401
    except ImportError:
        assert refused(plan.to_frame) == "a frame needs pandas: pip install 'jumplab[pandas]'"
    else:
        frame = plan.to_frame()
        assert len(frame) == len(plan.t) and "left_knee_torque_N_m" in frame


def test_pictures_by_name(plan):
    for draw in (plan.plots.strobe, plan.plots.joints, plan.plots.torques, plan.plots.momentum):
        assert draw().axes


def test_tasks_statistics_terms_and_planners_have_cards_too(plan):
    for x, word in (
        (plan.task, "CoM rise 0.50 m"),
        (plan.statistics, "iterations"),
        (plan.terms(), "more rows</summary>"),
        (jl.Planner(plan.robot), "none yet"),
    ):
        page = x._repr_html_()
        assert word in page and "<table>" in page, type(x)
    assert "bhr, built: nothing yet" in repr(jl.Planner(plan.robot)) and isinstance(plan.statistics, tuple)


def test_active_limits_are_those_that_the_plan_uses_up(plan):
    """A bar stands where a joint is as near to a stop, or gives as much of its torque, as planners may use."""
    fig = plan.plots.active()
    (ax,) = fig.axes
    names = [label.get_text() for label in ax.get_yticklabels()]
    bars = {name: [] for name in names}
    for bar in ax.collections:
        for path in bar.get_paths():
            x, y = path.vertices[:, 0], path.vertices[:, 1]
            bars[names[round(y.mean() - 1e-9)]].append((x.min(), x.max()))
    share = jumps.Limits().torque_share
    most = share * plan.robot.limits.range(plan.tape.v[:, 6:])[1]
    k = list(plan.tape.joint_names).index("left_ankle_pitch")
    used = plan.tape.tau[:, k] >= jumps.FULL * most[:, k]
    spans = bars.get("ankle pitch, torque", [])
    shown = np.any([(plan.t >= a) & (plan.t <= b) for a, b in spans], axis=0) if spans else np.zeros(len(plan.t), bool)
    assert names and all(spans for spans in bars.values()) and not (used & ~shown).any()
    least = jumps.active(plan, replace(jumps.Limits(), torque_share=5.0, range_margin_rad=-0.2))
    assert not any("torque" in x.get_text() or "stop" in x.get_text() for x in least.axes[0].get_yticklabels())


def test_the_users_style_wins_and_the_packages_own_stays_without_one(plan):
    usual = plan.plots.momentum()
    before = usual.axes[0].yaxis.label.get_fontsize()
    with plt.style.context({"font.size": 16, "axes.grid": False, "axes.facecolor": "yellow"}):
        fig = plan.plots.momentum()
    label = fig.axes[0].yaxis.label
    assert before == 8 and label.get_fontsize() == 16 and to_rgb(fig.axes[0].get_facecolor()) == to_rgb("yellow")
    assert fig._repr_png_() != usual._repr_png_() == plan.plots.momentum()._repr_png_()
    assert plt.rcParams["font.size"] == matplotlib.rcParamsDefault["font.size"]


def test_a_script_is_told_where_the_page_is(plan, tmp_path):
    """Run as a file, `jl.view` prints the place of a page that is there; imported, it prints nothing."""
    jl.save(tmp_path / "out", plan)
    script = tmp_path / "six.py"
    script.write_text(f"import jumplab as jl\njl.view(*jl.load({str(tmp_path / 'out')!r}))\n")
    env = os.environ | {"JUMPLAB_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(Path(jl.__file__).parents[1])}
    said = [
        subprocess.run([sys.executable, *words], env=env, cwd=tmp_path, capture_output=True, text=True, check=True)
        for words in ([script], ["-c", "import six"])
    ]
    place = Path(said[0].stdout.removeprefix("the jump in 3-D, for any browser: ").strip())
    assert place.suffix == ".html" and place.stat().st_size > 1e5 and said[1].stdout == ""
