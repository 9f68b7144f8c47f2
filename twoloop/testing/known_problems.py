"""Problems with known motions, by name and by tag."""

from collections.abc import Iterable
from typing import Any

from twoloop.testing import linkages, pendulums, spatial_mechanisms
from twoloop.testing.known_problem import KnownProblem

TAGS = {
    "smoke": "a few that together take little time",
    "open chain": "no loop of bodies",
    "closed chain": "loops of bodies",
    "planar": "in a plane",
    "spatial": "in space",
    "driven": "constraints that depend on time",
    "redundant": "a row of C follows from the others",
    "singular": "C_q loses rank on the way",
    "stiff": "a vibration far faster than the motion",
    "mass ratio": "masses that differ by a factor of 1000",
    "no motion to the end": "the motion ends before the end of the span, which has to be said",
}

MAKERS = {
    maker.__name__: maker
    for maker in (
        *(pendulums.pendulum, pendulums.shaken_spring, linkages.driven_crank, linkages.four_bar),
        *(linkages.redundant_slider_crank, spatial_mechanisms.heavy_top, pendulums.out_of_reach),
        *(pendulums.double_pendulum, pendulums.heavy_end, pendulums.spherical_pendulum),
        *(pendulums.stiff_spring_pendulum, pendulums.closed_chain, pendulums.parallelogram),
        *(linkages.crank_rocker, linkages.slider_crank, linkages.driven_slider_crank, linkages.andrews),
        *(spatial_mechanisms.spatial_four_bar, pendulums.force_ends),
    )
}


def problems(tags: str | Iterable[str] | None = None) -> list[KnownProblem]:
    """Return problems with known motions in plain numpy, to test a simulator.

    Parameters
    ----------
    tags : str or sequence of str, optional
        Tags of `KnownProblem.tags` that the problems must have. None: all problems.

    Returns
    -------
    list of KnownProblem
        Problems with equations, initial state, and the known motion `reference`.

    Raises
    ------
    ValueError
        If a tag is unknown.

    Notes
    -----
    The motions in the wheel were computed by two different methods, whose agreement is stored in `Motion.digits`:
    twoloop's Gauss method, and SciPy's DOP853 on equations in minimal coordinates, or on the index-1 equations with
    projection.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> [problem.name for problem in problems("driven")]
    ['driven_crank', 'out_of_reach', 'driven_slider_crank']
    """
    wanted = listed("tags", () if tags is None else tags)
    for tag in wanted:
        if tag not in TAGS:
            raise ValueError(f"tags must be of {', '.join(TAGS)}; given {tag!r}")
    everything = (maker() for maker in MAKERS.values())
    return [problem for problem in everything if set(wanted) <= set(problem.tags)]


def named(choice: str | KnownProblem | Iterable[str | KnownProblem]) -> list[KnownProblem]:
    """Return the problems selected by "smoke", "all", a name, or names and problems."""
    if isinstance(choice, str) and choice in ("smoke", "all"):
        return problems("smoke" if choice == "smoke" else None)
    chosen: list[KnownProblem] = []
    for each in [choice] if isinstance(choice, KnownProblem) else listed("problems", choice):
        if isinstance(each, KnownProblem):
            chosen.append(each)
        elif isinstance(each, str) and each in MAKERS:
            chosen.append(MAKERS[each]())
        else:
            raise ValueError(f"problems must be 'smoke', 'all' or of {', '.join(MAKERS)}; given {each!r}")
    if not chosen:
        raise ValueError("problems must name at least one; given an empty list, on which everything would pass")
    return chosen


def listed(name: str, given: Any) -> list[Any]:
    """Return the elements of a list, or a single text as a list."""
    if not isinstance(given, Iterable):
        raise TypeError(f"{name} must be a list; given {given!r}")
    return [given] if isinstance(given, str) else list(given)
