"""The runner on small notebooks made here, then the package's own: how they are written, and that they run."""

import ast
import json
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import nbformat
import numpy as np
import pytest
from fixtures_core import refused
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from paper import running
from PIL import Image
from test_store import names

from jumplab.cli import notebooks
from jumplab.errors import InputError, JumplabError, SolverError
from jumplab.io import folder as store
from jumplab.robot.files import SHIPPED

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / "notebooks").glob(notebooks.PATTERN))
EXPECTED = {"00_overview", "01_models", "02_srmp", "03_joint_space_mapping", "04_whole_body", "05_simulation",
            "06_experiments", "07_your_robot", "08_flips", "09_chained_jumps", "10_benchmark", "11_claims",
            "12_your_own_terms", "13_three_dimensions", "14_run_ups", "15_records", "16_clips"}  # fmt: skip
# of the whole chain in the tests: every cell runs, on fewer targets and robots
SMALL = dict(fast=True, samples=50, grid=2, targets=1, trials=1, runs=1, again=1, robots=1)
STEMS = sorted(EXPECTED | {p.stem for p in SOURCES})
PARAMETERS = """distance_m: float = 1.0  # [m]
height_m: float = 0.5
robot: str = "bhr"
out: str = "x"
figures: str = "y"
n: int = 1"""
CHECK = "from jumplab.cli.notebooks import check_parameters\ncheck_parameters(globals())"
RECORD = """
import json, pathlib, sys, os
pathlib.Path(out, "seen_%s.json").write_text(json.dumps({
    "distance_m": distance_m, "n": n, "python": sys.executable, "prefix": sys.prefix}))
pathlib.Path(figures, "figure_%s.png").write_bytes(b"png")
"""


def make_notebook(folder, name, *cells, parameters=PARAMETERS):
    """Write notebooks/NAME.ipynb with the parameters, the check and further code cells."""
    head = new_code_cell(parameters, metadata={"tags": ["parameters"]})
    nb = new_notebook(cells=[new_markdown_cell("# Title"), head, *(new_code_cell(c) for c in (CHECK, *cells))])
    nb.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    path = folder / "notebooks" / f"{name}.ipynb"
    path.parent.mkdir(exist_ok=True)
    nbformat.write(nb, path)
    return path


# ------------------------------------------------------------------------------------------ the runner


def test_chain_in_an_odd_place_under_this_very_python(odd_folder, monkeypatch):
    """Two notebooks pass results on; a kernel called python3 that is another program is not used."""
    bogus = odd_folder / "jupyter" / "kernels" / "python3"
    bogus.mkdir(parents=True)
    spec = {"argv": ["/bin/false", "{connection_file}"], "display_name": "x", "language": "python"}
    (bogus / "kernel.json").write_text(json.dumps(spec))
    monkeypatch.setenv("JUPYTER_PATH", str(odd_folder / "jupyter"))
    monkeypatch.setenv("HOME", "/nonexistent")
    second = "import pathlib\nassert pathlib.Path(out, 'seen_0.json').exists()" + RECORD % (1, 1)
    chain = [make_notebook(odd_folder, "00_first", RECORD % (0, 0)), make_notebook(odd_folder, "01_second", second)]
    monkeypatch.chdir("/")
    report = running.run_notebooks({"distance_m": 0.8, "n": 3}, notebooks=chain, progress=False)
    assert report.notebooks == ("00_first", "01_second") and report.wall_s > 0
    assert report.out == odd_folder / "executed" and report.figures == report.out / "figures"
    seen = json.loads((report.out / "seen_1.json").read_text())
    assert seen == {"distance_m": 0.8, "n": 3, "python": sys.executable, "prefix": sys.prefix}
    assert names(report.out) == ["figures", "notebooks", "seen_0.json", "seen_1.json"]
    assert names(report.out / "notebooks") == ["00_first.ipynb", "01_second.ipynb"]
    assert names(report.figures) == ["figure_0.png", "figure_1.png"]
    assert names(odd_folder) == ["executed", "jupyter", "notebooks"]


def test_figures_that_look_the_same_stay(tmp_path):
    """A picture is replaced, with its PDF and caption, where it shows; a caption alone where its words changed, not
    just the versions in its last line; other files and damaged pictures always.
    """
    work, out, figures = (tmp_path / name for name in ("work", "out", "figures"))
    for folder in (work / "figures", work / "result", out, figures):
        folder.mkdir(parents=True)
    old = np.full((100, 100, 3), 255, np.uint8)
    for name, rows in {"same": 0, "faint": 1, "other": 20}.items():
        new = old.copy()
        new[:rows] = 250 if name == "faint" else 0
        Image.fromarray(old).save(figures / f"{name}.png")
        Image.fromarray(new).save(work / "figures" / f"{name}.png")
    for folder, text in ((figures, "old"), (work / "figures", "new")):
        for name in ("faint.pdf", "other.txt", "damaged.png", "alone.txt"):
            (folder / name).write_text(text)
        (folder / "faint.txt").write_text(f"A caption, {text}.\nMade with a package.\n")
        (folder / "same.txt").write_text(f"A caption.\nMade with a package, {text}.\n")
    running.publish(work, out, figures)
    texts = {path.name: path.read_text() for path in figures.iterdir() if path.suffix in (".txt", ".pdf")}
    assert texts.pop("same.txt").endswith("old.\n") and texts.pop("faint.txt").startswith("A caption, new.")
    assert texts == {"faint.pdf": "old", "other.txt": "new", "alone.txt": "new"}
    assert np.asarray(Image.open(figures / "other.png"))[0].max() == 0
    assert (figures / "damaged.png").read_text() == "new"


@pytest.mark.parametrize(
    ("cell", "kind", "sentence"),
    [
        ("from jumplab.errors import InputError\nraise InputError('too far')", InputError, "too far"),
        ("from jumplab.errors import SolverError\nraise SolverError('stuck')", SolverError, "stuck"),
        ("x = 1\nassert x == 2, f'x is {x},\\nnot 2'", JumplabError, "AssertionError: not 2"),
        ("x = 1\nassert x == 2", JumplabError, "AssertionError: assert x == 2"),
        ("import os\nos._exit(3)", JumplabError, "its Python process died"),
    ],
)
def test_failing_notebook_stops_the_chain(tmp_path, cell, kind, sentence):
    """One sentence with notebook and cell, of the class that the cell raised; what was there before stays."""
    out, figures = tmp_path / "out", tmp_path / "figures"
    for folder in (out, figures):
        folder.mkdir()
        (folder / "old").write_text("old")
    chain = [
        make_notebook(tmp_path, "00_bad", RECORD % (0, 0), cell),
        make_notebook(tmp_path, "01_never", RECORD % (1, 1)),
    ]
    with pytest.raises(JumplabError) as e:
        running.run_notebooks(notebooks=chain, out=out, figures=figures, progress=False)
    assert type(e.value) is kind
    assert "notebook 00_bad.ipynb" in str(e.value) and sentence in str(e.value) and "\n" not in str(e.value)
    assert names(figures) == ["old"]
    if "died" in sentence:
        assert names(out) == ["old"]
    else:
        assert "cell In [5]" in str(e.value)
        assert names(out) == ["failed", "old"] and names(out / "failed") == ["00_bad.ipynb"]


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        (
            {"distance": 1.0},
            "unknown notebook parameter 'distance'; the notebooks have distance_m, figures, height_m, n, out, robot",
        ),
        ({"out": "x"}, "the runner sets the notebook parameter 'out' itself; pass the folder as its argument out"),
        ({"distance_m": "far"}, "parameter distance_m must be a number, got 'far'"),
        ({"distance_m": True}, "parameter distance_m must be a number, got True"),
        ({"distance_m": float("nan")}, "parameter distance_m must be finite, got nan"),
        ({"distance_m": 50}, "distance = 50 m is outside -3 ... 3 m"),
        ({"robot": ""}, "parameter robot must be a name or a path, got ''"),
        ({"robot": "asimo"}, f"robot 'asimo': neither a shipped robot ({', '.join(SHIPPED)}) nor a readable TOML file"),
    ],
)
def test_bad_parameters_are_refused_before_anything_runs(tmp_path, parameters, sentence):
    chain = [make_notebook(tmp_path, "00_first", RECORD % (0, 0))]
    assert refused(running.run_notebooks, parameters, notebooks=chain, progress=False) == sentence
    assert names(tmp_path) == ["notebooks"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"out": "/dev/null/x"}, "'/dev/null/x' cannot be written"),
        ({"figures": "/proc/x"}, "'/proc/x' cannot be written"),
    ],
)
def test_unwritable_folders_are_refused_before_anything_runs(tmp_path, arguments, sentence):
    chain = [make_notebook(tmp_path, "00_first", RECORD % (0, 0))]
    with pytest.raises(InputError, match=sentence):
        running.run_notebooks(notebooks=chain, progress=False, **arguments)
    assert names(tmp_path) == ["notebooks"]


def test_read_only_checkout_sends_everything_to_out(tmp_path, monkeypatch):
    """Whoever runs the tests may be allowed everything, so the refusal is played by ensure_writable."""
    checkout, out = tmp_path / "checkout", tmp_path / "out"
    checkout.mkdir()
    chain = [make_notebook(checkout, "00_first", RECORD % (0, 0))]
    real = store.ensure_writable

    def refuse_checkout(folder):
        if checkout in Path(folder).parents:
            raise InputError("read-only")
        return real(folder)

    monkeypatch.setattr(store, "ensure_writable", refuse_checkout)
    report = running.run_notebooks(notebooks=chain, out=out, progress=False)
    assert report.figures == out / "figures"
    assert names(out) == ["figures", "notebooks", "seen_0.json"] and names(checkout) == ["notebooks"]
    assert "read-only" in refused(running.run_notebooks, notebooks=chain, progress=False)


def test_a_second_chain_in_one_folder_is_refused(tmp_path):
    chain = [make_notebook(tmp_path, "00_first", RECORD % (0, 0))]
    (tmp_path / "executed" / "notebooks").mkdir(parents=True)
    with store.locked(tmp_path / "executed" / "notebooks"), pytest.raises(InputError, match="another jumplab"):
        running.run_notebooks(notebooks=chain, progress=False)


@pytest.mark.skipif(os.name == "nt", reason="no ipc")
def test_kernels_need_no_ports(tmp_path):
    """Two that start at once could be given the same free one."""
    cell = "from ipykernel import get_connection_info\nassert get_connection_info(unpack=True)['transport'] == 'ipc'"
    paths = [make_notebook(tmp_path, f"0{k}_x", cell) for k in range(3)]
    report = running.run_notebooks(out=tmp_path / "out", notebooks=paths, progress=False, jobs=2)
    assert report.notebooks == ("00_x", "01_x", "02_x")


def test_unreadable_and_missing_notebooks(tmp_path, monkeypatch):
    path = tmp_path / "notebooks" / "00_x.ipynb"
    path.parent.mkdir()
    path.write_text("{")
    assert "00_x.ipynb: not a readable notebook" in refused(running.run_notebooks, notebooks=[path], progress=False)
    path.unlink()
    monkeypatch.setattr(notebooks, "PLACES", [tmp_path / "notebooks", tmp_path / "jumplab" / "notebooks"])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^no notebooks in '.*notebooks' nor in '.*'; install jumplab again$"):
        notebooks.find_notebooks()


def test_some_notebooks_alone_leave_the_others_as_they_are(tmp_path, monkeypatch):
    """By number or by name, in their order; only a notebook that is no more loses its executed copy."""
    for k, stem in enumerate(("00_first", "01_second", "02_third")):
        make_notebook(tmp_path, stem, RECORD % (k, k))
    monkeypatch.setattr(notebooks, "PLACES", [tmp_path / "notebooks"])
    chosen = notebooks.find_notebooks(["02_third", "00"])
    assert [p.stem for p in chosen] == ["00_first", "02_third"]
    executed = tmp_path / "executed" / "notebooks"
    executed.mkdir(parents=True)
    for stem in ("01_second", "07_gone"):
        (executed / f"{stem}.ipynb").write_text("old")
    running.run_notebooks(notebooks=chosen, progress=False)
    assert names(executed) == ["00_first.ipynb", "01_second.ipynb", "02_third.ipynb"]
    with pytest.raises(InputError, match=r"^no notebook '03'; there are 00_first, 01_second, 02_third$"):
        notebooks.find_notebooks(["01", "03"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_chain_leaves_nothing_behind(tmp_path, number):
    """No half result, no kernel: the sleeping notebook's process is gone soon after."""
    pid_file = tmp_path / "pid"
    sleeper = f"import os, pathlib, time\npathlib.Path({str(pid_file)!r}).write_text(str(os.getpid()))\ntime.sleep(300)"
    make_notebook(tmp_path, "00_sleep", RECORD % (0, 0), sleeper)
    code = (
        f"import sys; from pathlib import Path; sys.path.insert(0, {str(ROOT)!r}); from jumplab.cli import notebooks;"
        f"notebooks.PLACES = [Path({str(tmp_path)!r}) / 'notebooks']; from jumplab.cli.main import main;"
        f"sys.exit(main(['run', '-p', 'n=2']))"
    )
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs ignore Ctrl-C
    process = subprocess.Popen(
        [sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, env=env, preexec_fn=heed
    )
    try:
        wait_for(lambda: process.poll() is not None or (pid_file.exists() and pid_file.read_text()))
        process.send_signal(number)
        said = process.communicate(timeout=60)[1]
    finally:
        process.kill()
    assert process.returncode == (130 if number == signal.SIGINT else 143)
    assert "Traceback" not in said
    assert names(tmp_path) == ["notebooks", "pid"]
    wait_for(lambda: not Path(f"/proc/{pid_file.read_text()}").exists())


def wait_for(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.05)


# ------------------------------------------------------------------------------------------ inside a notebook


def test_what_a_notebook_asks_is_known_before_it_runs(tmp_path):
    asked = {p.name[:2]: running.declared_parameters(p) for p in SOURCES}
    assert asked["01"]["samples"] == range(1, 10_001) and asked["05"]["fast"] is bool
    chain = [make_notebook(tmp_path, "00_x", parameters=f"{PARAMETERS}  # 2 ... 4, how many\nm: dict = {{}}")]
    declared = running.declared_parameters(chain[0])
    assert declared["n"] == range(2, 5) and declared["m"] is None and declared["distance_m"] is float
    for value, said in ((5, "must be 2 ... 4, got 5"), (2.5, "must be a whole number, got 2.5")):
        assert refused(running.run_notebooks, {"n": value}, notebooks=chain, progress=False) == f"parameter n {said}"
        assert names(tmp_path) == ["notebooks"]


def test_plain_papermill_with_an_unknown_parameter_fails(tmp_path):
    import papermill

    path = make_notebook(tmp_path, "00_first", RECORD % (0, 0))
    with pytest.raises(papermill.PapermillExecutionError, match="unknown notebook parameter 'distnace_m'"):
        papermill.execute_notebook(path, tmp_path / "x.ipynb", {"distnace_m": 2.0}, progress_bar=False, cwd=str(ROOT))


# ------------------------------------------------------------------------------------------ the package's notebooks


@pytest.mark.parametrize("stem", STEMS)
def test_source_notebook_keeps_the_house_rules(stem):
    """No outputs committed, short cells without classes, the standard parameters, refusal of unknown ones."""
    path = ROOT / "notebooks" / f"{stem}.ipynb"
    nb = nbformat.read(path, as_version=4)
    nbformat.validate(nb)
    code = [c for c in nb.cells if c.cell_type == "code"]
    assert nb.cells[0].cell_type == "markdown" and nb.cells[0].source.startswith("# ")
    assert all(not c.outputs and c.execution_count is None for c in code), "commit notebooks without outputs"
    assert set(running.STANDARD) <= set(running.declared_parameters(path))
    assert any("check_parameters(" in c.source for c in code)
    most = 10 if stem == "03_joint_space_mapping" else 25  # the lesson: one idea a cell
    for cell in code:
        assert len([line for line in cell.source.splitlines() if line.strip()]) <= most, cell.source
        plain = "\n".join(line for line in cell.source.splitlines() if not line.startswith(("%", "!")))
        assert not any(isinstance(node, ast.ClassDef) for node in ast.walk(ast.parse(plain))), cell.source


def imported(paths):
    """Imports of the notebooks from jumplab, ``import jumplab as jl`` apart: pairs of a module and a name from it.

    Of a sub-package that is imported whole, the module is the sub-package: ("jumplab.stages", "stages").
    """
    cells = [c for p in paths for c in nbformat.read(p, as_version=4).cells if c.cell_type == "code"]
    found = set()
    for node in (n for c in cells for n in ast.walk(ast.parse(c.source))):
        if isinstance(node, ast.Import):
            found |= {(a.name, a.asname or a.name) for a in node.names if (a.name, a.asname) != ("jumplab", "jl")}
        if isinstance(node, ast.ImportFrom):
            whole = node.module == "jumplab"
            found |= {(f"jumplab.{a.name}" if whole else node.module, a.name) for a in node.names}
    return {(module, name) for module, name in found if module.partition(".")[0] == "jumplab"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.stem)
def test_a_notebook_enters_by_the_front_door(path):
    """``import jumplab as jl``, and at most three sub-packages more."""
    assert any("import jumplab as jl" in c.source for c in nbformat.read(path, as_version=4).cells)
    rooms = {module.split(".")[1] for module, _ in imported([path])}
    assert len(rooms) <= 3, rooms


def test_all_notebooks_import_few_names_from_few_modules():
    found = imported(SOURCES)
    names, modules = {"jl"} | {name for _, name in found}, {"jumplab"} | {module for module, _ in found}
    assert len(names) <= 35, sorted(names)
    assert len(modules) <= 12, sorted(modules)


def test_imports_are_found_wherever_they_stand(tmp_path):
    cell = """import numpy, jumplab as jl
def f():
    from jumplab import sim, io as files
    import jumplab.robot.reach as reach
    from jumplab.cli import check_parameters; from paper import jumplab"""
    modules = {"sim": "sim", "io": "io", "reach": "robot.reach", "check_parameters": "cli"}
    found = imported([make_notebook(tmp_path, "00_x", cell)]) - {("jumplab.cli.notebooks", "check_parameters")}
    assert found == {(f"jumplab.{module}", name) for name, module in modules.items()}


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """The whole chain once, from another folder, into a path with a space and letters beyond ASCII."""
    folder = tmp_path_factory.mktemp("chain") / "voll ständig"
    return running.run_notebooks(SMALL, out=folder / "out", figures=folder / "figures", progress=False)


def test_chain_runs_and_publishes(chain):
    assert list(chain.notebooks) == STEMS
    assert names(chain.out / "notebooks") == [p.name for p in SOURCES]
    tape, _, summary = store.read_plan(chain.out)
    assert len(tape.t) > 500 and summary["stages"]
    figures = [p for p in chain.figures.rglob("*") if p.is_file()]
    assert {p.suffix for p in figures} >= {".png", ".pdf"}
    least = {".png": 500, ".pdf": 500, ".txt": 40}  # bytes: a caption is a sentence
    assert all(p.stat().st_size > least[p.suffix] for p in figures)
    assert {f"f{k:02}" for k in range(1, 15)} <= {p.name[:3] for p in figures}  # every figure of the paper


def test_figures_say_what_they_show_and_not_when(chain):
    """Captions with target, robot or robots, and versions, but for drawings of no jump; no dates in pictures."""
    drawings = {"f02_framework", "f04_pendulum"}
    robot_alone = {"f03_link_models", "f03b_simulation_model", "your_robot", "your_robot_envelope", "shipped_envelopes"}
    for path in chain.figures.rglob("*.txt"):
        said = path.read_text(encoding="utf-8")
        assert "Made with python 3." in said and "casadi" in said, path.name
        assert bool(re.search("Robots?: ", said)) == (path.stem not in drawings), path.name
        assert ("Target" in said) == (path.stem not in drawings | robot_alone), path.name
        for kind in (".png", ".pdf"):
            data = path.with_suffix(kind).read_bytes()
            assert not re.search(rb"Matplotlib v|CreationDate|ModDate|Software|20[2-9][0-9]-[01][0-9]-", data), (
                path.name
            )


def test_chain_lands_where_it_should(chain):
    simulation = store.read_json(chain.out / "simulation.json")
    assert simulation["foot_distance_m"] == pytest.approx(1.0, abs=0.05)
    assert simulation["com_rise_m"] == pytest.approx(0.5, abs=0.03)
    assert simulation["standing_s"] >= 3.0


def test_readme_tells_what_the_run_measured(chain):
    """Its table to the millimetre and to 10 ms, and the number of checks."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    simulation, (_, _, summary) = store.read_json(chain.out / "simulation.json"), store.read_plan(chain.out)
    rows = dict(re.findall(r"^\| ([^|]+?) \| [\d.]+ m?s? ?\|(.*)\|$", readme, re.M))
    said = {name: [float(x) for x in re.findall(r"[\d.]+\d", rest)] for name, rest in rows.items()}
    assert said["travel of the feet"] == pytest.approx(
        [summary["planned_distance_m"], simulation["foot_distance_m"]], abs=0.001
    )
    assert said["rise of the CoM"] == pytest.approx([summary["planned_rise_m"], simulation["com_rise_m"]], abs=0.001)
    apex = re.search(r"^\| apex of the CoM above its stance \| \| ([\d.]+) m \| ([\d.]+) m \|$", readme, re.M).groups()
    there = [summary["planned_apex_m"], simulation["com_apex_m"]]
    assert [float(x) for x in apex] == pytest.approx(there, abs=0.001)
    assert said["on its feet after touchdown"] == pytest.approx([simulation["standing_s"]], abs=0.01)
    passport = store.read_json(chain.out / "passport.json")
    assert len(passport["checks"]) == 51 and "passes 51 independent checks" in readme


@pytest.mark.parametrize("stem", STEMS)
def test_executed_notebook_is_quiet(chain, stem):
    """Nothing on stderr, no warning, and pictures that are really embedded."""
    nb = nbformat.read(chain.out / "notebooks" / f"{stem}.ipynb", as_version=4)
    outputs = [o for c in nb.cells if c.cell_type == "code" for o in c.outputs]
    noise = [o.text for o in outputs if o.output_type == "stream" and o.name == "stderr"]
    assert not noise
    assert not any("Warning" in o.get("text", "") for o in outputs)
