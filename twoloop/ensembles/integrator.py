"""Integrator: the same system, method and tolerances for run after run."""

from __future__ import annotations  # ArrayLike stays a word in help()

import copy
import inspect
from typing import Any

from numpy.typing import ArrayLike

from twoloop.checks.arguments import check_positive, check_tolerance
from twoloop.methods.plan import Method
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.solve import check_method, solve_dae

MOST = 64  # systems of other parameters that are kept
OF_A_RUN = {"system", "t_span", "q0", "v0", "method", "rtol", "atol", "t_eval"}


class Integrator:
    """A system with a method and tolerances, for many runs one after another.

    What does not change from run to run is made once and kept: plans, machine code, checks of the same start, and for
    the latest parameters the systems that they make. For thousands of runs at once see `ensemble`.

    Parameters
    ----------
    system : ConstrainedSystem
    method, rtol, atol
        As for `solve_dae`.
    **options
        Further keyword arguments of `solve_dae`, of all runs: events, compiled, max_step, ...

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, naming it.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        method: str | Method = "auto",
        rtol: float = 1e-8,
        atol: ArrayLike = 1e-8,
        **options: Any,
    ):
        check_system(system)
        known = inspect.signature(solve_dae).parameters.keys() - OF_A_RUN
        unknown = [name for name in options if name not in known]
        if unknown:
            raise TypeError(f"Integrator has no option {unknown[0]!r}; its options are {', '.join(sorted(known))}")
        check_positive("rtol", rtol)
        check_tolerance("atol", atol, system.n_q)
        self.system = system
        self._options = {"method": check_method(method), "rtol": rtol, "atol": copy.copy(atol), **options}
        self._systems: dict[bytes, ConstrainedSystem] = {}

    def run(
        self,
        t_span: tuple[float, float],
        q0: ArrayLike,
        v0: ArrayLike,
        parameters: ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
    ) -> Result:
        """Integrate from a consistent start, with other parameters where these are given.

        Parameters
        ----------
        t_span, q0, v0, t_eval
            As for `solve_dae`.
        parameters : array_like, optional
            The vector `p` of this run. None: that of the system.

        Returns
        -------
        Result

        Raises
        ------
        TypeError, ValueError
            As `solve_dae` and `ConstrainedSystem.with_parameters`.
        """
        system = self.system if parameters is None else self._system_of(parameters)
        return solve_dae(system, t_span, q0, v0, t_eval=t_eval, **self._options)

    def _system_of(self, parameters: ArrayLike) -> ConstrainedSystem:
        made = self.system.with_parameters(parameters)
        kept = self._systems.setdefault(made.parameters.tobytes(), made)
        if len(self._systems) > MOST:
            del self._systems[next(iter(self._systems))]
        return kept

    def __repr__(self) -> str:
        told = (self._options[name] for name in ("method", "rtol", "atol"))
        return "<Integrator of {!r}: {}, rtol {}, atol {}>".format(
            self.system.name, *(getattr(x, "name", x) for x in told)
        )
