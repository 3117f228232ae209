"""The front door: few names, loaded when first used, documented, and six lines from a target to a robot that stands."""

import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from fixtures_core import refused

import jumplab as jl

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("robot", "io", "models", "stages", "control", "sim", "studies", "show")  # those that load their names lazily
HEAVY = ("numpy", "casadi", "pinocchio", "pybullet", "matplotlib", "scipy", "cvxpy")


def loaded_by(code):
    """Names of the top-level packages that a new process has imported after ``code``."""
    code += "; import sys; print(*sorted({m.partition('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    return set(done.stdout.split())


def test_importing_the_package_imports_nothing_else():
    assert not loaded_by("import jumplab") & {*HEAVY, "jumplab.task"}


def test_planning_needs_neither_engine_nor_pictures():
    code = "import jumplab as jl; jl.Planner, jl.JumpTask, jl.Robot, jl.Term, jl.Scene.flat(), jl.Perturbation"
    assert not loaded_by(code) & {"pybullet", "matplotlib"}


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_is_light_and_has_what_it_lists(room):
    assert not loaded_by(f"import jumplab.{room}") & set(HEAVY)
    module = import_module(f"jumplab.{room}")
    assert module.__all__ and all(hasattr(module, name) for name in module.__all__)


@pytest.mark.parametrize("name", jl.__all__)
def test_every_name_is_there_and_documented(name):
    value = getattr(jl, name)
    assert len((inspect.getdoc(value) or "").split()) > 5, name
    assert name in dir(jl)


def test_the_names_are_few_and_an_unknown_one_is_refused_with_those_that_exist():
    assert len(jl.__all__) <= 25  # three write a contact schedule, two take motions of others, one seeks records
    with pytest.raises(AttributeError, match=r"module 'jumplab' has no attribute 'paln'; it has JumpTask, Contacts, "):
        _ = jl.paln


def test_it_has_a_version_and_ships_its_types():
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*", jl.__version__)
    assert (ROOT / "jumplab" / "py.typed").is_file()


def readme_lines():
    """The README's first block of Python."""
    return re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)[1]


@pytest.mark.slow
def test_six_lines_lead_to_a_robot_that_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = readme_lines()
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 7  # the import, and six
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    plan, run = names["plan"], names["run"]
    assert run.landed, run.reason
    assert abs(run.metrics.foot_distance_m - plan.task.distance_m) < 0.02
    again, shown = jl.load("out")
    assert again.summary == plan.summary | {"manifest": again.summary["manifest"], "audit": plan.audit.line()}
    assert (again.task, again.method, again.robot.hash) == (plan.task, plan.method, plan.robot.hash)
    np.testing.assert_array_equal(again.tape.tau, plan.tape.tau)
    np.testing.assert_array_equal(shown.q, run.q)
    assert jl.audit(again).passed
    assert again.planned_distance_m == plan.planned_distance_m and again.weights == plan.weights
    assert jl.view(again, shown).save("page.html").stat().st_size > 1e5


def test_wrong_things_are_refused_in_a_sentence(tmp_path):
    for call in (jl.audit, jl.simulate, jl.view):
        assert "must be a JumpPlan, got 'plan'" in refused(call, "plan", by=jl.errors.InputError)
    assert "there is no folder" in refused(jl.load, tmp_path / "nothing", by=jl.errors.InputError)
    assert "must be a JumpPlan" in refused(jl.save, tmp_path / "out", None, by=jl.errors.InputError)
    assert not (tmp_path / "out").exists()
