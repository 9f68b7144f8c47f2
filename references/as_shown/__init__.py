"""Solvers of other projects as shown in their documentation, one file each.

A file defines `NAME` for tables, `PACKAGE` for pip, `DRIFTS`, True if positions are not kept on the constraints, and
`simulate(problem, times, tolerance)` for `twoloop.testing.check_simulator` and `python -m studies.compare --solver`.
Packages are imported when it is called.
"""
