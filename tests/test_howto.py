"""The book's page of everyday tasks: each is short, its commands exist, and its code runs."""

import re
import shlex
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump

from jumplab.cli import main as command_line
from jumplab.robot import Robot

PAGE = (Path(__file__).resolve().parent.parent / "notebooks" / "book" / "howto.md").read_text(encoding="utf-8")
PREAMBLE, *TASKS = re.split(r"^## ", PAGE, flags=re.M)
TASKS = {title: body for title, _, body in (task.partition("\n") for task in TASKS)}
LINES = 10
PLANS = ("jl.plan(", "jl.mend(", "jl.simulate(")  # what takes seconds


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)


CODE = {title: "".join(blocks(body, "python")) for title, body in TASKS.items()}
QUICK = [title for title, code in CODE.items() if code and not any(word in code for word in PLANS)]
CLIPS = "Judge and mend a motion clip"  # its file is not there; tests of judging have one
SLOW = [title for title, code in CODE.items() if code and title not in (*QUICK, CLIPS)]


def test_there_are_as_many_as_the_page_says_and_each_is_short():
    assert len(TASKS) == 15 and "Fifteen everyday tasks" in PREAMBLE and len(QUICK) >= 4
    for title, body in TASKS.items():
        every = blocks(body, r"(?:python|sh)")
        assert every and all(len(block.splitlines()) <= LINES for block in every), title


@pytest.mark.parametrize("title", [title for title in TASKS if blocks(TASKS[title], "sh")])
def test_commands_can_be_typed(title, monkeypatch):
    monkeypatch.setattr(Robot, "load", lambda text: text)  # a file of one's own is not there
    for line in "".join(blocks(TASKS[title], "sh")).splitlines():
        program, *words = shlex.split(line)
        assert program == "jumplab" and command_line.make_parser().parse_args(words).command == words[0]


@pytest.fixture
def names(tmp_path, monkeypatch):
    """Names that the page's first lines define, with a plan that tests share."""
    monkeypatch.chdir(tmp_path)
    (start,) = blocks(PREAMBLE, "python")
    imports, _, last = start.rstrip().rpartition("\n")
    assert last.startswith("plan = jl.plan(jl.JumpTask(")
    exec(compile(imports, "howto.md", "exec"), found := {})
    found["plan"] = jump(0.4, 0.2, method="direct")
    yield found
    plt.close("all")


@pytest.mark.parametrize("title", QUICK)
def test_what_needs_no_further_plan_runs(title, names, tmp_path):
    for code in blocks(TASKS[title], "python"):
        exec(compile(code, "howto.md", "exec"), names)
        for written in re.findall(r'"(\w+\.(?:png|csv))"', code):
            assert (tmp_path / written).stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.parametrize("title", SLOW)
def test_what_plans_runs(title, names):
    for code in blocks(TASKS[title], "python"):
        exec(compile(code, "howto.md", "exec"), names)
    assert "run" not in names or names["run"].landed, names["run"].reason


def test_path_and_momentum_of_a_plan_are_those_of_its_tape():
    """By Pinocchio, of the same states; angular momentum about the CoM, in the direction of +y."""
    plan = jump(0.4, 0.2, method="direct")
    model = plan.robot.model
    data = model.createData()
    for row in range(0, len(plan.t), 150):
        pin.computeCentroidalMomentum(model, data, plan.tape.q[row], plan.tape.v[row])
        np.testing.assert_allclose(plan.com[row], data.com[0], atol=1e-9)
        np.testing.assert_allclose(plan.com_velocity[row], data.hg.linear / plan.robot.total_mass, atol=1e-9)
        assert plan.L[row] == pytest.approx(data.hg.angular[1], abs=1e-6)


def test_lines_about_clips_can_be_read():
    compile(CODE[CLIPS], "howto.md", "exec")
