"""The map of jumps: cells agree with the planner, resume, and say what limits them."""

import json
import math

import numpy as np
import pytest
from fixtures_robots import child, write

from jumplab.auditing.audit import audit
from jumplab.cli.main import main
from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.show.jumps import envelope_map
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import WholeBodyPlanner
from jumplab.studies.envelope import BEYOND, CELLS, OPEN, VERDICT, Cell, Envelope, envelope, most_used
from jumplab.task import JumpTask


def test_cells_are_plans_within_the_limits(bhr, tmp_path):
    told = []
    found = envelope(bhr, (0.4, 0.6), (0.3, 1.2), folder=tmp_path, tell=told.append)
    near, far, *refused = found.cells
    assert near.solved and far.solved and all(0.3 < c.share <= 1.0 for c in (near, far))
    assert [c.limiting for c in refused] == [VERDICT, VERDICT] and "by a straight push enough for" in refused[0].reason
    assert 0 < far.iterations < 60 and 0 < near.iterations < 60 and far.solve_s > 0
    assert (found.highest, found.farthest) == (far, far)
    assert told[0] == "height 0.30 m: 2 of 2 cells, up to 0.60 m"


def test_what_is_used_most_is_the_plans(bhr):
    """Torque at its speed, speed and friction, each worked out here once more."""
    plan = Planner(bhr).plan(JumpTask(0.5, 0.3))
    tape, shares = plan.tape, {}
    for i, name in enumerate(bhr.joint_names):
        motor, tau, rate = bhr.actuators[name], np.abs(tape.tau[:, i]), np.abs(tape.v[:, 6 + i])
        drives = tape.tau[:, i] * tape.v[:, 6 + i] > 0
        left = np.where(drives, (motor["speed"] - rate) / (motor["speed"] - motor["corner_speed"]), 1.0)
        joint = name.split("_", 1)[1].replace("_", " ")
        for what, share in (
            ("torque", tau / motor["effort"] / np.minimum(left, 1.0)),
            ("speed", rate / motor["speed"]),
        ):
            shares[f"{joint} {what}"] = max(share.max(), shares.get(f"{joint} {what}", 0.0))
    name, share = most_used(audit(tape, bhr, plan.task), bhr)
    assert name == max(shares, key=shares.get) and share == pytest.approx(shares[name], rel=1e-3) and 0.3 < share <= 1.0


def test_an_interrupted_map_goes_on(bhr, tmp_path, monkeypatch):
    first = envelope(bhr, (0.4,), (0.3,), folder=tmp_path)

    def never(*_, **__):
        raise AssertionError("a finished cell is not solved again")

    monkeypatch.setattr(WholeBodyPlanner, "plan", never)
    again = envelope(bhr, (0.4,), (0.3,), folder=tmp_path)
    assert again == first
    file = tmp_path / CELLS
    data = json.loads(file.read_text())
    file.write_text(json.dumps(data | {"robot": "somebody"}) + "\n")
    with pytest.raises(InputError, match="belongs to another robot"):
        envelope(bhr, (0.4,), (0.3,), folder=tmp_path)
    file.write_text(file.read_text()[:20])  # cut short: no cell
    with pytest.raises(AssertionError):
        envelope(bhr, (0.4,), (0.3,), folder=tmp_path)


def test_every_cell_is_kept_at_once(bhr, tmp_path, monkeypatch):
    """A map that is stopped within a row has the cells before; a map of its own is refused meanwhile."""
    tried = []

    def stopping(robot, task, guess, *, cold):
        tried.append(task.distance_m)
        if len(tried) == 3:
            with pytest.raises(InputError, match="another 'jumplab envelope' is writing it"):
                envelope(bhr, (0.1,), (0.3,), folder=tmp_path)
            raise KeyboardInterrupt
        return Cell(task.distance_m, task.height_m, True, "friction", 0.5), None

    monkeypatch.setattr("jumplab.studies.envelope._solve", stopping)
    with pytest.raises(KeyboardInterrupt):
        envelope(bhr, (0.1, 0.2, 0.3), (0.3,), folder=tmp_path)
    assert all(c.solved for c in envelope(bhr, (0.1, 0.2, 0.3), (0.3,), folder=tmp_path).cells)
    assert tried == [0.1, 0.2, 0.3, 0.3]


def test_far_cells_are_not_tried_for_ever(bhr, monkeypatch):
    def hopeless(robot, task, guess, *, cold):
        return Cell(task.distance_m, task.height_m, False, OPEN, math.nan), None

    monkeypatch.setattr("jumplab.studies.envelope._solve", hopeless)
    cells = envelope(bhr, (0.1, 0.2, 0.3, 0.4), (0.3,)).cells
    assert [c.limiting for c in cells] == [OPEN, OPEN, BEYOND, BEYOND]


def test_maps_over_other_numbers(bhr, monkeypatch):
    asked, told = [], []

    def solved(robot, task, guess, *, cold):
        asked.append(task)
        return Cell.of(task, True, "friction", 0.5), None

    monkeypatch.setattr("jumplab.studies.envelope._solve", solved)
    fixed = JumpTask(0.1, 0.4)
    found = envelope(bhr, (0.0, 0.2), (0.3,), axes=("side_m", "distance_m"), fixed=fixed, tell=told.append)
    assert asked == [JumpTask(0.3, 0.4), JumpTask(0.3, 0.4, side_m=0.2)] and told == [
        "distance 0.30 m: 2 of 2 cells, up to 0.20 m"
    ]
    assert [c.side_m for c in found.cells] == [0.0, 0.2] and found.axes == ("side_m", "distance_m")
    assert envelope_map(found).axes[0].get_xlabel() == "to the left [m]"
    assert [c.yaw_rad for c in envelope(bhr, (0.0, 1.0), (0.3,), axes=("yaw_rad", "height_m")).cells] == [0.0, 1.0]


def test_grids_that_cannot_be_meant(bhr):
    with pytest.raises(InputError, match=r"the map has 0 x 1 cells"):
        envelope(bhr, (), (0.3,))
    with pytest.raises(InputError, match=r"height = "):
        envelope(bhr, (0.3,), (-1.0,))


@pytest.mark.parametrize("argv, sentence", [
    (["--distance-m", "0:1"],
     "jumplab: --distance-m must be FROM:TO:COUNT or A,B,... with COUNT from 1 to 10000, got '0:1'"),
    (["--height-m", "1:0:0.1"],
     "jumplab: --height-m must be FROM:TO:COUNT or A,B,... with COUNT from 1 to 10000, got '1:0:0.1'"),
    (["--jobs", "0"], "jumplab: --jobs must be a whole number from 1 to 4096, got '0'"),
])  # fmt: skip
def test_bad_input_in_one_sentence(capsys, tmp_path, argv, sentence):
    assert main(["envelope", "--out", str(tmp_path / "x"), *argv]) == 2
    assert capsys.readouterr().err.strip() == sentence
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_the_command_draws_and_names_the_largest_jump(capsys, tmp_path):
    robot = write(tmp_path, child)
    argv = ["--distance-m", "0.2:0.4:2", "--height-m", "0.2", "--jobs", "1", "--robot", robot]
    assert main(["envelope", "--out", str(tmp_path / "map"), *argv]) == 0
    assert "limited by" in capsys.readouterr().out
    assert (tmp_path / "map" / "envelope.png").stat().st_size > 5000
    assert len(json.loads((tmp_path / "map" / "envelope.json").read_text())["cells"]) == 2
    assert Robot.load(robot).name == "child"


def test_the_picture_has_every_reason():
    cells = (Cell(0.0, 0.1, True, "friction", 0.9), Cell(0.1, 0.1, False, OPEN, math.nan),
             Cell(0.0, 0.2, False, VERDICT, math.nan), Cell(0.1, 0.2, False, BEYOND, math.nan))  # fmt: skip
    fig = envelope_map(Envelope("x", (0.0, 0.1), (0.1, 0.2), cells))
    labels = [t.get_text() for t in fig.axes[0].get_legend().get_texts()]
    assert labels == ["friction", "no plan found", "beyond a straight push, and no plan found", "not tried"]


def test_two_maps_at_once_are_refused(capsys, tmp_path):
    argv = ["envelope", "--out", str(tmp_path / "x"), "--side-m", "0:0.4:3"]
    assert main([*argv, "--yaw-deg", "0:90:3"]) == 2
    assert capsys.readouterr().err == "jumplab: --side-m and --yaw-deg are two maps; leave one of them away\n"
    assert main([*argv, "--height-m", "0.3,0.4"]) == 2
    said = "jumplab: a map of sides has one height, got 2; give --height-m one number\n"
    assert capsys.readouterr().err == said
