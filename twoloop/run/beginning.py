"""The arrays of a run that starts again and again, where its checks and choices come out alike."""

from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import Look
from twoloop.generate.choices import BOUNDS, LEAST, RANK, SINGULAR_MASS, Choice, Dependents
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.kernels.data import noted
from twoloop.kernels.data.flags import BANDWIDTH, FORM
from twoloop.kernels.layout import lasting, short_loops
from twoloop.kernels.linalg.band import addresses
from twoloop.run.asked import Asked
from twoloop.run.crossings import TURNED
from twoloop.run.run import CONTRADICTS, Run
from twoloop.run.short_changes import WITHIN
from twoloop.run.workspace import GAMMA_ACCURACY

Array = NDArray[np.float64]

NEARER = 0.1  # of the smallest pivot at the start of the first run: below it, a start is looked at anew


def arrays_of(
    run: Run, look: Look, code: GeneratedCode | None, definite: bool, asked: Asked, room: int
) -> SimpleNamespace:
    """The arrays that `go` of kernels/short_loops.py reads and writes, with room for so many steps.

    The run is at its start; its clock, control and tolerances become parts of one array. `look` is of its system, or of
    the one that it stands for; `code` is the machine code that its plan calls; `definite`: whether M has an inverse.
    """
    from twoloop.kernels.evaluation import checks as first_look
    from twoloop.kernels.linalg import rank as pivots
    from twoloop.kernels.linalg.dependent_columns import dependents as find

    loops, system = short_loops(), look.system
    of_mass = 0 if system.constant_mass else first_look.DEFINITE if definite else first_look.INDEFINITE
    numbers, n_rows = np.concatenate([run.clock, run.control, run.tolerances]), system.n_c + system.n_a
    i, j = run.clock.size, run.clock.size + run.control.size
    run.clock, run.control, run.tolerances = numbers[:i], numbers[i:j], numbers[j:]
    memory, (of_work, integers) = run.plan.memory, lasting(run.work)
    choice, nothing = None if code is None else code.shared.equations.choice, np.zeros(0, dtype=np.int64)
    expected, scale = _expected(choice)
    blocks = [] if choice is None else [(i[0], i[-1], j[0], j[-1]) for i, j in choice.blocks]
    dependents = Dependents(system, () if choice is None else choice.rows)
    search = dependents.arguments if dependents.find else (nothing, nothing, 0, np.zeros(0), nothing, nothing)
    places = np.flatnonzero(memory.view(np.int64))  # -0 is not what is cleared
    weak = 0.0 if system.constant_mass and system.made.get("no weak mass", False) else SINGULAR_MASS
    of_start: tuple[float, ...]
    of_start = max(run.rtol, GAMMA_ACCURACY), run.reuse, 0.0 if run.plan.watchful else 1.0
    of_start += np.array_equal(search[0] != 0, run.work.pattern.ravel() != 0.0), RANK, weak, scale, CONTRADICTS
    of_start += of_mass, NEARER * run.work.notes[noted.PIVOT], run.kit.flags[FORM]
    of_steps = asked.first_step or 0.0, run.least_atol, asked.max_step, run.plan.looks_within
    columns, width = run.a.N_STEP_COLUMNS, len(run.state)
    block = np.empty(loops.FRONT + 1 + (1 + columns) * room + width * (1 + room))
    told, states = np.split(block, [len(block) - width * (1 + room)])
    known = SimpleNamespace(
        **look.arrays,
        **{"numbers": numbers, "begin_numbers": numbers.copy()},
        **{"memory": memory, "places": places, "begin_memory": memory[places]},
        **{"clock": run.clock, "control": run.control, "tolerances": run.tolerances, "options": run.plan.options},
        **{"state": run.state, "new_state": run.new_state, "lasting": of_work, "lasting_integers": integers},
        **{"saved": np.empty(numbers.size + of_work.size + run.state.size), "saved_integers": integers.copy()},
        **{"constants": np.array([*of_start, *of_steps, run.near, TURNED, WITHIN])},
        lapack=np.array(addresses() if run.kit.flags[BANDWIDTH] >= 0 else [], dtype=np.int64),
        **{"bounds": BOUNDS, "scratch": np.zeros(pivots.room_size(n_rows, system.n_q)), "expected": expected},
        **{"chosen": np.zeros(2 + 3 * n_rows, dtype=np.int64), "blocks": np.array(blocks, dtype=np.int64).ravel()},
        **dict(zip(("kinds", "counted", "_", "search", "search_places", "found"), search, strict=True)),
        **{"begun": np.zeros(loops.BEGUN + 2 + 2 * system.n_q), "start_rows": run.work.rows_v.copy()},
        **{"end": np.zeros(1), "t": np.empty(room + 1), "states": states.reshape(room + 1, width)},
        **{"steps": np.empty((room, columns)), "filled": np.zeros(2, dtype=np.int64), "told": told, "block": block},
        **{"look": first_look.look, "choose": pivots.choose, "dependents": find},
        **{"start": run.kernels.start, "advance": run.kernels.advance},
    )
    known.table = loops.AGAIN.table(known)
    known.address = known.table.ctypes.data
    return known


def _expected(choice: Choice | None) -> tuple[NDArray[np.int64], float]:
    """A choice as kernels have it, and its scale."""
    if choice is None:
        return np.zeros(0, dtype=np.int64), 1.0
    place = int(np.searchsorted(-LEAST, -choice.least))
    numbers = place, len(choice.rows), len(choice.added), *choice.rows, *choice.added
    return np.array(numbers, dtype=np.int64), choice.scale
