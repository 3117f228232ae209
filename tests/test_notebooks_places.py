"""The runner where it may not write, without a display, killed without a warning: nothing is left behind."""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from paper import running
from test_notebooks import RECORD, make_notebook, wait_for
from test_store import names

from jumplab.cli import notebooks

ROOT = Path(__file__).resolve().parent.parent
CAP_DAC_OVERRIDE, PR_CAPBSET_DROP = 1, 24  # of Linux: what lets root write where nobody may


def obey_permissions():
    """Let the process that follows be refused what its file permissions forbid, even if root runs the tests."""
    if sys.platform == "linux" and os.geteuid() == 0:
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0)


def run_there(checkout, *arguments, code="", **options):
    """``jumplab run`` from a copy of the package that lies in ``checkout``."""
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "JUPYTER_PATH")}
    env |= {"PYTHONPATH": str(checkout), "HOME": "/nonexistent"}
    program = f"import sys; {code}\nfrom jumplab.cli.main import main; sys.exit(main(['run', *sys.argv[1:]]))"
    return subprocess.Popen([sys.executable, "-c", program, *map(str, arguments)], env=env, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=obey_permissions,
                            **options)  # fmt: skip


@pytest.fixture
def read_only(odd_folder):
    """A checkout that nobody may write to: the package, and two small notebooks that pass results on."""
    checkout = odd_folder / "check out"
    checkout.mkdir()
    shutil.copytree(ROOT / "jumplab", checkout / "jumplab", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copyfile(ROOT / "pyproject.toml", checkout / "pyproject.toml")
    shutil.copytree(ROOT / "notebooks" / "paper", checkout / "notebooks" / "paper")
    make_notebook(checkout, "00_first", RECORD % (0, 0), "assert 'DISPLAY' not in os.environ")
    make_notebook(
        checkout, "01_second", "import pathlib\nassert pathlib.Path(out, 'seen_0.json').exists()" + RECORD % (1, 1)
    )
    folders = [checkout, *(p for p in checkout.rglob("*") if p.is_dir())]
    for p in folders:
        p.chmod(0o555)
    yield checkout
    for p in folders:
        p.chmod(0o755)


def everything(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


# our two notebooks make no plan: what `run` prints of one is left out
NO_PLAN = """
from jumplab.cli import common
from jumplab.io import folder as store
common.print_summary = common.print_simulation = lambda x: None
store.read_plan, store.read_json = lambda x: (0, 0, 0), lambda x: 0"""


@pytest.mark.slow
def test_read_only_checkout(read_only, odd_folder):
    """With --out all goes there; without, it is refused before anything runs. No display, another working folder."""
    before, out = everything(read_only), odd_folder / "results"
    done = run_there(read_only, "--out", out, "-p", "n=3", code=NO_PLAN, cwd="/")
    said = done.communicate(timeout=120)
    assert done.returncode == 0, said
    assert names(out) == ["figures", "notebooks", "seen_0.json", "seen_1.json"]
    assert names(out / "figures") == ["figure_0.png", "figure_1.png"]
    refused = run_there(read_only, cwd=odd_folder)
    text, complaint = refused.communicate(timeout=120)
    assert (refused.returncode, text) == (2, "")
    assert complaint.startswith("jumplab: the folder '") and complaint.count("\n") == 1
    assert "cannot be written (Permission denied); choose another one" in complaint
    assert everything(read_only) == before


@pytest.mark.slow
def test_killed_runner_takes_its_kernel_along(tmp_path):
    """SIGKILL cannot be answered, but the kernel notices that its parent has gone; the next run clears the rest."""
    pid_file = tmp_path / "pid"
    sleeper = f"import os, pathlib, time\npathlib.Path({str(pid_file)!r}).write_text(str(os.getpid()))\ntime.sleep(300)"
    path = make_notebook(tmp_path, "00_sleep", RECORD % (0, 0), sleeper)
    there = f"sys.path.insert(0, {str(ROOT)!r}); from pathlib import Path; from jumplab.cli import notebooks;"
    there += f"notebooks.PLACES = [Path({str(tmp_path)!r}) / 'notebooks']"
    process = run_there(ROOT, "--out", tmp_path / "out", code=there)
    wait_for(lambda: process.poll() is not None or (pid_file.exists() and pid_file.read_text()))
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    wait_for(lambda: not alive(int(pid_file.read_text())))
    path.unlink()
    chain = [make_notebook(tmp_path, "00_quick", RECORD % (0, 0))]
    running.run_notebooks(notebooks=chain, out=tmp_path / "out", progress=False)
    assert names(tmp_path / "out") == ["figures", "notebooks", "seen_0.json"]


def alive(pid: int) -> bool:
    """True if the process runs; one that has ended but that nobody has asked about does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def test_finished_chain_leaves_no_process(tmp_path):
    """Neither a kernel nor anything that a kernel has started."""
    pids = tmp_path / "pids"
    report = f"import os, pathlib\npathlib.Path({str(pids)!r}).open('a').write(f'{{os.getpid()}}\\n')"
    chain = [make_notebook(tmp_path, f"0{k}_x", report) for k in range(2)]
    running.run_notebooks(notebooks=chain, progress=False)
    found = [int(x) for x in pids.read_text().split()]
    assert len(set(found)) == 2 and not any(alive(pid) for pid in found)


def test_an_installed_package_brings_its_notebooks(tmp_path, monkeypatch):
    """Not a checkout: the notebooks lie in the package, and results in the folder where one is."""
    package = tmp_path / "site-packages" / "jumplab"
    package.mkdir(parents=True)
    make_notebook(package, "00_first")
    monkeypatch.setattr(notebooks, "PACKAGE", package)
    monkeypatch.setattr(notebooks, "PLACES", [root / "notebooks" for root in (package.parent, package)])
    monkeypatch.chdir(tmp_path)
    found = notebooks.find_notebooks()
    assert [p.name for p in found] == ["00_first.ipynb"] and found[0].is_relative_to(package)
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert 'force-include = { "notebooks" = "jumplab/notebooks" }' in text
