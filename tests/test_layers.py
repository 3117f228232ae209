"""The one-way imports that pyproject.toml declares; a module that is missing there fails too."""

from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parent.parent


def test_imports_go_one_way(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    code = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True)
    assert code == 0, capsys.readouterr().out


@pytest.fixture(scope="module")
def imports():
    """Module -> modules of the package that it imports, but for those that only a type checker reads."""
    graph = grimp.build_graph("jumplab", exclude_type_checking_imports=True, cache_dir=None)
    return {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}


def test_no_module_imports_itself_by_way_of_others(imports):
    assert len(list(TopologicalSorter(imports).static_order())) == len(imports) > 60


def test_rooms_are_few_and_their_chains_short(imports):
    """A sub-package is a folder at the top of the package; the files beside them are the front door."""
    rooms = {name: set() for name in {module.split(".")[1] for module in imports if module.count(".") > 1}}
    for module, others in imports.items():
        for other in others:
            own, its = (name.partition(".")[2].partition(".")[0] for name in (module, other))
            if own in rooms and its in rooms and own != its:
                rooms[own].add(its)
    length = {}
    for room in TopologicalSorter(rooms).static_order():
        length[room] = 1 + max((length[below] for below in rooms[room]), default=0)
    assert len(rooms) <= 14 and max(length.values()) <= 11, length
