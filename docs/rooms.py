"""The folders of twoloop and the imports between them: for the picture in how_it_is_built.md, and for its test."""

import ast
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt

FOLDER = Path(__file__).resolve().parents[1] / "twoloop"
ROOMS = (  # from the lowest: each imports from itself and from those before it
    *("kernels.compile", "kernels.data", "kernels.algebra", "kernels.evaluation", "kernels.control", "kernels.steps"),
    *("kernels.lanes", "kernels", "checks", "problem", "generate", "methods", "run"),
    *("bodies", "mechanisms", "symbolic"),
    *("result", "solve", "impacts", "ensembles", "sweeps", "testing", "rows", "audit"),
)
CALLS = {"__init__", "__main__", "exported", "solve"}  # flat


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


def arrows() -> set[tuple[str, str]]:
    """Pairs of rooms, the first of which imports from the second."""
    pairs = {(room_of(name), room_of(other)) for name, path in MODULES.items() for other in imports_of(path)}
    return {(one, other) for one, other in pairs if one and other and one != other}


def levels() -> dict[str, int]:
    """How many rooms stand below each, one upon the other."""
    found: dict[str, int] = {}
    for room in ROOMS:
        found[room] = max((found[other] + 1 for one, other in arrows() if one == room), default=0)
    return found


def draw(path: Path) -> None:
    """Draw the rooms by level; an arrow leads to a room that is imported, unless others lead there."""
    level, pairs = levels(), arrows()
    rows: dict[int, list[str]] = {}
    for room, height in level.items():
        rows.setdefault(height, []).append(room)
    place = {room: (k - 0.5 * (len(row) - 1), height) for height, row in rows.items() for k, room in enumerate(row)}
    beyond = {(a, c) for a, b in pairs for b2, c in pairs if b == b2}  # over one room between
    figure, axes = plt.subplots(figsize=(6.4, 0.55 * (max(level.values()) + 2)), layout="constrained")
    for one, other in sorted(pairs - beyond):
        (x0, y0), (x1, y1) = place[one], place[other]
        bend = 0.3 if abs(y0 - y1) > 1 and x0 == x1 else 0.0  # around what lies between
        arrow = {
            "arrowstyle": "->",
            "color": "0.6",
            "shrinkA": 11,
            "shrinkB": 11,
            "connectionstyle": f"arc3,rad={bend}",
        }
        axes.annotate("", (x1, y1), (x0, y0), arrowprops=arrow)
    for room, (x, y) in place.items():
        colour = "#e8f0f8" if room.startswith("kernels") else "#f4f0e6"
        box = {"boxstyle": "round", "facecolor": colour, "edgecolor": "0.5"}
        axes.text(x, y, room.replace(".", "/"), ha="center", va="center", fontsize=9, bbox=box)
    width = 0.5 * max(map(len, rows.values()))
    axes.set(xlim=(-width - 0.4, width + 0.4), ylim=(-0.6, max(level.values()) + 0.6))
    axes.axis("off")
    figure.savefig(path)
    plt.close(figure)
