"""One side of `studies.bench_commits`: runs benchmarks by name, in a process whose folder is a commit's.

    python bench_side.py FOLDER < names > measurements

Each line of the input is the name of a benchmark, each line of the output what one repetition of it took, as JSON. It
needs nothing of the commit but `solve_dae` and `mechanisms.four_bar`, so that it runs on old commits.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

METHODS = ("Taylor", "Adams", "DOP853", "Gauss12", "SunRadau5", "RadauIIA5", "RadauIIA9", "BDF", "TRBDF2", "auto")
TOLERANCE = 1e-8
T_END = 10.0  # s of motion
WARM_UP = 0.1
SOL_POINTS = 10_000


Measured = tuple[dict[str, int], int, float | None]


def benchmarks(solve_dae: Callable[..., Any], problem: Any) -> dict[str, Callable[[], Measured]]:
    """By name, functions that return counts, by how many units the time is divided, and the time.

    The time is that of the integration, without the checks of the input; None: that of the call.
    """

    def run(method: str, **options: Any) -> Any:
        given = {"method": method, "rtol": TOLERANCE, "atol": TOLERANCE, "compiled": False} | options
        result = solve_dae(problem.system, (0.0, T_END), problem.q0, problem.v0, **given)
        if not result.success:
            raise RuntimeError(result.message)
        return result

    def step(method: str) -> Measured:
        stats = run(method).stats
        return {"steps": stats.n_accepted, "evaluations": stats.n_evaluations}, stats.n_accepted, stats.cpu_time

    def evaluation() -> Measured:
        stats = run("DOP853").stats
        return {"evaluations": stats.n_evaluations}, stats.n_evaluations, stats.cpu_time

    def motion() -> Measured:
        result = run("Adams", dense_output=True)
        times = [T_END * k / SOL_POINTS for k in range(SOL_POINTS)]
        result.sol(times)
        return {"points": SOL_POINTS}, 1, None

    made: dict[str, Callable[[], Measured]] = {"evaluation": evaluation, "sol": motion}
    for method in METHODS:
        made[f"step of {method}"] = lambda method=method: step(method)  # type: ignore[misc]
    return made


def main() -> None:
    """Measure what is asked for until the input ends."""
    sys.path.insert(0, sys.argv[1])
    began = time.process_time()
    from twoloop import solve_dae
    from twoloop.mechanisms import four_bar

    problem, warm = four_bar(), set()
    made = benchmarks(solve_dae, problem)
    solve_dae(problem.system, (0.0, WARM_UP), problem.q0, problem.v0)
    started = time.process_time() - began
    for line in sys.stdin:
        name = line.strip()
        try:
            if name == "compile":
                answer: dict[str, Any] = {"cpu": started, "counts": {}}
            else:
                if name not in warm:
                    made[name]()
                    warm.add(name)
                began = time.process_time()
                counts, units, seconds = made[name]()
                cpu = time.process_time() - began if seconds is None else seconds
                answer = {"cpu": cpu / units, "counts": counts}
        except Exception as error:  # a method that one of the commits does not have, or a run that fails there
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
