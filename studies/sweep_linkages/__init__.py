"""Ten thousand random linkages: energy error and period of each, and how a sweep scales on two cores."""

from studies.sweep_linkages.study import main as main
