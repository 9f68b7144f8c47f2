"""Presets: names of methods with their usual settings; and a key that equal methods share."""

from typing import Any

import numpy as np

from twoloop.methods.adams import Adams
from twoloop.methods.auto import Auto
from twoloop.methods.dop853 import DOP853
from twoloop.methods.lobatto import Lobatto16
from twoloop.methods.paper import BDF, Newmark, paper_irk, paper_newmark
from twoloop.methods.plan import Method
from twoloop.methods.runge_kutta import ESDIRK, RungeKutta
from twoloop.methods.tableaux import Tableau, gauss, radau_iia, sun_radau_iib
from twoloop.methods.taylor import Taylor

PRESETS: dict[str, Method] = {
    "auto": Auto(
        few=DOP853(),
        many=Adams(),
        series=Taylor(),
        loose=ESDIRK("TRBDF2"),
        tight=RungeKutta(radau_iia(3), outer="newton", tested="positions"),
        tightest=RungeKutta(radau_iia(5), outer="newton", tested="positions"),
        fixed=RungeKutta(sun_radau_iib(3), outer="auto"),
        lanes=Lobatto16(),
    ),
    "SunRadau5": RungeKutta(sun_radau_iib(3), outer="auto"),
    **{f"Gauss{2 * s}": RungeKutta(gauss(s)) for s in range(2, 9)},
    **{f"RadauIIA{2 * s - 1}": RungeKutta(radau_iia(s), outer="newton") for s in (3, 5, 7)},
    "TRBDF2": ESDIRK("TRBDF2"),
    "ESDIRK4": ESDIRK("ESDIRK4"),
    "Newmark": Newmark(),
    "BDF": BDF(),
    "Lobatto16": Lobatto16(),
    "DOP853": DOP853(),
    "Adams": Adams(),
    "Taylor": Taylor(),
    "PaperIRK": paper_irk(),
    "PaperNewmark": paper_newmark(),
}


OWN = (
    Adams,
    BDF,
    DOP853,
    ESDIRK,
    Lobatto16,
    Newmark,
    RungeKutta,
    Taylor,
)  # methods that are determined by the values of their options
PLAIN = (str, int, float, np.generic, type(None))  # types of such values, beside tableaux
_OF_PRESETS = frozenset(map(id, PRESETS.values()))


def is_preset(method: Any) -> bool:
    """Return whether a method is a preset or the name of one; these never change."""
    return isinstance(method, str) or id(method) in _OF_PRESETS


def identity(method: Method) -> Any:
    """Return a key shared by methods with the same options, by which runs are cached; None: the method has no key."""
    if is_preset(method):
        return id(method)
    if type(method) not in OWN:
        return None
    values = [value.content if type(value) is Tableau else value for value in vars(method).values()]
    return (type(method), *values) if all(isinstance(value, (*PLAIN, tuple)) for value in values) else None
