"""Solvers of other projects as their own documentation shows them, a file each, found by its place.

A file has `NAME`, as tables show it, `PACKAGE`, as pip knows it, `DRIFTS`, whether nothing keeps its positions on the
constraints, and `simulate(problem, times, tolerance)`, which `twoloop.testing.check_simulator` and
`python -m studies.compare --solver` take. Packages are imported when it is called.
"""
