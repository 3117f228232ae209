"""Independent audit of a finished plan: a second code path that shares nothing with the planner but
robot and tape.

In comes a tape with its robot, out goes an :class:`AuditReport`. Start reading at :func:`audit`;
every limit stands in ``limits.toml``.
"""

from jumplab.auditing.audit import audit, write_audit
from jumplab.auditing.report import AuditReport, Check

__all__ = ["AuditReport", "Check", "audit", "write_audit"]
