"""Where jumps begin to fail: for each disturbance, the largest size at which at least 95 % of the robots land."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import joblib

from jumplab.errors import InputError, Shown, quoted
from jumplab.io import folder as store
from jumplab.io.progress import tell
from jumplab.sim import Ranges, Scene
from jumplab.studies import trials as series
from jumplab.studies.trials import TrialKey, TrialSettings, wilson

SCHEMA, NAME = "jumplab-margins-1", "margins.json"
Probe = tuple[float, int, int]  # share of the limits, robots that landed, robots tried
WANTED = 0.95  # share of robots that shall land
STEPS = 4  # of the bisection: to a sixteenth of the largest size
SINGLE = tuple(f.name for f in fields(Ranges))
PAIRS = ("payload_kg+friction", "ground_m+ground_tilt_deg", "shove_flight_n_s+delay_s")


def ranges_at(names: str, share: float) -> Ranges:
    """Nothing differs but the disturbances in ``names`` (one, or several with a + between), at a share of their limit.

    Pairs of numbers become one: each robot has exactly that much. Half-widths and the delay, whose middle is known, are
    drawn up to there. Friction falls. Raises :class:`InputError` for names that :class:`Ranges` lacks.
    """
    known, found = {f.name: f for f in fields(Ranges)}, {}
    for name in names.split("+"):
        if name not in known:
            raise InputError(f"no disturbance is called {quoted(name)}; there are {', '.join(known)}")
        size = _size(name, share)
        found[name] = (0.0, size) if name == "delay_s" else (size, size)
        if not isinstance(known[name].default, tuple):
            found[name] = size
    return Ranges.none(**found)


def _size(name: str, share: float) -> float:
    """A disturbance's size at a share of the way from nothing to its limit, in its own unit."""
    limit = next(f.metadata for f in fields(Ranges) if f.name == name)
    nothing = getattr(Ranges.none(), name)
    nothing = nothing[0] if isinstance(nothing, tuple) else nothing
    return (1 - share) * nothing + share * limit["least" if name == "friction" else "most"]


@dataclass(frozen=True)
class Margin:
    """How much of one disturbance, or of several together, a plan bears."""

    names: str  # as in :func:`ranges_at`
    reaim: bool  # whether the legs were re-aimed
    share: float  # largest tried share of the limits at which enough land; 0 if they do not even without it
    landed: int  # robots that landed there ...
    tried: int  # ... of so many
    probes: tuple[Probe, ...]  # in the order of the search

    @property
    def sizes(self) -> dict[str, float]:
        """The disturbances there, each in the unit that its name tells."""
        return {name: _size(name, self.share) for name in self.names.split("+")}

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the share that lands there."""
        return wilson(self.landed, self.tried)

    def row(self) -> dict[str, Any]:
        """A line of a table."""
        size = ", ".join(f"{size:.3g}" for size in self.sizes.values())
        low, high = self.interval
        found = {"disturbance": self.names, "re-aim": self.reaim, "bears": ("≥ " if self.share == 1 else "") + size}
        return found | {"share of the limit": self.share, "land": f"{self.landed} of {self.tried}",
                        "interval": f"{low:.0%} ... {high:.0%}"}  # fmt: skip


@dataclass(frozen=True, repr=False)
class MarginReport(Shown):
    """The margins of one plan in one engine."""

    margins: tuple[Margin, ...]
    engine: str
    n: int  # robots per size
    target: dict[str, float]
    step: bool = False  # whether one recovery step was allowed
    feedback: bool = False  # whether the launch was corrected

    def line(self) -> str:
        """How many disturbances are borne to their limits."""
        whole = sum(m.share == 1 for m in self.margins)
        how = ", one recovery step allowed" * self.step + ", launch corrected" * self.feedback
        return f"{len(self.margins)} margins in {self.engine}{how}, {whole} of them at the limit of what is tried"

    def to_json(self) -> dict[str, Any]:
        """The content of ``margins.json``."""
        rows = [asdict(m) | {"sizes": m.sizes, "interval": m.interval} for m in self.margins]
        said = dict(schema=SCHEMA, wanted=WANTED, engine=self.engine, n=self.n, step=self.step, feedback=self.feedback)
        said |= dict(target=self.target, margins=rows)
        return said | {"versions": store.versions()}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> MarginReport:
        """Inverse of :meth:`to_json`; raises :class:`InputError` for other data."""
        try:
            rows = [{f.name: row[f.name] for f in fields(Margin)} for row in data["margins"]]
            found = [Margin(**(row | {"probes": tuple(map(tuple, row["probes"]))})) for row in rows]
            answers = (data.get(name, False) for name in ("step", "feedback"))
            return cls(tuple(found), data["engine"], data["n"], dict(data["target"]), *answers)
        except (KeyError, TypeError) as e:
            raise InputError(f"not the margins of a plan ({type(e).__name__}); make them with 'jumplab margins'") from e


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
    """Find the margin of each disturbance for the plan in ``folder``, without re-aim and with it; write
    ``trials.jsonl`` and ``margins.json`` there.

    ``n`` robots jump at a size, the same ones at each, until too many have failed; first at the limit, then by
    ``steps`` of a bisection. ``settings.ranges`` and ``settings.reaim`` are not used. The rest, and what is raised, is
    as in :func:`jumplab.studies.trials.run_trials`.
    """
    series.check_numbers(n, seed, jobs)
    for name in names:
        ranges_at(name, 0.0)
    tape, robot, summary = store.read_plan(folder)
    tape.require_jump()
    scene, plan = Scene.of_plan(summary, robot), series.plan_hash(summary)

    at_once = jobs or joblib.cpu_count()

    def probe(names: str, reaim: bool, share: float) -> Probe:
        how, landed, tried = replace(settings, ranges=ranges_at(names, share), reaim=reaim), 0, 0
        known = how.hash
        while tried < n and enough(landed + n - tried, n):
            keys = [TrialKey(seed, k, known, plan) for k in range(tried, min(tried + at_once, n))]
            work = {key: joblib.delayed(series.run_trial)(tape, robot, scene, how, key) for key in keys}
            done = series.run_series(folder, work, jobs, progress)[0]
            landed, tried = landed + sum(trial.landed for trial in done), tried + len(done)
        return share, landed, tried

    found = []
    for number, (name, reaim) in enumerate(product(names, (False, True))):
        tell(f"margin of {name}", number, 2 * len(names))
        found.append(_bisected(name, reaim, steps, n, partial(probe, name, reaim)))
    report = MarginReport(tuple(found), settings.engine, n, dict(summary["target"]), settings.step, settings.feedback)
    store.write_trials(folder, report.to_json(), summary, NAME)
    return report


def enough(landed: int, tried: int) -> bool:
    """Whether so many are 95 %."""
    return landed >= math.ceil(WANTED * tried - 1e-9)


def _bisected(names: str, reaim: bool, steps: int, n: int, probe: Callable[[float], Probe]) -> Margin:
    """The margin of ``names``: the limit is tried, then nothing, then ``steps`` shares between."""
    probes = [probe(1.0)]

    def good() -> bool:
        return probes[-1][2] == n and enough(probes[-1][1], n)

    best, high = probes[-1], 1.0
    if not good():
        probes.append(probe(0.0))
        best = probes[-1]
        for _ in range(steps if good() else 0):
            probes.append(probe((best[0] + high) / 2))
            if good():
                best = probes[-1]
            else:
                high = probes[-1][0]
    return Margin(names, reaim, *best, tuple(probes))
