"""The rooms of twoloop: imports go one way."""

import importlib.util
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]


def documentation(name):
    """A module of the documentation, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


rooms = documentation("rooms")


@cache
def imports():
    return {module: rooms.imports_of(path) for module, path in rooms.MODULES.items()}


def test_no_import_goes_upwards():
    level = {room: k for k, room in enumerate((*rooms.ROOMS, ""))}
    upwards = [
        (module, other)
        for module, others in imports().items()
        for other in others
        if level[rooms.room_of(other)] > level[rooms.room_of(module)]
    ]
    assert upwards == []


def test_no_module_imports_itself_by_others():
    TopologicalSorter(imports()).prepare()
