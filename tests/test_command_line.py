"""Options of all commands: JSON, quiet, progress on a terminal, completion; no option is ignored without a word."""

import json
import os
import pty
import re
import select
import subprocess
import sys
import time

import pytest
from fixtures_core import jump
from fixtures_robots import needs_published
from test_cli import ROOT, one_sentence, run
from test_store import names

from jumplab import auditing
from jumplab.cli import common
from jumplab.cli import main as cli
from jumplab.io import folder as store

NAMES = [work.__name__.rstrip("_") for work in cli.COMMANDS]


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    plan, place = jump(1.0, 0.5), tmp_path_factory.mktemp("shared") / "plan"
    store.write_plan(place, plan.tape, plan.robot, plan.summary, auditing.write_audit)
    return place


@pytest.mark.parametrize("name", NAMES)
def test_every_command_takes_json_and_quiet(capsys, name):
    with pytest.raises(SystemExit):
        cli.main([name, "--help"])
    said = capsys.readouterr().out
    assert "--json" in said and "--quiet" in said
    assert not re.search(r"--(workers|n-jobs|distances-m|heights-m|platforms-m)\b", said)
    if name in ("trials", "margins", "certify", "chain", "envelope", "sweep"):
        assert "--jobs N" in said


def test_json_is_one_object(capsys, planned):
    code, out, err = run(capsys, "audit", planned, "--json")
    found = json.loads(out)
    assert (code, err) == (0, "") and found["passed"] and found["exit_code"] == 0 and found["error"] is None
    assert len(found["checks"]) > 40


@pytest.mark.parametrize("argv", ["audit nowhere", "plan --out x --height-m 9", "plan"])
def test_json_tells_refusals_too(capsys, tmp_path, monkeypatch, argv):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *argv.split(), "--json")
    found = json.loads(out)
    assert code == 2 == found["exit_code"] and err == f"jumplab: {found['error']}\n"
    assert names(tmp_path) == []
    assert json.loads(run(capsys, "robot", "list", "--json")[1])["robots"][0]["name"] == "bhr"


def test_quiet_says_nothing(capsys, planned):
    assert run(capsys, "--quiet", "audit", planned) == (0, "", "")
    assert run(capsys, "audit", "nowhere", "--quiet")[2].startswith("jumplab: there is no folder")
    assert json.loads(run(capsys, "audit", planned, "--quiet", "--json")[1])["passed"]


IGNORED = [
    ("view {} --movie a.gif --out b.html", "--out names the page, but --movie makes an animation "
     "instead; leave it out"),
    ("chain --distance-m 0.5 --jobs 2 --out x", "--jobs has an effect only with several --runs; leave it out"),
    ("chain --distance-m 0.5 --ranges wide --out x", "--ranges is for perturbed robots, but neither --seed "
     "nor --runs asks for one; leave it out"),
    ("sweep --out x --cluster tcp://a:1 --jobs 2", "--jobs sets processes of this machine, but --cluster does the "
     "work elsewhere; leave it out"),
    ("robot check g1 --repair inertia", "--repair is for a bare URDF; a configuration has its own [source] repair, "
     "so leave it out"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "sentence"), IGNORED, ids=[line.split()[0] for line, _ in IGNORED])
def test_no_option_is_ignored(capsys, planned, tmp_path, monkeypatch, line, sentence):
    monkeypatch.chdir(tmp_path)
    assert one_sentence(*run(capsys, *line.format(planned).split())) == sentence
    assert names(tmp_path) == []


@pytest.mark.parametrize("line", ["view nowhere --out new/a.html", "view nowhere --movie new/a.gif",
                                  "export nowhere --format csv --out new/a.csv", "sweep --out new/s --robot asimo",
                                  "envelope --out new/e --robot asimo"])  # fmt: skip
def test_nothing_is_made_by_what_fails(capsys, tmp_path, monkeypatch, line):
    monkeypatch.chdir(tmp_path)
    one_sentence(*run(capsys, *line.split()))
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("shell", "word"), [("bash", "complete -"), ("zsh", "#compdef jumplab"), ("fish", "complete ")]
)
def test_completion(capsys, shell, word):
    code, out, err = run(capsys, "completion", shell)
    assert (code, err) == (0, "") and word in out and all(name in out for name in ("simulate", "platform-m"))


def test_a_terminal_sees_what_is_going_on(planned):
    """Within a second or two of a slow machine, and the line is gone when the command has ended."""
    mine, theirs = pty.openpty()
    argv = [sys.executable, "-m", "jumplab", "view", str(planned), "--out", str(planned / "seen.html")]
    process = subprocess.Popen(argv, cwd=ROOT, stderr=theirs, stdout=subprocess.DEVNULL)
    os.close(theirs)
    seen, end = b"", time.monotonic() + 60
    while time.monotonic() < end and (process.poll() is None or select.select([mine], [], [], 0.1)[0]):
        if select.select([mine], [], [], 0.1)[0]:
            try:
                seen += os.read(mine, 4096)
            except OSError:  # the other side is closed
                break
    assert process.wait() == 0
    if seen:
        *_, last, end = seen.split(b"\r")
        assert seen.startswith(b"\rjumplab view: loading, ")
        assert (last.strip(), end) == (b"", b"")  # blanks over the line


@needs_published
def test_the_example_in_the_help_of_each_command_can_be_typed():
    parser, count = cli.make_parser(), 0
    for name, options in common.OPTIONS.items():
        if line := options.get("example"):
            words = line.split()
            assert parser.parse_args(words).command == words[0] and name in words[:2]
            count += 1
    assert count == len(cli.COMMANDS) - len(("robot",)) + len(("list", "check"))
