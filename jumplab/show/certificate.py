"""The page of a certificate: how far the engines are apart, in one file without scripts."""

from __future__ import annotations

from importlib import resources

import matplotlib.colors as mcolors
from jinja2 import Template

from jumplab.show.style import LANDING, VERMILION, describe_task, made_with
from jumplab.show.tables import table
from jumplab.show.viewer import Page
from jumplab.studies.certify import COLUMNS, CONDITIONS, Certificate, ModeReport


def certificate_page(certificate: Certificate) -> Page:
    """The page of a :class:`jumplab.studies.certify.Certificate`, by ``certificate.html``."""
    title = f"Certificate: {describe_task(certificate.task)}"
    form = (resources.files("jumplab.show") / "certificate.html").read_text(encoding="utf-8")
    page = Template(form, autoescape=True).render(
        title=title,
        certificate=certificate,
        conditions=CONDITIONS,
        color=mcolors.to_hex(LANDING if certificate.passed else VERMILION),
        differences=_differences,
        made_with=made_with(),
    )
    return Page(page, title)


def _differences(report: ModeReport) -> str:
    return table(report.differences, COLUMNS, digits=3)._repr_html_()
