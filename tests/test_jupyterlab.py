"""Notebooks with pages and sliders, opened in a real JupyterLab in a real browser, and run from top to bottom.

The others are run by ``test_notebooks.py``.
Needs Chromium and the extra ``browser``; skipped without. Takes some minutes.
"""

import contextlib
import io
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import matplotlib.colors as mcolors
import matplotlib.image
import nbformat
import numpy as np
import pytest
from test_show_page import browser
from test_show_page_controls import chromium as chromium

from jumplab.show.style import PHASE_COLORS

pytestmark = [pytest.mark.slow, browser]
ROOT = Path(__file__).resolve().parent.parent
START_S, RUN_S = 90, 420  # generous: a machine that does much else besides
VIEWS = ("00_overview", "05_simulation")  # show the jump in 3-D
SLIDERS = "02_srmp"
RUN_ALL = """async () => {
  const app = window.jupyterapp;
  await app.commands.execute("notebook:run-all-cells");
  await app.commands.execute("docmanager:save");
}"""
KERNEL_IDLE = """() => {
  const panel = window.jupyterapp?.shell.currentWidget;
  return panel?.sessionContext?.session?.kernel?.status === "idle";
}"""


def free_port() -> int:
    with contextlib.closing(socket.socket()) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Address and folder of a JupyterLab with copies of the notebooks; it is gone afterwards."""
    folder, port = tmp_path_factory.mktemp("lab"), free_port()
    (folder / "notebooks").mkdir()
    for stem in (*VIEWS, SLIDERS):
        shutil.copy(ROOT / "notebooks" / f"{stem}.ipynb", folder / "notebooks")
    shutil.copytree(ROOT / "notebooks" / "paper", folder / "notebooks" / "paper")
    never = "jupyterlab.handlers.announcements.NeverCheckForUpdate"
    options = {"ip": "127.0.0.1", "port": port, "port_retries": 0, "open_browser": False, "root_dir": folder,
               "allow_root": True}  # fmt: skip
    command = [sys.executable, "-m", "jupyterlab", "--expose-app-in-browser", "--IdentityProvider.token="]
    command += [f"--ServerApp.{k}={v}" for k, v in options.items()] + [f"--LabApp.check_for_updates_class={never}"]
    env = {k: v for k, v in os.environ.items() if k != "MPLBACKEND"}  # the kernel chooses its own
    env |= {"PYTHONPATH": str(ROOT), "HOME": str(folder), "JUPYTER_CONFIG_DIR": str(folder / ".jupyter"),
            "JUPYTER_RUNTIME_DIR": str(folder / ".runtime"), "IPYTHONDIR": str(folder / ".ipython")}  # fmt: skip
    with (folder / "lab.log").open("w") as log:
        server = subprocess.Popen(command, stdout=log, stderr=log, env=env, cwd=folder)
    address = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + START_S
        while True:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{address}/api/status", timeout=5):
                break
            assert server.poll() is None and time.monotonic() < deadline, (folder / "lab.log").read_text()[-3000:]
            time.sleep(0.3)
        yield address, folder
    finally:
        server.terminate()  # it ends its kernels first
        try:
            server.wait(timeout=30)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


@pytest.fixture
def tab(chromium):
    tab = chromium.new_page(viewport={"width": 1400, "height": 1000})
    yield tab
    tab.close()


def phase_pixels(png: bytes) -> int:
    """Pixels of launch blue, flight orange or landing green, light or dark."""
    if not png:
        return 0
    hsv = mcolors.rgb_to_hsv(matplotlib.image.imread(io.BytesIO(png))[:, :, :3])
    hues = [mcolors.rgb_to_hsv(mcolors.to_rgb(c))[0] for c in PHASE_COLORS.values()]
    return sum(int(((np.abs(hsv[:, :, 0] - h) < 0.03) & (hsv[:, :, 1] > 0.3)).sum()) for h in hues)


@pytest.mark.parametrize("stem", [*VIEWS, SLIDERS])
def test_runs_in_jupyterlab(lab, tab, stem, record_property):
    address, folder = lab
    tab.goto(f"{address}/lab/tree/notebooks/{stem}.ipynb?reset")
    tab.wait_for_function(KERNEL_IDLE, timeout=1000 * START_S)
    tab.set_default_timeout(1000 * RUN_S)
    began = time.perf_counter()
    tab.evaluate(RUN_ALL)
    seconds = time.perf_counter() - began
    record_property("seconds", seconds)
    print(f"{stem}: {seconds:.1f} s")  # pytest -s shows it
    nb = nbformat.read(folder / "notebooks" / f"{stem}.ipynb", as_version=4)
    code = [c for c in nb.cells if c.cell_type == "code"]
    errors = [f"{o.ename}: {o.evalue}" for c in code for o in c.outputs if o.output_type == "error"]
    assert not errors
    assert all(c.execution_count for c in code if c.source.strip())
    noise = [o.text for c in code for o in c.outputs if o.output_type == "stream" and o.name == "stderr"]
    assert not noise
    if stem in VIEWS:
        look_at_the_jump(tab, folder / f"{stem}.png")
    if stem == SLIDERS:
        move_a_slider(tab, folder)


def look_at_the_jump(tab, place: Path) -> None:
    """The 3-D page plays by itself in its cell; JupyterLab may load it anew when it is scrolled to."""
    deadline = time.monotonic() + START_S
    frame = tab.locator("iframe[srcdoc]").first
    frame.scroll_into_view_if_needed()
    # legend, path and slider have 700 without a robot, which has 4,000 where its limbs are pale
    while phase_pixels(place.read_bytes() if place.exists() else b"") < 3000:
        assert time.monotonic() < deadline, f"no robot to be seen, {place}"
        tab.wait_for_timeout(1000)
        place.write_bytes(frame.screenshot())


def move_a_slider(tab, folder: Path) -> None:
    """The picture below the sliders changes when one of them is asked for another rise."""
    box = tab.locator(".widget-vbox").first
    box.scroll_into_view_if_needed()
    picture = box.locator("img")
    picture.wait_for(timeout=30_000)
    before = picture.get_attribute("src")
    number = box.locator(".widget-slider .widget-readout").nth(1)
    number.fill("0.30")
    number.press("Enter")
    tab.wait_for_function(
        "([box, before]) => { const i = box.querySelector('img'); return i && i.src !== before; }",
        arg=[box.element_handle(), before], timeout=30_000,
    )  # fmt: skip
    box.screenshot(path=folder / "sliders.png")
