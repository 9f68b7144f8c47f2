"""One side of `studies.bench_commits`: runs methods by name, in a process whose folder is a commit's.

    python bench_side.py FOLDER < names > measurements

Each line of the input is a method, or "start"; each line of the output what one repetition took, as JSON. It needs
nothing of the commit but `solve_dae` and `mechanisms.four_bar`, so that it runs on old commits.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

START = "start"  # imports, compilation and a short first run
TOLERANCE = 1e-8
T_END, WARM_UP = 10.0, 0.1  # s of motion


def step(solve_dae: Callable[..., Any], problem: Any, method: str, t_end: float = T_END) -> dict[str, Any]:
    """Run a method on the four-bar; return the CPU time of a step, without the checks of the input, and counts."""
    options: dict[str, Any] = {"method": method, "rtol": TOLERANCE, "atol": TOLERANCE, "compiled": False}
    result = solve_dae(problem.system, (0.0, t_end), problem.q0, problem.v0, **options)
    if not result.success:
        raise RuntimeError(result.message)
    stats = result.stats
    counts = {"steps": stats.n_accepted, "evaluations": stats.n_evaluations}
    return {"cpu": stats.cpu_time / stats.n_accepted, "counts": counts}


def main() -> None:
    """Measure the methods of the input until it ends."""
    sys.path.insert(0, sys.argv[1])
    began = time.process_time()
    from twoloop import solve_dae
    from twoloop.mechanisms import four_bar

    problem, warm = four_bar(), set()
    step(solve_dae, problem, "auto", WARM_UP)
    answers: dict[str, Any] = {START: {"cpu": time.process_time() - began, "counts": {}}}
    for line in sys.stdin:
        name = line.strip()
        try:
            if name not in answers and name not in warm:
                step(solve_dae, problem, name)  # compiles
                warm.add(name)
            answer = answers.get(name) or step(solve_dae, problem, name)
        except Exception as error:  # a method that one of the commits does not have, or a run that fails there
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
