"""Problems kept between processes: the same functions, and no trust in a file that was touched."""

import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures_core import import_graph
from test_solver import flat_guess, move
from test_transcription import random_point, toy

from jumplab.ocp import cache, compiled
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.nlp import Nlp
from jumplab.robot.reach import reach, shipped_reach
from jumplab.stages.srmp import SrmpPlanner
from jumplab.stages.srmp import planner as srmp_planner
from jumplab.stages.srmp.planner import reach_of
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner

BEGIN = compiled._begin


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("JUMPLAB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "HOME", (*cache.HOME, "test_"))
    return tmp_path / "cache"


@pytest.fixture
def counted(monkeypatch):
    """How often a problem was assembled anew."""
    fresh = []

    class Counting(Assembled):
        def __init__(self, problem, elements=None):
            if elements is None:
                fresh.append(problem.name)
            super().__init__(problem, elements)

    monkeypatch.setattr(cache, "Assembled", Counting)
    return fresh


def test_what_is_kept_is_the_same(place, counted):
    first, again = (cache.assembled(toy(), "a") for _ in range(2))
    assert counted == ["toy"] and len(list(place.iterdir())) == 1
    x, p, rng = random_point(first, 3)
    lam = rng.normal(size=first.n_rows)
    functions = dict.fromkeys(("nlp", "grad_f", "jac_g", "cost_parts", "gauss_newton"), (x, p))
    for name, arguments in {**functions, "hess_lag": (x, p, 1.0, lam)}.items():
        one, two = (getattr(a, name).call(list(arguments)) for a in (first, again))
        for u, v in zip(one, two, strict=True):
            np.testing.assert_array_equal(u.full(), v.full())
    describe = [[(r.owner, r.term.name, r.node, r.component) for r in a.rows] for a in (first, again)]
    assert describe[0] == describe[1]
    assert [t.name for _, t in first.cost_terms] == [t.name for _, t in again.cost_terms]
    assert (first.size, first.n_rows, first.p_size) == (again.size, again.n_rows, again.p_size)


def test_solves_alike(place):
    one, two = (Nlp(move(), key="k").solve({"goal": 2.0}, flat_guess()) for _ in range(2))
    assert one.statistics.objective == pytest.approx(two.statistics.objective, rel=1e-12)
    assert one.constraint_report[0]["name"] == two.constraint_report[0]["name"]


@pytest.mark.parametrize("damage", ["empty", "cut", "bit", "words", "folder"])
def test_a_damaged_file_is_passed_over_and_replaced(place, counted, damage):
    cache.assembled(toy(), "a")
    (path,) = place.iterdir()
    data = path.read_bytes()
    if damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        flipped = data[:5000] + bytes([data[5000] ^ 1]) + data[5001:]
        path.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "bit": flipped, "words": b"good\nday\n"}[damage])
    assert cache.assembled(toy(), "a").n_rows > 0
    assert len(counted) == 2
    if damage != "folder":
        assert path.read_bytes() == data and [p.name for p in place.iterdir()] == [path.name]


def test_other_keys_are_other_files(place, counted):
    for key in ("a", "b", "a"):
        cache.assembled(toy(), key)
    assert len(counted) == 2 and len(list(place.iterdir())) == 2


def test_other_words_are_other_files(place, counted):
    """A term with another equation or place, a bound with another name: not what is on file."""
    problem, phase = toy(), toy().phases[1]
    (jerk,) = phase.terms
    for other in (replace(jerk, equation="ours"), replace(jerk, at="interval"), replace(jerk, name="push")):
        if other.at == "interval":
            other = replace(other, expression=lambda left, right, step: left.j)
        cache.assembled(replace(problem, phases=(problem.phases[0], replace(phase, terms=(other,)))), "a")
    cache.assembled(problem, "a")
    assert len(counted) == len(list(place.iterdir())) == 4


def test_what_a_problem_is_built_by_is_all_listed(bhr, place):
    """Whatever the modules of the problems import, at any depth, is in the key; and every name listed is there."""
    graph, package = import_graph(), Path(cache.__file__).parent.parent
    planners = SrmpPlanner(bhr, keep=True), WholeBodyPlanner(bhr, Mesh(3, 2, 4), refine=False, keep=True)
    assert len(list(place.glob("*.casadi"))) == 2
    roots = {Assembled.__module__} | {sys.modules[type(p).__module__].build_problem.__module__ for p in planners}
    roots |= {t.expression.__module__ for p in planners for _, t in p.nlp.problem.terms()}
    found = roots.union(*(graph.find_upstream_modules(root) for root in roots))
    listed = tuple(f"jumplab.{name}" for name in cache.BUILT_BY)
    assert len(found) > 15
    assert [m for m in sorted(found) if not any(m == name or m.startswith(f"{name}.") for name in listed)] == []
    for name in cache.BUILT_BY:
        place = package.joinpath(*name.split("."))
        assert place.is_dir() or place.with_suffix(".py").is_file(), name


def test_the_folder_is_the_systems(monkeypatch, tmp_path):
    monkeypatch.delenv("JUMPLAB_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.folder().name == "jumplab"
    assert sys.platform != "linux" or cache.folder() == tmp_path / "jumplab"


def test_nothing_is_kept_unasked(place, counted, monkeypatch):
    cache.assembled(toy())
    assert not place.exists()
    monkeypatch.setenv("JUMPLAB_CACHE", "")
    assert cache.folder() is None and cache.assembled(toy(), "a").n_rows > 0
    assert len(counted) == 2


def test_terms_from_elsewhere_are_not_kept(place, counted, monkeypatch):
    """A lambda of a notebook may change under the same name: then the file would be another problem's."""
    monkeypatch.setattr(cache, "HOME", ("jumplab.",))
    assert [cache.assembled(toy(), "a").n_rows > 0 for _ in range(2)] == [True, True]
    assert len(counted) == 2 and not place.exists()


def test_a_folder_that_cannot_be_written_is_no_failure(place, monkeypatch, counted):
    monkeypatch.setenv("JUMPLAB_CACHE", "/dev/null/x")
    assert cache.assembled(toy(), "a").n_rows > 0 and counted == ["toy"]


def test_reach_comes_back_to_the_last_bit(bhr, place, monkeypatch):
    """And from the file, not sampled again; a damaged file is passed over."""
    other = bhr.with_limits(effort=0.9)  # nothing is shipped for it
    made, sampled = reach_of(other, keep=True), []
    monkeypatch.setattr(srmp_planner, "reach", lambda robot: sampled.append(robot) or reach(robot))
    for name, value in vars(reach_of(other, keep=True)).items():
        np.testing.assert_array_equal(value, getattr(made, name))
        assert type(value) is type(getattr(made, name)) is type(getattr(reach(other), name))
    assert not sampled
    (file,) = place.glob("*.json")
    file.write_bytes(file.read_bytes()[:-5])
    assert reach_of(other, keep=True).to_json() == made.to_json() and len(sampled) == 1


def test_the_shipped_reach_is_what_sampling_gives(bhr):
    shipped, sampled = shipped_reach(bhr), reach(bhr)
    for name, value in vars(sampled).items():
        if name == "weakest":
            assert shipped.weakest == value
        else:
            np.testing.assert_allclose(getattr(shipped, name), value, rtol=1e-9, atol=1e-12)
    assert shipped_reach(bhr.with_limits(speed=0.9)) is None


# ------------------------------------------------------------------------------------------ as machine code


@pytest.fixture
def by_compiler(place, monkeypatch):
    """Compile in this process, at once, with the system's compiler."""
    if shutil.which("cc") is None:
        pytest.skip("this system has no C compiler")
    monkeypatch.setenv("JUMPLAB_CC", "cc")
    monkeypatch.setattr(compiled, "_begin", compiled.build)


def kept(place, ending):
    return [path for path in place.iterdir() if path.name.endswith(ending)]


def test_machine_code_gives_the_same_numbers(place, by_compiler):
    first = cache.assembled(toy(), "a")
    cache.assembled(toy(), "a")  # finds the file, and compiles it
    again = cache.assembled(toy(), "a")
    assert len(kept(place, ".so")) == len(kept(place, ".sum")) == 1 and not kept(place, ".working")
    assert all(f.is_a("External") for e in again.elements for f, *_ in e.made.values())
    x, p, rng = random_point(first, 3)
    lam = rng.normal(size=first.n_rows)
    functions = dict.fromkeys(("nlp", "grad_f", "jac_g", "cost_parts", "gauss_newton"), (x, p))
    for name, arguments in {**functions, "hess_lag": (x, p, 1.0, lam)}.items():
        for u, v in zip(*(getattr(a, name).call(list(arguments)) for a in (first, again)), strict=True):
            np.testing.assert_array_equal(u.full(), v.full())


def test_code_that_was_touched_is_not_loaded(place, by_compiler):
    for _ in range(2):
        cache.assembled(toy(), "a")
    code = kept(place, ".so")[0]
    sound = code.read_bytes()
    code.write_bytes(sound[:-100])
    again = cache.assembled(toy(), "a")  # compiles anew
    assert not any(f.is_a("External") for e in again.elements for f, *_ in e.made.values())
    assert compiled._sum(code.read_bytes()) == code.with_suffix(".sum").read_text()


@pytest.mark.parametrize("command", ["false", "no-such-compiler", "true"])
def test_a_compiler_that_fails_is_asked_once(place, by_compiler, monkeypatch, command):
    monkeypatch.setenv("JUMPLAB_CC", command)
    for _ in range(2):
        cache.assembled(toy(), "a")
    said = kept(place, ".failed")[0].read_text()
    assert command in said and not kept(place, ".so") and not kept(place, ".working")
    monkeypatch.setattr(compiled, "_begin", BEGIN)
    monkeypatch.setattr(compiled.subprocess, "Popen", lambda *a, **k: pytest.fail("it was asked again"))
    cache.assembled(toy(), "a")


def test_code_with_other_numbers_is_not_kept(place, by_compiler, monkeypatch):
    wrong = place.parent / "wrong"
    swap = r"s/=\((a[0-9]+)\+/=(\1-/"  # sums become differences
    wrong.write_text(f'#!/bin/sh\nsed -E \'{swap}\' "$8" > "$8.c"\nexec cc -O1 -fPIC -shared -o "$7" "$8.c" -lm\n')
    wrong.chmod(0o755)
    monkeypatch.setenv("JUMPLAB_CC", str(wrong))
    for _ in range(2):
        cache.assembled(toy(), "a")
    assert "other numbers" in kept(place, ".failed")[0].read_text() and not kept(place, ".so")


def test_the_compiler_works_beside_the_plan(place, monkeypatch):
    """In a process of its own, once; without a compiler nothing happens."""
    monkeypatch.setenv("JUMPLAB_CC", "")
    for _ in range(2):
        cache.assembled(toy(), "a")
    assert compiled.compiler() is None and len(list(place.iterdir())) == 1
    begun = []
    monkeypatch.setenv("JUMPLAB_CC", "cc -v")
    monkeypatch.setattr(compiled.subprocess, "Popen", lambda command, **how: begun.append((command, how)))
    for _ in range(3):
        cache.assembled(toy(), "a")
    (command, how), claim = begun[0], kept(place, ".working")
    assert len(begun) == len(claim) == 1 and compiled.compiler() == ["cc", "-v"]
    assert command[1:] == ["-m", "jumplab.ocp.compiled", str(claim[0].with_suffix(".casadi"))]
    assert how["start_new_session"] and how["stdout"] == how["stderr"] == compiled.subprocess.DEVNULL
    os.utime(claim[0], (0, 0))  # whoever claimed it is long gone
    cache.assembled(toy(), "a")
    assert len(begun) == 2
