"""python -m twoloop: what is installed, compile everything, solve a mechanism, audit MuJoCo; rows of solvers."""

import argparse
import os
import pkgutil
import platform
import sys
import time
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from twoloop import Result, __version__, kernels, mechanisms, solve_dae
from twoloop.audit.mjcf import audit_mjcf, check_ending
from twoloop.bodies import SpatialModel, from_mjcf, from_urdf
from twoloop.checks.arguments import needed
from twoloop.kernels.compile.caches import cache_folder
from twoloop.mechanisms.registry import problem_from
from twoloop.methods.presets import PRESETS
from twoloop.problem.problem import Problem
from twoloop.rows.leaderboard import leaderboard
from twoloop.rows.row_format import MAX_ERRORS, find_errors, read_lines

NEEDED = ("numpy", "scipy", "numba")
OPTIONAL = ("pandas", "pyarrow", "matplotlib", "pillow", "rich", "sympy", "dask")
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
TABLES, PICTURES, ANIMATIONS = (".csv", ".parquet"), (".png", ".svg", ".pdf"), (".html", ".gif", ".mp4")
READERS: dict[str, Callable[..., SpatialModel]] = {".xml": from_mjcf, ".mjcf": from_mjcf, ".urdf": from_urdf}
ENDINGS = (*TABLES, *PICTURES, *ANIMATIONS, ".npz")
PACKAGES = {  # modules without which such files cannot be written, and the packages that have them
    ".csv": (("pandas", "pandas"),),
    ".parquet": (("pandas", "pandas"), ("pyarrow", "pyarrow")),
    ".gif": (("PIL", "pillow"),),
    ".mp4": (("PIL", "pillow"),),
    **dict.fromkeys(PICTURES, (("matplotlib", "matplotlib"),)),
}


def info() -> None:
    """Print versions, where compiled code is kept, and threads."""

    def installed(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "not installed"

    print(f"twoloop {__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}")
    print(f"needed:   {', '.join(f'{package} {installed(package)}' for package in NEEDED)}")
    print(f"optional: {', '.join(f'{package} {installed(package)}' for package in OPTIONAL)}")
    rooms = (each.name for each in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}.") if each.ispkg)
    folder, *others = (cache_folder(package) for package in (kernels, *map(import_module, rooms)))
    if folder is None:
        print("cache:    none: no folder can be written; set NUMBA_CACHE_DIR to one that can, by you alone")
    else:
        files = [file for each in (folder, *others) if each is not None for file in each.glob("*.nbc")]
        size = sum(file.stat().st_size for file in files)
        state = f"{len(files)} compiled functions, {size / 1e6:.1f} MB" if files else "empty: python -m twoloop compile"
        print(f"cache:    {folder} ({state})")
    limits = ", ".join(f"{name}={os.environ.get(name, 'not set')}" for name in THREADS)
    print(f"threads:  {os.cpu_count()} cores; a run uses one, and its linear algebra what {limits} allow")


def compile_all() -> None:
    """Compile every kernel, or read it from the cache, one line for each file."""
    prefix = f"{kernels.__name__}."
    names = sorted(each.name for each in pkgutil.walk_packages(kernels.__path__, prefix) if not each.ispkg)
    began = time.perf_counter()
    for number, name in enumerate(names, 1):
        print(f"{number:3d} of {len(names)}  {name.removeprefix(prefix):30s}", end="", flush=True)
        before = time.perf_counter()
        import_module(name)
        print(f"{time.perf_counter() - before:7.1f} s", flush=True)
    print(f"ready after {time.perf_counter() - began:.1f} s")


def problem_of(where: str) -> Problem:
    """Return the problem of a file of MuJoCo or URDF, of FILE.py:FUNCTION, or the ready mechanism of that name."""
    reader = READERS.get(Path(where).suffix.lower())
    return problem_from(where) if reader is None else reader(where).problem()


def solve(given: argparse.Namespace) -> None:
    """Solve a problem, say how the run ended, and write the requested files."""
    files = [Path(name) for name in given.out]
    for file in files:
        if file.suffix.lower() not in ENDINGS:
            raise ValueError(f"--out takes files that end in {', '.join(ENDINGS)}; given {str(file)!r}")
        if not file.parent.is_dir():
            raise ValueError(f"--out: there is no folder {file.parent.resolve()}")
        for module, package in PACKAGES.get(file.suffix.lower(), ()):
            needed(module, package, f"--out {file}")
    problem = problem_of(given.where)
    if problem.drawing is None and any(file.suffix.lower() in ANIMATIONS for file in files):
        raise ValueError(f"{given.where} makes a problem without a drawing: give it drawing=twoloop.Drawing(...)")
    t_span = (problem.t_span[0], problem.t_span[1] if given.t_end is None else given.t_end)
    began = time.process_time()
    result = solve_dae(
        problem.system,
        t_span,
        problem.q0,
        problem.v0,
        method=given.method,
        rtol=given.rtol,
        atol=given.atol,
        compiled=given.compiled or "auto",
        progress=sys.stderr.isatty(),
    )
    spent, counts = time.process_time() - began, result.stats
    print(f"{problem.name}, {given.method}: {result.status.name}. {result.message}")
    print(f"{counts.n_accepted} steps, {counts.n_evaluations} evaluations")
    print(f"CPU time of the whole call {spent:.3g} s, of it in steps {counts.cpu_time:.3g} s")
    for file in files:
        write(result, file)
        print(f"wrote {file}")
    if not result.success:
        raise SystemExit(1)


def write(result: Result, file: Path) -> None:
    """Write a result to a file of the kind that its ending says."""
    ending = file.suffix.lower()
    if ending == ".csv":
        result.to_dataframe().to_csv(file)
    elif ending == ".parquet":
        result.to_dataframe().to_parquet(file)
    elif ending == ".npz":
        result.save(file)
    elif ending in PICTURES:
        result.plot(file)
    else:
        result.animate(file)


def audit(given: argparse.Namespace) -> None:
    """Compare MuJoCo's motion of a file with that of rigid loops, and write the requested files."""
    for file in given.out:
        check_ending(file)
        if not file.parent.is_dir():
            raise ValueError(f"--out: there is no folder {file.parent.resolve()}")
    audit = audit_mjcf(given.file, error=given.error, t_end=given.t_end, key=given.key)
    print(audit)
    for file in given.out:
        audit.write(file)
        print(f"wrote {file}")
    if not audit.advice:
        raise SystemExit(1)


def check_rows(files: Sequence[Path]) -> None:
    """Say what files of rows hold, or what is wrong with them: then, or without a row, raise SystemExit."""
    failed = False
    for file in files:
        rows, wrong = find_errors(read_lines(file))
        failed |= bool(wrong) or not rows
        for each in wrong[:MAX_ERRORS]:
            print(f"{file}: {each}")
        more = f", {len(wrong)} mistakes" if wrong else ""
        n_solvers, n_mechanisms = (len({row[name] for row in rows}) for name in ("solver", "mechanism"))
        print(f"{file}: {len(rows)} good rows, of {n_solvers} solvers on {n_mechanisms} mechanisms{more}")
        for name in sorted({row["mechanism"] for row in rows}.difference(mechanisms.__all__)):
            for near in get_close_matches(name, mechanisms.__all__, 1, 0.8):
                print(f"{file}: mechanism: {name!r} is taken for one of your own; the ready one is {near!r}")
        if not rows and not wrong:
            print(f"{file}: there is no row, a JSON object on a line of its own")
    if failed:
        raise SystemExit(1)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m twoloop", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("info", help="versions, where compiled code is kept, threads")
    commands.add_parser("compile", help="compile all kernels now: the first run then starts at once")
    one = commands.add_parser("solve", help="solve a mechanism and write tables, figures, animations")
    one.add_argument(
        "where",
        metavar="MECHANISM",
        help="FILE.py:FUNCTION, a function without arguments that returns a twoloop.mechanisms.Problem; MODEL.xml of "
        "MuJoCo or MODEL.urdf; or the name of a ready mechanism, such as four_bar",
    )
    one.add_argument("--method", default="auto", choices=list(PRESETS), metavar="NAME", help=", ".join(PRESETS))
    one.add_argument("--rtol", type=float, default=1e-8, help="default: 1e-8")
    one.add_argument("--atol", type=float, default=1e-8, help="default: 1e-8")
    one.add_argument(
        "--compiled", action="store_true", help="make machine code of the equations, of large mechanisms too"
    )
    one.add_argument("--t-end", type=float, help="s; default: the end of the problem's t_span")
    one.add_argument("--out", nargs="+", default=[], metavar="FILE", help=f"files, by ending: {', '.join(ENDINGS)}")
    loops = commands.add_parser("audit", help="what MuJoCo is off by on the closed loops of an MJCF file; what to set")
    loops.add_argument("file", metavar="MODEL.xml", help="a file with loops closed by connect or weld")
    loops.add_argument("--error", type=float, default=1e-3, help="wanted, m and of axes; default: 1e-3")
    loops.add_argument("--t-end", type=float, default=2.0, help="s; default: 2")
    loops.add_argument("--key", help="keyframe to start from; default: the pose of the file, at rest")
    loops.add_argument("--out", nargs="+", default=[], type=Path, metavar="FILE", help="files, .json or .csv")
    rows = commands.add_parser("rows", help="rows of runs of solvers, as docs/reference/rows.md has their format")
    checked = rows.add_subparsers(dest="what", required=True).add_parser("check", help="say what is wrong with files")
    checked.add_argument("files", nargs="+", type=Path, metavar="FILE", help=".jsonl, or .jsonl.gz")
    board = commands.add_parser("leaderboard", help="which solver takes how long for an error on a mechanism")
    board.add_argument("--mechanism", required=True, metavar="NAME", help="such as four_bar; a wrong name lists all")
    board.add_argument("--error", type=float, default=1e-6, help="default: 1e-6")
    board.add_argument("--t-end", type=float, help="s; default: all ends that there are rows of")
    board.add_argument("--with", dest="files", nargs="+", default=[], type=Path, metavar="FILE", help="further rows")
    board.add_argument("--out", type=Path, metavar="FILE", help=f"a picture, by ending: {', '.join(PICTURES)}")
    return parser


def main(words: Sequence[str] | None = None) -> None:
    """Run a command; a wrong argument ends the process with one line and a status that is not 0."""
    given = parser().parse_args(words)
    try:
        if given.command == "info":
            info()
        elif given.command == "compile":
            compile_all()
        elif given.command == "audit":
            audit(given)
        elif given.command == "rows":
            check_rows(given.files)
        elif given.command == "leaderboard":
            print(leaderboard(given.mechanism, given.error, given.files, given.t_end, given.out))
        else:
            solve(given)
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
