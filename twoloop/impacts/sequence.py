"""Follow, one by one, impacts that succeed one another too fast for an integration between them."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array
from twoloop.impacts.forces import Tangents, impulses

MAX_HITS = 20_000  # largest number of impacts of a sequence; more than 10,000 occur with mass ratios of 1e8
MIN_RATE_RATIO = 1e-11  # largest rate, relative to the fastest closing rate, of a sequence that has died out


class ImpactWarning(UserWarning):
    """Warn that the outcome of impacts depends on their law, or that they were too many to follow.

    Examples
    --------
    >>> import warnings
    >>> from twoloop.impacts.sequence import ImpactWarning
    >>> warnings.simplefilter("ignore", ImpactWarning)  # or set `law` of `solve_with_stops`
    """


class Sequence(NamedTuple):
    """Impulses, drift and duration of a sequence of impacts.

    Attributes
    ----------
    impact_impulses : list of ndarray (k + n_tangents,)
        Impulses of each impact, of the stops and of their friction.
    drift : ndarray (k + n_tangents,)
        Integral of the impulses over the sequence: the displacement is v t + X drift.
    duration : float
        s.
    has_shared_impacts : bool
        Whether stops that touch shared an impact.
    is_complete : bool
        Whether the sequence ended or died out, within its duration and number of impacts.
    """

    impact_impulses: list[Array]
    drift: Array
    duration: float
    has_shared_impacts: bool
    is_complete: bool

    @property
    def impulses(self) -> Array:
        """Return the sum of the impulses over the sequence."""
        return sum(self.impact_impulses, 0.0 * self.drift)


class Impacts:
    """Data of impacts at a fixed position: between them, gaps change at constant rates.

    Parameters
    ----------
    D : ndarray (k + n_tangents, k + n_tangents)
        Changes of the rates by unit impulses, of the stops and of their friction.
    restitution : ndarray (k,)
    tangents : Tangents
    noise : float
        Largest gap that counts as closed; stops with such gaps close at the same time.
    min_rates : ndarray (k,)
        For each stop, the smallest rate that is not a rounding error.
    law : str or None
        Law of an impact that several stops share, see `impulses`.
    deadline : float
        Time of `time.monotonic()` after which no more impacts are followed.
    """

    def __init__(
        self,
        D: Array,
        restitution: Array,
        tangents: Tangents,
        noise: float,
        min_rates: Array,
        law: str | None,
        deadline: float,
    ):
        self.D, self.restitution, self.tangents, self.law = D, restitution, tangents, law
        self.noise, self.min_rates, self.n_stops, self.deadline = noise, min_rates, len(restitution), deadline

    def joint_impulses(self, stops: NDArray[np.int64], rates: Array, restitution: Array) -> Array:
        """Return the impulses (k + n_tangents,) of one impact that all `stops` share."""
        P = np.zeros(len(rates))
        index_of_stop = {int(k): i for i, k in enumerate(stops)}
        friction_indices = [i for i, k in enumerate(self.tangents.normal.tolist()) if k in index_of_stop]
        if len(stops) == 1 and not friction_indices:
            k = stops[0]
            P[k] = max(0.0, -(1.0 + restitution[k]) * rates[k] / self.D[k, k])
            return P
        rows = np.append(stops, [self.n_stops + i for i in friction_indices]).astype(np.int64)
        normal = np.array([index_of_stop[int(self.tangents.normal[i])] for i in friction_indices], dtype=np.int64)
        tangents = Tangents(
            normal, self.tangents.coefficient[friction_indices], np.zeros(len(friction_indices), dtype=np.int64)
        )
        P[rows] = impulses(self.D[np.ix_(rows, rows)], rates[rows], restitution[stops], tangents, self.law)
        return P

    def follow(self, gaps: Array, rates: Array, limit: float, together: bool) -> Sequence:
        """Follow the impacts until no stop closes within the time limit, or their rates have died out.

        Parameters
        ----------
        gaps, rates : ndarray (k,), ndarray (k + n_tangents,)
        limit : float
            Longest duration, s.
        together : bool
            Whether stops that touch share an impact. False: the stop that closes fastest is hit first.
        """
        n, D = self.n_stops, self.D
        g, u = np.maximum(gaps, 0.0), rates.copy()
        total, drift, elapsed = np.zeros(len(u)), np.zeros(len(u)), 0.0
        impact_impulses: list[Array] = []
        has_shared_impacts = False
        closing = u[:n] < -self.min_rates
        # to detect a collapse, rates are compared with the largest closing rate so far
        fastest, involved = float(-u[:n].min(initial=0.0)), np.zeros(n, dtype=bool)
        for _ in range(MAX_HITS):
            closing = u[:n] < -self.min_rates
            if not closing.any():
                return Sequence(impact_impulses, drift, elapsed, has_shared_impacts, True)
            if time.monotonic() > self.deadline:
                return Sequence(impact_impulses, drift, elapsed, has_shared_impacts, False)
            times = np.full(n, np.inf)
            times[closing] = np.where(g[closing] <= self.noise, 0.0, g[closing] / -u[:n][closing])
            waiting_time = float(times.min())
            if elapsed + waiting_time > limit:
                return Sequence(impact_impulses, drift, elapsed, has_shared_impacts, True)
            drift += total * waiting_time
            elapsed += waiting_time
            g = np.maximum(g + waiting_time * u[:n], 0.0)
            closes_now = closing & (times <= waiting_time)
            g[closes_now] = 0.0
            if together:
                stops = np.flatnonzero((g <= self.noise) & (u[:n] <= self.min_rates))
                has_shared_impacts |= len(stops) > 1
            else:
                stops = np.array([int(np.flatnonzero(closes_now)[np.argmin(u[:n][closes_now])])])
            P = self.joint_impulses(stops, u, self.restitution)
            u += D @ P
            total += P
            impact_impulses.append(P)
            involved[stops] = True
            if (
                len(impact_impulses) > 2
                and np.abs(u[:n][involved & (g <= limit * fastest)]).max() <= MIN_RATE_RATIO * fastest
            ):
                break
        else:
            return Sequence(impact_impulses, drift, elapsed, has_shared_impacts, False)
        # limit of infinitely many impacts: the remaining closing rates become zero
        P = self.joint_impulses(np.flatnonzero(involved & (g <= limit * fastest)), u, np.zeros(n))
        return Sequence([*impact_impulses, P], drift, elapsed, has_shared_impacts, True)
