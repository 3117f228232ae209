"""The benchmark: every sort of planning, true to its own raw times. Nothing is judged by its time."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures_core import refused
from paper import planning_times as benchmark
from paper.benchmark import FRESH, growth, new_processes
from paper.planning_times import BASE, SORTS, rows

from jumplab.cli.main import main
from jumplab.robot import Robot
from jumplab.task import JumpTask

ROOT = Path(__file__).resolve().parent.parent


def row(solver_s: float, clean: bool = True, **target: float) -> dict:
    """A raw row of made-up times."""
    return {"target": target, "solver_s": solver_s, "plan_s": 2 * solver_s, "iterations": 10, "clean": clean}


MADE = {
    BASE: [row(0.1, x=1), row(0.3, x=1), row(0.2, x=1), row(0.4, x=2), row(0.5, x=3)],
    "flips": [row(0.8, x=1), row(1.2, x=2, clean=False), {"target": {"x": 3}, "reason": "too high"}],
}


def test_rows_are_medians_over_targets_of_medians_over_repeats():
    ahead, flips = rows(MADE)
    assert (ahead["sort"], ahead["targets"], ahead["planned"], ahead["clean"]) == (BASE, 3, 3, 3)
    assert (ahead["solver_s"], ahead["plan_s"], ahead["ratio"]) == (0.4, 0.8, 1.0)
    assert (flips["targets"], flips["planned"], flips["clean"]) == (3, 2, 1)
    assert flips["solver_s"] == pytest.approx(1.0) and flips["ratio"] == pytest.approx(2.5)
    (none,) = rows({"flips": MADE["flips"][-1:]})
    assert (none["planned"], none["solver_s"], none["ratio"]) == (0, None, None)


@pytest.mark.slow
def test_every_sort_is_timed_and_audited():
    task, said = JumpTask(0.4, 0.3), []
    found = benchmark.bench("bhr", task, 1, sorts=tuple(SORTS)[:4], most=1, say=said.append)
    again = json.loads(json.dumps(found))
    assert [x["sort"] for x in again["rows"]] == [*SORTS][:4] == [x.partition(":")[0] for x in said]
    assert all(x["targets"] == x["planned"] == x["clean"] == 1 for x in again["rows"]), again["rows"]
    assert again["rows"] == json.loads(json.dumps(rows(found["raw"])))
    near = {x["sort"]: x["iterations"] for x in again["rows"]}
    assert max(near["ahead, re-planned"], near["ahead, from an atlas"]) < near[BASE] / 2
    for plans in again["raw"].values():
        assert all(0 < x["solver_s"] and sum(s for _, s in x["stages"]) == pytest.approx(x["solver_s"]) for x in plans)


def test_sorts_have_six_targets_around_one():
    """Three steps only of a robot that five links describe."""
    around = {name: benchmark.targets(JumpTask(0.4, 0.3), name) for name in SORTS}
    assert {len(set(tasks)) for tasks in around.values()} == {6}
    assert all(task.in_plane == (name.partition(",")[0] != "aside") for name in SORTS for task in around[name])
    assert all(bool(task.rotation_rad) == (name == "flips") for name in SORTS for task in around[name])


@pytest.mark.slow
def test_new_processes_are_timed():
    plans = new_processes("bhr", JumpTask(0.4, 0.3), 1)
    (fresh,), (kept,) = plans.values()
    assert next(iter(plans)) == FRESH and fresh["clean"] and kept["clean"]
    # one processor time on a busy machine says nothing of another
    assert min(fresh["build_s"], kept["build_s"]) > 0 and fresh["iterations"] == kept["iterations"]
    assert 0 < fresh["peak_gib"] < 4


def test_the_command_prints_a_table_and_writes_the_numbers(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(benchmark, "bench", lambda *asked, say: {"rows": rows(MADE), "raw": MADE})
    assert main(["bench", "--out", str(tmp_path / "b.json")]) == 0
    _, _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:2]] == [BASE, "flips"]
    assert lines[1].split()[1:] == ["3", "2", "1", "1", "2", "10", "2.5"]
    assert json.loads((tmp_path / "b.json").read_text())["raw"] == MADE


@pytest.mark.slow
def test_the_growth_has_a_row_for_each_mesh():
    found = growth(Robot.load(), JumpTask(0.4, 0.3), (16, 24), 1)
    assert [x["intervals"] for x in found] == [16, 24] and all(x["iteration_s"] > 0 for x in found)


def test_the_folder_beside_the_package_is_loaded_by_name():
    code = "from jumplab.cli.notebooks import paper; print(paper('planning_times').__file__)"
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=env, cwd="/", capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()) == ROOT / "notebooks" / "paper" / "planning_times.py"


def test_wrong_questions_of_the_benchmark():
    assert refused(benchmark.bench, repeats=0) == "repeats = 0: it takes 1 or more"
    assert refused(benchmark.bench, sorts=["hops"]) == f"sort 'hops': there are {', '.join(SORTS)}"
