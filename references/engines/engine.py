"""What a file of this folder says of its engine in `ENGINE`, by which the studies find it."""

from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, NamedTuple

from references.engines.rigid import Prepared


class Configured(NamedTuple):
    """Settings with a label; `how` says in the engine's own words what is set."""

    label: str
    settings: Any
    how: str = "nothing"
    everywhere: bool = False  # run on every mechanism, also with motors, lighter bodies and turned


class Engine(NamedTuple):
    """An engine: its name, its package, its function prepare(rigid, settings), and with which settings it is run."""

    name: str
    package: str  # name of the package, which provides the version
    prepare: Callable[..., Prepared]
    most_rigid: Any  # settings with which its models are compared with the mechanism
    configured: tuple[Configured, ...]


@cache
def engines() -> dict[str, Engine]:
    """Return the engines of all modules in this folder, by the names of these."""
    names = sorted(each.name for each in iter_modules([str(Path(__file__).parent)]))
    modules = {name: import_module(f"references.engines.{name}") for name in names}
    return {name: module.ENGINE for name, module in modules.items() if hasattr(module, "ENGINE")}
