"""An assembled model: a problem with named parameters, which can be reassembled with other values."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from twoloop.bodies.assembly import Freedom
from twoloop.checks.arguments import check_finite
from twoloop.problem.description import Stop
from twoloop.problem.problem import Problem

if TYPE_CHECKING:
    from twoloop.bodies.model import Model


@dataclass(frozen=True)
class ModelProblem(Problem):
    """A `Problem` made of bodies and joints.

    `parameters` maps the names of all masses, positions, lengths, stiffnesses, ... to values, in the order in which
    they begin `system.parameters`. The rest of that vector encodes the topology and must not be changed.

    Attributes
    ----------
    freedom : Freedom
        Degrees of freedom, and the joints with redundant rows.
    stops : tuple of Stop
        For `solve_with_stops`.

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> pin = model.revolute("ground", bob, at=(0.0, 0.0), name="pin")
    >>> problem = model.problem((0.0, 1.0))
    >>> heavier = problem.with_parameters({"mass of bob": 3.0})
    >>> float(heavier.system.mass(0.0, heavier.q0)[0, 0])
    3.0
    """

    model: Model | None = field(default=None, repr=False)
    keep: tuple[int, ...] = field(default=(), repr=False)
    freedom: Freedom = field(default_factory=lambda: Freedom(0, 0, ()))
    stops: tuple[Stop, ...] = ()

    def place(self, name: str) -> int:
        """Return the index of a parameter in `system.parameters`, by its name with or without the unit.

        Raises
        ------
        ValueError
            If there is no parameter of that name.
        """
        return self._known(name)[1]

    def with_parameters(self, parameters: Mapping[str, float]) -> ModelProblem:
        """Return the same model with other values of some parameters, reassembled from this start.

        Parameters
        ----------
        parameters : mapping
            Values by name, with or without the unit.

        Returns
        -------
        ModelProblem
            Its start is near this one and has the velocities given with the bodies. Nothing is recompiled.

        Raises
        ------
        TypeError, ValueError
            If a name is unknown, a value is not finite, or the model cannot be assembled.
        """
        if not isinstance(parameters, Mapping):
            raise TypeError(f"parameters must be a mapping from names to numbers; given {parameters!r}")
        values = dict(self.parameters)
        for name, value in parameters.items():
            values[self._known(name)[0]] = check_finite(f"parameters[{name!r}]", value)
        if self.model is None:
            raise ValueError(
                f"{self.name!r} came from another process without its model, whose functions cannot travel: make it "
                "again, or give them names at the top level of a module"
            )
        return self.model.put_together(self.t_span, self.name, self.keep, values, self.q0)

    def __getstate__(self) -> dict[str, Any]:
        state = dict(vars(self))
        try:
            pickle.dumps(self.model)
        except Exception:  # e.g. a lambda
            state["model"] = None
        return state

    def _known(self, name: Any) -> tuple[str, int]:
        for place, known in enumerate(self.parameters):
            if name in (known, known.rpartition(" (")[0]):
                return known, place
        words = str(name).split()
        near = [known for known in self.parameters if words and words[-1] in known.split()]
        raise ValueError(f"{self.name!r} has no parameter {name!r}; it has {_listed(near or list(self.parameters))}")


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(map(repr, names[:6]))
    return shown if len(names) <= 6 else f"{shown} and {len(names) - 6} more: see problem.parameters"
