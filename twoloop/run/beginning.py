"""A run that starts again and again by the same arrays, where its checks and choices come out alike."""

from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import Look
from twoloop.generate.choices import BOUNDS, LEAST, RANK, SINGULAR_MASS, Choice, Dependents
from twoloop.generate.straight_code import OwnCode
from twoloop.kernels.algebra.lapack import addresses
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import noted
from twoloop.kernels.data.flags import BANDWIDTH, FORM
from twoloop.kernels.layout import lasting, short_loops
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.asked import Asked
from twoloop.run.crossings import TURNED
from twoloop.run.interrupts import Interrupts
from twoloop.run.run import CONTRADICTS, Run
from twoloop.run.short_changes import WITHIN
from twoloop.run.workspace import GAMMA_ACCURACY

Array = NDArray[np.float64]

NEARER = 0.1  # of the smallest pivot at the start of the first run: below it, a start is looked at anew


class Beginning:
    """What `begin` and `go` of kernels/short_loops.py read and write.

    Parameters
    ----------
    run : Run
        At its start. Its clock, control and tolerances become parts of one array.
    system : ConstrainedSystem
        The one that is looked at.
    code : OwnCode or None
        The machine code that the plan of the run calls.
    definite : bool
        Whether M has an inverse.
    asked : Asked
        The options of the call.
    room : int
        For how many steps there is room.

    Attributes
    ----------
    look : Look
        What was found at the last start.
    t, rows, steps, filled, told : ndarray
        The states, the first included, and the steps that `go` made, how many, and what it tells of them.
    end : ndarray (1,)
        Where the run ends.
    """

    def __init__(
        self, run: Run, system: ConstrainedSystem, code: OwnCode | None, definite: bool, asked: Asked, room: int
    ):
        from twoloop.kernels.algebra import pivots
        from twoloop.kernels.evaluation import first_look

        self.names, self.look = short_loops(), Look(system)
        self._begin, self._go = direct(self.names.begin), direct(self.names.go)
        self.run, self._given = run, system.kit
        of_mass = 0 if system.constant_mass else first_look.DEFINITE if definite else first_look.INDEFINITE
        numbers, n_rows = np.concatenate([run.clock, run.control, run.tolerances]), system.n_c + system.n_a
        i, j = run.clock.size, run.clock.size + run.control.size
        run.clock, run.control, run.tolerances = numbers[:i], numbers[i:j], numbers[j:]
        memory, (of_work, integers) = run.plan.memory, lasting(run.work)
        choice = None if code is None else code.shared.equations.choice
        expected, scale = _expected(choice)
        self._dependents = None if choice is None else Dependents(system, choice.rows)
        blocks = [] if choice is None else [(i[0], i[-1], j[0], j[-1]) for i, j in choice.blocks]
        self._blocks = np.array(blocks, dtype=np.int64).ravel().data
        places = np.flatnonzero(memory.view(np.int64))  # -0 is not what is cleared
        of_start: tuple[float, ...]
        of_start = max(run.rtol, GAMMA_ACCURACY), run.reuse, 0.0 if run.plan.watchful else 1.0, RANK, scale, CONTRADICTS
        of_start += of_mass, NEARER * run.work.notes[noted.PIVOT], run.kit.flags[FORM]
        of_steps = asked.first_step or 0.0, run.least_atol, asked.max_step, run.plan.looks_within
        self.t, self.rows = np.empty(room + 1), np.empty((room + 1, len(run.state)))
        self.steps, self.told = np.empty((room, run.a.N_STEP_COLUMNS)), np.zeros(self.names.N_TOLD)
        self.end, self.filled = np.zeros(1), np.zeros(2, dtype=np.int64)
        self._known = known = SimpleNamespace(
            **self.look.arrays,
            **{"numbers": numbers, "begin_numbers": numbers.copy()},
            **{"memory": memory, "places": places, "begin_memory": memory[places]},
            **{"clock": run.clock, "control": run.control, "tolerances": run.tolerances, "options": run.plan.options},
            **{"state": run.state, "new_state": run.new_state, "lasting": of_work, "lasting_integers": integers},
            **{"saved": np.empty(numbers.size + of_work.size + run.state.size), "saved_integers": integers.copy()},
            **{"constants": np.array([*of_start, *of_steps, run.near, TURNED, WITHIN])},
            lapack=np.array(addresses() if run.kit.flags[BANDWIDTH] >= 0 else [], dtype=np.int64),
            **{"bounds": BOUNDS, "scratch": np.zeros(pivots.room_size(n_rows, system.n_q)), "expected": expected},
            chosen=np.zeros(2 + 3 * n_rows, dtype=np.int64),
            **{"end": self.end, "out_t": self.t, "out_rows": self.rows, "out_steps": self.steps},
            **{"told": self.told, "filled": self.filled, "look": first_look.look, "choose": pivots.choose},
            **{"start": run.kernels.start, "advance": run.kernels.advance},
        )
        known.table = self.names.AGAIN.table(known)
        known.address = known.table.ctypes.data

    def at(self, t: float, t1: float, q: Array, v: Array, interrupts: Interrupts) -> bool:
        """Whether a run to t1 is at its start at a state."""
        look, run, sure = self.look, self.run, False
        system = look.system
        weak = 0.0 if system.constant_mass and system.made.get("no weak mass", False) else SINGULAR_MASS
        while True:
            numbers = t, t1, q, v, look.sizes(), weak, sure
            try:
                code = self._begin(run.kit, self._given, run.work, self._known, *numbers)
            except Exception:  # of a callback, which is called by itself then
                return False
            if code != self.names.IN_DOUBT:
                break
            interrupts.listen()
            sure = look.is_surely(0, t, q, v)
            if not sure:
                return False
        dependents = self._dependents
        if code != self.names.READY or dependents is None or dependents.find is None:
            return bool(code == self.names.READY)
        n = dependents.find(look.rows, *dependents.arguments)  # whether the code is for the coordinates that rows give
        return bool(dependents.found[: 4 * n] == self._blocks)

    def go(self, t1: float, box: Array) -> int:
        """The first chunk of the steps from that start: how `advance` ended."""
        code: int = self._go(self.run.kit, self.run.work, self._known, t1, box, -1, -1)
        return code

    def tell(self, t1: float, box: Array, n_rows: int, n_steps: int) -> None:
        """Fill `told` after so many states, beside the first, and steps."""
        self._go(self.run.kit, self.run.work, self._known, t1, box, n_rows, n_steps)


def _expected(choice: Choice | None) -> tuple[NDArray[np.int64], float]:
    """A choice as kernels have it, and its scale."""
    if choice is None:
        return np.zeros(0, dtype=np.int64), 1.0
    place = int(np.searchsorted(-LEAST, -choice.least))
    numbers = place, len(choice.rows), len(choice.added), *choice.rows, *choice.added
    return np.array(numbers, dtype=np.int64), choice.scale
