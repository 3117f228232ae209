"""What an audit says: checks with values and limits, as an object, as text and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

SCHEMA = "jumplab-passport-1"


@dataclass(frozen=True)
class Check:
    """One audited quantity.

    Attributes
    ----------
    group : dynamics, tape, contact, joints, target or collision.
    name : unique in a passport.
    value, limit : worst value found and what is allowed, in ``unit``.
    unit : of both.
    time : when the worst value occurs [s], None if it has no instant.
    note : one line that says what is measured, and where the worst value sits.
    at_least : True if the value must not be below the limit, False if not above.
    """

    group: str
    name: str
    value: float
    limit: float
    unit: str
    time: float | None
    note: str
    at_least: bool = False

    @property
    def passed(self) -> bool:
        """True if the value keeps the limit; a value that is not a number never does."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def worst(
    group: str,
    name: str,
    values: np.ndarray,
    t: np.ndarray,
    limit: float,
    unit: str,
    note: str,
    *,
    at_least: bool = False,
    labels: Sequence[str] | None = None,
) -> Check:
    """Check of the worst entry of ``values`` (N,) or (N, M) over the times ``t`` (N,).

    ``labels`` (M,) name the columns; the worst one's is added to the note. Not a number counts as worst; no rows at all
    give the limit itself, with no time, since nothing was there to break it.
    """
    values = np.asarray(values, float)
    if values.size == 0:
        return Check(group, name, limit, limit, unit, None, f"{note} (nothing to check)", at_least)
    ranked = np.where(np.isnan(values), np.inf, -values if at_least else values)
    at = np.unravel_index(int(np.argmax(ranked)), values.shape)
    if labels is not None:
        note = f"{note}; worst: {labels[at[1]]}"
    value = float(values[at]) + 0.0  # no minus zero
    return Check(group, name, value, limit, unit, float(t[at[0]]), note, at_least)


@dataclass(frozen=True)
class AuditReport:
    """Outcome of an audit.

    Attributes
    ----------
    checks : in the order they were made.
    manifest : robot and its hash, target, number of samples, package versions; :func:`write_audit` adds the plan's
        digest and the planner's own summary.
    """

    checks: tuple[Check, ...]
    manifest: dict = field(default_factory=dict)

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
        for check in self.checks:
            if check.name == name:
                return check
        raise KeyError(name)

    def to_json(self) -> str:
        """JSON text, strict (a value that is not finite is written as null)."""
        rows = [{**asdict(c), "passed": c.passed} for c in self.checks]
        data = {"schema": SCHEMA, "passed": self.passed, "failed": [c.name for c in self.failed], "checks": rows,
                "manifest": self.manifest}  # fmt: skip
        return json.dumps(_finite(data), indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    def table(self) -> str:
        """Plain text: one line per check, then one line per failure that says what was measured."""
        width = max((len(c.name) for c in self.checks), default=0)
        lines, group = [], None
        for c in self.checks:
            if c.group != group:
                group = c.group
                lines.append(f"{group}")
            sense = ">=" if c.at_least else "<="
            when = "" if c.time is None else f"  at {c.time:.3f} s"
            mark = "ok  " if c.passed else "FAIL"
            lines.append(f"  {mark} {c.name:<{width}}  {c.value:>10.4g} {sense} {c.limit:<8.4g} {c.unit}{when}")
        bad = self.failed
        lines.append(f"{len(self.checks) - len(bad)} of {len(self.checks)} checks passed")
        return "\n".join(lines + [f"FAIL {c.name}: {c.note}" for c in bad])


def _finite(x):
    if isinstance(x, dict):
        return {str(k): _finite(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_finite(v) for v in x]
    if isinstance(x, (float, np.floating)):
        return float(x) if math.isfinite(x) else None
    if isinstance(x, (np.integer, np.bool_)):
        return x.item()
    return x
