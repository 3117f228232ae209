"""The 3-D page under somebody's hands, without network, on a desktop and on a phone.

Play, scrub, slow motion, loop, plan beside simulation, views, curves.
"""

import io

import matplotlib.image
import numpy as np
import pytest
from fixtures_core import jump
from fixtures_robots import needs_published
from test_show_page import CHROMIUM, FLAGS, STAGE, browser, count

import jumplab as jl
from jumplab.io.motion import Motion
from jumplab.show import viewer as viewer
from jumplab.show.viewer import FPS

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install -e '.[browser]'")
pytestmark = [pytest.mark.slow, browser]
GRAPHICS = [f for f in FLAGS if not f.startswith(("--headless", "--virtual-time", "--enable-logging"))]
SIZES = {"desktop": (1280, 720), "phone": (390, 844)}
PATIENCE_MS = 180_000  # a machine that does much else besides
# what is too small to read or to touch, or lies or reaches out of its place
FAULTS = """() => {
  const faults = [], all = [...document.querySelectorAll("header *, #curves *, footer *")];
  const seen = all.filter((e) => e.getClientRects().length);
  for (const e of seen) {
    const { left, top, right, bottom, width, height } = e.getBoundingClientRect();
    const said = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    const wrong = {
      "small text": said && parseFloat(getComputedStyle(e).fontSize) < 12,
      "too small": ["BUTTON", "SELECT", "INPUT"].includes(e.tagName) && Math.min(width, height) < 40,
      "outside": left < 0 || top < 0 || right > innerWidth + 0.5 || bottom > innerHeight + 0.5,
      "cut": said && e.tagName !== "SELECT" && e.clientWidth && e.scrollWidth > e.clientWidth + 1,
    };
    for (const name in wrong) if (wrong[name]) faults.push(`${e.tagName} ${e.id} ${e.className}: ${name}`);
  }
  const page = document.scrollingElement;
  if (page.scrollWidth > innerWidth || page.scrollHeight > innerHeight) faults.push("the page scrolls");
  if (document.getElementById("stage").clientHeight < 300) faults.push("little is left for the jump");
  return [seen.length, faults];
}"""
# where the base of the robot that leads is on the picture, -1 ... 1 from left to right
BASE = "() => { viewer.camera.updateMatrixWorld(); return upright(base(lead, now)).project(viewer.camera).x; }"


@pytest.fixture(scope="module")
def url(tmp_path_factory, simulation):
    p = jump(1.0, 0.5)
    page = viewer.page(p.robot, plan=p.tape, simulation=simulation, task=p.task)
    return page.save(tmp_path_factory.mktemp("page") / "jump.html").as_uri()


@pytest.fixture(scope="module")
def chromium():
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=GRAPHICS, timeout=PATIENCE_MS)
        yield chromium
        chromium.close()


@pytest.fixture
def tab(chromium):
    """A tab that is offline, and what its pages asked for or complained of."""
    tab = chromium.new_context(viewport={"width": 1280, "height": 720}, offline=True).new_page()
    tab.set_default_timeout(PATIENCE_MS)
    tab.set_default_navigation_timeout(PATIENCE_MS)
    tab.asked, tab.trouble = [], []
    tab.on("request", lambda r: tab.asked.append(r.url.split("#")[0]))
    tab.on("pageerror", lambda e: tab.trouble.append(str(e)))
    tab.on("console", lambda m: m.type == "error" and tab.trouble.append(m.text))
    yield tab
    tab.context.close()


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
    assert np.abs(picture(tab) - flight)[STAGE].max(axis=2).mean() > 0.01  # 0.0 of the same view; limbs are slim
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
    tab.wait_for_function("() => document.getElementById('play').textContent === '▶'")
    assert clock(tab) == pytest.approx(float(tab.locator("#time").get_attribute("max")), abs=0.01)
    assert tab.locator("#phase-name").inner_text() == "landing"


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_everything_can_be_seen_read_and_touched(tab, url, size):
    tab.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
    tab.goto(f"{url}#t=1.1&show=both")
    seen, faults = tab.evaluate(FAULTS)
    assert seen > 60 and faults == []
    assert count(picture(tab), "flight") > 3000 and tab.trouble == []


def test_a_click_on_a_curve_moves_the_time(tab, url):
    tab.goto(f"{url}#t=0")
    end = float(tab.locator("#time").get_attribute("max"))
    plot = tab.locator(".plot").nth(1)
    box = plot.bounding_box()
    plot.click(position={"x": 0.3 * box["width"], "y": 20})
    assert clock(tab) == pytest.approx(0.3 * end, abs=0.02)
    lefts = tab.evaluate("() => [...document.querySelectorAll('.cursor')].map((c) => parseFloat(c.style.left))")
    assert lefts == pytest.approx([30] * 4, abs=0.5)  # one cursor in all curves
    scrub(tab, 0.0)
    assert tab.locator(".cursor").first.evaluate("(c) => c.style.left") == "0%"
    inks = tab.evaluate("""() => [...document.querySelectorAll('.plot canvas')].map((c) => {
        const seen = new Set(new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer));
        return seen.size; })""")
    assert min(inks) > 5 and tab.trouble == []  # three phases, lines, and what lies between


def test_plan_beside_simulation_and_how_far_they_are_apart(tab, url, simulation):
    tab.goto(f"{url}#t=1.2&view=front")
    figures = tab.locator("#apart").inner_text()
    row = int(np.argmin(np.abs(simulation.t - 1.2)))
    liftoff = int(np.flatnonzero(simulation.phase == "flight")[0])
    tape = jump(1.0, 0.5).tape
    planned = int(np.argmin(np.abs(tape.t - 1.2)))
    rise = simulation.com[row, 2] - simulation.com[liftoff, 2]
    away = 1000 * np.linalg.norm(simulation.q[row, :3] - tape.q[planned, :3])
    cells = [line.split("\t") for line in figures.splitlines()]
    assert cells[0] == ["now", "simulation", "plan", "apart"] and cells[2][1] == f"{rise:.3f} m"
    assert float(cells[3][3].removesuffix(" mm")) == pytest.approx(away, abs=0.15)
    together = picture(tab)
    tab.locator("#offset").evaluate("(e) => { e.value = 0.8; e.dispatchEvent(new Event('input')); }")
    assert tab.locator("#show").input_value() == "both" and tab.locator("#offset-m").inner_text() == "0.8 m"
    assert tab.evaluate("() => clips.map((clip) => clip.aside)") == [-0.4, 0.4]
    # two robots, of which the pale one is in the colour of the phase in part
    assert count(picture(tab), "flight") > 1.15 * count(together, "flight")
    assert tab.locator("#apart").inner_text() == figures  # the offset is no error
    scrub(tab, 3.0)
    assert tab.locator("#apart").inner_text().startswith(f"at {tape.t[-1] - tape.t[-1] % 0.02:.2f} s, the plan's end")
    assert tab.trouble == []


def test_camera_follows_the_robot(tab, url):
    tab.goto(f"{url}#t=0.2&follow=0")
    places = []
    for _ in range(2):
        for t in (0.2, 1.2, 3.0):
            scrub(tab, t)
            places.append(tab.evaluate(BASE))
        tab.locator("#follow").click()
    assert np.ptp(places[:3]) > 0.15 and np.abs(places[3:]).max() < 0.02
    assert tab.trouble == []


def test_a_loop_begins_again(tab, url):
    tab.goto(f"{url}#t=0")
    tab.locator("#loop").click()
    scrub(tab, float(tab.locator("#time").get_attribute("max")) - 0.05)
    tab.locator("#play").click()
    tab.wait_for_function("() => Number(document.getElementById('time').value) < 2")
    assert tab.locator("#play").inner_text() == "❚❚" and tab.trouble == []


@needs_published
def test_meshes_of_a_published_robot(tab, tmp_path):
    page = jl.view(jl.plan(jl.JumpTask(0.4, 0.2), "g1"))
    file = page.save(tmp_path / "g1.html")
    assert file.stat().st_size < 10e6
    tab.goto(f"{file.as_uri()}#t=1.1")
    assert "published meshes" in tab.locator("#note").inner_text()
    assert count(picture(tab), "flight") > 3000 and tab.trouble == []


def test_keys_and_buttons_step_by_a_frame(tab, url):
    tab.goto(f"{url}#t=0.5")
    for press, seconds in (
        (lambda: tab.keyboard.press("ArrowRight"), 0.52),
        (lambda: tab.locator("#on").click(), 0.54),
        (lambda: tab.locator("#back").click(), 0.52),
        (lambda: tab.keyboard.press("ArrowLeft"), 0.5),
        (lambda: tab.keyboard.press("Home"), 0.0),
    ):
        press()
        assert clock(tab) == seconds
    tab.keyboard.press("End")
    assert clock(tab) == pytest.approx(float(tab.locator("#time").get_attribute("max")), abs=0.01) and tab.trouble == []


def test_curves_of_one_joint_a_legend_and_names_above_the_robots(tab, url, simulation):
    tab.goto(f"{url}#t=1.0&show=both")
    titles = tab.locator("#curves h2")
    assert "hip" in titles.nth(1).inner_text() and titles.count() == 4
    tab.locator("#joint").select_option(label="right shoulder pitch")
    shown = titles.nth(1).inner_text()
    row = int(np.argmin(np.abs(simulation.t - 1.0)))
    angle = round(float(np.degrees(simulation.angle["right_shoulder_pitch"][row])))
    assert titles.count() == 4 and shown == f"right shoulder pitch angle [°] {angle}".replace("-", "\u2212")
    legend = tab.locator("#legend").inner_text()
    assert all(word in legend for word in ("launch", "flight", "landing", "force of the ground", "the plan beside"))
    names = tab.locator("#labels span").filter(has_text="simulation")
    assert not names.is_visible()
    tab.locator("#offset").evaluate("(e) => { e.value = 0.6; e.dispatchEvent(new Event('input')); }")
    tab.wait_for_function("[...document.querySelectorAll('#labels span')].every((e) => e.style.display === '')")
    assert names.is_visible()
    tab.locator("#show").select_option("plan")
    gone = "[...document.querySelectorAll('#labels span')].every((e) => e.textContent !== 'plan' || e.style.display)"
    tab.wait_for_function(gone)
    assert tab.trouble == []


def test_it_starts_at_its_first_frame_when_it_is_seen(tab, url, tmp_path):
    """Far below in another page it waits; scrolled to, it plays from 0."""
    far = tmp_path / "far.html"
    far.write_text(f'<div style="height: 5000px"></div><iframe src="{url}" width="800" height="600"></iframe>')
    tab.goto(far.as_uri())
    (frame,) = tab.main_frame.child_frames
    frame.wait_for_selector("#clock")
    tab.wait_for_timeout(1500)
    assert frame.evaluate("[playing, now]") == [False, 0]
    tab.evaluate("scrollTo(0, 1e6)")
    frame.wait_for_function("playing")
    first = frame.evaluate("now")
    assert first < 0.6, "the first frames are skipped"
    frame.wait_for_function(f"now > {first}")


def test_the_trail_of_a_chain_leads_to_its_last_landing(tab, tmp_path):
    """Two jumps in one record, the second as the first one but 1 m on: beads lie under both flights."""
    p = jump(1.0, 0.5)
    tape = p.tape
    t, q, phase = (getattr(tape, name) for name in ("t", "q", "phase"))
    later = q.copy()
    later[:, 0] += 1.0
    stand = np.array(["landing"] * 2)
    motion = Motion(
        np.concatenate([t, [t[-1] + 0.1, t[-1] + 0.2], t + t[-1] + 0.3, [2 * t[-1] + 0.4, 2 * t[-1] + 0.6]]),
        np.concatenate([q, later[:1], later[:1], later, later[-1:], later[-1:]]),
        *(np.zeros((2 * len(t) + 4, n)) for n in (p.robot.model.nv, p.robot.model.nv - 6)),
        np.concatenate([phase, stand, phase, stand]), "simulation",
    )  # fmt: skip
    tab.goto(viewer.page(p.robot, simulation=motion).save(tmp_path / "chain.html").as_uri() + "#t=0")
    spheres = "clips[0].group.children.filter((x) => x.geometry && x.geometry.type === 'SphereGeometry')"
    beads = tab.evaluate(f"{spheres}.map((x) => x.position.x)")
    assert min(beads) < 0.2 and max(beads) > 1.8
