"""The folders of twoloop, in layers, and their imports: for tests of these, and of the list in how_it_is_built.md."""

import ast
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "twoloop"
ROOMS = (  # from the lowest: each imports from itself and from those before it
    *("kernels.compile", "kernels.data", "kernels.linalg", "kernels.evaluation", "kernels.control", "kernels.steps"),
    *("kernels.paper", "kernels.lanes", "kernels", "checks", "problem", "generate", "methods", "run"),
    *("bodies", "mechanisms", "symbolic"),
    *("result", "solve", "impacts", "ensembles", "sweeps", "testing", "rows", "audit"),
)
CALLS = {"__init__", "__main__", "solve"}  # flat


def _name(path: Path) -> str:
    return ".".join(path.relative_to(FOLDER).with_suffix("").parts).removesuffix(".__init__")


MODULES = {_name(path): path for path in FOLDER.rglob("*.py")}


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    """Statements that run, at any depth: expressions have no imports, and are most of a tree."""
    for kind in ("body", "handlers", "orelse", "finalbody", "cases"):
        if kind == "body" and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        for inner in getattr(node, kind, ()):
            if isinstance(inner, ast.stmt):
                yield inner
            yield from _statements(inner)


def imports_of(path: Path) -> set[str]:
    """Modules of twoloop that a file imports when it runs, wherever it says so; not those of annotations alone."""
    found = set()
    for node in _statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith("twoloop."):
            package = f"{node.module}.".removeprefix("twoloop.")
            names = (f"{package}{alias.name}" for alias in node.names)
            found |= {name if name in MODULES else package[:-1] for name in names}
    return found - {""}


def room_of(module: str) -> str:
    """The room of a module; "" of the calls above all rooms."""
    return max((room for room in ROOMS if f"{module}.".startswith(f"{room}.")), key=len, default="")
