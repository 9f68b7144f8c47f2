"""Steps by their names: the module of one is imported, and with that compiled or loaded, when a run needs it."""

from importlib import import_module
from typing import Any, NamedTuple

from twoloop.kernels.data.common import Step


class NamedStep(NamedTuple):
    """A step of this name in a module of this folder."""

    module: str
    name: str


LOADED: dict[NamedStep, Step] = {}


def loaded(step: Any) -> Any:
    """A step that may be given by its name."""
    if isinstance(step, NamedStep) and step not in LOADED:
        LOADED[step] = getattr(import_module(f"{__package__}.{step.module}"), step.name)
    return at_hand(step)


def at_hand(step: Any) -> Any:
    """The same without loading it: in its place one that asks for it."""
    if not isinstance(step, NamedStep):
        return step
    from twoloop.kernels.steps.asking_step import ASKING

    return LOADED.get(step, ASKING)
