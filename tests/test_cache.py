"""Problems kept between processes: the same functions, and no trust in a file that was touched."""

import numpy as np
import pytest
from test_solver import flat_guess, move
from test_transcription import random_point, toy

from jumplab.ocp import cache
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.nlp import Nlp


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("JUMPLAB_CACHE", str(tmp_path / "cache"))
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
    for name, arguments in {"nlp": (x, p), "grad_f": (x, p), "jac_g": (x, p), "hess_lag": (x, p, 1.0, lam),
                            "cost_parts": (x, p), "gauss_newton": (x, p)}.items():  # fmt: skip
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


def test_nothing_is_kept_unasked(place, counted, monkeypatch):
    cache.assembled(toy())
    assert not place.exists()
    monkeypatch.setenv("JUMPLAB_CACHE", "")
    assert cache.folder() is None and cache.assembled(toy(), "a").n_rows > 0
    assert len(counted) == 2


def test_a_folder_that_cannot_be_written_is_no_failure(monkeypatch, counted):
    monkeypatch.setenv("JUMPLAB_CACHE", "/dev/null/x")
    assert cache.assembled(toy(), "a").n_rows > 0 and counted == ["toy"]
