"""The line of a cell that takes long: only in an open notebook, and gone when the cell has ended."""

import io
import threading
import time
import types

import pytest

from jumplab.io.progress import tell
from jumplab.show import waiting


@pytest.fixture
def shell(monkeypatch):
    """A notebook's shell, with the lines that it was shown and the calls that wait for a cell."""
    shown, calls = [], {}
    update = lambda data, raw: shown.append(data["text/plain"])  # noqa: E731
    display = lambda data, raw, display_id: update(data, raw) or types.SimpleNamespace(update=update)  # noqa: E731
    import IPython.display

    monkeypatch.setattr(IPython.display, "display", display)
    monkeypatch.setattr(waiting, "FIRST_S", 0.0)
    monkeypatch.setattr(waiting, "REDRAW_S", 0.0)
    events = types.SimpleNamespace(register=calls.__setitem__)
    shell = types.SimpleNamespace(events=events, calls=calls, kernel=object(), shown=shown)
    monkeypatch.setitem(waiting.sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setenv("JPY_SESSION_NAME", "n.ipynb")
    return shell


def test_a_cell_shows_what_is_done_and_leaves_nothing(shell):
    waiting.show_waiting()
    tell("before any cell")
    shell.calls["pre_run_cell"](None)
    tell("done", 3, 7)
    tell("audit")
    shell.calls["post_run_cell"](None)
    tell("after it")
    assert [line for line in shell.shown if len(line) > 8] == ["done 3 of 7, 0 s", "done 3 of 7, audit, 0 s"]
    assert shell.shown[-1] == ""


def test_work_that_says_nothing_for_long_is_shown_all_the_same(shell, monkeypatch):
    """A solve of half a minute is one call, after a word that came too early to be shown."""
    before = threading.active_count()
    monkeypatch.setattr(waiting, "FIRST_S", 0.05)
    monkeypatch.setattr(waiting, "TICK_S", 0.01)
    waiting.show_waiting()
    shell.calls["pre_run_cell"](None)
    tell("solving")
    assert not any(shell.shown)
    until = time.monotonic() + 30
    while shell.shown.count("solving, 0 s") < 2 and time.monotonic() < until:
        time.sleep(0.01)
    shell.calls["post_run_cell"](None)
    assert shell.shown.count("solving, 0 s") >= 2 and shell.shown[-1] == ""
    assert threading.active_count() == before


def test_a_quick_cell_shows_nothing(shell, monkeypatch):
    monkeypatch.setattr(waiting, "FIRST_S", 5.0)
    waiting.show_waiting()
    shell.calls["pre_run_cell"](None)
    tell("audit")
    shell.calls["post_run_cell"](None)
    assert not any(shell.shown)


def test_only_an_open_notebook_has_one_and_only_one(shell, monkeypatch):
    monkeypatch.setenv("JPY_SESSION_NAME", "")  # as the runner says it
    waiting.show_waiting()
    assert not shell.calls
    monkeypatch.setenv("JPY_SESSION_NAME", "n.ipynb")
    waiting.show_waiting()
    first = dict(shell.calls)
    waiting.show_waiting()
    assert shell.calls == first != {}
    del shell.kernel  # a shell on a terminal
    del shell._jumplab_waiting
    waiting.show_waiting()
    assert shell.calls == first


def test_a_terminal_sees_a_line_that_is_gone_in_the_end(monkeypatch):
    out = io.StringIO()
    for name in ("FIRST_S", "REDRAW_S"):
        monkeypatch.setattr(waiting, name, 0.0)
    monkeypatch.setattr(waiting.sys, "stderr", out)
    with waiting.on_terminal("view"):
        tell("audit")
    assert out.getvalue() == ""
    out.isatty = lambda: True
    with waiting.on_terminal("view"):
        tell("audit")
    lines = [line.strip() for line in out.getvalue().split("\r")]
    assert "jumplab view: audit, 0 s" in lines and lines[-2:] == ["", ""]
