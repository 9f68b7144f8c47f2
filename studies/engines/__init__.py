"""Engines and closed loops: what MuJoCo, Drake, Pinocchio and Exudyn are off by, and what an accuracy costs there."""

from studies.engines.study import main as main
