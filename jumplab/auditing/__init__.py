"""Independent audit of a finished plan: a second code path that shares nothing with the planner but URDF and tape."""

from jumplab.auditing.audit import audit
from jumplab.auditing.folder import write_audit
from jumplab.auditing.report import AuditReport, Check

__all__ = ["AuditReport", "Check", "audit", "write_audit"]
