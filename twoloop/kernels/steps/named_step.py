"""Steps by their names: the module of one is imported, and with that compiled or loaded, when a run needs it."""

import sys
from importlib import import_module
from typing import Any, NamedTuple

from twoloop.kernels.data.common import Step


class NamedStep(NamedTuple):
    """A step of this name in a module of this folder."""

    module: str
    name: str

    @property
    def _path(self) -> str:
        return f"{__package__}.{self.module}"

    def loaded(self) -> Step:
        """The step itself."""
        step: Step = getattr(import_module(self._path), self.name)
        return step

    def at_hand(self) -> Step:
        """The step itself if it is loaded, else one that asks for it."""
        from twoloop.kernels.steps.asking_step import ASKING

        step: Step = getattr(sys.modules.get(self._path), self.name, ASKING)
        return step


def loaded(step: Any) -> Any:
    """A step that may be given by its name."""
    return step.loaded() if isinstance(step, NamedStep) else step


def at_hand(step: Any) -> Any:
    """The same of a step that a run may not come to."""
    return step.at_hand() if isinstance(step, NamedStep) else step
