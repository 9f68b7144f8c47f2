"""Load steps when a run needs them, because implicit ones take a third of the time of a cold first run."""

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from twoloop.kernels.control.step_size import commit_nothing
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, kernel
from twoloop.kernels.data.indices import NOT_LOADED


@kernel(ATTEMPT)
def stop_to_load(f, w, options, memory, t, h, tolerances, state, new_state):
    """Stop the run, so that its caller can load the step."""
    return Attempt(NOT_LOADED, np.inf, 0.0)


PLACEHOLDER = Step(stop_to_load, commit_nothing)


class LazyStep(NamedTuple):
    """Name of a step: its module, such as "steps.newton_step", and its name there."""

    module: str
    name: str


LOADED: dict[LazyStep, Step] = {}


def loaded(step: Any) -> Any:
    """Return a step; import its module first if it is a LazyStep."""
    if isinstance(step, LazyStep) and step not in LOADED:
        LOADED[step] = getattr(import_module(f"twoloop.kernels.{step.module}"), step.name)
    return without_loading(step)


def without_loading(step: Any) -> Any:
    """Return a step, or the placeholder if it is a LazyStep that nothing has loaded yet."""
    return LOADED.get(step, PLACEHOLDER) if isinstance(step, LazyStep) else step
