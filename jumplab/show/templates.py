"""Texts by Jinja: what notebooks show of results, pages, captions."""

import base64
from pathlib import Path
from typing import Any

import jinja2

FORMS = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent),
    autoescape=lambda name: not (name or "").endswith(".txt"),
)
FORMS.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")


def render(form: str, **facts: Any) -> str:
    """The text that a file of this folder makes of ``facts``; in HTML they are escaped."""
    return FORMS.get_template(form).render(facts)
