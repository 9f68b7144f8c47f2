"""Random linkages, sizes, masses and long runs: no answer of ours may be wrong and silent."""

from studies.robustness.study import main as main
