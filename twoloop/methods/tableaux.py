"""Runge-Kutta tableaux, generated for any number of stages.

Each family is the collocation method at its nodes. Symplectic families average this method with its symplectic adjoint:
A_S = (A + B)/2 with B_ij = b_j (1 - A_ji / b_i). Sun's Radau IIB is this average for Radau IIA (its 3-stage tableau is
Table 1 of Zhang & Zhang 2016), and Lobatto IIIE is this average for Lobatto IIIA.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Legendre
from numpy.typing import NDArray

from twoloop.checks.arguments import check_real, check_size, check_text, check_vector, shaped, shown, wrong_entries

Array = NDArray[np.float64]

ROUNDING_OF_SUM = 1e-12  # largest rounding error of a sum of coefficients, relative to the sum of their magnitudes
MAX_STAGES = 100  # largest number of stages: with more stages, steps would be longer than any motion stays smooth


@dataclass(frozen=True, eq=False)
class Tableau:
    """Coefficients of a Runge-Kutta method, checked when the tableau is created.

    Attributes
    ----------
    name : str
        Family and number of stages.
    A : ndarray (s, s)
    b, c : ndarray (s,)
        Weights and nodes; c = A 1, so that time-dependent problems are integrated consistently.
    order : int
        Classical order, on which step-size control relies; it is not checked, except that b must sum to 1.

    Raises
    ------
    TypeError, ValueError
        If shapes do not fit, a coefficient is not finite, b does not sum to 1, or c is not A 1.

    Examples
    --------
    >>> from twoloop.methods.tableaux import gauss
    >>> tableau = gauss(3)
    >>> tableau.A.shape, round(float(tableau.b.sum()), 12)
    ((3, 3), 1.0)
    """

    name: str
    A: Array
    b: Array
    c: Array
    order: int

    def __post_init__(self) -> None:
        check_text("name", self.name)
        b = check_real("b", self.b)
        if b.ndim != 1 or b.size == 0:
            raise ValueError(f"b must be a vector with one weight for each stage; given {shaped(b)}")
        s = b.size
        A = check_real("A", self.A)
        if A.shape != (s, s):
            raise ValueError(f"A must have shape ({s}, {s}), as b has {s} entries; given {shaped(A)}")
        if not np.isfinite(A).all():
            raise wrong_entries("A", "finite", A, ~np.isfinite(A))
        check_vector("b", b, s)
        c = check_vector("c", self.c, s)
        check_size("order", self.order, 1)
        if abs(b.sum() - 1.0) > ROUNDING_OF_SUM * np.abs(b).sum():
            raise ValueError(f"b must sum to 1; the sum of {b.tolist()} is {float(b.sum())!r}")
        errors = np.abs(A.sum(axis=1) - c)
        if (errors > ROUNDING_OF_SUM * np.maximum(np.abs(A).sum(axis=1), 1.0)).any():
            i = int(errors.argmax())
            raise ValueError(
                f"c must be the row sums of A, so that time is integrated as the state is; row {i} of A sums to "
                f"{float(A[i].sum())!r}, and c[{i}] is {float(c[i])!r}"
            )
        for name, array in (("A", A), ("b", b), ("c", c)):
            object.__setattr__(self, name, array)

    @property
    def content(self) -> tuple[object, ...]:
        """Return name, order and coefficients as a key by which tableaux are compared."""
        return self.name, self.order, self.A.tobytes(), self.b.tobytes(), self.c.tobytes()

    @property
    def stages(self) -> int:
        """Return the number of stages s."""
        return len(self.b)

    @property
    def symplectic(self) -> bool:
        """Return whether b_i a_ij + b_j a_ji = b_i b_j (Sanz-Serna 1988), to rounding."""
        bA = self.b[:, None] * self.A
        return bool(np.abs(bA + bA.T - np.outer(self.b, self.b)).max() < 1e-14)


def _nodes(polynomial: Legendre) -> Array:
    """Return the roots (s,) of a Legendre series, mapped to [0, 1] and improved by Newton's method."""
    x = np.sort(np.real(polynomial.roots()))
    derivative = polynomial.deriv()
    for _ in range(3):
        x = x - polynomial(x) / derivative(x)
    return np.asarray((1.0 + x) / 2.0)


def _collocation(c: Array) -> tuple[Array, Array]:
    """Return A (s, s) and b (s,) of the collocation method at the nodes c, in the well-conditioned Legendre basis."""
    s = len(c)
    x = 2.0 * c - 1.0
    basis = [Legendre.basis(k) for k in range(s)]
    values = np.column_stack([p(x) for p in basis])
    integrals = np.column_stack([p.integ(lbnd=-1)(x) / 2.0 for p in basis])
    A = np.asarray(np.linalg.solve(values.T, integrals.T).T, dtype=np.float64)
    b = np.asarray(np.linalg.solve(values.T, np.eye(s)[0]), dtype=np.float64)  # the integrals of P_1, P_2, ... are zero
    return A, b


def _symplectic_average(A: Array, b: Array) -> Array:
    return 0.5 * (A + b[None, :] * (1.0 - A.T / b[:, None]))


def _check_stages(s: int, minimum: int, family: str) -> None:
    if isinstance(s, bool) or not isinstance(s, (int, np.integer)):
        raise TypeError(f"s must be an int, the number of stages of {family}; given {s!r} of type {type(s).__name__}")
    if s < minimum:
        raise ValueError(f"s must be at least {minimum} for {family}; given {s}")
    if s > MAX_STAGES:
        raise ValueError(f"s must be at most {MAX_STAGES} for {family}; given {shown(s)}")


def gauss(s: int) -> Tableau:
    """Return the Gauss tableau with s >= 1 stages: order 2s, symplectic and symmetric.

    Examples
    --------
    >>> from twoloop.methods.tableaux import gauss
    >>> tableau = gauss(2)
    >>> tableau.order, tableau.b.round(12).tolist()
    (4, [0.5, 0.5])
    """
    _check_stages(s, 1, "gauss")
    c = _nodes(Legendre.basis(s))
    A, b = _collocation(c)
    return Tableau(f"Gauss({s})", A, b, A.sum(axis=1), 2 * s)


def radau_iia(s: int) -> Tableau:
    """Return the Radau IIA tableau with s >= 1 stages: order 2s - 1, stiffly accurate, L-stable, not symplectic.

    Examples
    --------
    >>> from twoloop.methods.tableaux import radau_iia
    >>> tableau = radau_iia(3)
    >>> tableau.order, tableau.stages
    (5, 3)
    """
    _check_stages(s, 1, "radau_iia")
    c = _nodes(Legendre.basis(s) - Legendre.basis(s - 1))
    A, b = _collocation(c)
    return Tableau(f"Radau IIA({s})", A, b, A.sum(axis=1), 2 * s - 1)


def sun_radau_iib(s: int) -> Tableau:
    """Return Sun's symplectic Radau II ("IIB") tableau with s >= 1 stages: order 2s - 1; s = 3 is Table 1 of the paper.

    It has the stability function of the Gauss method: |R(iy)| = 1 and R(infinity) = +-1, no damping. With s = 1 it is
    the implicit midpoint rule, of order 2.

    Examples
    --------
    >>> from twoloop.methods.tableaux import sun_radau_iib
    >>> tableau = sun_radau_iib(3)
    >>> tableau.order, tableau.stages
    (5, 3)
    """
    _check_stages(s, 1, "sun_radau_iib")
    base = radau_iia(s)
    A = _symplectic_average(base.A, base.b)
    return Tableau(f"Sun Radau IIB({s})", A, base.b, A.sum(axis=1), max(2, 2 * s - 1))


def lobatto_iiie(s: int) -> Tableau:
    """Return the Lobatto IIIE tableau with s >= 2 stages: order 2s - 2, symplectic and symmetric.

    Examples
    --------
    >>> from twoloop.methods.tableaux import lobatto_iiie
    >>> tableau = lobatto_iiie(3)
    >>> tableau.order, tableau.stages
    (4, 3)
    """
    _check_stages(s, 2, "lobatto_iiie")
    c = _nodes(Legendre.basis(s) - Legendre.basis(s - 2))
    A, b = _collocation(c)
    A = _symplectic_average(A, b)
    return Tableau(f"Lobatto IIIE({s})", A, b, A.sum(axis=1), 2 * s - 2)
