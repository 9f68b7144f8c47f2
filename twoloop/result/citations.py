"""What to cite for a result, as BibTeX."""

from twoloop.methods.presets import PRESETS
from twoloop.result.result import Result

SOFTWARE = """@software{twoloop,
  title = {twoloop: two-loop state-space integration of constrained mechanical systems},
  author = {{The twoloop contributors}},
  version = VERSION
}"""

ENTRIES = {
    "paper": """@article{zhang2016twoloop,
  title = {A two-loop procedure based on implicit {Runge--Kutta} method for index-3 {DAE} of constrained dynamic problems},
  author = {Zhang, L. and Zhang},
  journal = {Nonlinear Dynamics},
  year = {2016},
  doi = {10.1007/s11071-016-2682-8}
}""",  # noqa: E501
    "sun": """@article{sun2000,
  title = {A simple way constructing symplectic {Runge--Kutta} methods},
  author = {Sun, Geng},
  journal = {Journal of Computational Mathematics},
  volume = {18},
  pages = {61--68},
  year = {2000}
}""",
    "butcher": """@article{butcher1964,
  title = {Implicit {Runge--Kutta} processes},
  author = {Butcher, J. C.},
  journal = {Mathematics of Computation},
  volume = {18},
  pages = {50--64},
  year = {1964}
}""",
    "pryce": """@article{pryce2001,
  title = {A simple structural analysis method for {DAE}s},
  author = {Pryce, J. D.},
  journal = {BIT Numerical Mathematics},
  volume = {41},
  pages = {364--394},
  year = {2001}
}""",
    "jorba": """@article{jorba2005,
  title = {A software package for the numerical integration of {ODE}s by means of high-order {Taylor} methods},
  author = {Jorba, {\\`A}. and Zou, M.},
  journal = {Experimental Mathematics},
  volume = {14},
  pages = {99--117},
  year = {2005}
}""",
    "stiff": """@book{hairer1996,
  title = {Solving Ordinary Differential Equations {II}: Stiff and Differential-Algebraic Problems},
  author = {Hairer, E. and Wanner, G.},
  publisher = {Springer},
  edition = {2},
  year = {1996}
}""",
    "geometric": """@book{hairer2006,
  title = {Geometric Numerical Integration},
  author = {Hairer, E. and Lubich, C. and Wanner, G.},
  publisher = {Springer},
  edition = {2},
  year = {2006}
}""",
    "newmark": """@article{newmark1959,
  title = {A method of computation for structural dynamics},
  author = {Newmark, N. M.},
  journal = {Journal of the Engineering Mechanics Division},
  volume = {85},
  pages = {67--94},
  year = {1959}
}""",
    "brenan": """@book{brenan1996,
  title = {Numerical Solution of Initial-Value Problems in Differential-Algebraic Equations},
  author = {Brenan, K. E. and Campbell, S. L. and Petzold, L. R.},
  publisher = {SIAM},
  year = {1996}
}""",
    "explicit": """@book{hairer1993,
  title = {Solving Ordinary Differential Equations {I}: Nonstiff Problems},
  author = {Hairer, E. and N{\\o}rsett, S. P. and Wanner, G.},
  publisher = {Springer},
  edition = {2},
  year = {1993}
}""",
    "hosea": """@article{hosea1996,
  title = {Analysis and implementation of {TR-BDF2}},
  author = {Hosea, M. E. and Shampine, L. F.},
  journal = {Applied Numerical Mathematics},
  volume = {20},
  pages = {21--37},
  year = {1996}
}""",
    "kennedy": """@techreport{kennedy2016,
  title = {Diagonally Implicit {Runge}-{Kutta} Methods for Ordinary Differential Equations: A Review},
  author = {Kennedy, C. A. and Carpenter, M. H.},
  number = {NASA/TM-2016-219173},
  year = {2016}
}""",
    "krogh": """@incollection{krogh1974,
  title = {Changing stepsize in the integration of differential equations using modified divided differences},
  author = {Krogh, F. T.},
  booktitle = {Lecture Notes in Mathematics 362},
  pages = {22--71},
  year = {1974}
}""",
    "shampine": """@book{shampine1975,
  title = {Computer Solution of Ordinary Differential Equations},
  author = {Shampine, L. F. and Gordon, M. K.},
  year = {1975}
}""",
}

# by how the name of a method begins; the sources are those that the docstrings of the methods name
METHODS = {
    "Sun Radau IIB": ("sun",),
    "Gauss": ("butcher",),
    "Radau IIA": ("stiff",),
    "Lobatto IIIE": ("geometric",),
    "Newmark": ("newmark",),
    "BDF": ("brenan",),
    "TRBDF2": ("hosea",),
    "ESDIRK4": ("kennedy",),
    "DOP853": ("explicit",),
    "auto": ("explicit", "krogh", "shampine", "pryce", "jorba", "hosea", "stiff"),
    "Adams": ("krogh", "shampine"),
    "Taylor": ("pryce", "jorba"),
}


def citation(result: Result) -> str:
    """BibTeX of what a result was made with: the paper, its method, and this software.

    Parameters
    ----------
    result : Result
        Of `solve_dae`, or read from a file.

    Returns
    -------
    str
        Entries; print them into a .bib file. The comment at the head names the method with its options.

    Raises
    ------
    TypeError, ValueError
        If it is not a result, or one of another solver.
    """
    from twoloop import __version__

    if not isinstance(result, Result):
        raise TypeError(f"citation needs a result of solve_dae; given {type(result).__name__}")
    if not result.method:
        raise ValueError("this result was made by another solver, or by a version that did not note the method")
    keys = ["paper", *(key for name, known in METHODS.items() if result.method.startswith(name) for key in known)]
    if ", momenta" in result.method and "geometric" not in keys:
        keys.append("geometric")
    if any(outer in result.method for outer in (", auto", ", newton")) and "stiff" not in keys:
        keys.append("stiff")  # the outer loop is its simplified Newton
    preset = next((f' (method="{name}")' for name, known in PRESETS.items() if known.name == result.method), "")
    entries = [ENTRIES[key] for key in keys]
    return "\n\n".join([f"% {result.method}{preset}", *entries, SOFTWARE.replace("VERSION", f"{{{__version__}}}")])
