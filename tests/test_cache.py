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

from jumplab.ocp import assembly, cache, compiled
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.derivatives import ElementBuilder
from jumplab.ocp.nlp import Nlp
from jumplab.ocp.problem import Problem, layouts
from jumplab.robot.reach import reach, shipped_reach
from jumplab.stages.srmp import SrmpPlanner
from jumplab.stages.srmp import build_problem as srmp_problem
from jumplab.stages.srmp import planner as srmp_planner
from jumplab.stages.srmp.planner import reach_of
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner
from jumplab.stages.whole_body.problem import Schedule

BEGIN = compiled._begin
PARTS = len(ElementBuilder(toy(), layouts(toy())).parts)  # of the toy: each has its own file


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("JUMPLAB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "HOME", (*cache.HOME, "test_"))
    monkeypatch.setattr(cache, "KNOWN", {})
    return tmp_path / "cache"


@pytest.fixture
def counted(monkeypatch):
    """(owner, place) of every part that was made anew."""
    fresh = []

    class Counting(ElementBuilder):
        def build(self, part):
            fresh.append((part.owner, part.place))
            return super().build(part)

    for module in (cache, assembly):
        monkeypatch.setattr(module, "ElementBuilder", Counting)
    return fresh


def later(problem: Problem, key: str | None = "a") -> Assembled:
    """The problem as a process assembles it that has not seen any part of it."""
    cache.KNOWN.clear()
    return cache.assembled(problem, key)


def test_what_is_kept_is_the_same(place, counted):
    first, again = (later(toy()) for _ in range(2))
    assert len(counted) == len(set(counted)) == len(list(place.iterdir())) == PARTS
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


def test_one_process_makes_and_reads_a_part_once(place, counted):
    first = cache.assembled(toy(), "a")
    for path in place.iterdir():
        path.unlink()
    again = cache.assembled(toy(), "a")
    assert len(counted) == PARTS and not list(place.iterdir())
    pairs = zip(first.elements, again.elements, strict=True)
    assert all(one.function("rows")[0] is other.function("rows")[0] for one, other in pairs)


def test_problems_that_share_a_part_share_its_file(place, counted):
    """Another phase, on another mesh, adds but its own part; the numbers of the old ones stay."""
    problem = toy()
    short = replace(problem.phases[0], intervals=7)
    longer = replace(problem.phases[1], name="three")
    later(problem)
    other = later(replace(problem, phases=(short, problem.phases[1], longer), joints=()))
    assert counted[PARTS:] == [("three", "interval")]
    assert len(list(place.iterdir())) == PARTS + 1
    assert other.layouts["one"].nodes.shape[0] == 8


def test_solves_alike(place):
    one, two = (_solved() for _ in range(2))
    assert one.statistics.objective == pytest.approx(two.statistics.objective, rel=1e-12)
    assert one.constraint_report[0]["name"] == two.constraint_report[0]["name"]


def _solved():
    cache.KNOWN.clear()
    return Nlp(move(), key="k").solve({"goal": 2.0}, flat_guess())


@pytest.mark.parametrize("damage", ["empty", "cut", "bit", "words", "folder"])
def test_a_damaged_file_is_passed_over_and_replaced(place, counted, damage):
    later(toy())
    path, *others = sorted(place.iterdir(), key=lambda path: -path.stat().st_size)
    data = path.read_bytes()
    if damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        flipped = data[:5000] + bytes([data[5000] ^ 1]) + data[5001:]
        path.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "bit": flipped, "words": b"good\nday\n"}[damage])
    assert later(toy()).n_rows > 0
    assert len(counted) == PARTS + 1 and counted[-1] in counted[:-1]
    if damage != "folder":
        assert path.read_bytes() == data and set(place.iterdir()) == {path, *others}


def test_other_keys_are_other_files(place, counted):
    for key in ("a", "b", "a"):
        later(toy(), key)
    assert len(counted) == len(list(place.iterdir())) == 2 * PARTS


def test_other_words_are_other_files(place, counted):
    """A term with another equation or place, a bound with another name: not what is on file."""
    problem, phase = toy(), toy().phases[1]
    (jerk,) = phase.terms
    for other in (replace(jerk, equation="ours"), replace(jerk, at="interval"), replace(jerk, name="push")):
        if other.at == "interval":
            other = replace(other, expression=lambda left, right, step: left.j)
        later(replace(problem, phases=(problem.phases[0], replace(phase, terms=(other,)))))
    later(problem)
    # that phase has another part each time; the terms that join phases do not depend on its terms
    assert [part for part in counted if part == ("two", "interval")] == [("two", "interval")] * 4
    assert len(counted) == len(list(place.iterdir())) == PARTS + 3


def test_what_a_problem_is_built_by_is_all_listed(bhr, place):
    """Whatever the modules of the problems import, at any depth, is in the key; and every name listed is there."""
    graph, package = import_graph(), Path(cache.__file__).parent.parent
    mesh = Mesh(3, 2, 4)
    planners = (
        SrmpPlanner(bhr, keep=True),
        WholeBodyPlanner(bhr, mesh, keep=True),
        WholeBodyPlanner(bhr, mesh, tracking=True, keep=True),
    )
    parts = sum(len(p.nlp.assembled.elements) for p in planners)  # which builds them
    assert len(list(place.glob("*.casadi"))) == parts
    roots = {Assembled.__module__, Schedule.__module__, srmp_problem.__module__}
    roots |= {t.expression.__module__ for p in planners for _, t in p.nlp.problem.terms()}
    found = roots.union(*(graph.find_upstream_modules(root) for root in roots))
    listed = tuple(f"jumplab.{name}" for name in cache.BUILT_BY)
    assert len(found) > 15
    assert [m for m in sorted(found) if not any(m == name or m.startswith(f"{name}.") for name in listed)] == []
    for name in cache.BUILT_BY:
        place = package.joinpath(*name.split("."))
        assert place.is_dir() or place.with_suffix(".py").is_file(), name
    assert len(set(cache.BUILT_BY)) == len(cache.BUILT_BY)


def test_the_folder_is_the_systems(monkeypatch, tmp_path):
    monkeypatch.delenv("JUMPLAB_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.folder().name == "jumplab"
    assert sys.platform != "linux" or cache.folder() == tmp_path / "jumplab"


def test_nothing_is_kept_unasked(place, counted, monkeypatch):
    cache.assembled(toy())
    assert not place.exists()
    monkeypatch.setenv("JUMPLAB_CACHE", "")
    assert cache.folder() is None and later(toy()).n_rows > 0
    assert len(counted) == 2 * PARTS


def test_terms_from_elsewhere_are_not_kept(place, counted, monkeypatch):
    """A lambda of a notebook may change under the same name: then the file would be another problem's."""
    monkeypatch.setattr(cache, "HOME", ("jumplab.",))
    assert [cache.assembled(toy(), "a").n_rows > 0 for _ in range(2)] == [True, True]
    assert len(counted) == 2 * PARTS and not place.exists()


def test_a_folder_that_cannot_be_written_is_no_failure(place, monkeypatch, counted):
    monkeypatch.setenv("JUMPLAB_CACHE", "/dev/null/x")
    assert later(toy()).n_rows > 0 and len(counted) == PARTS


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
    first = later(toy())
    later(toy())  # finds the files, and compiles them
    again = later(toy())
    assert len(kept(place, ".so")) == len(kept(place, ".sum")) == PARTS
    assert not kept(place, ".working")
    assert all(f.is_a("External") for e in again.elements for f, *_ in e.made.values())
    x, p, rng = random_point(first, 3)
    lam = rng.normal(size=first.n_rows)
    functions = dict.fromkeys(("nlp", "grad_f", "jac_g", "cost_parts", "gauss_newton"), (x, p))
    for name, arguments in {**functions, "hess_lag": (x, p, 1.0, lam)}.items():
        for u, v in zip(*(getattr(a, name).call(list(arguments)) for a in (first, again)), strict=True):
            np.testing.assert_array_equal(u.full(), v.full())


def test_one_compiler_makes_the_code_of_all_parts(place, by_compiler, monkeypatch):
    monkeypatch.setattr(compiled, "_begin", lambda path: None)
    later(toy())
    compiled.build_all(kept(place, ".casadi")[-1])
    assert len(kept(place, ".so")) == PARTS and not kept(place, ".working")


def test_code_that_was_touched_is_not_loaded(place, by_compiler):
    for _ in range(2):
        later(toy())
    code = kept(place, ".so")[0]
    sound = code.read_bytes()
    code.write_bytes(sound[:-100])
    again = later(toy())  # compiles that part anew
    used = [all(f.is_a("External") for f, *_ in e.made.values()) for e in again.elements]
    assert used.count(False) == 1 and used.count(True) == PARTS - 1
    assert compiled._sum(code.read_bytes()) == code.with_suffix(".sum").read_text()


@pytest.mark.parametrize("command", ["false", "no-such-compiler", "true"])
def test_a_compiler_that_fails_is_asked_once(place, by_compiler, monkeypatch, command):
    monkeypatch.setenv("JUMPLAB_CC", command)
    for _ in range(2):
        later(toy())
    said = [path.read_text() for path in kept(place, ".failed")]
    assert len(said) == PARTS and all(command in text for text in said)
    assert not kept(place, ".so") and not kept(place, ".working")
    monkeypatch.setattr(compiled, "_begin", BEGIN)
    monkeypatch.setattr(compiled.subprocess, "Popen", lambda *a, **k: pytest.fail("it was asked again"))
    later(toy())


def test_code_with_other_numbers_is_not_kept(place, by_compiler, monkeypatch):
    wrong = place.parent / "wrong"
    swap = r"s/=\((a[0-9]+)\+/=(\1-/"  # sums become differences
    wrong.write_text(f'#!/bin/sh\nsed -E \'{swap}\' "$8" > "$8.c"\nexec cc -O1 -fPIC -shared -o "$7" "$8.c" -lm\n')
    wrong.chmod(0o755)
    monkeypatch.setenv("JUMPLAB_CC", str(wrong))
    for _ in range(2):
        later(toy())
    said = [path.read_text() for path in kept(place, ".failed")]
    assert said and all("other numbers" in text for text in said)
    assert len(kept(place, ".so")) == PARTS - len(said)  # of parts without a sum


class Compiler:
    """A process that compiles nothing, and ends when it is told to."""

    def __init__(self, command, **how):
        self.command, self.how, self.ended = command, how, False

    def poll(self):
        return 0 if self.ended else None


def test_the_compiler_works_beside_the_plan(place, monkeypatch):
    """In a process of its own, one part at a time; without a compiler nothing happens."""
    monkeypatch.setenv("JUMPLAB_CC", "")
    for _ in range(2):
        later(toy())
    assert compiled.compiler() is None and len(list(place.iterdir())) == PARTS
    begun = []

    def begin(command, **how):
        begun.append(Compiler(command, **how))
        return begun[-1]

    monkeypatch.setattr(compiled, "_working", [])
    monkeypatch.setenv("JUMPLAB_CC", "cc -v")
    monkeypatch.setattr(compiled.subprocess, "Popen", begin)
    for _ in range(3):
        later(toy())
    (first,), claim = begun, kept(place, ".working")
    assert len(claim) == 1 and compiled.compiler() == ["cc", "-v"]
    assert first.command[1:] == ["-m", "jumplab.ocp.compiled", str(claim[0].with_suffix(".casadi"))]
    assert first.how["start_new_session"]
    assert first.how["stdout"] == first.how["stderr"] == compiled.subprocess.DEVNULL
    first.ended = True  # the next part is its turn
    later(toy())
    assert len(begun) == len(kept(place, ".working")) == 2
    for compiler in begun:
        compiler.ended = True
    os.utime(claim[0], (0, 0))  # whoever claimed it is long gone
    later(toy())
    assert len(begun) == 3 and begun[-1].command == first.command
