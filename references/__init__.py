"""Adapters that run the mechanisms of twoloop with other solvers; each returns a `twoloop.result.result.Result`."""
