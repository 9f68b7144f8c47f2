"""The rooms of twoloop: imports go one way, no module has the name of another, nothing is flat but the calls."""

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


def test_no_name_stands_twice():
    names = [path.stem for path in rooms.MODULES.values() if path.stem != "__init__"]
    assert sorted({name for name in names if names.count(name) > 1}) == []


def test_nothing_is_flat_but_the_calls():
    assert {path.stem for path in rooms.FOLDER.glob("*.py")} == rooms.CALLS


def test_every_room_says_what_is_in_it_and_stands_on_the_page():
    page = (ROOT / "docs" / "how_it_is_built.md").read_text(encoding="utf-8")
    for room in set(rooms.ROOMS) - {"solve"}:
        about = (rooms.FOLDER / room.replace(".", "/") / "__init__.py").read_text(encoding="utf-8")
        assert about.startswith('"""') and f"**`{room.replace('.', '/')}/`**" in page
