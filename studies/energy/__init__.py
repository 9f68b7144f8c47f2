"""Energy over long times: which methods let it drift, what a run without drift costs, and why."""

from studies.energy.study import main as main
