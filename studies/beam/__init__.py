"""The stiff beam of Sect. 4.2: the paper's procedure beside Newton's method as the outer loop, IDA and others."""

from studies.beam.study import main as main
