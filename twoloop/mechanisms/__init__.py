"""Ready problems, each with its invariants and, where one exists, a reference."""

from twoloop.mechanisms.ancf_beam import ancf_beam, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.andrews import andrews
from twoloop.mechanisms.bricard import bricard
from twoloop.mechanisms.chain import closed_chain, double_pendulum
from twoloop.mechanisms.driven_crank import driven_crank
from twoloop.mechanisms.four_bar import four_bar
from twoloop.mechanisms.governor import governor
from twoloop.mechanisms.heavy_top import heavy_top
from twoloop.mechanisms.knife_edge import knife_edge
from twoloop.mechanisms.n_four_bar import n_four_bar
from twoloop.mechanisms.pendulum import pendulum, projection_pendulum
from twoloop.mechanisms.problem import Condition, Problem, Reference
from twoloop.mechanisms.rolling_disc import rolling_disc
from twoloop.mechanisms.slider_crank import driven_slider_crank, redundant_slider_crank
from twoloop.mechanisms.spatial_four_bar import spatial_four_bar
from twoloop.mechanisms.spatial_slider_crank import spatial_slider_crank
from twoloop.mechanisms.sundials_slider_crank import sundials_slider_crank

__all__ = [
    "Condition",
    "Problem",
    "Reference",
    "ancf_beam",
    "andrews",
    "bricard",
    "closed_chain",
    "double_pendulum",
    "driven_crank",
    "driven_slider_crank",
    "four_bar",
    "governor",
    "heavy_top",
    "knife_edge",
    "moderately_stiff_beam",
    "n_four_bar",
    "pendulum",
    "projection_pendulum",
    "redundant_slider_crank",
    "rolling_disc",
    "spatial_four_bar",
    "spatial_slider_crank",
    "sundials_slider_crank",
    "very_flexible_beam",
]
