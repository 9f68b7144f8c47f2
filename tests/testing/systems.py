"""Problems of `twoloop.testing` as systems of `twoloop`."""

from twoloop import ConstrainedSystem

KINDS = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")


def system_of(problem):
    functions = {kind: getattr(problem, kind) for kind in KINDS}
    return ConstrainedSystem.from_python(n_q=problem.n_q, n_c=problem.n_c, name=problem.name, **functions)
