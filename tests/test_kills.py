"""Real commands killed, terminated and interrupted: the folder then holds the old result or the new one, whole.

JUMPLAB_KILLS=25 sets how many processes are shot per test; the everyday run makes do with a few.
"""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from fixtures_core import jump

from jumplab import auditing as passport
from jumplab.io import folder as store

ROOT = Path(__file__).resolve().parent.parent
KILLS = int(os.environ.get("JUMPLAB_KILLS", "3"))
SIGNALS = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT]
PLAN = {"passport.json", "plan.npz", "robot.toml", "robot.urdf", "summary.json"}
SIMULATION = {"simulation.npz", "simulation.json"}
OLD, NEW = 0.5, 0.45  # rise asked of the plan that is there, and of those that are shot


def names(folder):
    return {p.name for p in folder.iterdir()}


@cache
def made():
    """Content of a folder with a finished plan of the old target, its passport and a simulation."""
    with tempfile.TemporaryDirectory() as place:
        folder, plan = Path(place), jump(1.0, OLD)
        store.write_plan(folder, plan.tape, plan.robot, plan.summary, passport.write_audit)
        command(["simulate", place], folder).communicate()
        assert names(folder) == PLAN | SIMULATION
        return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.fixture
def folder(tmp_path):
    restore(tmp_path, made())
    return tmp_path


def command(arguments, folder):
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs ignore Ctrl-C
    return subprocess.Popen([sys.executable, "-m", "jumplab", *arguments], cwd=ROOT, stdout=subprocess.DEVNULL,
                            stderr=subprocess.PIPE, text=True, preexec_fn=heed,
                            env=os.environ | {"OMP_NUM_THREADS": "1"})  # fmt: skip


def shoot(arguments, folder, rng, kind, aimed_s):
    """Start a command and end it: after a random time or, aimed, ``aimed_s`` after its first write at the latest.

    Returns what it said on stderr, and its exit code.
    """
    process = command(arguments, folder)
    deadline = time.monotonic() + (120.0 if aimed_s else rng.uniform(0.3, 6.0))
    writing = [folder / ".staging", folder / ".commit"]
    while time.monotonic() < deadline and process.poll() is None:
        if aimed_s and any(p.exists() for p in writing):
            time.sleep(rng.uniform(0.0, aimed_s))
            break
        time.sleep(0.0005)
    process.send_signal(kind)
    return process.communicate(timeout=60)[1], process.returncode


def restore(folder, files):
    """The old result again, and only it."""
    shutil.rmtree(folder)
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)


def check(folder):
    """Everything in the folder speaks of one and the same plan; returns its target's rise."""
    tape, _, summary = store.read_plan(folder)  # checks the hashes of plan and robot
    seal = store.read_json(folder / "passport.json")["manifest"]
    assert seal["plan_sha256"] == summary["manifest"]["files"]["plan.npz"]
    assert seal["target"] == summary["target"]
    com = tape.extra["planar_com"][tape.takeoff_index :, 1]
    assert com.max() - com[0] == pytest.approx(summary["target"]["height_m"], abs=2e-3)
    found = names(folder) & SIMULATION
    if found:
        assert found == SIMULATION
        told = store.read_json(folder / "simulation.json")
        assert told["planned_rise_m"] == summary["planned_rise_m"]
        with np.load(folder / "simulation.npz", allow_pickle=False) as file:
            assert all(np.size(file[k]) for k in file.files)
    return summary["target"]["height_m"], bool(found)


def starting(said):
    """Whether it was shot while Python was still starting: the command's own ``main`` is not in the traceback."""
    return "KeyboardInterrupt" in said and not re.search(r'jumplab/__main__\.py", line \d+, in main\n', said)


def quiet(said, code, kind):
    """Once the command has begun it leaves one sentence at most, and its exit code; before, Python itself speaks."""
    if kind == signal.SIGINT and starting(said):
        return
    assert "Traceback" not in said and said.count("\n") <= 1, said
    answered = {signal.SIGKILL: {-9}, signal.SIGTERM: {143, -15}, signal.SIGINT: {130, -2}}[kind]
    assert code in {0, *answered}


# what is shot -> its arguments, and how long it writes [s]: the audit takes about a second
SHOT = {"plan": (["--height-m", str(NEW), "--out"], 2.0), "simulate": (["--mode", "pd"], 0.5)}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHOT)
def test_shot_at_random_moments(folder, name):
    """A plan leaves the old result or the new one without a simulation; a simulation leaves the plan as it was."""
    rng, seen, (options, aimed_s) = random.Random(5), [], SHOT[name]
    arguments = [name, *options, str(folder)]
    before = made()
    for k in range(KILLS):
        kind = SIGNALS[k % 3]
        said, code = shoot(arguments, folder, rng, kind, (aimed_s, None)[k % 2])
        quiet(said, code, kind)
        rise, simulated = check(folder)
        assert (rise, simulated) in ((OLD, True), (NEW, False))
        if name == "simulate":
            mode = store.read_json(folder / "simulation.json")["settings"]["mode"]
            assert rise == OLD and mode in ("position", "pd")
            assert all((folder / n).read_bytes() == before[n] for n in PLAN)
        seen.append(rise)
        restore(folder, before)  # the next one finds the old result again
    print(f"{KILLS} shot: {seen.count(OLD)} left the old plan, {seen.count(NEW)} the new one")
    said = command(arguments, folder).communicate(timeout=120)[1]
    assert said == "" and check(folder) == ((NEW, False) if name == "plan" else (OLD, True))
