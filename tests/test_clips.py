"""The library of clips: targets, what passes and what is left out, and that a stopped one goes on."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures_core import jump
from test_certify import measured
from test_cli import one_sentence, run

from jumplab.errors import InfeasibleError, InputError
from jumplab.io import folder as store
from jumplab.robot import Robot
from jumplab.sim import DEFAULT_ENGINE, ENGINES, INSTALLED
from jumplab.stages.planner import Planner
from jumplab.studies import clips
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
        (folder / "simulation.json").write_text(json.dumps({"engine": self.engine}))


@pytest.fixture
def world(monkeypatch):
    """One plan for all targets, and what each engine measures; calls are listed."""
    world, plan = SimpleNamespace(say=lambda engine: {}, calls=[], refuse=set()), jump(0.6, 0.3, method="direct")

    def planned(self, task):
        world.calls.append(task.distance_m)
        if task.distance_m in world.refuse:
            raise InfeasibleError("the knee is too slow")
        return plan

    def simulate(tape, robot, *, engine, mode, scene):
        m = measured(**world.say(engine))
        return Played(landed=m.landed, reason=m.reason, metrics=m, checks_passed=True, tape=tape, engine=engine)

    monkeypatch.setattr(Planner, "plan", planned)
    monkeypatch.setattr(clips, "simulate_jump", simulate)
    monkeypatch.setattr(clips, "LIBRARY", FEW)
    return world


def test_thirty_targets_of_every_kind_grow_with_the_leg(bhr):
    found = clips.targets(bhr)
    assert len(found) == 30 and {name.split("-")[0] for name in found} == {
        "forward", "back", "height", "platform", "side", "turn"}  # fmt: skip
    assert len(set(found.values())) == 30
    leg = clips.leg_m(bhr)
    assert found["forward-1"] == JumpTask(round(0.2 * leg, 2), round(0.2 * leg, 2))
    assert found["back-4"].distance_m == -round(0.4 * leg, 2) and found["side-2"].side_m == -round(0.15 * leg, 2)
    assert found["platform-5"].platform_m < 0 < found["platform-1"].platform_m
    assert found["turn-4"].yaw_rad == math.radians(-40)


def test_what_passes_is_exported_and_the_rest_is_left_out_with_its_reason(world, tmp_path, capsys):
    far = clips.targets(Robot.load())["forward-2"].distance_m
    world.refuse = {far}
    code, said, err = run(capsys, "clips", "--out", tmp_path / "lib", "--jobs", "1", "--fps", "25")
    assert (code, err) == (0, "") and said.splitlines()[:3] == [
        "forward-1: passed",
        "forward-2: left out, the knee is too slow",
        f"1 of 2 clips passed; index.json in {tmp_path / 'lib'}",
    ]
    index = json.loads((tmp_path / "lib" / "index.json").read_text())
    assert (index["schema"], index["format"], index["fps"]) == ("jumplab-clips-1", "mjlab-npz", 25.0)
    assert index["robot"] == {"name": "bhr", "hash": Robot.load().hash}
    (row,), (out,) = index["clips"], index["left_out"]
    assert row["file"] == "forward-1/simulated_mjlab.npz" and row["duration_s"] == pytest.approx(0.029)
    assert row["target"]["distance_m"] == clips.targets(Robot.load())["forward-1"].distance_m
    assert row["measured"][DEFAULT_ENGINE]["foot_distance_m"] == 0.6 and set(row["measured"]) == set(ENGINES)
    assert out["reasons"] == ["the knee is too slow"] and not out["passed"] and "file" not in out
    with np.load(tmp_path / "lib" / row["file"]) as file:
        assert file["fps"] == 25 and len(file["joint_pos"]) == 2 and file["contact"].all()
    assert store.read_json(tmp_path / "lib" / "forward-1" / "simulation.json")["engine"] == DEFAULT_ENGINE


def test_clips_that_failed_are_tried_again(world, tmp_path):
    robot = Robot.load()
    world.refuse = {task.distance_m for task in clips.targets(robot).values()}
    assert len(clips.make_clips(robot, tmp_path, jobs=1)["left_out"]) == 2
    world.refuse = set()
    assert len(clips.make_clips(robot, tmp_path, jobs=1)["clips"]) == 2
    assert len(world.calls) == 4


def test_engines_that_do_not_agree_leave_a_clip_out(world, tmp_path, capsys):
    world.say = lambda engine: {"com_rise_m": 0.32} if engine == "mujoco" else {}
    code, _, err = run(capsys, "clips", "--out", tmp_path, "--jobs", "1", "--only", "forward-1")
    apart = "position mode: the engines differ by 0.02 m in rise of the CoM (limit 0.01 m)"
    assert code == 3 and err == f"jumplab: no clip of bhr passed: {apart}\n"
    assert not (tmp_path / "forward-1" / "simulated_mjlab.npz").exists()


def test_a_stopped_library_goes_on(world, tmp_path):
    robot, said = Robot.load(), []

    def stop(line):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clips.make_clips(robot, tmp_path, jobs=1, say=stop)
    assert len(world.calls) == 1 and not (tmp_path / "index.json").exists()
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
        (["--only", "forward-9"], "there is no clip 'forward-9'; choose from forward-1, forward-2"),
        (["--fps", "0"], "rate = 0 per second must lie above 0 and not above 10000"),
        (["--jobs", "0"], "--jobs must be a whole number from 1 to 4096, got '0'"),
    ],
)
def test_refusals(world, tmp_path, capsys, arguments, sentence):
    assert one_sentence(*run(capsys, "clips", "--out", tmp_path / "new", *arguments)) == sentence
    assert not world.calls and not (tmp_path / "new").exists()


def test_unknown_format(bhr, tmp_path):
    with pytest.raises(InputError, match=r"^format 'bvh': must be one of csv, npz, "):
        clips.make_clips(bhr, tmp_path, "bvh")
