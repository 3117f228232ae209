"""What an audit says: checks with values and limits, as an object, as text and as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from jumplab.io.folder import to_json

SCHEMA = "jumplab-passport-1"


@dataclass(frozen=True)
class Check:
    """One audited quantity.

    Attributes
    ----------
    group : tape, dynamics, contact, joints, target, collision or robot.
    name : unique in a report.
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


@dataclass(frozen=True)
class AuditReport:
    """Outcome of an audit.

    Attributes
    ----------
    checks : in the order they were made.
    manifest : robot and its hash, target, number of samples, package versions; :func:`jumplab.auditing.write_audit`
        adds the plan's digest and the planner's own summary.
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
