"""The book as a static site: the executed notebooks, the reference from docstrings, the gallery and the tuning page.

After ``jumplab run``, in the clone's root: ``python -m sphinx -b html -c notebooks/book notebooks site``.
"""

import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

from jumplab.io.folder import versions

NOTEBOOKS = Path(__file__).resolve().parent.parent
EXECUTED = NOTEBOOKS.parent / "executed" / "notebooks"

project, author = "jumplab", "The jumplab authors"
release = version = versions()["jumplab"]
root_doc = "book/index"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["paper", ".ipynb_checkpoints"]
html_math_renderer = "mathml"  # browsers draw it themselves: the site asks for nothing outside itself
html_theme, html_title = "furo", f"jumplab {release}"
html_extra_path = ["../../executed/jump.html"] if (EXECUTED.parent / "jump.html").is_file() else []
nb_execution_mode = "off"  # `jumplab run` has executed them; what it has not is shown without outputs
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "description"
suppress_warnings = ["mystnb.unknown_mime_type", "myst.xref_missing", "docutils"]
suppress_warnings += ["ref.python"]  # types in docstrings are short names, of which two classes may have the same


def with_outputs(app, name, source):
    """Put the executed notebook in the place of the one without outputs."""
    path = EXECUTED / f"{name}.ipynb"
    if path.is_file():
        source[0] = path.read_text(encoding="utf-8")


def front_page(app, exception):
    """The site's first page is the book's."""
    page = '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url=book/index.html">'
    (Path(app.outdir) / "index.html").write_text(f"{page}<title>jumplab</title>\n", encoding="utf-8")


def formula(translator, node):
    """A formula as MathML; what only makes brackets larger is left out, as MathML does that by itself."""
    tex = re.sub(r"\\[bB]ig+[lrm]?(?![a-zA-Z])", "", node.astext())
    block = isinstance(node, nodes.math_block)
    text = tex2mathml(f"{{}}{tex}" if tex.startswith("^") else tex, as_block=block)
    translator.body.append(f'<div class="math">{text}</div>' if block else text)
    raise nodes.SkipNode


def setup(app):
    """Called by Sphinx."""
    app.add_generic_role("mpltype", nodes.literal)  # of matplotlib's own docstrings, which figures inherit
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
    app.connect("source-read", with_outputs)
    app.connect("build-finished", front_page)
