"""The book, built as CONTRIBUTING.md says, and all its pages opened in Chromium, on a desktop and on a phone.

One notebook is executed before, the others are shown without outputs.
"""

import functools
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlparse

import pytest
from test_show_page import CHROMIUM, browser
from test_show_page_controls import GRAPHICS, PATIENCE_MS, SIZES

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install -e '.[browser]'")
BUILDERS = ("furo", "mathjax", "myst_nb", "sphinx")
installed = all(map(importlib.util.find_spec, BUILDERS))
pytestmark = [
    pytest.mark.slow,
    browser,
    pytest.mark.skipif(not installed, reason="what builds the book is not installed: pip install -e '.[book]'"),
]
ROOT = Path(__file__).resolve().parent.parent
BUILT_S = 900  # generous: a machine that does much else besides
# broken pictures, links, formulas, and how far the body reaches to the right. A formula is wrong if it is an error, is
# not drawn, or if its dots and tildes are not as many as its source has, each over one glyph
LOOK = """async () => {
  await globalThis.MathJax?.startup?.promise;
  const wrong = [...document.querySelectorAll(".math")].filter((x) => !x.querySelector("mjx-container"));
  for (const { math, typesetRoot } of globalThis.MathJax?.startup?.document?.math ?? []) {
    const count = (names) => (math.match(new RegExp(`\\\\\\\\(${names})(?![a-zA-Z])`, "g")) ?? []).length;
    const over = [...typesetRoot.querySelectorAll('[data-mml-node="mover"]')];
    const letters = over.filter((x) => x.children[0].querySelectorAll("use, path").length === 1);
    const small = "d{0,2}dot|tilde|hat|bar";
    const right = over.length === count(`${small}|overline`) && letters.length >= count(small);
    if (!right || typesetRoot.querySelector('[data-mml-node="merror"]')) wrong.push({ textContent: math });
  }
  const formulas = wrong.map((x) => x.textContent.slice(0, 80));
  const broken = [];
  for (const picture of document.images) {
    picture.loading = "eager";
    await picture.decode().catch(() => broken.push(picture.getAttribute("src").slice(0, 80)));
  }
  const links = [...document.links].map((a) => a.href);
  return { broken, links, formulas, right: document.scrollingElement.scrollWidth };
}"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the site; sources, figures and the executed notebook stand beside it as in a clone."""
    clone = tmp_path_factory.mktemp("clone")
    for name in ("notebooks", "figures"):
        shutil.copytree(ROOT / name, clone / name, ignore=shutil.ignore_patterns("__pycache__", ".ipynb_checkpoints"))
    shutil.copy(ROOT / "CHANGELOG.md", clone)
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    for line in ("jumplab run 00 --out executed --figures figures", "sphinx -b html -c notebooks/book notebooks site"):
        done = subprocess.run(
            [sys.executable, "-m", *line.split()], cwd=clone, env=env, capture_output=True, text=True, timeout=BUILT_S
        )
        assert done.returncode == 0, done.stderr[-3000:]
    assert "WARNING" not in done.stderr, done.stderr[-3000:]
    return clone / "site"


def pages(site: Path) -> list[Path]:
    """All pages but the first, which only leads to the book's."""
    found = sorted(p for p in site.rglob("*.html") if "_static" not in p.parts)
    return [p for p in found if p != site / "index.html"]


@functools.cache
def names(page: Path) -> frozenset[str]:
    """Names in a page to which links may lead."""
    return frozenset(re.findall(r'\bid="([^"]+)"', page.read_text(encoding="utf-8")))


def dead(link: str, site: Path) -> str | None:
    """Fault of a link within the site, in words; None if it leads somewhere."""
    address, name = urldefrag(link)
    if urlparse(address).scheme != "file":
        return None
    page = Path(unquote(urlparse(address).path))
    if not page.is_file() or not page.is_relative_to(site):
        return f"{link}: no such file"
    return f"{link}: no such place" if name and page.suffix == ".html" and unquote(name) not in names(page) else None


def test_first_page_leads_to_the_book(site):
    """And the executed notebook is there with its pictures."""
    target = re.search(r'url=([^"]+)"', (site / "index.html").read_text(encoding="utf-8"))[1]
    assert (site / target).is_file()
    overview = (site / "00_overview.html").read_text(encoding="utf-8")
    assert overview.count("<img") > 1 and "<iframe" in overview and "tex-svg-full.js" in overview
    assert {"jump.html", "00_overview.html", "gallery.html", "api.html", "tuning.html"} <= {p.name for p in pages(site)}


def faults_of(tab, page: Path, site: Path, width: int) -> list[str]:
    """Faults of one page in a tab of that width."""
    said = []
    tab.set_default_timeout(PATIENCE_MS)
    tab.on("pageerror", lambda e: said.append(str(e)))
    tab.on("console", lambda m: m.type == "error" and said.append(m.text))
    tab.goto(page.as_uri() + ("#t=1.1" if page.name == "jump.html" else ""))
    seen = tab.evaluate(LOOK)
    said += [f"no picture {source}" for source in seen["broken"]]
    said += [f"wrong formula {tex}" for tex in seen["formulas"]]
    said += filter(None, (dead(link, site) for link in sorted({*seen["links"]})))
    if seen["right"] > width:
        said.append(f"{seen['right']} pixels wide")
    return [f"{page.relative_to(site)}: {what}" for what in said]


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_pages_in_chromium(site, size):
    """No complaint of the browser, no missing picture, no dead link, nothing that scrolls to the side."""
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=GRAPHICS)
        context = chromium.new_context(viewport=dict(zip(("width", "height"), size, strict=True)), offline=True)
        faults = []
        for page in pages(site):
            tab = context.new_page()
            faults += faults_of(tab, page, site, size[0])
            tab.close()
        chromium.close()
    assert faults == []
