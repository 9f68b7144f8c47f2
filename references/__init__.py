"""The mechanisms of twoloop through other people's solvers; every adapter returns a `twoloop.result.Result`."""
