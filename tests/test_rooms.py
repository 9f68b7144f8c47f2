"""The rooms of twoloop: imports go one way, no module has the name of another, nothing is flat but the calls."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import twoloop

FOLDER = Path(twoloop.__file__).parent
ROOMS = (  # from the lowest: each imports from itself and from those before it
    *("kernels.compile", "kernels.data", "kernels.algebra", "kernels.evaluation", "kernels.control", "kernels.steps"),
    *("kernels", "checks", "problem", "generate", "methods", "run", "mechanisms", "symbolic"),
    *("result", "solve", "sweeps"),
)
CALLS = {"__init__", "__main__", "solve"}  # flat


def name_of(path):
    return ".".join(path.relative_to(FOLDER).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(path): path for path in FOLDER.rglob("*.py")}


def imports_of(path):
    """Modules of twoloop that a file imports when it runs, wherever it says so; not those of annotations alone."""
    tree = ast.parse(path.read_text())
    for_types = {
        id(node)
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If) and "TYPE_CHECKING" in ast.unparse(branch.test)
        for node in ast.walk(branch)
    }
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and id(node) not in for_types and f"{node.module}.".startswith("twoloop."):
            package = f"{node.module}.".removeprefix("twoloop.")
            found |= {
                module if (module := f"{package}{alias.name}") in MODULES else package[:-1] for alias in node.names
            }
    return found - {""}


def room_of(module):
    """The room of a module; "" of the calls."""
    return max((room for room in ROOMS if f"{module}.".startswith(f"{room}.")), key=len, default="")


def test_no_import_goes_upwards():
    level = {room: k for k, room in enumerate((*ROOMS, ""))}
    upwards = [
        (module, other)
        for module, path in MODULES.items()
        for other in imports_of(path)
        if level[room_of(other)] > level[room_of(module)] or (not room_of(other) and module not in CALLS)
    ]
    assert upwards == []


def test_no_module_imports_itself_by_others():
    TopologicalSorter({module: imports_of(path) for module, path in MODULES.items()}).prepare()


def test_no_name_stands_twice():
    names = [path.stem for path in MODULES.values() if path.stem != "__init__"]
    assert sorted({name for name in names if names.count(name) > 1}) == []


def test_nothing_is_flat_but_the_calls():
    assert {path.stem for path in FOLDER.glob("*.py")} == CALLS
