"""The mechanisms of twoloop through other solvers; every adapter of one returns a `twoloop.result.result.Result`."""
