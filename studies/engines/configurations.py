"""Which engines are run, with which settings: as they come, and as they do best."""

from typing import Any, NamedTuple

from references.engines.engine import engines

OURS = "twoloop"  # the engine that is none
NAMES = {**{key: each.name for key, each in engines().items()}, OURS: "twoloop"}


class Configuration(NamedTuple):
    """An engine with settings; of ours they are `compiled` of solve_dae."""

    engine: str
    name: str
    settings: Any
    how: str
    everywhere: bool


CONFIGURATIONS = (
    *(
        Configuration(key, f"{engine.name}, {each.label}", each.settings, each.how, each.everywhere)
        for key, engine in engines().items()
        for each in engine.configured
    ),
    Configuration(OURS, f"{NAMES[OURS]}, default", "auto", "nothing", True),
    Configuration(OURS, f"{NAMES[OURS]}, compiled=True", True, "`compiled=True`", False),
)
AS_IT_COMES = "MuJoCo, default"  # in the table of what each is off by, beside the best of each engine
