"""The bar of a cell that takes long: only in an open notebook, and gone when the cell has ended."""

import types

import pytest

from jumplab.io.progress import tell
from jumplab.show import waiting


class Events:
    def __init__(self):
        self.calls = {}

    def register(self, name, call):
        self.calls[name] = call


@pytest.fixture
def shell(monkeypatch):
    shown = []

    class Handle:
        def display(self, data, raw):
            shown.append(data["text/plain"])

        update = display

    import IPython.display

    monkeypatch.setattr(IPython.display, "DisplayHandle", Handle)
    monkeypatch.setattr(waiting, "FIRST_S", 0.0)
    monkeypatch.setattr(waiting, "REDRAW_S", 0.0)
    return types.SimpleNamespace(events=Events(), kernel=object(), shown=shown)


def test_a_cell_shows_what_is_done_and_leaves_nothing(shell):
    waiting.Waiting(shell)
    tell("before any cell")
    shell.events.calls["pre_run_cell"](None)
    tell("done", 3, 7)
    tell("audit")
    shell.events.calls["post_run_cell"](None)
    tell("after it")
    assert shell.shown == ["done 3 of 7, 0 s", "done 3 of 7, audit, 0 s", ""]


def test_a_quick_cell_shows_nothing(shell, monkeypatch):
    monkeypatch.setattr(waiting, "FIRST_S", 5.0)
    waiting.Waiting(shell)
    shell.events.calls["pre_run_cell"](None)
    tell("audit")
    shell.events.calls["post_run_cell"](None)
    assert shell.shown == []


def test_only_an_open_notebook_has_one(shell, monkeypatch):
    assert waiting.show_waiting() is None
    python = types.SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(waiting.sys.modules, "IPython", python)
    monkeypatch.setenv("JPY_SESSION_NAME", "")  # as the runner says it
    assert waiting.show_waiting() is None
    monkeypatch.setenv("JPY_SESSION_NAME", "n.ipynb")
    assert waiting.show_waiting() is waiting.show_waiting() is not None
