"""Clips mended: the schedule that is read from them, and one public clip from file to a robot that stands."""

import re
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from fixtures_robots import needs_published
from test_judge import CLIPS, standing

import jumplab as jl
from jumplab.cli.main import main
from jumplab.errors import InfeasibleError, InputError
from jumplab.io import export
from jumplab.io.motion import Motion
from jumplab.ocp.nlp import RESIDUAL_LIMIT
from jumplab.robot import Robot
from jumplab.stages.whole_body import Limits, Weights
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.terms import smoothness
from jumplab.studies import mend as study
from jumplab.studies.mend import AROUND_S, TOES_S, Draft, planned_phases


def seen(words):
    """A report of a clip whose feet carry as ``words`` say: (feet, frames at 30 per second); small letters slide."""
    ground = np.concatenate([np.tile(["L" in feet.upper(), "R" in feet.upper()], (n, 1)) for feet, n in words])
    still = np.concatenate([np.tile(["L" in feet, "R" in feet], (n, 1)) for feet, n in words])
    report = jl.judge(standing())
    clip = replace(report.clip, q=np.tile(report.clip.q[:1], (len(ground), 1)))
    tape = SimpleNamespace(v=np.zeros((len(ground), clip.robot.model.nv)))
    return replace(report, clip=clip, tape=tape, ground=ground, still=still)


def test_events_are_kept_around_a_jump_and_toes_put_before_it():
    feet, begin, end = zip(*planned_phases(seen([("LR", 40), ("-", 12), ("LR", 40)])), strict=True)
    assert feet == ("LR", "lr", "-", "LR")
    assert np.subtract(end, begin) == pytest.approx([AROUND_S[0] - TOES_S, TOES_S, 12 / 30, AROUND_S[0]], abs=0.05)
    assert begin[1:] == pytest.approx(end[:-1])


@pytest.mark.parametrize(
    "words, feet",
    [
        ([("LR", 30), ("R", 2), ("-", 12), ("L", 2), ("LR", 30)], "LR lr - LR"),  # feet that leave one after the other
        ([("LR", 30), ("L", 4), ("LR", 30)], "LR"),  # a step in place
        ([("LR", 30), ("L", 10), ("LR", 30)], "LR L LR"),
        ([("-", 5), ("LR", 30), ("L", 10), ("-", 9), ("L", 10), ("LR", 30), ("-", 5)], "LR L l - L LR"),
    ],
)
def test_short_events_are_one_and_a_motion_begins_and_ends_on_both_feet(words, feet):
    phases = planned_phases(seen(words))
    assert " ".join(x for x, *_ in phases) == feet
    assert [begin for _, begin, _ in phases[1:]] == [end for *_, end in phases[:-1]]
    if feet == "LR lr - LR":  # a foot's last two frames are no flight
        assert phases[2][1:] == pytest.approx((32 / 30, 44 / 30))
    if feet == "LR":
        assert phases[0][1:] == pytest.approx((0.0, 63 / 30))


@pytest.mark.parametrize(
    "words, feet",
    [  # both feet fast: a skip from foot to foot flies, between two steps on one foot the other one carries
        ([("LR", 30), ("R", 10), ("lr", 6), ("L", 10), ("LR", 30)], "LR R r - L LR"),
        ([("LR", 30), ("R", 10), ("lr", 6), ("R", 10), ("LR", 30)], "LR R L R LR"),
        # of two motions with long standing between them the one that flies, else that of more phases
        ([("LR", 30), ("-", 12), ("LR", 60), ("L", 10), ("R", 10), ("LR", 30)], "LR lr - LR"),
        ([("LR", 30), ("L", 10), ("LR", 60), ("L", 10), ("R", 10), ("LR", 30)], "LR L R LR"),
    ],
)
def test_skips_are_steps_or_flights_and_one_motion_is_kept(words, feet):
    assert " ".join(x for x, *_ in planned_phases(seen(words))) == feet


def test_the_cut_is_where_the_joints_are_quiet():
    report = seen([("LR", 60), ("-", 12), ("LR", 60)])
    report.tape.v[60 - 27 :, 6:] = 2.0  # it crouches for 0.9 s, and goes on moving
    (_, begin, _), *_, (_, lands, end) = planned_phases(report)
    assert 2.0 - begin == pytest.approx(0.93, abs=0.02) and end - lands == pytest.approx(AROUND_S[0], abs=0.02)


@needs_published
def test_a_stance_too_wide_for_flat_soles_is_refused():
    clip = jl.judge(CLIPS / "side_jump_level2.pkl", "g1").clip
    q = clip.q.copy()
    joints = [7 + clip.robot.joint_names.index(f"{side}_hip_roll_joint") for side in ("left", "right")]
    q[:, joints] += [0.5, -0.5]
    with pytest.raises(InfeasibleError, match="at its start no posture within the joints' ranges puts both soles flat"):
        jl.mend(replace(clip, q=q))


def test_a_clip_that_never_stands_is_refused():
    with pytest.raises(InputError, match="it never stands on both feet, and a motion has to begin so"):
        planned_phases(seen([("L", 30), ("R", 30)]))


# in the manner of a clip
GOAL = jl.JumpTask(0.6, 0.15, side_m=0.1, yaw_rad=0.3)


@needs_published
def test_a_clip_that_is_followed_to_a_target_lands_there():
    report = jl.judge(CLIPS / "jump_forward_level2.pkl", "g1")
    usual, moved = Draft(report), Draft(report, goal=GOAL)
    first, last = (np.mean([moved.middle(hold)], axis=0) for hold in (moved.holds[0], moved.holds[-1]))
    assert last - first == pytest.approx([GOAL.distance_m, GOAL.side_m, GOAL.yaw_rad])
    assert all(place.free_m == (0.0, 0.0) for place in moved.contacts.places)
    flight = next(phase for phase in moved.contacts.phases if phase.flying)
    assert flight.guess_s == pytest.approx(2 * np.sqrt(2 * GOAL.height_m / GOAL.gravity))
    np.testing.assert_allclose(moved.motion.charts[0], usual.motion.charts[0], atol=1e-9)  # the launch is the clip's


@needs_published
def test_what_no_clip_shows_is_refused():
    with pytest.raises(InputError, match="like a clip needs level ground and no flip"):
        jl.plan(jl.JumpTask(0.5, 0.3, platform_m=0.1), "g1", like=CLIPS / "jump_forward_level2.pkl")
    with pytest.raises(InputError, match="its contacts are LR R r - L LR; a jump to a target needs a clip that"):
        jl.plan(GOAL, "g1", like=CLIPS / "side_jump_level2.pkl")
    with pytest.raises(InputError, match="give only one of contacts and like, and leave out method, robust and starts"):
        jl.plan(GOAL, "g1", like=CLIPS / "jump_forward_level2.pkl", method="three-step")


@needs_published
def test_waist_and_arms_stay_near_what_is_followed():
    body = Body(Robot.load("g1"))
    mode = Mode(body, Limits().of_clip(), Weights().of_clip(), "LR")
    clip = np.linspace(-0.5, 0.5, len(body.stance))
    p = SimpleNamespace(tree=SimpleNamespace(q=ca.SX(clip)), ref=SimpleNamespace(chart=ca.SX(clip)))
    for follows, near in ((True, clip), (False, body.stance)):
        (term,) = (x for x in smoothness(mode, follows) if x.name == "waist and arms")
        off = np.array(ca.evalf(term.expression(p))).ravel()
        assert off == pytest.approx((clip - near)[body.upper]) and term.weight == 15.0 and len(off)


@needs_published
def test_the_command_plans_in_the_manner_of_a_clip(tmp_path, capsys):
    clip = str(CLIPS / "side_jump_level2.pkl")
    assert main(["plan", "--robot", "g1", "--like", clip, "--out", str(tmp_path)]) == 2
    assert "its contacts are LR R r - L LR" in capsys.readouterr().err


@needs_published
@pytest.mark.slow
def test_a_jump_to_a_target_in_the_manner_of_a_clip():
    plan = jl.plan(GOAL, "g1", like=CLIPS / "jump_forward_level2.pkl")
    assert plan.planned_distance_m == pytest.approx(0.6, abs=1e-4) and plan.planned_rise_m == pytest.approx(
        0.15, abs=2e-3
    )
    assert plan.task.side_m == pytest.approx(0.1, abs=1e-4) and plan.task.yaw_rad == pytest.approx(0.3, abs=1e-4)
    assert jl.audit(plan).passed


@needs_published
@pytest.mark.slow
def test_feet_that_carry_little_after_a_landing_need_no_finer_mesh():
    # it hops up again 0.3 s after touchdown: what the landing moved the base by must not come back there
    plan = jl.mend(CLIPS / "jump_degree_level4.pkl", "g1").plan
    assert "finer mesh" not in [x.start for x in plan.whole_body.attempts]
    assert plan.whole_body.used < 1 and jl.audit(plan).passed


@pytest.fixture(scope="module")
def mended():
    return jl.mend(CLIPS / "jump_forward_level2.pkl", "g1")


@needs_published
@pytest.mark.slow
def test_a_nearest_motion_that_fails_its_audit_is_none(mended, monkeypatch):
    audit = SimpleNamespace(failed=[SimpleNamespace(name="base residual")])
    plan = SimpleNamespace(audit=audit, whole_body=mended.plan.whole_body)
    monkeypatch.setattr(study, "FACTORS", (0.8,))
    monkeypatch.setattr(study.Planner, "follow", lambda *_, **how: plan)
    sentence = r"the nearest motion fails its audit \(base residual\), pressed by .+; nor can it with 0\.8 of"
    with pytest.raises(InfeasibleError, match=sentence):
        jl.mend(mended.before)


@needs_published
@pytest.mark.slow
def test_a_public_clip_is_mended_audited_and_stands(mended, tmp_path):
    rows = {row["what"]: row for row in mended.changes}
    assert jl.audit(mended.plan).passed and not mended.before.passed
    for fps in (50, 100):
        report = jl.judge(mended.plan, fps=fps)
        assert report.passed, report.table()
    assert rows["joints, rms [rad]"]["change"] < 0.25 and rows["footholds, largest [m]"]["change"] < 0.07
    assert abs(rows["flight 1 [s]"]["change"]) < 0.15 * rows["flight 1 [s]"]["clip"]
    assert mended.binding and mended.factor == 1
    # a rough solution is none: it is solved on to the end
    body = mended.plan.whole_body
    assert [x.start for x in body.attempts[:2]] == ["given motion", "links apart"]
    assert body.solution.statistics.residual < RESIDUAL_LIMIT
    assert jl.simulate(mended.plan).landed
    # the player's feedback catches this landing on MuJoCo's usual contact, and not the planned one
    run = jl.simulate(mended.plan, landing="spring")
    assert run.landed
    folder = export.write("mujoco", Motion.of(run), mended.plan.robot, tmp_path / "mujoco")
    done = subprocess.run([sys.executable, str(folder / "play.py")], capture_output=True, text=True)
    assert done.stdout.startswith("stands"), done.stderr
    moved, planned = (np.array(text.split(), float) for text in re.findall(r"\[(.*?)\]", done.stdout))
    assert np.linalg.norm(moved - planned) < 0.1, done.stdout
