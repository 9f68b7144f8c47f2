"""What step, and what settings, a simulator with fixed steps needs on a mechanism, against the motion of rigid joints."""

from twoloop.audit.mjcf_audit import MjcfAudit, audit_mjcf
from twoloop.audit.step_audit import Audit, AuditedRun, audit_simulator

__all__ = ["Audit", "AuditedRun", "MjcfAudit", "audit_mjcf", "audit_simulator"]
