"""What a simulator with fixed steps is off by on mechanisms with rigid joints, and which step and settings it needs."""

from twoloop.audit.mjcf_audit import MjcfAudit, audit_mjcf
from twoloop.audit.poses import coordinates
from twoloop.audit.step_audit import Audit, AuditedRun, audit_simulator

__all__ = ["Audit", "AuditedRun", "MjcfAudit", "audit_mjcf", "audit_simulator", "coordinates"]
