"""The 3-D page under somebody's hands, without network: play, scrub, slow motion, plan or simulation, views."""

import io

import matplotlib.image
import numpy as np
import pytest
from fixtures_core import jump
from test_show_page import CHROMIUM, FLAGS, browser, count

from jumplab.show import viewer as viewer
from jumplab.show.viewer import FPS
from jumplab.sim import simulate_jump

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install -e '.[browser]'")
pytestmark = [pytest.mark.slow, browser]


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    p = jump(1.0, 0.5)
    page = viewer.page(p.robot, plan=p.tape, simulation=simulate_jump(p.tape, p.robot), task=p.task)
    return page.save(tmp_path_factory.mktemp("page") / "jump.html").as_uri()


@pytest.fixture
def tab():
    """A browser that is offline, and what its pages asked for or complained of."""
    flags = [f for f in FLAGS if not f.startswith(("--headless", "--virtual-time", "--enable-logging"))]
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        tab = chromium.new_context(viewport={"width": 1280, "height": 720}, offline=True).new_page()
        tab.asked, tab.trouble = [], []
        tab.on("request", lambda r: tab.asked.append(r.url.split("#")[0]))
        tab.on("pageerror", lambda e: tab.trouble.append(str(e)))
        tab.on("console", lambda m: m.type == "error" and tab.trouble.append(m.text))
        yield tab
        chromium.close()


def clock(tab) -> float:
    return float(tab.locator("#clock").inner_text().removesuffix(" s"))


def picture(tab) -> np.ndarray:
    tab.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return matplotlib.image.imread(io.BytesIO(tab.screenshot()))[:, :, :3]


def scrub(tab, seconds: float) -> None:
    tab.locator("#time").evaluate("(e, t) => { e.value = t; e.dispatchEvent(new Event('input')); }", seconds)


def test_controls(tab, url):
    tab.goto(f"{url}#t=0.4")
    still = picture(tab)
    assert clock(tab) == 0.4 and tab.locator("#phase-name").inner_text() == "launch"
    assert count(still, "launch") > 6000
    scrub(tab, 1.1)
    assert clock(tab) == 1.1 and tab.locator("#phase-name").inner_text() == "flight"
    flight = picture(tab)
    assert count(flight, "flight") > 6000 and count(flight, "launch") < 1500
    tab.locator("#view").select_option("corner")
    assert np.abs(picture(tab) - flight).max(axis=2).mean() > 0.02
    end = float(tab.locator("#time").get_attribute("max"))
    tab.locator("#show").select_option("plan")
    touchdown = float(tab.locator("#time").get_attribute("max"))
    planned = jump(1.0, 0.5).tape.t[-1]
    assert 0 <= planned - touchdown < 1 / FPS and touchdown < end  # the last whole frame
    tab.locator("#show").select_option("both")
    scrub(tab, 4.0)
    assert tab.locator("#phase-name").inner_text() == "landing" and count(picture(tab), "landing") > 3000
    assert tab.trouble == [] and tab.asked == [url]  # the file itself and nothing else


def test_play_runs_at_the_chosen_speed(tab, url):
    tab.goto(f"{url}#t=0")
    tab.locator("#speed").select_option("0.1")
    began = tab.evaluate("performance.now()")
    tab.locator("#play").click()
    tab.wait_for_timeout(3000)
    tab.locator("#play").click()  # stop
    shown, passed = clock(tab), (tab.evaluate("performance.now()") - began) / 1000
    assert 0.5 * 0.1 * passed < shown <= 0.1 * passed + 0.01  # the last frame may be some time ago on a slow machine
    tab.wait_for_timeout(300)
    assert clock(tab) == shown
    assert tab.trouble == []


def test_without_an_instant_it_plays_to_its_end(tab, url):
    tab.goto(url)
    tab.wait_for_function("() => document.getElementById('play').textContent === '▶'", timeout=60_000)
    assert clock(tab) == pytest.approx(float(tab.locator("#time").get_attribute("max")), abs=0.01)
    assert tab.locator("#phase-name").inner_text() == "landing"
