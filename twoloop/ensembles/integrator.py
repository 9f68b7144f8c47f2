"""Define `Integrator`: one system, method and tolerances for many runs, one after another."""

from __future__ import annotations  # so that help() shows the name ArrayLike

import copy
import inspect
import warnings
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.checks.arguments import check_finite, check_positive, check_tolerance, check_vector
from twoloop.checks.consistency import ConstraintWarning
from twoloop.methods.plan import Method
from twoloop.problem.events import check_events
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.run.options import check_method, options_of
from twoloop.run.record import record_of
from twoloop.run.sampled import SampledRun, SampledState
from twoloop.run.signals import signals_of
from twoloop.solve import solve_dae

MAX_SYSTEMS = 64  # largest number of cached systems with other parameters
OPTIONS_OF_START = {"method", "rtol", "atol", "max_step", "check_derivatives"}
DEFAULTS = {name: parameter.default for name, parameter in inspect.signature(solve_dae).parameters.items()}
# not options, but arguments of `run` or of the integrator itself
ARGUMENTS_OF_RUN = {"system", "t_span", "q0", "v0", "method", "rtol", "atol", "t_eval", "store"}


class Integrator:
    """Integrator of one system with a method and tolerances, for many runs one after another, or from sample to sample.

    Plans, machine code, checks of equal starts, and systems with the latest parameters are created once and cached.
    `start` and `step` integrate sample by sample; a copy of the integrator needs a new `start`. For thousands of runs
    at once see `ensemble`.

    Parameters
    ----------
    system : ConstrainedSystem
    method, rtol, atol
        As for `solve_dae`.
    **options
        Further keyword arguments of `solve_dae`, used in all runs: events, compiled, max_step, ...

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, naming it.

    Examples
    --------
    >>> from twoloop import Integrator
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> integrator = Integrator(problem.system, rtol=1e-6, atol=1e-6)
    >>> result = integrator.run((0.0, 1.0), problem.q0, problem.v0)
    >>> result.success
    True
    >>> _ = integrator.start(0.0, problem.q0, problem.v0)
    >>> integrator.step(0.01).t  # from sample to sample
    0.01
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
        names = DEFAULTS.keys() - ARGUMENTS_OF_RUN
        unknown = [name for name in options if name not in names]
        if unknown:
            raise TypeError(f"Integrator has no option {unknown[0]!r}; its options are {', '.join(sorted(names))}")
        option_values = {name: options.get(name, DEFAULTS[name]) for name in names - {"events"}}
        options_of(system, method, rtol, atol, **option_values)
        check_events(options.get("events"))
        self.system = system
        self._options = {"method": check_method(method), "rtol": rtol, "atol": copy.copy(atol), **options}
        self._systems: dict[bytes, ConstrainedSystem] = {}
        self._sampled: SampledRun | None = None
        self._started_system = system

    def run(
        self,
        t_span: tuple[float, float],
        q0: ArrayLike,
        v0: ArrayLike,
        parameters: ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
    ) -> Result:
        """Integrate from a consistent start, with other parameters if they are given.

        Parameters
        ----------
        t_span, q0, v0, t_eval
            As for `solve_dae`.
        parameters : array_like, optional
            Parameters `p` of this run. None: those of the system.

        Returns
        -------
        Result

        Raises
        ------
        TypeError, ValueError
            As `solve_dae` and `ConstrainedSystem.with_parameters`.
        """
        system = self.system if parameters is None else self._system_with(parameters)
        return solve_dae(system, t_span, q0, v0, t_eval=t_eval, **self._options)

    def start(self, t0: float, q0: ArrayLike, v0: ArrayLike, parameters: ArrayLike | None = None) -> SampledState:
        """Begin a motion that `step` continues, sample by sample.

        Parameters
        ----------
        t0 : float
            Time, s.
        q0, v0 : array_like (n_q,)
            Consistent coordinates and velocities.
        parameters : array_like, optional
            Parameters of the first sample. None: those of the system.

        Returns
        -------
        SampledState
            `.t`, `.q`, `.v`, `.a` and `.lam` at the start.

        Raises
        ------
        TypeError, ValueError
            If the start is refused, or the integrator has the method "Taylor" or "Lobatto16", or an option that only
            `run` supports.
        """
        for name in self._options.keys() - OPTIONS_OF_START:
            if self._options[name] not in (None, False, "auto"):
                raise ValueError(f"start takes no {name}, which is for run alone; the integrator was made with it")
        check_system(self.system)
        t0 = check_finite("t0", t0)
        n, rtol, max_step = self.system.n_q, self._options["rtol"], self._options.get("max_step", np.inf)
        check_positive("max_step", max_step, infinite=True)
        self._started_system = self.system if parameters is None else self._system_with(parameters)
        system = copy.copy(self.system)
        if self.system.parameters.size:
            system = self.system.with_parameters(self.system.parameters if parameters is None else parameters)
        atol = check_tolerance("atol", self._options["atol"], n)
        q, v = check_vector("q0", q0, n), check_vector("v0", v0, n)
        checks = self._options.get("check_derivatives", True)
        settings = self._options["method"], float(rtol), atol, float(max_step), checks
        with signals_of(system):
            self._sampled = SampledRun(system, *settings, t0, q, v)
        if self._sampled.run.rows_warning:
            warnings.warn(self._sampled.run.rows_warning, ConstraintWarning, stacklevel=2)
        return self._sampled.state

    def step(self, dt: float, inputs: Mapping[int, float] | ArrayLike | None = None) -> SampledState:
        """Integrate to the next sample, with inputs that are constant until then.

        The checks of `start` are not repeated. When inputs change, accelerations jump and the method restarts. Errors
        are controlled as in `run`. As in a run, the equations are evaluated at least every hundredth of the time since
        the start, so the first samples are divided into many steps. If a sample meets a force that is shorter than the
        time between evaluations, it is repeated with more evaluations. A `ConstraintWarning` then says that earlier
        samples may have missed such a force.

        Parameters
        ----------
        dt : float
            Duration of the sample, s.
        inputs : mapping from int to float, or array_like (n_p,), optional
            Parameters of the system that change, by their indices, or all parameters. They may enter only forces. None:
            no parameter changes. `problem.place("value of motor of shoulder")` is the index of a parameter of a model.

        Returns
        -------
        SampledState
            `.t`, `.q`, `.v`, `.a` and `.lam` at the end of the sample, under its inputs; read-only.

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong, an input enters more than forces, or there was no `start`.
        RuntimeError
            If the step fails; the message says why, like that of a run. `result()` has the samples before.
        """
        if self._sampled is None:
            raise ValueError("step goes on from a start: call integrator.start(t0, q0, v0) first")
        if self.system.enclosed is not None:
            check_system(self.system)
        if not (type(dt) is float and 0.0 < dt < np.inf):
            check_positive("dt", dt)
        t = self._sampled.t
        if t + dt == t:
            raise ValueError(f"dt must reach the next floating-point number after t = {t!r}; given {dt!r}")
        if inputs is not None:
            self._sampled.set_parameters(inputs)
        return self._sampled.step(float(dt))

    def result(self) -> Result:
        """Return the motion since `start`, at the ends of the samples: a `Result` to plot, animate and save.

        Returns
        -------
        Result
            It has no dense solution. `result.changes` says that inputs changed. Its energy is computed with the
            parameters of the system, whatever inputs changed; it has no energy if `start` was given other parameters.

        Raises
        ------
        ValueError
            If there was no `start`.
        """
        if self._sampled is None:
            raise ValueError("result has the samples since a start: call integrator.start(t0, q0, v0) first")
        atol = check_tolerance("atol", self._options["atol"], self.system.n_q)
        settings = {"method": self._options["method"].name, "rtol": float(self._options["rtol"]), "atol": atol}
        fields = self._sampled.fields() | settings | {"system": self._started_system, "compiled": False}
        return record_of(Result, fields)

    def _system_with(self, parameters: ArrayLike) -> ConstrainedSystem:
        system = self.system.with_parameters(parameters)
        cached = self._systems.setdefault(system.parameters.tobytes(), system)
        if len(self._systems) > MAX_SYSTEMS:
            del self._systems[next(iter(self._systems))]
        return cached

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the system and the options only: two integrators cannot share the arrays of a motion."""
        return partial(Integrator, self.system, **self._options), ()

    def __repr__(self) -> str:
        method, rtol, atol = (self._options[name] for name in ("method", "rtol", "atol"))
        return f"<Integrator of {self.system.name!r}: {method.name}, rtol {rtol}, atol {atol}>"
