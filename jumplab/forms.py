"""Texts by Jinja, from files beside the modules that fill them in."""

import base64
import json
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

PACKAGE = Path(__file__).parent


def filled(form: str | Path, **facts: Any) -> str:
    """The text that a file, of this package if its path is relative, makes of ``facts``; in HTML
    they are escaped, unless ``safe``.
    """
    path = PACKAGE / form
    return _forms(path.parent).get_template(path.name).render(facts)


def toml(value: Any) -> str:
    """A text or an array of texts, the same in TOML as in JSON."""
    return json.dumps(value, ensure_ascii=False)


@cache
def _forms(folder: Path) -> jinja2.Environment:
    forms = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=lambda name: name.endswith(".html"),
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    forms.filters["toml"] = toml
    forms.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    return forms
