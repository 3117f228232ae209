"""Problems kept between processes: the same functions, and no trust in a file that was touched."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures_core import import_graph
from test_transcription import random_point, toy

from jumplab.ocp import cache
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.derivatives import Formulator, parts
from jumplab.ocp.problem import Problem
from jumplab.stages.srmp import SrmpPlanner
from jumplab.stages.srmp import build_problem as srmp_problem
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner
from jumplab.stages.whole_body.problem import Schedule

PARTS = len(parts(toy()))  # each has its own file


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

    class Counting(Formulator):
        def formulas(self, part):
            fresh.append((part.owner, part.place))
            return super().formulas(part)

    monkeypatch.setattr(cache, "Formulator", Counting)
    return fresh


def later(problem: Problem, key: str | None = "a") -> Assembled:
    """The problem as a process assembles it that has not seen any part of it."""
    cache.KNOWN.clear()
    return Assembled(problem, key)


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
    describe = [[(r.owner, r.term.name, r.index.tolist()) for r in a.rows] for a in (first, again)]
    assert describe[0] == describe[1]
    assert [t.name for _, t in first.cost_terms] == [t.name for _, t in again.cost_terms]
    assert (first.size, first.n_rows, first.p_size) == (again.size, again.n_rows, again.p_size)


def test_one_process_makes_and_reads_a_part_once(place, counted):
    first = Assembled(toy(), "a")
    for path in place.iterdir():
        path.unlink()
    again = Assembled(toy(), "a")
    assert len(counted) == PARTS and not list(place.iterdir())
    assert all(x is y for x, y in zip(first.functions, again.functions, strict=True))


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
    count = sum(len(p.nlp.assembled.parts) for p in planners)  # which builds them
    assert len(list(place.iterdir())) >= count
    roots = {Formulator.__module__, Schedule.__module__, srmp_problem.__module__}
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
    Assembled(toy())
    assert not place.exists()
    monkeypatch.setenv("JUMPLAB_CACHE", "")
    assert cache.folder() is None and later(toy()).n_rows > 0
    assert len(counted) == 2 * PARTS


def test_terms_from_elsewhere_are_not_kept(place, counted, monkeypatch):
    """A lambda of a notebook may change under the same name: then the file would be another problem's."""
    monkeypatch.setattr(cache, "HOME", ("jumplab.",))
    assert [Assembled(toy(), "a").n_rows > 0 for _ in range(2)] == [True, True]
    assert len(counted) == 2 * PARTS and not place.exists()


def test_a_folder_that_cannot_be_written_is_no_failure(place, monkeypatch, counted):
    monkeypatch.setenv("JUMPLAB_CACHE", "/dev/null/x")
    assert later(toy()).n_rows > 0 and len(counted) == PARTS
