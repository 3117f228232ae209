"""Studies on file, and the code that made them: each row stands below a stamp, and what is older is shown as old."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import platform
import tomllib
from collections import ChainMap, Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jumplab
from jumplab.io.files import open_log, write_file
from jumplab.io.folder import PLAN, sha256, versions
from jumplab.robot import Robot

Row = dict[str, Any]
# sub-packages whose code decides what a study finds; a reading, a picture or a command does not
ROOMS = ("robot", "models", "ocp", "stages", "auditing", "control", "sim", "studies")
STAMP = "stamp"
NAMED = 3  # changed files in a line


# ---------------------------------------------------------------------------------------------- stamps


@cache
def code() -> dict[str, str]:
    """File of the library, ``sub-package/name.py`` -> digest of what it does: comments, docstrings, layout and names of
    local variables do not count.
    """
    root = Path(jumplab.__file__).parent
    files = sorted(p for room in ROOMS for p in (root / room).rglob("*") if p.suffix in (".py", ".toml"))
    return {path.relative_to(root).as_posix(): digest(path) for path in files}


def digest(path: Path) -> str:
    """Eight digits that change with the code of a Python file, or with the values of a TOML file.

    Comments, docstrings and names of local variables may change; names of arguments may not: calls can have them.
    """
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".toml":
        parts = repr(tomllib.loads(text))
    else:
        tree = ast.parse(text)
        _leave_docstrings_out(tree)
        _Numbers().visit(tree)
        parts = ast.dump(tree)
    return hashlib.sha256(parts.encode()).hexdigest()[:8]


def _leave_docstrings_out(tree: ast.AST) -> None:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            if isinstance(getattr(body[0].value, "value", None), str):
                del body[0]


class _Numbers(ast.NodeVisitor):
    """Puts numbers in place of names of local variables, in each scope in the order of their first appearance."""

    def __init__(self):
        self.names = ChainMap()  # name -> number, or the name where it stays; a map for each scope, the inner first
        self.numbers = count()

    def visit_Name(self, node: ast.Name) -> None:
        node.id = self.names.get(node.id, node.id)

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) -> None:
        body = node.body if isinstance(node.body, list) else [node.body]
        for part in ast.iter_child_nodes(node):  # decorators, defaults, annotations: of the scope around it
            if part not in body:
                self.visit(part)
        stay = {part.arg for part in ast.iter_child_nodes(node.args) if isinstance(part, ast.arg)}
        self._enter(body, stay | _more_than_variables(body))
        for part in body:
            self.visit(part)
        self._leave()

    visit_AsyncFunctionDef = visit_Lambda = visit_FunctionDef

    def visit_ListComp(self, node: ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp) -> None:
        first = node.generators[0]
        around = first.iter  # of the scope around it
        self.visit(around)
        first.iter = None
        self._enter([part.target for part in node.generators])
        self.generic_visit(node)
        self._leave()
        first.iter = around

    visit_SetComp = visit_DictComp = visit_GeneratorExp = visit_ListComp

    def _enter(self, parts: list[ast.AST], stay: Iterable[str] = ()) -> None:
        bound = dict.fromkeys(name for part in parts for name in _bound(part))
        self.names = self.names.new_child({name: next(self.numbers) for name in bound} | {name: name for name in stay})

    def _leave(self) -> None:
        self.names = self.names.parents


def _bound(part: ast.AST) -> Iterator[str]:
    """Variables that a part of a scope binds, without those of scopes inside it."""
    if isinstance(part, ast.Name) and not isinstance(part.ctx, ast.Load):
        yield part.id
    if not isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef):
        inner = [part.iter, *part.ifs] if isinstance(part, ast.comprehension) else ast.iter_child_nodes(part)
        for child in inner:
            yield from _bound(child)


def _more_than_variables(body: list[ast.AST]) -> set[str]:
    """Names inside a function that are global, nonlocal, of functions, classes, their attributes, modules or errors."""
    stay = set()
    for part in (part for line in body for part in ast.walk(line)):
        if isinstance(part, ast.Global | ast.Nonlocal):
            stay.update(part.names)
        elif isinstance(part, ast.ClassDef):
            stay.update(name for line in part.body for name in _bound(line))
        other = (getattr(part, field, None) for field in ("asname", "name", "rest"))
        stay.update(name.split(".")[0] for name in other if name)
    return stay


def stamp(folder: str | Path | None = None, robot: Robot | None = None) -> Row:
    """Stamp of rows that are made now: code, versions, machine; plan of a result folder and robot, where a study is of
    one.
    """
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    made = {"code": code(), "version": versions()["jumplab"], "machine": machine}
    if folder is not None:
        made["plan"] = sha256(Path(folder) / PLAN)[:12]
    if robot is not None:
        made["robot"] = f"{robot.name} {robot.hash}"
    return made


def age(stamps: Iterable[Mapping[str, Any] | None]) -> str:
    """Number of rows, each given by its stamp or None, that the present code made, and the changes since the others.

    A file that came later does not count: it can only matter through a change of one that was there.
    """
    stamps, now = list(stamps), code()
    unknown, old, changed = stamps.count(None), 0, Counter()
    for made in filter(None, stamps):
        files = [file for file, was in made["code"].items() if now.get(file) != was]
        old += bool(files)
        changed.update(files)
    words = [f"{len(stamps) - old - unknown} of {len(stamps)} rows were made by the present code"]
    if old:
        named = sorted(changed)[:NAMED]
        more = f" and {len(changed) - NAMED} more" if len(changed) > NAMED else ""
        words.append(f"{old} are older: {', '.join(named)}{more} have changed since")
    if unknown:
        words.append(f"{unknown} are older, without a record of their code")
    return "; ".join(words)


# ---------------------------------------------------------------------------------------------- files


def lines(path: Path) -> list[tuple[Row, Row | None]]:
    """Rows of a log, each with the stamp above it, if there is one; ``null`` for rows from before there were stamps."""
    found, made = [], None
    for line in path.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        if STAMP in row:
            made = row[STAMP]
        else:
            found.append((row, made))
    return found


def rows(path: Path, say: Callable[[str], Any] = print) -> list[Row]:
    """Rows of a log, after a line that says how old they are: every notebook that shows them has it."""
    found = lines(path)
    say(f"{path.name}: {age(made for _, made in found)}")
    return [row for row, _ in found]


@contextmanager
def keep(path: Path, key: Callable[[Row], Hashable], **of: Any) -> Iterator[SimpleNamespace]:
    """A log that can be stopped and started again: ``done`` (key -> row) and ``add(row)``, on the disk at once.

    The stamp (of what :func:`stamp` takes) goes above the first row that is added.
    """

    def entry(line: Row) -> tuple[Hashable, Row]:
        if STAMP in line:
            raise ValueError("no row")
        return key(line), line

    with open_log(path, "study", entry) as log:
        stamped = False

        def add(row: Row) -> None:
            nonlocal stamped
            if not stamped:
                log.add({STAMP: stamp(**of)})
                stamped = True
            log.add(row)
            log.done[key(row)] = row

        yield SimpleNamespace(done=log.done, add=add)


def write(path: Path, found: Iterable[Row], **of: Any) -> None:
    """A log as a whole, of a study that is made in one go."""
    text = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in ({STAMP: stamp(**of)}, *found))
    write_file(path, text.encode())


def table(path: Path, say: Callable[[str], Any] = print) -> Any:
    """Content of a table by :func:`write_table`, or of one without a stamp, after a line on its age."""
    found = json.loads(path.read_text(encoding="utf-8"))
    made = found.get(STAMP) if isinstance(found, dict) else None
    inner = found if made is None else found["table"]
    counted = inner["rows"] if isinstance(inner, dict) and "rows" in inner else inner
    say(f"{path.name}: {age([made] * len(counted))}")
    return inner


def write_table(path: Path, found: Any, **of: Any) -> None:
    """A table of any shape as JSON, below a stamp."""
    text = json.dumps({STAMP: stamp(**of), "table": found}, ensure_ascii=False, indent=1)
    write_file(path, f"{text}\n".encode())


if __name__ == "__main__":
    for log in sorted(Path(__file__).parent.glob("*.json*")):
        (rows if log.suffix == ".jsonl" else table)(log)
