"""Which solver says so when it is wrong: every solver on every trap, right, said so, wrong and silent, or hung."""

from studies.honesty.study import main as main
