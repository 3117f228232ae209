"""Sweeps: the grid, the table, going on after a kill, a cluster, and every refusal."""

import csv
import json
import os
from pathlib import Path

import joblib
import pytest
from fixtures_core import refused
from test_cli import one_sentence, run
from test_store import names

from jumplab.cli.common import values_of
from jumplab.cli.studies import choices_of
from jumplab.errors import InputError
from jumplab.io.files import Log
from jumplab.studies import study, sweep
from jumplab.task import JumpTask

ROOT = Path(__file__).resolve().parent.parent


def quick(case, *_) -> dict:
    """In place of a plan."""
    row = {"weights": case.weights, "distance_m": case.task.distance_m, "planned": True}
    return dict.fromkeys(sweep.COLUMNS) | row


def test_grid_runs_distances_fastest():
    cases = sweep.grid([0.1, 0.2], [0.3, 0.4], robots=["bhr"], weights=[{}, {"torque": 2.0}])
    assert len(cases) == 8 and len({c.key() for c in cases}) == 8
    assert [(c.task.distance_m, c.task.height_m) for c in cases[:3]] == [(0.1, 0.3), (0.2, 0.3), (0.1, 0.4)]
    assert cases[4].weights == {"torque": 2.0}


def test_a_motion_that_was_stopped_before_its_line_goes(tmp_path, monkeypatch):
    """Of two cases the second is stopped between its motion and its line; files of others stay."""
    (tmp_path / sweep.TAPES).mkdir()
    (tmp_path / sweep.TAPES / "mine.npz").write_bytes(b"mine")
    add, lines = Log.add, []

    def stopped(log, line):
        lines.append(line)
        if len(lines) == 2:
            raise KeyboardInterrupt
        add(log, line)

    monkeypatch.setattr(Log, "add", stopped)
    with pytest.raises(KeyboardInterrupt):
        sweep.run(sweep.grid([0.3, 0.4], [0.2]), tmp_path, jobs=1, tapes_hz=50)
    assert names(tmp_path / sweep.TAPES) == sorted([f"{lines[0]['key']}.npz", "mine.npz"])


def test_values_as_they_are_typed():
    assert values_of("--x", "0:1.2:13") == [round(0.1 * k, 9) for k in range(13)]
    assert values_of("--x", "0.5") == [0.5] and values_of("--x", "1,-2,3e-1") == [1.0, -2.0, 0.3]
    assert values_of("--x", "2:3:1") == [2.0]
    assert choices_of("--weight must be TERM", ["a=1,2", "b=3"]) == [{"a": 1.0, "b": 3.0}, {"a": 2.0, "b": 3.0}]


def test_robots_that_differ():
    names = sweep.varied(["bhr", "g1"], choices_of("--vary must be WHAT", ["mass=0.9,1", "leg=1.1"]))
    assert names == ["bhr mass=0.9 leg=1.1", "bhr leg=1.1", "g1 mass=0.9 leg=1.1", "g1 leg=1.1"]
    robot, bhr = sweep.robot_of(names[0]), sweep.robot_of("bhr")
    assert (
        robot.total_mass == pytest.approx(0.9 * bhr.total_mass)
        and robot.hash == bhr.with_mass(factor=0.9).with_legs(1.1).hash
    )
    said = refused(sweep.varied, ["bhr"], [{"arm": 1.1}])
    assert said == "a sweep varies mass, effort, speed, leg of a robot, not 'arm'"


@pytest.mark.slow
def test_a_small_sweep_is_one_table(tmp_path):
    """Two targets that can be planned, one that cannot: three rows, true to their plans."""
    cases = sweep.grid([0.3], [0.3, 1.4]) + sweep.grid([0.3], [0.3], weights=[{"torque": 3e-4}])
    rows = sweep.run(cases, tmp_path, jobs=1, progress=False)
    assert [row["planned"] for row in rows] == [True, False, True]
    assert rows[0]["clean"] and rows[0]["planned_distance_m"] == pytest.approx(0.3, abs=1e-3)
    assert rows[1]["reason"].startswith("whole body: no plan (") and rows[1]["cost"] is None
    assert rows[2]["cost"] > rows[0]["cost"]
    with open(tmp_path / sweep.TABLE, newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["weights"] for row in table] == ["", "", "torque=0.0003"]
    assert tuple(table[0]) == sweep.COLUMNS
    assert sweep.run(cases, tmp_path, jobs=1, progress=False) == rows  # nothing is planned again


def test_it_goes_on_where_it_stopped(tmp_path, monkeypatch):
    cases, planned = sweep.grid([0.1, 0.2, 0.3], [0.3]), []

    def some(case, *_):
        if len(planned) == 2:
            raise KeyboardInterrupt
        planned.append(case.task.distance_m)
        return quick(case)

    monkeypatch.setattr(sweep, "run_case", some)
    with pytest.raises(KeyboardInterrupt):
        sweep.run(cases, tmp_path, jobs=1, progress=False)
    assert sweep.TABLE not in names(tmp_path)
    log = tmp_path / sweep.CASES
    log.write_bytes(log.read_bytes()[:-7])  # as if the power had gone within the last line
    planned.clear()
    rows = sweep.run(cases, tmp_path, jobs=1, progress=False)
    assert planned == [0.2, 0.3] and [row["distance_m"] for row in rows] == [0.1, 0.2, 0.3]
    assert all(json.loads(line) for line in log.read_text().splitlines())


@pytest.mark.slow
def test_the_same_on_a_cluster(tmp_path):
    """A local Dask cluster, one worker of two threads, gives the rows that this process gives."""
    distributed = pytest.importorskip("distributed")
    with pytest.raises(InputError, match=r"^no Dask scheduler answers at 'nowhere:1' "):
        sweep.run(sweep.grid([0.3], [0.3]), tmp_path, cluster="nowhere:1", progress=False)
    cases = sweep.grid([0.3, 0.4, 0.5], [0.3])
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=":0") as cluster:
        far = sweep.run(cases, tmp_path / "far", cluster=cluster.scheduler_address, progress=False)
    near = sweep.run(cases, tmp_path / "near", jobs=1, progress=False)
    for a, b in zip(far, near, strict=True):
        assert a["clean"] and b["clean"]
        assert (a["distance_m"], a["iterations"]) == (b["distance_m"], b["iterations"])
        assert a["cost"] == pytest.approx(b["cost"], rel=1e-9)


def where(k):
    return k, os.getpid()


@pytest.mark.slow
def test_a_cluster_of_any_shape_is_used_if_it_has_the_same_code(monkeypatch):
    distributed = pytest.importorskip("distributed")
    work = [joblib.delayed(where)(k) for k in range(4)]
    for workers in (1, 2):
        with distributed.LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0") as cluster:
            with study.on_cluster(cluster.scheduler_address):
                found = sorted(study.in_parallel(work, 1))
            assert [k for k, _ in found] == [0, 1, 2, 3] and os.getpid() not in {pid for _, pid in found}
            if workers == 1:
                monkeypatch.setattr(study, "code", lambda: "another")
                refused = pytest.raises(
                    InputError, match=r"^worker \S+ has code \w+, this process another; install the same"
                )
                with refused, study.on_cluster(cluster.scheduler_address):
                    pass
                monkeypatch.undo()


def test_sweeps_share_a_log_and_do_not_mix(tmp_path, monkeypatch):
    """Each has its own table; what decides a plan is all in its key. A log of something else is refused."""
    asked = []
    monkeypatch.setattr(sweep, "run_case", lambda case, *_: (asked.append(case), quick(case))[1])

    def swept(cases, **how):
        return [row["distance_m"] for row in sweep.run(cases, tmp_path, jobs=1, progress=False, **how)]

    assert swept(sweep.grid([0.1], [0.3])) == [0.1] and swept(sweep.grid([0.1, 0.2], [0.3])) == [0.1, 0.2]
    assert [case.task.distance_m for case in asked] == [0.1, 0.2]
    others = [
        sweep.Case(JumpTask(0.1, 0.3, **more)) for more in ({"gravity": 3.7}, {"platform_m": 0.1}, {"side_m": 0.1})
    ]
    others += sweep.grid([0.1], [0.3], robots=["bhr mass=1.1"], weights=[{}, {"torque": 1e-3}])
    others += sweep.grid([0.1], [0.3], method="three-step")
    asked.clear()
    assert swept(others) == 6 * [0.1] and asked == others
    swept(sweep.grid([0.1], [0.3]), tapes_hz=50)
    assert len(asked) == 7
    with open(tmp_path / sweep.TABLE, newline="") as file:
        assert [row["distance_m"] for row in csv.DictReader(file)] == ["0.1"]
    for old in ("good morning\n", '{"case": "{}", "row": {}}\n'):
        (tmp_path / sweep.CASES).write_text(old)
        with pytest.raises(InputError, match=r"was not written by this version's 'jumplab sweep'; choose another"):
            swept(sweep.grid([0.1], [0.3]))


REFUSALS = [
    ("sweep", "the following arguments are required: --out; 'jumplab sweep --help' shows what is possible"),
    (
        "sweep --out s --distance-m 0:1",
        "--distance-m must be FROM:TO:COUNT or A,B,... with COUNT from 1 to 10000, got '0:1'",
    ),
    ("sweep --out s --height-m 9", "height = 9 m is outside 0.02 ... 1.5 m"),
    ("sweep --out s --weight torque", "--weight must be TERM=A,B,..., got 'torque'"),
    ("sweep --out s --vary mass", "--vary must be WHAT=A,B,..., got 'mass'"),
    ("sweep --out s --distance-m 0.1,0.1", "the sweep has the same case twice; give every value once"),
    ("bench --repeats 0", "--repeats must be a whole number from 1 to 1000, got '0'"),
    ("bench --repeats 1 --out no/such/file", "--out must name a file in a folder that exists, got 'no/such/file'"),
]


@pytest.mark.parametrize(("command", "sentence"), REFUSALS, ids=[c for c, _ in REFUSALS])
def test_refusals(capsys, tmp_path, monkeypatch, command, sentence):
    monkeypatch.chdir(tmp_path)
    assert one_sentence(*run(capsys, *command.split())) == sentence
    assert names(tmp_path) == [] and os.listdir(tmp_path) == []


def test_an_unknown_weight_is_refused_at_once(tmp_path):
    """Not once per case, after the robot has been built."""
    cases = sweep.grid([0.3], [0.3], weights=[{"torqe": 1.0}])
    said = refused(sweep.run, cases, tmp_path / "s", jobs=1, progress=False)
    assert said.startswith("weight or switch 'torqe': the problem 'whole body' has no such term; it has ")
    assert not (tmp_path / "s").exists()
