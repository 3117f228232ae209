"""The page of a certificate: how far the engines are apart, in one file without scripts."""

from __future__ import annotations

from pathlib import Path

from jumplab.show.style import LANDING, VERMILION, describe_task
from jumplab.show.tables import table
from jumplab.show.viewer import Page, filled
from jumplab.studies.certify import COLUMNS, CONDITIONS, Certificate


def certificate_page(certificate: Certificate) -> Page:
    """The page of a :class:`jumplab.studies.certify.Certificate`, by ``certificate.html``."""
    title = f"Certificate: {describe_task(certificate.task)}"
    modes = certificate.modes
    return filled(
        Path(__file__).with_suffix(".html"),
        title,
        certificate=certificate,
        conditions=CONDITIONS,
        color=LANDING if certificate.passed else VERMILION,
        tables=[table(mode.differences, COLUMNS, digits=3)._repr_html_() for mode in modes],
    )
