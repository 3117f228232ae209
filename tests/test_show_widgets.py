"""Counted loops and sliders: there while somebody looks, and not a trace of them otherwise."""

import pytest
from paper import explore
from paper import widgets as live

from jumplab.errors import JumplabError
from jumplab.io.progress import told_to
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


def test_nobody_looks(unwatched, monkeypatch):
    assert not live.watched()
    monkeypatch.setenv(live.SESSION, "")  # as the runner sets it
    assert not live.watched()


def test_items_are_counted(watched, capfd):
    said = []
    with told_to(lambda *what: said.append(what)):
        assert list(live.progress("ab", "letters")) == ["a", "b"]
    assert live.watched() and said == [("letters", 1, 2), ("letters", 2, 2)] and capfd.readouterr() == ("", "")


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
