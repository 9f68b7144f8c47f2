"""Audit of fixed-step simulators on mechanisms with rigid joints: errors, and the step and settings required."""

from twoloop.audit.mjcf import MjcfAudit, audit_mjcf
from twoloop.audit.simulator import Audit, AuditedRun, audit_simulator, coordinates

__all__ = ["Audit", "AuditedRun", "MjcfAudit", "audit_mjcf", "audit_simulator", "coordinates"]
