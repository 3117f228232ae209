"""Public names have docstrings, nothing is longer than what one reads in one go, README and book leave nothing out."""

import ast
import importlib
import inspect
import json
import re
from pathlib import Path

import pytest
from paper import tuning

import jumplab as jl
from jumplab.auditing.report import LIMITS
from jumplab.cli import main as command_line
from jumplab.cli import notebooks
from jumplab.sim import Ranges
from jumplab.stages import joint_qp, srmp, whole_body
from jumplab.task import FRICTION

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted((ROOT / "jumplab").rglob("*.py"))
TESTS = sorted((ROOT / "tests").glob("*.py"))
PAPER = sorted((ROOT / "notebooks" / "paper").glob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob(notebooks.PATTERN))
README = (ROOT / "README.md").read_text(encoding="utf-8")
BOOK = ROOT / "notebooks" / "book"
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in sorted(BOOK.glob("*.md"))}
FUNCTION_LINES, CELL_LINES, README_WORDS = 60, 25, 1200
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


def unhinted(tree):
    """Public functions and methods with a parameter, or a result, of no stated type."""
    missing = []
    for name, node in public(tree):
        if isinstance(node, FUNCTIONS):
            a = node.args
            given = [x for x in (*a.posonlyargs, *a.args, *a.kwonlyargs) if x.arg not in ("self", "cls")]
            if node.returns is None or any(x.annotation is None for x in given):
                missing.append(name)
    return missing


def long_functions(tree):
    """Functions, methods and those inside them that are too long: name -> lines, the docstring's not counted."""
    lines = {}
    for node in ast.walk(tree):
        if isinstance(node, FUNCTIONS):
            docstring = node.body[0] if ast.get_docstring(node) is not None else None
            described = docstring.end_lineno - docstring.lineno + 1 if docstring else 0
            lines[node.name] = node.end_lineno - node.lineno + 1 - described
    return {name: n for name, n in lines.items() if n > FUNCTION_LINES}


def test_the_readme_is_short():
    assert len(README.split()) <= README_WORDS


def test_the_book_counts_the_lines_of_the_six_files_to_read():
    """Rounded to hundreds."""
    said = int(re.search(r"Six files of ([\d,]+) lines", PAGES["course"])[1].replace(",", ""))
    files = re.findall(r"^\d\. `(jumplab/\S+\.py)`", PAGES["course"], re.M)
    lines = sum(len((ROOT / name).read_text(encoding="utf-8").splitlines()) for name in files)
    assert len(files) == 6 and abs(said - lines) <= 50, lines


@pytest.mark.parametrize("path", MODULES, ids=short)
def test_public_names_are_documented(path):
    missing = undocumented(ast.parse(path.read_text()))
    assert not missing, f"{short(path)}: {', '.join(n or 'the module' for n in missing)}"


@pytest.mark.parametrize("path", MODULES, ids=short)
def test_public_functions_state_their_types(path):
    missing = unhinted(ast.parse(path.read_text()))
    assert not missing, f"{short(path)}: {', '.join(missing)}"


@pytest.mark.parametrize("path", [*MODULES, *TESTS], ids=short)
def test_functions_are_short(path):
    assert not long_functions(ast.parse(path.read_text())), short(path)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=short)
def test_code_cells_are_short(path):
    cells = ["".join(c["source"]) for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    lengths = [len(source.splitlines()) for source in cells]
    assert max(lengths) <= CELL_LINES, lengths


def everything_said(parser):
    """Help of a command and of those below it."""
    below = [p for a in parser._actions if isinstance(a.choices, dict) for p in a.choices.values()]
    return parser.format_help() + "".join(map(everything_said, below))


def test_the_book_knows_every_notebook_and_command():
    """And nothing that is not there: commands with options that exist."""
    assert {p.stem for p in NOTEBOOKS} == set(re.findall(r"^\| `(\d\d_\w+)` \|", PAGES["course"], re.M))
    lines = re.findall(r"^jumplab (\w+) +(.*?) *(?:#.*)?$", PAGES["commands"], re.M)
    assert {name for name, _ in lines} == {c.__name__ for c in command_line.COMMANDS}
    commands = next(a for a in command_line.make_parser()._actions if a.dest == "command").choices
    for name, options in lines:
        for option in re.findall(r"--[\w-]+", options):
            assert option in everything_said(commands[name]), (name, option)


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(BOOK.glob("*.md"))], ids=short)
def test_pages_point_at_what_exists_and_describe_their_pictures(page):
    """Links, and files named in code."""
    text = page.read_text(encoding="utf-8")
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^):]+)\)", text)]
    assert all((page.parent / link).exists() for link in links), links
    named = re.findall(r"`((?:jumplab|notebooks|tests|figures)/[\w./]*)`", text)
    named += re.findall(r"`(C[A-Z]+\.\w+)`", text)
    assert all((ROOT / name).exists() for name in named), named
    assert all(len(words.split()) >= 4 for words in re.findall(r"!\[([^]]*)\]", text)), "a picture without words"
    if page.name == "README.md":
        assert len(links) > 8 and len(named) >= 3
        assert all((ROOT / name).exists() for name in ("LICENSE", "CHANGELOG.md", ".pre-commit-config.yaml", ".ci/run"))


def test_the_book_says_the_friction_that_plans_obey():
    """Each stage's, at its nodes; and what the audit refuses between them is the least that trials simulate."""
    sentence = r"Stage 3 counts on a friction of ([\d.]+) at its nodes, stages 1 and 2 on ([\d.]+); "
    sentence += r"between nodes plans stay below ([\d.]+)"
    said = re.search(sentence, " ".join(PAGES["validity"].split()))  # lines may break anywhere
    assert {s().friction for s in (srmp.settings.SrmpSettings, joint_qp.settings.Limits)} == {FRICTION}
    limits = whole_body.Limits()
    assert float(said[1]) == limits.friction == limits.of_flip().friction < float(said[2])
    assert float(said[2]) == FRICTION
    assert float(said[3]) == LIMITS["friction used"].limit == Ranges().friction[0]


def test_these_checks_can_fail():
    bad = '"""A module\'s docstring."""\nclass A:\n    """What A is for."""\n    def f(self):\n        pass\n'
    bad += "    def _private(self):\n        pass\ndef g():\n    '''Short'''\n" + "    x = 1\n" * FUNCTION_LINES
    tree = ast.parse(bad)
    assert undocumented(tree) == ["A.f", "g"] and list(long_functions(tree)) == ["g"]
    assert undocumented(ast.parse("x = 1")) == [""]
    assert unhinted(tree) == ["A.f", "g"] and not unhinted(ast.parse("def f(x: int, *, y: str = '') -> None: ..."))


def riddles(tree):
    """Docstrings, of private names too, that begin with a question word instead of a noun or a verb."""
    nodes = (node for node in ast.walk(tree) if isinstance(node, FUNCTIONS | ast.ClassDef | ast.Module))
    docs = (ast.get_docstring(node) or "" for node in nodes)
    return [doc.partition("\n")[0] for doc in docs if re.match(r"(?:What|How|Where|Who|Whose|Why)\b", doc)]


def test_docstrings_begin_with_a_noun_or_a_verb():
    assert riddles(ast.parse('"""What it is."""\nclass A:\n    """Whether."""\n    def _f():\n        "How far."')) == [
        "What it is.",
        "How far.",
    ]
    found = {short(path): riddles(ast.parse(path.read_text(encoding="utf-8"))) for path in [*MODULES, *PAPER, *TESTS]}
    assert not {name: docs for name, docs in found.items() if docs}


def torn(doc):
    """Lines of a docstring's lists of parameters and attributes that the reference would take for one."""
    lines, inside = doc.splitlines(), ""
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if re.fullmatch("-{3,}", below):
            inside = line
        elif inside in ("Parameters", "Attributes") and re.match(r"[^\s-]", line):
            if not re.fullmatch(r"[\w*, `]+ : .+", line):
                yield line


def test_the_reference_has_no_sentence_for_a_parameter():
    assert list(torn("Short.\n\nParameters\n----------\nx, y : what\n    more\n\nAnd: more.")) == ["And: more."]
    found = []
    listed = {name.replace(".", "/") for name in re.findall(r"automodule:: ([\w.]+)", PAGES["api"])}
    for path in (path for path in MODULES if short(path).removesuffix(".py") in listed):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for name, node in [("", tree), *public(tree)]:
            found += [f"{short(path)} {name}: {line}" for line in torn(ast.get_docstring(node) or "")]
    assert found == []


def test_the_book_has_all_that_it_names():
    """Every module of the reference can be imported; every page is in the index."""
    modules = re.findall(r"automodule:: ([\w.]+)", PAGES["api"])
    assert len(modules) > 30 and all(importlib.import_module(name).__doc__ for name in modules)
    names = {name: getattr(jl, name) for name in jl.__all__}
    assert {getattr(x, "__module__", modules[0]) for x in names.values()} <= set(modules)
    listed = re.findall(r"^([a-z]+)$", PAGES["index"], re.M)
    assert sorted([*listed, "index"]) == sorted(PAGES)
    assert (ROOT / "figures" / "jump.gif").stat().st_size <= 1.5e6


def test_the_page_of_numbers_is_that_of_the_code():
    """``python -m paper.tuning`` in the folder of the notebooks makes it."""
    assert tuning.PAGE.read_text(encoding="utf-8") == tuning.page()


# words --------------------------------------------------------------------------------------------------------------
# Prose is plain: subject, verb, object. What these patterns find reads like a translation, or like a riddle.
NEVER = {
    "a verb of saying or bearing": r"\b(?:tells?|telling|bears?|borne|speaks? (?:of|for)|whom it)\b",
    "a word of praise or of conversation": r"\b(?:honest(?:y|ly)?|dear(?:er|est)|manieth|whom|somebody|anybody)\b",
    "a sub-package or a margin as a room": r"\brooms?\b",
    "a subject 'what' or 'who'": r"(?:^|(?<=[.;:!?] ))(?:What|Who|Whoever)\b[^.?!\n]*(?:[.!:;]|\n|$)",
    "a default that is called usual but for something": r"\busual but\b",
    "a riddle of nothing": r"\b(?:from nowhere|no room|Nothing jumps|weigh nothing|is no result)\b",
    "a path, a door, a judge": r"\b(?:code path|opens? the door|show themselves|only judge|do two physics)\b",
    "talk": r"\b(?:Sentences that|wrong name shows|speak alike|goes on where it|as many that)\b",
}
CLEAN = r"\bclean(?:ly|er|est)?\b"  # in prose: a plan passes the audit, ground is level


def prose():
    """(where, text) of all that people read: notebooks with captions and messages, README, book, help, docstrings."""
    for path in NOTEBOOKS:
        for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
            source = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                yield f"{path.name}[{number}]", source
            else:
                texts = (text for text in texts_of(source) if " " in text)  # others are keys
                yield from ((f"{path.name}[{number}] code", text) for text in texts)
    yield "README.md", README
    yield from ((f"{name}.md", page) for name, page in PAGES.items())
    for owner in (jl, jl.plots):
        yield from ((f"{name}'s help", inspect.getdoc(getattr(owner, name)) or "") for name in owner.__all__)
    yield "options.toml", (ROOT / "jumplab" / "cli" / "options.toml").read_text(encoding="utf-8")
    for path in MODULES:
        yield from ((short(path), text) for text in texts_of(path.read_text(encoding="utf-8"), sentences=True))
    for path in (*MODULES, *PAPER):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        docs = (ast.get_docstring(node) for node in nodes if isinstance(node, FUNCTIONS | ast.ClassDef | ast.Module))
        yield from ((short(path), re.sub(r"^(?:>>>|\.\.\.) .*$", "", doc, flags=re.M)) for doc in docs if doc)


def texts_of(source, *, sentences=False):
    """Texts in code, docstrings left out; ``sentences`` only those of several words."""
    tree = ast.parse(source)
    described = {id(node.body[0].value) for node in ast.walk(tree) if getattr(node, "body", None)
                 and isinstance(node.body, list) and isinstance(node.body[0], ast.Expr)}  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in described:
            if not sentences or node.value.count(" ") > 1:
                yield node.value


def test_prose_is_plain():
    found = [
        f"{where}: {kind}: ...{text[max(0, match.start() - 40) : match.end() + 20]!r}"
        for where, text in prose()
        for kind, pattern in NEVER.items()
        for match in re.finditer(pattern, text, re.M)
    ]
    assert not found, "\n".join(found)


def test_plans_pass_the_audit_and_are_not_called_clean():
    """In prose; the stored studies have a column of that name."""
    found = [f"{where}: {text[max(0, m.start() - 40) : m.end() + 20]!r}" for where, text in prose()
             if "code" not in where and not where.endswith(".py") for m in re.finditer(CLEAN, text)]  # fmt: skip
    assert not found, "\n".join(found)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name[:2])
def test_a_notebook_begins_with_its_result_and_says_when_its_comments_hold(path):
    """A title and the result, in at most 170 words; comments that hold for a default say so in one way."""
    first = "".join(json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"])
    assert first.startswith("# ") and "**Result.**" in first and len(first.split()) <= 170
    assert "default target" not in first or "The text comments on results for the default" in first


def reading(path):
    """(words, looks) of a notebook as it opens: what stands below a collapsed heading, and cells that are folded whole,
    do not count; a look is a cell whose code or output is in sight.
    """
    words = looks = 0
    closed = 9  # level of the collapsed heading above
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source, data = "".join(cell["source"]), cell["metadata"]
        if cell["cell_type"] == "markdown":
            level = len(source) - len(source.lstrip("#")) or 9
            closed = 9 if level <= closed < 9 else closed
            words += len(source.split()) * (closed == 9)
            closed = level if data.get("jp-MarkdownHeadingCollapsed") and closed == 9 else closed
        elif closed == 9:
            folded = data.get("jupyter", {})
            looks += not (folded.get("source_hidden") and folded.get("outputs_hidden"))
    return words, looks


def test_notebooks_are_short():
    """At 200 words and one look a minute: the first in five minutes, none in more than twenty, all in three hours."""
    minutes = {path.name[:2]: words / 200 + looks for path in NOTEBOOKS for words, looks in (reading(path),)}
    assert minutes["00"] <= 5 and max(minutes.values()) <= 20 and sum(minutes.values()) <= 180, minutes


def test_patterns_of_words_find_what_they_are_for():
    wrong = ("What is clean is played.", "The log tells: a foot.", "here they only judge", "Who wants to know reads.",
             "it has to know whom it speaks for", "rotors that weigh nothing", "by a second code path")  # fmt: skip
    for text in wrong:
        assert any(re.search(pattern, text, re.M) for pattern in NEVER.values()), text
    right = ("What feet do is a question?", "A key `clean` is a word.", "To see what binds, read the table.")
    for text in right:
        assert not any(re.search(pattern, text, re.M) for pattern in NEVER.values()), text
