"""Every public name has a docstring, and nothing has grown beyond what one reads in one go."""

import ast
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted((ROOT / "jumplab").rglob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))
FUNCTION_LINES, MODULE_LINES, CELL_LINES = 60, 350, 25
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef


def short(path):
    return str(path.relative_to(ROOT))


def public(node, prefix=""):
    """(name, node) of every public class, function and method; what a function defines inside is its own business."""
    for child in node.body:
        if isinstance(child, FUNCTIONS | ast.ClassDef) and not child.name.startswith("_"):
            yield prefix + child.name, child
            if isinstance(child, ast.ClassDef):
                yield from public(child, f"{prefix}{child.name}.")


def overrides(node):
    """A setter, or an overload: it is documented where it is defined first."""
    return any(getattr(d, "attr", getattr(d, "id", "")) in ("setter", "overload") for d in node.decorator_list)


def undocumented(tree):
    """Names without a docstring of at least two words; "" is the module itself."""
    nodes = [("", tree), *((name, node) for name, node in public(tree) if not overrides(node))]
    return [name for name, node in nodes if len((ast.get_docstring(node) or "").split()) < 2]


def long_functions(tree):
    """Functions, methods and those inside them that are too long: name -> lines."""
    functions = [node for node in ast.walk(tree) if isinstance(node, FUNCTIONS)]
    lines = {node.name: node.end_lineno - node.lineno + 1 for node in functions}
    return {name: n for name, n in lines.items() if n > FUNCTION_LINES}


@pytest.mark.parametrize("path", MODULES, ids=short)
def test_public_names_are_documented(path):
    missing = undocumented(ast.parse(path.read_text()))
    assert not missing, f"{short(path)}: {', '.join(n or 'the module' for n in missing)}"


@pytest.mark.parametrize("path", MODULES, ids=short)
def test_functions_and_modules_are_short(path):
    text = path.read_text()
    assert not long_functions(ast.parse(text)), short(path)
    assert len(text.splitlines()) <= MODULE_LINES, short(path)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=short)
def test_code_cells_are_short(path):
    cells = ["".join(c["source"]) for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    lengths = [len(source.splitlines()) for source in cells]
    assert max(lengths) <= CELL_LINES, lengths


def test_these_checks_can_fail():
    bad = '"""A module\'s docstring."""\nclass A:\n    """What A is for."""\n    def f(self):\n        pass\n'
    bad += "    def _private(self):\n        pass\ndef g():\n    '''Short'''\n" + "    x = 1\n" * FUNCTION_LINES
    tree = ast.parse(bad)
    assert undocumented(tree) == ["A.f", "g"] and list(long_functions(tree)) == ["g"]
    assert undocumented(ast.parse("x = 1")) == [""]
