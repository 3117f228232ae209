"""Result folders: whole or not at all, whoever kills, races or damages them."""

import ast
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from fixtures_core import refused

from jumplab.errors import InputError
from jumplab.io import folder as store
from jumplab.io.files import open_log
from jumplab.io.tape import Tape

ROOT = Path(__file__).resolve().parent.parent


def make_tape(robot, value=0.0, n=200):
    """A tape that is no jump, all of whose numbers are ``value``, long enough for a write to take a while."""
    nq, nv = robot.model.nq, robot.model.nv
    phase = np.array(["launch"] * (n // 2) + ["flight"] * (n - n // 2))
    rows = {"q": (n, nq), "v": (n, nv), "a": (n, nv), "tau": (n, nv - 6), "f": (n, 2, 6)}
    return Tape(t=np.full(n, value), phase=phase, contact_frames=np.array(robot.foot.frames),
                joint_names=np.array(robot.joint_names), **{k: np.full(s, value) for k, s in rows.items()})  # fmt: skip


def make_summary(value=0.0):
    return {"target": {"distance_m": 1.0, "height_m": 0.5}, "value": value, "planned_distance_m": 1.0,
            "planned_rise_m": 0.5}  # fmt: skip


class Result:
    """Stands in for a simulation's result."""

    def save(self, folder, extra=None):
        np.savez(folder / "simulation.npz", t=np.zeros(3))
        (folder / "simulation.json").write_text(json.dumps(extra))


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_round_trip(bhr, odd_folder):
    folder = odd_folder / "new" / "plan"
    store.write_plan(folder, make_tape(bhr, 2.0), bhr, make_summary(2.0) | {"bad": float("nan"), "n": np.int64(3)})
    assert names(folder) == ["plan.npz", "robot.toml", "robot.urdf", "summary.json"]
    tape, robot, summary = store.read_plan(folder)
    assert np.array_equal(tape.q, make_tape(bhr, 2.0).q)
    assert robot.hash == bhr.hash
    assert summary["bad"] is None and summary["n"] == 3
    assert summary["manifest"]["robot"] == {"name": bhr.name, "hash": bhr.hash}
    assert summary["manifest"]["versions"]["casadi"][0].isdigit()


def test_new_plan_removes_what_was_said_of_the_old_one_and_nothing_else(bhr, tmp_path):
    store.write_plan(tmp_path, make_tape(bhr), bhr, make_summary(), lambda d: (d / "passport.json").write_text("{}"))
    store.write_simulation(tmp_path, Result(), store.read_plan(tmp_path)[2])
    (tmp_path / "notes.txt").write_text("mine")
    assert {"passport.json", "simulation.npz", "simulation.json"} < set(names(tmp_path))
    assert json.loads((tmp_path / "simulation.json").read_text()) == {"planned_distance_m": 1.0, "planned_rise_m": 0.5}
    store.write_plan(tmp_path, make_tape(bhr, 1.0), bhr, make_summary(1.0))
    assert names(tmp_path) == ["notes.txt", "plan.npz", "robot.toml", "robot.urdf", "summary.json"]


def test_simulation_of_a_plan_that_has_gone_is_refused(bhr, tmp_path):
    store.write_plan(tmp_path, make_tape(bhr), bhr, make_summary())
    old = store.read_plan(tmp_path)[2]
    store.write_plan(tmp_path, make_tape(bhr, 1.0), bhr, make_summary(1.0))
    assert "planned again in the meantime" in refused(store.write_simulation, tmp_path, Result(), old)
    assert "simulation.json" not in names(tmp_path)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit, OSError])
@pytest.mark.parametrize("first", [True, False])
def test_failed_write_leaves_what_was_there(bhr, tmp_path, error, first):
    def fail(staging):
        raise error("no")

    folder = tmp_path / "a" / "b"
    if not first:
        store.write_plan(folder, make_tape(bhr), bhr, make_summary())
    before = {p: p.is_file() and p.read_bytes() for p in tmp_path.rglob("*")}
    with pytest.raises(InputError if error is OSError else error):
        store.write_plan(folder, make_tape(bhr, 1.0), bhr, make_summary(1.0), fail)
    assert {p: p.is_file() and p.read_bytes() for p in tmp_path.rglob("*")} == before


@pytest.mark.parametrize("moved", range(5))
def test_commit_that_was_killed_is_completed_by_the_next_reader(bhr, tmp_path, monkeypatch, moved):
    """The process dies after ``moved`` renames of the commit."""

    class Killed(BaseException):
        pass

    count = itertools.count()

    def dying(source, target):
        if next(count) >= moved:
            raise Killed
        os.rename(source, target)

    def passport(staging):
        (staging / "passport.json").write_text("{}")

    store.write_plan(tmp_path, make_tape(bhr), bhr, make_summary())
    store.write_simulation(tmp_path, Result(), store.read_plan(tmp_path)[2])
    monkeypatch.setattr(os, "replace", dying)
    with pytest.raises(Killed):
        store.write_plan(tmp_path, make_tape(bhr, 1.0), bhr, make_summary(1.0), passport)
    monkeypatch.undo()
    assert "summary.json" not in names(tmp_path), "a mix must have no summary"
    tape, _, summary = store.read_plan(tmp_path)
    assert tape.t[0] == summary["value"] == 1.0
    assert names(tmp_path) == ["passport.json", "plan.npz", "robot.toml", "robot.urdf", "summary.json"]


WRITER = """
    import sys, itertools, time
    sys.path[:0] = [{root!r}, {tests!r}]
    from test_store import make_summary, make_tape
    from jumplab.io import folder as store
    from jumplab.robot import Robot
    robot = Robot.load()
    for k in itertools.count({start}, 2):
        store.write_plan({folder!r}, make_tape(robot, float(k)), robot, make_summary(float(k)))
        print(k, flush=True)
        time.sleep(0.01)
"""


def start_writer(folder, start):
    code = WRITER.format(root=str(ROOT), tests=str(ROOT / "tests"), folder=str(folder), start=start)
    return subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True)


def check_whole(folder):
    """Tape, robot and summary of one and the same write; returns which."""
    tape, _, summary = store.read_plan(folder)
    assert tape.t[0] == tape.f[-1, -1, -1] == summary["value"]
    return summary["value"]


def test_writers_killed_at_random_moments(bhr, tmp_path):
    moments = random.Random(7)
    for k in range(4):
        writer = start_writer(tmp_path, start=100 * k)
        assert writer.stdout.readline(), "the writer did not start"
        time.sleep(moments.uniform(0.0, 0.1))
        writer.send_signal(signal.SIGKILL if k % 2 else signal.SIGTERM)
        writer.wait()
        writer.stdout.close()
        assert check_whole(tmp_path) >= 100 * k
    store.write_plan(tmp_path, make_tape(bhr, -1.0), bhr, make_summary(-1.0))
    assert names(tmp_path) == ["plan.npz", "robot.toml", "robot.urdf", "summary.json"]


def test_two_writers_and_a_reader_in_one_folder(tmp_path):
    writers = [start_writer(tmp_path, start=k) for k in (0, 1)]
    for w in writers:
        assert w.stdout.readline(), "the writer did not start"
    seen = set()
    for _ in range(20):
        seen.add(check_whole(tmp_path))
        time.sleep(0.01)  # a reader that never pauses would keep the writers out
    for w in writers:
        assert w.poll() is None
        w.kill()
        w.wait()
        w.stdout.close()
    assert len(seen) > 1
    check_whole(tmp_path)


def test_second_writer_gives_up_in_one_sentence(bhr, tmp_path, monkeypatch):
    monkeypatch.setattr(store.locked.__wrapped__, "__kwdefaults__", {"shared": False, "wait_s": 0.05})
    with store.locked(tmp_path), pytest.raises(InputError, match="another jumplab is writing into"):
        store.write_plan(tmp_path, make_tape(bhr), bhr, make_summary())
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("/dev/null/x", "cannot be written (Not a directory); choose another one"),
        ("/proc/x", "cannot be written"),
        ("x" * 300, "cannot be the name of a file or folder"),
        ("a\0b", "cannot be the name of a file or folder"),
        (__file__, "is a file; choose a folder"),
    ],
)
def test_unwritable_folder(bhr, tmp_path, monkeypatch, name, sentence):
    monkeypatch.chdir(tmp_path)
    for attempt in (
        lambda: store.ensure_writable(name),
        lambda: store.write_plan(name, make_tape(bhr), bhr, make_summary()),
    ):
        said = refused(attempt)
        assert sentence in said and "\n" not in said
    assert names(tmp_path) == []


def test_a_log_is_read_around_what_is_not_its_own(tmp_path):
    """Of equal keys the last line counts; a line that was cut off goes, foreign ones stay, and nothing is no file."""

    def parse(line):
        return line["key"], line["value"]

    path = tmp_path / "log.jsonl"
    with open_log(path, "log", parse) as log:
        assert log.empty and not log.done
    assert names(tmp_path) == []
    path.write_bytes(b'hello\n[1]\n{"key": 1, "value": 2}\n{"key": 1, "value": 3}\n{"key": 4, "val')
    with open_log(path, "log", parse) as log:
        assert log.done == {1: 3} and not log.empty
        log.add({"key": 5, "value": 6})
        with pytest.raises(InputError, match=r"another 'jumplab log' is writing it"), open_log(path, "log", parse):
            pass
    assert path.read_bytes().splitlines()[-2:] == [b'{"key": 1, "value": 3}', b'{"key": 5, "value": 6}']
    with pytest.raises(InputError, match="cannot be written"), open_log(tmp_path, "log", parse):
        pass


def damage(folder, name, how):
    path = folder / name
    data = path.read_bytes()
    if how == "missing":
        path.unlink()
    elif how == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif how == "flipped":
        path.write_bytes(data[:40] + bytes([data[40] ^ 1]) + data[41:])
    else:
        path.write_bytes(how)


HOW = ["missing", "cut", "flipped", b""]
DAMAGES = [(name, how) for name in ("plan.npz", "robot.urdf", "robot.toml") for how in HOW]
SUMMARIES = ["missing", "cut", b"", b"[]", b"{}", b"\xff", b"[" * 100_000, b'{"manifest": 3}']
DAMAGES += [("summary.json", how) for how in SUMMARIES]


@pytest.mark.parametrize(("name", "how"), DAMAGES)
def test_a_damaged_file_is_refused(bhr, tmp_path, name, how):
    store.write_plan(tmp_path, make_tape(bhr), bhr, make_summary())
    damage(tmp_path, name, how)
    words = "cannot be read" if how == "missing" else "changed or damaged"
    with pytest.raises(InputError, match=r"summary\.json" if name == "summary.json" else words):
        store.read_plan(tmp_path)


OPCODES = "GLOBAL MARK TUPLE EMPTY_TUPLE REDUCE BINPERSID PROTO EMPTY_DICT SETITEMS STOP".split()


def test_nothing_in_the_package_unpickles():
    """Nothing of pickle but ``dumps`` is used, nothing of its relatives, and no array file may hold objects.

    The reader of other people's clips names what an unpickler may do, and tests of clips hold it to that.
    """
    kin = {"_pickle", "dill", "cloudpickle", "shelve", "marshal"}
    sources = sorted((ROOT / "jumplab").rglob("*.py"))
    assert len(sources) > 50
    for path in sources:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Name | ast.Attribute) and ast.unparse(node).startswith("pickle"):
                narrow = {"pickle.UnpicklingError", "pickle.BUILD"} if path.match("io/clip.py") else set()
                if path.match("io/tensors.py"):  # writes opcodes; its reader overrides find_class
                    narrow = {"pickle.UnpicklingError", "pickle.Unpickler"} | {f"pickle.{name}" for name in OPCODES}
                assert ast.unparse(node) in {"pickle", "pickle.dumps"} | narrow, path
            if isinstance(node, ast.Import):
                assert all(a.asname is None for a in node.names if a.name == "pickle"), path
                assert not kin & {a.name.split(".")[0] for a in node.names}, path
            elif isinstance(node, ast.ImportFrom):
                assert not {*kin, "pickle"} & {str(node.module)} and "Memory" not in {a.name for a in node.names}, path
            elif isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                assert name not in ("joblib.load", "joblib.Memory"), path
                if name in ("np.load", "numpy.load"):
                    assert {k.arg: ast.unparse(k.value) for k in node.keywords}.get("allow_pickle") == "False", path
