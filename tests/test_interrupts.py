"""Ctrl-C, SIGTERM and SIGKILL at random moments: every command ends, and no result is half written.

``python tests/trust.py signals DIR`` sends hundreds to all commands; here are a few to quick ones.
"""

import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from test_store import names
from trust import KINDS

from jumplab.cli import main as cli
from jumplab.cli.interrupts import Stopped
from jumplab.io import files

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["signals", "kills"])
def test_random_moments(kind, tmp_path):
    """Commands end in a sentence, and leave the old result or the new one, whole."""
    case = KINDS[kind][0](tmp_path)
    for number in range(100, 106):
        row = case(number, random.Random(number))
        assert not row["fault"], row


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
