"""Cost against size: an evaluation of mechanisms of 3 to 3000 bodies, and chains beside others' solvers."""

from studies.scale.study import main as main
