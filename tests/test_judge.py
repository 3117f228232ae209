"""Motion clips: read by content, refused in a sentence, judged; public ones and our own."""

import json
import os
import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import joblib
import numpy as np
import pytest
from fixtures_core import jump, planner, refused
from fixtures_robots import needs_published
from scipy.spatial.transform import Rotation
from test_cli import one_sentence, run

import jumplab as jl
from jumplab.errors import InputError
from jumplab.io import export
from jumplab.io.clip import Clip, read_clips
from jumplab.io.motion import Motion
from jumplab.io.whole import ordered
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration

CLIPS = Path(__file__).parent / "clips"
FILES = [name for name in export.FORMATS if Path(export.FORMATS[name][0]).suffix]
assert len(FILES) == len(export.FORMATS) - 2  # all but the two folders


@cache
def standing(seconds=1.0, fps=30.0) -> Clip:
    robot = Robot.load()
    q = np.tile(stance_configuration(robot), (round(seconds * fps), 1))
    return Clip("standing", robot, q, fps, "made here")


@cache
def jumping() -> Clip:
    return Clip.of(jump(0.6, 0.3))


@cache
def landed(task, robot="bhr"):
    """A plan and its simulation."""
    plan = planner().plan(task) if robot == "bhr" else jl.plan(task, robot)
    return plan, jl.simulate(plan)


def moved(clip, **columns):
    q = clip.q.copy()
    for name, value in columns.items():
        q[:, "xyz".index(name)] += value
    return replace(clip, q=q)


def values(clip):
    return {c.name: c.value for c in jl.judge(clip).checks}


# what is found
# ----------------------------------------------------------------------------------------------------------------------
def test_a_robot_that_stands_is_physical_and_on_both_feet():
    report = jl.judge(standing())
    assert report.passed and report.flights == [] and [feet for feet, *_ in report.phases] == ["LR"]
    assert json.loads(report.to_json())["manifest"]["frames"] == 30


def test_feet_that_float_sink_or_slide_are_found_by_how_much():
    assert values(moved(standing(), z=0.03))["standing feet float"] == pytest.approx(30.0, abs=0.1)
    assert values(moved(standing(), z=-0.02))["feet in the ground"] == pytest.approx(20.0, abs=0.1)
    slid = moved(standing(), x=0.3 * standing().t)
    assert values(slid)["feet on the ground slide"] == pytest.approx(0.3, rel=1e-3)
    assert {c.name for c in jl.judge(slid).failed} == {"feet on the ground slide"}


def test_a_plan_has_no_finding_and_the_flight_that_it_was_planned_with():
    report = jl.judge(jumping())
    plan = jump(0.6, 0.3)
    (begin, end) = report.flights[0]
    assert report.passed, report.table()
    assert begin == pytest.approx(plan.tape.takeoff_time, abs=0.11)  # toes lift slowly
    assert end <= plan.tape.t[-1] and report.manifest["flights"][0]["acceleration_m_s2"][2] == pytest.approx(
        -9.8, rel=2e-3
    )


def test_a_flight_that_is_stretched_in_time_does_not_fall_freely():
    slow = replace(jumping(), fps=jumping().fps / 1.3)
    report = jl.judge(slow)
    assert "flights fall freely" in {c.name for c in report.failed}
    assert report["flights fall freely"].value == pytest.approx(100 * (1 - 1 / 1.3**2), abs=2)


def test_a_body_that_is_carried_through_the_air_needs_a_force_from_nowhere():
    lifted = moved(standing(2.0), z=np.clip(0.4 * (standing(2.0).t - 0.5), 0, 0.4))
    report = jl.judge(lifted)
    assert report["unphysical force"].value == pytest.approx(100, abs=5)
    assert [feet for feet, *_ in report.phases][:2] == ["LR", "-"]


def test_joints_beyond_their_ranges_are_found():
    q = standing().q.copy()
    knee = 7 + standing().robot.joint_names.index("left_knee")
    q[:, knee] = standing().robot.limits.upper[knee - 7] + 0.1
    assert values(replace(standing(), q=q))["joint range"] == pytest.approx(100, abs=0.1)


@pytest.mark.parametrize("fps", [50, 100, 1000])
def test_motors_that_are_too_weak_for_a_plan_are_found_at_usual_rates_and_no_others(fps):
    def judged(effort):
        clip = Clip.of(jump(0.6, 0.3), fps=fps)
        return jl.judge(replace(clip, robot=clip.robot.with_limits(effort=effort)))

    assert judged(0.6).passed and judged(1.0)["joint torque"].value == pytest.approx(55, abs=5)
    assert {c.name for c in judged(0.4).failed} == {"joint torque", "torque at speed"}


@pytest.mark.parametrize("fps", [30, 100])
def test_what_stands_on_a_platform_is_judged_if_its_height_is_told(fps):
    plan, run = landed(jl.JumpTask(0.4, 0.3, platform_m=0.2))
    assert jl.judge(plan, fps=fps).passed and jl.judge(run, fps=fps, platform_m=0.2).passed
    assert "standing feet float" in {c.name for c in jl.judge(run, fps=fps).failed}


def test_a_turn_on_the_spot_has_a_flight():
    """At its apex feet are as slow as those that stand."""
    plan = planner().plan(jl.JumpTask(0.0, 0.2, yaw_rad=1.57))
    report = jl.judge(plan, fps=100)
    (begin, end) = report.flights[0]
    assert report.passed and end - begin == pytest.approx(plan.tape.t[-1] - plan.tape.takeoff_time, abs=0.15)


@needs_published
@pytest.mark.parametrize("fps", [30, 100])
def test_a_joint_leans_on_its_stop_which_takes_what_the_motor_cannot(fps):
    """As the waist of a G1 does when it has landed, with its motor spent."""
    _, run = landed(jl.JumpTask(0.3, 0.2), "g1")
    waist = run.joint_names.index("waist_pitch_joint")
    spent = np.abs(run.tau[:, waist]) > 0.99 * run.robot.limits.effort[waist]
    assert run.landed and spent.mean() > 0.03
    report = jl.judge(run, fps=fps)
    assert report.passed, report.table()


def test_a_foot_that_swings_low_over_the_ground_does_not_slide():
    report = jl.judge(jump(-0.3, 0.2, method="direct"), fps=1000)
    assert report["feet on the ground slide"].passed, report.table()


# files
# ----------------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", FILES)
def test_every_format_that_is_written_is_read_again(name, tmp_path):
    path = tmp_path / export.FORMATS[name][0]
    plan = jump(0.6, 0.3)
    export.write(name, Motion.of(plan.tape), plan.robot, path, fps=50)
    (clip,) = read_clips(path, plan.robot, fps=50 if name in ("unitree-csv", "bones-csv") else None)
    there = Motion.of(plan.tape).every(50, end=True)
    assert clip.fps == pytest.approx(50, rel=1e-3) and len(clip.q) == len(there.q)
    assert np.abs(clip.q[:, :3] - there.q[:, :3]).max() < 1e-5 and np.abs(clip.q[:, 7:] - there.q[:, 7:]).max() < 1e-5
    apart = (Rotation.from_quat(clip.q[:, 3:7]) * Rotation.from_quat(there.q[:, 3:7]).inv()).magnitude()
    assert apart.max() < 1e-5


Q = standing().q
DOF = Q[:, [7 + standing().robot.joint_names.index(name) for name in ordered(standing().robot.urdf)[0]]]


def library(tmp_path, **changes):
    """A pickle as motion libraries have it, of the standing robot."""
    clip = standing()
    entry = {"root_trans_offset": clip.q[:, :3], "root_rot": clip.q[:, 3:7], "dof": DOF, "fps": 30}
    path = tmp_path / "clip.pkl"
    joblib.dump({"one": entry | changes}, path)
    return path


def test_a_pickle_of_a_motion_library_is_read(tmp_path):
    (clip,) = read_clips(library(tmp_path), standing().robot)
    assert clip.name == "clip" and np.allclose(clip.q, standing().q)


class Code:
    """Code that a pickle may run."""

    def __reduce__(self):
        return os.mkdir, ("it_ran",)


@pytest.mark.parametrize("content", [Code(), np.array([Code()]), {"dof": [Code()]}], ids=["bare", "array", "inside"])
@pytest.mark.parametrize(
    "dump", [joblib.dump, lambda x, path: path.write_bytes(pickle.dumps(x))], ids=["joblib", "pickle"]
)
def test_a_pickle_with_code_is_refused_and_not_run(content, dump, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dump(content, tmp_path / "bad.pkl")
    with pytest.raises(
        InputError, match=r"bad.pkl: refused, it (names|holds) .*could run code; ask for the clip as npz"
    ):
        read_clips(tmp_path / "bad.pkl", standing().robot)
    assert not (tmp_path / "it_ran").exists()


WRONG = {
    "degrees": (dict(dof=np.degrees(Q[:, 7:])), "they look like degrees: pass radians"),
    "w first": (dict(root_rot=np.roll(Q[:, 3:7], 1, axis=1)), "upright: reorder them to x y z w"),
    "y up": (
        dict(
            root_trans_offset=Q[:, [0, 2, 1]],
            root_rot=(Rotation.from_euler("x", -90, degrees=True) * Rotation.from_quat(Q[:, 3:7])).as_quat(),
        ),
        "the robot's up is the world's y; turn the clip so that z points up",
    ),
    "nan": (dict(dof=np.where(np.arange(len(Q))[:, None] == 7, np.nan, Q[:, 7:])), "frame 7, column 7 is not a finite"),
    "few": (dict(root_trans_offset=Q[:3, :3], root_rot=Q[:3, 3:7], dof=Q[:3, 7:]), "has 3 frames; a motion has 10"),
    "count": (dict(dof=Q[:, 7:-1]), "clips of robot bhr have 14: pass the robot that the clip was made for"),
    "lengths": (dict(dof=Q[:5, 7:]), r"must be \(n, 3\), \(n, 4\), \(n, joints\)"),
    "order": (dict(dof=2.9 + 0 * Q[:, 7:]), "most of the time: its joints are in another order, or the clip is"),
    "length": (dict(root_rot=2 * Q[:, 3:7]), "the quaternion of frame 0 has length 2, must be 1; normalise it"),
    "a list": (dict(dof=[None] * len(Q)), r"its arrays do not fit each other \(joints: no real numbers\)"),
    "complex": (dict(dof=Q[:, 7:] + 0j), r"its arrays do not fit each other \(joints: no real numbers\)"),
    "slow": (dict(fps=3), "says 3 frames per second; a motion has 5 to 10000: correct it in the file"),
    "no rate": (dict(fps=0), "says 0 frames per second"),
    "nan rate": (dict(fps=float("nan")), "says nan frames per second"),
    "back in time": (dict(fps=-30), "says -30 frames per second"),
    "metres": (dict(root_trans_offset=100 * Q[:, :3]), "looks like cm or mm: pass metres"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_clip_that_cannot_be_meant_is_refused_in_a_sentence(fault, tmp_path):
    changes, sentence = WRONG[fault]
    with pytest.raises(InputError, match=sentence):
        read_clips(library(tmp_path, **changes), standing().robot)


def test_joints_in_the_other_order_are_refused_and_in_a_third_one_noted(tmp_path):
    robot = standing().robot
    crouched = 3 * DOF
    crouched[:, -2:] = 1.2  # arms
    columns = [ordered(robot.urdf)[0].index(name) for name in ordered(robot.urdf, "breadth-first")[0]]
    path = library(tmp_path, dof=crouched[:, columns])
    assert "in breadth-first order 0.1 rad; pass order = 'breadth-first'" in refused(read_clips, path, robot)
    (clip,) = read_clips(path, robot, order="breadth-first")
    there = [7 + robot.joint_names.index(name) for name in ordered(robot.urdf)[0]]
    assert np.allclose(clip.q[:, there], crouched) and "level" not in clip.line()
    tipped = DOF.copy()
    tipped[:, [ordered(robot.urdf)[0].index(f"{side}_ankle_pitch") for side in ("left", "right")]] -= 1.0
    (clip,) = read_clips(library(tmp_path, dof=tipped), robot)
    assert "the lower sole is 1.0 rad off level half of the time" in clip.line()


def test_joints_of_another_robot_are_named(tmp_path):
    path = tmp_path / "clip.npz"
    names = [f"strange_{k}" for k in range(Q.shape[1] - 7)]
    np.savez(path, q=Q, t=np.arange(len(Q)) / 30, joint_names=names)
    assert "joints, of which 'strange_0' is none of the robot's" in refused(read_clips, path, standing().robot)


def test_what_is_no_clip_is_refused(tmp_path):
    for name, content in (("a.csv", b"hello"), ("b.npz", b"PK\x03\x04junk"), ("c.pkl", b"\x80\x04junk")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=f"{name}: not a readable clip"):
            read_clips(tmp_path / name, standing().robot)
    (tmp_path / "e.csv").write_bytes(b"")
    with pytest.raises(InputError, match=r"e.csv: is empty; give a pickle, npz or csv file"):
        read_clips(tmp_path / "e.csv", standing().robot)
    np.savez(tmp_path / "d.npz", other=np.zeros(3))
    with pytest.raises(InputError, match=r"holds no clip, but .'other'.; a clip has one of: root_trans_offset"):
        read_clips(tmp_path / "d.npz", standing().robot)


# public clips
# ----------------------------------------------------------------------------------------------------------------------
FLIGHTS = {"CR7_level1": [(1.53, 2.13)], "jump_forward_level2": [(1.70, 2.10)], "side_jump_level2": []}
FLOAT_MM = {"CR7_level1": 71, "jump_forward_level2": 68, "side_jump_level2": 13}


@needs_published
@pytest.mark.parametrize("name", FLIGHTS)
def test_a_public_clip_flies_when_it_was_seen_to_and_is_not_physical(name):
    report = jl.judge(CLIPS / f"{name}.pkl", "g1")
    assert report.clip.robot.name == "g1" and not report.passed
    assert np.array(report.flights) == pytest.approx(np.array(FLIGHTS[name]), abs=0.1)
    assert report["standing feet float"].value == pytest.approx(FLOAT_MM[name], abs=2)


# the command
# ----------------------------------------------------------------------------------------------------------------------
def test_the_command_judges_a_clip_and_a_folder(tmp_path, capsys):
    path = library(tmp_path)
    code, out, _ = run(capsys, "judge", path)
    assert code == 0 and "10 of 11" not in out and "contacts: LR 0.00 to 0.97 s" in out
    library(tmp_path, root_trans_offset=Q[:, :3] + [0, 0, 0.05]).rename(tmp_path / "floats.pkl")
    library(tmp_path)
    code, out, _ = run(capsys, "judge", tmp_path, "--out", tmp_path / "out")
    assert code == 0 and "physical: 1 of 2 clips; not for: standing feet float 1" in out
    assert json.loads((tmp_path / "out" / "judged.json").read_text())["physical"] == 1
    code, _, err = run(capsys, "judge", tmp_path / "floats.pkl")
    assert code == 3 and "not physical: 1 of 11 checks failed: standing feet float" in err
    sentence = one_sentence(*run(capsys, "judge", tmp_path / "none.pkl"))
    assert sentence.endswith(
        "none.pkl: not a readable clip (No such file or directory); give a pickle, npz or csv file"
    )


def test_a_clip_at_the_wrong_rate_is_told_the_one_with_which_it_falls_freely(tmp_path, capsys):
    path = tmp_path / "hop.csv"
    plan = jump(0.6, 0.3, method="direct")
    export.write("unitree-csv", Motion.of(plan.tape), plan.robot, path, fps=50)
    code, out, _ = run(capsys, "judge", path, "--fps", "60")
    assert code == 3 and "at 50 frames per second its flights would fall nearly freely: is 60 its rate?" in out
    code, out, _ = run(capsys, "judge", path, "--fps", "120")
    assert code == 3 and "at 50 frames per second its flights would fall nearly freely: is 120 its rate?" in out
    code, out, _ = run(capsys, "judge", path, "--fps", "50")
    assert code == 0 and "its rate?" not in out
