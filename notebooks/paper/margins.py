"""Sizes of disturbances at which jumps begin to fail: for each one, the largest size at which at
least 95 % of the robots land.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import product
from pathlib import Path

import joblib
import numpy as np
from matplotlib.figure import Figure

from jumplab.arguments import checked
from jumplab.errors import InputError, Shown, quoted
from jumplab.io import folder as store
from jumplab.io.progress import tell
from jumplab.show import cards, tables
from jumplab.show.style import FLIGHT, INK, LANDING, LAUNCH, PAGE_IN, new_figure, themed, tint
from jumplab.sim import Ranges, is_pair
from jumplab.studies.study import Plain, check_numbers
from jumplab.studies.trials import PlanOnFile, TrialSettings, wilson

SCHEMA = "jumplab-margins-1"
NAME = "margins.json"
Probe = tuple[float, int, int]  # share of the limits, robots that landed, robots tried
WANTED = 0.95  # share of robots that shall land
STEPS = 4  # of the bisection: to a sixteenth of the largest size
# of each disturbance, in the unit of its name; friction falls
LIMITS = {f.name: f.metadata["least" if f.name == "friction" else "most"] for f in fields(Ranges)}
SINGLE = tuple(LIMITS)
MARKS = (LAUNCH, "o"), (FLIGHT, "s"), (INK, "^"), (LANDING, "D")  # of several reports
PAIRS = ("payload_kg+friction", "ground_m+ground_tilt_deg", "shove_flight_n_s+delay_s")


def ranges_at(names: str, share: float) -> Ranges:
    """Nothing differs but the disturbances in ``names`` (one, or several with a + between), at a
    share of their limit.

    Pairs of numbers become one: each robot has exactly that much. Half-widths and the delay, whose
    middle is known, are drawn up to there. Friction falls. Raises :class:`InputError` for names
    that :class:`Ranges` lacks.
    """
    ranges = {}
    for name in names.split("+"):
        if name not in LIMITS:
            raise InputError(
                f"no disturbance is called {quoted(name)}; there are {', '.join(LIMITS)}"
            )
        size = _size(name, share)
        ranges[name] = (0.0 if name == "delay_s" else size, size) if is_pair(name) else size
    return Ranges.none(**ranges)


def _size(name: str, share: float) -> float:
    """A disturbance's size at a share of the way from nothing to its limit, in its own unit."""
    nothing = getattr(Ranges.none(), name)
    nothing = nothing[0] if is_pair(name) else nothing
    return (1 - share) * nothing + share * LIMITS[name]


@dataclass(frozen=True)
class Margin:
    """Margin of a plan against one disturbance, or against several together."""

    names: str  # as in :func:`ranges_at`
    reaim: bool  # whether the legs were re-aimed
    # largest tried share of the limits at which enough land; 0 if they do not even without it
    share: float
    landed: int  # robots that landed there ...
    tried: int  # ... of so many
    probes: tuple[Probe, ...]  # in the order of the search

    @property
    def sizes(self) -> dict[str, float]:
        """The disturbances there, each in the unit of its name."""
        return {name: _size(name, self.share) for name in self.names.split("+")}

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the share that lands there."""
        return wilson(self.landed, self.tried)

    def row(self) -> Plain:
        """A line of a table."""
        size = ", ".join(f"{size:.3g}" for size in self.sizes.values())
        low, high = self.interval
        return {
            "disturbance": self.names,
            "re-aim": self.reaim,
            "tolerates": ("≥ " if self.share == 1 else "") + size,
            "share of the limit": self.share,
            "land": f"{self.landed} of {self.tried}",
            "interval": f"{low:.0%} ... {high:.0%}",
        }


@dataclass(frozen=True, repr=False)
class MarginReport(Shown):
    """The margins of one plan in one engine."""

    margins: tuple[Margin, ...]
    engine: str
    n: int  # robots per size
    target: dict[str, float]
    step: bool = False  # whether recovery steps were allowed
    feedback: bool = False  # whether the launch was corrected

    def line(self) -> str:
        """Number of disturbances that are tolerated up to the largest size tried."""
        whole = sum(m.share == 1 for m in self.margins)
        ways = ", recovery steps allowed" * self.step + ", launch corrected" * self.feedback
        return (
            f"{len(self.margins)} margins in {self.engine}{ways}, "
            f"{whole} of them at the largest size tried"
        )

    def to_json(self) -> Plain:
        """The content of ``margins.json``."""
        rows = [asdict(m) | {"sizes": m.sizes, "interval": m.interval} for m in self.margins]
        head = {"schema": SCHEMA, "wanted": WANTED, "versions": store.versions()}
        return head | {f.name: getattr(self, f.name) for f in fields(self)} | {"margins": rows}

    @classmethod
    def from_json(cls, data: Plain) -> MarginReport:
        """Inverse of :meth:`to_json` (``margins.json`` as read); raises :class:`InputError` for
        other data.
        """
        try:
            rows = [{f.name: row[f.name] for f in fields(Margin)} for row in data["margins"]]
            rows = [Margin(**row | {"probes": tuple(map(tuple, row["probes"]))}) for row in rows]
            ways = (data.get(name, False) for name in ("step", "feedback"))
            return cls(tuple(rows), data["engine"], data["n"], dict(data["target"]), *ways)
        except (KeyError, TypeError) as e:
            raise InputError(
                f"not the margins of a plan ({type(e).__name__}); make them with 'jumplab margins'"
            ) from e


@checked
def margins(
    folder: str | Path,
    names: Sequence[str] = (*SINGLE, *PAIRS),
    n: int = 20,
    seed: int = 0,
    settings: TrialSettings = TrialSettings(),
    *,
    steps: int = STEPS,
    jobs: int | None = None,
    progress: bool | None = None,
) -> MarginReport:
    """Find the margin [share of its limit] of each disturbance for the plan in ``folder``, without
    re-aim and with it;
    write ``trials.jsonl`` and ``margins.json`` there.

    ``n`` robots jump at a size, the same ones at each, until too many have failed; first at the
    limit, then by ``steps`` of a bisection. ``settings.ranges`` and ``settings.reaim`` are not
    used. The rest, and what is raised, is as in :func:`jumplab.studies.trials.run_trials`.
    """
    check_numbers(n, seed, jobs)
    for name in names:
        ranges_at(name, 0.0)
    plan = PlanOnFile.read(folder)
    at_once = jobs or joblib.cpu_count()

    def probe(names: str, reaim: bool, share: float) -> Probe:
        disturbed = replace(settings, ranges=ranges_at(names, share), reaim=reaim)
        landed = 0
        tried = 0
        while tried < n and enough(landed + n - tried, n):
            numbers = range(tried, min(tried + at_once, n))
            trials = study.results(plan.trials(disturbed, seed, numbers))
            landed += sum(trial.landed for trial in trials)
            tried += len(trials)
        return share, landed, tried

    margins = []
    with plan.study(jobs=jobs, progress=progress) as study:
        for number, (name, reaim) in enumerate(product(names, (False, True))):
            tell(f"margin of {name}", number, 2 * len(names))
            best, probes = _largest(partial(probe, name, reaim), n, steps)
            margins.append(Margin(name, reaim, *best, tuple(probes)))
    where = settings.engine, n, dict(plan.summary["target"]), settings.step, settings.feedback
    report = MarginReport(tuple(margins), *where)
    plan.write(NAME, report.to_json())
    return report


def enough(landed: int, tried: int) -> bool:
    """Whether ``landed`` of ``tried`` (both numbers of robots) are 95 %."""
    return landed >= math.ceil(WANTED * tried - 1e-9)


def _largest(probe: Callable[[float], Probe], n: int, steps: int) -> tuple[Probe, list[Probe]]:
    """The probe of the largest share at which enough of ``n`` robots land (of nothing, if they do
    not even there), and all: the limit, then nothing, then ``steps`` shares between.
    """
    probes = [probe(1.0)]
    best = probes[0]
    high = 1.0
    if enough(best[1], n):
        return best, probes
    best = probe(0.0)
    probes.append(best)
    for _ in range(steps if enough(best[1], n) else 0):
        probes.append(probe((best[0] + high) / 2))
        if enough(probes[-1][1], n):
            best = probes[-1]
        else:
            high = probes[-1][0]
    return best, probes


# the chart ------------------------------------------------------------------------------------
@checked
@themed
def margin_chart(reports: MarginReport | Mapping[str, MarginReport]) -> Figure:
    """The largest size of each disturbance that plans tolerate, as a share of the largest tried:
    plain, and with re-aim; one mark per report.

    Of several reports, by the names that the legend shall have, only the disturbances that two or
    more of them have. Raises :class:`InputError` for more reports than marks, or if nothing is left
    to show.
    """
    several = dict(reports) if isinstance(reports, Mapping) else {"": reports}
    for report in several.values():
        if not hasattr(report, "margins"):
            raise InputError(f"the chart shows reports of margins, got {quoted(report)}")
    counts = Counter(m.names for report in several.values() for m in report.margins if m.reaim)
    names = [name for name, count in counts.items() if count > 1 or len(several) == 1]
    if not names or len(several) > len(MARKS):
        given = f"{len(several)} reports with {len(names)} disturbances in two of them"
        most = f"up to {len(MARKS)} reports with disturbances in two of them"
        raise InputError(f"the chart shows {most}, got {given}")
    fig = new_figure(PAGE_IN, 0.9 + 0.3 * len(names))
    panels = fig.subplots(1, 2, sharey=True)
    rows = np.arange(len(names))[::-1]
    apart = 0.7 * (np.arange(len(several)) / max(len(several), 2) - 0.5)
    for ax, reaim in zip(panels, (False, True), strict=True):
        for k, (title, report) in enumerate(several.items()):
            shares = {m.names: 100 * m.share for m in report.margins if m.reaim == reaim}
            values = np.array([shares.get(name, np.nan) for name in names])
            color, marker = MARKS[k]
            ax.hlines(rows - apart[k], 0, values, color=tint(color, 0.5), linewidth=1.0)
            look = dict(color=color, marker=marker, linestyle="none", markersize=4, label=title)
            ax.plot(values, rows - apart[k], clip_on=False, zorder=3, **look)
        ax.set_title("re-aimed" if reaim else "plain")
        ax.set(xlim=(0, 100), xlabel="share of the largest size tried [%]")
        ax.set_yticks(rows, names)
        ax.grid(False, axis="y")
    if "" not in several:
        handles, labels = ax.get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper center", ncols=len(several))
    return fig


def _card(report: MarginReport) -> cards.Card:
    return tables.table([margin.row() for margin in report.margins], digits=3), margin_chart(report)


cards.CARDS["MarginReport"] = _card
