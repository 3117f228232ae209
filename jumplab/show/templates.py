"""HTML by Jinja: what notebooks show of results, and pages."""

import base64
from pathlib import Path
from typing import Any

import jinja2

FORMS = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True)
FORMS.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")


def render(form: str, **facts: Any) -> str:
    """The HTML that a file of this folder makes of ``facts``, escaped where it is not ``safe``."""
    return FORMS.get_template(form).render(facts)
