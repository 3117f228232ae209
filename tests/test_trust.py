"""Hostile files, foreign folders and wrong calls: each is refused in a sentence, in little memory and time."""

import inspect
import io
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import joblib
import numpy as np
import psutil
import pytest
from fixtures_core import refused
from paper import clips
from test_store import make_summary, make_tape
from test_urdf_checks import TEXTS
from together import together

import jumplab as jl
from jumplab import reading
from jumplab.errors import InputError, JumplabError
from jumplab.io import folder as store
from jumplab.io.files import ensure_writable, locked, open_log
from jumplab.ocp import cache
from jumplab.sim import Scene
from jumplab.studies import sweep
from jumplab.studies.study import in_parallel, open_study

ROOT = Path(__file__).resolve().parent.parent
MEMORY_BYTES, CPU_S = 1 << 30, 30
MJCF = "<mujoco>{}<worldbody>{}</worldbody></mujoco>"
COPIES = '<replicate count="{}"><geom size="1"/></replicate>'
# runs in a process of its own: a line per file, the name of the error and its sentence
READ = """
import sys
from jumplab.errors import JumplabError
from jumplab.robot import Robot
from jumplab.io import folder, motion
from jumplab.studies.atlas import Atlas
from jumplab.studies.study import open_study
from pathlib import Path
def log(path):
    with open_study(Path(path), "trials"):
        pass
READERS = {"robot": Robot.load, "plan": folder.read_plan, "atlas": Atlas.load, "log": log}
for line in sys.stdin.read().splitlines():
    kind, path = line.split(" ", 1)
    try:
        READERS[kind](path)
        print("accepted")
    except JumplabError as e:
        print(e)
"""


def npy(shape, kind="<f8", content=b""):
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (63 - (len(head) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + content


def npz(**members):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return buffer.getvalue()


def plan_folder(place, robot, **files):
    """A result folder whose manifest fits its files, some of them foreign."""
    store.write_plan(place, make_tape(robot), robot, make_summary())
    for name, content in files.items():
        (place / name.replace("_", ".")).write_bytes(content)
    summary = json.loads((place / "summary.json").read_text())
    summary["manifest"]["files"] = {name: store.sha256(place / name) for name in store.HASHED}
    (place / "summary.json").write_text(json.dumps(summary))
    return place


def hostile(folder, robot):
    """(reader, path, what the sentence says) of every file."""
    big = 200_000_000
    shape = '<collision><geometry><mesh filename="/dev/zero"/></geometry></collision>'
    mesh = robot.urdf.replace("<collision>", f"{shape}<collision>", 1)
    field = '<asset><hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/></asset>'
    bombs = dict.fromkeys(("schema", "t", "q", "v", "a"), npy((big // 8,), content=bytes(big)))
    texts = {
        "deep.urdf": ("<robot>" + "<link>" * 60_000 + "</link>" * 60_000 + "</robot>", "has 120002 XML tags"),
        "long.urdf": ("<robot name='x'>" + "<link name='a'/>" * 1100 + "<joint/></robot>", "has 1100 links"),
        "deep.toml": ("a = " + "[" * 100_000, "not a TOML file"),
        "keys.toml": (".".join("a" * 20_000) + " = 1", "a key has more than 100 parts"),
        "copies.xml": (MJCF.format("", COPIES.format(10**9)), "<replicate> makes 1e+09 copies"),
        "field.xml": (MJCF.format(field, ""), "<hfield> makes 9e+08"),
        "pipe.xml": (MJCF.format('<include file="pipe.urdf"/>', ""), "is a pipe or a device"),
    }
    os.mkfifo(folder / "pipe.urdf")
    os.mkfifo(folder / "pipe.toml")
    (folder / "zero.urdf").symlink_to("/dev/zero")
    out = [("robot", folder / name, "is a pipe or a device") for name in ("pipe.urdf", "pipe.toml", "zero.urdf")]
    for name, (text, sentence) in texts.items():
        (folder / name).write_text(text)
        out.append(("robot", folder / name, sentence))
    heads = {"head": npy((10**10,)), "texts": npy((10**12,), "<U0")}
    files = {"bomb": npz(**bombs)} | {name: npz(schema=head) for name, head in heads.items()}
    for name, content in files.items():
        out.append(("plan", plan_folder(folder / name, robot, plan_npz=content), "not a readable plan"))
    place = plan_folder(folder / "mesh", robot, robot_urdf=mesh.encode())
    out.append(("plan", place, "the mesh '/dev/zero' is not opened"))
    (folder / "atlas").mkdir()
    (folder / "atlas" / "atlas.npz").write_bytes(npz(head=npy((10**10,))))
    out.append(("atlas", folder / "atlas", "is damaged or no atlas"))
    with open(folder / "trials.jsonl", "wb") as file:
        file.truncate(3_000_000_000)
    out.append(("log", folder / "trials.jsonl", "has 3000 MB, a log has at most 1000"))
    return out


def test_hostile_files_are_refused_in_little_memory_and_time(bhr, tmp_path):
    cases = hostile(tmp_path, bhr)

    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))

    asked = "".join(f"{kind} {path}\n" for kind, path, _ in cases)
    how = dict(cwd=ROOT, input=asked, capture_output=True, text=True, preexec_fn=limit, timeout=300)
    how["env"] = os.environ | {"OMP_NUM_THREADS": "1"}  # threads take address space
    done = subprocess.run([sys.executable, "-c", "import jumplab\n" + READ], **how)
    said = done.stdout.splitlines()
    assert done.returncode == 0 and len(said) == len(cases), done.stderr[-500:]
    for (_, path, sentence), line in zip(cases, said, strict=True):
        assert sentence in line and len(line) <= 300, (path.name, line)


@pytest.mark.parametrize("name", [".commit", ".staging", "plan.npz", "trials.jsonl", "falls"])
def test_no_link_below_a_result_folder_is_followed(bhr, tmp_path, name):
    """Targets of links stay as they were, whoever reads or writes the folder."""
    place = plan_folder(tmp_path / "out", bhr)
    foreign = tmp_path / "foreign"
    if "." in name[1:]:
        foreign.write_text("mine\n{half")
        (place / name).unlink(missing_ok=True)
    else:
        foreign.mkdir()
        (foreign / "mine").write_text("mine")
    (place / name).symlink_to(foreign)
    calls = {
        ".commit": lambda: store.read_plan(place),
        "plan.npz": lambda: store.read_plan(place),
        ".staging": lambda: store.write_plan(place, make_tape(bhr), bhr, make_summary()),
        "trials.jsonl": lambda: open_study(place / name, "trials").__enter__(),
        "falls": lambda: reading.below(place, name, "1"),
    }
    assert refused(calls[name]).endswith("is a symbolic link, which no result folder holds; remove it")
    if foreign.is_file():
        assert foreign.read_text() == "mine\n{half"
    else:
        assert [p.name for p in foreign.iterdir()] == ["mine"]


@pytest.mark.parametrize("how", ["folder", "file", "link", "owner"])
def test_a_cache_that_others_can_write_is_not_read(tmp_path, monkeypatch, how):
    """Unserialising a function may load a library that it names."""
    place = tmp_path / "cache"
    monkeypatch.setenv("JUMPLAB_CACHE", str(place))

    def kept(value):
        return cache.remembered(["words"], "key", lambda: value)

    assert (kept(1), kept(2)) == (1, 1)
    (path,) = place.iterdir()
    assert (place.stat().st_mode & 0o777, path.stat().st_mode & 0o777) == (0o700, 0o600)
    if how == "link":
        path.rename(tmp_path / "other")
        path.symlink_to(tmp_path / "other")
    elif how == "owner":
        monkeypatch.setattr(os, "geteuid", lambda: place.stat().st_uid + 1)
    else:
        (place if how == "folder" else path).chmod(0o777)
    assert kept(3) == 3
    if how in ("file", "link"):  # it was replaced
        assert kept(4) == 3 and path.stat().st_mode & 0o777 == 0o600


def _square(x):
    return x * x


def test_workers_import_nothing_from_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("joblib", "jumplab", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"open('{tmp_path}/run', 'w')")
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    assert sorted(in_parallel([joblib.delayed(_square)(x) for x in range(4)], 2)) == [0, 1, 4, 9]
    assert not (tmp_path / "run").exists() and "PYTHONSAFEPATH" not in os.environ


@pytest.mark.slow
def test_processes_and_threads_do_everything_at_once(tmp_path, monkeypatch):
    """A planner and engines are shared by threads of two processes: results are equal."""
    monkeypatch.setattr("together.ROUND_S", 5.0)
    monkeypatch.setattr("together.PROCESSES", 2)
    monkeypatch.setattr("together.WORKS", ("shared planner", "another", "bullet", "mujoco", "page"))
    row = together(tmp_path)(0, random.Random(1))
    assert not row["fault"] and row["calls"] >= 8, row


# processes ----------------------------------------------------------------------------------------------------------
def ended(work, **limits):
    """End of a fork that does ``work`` within limits, such as CPU=30: its exit code, or minus a signal."""
    child = os.fork()
    if not child:
        code = 99
        try:
            for name, value in limits.items():
                resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (value, value))
            code = work() or 0
        except JumplabError:
            code = 3
        except MemoryError:
            code = 4
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _killed(x):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_is_killed_is_told(tmp_path):
    with pytest.raises(JumplabError, match=r"^a worker process was killed, perhaps for lack of memory; what was "):
        list(in_parallel([joblib.delayed(_killed)(x) for x in range(2)], 2))
    assert sorted(in_parallel([joblib.delayed(_square)(x) for x in range(3)], 2)) == [0, 1, 4]


def test_many_processes_use_a_new_folder_at_once(bhr, tmp_path):
    tape = make_tape(bhr, n=20)
    for number in range(4):
        place = tmp_path / str(number) / "new"
        children = []
        for _ in range(8):
            if not (child := os.fork()):
                code = 99
                try:
                    store.write_plan(place, tape, bhr, make_summary())
                    store.read_plan(place)
                    code = 0
                finally:
                    os._exit(code)
            children.append(child)
        assert [os.waitpid(child, 0)[1] for child in children] == 8 * [0]


@pytest.mark.slow
@pytest.mark.parametrize("more_mb", [4, 12, 30])
def test_a_solve_without_memory_ends(bhr, more_mb, monkeypatch):
    """It has a plan, an error, or no memory; it does not go on for ever."""
    monkeypatch.setenv("JUMPLAB_CACHE", "")
    jl.Planner(bhr).plan(jl.JumpTask(0.3, 0.2))  # everything is imported
    used = psutil.Process().memory_info().vms + (more_mb << 20)
    cpu_s = int(time.process_time()) + 30
    assert ended(lambda: jl.plan(jl.JumpTask(0.4, 0.3), bhr) and 0, AS=used, CPU=cpu_s) in (0, 3, 4)


URDF = ROOT / "tests" / "mini.urdf"
STREAMS = [
    ("robot list > /dev/full", 4, None),
    ("robot list >&-", 0, None),
    ("robot list >&- 2>&-", 0, None),
    ("robot list | true", 0, None),
    ("plan --distance-m x --out p 2>&-", 2, None),
    ("plan --distance-m x --out p 2> /dev/full", 2, None),
    (f"robot check {URDF} --out new <&- >&- 2>&-", 0, "new/mini.txt"),
    (f"robot check {URDF} --out new > /dev/full 2> /dev/full", 4, "new/mini.txt"),
    ("envelope --distance-m 0.3,0.4 --height-m 0.2 --jobs 2 --out map <&- >&- 2>&-", 0, "map/envelope.json"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("line", "code", "made"), STREAMS, ids=range(len(STREAMS)))
def test_streams_change_nothing(tmp_path, line, code, made):
    """Closed, full or without a reader: the work is done, and its exit code is that of the page of commands."""
    shell = f"set -o pipefail; '{sys.executable}' -m jumplab {line}"
    how = dict(cwd=tmp_path, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    done = subprocess.run(["bash", "-c", shell], **how)
    sentence = "jumplab: the output cannot be written (No space left on device)\n" if code == 4 else ""
    assert done.returncode == code and done.stderr == ("" if "2>" in line else sentence)
    assert made is None or (tmp_path / made).stat().st_size > 0


def test_two_commands_do_not_write_one_folder_at_once(bhr, tmp_path):
    """The second says so, and changes nothing."""
    logs = {
        "envelope": ("cells.jsonl", lambda: jl.envelope(bhr, [0.3], [0.2], folder=tmp_path, progress=False)),
        "atlas": ("cells.jsonl", lambda: jl.Atlas.build(bhr, [0.3, 0.4], [0.2, 0.3], folder=tmp_path, progress=False)),
        "sweep": (sweep.CASES, lambda: sweep.run(sweep.grid([0.3], [0.3]), tmp_path, jobs=1, progress=False)),
    }
    for name, (log, call) in logs.items():
        with open_log(tmp_path / log, name, lambda line: (line, line)) as first:
            first.add({})
            with pytest.raises(InputError, match=rf"another 'jumplab {name}' is writing it; wait until that is done$"):
                call()
        assert (tmp_path / log).read_text() == "{}\n" and [p.name for p in tmp_path.iterdir()] == [log]
        (tmp_path / log).unlink()
    with locked(tmp_path), pytest.raises(InputError, match="another jumplab is writing into"):
        clips.make_clips(bhr, tmp_path)
    assert not list(tmp_path.iterdir())


# wrong calls --------------------------------------------------------------------------------------------------------
ENDLESS = []
ENDLESS.append(ENDLESS)
WRONG = [None, np.True_, "far", "", b"x", 1e300, 10**400, 1j, {}, ENDLESS, np.array([1.0, 2.0]), np.array(["a"]),
         object(), print, "x" * 5000, {"a": 1}, int, range(3), lambda x: x, np.complex128(1), [1.0, 2.0]]  # fmt: skip


# each public function is called with these, by the names of its parameters, but one
FIT = {
    "jobs": 1, "n": 1, "progress": False, "distances": [], "heights": [0.3], "distance_m": 0.4, "height_m": 0.3,
    "feet": "LR", "time_s": (0.1, 0.5), "guess_s": 0.2, "ahead_m": 0.2, "drop_m": 0.1, "gravity": 9.0,
    "tops": {0.3: 0.2}, "patience_s": 1.0, "stand_s": 0.1,
    "urdf": "<robot/>", "config_text": "", "color": "#102030", "share": 0.5,
}  # fmt: skip
SLOW = "record", "run_trials", "run_chain", "mend", "Atlas.build", "Planner.plan", "Planner.replan", "plan", "simulate"


def public(robot, slow=False):
    """Name -> every public function, class and method that takes something; ``slow`` ones as well, or not."""
    objects = {"Scene": Scene.flat(), "Robot": robot, "Planner": jl.Planner(robot), "JumpTask": jl.JumpTask(0.4, 0.3)}
    objects |= {"Contacts": jl.Contacts.hop(robot), "Perturbation": jl.Perturbation()}
    out = {name: getattr(jl, name) for name in jl.__all__ if callable(getattr(jl, name))}
    for name, kind in list(out.items()):
        if isinstance(kind, type):
            of = objects.get(name, kind)
            methods = {m for m in vars(kind) if not m.startswith("_") and callable(getattr(of, m, None))}
            out |= {f"{name}.{m}": getattr(of, m) for m in methods if inspect.isroutine(vars(kind)[m])}
    out |= {f"plots.{m}": getattr(jl.plots, m) for m in dir(jl.plots) if inspect.isfunction(getattr(jl.plots, m))}
    called = {name: takes(call) for name, call in out.items() if slow or name not in SLOW}
    return {name: out[name] for name, parameters in called.items() if parameters and "self" not in parameters}


def takes(call):
    """Parameters of a function, but those of which there may be any number."""
    parameters = inspect.signature(call).parameters.values()
    return {p.name: p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}


def test_wrong_calls_are_refused_in_a_sentence(bhr, tmp_path):
    """Drawn calls of all public functions with one wrong argument: none ends in a bare error, none is endless."""
    rng = random.Random(3)
    functions = public(bhr)
    assert len(functions) > 80
    ax = jl.plots.new_figure().subplots()
    fit = FIT | dict(robot=bhr, ax=ax, fig=ax.figure, folder=tmp_path / "none", task=jl.JumpTask(0.4, 0.3))
    for number in range(500):
        name = sorted(functions)[number % len(functions)]
        parameters = takes(functions[name])
        good = {k: fit.get(k, None if p.default is p.empty else p.default) for k, p in parameters.items()}
        wrong = rng.choice(list(good))
        value = rng.choice(WRONG)
        try:
            functions[name](**good | {wrong: value})
        except JumplabError as e:
            assert "\n" not in str(e) and len(str(e)) <= 300, (name, wrong)
        except Exception as e:
            raise AssertionError(f"{name}({wrong}={value!r:.60}): {type(e).__name__}: {e}") from e


def test_whether_a_folder_can_be_made_is_seen_without_making_it(tmp_path):
    assert ensure_writable(tmp_path / "a" / "b") == tmp_path / "a" / "b" and not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", [text for _, text, _ in TEXTS], ids=[name for name, _, _ in TEXTS])
def test_a_pair_of_texts_is_refused_as_a_urdf_is(bhr, text):
    """Without [source], and without a file, the faults of a URDF are the same."""
    with pytest.raises(InputError) as told:
        jl.Robot.from_text(text, bhr.config_text)
    assert len(str(told.value)) <= 300 and "\n" not in str(told.value)


def test_a_pair_of_texts_is_checked_as_a_urdf_is(bhr, tmp_path):
    """Without [source] as well: Pinocchio reads a mass with a unit as nothing."""
    wrong = bhr.urdf.replace('"19.994"', '"19.994kg"')
    (tmp_path / "bhr.urdf").write_text(wrong)
    (tmp_path / "my.toml").write_text(bhr.config_text)
    for call in (lambda: jl.Robot.load(tmp_path / "my.toml"), lambda: jl.Robot.from_text(wrong, bhr.config_text)):
        assert refused(call).endswith("link 'trunk': mass = '19.994kg' must be a finite number of kg")
