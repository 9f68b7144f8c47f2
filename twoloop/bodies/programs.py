"""Evaluate callbacks of models in which motions, rows or forces are functions, traced to programs stored in p."""

from twoloop.bodies.callbacks import fill_rows, fill_values, motion_results
from twoloop.bodies.forces import fill_force, force_results
from twoloop.bodies.read_tables import fill_nonholonomic, fill_nonholonomic_gamma
from twoloop.kernels.compile.callbacks import callback


@callback("force")
def force(t, q, v, p, Q):
    fill_force(q, v, p, force_results(t, q, v, p), Q)


@callback("constraint")
def constraint(t, q, p, C):
    fill_rows(q, q, p, motion_results(t, q, q, p), C, None, None, None)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    fill_rows(q, q, p, motion_results(t, q, q, p), None, Cq, None, None)


@callback("jacobian_values")
def jacobian_values(t, q, p, values):
    fill_values(q, p, motion_results(t, q, q, p), values)


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    fill_rows(q, q, p, motion_results(t, q, q, p), None, None, Ct, None)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    fill_rows(q, v, p, motion_results(t, q, v, p), None, None, None, Qd)


@callback("kinematics")
def kinematics(t, q, v, p, C, Cq, Ct, Qd):
    fill_rows(q, v, p, motion_results(t, q, v, p), C, Cq, Ct, Qd)


@callback("nonholonomic")
def nonholonomic(t, q, p, A):
    fill_nonholonomic(p, motion_results(t, q, q, p), A)


@callback("nonholonomic_gamma")
def nonholonomic_gamma(t, q, v, p, Qa):
    fill_nonholonomic_gamma(p, motion_results(t, q, v, p), Qa)
