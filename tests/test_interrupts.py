"""Ctrl-C and SIGTERM at random moments: every command ends, and nothing new has been written.

JUMPLAB_SHOTS=200 sets how many commands are shot; the everyday run makes do with a few.
"""

import os
import random
import shutil
import signal
import subprocess
import sys

import pytest
from test_kills import ROOT, command, folder, starting  # noqa: F401 - a fixture
from test_store import names

from jumplab.cli import main as cli
from jumplab.cli.interrupts import Stopped
from jumplab.io import files

SHOTS = int(os.environ.get("JUMPLAB_SHOTS", "5"))
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
LOGS = {"cases.jsonl", "trials.jsonl"}  # finished pieces of work are kept


def commands(place, plan):
    """Name -> arguments, and how long it takes at least on a quiet machine [s]."""
    return {
        "plan": (["plan", "--height-m", "0.4", "--out", place / "p"], 3.0),
        "direct": (["plan", "--method", "direct", "--out", place / "p"], 3.0),
        "side": (["plan", "--side-m", "0.2", "--distance-m", "0.2", "--height-m", "0.3", "--out", place / "p"], 6.0),
        "run": (["run", "00", "--out", place / "r"], 10.0),
        "bench": (["bench", "--repeats", "1", "--out", place / "b.json"], 10.0),
        "sweep": (["sweep", "--distance-m", "0.3:1:9", "--height-m", "0.4", "--jobs", "2", "--out", place / "s"], 8.0),
        "trials": (["trials", plan, "--n", "4", "--jobs", "2"], 8.0),
        "chain": (["chain", "--distance-m", "0.4,0.4", "--out", place / "c"], 10.0),
    }


def content(place):
    return {p.relative_to(place): p.read_bytes() for p in place.rglob("*") if p.is_file() and p.name not in LOGS}


@pytest.mark.slow
def test_random_moments(folder, tmp_path_factory):  # noqa: F811
    rng = random.Random(11)
    for k in range(SHOTS):
        place = tmp_path_factory.mktemp("shot")
        shutil.copytree(folder, place / "plan")
        every = commands(place, place / "plan")
        name = list(every)[k % len(every)]
        arguments, longest = every[name]
        number, before = rng.choice(list(CODES)), content(place)
        process = command(list(map(str, arguments)), place)
        try:
            process.wait(rng.uniform(0.2, longest))
        except subprocess.TimeoutExpired:
            process.send_signal(number)
        said = process.communicate(timeout=60)[1]
        told = (name, number.name, process.returncode, said)
        if starting(said):
            said, process.returncode = "", CODES[number]
        assert "Traceback" not in said and said.count("\n") <= 1, told
        assert process.returncode in (0, CODES[number]), told
        if process.returncode:
            assert content(place) == before, told
        shutil.rmtree(place)


def heeding():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


LOST = """
import sys, time
import jumplab
from jumplab.cli import main as cli
def swallow(*given, **how):
    print("working", flush=True)
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            time.sleep(0.01)
        except BaseException as e:  # as CasADi does with what is raised in its callbacks
            del e
            {then}
jumplab.plan = swallow
sys.exit(cli.main())
"""


@pytest.mark.parametrize("then", ["break", "pass"])
def test_an_exception_that_gets_lost_is_raised_again(tmp_path, then):
    """Once lost, the work goes on elsewhere and is stopped there; lost again and again, the process is ended."""
    argv = [sys.executable, "-c", LOST.format(then=then), "plan", "--out", str(tmp_path / "p")]
    # whoever runs the tests in the background may ignore Ctrl-C, and so would the command
    how = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeding)
    process = subprocess.Popen(argv, cwd=ROOT, **how)
    assert process.stdout.readline() == "working\n" or process.stdout.readline() == "working\n"
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert (process.returncode, said) == (130, "jumplab: interrupted; what was there before is unchanged\n")
    assert names(tmp_path) == []


def test_results_are_settled_or_not_at_all(tmp_path, monkeypatch):
    """A signal that was heard, and lost, raises at the last moment; one that comes later is too late."""
    heard = cli.Interrupts(alone=False)
    with heard.heeded():
        heard.number = signal.SIGINT
        with pytest.raises(Stopped):
            files.settle()
    late = cli.Interrupts(alone=False)
    with late.heeded():
        files.settle()
        signal.raise_signal(signal.SIGINT)
        assert late.number is None
    assert not files.AT_SETTLE
