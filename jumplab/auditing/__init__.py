"""Independent audit of a finished plan: an implementation that shares nothing with the planner but
robot and tape.

In comes a tape with its robot, out goes an :class:`AuditReport`. Start reading at :func:`audit`;
every limit stands in ``limits.toml``. :func:`judge` asks the same of motion clips.
"""

from jumplab.auditing.audit import audit, write_audit
from jumplab.auditing.clip import ClipReport, judge
from jumplab.auditing.report import AuditReport, Check

__all__ = ["AuditReport", "Check", "ClipReport", "audit", "judge", "write_audit"]
