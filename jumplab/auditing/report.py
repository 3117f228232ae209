"""Limits (``limits.toml``) and checks of an audit, and the report of them."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jumplab.errors import Shown
from jumplab.io.folder import to_json
from jumplab.robot import Robot
from jumplab.robot.legs import size

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
class Limit:
    """Limit of a check: ``limit`` in ``unit``; ``note`` is the text on the measurement, with
    braces.
    """

    group: str
    name: str
    limit: float
    unit: str
    note: str
    at_least: bool = False

    def check(
        self,
        values: ArrayLike,
        t: ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        numbers: Mapping[str, float | str] | None = None,
    ) -> Check:
        """Check of one value in SI units, or of the worst entry of (N,) or (N, M) values over the
        times ``t`` (N,) [s].

        ``labels`` (M,) name the columns, the worst one's is added to the note; ``numbers`` fill the
        note's braces. Not a number counts as worst; no rows at all give the limit itself, with no
        time, since nothing was there to break it.
        """
        x = np.asarray(values, float)
        time = None
        worst = self.limit
        where = " (nothing to check)"
        if x.size:
            ranked = np.where(np.isnan(x), np.inf, -x if self.at_least else x)
            at = np.unravel_index(np.argmax(ranked), x.shape)
            worst = float(x[at]) * SCALES.get(self.unit.split()[0].rstrip(","), 1.0) + 0.0  # no -0
            time = None if t is None else float(np.ravel(t)[at[0] if at else 0])
            where = f"; worst: {labels[at[1]]}" if labels is not None else ""
        note = self.note.format(**vars(METHOD) | dict(numbers or {})) + where
        return Check(self.group, self.name, worst, self.limit, self.unit, time, note, self.at_least)


SCALES = {"mm": 1e3, "mrad": 1e3, "ms": 1e3, "%": 100.0}  # from SI to the units of limits
_TABLE = tomllib.loads(Path(__file__).with_name("limits.toml").read_text(encoding="utf-8"))
METHOD = SimpleNamespace(**_TABLE.pop("method"))  # its numbers that are no limits
_GROWS = _TABLE.pop("grows")  # name of a number of METHOD or a limit -> its unit in `UNITS`
LIMITS = {
    name: Limit(group, name, *row) for group, rows in _TABLE.items() for name, row in rows.items()
}
METHOD.friction = LIMITS["friction used"].limit


def of_size(robot: Robot) -> tuple[SimpleNamespace, dict[str, Limit]]:
    """:data:`METHOD` and :data:`LIMITS` as they are for a ``robot`` of its size."""
    large = size(robot)
    method = vars(METHOD).copy()
    limits = LIMITS.copy()
    for name, unit in _GROWS.items():
        if name in method:
            method[name] = large.of(method[name], unit)
        else:
            limits[name] = replace(limits[name], limit=large.of(limits[name].limit, unit))
    return SimpleNamespace(**method), limits


# what a group of checks yields: the arguments of :meth:`.Replay.named`
Measure = tuple[Any, ...]


@dataclass(frozen=True, repr=False)
class AuditReport(Shown):
    """Outcome of an audit: the checks in the order they were made, and what was audited.

    ``capture`` is none of the checks: how far outside the soles the robot would come to rest from
    the momentum that it lands with; None of what is no standing jump. A plan can be sound and still
    not be caught.
    The manifest has robot and its hash, target, number of samples, package versions;
    :func:`jumplab.auditing.write_audit` adds the plan's digest and the planner's own summary.
    """

    checks: tuple[Check, ...]
    manifest: dict = field(default_factory=dict)
    capture: Check | None = None

    def line(self) -> str:
        """Number of checks that passed, names of those that failed, and whether the jump lands too
        fast to be caught.
        """
        words = f"all {len(self.checks)} checks passed"
        if not self.passed:
            names = ", ".join(c.name for c in self.failed)
            words = f"{len(self.failed)} of {len(self.checks)} checks failed: {names}"
        return f"{words}; {self.uncaught}" if self.uncaught else words

    @property
    def sound(self) -> bool:
        """True if every check passed, and the landing can be caught as far as the capture point
        shows.
        """
        return self.passed and not self.uncaught

    @property
    def uncaught(self) -> str:
        """Reason why a landing can hardly be caught; empty if there is none."""
        c = self.capture
        if c is None or c.passed:
            return ""
        return (
            f"but it lands too fast to be caught: the {c.name} lies {c.value:.0f} {c.unit} outside "
            f"the soles, over the limit of {c.limit:g}; ask for less distance or rise"
        )

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
        capture = self.capture and asdict(self.capture)
        return to_json(verdict | {"checks": rows, "capture": capture, "manifest": self.manifest})

    def table(self) -> str:
        """Plain text: one line per check, then one line per failure that says what was measured."""
        width = max((len(c.name) for c in self.checks), default=0)
        lines = []
        for group, checks in itertools.groupby(self.checks, lambda c: c.group):
            lines.append(group)
            for c in checks:
                sense = ">=" if c.at_least else "<="
                when = "" if c.time is None else f"  at {c.time:.3f} s"
                lines.append(
                    f"  {'ok  ' if c.passed else 'FAIL'} {c.name:<{width}}  {c.value:>10.4g} "
                    f"{sense} {c.limit:<8.4g} {c.unit}{when}"
                )
        passed = len(self.checks) - len(self.failed)
        lines.append(f"{passed} of {len(self.checks)} checks passed")
        lines += [f"FAIL {c.name}: {c.note}" for c in self.failed]
        return "\n".join([*lines, self.uncaught] if self.uncaught else lines)
