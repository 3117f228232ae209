"""The map of jumps: cells agree with the planner, resume, and say what limits them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from fixtures_core import jump
from fixtures_robots import child, write

from jumplab.auditing.audit import audit
from jumplab.cli.main import main
from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.show import envelope_map
from jumplab.studies.envelope import BEYOND, OPEN, Cell, Envelope, envelope
from jumplab.studies.grid import most_used
from jumplab.task import JumpTask


def test_cells_are_plans_within_the_limits(bhr, tmp_path):
    found = envelope(bhr, (0.4,), (0.3, 1.2), folder=tmp_path)
    jump, refused = found.cells
    assert jump.solved and 0.3 < jump.share <= 1.0 and 0 < jump.iterations < 60 and jump.solve_s > 0
    assert refused.limiting == OPEN and "no plan" in refused.reason
    assert (found.highest, found.farthest) == (jump, jump)


def test_what_is_used_most_is_the_plans(bhr):
    """Torque at its speed, speed and friction, each worked out here once more."""
    plan = jump(0.5, 0.3, method="direct")
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


CELLS = "cells.jsonl"


def row(clean: bool, infeasible: bool = False, **more) -> dict:
    """In place of a plan."""
    used = {"limiting": "friction", "share": 0.5, "iterations": 9} if clean else dict.fromkeys(("share", "iterations"))
    return used | {"clean": clean, "infeasible": infeasible, "cpu_s": 0.1, "reason": None} | more


@pytest.fixture
def asked(monkeypatch):
    """Targets that are planned; all have a plan up to 0.25 m, and none with a height of 1 m."""
    asked = []

    def plan(planner, task):
        asked.append(task)
        return row(task.distance_m < 0.25 and task.height_m < 1)

    monkeypatch.setattr("jumplab.studies.envelope.cell_row", plan)
    return asked


def test_a_cell_does_not_depend_on_those_planned_before(bhr):
    """To the last digit, but for the times."""
    both, alone = (envelope(bhr, distances, (0.3,)).cells for distances in ((0.4, 0.6), (0.6,)))
    assert replace(both[1], solve_s=0.0) == replace(alone[0], solve_s=0.0) and alone[0].solved


def test_an_interrupted_map_equals_an_undisturbed_one(bhr, tmp_path, asked):
    """Wherever it stopped, and whatever other cells the folder has."""
    grid = (0.1, 0.2, 0.8), (0.3, 0.4)
    whole = envelope(bhr, *grid, folder=tmp_path / "whole")
    lines = (tmp_path / "whole" / CELLS).read_bytes().splitlines(keepends=True)
    assert len(asked) == 6 == len(lines)
    for kept in (lines[:1], lines[4:], [*lines[1:3], lines[3][:50]]):
        (tmp_path / CELLS).write_bytes(b"".join(kept))
        asked.clear()
        assert envelope(bhr, *grid, folder=tmp_path) == whole and len(asked) == 6 - sum(x[-1:] == b"\n" for x in kept)
    envelope(bhr, (0.1, 0.7), (0.35,), folder=tmp_path / "other")
    assert envelope(bhr, *grid, folder=tmp_path / "other") == whole


def test_a_folder_gives_back_the_cells_of_the_same_question_only(bhr, tmp_path, asked):
    """Another platform, gravity, side, turn, robot or atlas are other cells; the same ones are not planned again."""
    others = {"platform_m": 0.1, "gravity": 3.7, "side_m": 0.1, "yaw_rad": 0.1, "rotation_rad": 2 * math.pi}
    questions = [{}, *({"fixed": JumpTask(0.1, 0.3, **{name: value})} for name, value in others.items())]
    for robot in (bhr, bhr.with_mass(factor=1.1)):
        for question in questions:
            asked.clear()
            found = envelope(robot, (0.1, 0.2), (0.3,), folder=tmp_path, **question)
            assert len(asked) == 2 and asked[0] == replace(question.get("fixed", JumpTask(0.1, 0.3)), distance_m=0.1)
            assert envelope(robot, (0.1, 0.2), (0.3,), folder=tmp_path, **question) == found and len(asked) == 2


def test_maps_of_an_older_version_are_refused(bhr, tmp_path):
    (tmp_path / CELLS).write_text('{"robot": "x", "distance_m": 0.1, "height_m": 0.3, "solved": true}\n')
    with pytest.raises(
        InputError, match=r"cells.jsonl' was not written by this version's 'jumplab envelope'; choose another"
    ):
        envelope(bhr, (0.1,), (0.3,), folder=tmp_path)


def test_far_cells_are_not_tried_for_ever(bhr, asked):
    cells = envelope(bhr, (0.1, 0.3, 0.4, 0.5, 0.6), (0.3, 1.0)).cells
    assert [c.limiting for c in cells] == ["friction", OPEN, OPEN, BEYOND, BEYOND, OPEN, OPEN, BEYOND, BEYOND, BEYOND]
    assert all(math.isnan(c.share) for c in cells[1:]) and len(asked) == 5


def test_maps_over_other_numbers(bhr, asked):
    fixed = JumpTask(0.1, 0.4)
    found = envelope(bhr, (0.0, 0.2), (0.2,), axes=("side_m", "distance_m"), fixed=fixed)
    assert asked == [JumpTask(0.2, 0.4), JumpTask(0.2, 0.4, side_m=0.2)]
    assert [c.side_m for c in found.cells] == [0.0, 0.2] and found.axes == ("side_m", "distance_m")
    assert envelope_map(found).axes[0].get_xlabel() == "to the left [m]"
    assert [c.yaw_rad for c in envelope(bhr, (0.0, 1.0), (0.3,), axes=("yaw_rad", "height_m")).cells] == [0.0, 1.0]


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
             Cell(0.1, 0.2, False, BEYOND, math.nan))  # fmt: skip
    fig = envelope_map(Envelope("x", (0.0, 0.1), (0.1, 0.2), cells))
    labels = [t.get_text() for t in fig.axes[0].get_legend().get_texts()]
    assert labels == ["friction", "no plan found", "not tried"]


def test_two_maps_at_once_are_refused(capsys, tmp_path):
    argv = ["envelope", "--out", str(tmp_path / "x"), "--side-m", "0:0.4:3"]
    assert main([*argv, "--yaw-deg", "0:90:3"]) == 2
    assert (
        capsys.readouterr().err == "jumplab: --side-m and --yaw-deg ask for two different maps; leave one of them out\n"
    )
    assert main([*argv, "--height-m", "0.3,0.4"]) == 2
    said = "jumplab: a map of sides has one height, got 2; give --height-m one number\n"
    assert capsys.readouterr().err == said
