"""Audit of fixed-step simulators on mechanisms with rigid joints: errors, and the step and settings required."""

from twoloop.audit.mjcf_audit import MjcfAudit, audit_mjcf
from twoloop.audit.poses import coordinates
from twoloop.audit.step_audit import Audit, AuditedRun, audit_simulator

__all__ = ["Audit", "AuditedRun", "MjcfAudit", "audit_mjcf", "audit_simulator", "coordinates"]
