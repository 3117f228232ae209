"""Mutants of modules whose word is trusted: one operator, number, name or sentence changed at a time, in memory.

``python tests/mutants.py audit exports checks claims`` runs the tests concerned on every mutant, each in a fork of one
warm process, and prints the share that one of them notices; ``--share 0.1 --seed 1`` takes a sample. No part of the
collected tests.
"""

from __future__ import annotations

import argparse
import ast
import copy
import functools
import importlib
import inspect
import os
import random
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

import pytest

AUDIT = tuple(f"jumplab.auditing.{part}" for part in ("audit", "contact", "dynamics", "motion", "replay", "report"))
# what is judged: modules, tests, and the least share of mutants that they must notice
JUDGED = {
    "audit": (AUDIT, ("tests/test_audit_amounts.py", "tests/test_audit_words.py"), 0.95),
    "exports": (
        ("jumplab.io.export", "jumplab.io.motion"),
        ("tests/test_export_amounts.py", "tests/test_motion.py"),
        0.95,
    ),
    "checks": (("jumplab.sim.checks",), ("tests/test_sim_amounts.py",), 0.90),
    "claims": (("paper.claims", "paper.tracking"), ("tests/test_claims.py", "-m", "not slow"), 1.0),
}
# where a part has a list, its mutants are these alone: module, what is changed, and into what
CHOSEN = {
    "claims": (
        ("paper.claims", "if claim.adopted else CHANGED if change else HOLDS", "if claim.adopted else HOLDS"),
        ("paper.claims", "agreed if ok else FAILS", "agreed"),
        ("paper.claims", "ok = all(least <= values[key] <= most", "ok = any(least <= values[key] <= most"),
        ("paper.claims", "ok = all(least <= values[key] <= most", "ok = all(values[key] <= most"),
        ("paper.claims", '"L off, rms, share of its peak": (0, 0.1)', '"L off, rms, share of its peak": (0, 0.2)'),
        ("paper.claims", '"share that hits the goal": (0.9, 1)', '"share that hits the goal": (0.8, 1)'),
        ("paper.claims", "first, later = (float(np.sqrt(np.mean(e**2)))", "first, later = (float(np.mean(abs(e)) / 2)"),
        ("paper.claims", "float(np.sqrt(np.mean(e**2)))", "float(np.sqrt(np.mean(e**2)) / 2)"),
        ("paper.claims", "return first, later", "return later, first"),
        ("paper.claims", "return error[start], error[~start]", "return error[~start], error[start]"),
        ("paper.claims", "start = run.t[down] < FIRST_S", "start = run.t[down] < 2 * FIRST_S"),
        ("paper.claims", "down = run.t < run.metrics.liftoff_s", "down = run.t < run.t[-1]"),
        ("paper.claims", "return float(np.degrees(pitch[push] - pitch[0]))", "return float(pitch[push] - pitch[0])"),
        ("paper.claims", "push = int(np.argmin(rate[: np.argmax(rate)]))", "push = int(np.argmin(rate))"),
        ("paper.claims", "SWING = 0.01", "SWING = 0.02"),
        ("paper.claims", "[: -round(LAST_S / STEP_S)]", "[:]"),
        ("paper.claims", "FIRST_S, LAST_S, STEADY_S = 0.1, 0.05, 0.02", "FIRST_S, LAST_S, STEADY_S = 0.1, 0.05, 0.04"),
        ("paper.claims", "np.diff(velocity, axis=0) / STEP_S - gravity", "np.diff(velocity, axis=0) / STEP_S"),
        ("paper.claims", "q[7:][moved] = folded[7:][moved]", "q[7:][moved] = folded[7:][moved] / 2"),
        ("paper.claims", "r.total_s / c.total_s for r, c in both", "r.alone_s / c.alone_s for r, c in both"),
        ("paper.claims", "SAME_COST = 1.01", "SAME_COST = 1.02"),
        ("paper.claims", 'np.degrees([*sagittal', "np.array([*sagittal"),
        ("paper.tracking", 'missed["L"]["rms"] / float', 'missed["L"]["rms"] / 2 / float'),
        ("paper.tracking", "np.abs(peaks.L).max()", "np.abs(peaks.L).mean()"),
        ("paper.tracking", "np.mean(np.sum((done - asked) ** 2, axis=0))", "np.mean((done - asked) ** 2)"),
        ("paper.tracking", "np.subtract(*ways), axis=1).max()", "np.subtract(*ways), axis=1).mean()"),
        ("paper.tracking", "return asked.launch, asked.flight", "return asked.flight, asked.launch"),
        ("paper.tracking", '"yes" if max(sizes) <= most', '"yes" if np.median(sizes) <= most'),
        ("paper.tracking", '"CoM off its path", 3.0, 100', '"CoM off its path", 9.0, 100'),
        ("paper.tracking", 'momentum = np.abs(missed["L"][:n]) / max', 'momentum = np.abs(missed["L"][:n]) / 2 / max'),
        ("paper.tracking", "np.mean(x**2)) / size)", "np.mean(x**2)) / size / 2)"),
        ("paper.tracking", '"touchdown_foot": float(foot[-1])', '"touchdown_foot": float(foot[0])'),
        ("paper.tracking", 'norm(missed["com"][:n], axis=1)', 'norm(missed["com"], axis=1)'),
    )
}  # fmt: skip
# mutants that do the same: what is changed, where in its line, the line; and why
SAME = {
    ("Sub", 44, "return max(foot.heel - x, x - foot.toe, abs(y - foot.center[1]) - foot.half_width)"): "center[1] is 0",
    ("Sub", 8, "speed = speed - np.cross(spin, arm)"): "a steady speed of the whole robot takes no force",
    ("Gt", 25, "for k in np.flatnonzero((result.foot_wrench[:-1, :, 2] > LOADED_N).any(axis=1)):"): "asked again below",
    ("Mult", 22, "corners += [place.act(half * signs) for signs in product((-1, 1), repeat=3)]"): "signs are 1 or -1",
}
SWAPS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.And: ast.Or,
         ast.Mod: ast.Div, ast.MatMult: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Or: ast.And,
         ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
         ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.USub: ast.UAdd}  # fmt: skip
PAIRS = (("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("any", "all"), ("floor", "ceil"))
GUARDS = ("strict", "initial")  # of lengths that differ, and of nothing at all: neither comes that far
NAMES = dict([*PAIRS, *((b, a) for a, b in PAIRS)])
NOTICED, BROKEN, SLOWEST_S = 1, 97, 120  # exit codes of a fork; mutants that take longer count as noticed


def changes(node: ast.AST) -> Iterator[tuple[str, Callable[[ast.AST], None]]]:
    """(what is changed, how) of each mutant of one node of a program."""
    sign, value = getattr(node, "op", None), getattr(node, "value", None)
    if type(sign) in SWAPS:
        yield type(sign).__name__, lambda n: setattr(n, "op", SWAPS[type(sign)]())
    elif isinstance(sign, ast.Not | ast.Invert):
        yield type(sign).__name__, lambda n: setattr(n, "operand", ast.UnaryOp(type(sign)(), n.operand))
    for i, sense in enumerate(getattr(node, "ops", ())):
        new = SWAPS[type(sense)]
        yield type(sense).__name__, functools.partial(lambda i, new, n: n.ops.__setitem__(i, new()), i, new)
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield "condition", lambda n: setattr(n, "test", ast.UnaryOp(ast.Not(), n.test))
    if isinstance(node, ast.Constant) and isinstance(value, bool | int | float | str):
        new = f"XX{value}XX" if isinstance(value, str) else not value if isinstance(value, bool) else value + 1
        yield repr(value), lambda n: setattr(n, "value", new)
    for field in ("id", "attr"):
        if (name := getattr(node, field, None)) in NAMES:
            yield name, functools.partial(lambda f, new, n: setattr(n, f, new), field, NAMES[name])
    if isinstance(node, ast.keyword) and node.arg not in GUARDS:
        yield f"{node.arg}=", lambda n: setattr(n, "value", ast.Constant(None))


def chosen(part: str) -> Iterator[Mutant]:
    """The mutants that :data:`CHOSEN` has for a part: one passage of a module each, which stands there once."""
    for name, old, new in CHOSEN[part]:
        module = importlib.import_module(name)
        text = inspect.getsource(module)
        if text.count(old) != 1:
            raise ValueError(f"{name}: {old!r} stands there {text.count(old)} times; renew the list of mutants")
        row = text[: text.index(old)].count("\n") + 1
        tops = [n for n in ast.parse(text).body if isinstance(n, ast.FunctionDef) and n.lineno <= row <= n.end_lineno]
        first = min([n.lineno, *(d.lineno for d in n.decorator_list)]) if (n := next(iter(tops), None)) else 0
        yield Mutant(module, f"{name}:{row} {new}", first, functools.partial(ast.parse, text.replace(old, new)))


@dataclass(frozen=True)
class Mutant:
    """One change of a module: where and what it is, the function that it is in, and what makes the program."""

    module: ModuleType
    name: str
    function: int  # first line of the outermost function; 0 outside of all
    program: Callable[[], ast.Module]


def mutants(module: ModuleType) -> Iterator[Mutant]:
    """Every mutant of a module, but for annotations, docstrings and guards."""
    text = inspect.getsource(module)
    tree, lines = ast.parse(text), text.splitlines()
    passive = [n.value for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
    passive += [n.value for n in ast.walk(tree) if isinstance(n, ast.keyword) and n.arg in GUARDS]
    passive += [a for n in ast.walk(tree) for f in ("annotation", "returns") if (a := getattr(n, f, None))]
    alone = {id(n) for a in passive for n in ast.walk(a)}
    inside = {}
    for n in (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)):  # outer ones first
        first = min([n.lineno, *(d.lineno for d in n.decorator_list)])
        inside |= {row: first for row in range(n.lineno, n.end_lineno + 1) if row not in inside}
    for at, node in enumerate(ast.walk(tree)):
        for which, (what, _) in enumerate(changes(node) if id(node) not in alone else ()):
            row = getattr(node, "lineno", 0) or node.value.lineno
            line = lines[row - 1].strip()
            column = getattr(node, "col_offset", 0) - lines[row - 1].index(line)
            name = f"{module.__name__}:{row} [{what} at {column}] {line}"
            if (what, column, line) in SAME:
                continue
            yield Mutant(module, name, inside.get(row, 0), functools.partial(build, tree, at, which))


def build(tree: ast.Module, at: int, which: int) -> ast.Module:
    """A copy of a program with one change of its node number ``at``."""
    new = copy.deepcopy(tree)
    node = list(ast.walk(new))[at]
    list(changes(node))[which][1](node)
    return ast.fix_missing_locations(new)


def install(module: ModuleType, tree: ast.Module) -> None:
    """Let everyone who imported from a module see the mutant: functions get its code, the rest its objects."""
    usual, mutant = dict(vars(module)), {"__name__": module.__name__, "__file__": module.__file__}
    exec(compile(tree, module.__file__, "exec"), mutant)
    others = [m for name, m in sys.modules.items() if name.startswith(("jumplab", "paper", "test_", "fixtures"))]
    for name, new in mutant.items():
        old = usual.get(name)
        ours = getattr(old, "__module__", module.__name__) == module.__name__
        if name.startswith("__") or old is None or not ours or isinstance(old, ModuleType) or renew(old, new):
            continue
        if isinstance(old, type):  # objects that are there already have its methods, too
            for method, code in vars(new).items():
                renew(vars(old).get(method), code)
        for other in others:
            if vars(other).get(name) is old:
                setattr(other, name, new)


def renew(old: object, new: object) -> bool:
    """Give a function, or what a property or a class method is made of, another's code; whether it is one."""
    for part in ("fget", "func", "__func__"):
        old, new = getattr(old, part, old), getattr(new, part, new)
    if not isinstance(old, FunctionType) or old.__code__.co_freevars != new.__code__.co_freevars:
        return False
    old.__code__, old.__defaults__, old.__kwdefaults__ = new.__code__, new.__defaults__, new.__kwdefaults__
    return True


class Judge:
    """A plugin of pytest that runs the tests it collected on every mutant, each in a fork of the warm process.

    Only tests that call the function concerned are run.
    """

    def __init__(self, mutants: list[Mutant]):
        self.mutants, self.missed = mutants, []

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Instead of running the tests once: first without a mutant, then with each."""
        called = {}
        for item in session.items:
            called[item] = set()
            sys.setprofile(lambda frame, *_, seen=called[item]: seen.add(place(frame.f_code)))
            failure = failed(session, [item])
            sys.setprofile(None)
            if failure:
                raise RuntimeError(f"{item.nodeid} fails without any mutant")
        for count, m in enumerate(self.mutants):
            if count % 100 == 0:
                print(f"  {count} of {len(self.mutants)}, {len(self.missed)} not noticed", flush=True)
            at = (m.module.__file__, m.function)
            items = [item for item in session.items if not m.function or at in called[item]]
            if not noticed(session, items, m):
                self.missed.append(m.name)
                print(f"  not: {m.name}", flush=True)
        return True


def place(code: CodeType) -> tuple[str, int]:
    """File and first line of a function."""
    return code.co_filename, code.co_firstlineno


def failed(session: pytest.Session, items: list[pytest.Item]) -> bool:
    """Whether one of these tests fails; the rest is left out then."""
    for item, after in zip(items, [*items[1:], None], strict=True):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
        if session.testsfailed:
            return True
    return False


def noticed(session: pytest.Session, items: list[pytest.Item], mutant: Mutant) -> bool:
    """Whether one of the tests fails on a mutant, or it cannot be loaded, or does not end."""
    sys.stdout.flush()
    if (child := os.fork()) == 0:
        signal.alarm(SLOWEST_S)
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        code = BROKEN
        try:
            tree = mutant.program()
            compile(tree, "mutant", "exec")
            code = NOTICED
            install(mutant.module, tree)
            code = NOTICED if failed(session, items) else 0
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == BROKEN:
        raise RuntimeError(f"{mutant.name} is no program")
    return code != 0


def main() -> int:
    """Print what is noticed; 1 if it is less than it must be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="+", choices=JUDGED)
    parser.add_argument("--share", type=float, default=1.0, help="of the mutants, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="mutants whose line or place contains this text")
    asked, short = parser.parse_args(), False
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "notebooks"))  # of the package "paper"
    for part in asked.parts:
        modules, tests, least = JUDGED[part]
        every = chosen(part) if part in CHOSEN else chain(*map(mutants, map(importlib.import_module, modules)))
        found = [x for x in every if asked.only in x.name]
        judge = Judge(random.Random(asked.seed).sample(found, round(asked.share * len(found))))
        if pytest.main(["-q", "-s", "-p", "no:cacheprovider", "--tb=short", *tests], plugins=[judge]):
            return 2
        count, missed = len(judge.mutants), len(judge.missed)
        share = 1 - missed / count
        print(f"{part}: {count - missed} of {count} mutants noticed, {100 * share:.1f} %", flush=True)
        short |= share < least
    return int(short)


if __name__ == "__main__":
    sys.exit(main())
