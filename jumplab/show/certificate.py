"""The page of a plan's certificate: how far the engines are apart, on any screen, in one file without scripts."""

from __future__ import annotations

from html import escape
from importlib import resources
from string import Template

import matplotlib.colors as mcolors

from jumplab.io.folder import versions
from jumplab.show.style import LANDING, VERMILION, describe_task
from jumplab.show.viewer import Page
from jumplab.sim.engine import engine_class
from jumplab.studies.certify import Certificate, Difference, ModeReport

WIDE, HIGH, SHOWN = 220, 24, 2.0  # [px] of a scale, and how many limits it shows; what is beyond lies at its end
SMALL = {"s": ("ms", 1e3), "m": ("mm", 1e3), "rad": ("°", 57.29577951308232), "rad/s": ("°/s", 57.29577951308232)}
GOOD, BAD = (mcolors.to_hex(color) for color in (LANDING, VERMILION))
CERTIFIED = "The audit is clean, and the engines agree: it lands."
KEY = (
    "On each scale the engines are apart by nothing on the left, by the limit at the line in the middle. Diamond: the "
    "robot as planned. Dots: perturbed robots, the same in all engines; the limits hold for their median."
)


def certificate_page(certificate: Certificate) -> Page:
    """The page of a :class:`jumplab.studies.certify.Certificate`."""
    title = f"Certificate: {describe_task(certificate.task)}"
    checks, robot = certificate.audit.checks, certificate.robot
    passed = len(checks) - len(certificate.audit.failed)
    facts = (
        f"Robot {robot.name}, {robot.total_mass:.1f} kg. Audit: {passed} of {len(checks)} checks passed. "
        f"{len(certificate.modes[0].pairs)} perturbed robots per mode, seed {certificate.seed}."
    )
    made = ", ".join(f"{name} {version}" for name, version in versions().items() if version != "not installed")
    conditions = certificate.modes[0].settings.conditions
    said = "; ".join(f"{name}: {text}" for name, text in conditions.items() if name != "playback")
    words = {
        "TITLE": title,
        "VERDICT": "The audit is clean, and the engines agree that it lands."
        if certificate.passed
        else "Not certified.",
        "FACTS": facts,
        "KEY": KEY,
        "FOOTER": f"Perturbed robots: {said}. Plan {certificate.plan}. Made with {made}.",
    }
    listed = "".join(f"<li>{escape(told)}</li>" for told in certificate.failures)
    parts = {
        "FAILURES": f"<ul>{listed}</ul>" if listed else "",
        "MODES": "\n".join(map(_mode, certificate.modes)),
        "COLOR": GOOD if certificate.passed else BAD,
        "BAD": BAD,
    }
    form = Template((resources.files("jumplab.show") / "certificate.html").read_text(encoding="utf-8"))
    return Page(form.substitute({name: escape(text) for name, text in words.items()} | parts), title)


def _mode(report: ModeReport) -> str:
    """Section of one mode."""
    rows = "\n".join(_row(d, report) for d in report.differences)
    landed = {name: sum(trial.landed for trial in jumps) for name, jumps in report.robots.items()}
    counts = ", ".join(f"{_title(name)} {count}" for name, count in landed.items())
    many = f"{report.same} of {len(report.pairs)} perturbed robots fare alike in all engines; they land: {counts}."
    planned = " ".join(f"{_title(name)}: {trial.reason}." for name, trial in report.planned.items())
    unlike = ((k, pair) for k, pair in enumerate(report.pairs) if len({t.landed for t in pair.values()}) > 1)
    told = [f"robot {k}: " + "; ".join(f"{_title(e)}: {t.reason}" for e, t in pair.items()) for k, pair in unlike]
    items = "".join(f"<li>{escape(text)}</li>" for text in told)
    head = f"<h2>{report.mode} mode</h2><p>{escape(planned)}</p>"
    return f"<section>{head}{rows}<p>{escape(many)}</p>{f'<ul>{items}</ul>' if items else ''}</section>"


def _row(difference: Difference, report: ModeReport) -> str:
    """One quantity: its values, a scale with all robots on it, and how far the engines are apart."""
    q, look = difference.quantity, "apart" if difference.within else "apart beyond"
    values = ", ".join(
        f"{_title(name)} {'-' if x is None else f'{x:.4g} {q.unit}'}" for name, x in difference.values.items()
    )
    unit, factor = ("%", 100.0) if q.relative else SMALL.get(q.unit, (q.unit, 1.0))
    apart = "-" if difference.apart is None else f"{factor * difference.apart:.2g}"
    said = f"{apart} of {factor * difference.limit:.3g} {unit}"
    dots = "".join(
        f'<circle cx="{_place(x / difference.limit):.1f}" cy="{HIGH / 2 + 5 * (k % 3 - 1)}" r="2.5" fill="#7a828e" '
        'fill-opacity="0.6"/>'
        for k, x in enumerate(report.apart(q))
    )
    mark = ""
    if difference.apart is not None:
        at, color = _place(difference.apart / difference.limit), GOOD if difference.within else BAD
        mark = f'<path d="M{at:.1f} 4l6 8l-6 8l-6 -8z" fill="{color}" stroke="#fff"/>'
    lines = f'<path d="M8 12H{WIDE - 8}" stroke="#c3c9d2"/><path d="M{_place(1.0):.1f} 2V22" stroke="#222"/>'
    scale = f'<svg viewBox="0 0 {WIDE} {HIGH}" role="img" aria-label="{escape(said)}">{lines}{dots}{mark}</svg>'
    name = f"<div>{escape(q.name)}<small>{escape(values)}</small></div>"
    return f'<div class="row">{name}{scale}<div class="{look}">{escape(said)}</div></div>'


def _place(share: float) -> float:
    """Where a share of the limit lies on the scale [px]."""
    return 8 + (WIDE - 16) * min(share, SHOWN) / SHOWN


def _title(engine: str) -> str:
    return engine_class(engine).title
