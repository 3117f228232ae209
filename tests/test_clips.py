"""The library of clips: targets, what passes and what is left out, and that a stopped one goes on."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures_core import jump, refused
from paper import clips, library
from test_certify import measured
from test_cli import one_sentence, run

from jumplab.errors import InfeasibleError
from jumplab.io import folder as store
from jumplab.robot import Robot
from jumplab.robot.legs import segments_m
from jumplab.sim import DEFAULT_ENGINE, ENGINES, INSTALLED
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Contacts
from jumplab.task import JumpTask

pytestmark = pytest.mark.skipif(set(INSTALLED) != set(ENGINES), reason="clips need every engine")
FEW = {"forward": [(0.8, 0.4, 0.0, 0.0, 0.0), (1.0, 0.4, 0.0, 0.0, 0.0)]}


class Played(SimpleNamespace):
    """A simulation that stands where the plan begins."""

    def save(self, folder, extra=None):
        tape, n = self.tape, 30
        arrays = dict(t=np.arange(n) / 1000, q=np.repeat(tape.q[:1], n, axis=0), v=np.zeros((n, tape.v.shape[1])))
        arrays |= dict(tau=np.ones((n, tape.tau.shape[1])), phase=np.array(["landing"] * n))
        arrays |= dict(foot_wrench=np.full((n, 2, 6), 150.0), joint_names=tape.joint_names)
        np.savez(folder / "simulation.npz", schema=np.array("jumplab-simulation-1"), **arrays)
        (folder / "simulation.json").write_text(json.dumps({"engine": self.engine, "mode": self.mode}))


@pytest.fixture
def world(monkeypatch):
    """One plan for all targets, and what each engine measures; calls are listed."""
    world = SimpleNamespace(say=lambda engine, mode: {}, calls=[], modes=[], refuse=set())
    plan = jump(0.6, 0.3, method="direct")

    def planned(self, task):
        world.calls.append(task.distance_m)
        if task.distance_m in world.refuse:
            raise InfeasibleError("the knee is too slow")
        return plan

    def simulate(tape, robot, *, engine, mode, scene):
        world.modes.append(mode)
        m = measured(**world.say(engine, mode))
        played = Played(landed=m.landed, reason=m.reason, metrics=m, checks_passed=True, tape=tape)
        played.engine, played.mode = engine, mode
        return played

    monkeypatch.setattr(Planner, "plan", planned)
    monkeypatch.setattr(clips, "simulate_jump", simulate)
    monkeypatch.setattr(clips, "LIBRARY", FEW)
    return world


def test_a_hundred_targets_of_every_kind_grow_with_the_leg(bhr):
    found = clips.targets()
    plans = {name: target.of(bhr) for name, target in found.items()}
    assert len(plans) == 100 and {target.kind for target in found.values()} == {
        "forward", "back", "height", "platform", "side", "turn", "diagonal", "turn-forward", "flip",
        "hop", "run_up", "leap", "hurdle", "bound", "step_off", "drop_jump"}  # fmt: skip
    assert len(set(map(repr, plans.values()))) == 100
    leg = sum(segments_m(bhr))
    assert plans["forward-1"] == JumpTask(round(0.2 * leg, 2), round(0.2 * leg, 2))
    assert plans["back-4"].distance_m == -round(0.4 * leg, 2) and plans["side-2"].side_m == -round(0.15 * leg, 2)
    assert plans["platform-5"].platform_m < 0 < plans["platform-1"].platform_m
    assert plans["turn-4"].yaw_rad == math.radians(-40) and plans["turn-13"].yaw_rad == math.pi
    assert (plans["flip-1"].rotation_rad, plans["flip-3"].rotation_rad) == (-2 * math.pi, 2 * math.pi)
    assert plans["hop-2"] == Contacts.hop(bhr, round(0.15 * leg, 2), foot="right")
    assert plans["bound-2"] == Contacts.bound(bhr, 3, round(0.33 * leg, 2))
    long = bhr.with_legs(1.2)
    assert found["forward-16"].of(long).distance_m == round(1.2 * leg, 2)


def test_a_fifth_is_held_out_of_every_kind_and_mirror_images_stay_together():
    found = clips.targets()
    sides = {name: target.split for name, target in found.items()}
    held = [name for name, split in sides.items() if split == "held-out"]
    assert 20 <= len(held) <= 30 and {*sides.values()} == {"training", "held-out"}
    for one, other in (("side-3", "side-4"), ("turn-13", "turn-14"), ("hop-3", "hop-4"), ("side-1", "side-2")):
        assert sides[one] == sides[other]
    kinds = {target.kind for target in found.values()}
    small = {kind for kind in kinds if len(clips.LIBRARY[kind]) == 1}
    assert {found[name].kind for name in held} == kinds - small


def test_a_row_added_at_the_end_moves_no_other_to_the_other_side(monkeypatch):
    before = clips.targets()
    longer = {kind: [*rows, rows[0]] for kind, rows in clips.LIBRARY.items()}
    monkeypatch.setattr(clips, "LIBRARY", longer)
    after = clips.targets()
    assert len(after) == 116 and all(after[name] == target for name, target in before.items())


def test_variants_stay_on_their_target_s_side_and_are_left_out_where_nothing_changes(bhr):
    vary = [{"mass": 1.1}, {"height": 0.8, "effort": 0.9}, {"distance": 0.8}]
    found = {name: rest for name, *rest in clips.variants(bhr, ["forward-2", "height-1", "hop-1"], vary)}
    assert set(found) == {
        "forward-2", "height-1", "hop-1", "forward-2_mass=1.1", "height-1_mass=1.1", "hop-1_mass=1.1",
        "forward-2_height=0.8_effort=0.9", "height-1_height=0.8_effort=0.9", "hop-1_height=0.8_effort=0.9",
        "forward-2_distance=0.8", "hop-1_distance=0.8"}  # fmt: skip
    assert {name for name, (target, *_) in found.items() if target.split == "held-out"} == {
        name for name in found if name.startswith("forward-2")}  # fmt: skip
    _, _, robot, task = found["forward-2_mass=1.1"]
    assert robot.total_mass == pytest.approx(1.1 * bhr.total_mass) and task == found["forward-2"][3]
    _, factors, robot, task = found["forward-2_height=0.8_effort=0.9"]
    usual = found["forward-2"][3]
    assert factors == vary[1] and robot.limits.effort == pytest.approx(0.9 * bhr.limits.effort)
    assert task == JumpTask(usual.distance_m, round(0.8 * 0.25 * sum(segments_m(bhr)), 2))
    assert found["hop-1_height=0.8_effort=0.9"][3] == found["hop-1"][3]


def test_what_passes_is_exported_and_the_rest_is_left_out_with_its_reason(world, tmp_path, capsys):
    far = clips.targets()["forward-2"].of(Robot.load()).distance_m
    world.refuse = {far}
    code, said, err = run(capsys, "clips", "--out", tmp_path / "lib", "--jobs", "1", "--fps", "25")
    assert (code, err) == (0, "") and said.splitlines()[:3] == [
        "forward-1: passed",
        "forward-2: left out, the knee is too slow",
        f"1 of 2 clips passed; index.json and index.html in {tmp_path / 'lib'}",
    ]
    index = json.loads((tmp_path / "lib" / "index.json").read_text())
    assert (index["schema"], index["format"], index["fps"]) == ("jumplab-clips-2", "mjlab-npz", 25.0)
    assert index["robot"] == {"name": "bhr", "hash": Robot.load().hash}
    (row,), (out,) = index["clips"], index["left_out"]
    assert row["file"] == "forward-1/simulated_mjlab.npz" and row["duration_s"] == pytest.approx(0.029)
    assert row["target"]["distance_m"] == clips.targets()["forward-1"].of(Robot.load()).distance_m
    assert row["measured"][DEFAULT_ENGINE]["foot_distance_m"] == 0.6 and set(row["measured"]) == set(ENGINES)
    assert out["reasons"] == ["the knee is too slow"] and not out["passed"] and "file" not in out
    assert (row["planned"], out["planned"], row["mode"]) == (True, False, "position")
    assert (row["split"], out["split"]) == ("training", "held-out") and index["targets"] == 2
    assert row["picture"] == "forward-1/strip.png"
    assert (tmp_path / "lib" / row["picture"]).read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "lib" / "index.html").read_text()
    assert page.count("<img ") == 1 and "forward-1/strip.png" in page and "the knee is too slow" in page
    words = (tmp_path / "lib" / "LICENSE.txt").read_text()
    assert "BSD 3-Clause" in words and "bhr.urdf, of jumplab" in words
    with np.load(tmp_path / "lib" / row["file"]) as file:
        assert file["fps"] == 25 and len(file["joint_pos"]) == 2 and file["contact"].all()
    assert store.read_json(tmp_path / "lib" / "forward-1" / "simulation.json")["engine"] == DEFAULT_ENGINE


def test_clips_that_failed_are_tried_again_when_named(world, tmp_path):
    robot = Robot.load()
    world.refuse = {target.of(robot).distance_m for target in clips.targets().values()}
    assert len(clips.make_clips(robot, tmp_path, jobs=1)["left_out"]) == 2
    world.refuse = set()
    assert len(clips.make_clips(robot, tmp_path, jobs=1)["left_out"]) == 2 and len(world.calls) == 2
    (made,) = clips.make_clips(robot, tmp_path, only=["forward-2"], jobs=1)["clips"]
    assert made["name"] == "forward-2" and len(world.calls) == 3
    assert len(clips.make_clips(robot, tmp_path, jobs=1)["clips"]) == 1 and len(world.calls) == 3


def test_a_schedule_is_followed(world, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(clips, "LIBRARY", {"hop": [{"ahead_m": 0.2, "foot": "right"}]})
    plan = jump(0.6, 0.3, method="direct")
    monkeypatch.setattr(Planner, "follow", lambda self, contacts: asked.append(contacts) or plan)
    robot = Robot.load()
    (row,) = clips.make_clips(robot, tmp_path, jobs=1)["clips"]
    assert asked == [Contacts.hop(robot, round(0.2 * sum(segments_m(robot)), 2), foot="right")]
    assert [phase["feet"] for phase in row["target"]["phases"]] == ["LR", "R", "r", "-", "LR"] and not world.calls


def test_variants_are_made_of_their_own_robots(world, tmp_path, capsys):
    arguments = ("--only", "forward-1", "--vary", "mass=0.9,1.1", "--jobs", "1")
    code, said, _ = run(capsys, "clips", "--out", tmp_path, *arguments)
    assert code == 0 and "3 of 3 clips passed" in said
    index = json.loads((tmp_path / "index.json").read_text())
    assert [row["name"] for row in index["clips"]] == ["forward-1", "forward-1_mass=0.9", "forward-1_mass=1.1"]
    assert len({row["robot"] for row in index["clips"]}) == 3 and {r["split"] for r in index["clips"]} == {"training"}
    _, robot, _ = store.read_plan(tmp_path / "forward-1_mass=1.1")
    assert len(world.calls) == 3 and robot is not None


def test_engines_that_do_not_agree_leave_a_clip_out(world, tmp_path, capsys):
    world.say = lambda engine, mode: {"com_rise_m": 0.32} if engine == "mujoco" else {}
    code, _, err = run(capsys, "clips", "--out", tmp_path, "--jobs", "1", "--only", "forward-1")
    apart = "{} mode: the engines differ by 0.02 m in rise of the CoM (limit 0.01 m)"
    assert code == 3 and err == f"jumplab: no clip of bhr passed: {apart.format('position')}\n"
    assert not (tmp_path / "forward-1" / "simulated_mjlab.npz").exists()
    (row,) = json.loads((tmp_path / "index.json").read_text())["left_out"]
    assert row["reasons"] == [apart.format("position"), apart.format("whole-body")] and row["mode"] == "position"
    assert store.read_json(tmp_path / "forward-1" / "simulation.json")["mode"] == "position"


def test_a_clip_is_the_jump_in_the_first_mode_in_which_the_engines_agree(world, tmp_path):
    """Drives that hold angles may land differently where those that measure the base do not; row and page say which."""
    world.say = lambda engine, mode: {"touchdown_s": 1.507} if (engine, mode) == ("mujoco", "position") else {}
    found = clips.make_clips(Robot.load(), tmp_path, only=["forward-1"], jobs=1)
    (row,) = found["clips"]
    assert (row["mode"], row["passed"], row["reasons"]) == ("whole-body", True, [])
    assert world.modes == ["position", "position", "whole-body", "whole-body"]
    report = store.read_json(tmp_path / "forward-1" / "simulation.json")
    assert (report["mode"], report["engine"]) == ("whole-body", DEFAULT_ENGINE)
    index = json.loads((tmp_path / "index.json").read_text())
    assert "whole-body mode, training" in library.clips_page(index).html


def test_a_plan_that_fails_its_audit_is_played_in_one_mode(world, tmp_path, monkeypatch):
    bad = SimpleNamespace(failed=[SimpleNamespace(name="torque")], checks=[1])
    monkeypatch.setattr(clips.store, "write_plan", lambda *args, **options: bad)
    monkeypatch.setattr(clips.store, "read_plan", lambda folder: (None, None, {}))
    monkeypatch.setattr(clips.store, "write_simulation", lambda *args: None)
    (row,) = clips.make_clips(Robot.load(), tmp_path, only=["forward-1"], jobs=1)["left_out"]
    assert row["reasons"] == ["the plan fails the audit's check torque"] and len(world.modes) == 2


def test_a_stopped_library_goes_on(world, tmp_path):
    robot, said = Robot.load(), []

    def stop(line):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clips.make_clips(robot, tmp_path, jobs=1, say=stop)
    index = json.loads((tmp_path / "index.json").read_text())
    assert len(world.calls) == 1 and (len(index["clips"]), index["targets"]) == (1, 2)
    assert not (tmp_path / ".staging").exists()
    found = clips.make_clips(robot, tmp_path, jobs=1, say=said.append)
    assert len(found["clips"]) == 2 and len(world.calls) == 2 and said == ["forward-1: passed", "forward-2: passed"]
    other = clips.make_clips(robot, tmp_path, "unitree-csv", jobs=1)  # another format of the same simulations
    assert len(world.calls) == 2 and other["clips"][0]["file"] == "forward-1/simulated_unitree.csv"
    assert (tmp_path / "forward-1" / "simulated_mjlab.npz").is_file()
    clips.make_clips(robot.with_limits(effort=1.01), tmp_path, jobs=1, only=["forward-2"])
    assert len(world.calls) == 3 and (tmp_path / "forward-1").is_dir()  # another robot's are made anew


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--only", "forward-9"], "there is no clip 'forward-9'; names are KIND-NUMBER: forward 1-2"),
        (["--vary", "leg=1.1"], "clips vary by distance, height, mass, effort, speed, not by 'leg'"),
        (["--vary", "mass"], "--vary must be WHAT=A,B,..., got 'mass'"),
        (["--fps", "0"], "rate = 0 per second must lie above 0 and not above 10000"),
        (["--jobs", "0"], "--jobs must be a whole number from 1 to 4096, got '0'"),
    ],
)
def test_refusals(world, tmp_path, capsys, arguments, sentence):
    assert one_sentence(*run(capsys, "clips", "--out", tmp_path / "new", *arguments)) == sentence
    assert not world.calls and not (tmp_path / "new").exists()


def test_unknown_format(bhr, tmp_path):
    assert refused(clips.make_clips, bhr, tmp_path, "bvh").startswith("format 'bvh': must be one of csv, npz, ")


def test_films_are_drawn_where_they_are_asked_for_and_once(world, tmp_path, capsys, monkeypatch):
    drawn = []

    def draw(path, robot, motion, scene):
        drawn.append(path.relative_to(tmp_path).as_posix())
        path.write_bytes(b"GIF")

    monkeypatch.setattr(library, "write_movie", draw)
    for _ in range(2):
        code, _, _ = run(capsys, "clips", "--out", tmp_path, "--jobs", "1", "--films", "--only", "forward-1")
        assert code == 0 and drawn == ["forward-1/film.gif"]
    assert 'src="forward-1/film.gif"' in (tmp_path / "index.html").read_text()


def test_the_page_tells_schedules_variants_and_what_is_not_made_yet():
    hop = {"phases": [{"feet": "LR"}, {"feet": "L"}, {"feet": "-"}, {"feet": "LR"}], "places": [{"ahead_m": 0.2}]}
    row = {"name": "hop-1_mass=1.1", "kind": "hop", "target": hop, "split": "held-out", "duration_s": 2.0}
    row |= {"file": "hop-1_mass=1.1/x.npz"}
    bad = {"name": "hop-2", "kind": "hop", "target": hop, "split": "training", "reasons": ["<it> falls"]}
    index = {"robot": {"name": "g1"}, "format": "npz", "targets": 5, "clips": [row], "left_out": [bad]}
    assert "the index of a library lacks 'robot'" in refused(library.clips_page, {})
    page = library.clips_page(index).html
    for words in ("hop-1_mass%3D1.1/x.npz", "feet LR L - LR, 0.20 m ahead", "held-out", "&lt;it&gt; falls"):
        assert words in page
    assert "1 targets are left out, 3 are not made yet" in page and "<img" not in page
