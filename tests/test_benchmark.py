"""The benchmark's report, on a small mesh: complete, true to its own raw times, honest. Nothing is timed."""

import json

import numpy as np
import pytest
from paper.benchmark import goals

from jumplab.cli.main import main
from jumplab.errors import InputError
from jumplab.stages.whole_body import Mesh
from jumplab.studies import bench as benchmark
from jumplab.studies.bench import AT_ONCE, ATLAS, AUDITED, HELD, Stopwatch, line_error, report
from jumplab.task import JumpTask

TIMES = {"plan": [0.5, 0.6], "re-plan": [0.2, 0.2], AT_ONCE: [1.0, 1.0], "direct, build": [0.5, 0.5],
         HELD: [0.5, 0.5], "plan: 1 SRMP": [0.1, 0.1], "plan: 3 whole body": [0.3, 0.5]}  # fmt: skip
NODES = [dict(intervals=n, iteration_s=1e-3 + 2e-4 * n, iterations=20, solve_s=1.0) for n in (20, 40, 80)]


def made(**other) -> dict:
    """A report of made-up times."""
    growth = {"nodes": NODES, "targets_cpu_s": {"1": 0.5},
              "spread": [dict(ratio=r, ratio_held=2 * r, clean=True) for r in (0.4, 0.7, 0.5)]}  # fmt: skip
    head, watch = {"repeats": 2, "iterations": {"plan": {"1 SRMP": 9}}, "functions_s": {"plan": 0.1}}, Stopwatch()
    watch.cpu, watch.wall = {**TIMES, **other}, TIMES
    return report(head, watch, {"plan": [True, False]}, growth, [0.4, 0.5] if "cold" in other else [])


@pytest.fixture(scope="module")
def found():
    return benchmark.bench("bhr", JumpTask(0.4, 0.3), 1, Mesh(9, 6, 9), nodes=(20, 24, 28),
                           spread=((0.5, 1.0),), cold=False, say=lambda word: None)  # fmt: skip


@pytest.mark.slow
def test_the_report_is_plain_and_complete(found):
    again = json.loads(json.dumps(found))
    assert {"warm_over_direct", "replan_over_direct", "cold_over_direct", "raw_s", "median_s", "growth"} <= set(again)
    cpu = again["raw_s"]["cpu"]
    assert all(len(times) == 1 and times[0] > 0 for times in cpu.values())
    steps = sum(times[0] for name, times in cpu.items() if name.startswith("plan: ") and name != "plan: tape")
    assert again["warm_over_direct"] == pytest.approx(steps / cpu[AT_ONCE][0])
    assert again["tape_over_direct"] == pytest.approx(cpu["plan"][0] / cpu[AT_ONCE][0])
    assert again["replan_over_direct"] == pytest.approx(cpu["re-plan"][0] / cpu[AT_ONCE][0])
    assert again["atlas_over_direct"] == pytest.approx(cpu[ATLAS][0] / cpu[AT_ONCE][0])
    assert again["three_over_direct_gn"] == pytest.approx(steps / cpu[HELD][0])
    assert again["plans_per_s"] == pytest.approx(1 / cpu[AUDITED][0]) and again["process_s"] is None
    assert again["cold_over_direct"] is None and again["peak_memory_gib"] is None
    assert [row["intervals"] for row in again["growth"]["nodes"]] == [20, 24, 28]
    (other,) = again["growth"]["spread"]
    assert (other["distance_m"], other["height_m"]) == (0.2, 0.3)
    assert other["ratio"] == pytest.approx(other["plan_s"] / other["direct_s"])
    assert other["ratio_held"] == pytest.approx(other["plan_s"] / other["held_s"])
    assert sum(again["where"].values()) == pytest.approx(1.0)


@pytest.mark.slow
def test_every_timed_plan_was_audited(found):
    assert {"plan", "re-plan", AT_ONCE, HELD, ATLAS} == set(found["audits"])
    assert all(a["of"] == 1 for a in found["audits"].values())


def test_what_is_not_reached_is_said():
    slow = made(cold=[4.0, 5.0], **{"cold, functions kept": [3.0, 3.0]})
    said = {row["number"].partition(" /")[0]: (row["value"], row["limit"], row["aim"], row["verdict"])
            for row in goals(slow)}  # fmt: skip
    assert len(said) == 7 and said["new process to finished plan"] == (3.0, 1.5, None, "not reached")
    assert said["three steps, warm"] == (1.0, 1.0, None, "reached")  # against the held Hessian; the last of two rows
    assert [row["verdict"] for row in goals(made())].count("not measured here") == 4
    ratios = ("cold_kept_over_direct", "three_over_direct_gn", "tape_over_direct")
    assert [slow[name] for name in ratios] == pytest.approx([2.0, 1.0, 0.55])
    assert slow["audits"] == {"plan": {"clean": 1, "of": 2}}


def test_the_command_prints_a_short_table_and_writes_the_numbers(monkeypatch, capsys, tmp_path):
    times = made(cold=[4.0, 5.0], **{"cold, functions kept": [3.0, 3.0]})
    monkeypatch.setattr(benchmark, "bench", lambda *asked, say: times)
    assert main(["bench", "--out", str(tmp_path / "b.json")]) == 0
    head, _, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["what", "CPU", "[s]", "ratio"]
    rows = {row["what"]: (row["CPU [s]"], row["ratio"]) for row in benchmark.rows(times)}
    assert rows["three steps"] == pytest.approx((0.5, 0.5)) and rows["plan"] == pytest.approx((0.55, 0.55))
    assert rows[AT_ONCE] == (1.0, 1.0) and rows["cold"] == pytest.approx((4.5, 3.0))
    assert rows["plan: 1 SRMP"] == (0.1, None)
    assert [line.partition("  ")[0] for line in lines[: len(rows)]] == [*rows]
    assert "audited clean: plan 1 of 2" in lines
    assert json.loads((tmp_path / "b.json").read_text()) == json.loads(json.dumps(times))


def test_growth_is_the_distance_from_a_line():
    assert line_error(NODES) == pytest.approx(0.0, abs=1e-12)
    bent = [dict(row, iteration_s=row["intervals"] ** 2 * 1e-6) for row in NODES]
    assert line_error(bent) > 0.2 and line_error(NODES[:2]) is None
    assert np.isclose(made()["node_growth_error"], 0.0)


def test_no_repeats():
    with pytest.raises(InputError) as e:
        benchmark.bench(repeats=0)
    assert str(e.value) == "repeats = 0: it takes 1 or more"
