"""Studies on file carry the code that made them; rows of another code are shown as old."""

import json
import re

import pytest
from paper import logs


@pytest.fixture
def now(monkeypatch):
    """The code of now, which a test may change."""
    code = {f"{room}/a.py": "00000000" for room in logs.ROOMS}
    monkeypatch.setattr(logs, "code", lambda: dict(code))
    return code


def test_a_digest_changes_with_code_alone(tmp_path):
    module, numbers = tmp_path / "a.py", tmp_path / "a.toml"
    written = {
        "as it is": ('"""Doc."""\n\n\ndef f(x):\n    """Doc."""\n    return x + 1\n', "a = 1  # one\n"),
        "the same": ('"""Other."""\ndef f(x):  # new\n    return (x + 1)\n', "a=1\n"),
        "a number": ('"""Doc."""\n\n\ndef f(x):\n    """Doc."""\n    return x + 2\n', "a = 1  # one\n"),
        "a limit": ('"""Doc."""\n\n\ndef f(x):\n    """Doc."""\n    return x + 1\n', "a = 2  # one\n"),
    }
    found = {}
    for name, (code, values) in written.items():
        module.write_text(code)
        numbers.write_text(values)
        found[name] = logs.digest(module), logs.digest(numbers)
    assert found["as it is"] == found["the same"] and len(set(found.values())) == 3, found
    assert {file.split("/")[0] for file in logs.code()} == set(logs.ROOMS)
    assert {"stages/planner.py", "auditing/limits.toml"} <= set(logs.code())


LOCALS = """
def f(x, most=1):
    total = x * 2

    def g(y):
        part = total + y.size
        return [part for part in range(part) if part < most]

    while more := g(x):
        total += sum(more)
    return (lambda z: z + total)(x)
"""
SHARED = """
def f():
    total = 0

    def g():
        nonlocal total
        global count
        total += 1
        count = total

    return g
"""
SAME_LOCALS = [
    (r"total", "amount"),
    (r"part", "more"),
    (r"more", "part"),
    (r"part for part in range\(part\) if part", "k for k in range(part) if k"),
]
OTHER_CODE = {
    "a constant": (r"2", "3"),
    "an operator": (r"\*", "+"),
    "an attribute": (r"size", "ndim"),
    "an argument": (r"most", "largest"),
    "a lambda's argument": (r"z", "w"),
    "a global": (r"sum", "max"),
    "another local": (r"z \+ total", "z + more"),
    "a local, now a global": (r"part\)", "parts)"),
    "another scope's variable": (r"range\(part\)", "range(total)"),
}


def test_names_of_locals_do_not_count(tmp_path):
    def digest(code):
        (tmp_path / "a.py").write_text(code)
        return logs.digest(tmp_path / "a.py")

    renamed = {digest(re.sub(rf"\b{old}", new, LOCALS)) for old, new in SAME_LOCALS}
    assert renamed == {digest(LOCALS)}
    others = [digest(re.sub(old, new, LOCALS)) for old, new in OTHER_CODE.values()]
    assert len({digest(LOCALS), *others}) == len(OTHER_CODE) + 1, dict(zip(OTHER_CODE, others, strict=True))
    assert digest(SHARED.replace("count", "number")) != digest(SHARED)


def test_rows_of_other_code_are_told(tmp_path, now, bhr):
    """A study that goes on after a change: each row belongs to the stamp above it."""
    path, said = tmp_path / "log.jsonl", []
    path.write_text('{"n": 0}\n')
    for n, room in ((1, "sim"), (2, "stages"), (3, "stages")):
        with logs.keep(path, lambda row: row["n"], robot=bhr) as log:
            assert sorted(log.done) == list(range(n))
            log.add({"n": n})
        now[f"{room}/a.py"] = f"0000000{n}"
    now["stages/a.py"] = "00000002"
    now["stages/new.py"] = "00000001"  # none of the rows can have used it
    assert logs.rows(path, said.append) == [{"n": n} for n in range(4)]
    assert said == [
        "log.jsonl: 1 of 4 rows were made by the present code; 2 are older: sim/a.py, stages/a.py have changed since; "
        "1 are older, without a record of their code"
    ]
    made = logs.lines(path)[-1][1]
    assert made["robot"] == f"bhr {bhr.hash}" and made["code"]["sim/a.py"] == "00000001" and "cores" in made["machine"]
    with path.open("a") as file:
        file.write('{"stamp": null}\n{"n": 4}\n')
    assert [made is None for _, made in logs.lines(path)] == [True, False, False, False, True]
    with logs.keep(path, lambda row: row["n"]):
        pass
    assert len(path.read_text().splitlines()) == 9  # nothing was added: no stamp either


def test_whole_logs_and_tables(tmp_path, now):
    said = []
    (tmp_path / "plan.npz").write_bytes(b"tape")
    logs.write(tmp_path / "a.jsonl", [{"n": 1}, {"n": 2}], folder=tmp_path)
    logs.write_table(tmp_path / "b.json", {"bhr": 1})
    (tmp_path / "c.json").write_text(json.dumps([1, 2, 3]))
    assert logs.rows(tmp_path / "a.jsonl", said.append) == [{"n": 1}, {"n": 2}]
    assert logs.lines(tmp_path / "a.jsonl")[0][1]["plan"] == logs.sha256(tmp_path / "plan.npz")[:12]
    assert logs.table(tmp_path / "b.json", said.append) == {"bhr": 1}
    assert logs.table(tmp_path / "c.json", said.append) == [1, 2, 3]
    assert said == [
        "a.jsonl: 2 of 2 rows were made by the present code",
        "b.json: 1 of 1 rows were made by the present code",
        "c.json: 0 of 3 rows were made by the present code; 3 are older, without a record of their code",
    ]
