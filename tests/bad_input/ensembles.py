"""Ensembles, many starts and integrators that cannot be made."""

import numpy as np

from tests.bad_input.case import cases_of
from twoloop import Integrator, consistent_states, ensemble
from twoloop.mechanisms import four_bar

LINKAGE = four_bar()
THREE = np.tile(LINKAGE.q0, (3, 1))


def many(q0=THREE, system=LINKAGE.system, **options):
    return ensemble(system, (0.0, 0.1), q0, LINKAGE.v0, **options)


def states(q=THREE, v=LINKAGE.v0, t=0.0, **options):
    return consistent_states(LINKAGE.system, t, q, v, **options)


def moved(run, by):
    q = THREE.copy()
    q[run] += by
    return q


of_ensemble, of_states = cases_of("ensemble"), cases_of("consistent_states")
of_integrator = cases_of("Integrator")
A_ROW = "give a row for each run, or one for all"
ENSEMBLES = [
    of_ensemble("starts as columns", lambda: many(THREE.T), r"q0 must have shape \(9,\) or \(n_runs, 9\)", A_ROW),
    of_ensemble("fewer parameters than runs", lambda: many(parameters=np.ones((2, 4)))).says("a row for each run; rows given: q0 3, parameters 2", A_ROW),
    of_ensemble("one vector of parameters", lambda: many(parameters=[1.0, 2.0, 1.5, 3.0])).says(r"parameters must have shape \(n_runs, 4\)", "give a row for each run, or `system.with_parameters(p)`"),
    of_ensemble("a start off the constraints", lambda: many(moved(2, 0.1))).says("run 2: q0 is not consistent", "put all starts on the constraints by `consistent_states`"),
    of_ensemble("a start with a NaN", lambda: many(moved(1, np.nan)), r"q0 must be finite; row 1 is not: given \[nan", "find out where the NaN comes from"),
    of_ensemble("one start for all runs, with a NaN", lambda: many(np.r_[0.0, np.nan, LINKAGE.q0[2:]]), r"q0 must be finite; entries \[1\] are not: given \[nan\]", "find out where the NaN comes from"),
    of_ensemble("`threads=0`", lambda: many(threads=0), "threads must be at least 1", "leave it out: all cores"),
    of_ensemble("a problem in place of its system", lambda: many(system=LINKAGE)).says("give its system, problem.system", "give `problem.system`", TypeError),
    of_states("guesses as columns", lambda: states(THREE.T), r"q must have shape \(9,\) or \(n_runs, 9\)", A_ROW),
    of_states("a guess whose crank points elsewhere", lambda: states(moved(1, 2.5 * np.eye(9)[2]))).says("guess 1: q does not say on which assembly", "give a guess that is nearer to an assembled position"),
    of_states("`keep=[9]` of nine coordinates", lambda: states(keep=[9]), "keep must hold indices", "count from 0"),
    of_integrator("`tol=1e-6`", lambda: Integrator(LINKAGE.system, tol=1e-6)).says("Integrator has no option 'tol'", "give `rtol` and `atol`", TypeError),
    of_integrator("`max_step=-1.0`", lambda: Integrator(LINKAGE.system, max_step=-1.0)).says("max_step must be positive; given -1.0", "give a positive number of seconds"),
    of_integrator("`compiled='yes'`", lambda: Integrator(LINKAGE.system, compiled="yes")).says("compiled must be True, False or 'auto'", "take one of the values named"),
    of_integrator("`events=3`", lambda: Integrator(LINKAGE.system, events=3)).says("events must be a function event", "give event(t, q, v)", TypeError),
    of_integrator("other parameters than there are").when(lambda: Integrator(LINKAGE.system).run((0.0, 1.0), LINKAGE.q0, LINKAGE.v0, [1.0])).says("parameters of 'four-bar' must be 4 numbers", "give as many as `system.parameters` has"),
]
