"""The benchmark: every sort of planning, true to its own raw times. Nothing is judged by its time."""

import json

import pytest
from paper.benchmark import growth

from jumplab.cli.main import main
from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.studies import bench as benchmark
from jumplab.studies.bench import BASE, FRESH, SORTS, rows
from jumplab.task import JumpTask


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
    """Three steps only of a robot that five links describe."""
    task, said = JumpTask(0.4, 0.3), []
    found = benchmark.bench("bhr", task, 1, sorts=tuple(SORTS)[:4], processes=False, say=said.append)
    again = json.loads(json.dumps(found))
    assert [x["sort"] for x in again["rows"]] == [*SORTS][:4] == [x.partition(":")[0] for x in said]
    assert all(x["targets"] == x["planned"] == x["clean"] == 6 for x in again["rows"]), again["rows"]
    assert again["rows"] == json.loads(json.dumps(rows(found["raw"])))
    near = {x["sort"]: x["iterations"] for x in again["rows"]}
    assert max(near["ahead, re-planned"], near["ahead, from an atlas"]) < near[BASE] / 2
    for plans in again["raw"].values():
        assert all(0 < x["solver_s"] and sum(s for _, s in x["stages"]) == pytest.approx(x["solver_s"]) for x in plans)
    lopsided = Robot.load().with_mass("left_thigh", factor=1.2)
    made = benchmark.Bench(lopsided, task)
    assert not made.robot.planar and {len(x) for x in (made.ahead, made.aside, made.flips)} == {6}


@pytest.mark.slow
def test_new_processes_are_timed():
    plans = benchmark.bench("bhr", JumpTask(0.4, 0.3), 1, sorts=())["raw"]
    (fresh,), (kept,) = plans.values()
    assert next(iter(plans)) == FRESH and fresh["clean"] and kept["clean"] and kept["build_s"] < fresh["build_s"]
    assert fresh["iterations"] == kept["iterations"] and 0 < fresh["peak_gib"] < 4


def test_the_command_prints_a_table_and_writes_the_numbers(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(benchmark, "bench", lambda *asked, say: {"rows": rows(MADE), "raw": MADE})
    assert main(["bench", "--out", str(tmp_path / "b.json")]) == 0
    _, _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:2]] == [BASE, "flips"]
    assert lines[1].split()[1:] == ["3", "2", "1", "1", "2", "10", "2.5"]
    assert json.loads((tmp_path / "b.json").read_text())["raw"] == MADE


def test_the_growth_has_a_row_for_each_mesh():
    found = growth(Robot.load(), JumpTask(0.4, 0.3), (16, 24))
    assert [x["intervals"] for x in found] == [16, 24] and all(x["iteration_s"] > 0 for x in found)


def test_wrong_questions_of_the_benchmark():
    with pytest.raises(InputError) as e:
        benchmark.bench(repeats=0)
    assert str(e.value) == "repeats = 0: it takes 1 or more"
    with pytest.raises(InputError) as e:
        benchmark.bench(sorts=["hops"])
    assert str(e.value) == f"sort 'hops': there are {', '.join(SORTS)}"
