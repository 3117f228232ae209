"""Bars and sliders: there while somebody looks, and not a trace of them otherwise."""

import contextlib
import gc
import sys
import types

import pytest
from paper import explore
from paper import widgets as live

from jumplab.errors import JumplabError
from jumplab.show.style import Picture
from jumplab.task import JumpTask


@pytest.fixture
def unwatched(monkeypatch):
    monkeypatch.delenv(live.SESSION, raising=False)


@pytest.fixture
def watched(monkeypatch):
    monkeypatch.setenv(live.SESSION, "notebooks/02_srmp.ipynb")


@pytest.fixture
def planner():
    from fixtures_core import srmp_planner

    return srmp_planner()


def test_nobody_looks(unwatched, capfd, monkeypatch):
    assert not live.watched()
    assert list(live.progress(range(5), "x")) == [0, 1, 2, 3, 4]
    assert capfd.readouterr() == ("", "")
    monkeypatch.setenv(live.SESSION, "")  # as the runner sets it
    assert not live.watched()


@pytest.mark.parametrize("failing", [False, True])
def test_somebody_looks(watched, monkeypatch, failing):
    """A bar counts, and its place is empty afterwards, even if the work fails on the way."""
    shown = []

    def display(thing, display_id=False):
        shown.append(thing)
        return types.SimpleNamespace(update=lambda data, raw: shown.append(data))

    monkeypatch.setattr("IPython.display.display", display)
    assert live.watched()
    done = []
    with contextlib.suppress(ZeroDivisionError):
        for letter in live.progress(iter("ab"), "letters", total=2):
            assert shown[0].children[1].max == 2 and "letters" in shown[0].children[0].value
            done.append(letter)
            assert not failing or 1 / 0
    gc.collect()  # where the loop broke off, the generator ends when it is collected
    assert done == (["a"] if failing else ["a", "b"]) and shown[1:] == [{"text/plain": ""}]


def test_a_terminal_has_a_plain_bar(unwatched, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert list(live.progress([1, 2, 3], "numbers")) == [1, 2, 3]
    assert "numbers" in capsys.readouterr().err


def test_explore_without_reader_is_a_picture(unwatched, planner, capsys):
    assert isinstance(explore.explore_stage1(planner, JumpTask(0.5, 0.5)), Picture)
    with pytest.raises(JumplabError) as refusal:
        planner.plan(JumpTask(0.5, 1.4))
    capsys.readouterr()
    assert explore.explore_stage1(planner, JumpTask(0.5, 1.4)) is None
    assert capsys.readouterr().out == f"{refusal.value}\n"


def test_explore_with_reader_solves_what_the_sliders_ask(watched, planner, monkeypatch):
    asked = []
    monkeypatch.setattr(explore, "_picture_or_refusal", lambda planner, task: asked.append(task))
    box = explore.explore_stage1(planner, JumpTask(0.5, 0.4))
    (distance, height, turn), picture = box.children[0].children, box.children[1]
    assert type(picture).__name__ == "Output"
    assert [(t.distance_m, t.height_m, t.rotation_rad) for t in asked] == [(0.5, 0.4, 0.0)]
    distance.value, height.value = 0.8, 0.3
    turn.value = "backflip"
    assert asked[-1] == JumpTask(0.8, 0.3, rotation_rad=explore.TURNS["backflip"])
    far = explore.explore_stage1(planner, JumpTask(2.5, 1.0)).children[0].children  # beyond the usual
    assert (far[0].max, far[1].max) == (2.5, 1.0)
