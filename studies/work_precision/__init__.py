"""Every mechanism with every solver, ours and others': what each accuracy costs, and which solver to take."""

from studies.work_precision.study import main as main
