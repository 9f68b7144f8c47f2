"""The start of a run from another state by the arrays of one before it, where its checks and choices come out alike."""

from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import Look
from twoloop.generate.choices import BOUNDS, LEAST, RANK, SINGULAR_MASS, Choice
from twoloop.generate.straight_code import OwnCode
from twoloop.kernels.algebra.lapack import addresses
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data.flags import BANDWIDTH
from twoloop.kernels.layout import lasting, short_loops
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.run import CONTRADICTS, Run
from twoloop.run.workspace import GAMMA_ACCURACY

Array = NDArray[np.float64]


class Beginning:
    """What `begin` of kernels/short_loops.py reads and writes.

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

    Attributes
    ----------
    look : Look
        What was found at the last start.
    lasting : tuple of ndarray
        What counts at the start of a run, beside its state.
    """

    def __init__(self, run: Run, system: ConstrainedSystem, code: OwnCode | None, definite: bool):
        from twoloop.kernels.algebra import pivots
        from twoloop.kernels.evaluation import first_look

        self.names, self.look = short_loops(), Look(system)
        self._begin = direct(self.names.begin)
        self.run, self._given = run, system.kit
        self._definite = 0 if system.constant_mass else first_look.DEFINITE if definite else first_look.INDEFINITE
        numbers, n_rows = np.concatenate([run.clock, run.control, run.tolerances]), system.n_c + system.n_a
        i, j = run.clock.size, run.clock.size + run.control.size
        run.clock, run.control, run.tolerances = numbers[:i], numbers[i:j], numbers[j:]
        memory, (of_work, integers) = run.plan.memory, lasting(run.work)
        self.lasting = numbers, memory, of_work, integers
        expected, scale = _expected(None if code is None else code.shared.equations.choice)
        places = np.flatnonzero(memory.view(np.int64))  # -0 is not what is cleared
        nearly = 0.0 if run.plan.watchful else 1.0
        banded = run.kit.flags[BANDWIDTH] >= 0
        self._known = known = SimpleNamespace(
            **self.look.arrays,
            **{"numbers": numbers, "begin_numbers": numbers.copy()},
            **{"memory": memory, "places": places, "begin_memory": memory[places]},
            **{"clock": run.clock, "state": run.state, "lasting": of_work, "lasting_integers": integers},
            constants=np.array([max(run.rtol, GAMMA_ACCURACY), run.reuse, nearly, RANK, scale, CONTRADICTS]),
            lapack=np.array(addresses() if banded else [], dtype=np.int64),
            **{"bounds": BOUNDS, "scratch": np.zeros(pivots.room_size(n_rows, system.n_q)), "expected": expected},
            chosen=np.zeros(2 + 3 * n_rows, dtype=np.int64),
            **{"look": first_look.look, "choose": pivots.choose, "start": run.kernels.start},
        )
        known.table = self.names.BEGINNING.table(known)
        known.address = known.table.ctypes.data

    def at(self, t: float, q: Array, v: Array) -> bool:
        """Whether the run is at its start at a state."""
        look, run, sure = self.look, self.run, False
        system = look.system
        weak = 0.0 if system.constant_mass and system.made.get("no weak mass", False) else SINGULAR_MASS
        while True:
            numbers = t, q, v, look.sizes(), weak, self._definite, sure
            try:
                code = self._begin(run.kit, self._given, run.work, self._known, *numbers)
            except Exception:  # of a callback, which is called by itself then
                return False
            if code != self.names.IN_DOUBT:
                return bool(code == self.names.READY)
            sure = look.is_surely(0, t, q, v)
            if not sure:
                return False


def _expected(choice: Choice | None) -> tuple[NDArray[np.int64], float]:
    """A choice as kernels have it, and its scale."""
    if choice is None:
        return np.zeros(0, dtype=np.int64), 1.0
    place = int(np.searchsorted(-LEAST, -choice.least))
    numbers = place, len(choice.rows), len(choice.added), *choice.rows, *choice.added
    return np.array(numbers, dtype=np.int64), choice.scale
