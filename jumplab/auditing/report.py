"""What an audit looks at and says: limits (all in ``limits.toml``), checks against them, and the report they make."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from jumplab.errors import Shown
from jumplab.io.folder import to_json

SCHEMA = "jumplab-passport-1"


@dataclass(frozen=True)
class Check:
    """One audited quantity."""

    group: str  # tape, dynamics, contact, joints, target, collision or robot
    name: str  # unique in a report
    value: float  # the worst found
    limit: float  # what is allowed
    unit: str  # of both
    time: float | None  # when the worst value occurs [s], None if it has no instant
    note: str  # one line that says what is measured, and where the worst value sits
    at_least: bool = False  # True if the value must not be below the limit, False if not above

    @property
    def passed(self) -> bool:
        """True if the value keeps the limit; a value that is not a number never does."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True)
class Method:
    """Numbers of the audit that are no limits; the paper prints none of them."""

    min_samples: int = 10  # per phase: fewer are no motion
    mid_flight: tuple[float, float] = (0.3, 0.7)  # share of the flight: outside, the sole is near a surface
    cop_force_n: float = 50.0  # per foot: below, the CoP is a quotient of two small numbers
    heel_up_mm: float = 5.0  # heel height from which the foot counts as tipped
    friction_force_n: float = 10.0  # per foot: below, the ratio is taken to this force instead
    torsion_arm_m: float = 0.05  # half width of a sole: lever of the friction that resists turning on the spot
    torque_floor: float = 0.01  # of the peak torque: left at the speed limit, so that shares stay finite
    sole_points: int = 7  # along each edge of the sole: a platform's edge cannot pass between two of them
    same_level_m: float = 1e-3  # corners this close to the lowest one belong to the sole
    edge_room_m: float = 0.05  # from a sole to the edge of what it stands on: a playback that falls short still lands
    collision_step: int = 2  # samples: the fastest hand moves 2 cm meanwhile, and contact between links lasts longer
    block_m: float = 20.0  # size of the platform's block, larger than any jump


@dataclass(frozen=True)
class Limit:
    """What a check allows: ``limit`` in ``unit``; ``note`` says what is measured, with braces for what is found."""

    group: str
    name: str
    limit: float
    unit: str
    note: str
    at_least: bool = False

    def check(self, value: float, time: float | None = None, where: str = "", **found: object) -> Check:
        """Check of one value, which occurs at a time [s]; ``where`` is added to the note."""
        note = self.note.format(**asdict(METHOD), **found) + where
        return Check(self.group, self.name, value, self.limit, self.unit, time, note, self.at_least)

    def worst(self, values: np.ndarray, t: np.ndarray, labels: Sequence[str] | None = None, **found: object) -> Check:
        """Check of the worst entry of ``values`` (N,) or (N, M) over the times ``t`` (N,) [s].

        ``labels`` (M,) name the columns; the worst one's is added to the note. Not a number counts as worst; no rows at
        all give the limit itself, with no time, since nothing was there to break it.
        """
        values = np.asarray(values, float)
        if values.size == 0:
            return self.check(self.limit, None, " (nothing to check)", **found)
        ranked = np.where(np.isnan(values), np.inf, -values if self.at_least else values)
        at = np.unravel_index(int(np.argmax(ranked)), values.shape)
        where = "" if labels is None else f"; worst: {labels[at[1]]}"
        return self.check(float(values[at]) + 0.0, float(t[at[0]]), where, **found)  # no minus zero


METHOD = Method()
_TABLE = tomllib.loads(Path(__file__).with_name("limits.toml").read_text(encoding="utf-8"))
LIMITS = {name: Limit(group, name, *row) for group, rows in _TABLE.items() for name, row in rows.items()}


@dataclass(frozen=True, repr=False)
class AuditReport(Shown):
    """Outcome of an audit: the checks in the order they were made, and what was audited.

    The manifest tells robot and its hash, target, number of samples, package versions;
    :func:`jumplab.auditing.write_audit` adds the plan's digest and the planner's own summary.
    """

    checks: tuple[Check, ...]
    manifest: dict = field(default_factory=dict)

    def line(self) -> str:
        """How many checks passed, and which did not."""
        if self.passed:
            return f"all {len(self.checks)} checks passed"
        return f"{len(self.failed)} of {len(self.checks)} checks failed: {', '.join(c.name for c in self.failed)}"

    @property
    def passed(self) -> bool:
        """True if every check passed (and there was one)."""
        return bool(self.checks) and not self.failed

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that did not pass."""
        return tuple(c for c in self.checks if not c.passed)

    def __getitem__(self, name: str) -> Check:
        """The check of that name; raises KeyError if there is none."""
        return {c.name: c for c in self.checks}[name]

    def to_json(self) -> str:
        """JSON text, strict (a value that is not finite is written as null)."""
        rows = [asdict(c) | {"passed": c.passed} for c in self.checks]
        verdict = {"schema": SCHEMA, "passed": self.passed, "failed": [c.name for c in self.failed]}
        return to_json(verdict | {"checks": rows, "manifest": self.manifest})

    def table(self) -> str:
        """Plain text: one line per check, then one line per failure that says what was measured."""
        width = max((len(c.name) for c in self.checks), default=0)
        lines, group = [], None
        for c in self.checks:
            if c.group != group:
                group = c.group
                lines.append(group)
            sense = ">=" if c.at_least else "<="
            when = "" if c.time is None else f"  at {c.time:.3f} s"
            mark = "ok  " if c.passed else "FAIL"
            lines.append(f"  {mark} {c.name:<{width}}  {c.value:>10.4g} {sense} {c.limit:<8.4g} {c.unit}{when}")
        bad = self.failed
        lines.append(f"{len(self.checks) - len(bad)} of {len(self.checks)} checks passed")
        return "\n".join(lines + [f"FAIL {c.name}: {c.note}" for c in bad])
