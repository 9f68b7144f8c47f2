"""What a mechanism is called in rows: a ready one by its function, another by its own name in letters and digits."""

import re

READY = {  # by the names of their problems, where these are others
    "Andrews' squeezing mechanism": "andrews",
    "SUNDIALS slider-crank": "sundials_slider_crank",
    "A01 pendulum": "pendulum",
    "A02, N = 2": "n_four_bar",
    "A04 Bricard": "bricard",
    "A05 governor": "governor",
    "closed chain of 4": "closed_chain",
    "four-bar 1, 2, 1.5 m on 3 m": "four_bar",
    "four-bar 0.8, 1.2, 1 m on 2 m": "four_bar_second",
    "ANCF beam, 4 elements, E = 2e+08 N/m^2, start='node'": "moderately_stiff_beam",
    "ANCF beam, 4 elements, E = 2e+06 N/m^2, start='node'": "very_flexible_beam",
}


def mechanism_of(name: str) -> str:
    """The name in rows of a problem, or of a case."""
    return READY.get(name) or re.sub(r"\W+", "_", name).strip("_").lower()
