"""The book as a static site: the executed notebooks, the reference from docstrings, the gallery and the tuning page.

After ``jumplab run``, in the clone's root: ``python -m sphinx -b html -c notebooks/book notebooks site``.
"""

import re
from importlib.util import find_spec
from pathlib import Path

from docutils import nodes

from jumplab.io.folder import versions

NOTEBOOKS = Path(__file__).resolve().parent.parent
EXECUTED = NOTEBOOKS.parent / "executed" / "notebooks"

project, author = "jumplab", "The jumplab authors"
release = version = versions()["jumplab"]
root_doc = "book/index"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["paper", ".ipynb_checkpoints"]
# one file of MathJax goes with the site, which asks for nothing outside itself
html_static_path = [str(Path(find_spec("mathjax").origin).parent / "static" / "mathjax" / "es5" / "tex-svg-full.js")]
mathjax_path = "tex-svg-full.js"
html_theme, html_title = "furo", f"jumplab {release}"
html_extra_path = ["../../executed/jump.html"] if (EXECUTED.parent / "jump.html").is_file() else []
nb_execution_mode = "off"  # `jumplab run` has executed them; what it has not is shown without outputs
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "description"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
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


def sentences(app, what, name, obj, options, lines):
    """Of ``name : words`` in a list of parameters the words are no type, which is in the annotation: put them below."""
    inside, text = False, []
    for above, line in zip(["", *lines], lines, strict=False):
        if set(above.strip()) == {"-"}:
            inside = text[-2].strip() in ("Parameters", "Attributes")
        named = re.fullmatch(r"([\w*., `]+?) : (.+)", line)
        text += [named[1], f"    {named[2]}"] if inside and named else [line]
    lines[:] = text


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", sentences, priority=400)  # before napoleon reads them
    app.add_generic_role("mpltype", nodes.literal)  # of matplotlib's own docstrings, which figures inherit
    app.connect("source-read", with_outputs)
    app.connect("build-finished", front_page)
