"""Independent audit of a finished plan: a second code path that shares nothing with the planner but URDF and tape."""

from jumplab.passport.audit import audit
from jumplab.passport.folder import write_passport
from jumplab.passport.report import Check, Passport

__all__ = ["Check", "Passport", "audit", "write_passport"]
